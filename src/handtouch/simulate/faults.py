"""What can be wrong with a pad, as physics: a fault changes a sheet, its wiring or its channels.

Public names: `Fault` and its kinds, `FAULTS` (by name), `INFLUENCES` (what isn't a fault but acts alike),
`Acting` (any of them, as a scenario file has it). They are tables, frozen and checked: `[[fault]]`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from handtouch.canbus.objects.channels import ELECTRODES
from handtouch.config.tables import Electrode, Name, NonNegative, Positive, Table
from handtouch.simulate.circuit import Wiring

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Fraction = Annotated[float, Field(ge=0.02, le=0.98)]
Corner = Literal["x0y0", "x0yb", "xay0", "xayb"]

_LEAK_POINTS = 13
_GOLDEN = np.pi * (3 - 5**0.5)


@dataclass(frozen=True)
class Contacts:
    """What presses on a pad, or leaks into it, over times (n,).

    Places (k, 2) as fractions of the pad, radii (k,), and either forces (n,) [N] of all k,
    or conductances (n,) [S] that they share evenly.
    """

    place: FloatArray
    radius_m: FloatArray
    force_n: FloatArray | None = None
    siemens: FloatArray | None = None


class Fault(Table):
    """What all kinds have in common, and what they may change; a kind overrides what it does change."""

    link: Name = Field(description="link whose pad it befalls")
    from_s: NonNegative = Field(description="when it begins, from the start of the scenario")
    until_s: Positive | None = Field(None, description="when it ends; left out: never")

    @model_validator(mode="after")
    def _ends_after_it_begins(self) -> Self:
        if self.until_s is not None and self.until_s <= self.from_s:
            raise ValueError(f"until_s = {self.until_s} must come after from_s = {self.from_s}")
        return self

    def active(self, times_s: FloatArray) -> BoolArray:
        """When it is there (n,)."""
        until = np.inf if self.until_s is None else self.until_s
        return (times_s >= self.from_s) & (times_s < until)

    def contacts(self, times_s: FloatArray, size_m: tuple[float, float]) -> Contacts | None:  # noqa: ARG002
        """What it presses or leaks, nothing by default; `size_m` are the sides of the pad at its middle."""
        return None

    def rewire(self, wiring: Wiring) -> None:
        """Change the wiring while it is there."""

    def signal(self, counts: FloatArray) -> FloatArray:
        """What becomes of the counts (n, 4) of amplifiers, before noise and rounding, while it is there."""
        return counts

    def freeze(self, counts: NDArray[np.int64], limits: NDArray[np.int64]) -> None:
        """What becomes of the readings (n, 4), in place, while it is there; limits (4, 2)."""

    def warmer_k(self, times_s: FloatArray) -> FloatArray:
        """How much it warms the pad (n,)."""
        return np.zeros(len(times_s))

    @property
    def cut(self) -> tuple[Corner, float, float] | None:
        """The corner that it cuts off, and how much of the sides along x and y [m]."""
        return None

    @property
    def permutation(self) -> list[int] | None:
        """Number of the electrode on each channel, where they are mixed up."""
        return None


class Gum(Fault):
    """Something stuck: it comes with a touch that presses it on, and stays as a nearly constant contact."""

    kind: Literal["gum"] = "gum"
    place: Annotated[tuple[Fraction, Fraction], Field(strict=False)] = Field(
        description="where (x, y), as fractions of the pad"
    )
    radius_mm: Positive = Field(3.0, description="radius of what sticks")
    force_n: Positive = Field(0.5, description="force with which it keeps pressing")
    press_n: NonNegative = Field(1.5, description="force of the touch that brings it; 0: no touch")
    press_s: Positive = Field(0.8, description="how long that touch lasts")
    relax: Annotated[float, Field(ge=0, lt=1)] = Field(0.1, description="share of the force that is lost")
    relax_s: Positive = Field(60.0, description="time constant of that loss")

    def contacts(self, times_s: FloatArray, size_m: tuple[float, float]) -> Contacts:  # noqa: ARG002
        """A disc."""
        since = np.maximum(times_s - self.from_s, 0.0)
        stays = self.force_n * (1 - self.relax * -np.expm1(-since / self.relax_s))
        ramp = _gentle(since / (0.25 * self.press_s))
        let_go = 1 - _gentle((since - 0.7 * self.press_s) / (0.3 * self.press_s))
        force = ramp * np.maximum(stays, self.press_n * let_go) * self.active(times_s)
        return Contacts(np.array([self.place]), np.array([1e-3 * self.radius_mm]), force_n=force)


class Moisture(Fault):
    """Moisture between the layers: they leak over an area, more and more; after the end it dries."""

    kind: Literal["moisture"] = "moisture"
    place: Annotated[tuple[Fraction, Fraction], Field(strict=False)] = Field(
        description="middle of the wet area (x, y), as fractions of the pad"
    )
    radius_mm: Positive = Field(8.0, description="radius of the wet area")
    leak_ohm: Positive = Field(5000.0, description="resistance between the layers over all of it, when wet")
    grow_s: Positive = Field(30.0, description="time constant with which the leak grows")
    dry_s: Positive = Field(120.0, description="time constant with which it dries after the end")

    def contacts(self, times_s: FloatArray, size_m: tuple[float, float]) -> Contacts:
        """Discs spread evenly over the area, as far as the pad reaches."""
        number = np.arange(_LEAK_POINTS) + 0.5
        out, angle = np.sqrt(number / _LEAK_POINTS), _GOLDEN * number
        area = np.stack([out * np.cos(angle), out * np.sin(angle)], axis=1) * 1e-3 * self.radius_mm
        place = np.array(self.place) + area / size_m
        inside = ((place > 0.02) & (place < 0.98)).all(1)
        inside |= out == out[0]
        until = np.inf if self.until_s is None else self.until_s
        grown = -np.expm1(-np.clip(times_s, self.from_s, until) / self.grow_s + self.from_s / self.grow_s)
        dried = np.exp(-np.maximum(times_s - until, 0.0) / self.dry_s)
        siemens = grown * dried * inside.sum() / _LEAK_POINTS / self.leak_ohm
        radius = 1e-3 * self.radius_mm / _LEAK_POINTS**0.5
        return Contacts(np.clip(place[inside], 0.02, 0.98), np.full(inside.sum(), radius), siemens=siemens)


class DeadElectrode(Fault):
    """A broken wire: the electrode floats, and the other three share all of the current."""

    kind: Literal["dead_electrode"] = "dead_electrode"
    electrode: Electrode = Field(description="electrode whose wire is broken")
    open_ohm: Positive = Field(1e9, description="resistance of the break")

    def rewire(self, wiring: Wiring) -> None:
        """Add the break to the electrode's resistor."""
        wiring.series_ohm[_number(self.electrode)] += self.open_ohm


class ShortedElectrode(Fault):
    """A short circuit of an electrode, to the conducting layer or to another electrode."""

    kind: Literal["shorted_electrode"] = "shorted_electrode"
    electrode: Electrode = Field(description="electrode that is shorted")
    to: Electrode | Literal["layer"] = Field("layer", description="what it touches")
    short_ohm: Positive = Field(5.0, description="resistance of the short circuit")
    input_ohm: NonNegative = Field(
        50.0, description="resistance of each amplifier's input, by which two shorted electrodes share"
    )

    @model_validator(mode="after")
    def _is_another(self) -> Self:
        if self.to == self.electrode:
            raise ValueError(f'to = "{self.to}" is the electrode itself; name another one or "layer"')
        return self

    def rewire(self, wiring: Wiring) -> None:
        """Add the short circuit."""
        one = _number(self.electrode)
        if self.to == "layer":
            wiring.to_layer.append((one, self.short_ohm))
            return
        other = _number(self.to)
        wiring.between.append((one, other, self.short_ohm))
        wiring.series_ohm[[one, other]] += self.input_ohm


class SwappedCables(Fault):
    """Cables plugged into each other's sockets."""

    kind: Literal["swapped_cables"] = "swapped_cables"
    order: Annotated[tuple[Electrode, Electrode, Electrode, Electrode], Field(strict=False)] = Field(
        description="electrodes that are plugged in where x0, xa, y0, yb belong"
    )

    @model_validator(mode="after")
    def _is_an_order(self) -> Self:
        if set(self.order) != set(ELECTRODES) or self.order == ELECTRODES:
            raise ValueError("order must name each of x0, xa, y0, yb once, and change their order")
        return self

    @property
    def permutation(self) -> list[int]:
        """Number of the electrode on each channel."""
        return [_number(electrode) for electrode in self.order]


class SaturatedChannel(Fault):
    """A channel at an end of its range."""

    kind: Literal["saturated_channel"] = "saturated_channel"
    electrode: Electrode = Field(description="electrode of the channel")
    high: bool = Field(True, description="whether at the upper end")

    def freeze(self, counts: NDArray[np.int64], limits: NDArray[np.int64]) -> None:
        """The limit."""
        channel = _number(self.electrode)
        counts[:, channel] = limits[channel, int(self.high)]


class StuckChannel(Fault):
    """A channel that shows one count for ever."""

    kind: Literal["stuck_channel"] = "stuck_channel"
    electrode: Electrode = Field(description="electrode of the channel")
    count: int | None = Field(None, description="what it shows; left out: what it showed when it got stuck")

    def freeze(self, counts: NDArray[np.int64], limits: NDArray[np.int64]) -> None:
        """The count."""
        channel = _number(self.electrode)
        if self.count is not None:
            counts[:, channel] = np.clip(self.count, *limits[channel])


class TornCorner(Fault):
    """A corner of the sheet is cut off, straight across: what is beyond the cut conducts no more."""

    kind: Literal["torn_corner"] = "torn_corner"
    corner: Corner = Field(description="the corner between these electrodes")
    along_x_mm: NonNegative = Field(description="how much of the side along x is gone")
    along_y_mm: NonNegative = Field(description="how much of the side along y is gone")

    @property
    def cut(self) -> tuple[Corner, float, float]:
        """The corner and the lost sides [m]."""
        return self.corner, 1e-3 * self.along_x_mm, 1e-3 * self.along_y_mm


class Offset(Fault):
    """An amplifier's zero has jumped."""

    kind: Literal["offset"] = "offset"
    electrode: Electrode = Field(description="electrode of the channel")
    counts: float = Field(description="how far")

    def signal(self, counts: FloatArray) -> FloatArray:
        """With the offset."""
        counts[:, _number(self.electrode)] += self.counts
        return counts


class GainStep(Fault):
    """A channel's gain has changed."""

    kind: Literal["gain_step"] = "gain_step"
    electrode: Electrode = Field(description="electrode of the channel")
    factor: Positive = Field(description="times the gain that it had")

    def signal(self, counts: FloatArray) -> FloatArray:
        """With the new gain."""
        counts[:, _number(self.electrode)] *= self.factor
        return counts


class Heat(Fault):
    """Not a fault: something warm or cold is held, and the pad takes on its temperature."""

    kind: Literal["heat"] = "heat"
    warmer_by_k: float = Field(description="temperature that it tends to, above its own; negative: colder")
    time_s: Positive = Field(40.0, description="time constant with which it warms, and cools again")

    def warmer_k(self, times_s: FloatArray) -> FloatArray:
        """Exponentially there and back."""
        until = np.inf if self.until_s is None else self.until_s
        risen = -np.expm1((self.from_s - np.clip(times_s, self.from_s, until)) / self.time_s)
        return np.asarray(self.warmer_by_k * risen * np.exp(-np.maximum(times_s - until, 0.0) / self.time_s))


FAULTS: Mapping[str, type[Fault]] = MappingProxyType(
    {
        "gum": Gum,
        "moisture": Moisture,
        "dead_electrode": DeadElectrode,
        "shorted_electrode": ShortedElectrode,
        "swapped_cables": SwappedCables,
        "saturated_channel": SaturatedChannel,
        "torn_corner": TornCorner,
        "offset": Offset,
        "stuck_channel": StuckChannel,
        "gain_step": GainStep,
    }
)
INFLUENCES: Mapping[str, type[Fault]] = MappingProxyType({"heat": Heat})

Acting = Annotated[
    Gum
    | Moisture
    | DeadElectrode
    | ShortedElectrode
    | SwappedCables
    | SaturatedChannel
    | TornCorner
    | Offset
    | StuckChannel
    | GainStep
    | Heat,
    Field(discriminator="kind"),
]


def _number(electrode: str) -> int:
    return ELECTRODES.index(electrode)


def _gentle(part: FloatArray) -> FloatArray:
    part = np.clip(part, 0.0, 1.0)
    return np.asarray(part * part * (3 - 2 * part))
