"""Evidence of slip from joint states: features of contacts on moving links, and trees that weigh them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.core.slip import SlipDetector
from handtouch.core.stages.solve import VALUE_COUNT
from handtouch.percept.samples import ContactBuffer, ContactSamples
from handtouch.percept.slip_evidence import SLIP_FEATURES, SlipTrees, slip_features

FloatArray = NDArray[np.float64]
PERIOD_S, PADS = 0.005, 4


def turned(angle_rad: float) -> FloatArray:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def played(
    samples: int, *, rolls_mm_per_s: float = 0.0, slides_mm_per_s: float = 0.0, posed: bool = True
) -> dict[str, FloatArray]:
    """Features (PADS,) by name, of contacts on a plane; the first rolls on it or slides over it.

    A link of 10 mm radius; the others rest.
    """
    buffer = ContactBuffer(PADS, length=22)
    n, pads = PADS, np.arange(PADS)
    slip = SlipDetector(PERIOD_S, np.full((n, VALUE_COUNT), np.nan), np.zeros(n), np.zeros(n, np.int64),
                        np.zeros(n, np.uint32))  # fmt: skip
    for k in range(samples):
        way_m = 1e-3 * rolls_mm_per_s * k * PERIOD_S
        angle = way_m / 0.01
        sample = ContactSamples(pads, np.full(n, 10**9 + 5_000_000 * k), np.ones(n, np.uint32))
        sample["pad_m"] = np.array([[way_m, 0.0]] + [[0.0, 0.0]] * (n - 1))
        sample["total_current_a"] = np.full(n, 1e-3 * 1.01**k)
        on_link = np.array([turned(-angle) @ [0.0, 0.0, -0.01]] + [[0.0, 0.0, -0.01]] * (n - 1))
        slid_m = 1e-3 * slides_mm_per_s * k * PERIOD_S
        origin = np.array([[way_m + slid_m, 0.03 * p, 0.01 + 0.01 * (p % 2)] for p in pads])
        origin[1:, 0] = 0.02 * np.arange(n - 1)
        if posed:
            sample["position_m"] = on_link
            sample["palm_rotation"] = np.array([turned(angle)] + [np.eye(3)] * (n - 1))
            sample["palm_position_m"] = origin - np.array([0.0, 0.0, 0.01])
            sample["palm_normal"] = np.tile([0.0, 0.0, -1.0], (n, 1))
        buffer.add_samples(sample)
    values = slip_features(buffer, slip, pads, PERIOD_S)
    assert values.shape == (PADS, len(SLIP_FEATURES))
    return dict(zip(SLIP_FEATURES, values.T, strict=True))


def test_link_that_rolls_turns_and_does_not_move_against_the_object() -> None:
    found = played(22, rolls_mm_per_s=10.0)
    assert found["turned_rad_100ms"] == pytest.approx([0.1, 0, 0, 0], abs=1e-3)
    assert found["hand_turned_rad_100ms"] == pytest.approx([0.1] * PADS, abs=1e-3)
    assert found["moved_mm_50ms"] == pytest.approx([0.5, 0, 0, 0], abs=1e-9)
    assert found["relative_mm_50ms"][0] < 0.05


def test_link_that_slides_moves_against_the_object() -> None:
    found = played(22, slides_mm_per_s=10.0)
    assert found["turned_rad_100ms"] == pytest.approx(np.zeros(PADS), abs=1e-6)
    assert found["link_moved_mm_100ms"] == pytest.approx([1.0, 0, 0, 0], abs=1e-9)
    assert found["relative_mm_100ms"][0] == pytest.approx(1.0, rel=0.1)
    assert 0.0 < found["relative_std_mm_100ms"][0] < 1.0


def test_features_of_a_new_contact_or_without_joint_states_are_unknown() -> None:
    early = played(5)
    assert np.isfinite(early["moved_mm_20ms"]).all()
    assert np.isnan(early["moved_mm_50ms"]).all()
    assert np.isnan(early["turned_rad_50ms"]).all()
    without = played(22, posed=False)
    assert np.isfinite(without["log_current_change_100ms"]).all()
    assert np.isnan(without["relative_mm_50ms"]).all()
    assert without["log_current_change_10ms"] == pytest.approx(np.full(PADS, 2 * np.log(1.01)))


def test_trees_sum_the_value_of_the_leaf_of_each_and_unknown_is_not_above() -> None:
    first, second = SLIP_FEATURES.index("slipping"), SLIP_FEATURES.index("moved_mm_50ms")
    trees = SlipTrees(
        np.array([[first, second], [second, second]]),
        np.array([[0.5, 1.0], [2.0, 3.0]]),
        np.array([[1.0, 2.0, 4.0, 8.0], [10.0, 20.0, 40.0, 80.0]]),
    )
    features = np.full((3, len(SLIP_FEATURES)), np.nan)
    features[1, [first, second]] = 1.0, 1.5
    features[2, [first, second]] = 0.0, 5.0
    assert trees.log_odds(features).tolist() == [11.0, 18.0, 84.0]
    assert SlipTrees.from_text(trees.to_text()).log_odds(features).tolist() == [11.0, 18.0, 84.0]


def test_trees_of_an_unknown_feature_are_refused() -> None:
    with pytest.raises(ValueError, match="unknown features of slip: colour"):
        SlipTrees.from_text('[[["colour"], [0.5], [0.0, 1.0]]]')


def test_shipped_trees_expect_no_slip_of_a_contact_at_rest() -> None:
    features = np.stack(list(played(22).values()), axis=1)
    assert (SlipTrees.shipped().log_odds(features) < 0).all()
