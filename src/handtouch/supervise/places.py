"""Contacts cut into places: from the ticks of a pad to mean currents of a contact that stood still.

Public: `Places` of one pad; `Place`. A held contact is one place however long it is held, a slow slide many:
each adds to what is known of the gains, see `gains`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
WINDOW = 4
"""Samples that are looked at together."""
_STILL = 0.012
"""Of the fractions: how far they may move in a place. The mean's error is of second order, below 1e-4."""
_APART = 0.03
"""Of the fractions: nearer to the last one is no place of its own."""
_SIGMAS = 4.0
_SKIPPED = 2  # samples after the beginning, while the contact grows
_MOST = 256  # samples of a place


@dataclass(frozen=True)
class Place:
    """A contact at one place: mean currents (4,) and their noise (4,) [A], samples, time of the last [ns]."""

    currents: FloatArray
    noise: FloatArray
    samples: int
    t_ns: int


class Places:
    """Cuts the contacts of one pad; give it every tick in which the pad is touched, in order."""

    def __init__(self, noise_a: FloatArray) -> None:
        self._noise = noise_a
        self._contact = 0
        self._waiting: list[FloatArray] = []
        self._skip = 0
        self._told: FloatArray | None = None
        self._sum: FloatArray = np.zeros(4)
        self._at: FloatArray = np.zeros(4)
        self._count, self._t_ns = 0, 0

    def take(self, contact: int, currents: FloatArray, t_ns: int) -> Place | None:
        """One sample (4,) of a contact; a place that is complete by now. `contact` 0: not touched."""
        done = None
        if contact != self._contact:
            done = self._end()
            self._contact, self._skip, self._told = contact, _SKIPPED, None
        if not contact:
            return done
        if self._skip:
            self._skip -= 1
            return done
        self._waiting.append(currents)
        if len(self._waiting) < WINDOW:
            return done
        window, self._waiting = np.array(self._waiting), []
        return self._join(window, t_ns) or done

    def _join(self, window: FloatArray, t_ns: int) -> Place | None:
        """Take a window (k, 4) into the place, or begin another with it."""
        half = len(window) // 2
        mean = window.mean(axis=0)
        total = float(mean.sum())
        if not total > 0:
            return None
        slack = _STILL + _SIGMAS * float(self._noise.max()) / total
        moved = np.abs(_fractions(window[half:].mean(axis=0)) - _fractions(window[:half].mean(axis=0))).max()
        if moved > slack:  # too quick to be a place
            return self._end()
        done = None
        if self._count and np.abs(_fractions(mean) - self._at).max() > slack:
            done = self._end()
        if not self._count:
            self._at = _fractions(mean)
        if self._count < _MOST:
            self._sum += window.sum(axis=0)
            self._count += len(window)
            self._t_ns = t_ns
        return done

    def _end(self) -> Place | None:
        """The place so far, if it is one and not the last one again."""
        self._waiting = []
        total, count, t_ns = self._sum, self._count, self._t_ns
        self._begin()
        if not count:
            return None
        at = _fractions(total)
        if self._told is not None and np.abs(at - self._told).max() < _APART:
            return None
        self._told = at
        return Place(total / count, self._noise / np.sqrt(count), count, t_ns)

    def _begin(self) -> None:
        self._sum = np.zeros(4)
        self._count = 0


def _fractions(currents: FloatArray) -> FloatArray:
    return np.asarray(currents / currents.sum())
