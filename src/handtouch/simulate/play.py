"""What presses on a simulated hand in the course of time, whoever says it: a scenario, or a grasp.

Public names: `Play` (of a whole hand), `OnPad` (of one pad), `Pressing`, `Moving`, `Played` (touches).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from handtouch.hand.urdf import Description

if TYPE_CHECKING:
    from handtouch.simulate.faults import Fault
    from handtouch.simulate.scenario import Swap, Touch

FloatArray = NDArray[np.float64]


class Pressing(NamedTuple):
    """A contact at one moment: the touch's number, the place as fractions of the pad, the force."""

    touch: int
    x: float
    y: float
    force_n: float
    radius_m: float | None = None
    """None: that of the touch, or of the world"""


class Moving(Protocol):
    """Joints of a hand."""

    def at(self, t_s: float) -> dict[str, float]:
        """Where they are told to be: radians, or metres."""


class OnPad(Protocol):
    """What presses on one pad."""

    @property
    def depth(self) -> int:
        """The most contacts at a time."""

    @property
    def changes(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Times [s] at which the force is to be looked at; those after which a sheet has to settle, those at
        which a touch begins."""

    def contacts(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Places (depth, 2, n), forces (depth, n) [N], 0 where nothing presses, and radii (depth, n) [m]."""


class Play(Protocol):
    """What happens to a hand. Times count in seconds from the start, and from 0 again where it repeats."""

    @property
    def faults(self) -> Sequence[Fault]: ...
    @property
    def swaps(self) -> Sequence[Swap]: ...
    @property
    def repeat(self) -> bool: ...
    @property
    def duration_s(self) -> float:
        """Time of one round."""

    @property
    def links(self) -> Sequence[tuple[str, float | None]]:
        """Of each touch its link, and its radius [m] where it says one."""

    def pressing(self, t_s: float) -> list[Pressing]:
        """The contacts at `t_s` from the start."""

    def on(self, link: str, radius_m: Callable[[int], float]) -> OnPad:
        """What presses on one pad; `radius_m` of a touch by its number, where it doesn't say one."""

    def moved(self, robot: Description) -> Moving | None:
        """How the joints of a hand move; None where nothing moves them."""

    def check_links(self, links: Iterable[str], file: str = ...) -> None:
        """Raise ConfigError for what happens on a link that carries no pad."""


class Played:
    """Touches on a pad, at most `depth` at a time."""

    def __init__(self, touches: Sequence[tuple[Touch, float]]) -> None:
        """touches: with the radius [m] of each."""
        self._lanes: list[list[tuple[Touch, float]]] = []
        for touch, radius_m in sorted(touches, key=lambda pair: pair[0].from_s):
            free = (lane for lane in self._lanes if lane[-1][0].until_s <= touch.from_s)
            lane = next(free, None)
            if lane is None:
                self._lanes.append(lane := [])
            lane.append((touch, radius_m))

    @property
    def depth(self) -> int:
        """The most touches at a time."""
        return len(self._lanes)

    @property
    def changes(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Times [s] at which the force is to be looked at; those after which a sheet has to settle, those at
        which a touch begins."""
        touches = [touch for lane in self._lanes for touch, _ in lane]
        looked = [touch.knots() for touch in touches]
        settles = [t for touch in touches for t in (touch.from_s, touch.from_s + touch.ramp_s, touch.until_s)]
        begins = np.array([touch.from_s for touch in touches])
        return np.concatenate([np.zeros(0), *looked]), np.array(settles), begins

    def contacts(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Places (depth, 2, n), forces (depth, n) [N], 0 where nothing presses, and radii (depth, n) [m]."""
        order = np.argsort(times_s, kind="stable")
        ordered = times_s[order]
        depth, n = len(self._lanes), len(times_s)
        place, force, radius = np.full((depth, 2, n), 0.5), np.zeros((depth, n)), np.ones((depth, n))
        for row, lane in enumerate(self._lanes):
            for touch, radius_m in lane:
                first, last = np.searchsorted(ordered, (touch.from_s, touch.until_s))
                if first < last:
                    at = order[first:last]
                    place[row][:, at] = touch.places(times_s[at])
                    force[row, at], radius[row, at] = touch.forces(times_s[at]), radius_m
        return place, force, radius
