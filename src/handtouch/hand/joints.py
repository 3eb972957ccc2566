"""Joint states as a robot tells them, matched in time to samples of touch.

Public names: `JointStates`, `Joints`. Times are ns of the host's monotonic clock; positions are radians, and
metres for joints that slide.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
_KEPT = 64
"""States of one source: 64 ms of a robot that tells them at 1 kHz."""
_SOURCES = 16
_AHEAD_NS = 20_000_000
"""For so long joints are taken to go on as they moved; after that, to stand where that led."""


class Joints(NamedTuple):
    """All joints of a hand at one time."""

    t_ns: int
    position_rad: FloatArray
    """(m,) NaN for a joint that nobody told"""
    age_s: FloatArray
    """(m,) to the nearest state, before or after; infinite for a joint that nobody told"""
    std_rad: FloatArray
    """(m,) standard deviation as told, 0 where that wasn't"""

    @classmethod
    def unknown(cls, t_ns: int, m: int) -> Joints:
        """Of m joints that nobody told."""
        return cls(t_ns, np.full(m, np.nan), np.full(m, np.inf), np.zeros(m))


class _State(NamedTuple):
    t_ns: int
    position: FloatArray
    velocity: FloatArray | None
    std: FloatArray | None


class JointStates:
    """States of the joints `names` (m); several sources may each tell some of them, and others besides.

    `continuous` (m,) turn without end: the short way round is theirs. `late` counts states older than the one
    before of the same source, which are of no use.
    """

    def __init__(self, names: Sequence[str], continuous: NDArray[np.bool_] | None = None) -> None:
        self.names = tuple(names)
        self.late = 0
        self._continuous = np.zeros(len(self.names), dtype=np.bool_) if continuous is None else continuous
        self._sources: dict[tuple[str, ...], tuple[IntArray, IntArray, deque[_State]]] = {}

    def like(self) -> JointStates:
        """Another one of the same joints, of which nothing is told yet."""
        return JointStates(self.names, self._continuous)

    def take(
        self,
        t_ns: int,
        names: tuple[str, ...],
        position_rad: FloatArray,
        velocity_rad_s: FloatArray | None = None,
        std_rad: FloatArray | None = None,
    ) -> bool:
        """Keep a state, arrays as `names`; whether any of the joints is known here, and the state news."""
        source = self._sources.get(names)
        if source is None:
            known = [name for name in self.names if name in names]
            ours = np.array([self.names.index(name) for name in known], dtype=np.intp)
            theirs = np.array([names.index(name) for name in known], dtype=np.intp)
            if len(known) == 0:
                return False
            source = ours, theirs, deque[_State](maxlen=_KEPT)
            if len(self._sources) >= _SOURCES:
                self._sources.pop(min(self._sources, key=lambda s: self._sources[s][2][-1].t_ns))
            self._sources[names] = source
        _, theirs, states = source
        if states and t_ns <= states[-1].t_ns:
            self.late += 1
            return False
        velocity = None if velocity_rad_s is None else velocity_rad_s[theirs]
        states.append(
            _State(t_ns, position_rad[theirs], velocity, None if std_rad is None else std_rad[theirs])
        )
        return True

    def at(self, t_ns: int) -> Joints:
        """All joints at a time: between two states on the line, beyond the last one a little way further."""
        found = Joints.unknown(t_ns, len(self.names))
        sources = list(self._sources.values())
        if len(sources) > 1:  # of a joint that several tell, the newest counts
            sources.sort(key=lambda source: source[2][-1].t_ns)
        for ours, _, states in sources:
            position, age_ns, std = self._match(states, t_ns, self._continuous[ours])
            found.position_rad[ours], found.age_s[ours] = position, age_ns * 1e-9
            found.std_rad[ours] = 0.0 if std is None else std
        return found

    def _match(
        self, states: deque[_State], t_ns: int, continuous: NDArray[np.bool_]
    ) -> tuple[FloatArray, int, FloatArray | None]:
        after = before = states[-1]
        number = len(states) - 1
        while before.t_ns > t_ns and number > 0:
            number -= 1
            after, before = before, states[number]
        if before.t_ns >= t_ns:  # the very time, or before all that is kept
            return before.position, before.t_ns - t_ns, before.std
        since_ns = t_ns - before.t_ns
        if after is not before:
            step = _way(before.position, after.position, continuous)
            part = since_ns / (after.t_ns - before.t_ns)
            near = min(since_ns, after.t_ns - t_ns)
            return before.position + part * step, near, before.std
        velocity = before.velocity
        if velocity is None:
            velocity = np.zeros(len(before.position))
            if number > 0:
                last = states[number - 1]
                if (apart_ns := before.t_ns - last.t_ns) <= 10 * _AHEAD_NS:
                    velocity = _way(last.position, before.position, continuous) / (apart_ns * 1e-9)
        return before.position + velocity * (min(since_ns, _AHEAD_NS) * 1e-9), since_ns, before.std


def _way(one: FloatArray, two: FloatArray, continuous: NDArray[np.bool_]) -> FloatArray:
    way = two - one
    if np.count_nonzero(continuous):
        way = np.where(continuous, np.remainder(way + np.pi, 2 * np.pi) - np.pi, way)
    return way
