"""Evidence of slip from the hand: motion of a contact, its link and the other links, and changes of current.

A centroid moves on a pad when its contact slips, but also when the link rolls on the object, or when the load
shifts to another part of the pad. Joint states distinguish these: a link that rolls turns, and its surface
moves with the object. `slip_features` computes what is known of each contact over windows of 10 to 100 ms,
and `SlipTrees`, boosted decision trees with the same test for all nodes of a level (A. Gulin et al. 2011,
"Winning the transfer learning track of Yahoo!'s Learning to Rank challenge with YetiRank"), the odds of slip.
benchmarks/train_slip.py trains them with simulated grasps of the tuning family.

Public names: `SLIP_FEATURES`, `FEATURE_WINDOW_S`, `slip_features`, `SlipTrees`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib import resources

import numpy as np
from numpy.typing import NDArray

from handtouch.core.slip import SlipDetector
from handtouch.percept.relative_motion import ContactLinkPoses
from handtouch.percept.samples import ContactBuffer, IntArray

FloatArray = NDArray[np.float64]

_WINDOWS_S = (0.01, 0.02, 0.05, 0.1)
_LINK_WINDOWS_S = (0.02, 0.05, 0.1)  # shorter ones show the noise of encoders alone
_HAND_WINDOWS_S = (0.05, 0.1)
FEATURE_WINDOW_S = max(_WINDOWS_S)
"""Longest time that features look back."""


def _named(name: str, windows_s: tuple[float, ...]) -> tuple[str, ...]:
    return tuple(f"{name}_{round(1e3 * s)}ms" for s in windows_s)


SLIP_FEATURES = (
    "log_ratio", "slipping", "slip_mm_per_s", "onset_age_s", "relative_force_rate_per_s",
    *_named("log_current_change", _WINDOWS_S),
    *_named("moved_mm", _WINDOWS_S),
    *_named("turned_rad", _LINK_WINDOWS_S),
    *_named("link_moved_mm", _LINK_WINDOWS_S),
    *_named("relative_mm", _LINK_WINDOWS_S),
    *_named("relative_std_mm", _LINK_WINDOWS_S),
    *_named("hand_turned_rad", _HAND_WINDOWS_S),
)  # fmt: skip
"""Names of features; each is NaN where a contact or its link's pose hasn't been known for long enough.

log_ratio to relative_force_rate: of the slip stage. Over windows: change of ln of the total current; way of
the centroid on the pad; rotation of the link in the palm; tangential way of the link's material at the
contact; that way relative to a rigid body on the hand's other contacts, and the deviation of that body's way
by geometry, for contacts each known within 0.1 mm; the largest rotation of a touched link of the hand."""
_MAX_LOG_RATIO = 60.0
_MIN_LOG_RATIO = -20.0
_MIN_FORCE_N = 0.05
_CONTACT_STD_M = 1e-4
_OBJECT_SPEED_STD_M_PER_S, _OBJECT_ROTATION_STD_RAD_PER_S = 0.3, 0.5  # priors of a held object
_MAX_HOLDING_LOG_RATIO = 3.0  # ln R of a contact that counts as sticking to the object


def slip_features(buffer: ContactBuffer, slip: SlipDetector, pads: IntArray, period_s: float) -> FloatArray:
    """Return features (k, len(SLIP_FEATURES)) of the contacts on pads (k,), from samples in the buffer.

    The buffer's fields are pad_m and total_current_a, and position_m, palm_position_m, palm_normal and
    palm_rotation where joint states are known; samples come every `period_s`.
    """
    state = {name: slip.column(name)[pads] for name in ("log_ratio", "slipping", "onset_age_s", "force_n")}
    slipping, log_ratio = state["slipping"], np.clip(state["log_ratio"], _MIN_LOG_RATIO, _MAX_LOG_RATIO)
    columns = [
        log_ratio,
        slipping,
        1e3 * np.hypot(*slip.column("slip_velocity_m_per_s")[pads].T),
        state["onset_age_s"],
        slip.column("force_rate_n_per_s")[pads] / np.maximum(state["force_n"], _MIN_FORCE_N),
    ]
    current, centroid = buffer.latest_field(pads, "total_current_a"), buffer.latest_field(pads, "pad_m")
    with np.errstate(invalid="ignore", divide="ignore"):
        back = [max(round(window_s / period_s), 1) for window_s in _WINDOWS_S]
        columns += [np.log(current / buffer.latest_field(pads, "total_current_a", b)) for b in back]
        columns += [
            1e3 * np.linalg.norm(centroid - buffer.latest_field(pads, "pad_m", b), axis=1) for b in back
        ]
    holding = (slipping == 0) & (log_ratio < _MAX_HOLDING_LOG_RATIO)
    turned, link_moved, relative, relative_std = [], [], [], []
    now, normal = ContactLinkPoses.from_buffer(buffer, pads), buffer.latest_field(pads, "palm_normal")
    for window_s in _LINK_WINDOWS_S:
        before = ContactLinkPoses.from_buffer(buffer, pads, max(round(window_s / period_s), 1))
        way = now.material_way_m(before)
        turned.append(_turned_rad(now, before))
        link_moved.append(1e3 * np.linalg.norm(_tangential(way, normal), axis=1))
        against_m, std_m = _relative_to_rigid(
            now.palm_m, normal, way, holding, buffer.hand_index[pads], window_s
        )
        relative.append(1e3 * against_m)
        relative_std.append(1e3 * std_m)
    of_hand = [
        _largest_of_hand(turned[_LINK_WINDOWS_S.index(s)], buffer.hand_index[pads]) for s in _HAND_WINDOWS_S
    ]
    return np.stack([*columns, *turned, *link_moved, *relative, *relative_std, *of_hand], axis=1)


def _turned_rad(now: ContactLinkPoses, before: ContactLinkPoses) -> FloatArray:
    """Return the angles (k,) by which links have turned, as their sines."""
    turn = now.rotation @ before.rotation.transpose(0, 2, 1)
    axis = np.stack(
        [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]],
        axis=1,
    )
    return np.asarray(np.linalg.norm(axis, axis=1) / 2)


def _tangential(way: FloatArray, normal: FloatArray) -> FloatArray:
    return np.asarray(way - normal * np.einsum("ki,ki->k", way, normal)[:, None])


def _relative_to_rigid(
    position_m: FloatArray,
    normals: FloatArray,
    moved_m: FloatArray,
    holding: NDArray[np.bool_],
    hand: IntArray,
    window_s: float,
) -> tuple[FloatArray, FloatArray]:
    """Return each contact's way (k,) [m] relative to a rigid body on its hand's other holding contacts.

    Also the standard deviation (k,) of a component of the body's way; both NaN without another contact.
    """
    n = len(holding)
    against, std = np.full(n, np.nan), np.full(n, np.nan)
    known = np.isfinite(moved_m).all(axis=1)
    for number in np.unique(hand[known]):
        rows = np.flatnonzero(known & (hand == number))
        holds = holding[rows].astype(np.float64)
        others = holds.sum() - holds
        position, normal, way = position_m[rows], normals[rows], moved_m[rows]
        x, y, z = (position - position.mean(axis=0)).T
        at = np.zeros((len(rows), 3, 6))  # way at a point: v + omega x offset
        at[:, [0, 1, 2], [0, 1, 2]] = 1.0
        at[:, 0, 4], at[:, 0, 5], at[:, 1, 3] = z, -y, -z
        at[:, 1, 5], at[:, 2, 3], at[:, 2, 4] = x, y, -x
        weight = holds / _CONTACT_STD_M**2
        own = weight[:, None, None] * (at.transpose(0, 2, 1) @ at)
        own_way = weight[:, None] * (at.transpose(0, 2, 1) @ way[:, :, None])[:, :, 0]
        prior = [(_OBJECT_SPEED_STD_M_PER_S * window_s) ** -2] * 3
        prior += [(_OBJECT_ROTATION_STD_RAD_PER_S * window_s) ** -2] * 3
        covariance = np.linalg.inv(np.diag(prior) + own.sum(axis=0) - own)
        motion = (covariance @ (own_way.sum(axis=0) - own_way)[:, :, None])[:, :, 0]
        off = _tangential(way - (at @ motion[:, :, None])[:, :, 0], normal)
        spread = at @ covariance @ at.transpose(0, 2, 1)
        along = np.einsum("ki,kij,kj->k", normal, spread, normal)
        variance = (np.trace(spread, axis1=1, axis2=2) - along) / 2
        against[rows] = np.where(others > 0, np.linalg.norm(off, axis=1), np.nan)
        std[rows] = np.where(others > 0, np.sqrt(np.maximum(variance, 0.0)), np.nan)
    return against, std


def _largest_of_hand(values: FloatArray, hand: IntArray) -> FloatArray:
    """Return for each row the largest value of its hand; 0 if none is known."""
    largest = np.zeros(int(hand.max()) + 1 if len(hand) else 0)
    np.maximum.at(largest, hand, np.nan_to_num(values))
    return largest[hand]


@dataclass(frozen=True, slots=True)
class SlipTrees:
    """Boosted trees of t trees and d levels; `features` and `thresholds` (t, d), `values` (t, 2^d)."""

    features: IntArray
    thresholds: FloatArray
    values: FloatArray

    @classmethod
    def shipped(cls) -> SlipTrees:
        """Return the trees of this package."""
        return _shipped()

    def log_odds(self, features: FloatArray) -> FloatArray:
        """Return ln of the odds of slip (k,) of contacts with features (k, len(SLIP_FEATURES))."""
        above = features[:, self.features] > self.thresholds  # NaN is not
        leaf = above @ (1 << np.arange(self.features.shape[1]))
        return np.asarray(self.values[np.arange(len(self.values)), leaf].sum(axis=1))

    def to_text(self) -> str:
        """Return the trees as JSON, with features by name."""
        names = [[SLIP_FEATURES[k] for k in row] for row in self.features.tolist()]
        parts = (names, self.thresholds.tolist(), self.values.tolist())
        lines = [json.dumps(tree) for tree in zip(*parts, strict=True)]
        return "[\n" + ",\n".join(lines) + "\n]\n"

    @classmethod
    def from_text(cls, text: str) -> SlipTrees:
        """Return the trees of `to_text`; raises ValueError for an unknown feature."""
        names, thresholds, values = zip(*json.loads(text), strict=True)
        if unknown := {name for row in names for name in row} - set(SLIP_FEATURES):
            raise ValueError(f"unknown features of slip: {', '.join(sorted(unknown))}")
        return cls(
            np.array([[SLIP_FEATURES.index(name) for name in row] for row in names], np.intp),
            np.array(thresholds, np.float64),
            np.array(values, np.float64),
        )


@cache
def _shipped() -> SlipTrees:
    return SlipTrees.from_text((resources.files("handtouch.percept") / "slip_trees.json").read_text())
