"""The tables of a deployment file and their keys, each with its unit, range and meaning.

Public names: `Deployment` and the tables in it; `TABLES` and `SURFACES`, by their names in the file.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(gt=0, lt=1)]
Three = Annotated[tuple[float, float, float], Field(strict=False)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_\-]*$", max_length=64)]
Electrode = Literal["x0", "xa", "y0", "yb"]
Output = Literal["location", "strength", "raw", "palm", "base", "motion", "hardness", "shape", "texture"]
Four = Annotated[tuple[Positive, Positive, Positive, Positive], Field(strict=False)]
NodeId = Annotated[int, Field(ge=1, le=127)]
Unsigned32 = Annotated[int, Field(ge=0, le=0xFFFFFFFF)]


class Table(BaseModel):
    """A table of the file: frozen, no unknown keys, no silent conversion of types, no NaN or infinity."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, populate_by_name=False
    )


class Daemon(Table):
    """`[daemon]`: where the daemon is reached and how fast it works."""

    live: str = Field("tcp://127.0.0.1:5580", description="ZeroMQ endpoint of the live stream")
    complete: str = Field("tcp://127.0.0.1:5582", description="ZeroMQ endpoint of the complete stream")
    control: str = Field("tcp://127.0.0.1:5581", description="ZeroMQ endpoint of request-reply control")
    inputs: str = Field("tcp://127.0.0.1:5583", description="ZeroMQ endpoint of joint states and forces")
    keys: str | None = Field(
        None,
        min_length=1,
        description="folder, beside this file, of the keys that TCP clients need (`handtouch keys make`); "
        "left out: any local client may connect, and no other machine can",
    )
    store: str | None = Field(
        None,
        min_length=1,
        description="file of the calibration store, beside this file; left out: "
        "$XDG_STATE_HOME/handtouch/calibrations.db, or in the state folder of the service",
    )
    supervise: bool = Field(
        True, description="watch, calibrate and diagnose all pads, in a process of its own beside the daemon"
    )
    another_unit: Literal["refuse", "quarantine"] = Field(
        "quarantine",
        description="what to do with a node whose serial number isn't the configured one: take it as a "
        "replacement, in quarantine until it is calibrated, or refuse it. Without `supervise`, and where "
        "the number is configured for another pad, it is refused",
    )
    sync_period_ms: float = Field(5.0, ge=0.5, le=1000, description="period of SYNC and of the tick")
    window: Fraction = Field(0.6, description="part of the period after SYNC that a tick waits for samples")
    log_level: Literal["debug", "info", "warning", "error"] = Field(
        "info", description="how grave a message must be to be logged"
    )
    metrics: str | None = Field(
        None,
        description="loopback HOST:PORT that Prometheus reads from, e.g. 127.0.0.1:9580; left out: none",
    )
    realtime_priority: int = Field(
        0, ge=0, le=99, description="SCHED_FIFO priority of the thread that ticks; 0: an ordinary thread"
    )
    cpus: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(strict=False)] = Field(
        (), description="processors that the thread that ticks may use; none given: any"
    )
    lock_memory: bool = Field(False, description="keep all memory of the daemon from being swapped out")
    busy_poll_us: float = Field(
        0,
        ge=0,
        le=10_000,
        description="wait for samples without sleeping, so long before and after the last one usually comes; "
        "0: always sleep",
    )


class Bus(Table):
    """`[[bus]]`: one CAN bus, by python-can's names."""

    name: Name = Field(description="what pads and --bus call it")
    interface: str = Field(description="python-can interface: socketcan, udp_multicast, virtual, slcan …")
    channel: str | int = Field(description="python-can channel: can0, 239.74.163.2, /dev/ttyACM0 …")
    bitrate_bit_s: int = Field(1_000_000, ge=10_000, le=1_000_000, description="bit rate, for the bus load")
    sync: Literal["producer", "consumer"] = Field(
        "producer", description="who sends SYNC on this bus: this daemon, or somebody else"
    )
    role: Literal["master", "guest", "listener"] = Field(
        "master",
        description="master: configures and starts our nodes; guest: configures them, and another master "
        "starts them; listener: sends nothing at all",
    )
    options: dict[str, str | int | float | bool] = Field(
        default_factory=dict, description="further options of the python-can interface, passed on as they are"
    )


class Idle(Table):
    """`[node.NAME.idle]`: an untouched pad in the scene sends when a channel moves, not with SYNC."""

    delta_counts: Annotated[int, Field(ge=1)] = Field(
        description="change of a channel after which the node sends at once; some five times noise_counts"
    )
    period_ms: Annotated[int, Field(ge=10, le=65_535)] = Field(
        100, description="and it sends this often in any case, by its event timer (0x1800 + n sub 5)"
    )
    delta_objects: Annotated[tuple[str, str, str, str], Field(strict=False)] = Field(
        ("0x6426:1:u32", "0x6426:2:u32", "0x6426:3:u32", "0x6426:4:u32"),
        description="objects that delta_counts is written to, one a channel",
    )
    enable_object: str | None = Field(
        "0x6423:0:u8", description="object that a 1 is written to, so that changes are sent; none: left out"
    )


class Node(Table):
    """`[node.NAME]`: a kind of sensor node, its electronics and its supervision."""

    eds: str | None = Field(
        None, description="EDS file beside this one; left out: the shipped four-channel node"
    )
    vendor_id: Unsigned32 | None = Field(None, description="checked against 0x1018 sub 1 when given")
    product_code: Unsigned32 | None = Field(None, description="checked against 0x1018 sub 2 when given")
    channels: Annotated[tuple[str, str, str, str], Field(strict=False)] = Field(
        ("0x6401:1", "0x6401:2", "0x6401:3", "0x6401:4"),
        description="objects of the four channels, INDEX:SUB; with a type (i16, u24 …) where no EDS tells it",
    )
    remap: bool = Field(
        True, description="map the channels to a TPDO over SDO where the node has them in none and allows it"
    )
    revision: Unsigned32 | None = Field(None, description="checked against 0x1018 sub 3 when given")
    drive_v: Positive = Field(description="potential of the conducting layer against the electrodes, volt")
    full_scale_ma: Positive = Field(description="electrode current at full_scale_counts")
    full_scale_counts: Annotated[int, Field(ge=1)] | None = Field(
        None,
        description="count at full_scale_ma; left out: the greatest of the channel's type (32767 for i16)",
    )
    channel_scale: Four = Field(
        (1.0, 1.0, 1.0, 1.0),
        description="current per count of each channel, relative to that of full_scale_ma",
    )
    noise_counts: Positive = Field(description="standard deviation of one channel's reading, counts")
    idle: Idle | None = Field(None, description="event-driven while untouched; left out: always with SYNC")
    excitation: str | None = Field(
        None, description="object that 0 switches the pad's excitation off with and 1 on, e.g. 0x2100:0:u8"
    )
    heartbeat_ms: int = Field(
        100,
        ge=10,
        le=60_000,
        description="producer heartbeat time, written to 0x1017; guard time of a node that has none",
    )
    heartbeat_timeout_ms: int = Field(
        350, ge=20, le=300_000, description="silence after which a node is lost"
    )


class Behaviour(Table):
    """`[sheet.NAME.behaviour]`: how a sheet creeps, adapts and remembers, to be undone."""

    preset: Literal["S1", "S2"] = Field(
        "S1", description="sheet of the paper that it is like; keys below that are left out are that one's"
    )
    adaptation_share: Annotated[float, Field(ge=0, le=1)] | None = Field(
        None, description="part of a lasting load that it gets used to"
    )
    adaptation_time_s: Positive | None = Field(None, description="time constant of that, under load")
    recovery_time_s: Positive | None = Field(
        None, description="time constant of recovering, without potential"
    )
    fatigue_s: Positive | None = Field(
        None, description="time under load in its life after which it adapts twice as fast"
    )
    threshold_n: NonNegative | None = Field(None, description="least force that it feels")
    creep_share: Annotated[float, Field(ge=0, lt=1)] | None = Field(
        None, description="part of a reading that comes late"
    )
    creep_time_s: Positive | None = Field(None, description="time constant of that")
    loop: Annotated[float, Field(ge=0, lt=0.4)] = Field(
        0.0, description="width of its hysteresis loop half-way to loop_full_n, as a part of that; 0: none"
    )
    loop_full_n: Positive = Field(5.0, description="load up to which that loop was measured")
    press_std: Annotated[float, Field(ge=0, le=1)] | None = Field(
        None, description="relative spread of the readings of equal presses (1 sigma)"
    )
    gain_std: Annotated[float, Field(ge=0, le=1)] = Field(
        0.05, description="relative error of forces on a fresh sheet, the same for all presses (1 sigma)"
    )
    doubt: Annotated[float, Field(ge=0, le=1)] = Field(
        0.2, description="relative error of these numbers of creep, adaptation and hysteresis (1 sigma)"
    )
    slow_creep: Annotated[float, Field(ge=0, le=1)] = Field(
        0.02,
        description="part by which a reading may go on growing each time that a touch lasts e times longer "
        "(1 sigma): creep by a power law, which isn't undone",
    )
    silence_s: Positive = Field(
        45.0,
        description="time unfelt in which a press too light to be felt may have made it forget (1 - 1/e), if "
        "it has got used to 1 N; as much longer as that is less",
    )
    history_std_n: NonNegative = Field(
        0.1, description="what it may have got used to before the daemon started (1 sigma)"
    )


class Sheet(Table):
    """`[sheet.NAME]`: a resistive sandwich with its contact law, k / pressure^alpha (paper eq. 12)."""

    ohm_per_square: Positive = Field(description="sheet resistance rho/w")
    contact_ohm_mm2: Positive = Field(description="contact resistance times area at the reference pressure")
    reference_kpa: Positive = Field(100.0, description="the pressure at which contact_ohm_mm2 holds")
    alpha: float = Field(gt=0, le=5, description="exponent of pressure in the contact law")
    contact_radius_mm: Positive = Field(description="radius assumed for a contact")
    contact_radius_std_mm: NonNegative = Field(
        description="how far from that a contact's radius may be (1 sigma)"
    )
    behaviour: Behaviour | None = Field(
        None, description="how it creeps, adapts and remembers; left out: its readings are taken as they are"
    )


class Plane(Table):
    """A flat pad."""

    kind: Literal["plane"]
    length_mm: Positive = Field(description="from electrode x0 to electrode xa")
    width_mm: Positive = Field(description="from electrode y0 to electrode yb")


class Cylinder(Table):
    """A patch of a cylinder; its x axis runs along the cylinder."""

    kind: Literal["cylinder"]
    radius_mm: Positive = Field(description="radius of the sensing surface")
    length_mm: Positive = Field(description="along the axis, from electrode x0 to electrode xa")
    arc_deg: float = Field(
        gt=0, le=360, description="around the axis, from electrode y0 to electrode yb; 360: all round"
    )


class Cone(Table):
    """A patch of a cone between two of its circles."""

    kind: Literal["cone"]
    near_radius_mm: Positive = Field(description="radius of the circle at electrode x0")
    far_radius_mm: Positive = Field(description="radius of the circle at electrode xa")
    slant_mm: Positive = Field(description="along the surface, from electrode x0 to electrode xa")
    arc_deg: float = Field(
        gt=0, le=360, description="around the axis, from electrode y0 to electrode yb; 360: all round"
    )


class Sphere(Table):
    """A patch of a sphere between two parallels and two meridians."""

    kind: Literal["sphere"]
    radius_mm: Positive = Field(description="radius of the sensing surface")
    from_deg: float = Field(gt=-90, lt=90, description="latitude of electrode x0")
    to_deg: float = Field(gt=-90, lt=90, description="latitude of electrode xa")
    arc_deg: float = Field(
        gt=0, le=360, description="around the axis, from electrode y0 to electrode yb; 360: all round"
    )


Surface = Annotated[Plane | Cylinder | Cone | Sphere, Field(discriminator="kind")]


class Mount(Table):
    """Where the pad frame (origin at its centre, x towards xa, y towards yb, z outward) sits on its link."""

    link: str | None = Field(
        None,
        min_length=1,
        description="link of the URDF that carries the pad; left out: the one of the pad's name",
    )
    position_mm: Three = Field((0.0, 0.0, 0.0), description="origin of the pad frame in the link frame")
    rpy_deg: Three = Field((0.0, 0.0, 0.0), description="roll, pitch, yaw about fixed axes, as in URDF")


class Touch(Table):
    """`[touch]`: when a pad counts as touched."""

    on_n: Positive = Field(0.06, description="a touch begins above this force")
    off_n: Positive = Field(0.03, description="and ends below this one")
    begin_samples: int = Field(2, ge=1, le=100, description="samples in a row above on_n before it begins")
    end_samples: int = Field(2, ge=1, le=100, description="samples in a row below off_n before it ends")
    slow_touch_s: Positive = Field(
        20.0,
        description="what takes longer to rise to off_n is no touch but drift, and followed; less: faster "
        "drift is followed, and more slow touches are missed",
    )


class Pad(Table):
    """`[[hand.pad]]`: one area touch sensor on a link of the hand."""

    link: Name = Field(description="link that carries the pad; also its name in topics")
    bus: Name = Field(description="name of the [[bus]] that its node is on")
    node_id: NodeId = Field(description="CANopen node id, 1 to 127")
    serial: Unsigned32 | None = Field(
        None, description="serial number (0x1018 sub 4) of the node calibrated here"
    )
    node: Name = Field(description="kind of node, a [node.NAME] table")
    electrodes: Annotated[tuple[Electrode, Electrode, Electrode, Electrode], Field(strict=False)] = Field(
        ("x0", "xa", "y0", "yb"), description="what the node's four channels are wired to, in their order"
    )
    sheet: Name = Field(description="kind of sheet, a [sheet.NAME] table")
    surface: Surface = Field(description="shape of the sensing surface")
    gap_mm: NonNegative = Field(description="bare length of each side next to its corners, along the surface")
    series_ohm: Annotated[tuple[NonNegative, NonNegative, NonNegative, NonNegative], Field(strict=False)] = (
        Field((0.0, 0.0, 0.0, 0.0), description="resistors from the electrodes x0, xa, y0, yb to ground")
    )
    mount: Mount = Field(Mount(), description="where the pad sits on its link")
    touch: Touch | None = Field(None, description="thresholds of this pad alone; left out: those of [touch]")


class Hand(Table):
    """`[[hand]]`: a hand and its pads."""

    name: Name = Field(description="name of the hand in topics")
    urdf: str | None = Field(
        None,
        min_length=1,
        description="the robot's description, beside this file or shipped; left out: no palm or base frame",
    )
    palm_link: str | None = Field(
        None, min_length=1, description="link of the URDF whose frame is the palm's; left out: its root"
    )
    base_link: str | None = Field(
        None, min_length=1, description="link of the URDF whose frame is the base's; left out: its root"
    )
    joint_names: dict[str, str] = Field(
        default_factory=dict, description="joint of the URDF -> its name in joint states, if another"
    )
    joint_prefix: str = Field(
        "", description="what joint states put before the names of joints, e.g. left_; not before joint_names"
    )
    mount_std_mm: NonNegative = Field(
        0.0,
        description="how far a pad may sit from where its mount says, along each axis (1 sigma): it enters "
        "the covariances in palm and base; 0: not stated, and not in them",
    )
    mount_std_deg: NonNegative = Field(
        0.0, description="and how far it may be turned, about each axis (1 sigma)"
    )
    joint_std_deg: NonNegative = Field(
        0.0,
        description="error of the joint angles (1 sigma) where joint states tell no position_std_rad, as of "
        "their zeros: it enters these covariances too; 0: not stated",
    )
    joint_std_mm: NonNegative = Field(0.0, description="the same of joints that slide")
    joints_stale_ms: Positive = Field(
        100.0,
        description="a contact farther in time from the nearest joint state has no place in palm and base",
    )
    gravity: Three = Field(
        (0.0, 0.0, -1.0),
        description="which way gravity points in the base's frame, for pads that feel it; joint states may "
        "tell another, of a base that moves",
    )
    group_mm: NonNegative = Field(
        25.0, description="contacts that lie this close may be of one object, and are told as a group"
    )
    pads: Annotated[tuple[Pad, ...], Field(strict=False, min_length=1)] = Field(alias="pad")


class Wants(Table):
    """What somebody uses of the hand: which links, what of them, how finely and how often."""

    links: Annotated[tuple[str, ...], Field(strict=False)] = Field(
        ("*",), description='links in use, as patterns: "thumb_*", "left/index_distal"'
    )
    outputs: Annotated[tuple[Output, ...], Field(strict=False)] = Field(
        ("location", "strength"),
        description="what is used of a contact; raw: its pads are sampled with every SYNC, touched or not; "
        "palm, base: places in these frames, which need [[hand]] urdf and joint states; motion, hardness, "
        "shape, texture: perceived whether anybody listens or not, where a listener alone would do",
    )
    tolerance_mm: NonNegative = Field(
        0.0, le=10, description="error of a location that does no harm; 0: as good as the currents tell it"
    )
    rate_hz: Positive | None = Field(
        None, description="updates a second that are enough; left out: one a SYNC. Begin and end come at once"
    )


class Scene(Wants):
    """`[scene]`: what the task at hand needs; pads outside it are switched off."""

    idle_after_s: Positive = Field(
        2.0, description="a pad untouched for so long becomes event-driven, where its node can"
    )
    rest_after_s: Positive | None = Field(
        None,
        description="a hand untouched for so long rests the sheets that fade, half of them at a time, "
        "without potential: they recover, and feel nothing until another pad is touched; left out: never",
    )
    idle_sync_period_ms: float = Field(
        50.0,
        ge=1,
        le=1000,
        description="period of SYNC while every pad in the scene is event-driven, if that is longer",
    )


class Deployment(Table):
    """The whole file."""

    daemon: Daemon = Daemon()
    scene: Scene = Scene()
    buses: Annotated[tuple[Bus, ...], Field(strict=False, min_length=1)] = Field(alias="bus")
    nodes: dict[Name, Node] = Field(alias="node")
    sheets: dict[Name, Sheet] = Field(alias="sheet")
    touch: Touch = Touch()
    hands: Annotated[tuple[Hand, ...], Field(strict=False, min_length=1)] = Field(alias="hand")


SURFACES: dict[str, type[Table]] = {"plane": Plane, "cylinder": Cylinder, "cone": Cone, "sphere": Sphere}
TABLES: dict[str, type[Table]] = {
    "": Deployment,
    "daemon": Daemon,
    "bus": Bus,
    "scene": Scene,
    "node.*": Node,
    "node.*.idle": Idle,
    "sheet.*": Sheet,
    "sheet.*.behaviour": Behaviour,
    "touch": Touch,
    "hand": Hand,
    "hand.pad": Pad,
    "hand.pad.mount": Mount,
    "hand.pad.touch": Touch,
}
