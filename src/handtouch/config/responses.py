"""The tables `[response.NAME]`: kinds of pads that aren't a sheet with electrodes on a conductor, to which
entry points of the group `handtouch.responses` add (docs/responses.md).

Public names: `ResponseTable`, `ForceLaw`, `RESPONSES`, `PadResponse`, `Taxels`, `TwoLayersTable`,
`Measured`, `response_of`,
`presses_of`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, TypeAdapter, ValidationError

from handtouch import field
from handtouch.config.base import (
    CHANNEL_RANGE,
    PER_CHANNEL,
    Name,
    NonNegative,
    OneOfKinds,
    Positive,
    PositivePerChannel,
    Table,
    Vector3,
)
from handtouch.field.channel_map import ChannelMap
from handtouch.field.embedded_file import embed_file, read_embedded
from handtouch.field.surface_base import Surface
from handtouch.host.plugins import load_plugins

Place = Annotated[tuple[float, ...], Field(strict=False, min_length=2, max_length=3)]

_STACK_FACTOR_AT_1N = 3e7
"""Resistance of the equivalent layer at 1 N over its sheet's, so that the sheet matters to 1e-5 up to 300 N,
and a millinewton is within the tables of the law."""
_MM = 1e-3


@lru_cache(maxsize=64)
def presses_of(file: str) -> field.PressTable:
    """Return the presses of a file, by its path or embedded. Raises ValueError."""
    return field.PressTable(read_embedded(file))


class ResponseTable(Table):
    """What a kind of pad responds with; its keys depend on `kind`."""

    kind: str
    is_current: ClassVar[bool] = False
    """channels measure currents of electrodes, in milliamperes"""

    @property
    def channel_count(self) -> int:
        """Number of channels."""
        raise NotImplementedError

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels, in their order."""
        return tuple(f"t{number}" for number in range(1, self.channel_count + 1))

    def build(self, surface: Surface) -> ChannelMap:
        """Return the signals of the channels on a surface. Raises ValueError for what can't exist."""
        raise NotImplementedError

    def with_embedded_files(self, folder: Path) -> Self:  # noqa: ARG002
        """Return the table with the content of the files that it names, relative to a folder."""
        return self

    def sheet_values(self) -> dict[str, Any]:
        """Return the keys of the sheet whose contacts have the same law of strength and tolerances."""
        raise NotImplementedError

    def problems(self, surface: Surface) -> Iterator[tuple[str, str]]:
        """Yield (key, remedy) for values that don't fit each other, or the surface."""
        try:
            self.build(surface)
        except ValueError as error:
            key, _, remedy = str(error).partition(": ")
            yield (key, remedy) if key in type(self).model_fields else ("kind", str(error))


class ForceLaw(ResponseTable):
    """Keys of kinds whose strength follows from the force alone: strength = (force / 1 N)^alpha.

    A signal is a channel's share of the strength, times `signal_per_n`, in the unit of the node's counts.
    The law is that of a contact on a sheet without resistance, through a layer whose conductance grows with
    force^alpha: so it is calibrated, and its tolerances are propagated, as those of sheets are.
    """

    alpha: float = Field(1.0, ge=0.3, le=1.5, description="exponent of the force in a signal; 1: linear")
    alpha_std: Annotated[float, Field(ge=0, le=1)] = Field(0.0, description="error of alpha (1 sigma)")
    signal_std: Annotated[float, Field(ge=0, le=1)] = Field(
        0.2, description="relative error of all signals together at one force, hysteresis included (1 sigma)"
    )
    contact_radius_mm: Positive = Field(2.0, description="radius of a contact, which widens the response")
    contact_radius_std_mm: NonNegative = Field(0.5, description="spread of that radius (1 sigma)")
    contact_elongation_std: Annotated[float, Field(ge=0, le=2)] = Field(
        0.4, description="logarithm of a contact's length over its width, along x or y (1 sigma)"
    )
    max_force_n: Positive | None = Field(
        None, description="greatest force of a contact; default: unknown", examples=[20.0]
    )
    pair_false_alarm: Annotated[float, Field(ge=0, le=0.002)] = Field(
        1e-3, description="probability that one contact is reported as two; 0: never two"
    )
    max_contact_length_mm: NonNegative = Field(
        10.0, description="length up to which an elongated contact isn't reported as two"
    )

    @property
    def unit_signal(self) -> float:
        """Signal of a contact of 1 N right on a channel of gain 1, in the unit of the node's counts."""
        raise NotImplementedError

    def sheet_values(self) -> dict[str, Any]:
        area_mm2 = math.pi * self.contact_radius_mm**2
        return {
            "ohm_per_square": 2 * math.pi / (_STACK_FACTOR_AT_1N * self.unit_signal),
            "contact_ohm_mm2": area_mm2 / self.unit_signal,
            "reference_kpa": 1e3 / area_mm2,  # the pressure of 1 N
            "alpha": self.alpha,
            "contact_radius_mm": self.contact_radius_mm,
            "contact_radius_std_mm": 0.0,
            "contact_elongation_std": 0.0,
            "contact_tilt_std": 0.0,
            "crowding": False,
            "pair_false_alarm": self.pair_false_alarm,
            "max_contact_length_mm": self.max_contact_length_mm,
            "max_force_n": self.max_force_n,
            "ohm_per_square_std": 0.0,
            "contact_ohm_std": self.signal_std,
            "alpha_std": self.alpha_std,
            "anisotropy_std": 0.0,
            "gap_std_mm": 0.0,
            "unevenness_std": 0.0,
            "size_std_mm": 0.0,
        }


class Taxels(ForceLaw):
    """Sensors of a force each, at known places: FSR arrays, barometers, Hall sensors by their resultant."""

    kind: Literal["taxels"]
    positions_mm: Annotated[tuple[Place, ...], PER_CHANNEL] = Field(
        description=f"places of the {CHANNEL_RANGE} taxels: x and y along the surface from the pad's centre, "
        "or x, y and z in the pad frame, also below the surface",
        examples=[[[-5.0, -5.0], [5.0, -5.0], [0.0, 5.0]]],
    )
    normals: Annotated[tuple[Vector3, ...], PER_CHANNEL] | None = Field(
        None,
        description="directions of the taxels out of the pad; default: the surface's",
        examples=[[[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]],
    )
    profile: Literal["gaussian", "buried"] = Field(
        "gaussian",
        description="response by the distance d from a taxel: exp(-d^2 / 2 w^2), or of taxels at the depth w "
        "under an elastic cover (1 + d^2 / w^2)^-2.5",
    )
    width_mm: Positive | PositivePerChannel = Field(
        description="w of the profile for a contact that is a point, of all taxels or of each", examples=[4.0]
    )
    signal_per_n: Positive | PositivePerChannel = Field(
        description="signal of a taxel for 1 N right on it, in the unit of the node's counts, of all or each",
        examples=[1.0],
    )
    position_std_mm: NonNegative = Field(0.2, description="error of a position along each axis (1 sigma)")
    width_std: Annotated[float, Field(ge=0, le=1)] = Field(
        0.05, description="relative error of width_mm (1 sigma)"
    )
    crosstalk_std: Annotated[float, Field(ge=0, le=1)] = Field(
        0.01, description="share of its nearest neighbours' signals that a taxel reads besides (1 sigma)"
    )
    profile_std: Annotated[float, Field(ge=0, le=1)] = Field(
        0.06, description="share of the response that is about twice as wide as the profile (1 sigma)"
    )
    touch_std: Annotated[float, Field(ge=0, le=1)] = Field(
        0.005,
        description="error of a signal over the greatest one, another one in each touch (1 sigma)",
    )
    magnetic: bool = Field(
        False,
        description="zeros change as the pad turns in the Earth's magnetic field, as those of Hall sensors "
        "do; compensated by joint states",
    )

    @property
    def channel_count(self) -> int:
        return len(self.positions_mm)

    @property
    def unit_signal(self) -> float:
        given = self.signal_per_n
        return sum(given) / len(given) if isinstance(given, tuple) else given

    def build(self, surface: Surface) -> field.TaxelArray:
        for key in ("normals", "width_mm", "signal_per_n"):
            values = getattr(self, key)
            if isinstance(values, tuple) and len(values) != len(self.positions_mm):
                raise ValueError(f"{key}: needs {len(self.positions_mm)} values, one for each taxel")
        if len({len(place) for place in self.positions_mm}) > 1:
            raise ValueError("positions_mm: all must have two numbers, or all three")
        if self.normals is not None and not all(math.hypot(*normal) > 0 for normal in self.normals):
            raise ValueError("normals: must be directions other than 0, 0, 0")
        array = field.TaxelArray(
            surface,
            [[_MM * number for number in place] for place in self.positions_mm],
            _scaled(self.width_mm, _MM),
            _scaled(self.signal_per_n, 1 / self.unit_signal),
            normals=self.normals,
            profile=self.profile,
            patch=field.TaxelContact(
                _MM * self.contact_radius_mm, _MM * self.contact_radius_std_mm, self.contact_elongation_std
            ),
            tolerances=field.TaxelTolerances(
                position_m=_MM * self.position_std_mm,
                width=self.width_std,
                crosstalk=self.crosstalk_std,
                profile=self.profile_std,
                touch=self.touch_std,
            ),
        )
        if not (array.fractions(*array.centres.T).max(axis=1) > _MIN_RESPONSE).all():
            raise ValueError(
                "positions_mm: a taxel hardly responds anywhere on the pad; x and y are from its centre"
            )
        return array


class TwoLayersTable(ResponseTable):
    """Two films, a pressed layer between: x electrodes on the upper one, y electrodes on the lower one."""

    kind: Literal["two_layers"]
    ohm_per_square: Positive = Field(description="sheet resistance of each film", examples=[400.0])
    contact_ohm_mm2: Positive = Field(
        description="contact resistance times area of the layer at reference_kpa", examples=[12000.0]
    )
    alpha: float = Field(1.0, gt=0, le=5, description="exponent of the pressure in its conductance")
    reference_kpa: Positive = Field(100.0, description="pressure of contact_ohm_mm2")
    contact_radius_mm: Positive = Field(2.5, description="radius of a contact")
    contact_radius_std_mm: NonNegative = Field(0.3, description="spread of that radius (1 sigma)")
    contact_elongation_std: Annotated[float, Field(ge=0, le=2)] = Field(
        0.4, description="logarithm of a contact's length over its width (1 sigma)"
    )
    contact_tilt_std: Annotated[float, Field(ge=0, le=1)] = Field(
        0.3,
        description="rise of a contact's pressure to its rim, over its mean, along any direction (1 sigma)",
    )
    lead_ohm: Annotated[tuple[NonNegative, ...], PER_CHANNEL] = Field(
        (0.0, 0.0, 0.0, 0.0), description="from electrodes x0, xa, y0, yb to their amplifiers"
    )
    lead_std_ohm: NonNegative = Field(
        3.0, description="error of each of these (1 sigma); of a lead of 0 ohm, the root mean square"
    )
    unevenness_std: Annotated[float, Field(ge=0, le=1)] = Field(
        0.01, description="logarithm of a film's resistance at one end over that in the middle (1 sigma)"
    )
    size_std_mm: NonNegative = Field(0.1, description="error of the length and of the width (1 sigma)")
    ohm_per_square_std: Annotated[float, Field(ge=0, le=1)] = Field(
        0.1, description="relative error of ohm_per_square (1 sigma)"
    )
    contact_ohm_std: Annotated[float, Field(ge=0, le=1)] = Field(
        0.1, description="relative error of contact_ohm_mm2 (1 sigma)"
    )
    alpha_std: Annotated[float, Field(ge=0, le=1)] = Field(0.05, description="error of alpha (1 sigma)")
    max_force_n: Positive | None = Field(
        None, description="greatest force of a contact; default: unknown", examples=[20.0]
    )

    is_current: ClassVar[bool] = True

    @property
    def channel_count(self) -> int:
        return 4

    @property
    def channels(self) -> tuple[str, ...]:
        return "x0", "xa", "y0", "yb"

    def build(self, surface: Surface) -> field.TwoLayers:
        if len(self.lead_ohm) != 4:
            raise ValueError("lead_ohm: needs 4 values, of electrodes x0, xa, y0, yb")
        return field.TwoLayers(
            surface,
            self.ohm_per_square,
            _MM * self.contact_radius_mm,
            self.lead_ohm,
            lead_std_ohm=self.lead_std_ohm,
            unevenness_std=self.unevenness_std,
        )

    def sheet_values(self) -> dict[str, Any]:
        own = {"kind", "lead_ohm", "lead_std_ohm", "ohm_per_square", "unevenness_std"}
        return self.model_dump(exclude=own) | {
            "ohm_per_square": 2 * self.ohm_per_square,
            "unevenness_std": 0.0,
            "anisotropy_std": 0.0,
            "gap_std_mm": 0.0,
            "pair_false_alarm": 0.0,
        }


class Measured(ForceLaw):
    """Channels that respond in a way that presses at known places show."""

    kind: Literal["measured"]
    presses: str = Field(
        min_length=1,
        description="NumPy archive (.npz) of presses at known places with their forces, relative to this "
        "file",
        examples=["tip_presses.npz"],
    )
    names: Annotated[tuple[Name, ...], PER_CHANNEL] = Field(
        description=f"names of the {CHANNEL_RANGE} channels, in the order of the signals in `presses`",
        examples=[["a", "b", "c"]],
    )

    @property
    def channel_count(self) -> int:
        return len(self.names)

    @property
    def channels(self) -> tuple[str, ...]:
        return self.names

    @property
    def unit_signal(self) -> float:
        return field.unit_signal(presses_of(self.presses), self.alpha)

    def with_embedded_files(self, folder: Path) -> Self:
        return self.model_copy(update={"presses": embed_file(self.presses, folder)})

    def build(self, surface: Surface) -> field.MeasuredMap:
        try:
            presses = presses_of(self.presses)
            if presses.signals.shape[1] != len(self.names):
                raise ValueError(f"has signals of {presses.signals.shape[1]} channels, not {len(self.names)}")
            return self.map_of(surface, presses)
        except ValueError as error:
            raise ValueError(f"presses: {error}") from error

    def map_of(self, surface: Surface, presses: field.PressTable) -> field.MeasuredMap:
        """Return the map that presses show. Raises ValueError."""
        radius_m, std_m = _MM * self.contact_radius_mm, _MM * self.contact_radius_std_mm
        prior = field.MapPrior(alpha=self.alpha)
        return field.MeasuredMap(surface, presses, prior, radius_m, std_m, self.contact_elongation_std)


_MIN_RESPONSE = 0.05  # greatest response of a taxel on the pad, over that right on it


def _scaled(values: float | tuple[float, ...], factor: float) -> list[float] | float:
    return [factor * value for value in values] if isinstance(values, tuple) else factor * values


def _kind_of(table: type[ResponseTable]) -> str:
    """Return the `kind` that a table's key of that name allows."""
    return str(table.model_fields["kind"].annotation.__args__[0])  # type: ignore[union-attr]


RESPONSES: dict[str, type[ResponseTable]] = {
    _kind_of(table): table
    for table in (
        Taxels,
        TwoLayersTable,
        Measured,
        *load_plugins("handtouch.responses", ResponseTable).values(),
    )
}
"""Tables of responses by their kind."""

PadResponse = Annotated[ResponseTable, OneOfKinds(RESPONSES)]
_ADAPTER: TypeAdapter[ResponseTable] = TypeAdapter(PadResponse)


def response_of(value: object) -> ResponseTable | None:
    """Return the table of a value of a file; None for one that isn't valid."""
    try:
        return _ADAPTER.validate_python(value)
    except ValidationError:
        return None
