"""Test whether the contacts of a calibrated pad are on the sheet that it was calibrated with.

Public name: `SheetTest`. Gaps, sides and waves of a new sheet are others within the same tolerances; its
node's gains stay. Two explanations of the latest contacts are compared by their probability: gains and parts
as calibrated, or gains as calibrated and parts anywhere within the tolerances.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.calibration.calibration import Gains, drifted_gains
from handtouch.calibration.gains import GainEstimator
from handtouch.wire.faults import FaultKind
from handtouch.wire.health import Diagnosis

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

    def add_contacts(self, currents: FloatArray, noise: FloatArray, now_ns: int) -> GainEstimator:
        """Add contacts as `GainEstimator` does; return the estimator of a new sheet, by the window's."""
        self._begin_ns = now_ns if self._begin_ns is None else self._begin_ns
        estimator, before = self._window, self._window.estimate.contacts
        self._since_ns = self._since_ns or now_ns
        estimator.add_contacts(currents, noise, now_ns)
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
