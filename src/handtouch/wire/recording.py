"""Payloads for recorders and exact replay: `Raw`, `TickInputs`, `StateSnapshot`, `Config`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from handtouch.wire.columns import Column
from handtouch.wire.status import PadState


@dataclass(frozen=True, slots=True)
class Raw:
    """`raw/<hand>`: electrode counts as received, one message per tick; one row per link."""

    v: int
    session: int
    seq: int
    t_ns: int
    tick: int
    hand: str
    links: tuple[str, ...]
    counts: Annotated[bytes, Column("<i8", 4)]
    """x0, xa, y0, yb"""
    sample_ns: Annotated[bytes, Column("<i8")]
    fresh: Annotated[bytes, Column("<u1")]
    """1 where the sample belongs to this tick"""
    retained: bool


@dataclass(frozen=True, slots=True)
class TickInputs:
    """`tick`: all inputs of one tick of all hands, for an exact replay with `state` and `config`.

    Rows of the columns are the pads in the order of `config`.
    """

    v: int
    session: int
    seq: int
    t_ns: int
    """SYNC of the tick's cycle"""
    tick: int
    previous_sync_ns: int
    """SYNC of the previous cycle"""
    now_ns: int
    """time of the tick"""
    cycle_end_ns: int | None
    """samples that arrived from then on belong to the next cycle"""
    stopped: bool
    """no tick, but the end of all contacts because the daemon stopped"""
    counts: Annotated[bytes, Column("<i8", 4)]
    arrival_ns: Annotated[bytes, Column("<i8")]
    fresh: Annotated[bytes, Column("<u1")]
    node_state: Annotated[bytes, Column("<u1", codes=PadState)]
    """CLEAR where the node is operational, else the resulting state of its pad"""
    synchronous: Annotated[bytes, Column("<u1")]
    period_ns: Annotated[bytes, Column("<i8")]
    period_since_ns: Annotated[bytes, Column("<i8")]
    limits: bytes | None
    """int64 x 8: lower, then upper limits of the four channels, in counts; None: unchanged"""
    extra_inputs: dict[str, Any]
    """inputs of other kinds, by name"""
    retained: bool


@dataclass(frozen=True, slots=True)
class StateSnapshot:
    """`state`: everything that the daemon keeps from tick to tick, after the tick `tick`."""

    v: int
    session: int
    seq: int
    t_ns: int
    tick: int
    state: bytes
    """msgpack map: path of each value in the pipeline -> value; valid for the same build only"""
    limits: bytes
    """as in `tick`"""
    retained: bool


@dataclass(frozen=True, slots=True)
class Config:
    """`config`: the deployment that the daemon serves, and its build."""

    v: int
    session: int
    seq: int
    t_ns: int
    deployment: str
    """as JSON, with the keys of the deployment file"""
    files: dict[str, Any]
    """path of each file named in the deployment -> its bytes"""
    build: dict[str, Any]
    """versions of handtouch and of the numerical libraries, and the processor"""
    retained: bool
