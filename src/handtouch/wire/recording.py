"""Payloads for recorders and exact replay: `Raw`, `TickInputs`, `StateSnapshot`, `Config`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, TypedDict

from handtouch.wire.columns import Column
from handtouch.wire.status import PadState


@dataclass(frozen=True, slots=True)
class Raw:
    """`raw/<hand>`: electrode counts as received, one message per tick; one row per link."""

    v: int
    session: int
    seq: int
    t_ns: int
    """the tick's SYNC; `sample_ns` has the samples"""
    tick: int
    """number of the tick"""
    hand: str
    """name of the hand"""
    links: tuple[str, ...]
    """row names of all columns"""
    counts: Annotated[bytes, Column("<i8", 4, is_least=True)]
    """electrodes x0, xa, y0, yb, or those of `electrode_arcs_mm`; for any width of the node's channels. More
    where a pad of the hand has more, as many as that; 0 beyond a pad's own"""
    sample_ns: Annotated[bytes, Column("<i8")]
    """time of the row's sample, 0 before the first"""
    fresh: Annotated[bytes, Column("<u1")]
    """1 where the sample belongs to this tick"""
    retained: bool
    second_counts: Annotated[bytes, Column("<i8")] = b""
    """count of the second sheet's channel, 0 of pads without one; empty for a hand without any"""


class UsedJoints(TypedDict):
    """`joints`: the joints of a hand at one time, as columns of float64."""

    hand: str
    """name of the hand"""
    t_ns: int
    """time of the samples"""
    position_rad: bytes
    """positions; metres for prismatic joints"""
    age_s: bytes
    """time to the nearest joint state"""
    std_rad: bytes
    """standard deviations, 0 where the robot gives none"""


@dataclass(frozen=True, slots=True)
class TickInputs:
    """`tick`: all inputs of one tick of all hands, for an exact replay with `state` and `config`.

    Rows of the columns are the pads in the order of `config`.
    """

    v: int
    session: int
    seq: int
    t_ns: int
    """the tick's SYNC"""
    tick: int
    """number of the tick"""
    previous_sync_ns: int
    """SYNC of the cycle before that of `t_ns`"""
    now_ns: int
    """time of the tick"""
    cycle_end_ns: int | None
    """samples that arrived from then on belong to the next cycle; nil: none"""
    stopped: bool
    """no tick, but the end of all contacts because the daemon stops"""
    counts: Annotated[bytes, Column("<i8", 4)]
    """as in `raw`; as many for each pad as the pad with most electrodes has"""
    arrival_ns: Annotated[bytes, Column("<i8")]
    """arrival of the newest sample, 0 before the first"""
    fresh: Annotated[bytes, Column("<u1")]
    """as in `raw`"""
    node_state: Annotated[bytes, Column("<u1", codes=PadState)]
    """0 where the node is operational, else the resulting state of its pad"""
    limits: bytes | None
    """int64 for each pad, two for each channel: limits of the channels' ranges, all lower ones first; nil:
    unchanged"""
    events: tuple[dict[str, Any], ...]
    """changes since the tick before, in the order in which the tick applied them before its samples; each has
    a `kind`"""
    joints: Annotated[tuple[dict[str, Any], ...], tuple[UsedJoints, ...]]
    """joint states used by the tick"""
    retained: bool


@dataclass(frozen=True, slots=True)
class StateSnapshot:
    """`state`: everything that the daemon keeps from tick to tick, after the tick `tick`."""

    v: int
    session: int
    seq: int
    t_ns: int
    """publication"""
    tick: int
    """number of that tick"""
    layout: str
    """version and hash of the layout of `state`"""
    state: bytes
    """all arrays of the tick's state, one after another"""
    calibrations: tuple[dict[str, Any], ...]
    """calibration of each pad, as in an event of the kind `calibration`"""
    limits: bytes
    """as in `tick`"""
    retained: bool


class BuildInfo(TypedDict):
    """`build`: what decides on the last bit of a result."""

    handtouch: str
    """version of handtouch"""
    source: str
    """hash of its code"""
    python: str
    """version of Python"""
    numpy: str
    """version of numpy"""
    scipy: str
    """version of scipy"""
    processor: str
    """name of the processor"""
    features: list[str]
    """features of the processor that are used"""


@dataclass(frozen=True, slots=True)
class Config:
    """`config`: the deployment that the daemon serves, and its build."""

    v: int
    session: int
    seq: int
    t_ns: int
    """publication"""
    deployment: str
    """JSON, with the keys of the deployment file"""
    files: Annotated[dict[str, Any], dict[str, bytes]]
    """path of each EDS and URDF that it names -> its bytes"""
    build: Annotated[dict[str, Any], BuildInfo]
    """versions and processor"""
    retained: bool
