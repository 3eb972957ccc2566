"""Automatic calibration of the node of one pad by ordinary contacts.

Public: `AutoCalibrator`, `GainUpdate`, `new_gain_estimator`. A node that replaced another
is in quarantine until it has a calibration of its own: from the store, from contacts, or from an operator. No
clock; time is an argument.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.calibration.calibration import (
    MAX_GAIN,
    MIN_GAIN,
    CalibrationState,
    Gains,
    LearnedParts,
    channel_values,
    drifted_gains,
    matrix,
)
from handtouch.calibration.gains import (
    BATCH_CONTACTS,
    MAX_SHAPE_DEVIATION,
    NO_PARTS,
    GainEstimator,
    GainStatus,
    PartModels,
)
from handtouch.calibration.stationary_contacts import StationaryContact
from handtouch.field.model import ForwardModel
from handtouch.wire.faults import FaultKind
from handtouch.wire.health import Diagnosis

_INITIAL_LOG_GAIN_STDS = (0.05, 0.2)
"""Initial standard deviation of log gains; the next one if no gains near these explain the contacts."""
_CONTACTS_PER_UPDATE = BATCH_CONTACTS // 2
"""Contacts passed to the estimator together: one by one they take several times as long."""
_MIN_CONTACTS_TO_STORE_AGAIN = 4 * BATCH_CONTACTS
"""Contacts after which gains known before are stored again; then twice as many each time."""
_MAX_CALIBRATED_LOG_GAIN_STD = 0.02
"""Standard deviation of the least certain log gain of a calibrated node. In this direction gains hardly
change a position: by 0.3 to 0.5 % of the pad's length, rms, from 1:1 to 2:1."""
_MODEL_ERROR, _MODEL_ERROR_WITHOUT_PARTS = 5e-5, 5e-4
"""Standard deviation of the fractions by what neither gains nor parts with tolerances explain."""
_MIN_REPORTED_WIDENING = 3.0
"""Deviation of a pad's leads, over that stated, from which on they are reported: four leads as stated have it
in 1 of 10^6 pads."""
_MANUAL_REMEDY = "measure them with `handtouch calibrate`"


@dataclass(frozen=True)
class GainUpdate:
    """Consequence of contacts: apply the gains; store them, too."""

    apply: bool = False
    store: bool = False


def new_gain_estimator(
    model: ForwardModel,
    attempt: int = 0,
    own: Gains | None = None,
    parts: PartModels = NO_PARTS,
    gain_std: float | None = None,
) -> GainEstimator:
    """Return the estimator of a pad's gains, about gains of its `own` or the deployment's.

    `attempt`: 0, then 1, with a wider prior, where no gains near these explain the contacts.
    """
    return GainEstimator(
        model,
        tolerance=_INITIAL_LOG_GAIN_STDS[attempt],
        model_error=_MODEL_ERROR if parts.models else _MODEL_ERROR_WITHOUT_PARTS,
        required_std=_MAX_CALIBRATED_LOG_GAIN_STD,
        gain_std=gain_std if attempt == 0 else None,
        known=own,
        parts=parts,
    )


class AutoCalibrator:
    """Calibration state and gain estimate of the node at one pad.

    model: the pad's. parts: those that differ from pad to pad; part_stds: their standard deviations.
    gain_std: of the logarithm of a gain, as stated.
    """

    def __init__(
        self,
        model: ForwardModel,
        parts: PartModels = NO_PARTS,
        part_stds: Sequence[float] = (),
        gain_std: float | None = None,
    ) -> None:
        self._model, self._parts, self.part_stds = model, parts, tuple(part_stds)
        self._gain_std = gain_std
        self._part_limits = np.broadcast_to(np.asarray(parts.limits, np.float64), len(parts.models))
        self.serial: int | None = None
        self.calibration_state = CalibrationState.DEFAULT
        self.can_learn = False
        """contacts can calibrate this node"""
        self._obstacle = ""
        self._quarantine_cause: tuple[FaultKind, str] = (FaultKind.NODE_REPLACED, "")
        self._pending: list[StationaryContact] = []
        self.since_ns, self._attempt, self._store_at_contacts = 0, 0, 0
        self._has_own_gains = False  # the estimate started from gains of its own
        self._mean_gain = 1.0  # geometric mean, not observable by contacts
        self._sheet_test: SheetTest | None = None
        self._estimator = new_gain_estimator(model, parts=parts, gain_std=gain_std)
        self.estimate = self._estimator.estimate

    def assign_node(
        self,
        serial: int,
        before: int | None,
        own: Gains | None,
        obstacle: str,
        now_ns: int,
        *,
        foreign: bool = False,
    ) -> None:
        """Assign a node to the pad.

        before: serial number of the previous node, None if unknown. own: stored gains. obstacle: reason why
        contacts can't calibrate it; empty without one. foreign: the gains were taken over from another node.
        """
        self.serial, self.can_learn, self._obstacle = serial, not obstacle, obstacle
        self.since_ns = now_ns
        replaced = before is not None and before != serial
        self._quarantine_cause = FaultKind.NODE_REPLACED, f"node replaced: serial {before} -> {serial}"
        self._restart_estimator(0, own)
        if own and not foreign:
            self.calibration_state = CalibrationState.CALIBRATED
        elif replaced and not foreign:
            self.calibration_state = CalibrationState.QUARANTINED
        else:
            self.calibration_state = CalibrationState.DEFAULT
        self._require_manual_if_unobservable()

    def apply_gains(self, own: Gains, *, foreign: bool = False) -> None:
        """Restart from gains that an operator set, or rolled back to."""
        self._restart_estimator(0, own)
        self.calibration_state = CalibrationState.DEFAULT if foreign else CalibrationState.CALIBRATED

    def accept_measured_law(self) -> None:
        """Release a node from quarantine, as its contact law was measured, which determines forces."""
        if self.force_unreliable:
            self.calibration_state = CalibrationState.CALIBRATED

    def revert_to_default(self) -> None:
        """Restart from the deployment file's gains, unless the node is in quarantine."""
        if not self.force_unreliable:
            self._restart_estimator(0)
            self.calibration_state = CalibrationState.DEFAULT

    def add_contact(self, contact: StationaryContact) -> GainUpdate:
        """Add a stationary contact; return what to do with the gains."""
        if not self.can_learn or self._estimator.shape_deviation > MAX_SHAPE_DEVIATION:
            return GainUpdate()
        self._pending.append(contact)
        if len(self._pending) < _CONTACTS_PER_UPDATE:
            return GainUpdate()
        contacts, self._pending = self._pending, []
        before = self.estimate.contacts
        currents = np.transpose([one.currents for one in contacts])
        noise = np.transpose([one.noise for one in contacts])
        batch = currents, noise, contact.last_sync_ns, [one.touch for one in contacts]
        if (
            self._sheet_test is None
            and self.calibration_state is CalibrationState.CALIBRATED
            and self.part_stds
        ):
            self._sheet_test = SheetTest(self.gains, self._new_estimator)
        self._estimator.add_contacts(*batch)
        self.estimate = self._estimator.estimate
        if self._test_sheet(*batch):
            return GainUpdate(apply=True)
        if self.estimate.contacts == before:
            return GainUpdate()
        self._check_gain_limits()
        return self._assess_estimate(contact.last_sync_ns)

    def _test_sheet(
        self, currents: FloatArray, noise: FloatArray, now_ns: int, touches: Sequence[int]
    ) -> bool:
        """Test whether contacts (c, n) are on the calibrated sheet; return whether that has changed.

        While they aren't, the estimate is that of another sheet on the same node.
        """
        if self._sheet_test is None:
            return False
        test, before = self._sheet_test, self._sheet_test.is_replaced
        estimator = test.add_contacts(currents, noise, now_ns, touches)
        if test.is_replaced and not before:
            self._estimator = estimator
        elif before and not test.is_replaced:
            self._restart_estimator(0, test.known)
        elif test.is_finished:
            self._sheet_test = None
        self.estimate = self._estimator.estimate
        return before != test.is_replaced

    def _new_estimator(self, own: Gains) -> GainEstimator:
        return new_gain_estimator(self._model, 0, own, self._parts, self._gain_std)

    @property
    def sheet_replaced(self) -> bool:
        """Return whether contacts are on another sheet than the calibrated one, probably."""
        return self._sheet_test is not None and self._sheet_test.is_replaced

    @property
    def force_unreliable(self) -> bool:
        """Return whether forces are unreliable."""
        return self.calibration_state in (CalibrationState.QUARANTINED, CalibrationState.MANUAL_REQUIRED)

    @property
    def gains(self) -> Gains:
        """Return the gains estimated by contacts and stored values, with the pad's parts."""
        found, parts = self.estimate, None
        if self.part_stds:
            offsets = tuple(found.part_offsets.tolist())
            parts = LearnedParts(self.part_stds, offsets, matrix(found.joint_covariance), found.touch_error)
        factors = channel_values(self._mean_gain * found.gains)
        return Gains(factors, matrix(found.covariance), parts)

    @property
    def progress(self) -> str:
        """Return the progress of calibration by contacts as text."""
        if self._obstacle:
            return self._obstacle
        if self.serial is None:
            return ""
        if (
            self.calibration_state is CalibrationState.CALIBRATED
            and self._has_own_gains
            and not self.estimate.contacts
        ):
            return f"gains set or stored, known to {100 * self.estimate.std:.2g} %; contacts refine them"
        return f"gains {self.estimate.status}: {self.estimate.reason}{self._found_leads}"

    @property
    def _found_leads(self) -> str:
        """Resistances of leads beyond what the deployment states, as text; empty where they are as stated."""
        found, leads = self.estimate, np.flatnonzero(self._part_limits > 1)
        if found.status is not GainStatus.ESTIMATED or found.widening < _MIN_REPORTED_WIDENING:
            return ""
        stds = np.array(self.part_stds)[leads]
        ohm = found.part_offsets[leads] * stds
        std = np.sqrt(np.diag(found.joint_covariance)[len(found.gains) + leads]) * stds
        values = ", ".join(f"{value:.0f} +- {error:.0f}" for value, error in zip(ohm, std, strict=True))
        return (
            f"; from its electrodes to their channels are {values} ohm besides series_ohm, "
            f"{stds.max():.2g} stated (series_std_ohm): check leads and plugs; positions allow for it"
        )

    @property
    def diagnoses(self) -> tuple[Diagnosis, ...]:
        """Return the diagnosis of a node in quarantine, or of a new sheet: cause and remedy."""
        if self._sheet_test is not None and self._sheet_test.is_replaced:
            return (self._sheet_test.diagnosis,)
        if not self.force_unreliable:
            return ()
        kind, cause = self._quarantine_cause
        if self.calibration_state is CalibrationState.MANUAL_REQUIRED:
            reason = self._obstacle or self.estimate.reason
            remedy = f"contacts can't calibrate it: {_MANUAL_REMEDY}"
        else:
            reason = self.estimate.reason
            remedy = (
                "ordinary contacts calibrate it: touch the pad all over with different forces; until then "
                "its forces are invalid and its positions less certain"
            )
        evidence = f"no calibration of its own is stored; {reason}"
        since_ns = self.since_ns
        return (
            Diagnosis(
                kind=kind, cause=cause, evidence=evidence, remedy=remedy, since_ns=since_ns, force_valid=False
            ),
        )

    def _check_gain_limits(self) -> None:
        """Reject gains out of range, which contacts that are no points can lead to."""
        lowest, highest = (self._mean_gain * limit(self.estimate.gains) for limit in (np.min, np.max))
        if lowest >= MIN_GAIN and highest <= MAX_GAIN:
            return
        reason = (
            f"gains from {lowest:.2g} to {highest:.2g} would explain its contacts, beyond any amplifier's "
            f"({MIN_GAIN:g} to {MAX_GAIN:g}): the pad isn't as configured, or several objects touch it "
            "at once"
        )
        self.estimate = replace(self.estimate, status=GainStatus.INVALID, reason=reason)

    def _assess_estimate(self, now_ns: int) -> GainUpdate:
        """Update the state after a batch of contacts."""
        status = self.estimate.status
        if status is GainStatus.INVALID:
            return self._reject_gains(now_ns)
        if status is GainStatus.UNDETERMINED:
            return GainUpdate(apply=self.force_unreliable or self.sheet_replaced)
        newly_calibrated = self.calibration_state is not CalibrationState.CALIBRATED
        if not newly_calibrated and self.estimate.contacts < self._store_at_contacts:
            return GainUpdate()
        self._store_at_contacts = 2 * self.estimate.contacts
        self.calibration_state = CalibrationState.CALIBRATED
        return GainUpdate(apply=True, store=not self.sheet_replaced)

    def _reject_gains(self, now_ns: int) -> GainUpdate:
        """Restart, or enter quarantine, as no gains near these explain the contacts."""
        reason = self.estimate.reason
        if self.calibration_state in (CalibrationState.CALIBRATED, CalibrationState.DEFAULT):
            self.calibration_state, self.since_ns = CalibrationState.QUARANTINED, now_ns
            self._quarantine_cause = FaultKind.GAINS_CHANGED, f"its gains have changed: {reason}"
            self._restart_estimator(0)
        elif self._attempt + 1 < len(_INITIAL_LOG_GAIN_STDS):
            self._restart_estimator(self._attempt + 1)
        else:
            self.calibration_state = CalibrationState.MANUAL_REQUIRED
            self._restart_estimator(0)  # and retry
        self._require_manual_if_unobservable()
        return GainUpdate(apply=True)

    def _require_manual_if_unobservable(self) -> None:
        if self.calibration_state is CalibrationState.QUARANTINED and (
            self._estimator.shape_deviation > MAX_SHAPE_DEVIATION or self._obstacle
        ):
            self.calibration_state = CalibrationState.MANUAL_REQUIRED

    def _restart_estimator(self, attempt: int, own: Gains | None = None) -> None:
        self._attempt, self._pending, self._has_own_gains = attempt, [], own is not None
        self._mean_gain = math.exp(np.log(own.factors).mean()) if own else 1.0
        self._sheet_test = None
        self._estimator = new_gain_estimator(self._model, attempt, own, self._parts, self._gain_std)
        self.estimate = self._estimator.estimate
        self._store_at_contacts = _MIN_CONTACTS_TO_STORE_AGAIN


_REPLACED_NATS = 14.0
"""Evidence of a new sheet that is reported: odds of 1.2e6, as for other faults that contacts show."""
_NATS_PER_LOGIT = 4.0
"""Evidence per logit of the stated confidence, as of other faults that contacts show."""
_MAX_NATS = 2 * _REPLACED_NATS
"""Bounds how long a diagnosis outlives a wrong one."""
_GAIN_STD = 0.001
"""What temperature adds to a log gain as known: 10 K of 1e-4 / K."""
_WINDOW_CONTACTS = 128
"""Contacts that are explained jointly: chosen, twice what shows most new sheets."""


class SheetTest:
    """Test by the contacts of a pad since its gains were `known`, with its parts.

    new_estimator: returns the estimator of a pad with given gains, and parts as the deployment states them.
    """

    def __init__(self, known: Gains, new_estimator: Callable[[Gains], GainEstimator]) -> None:
        assert known.parts is not None
        self.known, self._new_estimator = drifted_gains(known, 0.0, _GAIN_STD), new_estimator
        self._begin_ns: int | None = None
        self._since_ns = 0
        self._before_nats = self.nats = 0.0
        self.contacts = 0
        """since the contacts began to speak for a new sheet"""
        self.is_replaced = self.is_finished = False
        """finished: a window of contacts is on the calibrated sheet"""
        self._start_window()

    def add_contacts(
        self, currents: FloatArray, noise: FloatArray, now_ns: int, touches: Sequence[int]
    ) -> GainEstimator:
        """Add contacts as `GainEstimator` does; return the estimator of a new sheet, by the window's."""
        self._begin_ns = now_ns if self._begin_ns is None else self._begin_ns
        estimator, before = self._window, self._window.estimate.contacts
        self._since_ns = self._since_ns or now_ns
        estimator.add_contacts(currents, noise, now_ns, touches)
        contacts = estimator.estimate.contacts
        if contacts == before:
            return estimator
        self.contacts += contacts - before
        elapsed_s = (now_ns - self._begin_ns) * 1e-9
        nats = -estimator.evidence_nats(drifted_gains(self.known, elapsed_s))
        self.nats = float(np.clip(self._before_nats + nats, 0.0, _MAX_NATS))
        was_replaced = self.is_replaced
        self.is_replaced = self.nats >= _REPLACED_NATS or (was_replaced and self.nats > 0)
        if contacts >= _WINDOW_CONTACTS or self.is_replaced != was_replaced:
            self._before_nats, self.is_finished = self.nats, self.nats == 0.0
            self._start_window()
        return estimator

    def _start_window(self) -> None:
        if self._before_nats == 0.0:
            self.contacts = self._since_ns = 0
        self._window = self._new_estimator(replace(self.known, parts=None))

    @property
    def diagnosis(self) -> Diagnosis:
        """Return the diagnosis of a new sheet."""
        nats = f"at least {self.nats:.0f}" if self.nats >= _MAX_NATS else f"{self.nats:.0f}"
        return Diagnosis(
            kind=FaultKind.SHEET_REPLACED,
            cause="another sheet than the calibrated one on the same node, or channel gains a few percent "
            "off, which look the same",
            evidence=f"{self.contacts} contacts: other gaps, sides and waves of the sheet within the stated "
            f"tolerances explain their currents better, by {nats} nats",
            remedy="after a new sheet, `handtouch calibrate PAD --new-sheet`; if the sheet is the same, "
            "return with `handtouch calibrations rollback`; positions are learned anew meanwhile",
            since_ns=self._since_ns,
            confidence=1 / (1 + math.exp(-self.nats / _NATS_PER_LOGIT)),
            force_valid=False,
        )
