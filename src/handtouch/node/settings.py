"""File of a sensor node (TOML) -> frozen, checked objects; errors name file, key, value and remedy.

Public names: `load`, `json_schema`, `NodeFile`, `PACKED_BITS`, `PACKED_CHANNELS`, `TouchNode` and its tables.
"""

from __future__ import annotations

import math
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

import numpy as np
from pydantic import Field, ValidationError, model_validator

from handtouch.config.base import MAX_CHANNELS, MIN_CHANNELS, Name, OneOfKinds, Positive, Table
from handtouch.config.problems import ConfigError, Problem, Tables, problems_of
from handtouch.config.tables import NodeId
from handtouch.config.toml_text import parse_toml, read_text
from handtouch.host.plugins import load_plugins
from handtouch.node.dbc import DbcSource
from handtouch.node.lines import LinesSource
from handtouch.node.source import Source

_IIO_CHANNEL = re.compile(r"(voltage|current)\d+(-(voltage|current)\d+)?")
Channel = Annotated[str, Field(min_length=1, max_length=200)]
PadChannels = Annotated[
    tuple[Channel, ...], Field(strict=False, min_length=MIN_CHANNELS, max_length=MAX_CHANNELS)
]


def source_kinds() -> dict[str, type[Source]]:
    """Return the kinds of sources by name: handtouch's own, and those of entry points.

    Raises PluginError for an entry point that is no subclass of `Source`, naming its package.
    """
    return {"lines": LinesSource, "dbc": DbcSource, **load_plugins("handtouch.sources", Source)}


KINDS: Mapping[str, Tables] = {"source": source_kinds()}
"""Models of tables that follow one of several, by `kind`"""
AnySource = Annotated[Source, OneOfKinds(KINDS["source"])]
PerChannel = Annotated[tuple[float, ...], Field(strict=False)]
Serial = Annotated[int, Field(ge=1, le=0xFFFFFFFF)]
_Model = TypeVar("_Model", bound=Table)
PACKED_BITS, PACKED_CHANNELS = 12, 5
"""Bits of a channel, and channels, of a node that sends all in one TPDO."""
_MAX_DRAIN_PERIOD_S = 0.1  # between two readings of a buffer's queue, on a busy machine


class CanInterface(Table):
    """`[bus]`: the CAN interface, in python-can's terms."""

    interface: str = Field("socketcan", description="python-can interface: socketcan, udp_multicast …")
    channel: str | int = Field(description="python-can channel, e.g. can0")
    options: dict[str, str | int | float | bool] = Field(
        default_factory=dict,
        description="further options of python-can's interface",
        examples=[{"port": 43114}],
    )


class Adc(Table):
    """`[adc.NAME]`: an ADC with a driver of the kernel's IIO subsystem."""

    device: str = Field(
        min_length=1,
        description="name or label of the device, as in /sys/bus/iio/devices/iio:device*/name, or its "
        "folder; two ADCs "
        "of one type need labels, as numbers such as iio:device0 may change at each boot",
    )
    mode: Literal["one-shot", "buffered"] = Field(
        "one-shot",
        description="one-shot: read in_CHANNEL_raw of one channel after another at each SYNC; buffered: "
        "scans from /dev/iio:deviceN",
    )
    trigger: str | None = Field(
        None,
        min_length=1,
        description="name of the trigger of a buffered ADC; one of iio-trig-sysfs starts a conversion at "
        "each SYNC, with any other the ADC runs freely. Default: the driver's own",
        examples=["adc-trigger"],
    )
    rate_hz: Positive | None = Field(None, description="written to sampling_frequency; default: unchanged")
    buffer_scans: int = Field(256, ge=8, le=65536, description="scans in the kernel's buffer")
    average_scans: int = Field(
        1, ge=1, le=1024, description="scans of a freely running ADC that a sample is the mean of"
    )
    timeout_ms: float = Field(5.0, gt=0, le=1000, description="time limit for a conversion started at SYNC")


class Excitation(Table):
    """`[pad.excitation]`: output that switches the sheet's excitation: a GPIO line, or a file."""

    chip: str | None = Field(None, min_length=1, description="GPIO chip, e.g. /dev/gpiochip0")
    line: int | None = Field(None, ge=0, le=1023, description="line of the chip")
    active_low: bool = Field(False, description="the excitation is on while the line is low")
    file: str | None = Field(
        None,
        min_length=1,
        description="file that takes 1 (on) and 0 (off)",
        examples=["/sys/class/gpio/gpio17/value"],
    )

    @model_validator(mode="after")
    def _check_kind(self) -> Self:
        if (self.file is None) == (self.chip is None) or (self.chip is None) != (self.line is None):
            raise ValueError("give either chip and line, or file")
        return self


class Trim(Table):
    """Trim file of a pad: corrections of its channels, from a measurement with known currents."""

    gain: PerChannel | None = Field(
        None,
        description="factors of the currents; default: 1 for each",
        examples=[(1.004, 0.998, 1.001, 1.0)],
    )
    offset_ma: PerChannel | None = Field(
        None,
        description="currents measured without any, subtracted before the factors; default: 0 for each",
        examples=[(0.002, 0.0, -0.001, 0.0)],
    )


class NodePad(Table):
    """`[[pad]]`: one pad, which is one CANopen node."""

    name: Name = Field(description="name of the pad in log lines and in the state file")
    node_id: NodeId | None = Field(
        None,
        description="node id, until LSS stores another one; default: none, LSS assigns it (`handtouch "
        "scan --assign`)",
    )
    serial: Serial | None = Field(
        None, description="serial number, 0x1018 sub 4; default: a random one, kept in the state file"
    )
    adc: str | None = Field(None, description="name of its [adc.NAME]", examples=["main"])
    source: str | None = Field(
        None, description="name of its [source.NAME], instead of an ADC", examples=["board"]
    )
    channels: PadChannels = Field(
        description="channels of 0x6401:01 and those after it, one for each electrode (3 to 32). Of an ADC: "
        "IIO channels, e.g. voltage0, or voltage0-voltage1 (differential); of lines: the value's number, "
        "or its label; of a DBC file: SIGNAL or MESSAGE.SIGNAL"
    )
    gain_ohm: float | None = Field(
        None,
        description="of an ADC: volts at it per ampere into the electrode, negative for an inverting "
        "amplifier; not needed for channels currentN",
        examples=[-240.0],
    )
    ma_per_unit: float | None = Field(
        None,
        description="of another source: milliamperes into the electrode per unit of its values, negative "
        "where they fall with the current",
        examples=[0.0204],
    )
    bits: Literal[12, 16] = Field(
        16,
        description="bits of a channel's counts; with 12, up to five channels are in one TPDO, and of type "
        'i12 in the deployment: "0x6401:1:i12"',
    )
    full_scale_ma: Positive = Field(10.0, description="current at the greatest count, as in the deployment")
    full_scale: float | None = Field(
        None,
        description="of another source whose values aren't currents: value at the greatest count, negative "
        "where they fall with the force; instead of ma_per_unit and full_scale_ma",
        examples=[4095.0],
    )
    trim: str | None = Field(
        None,
        min_length=1,
        description="trim file of the channels, relative to this file",
        examples=["thumb_tip.trim.toml"],
    )
    excitation: Excitation | None = Field(
        None,
        description="output of object 0x2100, off before the node boots and after the program ends; "
        "default: the excitation is always on",
    )

    @model_validator(mode="after")
    def _check_values(self) -> Self:
        if self.gain_ohm == 0:
            raise ValueError("gain_ohm must not be 0: it is the feedback resistance of the amplifiers")
        if self.ma_per_unit == 0:
            raise ValueError("ma_per_unit must not be 0: it is the current per unit of the values")
        if self.full_scale is not None:
            others = {"adc", "gain_ohm", "ma_per_unit", "full_scale_ma"} & self.model_fields_set
            if others or self.full_scale == 0:
                raise ValueError(
                    "full_scale must not be 0, and takes the place of gain_ohm, ma_per_unit and "
                    "full_scale_ma, for a source"
                )
        if (self.adc is None) == (self.source is None):
            raise ValueError("give either adc or source: the name of an [adc.NAME] or a [source.NAME]")
        if len(set(self.channels)) < len(self.channels):
            raise ValueError("channels must be different ones")
        if self.bits == PACKED_BITS and len(self.channels) > PACKED_CHANNELS:
            raise ValueError(f"bits = {PACKED_BITS}: at most {PACKED_CHANNELS} channels fit into a TPDO")
        return self

    @property
    def full_scale_signal(self) -> float:
        """Signal at the greatest count: a current [mA], or in the unit of other values of a source."""
        return self.full_scale_ma if self.full_scale is None else abs(self.full_scale)

    def ma_per_unit_of(self, channel: str) -> float:
        """Return the milliamperes per unit of a channel's values: mV of an ADC, else the source's unit.

        Of a source whose values aren't currents, 1 or -1: their own unit takes the place of milliamperes.
        """
        if self.full_scale is not None:
            return math.copysign(1.0, self.full_scale)
        if self.source is not None:
            return self.ma_per_unit or 1.0
        return 1.0 if channel.startswith("current") else 1.0 / (self.gain_ohm or 1.0)


class TouchNode(Table):
    """File of `handtouch node`."""

    bus: CanInterface
    adcs: dict[Name, Adc] = Field(
        default_factory=dict, alias="adc", description="[adc.NAME] tables: ADCs of this computer"
    )
    sources: dict[Name, AnySource] = Field(
        default_factory=dict,
        alias="source",
        description="[source.NAME] tables: lines of numbers, CAN frames, or what a package of yours reads",
    )
    pads: Annotated[tuple[NodePad, ...], Field(strict=False)] = Field(
        alias="pad", min_length=1, max_length=127, description="[[pad]] tables"
    )
    state: str | None = Field(
        None,
        min_length=1,
        description="file of node ids and serial numbers, relative to this file; default: FILE.state.json, "
        "or in the service's state folder",
        examples=["node.state.json"],
    )
    event_sample_ms: float = Field(
        5.0, ge=1, le=1000, description="period of samples while TPDOs are event-driven"
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        "info", description="least severity that is logged"
    )
    realtime_priority: int = Field(0, ge=0, le=99, description="SCHED_FIFO priority; 0: normal scheduling")
    cpus: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(strict=False)] = Field(
        (), description="CPUs that the node may run on; default: any", examples=[(3,)]
    )
    lock_memory: bool = Field(False, description="lock the memory against swapping (mlockall)")
    sysfs: str = Field(
        "/sys/bus/iio/devices", min_length=1, description="folder of the IIO devices and triggers"
    )
    devices: str = Field("/dev", min_length=1, description="folder of the character devices iio:deviceN")


TABLES: Tables = {
    "": TouchNode,
    "bus": CanInterface,
    "adc.*": Adc,
    "pad": NodePad,
    "pad.excitation": Excitation,
}


@dataclass(frozen=True)
class NodeFile:
    """A checked file: its tables, the trim of each pad, and the path of the state file."""

    settings: TouchNode
    trims: tuple[Trim, ...]
    state: Path
    folder: Path
    """that paths in it are relative to"""


def load(path: Path) -> NodeFile:
    """Read and check the file of a node and its trim files. Raises ConfigError with every error."""
    settings = _read(path, TouchNode, TABLES)
    if problems := tuple(_problems_in(settings, path.parent)):
        raise ConfigError(str(path), problems)
    trims = tuple(_read_trim(path.parent, pad) for pad in settings.pads)
    return NodeFile(settings, trims, _state_path(path, settings), path.parent)


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of the file, for editors, from the models that validate it."""
    schema = TouchNode.model_json_schema(by_alias=True)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "handtouch node"}


def _read(path: Path, model: type[_Model], tables: Tables) -> _Model:
    raw = parse_toml(read_text(path, "an existing file"), str(path))
    try:
        return model.model_validate(raw)
    except ValidationError as error:
        raise ConfigError(str(path), problems_of(raw, error, tables, KINDS)) from error


def _read_trim(folder: Path, pad: NodePad) -> Trim:
    if pad.trim is None:
        return Trim()
    trim = _read(folder / pad.trim, Trim, {"": Trim})
    problems = [
        Problem(key, f" = {list(values)}", f"must have {len(pad.channels)} values, one for each channel")
        for key, values in (("gain", trim.gain), ("offset_ma", trim.offset_ma))
        if values is not None and len(values) != len(pad.channels)
    ]
    if problems:
        raise ConfigError(str(folder / pad.trim), tuple(problems))
    return trim


def _problems_in(settings: TouchNode, folder: Path) -> Iterator[Problem]:
    """Yield the errors that several tables make together."""
    for name, adc in settings.adcs.items():
        if adc.mode == "one-shot":
            for key in ("trigger", "buffer_scans", "average_scans", "timeout_ms"):
                if key in adc.model_fields_set:
                    yield Problem(
                        f"[adc.{name}]: {key}", "", 'is used only with mode = "buffered"; delete it'
                    )
        need = round((adc.rate_hz or 0) * _MAX_DRAIN_PERIOD_S)
        if adc.mode == "buffered" and adc.buffer_scans < need:
            yield Problem(
                f"[adc.{name}]: buffer_scans",
                f" = {adc.buffer_scans}",
                f"holds less than {_MAX_DRAIN_PERIOD_S:g} s at that rate_hz; give at least {need}",
            )
    used: set[tuple[str | None, str | None, str]] = set()
    for number, pad in enumerate(settings.pads, 1):
        section = f'[[pad]] {number} "{pad.name}"'
        yield from _problems_of_input(settings, pad, section, folder)
        for channel in pad.channels:
            if (pad.adc, pad.source, channel) in used:
                yield Problem(f"{section}: channels", f" = {channel}", "another pad has this channel")
            used.add((pad.adc, pad.source, channel))
    for key in ("name", "node_id", "serial"):
        given = Counter(getattr(pad, key) for pad in settings.pads)
        for value, count in given.items():
            if value is not None and count > 1:
                yield Problem(
                    f"[[pad]]: {key}", f" = {value}", f"is given {count} times; each pad needs its own"
                )


def _problems_of_input(settings: TouchNode, pad: NodePad, section: str, folder: Path) -> Iterator[Problem]:
    """Yield the errors of a pad's ADC or source, its channels and their unit."""
    table, name = ("adc", pad.adc) if pad.source is None else ("source", pad.source)
    known = settings.adcs if pad.source is None else settings.sources
    if name not in known:
        names = ", ".join(known) or "none"
        yield Problem(f"{section}: {table}", f" = {name}", f"there is no [{table}.{name}]; known: {names}")
        return
    source = settings.sources.get(pad.source or "")
    for channel in pad.channels:
        if source is not None:
            problem = source.problem_of(channel, folder)
        else:
            problem = "" if _IIO_CHANNEL.fullmatch(channel) else "must be an IIO channel such as voltage0"
        if problem:
            yield Problem(f"{section}: channels", f" = {channel}", problem)
    is_current = all(channel.startswith("current") for channel in pad.channels)
    needed, other = ("gain_ohm", "ma_per_unit") if source is None else ("ma_per_unit", "gain_ohm")
    has_unit = pad.full_scale is not None or (source is None and is_current)
    if getattr(pad, needed) is None and not has_unit:
        yield Problem(f"{section}: {needed}", "", f"is missing; {NodePad.model_fields[needed].description}")
    if getattr(pad, other) is not None:
        given = f" = {getattr(pad, other):g}"
        yield Problem(f"{section}: {other}", given, f"write {needed} for a [{table}.{name}]")
    if source is not None and not any(source.problem_of(channel, folder) for channel in pad.channels):
        yield from _problems_of_range(source, pad, section, folder)


def _problems_of_range(source: Source, pad: NodePad, section: str, folder: Path) -> Iterator[Problem]:
    """Yield the channel that ends below the full scale: the daemon wouldn't know that it is saturated."""
    tops = [max(np.multiply(source.limits_of(c, folder), pad.ma_per_unit_of(c))) for c in pad.channels]
    top = min(tops)
    if top < pad.full_scale_signal:
        key, unit = ("full_scale_ma", " mA") if pad.full_scale is None else ("full_scale", "")
        channel = pad.channels[tops.index(top)]
        yield Problem(
            f"{section}: {key}",
            f" = {getattr(pad, key):g}",
            f"channel {channel} ends at {top:.4g}{unit}: give that at most, here and in the deployment, "
            "which takes a channel at full scale for saturated",
        )


def _state_path(path: Path, settings: TouchNode) -> Path:
    if settings.state is not None:
        return path.parent / settings.state
    folder = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]  # set by systemd for the service
    return Path(folder) / "state.json" if folder else path.with_name(f"{path.name}.state.json")
