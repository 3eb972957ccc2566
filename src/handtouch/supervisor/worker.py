"""Work of the supervisor process, whose results may take seconds: calibration, storage, diagnosis.

Public: `SupervisorWorker`: messages of the daemon in, messages to it out (`ipc`). It calibrates nodes by
their contacts, stores calibrations and baselines, and diagnoses pads. No clock and no I/O but the store's.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Any

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.calibration.auto_calibration import AutoCalibrator
from handtouch.calibration.calibration import (
    NEW_SHEET_METHOD,
    CalibrationState,
    CalibrationVersion,
    Gains,
    Provenance,
    age_s,
    aged_gains,
    aged_offset_std,
    channel_values,
    matrix,
)
from handtouch.calibration.gains import PartModels
from handtouch.calibration.stationary_contacts import StationaryContactDetector
from handtouch.calibration.store_client import MountingPoint, StoreClient
from handtouch.calibration.store_schedule import StoreSchedule, restored_sheet
from handtouch.config import Deployment
from handtouch.core.least_threshold import least_begin_counts
from handtouch.core.pad_model import ampere_per_count_of, default_calibration_id_of, noise_counts_of
from handtouch.field.model import ChannelModel
from handtouch.hand import (
    channel_gain_std,
    network_parameters,
    pad_channels,
    part_stds,
)
from handtouch.supervisor.deployment_diagnostics import DeploymentDiagnostics
from handtouch.supervisor.ipc import (
    MAX_DIAGNOSES,
    MAX_TEXT,
    CalibrationAssessment,
    CalibrationUpdate,
    DaemonMessage,
    ManualCalibration,
    NodeSerials,
    SampleBlock,
    WorkerMessage,
    WorkerStatus,
)
from handtouch.supervisor.level_scatter import LevelScatter
from handtouch.wire.faults import FaultKind
from handtouch.wire.health import Diagnosis
from handtouch.wire.status import PadState

_log = logging.getLogger("handtouch.supervisor")
_STATUS_PERIOD_NS = 500_000_000
_STORE_POLL_PERIOD_NS = 2_000_000_000
"""Period of checks whether other processes have stored anything."""
_ZERO_SETTLING_NS = 60_000_000_000
"""Time in which the zero of static loads tracks the daemon's baseline, from a node's assignment on."""
_MAX_SETTLING_STEP_NS = 1_000_000_000
"""Greatest part of that time that passes from one block to the next, after a pause."""
_MAX_ZERO_CHANGE_SIGMA = 3.0
"""Greatest change of a channel's zero since it was stored; a greater one is a load."""

_MIN_THRESHOLD_CHANGE = 0.1
"""Least relative change of a least threshold that is reported."""

_SWITCHED = "electrodes share channels by switch_states: gains aren't learned, the pad isn't diagnosed"


@dataclass
class _PadEntry:
    """State of one pad."""

    mounting_point: MountingPoint
    calibrator: AutoCalibrator
    contact_detector: StationaryContactDetector
    channels: int
    is_switched: bool
    """its electrodes share channels by a schedule: their gains aren't independent, and aren't learned"""
    version_number: int = 0
    """number of the newest stored version of the node, 0 for none"""
    rejection_reason: str = ""
    """reason why a stored calibration isn't applied"""
    foreign_source: str = ""
    """origin of its calibration, if taken over from another node"""
    last_assessment: CalibrationAssessment | None = None
    least_begin_counts: float | None = None
    """as reported last"""
    stored_zero: tuple[FloatArray, FloatArray] | None = None
    """stored offsets (c,) of the node and their present standard deviations (c,), if any"""
    zero_settling_ns: int = 0
    """remaining time in which its zero tracks the daemon's baseline"""


class SupervisorWorker:
    """Processes the daemon's messages; `process_message` returns the messages for the daemon.

    The store is opened on first use.
    """

    def __init__(
        self, deployment: Deployment, store: StoreClient, diagnostics: DeploymentDiagnostics | None = None
    ) -> None:
        entries = deployment.pads
        models: dict[object, tuple[ChannelModel, PartModels, tuple[float, ...], float]] = {}
        self._pads = []
        most = max(len(pad.electrode_names) for _, pad in entries)
        self._ampere_per_count = np.zeros((len(entries), most))
        """(n, c) without any calibration, 0 beyond a pad's own channels"""
        for number, (hand, pad) in enumerate(entries):
            design, sheet = (network_parameters(pad), pad.sheet, pad.node), deployment.sheet_of(pad)
            node, scale = deployment.nodes[pad.node], np.array(ampere_per_count_of(pad, deployment))
            self._ampere_per_count[number, : len(scale)] = scale
            if design not in models:
                network = pad_channels(pad, sheet, node)
                parts = PartModels.of_pad(network, pad, node, sheet)
                stds, gain_std = part_stds(pad, node, sheet), channel_gain_std(pad, node)
                models[design] = network, parts, stds, gain_std
            mounting_point = MountingPoint(hand, pad.link, default_calibration_id_of(pad, deployment))
            detector = StationaryContactDetector(noise_counts_of(node) * scale)
            calibrator = AutoCalibrator(*models[design])
            self._pads.append(
                _PadEntry(mounting_point, calibrator, detector, len(scale), bool(pad.switch_states))
            )
        self._store, self._diagnostics = store, diagnostics
        self._store_schedule = StoreSchedule([row.channels for row in self._pads])
        self._level_scatter = LevelScatter([deployment.touch_of(pad).begin_ms for _, pad in entries])
        self._diagnoses: dict[int, list[Diagnosis]] = {}
        self._dead_electrodes: Mapping[int, int] = {}
        self._latest_sync_ns = self._status_sent_ns = self._store_polled_ns = 0

    def process_message(self, message: DaemonMessage, now: datetime) -> list[WorkerMessage]:
        """Process a message of the daemon; return the messages that follow."""
        messages: list[WorkerMessage] = []
        match message:
            case NodeSerials():
                self._latest_sync_ns = max(self._latest_sync_ns, message.sync_ns)
                self._assign_nodes(message.now, message.before, now, messages)
            case SampleBlock():
                self._process_block(message, now, messages)
            case ManualCalibration():
                self._apply_manual_calibration(message.update, message.given, messages)
        self._poll_store(now, messages)
        for pad in range(len(self._pads)):
            self._report_assessment(pad, messages)
        if self._latest_sync_ns - self._status_sent_ns >= _STATUS_PERIOD_NS:
            self._status_sent_ns = self._latest_sync_ns
            messages.append(
                WorkerStatus(
                    processed_ns=self._latest_sync_ns,
                    store_error=self._store.error[:MAX_TEXT],
                    summary=self._summary(),
                )
            )
        return messages

    def finish(self, now: datetime) -> None:
        """Store what isn't stored yet and close the store."""
        for pad, row in enumerate(self._pads):
            self._store_state(pad, row, now, last=True)
        self._store.close()

    # Calibration of nodes ---------------------------------------------------------------------------------

    def _assign_nodes(
        self,
        serials: Sequence[int | None],
        before: Sequence[int | None],
        now: datetime,
        messages: list[WorkerMessage],
    ) -> None:
        """Assign nodes to pads; a new node gets its stored calibration."""
        shared = Counter(serials)
        for pad, (row, serial) in enumerate(zip(self._pads, serials, strict=True)):
            obstacle = _obstacle(serial, shared)
            if serial is None or (
                serial == row.calibrator.serial and row.calibrator.can_learn == (not obstacle)
            ):
                continue
            last = before[pad] or self._store.last_serial_at(row.mounting_point, now)
            version = None
            if not obstacle:
                version, row.rejection_reason = self._store.newest_applicable(serial, row.mounting_point, now)
            own = aged_gains(version, now, row.calibrator.part_stds) if version else None
            row.version_number, row.foreign_source = 0, version.provenance.foreign if version else ""
            row.calibrator.assign_node(
                serial, last, own, obstacle, self._latest_sync_ns, foreign=bool(row.foreign_source)
            )
            self._store_schedule.reset_pad(pad)
            row.stored_zero, row.zero_settling_ns = None, _ZERO_SETTLING_NS
            row.least_begin_counts = None
            self._level_scatter.forget(pad)
            if self._diagnostics is not None:
                self._diagnostics.set_gains(pad, row.calibrator.gains)
                self._diagnostics.set_offsets(pad, np.zeros(row.channels))
            name = f"{row.mounting_point.hand}/{row.mounting_point.link}"
            _log.info(
                "%s: node with serial %d: calibration %s%s",
                name,
                serial,
                row.calibrator.calibration_state,
                f", version {version.number} of {version.written_utc}" if version else "",
            )
            if version is not None:
                messages.append(self._restore_calibration(pad, version, now))

    def _poll_store(self, now: datetime, messages: list[WorkerMessage]) -> None:
        """Apply what other processes have stored meanwhile: `calibrate`, a rollback, an import."""
        if self._latest_sync_ns - self._store_polled_ns < _STORE_POLL_PERIOD_NS:
            return
        self._store_polled_ns = self._latest_sync_ns
        if not self._store.changed(now):
            return
        for pad, row in enumerate(self._pads):
            if row.calibrator.serial is None or not row.calibrator.can_learn:
                continue
            version, row.rejection_reason = self._store.newest_applicable(
                row.calibrator.serial, row.mounting_point, now
            )
            if version is None or version.number == row.version_number:
                continue
            row.foreign_source = version.provenance.foreign
            if own := aged_gains(version, now, row.calibrator.part_stds):
                row.calibrator.apply_gains(own, foreign=bool(row.foreign_source))
            elif version.calibration.law and row.calibrator.force_unreliable:
                row.calibrator.accept_measured_law()
            else:
                row.calibrator.revert_to_default()
            if self._diagnostics is not None:
                self._diagnostics.set_gains(pad, row.calibrator.gains)
            messages.append(self._restore_calibration(pad, version, now))
            _log.info(
                "%s/%s: calibration %s stored by another process: applied",
                row.mounting_point.hand,
                row.mounting_point.link,
                version.calibration_id,
            )

    def _apply_manual_calibration(
        self, update: CalibrationUpdate, given: Sequence[str], messages: list[WorkerMessage]
    ) -> None:
        """Continue from an operator's calibration; send it again, as a stored one may have replaced it."""
        row = self._pads[update.pad]
        if update.serial != row.calibrator.serial:
            return
        if "gains" in given:
            row.foreign_source = ""
            covariance = np.reshape(update.covariance or (0.0,) * row.channels**2, (row.channels, -1))
            row.calibrator.apply_gains(Gains(update.gains, matrix(covariance), update.parts))
        if "law" in given:
            row.calibrator.accept_measured_law()
        if self._diagnostics is not None:
            if "gains" in given:
                self._diagnostics.set_gains(update.pad, row.calibrator.gains)
            if update.offset_counts is not None:
                self._diagnostics.set_offsets(update.pad, update.offset_counts)
                row.zero_settling_ns = 0
        if {"gains", "law"} & {*given}:
            messages.append(update)

    def _process_block(self, block: SampleBlock, now: datetime, messages: list[WorkerMessage]) -> None:
        elapsed_ns = min(int(block.sync_ns[-1]) - self._latest_sync_ns, _MAX_SETTLING_STEP_NS)
        self._latest_sync_ns = int(block.sync_ns[-1])
        self._update_zeros(block, elapsed_ns)
        self._update_diagnoses(block)
        self._update_thresholds(block)
        self._store_schedule.update_block(block)
        for pad in np.flatnonzero(block.contact_id.any(axis=0)).tolist():
            self._learn_from_contacts(pad, block, now, messages)
        for pad, row in enumerate(self._pads):
            self._store_state(pad, row, now)

    def _learn_from_contacts(
        self, pad: int, block: SampleBlock, now: datetime, messages: list[WorkerMessage]
    ) -> None:
        """Calibrate the node of a pad by the contacts in a block."""
        row = self._pads[pad]
        if row.is_switched or not row.calibrator.can_learn:
            return
        if pad in self._diagnoses:  # nothing is learnt from a faulty pad
            return
        fresh = block.fresh[:, pad]
        counts = block.counts[:, pad] - block.offset_counts[pad]
        currents = (counts * self._ampere_per_count[pad])[:, : row.channels]
        for sync_ns, contact_id, reading in zip(
            block.sync_ns[fresh].tolist(), block.contact_id[fresh, pad].tolist(), currents[fresh], strict=True
        ):
            contact = row.contact_detector.add_sample(contact_id, reading, sync_ns)
            if contact is None:
                continue
            gain_update = row.calibrator.add_contact(contact)
            version = self._store_gains(row, now) if gain_update.store else None
            if gain_update.apply:
                assert row.calibrator.serial is not None
                name = version.calibration_id if version else f"{row.calibrator.serial}-learning"
                messages.append(_calibration_update(pad, row.calibrator.serial, name, row.calibrator.gains))
                if self._diagnostics is not None:
                    self._diagnostics.set_gains(pad, row.calibrator.gains)

    def _store_gains(self, row: _PadEntry, now: datetime) -> CalibrationVersion | None:
        estimate, serial = row.calibrator.estimate, row.calibrator.serial
        assert serial is not None
        residual = estimate.misfit
        origin = Provenance("gains from contacts", contacts=estimate.contacts, residual=residual)
        version = self._record_stored(
            row, self._store.store_parts(serial, row.mounting_point, origin, now, gains=row.calibrator.gains)
        )
        name = f"{row.mounting_point.hand}/{row.mounting_point.link}"
        stored = f"stored as {version.calibration_id}" if version else "not stored"
        _log.info("%s: gains of node %d from contacts %s: %s", name, serial, stored, estimate.reason)
        return version

    def _store_state(self, pad: int, row: _PadEntry, now: datetime, last: bool = False) -> None:
        serial = row.calibrator.serial
        if (
            serial is None
            or not row.calibrator.can_learn
            or row.calibrator.sheet_replaced
            or row.calibrator.calibration_state not in (CalibrationState.DEFAULT, CalibrationState.CALIBRATED)
        ):
            return
        offsets, sheet = self._store_schedule.due_parts(pad, self._latest_sync_ns, last)
        if offsets is not None or sheet is not None:
            origin = Provenance("baseline and sheet state tracked")
            stored = self._store.store_parts(
                serial, row.mounting_point, origin, now, offsets=offsets, sheet=sheet
            )
            if self._record_stored(row, stored) is None:
                self._store_schedule.retry_pad(pad, self._latest_sync_ns)

    @staticmethod
    def _record_stored(row: _PadEntry, version: CalibrationVersion | None) -> CalibrationVersion | None:
        if version is not None:
            row.version_number, row.foreign_source = version.number, version.provenance.foreign
        return version

    def _restore_zero(self, pad: int, version: CalibrationVersion, now: datetime) -> None:
        """Make the offsets of a version the zero from which diagnostics detects static loads."""
        row, offsets = self._pads[pad], version.calibration.offsets
        if self._diagnostics is None or offsets is None or version.provenance.foreign:
            return
        row.stored_zero = np.array(offsets.counts), aged_offset_std(offsets, age_s(version, now))
        row.zero_settling_ns = _ZERO_SETTLING_NS
        self._diagnostics.set_offsets(pad, offsets.counts)

    def _update_zeros(self, block: SampleBlock, elapsed_ns: int) -> None:
        """Make the daemon's baselines the zeros of static loads, while these settle.

        A stored zero remains if its age doesn't explain the difference: the baseline may have tracked a load.
        Without a stored one, such as after a node was replaced, the baseline is all that is known.
        """
        for pad, row in enumerate(self._pads):
            if row.zero_settling_ns <= 0 or not np.isfinite(block.offset_std[pad]):
                continue
            row.zero_settling_ns -= elapsed_ns
            offset = block.offset_counts[pad, : row.channels]
            if row.stored_zero is not None:
                stored, std = row.stored_zero
                if (np.abs(offset - stored) > _MAX_ZERO_CHANGE_SIGMA * std).any():
                    continue
            if self._diagnostics is not None:
                self._diagnostics.set_offsets(pad, offset)

    def _restore_calibration(self, pad: int, version: CalibrationVersion, now: datetime) -> CalibrationUpdate:
        """Return the update of a pad to a stored version."""
        known, row = version.calibration, self._pads[pad]
        row.version_number = version.number
        self._restore_zero(pad, version, now)
        gains = row.calibrator.gains
        update = _calibration_update(pad, version.serial, version.calibration_id, gains)
        found: dict[str, Any] = {}
        if not known.gains and row.calibrator.calibration_state is CalibrationState.DEFAULT:
            found = {
                "gains": (1.0,) * row.channels,
                "covariance": None,
                "parts": None,
            }  # as in the deployment file
        if known.offsets:
            found["offset_counts"] = known.offsets.counts
            found["offset_std"] = channel_values(np.sqrt(known.offsets.variance))
        if version.provenance.method == NEW_SHEET_METHOD:
            found["new_sheet"] = True
            self._store_schedule.reset_pad(pad)  # what is due is of the old sheet
        for name in ("law", "second_law"):
            if law := getattr(known, name):
                found[name] = law
        if sheet := restored_sheet(version, age_s(version, now)):
            found |= sheet._asdict()
        return update.model_copy(update=found)

    # Reports ----------------------------------------------------------------------------------------------

    def _update_diagnoses(self, block: SampleBlock) -> None:
        self._diagnoses = {}
        for pad, diagnosis in self._diagnostics.process_block(block) if self._diagnostics else ():
            self._diagnoses.setdefault(pad, []).append(diagnosis)
        if self._diagnostics is not None:
            self._dead_electrodes = self._diagnostics.dead_electrodes()

    def _update_thresholds(self, block: SampleBlock) -> None:
        """Measure how low contacts may begin; what hardly changes is kept, so that it isn't reported."""
        usable = block.fresh & (block.pad_state == int(PadState.CLEAR)) & ~np.isnan(block.offset_std)
        levels = (block.counts - block.offset_counts).sum(axis=2)
        self._level_scatter.add_block(block.sync_ns, levels, usable, block.contact_id != 0)
        rate = self._level_scatter.samples_per_s
        for row, scatter in zip(self._pads, self._level_scatter.counts.tolist(), strict=True):
            if scatter > 0:
                now, before = least_begin_counts(scatter, rate), row.least_begin_counts
                if before is None or abs(now - before) > _MIN_THRESHOLD_CHANGE * before:
                    row.least_begin_counts = now

    def _report_assessment(self, pad: int, messages: list[WorkerMessage]) -> None:
        """Report the assessment of a pad, if it changed."""
        row = self._pads[pad]
        progress = row.calibrator.progress
        if row.is_switched:
            progress = _SWITCHED
        if row.rejection_reason:
            progress = f"{row.rejection_reason}; {progress}"
        diagnoses = (*row.calibrator.diagnoses, *self._store_diagnoses(row), *self._diagnoses.get(pad, ()))
        assessment = CalibrationAssessment(
            pad=pad,
            serial=row.calibrator.serial,
            calibration_state=row.calibrator.calibration_state,
            calibration_progress=progress[:MAX_TEXT],
            diagnoses=tuple(map(_shorten, diagnoses[:MAX_DIAGNOSES])),
            dead_electrode=self._dead_electrodes.get(pad),
            least_begin_counts=row.least_begin_counts,
        )
        if row.calibrator.serial is not None and assessment != row.last_assessment:
            row.last_assessment = assessment
            messages.append(assessment)

    def _store_diagnoses(self, row: _PadEntry) -> tuple[Diagnosis, ...]:
        """Return the diagnosis of a calibration from another node, or of an unavailable store."""
        if row.foreign_source:
            return (
                Diagnosis(
                    kind=FaultKind.FOREIGN_CALIBRATION,
                    cause="the active calibration was taken over from another node",
                    evidence=row.foreign_source,
                    remedy="return to an older one with `handtouch calibrations rollback`, or measure it "
                    "with `handtouch calibrate`",
                    since_ns=row.calibrator.since_ns,
                ),
            )
        if (
            not self._store.error
            or row.calibrator.calibration_state is CalibrationState.CALIBRATED
            or not row.calibrator.can_learn
        ):
            return ()
        return (
            Diagnosis(
                kind=FaultKind.STORE_UNAVAILABLE,
                cause="the stored calibration of this node can't be read",
                evidence=self._store.error,
                remedy="repair the store; until then, the deployment file's calibration applies, and the "
                "node is calibrated again by contacts",
                since_ns=row.calibrator.since_ns,
            ),
        )

    def _summary(self) -> str:
        counts = Counter(
            row.calibrator.calibration_state.value for row in self._pads if row.calibrator.serial is not None
        )
        return ", ".join(f"{count} {state}" for state, count in sorted(counts.items())) or "no nodes yet"


def _shorten(diagnosis: Diagnosis) -> Diagnosis:
    return replace(
        diagnosis,
        cause=diagnosis.cause[:MAX_TEXT],
        evidence=diagnosis.evidence[:MAX_TEXT],
        remedy=diagnosis.remedy[:MAX_TEXT],
    )


def _calibration_update(pad: int, serial: int, name: str, gains: Gains) -> CalibrationUpdate:
    covariance = tuple(value for row in gains.covariance for value in row)
    return CalibrationUpdate(
        pad=pad,
        serial=serial,
        calibration_id=name,
        gains=gains.factors,
        covariance=covariance,
        parts=gains.parts,
    )


def _obstacle(serial: int | None, shared: Counter[int | None]) -> str:
    """Return the reason why a node can't be calibrated by contacts; empty if it can."""
    if not serial:
        return "no calibration by contacts: the node has no serial number (object 0x1018 sub 4)"
    if shared[serial] > 1:
        return (
            f"no calibration by contacts: {shared[serial]} nodes have the serial number {serial}; assign "
            "unique ones"
        )
    return ""
