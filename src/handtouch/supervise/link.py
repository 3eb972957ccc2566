"""What the daemon and the slow half tell each other over their socket pair: msgpack maps, one a message.

Public: to the slow half `Start` (JSON on its standard input), `Block` (ticks of all pads), `serials`, `put`
(what a person gave); from it `Alive`, `Calibrate`, `Judged` with `Finding`s. `read_word` takes any bytes and
raises WordError.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import msgpack
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from handtouch.config import Deployment, Table
from handtouch.supervise.calibration import LEAST_GAIN, MOST_GAIN

LARGEST_WORD = 32_768
"""Bytes of a word of the slow half; a longer one isn't read."""
FloatArray = NDArray[np.float64]
Text = Annotated[str, Field(max_length=1000)]
Four = Annotated[tuple[float, float, float, float], Field(strict=False)]
Factor = Annotated[float, Field(ge=LEAST_GAIN, le=MOST_GAIN)]
Pair = Annotated[tuple[float, float], Field(strict=False)]
Row3 = Annotated[tuple[float, float, float], Field(strict=False)]
Positive = Annotated[float, Field(gt=0)]
Serial = Annotated[int, Field(ge=0, le=0xFFFFFFFF)]
PadNumber = Annotated[int, Field(ge=0, le=100_000)]


class WordError(ValueError):
    """A message that isn't one of those of this module."""


@dataclass(frozen=True)
class Start:
    """What the slow half has to know from the beginning; pads in the order of the deployment.

    nominal: names of the calibrations that the deployment file itself is. ampere_per_count (n, 4) without
    any calibration; noise_counts (n,). store: path of the calibration store.
    """

    deployment: Deployment
    store: str
    nominal: tuple[str, ...]
    ampere_per_count: FloatArray
    noise_counts: FloatArray

    def dump(self) -> bytes:
        """As JSON."""
        return json.dumps(
            {
                "deployment": self.deployment.model_dump(mode="json", by_alias=True),
                "store": self.store,
                "nominal": self.nominal,
                "ampere_per_count": self.ampere_per_count.tolist(),
                "noise_counts": self.noise_counts.tolist(),
            }
        ).encode()

    @classmethod
    def load(cls, data: bytes) -> Start:
        """Inverse of `dump`."""
        record = json.loads(data)
        return cls(
            Deployment.model_validate(record["deployment"]),
            record["store"],
            tuple(record["nominal"]),
            np.array(record["ampere_per_count"]),
            np.array(record["noise_counts"]),
        )


@dataclass(frozen=True)
class Block:
    """k ticks of all n pads; electrodes in the order x0, xa, y0, yb.

    t_ns (k,); sample_ns (k, n); counts (k, n, 4) as they came; fresh (k, n): the sample belongs to the tick;
    state (k, n) PadState; contact (k, n) ids, 0 for none; at the end of the block: offset_counts (n, 4)
    that the channels read untouched, standard deviation offset_std (n,) of their sum, NaN while that isn't
    known, noise_counts (n, 4) as found; back_n and back_std_n (n,) [N] that sheets are used to, else NaN.
    """

    t_ns: NDArray[np.int64]
    sample_ns: NDArray[np.int64]
    counts: NDArray[np.int32]
    fresh: NDArray[np.bool_]
    state: NDArray[np.uint8]
    contact: NDArray[np.uint32]
    offset_counts: FloatArray
    offset_std: FloatArray
    noise_counts: FloatArray
    back_n: FloatArray
    back_std_n: FloatArray

    def dump(self) -> bytes:
        """As msgpack."""
        parts = {name: np.ascontiguousarray(value).tobytes() for name, value in vars(self).items()}
        packed: bytes = msgpack.packb({"kind": "block", "ticks": len(self.t_ns), **parts})
        return packed


_TYPES: dict[str, tuple[str, int, bool]] = {  # dtype, elements a pad, one a tick
    "sample_ns": ("<i8", 1, True),
    "counts": ("<i4", 4, True),
    "fresh": ("?", 1, True),
    "state": ("u1", 1, True),
    "contact": ("<u4", 1, True),
    "offset_counts": ("<f8", 4, False),
    "offset_std": ("<f8", 1, False),
    "noise_counts": ("<f8", 4, False),
    "back_n": ("<f8", 1, False),
    "back_std_n": ("<f8", 1, False),
}


def serials(now: Sequence[int | None], before: Sequence[int | None], t_ns: int) -> bytes:
    """The serial number of the unit in each place, and of the one before; None where it isn't known."""
    message = {"kind": "serials", "serials": list(now), "before": list(before), "t_ns": t_ns}
    packed: bytes = msgpack.packb(message)
    return packed


def read_block(message: dict[str, Any], pads: int) -> Block:
    """A block of a message of the daemon's, whom we trust."""
    ticks = int(message["ticks"])
    arrays: dict[str, Any] = {"t_ns": np.frombuffer(message["t_ns"], "<i8")}
    for name, (kind, width, each) in _TYPES.items():
        shape = (*((ticks,) if each else ()), pads, *((width,) if width > 1 else ()))
        arrays[name] = np.frombuffer(message[name], kind).reshape(shape)
    return Block(**arrays)


class Finding(Table):
    """What is wrong with a pad, why one thinks so, and what helps; location, strength: whether they can be
    relied on while it lasts."""

    kind: Annotated[str, Field(pattern=r"^[a-z][a-z ]*$", max_length=40)]
    cause: Text
    evidence: Text
    remedy: Text
    since_ns: int
    confidence: Annotated[float, Field(ge=0, le=1)] = 1.0
    pad_m: Pair | None = None
    size_m: float | None = None
    location: bool = True
    strength: bool = True


class Alive(Table):
    """It has worked off what was sent until `t_ns`. store: what is wrong with the store, else empty."""

    kind: Literal["alive"] = "alive"
    t_ns: int
    word: Text = ""
    store: Text = ""


class ContactLaw(Table):
    """Of `calibration.Law`."""

    contact_ohm_mm2: Positive
    alpha: Positive
    ohm_per_square: Positive
    covariance: Annotated[tuple[Row3, Row3, Row3], Field(strict=False)]


class Calibrate(Table):
    """Correct a pad, as long as the unit in it is this one. covariance: (4, 4) of log gains, row by row.

    Where that is known: what it reads untouched and how sure that is, a channel; what weighs its contacts;
    back_n, back_std_n [N] that its sheet is used to.
    """

    kind: Literal["calibrate"] = "calibrate"
    pad: PadNumber
    serial: Serial
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.\-]*$", max_length=64)]
    gains: Annotated[tuple[Factor, Factor, Factor, Factor], Field(strict=False)]
    covariance: Annotated[tuple[float, ...], Field(strict=False, min_length=16, max_length=16)]
    offset_counts: Four | None = None
    offset_std: Four | None = None
    law: ContactLaw | None = None
    back_n: Annotated[float, Field(ge=0)] | None = None
    back_std_n: Annotated[float, Field(ge=0)] = 0.0


class Judged(Table):
    """How far the unit in a pad is trusted, and what there is to say of it."""

    kind: Literal["judged"] = "judged"
    pad: PadNumber
    serial: Serial | None
    trust: Literal["nominal", "trusted", "quarantined", "person"]
    calibrating: Text = ""
    findings: Annotated[tuple[Finding, ...], Field(strict=False, max_length=8)] = ()


def put(word: Calibrate, given: Collection[str]) -> bytes:
    """What a person put in force, and which of its fields that person gave."""
    packed: bytes = msgpack.packb({"kind": "put", "given": list(given), "word": word.model_dump()})
    return packed


Word = Alive | Calibrate | Judged
_WORDS: dict[object, type[Alive] | type[Calibrate] | type[Judged]] = {
    "alive": Alive,
    "calibrate": Calibrate,
    "judged": Judged,
}


def write_word(word: Word) -> bytes:
    """As msgpack."""
    packed: bytes = msgpack.packb(word.model_dump(mode="python"))
    return packed


def read_word(data: bytes) -> Word:
    """A word of the slow half, whatever the bytes. Raises WordError."""
    try:
        record = msgpack.unpackb(data)
        return _WORDS[record["kind"]].model_validate(record)
    except (ValidationError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise WordError(f"not a word of the slow half: {error}") from error
    except msgpack.exceptions.UnpackException as error:
        raise WordError(f"not a word of the slow half: {error}") from error


def plain(finding: Finding) -> dict[str, Any]:
    """As the map that `health` carries."""
    return finding.model_dump(mode="python")
