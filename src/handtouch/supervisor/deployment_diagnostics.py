"""Diagnosis of all hands of a deployment, from the daemon's blocks to published diagnoses.

Public name: `DeploymentDiagnostics`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from handtouch.arrays import FloatArray
from handtouch.calibration.calibration import Gains
from handtouch.config import Deployment
from handtouch.supervisor import diagnose
from handtouch.supervisor.ipc import SampleBlock
from handtouch.wire.faults import FaultKind
from handtouch.wire.health import Diagnosis

_BLOCK_DURATION_NS, _BLOCK_TICKS = 250_000_000, 20
"""Least duration and number of the samples that are diagnosed together: of fewer, slow or from an overloaded
host, a short mean would join positions of a sliding contact, with no other to compare it with."""


class DeploymentDiagnostics:
    """Diagnostics of all pads, numbered in the order of the deployment.

    Pads with a schedule of switched electrodes have none: each of their readings is repeated until its state
    is next.
    """

    def __init__(self, deployment: Deployment) -> None:
        self._hands: list[tuple[slice, diagnose.HandDiagnostics]] = []
        self._models: dict[int, diagnose.DiagnosisModel] = {}
        self._default_ampere_per_count: dict[int, FloatArray] = {}
        self._stated_gain_covariance: dict[int, FloatArray] = {}
        first = 0
        for hand in deployment.hands:
            rows = slice(first, first + len(hand.pads))
            model = diagnose.DiagnosisModel.from_deployment(deployment, hand.name)
            self._models[first], self._default_ampere_per_count[first] = model, model.ampere_per_count.copy()
            self._stated_gain_covariance[first] = model.gain_covariance.copy()
            self._hands.append((rows, diagnose.HandDiagnostics(model)))
            first = rows.stop
        self._switched = np.array([bool(entry.pad.switch_states) for entry in deployment.pads])
        self._pending: list[SampleBlock] = []
        self._diagnoses: list[tuple[int, Diagnosis]] = []

    def process_block(self, block: SampleBlock) -> Sequence[tuple[int, Diagnosis]]:
        """Process a block; return the active diagnoses with their pads, updated every quarter of a second."""
        self._pending.append(block)
        duration_ns = block.sync_ns[-1] - self._pending[0].sync_ns[0]
        if duration_ns < _BLOCK_DURATION_NS or sum(len(one.sync_ns) for one in self._pending) < _BLOCK_TICKS:
            return self._diagnoses
        blocks, self._pending = self._pending, []
        sample_ns, counts, fresh = (
            np.concatenate([getattr(one, name) for one in blocks])
            for name in ("sample_ns", "counts", "fresh")
        )
        fresh = fresh & ~self._switched
        self._diagnoses = []
        for rows, hand in self._hands:
            if fresh[:, rows].any():
                most = self._models[rows.start].ampere_per_count.shape[1]
                samples = counts[:, rows, :most].astype(np.int64)
                hand.process_block(diagnose.HandSamples(sample_ns[:, rows], samples, fresh[:, rows]))
            self._diagnoses += [
                (rows.start + row, diagnosis.published)
                for row, diagnosis in hand.diagnoses_by_pad()
                if diagnosis.kind != FaultKind.HELD_OBJECT and not self._switched[rows.start + row]
            ]
        return self._diagnoses

    def dead_electrodes(self) -> dict[int, int]:
        """Return the dead electrodes of pads that are located with the others, by pad."""
        return {
            rows.start + row: electrode
            for rows, hand in self._hands
            for row, electrode in hand.dead_electrodes().items()
            if not self._switched[rows.start + row]
        }

    def set_offsets(self, pad: int, offset_counts: ArrayLike) -> None:
        """Set the stored offsets (c,) of a pad."""
        rows, hand = self._hand_of(pad)
        hand.set_offsets(pad - rows.start, offset_counts)

    def set_gains(self, pad: int, gains: Gains) -> None:
        """Set the gains of a pad, with their covariance, and discard its contacts so far.

        A covariance wider than what the deployment states, as before any contact, is no information.
        """
        rows, hand = self._hand_of(pad)
        row, model = pad - rows.start, self._models[rows.start]
        own = slice(len(gains.factors))
        model.ampere_per_count[row, own] = (
            self._default_ampere_per_count[rows.start][row, own] * gains.factors
        )
        stated, known = self._stated_gain_covariance[rows.start][row, own, own], np.array(gains.covariance)
        model.gain_covariance[row, own, own] = known if 0 < np.trace(known) < np.trace(stated) else stated
        hand.reset_contacts(row)

    def _hand_of(self, pad: int) -> tuple[slice, diagnose.HandDiagnostics]:
        return next((rows, hand) for rows, hand in self._hands if rows.start <= pad < rows.stop)
