"""Evidence of slip by joint states: features of contacts on moving links, and boosted trees that sum it.

Contacts on one rigid object slip together, and each shows it in its own way, so the odds of a contact include
the evidence of the hand's other contacts.

Public names: `EvidenceStage`, `SLIP_FEATURES`, `EVIDENCE_WINDOWS_S`, `EVIDENCE_FIELDS`,
`ALONE_LOG_ODDS`, `OTHERS_WEIGHT`, `MAX_OTHERS_LOG_ODDS`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from handtouch.core.memory import RowArray, number_memory, row_count, view_memory, view_rows

_WINDOW_MS = (10, 20, 50, 100)
_LINK_WINDOW_MS = (20, 50, 100)  # shorter ones show the noise of encoders alone
_HAND_WINDOW_MS = (50, 100)
FEATURE_ROW = np.dtype(
    [
        ("log_ratio", "<f8"),
        ("slipping", "<f8"),
        ("slip_mm_per_s", "<f8"),
        ("onset_age_s", "<f8"),
        ("relative_force_rate_per_s", "<f8"),
        ("log_current_change", "<f8", len(_WINDOW_MS)),
        ("moved_mm", "<f8", len(_WINDOW_MS)),
        ("turned_rad", "<f8", len(_LINK_WINDOW_MS)),
        ("link_moved_mm", "<f8", len(_LINK_WINDOW_MS)),
        ("relative_mm", "<f8", len(_LINK_WINDOW_MS)),
        ("relative_std_mm", "<f8", len(_LINK_WINDOW_MS)),
        ("hand_turned_rad", "<f8", len(_HAND_WINDOW_MS)),
        ("others_slipping", "<f8"),
        ("others_log_ratio", "<f8"),
        ("others_current_change_20ms", "<f8"),
        ("step_mm_100ms", "<f8"),
        ("straightness_100ms", "<f8"),
        ("explained_by_current_100ms", "<f8"),
        ("palm_moved_mm_100ms", "<f8"),
    ]
)
"""Features of a contact, those over windows from the shortest to the longest"""
_WINDOWS_MS = {len(windows): windows for windows in (_WINDOW_MS, _LINK_WINDOW_MS, _HAND_WINDOW_MS)}
SLIP_FEATURES = tuple(
    f"{name}_{ms}ms" if ms else name
    for name in FEATURE_ROW.names or ()
    for ms in _WINDOWS_MS.get(row_count(FEATURE_ROW[name]), (0,))
)
"""Names of features; each is NaN where a contact or its link's pose hasn't been known for long enough.

log_ratio to relative_force_rate: of the slip stage. Over windows: change of ln of the total current; way of
the centroid on the pad; rotation of the link in the palm; tangential way of the link's material at the
contact; that way relative to a rigid body on the hand's other contacts, and the deviation of that body's way
by geometry, for contacts each known within 0.1 mm; the largest rotation of a touched link of the hand.

others: of the hand's other contacts, the number that slip by the slip stage, the largest log_ratio, and the
mean absolute change of ln of the current. step to palm_moved: of the centroid's path on the pad, in samples
5 ms apart, the longest step, the way over the length, and the share of its variance that a linear dependence
on ln of the current explains; and the way of the contact in the palm. A load that shifts to another part of
the pad moves the centroid in a step, as the current changes, while no other contact slips."""
EVIDENCE_WINDOWS_S = tuple(1e-3 * ms for ms in _WINDOW_MS)
"""Windows [s] of features."""
EVIDENCE_FIELDS = (
    "pad_m",
    "total_current_a",
    "position_m",
    "palm_position_m",
    "palm_normal",
    "palm_rotation",
    "palm_joints_m2",
)
"""Fields of samples that features are computed from"""

ALONE_LOG_ODDS = 1.5
"""Added to ln of the odds of a hand's only contact: nothing else holds the object there."""
OTHERS_WEIGHT, MAX_OTHERS_LOG_ODDS = 0.8, 4.0
"""Weight of the mean of the trees' sums of a hand's other contacts, limited to +-MAX_OTHERS_LOG_ODDS."""

_COUNT, _WINDOWS = len(SLIP_FEATURES), len(_WINDOW_MS)
_LINK_WINDOWS, _HAND_WINDOWS = len(_LINK_WINDOW_MS), len(_HAND_WINDOW_MS)
_OTHERS_WINDOW, _PATH_WINDOW, _PATH_STEPS = 1, 3, 20
_MAX_LOG_RATIO = 60.0
_MIN_LOG_RATIO = -20.0
_MIN_FORCE_N = 0.05
_CONTACT_VARIANCE_M2 = 1e-4 * 1e-4
_OBJECT_SPEED_STD_M_PER_S, _OBJECT_ROTATION_STD_RAD_PER_S = 0.3, 0.5  # priors of a held object
_LINK_SPEED_STD_M_PER_S = 1e-3  # from the elasticity of links
_VELOCITY_WINDOW, _MAX_AGE_NS = 2, 50_000_000
_MAX_STICKING_LOG_ODDS = -3.0  # ln of the odds of slip below which a contact holds the object
_MAX_HOLDING_LOG_RATIO = 3.0  # ln R of a contact that counts as sticking to the object
_UPDATE_NS = 4_500_000
_ALONE_LOG_ODDS, _OTHERS_WEIGHT, _MAX_OTHERS_LOG_ODDS = ALONE_LOG_ODDS, OTHERS_WEIGHT, MAX_OTHERS_LOG_ODDS
_MIN_LOG_ODDS, _ODDS_DECAY_S = -50.0, 0.05  # evidence of slip decays by 1 in that time
_MIN_PATH_M, _MIN_CURRENT_VARIANCE = 1e-8, 1e-6
_MIN_PIVOT = 1e-6  # information is that of the prior at least, 1e3 and more
_NAN, _INFINITY = float("nan"), float("inf")

_MOTION = 6  # velocity and rotation of a rigid body
BODY_ROW = np.dtype(
    [
        ("information", "<f8", (_MOTION, _MOTION)),
        ("weighted", "<f8", _MOTION),  # ways of its points
        ("factor", "<f8", (_MOTION, _MOTION)),  # of the information: lower triangle
        ("motion", "<f8", _MOTION),  # L^-1 of the weighted ways
        ("point", "<f8", (3, _MOTION)),  # way of one point per motion
        ("off", "<f8", 3),  # way of that point off the body
    ]
)
"""A rigid body on the contacts of a hand"""


class EvidenceStage:
    """Evidence of slip of the contacts of n pads.

    offsets: of EVIDENCE_FIELDS in a sample, by name. steps: samples in each of the windows. hands: (n,)
    number of each pad's hand. slip: (n,) SLIP_ROWs of the slip stage.

    arrays: memory by name. Those of a `ContactBuffer` are values (n 2 length width,), sample_ns (n 2 length,)
    and sample_count (n,). Of t trees of d levels tested, thresholds (t d,) are features and thresholds,
    leaves (t 2^d,). Results: features (n SLIP_FEATURES,); log_odds (n,) of slip, NaN where unknown, and the
    times evidence_ns (n,) of the last update.

    Results besides: velocities (n 3,) [m/s] of links at contacts in the palm, with the deviation of a
    component in velocity_std (n,), NaN where unknown; own_odds (n,), the trees' sums of the last update.
    """

    def __init__(
        self,
        arrays: Mapping[str, Any],
        offsets: Mapping[str, int],
        steps: Sequence[int],
        width: int,
        levels: int,
        hands: memoryview[int],
        slip: RowArray,
    ) -> None:
        n = len(hands)
        self.history: memoryview[float] = arrays["values"]
        self.sample_ns: memoryview[int] = arrays["sample_ns"]
        self.sample_count: memoryview[int] = arrays["sample_count"]
        self.width = width
        self.length = len(self.sample_ns) // (2 * n)
        self.pad_m, self.total_current_a = offsets["pad_m"], offsets["total_current_a"]
        self.position_m, self.palm_position_m = offsets["position_m"], offsets["palm_position_m"]
        self.palm_normal, self.palm_rotation = offsets["palm_normal"], offsets["palm_rotation"]
        self.palm_joints_m2 = offsets["palm_joints_m2"]
        self.steps = view_memory(np.array(steps, np.intp))
        self.windows = view_memory(np.array(EVIDENCE_WINDOWS_S))
        self.hands, self.slip = hands, slip
        self.tested, self.thresholds, self.leaves = arrays["tested"], arrays["thresholds"], arrays["leaves"]
        self.levels, self.trees = levels, len(self.tested) // levels
        self.features, self.log_odds = arrays["features"], arrays["log_odds"]
        self.rows = view_rows(np.asarray(arrays["features"]), FEATURE_ROW)
        self.evidence_ns = arrays["evidence_ns"]
        self.velocities, self.velocity_std = number_memory(3 * n), number_memory(n)
        self.ways, self.own_odds = number_memory(3 * n), number_memory(n)
        self.due = view_memory(np.zeros(n, np.intp))
        self.body = np.zeros(1, BODY_ROW).view(np.recarray)
        for pad in range(n):
            self.velocity_std[pad] = _NAN
            for i in range(3):
                self.velocities[3 * pad + i] = _NAN

    def update_odds(self, pads: memoryview[int], now_ns: int) -> None:
        """Update the odds of slip of the contacts on these pads, ascending, by samples up to `now_ns`.

        They are NaN where the pose of a contact's link is unknown. All are updated together, where one was
        last updated more than 4.5 ms ago.
        """
        count, waits = 0, True
        for k in range(len(pads)):
            pad = pads[k]
            if _is_placed(self, pad):
                self.due[count] = pad
                count += 1
                if now_ns - self.evidence_ns[pad] >= _UPDATE_NS:
                    waits = False
            else:
                self.log_odds[pad] = _NAN
        if waits:
            return
        _compute_features(self, self.due, count)
        first = 0
        while first < count:
            stop, total = first, 0.0
            while stop < count and self.hands[self.due[stop]] == self.hands[self.due[first]]:
                self.own_odds[self.due[stop]] = _sum_trees(self, self.due[stop])
                total += self.own_odds[self.due[stop]]
                stop += 1
            for k in range(first, stop):
                _update_contact(self, self.due[k], stop - first - 1, total, now_ns)
            first = stop

    def compute_velocities(self, now_ns: int) -> None:
        """Compute the velocities of links at all contacts that have a sample in the last 50 ms."""
        for pad in range(len(self.hands)):
            _compute_velocity(self, pad, now_ns)

    def compare_to_object(self, pad: int, out: memoryview[float]) -> bool:
        """Write velocity (3,) of a contact's link relative to the object, deviation of a component, and the
        number of other contacts that determine the object's velocity; False if the link's is unknown.

        The object is a rigid body that moves with its hand's contacts unless they slip or may do so, and at
        rest in the palm without.
        """
        at = _sample_at(self, pad, 0)
        if not self.velocity_std[pad] < _INFINITY:
            return False
        origin, others = at + self.palm_position_m, 0
        x, y, z = self.history[origin], self.history[origin + 1], self.history[origin + 2]
        _set_prior(self.body, _OBJECT_SPEED_STD_M_PER_S, _OBJECT_ROTATION_STD_RAD_PER_S)
        for other in range(len(self.hands)):
            if other == pad or self.hands[other] != self.hands[pad] or self.slip[other].slipping != 0.0:
                continue
            std = self.velocity_std[other]
            if std < _INFINITY and not self.slip[other].log_odds > _MAX_STICKING_LOG_ODDS:
                _set_point(self, other, x, y, z)
                _add_point(self.body, self.velocities, other, 1.0 / (std * std))
                others += 1
        variance = 0.0
        if others:
            _set_point(self, pad, x, y, z)
            variance = _compare_to_body(self, self.velocities, pad)
        else:
            _remove_normal(self, self.velocities, pad)
        for i in range(3):
            out[i] = self.body[0].off[i]
        std = self.velocity_std[pad]
        out[3], out[4] = math.sqrt(std * std + variance), float(others)
        return True

    def compute_features(self, pads: memoryview[int]) -> None:
        """Compute the features of the contacts on these pads alone."""
        _compute_features(self, pads, len(pads))


def _update_contact(stage: EvidenceStage, pad: int, others: int, total: float, now_ns: int) -> None:
    """Update a contact's odds by those of its own and of its hand's `others`, with their sum `total`."""
    found = stage.own_odds[pad]
    if others == 0:
        found += _ALONE_LOG_ODDS
    else:
        mean = (total - found) / others
        if mean > _MAX_OTHERS_LOG_ODDS:
            mean = _MAX_OTHERS_LOG_ODDS
        elif mean < -_MAX_OTHERS_LOG_ODDS:
            mean = -_MAX_OTHERS_LOG_ODDS
        found += _OTHERS_WEIGHT * mean
    last = stage.log_odds[pad] if stage.log_odds[pad] > _MIN_LOG_ODDS else _MIN_LOG_ODDS
    kept = last - (now_ns - stage.evidence_ns[pad]) * 1e-9 / _ODDS_DECAY_S
    stage.log_odds[pad] = found if found > kept else kept
    stage.evidence_ns[pad] = now_ns


def _is_placed(stage: EvidenceStage, pad: int) -> bool:
    """Return True if the pose of the link under a contact is known."""
    at = _sample_at(stage, pad, 0)
    if at < 0:
        return False
    return -_INFINITY < stage.history[at + stage.palm_position_m] < _INFINITY


def _sample_at(stage: EvidenceStage, pad: int, back: int) -> int:
    """Return the index of a pad's last sample, or of `back` samples earlier; -1 if missing."""
    last = stage.sample_count[pad] - 1
    if back > last or back >= stage.length:
        return -1
    return (2 * pad * stage.length + (last - back) % stage.length) * stage.width


def _sum_trees(stage: EvidenceStage, pad: int) -> float:
    """Return the sum of the leaves that a pad's features reach; an unknown feature is above no threshold."""
    levels, first, total, node, size = stage.levels, pad * _COUNT, 0.0, 0, 1
    for _ in range(levels):
        size += size
    for tree in range(stage.trees):
        leaf, bit = tree * size, 1
        for _ in range(levels):
            if stage.features[first + stage.tested[node]] > stage.thresholds[node]:
                leaf += bit
            bit += bit
            node += 1
        total += stage.leaves[leaf]
    return total


def _compute_features(stage: EvidenceStage, pads: memoryview[int], count: int) -> None:
    """Compute the features of contacts on the first `count` of these pads, hand by hand."""
    first = 0
    while first < count:
        stop = first
        while stop < count and stage.hands[pads[stop]] == stage.hands[pads[first]]:
            _compute_own_features(stage, pads[stop])
            stop += 1
        for link_window in range(_LINK_WINDOWS):
            for k in range(first, stop):
                _compute_link_motion(stage, pads[k], link_window)
            _compute_relative_motion(stage, pads, first, stop, link_window)
        for hand_window in range(_HAND_WINDOWS):
            link_window, largest = _LINK_WINDOWS - _HAND_WINDOWS + hand_window, 0.0
            for k in range(first, stop):
                angle = stage.rows[pads[k]].turned_rad[link_window]
                if angle > largest:
                    largest = angle
            for k in range(first, stop):
                stage.rows[pads[k]].hand_turned_rad[hand_window] = largest
        for k in range(first, stop):
            _compute_path(stage, pads[k])
        _compute_others(stage, pads, first, stop)
        first = stop


def _compute_own_features(stage: EvidenceStage, pad: int) -> None:
    """Compute the features of the slip stage, and those from current and centroid."""
    history = stage.history
    ratio = stage.slip[pad].log_ratio
    if ratio > _MAX_LOG_RATIO:
        ratio = _MAX_LOG_RATIO
    elif ratio < _MIN_LOG_RATIO:
        ratio = _MIN_LOG_RATIO
    force = stage.slip[pad].force_n
    x, y = stage.slip[pad].slip_velocity_m_per_s[0], stage.slip[pad].slip_velocity_m_per_s[1]
    stage.rows[pad].log_ratio, stage.rows[pad].slipping = ratio, stage.slip[pad].slipping
    stage.rows[pad].slip_mm_per_s = 1e3 * math.sqrt(x * x + y * y)
    stage.rows[pad].onset_age_s = stage.slip[pad].onset_age_s
    stage.rows[pad].relative_force_rate_per_s = stage.slip[pad].force_rate_n_per_s / (
        force if force > _MIN_FORCE_N else _MIN_FORCE_N
    )
    now = _sample_at(stage, pad, 0)
    for window in range(_WINDOWS):
        stage.rows[pad].log_current_change[window] = stage.rows[pad].moved_mm[window] = _NAN
        before = _sample_at(stage, pad, stage.steps[window])
        if before < 0:
            continue
        at = stage.total_current_a
        current, earlier = history[now + at], history[before + at]
        if current > 0.0 and earlier > 0.0:
            stage.rows[pad].log_current_change[window] = math.log(current / earlier)
        at = stage.pad_m
        x, y = history[now + at] - history[before + at], history[now + at + 1] - history[before + at + 1]
        stage.rows[pad].moved_mm[window] = 1e3 * math.sqrt(x * x + y * y)


def _compute_path(stage: EvidenceStage, pad: int) -> None:
    """Compute the features of the centroid's path on the pad over 100 ms; NaN where it isn't known."""
    history, now = stage.history, _sample_at(stage, pad, 0)
    at, current, steps = stage.pad_m, stage.total_current_a, stage.steps[_PATH_WINDOW]
    stage.rows[pad].step_mm_100ms = stage.rows[pad].straightness_100ms = _NAN
    stage.rows[pad].explained_by_current_100ms = stage.rows[pad].palm_moved_mm_100ms = _NAN
    before = _sample_at(stage, pad, steps)
    if before < 0:
        return
    p, o, square = now + stage.palm_position_m, before + stage.palm_position_m, 0.0
    for i in range(3):
        square += (history[p + i] - history[o + i]) * (history[p + i] - history[o + i])
    stage.rows[pad].palm_moved_mm_100ms = 1e3 * math.sqrt(square)
    stride = (steps + _PATH_STEPS - 1) // _PATH_STEPS
    longest = length = count = 0.0
    sum_c = sum_x = sum_y = sum_cc = sum_cx = sum_cy = sum_xx = 0.0
    origin_x, origin_y, origin_a = history[now + at], history[now + at + 1], history[now + current]
    if not 0.0 < origin_a < _INFINITY:
        return
    back = 0
    while back < steps:
        later = _sample_at(stage, pad, back)
        back = back + stride if back + stride < steps else steps
        earlier = _sample_at(stage, pad, back)
        x, y = (
            history[later + at] - history[earlier + at],
            history[later + at + 1] - history[earlier + at + 1],
        )
        step = math.sqrt(x * x + y * y)
        length += step
        if step > longest:
            longest = step
        if not 0.0 < history[later + current] < _INFINITY:
            return
        c = math.log(history[later + current] / origin_a)
        x, y = history[later + at] - origin_x, history[later + at + 1] - origin_y
        sum_c, sum_x, sum_y, count = sum_c + c, sum_x + x, sum_y + y, count + 1.0
        sum_cc, sum_cx, sum_cy = sum_cc + c * c, sum_cx + c * x, sum_cy + c * y
        sum_xx += x * x + y * y
    x, y = origin_x - history[before + at], origin_y - history[before + at + 1]
    if not length < _INFINITY:
        return
    stage.rows[pad].step_mm_100ms = 1e3 * longest
    stage.rows[pad].straightness_100ms = math.sqrt(x * x + y * y) / (
        length if length > _MIN_PATH_M else _MIN_PATH_M
    )
    variance = (sum_xx - (sum_x * sum_x + sum_y * sum_y) / count) / count
    c = (sum_cc - sum_c * sum_c / count) / count + _MIN_CURRENT_VARIANCE
    x, y = (sum_cx - sum_c * sum_x / count) / count, (sum_cy - sum_c * sum_y / count) / count
    if variance < _MIN_PATH_M * _MIN_PATH_M:
        variance = _MIN_PATH_M * _MIN_PATH_M
    stage.rows[pad].explained_by_current_100ms = (x * x + y * y) / (c * variance)


def _compute_others(stage: EvidenceStage, pads: memoryview[int], first: int, stop: int) -> None:
    """Compute the features of a hand's contacts that are about its others; NaN where there is none."""
    slipping = known = change = 0.0
    largest, second, at = _MIN_LOG_RATIO, _MIN_LOG_RATIO, -1
    for k in range(first, stop):
        slipping += stage.rows[pads[k]].slipping
        part = math.fabs(stage.rows[pads[k]].log_current_change[_OTHERS_WINDOW])
        if part < _INFINITY:
            known, change = known + 1.0, change + part
        if stage.rows[pads[k]].log_ratio > largest:
            largest, second, at = stage.rows[pads[k]].log_ratio, largest, k
        elif stage.rows[pads[k]].log_ratio > second:
            second = stage.rows[pads[k]].log_ratio
    for k in range(first, stop):
        own = math.fabs(stage.rows[pads[k]].log_current_change[_OTHERS_WINDOW])
        stage.rows[pads[k]].others_slipping = slipping - stage.rows[pads[k]].slipping
        stage.rows[pads[k]].others_log_ratio = second if k == at else largest
        stage.rows[pads[k]].others_current_change_20ms = _NAN
        if own < _INFINITY:
            if known > 1.5:
                stage.rows[pads[k]].others_current_change_20ms = (change - own) / (known - 1.0)
        elif known > 0.5:
            stage.rows[pads[k]].others_current_change_20ms = change / known


def _compute_link_motion(stage: EvidenceStage, pad: int, link_window: int) -> None:
    """Compute rotation and way of the link's material at the contact over a window, NaN where unknown."""
    at, history, ways = 3 * pad, stage.history, stage.ways
    stage.rows[pad].turned_rad[link_window] = stage.rows[pad].link_moved_mm[link_window] = _NAN
    stage.rows[pad].relative_mm[link_window] = stage.rows[pad].relative_std_mm[link_window] = _NAN
    ways[at] = _NAN
    now = _sample_at(stage, pad, 0)
    before = _sample_at(stage, pad, stage.steps[_WINDOWS - _LINK_WINDOWS + link_window])
    if before < 0:
        return
    _compute_material_way(stage, pad, now, before)
    r, q, n = now + stage.palm_rotation, before + stage.palm_rotation, now + stage.palm_normal
    along = ways[at] * history[n] + ways[at + 1] * history[n + 1] + ways[at + 2] * history[n + 2]
    x = y = z = squares = 0.0
    for i in range(3):  # columns of the rotations; their cross products sum to twice the axis
        x += history[q + 3 + i] * history[r + 6 + i] - history[q + 6 + i] * history[r + 3 + i]
        y += history[q + 6 + i] * history[r + i] - history[q + i] * history[r + 6 + i]
        z += history[q + i] * history[r + 3 + i] - history[q + 3 + i] * history[r + i]
        off = ways[at + i] - along * history[n + i]
        squares += off * off
    stage.rows[pad].turned_rad[link_window] = 0.5 * math.sqrt(x * x + y * y + z * z)
    stage.rows[pad].link_moved_mm[link_window] = 1e3 * math.sqrt(squares)


def _compute_material_way(stage: EvidenceStage, pad: int, now: int, before: int) -> None:
    """Compute the way in the palm, between two samples, of the link's point that is in contact now."""
    history, q = stage.history, before + stage.palm_rotation
    p, o = now + stage.position_m, before + stage.position_m
    a, b, c = history[p] - history[o], history[p + 1] - history[o + 1], history[p + 2] - history[o + 2]
    p, o = now + stage.palm_position_m, before + stage.palm_position_m
    for i in range(3):
        on_link = history[q + 3 * i] * a + history[q + 3 * i + 1] * b + history[q + 3 * i + 2] * c
        stage.ways[3 * pad + i] = history[p + i] - history[o + i] - on_link


def _compute_velocity(stage: EvidenceStage, pad: int, now_ns: int) -> None:
    """Compute the velocity of the link at a contact over 50 ms, or since the contact began."""
    stage.velocity_std[pad] = _NAN
    back = stage.steps[_VELOCITY_WINDOW]
    if back >= stage.sample_count[pad]:
        back = stage.sample_count[pad] - 1
    if back < 1:
        return
    now, before = _sample_at(stage, pad, 0), _sample_at(stage, pad, back)
    last_ns, then_ns = stage.sample_ns[now // stage.width], stage.sample_ns[before // stage.width]
    if not now_ns - last_ns <= _MAX_AGE_NS or last_ns <= then_ns:
        return
    _compute_material_way(stage, pad, now, before)
    if not _is_known(stage, pad):
        return
    over_s = (last_ns - then_ns) * 1e-9
    for i in range(3):
        stage.velocities[3 * pad + i] = stage.ways[3 * pad + i] / over_s
    variance_m2 = stage.history[now + stage.palm_joints_m2] + stage.history[before + stage.palm_joints_m2]
    if not 0.0 <= variance_m2 < _INFINITY:
        variance_m2 = 0.0
    variance = variance_m2 / (over_s * over_s)  # as if independent in every sample
    stage.velocity_std[pad] = math.sqrt(_LINK_SPEED_STD_M_PER_S * _LINK_SPEED_STD_M_PER_S + variance)


def _is_known(stage: EvidenceStage, pad: int) -> bool:
    """Return True if the way of a contact's link over the window is known."""
    at = 3 * pad
    return -_INFINITY < stage.ways[at] + stage.ways[at + 1] + stage.ways[at + 2] < _INFINITY


def _is_holding(stage: EvidenceStage, pad: int) -> bool:
    """Return True if a contact counts as sticking to the object."""
    ratio: float = stage.rows[pad].log_ratio
    return not stage.rows[pad].slipping and ratio < _MAX_HOLDING_LOG_RATIO


def _compute_relative_motion(
    stage: EvidenceStage, pads: memoryview[int], first: int, stop: int, link_window: int
) -> None:
    """Compute the ways of a hand's contacts, each relative to a rigid body on the other holding contacts, and
    the deviation of a component of that body's way."""
    history, known, holding = stage.history, 0, 0
    x = y = z = 0.0
    for k in range(first, stop):
        if _is_known(stage, pads[k]):
            at = _sample_at(stage, pads[k], 0) + stage.palm_position_m
            x, y, z = x + history[at], y + history[at + 1], z + history[at + 2]
            known += 1
    if known < 2:
        return
    x, y, z = x / known, y / known, z / known
    window_s = stage.windows[_WINDOWS - _LINK_WINDOWS + link_window]
    _set_prior(stage.body, _OBJECT_SPEED_STD_M_PER_S * window_s, _OBJECT_ROTATION_STD_RAD_PER_S * window_s)
    for k in range(first, stop):
        if _is_known(stage, pads[k]) and _is_holding(stage, pads[k]):
            _set_point(stage, pads[k], x, y, z)
            _add_point(stage.body, stage.ways, pads[k], 1.0 / _CONTACT_VARIANCE_M2)
            holding += 1
    for k in range(first, stop):
        if not _is_known(stage, pads[k]):
            continue
        own = _is_holding(stage, pads[k])
        if holding < (2 if own else 1):
            continue
        _set_point(stage, pads[k], x, y, z)
        if own:
            _add_point(stage.body, stage.ways, pads[k], -1.0 / _CONTACT_VARIANCE_M2)
        variance, squares = _compare_to_body(stage, stage.ways, pads[k]), 0.0
        for i in range(3):
            squares += stage.body[0].off[i] * stage.body[0].off[i]
        stage.rows[pads[k]].relative_mm[link_window] = 1e3 * math.sqrt(squares)
        stage.rows[pads[k]].relative_std_mm[link_window] = 1e3 * math.sqrt(variance)
        if own:
            _set_point(stage, pads[k], x, y, z)
            _add_point(stage.body, stage.ways, pads[k], 1.0 / _CONTACT_VARIANCE_M2)


def _set_point(stage: EvidenceStage, pad: int, x: float, y: float, z: float) -> None:
    """Set the ways of a contact's point per way and rotation of a body at (x, y, z)."""
    at = _sample_at(stage, pad, 0) + stage.palm_position_m
    x, y, z = stage.history[at] - x, stage.history[at + 1] - y, stage.history[at + 2] - z
    for i in range(3):
        for j in range(_MOTION):
            stage.body[0].point[i][j] = 1.0 if i == j else 0.0
    stage.body[0].point[0][4], stage.body[0].point[0][5] = z, -y
    stage.body[0].point[1][3], stage.body[0].point[1][5] = -z, x
    stage.body[0].point[2][3], stage.body[0].point[2][4] = y, -x


def _set_prior(body: RowArray, speed: float, rotation: float) -> None:
    """Set the information about a body's motion to that of a prior of these deviations."""
    for i in range(_MOTION):
        body[0].weighted[i] = 0.0
        for j in range(_MOTION):
            body[0].information[i][j] = 0.0
    for i in range(3):
        body[0].information[i][i] = 1.0 / (speed * speed)
        body[0].information[i + 3][i + 3] = 1.0 / (rotation * rotation)


def _add_point(body: RowArray, ways: memoryview[float], pad: int, weight: float) -> None:
    """Add what the point that was set, of a pad, contributes to the body's motion."""
    for i in range(3):
        way = ways[3 * pad + i]
        for j in range(_MOTION):
            part = weight * body[0].point[i][j]
            body[0].weighted[j] += part * way
            for m in range(j + 1):
                body[0].information[j][m] += part * body[0].point[i][m]


def _compare_to_body(stage: EvidenceStage, ways: memoryview[float], pad: int) -> float:
    """Compute the tangential way, relative to the body, of the point that was set, of a pad; return the
    variance of a component of the body's way."""
    normal = _sample_at(stage, pad, 0) + stage.palm_normal
    _factorise(stage.body)
    for i in range(_MOTION):
        value = stage.body[0].weighted[i]
        for j in range(i):
            value -= stage.body[0].factor[i][j] * stage.body[0].motion[j]
        stage.body[0].motion[i] = value / stage.body[0].factor[i][i]
    along = trace = spread = 0.0
    for i in range(3):
        _whiten_row(stage.body, i)
        way = ways[3 * pad + i]
        for j in range(_MOTION):
            value = stage.body[0].point[i][j]
            way -= value * stage.body[0].motion[j]
            trace += value * value
        stage.body[0].off[i] = way
        along += way * stage.history[normal + i]
    for i in range(3):
        stage.body[0].off[i] -= along * stage.history[normal + i]
    for j in range(_MOTION):
        part = 0.0
        for i in range(3):
            part += stage.body[0].point[i][j] * stage.history[normal + i]
        spread += part * part
    variance = 0.5 * (trace - spread)
    return variance if variance > 0.0 else 0.0


def _remove_normal(stage: EvidenceStage, ways: memoryview[float], pad: int) -> None:
    """Compute the tangential way of a pad's point, relative to a body at rest."""
    normal, along = _sample_at(stage, pad, 0) + stage.palm_normal, 0.0
    for i in range(3):
        along += ways[3 * pad + i] * stage.history[normal + i]
    for i in range(3):
        stage.body[0].off[i] = ways[3 * pad + i] - along * stage.history[normal + i]


def _whiten_row(body: RowArray, i: int) -> None:
    """Replace row i of the point's ways by L^-1 of it."""
    for j in range(_MOTION):
        value = body[0].point[i][j]
        for m in range(j):
            value -= body[0].factor[j][m] * body[0].point[i][m]
        body[0].point[i][j] = value / body[0].factor[j][j]


def _factorise(body: RowArray) -> None:
    """Compute the Cholesky factor of the information about the body's motion."""
    for i in range(_MOTION):
        for j in range(i + 1):
            value = body[0].information[i][j]
            for m in range(j):
                value -= body[0].factor[i][m] * body[0].factor[j][m]
            if i == j:
                body[0].factor[i][i] = math.sqrt(value if value > _MIN_PIVOT else _MIN_PIVOT)
            else:
                body[0].factor[i][j] = value / body[0].factor[j][j]
