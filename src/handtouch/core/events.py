"""Events: everything that changes the state between two ticks other than samples.

Public names: `Event`, `EventTarget`, `encode_event`, `decode_event`, and the events.

They are collected by `Pipeline.add_event`, applied in their order at the start of the next tick, and recorded
with its inputs, so that a replay applies the same at the same point.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from handtouch.core.active_calibration import ActiveCalibration
from handtouch.core.scene import RequestedOutputs
from handtouch.core.sheet_force import ForceReference
from handtouch.core.stages.frames import ContactTransforms
from handtouch.core.tick import TickProcessor


class EventTarget(Protocol):
    """The part of `Pipeline` that events change."""

    tick: TickProcessor
    transforms: ContactTransforms

    def apply_next_model(self, changed: NDArray[np.intp]) -> None:
        """Continue with the next deployment's model."""


class Event(Protocol):
    """A change between two ticks; `kind` is its name in a recording."""

    kind: ClassVar[str]

    def apply(self, target: EventTarget) -> None:
        """Change the state."""


@dataclass(frozen=True, slots=True)
class BaselineEvent:
    """Offsets (n,) of a pad and their standard deviations [counts]: a tare, or from a calibration.

    shear_counts: (4,) of the shear pad beneath it at rest; () leaves its rest position as it is.
    second_counts: offset of its second sheet's channel and standard deviation; () leaves it as it is."""

    kind: ClassVar[str] = "baseline"
    pad: int
    offset_counts: tuple[float, ...]
    std_counts: tuple[float, ...]
    shear_counts: tuple[float, ...] = ()
    second_counts: tuple[float, ...] = ()

    def apply(self, target: EventTarget) -> None:
        target.tick.set_baseline(self.pad, self.offset_counts, self.std_counts)
        if self.shear_counts:
            target.tick.shear.set_rest(self.pad, self.shear_counts)
        if self.second_counts:
            target.tick.second.set_offset(self.pad, *self.second_counts)


@dataclass(frozen=True, slots=True)
class CalibrationEvent:
    """Another calibration of a pad: learned, set, rolled back, or quarantined."""

    kind: ClassVar[str] = "calibration"
    pad: int
    calibration: ActiveCalibration

    def apply(self, target: EventTarget) -> None:
        target.tick.set_calibration(self.pad, self.calibration)


@dataclass(frozen=True, slots=True)
class EvidenceEvent:
    """Forces of a pad are unreliable until there is evidence again: the calibration was set by hand."""

    kind: ClassVar[str] = "evidence"
    pad: int

    def apply(self, target: EventTarget) -> None:
        target.tick.sheet_force.reset_evidence(self.pad)


@dataclass(frozen=True, slots=True)
class ReplacementEvent:
    """Node and sheet of a pad were replaced: what was learned of them is forgotten."""

    kind: ClassVar[str] = "replacement"
    pad: int

    def apply(self, target: EventTarget) -> None:
        target.tick.reset_pad(self.pad)


@dataclass(frozen=True, slots=True)
class BackForceEvent:
    """Back force of a pad's sheet and its standard deviation [N], and what was learned of its behaviour
    (`SheetForceCompensation.learned_of`; empty: unknown), from a store."""

    kind: ClassVar[str] = "back_force"
    pad: int
    back_n: float
    std_n: float
    learned: tuple[float, ...] = ()

    def apply(self, target: EventTarget) -> None:
        target.tick.sheet_force.set_back_force(self.pad, self.back_n, self.std_n, self.learned)


@dataclass(frozen=True, slots=True)
class ModelEvent:
    """A reloaded deployment, in the latest `config`, changed these pads."""

    kind: ClassVar[str] = "model"
    pads: tuple[int, ...]

    def apply(self, target: EventTarget) -> None:
        target.apply_next_model(np.array(self.pads, dtype=np.intp))


@dataclass(frozen=True, slots=True)
class ExcitationEvent:
    """Pads (n,) whose sheet has its potential."""

    kind: ClassVar[str] = "excitation"
    on: tuple[bool, ...]

    def apply(self, target: EventTarget) -> None:
        target.tick.sheet_force.set_excitation(np.array(self.on))
        target.tick.second.set_excitation(np.array(self.on))


@dataclass(frozen=True, slots=True)
class DemandEvent:
    """Outputs that scenes and subscriptions request, each (n,)."""

    kind: ClassVar[str] = "demand"
    position: tuple[bool, ...]
    force: tuple[bool, ...]
    interval_ticks: tuple[int, ...]
    palm: tuple[bool, ...]
    base: tuple[bool, ...]
    motion: tuple[bool, ...]
    ticks_per_hand_frame: int

    @classmethod
    def of(cls, requested: RequestedOutputs, ticks_per_hand_frame: int) -> DemandEvent:
        """Return the event that requests these outputs."""
        position, force, interval, palm, base = (tuple(column.tolist()) for column in requested[:5])
        motion = tuple(requested.motion.tolist())
        return cls(
            position=position,
            force=force,
            interval_ticks=interval,
            palm=palm,
            base=base,
            motion=motion,
            ticks_per_hand_frame=ticks_per_hand_frame,
        )

    def apply(self, target: EventTarget) -> None:
        target.tick.set_requested(
            np.array(self.position), np.array(self.force), np.array(self.interval_ticks, dtype=np.int64)
        )
        target.tick.slip.set_requested(np.array(self.motion))
        target.tick.state.ticks_per_hand_frame[0] = self.ticks_per_hand_frame
        target.transforms.set_requested(np.array(self.palm), np.array(self.base))


@dataclass(frozen=True, slots=True)
class SamplingEvent:
    """Sampling of the pads (n,): by SYNC, longest regular time between samples; and pads (k,) that changed,
    whose first sample is awaited from now on."""

    kind: ClassVar[str] = "sampling"
    synchronous: tuple[bool, ...]
    max_sample_period_ns: tuple[int, ...]
    changed: tuple[int, ...]

    def apply(self, target: EventTarget) -> None:
        state = target.tick.state
        state.synchronous[:] = self.synchronous
        state.max_sample_period_ns[:] = self.max_sample_period_ns
        state.silent_ns[list(self.changed)] = 0


@dataclass(frozen=True, slots=True)
class GravityEvent:
    """Gravity less acceleration in each link's frame (n, 3), in units of gravity, NaN where unknown."""

    kind: ClassVar[str] = "gravity"
    felt: tuple[tuple[float, float, float], ...]

    def apply(self, target: EventTarget) -> None:
        target.tick.baseline.set_felt_gravity(np.array(self.felt))


@dataclass(frozen=True, slots=True)
class ForceEvent:
    """Forces on pads (k,), measured by another sensor [N]."""

    kind: ClassVar[str] = "force"
    pads: tuple[int, ...]
    force_n: tuple[float, ...]
    std_n: tuple[float, ...]
    measured_ns: int

    def apply(self, target: EventTarget) -> None:
        pads = np.array(self.pads, dtype=np.intp)
        target.tick.update_force_gains(
            ForceReference(pads, np.array(self.force_n), np.array(self.std_n), self.measured_ns)
        )


_EVENTS: dict[str, type[Any]] = {
    event.kind: event
    for event in (
        BaselineEvent,
        CalibrationEvent,
        EvidenceEvent,
        ReplacementEvent,
        BackForceEvent,
        ModelEvent,
        ExcitationEvent,
        DemandEvent,
        SamplingEvent,
        GravityEvent,
        ForceEvent,
    )
}


def encode_event(event: Event) -> dict[str, Any]:
    """Return an event as a map of msgpack values: its kind, and its fields by name."""
    return {"kind": event.kind, **asdict(event)}  # type: ignore[call-overload]


def decode_event(recorded: Mapping[str, Any]) -> Event:
    """Return a recorded event. Raises ValueError for one that this version doesn't know."""
    try:
        content = dict(recorded)
        kind = content.pop("kind")
        event: Event = _adapter(kind).validate_json(json.dumps(content))  # lists become tuples
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"unknown event {str(recorded)[:80]}: {error}") from error
    return event


def encode_calibration(calibration: ActiveCalibration) -> dict[str, Any]:
    """Return a calibration as msgpack values."""
    return asdict(calibration)


def decode_calibration(recorded: Any) -> ActiveCalibration:
    """Return a recorded calibration. Raises ValueError for an invalid one."""
    calibration: ActiveCalibration = TypeAdapter(ActiveCalibration).validate_json(json.dumps(recorded))
    return calibration


@cache
def _adapter(kind: str) -> TypeAdapter[Any]:
    return TypeAdapter(_EVENTS[kind])
