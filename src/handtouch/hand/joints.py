"""Joint states reported by a robot, interpolated to the times of touch samples.

Public names: `JointStateBuffer`, `JointSnapshot`, `JointLimitsError`. Times are ns of the host's monotonic
clock; positions are radians, metres for prismatic joints.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
_STATES_PER_SOURCE = 64
"""States kept of one source: 64 ms at 1 kHz."""
_MAX_SOURCES = 16
_MAX_EXTRAPOLATION_NS = 20_000_000
"""Joints are extrapolated at their velocity for this long; after that they are held."""


class JointSnapshot(NamedTuple):
    """All joints of a hand at one time."""

    sample_ns: int
    position_rad: FloatArray
    """(m,) NaN for a joint without state"""
    age_s: FloatArray
    """(m,) to the nearest state, before or after; infinite for a joint without state"""
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


class JointStateBuffer:
    """Recent states of the joints `names` (m), from several sources, each of which may report any joints.

    `continuous` (m,) joints have no limits and are interpolated along the shorter way. `limits` (m, 2) are
    the lower and upper limits of the others; a position that exceeds one by more than the range between them
    is rejected. `late_count` counts states discarded because they were older than the last one of the same
    source.
    """

    def __init__(
        self,
        names: Sequence[str],
        continuous: NDArray[np.bool_] | None = None,
        limits: FloatArray | None = None,
    ) -> None:
        self.names = tuple(names)
        self.late_count = 0
        self._continuous = np.zeros(len(self.names), dtype=np.bool_) if continuous is None else continuous
        self._limits = np.full((len(self.names), 2), (-np.inf, np.inf)) if limits is None else limits
        ranges = np.subtract(*self._limits.T[::-1])
        ranges[ranges <= 0] = np.inf  # limits that a URDF leaves at their default, 0
        self._accepted = self._limits + ranges[:, None] * (-1, 1)
        self._sources: dict[tuple[str, ...], tuple[IntArray, IntArray, deque[_JointState]]] = {}

    def __len__(self) -> int:
        """Return the number of states in memory."""
        return sum(len(states) for _, _, states in self._sources.values())

    def empty_copy(self) -> JointStateBuffer:
        """Return an empty buffer of the same joints."""
        return JointStateBuffer(self.names, self._continuous, self._limits)

    def add_state(
        self,
        t_ns: int,
        names: tuple[str, ...],
        position_rad: FloatArray,
        velocity_rad_s: FloatArray | None = None,
        std_rad: FloatArray | None = None,
    ) -> bool:
        """Add a state, arrays as `names`; return whether it holds a known joint and is newer than the last.

        Raises JointLimitsError for a position far beyond its joint's limits.
        """
        source = self._sources.get(names)
        if source is None:
            known = [name for name in self.names if name in names]
            columns = np.array([self.names.index(name) for name in known], dtype=np.intp)
            source_columns = np.array([names.index(name) for name in known], dtype=np.intp)
            if len(known) == 0:
                return False
            source = columns, source_columns, deque[_JointState](maxlen=_STATES_PER_SOURCE)
        columns, source_columns, states = source
        position = position_rad[source_columns]
        self._check_limits(columns, position)
        if states and t_ns <= states[-1].state_ns:
            self.late_count += 1
            return False
        if not states:
            if len(self._sources) >= _MAX_SOURCES:
                self._sources.pop(min(self._sources, key=lambda s: self._sources[s][2][-1].state_ns))
            self._sources[names] = source
        velocity = None if velocity_rad_s is None else velocity_rad_s[source_columns]
        states.append(
            _JointState(
                t_ns,
                position,
                velocity,
                None if std_rad is None else std_rad[source_columns],
            )
        )
        return True

    def interpolate(self, t_ns: int) -> JointSnapshot:
        """Return all joints at `sample_ns`: interpolated between states, extrapolated briefly after the last
        one.
        """
        found = JointSnapshot.unknown(t_ns, len(self.names))
        sources = list(self._sources.values())
        if len(sources) > 1:  # if several sources report a joint, the newest counts
            sources.sort(key=lambda source: source[2][-1].state_ns)
        for columns, _, states in sources:
            position, age_ns, std = self._interpolate_source(states, t_ns, self._continuous[columns])
            found.position_rad[columns], found.age_s[columns] = position, age_ns * 1e-9
            found.std_rad[columns] = 0.0 if std is None else std
        return found

    def _check_limits(self, columns: IntArray, position: FloatArray) -> None:
        lowest, highest = self._accepted[columns].T
        beyond = (position < lowest) | (position > highest)
        if np.count_nonzero(beyond):
            first = int(np.flatnonzero(beyond)[0])
            lower, upper = self._limits[columns[first]]
            raise JointLimitsError(
                f"{self.names[columns[first]]} = {position[first]:.6g}, limits {lower:.4g} to {upper:.4g}; "
                "send radians, for a prismatic joint metres"
            )

    def _interpolate_source(
        self, states: deque[_JointState], t_ns: int, continuous: NDArray[np.bool_]
    ) -> tuple[FloatArray, int, FloatArray | None]:
        after = before = states[-1]
        number = len(states) - 1
        while before.state_ns > t_ns and number > 0:
            number -= 1
            after, before = before, states[number]
        if before.state_ns >= t_ns:  # exactly this time, or before the oldest kept state
            return before.position_rad, before.state_ns - t_ns, before.std_rad
        since_ns = t_ns - before.state_ns
        if after is not before:
            step = _joint_difference(before.position_rad, after.position_rad, continuous)
            fraction = since_ns / (after.state_ns - before.state_ns)
            near = min(since_ns, after.state_ns - t_ns)
            return before.position_rad + fraction * step, near, before.std_rad
        velocity = before.velocity_rad_per_s
        if velocity is None:
            velocity = np.zeros(len(before.position_rad))
            if number > 0:
                last = states[number - 1]
                if (apart_ns := before.state_ns - last.state_ns) <= 10 * _MAX_EXTRAPOLATION_NS:
                    velocity = _joint_difference(last.position_rad, before.position_rad, continuous) / (
                        apart_ns * 1e-9
                    )
        return (
            before.position_rad + velocity * (min(since_ns, _MAX_EXTRAPOLATION_NS) * 1e-9),
            since_ns,
            before.std_rad,
        )


def _joint_difference(one: FloatArray, two: FloatArray, continuous: NDArray[np.bool_]) -> FloatArray:
    way = two - one
    if np.count_nonzero(continuous):
        way = np.where(continuous, np.remainder(way + np.pi, 2 * np.pi) - np.pi, way)
    return way
