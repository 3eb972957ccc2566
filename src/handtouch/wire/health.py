"""Payloads about the state of pads and joints: `Health` and the maps in it, `JointPositions`."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal, cast

from handtouch.wire.faults import FaultKind
from handtouch.wire.status import PadState, PadStateName

NodeStateName = Literal[
    "absent", "booting", "identified", "configuring", "settling", "operational", "stale", "faulted", "stopped"
]
CalibrationStateName = Literal["default", "calibrated", "quarantined", "manual_required", ""]
AdaptationStatusName = Literal["compensated", "rejected", ""]
SecondSheetStatusName = Literal["operational", "no_zero", "dead", "saturated", "stuck", "contradictory", ""]
ShearStatusName = Literal["operational", "no_rest", "dead", "saturated", "shorted", ""]


class _HealthPart:
    """A dataclass that `health` publishes as a map."""

    __slots__ = ()

    def to_map(self) -> dict[str, Any]:
        """Return the map in a health message."""
        return {field.name: getattr(self, field.name) for field in fields(cast(Any, self))}


@dataclass(frozen=True, slots=True)
class Emergency(_HealthPart):
    """An error that a node has reported by EMCY, as the topic `health` publishes it."""

    code: int
    """error code"""
    register: int
    """error register (0x1001) in the message"""
    manufacturer: str
    """the five manufacturer-specific bytes, ten hexadecimal digits"""
    text: str
    """code and register as text"""
    arrival_ns: int
    """reception of the first message, on the clock of `t_ns`"""
    cleared_ns: int | None = None
    """when the node cleared it, on the clock of `t_ns`; nil while it lasts"""
    count: int = 1
    """messages received in succession"""


@dataclass(frozen=True, slots=True)
class Diagnosis(_HealthPart):
    """One fault of a pad that lasts, as the topic `health` publishes it: kind, cause, evidence, remedy."""

    kind: FaultKind
    """identifier"""
    cause: str
    """cause as text"""
    evidence: str
    """evidence as text"""
    remedy: str
    """remedy as text"""
    since_ns: int
    """begin, on the clock of `t_ns`"""
    confidence: float = 1.0
    """probability of this kind, against another or none"""
    pad_m: tuple[float, float] | None = None
    """its arc lengths on the pad, from the electrodes x0 and y0"""
    size_m: float | None = None
    """its diameter"""
    position_valid: bool = True
    """the pad's contact positions can be relied on meanwhile"""
    force_valid: bool = True
    """the pad's forces can be relied on meanwhile"""


@dataclass(frozen=True, slots=True)
class Health:
    """`health/<hand>/<link>`: state of a pad and its node; at every change and once a second."""

    v: int
    session: int
    seq: int
    t_ns: int
    """publication"""
    hand: str
    """name of the hand"""
    link: str
    """link that carries the pad"""
    bus: str
    """bus of its node, as named in the deployment"""
    node_id: int
    """CANopen node id"""
    state: Annotated[PadStateName, PadState]
    """state of the pad"""
    node_state: NodeStateName
    """`absent`, `booting`, `identified`, `configuring`, `settling`, `operational`, `stale`, `faulted` or
    `stopped`"""
    node_state_since_ns: int
    """when the node entered that state"""
    sampling: Literal["sync", "event", "off"]
    """`sync`: with every SYNC; `event`: on change and ten times a second, while untouched; `off`: switched
    off"""
    reason: str
    """cause and remedy as text; empty without a fault"""
    serial: int | None
    """the node's serial number (0x1018 sub 4), once read"""
    rate_hz: float
    """samples per second, over the last second"""
    samples: int
    """since the daemon started"""
    missed_samples: int
    """ticks without the sample of their SYNC: it was late, for the next tick, or lost"""
    age_s: float | None
    """age of the newest sample"""
    reboots: int
    """boot-up messages of its node after the first"""
    heartbeats_missed: int
    """heartbeats of its node that timed out"""
    emergencies: Annotated[tuple[dict[str, Any], ...], tuple[Emergency, ...]]
    """the latest 16 errors that the node has reported by EMCY, newest last; error resets (code 0x00xx) end
    errors and aren't listed"""
    retained: bool
    error_register: int | None = None
    """error register (0x1001), from EMCY or as read at boot; absent before"""
    error_history: tuple[int, ...] = ()
    """pre-defined error field (0x1003) as read at boot and after a failure, the latest error first: error
    code in bits 0 to 15, manufacturer's information in bits 16 to 31"""
    adaptation_status: AdaptationStatusName = ""
    """adaptation of the sheet in `force_n`: `compensated`; `rejected`: not compensated on this pad, because
    forces of steady holds drift less without; absent where sheet behaviour isn't modelled"""
    shear_status: ShearStatusName = ""
    """channels of the shear pad beneath: `operational`; `no_rest`: its rest position isn't known yet;
    `dead`: a channel has almost no current; `saturated`: one is at the end of its range; `shorted`: two have
    had equal currents, also under touches. Absent without a shear pad. Force vectors are `invalid` or
    `unreliable` unless it is `operational`, but for `shorted`, whose component reads 0"""
    calibration_state: CalibrationStateName = ""
    """`default`: the deployment's values; `calibrated`; `quarantined`: not relied on after its node was
    replaced; `manual_required`: automatic calibration failed. This and the following are absent where
    `[daemon] supervise` is false"""
    calibration_id: str = ""
    """the active calibration, as in `contact`"""
    calibration_progress: str = ""
    """progress of the automatic calibration, as text"""
    diagnoses: Annotated[tuple[dict[str, Any], ...], tuple[Diagnosis, ...]] = ()
    """active diagnoses"""
    least_begin_threshold_n: float | None = None
    """lower bound of the `begin_threshold_n` with one false contact in 100 hours, by noise and drift of the
    pad while untouched; absent in its first minute"""
    second_sheet_status: SecondSheetStatusName = ""
    """channel of the second sheet: `operational`; `no_zero`: its zero isn't known yet; under the last touch
    `dead`: it had no current; `saturated`: it was at the end of its range; `stuck`: its counts never changed;
    `contradictory`: no expected radius explains both sheets. Absent without one. Forces are those of the
    first sheet unless it is `operational`"""


@dataclass(frozen=True, slots=True)
class JointPositions:
    """`joints/<hand>`: joint positions as received from the robot; at most 30 a second."""

    v: int
    session: int
    seq: int
    t_ns: int
    """publication, and the time at which the joints have these positions"""
    hand: str
    """name of the hand"""
    names: tuple[str, ...]
    """joints that move its links, as named in the URDF"""
    position_rad: tuple[float | None, ...]
    """in the order of `names`; metres for a prismatic joint, nil without any joint state"""
    age_s: tuple[float | None, ...]
    """age of the nearest joint state"""
    retained: bool
