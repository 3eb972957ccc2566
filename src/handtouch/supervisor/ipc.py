"""Messages between daemon and supervisor process over their socket pair.

To the supervisor process: `SampleBlock` (ticks of all pads), as msgpack, `NodeSerials` and
`ManualCalibration` (set by an operator); from it `WorkerStatus`, `CalibrationUpdate` and
`CalibrationAssessment`. All but blocks are JSON. `unpack_worker_message` accepts any bytes and raises
WorkerMessageError. On its standard input the process gets the deployment.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal, Self

import msgpack
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter, ValidationError, field_validator, model_validator

from handtouch.arrays import FloatArray
from handtouch.calibration.calibration import (
    MAX_GAIN,
    MIN_GAIN,
    CalibrationState,
    ChannelValues,
    LawParameters,
    LearnedParts,
)
from handtouch.config import Table
from handtouch.config.base import MAX_CHANNELS, MIN_CHANNELS
from handtouch.sheet import BANK_LEARNED, check_learned
from handtouch.wire.health import Diagnosis

MAX_DIAGNOSES = 8
"""Number of diagnoses of one pad in a message."""
MAX_TEXT = 1000
"""Number of characters of a text in a message."""
ShortText = Annotated[str, Field(max_length=MAX_TEXT)]
GainFactor = Annotated[float, Field(ge=MIN_GAIN, le=MAX_GAIN)]
PositiveFloat = Annotated[float, Field(gt=0)]
Serial = Annotated[int, Field(ge=0, le=0xFFFFFFFF)]
PadIndex = Annotated[int, Field(ge=0, le=100_000)]


class WorkerMessageError(ValueError):
    """Bytes that are no message of the supervisor process."""


@dataclass(frozen=True)
class SampleBlock:
    """k ticks of all n pads; c channels of the pad with most, in the order of its electrodes.

    sync_ns (k,); sample_ns (k, n); counts (k, n, c), raw; fresh (k, n): the sample belongs to the tick;
    pad_state (k, n) PadState; contact_id (k, n), 0 for none; at the end of the block: offset_counts (n, c),
    standard deviation offset_std (n,) of their sum, NaN if unknown, noise_counts (n, c) as estimated; back_n
    and back_std_n (n,): back force of the sheets [N], to which they have adapted, NaN if unknown; learned
    (`sheet.BANK_LEARNED`,): learned behaviour of the sheet of one pad, `learned_pad` (), another one in each
    block, NaN if not modelled.
    """

    sync_ns: NDArray[np.int64]
    sample_ns: NDArray[np.int64]
    counts: NDArray[np.int64]
    fresh: NDArray[np.bool_]
    pad_state: NDArray[np.uint8]
    contact_id: NDArray[np.uint32]
    offset_counts: FloatArray
    offset_std: FloatArray
    noise_counts: FloatArray
    back_n: FloatArray
    back_std_n: FloatArray
    learned_pad: NDArray[np.int32] = field(default_factory=lambda: np.zeros((), np.int32))
    learned: FloatArray = field(default_factory=lambda: np.full(BANK_LEARNED, np.nan))

    def dump(self) -> bytes:
        """Return the block as msgpack."""
        arrays = {name: (a.dtype.str, a.shape, a.tobytes()) for name, a in vars(self).items()}
        packed: bytes = msgpack.packb(arrays)
        return packed

    @classmethod
    def load(cls, data: bytes) -> SampleBlock:
        """Return the block that `dump` made the bytes of."""
        arrays = msgpack.unpackb(data).items()
        return cls(**{name: np.frombuffer(raw, kind).reshape(shape) for name, (kind, shape, raw) in arrays})


class NodeSerials(Table):
    """Serial numbers of all pads' nodes, now and before; None if unknown."""

    kind: Literal["serials"] = "serials"
    now: tuple[int | None, ...]
    before: tuple[int | None, ...]
    sync_ns: int


class WorkerStatus(Table):
    """Heartbeat of the supervisor process, which has processed all messages up to processed_ns.

    store_error: problem with the store and its remedy, else empty. summary: number of nodes by calibration
    state.
    """

    kind: Literal["status"] = "status"
    processed_ns: int
    summary: ShortText = ""
    store_error: ShortText = ""


class CalibrationUpdate(Table):
    """Calibration to apply to a pad, as long as its node has this serial number.

    covariance: (c, c) of the log gains of c channels, row by row; None, as the deployment states. parts: of
    the pad, learned with the gains; None, as the deployment states. If known: offset_counts and their
    standard deviations, per channel; contact laws of the
    pad's sheet and of its second one; back_n, back_std_n: back force [N] of its sheet; learned:
    its behaviour, as `sheet.ModelBank.learned`, or empty. new_sheet: the node has another sheet than before,
    so law, state and evidence of the old one don't hold.
    """

    kind: Literal["calibration"] = "calibration"
    pad: PadIndex
    serial: Serial
    calibration_id: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]*$", max_length=64)]
    gains: Annotated[tuple[GainFactor, ...], Field(min_length=MIN_CHANNELS, max_length=MAX_CHANNELS)]
    covariance: tuple[float, ...] | None = None
    parts: LearnedParts | None = None
    offset_counts: ChannelValues | None = None
    offset_std: ChannelValues | None = None
    law: LawParameters | None = None
    second_law: LawParameters | None = None
    back_n: Annotated[float, Field(ge=0)] | None = None
    back_std_n: Annotated[float, Field(ge=0)] = 0.0
    learned: tuple[float, ...] = ()
    new_sheet: bool = False

    @model_validator(mode="after")
    def _check_channels(self) -> Self:
        count = len(self.gains)
        if self.covariance is not None and len(self.covariance) != count**2:
            raise ValueError(f"covariance: has {len(self.covariance)} values for {count} gains")
        if self.parts is not None and len(self.parts.covariance) - len(self.parts.offsets) != count:
            raise ValueError(f"parts: were learned with another number of gains than {count}")
        for name in ("offset_counts", "offset_std"):
            values = getattr(self, name)
            if values is not None and len(values) != count:
                raise ValueError(f"{name}: has {len(values)} values for {count} gains")
        return self

    @field_validator("learned")
    @classmethod
    def _check_learned(cls, learned: tuple[float, ...]) -> tuple[float, ...]:
        if learned:
            check_learned(learned)
        return learned


class CalibrationAssessment(Table):
    """Calibration state of the node at a pad, and the pad's diagnoses.

    dead_electrode: index of the electrode without which contacts are to be located, None without one.
    least_begin_counts: sum of its channels above which contacts may begin, see `core.least_threshold`; None
    while it isn't known.
    """

    kind: Literal["assessment"] = "assessment"
    pad: PadIndex
    serial: Serial | None
    calibration_state: CalibrationState
    calibration_progress: ShortText = ""
    diagnoses: Annotated[tuple[Diagnosis, ...], Field(max_length=MAX_DIAGNOSES)] = ()
    dead_electrode: Annotated[int, Field(ge=0, lt=MAX_CHANNELS)] | None = None
    least_begin_counts: PositiveFloat | None = None


class ManualCalibration(Table):
    """A calibration that an operator applied, and the names of the given fields."""

    kind: Literal["manual_calibration"] = "manual_calibration"
    given: tuple[str, ...]
    update: CalibrationUpdate


DaemonMessage = SampleBlock | NodeSerials | ManualCalibration
_CONTROL_MESSAGE: TypeAdapter[NodeSerials | ManualCalibration] = TypeAdapter(
    Annotated[NodeSerials | ManualCalibration, Field(discriminator="kind")]
)
WorkerMessage = WorkerStatus | CalibrationUpdate | CalibrationAssessment
_WORKER_MESSAGE: TypeAdapter[WorkerMessage] = TypeAdapter(
    Annotated[WorkerMessage, Field(discriminator="kind")]
)


def pack_message(message: Table) -> bytes:
    """Return a message other than a block as JSON."""
    return message.model_dump_json().encode()


def unpack_daemon_message(data: bytes) -> DaemonMessage:
    """Return a message of the daemon, which is trusted. A map of msgpack doesn't begin with a brace."""
    return _CONTROL_MESSAGE.validate_json(data) if data[:1] == b"{" else SampleBlock.load(data)


def unpack_worker_message(data: bytes) -> WorkerMessage:
    """Return the message of the supervisor process in any bytes. Raises WorkerMessageError."""
    try:
        return _WORKER_MESSAGE.validate_json(data)
    except ValidationError as error:
        problem = error.errors(include_url=False, include_input=False)[0]
        key = ".".join(map(str, problem["loc"]))
        raise WorkerMessageError(f"no message of the supervisor process: {key}: {problem['msg']}") from error
