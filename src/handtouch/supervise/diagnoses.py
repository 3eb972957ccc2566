"""The diagnosis of every hand of a deployment, from blocks of the daemon to findings that health can carry.

Public name: `Diagnoses`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from handtouch.config import Deployment
from handtouch.supervise import diagnose
from handtouch.supervise.diagnose.diagnosis import Diagnosis
from handtouch.supervise.link import Block, Finding, FloatArray

_TOGETHER_NS = 250_000_000
"""Of samples that are diagnosed at once."""


class Diagnoses:
    """Of all pads, in the order of the deployment; blocks in, all that lasts out."""

    def __init__(self, deployment: Deployment) -> None:
        self._hands: list[tuple[slice, Diagnosis]] = []
        self._models: dict[int, diagnose.DiagnosisModel] = {}
        self._nominal: dict[int, FloatArray] = {}
        first = 0
        for hand in deployment.hands:
            rows = slice(first, first + len(hand.pads))
            model = diagnose.DiagnosisModel.of(deployment, hand.name)
            self._models[first], self._nominal[first] = model, model.ampere_per_count.copy()
            self._hands.append((rows, Diagnosis(model)))
            first = rows.stop
        self._waiting: list[Block] = []
        self._found: list[tuple[int, Finding]] = []

    def take(self, block: Block) -> Sequence[tuple[int, Finding]]:
        """What is the matter with which pads, as of the last block that made a quarter of a second full."""
        self._waiting.append(block)
        if block.t_ns[-1] - self._waiting[0].t_ns[0] < _TOGETHER_NS:
            return self._found
        blocks, self._waiting = self._waiting, []
        sample_ns, counts, fresh = (
            np.concatenate([getattr(one, name) for one in blocks])
            for name in ("sample_ns", "counts", "fresh")
        )
        self._found = []
        for rows, hand in self._hands:
            known = fresh[:, rows].any()
            if known:
                samples = counts[:, rows].astype(np.int64)
                hand.step(diagnose.Block(sample_ns[:, rows], samples, fresh[:, rows]))
            self._found += [
                (rows.start + row, _told(finding)) for row, finding in hand.by_pad() if finding.fault
            ]
        return self._found

    def tare(self, pad: int, offset_counts: ArrayLike) -> None:
        """What the channels (4,) of a pad read untouched, as stored."""
        rows, hand = self._of(pad)
        hand.tare(pad - rows.start, offset_counts)

    def calibrate(self, pad: int, gains: ArrayLike) -> None:
        """Gains (4,) of the unit that is in the place of a pad now; what its contacts told is void."""
        rows, hand = self._of(pad)
        row, model = pad - rows.start, self._models[rows.start]
        model.ampere_per_count[row] = self._nominal[rows.start][row] * np.asarray(gains)
        hand.renew(row)

    def _of(self, pad: int) -> tuple[slice, Diagnosis]:
        return next((rows, hand) for rows, hand in self._hands if rows.start <= pad < rows.stop)


def _told(finding: diagnose.Finding) -> Finding:
    return Finding(
        kind=finding.kind.value,
        cause=finding.cause[:1000],
        evidence=_words(finding.evidence)[:1000],
        remedy=finding.remedy[:1000],
        since_ns=finding.since_ns,
        confidence=float(np.clip(finding.confidence, 0.0, 1.0)),
        pad_m=None if (at := finding.place_m) is None else (float(at[0]), float(at[1])),
        size_m=None if finding.size_m is None else float(finding.size_m),
        location=finding.location,
        strength=finding.strength,
    )


def _words(evidence: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:.3g}" for name, value in evidence.items())
