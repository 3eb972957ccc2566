"""Evidence of slip from joint states: features of contacts on moving links, and trees that weigh them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handtouch.core.stages.evidence import (
    ALONE_LOG_ODDS,
    MAX_OTHERS_LOG_ODDS,
    OTHERS_WEIGHT,
    SLIP_FEATURES,
)
from handtouch.core.stages.rows import VALUE_COUNT
from handtouch.core.stages.slip import SLIP_SLICES, SlipDetector
from handtouch.core.state import TickState
from handtouch.percept.samples import ContactBuffer, ContactSamples
from handtouch.percept.slip_evidence import SlipEvidence, SlipTrees

FloatArray = NDArray[np.float64]
PERIOD_S, PADS = 0.005, 4


def turned(angle_rad: float) -> FloatArray:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def detector(n: int) -> SlipDetector:
    """The slip stage of contacts that it knows nothing of."""
    values, times, ids = np.full((n, VALUE_COUNT), np.nan), np.zeros(n, np.int64), np.zeros(n, np.uint32)
    return SlipDetector(PERIOD_S, values, np.zeros(n), times, ids, TickState.empty(n))


def played(
    samples: int, *, rolls_mm_per_s: float = 0.0, slides_mm_per_s: float = 0.0, posed: bool = True
) -> dict[str, FloatArray]:
    """Features (PADS,) by name, of contacts on a plane; the first rolls on it or slides over it.

    A link of 10 mm radius; the others rest.
    """
    buffer = ContactBuffer(PADS, length=22)
    n, pads = PADS, np.arange(PADS)
    slip = detector(n)
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
    values = SlipEvidence(buffer, slip, PERIOD_S).features(pads)
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


class RandomHands:
    """Contacts that begin, end and move at random on two hands, with poses that are unknown at times."""

    PADS = 9
    HANDS = (0, 0, 0, 0, 0, 1, 1, 1, 1)

    def __init__(self, missing: float = 0.1) -> None:
        """missing: share of contacts without a sample in a tick; with 0, all last."""
        self.rng, self._missing = np.random.default_rng(4), missing
        self.buffer, self.slip = ContactBuffer(self.PADS, self.HANDS, 22), detector(self.PADS)
        self._ids, self._palm_m = np.ones(self.PADS, np.uint32), self.rng.normal(0.0, 0.03, (self.PADS, 3))

    def tick(self, k: int) -> NDArray[np.intp]:
        """Add a sample of most contacts; return their pads, in no order."""
        rng, n = self.rng, self.PADS
        self._ids += rng.random(n) < 0.2 * self._missing
        self._palm_m += rng.normal(0.0, 1e-4, (n, 3))
        pads = np.flatnonzero(rng.random(n) >= self._missing)
        m = len(pads)
        sample = ContactSamples(pads, np.full(m, 10**9 + 5_000_000 * k), self._ids[pads])
        sample["pad_m"] = rng.normal(0.0, 1e-3, (m, 2))
        sample["total_current_a"] = np.exp(rng.normal(-7.0, 1.0, m))
        if k % 50 < 45:
            sample["position_m"] = rng.normal(0.0, 1e-3, (m, 3))
            sample["palm_rotation"] = Rotation.random(m, rng).as_matrix()
            sample["palm_position_m"] = np.where(rng.random((m, 1)) < 0.05, np.nan, self._palm_m[pads])
            normal = rng.normal(size=(m, 3))
            sample["palm_normal"] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        self.buffer.add_samples(sample)
        state = {name: rng.normal(0.0, 3.0, n) for name in ("log_ratio", "force_n", "force_rate_n_per_s")}
        for name, values in {**state, "slipping": rng.random(n) < 0.3}.items():
            self.slip.state[:, SLIP_SLICES[name].start] = values
        return rng.permutation(pads)


def relative_to_body(
    buffer: ContactBuffer,
    pads: NDArray[np.intp],
    sticks: NDArray[np.bool_],
    pad: int,
    window_s: float,
    std_m: float = 1e-4,
    around: int | None = None,
) -> tuple[float, float]:
    """Way [mm] of a contact relative to the body on others that stick, and its deviation, by regression."""
    then = round(window_s / PERIOD_S)

    def field(name: str, of: int, back: int = 0) -> FloatArray:
        values = buffer.window(of, name)
        return values[-1 - back] if back < len(values) else np.full(values.shape[1:], np.nan)

    def way(of: int) -> FloatArray:
        turned = field("palm_rotation", of, then) @ (field("position_m", of) - field("position_m", of, then))
        return np.asarray(field("palm_position_m", of) - field("palm_position_m", of, then) - turned)

    known = [k for k in pads if buffer.hand_index[k] == buffer.hand_index[pad] and np.isfinite(way(k)).all()]
    others = [k for k in known if k != pad and sticks[k]]
    if pad not in known or not others:
        return np.nan, np.nan
    centre = np.mean([field("palm_position_m", k) for k in (known if around is None else [around])], axis=0)

    def point(of: int) -> FloatArray:
        x, y, z = field("palm_position_m", of) - centre
        return np.hstack([np.eye(3), [[0, z, -y], [-z, 0, x], [y, -x, 0]]])

    prior = np.diag(1 / (window_s * np.repeat([0.3, 0.5], 3)))
    rows = np.vstack([prior, *(point(k) / std_m for k in others)])
    covariance = np.linalg.inv(rows.T @ rows)
    body = covariance @ rows.T @ np.concatenate([np.zeros(6), *(way(k) / std_m for k in others)])
    normal, own = field("palm_normal", pad), point(pad)
    across = np.eye(3) - np.outer(normal, normal)
    spread = across @ own @ covariance @ own.T @ across
    off = across @ (way(pad) - own @ body)
    return 1e3 * float(np.linalg.norm(off)), 1e3 * float(np.sqrt(np.trace(spread) / 2))


def test_motion_against_other_contacts_is_that_of_least_squares() -> None:
    hands = RandomHands()
    evidence, compared = SlipEvidence(hands.buffer, hands.slip, PERIOD_S), 0
    for k in range(80):
        pads = hands.tick(k)
        found = evidence.features(pads)
        contacts = hands.slip.contacts()
        ratio, slipping = contacts.log_ratio, contacts.slipping
        for window_s in (0.02, 0.05, 0.1):
            at = SLIP_FEATURES.index(f"relative_mm_{1e3 * window_s:.0f}ms")
            true = [
                relative_to_body(hands.buffer, pads, (slipping == 0) & (ratio < 3), p, window_s) for p in pads
            ]
            assert found[:, [at, at + 3]] == pytest.approx(np.array(true), rel=1e-8, abs=1e-9, nan_ok=True)
            compared += int(np.isfinite(true).all(axis=1).sum())
    assert compared > 300


def test_odds_sum_the_evidence_of_a_hand_and_decay_by_one_in_50_ms() -> None:
    """Those of a hand's other contacts count with a weight; the odds of an only contact are higher."""
    hands = RandomHands(missing=0.4)
    evidence, expected = SlipEvidence(hands.buffer, hands.slip, PERIOD_S), np.full(RandomHands.PADS, np.nan)
    updated_ns = np.zeros(RandomHands.PADS, np.int64)
    for k in range(100):
        pads, now_ns = np.sort(hands.tick(k)), 10**9 + 5_000_000 * k
        evidence.update_odds(pads, now_ns)
        placed = np.isfinite(hands.buffer.latest_field(pads, "palm_position_m")[:, 0])
        expected[pads[~placed]] = np.nan
        due = pads[placed]
        passed_s = (now_ns - updated_ns[due]) * 1e-9
        kept = np.nan_to_num(expected[due], nan=-50.0) - passed_s / 0.05
        own = SlipEvidence(hands.buffer, hands.slip, PERIOD_S).features(due)
        found = SlipTrees.shipped().log_odds(own)
        hand, alone = hands.buffer.hand_index[due], found + ALONE_LOG_ODDS
        for row in range(len(due)):
            others = found[(hand == hand[row]) & (due != due[row])]
            if len(others):
                limited = np.clip(others.mean(), -MAX_OTHERS_LOG_ODDS, MAX_OTHERS_LOG_ODDS)
                alone[row] = found[row] + OTHERS_WEIGHT * limited
        found = alone
        expected[due] = np.maximum(found, kept)
        updated_ns[due] = now_ns
        assert evidence.log_odds == pytest.approx(expected, rel=1e-9, abs=1e-9, nan_ok=True)
    before = evidence.log_odds.copy()
    evidence.update_odds(pads, now_ns + 1_000_000)
    assert np.array_equal(evidence.log_odds, before, equal_nan=True)


def test_velocity_against_the_object_is_that_of_least_squares() -> None:
    hands = RandomHands(missing=0.0)
    evidence, compared = SlipEvidence(hands.buffer, hands.slip, PERIOD_S), 0
    for k in range(80):
        pads = hands.tick(k)
        log_odds = hands.rng.normal(-4.0, 4.0, hands.PADS)
        hands.slip.state[:, SLIP_SLICES["log_odds"].start] = log_odds
        sticks = (hands.slip.contacts().slipping == 0) & (log_odds <= -3)
        evidence.compute_velocities(10**9 + 5_000_000 * k)
        for pad in range(hands.PADS) if k > 12 else ():
            found = evidence.relative_motion(pad)
            way_mm, std_mm = relative_to_body(hands.buffer, pads, sticks, pad, 0.05, 5e-5, around=pad)
            if found is None or not found.contacts:
                assert np.isnan(way_mm)
                continue
            assert found.object == "grasp"
            assert np.linalg.norm(found.velocity) == pytest.approx(1e-3 * way_mm / 0.05, rel=1e-8)
            assert found.std == pytest.approx(np.hypot(1e-3, 1e-3 * std_mm / 0.05), rel=1e-8)
            compared += 1
    assert compared > 200


def path_features(path_m: FloatArray, current_a: FloatArray) -> dict[str, FloatArray]:
    """Features by name of the contact on one pad with this path (k, 2) and current (k,)."""
    buffer, pads = ContactBuffer(1, length=22), np.zeros(1, np.intp)
    for k, (place, current) in enumerate(zip(path_m, current_a, strict=True)):
        sample = ContactSamples(pads, np.full(1, 10**9 + 5_000_000 * k), np.ones(1, np.uint32))
        sample["pad_m"], sample["total_current_a"] = place[None], np.array([current])
        buffer.add_samples(sample)
    values = SlipEvidence(buffer, detector(1), PERIOD_S).features(pads)
    return dict(zip(SLIP_FEATURES, values.T, strict=True))


def test_load_that_shifts_moves_the_centroid_in_a_step_with_the_current() -> None:
    shifted = np.arange(21) > 12
    found = path_features(np.outer(shifted, [3e-4, 4e-4]), 1e-3 * np.where(shifted, 1.5, 1.0))
    assert found["step_mm_100ms"] == pytest.approx([0.5])
    assert found["straightness_100ms"] == pytest.approx([1.0])
    assert found["explained_by_current_100ms"] == pytest.approx([1.0], abs=1e-4)


def test_slip_at_constant_force_moves_the_centroid_steadily() -> None:
    found = path_features(np.outer(np.arange(21), [3e-5, 4e-5]), np.full(21, 1e-3))
    assert found["step_mm_100ms"] == pytest.approx([0.05])
    assert found["straightness_100ms"] == pytest.approx([1.0])
    assert found["explained_by_current_100ms"] == pytest.approx([0.0], abs=1e-9)


def test_chatter_returns_on_its_path() -> None:
    found = path_features(np.outer(np.arange(21) % 2, [1e-4, 0.0]), np.full(21, 1e-3))
    assert found["straightness_100ms"] == pytest.approx([0.0], abs=1e-9)


def test_path_of_a_new_contact_or_without_current_is_unknown() -> None:
    names = ("step_mm_100ms", "straightness_100ms", "explained_by_current_100ms")
    still = np.zeros((21, 2))
    for found in (path_features(still[:20], np.full(20, 1e-3)), path_features(still, np.zeros(21))):
        assert all(np.isnan(found[name]).all() for name in names)


def test_features_of_other_contacts_leave_out_the_contact_itself() -> None:
    hands = RandomHands()
    evidence, at = SlipEvidence(hands.buffer, hands.slip, PERIOD_S), SLIP_FEATURES.index("others_slipping")
    for k in range(60):
        pads = hands.tick(k)
        found = evidence.features(pads)
        change = np.abs(found[:, SLIP_FEATURES.index("log_current_change_20ms")])
        for row, pad in enumerate(pads):
            others = (hands.buffer.hand_index[pads] == hands.buffer.hand_index[pad]) & (pads != pad)
            known = change[others & np.isfinite(change)]
            expected = (
                found[others, SLIP_FEATURES.index("slipping")].sum(),
                found[others, SLIP_FEATURES.index("log_ratio")].max(initial=-20.0),
                known.mean() if len(known) else np.nan,
            )
            assert found[row, at : at + 3] == pytest.approx(expected, rel=1e-9, nan_ok=True)
