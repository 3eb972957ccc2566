"""A gripper that is commanded and touches things: joints, their motors and an object, as a hand's `Play`.

Public names: `GripperWorld` (joints and object), `GripperPlay` (what its pads feel). No clock: times are
seconds from the first SYNC, and only go on.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.config.problems import ConfigError, Problem
from handtouch.hand.urdf import Description
from handtouch.simulate.objects import OBJECTS, Block, Edge, Spot, Tips
from handtouch.simulate.play import Pressing

FloatArray = NDArray[np.float64]
LINKS = {"thumb": "thumb_tip", "index": "index_tip"}
"""Finger -> link that carries its pad."""
LIMITS_M = {"reach": (0.0, 0.1), "lift": (-0.03, 0.03), "thumb": (0.0, 0.03), "index": (0.0, 0.03)}
"""Joint -> its range, as in two_finger.urdf."""
SPEED_M_S = 0.1
COMMAND_S = 0.05
"""A velocity is obeyed for so long; then the joints stop, as those of a careful robot do."""
_LONGEST_S = 0.05
"""Unsampled for longer, on a machine that is too busy, the world waits."""
_LAG_S = 0.01
_STEP_S = 0.001
_HOME_Y_M = 0.03  # of each fingertip from the middle, with its joint at 0
_ON_PAD = (0.02, 0.98)


class GripperWorld:
    """Joints that follow commanded velocities with a lag of 10 ms, and the object between the fingers."""

    def __init__(self, tip_radius_m: float) -> None:
        self._spots: list[Spot] = []
        self._radius = tip_radius_m
        self._lock = threading.Lock()
        self._t_s = 0.0
        self._sampled_s = 0.0
        self._waited_s = 0.0
        self._wanted = dict.fromkeys(LIMITS_M, 0.0)
        self._until_s = 0.0
        self.reset("block")

    def reset(self, thing: str, **parameters: float) -> None:
        """Joints home, and another object: "block" or "edge" with some of its numbers.

        Raises ValueError for an object or a number that there isn't.
        """
        made = _made(thing, parameters)
        with self._lock:
            self._thing = made
            self._wanted = dict.fromkeys(LIMITS_M, 0.0)
            self._speed = dict.fromkeys(LIMITS_M, 0.0)
            self._position = dict.fromkeys(LIMITS_M, 0.0)
            self._pull = (0.0, 0.0, 0.0, 0.0)
            self._spots = []

    def command(self, t_s: float, velocity_m_s: Mapping[str, float]) -> None:
        """Move so from `t_s` on, joints that aren't named not at all; ValueError for one that there isn't."""
        _check(velocity_m_s, LIMITS_M, "joint")
        self.advance(t_s)
        with self._lock:
            self._wanted = {
                name: min(max(velocity_m_s.get(name, 0.0), -SPEED_M_S), SPEED_M_S) for name in LIMITS_M
            }
            self._until_s = self._t_s + COMMAND_S

    def pull(self, t_s: float, force_n: float, ramp_s: float) -> None:
        """Somebody pulls at the object along +x, more and more until `ramp_s` have passed, then evenly."""
        if not (math.isfinite(force_n) and ramp_s >= 0):
            raise ValueError(f"pull of {force_n} N in {ramp_s} s: give finite numbers, a time of 0 or more")
        self.advance(t_s)
        with self._lock:
            self._pull = (self._t_s, self._pull_n(self._t_s), force_n, ramp_s)

    def sample(self, t_s: float) -> list[Spot]:
        """The contacts at `t_s`, or now where that is past."""
        with self._lock:
            self._waited_s += max(t_s - self._sampled_s - _LONGEST_S, 0.0)
            self._sampled_s = max(t_s, self._sampled_s)
        self.advance(t_s)
        with self._lock:
            return self._spots

    def advance(self, t_s: float) -> None:
        """Let time pass until `t_s`, though not much longer than since the last sample."""
        with self._lock:
            until_s = min(t_s, self._sampled_s + _LONGEST_S) - self._waited_s
            while self._t_s + _STEP_S <= until_s:
                self._t_s += _STEP_S
                self._step()

    @property
    def position_m(self) -> dict[str, float]:
        """Of the joints."""
        with self._lock:
            return dict(self._position)

    def truth(self) -> dict[str, float]:
        """What really happens to the object."""
        with self._lock:
            return self._thing.truth()

    def _step(self) -> None:
        share = 1 - math.exp(-_STEP_S / _LAG_S)
        for name, (least, most) in LIMITS_M.items():
            wanted = self._wanted[name] if self._t_s < self._until_s else 0.0
            self._speed[name] += share * (wanted - self._speed[name])
            self._position[name] = min(max(self._position[name] + _STEP_S * self._speed[name], least), most)
        at = self._position
        self._thing.pull(self._pull_n(self._t_s))
        tips = Tips(at["reach"], at["lift"], at["thumb"] - _HOME_Y_M, _HOME_Y_M - at["index"], self._radius)
        self._spots = self._thing.step(_STEP_S, tips)

    def _pull_n(self, t_s: float) -> float:
        begin_s, before, after, ramp_s = self._pull
        part = min(max((t_s - begin_s) / ramp_s, 0.0), 1.0) if ramp_s else 1.0
        return before + part * (after - before)


class GripperPlay:
    """The contacts of a world on the pads of a deployment, live: it can't tell what will be, or has been."""

    faults = ()
    swaps = ()
    repeat = False
    duration_s = math.inf

    def __init__(self, world: GripperWorld, thumb: config.Plane, index: config.Sphere) -> None:
        self.world = world
        self._thumb, self._index = thumb, index

    @classmethod
    def of(cls, deployment: config.Deployment, file: str = "the deployment") -> GripperPlay:
        """On the pads of its links; raises ConfigError where they are missing, or of another shape."""
        pads = {pad.link: pad.surface for hand in deployment.hands for pad in hand.pads}
        thumb, index = (pads.get(link) for link in LINKS.values())
        if not (isinstance(thumb, config.Plane) and isinstance(index, config.Sphere)):
            reason = "a gripper needs a plane on thumb_tip and a sphere on index_tip; copy two_finger.toml"
            raise ConfigError(file, (Problem("[[hand.pad]]", "", reason),))
        return cls(GripperWorld(1e-3 * index.radius_mm), thumb, index)

    @property
    def links(self) -> Sequence[tuple[str, float | None]]:
        """A touch for each finger."""
        return [(link, None) for link in LINKS.values()]

    def pressing(self, t_s: float) -> list[Pressing]:
        """The contacts at `t_s`, or now where that is past."""
        found = []
        for spot in self.world.sample(t_s):
            x, y = self._on_plate(spot) if spot.finger == "thumb" else self._on_tip(spot)
            if min(x, y) >= _ON_PAD[0] and max(x, y) <= _ON_PAD[1]:  # beside the pad nothing is felt
                found.append(Pressing(list(LINKS).index(spot.finger), x, y, spot.force_n))
        return found

    def on(self, link: str, radius_m: Callable[[int], float]) -> Live:  # noqa: ARG002
        """One contact at a time, of which nothing is known ahead."""
        return Live()

    def moved(self, robot: Description) -> MovedByCommand:  # noqa: ARG002
        """The joints, wherever commands have brought them."""
        return MovedByCommand(self.world)

    def check_links(self, links: Iterable[str], file: str = "gripper") -> None:
        """Raise ConfigError for links that carry no pad."""
        if missing := sorted(set(LINKS.values()) - set(links)):
            raise ConfigError(file, (Problem("[[hand.pad]]", "", f"no pad on {', '.join(missing)}"),))

    def _on_plate(self, spot: Spot) -> tuple[float, float]:
        """Fractions of the thumb's pad: its x is along x, its y along -z."""
        x, z = spot.aside
        return 0.5 + 1e3 * x / self._thumb.length_mm, 0.5 - 1e3 * z / self._thumb.width_mm

    def _on_tip(self, spot: Spot) -> tuple[float, float]:
        """Fractions of the index finger's pad: latitude along x, longitude along z."""
        x, z = spot.aside
        latitude = math.degrees(math.asin(x))
        longitude = math.degrees(math.atan2(z, math.sqrt(max(1 - x * x - z * z, 0.0))))
        low, high = self._index.from_deg, self._index.to_deg
        return (latitude - low) / (high - low), 0.5 + longitude / self._index.arc_deg


@dataclass(frozen=True)
class MovedByCommand:
    """The joints of a world, as those of a hand that moves."""

    world: GripperWorld

    def at(self, t_s: float) -> dict[str, float]:
        """Where they are at `t_s`, or now where that is past [m]."""
        self.world.advance(t_s)
        return self.world.position_m


class Live:
    """What presses on a pad, as far as it is known ahead: nothing. Sheets with a history can't be had so."""

    depth = 1

    @property
    def changes(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """None."""
        return np.zeros(0), np.zeros(0), np.zeros(0)

    def contacts(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """One that never presses."""
        n = len(times_s)
        return np.full((1, 2, n), 0.5), np.zeros((1, n)), np.ones((1, n))


def _made(thing: str, parameters: Mapping[str, float]) -> Block | Edge:
    if thing not in OBJECTS:
        raise ValueError(f"no object {thing!r}; there are: {', '.join(OBJECTS)}")
    kind = OBJECTS[thing]
    known = [name for name in kind.__dataclass_fields__ if not name.startswith("_")]
    _check(parameters, known, f"number of {thing}")
    return Edge(**parameters) if kind is Edge else Block(**parameters)


def _check(given: Mapping[str, float], known: Iterable[str], what: str) -> None:
    for name, value in given.items():
        if name not in known:
            raise ValueError(f"no {what} is called {name!r}; there are: {', '.join(known)}")
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise ValueError(f"{name} = {value!r}: must be a finite number")
