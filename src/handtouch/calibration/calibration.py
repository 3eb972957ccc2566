"""Calibration of one node beyond the deployment file, and its provenance; to JSON and back.

Public: `Calibration` of `Gains` (with `LearnedParts`), `Offsets`, `LawParameters` and `StoredSheetState`;
`Provenance`; `CalibrationState`; `CalibrationVersion`, one entry of the store; `check_match`, which binds a
version to a node, `MismatchError`; `differences`; `aged_gains`, `drifted_gains`; `channel_values`
and `matrix`, which convert arrays.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from enum import StrEnum
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from handtouch.config.base import CHANNEL_RANGE, MAX_CHANNELS, MIN_CHANNELS

ChannelValues = Annotated[tuple[float, ...], Field(min_length=MIN_CHANNELS, max_length=MAX_CHANNELS)]
Matrix = tuple[tuple[float, ...], ...]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]

_RECORD = ConfigDict(
    extra="forbid", strict=True, allow_inf_nan=False, ser_json_bytes="base64", val_json_bytes="base64"
)
_LOG_GAIN_STD_PER_DAY = 1e-3
"""Standard deviation of a log gain's random walk, after a day."""
_NODE_TO_NODE_LOG_GAIN_STD = 0.05
"""Standard deviation of a log gain from node to node."""
_OFFSET_STD_PER_ROOT_HOUR_COUNTS = 3.0
"""Standard deviation of an offset's random walk, after an hour."""
NEW_SHEET_METHOD = "sheet replaced"
"""Method of a version that sets aside what was known of a sheet, as its node has another one."""
MIN_GAIN, MAX_GAIN = 0.1, 10.0
"""Range of gain factors; no amplifier meant for these channels is beyond it."""
LAW_AGE_S = 1.5
"""Age of contacts at which a law holds that doesn't state it: `handtouch calibrate` takes means of a second,
from a second after a weight is down."""


class MismatchError(ValueError):
    """A calibration belongs to another node, or to the same node under other tables of the file."""


def _check_covariance(values: Matrix) -> Matrix:
    size = len(values)
    if size < 3 or any(len(row) != size for row in values):
        raise ValueError(f"must be a square matrix, has rows of {[len(row) for row in values]}")
    array = np.array(values)
    scale = float(np.abs(array).max())
    if not np.allclose(array, array.T, rtol=0, atol=1e-9 * scale):
        raise ValueError("must be symmetric")
    if scale > 0 and np.linalg.eigvalsh(array / scale).min() < -1e-9:
        raise ValueError("must not have negative eigenvalues")
    return values


Covariance3 = Annotated[Matrix, Field(min_length=3, max_length=3), AfterValidator(_check_covariance)]
Covariance = Annotated[Matrix, AfterValidator(_check_covariance)]


class CalibrationState(StrEnum):
    """State of a node's calibration, as `health` publishes it."""

    DEFAULT = "default"
    """deployment file only, and no contradiction to it"""
    CALIBRATED = "calibrated"
    """own calibration active"""
    QUARANTINED = "quarantined"
    """replaced or changed, without a calibration of its own yet"""
    MANUAL_REQUIRED = "manual_required"
    """the same, and contacts can't calibrate it"""


@dataclass(frozen=True, config=_RECORD)
class LearnedParts:
    """Parts of a pad that were learned with its gains: gaps, sides, waves of the sheet, resistors.

    stated_stds: (p,) of the deployment that they were learned under, as `part_stds` of `hand`; 0 for parts
    that don't matter. offsets: (p,) in these. covariance: (c + p, c + p) of the log gains of the c channels,
    then of the offsets.
    touch_error: standard deviation of the fractions of a touch, another one each time.
    """

    stated_stds: tuple[float, ...]
    offsets: tuple[float, ...]
    covariance: Covariance
    touch_error: NonNegative = 0.0

    def __post_init__(self) -> None:
        count, rows = len(self.offsets), len(self.covariance)
        if len(self.stated_stds) != count or not MIN_CHANNELS <= rows - count <= MAX_CHANNELS:
            raise ValueError(
                f"offsets: has {count} parts, stated_stds {len(self.stated_stds)}, covariance {rows} rows: "
                "must be as many, and one more for each channel"
            )


@dataclass(frozen=True, config=_RECORD)
class Gains:
    """Factors (c,) that correct the currents of the electrodes; covariance (c, c) of their logarithms.

    parts: of the pad, where they were learned with the gains.
    """

    factors: Annotated[tuple[Positive, ...], Field(min_length=MIN_CHANNELS, max_length=MAX_CHANNELS)]
    covariance: Covariance
    parts: LearnedParts | None = None

    def __post_init__(self) -> None:
        count = len(self.factors)
        if len(self.covariance) != count:
            raise ValueError(f"covariance: has {len(self.covariance)} rows for {count} factors")
        if self.parts is not None and len(self.parts.covariance) - len(self.parts.offsets) != count:
            raise ValueError(f"parts: were learned with gains of another number of channels than {count}")


@dataclass(frozen=True, config=_RECORD)
class Offsets:
    """Readings of untouched channels [counts], their variance [counts^2]; noise of readings if known."""

    counts: ChannelValues
    variance: tuple[NonNegative, ...]
    noise: tuple[NonNegative, ...] | None = None

    def __post_init__(self) -> None:
        count = len(self.counts)
        if len(self.variance) != count or (self.noise is not None and len(self.noise) != count):
            raise ValueError(f"variance, noise: must have one value for each of {count} channels")


@dataclass(frozen=True, config=_RECORD)
class LawParameters:
    """Contact law (paper eq. 12) and sheet; keys as in a deployment's `[sheet.NAME]`.

    covariance: (3, 3), of ln contact_ohm_mm2, alpha, ln ohm_per_square. hertz_force_n: force at which a
    contact has the sheet's contact_radius_mm, from which it grows as force^(1/3); None: it doesn't. age_s: of
    the contacts that it was measured by: where a sheet creeps, its readings are the law's at that age.
    """

    contact_ohm_mm2: Positive
    alpha: Positive
    ohm_per_square: Positive
    covariance: Covariance3
    hertz_force_n: Positive | None = None
    age_s: Positive = LAW_AGE_S


@dataclass(frozen=True, config=_RECORD)
class StoredSheetState:
    """State of a sheet model; `data` is readable for a model of that kind and version only."""

    kind: str
    version: int
    data: bytes


@dataclass(frozen=True, config=_RECORD)
class Calibration:
    """Calibration of one node; None for parts that are unknown. second_law: of the pad's second sheet."""

    gains: Gains | None = None
    offsets: Offsets | None = None
    law: LawParameters | None = None
    sheet: StoredSheetState | None = None
    second_law: LawParameters | None = None


@dataclass(frozen=True, config=_RECORD)
class Provenance:
    """Origin of a calibration.

    method: e.g. "gains from contacts", "guided session". contacts: number used. residual: root mean square
    misfit in standard deviations, NaN if unknown. hand, link: where the node was mounted. host, program: of
    the writer. note: anything else. foreign: not empty if the values are another node's.
    """

    method: str
    contacts: int = 0
    residual: Annotated[float, Field(allow_inf_nan=True)] = math.nan
    hand: str = ""
    link: str = ""
    host: str = ""
    program: str = ""
    note: str = ""
    foreign: str = ""


@dataclass(frozen=True, config=_RECORD)
class CalibrationVersion:
    """One entry of the store. number: counts from 1 for each serial. config: hash of the pad's tables."""

    serial: int
    config: str
    number: int
    written_utc: str
    provenance: Provenance
    calibration: Calibration

    def is_own(self, config: str) -> bool:
        """Return True if the values are this node's, under the pad's tables of this hash."""
        return self.config == config and not self.provenance.foreign

    @property
    def calibration_id(self) -> str:
        """Return the identifier that contacts carry, as "1001-3"."""
        return f"{self.serial}-{self.number}"

    def to_json(self) -> dict[str, Any]:
        """Return a record ready for `json.dumps`: known parts, all digits, the sheet's state as base64."""
        record: dict[str, Any] = _VERSION.dump_python(self, mode="json", exclude_none=True)
        if math.isnan(self.provenance.residual):
            del record["provenance"]["residual"]
        return record

    @classmethod
    def from_json(cls, record: object) -> CalibrationVersion:
        """Return the version in a record of `to_json`. Raises ValueError naming the wrong key."""
        try:
            return _VERSION.validate_json(json.dumps(record))
        except ValidationError as error:
            problem = error.errors(include_url=False)[0]
            key = ".".join(map(str, ("version", *problem["loc"])))
            text = _PROBLEMS.get(problem["type"], problem["msg"].replace("Input should be", "must be"))
            raise ValueError(f"{key}: {text}") from error


_VERSION: TypeAdapter[CalibrationVersion] = TypeAdapter(CalibrationVersion)
_PROBLEMS = {"unexpected_keyword_argument": "unknown key", "missing": "missing key"}


def check_match(
    version: CalibrationVersion, serial: int, config: str, *, accept_mismatch: bool = False
) -> str:
    """Return why a version isn't the node `serial`'s own under the tables `config`, empty if it is.

    Raises MismatchError if it isn't, unless that is accepted.
    """
    mismatches = [version.provenance.foreign] if version.provenance.foreign else []
    if version.serial != serial:
        mismatches.append(f"it was made for serial {version.serial}, not for {serial}")
    if version.config != config:
        mismatches.append(f"it was made under {version.config}, the deployment file now has {config}")
    mismatch = "; ".join(mismatches)
    if mismatch and not accept_mismatch:
        raise MismatchError(
            f"version {version.number} of serial {version.serial} doesn't match: {mismatch}; "
            "calibrate this node, or accept the mismatch explicitly"
        )
    return mismatch


def age_s(version: CalibrationVersion, now: datetime) -> float:
    """Return the age of a version [s]; 0 if its time is in the future."""
    written = datetime.fromisoformat(version.written_utc).astimezone(UTC)
    return max(0.0, (now - written).total_seconds())


def aged_offset_std(offsets: Offsets, away_s: float) -> NDArray[np.float64]:
    """Return the standard deviations (c,) [counts] of offsets away_s after they were stored: a random walk.

    They may be an hour older, as they are stored no more often.
    """
    walk = _OFFSET_STD_PER_ROOT_HOUR_COUNTS**2 * (1 + away_s / 3600)
    return np.asarray(np.sqrt(np.add(offsets.variance, walk)))


def aged_gains(
    version: CalibrationVersion, now: datetime, stated_stds: tuple[float, ...] | None = None
) -> Gains | None:
    """Return the gains of a version, with the uncertainty of drift since, and of another node's gains.

    With the parts of its pad, unless they are another node's or were learned under other tolerances than
    `stated_stds`.
    """
    gains = version.calibration.gains
    if gains is None:
        return None
    foreign = bool(version.provenance.foreign)
    if foreign or gains.parts is None or gains.parts.stated_stds != stated_stds:
        gains = replace(gains, parts=None)
    return drifted_gains(gains, age_s(version, now), _NODE_TO_NODE_LOG_GAIN_STD if foreign else 0.0)


def drifted_gains(gains: Gains, elapsed_s: float, log_gain_std: float = 0.0) -> Gains:
    """Return gains with the uncertainty of their drift in a time, and of `log_gain_std` besides."""
    drift = _LOG_GAIN_STD_PER_DAY**2 * elapsed_s / 86400 + log_gain_std**2
    # a random walk of gains that leaves their product unchanged
    count = len(gains.factors)
    walk, parts = drift * (np.eye(count) - 1 / count), gains.parts
    if parts is not None:
        joint = np.array(parts.covariance)
        joint[:count, :count] += walk
        parts = replace(parts, covariance=matrix(joint))
    return Gains(gains.factors, matrix(np.array(gains.covariance) + walk), parts)


def channel_values(values: ArrayLike) -> ChannelValues:
    """Return numbers of all channels as a tuple. Raises ValueError for another shape."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 1 or not MIN_CHANNELS <= len(array) <= MAX_CHANNELS:
        raise ValueError(f"values has shape {array.shape}: must be one for each of {CHANNEL_RANGE} channels")
    return tuple(array.tolist())


def matrix(values: ArrayLike) -> Matrix:
    """Return the rows of a matrix as tuples. Raises ValueError for another shape."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 2:
        raise ValueError(f"matrix has shape {array.shape}: must have two axes")
    return tuple(tuple(row) for row in array.tolist())


def differences(
    before: Calibration, after: Calibration
) -> list[tuple[str, Sequence[float] | str | None, Any]]:
    """Return what differs as (name, before, after), without covariances."""
    rows: list[tuple[str, Any, Any]] = []
    of_law = ("contact_ohm_mm2", "alpha", "ohm_per_square", "hertz_force_n", "age_s")
    for part, names in (
        ("gains", ("factors",)),
        ("offsets", ("counts", "variance", "noise")),
        ("law", of_law),
        ("second_law", of_law),
        ("sheet", ("kind", "version", "data")),
    ):
        one, other = getattr(before, part), getattr(after, part)
        for name in names:
            old, new = getattr(one, name, None), getattr(other, name, None)
            if old != new:
                rows.append((f"{part}.{name}", old, new))
    return rows
