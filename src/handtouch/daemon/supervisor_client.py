"""The daemon's side of supervision: sends blocks of ticks to the supervisor process and applies its results.

Public name: `SupervisorClient`. Everything here runs in the hot thread; `ChildProcess` runs the process.
A replaced node is quarantined here at once, whether the supervisor process is running or not.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch.calibration.calibration import LearnedParts, channel_values
from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.canbus.nodes.master import Master
from handtouch.canbus.nodes.spec import NodeEvent, SerialChanged
from handtouch.config import Deployment
from handtouch.core.active_calibration import ActiveCalibration
from handtouch.core.events import (
    BackForceEvent,
    BaselineEvent,
    ExcitationEvent,
    ReplacementEvent,
)
from handtouch.core.pipeline import Pipeline
from handtouch.daemon.block_buffer import BlockBuffer
from handtouch.daemon.child_process import ChildProcess, child_statistics
from handtouch.daemon.excitation import ExcitationSchedule
from handtouch.supervisor.ipc import (
    CalibrationAssessment,
    CalibrationUpdate,
    ManualCalibration,
    NodeSerials,
    WorkerMessage,
    WorkerMessageError,
    WorkerStatus,
    pack_message,
    unpack_worker_message,
)
from handtouch.wire.faults import FaultKind
from handtouch.wire.health import Diagnosis

_UNKNOWN_LOG_GAIN_STD = 0.05
"""Standard deviation of the log gains of an unknown sensor"""
_MANUAL_LOG_GAIN_STD = 0.01
"""Standard deviation of manually set log gains: the error of measuring them with known currents"""
_EXCITATION_OFF_TEXT = (
    "excitation off: the sheet has adapted to load and hides light touches; no contacts until another pad of "
    "the hand is touched, or other pads take their turn"
)
_IDENTIFIED_STATES = (NodeState.CONFIGURING, NodeState.OPERATIONAL)
"""States in which the identity of a node is known"""
_POSITION_UNKNOWN_LOG_GAIN_STD = 0.5
"""Standard deviation where a fault makes positions invalid: about the size of the pad"""
_log = logging.getLogger("handtouch.supervisor")


class SupervisorClient:
    """Call `process_tick` after every tick, and `handle_node_events` with the events of nodes. Times in ns.

    `store`: path of the calibration store. `assessments`: the latest assessment of each pad by the supervisor
    process, None before the first.
    `malformed` counts its invalid messages, `late` those about a node that has been replaced since.
    `on_excitation_changed` is called with the time when `excitation.off` has changed.
    """

    def __init__(
        self,
        deployment: Deployment,
        pipeline: Pipeline,
        master: Master,
        store: str,
        process: ChildProcess | None = None,
        on_excitation_changed: Callable[[int], None] = lambda _: None,
    ) -> None:
        self._pipeline, self._master = pipeline, master
        self.store = store
        self._set_deployment(deployment)
        self.process = process or ChildProcess(
            "handtouch.supervisor.child",
            "supervisor",
            lambda: self.deployment.model_dump_json(by_alias=True).encode(),
        )
        self.assessments: list[CalibrationAssessment | None] = [None] * pipeline.model.size
        self.malformed = self.late = 0
        self.changed_pads: set[int] = set()
        """pads whose health has changed; cleared by the reporter when it is published"""
        self._needed_pads = np.ones(pipeline.model.size, dtype=np.bool_)
        self._on_excitation_changed = on_excitation_changed
        rows = pipeline.model.rows_of_hand.values()
        self.excitation = ExcitationSchedule(
            rows, pipeline.model.size, deployment.scene.excitation_off_after_s
        )
        self._position_unreliable = np.zeros(pipeline.model.size, dtype=np.bool_)
        self._degrading_kinds: list[tuple[str, ...]] = [()] * pipeline.model.size
        """of each pad, kinds of the diagnoses that invalidate force or position"""
        self._dead_electrodes: list[int | None] = [None] * pipeline.model.size
        self._log_gain_covariance: list[NDArray[np.float64] | None] = [None] * pipeline.model.size
        self._parts: list[LearnedParts | None] = [None] * pipeline.model.size
        """of each pad; None: as the deployment states"""
        self._block_buffer = BlockBuffer(pipeline.model.size, pipeline.model.channels)
        self._serials: list[int | None] = [None] * pipeline.model.size
        self._previous_serials: list[int | None] = [pad.serial for _, pad in self._pads]
        self._manual_parts: dict[int, set[str]] = {}
        """pad -> manually set parts of its calibration"""
        self._unconfirmed_calibrations: dict[int, str] = {}
        """pad -> calibration id sent to the supervisor process and not yet confirmed"""
        self._last_sent_sync_ns = 0
        self._worker_status: WorkerStatus | None = None

    def set_needed_pads(self, needed: NDArray[np.bool_]) -> None:
        """Set the pads (n,) that a scene needs."""
        self._needed_pads = needed

    @property
    def active_pads(self) -> NDArray[np.bool_]:
        """Pads (n,) that a scene needs and whose excitation is on."""
        return np.asarray(self._needed_pads & ~self.excitation.off)

    def start(self, now_ns: int) -> None:
        """Start the supervisor process."""
        self.process.start(now_ns)

    def restart_with(self, deployment: Deployment, now_ns: int) -> None:
        """Restart the supervisor process with a reloaded deployment."""
        self._set_deployment(deployment)
        self.process.restart(now_ns)

    def close(self) -> None:
        """Stop the supervisor process."""
        self.process.close()

    def handle_node_events(self, events: Sequence[NodeEvent | SerialChanged], now_ns: int) -> None:
        """Update the serial numbers after node events; quarantine pads whose node was replaced."""
        if not any(
            isinstance(event, SerialChanged) or event.new_state in _IDENTIFIED_STATES for event in events
        ):
            return
        replaced = [event for event in events if isinstance(event, SerialChanged)]
        known = [
            None if status.state == NodeState.FAULTED else status.serial for status in self._master.status()
        ]  # a node that was refused is none of the pad's
        for event in replaced:
            if self._serials[event.slot] is None:
                self._serials[event.slot] = event.old_serial
            if event.new_serial is None:
                known[event.slot] = 0  # a node without a serial number
        for pad, (before, after) in enumerate(zip(self._serials, known, strict=True)):
            if after is None or after == before:
                continue
            if before is not None:
                self._previous_serials[pad] = before
            self._serials[pad] = after
            self.assessments[pad] = None
            if self._previous_serials[pad] is not None and self._previous_serials[pad] != after:
                self._quarantine_pad(pad)
        self._send_serials(now_ns)

    def register_manual_calibration(
        self, pad: int, parts: Collection[str], offset_counts: Sequence[float] | None = None
    ) -> None:
        """Forward manually set parts (gains, law, offset_counts) of a calibration to the supervisor process.

        Gains and law are sent again whenever it restarts. They apply until the daemon ends, the node is
        replaced, or automatic calibration estimates better gains.
        """
        if "gains" in parts:
            self._log_gain_covariance[pad] = self._covariance_of(pad, _MANUAL_LOG_GAIN_STD)
            self._parts[pad] = None
            self._update_uncertainty(pad, self._pipeline.calibrations[pad].quarantined)
        self._manual_parts[pad] = self._manual_parts.get(pad, set()) | set(parts)
        self._send_manual_calibration(pad, offset_counts)
        self._manual_parts[pad].discard("offset_counts")  # the baseline tracks them from now on

    def process_tick(self, now_ns: int) -> None:
        """Add a tick to the block; send complete blocks and apply the results that were received."""
        touching = self._pipeline.tick.state.touching
        if self.excitation.is_due(now_ns, touching):
            self._update_excitation(now_ns, touching)
        if self.process.pid is None:
            if self.process.poll(now_ns):
                self._block_buffer.clear()
                self._worker_status = None
                self._send_serials(now_ns)
            return
        block = self._block_buffer.add_tick(self._pipeline)
        if block is None:
            return
        if self.process.send(block.dump()):
            self._last_sent_sync_ns = int(block.sync_ns[-1])
        for data in self.process.receive(now_ns):
            self._handle_message(data)
        self.process.poll(now_ns)

    def statistics(self) -> dict[str, Any]:
        """Return the state of the supervisor process for the `service` message."""
        status = self._worker_status
        processed_ns = status.processed_ns if status else None
        return {
            **child_statistics(self.process, self._last_sent_sync_ns, processed_ns),
            "malformed": self.malformed,
            "late": self.late,
            "summary": status.summary if status else "",
            "store_error": status.store_error if status else "",
        }

    def health_fields(self, pad: int) -> dict[str, Any]:
        """Return the fields of `health` about calibration and diagnoses of a pad."""
        assessment = self.assessments[pad]
        calibration = self._pipeline.calibrations[pad]
        quarantined, calibration_id = calibration.quarantined, calibration.calibration_id
        excitation_off = (self._excitation_off_diagnosis(pad),) if self.excitation.off[pad] else ()
        if assessment is None:
            state = "quarantined" if quarantined else "default"
            return {"calibration_state": state, "calibration_id": calibration_id, "diagnoses": excitation_off}
        return {
            "calibration_state": assessment.calibration_state,
            "calibration_id": calibration_id,
            "calibration_progress": assessment.calibration_progress,
            "least_begin_threshold_n": self._least_begin_n(pad, assessment),
            "diagnoses": (*excitation_off, *(diagnosis.to_map() for diagnosis in assessment.diagnoses)),
        }

    def _least_begin_n(self, pad: int, assessment: CalibrationAssessment) -> float | None:
        """Return the force of the least threshold of a pad, None while it isn't known."""
        counts = assessment.least_begin_counts
        return None if counts is None else self._pipeline.model.centre_force(pad, counts)

    def _update_excitation(self, now_ns: int, touching: NDArray[np.bool_]) -> None:
        """Switch the excitation of fading sheets off, or on again."""
        sheet_force, schedule = self._pipeline.tick.sheet_force, self.excitation
        before = schedule.off.copy()
        if not schedule.update_schedule(
            now_ns,
            touching,
            self._needed_pads,
            sheet_force.back_force[0],
            self._pipeline.model.touch.begin_threshold_n,
        ):
            return
        self._pipeline.add_event(ExcitationEvent(tuple((~schedule.off).tolist())))
        for pad in np.flatnonzero(schedule.off != before).tolist():
            self._log_pad(pad, _EXCITATION_OFF_TEXT if schedule.off[pad] else "excitation on again")
            self.changed_pads.add(pad)
        self._on_excitation_changed(now_ns)

    # Details ----------------------------------------------------------------------------------------------

    def _set_deployment(self, deployment: Deployment) -> None:
        """Set the deployment, with the path of the store, that the supervisor process gets when it starts."""
        daemon = deployment.daemon.model_copy(update={"store": self.store})
        self.deployment, self._pads = deployment.model_copy(update={"daemon": daemon}), deployment.pads

    def _send_serials(self, now_ns: int) -> None:
        serials = NodeSerials(now=tuple(self._serials), before=tuple(self._previous_serials), sync_ns=now_ns)
        self.process.send(pack_message(serials))
        for pad in self._manual_parts:
            self._send_manual_calibration(pad)

    def _send_manual_calibration(self, pad: int, offset_counts: Sequence[float] | None = None) -> None:
        serial, given = self._serials[pad], self._manual_parts[pad]
        if serial is None or not given:
            return
        covariance = self._log_gain_covariance[pad]
        if covariance is None:
            count = self._channels(pad)
            covariance = self._pipeline.model.gain_covariance[pad, :count, :count]
        calibration = self._pipeline.calibrations[pad]
        message = CalibrationUpdate(
            pad=pad,
            serial=serial,
            calibration_id=calibration.calibration_id,
            gains=calibration.gains,
            covariance=tuple(covariance.ravel().tolist()),
            parts=self._parts[pad],
            offset_counts=channel_values(offset_counts) if offset_counts is not None else None,
            law=calibration.law if "law" in given else None,
            second_law=calibration.second_law if "law" in given else None,
        )
        if {"gains", "law"} & given:  # the supervisor process confirms these
            self._unconfirmed_calibrations[pad] = message.calibration_id
        self.process.send(pack_message(ManualCalibration(given=tuple(sorted(given)), update=message)))

    def _quarantine_pad(self, pad: int) -> None:
        """Discard the calibration of a pad whose node was replaced, until the new node is calibrated."""
        pipeline = self._pipeline
        default = pipeline.model.default_calibration(pad)
        self._log_gain_covariance[pad] = self._covariance_of(pad, _UNKNOWN_LOG_GAIN_STD)
        self._parts[pad] = None
        self._manual_parts.pop(pad, None)
        self._unconfirmed_calibrations.pop(pad, None)
        self._position_unreliable[pad], self._degrading_kinds[pad] = False, (FaultKind.NODE_REPLACED.value,)
        self._dead_electrodes[pad] = None
        self._set_calibration(pad, default, quarantined=True)
        pipeline.add_event(ReplacementEvent(pad))
        self.changed_pads.add(pad)
        _log.warning(
            "%s: node replaced (serial %s -> %s); quarantined until it is calibrated",
            self._pad_name(pad),
            self._previous_serials[pad],
            self._serials[pad],
            extra=self._log_fields(pad),
        )

    def _update_uncertainty(self, pad: int, quarantined: bool) -> None:
        self._set_calibration(pad, self._pipeline.calibrations[pad], quarantined)

    def _set_calibration(self, pad: int, calibration: ActiveCalibration, quarantined: bool) -> None:
        """Apply a calibration with what is known about its quality."""
        unreliable = bool(self._position_unreliable[pad])
        covariance = self._log_gain_covariance[pad]
        if unreliable:
            covariance = self._covariance_of(pad, _POSITION_UNKNOWN_LOG_GAIN_STD)
        self._pipeline.set_calibration(
            pad,
            replace(
                calibration,
                gain_covariance=None if covariance is None else tuple(covariance.ravel().tolist()),
                parts=None if unreliable else self._parts[pad],
                quarantined=quarantined,
                position_unreliable=unreliable,
                diagnoses=self._degrading_kinds[pad],
                dead_electrode=self._dead_electrodes[pad],
            ),
        )

    def _handle_message(self, data: bytes) -> None:
        """Apply a message of the supervisor process completely, or count and ignore it."""
        try:
            message = unpack_worker_message(data)
        except WorkerMessageError as error:
            self.malformed += 1
            _log.warning("supervisor process: malformed message: %s", error)
            return
        if isinstance(message, WorkerStatus):
            self._worker_status = message
        elif message.pad >= len(self._pads) or not self._has_channels(message):
            self.malformed += 1
        elif message.serial != self._serials[message.pad]:
            self.late += 1
        else:
            self._dispatch_message(message)

    def _dispatch_message(self, message: WorkerMessage) -> None:
        if isinstance(message, CalibrationUpdate):
            self._apply_calibration(message)
        elif isinstance(message, CalibrationAssessment):
            self._apply_assessment(message)

    def _apply_calibration(self, message: CalibrationUpdate) -> None:
        pipeline, pad, offsets = self._pipeline, message.pad, message.offset_counts
        if offsets is not None and max(map(abs, offsets)) > pipeline.model.max_counts[pad] / 2:
            self.malformed += 1
            return
        if self._unconfirmed_calibrations.get(pad) == message.calibration_id:
            del self._unconfirmed_calibrations[pad]
        elif pad not in self._unconfirmed_calibrations:  # newer knowledge replaces manual settings
            self._manual_parts.pop(pad, None)
        before = pipeline.calibrations[pad]
        kept = pipeline.model.default_calibration(pad) if message.new_sheet else before
        self._log_gain_covariance[pad], self._parts[pad] = None, message.parts
        if message.covariance is not None:
            self._log_gain_covariance[pad] = np.reshape(message.covariance, (len(message.gains), -1))
        calibration = replace(
            before,
            calibration_id=message.calibration_id,
            gains=message.gains,
            law=message.law or kept.law,
            second_law=message.second_law or kept.second_law,
        )
        self._set_calibration(pad, calibration, before.quarantined)
        if message.new_sheet:
            pipeline.add_event(ReplacementEvent(pad))
        if offsets is not None:
            pipeline.add_event(BaselineEvent(pad, offsets, message.offset_std or (0.0,) * len(offsets)))
        if message.back_n is not None:
            pipeline.add_event(BackForceEvent(pad, message.back_n, message.back_std_n, message.learned))
        self.changed_pads.add(pad)
        _log.info(
            "%s: calibration %s", self._pad_name(pad), message.calibration_id, extra=self._log_fields(pad)
        )

    def _apply_assessment(self, message: CalibrationAssessment) -> None:
        pad, before = message.pad, self.assessments[message.pad]
        self.assessments[pad] = message
        force_invalid = message.calibration_state in ("quarantined", "manual_required") or not all(
            diagnosis.force_valid for diagnosis in message.diagnoses
        )
        position_unreliable = not all(diagnosis.position_valid for diagnosis in message.diagnoses)
        kinds = tuple(f.kind for f in message.diagnoses if not (f.position_valid and f.force_valid))
        self._position_unreliable[pad], self._degrading_kinds[pad] = position_unreliable, kinds
        self._dead_electrodes[pad] = message.dead_electrode
        self._update_uncertainty(pad, force_invalid)
        known = {diagnosis.kind for diagnosis in before.diagnoses} if before else set()
        old_state = before.calibration_state if before else "default"
        for diagnosis in message.diagnoses:
            if diagnosis.kind not in known:
                self._log_pad(pad, f"{diagnosis.cause} ({diagnosis.evidence}); {diagnosis.remedy}")
        for kind in sorted(known - {diagnosis.kind for diagnosis in message.diagnoses}):
            self._log_pad(pad, f"{kind}: cleared", logging.INFO)
        if message.calibration_state != old_state:
            level = (
                logging.INFO if message.calibration_state in ("default", "calibrated") else logging.WARNING
            )
            self._log_pad(
                pad,
                f"calibration {old_state} -> {message.calibration_state}: {message.calibration_progress}",
                level,
            )
        if (old_state, known) != (
            message.calibration_state,
            {diagnosis.kind for diagnosis in message.diagnoses},
        ) or before is None:
            self.changed_pads.add(pad)

    def _channels(self, pad: int) -> int:
        return int(self._pipeline.model.electrode_counts[pad])

    def _has_channels(self, message: CalibrationUpdate | CalibrationAssessment) -> bool:
        """Return whether a message is about as many channels as its pad has."""
        if isinstance(message, CalibrationUpdate):
            return len(message.gains) == self._channels(message.pad)
        return message.dead_electrode is None or message.dead_electrode < self._channels(message.pad)

    def _covariance_of(self, pad: int, std: float) -> NDArray[np.float64]:
        """Return the covariance of log gains of a standard deviation; their sum is not observable."""
        count = self._channels(pad)
        return std**2 * (np.eye(count) - 1 / count)

    def _excitation_off_diagnosis(self, pad: int) -> dict[str, Any]:
        back_n = float(self._pipeline.tick.sheet_force.back_force[0][pad])
        diagnosis = Diagnosis(
            kind=FaultKind.SHEET_ADAPTED,
            cause="sheet has adapted to load",
            evidence=f"{back_n:.2f} N hidden, contacts begin at "
            f"{self._pipeline.model.touch.begin_threshold_n[pad]:.2f} N",
            remedy="excitation is off and no contact is detected: touch another pad to switch it on",
            since_ns=self._pipeline.cycle.sync_ns,
        )
        return diagnosis.to_map()

    def _log_pad(self, pad: int, text: str, level: int = logging.WARNING) -> None:
        _log.log(level, "%s: %s", self._pad_name(pad), text, extra=self._log_fields(pad))

    def _pad_name(self, pad: int) -> str:
        return f"{self._pads[pad][0]}/{self._pads[pad][1].link}"

    def _log_fields(self, pad: int) -> dict[str, Any]:
        return {"fields": {"hand": self._pads[pad][0], "link": self._pads[pad][1].link}}
