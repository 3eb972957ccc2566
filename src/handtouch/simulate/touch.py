"""Touches of a scenario: position and force over time, and the touches of one pad together.

Public names: `ScenarioTouch` (`[[touch]]`), `ScheduledTouches` (a `PadStimulus`).
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_right
from collections.abc import Sequence
from functools import cached_property
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, model_validator

from handtouch.arrays import FloatArray
from handtouch.config.base import Name, Positive, Table
from handtouch.simulate.contact_patch import ContactPatch, Profile, discs
from handtouch.simulate.smoothstep import smoothstep, smoothstep_array

_Fraction = Annotated[float, Field(ge=0.02, le=0.98)]
_Force2 = Annotated[tuple[float, float], Field(strict=False)]
_Point = Annotated[tuple[_Fraction, _Fraction], Field(strict=False)]


class ScenarioTouch(Table):
    """`[[touch]]`: one contact from begin to end."""

    link: Name = Field(description="link that is touched")
    from_s: float = Field(ge=0, description="begin, in seconds since the start of the scenario")
    duration_s: Positive = Field(description="duration, ramps included")
    path: Annotated[tuple[_Point, ...], Field(strict=False, min_length=1)] = Field(
        description="way points (x, y) as fractions of the pad, from electrodes x0 and y0; 0.02 to 0.98"
    )
    force_n: Annotated[tuple[Positive, ...], Field(strict=False, min_length=1)] = Field(
        description="forces at evenly spaced times between the ramps, smoothly interpolated; one: constant"
    )
    tangential_n: Annotated[tuple[_Force2, ...], Field(strict=False)] = Field(
        (),
        description="tangential forces along x and y of the pad, at such times likewise; only shear pads "
        "sense them; default: none",
    )
    ramp_s: Positive = Field(
        0.15, description="time in which the force rises from 0, and falls to 0 at the end"
    )
    radius_mm: Positive | None = Field(
        None, description="contact radius, of a round, even patch unless stated; left out: the world's patch"
    )
    hertz_force_n: Positive | None = Field(
        None,
        description="force at which the patch has radius_mm, from which it grows as force^(1/3), as under a "
        "round tip; left out: it doesn't grow",
    )
    profile: Profile | None = Field(
        None, description="how the pressure is distributed over the patch; left out: the world's"
    )
    elongation: Annotated[float, Field(ge=1, le=5)] | None = Field(
        None, description="length over width of the patch, of the same area; left out: the world's"
    )
    direction_deg: float | None = Field(
        None,
        description="from x on the pad to the patch's length and rise of pressure; left out: the world's",
    )

    @model_validator(mode="after")
    def _check_patch(self) -> Self:
        if self.hertz_force_n is not None and self.radius_mm is None:
            raise ValueError(
                f"hertz_force_n = {self.hertz_force_n:g} needs radius_mm, the radius at that force; "
                "state radius_mm, or leave hertz_force_n out"
            )
        return self

    def patch(self, drawn: ContactPatch) -> ContactPatch:
        """Return the touch's patch; `drawn`: the world's, for what it leaves out."""
        made = drawn
        if self.radius_mm is not None:
            made = ContactPatch(1e-3 * self.radius_mm, hertz_force_n=self.hertz_force_n)
        stated: dict[str, Any] = {
            "profile": self.profile,
            "elongation": self.elongation,
            "direction_rad": None if self.direction_deg is None else math.radians(self.direction_deg),
        }
        return made._replace(**{key: value for key, value in stated.items() if value is not None})

    @property
    def until_s(self) -> float:
        """End of the touch."""
        return self.from_s + self.duration_s

    def position_at(self, t_s: float) -> tuple[float, float]:
        """Return the position at `t_s` as fractions of the pad; speed is smooth along the whole path."""
        if len(self.path) == 1:
            return self.path[0]
        passed = self._path_lengths[-1] * smoothstep((t_s - self.from_s) / self.duration_s)
        leg = min(max(bisect_right(self._path_lengths, passed) - 1, 0), len(self.path) - 2)
        (x0, y0), (x1, y1) = self.path[leg], self.path[leg + 1]
        length = self._path_lengths[leg + 1] - self._path_lengths[leg]
        fraction = (passed - self._path_lengths[leg]) / length if length > 0 else 0.0
        return x0 + fraction * (x1 - x0), y0 + fraction * (y1 - y0)

    def force_at(self, t_s: float) -> float:
        """Return the force at `t_s` [N], 0 outside the touch."""
        elapsed, remaining = t_s - self.from_s, self.until_s - t_s
        if elapsed <= 0 or remaining <= 0:
            return 0.0
        ramp = min(self.ramp_s, self.duration_s / 2)
        return (
            smoothstep(elapsed / ramp)
            * smoothstep(remaining / ramp)
            * self._plateau_force(elapsed - ramp, ramp)
        )

    def _plateau_force(self, elapsed_s: float, ramp: float) -> float:
        span = self.duration_s - 2 * ramp
        steps = len(self.force_n) - 1
        if steps == 0 or span <= 0:
            return self.force_n[0]
        progress = min(max(elapsed_s / span * steps, 0.0), float(steps))
        step = min(int(progress), steps - 1)
        before, after = self.force_n[step], self.force_n[step + 1]
        return before + (after - before) * smoothstep(progress - step)

    def positions(self, times_s: FloatArray) -> FloatArray:
        """Return `position_at` for times (n,): (2, n)."""
        way = np.array(self.path).T
        if way.shape[1] == 1:
            return np.repeat(way, len(times_s), axis=1)
        passed = self._path_lengths[-1] * smoothstep_array((times_s - self.from_s) / self.duration_s)
        return np.stack([np.interp(passed, self._path_lengths, along) for along in way])

    def forces(self, times_s: FloatArray) -> FloatArray:
        """Return `force_at` for times (n,)."""
        return self._interpolate(np.array(self.force_n), times_s)

    def tangential_forces(self, times_s: FloatArray) -> FloatArray:
        """Return the tangential force (2, n) at times (n,)."""
        levels = np.array(self.tangential_n or [(0.0, 0.0)])
        return np.stack([self._interpolate(along, times_s) for along in levels.T])

    def _interpolate(self, levels: FloatArray, times_s: FloatArray) -> FloatArray:
        """Interpolate levels at evenly spaced times between the ramps."""
        ramp = min(self.ramp_s, self.duration_s / 2)
        elapsed, remaining = times_s - self.from_s, self.until_s - times_s
        span = self.duration_s - 2 * ramp
        plateau = levels[:1]
        if len(levels) > 1 and span > 0:
            progress = np.clip((elapsed - ramp) / span, 0.0, 1.0) * (len(levels) - 1)
            step = np.minimum(progress.astype(int), len(levels) - 2)
            plateau = levels[step] + np.diff(levels)[step] * smoothstep_array(progress - step)
        return np.asarray(smoothstep_array(elapsed / ramp) * smoothstep_array(remaining / ramp) * plateau)

    def force_times_s(self) -> FloatArray:
        """Return times between which the force is nearly linear."""
        ramp = min(self.ramp_s, self.duration_s / 2)
        rise = ramp * np.linspace(0, 1, 9)
        steps = 6 * (len(self.force_n) - 1) + 1
        plateau = np.linspace(self.from_s + ramp, self.until_s - ramp, steps)
        return np.concatenate([self.from_s + rise, plateau, self.until_s - rise])

    @cached_property
    def _path_lengths(self) -> list[float]:
        """Length of the path up to each way point."""
        return [0.0, *itertools.accumulate(math.dist(a, b) for a, b in itertools.pairwise(self.path))]


class ScheduledTouches:
    """The touches of one pad, arranged in lanes of touches that don't overlap in time."""

    def __init__(self, touches: Sequence[tuple[ScenarioTouch, ContactPatch]]) -> None:
        """touches: each with its patch."""
        self._lanes: list[list[tuple[ScenarioTouch, ContactPatch]]] = []
        for touch, patch in sorted(touches, key=lambda pair: pair[0].from_s):
            free = (lane for lane in self._lanes if lane[-1][0].until_s <= touch.from_s)
            lane = next(free, None)
            if lane is None:
                self._lanes.append(lane := [])
            lane.append((touch, patch))
        self._spans_s = [
            np.array([(touch.from_s, touch.until_s) for touch, _ in lane]).T for lane in self._lanes
        ]

    @property
    def max_contacts(self) -> int:
        """Largest number of simultaneous touches."""
        return len(self._lanes)

    @property
    def event_times_s(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Times [s]: to sample the force at; after which the sheet settles; at which touches begin."""
        touches = [touch for lane in self._lanes for touch, _ in lane]
        force_times = [touch.force_times_s() for touch in touches]
        settling = [
            t for touch in touches for t in (touch.from_s, touch.from_s + touch.ramp_s, touch.until_s)
        ]
        begins = np.array([touch.from_s for touch in touches])
        return np.concatenate([np.zeros(0), *force_times]), np.array(settling), begins

    def contacts(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return positions (k, 2, n), forces (k, n) [N], 0 without contact, patches (k, PATCH_ROWS, n)."""
        order = np.argsort(times_s, kind="stable")
        ordered = times_s[order]
        k, n = len(self._lanes), len(times_s)
        position, force = np.full((k, 2, n), 0.5), np.zeros((k, n))
        patches = discs(np.ones((k, n)))
        for row, (lane, spans_s) in enumerate(zip(self._lanes, self._spans_s, strict=True)):
            first, last = np.searchsorted(ordered, spans_s)
            for number in np.flatnonzero(first < last).tolist():
                touch, patch = lane[number]
                during = order[first[number] : last[number]]
                position[row][:, during] = touch.positions(times_s[during])
                force[row, during] = touch.forces(times_s[during])
                patches[row][:, during] = patch.column(force[row, during])
        return position, force, patches

    def tangential_n(self, times_s: FloatArray) -> FloatArray:
        """Return the sum (2, n) of the touches' tangential forces along x and y of the pad [N]."""
        total = np.zeros((2, len(times_s)))
        for touch in (touch for lane in self._lanes for touch, _ in lane if touch.tangential_n):
            during = (touch.from_s < times_s) & (times_s < touch.until_s)
            total[:, during] += touch.tangential_forces(times_s[during])
        return total
