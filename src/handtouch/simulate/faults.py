"""Faults of a pad as physics: each changes the sheet, its wiring, or its channels.

A fault class declares its `kind`, the keys of its `[[fault]]` table and its effects; everything else follows
from the class. Public names: `Fault` and its subclasses, `FAULTS` (by kind), `INFLUENCES` (not faults, but
with similar effects), `AnyFault` (any of them, as a scenario file has it), `electrode_index`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from handtouch.arrays import BoolArray, FloatArray
from handtouch.config.base import Name, NonNegative, OneOfKinds, Positive, Table
from handtouch.config.tables import SIDE_ELECTRODES, Electrode
from handtouch.simulate.sheet_circuit import Wiring
from handtouch.simulate.smoothstep import smoothstep_array
from handtouch.wire.faults import FaultKind

Fraction = Annotated[float, Field(ge=0.02, le=0.98)]
Channel = Annotated[str, Field(pattern=r"^(x0|xa|y0|yb|t[1-9][0-9]?)$")]
Corner = Literal["x0y0", "x0yb", "xay0", "xayb"]

_LEAK_POINTS = 13
_GOLDEN_ANGLE_RAD = np.pi * (3 - 5**0.5)


@dataclass(frozen=True)
class FaultContacts:
    """Contacts or leaks that a fault adds to a pad at n times: k discs with a force or a conductance."""

    position: FloatArray
    """(k, 2), fractions of the pad."""
    radius_m: FloatArray
    """(k,)."""
    force_n: FloatArray | None = None
    """(n,), the force of each disc."""
    conductance_s: FloatArray | None = None
    """(n,) [S], shared evenly by all discs."""


class Fault(Table):
    """`[[fault]]`: keys of all kinds, and effects; a subclass overrides the effects that it has."""

    is_influence: ClassVar[bool] = False
    """True for influences that are no fault, such as heat."""
    link: Name = Field(description="link of the pad with the fault")
    from_s: NonNegative = Field(description="begin, in seconds since the start of the scenario")
    until_s: Positive | None = Field(None, description="end; left out: it lasts")

    @classmethod
    def fault_kind(cls) -> FaultKind:
        """Return the class's `kind`."""
        kind: FaultKind = cls.model_fields["kind"].default
        return kind

    @model_validator(mode="after")
    def _check_interval(self) -> Self:
        if self.until_s is not None and self.until_s <= self.from_s:
            raise ValueError(f"until_s = {self.until_s} must come after from_s = {self.from_s}")
        return self

    def is_active(self, times_s: FloatArray) -> BoolArray:
        """Return whether the fault is active at times (n,)."""
        until = np.inf if self.until_s is None else self.until_s
        return (times_s >= self.from_s) & (times_s < until)

    def contacts(self, times_s: FloatArray, size_m: tuple[float, float]) -> FaultContacts | None:  # noqa: ARG002
        """Return contacts or leaks that the fault adds; `size_m` are the sides of the pad at its middle."""
        return None

    def modify_wiring(self, wiring: Wiring) -> None:
        """Change the wiring, in place, while the fault is active."""

    def distort_counts(self, counts: FloatArray) -> FloatArray:
        """Return the amplifiers' counts (n, 4), before noise and rounding, while the fault is active."""
        return counts

    def override_counts(self, counts: NDArray[np.int64], limits: NDArray[np.int64]) -> None:
        """Overwrite readings (n, 4) in place while the fault is active; limits (4, 2) of the channels."""

    def temperature_rise_k(self, times_s: FloatArray) -> FloatArray:
        """Return the temperature rise (n,) that it causes."""
        return np.zeros(len(times_s))

    @property
    def cut_corner(self) -> tuple[Corner, float, float] | None:
        """Corner that is cut off, and the lost lengths of the sides along x and y [m]; None: no cut."""
        return None

    @property
    def channel_permutation(self) -> list[int] | None:
        """Index of the electrode on each channel; None: in order."""
        return None


class Gum(Fault):
    """Something sticks to the pad: a touch presses it on, then it remains as a nearly constant contact."""

    kind: Literal[FaultKind.GUM] = FaultKind.GUM
    place: Annotated[tuple[Fraction, Fraction], Field(strict=False)] = Field(
        description="position (x, y), as fractions of the pad"
    )
    radius_mm: Positive = Field(3.0, description="radius of the stuck object")
    force_n: Positive = Field(0.5, description="force of the remaining contact")
    press_n: NonNegative = Field(1.5, description="force of the touch that presses it on; 0: no touch")
    press_s: Positive = Field(0.8, description="duration of that touch")
    relax: Annotated[float, Field(ge=0, lt=1)] = Field(
        0.1, description="fraction of the force that is lost by relaxation"
    )
    relax_s: Positive = Field(60.0, description="time constant of the relaxation")

    def contacts(self, times_s: FloatArray, size_m: tuple[float, float]) -> FaultContacts:  # noqa: ARG002
        """Return one disc."""
        elapsed = np.maximum(times_s - self.from_s, 0.0)
        remaining = self.force_n * (1 - self.relax * -np.expm1(-elapsed / self.relax_s))
        ramp = smoothstep_array(elapsed / (0.25 * self.press_s))
        release = 1 - smoothstep_array((elapsed - 0.7 * self.press_s) / (0.3 * self.press_s))
        force = ramp * np.maximum(remaining, self.press_n * release) * self.is_active(times_s)
        return FaultContacts(np.array([self.place]), np.array([1e-3 * self.radius_mm]), force_n=force)


class Moisture(Fault):
    """Moisture between the layers: a leak over an area that grows, and dries after the end."""

    kind: Literal[FaultKind.MOISTURE] = FaultKind.MOISTURE
    place: Annotated[tuple[Fraction, Fraction], Field(strict=False)] = Field(
        description="centre of the wet area (x, y), as fractions of the pad"
    )
    radius_mm: Positive = Field(8.0, description="radius of the wet area")
    leak_ohm: Positive = Field(5000.0, description="resistance between the layers over the whole wet area")
    grow_s: Positive = Field(30.0, description="time constant of the growing leak")
    dry_s: Positive = Field(120.0, description="time constant of drying after the end")

    def contacts(self, times_s: FloatArray, size_m: tuple[float, float]) -> FaultContacts:
        """Return discs spread evenly over the part of the area that lies on the pad."""
        number = np.arange(_LEAK_POINTS) + 0.5
        out, angle = np.sqrt(number / _LEAK_POINTS), _GOLDEN_ANGLE_RAD * number
        area = np.stack([out * np.cos(angle), out * np.sin(angle)], axis=1) * 1e-3 * self.radius_mm
        position = np.array(self.place) + area / size_m
        inside = ((position > 0.02) & (position < 0.98)).all(1)
        inside |= out == out[0]
        until = np.inf if self.until_s is None else self.until_s
        grown = -np.expm1(-np.clip(times_s, self.from_s, until) / self.grow_s + self.from_s / self.grow_s)
        dried = np.exp(-np.maximum(times_s - until, 0.0) / self.dry_s)
        conductance = grown * dried * inside.sum() / _LEAK_POINTS / self.leak_ohm
        radius = 1e-3 * self.radius_mm / _LEAK_POINTS**0.5
        return FaultContacts(
            np.clip(position[inside], 0.02, 0.98), np.full(inside.sum(), radius), conductance_s=conductance
        )


class DeadElectrode(Fault):
    """Broken wire: the electrode floats, and the other three carry all of the current."""

    kind: Literal[FaultKind.DEAD_ELECTRODE] = FaultKind.DEAD_ELECTRODE
    electrode: Channel = Field(description="electrode whose wire is broken")
    open_ohm: Positive = Field(1e9, description="resistance of the break")

    def modify_wiring(self, wiring: Wiring) -> None:
        """Add the break to the electrode's resistor."""
        wiring.series_ohm[electrode_index(self.electrode)] += self.open_ohm


class ShortedElectrode(Fault):
    """Short circuit of an electrode, to the conducting layer or to another electrode."""

    kind: Literal[FaultKind.SHORTED_ELECTRODE] = FaultKind.SHORTED_ELECTRODE
    electrode: Electrode = Field(description="electrode that is shorted")
    to: Electrode | Literal["layer"] = Field("layer", description="what it is shorted to")
    short_ohm: Positive = Field(5.0, description="resistance of the short circuit")
    input_ohm: NonNegative = Field(
        50.0,
        description="input resistance of each amplifier, which divides the current of two shorted electrodes",
    )

    @model_validator(mode="after")
    def _check_other_electrode(self) -> Self:
        if self.to == self.electrode:
            raise ValueError(f'to = "{self.to}" is the electrode itself; name another one or "layer"')
        return self

    def modify_wiring(self, wiring: Wiring) -> None:
        """Add the short circuit."""
        one = electrode_index(self.electrode)
        if self.to == "layer":
            wiring.layer_shorts.append((one, self.short_ohm))
            return
        other = electrode_index(self.to)
        wiring.electrode_shorts.append((one, other, self.short_ohm))
        wiring.series_ohm[[one, other]] += self.input_ohm


class SwappedCables(Fault):
    """Electrode cables plugged into the wrong sockets."""

    kind: Literal[FaultKind.SWAPPED_CABLES] = FaultKind.SWAPPED_CABLES
    order: Annotated[tuple[Electrode, Electrode, Electrode, Electrode], Field(strict=False)] = Field(
        description="electrodes found on the channels of x0, xa, y0, yb"
    )

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if set(self.order) != set(SIDE_ELECTRODES) or self.order == SIDE_ELECTRODES:
            raise ValueError("order must name each of x0, xa, y0, yb once, and change their order")
        return self

    @property
    def channel_permutation(self) -> list[int]:
        """Index of the electrode on each channel."""
        return [electrode_index(electrode) for electrode in self.order]


class SaturatedChannel(Fault):
    """Channel at an end of its range."""

    kind: Literal[FaultKind.SATURATED_CHANNEL] = FaultKind.SATURATED_CHANNEL
    electrode: Channel = Field(description="electrode of the channel")
    high: bool = Field(True, description="true: at the upper end; false: at the lower")

    def override_counts(self, counts: NDArray[np.int64], limits: NDArray[np.int64]) -> None:
        """Set the channel to its limit."""
        channel = electrode_index(self.electrode)
        counts[:, channel] = limits[channel, int(self.high)]


class StuckChannel(Fault):
    """Channel that always reads the same count."""

    kind: Literal[FaultKind.STUCK_CHANNEL] = FaultKind.STUCK_CHANNEL
    electrode: Channel = Field(description="electrode of the channel")
    count: int | None = Field(None, description="the count; left out: the reading when it got stuck")

    def override_counts(self, counts: NDArray[np.int64], limits: NDArray[np.int64]) -> None:
        """Set the channel to the count."""
        channel = electrode_index(self.electrode)
        if self.count is not None:
            counts[:, channel] = np.clip(self.count, *limits[channel])


class TornCorner(Fault):
    """Corner of the sheet cut off along a straight line: no conduction beyond the cut."""

    kind: Literal[FaultKind.TORN_CORNER] = FaultKind.TORN_CORNER
    corner: Corner = Field(description="the corner between these electrodes")
    along_x_mm: NonNegative = Field(description="lost length of the side along x")
    along_y_mm: NonNegative = Field(description="lost length of the side along y")

    @property
    def cut_corner(self) -> tuple[Corner, float, float]:
        """Corner, and the lost lengths of its sides [m]."""
        return self.corner, 1e-3 * self.along_x_mm, 1e-3 * self.along_y_mm


class Offset(Fault):
    """Step of an amplifier's zero."""

    kind: Literal[FaultKind.OFFSET] = FaultKind.OFFSET
    electrode: Channel = Field(description="electrode of the channel")
    counts: float = Field(description="size of the step")

    def distort_counts(self, counts: FloatArray) -> FloatArray:
        """Add the offset."""
        counts[:, electrode_index(self.electrode)] += self.counts
        return counts


class GainStep(Fault):
    """Step of a channel's gain."""

    kind: Literal[FaultKind.GAIN_STEP] = FaultKind.GAIN_STEP
    electrode: Channel = Field(description="electrode of the channel")
    factor: Positive = Field(description="new gain relative to the old one")

    def distort_counts(self, counts: FloatArray) -> FloatArray:
        """Apply the new gain."""
        counts[:, electrode_index(self.electrode)] *= self.factor
        return counts


class Heat(Fault):
    """Not a fault: the pad takes on the temperature of a warm or cold object in the hand."""

    is_influence: ClassVar[bool] = True
    kind: Literal[FaultKind.HEAT] = FaultKind.HEAT
    warmer_by_k: float = Field(
        description="temperature that the pad tends to, relative to its own; negative: colder"
    )
    time_s: Positive = Field(40.0, description="time constant of warming and cooling")

    def temperature_rise_k(self, times_s: FloatArray) -> FloatArray:
        """Return an exponential rise, and a decay after the end."""
        until = np.inf if self.until_s is None else self.until_s
        risen = -np.expm1((self.from_s - np.clip(times_s, self.from_s, until)) / self.time_s)
        return np.asarray(self.warmer_by_k * risen * np.exp(-np.maximum(times_s - until, 0.0) / self.time_s))


_ALL = tuple(Fault.__subclasses__())
FAULTS: Mapping[str, type[Fault]] = MappingProxyType(
    {it.fault_kind(): it for it in _ALL if not it.is_influence}
)
"""By kind, as in a scenario file."""
INFLUENCES: Mapping[str, type[Fault]] = MappingProxyType(
    {it.fault_kind(): it for it in _ALL if it.is_influence}
)
AnyFault = Annotated[Fault, OneOfKinds({**FAULTS, **INFLUENCES})]


def electrode_index(electrode: str) -> int:
    """Return the number of an electrode on a side, or of channel t1, t2 ... of a response."""
    if electrode not in SIDE_ELECTRODES:
        return int(electrode.removeprefix("t")) - 1
    return SIDE_ELECTRODES.index(electrode)
