"""What is known of one unit beyond the deployment file, and where it comes from; to JSON and back.

Public: `Calibration` of `Gains`, `Offsets`, `Law` and `SheetState`; its `Provenance`; `Version`, one entry of
the store; `fit`, which says whether a version belongs to a unit; `MismatchError`; `changes` between two;
`four` and `matrix`, which make the parts' values of arrays.
"""

from __future__ import annotations

import base64
import binascii
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

Four = tuple[float, float, float, float]
Matrix = tuple[tuple[float, ...], ...]


class MismatchError(ValueError):
    """A calibration was made for another unit, or for the same unit under other tables of the file."""


LEAST_GAIN, MOST_GAIN = 0.1, 10.0
"""What a factor may be; beyond it is no amplifier that was meant for these channels."""


@dataclass(frozen=True)
class Gains:
    """Factors that correct the currents of channels x0, xa, y0, yb; covariance (4, 4) of their logarithms."""

    factors: Four
    covariance: Matrix

    def __post_init__(self) -> None:
        _set(self, "factors", _vector(self.factors, 4, "gains.factors", positive=True))
        _set(self, "covariance", _covariance(self.covariance, 4, "gains.covariance"))


@dataclass(frozen=True)
class Offsets:
    """What channels read untouched [counts], the variance of that [counts^2]; noise of readings if known."""

    counts: Four
    variance: Four
    noise: Four | None = None

    def __post_init__(self) -> None:
        _set(self, "counts", _vector(self.counts, 4, "offsets.counts"))
        _set(self, "variance", _vector(self.variance, 4, "offsets.variance"))
        if min(self.variance) < 0:
            raise ValueError(f"offsets.variance = {self.variance}: a variance is not negative")
        if self.noise is not None:
            _set(self, "noise", _vector(self.noise, 4, "offsets.noise"))
            if min(self.noise) < 0:
                raise ValueError(f"offsets.noise = {self.noise}: a standard deviation is not negative")


@dataclass(frozen=True)
class Law:
    """Contact law (paper eq. 12) and sheet; keys as in a deployment's `[sheet.NAME]`.

    covariance: (3, 3), of ln contact_ohm_mm2, alpha, ln ohm_per_square.
    """

    contact_ohm_mm2: float
    alpha: float
    ohm_per_square: float
    covariance: Matrix

    def __post_init__(self) -> None:
        for name in ("contact_ohm_mm2", "alpha", "ohm_per_square"):
            _set(self, name, _vector([getattr(self, name)], 1, f"law.{name}", positive=True)[0])
        _set(self, "covariance", _covariance(self.covariance, 3, "law.covariance"))


@dataclass(frozen=True)
class SheetState:
    """State of a model of the sheet; only that model, of that kind and version, can read `data`."""

    kind: str
    version: int
    data: bytes


@dataclass(frozen=True)
class Calibration:
    """What is known of a unit; None where nothing is."""

    gains: Gains | None = None
    offsets: Offsets | None = None
    law: Law | None = None
    sheet: SheetState | None = None

    def to_json(self) -> dict[str, Any]:
        """Everything but the sheet's state, ready for `json.dumps`; numbers keep all their digits."""
        parts = {"gains": self.gains, "offsets": self.offsets, "law": self.law}
        records = {name: asdict(part) for name, part in parts.items() if part is not None}
        if self.offsets is not None and self.offsets.noise is None:
            del records["offsets"]["noise"]
        return records

    @classmethod
    def from_json(cls, record: object, sheet: SheetState | None = None) -> Calibration:
        """Inverse of `to_json`. Raises ValueError naming the field that can't be."""
        known = {"gains": Gains, "offsets": Offsets, "law": Law}
        table = _table(record, "calibration", known)
        parts = {name: _make(known[name], table[name], name) for name in table}
        return cls(**parts, sheet=sheet)


@dataclass(frozen=True)
class Provenance:
    """How a calibration came about.

    method: e.g. "gains from contacts", "guided session". contacts: how many it rests on. residual: root mean
    square misfit in standard deviations, NaN where there is none. hand, link: where the unit sat. host,
    program: who wrote it. note: anything else. foreign: not empty where the values are another unit's.
    """

    method: str
    contacts: int = 0
    residual: float = math.nan
    hand: str = ""
    link: str = ""
    host: str = ""
    program: str = ""
    note: str = ""
    foreign: str = ""

    def to_json(self) -> dict[str, Any]:
        """Ready for `json.dumps`; a NaN is left out."""
        return {name: value for name, value in asdict(self).items() if value == value}

    @classmethod
    def from_json(cls, record: object) -> Provenance:
        """Inverse of `to_json`. Raises ValueError naming the field that can't be."""
        made: Provenance = _make(
            cls, {"residual": math.nan, **_table(record, "provenance", _names(cls))}, "provenance"
        )
        for field in fields(cls):
            kind = {"contacts": int, "residual": float | int}.get(field.name, str)
            if not isinstance(getattr(made, field.name), kind):
                raise ValueError(
                    f"provenance.{field.name} = {getattr(made, field.name)!r}: is of a wrong type"
                )
        return made


@dataclass(frozen=True)
class Version:
    """One entry of the store. number: counts up from 1 for each serial. config: hash of the pad's tables."""

    serial: int
    config: str
    number: int
    written_utc: str
    provenance: Provenance
    calibration: Calibration

    @property
    def name(self) -> str:
        """What contacts tell of it, as "1001-3"."""
        return f"{self.serial}-{self.number}"

    def to_json(self) -> dict[str, Any]:
        """All of it, the sheet's state as base64."""
        sheet = self.calibration.sheet
        record = {
            "serial": self.serial,
            "config": self.config,
            "number": self.number,
            "written_utc": self.written_utc,
            "provenance": self.provenance.to_json(),
            "calibration": self.calibration.to_json(),
        }
        if sheet is not None:
            data = base64.b64encode(sheet.data).decode()
            record["sheet"] = {"kind": sheet.kind, "version": sheet.version, "data": data}
        return record

    @classmethod
    def from_json(cls, record: object) -> Version:
        """Inverse of `to_json`. Raises ValueError naming the field that can't be."""
        table = _table(record, "version", {*_names(cls), "sheet"})
        kinds = {"serial": int, "config": str, "number": int, "written_utc": str}
        for name, kind in kinds.items():
            if not isinstance(table.get(name), kind):
                raise ValueError(f"{name} = {table.get(name)!r}: must be there, of type {kind.__name__}")
        calibration = Calibration.from_json(table.get("calibration"), _sheet(table.get("sheet")))
        plain = {name: table[name] for name in kinds}
        return cls(**plain, provenance=Provenance.from_json(table.get("provenance")), calibration=calibration)


@dataclass(frozen=True)
class Applied:
    """A calibration to be applied. mismatch: why it isn't this unit's own; empty if it is."""

    version: Version
    mismatch: str


def fit(version: Version, serial: int, config: str, *, accept_mismatch: bool = False) -> Applied:
    """Take a version for the unit `serial` under the tables `config`.

    Raises MismatchError if it is another unit's, or was made under other tables, unless that is accepted;
    then the result says so.
    """
    problems = [version.provenance.foreign] if version.provenance.foreign else []
    if version.serial != serial:
        problems.append(f"it was made for serial {version.serial}, not for {serial}")
    if version.config != config:
        problems.append(f"it was made under {version.config}, and the deployment file now says {config}")
    mismatch = "; ".join(problems)
    if mismatch and not accept_mismatch:
        raise MismatchError(
            f"calibration {version.number} of serial {version.serial} doesn't fit: {mismatch}; "
            "calibrate this unit, or accept the mismatch expressly"
        )
    return Applied(version, mismatch)


def four(values: ArrayLike) -> Four:
    """Four numbers of an array. Raises ValueError for another shape."""
    made: Four = _vector(values, 4, "values")
    return made


def matrix(values: ArrayLike) -> Matrix:
    """The rows of a matrix. Raises ValueError for another shape."""
    array = _array(values, "matrix")
    if array.ndim != 2:
        raise ValueError(f"matrix has shape {array.shape}: must have two axes")
    return tuple(tuple(row) for row in array.tolist())


def _set(target: object, name: str, value: object) -> None:
    object.__setattr__(target, name, value)


def _vector(values: ArrayLike, size: int, name: str, positive: bool = False) -> Any:
    array = _array(values, name)
    if array.shape != (size,):
        raise ValueError(f"{name} has shape {array.shape}: must be ({size},)")
    if positive and not (array > 0).all():
        raise ValueError(f"{name} = {array.tolist()}: must be above 0")
    return tuple(array.tolist())


def _covariance(values: ArrayLike, size: int, name: str) -> Matrix:
    array = _array(values, name)
    if array.shape != (size, size):
        raise ValueError(f"{name} has shape {array.shape}: must be ({size}, {size})")
    scale = float(np.abs(array).max())
    if not np.allclose(array, array.T, rtol=0, atol=1e-9 * scale):
        raise ValueError(f"{name}: must be symmetric")
    if scale > 0 and np.linalg.eigvalsh(array / scale).min() < -1e-9:
        raise ValueError(f"{name}: must not have negative eigenvalues")
    return matrix(array)


def _array(values: ArrayLike, name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} = {values!r}: must be numbers") from error
    if not np.isfinite(array).all():
        raise ValueError(f"{name} = {array.tolist()}: must be finite")
    return array


def _names(kind: type) -> set[str]:
    return {field.name for field in fields(kind)}


def _table(record: object, name: str, known: Mapping[str, object] | set[str]) -> dict[str, Any]:
    if not isinstance(record, dict):
        raise ValueError(f"{name}: must be a table, is {record!r:.40}")
    if unknown := sorted(set(record) - set(known)):
        raise ValueError(f"{name}.{unknown[0]}: is not known to this version of handtouch")
    return record


def _make(kind: type[Any], record: object, name: str) -> Any:
    table = _table(record, name, _names(kind))
    try:
        return kind(**table)
    except TypeError as error:
        raise ValueError(f"{name}: {error}") from error


def _sheet(record: object) -> SheetState | None:
    if record is None:
        return None
    made: SheetState = _make(SheetState, record, "sheet")
    if not (isinstance(made.kind, str) and isinstance(made.version, int) and isinstance(made.data, str)):
        raise ValueError("sheet: must have a kind, a whole version and data as base64")
    try:
        return SheetState(made.kind, made.version, base64.b64decode(made.data, validate=True))
    except binascii.Error as error:
        raise ValueError(f"sheet.data: is not base64: {error}") from error


def changes(before: Calibration, after: Calibration) -> list[tuple[str, Sequence[float] | str, Any]]:
    """What differs: (name, before, after), covariances left out."""
    rows: list[tuple[str, Any, Any]] = []
    for part, names in (
        ("gains", ("factors",)),
        ("offsets", ("counts", "variance", "noise")),
        ("law", ("contact_ohm_mm2", "alpha", "ohm_per_square")),
        ("sheet", ("kind", "version", "data")),
    ):
        one, other = getattr(before, part), getattr(after, part)
        for name in names:
            old, new = getattr(one, name, None), getattr(other, name, None)
            if old != new:
                rows.append((f"{part}.{name}", old, new))
    return rows
