"""Tables of a deployment file: every key with its type, unit, range, default and description.

Public names: `Deployment` and the tables in it; `TABLES`, by their names in the file; `KINDS`, of tables that
follow one of several models.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from fnmatch import fnmatchcase
from functools import lru_cache
from typing import Annotated, Any, Final, Literal, NamedTuple

from pydantic import BeforeValidator, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from handtouch.config.base import (
    CHANNEL_RANGE,
    PER_CHANNEL,
    Name,
    NonNegative,
    Positive,
    PositivePerChannel,
    Table,
    Vector3,
)
from handtouch.config.objects import OBJECT_SHAPES, ObjectTable
from handtouch.config.responses import RESPONSES, PadResponse, ResponseTable, response_of
from handtouch.config.shear import SHEAR_PATTERNS, Shear
from handtouch.config.surfaces import SURFACE_TABLES, PadSurface
from handtouch.host.endpoints import (
    COMPLETE_ENDPOINT,
    CONTROL_ENDPOINT,
    INPUTS_ENDPOINT,
    LIVE_ENDPOINT,
)
from handtouch.wire.contact import Output

Fraction = Annotated[float, Field(gt=0, lt=1)]


def _refuse_removed(output: object) -> object:
    if output == "texture":
        raise PydanticCustomError("removed", "is no longer estimated; delete it from the list")
    return output


RequestedOutput = Annotated[Output, BeforeValidator(_refuse_removed)]
Ends = Annotated[tuple[NonNegative, NonNegative], Field(strict=False)]
Electrode = Literal["x0", "xa", "y0", "yb"]
SIDE_ELECTRODES: tuple[Electrode, ...] = ("x0", "xa", "y0", "yb")
MAX_STATES = 4
SwitchState = Annotated[tuple[Name, ...], PER_CHANNEL]
Arc = Annotated[tuple[float, float], Field(strict=False)]
NodeId = Annotated[int, Field(ge=1, le=127)]
Unsigned32 = Annotated[int, Field(ge=0, le=0xFFFFFFFF)]


class Daemon(Table):
    """`[daemon]`: endpoints, cycle time and operation of the daemon."""

    live: str = Field(LIVE_ENDPOINT, description="ZeroMQ endpoint of the live stream")
    complete: str = Field(COMPLETE_ENDPOINT, description="ZeroMQ endpoint of the complete stream")
    control: str = Field(CONTROL_ENDPOINT, description="ZeroMQ endpoint of control requests")
    inputs: str = Field(INPUTS_ENDPOINT, description="ZeroMQ endpoint for joint states and reference forces")
    keys: str | None = Field(
        None,
        min_length=1,
        description="folder of the CURVE keys that TCP clients need (`handtouch keys make`), relative to "
        "this file; default: no keys, so any local client may connect and no other machine can",
        examples=["keys"],
    )
    store: str | None = Field(
        None,
        min_length=1,
        description="calibration store, relative to this file; default: "
        "$XDG_STATE_HOME/handtouch/calibrations.db, or in the service's state folder; simulated.db there for "
        "nodes on a bus of udp_multicast or virtual",
        examples=["calibrations.db"],
    )
    supervise: bool = Field(
        True, description="calibrate and diagnose all pads continuously, in a separate supervisor process"
    )
    on_node_replaced: Literal["refuse", "quarantine"] = Field(
        "quarantine",
        description="reaction to a node whose serial number isn't the configured one: quarantine accepts it "
        "as a replacement, unreliable until it is calibrated; refuse rejects it. Always rejected without "
        "`supervise`, or if the serial number is configured for another pad",
    )
    sync_period_ms: float = Field(5.0, ge=0.5, le=1000, description="period of SYNC and of the tick")
    sample_window_fraction: Fraction = Field(
        0.6, description="fraction of the SYNC period to wait for samples before a tick"
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        "info", description="least severity that is logged"
    )
    metrics: str | None = Field(
        None,
        description="loopback HOST:PORT of the Prometheus metrics, e.g. 127.0.0.1:9580; default: none",
        examples=["127.0.0.1:9580"],
    )
    realtime_priority: int = Field(
        0, ge=0, le=99, description="SCHED_FIFO priority of the daemon's main thread; 0: normal scheduling"
    )
    cpus: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(strict=False)] = Field(
        (), description="CPUs that the daemon's main thread may run on; default: any", examples=[(3,)]
    )
    lock_memory: bool = Field(False, description="lock the daemon's memory against swapping (mlockall)")
    busy_poll_us: float = Field(
        0,
        ge=0,
        le=10_000,
        description="poll for samples without sleeping, for so long before and after the last one of a "
        "cycle is expected; 0: always sleep",
    )


CABLELESS_INTERFACES: Final = frozenset({"udp_multicast", "virtual"})
"""Interfaces of python-can that connect programs."""


class Bus(Table):
    """`[[bus]]`: one CAN bus, in python-can's terms."""

    name: Name = Field(description="name of the bus, used by pads and by --bus")
    interface: str = Field(description="python-can interface: socketcan, udp_multicast, virtual, slcan …")
    channel: str | int = Field(description="python-can channel: can0, 239.74.163.2, /dev/ttyACM0 …")
    bitrate_bit_s: int = Field(
        1_000_000, ge=10_000, le=1_000_000, description="bit rate, used to compute the bus load"
    )
    sync: Literal["producer", "consumer"] = Field(
        "producer", description="producer: the daemon sends SYNC on this bus; consumer: another device does"
    )
    role: Literal["master", "guest", "listener"] = Field(
        "master",
        description="master: the daemon configures and starts its nodes (NMT); guest: it configures them, "
        "another NMT master starts them; listener: it sends nothing",
    )
    options: dict[str, str | int | float | bool] = Field(
        default_factory=dict,
        description="further options of the python-can interface, passed on unchanged",
        examples=[{"port": 43114}],
    )

    @property
    def is_cableless(self) -> bool:
        """True if the bus is between programs, without a cable that may be at fault."""
        return self.interface in CABLELESS_INTERFACES


class Idle(Table):
    """`[node.NAME.idle]`: event-driven transmission of an untouched pad, on change instead of with SYNC."""

    delta_counts: Annotated[int, Field(ge=1)] = Field(
        description="change of a channel that makes the node send at once; about five times noise_counts",
        examples=[5],
    )
    period_ms: Annotated[int, Field(ge=10, le=65_535)] = Field(
        100, description="event timer of the TPDO (0x1800 + n sub 5): the longest time between two samples"
    )
    delta_objects: Annotated[tuple[str, ...], PER_CHANNEL] = Field(
        ("0x6426:1:u32", "0x6426:2:u32", "0x6426:3:u32", "0x6426:4:u32"),
        description="objects that delta_counts is written to, one per channel; default: 0x6426 sub 1 and up",
    )
    enable_object: str | None = Field(
        "0x6423:0:u8", description="object that is set to 1 to enable transmission on change"
    )


def _required_unless(key: str, *required: str) -> ConfigDict:
    """Return the configuration of a table whose keys `required` aren't, where it has `key`."""

    def change(schema: dict[str, Any]) -> None:
        schema["required"] = [name for name in schema["required"] if name not in required]
        schema["anyOf"] = [{"required": list(required)}, {"required": [key]}]

    return ConfigDict(json_schema_extra=change)


class Node(Table):
    """`[node.NAME]`: a kind of sensor node: its identity, channels, electronics and heartbeat."""

    model_config = _required_unless("full_scale", "drive_v", "full_scale_ma")

    eds: str | None = Field(
        None,
        description="EDS file, relative to this file; default: the shipped four-channel node",
        examples=["vendor_node.eds"],
    )
    vendor_id: Unsigned32 | None = Field(
        None, description="expected vendor id (0x1018 sub 1); default: any", examples=[755]
    )
    product_code: Unsigned32 | None = Field(
        None, description="expected product code (0x1018 sub 2); default: any", examples=[4]
    )
    channels: Annotated[tuple[str, ...], PER_CHANNEL] = Field(
        ("0x6401:1", "0x6401:2", "0x6401:3", "0x6401:4"),
        description=f"objects of the {CHANNEL_RANGE} channels, INDEX:SUB; with a type (i16, u24) where no "
        "EDS has it, i12 where a TPDO carries its low 12 bits, REAL32 as f32/1000 for 1000 counts per unit",
    )
    allow_pdo_remapping: bool = Field(
        True, description="map the channels to a TPDO over SDO if no TPDO of the node carries them"
    )
    allow_nmt_reset: bool = Field(
        True,
        description="send one NMT reset communication to a node that refuses OPERATIONAL; role master only",
    )
    revision: Unsigned32 | None = Field(
        None, description="expected revision number (0x1018 sub 3); default: any", examples=[65537]
    )
    drive_v: Positive = Field(description="voltage between the conducting layer and the electrodes")
    full_scale_ma: Positive = Field(description="electrode current at full_scale_counts")
    unit: str | None = Field(
        None,
        min_length=1,
        max_length=16,
        description="unit of what the channels measure, if that isn't a current; used in texts only",
        examples=["N"],
    )
    full_scale: Positive | None = Field(
        None,
        description="signal at full_scale_counts in `unit`, of a pad with a response in that unit; instead "
        "of drive_v and full_scale_ma",
        examples=[32.767],
    )
    full_scale_counts: Annotated[int, Field(ge=1)] | None = Field(
        None,
        description="count at full_scale_ma, or full_scale; default: max_count",
        examples=[32767],
    )
    max_count: Annotated[int, Field(ge=1)] | None = Field(
        None,
        description="greatest count of the converter, 4095 for one of 12 bits: a channel there is saturated; "
        "default: full_scale_counts if that is 2^k or 2^k - 1, else the maximum of the channel's type",
        examples=[4095],
    )
    channel_scale: PositivePerChannel = Field(
        (1.0, 1.0, 1.0, 1.0),
        description="gain of each channel: current per count, relative to full_scale_ma / full_scale_counts; "
        "default: 1 for each",
    )
    noise_counts: Positive = Field(description="noise of one channel (1 sigma)")
    gain_std: Annotated[float, Field(ge=0, le=1)] = Field(
        0.012,
        description="relative error of a channel's gain before calibration (1 sigma); default: that of "
        "amplifiers with parts of 1 %, +-2 %",
    )
    series_std: Annotated[float, Field(ge=0, le=1)] = Field(
        0.03, description="relative error of a series resistor (1 sigma); default: that of +-5 %"
    )
    series_std_ohm: NonNegative = Field(
        1.2,
        description="resistance of the way from an electrode to its channel, electrode included, besides "
        "series_ohm (1 sigma); default: that of copper or short silver tracks, up to 2",
    )
    idle: Idle | None = Field(None, description="transmission while untouched; default: with every SYNC")
    excitation_object: str | None = Field(
        None,
        description="object that switches the pad's excitation: 1 on, 0 off, e.g. 0x2100:0:u8",
        examples=["0x2100:0:u8"],
    )
    sample_delay_ms: Annotated[float, Field(ge=0, le=1000)] = Field(
        0.0,
        description="mean time from a sample to the SYNC that it is sent with, of a node that doesn't sample "
        "at SYNC: samples are dated so much earlier. `handtouch node` logs it",
        examples=[4.0],
    )
    heartbeat_ms: int = Field(
        100,
        ge=10,
        le=60_000,
        description="producer heartbeat time, written to 0x1017; guard time of a node without heartbeat",
    )
    heartbeat_timeout_ms: int = Field(
        350,
        ge=20,
        le=300_000,
        description="heartbeat consumer time: a node without heartbeat for this long is lost",
    )

    @model_validator(mode="before")
    @classmethod
    def _fill_channels(cls, values: Any) -> Any:
        """Fill in what depends on the number of channels, and on their unit."""
        full_scale = values.get("full_scale") if isinstance(values, dict) else None
        if isinstance(full_scale, int | float):  # a signal takes the place of a current, whatever its unit
            values = {"drive_v": 1.0, "full_scale_ma": 1e3 * full_scale} | values
        channels = values.get("channels") if isinstance(values, dict) else None
        if not isinstance(channels, list | tuple) or len(channels) == len(SIDE_ELECTRODES):
            return values
        filled = {"channel_scale": (1.0,) * len(channels)} | values
        if isinstance(idle := values.get("idle"), dict):
            deltas = tuple(f"0x6426:{sub}:u32" for sub in range(1, len(channels) + 1))
            filled["idle"] = {"delta_objects": deltas} | idle
        return filled


class Behaviour(Table):
    """`[sheet.NAME.behaviour]`: creep, adaptation and hysteresis of a sheet, to be compensated."""

    preset: Literal["S1", "S2", "unknown"] = Field(
        "S1",
        description="sheet of the paper whose values are the defaults of keys below that have no other; "
        "unknown: one that wasn't measured, with wide intervals of force",
    )
    adaptation_share: Annotated[float, Field(ge=0, le=1)] | None = Field(
        None,
        description="fraction of a sustained load that adaptation removes; default: the preset's",
        examples=[0.851],
    )
    adaptation_time_s: Positive | None = Field(
        None, description="time constant of adaptation under load; default: the preset's", examples=[3000.0]
    )
    recovery_time_s: Positive | None = Field(
        None,
        description="time constant of recovery with excitation off; default: the preset's",
        examples=[5400.0],
    )
    fatigue_s: Positive | None = Field(
        None,
        description="accumulated time under load after which the sheet adapts twice as fast; default: the "
        "preset's, never for S2 and unknown",
        examples=[10_000.0],
    )
    threshold_n: NonNegative | None = Field(
        None, description="least force that the sheet responds to; default: the preset's", examples=[0.02]
    )
    creep_share: Annotated[float, Field(ge=0, lt=1)] | None = Field(
        None, description="fraction of a reading that arrives by creep; default: the preset's", examples=[0.4]
    )
    creep_time_s: Positive | None = Field(
        None, description="time constant of creep; default: the preset's", examples=[0.25]
    )
    hysteresis_width: Annotated[float, Field(ge=0, lt=0.4)] = Field(
        0.0,
        description="width of the hysteresis loop at half of hysteresis_full_scale_n, as a fraction of that "
        "force; 0: none",
        examples=[0.08],
    )
    hysteresis_full_scale_n: Positive = Field(
        5.0, description="greatest load of the measured hysteresis loop"
    )
    press_std: Annotated[float, Field(ge=0, le=1)] | None = Field(
        None,
        description="relative spread between readings of equal presses (1 sigma); default: the preset's",
        examples=[0.072],
    )
    gain_std: Annotated[float, Field(ge=0, le=1)] | None = Field(
        None,
        description="relative error of forces on a fresh sheet, common to all presses (1 sigma), where that "
        "of the contact law isn't larger; default: 0; of an unknown sheet 0.15, as its hysteresis isn't "
        "known",
        examples=[0.04],
    )
    parameter_std_fraction: Annotated[float, Field(ge=0, le=1)] = Field(
        0.2, description="relative error of the parameters of creep, adaptation and hysteresis (1 sigma)"
    )
    slow_creep: Annotated[float, Field(ge=0, le=1)] = Field(
        0.05,
        description="relative growth of a reading each time that a touch lasts e times longer (1 sigma): "
        "creep by a power law, which is learned from use; the contact law holds for touches of 1.5 s, or as "
        "old as those that it was calibrated by",
    )
    forget_time_s: Positive = Field(
        45.0,
        description="time without a detected touch in which presses below the threshold may have removed "
        "(1 - 1/e) of an adaptation to 1 N; inversely proportional to the adapted force",
    )
    back_force_std_n: NonNegative = Field(
        0.1,
        description="adapted force at the daemon's start, from earlier loads, of a sheet that adapts fully "
        "(1 sigma); in proportion to adaptation_share",
    )


class Sheet(Table):
    """`[sheet.NAME]`: a resistive sandwich and its contact law, k / pressure^alpha (paper eq. 12)."""

    ohm_per_square: Positive = Field(description="sheet resistance, rho / w")
    contact_ohm_mm2: Positive = Field(description="contact resistance times area at the reference pressure")
    reference_kpa: Positive = Field(100.0, description="pressure at which contact_ohm_mm2 applies")
    alpha: float = Field(gt=0, le=5, description="exponent of pressure in the contact law")
    contact_radius_mm: Positive = Field(
        description="radius of a contact, assumed to convert its current to force"
    )
    contact_radius_std_mm: NonNegative = Field(
        description="error of contact_radius_mm (1 sigma), included in the standard deviation of the force"
    )
    hertz_force_n: Positive | None = Field(
        None,
        description="force at which a contact has contact_radius_mm, which grows as force^(1/3), as under "
        "round objects (Hertz); default: the same radius at every force",
        examples=[2.0],
    )
    contact_elongation_std: Annotated[float, Field(ge=0, le=2)] = Field(
        0.4,
        description="logarithm of a contact's length over its width, in any direction (1 sigma); default: "
        "that of objects of many shapes; 0: round",
    )
    contact_tilt_std: Annotated[float, Field(ge=0, le=1)] = Field(
        0.3,
        description="rise of the pressure from the middle of a contact to its rim, over the mean, along any "
        "direction (1 sigma): current and pressure have different centres; default: that of objects pressed "
        "on unevenly; 0: evenly",
    )
    crowding: bool = Field(
        True,
        description="the current of a firm contact crowds towards the nearest electrode, which positions "
        "take into account; false: it is uniform over the contact",
    )
    pair_false_alarm: Annotated[float, Field(ge=0, le=0.002)] = Field(
        1e-3,
        description="probability that one contact on a pad of six or more electrodes is reported as two; 0: "
        "never two",
    )
    max_contact_length_mm: NonNegative = Field(
        10.0, description="length up to which an elongated contact isn't reported as two"
    )
    max_force_n: Positive | None = Field(
        None,
        description="greatest force of a contact; forces near the maximum current of the sheet, which hardly "
        "differ in current, are intervals up to it; default: unknown, they are lower bounds",
    )
    ohm_per_square_std: Annotated[float, Field(ge=0, le=1)] = Field(
        0.1, description="relative error of ohm_per_square (1 sigma); default: that of printed carbon"
    )
    contact_ohm_std: Annotated[float, Field(ge=0, le=1)] = Field(
        0.06, description="relative error of contact_ohm_mm2 (1 sigma); default: from part to part of FSRs"
    )
    alpha_std: Annotated[float, Field(ge=0, le=1)] = Field(0.05, description="error of alpha (1 sigma)")
    anisotropy_std: Annotated[float, Field(ge=0, le=1)] = Field(
        0.02, description="relative error of the surface's resistivity_ratio (1 sigma)"
    )
    gap_std_mm: NonNegative = Field(
        0.12,
        description="error of a pad's gap_mm, each end of an electrode (1 sigma); default: that of +-0.2",
    )
    unevenness_std: Annotated[float, Field(ge=0, le=1)] = Field(
        0.01,
        description="relative amplitude of each of the five longest waves of the sheet resistance over a pad "
        "(1 sigma); a film of +-10 % has about 0.04; default: that of +-2.5 %",
    )
    size_std_mm: NonNegative = Field(
        0.06, description="error of a pad's length and width (1 sigma); default: that of +-0.1"
    )
    behaviour: Behaviour | None = Field(
        None, description="creep, adaptation and hysteresis; default: none, readings are used unchanged"
    )


class Mount(Table):
    """Pose of the pad frame (origin at its centre, x towards xa, y towards yb, z outward) on its link."""

    link: str | None = Field(
        None,
        min_length=1,
        description="link of the URDF that carries the pad; default: the link of the pad's own name",
        examples=["link_3.0_tip"],
    )
    position_mm: Vector3 = Field((0.0, 0.0, 0.0), description="origin of the pad frame in the link frame")
    rpy_deg: Vector3 = Field((0.0, 0.0, 0.0), description="roll, pitch, yaw about fixed axes, as in URDF")


class Touch(Table):
    """`[touch]`: thresholds of contact detection."""

    begin_threshold_n: Positive = Field(0.06, description="a contact begins above this force")
    end_threshold_n: Positive = Field(0.03, description="a contact ends below this force")
    begin_ms: float = Field(
        5.0,
        ge=0,
        le=1000,
        description="a contact begins once all samples have been above begin_threshold_n for so long, within "
        "half a SYNC period; from two samples on, with 0 at the first",
    )
    end_ms: float = Field(
        5.0,
        ge=0,
        le=1000,
        description="a contact ends once all samples have been below end_threshold_n for so long, likewise",
    )
    max_gap_periods: int = Field(
        10,
        ge=3,
        le=1000,
        description="a contact continues with its id while at most so many samples in a row are missing; its "
        "messages have fresh = false meanwhile",
    )
    max_rise_time_s: Positive = Field(
        20.0,
        description="a reading that takes longer to rise to end_threshold_n is drift, which the baseline "
        "tracks; shorter: faster drift is tracked, and more slow touches are missed",
    )


class Pad(Table):
    """`[[hand.pad]]`: one area touch sensor on a link of the hand."""

    model_config = _required_unless("response", "sheet", "gap_mm")

    link: Name = Field(description="link that carries the pad; also its name in topics")
    bus: Name = Field(description="name of the [[bus]] that its node is on")
    node_id: NodeId = Field(description="CANopen node id, 1 to 127")
    serial: Unsigned32 | None = Field(
        None,
        description="serial number (0x1018 sub 4) of the pad's node, to which its calibration belongs; "
        "default: any, so a replaced sensor isn't detected",
    )
    node: Name = Field(description="kind of node, a [node.NAME] table")
    electrodes: Annotated[tuple[Name, ...], PER_CHANNEL] = Field(
        SIDE_ELECTRODES,
        description="electrodes that the node's channels are wired to, in channel order; default: x0, xa, "
        "y0, yb, or those of electrode_arcs_mm",
    )
    electrode_arcs_mm: dict[Name, Arc] | None = Field(
        None,
        description=f"of a pad with an outline or on a mesh, names of {CHANNEL_RANGE} electrodes in the "
        "order in which they follow each other counter-clockwise, each with the part of the edge that it "
        "covers, less gap_mm at both ends: lengths along it from the first vertex, on a mesh from the "
        "first corner; default: one electrode between each two corners",
    )
    switch_states: tuple[SwitchState, ...] | None = Field(
        None,
        strict=False,
        min_length=2,
        max_length=MAX_STATES,
        description="of a pad with electrode_arcs_mm whose node connects its electrodes in turn, one group "
        "of them in each SYNC period: for each state the names of the electrodes that are connected, each "
        "electrode in one state; those at the same place of every state share a channel. The contact is "
        "estimated from the samples of all states; default: all are connected all the time",
    )
    sheet: Name = Field(description="kind of sheet, a [sheet.NAME] table")
    response: PadResponse | Name | None = Field(
        None,
        description="kind of a pad that isn't a sheet with electrodes on a conductor, a [response.NAME] "
        "table; then `electrodes` are its channels, and no key of electrodes is given; default: it is one",
        examples=["taxel_array"],
    )
    surface: PadSurface = Field(description="shape of the sensing surface")
    resistance_map: str | None = Field(
        None,
        min_length=1,
        description="NumPy archive (.npz) of the sheet resistance as measured on this pad's film, relative "
        "to this file: x_mm, y_mm (lengths along the film from electrodes x0 and y0; on a mesh with z_mm the "
        "coordinates of its file) and ohm_per_square, one value for each place; default: the same everywhere",
        examples=["film.npz"],
    )
    press_map: str | None = Field(
        None,
        min_length=1,
        description="NumPy archive (.npz) of presses of this pad at known places, relative to this file, by "
        "which positions are estimated beside what is stated of the pad; `handtouch calibrate --map` makes "
        "it; default: none",
        examples=["tip_presses.npz"],
    )
    gap_mm: NonNegative = Field(description="bare length of each side next to its corners, along the surface")
    gap_offsets_mm: Annotated[tuple[Ends, ...], PER_CHANNEL] = Field(
        ((0.0, 0.0),) * 4,
        description="bare lengths besides gap_mm at the low and the high end of electrodes x0, xa, y0, yb, "
        "as `handtouch design` computes them, or at both ends of each arc; default: 0",
    )
    series_ohm: Annotated[tuple[NonNegative, ...], PER_CHANNEL] = Field(
        (0.0, 0.0, 0.0, 0.0),
        description="series resistors of electrodes x0, xa, y0, yb, or of each arc, to ground; default: 0",
    )
    mount: Mount = Field(Mount(), description="pose of the pad on its link")
    shear: Name | None = Field(
        None,
        description="kind of shear pad beneath this pad, a [shear.NAME] table, on channels of the same node; "
        "x along x, its centre at the pad's; default: none",
    )
    shear_electrodes: Annotated[tuple[Name, ...], Field(strict=False)] = Field(
        SIDE_ELECTRODES,
        description="electrodes of the shear pad that the node's channels after those of the pad are wired "
        "to, in channel order",
    )
    second_sheet: Name | None = Field(
        None,
        description="kind of the second sheet in the pad's sandwich, a [sheet.NAME] table of another alpha: "
        "force and contact radius are estimated from both. It has the first one's shape and electrodes, all "
        "joined: the node's last channel is its total current. Default: none",
        examples=["even"],
    )
    touch: Touch | None = Field(None, description="thresholds of this pad; default: those of [touch]")

    @model_validator(mode="before")
    @classmethod
    def _fill_electrodes(cls, values: Any) -> Any:
        """Fill in what depends on the number of electrodes."""
        if not isinstance(values, dict):
            return values
        arcs: Any = values.get("electrode_arcs_mm")
        if values.get("response") is not None:
            values = {"sheet": "none", "gap_mm": 0.0} | values
            arcs = response_of(values["response"])
            arcs = arcs and dict.fromkeys(arcs.channels)
        if not isinstance(arcs, dict):
            return values
        count = len(arcs)
        defaults = {
            "electrodes": tuple(arcs),
            "gap_offsets_mm": ((0.0, 0.0),) * count,
            "series_ohm": (0.0,) * count,
        }
        return defaults | values

    @property
    def electrode_names(self) -> tuple[str, ...]:
        """Names of the electrodes, in the order of the columns of all currents."""
        if isinstance(self.response, ResponseTable):
            return self.response.channels
        return SIDE_ELECTRODES if self.electrode_arcs_mm is None else tuple(self.electrode_arcs_mm)

    @property
    def arcs_mm(self) -> tuple[tuple[float, float], ...]:
        """Begin and end [mm] of each electrode of `electrode_arcs_mm`: (n, 2); empty without."""
        return tuple((self.electrode_arcs_mm or {}).values())

    @property
    def state_numbers(self) -> tuple[tuple[int, ...], ...]:
        """Numbers of the electrodes in each state of `switch_states`: (states, k); empty without."""
        names = self.electrode_names
        return tuple(tuple(map(names.index, state)) for state in self.switch_states or ())

    @property
    def state_count(self) -> int:
        """Number of states of `switch_states`; 1 without."""
        return len(self.switch_states or (0,))

    @property
    def is_magnetic(self) -> bool:
        """True if the Earth's field shifts its zeros."""
        return bool(getattr(self.response, "magnetic", False))

    @property
    def gaps_mm(self) -> tuple[tuple[float, float], ...]:
        """Bare lengths [mm] at the low and the high end of each electrode: (n, 2)."""
        return tuple((self.gap_mm + low, self.gap_mm + high) for low, high in self.gap_offsets_mm)


class HandTable(Table):
    """`[[hand]]`: a hand and its pads."""

    name: Name = Field(description="name of the hand in topics")
    urdf: str | None = Field(
        None,
        min_length=1,
        description="URDF file of the robot, relative to this file or shipped; default: none, so no "
        "positions in palm and base",
    )
    palm_link: str | None = Field(
        None, min_length=1, description="link of the URDF that is the palm frame; default: its root"
    )
    base_link: str | None = Field(
        None, min_length=1, description="link of the URDF that is the base frame; default: its root"
    )
    joint_names: dict[str, str] = Field(
        default_factory=dict,
        description="joint of the URDF -> its name in joint states, where they differ",
        examples=[{"joint_1.0": "index_mcp"}],
    )
    joint_prefix: str = Field(
        "",
        description="prefix of joint names in joint states, e.g. left_; not applied to joint_names",
        examples=["right_"],
    )
    mount_std_mm: NonNegative = Field(
        0.2,
        description="position error of a mount along each axis (1 sigma), included in the covariances in "
        "palm and base; default: that of printed parts; 0: not included",
    )
    mount_std_deg: NonNegative = Field(
        0.5,
        description="orientation error of a mount about each axis (1 sigma), included like mount_std_mm; "
        "default: that of printed parts",
    )
    joint_std_deg: NonNegative = Field(
        0.2,
        description="error of joint angles, such as their zeros (1 sigma), used where joint states carry no "
        "position_std_rad; included in these covariances; 0: not included",
    )
    joint_std_mm: NonNegative = Field(
        0.0, description="error of prismatic joints (1 sigma), used like joint_std_deg"
    )
    joint_backlash_deg: NonNegative = Field(
        0.0,
        description="play between a joint's encoder and its link, from one end to the other; included in "
        "these covariances as even over the play, also where joint states carry position_std_rad",
    )
    joint_backlash_mm: NonNegative = Field(
        0.0, description="play of prismatic joints, used like joint_backlash_deg"
    )
    joint_state_timeout_ms: Positive = Field(
        100.0,
        description="positions in palm and base are stale when the nearest joint state is farther in time",
    )
    gravity: Vector3 = Field(
        (0.0, 0.0, -1.0),
        description="direction of gravity in the base frame, to compensate the weight of the pads; joint "
        "states of a moving base may override it",
    )
    object: Name | None = Field(
        None,
        description="object that the hand handles, of the tables [object.NAME]; the control command `object` "
        "may replace it; default: none",
        examples=["bolt"],
    )
    grouping_distance_mm: NonNegative = Field(
        25.0, description="contacts at most this far apart are published as a group, probably of one object"
    )
    pads: Annotated[tuple[Pad, ...], Field(strict=False, min_length=1)] = Field(alias="pad")


class SceneRequest(Table):
    """Links, outputs and rate that a task uses."""

    links: Annotated[tuple[str, ...], Field(strict=False)] = Field(
        ("*",), description='patterns of the links in use: "thumb_*", "left/index_distal"'
    )
    outputs: Annotated[tuple[RequestedOutput, ...], Field(strict=False)] = Field(
        ("position", "force"),
        description="outputs of a contact that are computed; raw: pads are sampled with every SYNC even "
        "while untouched; palm, base: positions in these frames, which need [[hand]] urdf and joint states; "
        "motion, shape, friction, object: computed even without a subscriber",
    )
    rate_hz: Positive | None = Field(
        None,
        description="rate of contact updates; default: one per SYNC. Begin and end are published at once",
        examples=[50.0],
    )


class Scene(SceneRequest):
    """`[scene]`: links and outputs that the task uses; pads outside it are switched off."""

    idle_after_s: Positive = Field(
        2.0, description="a pad untouched for this long becomes event-driven, if its node supports it"
    )
    excitation_off_after_s: Positive | None = Field(
        None,
        description="in a hand untouched for this long, excitation of the sheets that adapt is switched off, "
        "half of them at a time, until another pad is touched: they recover, and detect nothing meanwhile; "
        "default: never",
        examples=[60.0],
    )
    idle_sync_period_ms: float = Field(
        50.0,
        ge=1,
        le=1000,
        description="SYNC period while every pad in the scene is event-driven, if longer than sync_period_ms",
    )


class NamedPad(NamedTuple):
    """A pad with its hand's name."""

    hand: str
    pad: Pad

    @property
    def name(self) -> str:
        """Name of the pad in topics and messages: "hand/link"."""
        return f"{self.hand}/{self.pad.link}"


@lru_cache(maxsize=256)
def _checked_sheet(**values: Any) -> Sheet:
    return Sheet.model_validate(values)


class Deployment(Table):
    """The whole file."""

    daemon: Daemon = Daemon()
    scene: Scene = Scene()
    buses: Annotated[tuple[Bus, ...], Field(strict=False, min_length=1)] = Field(alias="bus")
    nodes: dict[Name, Node] = Field(alias="node")
    sheets: dict[Name, Sheet] = Field(alias="sheet")
    responses: dict[Name, PadResponse] = Field({}, alias="response")
    shears: dict[Name, Shear] = Field({}, alias="shear")
    objects: dict[Name, ObjectTable] = Field({}, alias="object")
    touch: Touch = Touch()
    hands: Annotated[tuple[HandTable, ...], Field(strict=False, min_length=1)] = Field(alias="hand")

    @model_validator(mode="before")
    @classmethod
    def _insert_responses(cls, values: Any) -> Any:
        """Replace the name of a response in each pad by its table."""
        responses = values.get("response") if isinstance(values, dict) else None
        if not isinstance(responses, dict):
            return values

        def inserted(pad: Any) -> Any:
            name = pad.get("response") if isinstance(pad, dict) else None
            known = isinstance(name, str) and response_of(responses.get(name))
            return pad | {"response": responses[name]} if known else pad

        hands = values.get("hand")
        if isinstance(hands, list | tuple):
            hands = [
                hand | {"pad": list(map(inserted, hand["pad"]))}
                if isinstance(hand, dict) and isinstance(hand.get("pad"), list | tuple)
                else hand
                for hand in hands
            ]
            values = values | {"hand": hands}
        return {"sheet": {}} | values

    def sheet_of(self, pad: Pad) -> Sheet:
        """Return the sheet of a pad, or the one that is equivalent to its response."""
        if not isinstance(pad.response, ResponseTable):
            return self.sheets[pad.sheet]
        return _checked_sheet(**pad.response.sheet_values())

    @property
    def pads(self) -> list[NamedPad]:
        """All pads in the order of the file; a pad's row everywhere is its index here."""
        return [NamedPad(hand.name, pad) for hand in self.hands for pad in hand.pads]

    def with_pads(self, change: Callable[[str, Pad], Pad]) -> Deployment:
        """Return the deployment with each pad as `change` makes it of its hand's name and itself."""
        hands = tuple(
            hand.model_copy(update={"pads": tuple(change(hand.name, pad) for pad in hand.pads)})
            for hand in self.hands
        )
        return self.model_copy(update={"hands": hands})

    def touch_of(self, pad: Pad) -> Touch:
        """Return the thresholds of a pad: its own, or those of all."""
        return pad.touch or self.touch

    @property
    def pad_names(self) -> list[str]:
        """Names "hand/link" of all pads, in the order of `pads`."""
        return [entry.name for entry in self.pads]

    @property
    def links_by_hand(self) -> dict[str, list[str]]:
        """Names of the links of every hand, by the hand's name."""
        return {hand.name: [pad.link for pad in hand.pads] for hand in self.hands}

    def pads_on(self, bus: str) -> list[NamedPad]:
        """Return the pads whose node is on a bus."""
        return [entry for entry in self.pads if entry.pad.bus == bus]

    def rows_matching(self, pattern: str) -> list[int]:
        """Return the rows of the pads that match "thumb_*" (a link of any hand) or "left/thumb_*"."""
        full = pattern if "/" in pattern else f"*/{pattern}"
        return [row for row, name in enumerate(self.pad_names) if fnmatchcase(name, full)]


TABLES: dict[str, type[Table]] = {
    "": Deployment,
    "daemon": Daemon,
    "bus": Bus,
    "scene": Scene,
    "node.*": Node,
    "node.*.idle": Idle,
    "sheet.*": Sheet,
    "sheet.*.behaviour": Behaviour,
    "shear.*": Shear,
    "object.*": ObjectTable,
    "touch": Touch,
    "hand": HandTable,
    "hand.pad": Pad,
    "hand.pad.mount": Mount,
    "hand.pad.touch": Touch,
}
KINDS: dict[str, Mapping[str, type[Table]]] = {
    "surface": SURFACE_TABLES,
    "response": RESPONSES,
    "pattern": SHEAR_PATTERNS,
    "shape": OBJECT_SHAPES,
}
"""Models by the key `kind`, of each table that follows one of several."""
