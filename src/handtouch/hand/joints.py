"""Joint states reported by a robot, interpolated to the times of touch samples.

Public names: `JointStateBuffer`, `JointSnapshot`, `JointProblem`, `JointLimitsError`, `FollowerJoint`. Times
are ns of the host's monotonic clock; positions are radians, metres for prismatic joints.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import BoolArray, FloatArray, IntArray

_STATES_PER_SOURCE = 64
"""States kept of one source: 64 ms at 1 kHz."""
_MAX_SOURCES = 16
_MAX_EXTRAPOLATION_NS = 20_000_000
"""Joints are extrapolated at their velocity for this long; after that they are held."""
_MAX_UNSEEN_MOTION = 0.1
"""A held joint that would have moved on by a tenth of the tolerance, 0.02 rad or 2 mm, is unknown: about the
accuracy of a hand's joints."""
_MIN_SPEED_SPAN_NS, _MAX_SPEED_SPAN_NS = 5_000_000, 200_000_000
"""A speed is the difference of states this far apart: of closer ones it would be that of their noise, and of
their stamps, which a sender may give to all states of one packet."""
_MAX_REPORTED_SPEED_RATIO, _REPORTED_SPEED_MARGIN = 3.0, 0.5
"""A reported speed up to 3 times that of the states, and 0.5 rad/s, is believed: an acceleration from rest
within one period of 100 Hz; degrees per second, and a constant instead of a measurement, aren't."""
LIMIT_TOLERANCE_RAD, LIMIT_TOLERANCE_M = 0.2, 0.02
"""Joints may be this far beyond the limits of their URDF: the zero of an encoder may be off by as much."""
_MIN_DEGREES_RATIO = 5.0
"""A position beyond its limits by 5 times their range isn't one of a bad encoder; a finger bent by 10
degrees, sent in degrees, is."""
_HOLD_BACK_NS = 10_000_000_000
"""After positions in degrees a source is refused for this long: others of its positions may look right."""
_MAX_SPEED = 30.0
"""Joints of hands take at least 50 ms for a quarter of a turn; a faster change is a jump [rad/s or m/s]."""
_DISAGREEMENT_NS = 1_000_000_000
"""Two jumps of a joint within this time are positions of two senders; it ends as long after the last."""


class JointSnapshot(NamedTuple):
    """All joints of a hand at one time."""

    sample_ns: int
    position_rad: FloatArray
    """(m,) NaN for a joint without state"""
    age_s: FloatArray
    """(m,) to the nearest state, before or after, to the farther one of two that are farther apart than the
    time-out of joint states; infinite for a joint without state, with senders that disagree, or that was
    moving before a pause"""
    std_rad: FloatArray
    """(m,) reported standard deviation, 0 if not reported"""

    @classmethod
    def unknown(cls, t_ns: int, m: int) -> JointSnapshot:
        """Return a snapshot of m joints without state."""
        return cls(t_ns, np.full(m, np.nan), np.full(m, np.inf), np.zeros(m))


class _JointState(NamedTuple):
    state_ns: int
    position_rad: FloatArray
    velocity_rad_per_s: FloatArray | None
    std_rad: FloatArray | None


class JointLimitsError(ValueError):
    """Joint positions that are far beyond the limits; the text names joint, value, limits and remedy."""


class FollowerJoint(NamedTuple):
    """A joint that mimics another one: its position is `factor` times that of `leader`, plus `offset`."""

    leader: str
    factor: float
    offset: float


class _JointSource(NamedTuple):
    """A sender of states of the same joints: which of them are known, as which columns, and its states.

    The position of a known joint is `scale` times that sent, plus `shift`.
    """

    columns: IntArray
    source_columns: IntArray
    scale: FloatArray
    shift: FloatArray
    states: deque[_JointState]


class JointProblem(NamedTuple):
    """A part of a state that isn't used: its cause, a name of `daemon.inputs.DROP_CAUSES`, and details."""

    cause: str
    text: str


class JointStateBuffer:
    """Recent states of the joints `names` (m), from several sources, each of which may report any joints.

    `continuous` (m,) joints have no limits and are interpolated along the shorter way. `limits` (m, 2) are
    the lower and upper limits of the others, and `tolerances` (m,) how far a position may be beyond them; a
    joint farther beyond isn't used. A state with two such joints, or with one that is beyond by 5 times the
    range between its limits, isn't in radians and is refused. `followers` are joints that mimic these: a
    state with one of them and without its leader determines the leader. States farther apart than
    `timeout_ns` say little about the time between.

    `late_count` counts states discarded because they were older than the last one of the same source.
    """

    def __init__(
        self,
        names: Sequence[str],
        continuous: BoolArray | None = None,
        limits: FloatArray | None = None,
        tolerances: FloatArray | None = None,
        timeout_ns: int = 100_000_000,
        followers: Mapping[str, FollowerJoint] = MappingProxyType({}),
    ) -> None:
        m = len(names)
        self.names = tuple(names)
        self.late_count = 0
        self._continuous = np.zeros(m, dtype=np.bool_) if continuous is None else continuous
        self._stated_limits = np.full((m, 2), (-np.inf, np.inf)) if limits is None else limits
        self._tolerances = np.full(m, LIMIT_TOLERANCE_RAD) if tolerances is None else tolerances
        self._timeout_ns, self._followers = timeout_ns, followers
        ranges = np.subtract(*self._stated_limits.T[::-1])
        ranges[ranges <= 0] = np.inf  # limits that a URDF leaves at their default, 0
        unlimited = np.isinf(ranges)[:, None]
        self._limits = np.where(unlimited, (-np.inf, np.inf), self._stated_limits)
        self._accepted = self._limits + self._tolerances[:, None] * (-1, 1)
        self._possible = self._limits + (_MIN_DEGREES_RATIO * ranges[:, None]) * (-1, 1)
        self._sources: dict[tuple[str, ...], _JointSource] = {}
        self._held_back_until_ns: dict[tuple[str, ...], int] = {}
        self._problems: list[JointProblem] = []
        # newest position of each joint, whatever the source, and its last jump
        self._newest, self._newest_ns = np.full(m, np.nan), np.zeros(m, np.int64)
        self._jumped_ns = np.full(m, -_DISAGREEMENT_NS, np.int64)
        self._disagreed_until_ns = np.full(m, np.iinfo(np.int64).min, np.int64)

    def __len__(self) -> int:
        """Return the number of states in memory."""
        return sum(len(source.states) for source in self._sources.values())

    def pop_problems(self) -> list[JointProblem]:
        """Return what wasn't used of the states since the last call."""
        problems, self._problems = self._problems, []
        return problems

    def add_state(
        self,
        t_ns: int,
        names: tuple[str, ...],
        position_rad: FloatArray,
        velocity_rad_s: FloatArray | None = None,
        std_rad: FloatArray | None = None,
        *,
        replace: bool = False,
    ) -> bool:
        """Add a state, arrays as `names`; return whether it holds a known joint and is newer than the last.

        Joints whose position isn't finite, or beyond the limits, are left out (`pop_problems`); a velocity
        that isn't finite counts as not given. With `replace` a state of the same time as the last one of the
        source takes its place. Raises JointLimitsError for positions in degrees, which also holds the source
        back for 10 s.
        """
        source = self._sources.get(names) or self._make_source(names)
        columns, source_columns, scale, shift, states = source
        if len(columns) == 0:
            return False
        position = scale * position_rad[source_columns] + shift
        self._check_unit(t_ns, names, columns, position)
        usable = self._find_usable(columns, position)
        if not usable.all():
            kept = source_columns[usable]
            return len(kept) > 0 and self.add_state(
                t_ns,
                tuple(names[column] for column in kept),
                position_rad[kept],
                None if velocity_rad_s is None else velocity_rad_s[kept],
                None if std_rad is None else std_rad[kept],
                replace=replace,
            )
        replaced = bool(replace and states and states[-1].state_ns == t_ns)
        if states and t_ns <= states[-1].state_ns and not replaced:
            self.late_count += 1
            return False
        if not states:
            if len(self._sources) >= _MAX_SOURCES:
                self._sources.pop(min(self._sources, key=lambda s: self._sources[s].states[-1].state_ns))
            self._sources[names] = source
        if replaced:
            states.pop()
        else:
            self._check_jumps(t_ns, columns, position)
        self._newest[columns], self._newest_ns[columns] = position, t_ns
        velocity = None if velocity_rad_s is None else scale * velocity_rad_s[source_columns]
        std = None if std_rad is None else np.abs(scale) * std_rad[source_columns]
        states.append(_JointState(t_ns, position, velocity, std))
        return True

    def interpolate(self, t_ns: int, *, as_sent: bool = False) -> JointSnapshot:
        """Return all joints at `sample_ns`: interpolated between states, extrapolated briefly after the last
        one, but not beyond the limits.

        A joint about which senders disagree is unknown; with `as_sent` it has the position sent last.
        """
        found = JointSnapshot.unknown(t_ns, len(self.names))
        sources = list(self._sources.values())
        if len(sources) > 1:  # if several sources report a joint, the newest counts
            sources.sort(key=lambda source: source.states[-1].state_ns)
        for source in sources:
            columns = source.columns
            position, age_s, std = self._interpolate_source(source.states, t_ns, columns)
            found.position_rad[columns], found.age_s[columns] = position, age_s
            found.std_rad[columns] = 0.0 if std is None else std
        disagreed = self._disagreed_until_ns > t_ns
        if np.count_nonzero(disagreed):
            age_s = np.maximum(t_ns - self._newest_ns, 0) * 1e-9
            found.position_rad[disagreed] = self._newest[disagreed] if as_sent else np.nan
            found.age_s[disagreed] = age_s[disagreed] if as_sent else np.inf
        return found

    def _make_source(self, names: tuple[str, ...]) -> _JointSource:
        known = [(column, name, 1.0, 0.0) for column, name in enumerate(self.names) if name in names]
        for name, (leader, factor, offset) in self._followers.items():
            led = leader in self.names and all(leader != self.names[column] for column, *_ in known)
            if name in names and led and factor:
                known.append((self.names.index(leader), name, 1 / factor, -offset / factor))
        return _JointSource(
            np.array([column for column, *_ in known], dtype=np.intp),
            np.array([names.index(name) for _, name, *_ in known], dtype=np.intp),
            np.array([scale for *_, scale, _ in known]),
            np.array([shift for *_, shift in known]),
            deque[_JointState](maxlen=_STATES_PER_SOURCE),
        )

    def _check_unit(self, t_ns: int, names: tuple[str, ...], columns: IntArray, position: FloatArray) -> None:
        """Raise JointLimitsError for positions that can't be in radians, and for a while after them."""
        lowest, highest = self._accepted[columns].T
        beyond = (position < lowest) | (position > highest)
        count = np.count_nonzero(beyond)
        if count == 1:
            lowest, highest = self._possible[columns].T
            beyond &= (position < lowest) | (position > highest)
            count += np.count_nonzero(beyond)
        if count > 1:
            self._held_back_until_ns = {names: t_ns + _HOLD_BACK_NS}
            first = int(np.flatnonzero(beyond)[0])
            lower, upper = self._stated_limits[columns[first]]
            raise JointLimitsError(
                f"{self.names[columns[first]]} = {position[first]:.6g}, limits {lower:.4g} to {upper:.4g}; "
                "send radians, for a prismatic joint metres"
            )
        if t_ns < self._held_back_until_ns.get(names, t_ns):
            raise JointLimitsError(
                "held back, as this sender's last positions were far beyond the limits; send radians, for a "
                f"prismatic joint metres, and nothing else for {_HOLD_BACK_NS * 1e-9:.0f} s"
            )

    def _find_usable(self, columns: IntArray, position: FloatArray) -> BoolArray:
        """Return which positions are finite and within the limits; note the others."""
        lowest, highest = self._accepted[columns].T
        usable = (position >= lowest) & (position <= highest) & np.isfinite(position)
        for row in np.flatnonzero(~usable).tolist():
            name = self.names[columns[row]]
            if np.isfinite(position[row]):
                lower, upper = self._stated_limits[columns[row]]
                text = f"{name} = {position[row]:.6g}, limits {lower:.4g} to {upper:.4g}; the others are used"
                self._problems.append(JointProblem("joint_limits", text))
            else:
                self._problems.append(JointProblem("not_finite", f"position of {name}; the others are used"))
        return np.asarray(usable)

    def _check_jumps(self, t_ns: int, columns: IntArray, position: FloatArray) -> None:
        """Note joints that jump to and fro: two senders report them."""
        before_ns = self._newest_ns[columns]
        step = np.abs(_joint_difference(self._newest[columns], position, self._continuous[columns]))
        apart_ns = np.abs(t_ns - before_ns)
        jumped = (step * 1e9 > _MAX_SPEED * np.maximum(apart_ns, _MIN_SPEED_SPAN_NS)) & (
            apart_ns <= _MAX_SPEED_SPAN_NS
        )
        for row in np.flatnonzero(jumped).tolist():
            joint = columns[row]
            if abs(t_ns - self._jumped_ns[joint]) <= _DISAGREEMENT_NS:
                self._disagreed_until_ns[joint] = t_ns + _DISAGREEMENT_NS
                text = (
                    f"two senders disagree about {self.names[joint]}: {self._newest[joint]:.4g} and "
                    f"{position[row]:.4g} within {apart_ns[row] * 1e-6:.3g} ms; stop one of them"
                )
                self._problems.append(JointProblem("disagreement", text))
            self._jumped_ns[joint] = t_ns

    def _interpolate_source(
        self, states: deque[_JointState], t_ns: int, columns: IntArray
    ) -> tuple[FloatArray, FloatArray | float, FloatArray | None]:
        """Return positions, their ages [s] and standard deviations of a source's joints at a time."""
        after = before = states[-1]
        number = len(states) - 1
        while before.state_ns > t_ns and number > 0:
            number -= 1
            after, before = before, states[number]
        if before.state_ns >= t_ns:  # exactly this time, or before the oldest kept state
            return before.position_rad, (before.state_ns - t_ns) * 1e-9, before.std_rad
        since_ns = t_ns - before.state_ns
        if after is not before:
            step = _joint_difference(before.position_rad, after.position_rad, self._continuous[columns])
            gap_ns, until_ns = after.state_ns - before.state_ns, after.state_ns - t_ns
            age_ns = (min if gap_ns <= self._timeout_ns else max)(since_ns, until_ns)
            return before.position_rad + since_ns / gap_ns * step, age_ns * 1e-9, before.std_rad
        velocity = self._velocity(states, columns)
        way = velocity * (min(since_ns, _MAX_EXTRAPOLATION_NS) * 1e-9)
        age_s: FloatArray | float = since_ns * 1e-9
        if _MAX_EXTRAPOLATION_NS < since_ns <= self._timeout_ns:  # beyond that it is stale, with its age
            unseen = np.abs(velocity) * ((since_ns - _MAX_EXTRAPOLATION_NS) * 1e-9)
            age_s = np.where(unseen > _MAX_UNSEEN_MOTION * self._tolerances[columns], np.inf, age_s)
        lowest, highest = self._limits[columns].T
        held = before.position_rad
        position = np.clip(held + way, np.minimum(lowest, held), np.maximum(highest, held))
        return position, age_s, before.std_rad

    def _velocity(self, states: deque[_JointState], columns: IntArray) -> FloatArray:
        """Return the velocity after the newest state: as reported, where the states agree with it."""
        last, measured = states[-1], None
        for state in reversed(states):
            span_ns = last.state_ns - state.state_ns
            if span_ns >= _MIN_SPEED_SPAN_NS:
                if span_ns <= _MAX_SPEED_SPAN_NS:
                    way = _joint_difference(state.position_rad, last.position_rad, self._continuous[columns])
                    measured = way / (span_ns * 1e-9)
                break
        reported = last.velocity_rad_per_s
        if measured is None:
            measured = np.zeros(len(last.position_rad))
        if reported is None:
            return measured
        limit = _MAX_REPORTED_SPEED_RATIO * np.abs(measured) + _REPORTED_SPEED_MARGIN
        return np.where(np.abs(reported) <= limit, reported, measured)  # False for NaN


def _joint_difference(one: FloatArray, two: FloatArray, continuous: NDArray[np.bool_]) -> FloatArray:
    way = two - one
    if np.count_nonzero(continuous):
        way = np.where(continuous, np.remainder(way + np.pi, 2 * np.pi) - np.pi, way)
    return way
