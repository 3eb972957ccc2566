"""A grasp as what happens to a simulated hand: its discs press on the pads, and its joints are told.

Public names: `Timeline`, `Encoders`. Between two steps of MuJoCo what was at the one before holds.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtouch.config import ConfigError, Problem
from handtouch.hand.urdf import Description
from handtouch.simulate.faults import Fault
from handtouch.simulate.grasp.episode import Grasp
from handtouch.simulate.grasp.patches import Patches
from handtouch.simulate.grasp.scene import STEP_S
from handtouch.simulate.play import Moving, Pressing
from handtouch.simulate.scenario import Swap

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
_KNOT_STEPS = 8  # how closely a sheet's history looks at the force
_APART_STEPS = 20  # a disc that comes back within so many is the same press
_BEFORE = 1e-6  # of a step: times that ought to be a step's, rounded


@dataclass(frozen=True)
class Encoders:
    """What is wrong with the joint angles that a robot tells; another robot for every seed."""

    seed: int = 1
    offset_deg: float = 0.0
    """standard deviation, from joint to joint, of what calibration left"""
    noise_deg: float = 0.0
    """standard deviation of a reading"""
    delay_s: float = 0.0
    """how much older than its stamp a reading is"""

    def read(self, position_rad: FloatArray) -> FloatArray:
        """Readings (n, m) of steps at 1 kHz."""
        rng = np.random.default_rng((self.seed, 31))
        n, m = position_rad.shape
        offset, noise = self.offset_deg * rng.normal(size=m), self.noise_deg * rng.normal(size=(n, m))
        return self.delayed(position_rad) + np.radians(offset + noise)

    def delayed(self, position_rad: FloatArray) -> FloatArray:
        """`read` by encoders with nothing else wrong."""
        late = round(self.delay_s / STEP_S)
        return np.asarray(position_rad[np.maximum(np.arange(len(position_rad)) - late, 0)])

    @property
    def std_rad(self) -> float:
        """Standard deviation of a reading, as its maker would tell it."""
        return float(np.radians(np.hypot(self.offset_deg, self.noise_deg)))


@dataclass(frozen=True, eq=False)
class Timeline:
    """What presses on the pads of a hand: a `handtouch.simulate.play.Play`.

    Its touches are numbered pad by pad, with a number for each of the discs that a pad has at a time.
    """

    of: Patches
    pads: tuple[str, ...]
    """links, as `of` has them"""
    joints: tuple[str, ...]
    told_rad: FloatArray
    """(n, m) what the robot tells of its joints"""
    repeat: bool = False
    faults: Sequence[Fault] = ()
    swaps: Sequence[Swap] = ()

    @classmethod
    def play(
        cls, grasp: Grasp, of: Patches, encoders: Encoders | None = None, repeat: bool = False
    ) -> Timeline:
        """Of a grasp; without `encoders` joints are told as they are."""
        told = (encoders or Encoders()).read(grasp.position_rad)
        return cls(of, tuple(pad.link for pad in grasp.pads), grasp.joints, told, repeat)

    def evenly(self, radius_m: FloatArray) -> Timeline:
        """The same forces, but each pad's in one disc of a radius (p,) of our choice."""
        of = self.of
        place = np.where(np.isnan(of.centre), 0.5, of.centre)[:, :, None]
        radii = np.broadcast_to(radius_m[:, None], (*of.total_n.shape, 1))
        alone = dataclasses.replace(of, place=place, force_n=of.total_n[:, :, None], radius_m=radii)
        return dataclasses.replace(self, of=alone)

    @property
    def depth(self) -> int:
        """The most discs on a pad at a time."""
        return int(self.of.force_n.shape[2])

    @property
    def duration_s(self) -> float:
        """Time of one round."""
        return len(self.of.total_n) * STEP_S

    @property
    def links(self) -> list[tuple[str, float | None]]:
        """Of each touch its link; discs have radii of their own at every moment."""
        return [(link, None) for link in self.pads for _ in range(self.depth)]

    def pressing(self, t_s: float) -> list[Pressing]:
        """The discs at `t_s` from the start."""
        step = self.steps(np.array([t_s]))[0]
        if step < 0:
            return []
        force, place, radius = self.of.force_n[step], self.of.place[step], self.of.radius_m[step]
        return [
            Pressing(pad * self.depth + lane, x, y, float(force[pad, lane]), float(radius[pad, lane]))
            for pad, lane in np.argwhere(force > 0).tolist()
            for x, y in [place[pad, lane].tolist()]
        ]

    def on(self, link: str, radius_m: Callable[[int], float]) -> _OnPad:  # noqa: ARG002
        """What presses on one pad."""
        row = self.pads.index(link)
        return _OnPad(self, row, int((self.of.force_n[:, row] > 0).any(axis=0).sum()))

    def moved(self, robot: Description) -> Moving | None:
        """How its joints move, if it is this hand."""
        return _Told(self) if set(self.joints) <= set(robot.joints) else None

    def check_links(self, links: Iterable[str], file: str = "grasp") -> None:
        """Raise ConfigError for a pad that the deployment lacks."""
        if lost := sorted(set(self.pads) - set(links)):
            raise ConfigError(file, (Problem("the grasp", "", f"presses on {', '.join(lost)}: no such pad"),))

    def steps(self, times_s: FloatArray) -> IntArray:
        """Numbers (n,) of the steps at times (n,); -1 after the end."""
        number = np.floor(times_s / STEP_S + _BEFORE).astype(np.intp)
        n = len(self.of.total_n)
        return number % n if self.repeat else np.where(number < n, number, -1)


class _Told:
    """The joints as they are told."""

    def __init__(self, timeline: Timeline) -> None:
        self._timeline = timeline

    def at(self, t_s: float) -> dict[str, float]:
        """Where they are told to be: radians, or metres."""
        of = self._timeline
        step = max(int(of.steps(np.array([t_s]))[0]), -1)
        return dict(zip(of.joints, of.told_rad[step].tolist(), strict=True))


@dataclass(frozen=True)
class _OnPad:
    """The discs on one pad."""

    timeline: Timeline
    row: int
    depth: int
    """the most at a time"""

    @property
    def changes(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Times [s] at which to look at the force, after which a sheet settles, of presses' begins."""
        on = np.flatnonzero(self.timeline.of.total_n[:, self.row] > 0)
        gaps = np.flatnonzero(np.diff(on, prepend=-_APART_STEPS - 1) > _APART_STEPS)
        begins = on[gaps]
        ends = on[np.append(gaps[1:] - 1, len(on) - 1)] + 1 if len(on) else on
        looked = np.unique(np.concatenate([on[::_KNOT_STEPS], begins, ends]))
        of_s = [np.asarray(steps * STEP_S, np.float64) for steps in (looked, np.append(begins, ends), begins)]
        return of_s[0], of_s[1], of_s[2]

    def contacts(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Places (depth, 2, n), forces (depth, n) [N], 0 where nothing presses, and radii (depth, n) [m]."""
        of, steps, lanes = self.timeline.of, self.timeline.steps(times_s), np.arange(self.depth)
        force = of.force_n[steps, self.row][:, lanes].T * (steps >= 0)
        place = of.place[steps, self.row][:, lanes].transpose(1, 2, 0)
        radius = of.radius_m[steps, self.row][:, lanes].T
        return np.asarray(place), np.asarray(force), np.asarray(radius)
