"""Scenario file (TOML) -> frozen, checked touches on links: where, when and how hard.

Public names: `Scenario`, `Touch`, `Swap`. Mistakes are reported as in a deployment file.
"""

from __future__ import annotations

import itertools
import math
import tomllib
from bisect import bisect_right
from collections.abc import Callable, Iterable
from functools import cached_property
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from handtouch.config import Deployment
from handtouch.config.problems import ConfigError, Problem, problems_of
from handtouch.config.tables import Four, Name, Positive, Table, Unsigned32
from handtouch.hand.urdf import Description
from handtouch.simulate.faults import FAULTS, INFLUENCES, Acting
from handtouch.simulate.joints import Motion, Moved
from handtouch.simulate.play import Played, Pressing

FloatArray = NDArray[np.float64]
_Fraction = Annotated[float, Field(ge=0.02, le=0.98)]
_Point = Annotated[tuple[_Fraction, _Fraction], Field(strict=False)]
_TOUR_S, _TOUR_STEP_S = 1.6, 1.0
_KINDS = {**FAULTS, **INFLUENCES}


class Touch(Table):
    """`[[touch]]`: one contact from its begin to its end."""

    link: Name = Field(description="link that is touched")
    from_s: float = Field(ge=0, description="when it begins, from the start of the scenario")
    duration_s: Positive = Field(description="how long it lasts, ramps included")
    path: Annotated[tuple[_Point, ...], Field(strict=False, min_length=1)] = Field(
        description="way points (x, y) as fractions of the pad, from electrodes x0 and y0; 0.02 to 0.98"
    )
    force_n: Annotated[tuple[Positive, ...], Field(strict=False, min_length=1)] = Field(
        description="forces at even times between the ramps, smoothly joined; one for an even press"
    )
    ramp_s: Positive = Field(0.15, description="time in which the force rises from nothing and falls again")
    radius_mm: Positive | None = Field(None, description="radius of the contact; left out: the sheet's own")

    @property
    def until_s(self) -> float:
        """When it ends."""
        return self.from_s + self.duration_s

    def place(self, t_s: float) -> tuple[float, float]:
        """Where it is at `t_s`, fractions of the pad; it starts and stops gently and passes at even speed."""
        if len(self.path) == 1:
            return self.path[0]
        passed = self._lengths[-1] * _gentle((t_s - self.from_s) / self.duration_s)
        leg = min(max(bisect_right(self._lengths, passed) - 1, 0), len(self.path) - 2)
        (x0, y0), (x1, y1) = self.path[leg], self.path[leg + 1]
        length = self._lengths[leg + 1] - self._lengths[leg]
        part = (passed - self._lengths[leg]) / length if length > 0 else 0.0
        return x0 + part * (x1 - x0), y0 + part * (y1 - y0)

    def force(self, t_s: float) -> float:
        """Force at `t_s` in newton, 0 outside the touch."""
        since, left = t_s - self.from_s, self.until_s - t_s
        if since <= 0 or left <= 0:
            return 0.0
        ramp = min(self.ramp_s, self.duration_s / 2)
        return _gentle(since / ramp) * _gentle(left / ramp) * self._plateau((since - ramp), ramp)

    def _plateau(self, since_s: float, ramp: float) -> float:
        span = self.duration_s - 2 * ramp
        steps = len(self.force_n) - 1
        if steps == 0 or span <= 0:
            return self.force_n[0]
        at = min(max(since_s / span * steps, 0.0), float(steps))
        step = min(int(at), steps - 1)
        before, after = self.force_n[step], self.force_n[step + 1]
        return before + (after - before) * _gentle(at - step)

    def places(self, times_s: FloatArray) -> FloatArray:
        """`place` at many times (n,): (2, n)."""
        way = np.array(self.path).T
        if way.shape[1] == 1:
            return np.repeat(way, len(times_s), axis=1)
        passed = self._lengths[-1] * _gentles((times_s - self.from_s) / self.duration_s)
        return np.stack([np.interp(passed, self._lengths, along) for along in way])

    def forces(self, times_s: FloatArray) -> FloatArray:
        """`force` at many times (n,)."""
        ramp = min(self.ramp_s, self.duration_s / 2)
        since, left = times_s - self.from_s, self.until_s - times_s
        levels, span = np.array(self.force_n), self.duration_s - 2 * ramp
        plateau = levels[:1]
        if len(levels) > 1 and span > 0:
            at = np.clip((since - ramp) / span, 0.0, 1.0) * (len(levels) - 1)
            step = np.minimum(at.astype(int), len(levels) - 2)
            plateau = levels[step] + np.diff(levels)[step] * _gentles(at - step)
        return np.asarray(_gentles(since / ramp) * _gentles(left / ramp) * plateau)

    def knots(self) -> FloatArray:
        """Times between which its force is nearly straight."""
        ramp = min(self.ramp_s, self.duration_s / 2)
        rise = ramp * np.linspace(0, 1, 9)
        steps = 6 * (len(self.force_n) - 1) + 1
        plateau = np.linspace(self.from_s + ramp, self.until_s - ramp, steps)
        return np.concatenate([self.from_s + rise, plateau, self.until_s - rise])

    @cached_property
    def _lengths(self) -> list[float]:
        """Length of the path up to each way point."""
        return [0.0, *itertools.accumulate(math.dist(a, b) for a, b in itertools.pairwise(self.path))]


class Swap(Table):
    """`[[swap]]`: a pad's node is taken out and another unit put in."""

    link: Name = Field(description="link whose pad gets another node")
    at_s: float = Field(ge=0, description="when, from the start; once, also where the scenario repeats")
    serial: Unsigned32 = Field(description="serial number of the new one")
    gain: Four | None = Field(
        None, description="gains of its channels, relative to what is configured; left out: drawn by serial"
    )


class Scenario(Table):
    """What happens to a hand; after the last touch it ends, or begins again after `pause_s`."""

    touches: Annotated[tuple[Touch, ...], Field(strict=False, min_length=1)] = Field(alias="touch")
    faults: Annotated[tuple[Acting, ...], Field(strict=False)] = Field(
        (), alias="fault", description="what is wrong with pads, and when"
    )
    swaps: Annotated[tuple[Swap, ...], Field(strict=False)] = Field(
        (), alias="swap", description="nodes that are replaced, and when"
    )
    motions: Annotated[tuple[Motion, ...], Field(strict=False)] = Field(
        (), alias="joint", description="how the joints move; a hand without any stands still"
    )
    repeat: bool = Field(False, description="whether it begins again when it has ended")
    pause_s: float = Field(1.0, ge=0, description="time after the last touch, before it ends or begins again")

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read and check a scenario file. Raises ConfigError naming every mistake."""
        try:
            text = Path(path).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "is not UTF-8 text"
            problem = Problem("the file", "", f"{reason}; give the path of a scenario file")
            raise ConfigError(str(path), (problem,)) from error
        return cls.parse(text, str(path))

    @classmethod
    def parse(cls, text: str, file: str = "scenario.toml") -> Self:
        """Check the text of a scenario file. Raises ConfigError naming every mistake."""
        try:
            raw = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise ConfigError(file, (Problem("TOML", "", f"{error}; mend the syntax there"),)) from error
        try:
            scenario = cls.model_validate(raw)
        except ValidationError as error:
            tables: dict[str, type[Table]] = {"": cls, "touch": Touch, "swap": Swap, "joint": Motion}
            raise ConfigError(file, problems_of(raw, error, tables, _KINDS)) from error
        return scenario

    @classmethod
    def tour(cls, deployment: Deployment) -> Self:
        """A touch that slides and presses on every pad in turn, each begun before the last has ended."""
        links = dict.fromkeys(pad.link for hand in deployment.hands for pad in hand.pads)
        touches = [
            Touch(
                link=link,
                from_s=1.0 + number * _TOUR_STEP_S,
                duration_s=_TOUR_S,
                path=((0.3, 0.35), (0.7, 0.5), (0.4, 0.65)),
                force_n=(0.5, 2.0, 1.0),
            )
            for number, link in enumerate(links)
        ]
        return cls.model_validate({"touch": touches, "repeat": True})

    @property
    def duration_s(self) -> float:
        """Time of one round."""
        return max(touch.until_s for touch in self.touches) + self.pause_s

    @property
    def links(self) -> list[tuple[str, float | None]]:
        """Of each touch its link, and its radius [m] where it says one."""
        return [(t.link, None if t.radius_mm is None else 1e-3 * t.radius_mm) for t in self.touches]

    def on(self, link: str, radius_m: Callable[[int], float]) -> Played:
        """The touches of one pad; `radius_m` of a touch by its number, where it doesn't say one."""
        return Played(
            [
                (touch, 1e-3 * touch.radius_mm if touch.radius_mm else radius_m(number))
                for number, touch in enumerate(self.touches)
                if touch.link == link
            ]
        )

    def moved(self, robot: Description) -> Moved | None:
        """How the joints of a hand move; None where nothing moves them."""
        return Moved(robot.joints.values(), self.motions) if self.motions else None

    def pressing(self, t_s: float) -> list[Pressing]:
        """The contacts at `t_s` from the start."""
        if self.repeat:
            t_s %= self.duration_s
        return [
            Pressing(number, *touch.place(t_s), force)
            for number, touch in enumerate(self.touches)
            if touch.from_s < t_s < touch.until_s and (force := touch.force(t_s)) > 0
        ]

    def check_links(self, links: Iterable[str], file: str = "scenario") -> None:
        """Raise ConfigError for a touch, fault or swap on a link that carries no pad."""
        known = sorted(set(links))
        problems = [
            Problem(
                f"[[{table}]] {number}: link",
                f' = "{entry.link}"',
                f"carries no pad; pads: {', '.join(known)}",
            )
            for table, entries in (("touch", self.touches), ("fault", self.faults), ("swap", self.swaps))
            for number, entry in enumerate(entries, 1)
            if entry.link not in known
        ]
        if problems:
            raise ConfigError(file, tuple(problems))


def _gentles(part: FloatArray) -> FloatArray:
    """`_gentle` of many."""
    part = np.clip(part, 0.0, 1.0)
    return np.asarray(part * part * (3 - 2 * part))


def _gentle(part: float) -> float:
    """0 to 1 with level ends (smoothstep)."""
    part = min(max(part, 0.0), 1.0)
    return part * part * (3 - 2 * part)
