"""The features of touch: one layout from every source, and nothing unknown shown as zero."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from handtouch import wire
from handtouch.client.hand_arrays import HandArrays
from handtouch.client.window import HandWindow
from handtouch.learn import TouchFeatures
from handtouch.learn.features import MAX_AGE_S
from handtouch.wire import ForceStatus, PadState, PositionStatus
from tests.client.hand_messages import LINKS, make_frame

NAN = float("nan")
T_NS = 5_000_000_000
STATES = (PadState.TOUCHED, PadState.CLEAR, PadState.STALE)


def touching(seq: int = 1, grip_n: float = 2.0, t_ns: int = T_NS, **values: Any) -> wire.HandFrame:
    """Return a frame of a touched pad, a clear one and one that isn't sampled."""
    covariance = (1e-8, 0, 0, 0, 4e-8, 0, 0, 0, 4e-8)
    columns = {
        "state": STATES,
        "sample_ns": (t_ns - 1_000_000, t_ns - 2_000_000, t_ns - 400_000_000),
        "position_m": ((0.01, 0.02, 0.03), (NAN,) * 3, (0.5,) * 3),
        "covariance_m2": (covariance, (NAN,) * 9, covariance),
        "pad_m": ((0.004, 0.005), (NAN,) * 2, (0.1,) * 2),
        "position_status": (PositionStatus.VALID, 0, PositionStatus.VALID),
        "force_n": (grip_n, NAN, 7.0),
        "force_std_n": (0.2, NAN, 0.1),
        "force_status": (ForceStatus.VALID, 0, ForceStatus.VALID),
    }
    return make_frame(seq, t_ns=t_ns, **{**columns, **values})


def shown(features: TouchFeatures, values: Any) -> dict[str, float]:
    return dict(zip(features.names, np.asarray(values).tolist(), strict=True))


def test_a_touched_pad_has_its_values_and_a_clear_one_zero_newtons() -> None:
    features = TouchFeatures(LINKS)
    found = shown(features, features.of(HandArrays(touching())))
    touched, clear, unknown = LINKS
    expected = {"x_m": 0.01, "y_m": 0.02, "z_m": 0.03, "position_std_m": 3e-4, "force_n": 2.0}
    expected |= {"force_std_n": 0.2, "age_s": 1e-3, "sampled": 1, "touched": 1, "position_known": 1}
    expected |= {"position_valid": 1, "force_known": 1, "force_valid": 1}
    for name, value in expected.items():
        assert found[f"{touched}.{name}"] == pytest.approx(value), name
    assert [found[f"{clear}.{name}"] for name in ("sampled", "force_known", "force_valid")] == [1, 1, 1]
    assert [found[f"{clear}.{name}"] for name in ("touched", "position_known", "force_n")] == [0, 0, 0]
    assert found[f"{clear}.age_s"] == pytest.approx(2e-3)
    known = {name: value for name, value in found.items() if name.startswith(unknown) and value}
    assert known == {f"{unknown}.age_s": pytest.approx(0.4)}


@pytest.mark.parametrize("name", ["position_m", "force_n"])
def test_what_is_not_known_is_zero_and_its_flag_says_so(name: str) -> None:
    """A lower bound has a force, but no interval; nothing is ever NaN."""
    features = TouchFeatures(LINKS[:1])
    part = name.partition("_")[0]
    missing: dict[str, Any] = {"position_m": ((NAN,) * 3,) * 3, "force_n": (NAN,) * 3}
    found = shown(features, features.of(HandArrays(touching(**{name: missing[name]}))))
    assert found[f"{LINKS[0]}.{part}_known"] == found[f"{LINKS[0]}.{part}_valid"] == 0
    bound = touching(force_status=(ForceStatus.UNRELIABLE,) * 3, position_status=(2,) * 3)
    assert PositionStatus(2) == PositionStatus.UNRELIABLE
    found = shown(features, features.of(HandArrays(bound)))
    assert (found[f"{LINKS[0]}.{part}_known"], found[f"{LINKS[0]}.{part}_valid"]) == (1, 0)
    for states in PadState:
        values = features.of(HandArrays(touching(state=(states,) * 3)))
        assert np.isfinite(values).all()


def test_an_old_frame_shows_nothing_of_any_pad() -> None:
    features = TouchFeatures(LINKS)
    found = shown(features, features.of(HandArrays(touching()).as_old(), now_ns=T_NS + 10**10))
    assert {name for name, value in found.items() if value} == {f"{link}.age_s" for link in LINKS}
    assert found[f"{LINKS[0]}.age_s"] == MAX_AGE_S
    gone = features.of(SimpleNamespace(alive=False))  # a hand whose daemon is gone has no columns
    assert shown(features, gone) == found


def test_the_layout_is_the_same_from_a_frame_and_from_a_window() -> None:
    frames = [touching(seq, grip_n=0.1 * seq, t_ns=T_NS + 5_000_000 * seq) for seq in range(1, 9)]
    window = HandWindow(frames)
    features = TouchFeatures((LINKS[2], LINKS[0]), frame="pad")
    each = np.stack([features.of(HandArrays(frame)) for frame in frames])
    assert features.of(window).tobytes() == each.tobytes()
    assert features.of_window(window, 3).tobytes() == each[-3:].tobytes()
    padded = features.of_window(window, 10)
    assert padded[2:].tobytes() == each.tobytes()
    assert not padded[:2].any()
    assert features.of_window(HandWindow([]), 2).tobytes() == bytes(2 * 4 * features.size)


def test_values_are_within_the_declared_ranges_and_names() -> None:
    features = TouchFeatures(LINKS, frame="link")
    values = features.of(HandArrays(touching()))
    assert values.dtype == np.float32
    assert (values >= features.low).all()
    assert (values <= features.high).all()
    declared = features.declaration()
    assert declared["shape"] == values.shape == (features.size,)
    assert declared["names"] == features.names
    assert len(set(features.names)) == features.size
    assert all(feature.meaning for feature in features.features)


def test_pads_are_chosen_by_link_and_an_unknown_one_is_named() -> None:
    arrays = HandArrays(touching())
    one = TouchFeatures(LINKS[:1])
    assert one.of(arrays).tobytes() == TouchFeatures(LINKS).of(arrays)[: one.size].tobytes()
    named = [f"right/{link}" for link in LINKS]
    assert one.of(arrays, links=named).tobytes() == one.of(arrays).tobytes()
    with pytest.raises(LookupError, match=r"ring_tip.*index_tip"):
        TouchFeatures(("ring_tip",)).of(arrays)
    for links in ((), ("a", "a")):
        with pytest.raises(ValueError, match="links"):
            TouchFeatures(links)
    with pytest.raises(LookupError, match="palm"):  # no scene requests it
        TouchFeatures(LINKS, frame="palm").of(arrays)


def test_force_vectors_are_features_of_shear_pads() -> None:
    vectors: dict[str, Any] = {
        "force_vector_status": (ForceStatus.VALID, 0, 0),
        "force_vector_n": ((0.1, -0.2, -1.0), (NAN,) * 3, (NAN,) * 3),
        "force_vector_covariance_n2": ((0.04, 0, 0, 0, 0, 0, 0, 0, 0), (NAN,) * 9, (NAN,) * 9),
    }
    features = TouchFeatures(LINKS[:2], vector=True)
    found = shown(features, features.of(HandArrays(touching(**vectors))))
    touched, clear = LINKS[:2]
    assert [found[f"{touched}.force_{axis}_n"] for axis in "xyz"] == pytest.approx([0.1, -0.2, -1.0])
    assert found[f"{touched}.force_std_n"] == pytest.approx(0.2)
    assert found[f"{clear}.force_known"] == 1
