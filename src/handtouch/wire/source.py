"""What contacts are made from, so that they can be made again: `Raw`, `TickInputs`, `State`, `Config`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Raw:
    """`raw/<hand>`: the counts as they came, one per tick."""

    v: int
    run: int
    seq: int
    t_ns: int
    tick: int
    hand: str
    links: tuple[str, ...]
    counts: bytes
    """int64 x 4 (x0, xa, y0, yb), little-endian, one row per link"""
    sample_ns: bytes
    """int64"""
    fresh: bytes
    """uint8, 1 where the sample belongs to this tick"""
    repeat: bool


@dataclass(frozen=True, slots=True)
class TickInputs:
    """`tick`: all that one tick of all hands was made from; with `state` and `config` it can be made again.

    Columns are as INPUTS; their rows are the pads in the order of `config`.
    """

    v: int
    run: int
    seq: int
    t_ns: int
    """SYNC of the tick's cycle"""
    tick: int
    previous_ns: int
    """SYNC of the cycle before"""
    now_ns: int
    """when the tick was"""
    until_ns: int | None
    """samples that arrived from then on are of the next cycle"""
    stopped: bool
    """no tick, but the end of all contacts: the daemon stopped"""
    counts: bytes
    arrived_ns: bytes
    fresh: bytes
    node_state: bytes
    """uint8, PadState.CLEAR where the node is up, else what its pad is instead"""
    synchronous: bytes
    period_ns: bytes
    paced_ns: bytes
    limits: bytes | None
    """int64 x 8, counts at the bottom and at the top of the four channels, when they have changed"""
    others: dict[str, Any]
    """inputs of other kinds, by name"""
    repeat: bool


@dataclass(frozen=True, slots=True)
class State:
    """`state`: all that is kept from tick to tick, as it was after the tick `tick`."""

    v: int
    run: int
    seq: int
    t_ns: int
    tick: int
    state: bytes
    """msgpack map: path of each value inside the pipeline -> value; of the same build only"""
    limits: bytes
    """as of `tick`"""
    repeat: bool


@dataclass(frozen=True, slots=True)
class Config:
    """`config`: the deployment that the daemon serves, and the build that serves it."""

    v: int
    run: int
    seq: int
    t_ns: int
    deployment: str
    """as JSON, with the keys of the deployment file"""
    files: dict[str, Any]
    """path of each file that it names -> its bytes"""
    build: dict[str, Any]
    """versions of what computes, and the processor"""
    repeat: bool
