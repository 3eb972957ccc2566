"""Detect faults that show in every contact: dead and merged electrodes, swapped cables, wrong gains.

Public: `ContactFaultDetector`. Each alternative to the nominal pad is tested by how well *its* pad explains
the same currents:

    dead      the electrode floats, the others share all
    merged    two electrodes are one; each channel gets half (observable with series resistors only)
    swapped   the channels are permuted; permutations that mirror the pad are not observable and left out
    gain      a channel is multiplied by a factor beyond tolerances of parts
    torn      a cut across a corner removes a part of both its sides (pads with four sides only)
    (none)    no contact is a point: a fault that isn't in this list

Two steps. Each contact adds the logarithm of its likelihood ratio to a sum kept above zero (Page's CUSUM),
cheaply, with gains as noise. A sum above its threshold is a suspicion: then the last contacts are explained
jointly (`contact_evidence`), by a pad without a fault whose parts are anywhere within tolerance and by each
suspected fault. A fault is one that explains them better by `MIN_EVIDENCE_NATS`. Contacts that look the same
without the fault, such as strokes along the centre line of a pad whose electrodes might be merged, are no
evidence. A diagnosis ends when recent contacts contradict it, or none in memory supports it any more.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray
from handtouch.supervisor.diagnose.contact_evidence import Evidence, explain_contacts
from handtouch.supervisor.diagnose.hypotheses import ContactCurrents, Hypothesis, HypothesisTables, Scores
from handtouch.wire.faults import FaultKind

# Constants without another origin were tuned by hand on episodes of benchmarks/diagnose_episodes.py with
# seeds below 1100; none is a counted frequency. docs/benchmarks/diagnose.md and soak_alarms.md measure what
# they yield.
SUSPICION_NATS = 20.0
"""Sum at which a fault is suspected. With an exact model, false suspicions would be e^20 = 5e8 contacts apart
on average (Lorden 1971), 15 years of a contact a second."""
MIN_EVIDENCE_NATS = 14.0
"""Margin of a fault over a pad without one, by joint evidence: odds of 1.2e6, for rare faults and what the
model neglects."""
_MIN_EVIDENCE_SIMILAR_NATS = 18.0
"""The same for gain steps and torn corners, whose sizes are free: e^4 = 55 more, for the 38 factors of a gain
and more sizes of cuts that are tried."""
MIN_SEPARATION_NATS = 6.0
"""Margin over faults of other kinds, odds of 400; far from the corner, a torn corner looks like a gain
step."""
_MIN_SEPARATION_LONG_NATS = 12.0
"""The same between gain steps and torn corners of a long pad, which show in two small currents."""
CLEAR_NATS = 8.0
"""Margin of a pad without a fault over the diagnosed one that ends the diagnosis: odds of 3000, chosen."""
_MAX_SUM_NATS = 4 * SUSPICION_NATS  # bounds how long a sum outlives a mended fault
_NATS_PER_LOGIT = 4.0
"""Evidence per logit of the stated confidence: what the model neglects is common to many contacts."""
_WINDOWS = (64, 52, 44, 36, 28, 20, 12)
"""Contacts that are explained jointly, and last ones of them among which the fault may have begun. Chosen: 64
bounds the cost of a joint fit, and a begin between two windows leaves four contacts at most on the wrong
side."""
_MIN_CONTACTS_TO_END, _MAX_CONTACTS_TO_END = 20, 40
"""Recent contacts by which a diagnosis ends."""
_MAX_BEGINS = 3
"""Begins of the most likely suspicions, from which contacts are explained jointly, too."""
_MIN_CONTACTS, _MAX_STEP_CONTACTS = 6, 6
"""Contacts before the first comparison, and from one to the next while they find nothing new: chosen, against
the cost of a comparison."""
_MAX_SUSPECTS, _MAX_SUSPECTS_ALIKE = 16, 4
"""Hypotheses of a joint comparison, and those of one kind: bounds its cost."""
_GAIN_STEP_STD = 0.1
"""Standard deviation of a gain about that of a hypothesis, as factors are few."""
_CALIBRATED_GAIN_STD = 0.005
"""What temperature and age add to a channel's gain as known."""
_TOLERANCE_WIDENING = 1.2
"""Factor on every stated standard deviation: a part far out in its distribution is no fault. Chosen: a
uniform tolerance, such as a gain of +-2 %, ends 1.7 of its standard deviations from its mean."""
_MIN_UNEXPLAINED_SHARE, _MAX_EXPLAINED_SHARE = 0.65, 0.35
"""Share of contacts that are no points, at which they are unexplained, and at which that ends."""
_SIMILAR_KINDS = {FaultKind.GAIN_STEP, FaultKind.TORN_CORNER}
_MAX_SILENT_FRACTION, _SHARE_CELLS = 0.005, 16
"""Fraction of the total current in a channel that carries nothing; cells of each share of such a contact."""
_MIN_CONTACTS_SIMILAR = 12
"""Contacts of a fault of free size: fewer fit one of the sizes now and then."""
_MIN_SILENT_SHARE, _SILENT_NATS = 0.9, 30.0
"""Share of contacts without a current in a dead electrode's channel, and what that adds to its evidence."""
_SIMILAR_STEP = 3
"""Stride through hypotheses of gain steps and torn corners that one of a long pad must beat unsuspected."""
_KINDS_WITH_ALTERNATIVES = (*_SIMILAR_KINDS, FaultKind.SWAPPED_CABLES)
"""Kinds that are diagnosed while it is open which electrodes are concerned."""


@dataclass(frozen=True)
class ContactFault:
    """Most likely hypothesis. nats: its margin over a pad without a fault. probability: that its kind is
    right."""

    hypothesis: Hypothesis
    alternatives: tuple[Hypothesis, ...]
    """of the same kind and about as likely"""
    nats: float
    probability: float
    since_ns: int
    contacts: int
    rival: Hypothesis | None = None
    """of another kind, about as likely"""

    @property
    def kind(self) -> FaultKind:
        """Kind to report."""
        return FaultKind.UNEXPLAINED if self.rival else self.hypothesis.kind


class _RememberedContact:
    """A contact, its cell of the pad, and its scores by hypothesis."""

    def __init__(self, contact: ContactCurrents) -> None:
        self.contact = contact
        self.cell = _cell(contact)
        self.scores: dict[int | None, Scores] = {}


def _cell(contact: ContactCurrents) -> tuple[int, ...]:
    """Return a number for contacts that are much the same: those beside each other on the pad.

    If a channel carries nothing, as that of a dead electrode, the position of a healthy pad is at the
    opposite side all the time: then those that share their current alike among the others.
    """
    shares = contact.currents / max(float(contact.currents.sum()), 1e-30)
    if np.abs(shares).min() < _MAX_SILENT_FRACTION:
        return int(np.abs(shares).argmin()), *(_SHARE_CELLS * shares).astype(int).tolist()
    return int(8 * contact.position[0]), int(8 * contact.position[1])


class ContactFaultDetector:
    """Detector of faults of one pad by its contacts, one after another.

    gain_covariance: (c, c), of the logarithms of the channels' gains, as calibrated or stated.
    """

    def __init__(self, tables: HypothesisTables, gain_covariance: FloatArray) -> None:
        self._tables, self._gain_covariance = tables, gain_covariance
        n = len(tables.hypotheses)
        self._sums, self._since_ns = np.zeros((2, n)), np.zeros(n, dtype=np.int64)
        self._last_resort = tables.kinds == FaultKind.UNEXPLAINED
        self._suspicion_nats = np.where(self._last_resort, 2 * SUSPICION_NATS, SUSPICION_NATS)
        self._prior = -np.log([(tables.kinds == kind).sum() for kind in tables.kinds])
        self._contacts: deque[_RememberedContact] = deque(maxlen=_WINDOWS[0])
        self._new_contacts = self._contacts_since_fault = self._step = 0
        self._fault: ContactFault | None = None

    def add_contact(self, contact: ContactCurrents, left_out: NDArray[np.bool_]) -> None:
        """Update the sums by one contact; compare explanations where a fault is suspected."""
        ratios = self._tables.log_likelihood_ratios(contact, left_out)
        remembered = _RememberedContact(contact)
        weight = 0.5 ** sum(one.cell == remembered.cell for one in self._contacts)
        self._contacts.append(remembered)
        self._new_contacts += 1
        self._contacts_since_fault += 1
        self._since_ns[self._min_sums <= 0] = contact.sample_ns
        self._sums += weight * ratios
        self._sums -= max(self._min_sums.max() - _MAX_SUM_NATS, 0.0)
        np.maximum(self._sums, 0.0, out=self._sums)
        suspected = self._min_sums >= self._suspicion_nats
        if self._fault is None and not suspected.any():
            self._step = 0
        elif self._new_contacts > self._step and len(self._contacts) >= _MIN_CONTACTS:
            self._new_contacts, self._step = 0, min(self._step + 2, _MAX_STEP_CONTACTS)
            self._update_fault(suspected)

    @property
    def _min_sums(self) -> FloatArray:
        return np.asarray(self._sums.min(axis=0))

    @property
    def fault(self) -> ContactFault | None:
        """Fault found, if any."""
        return self._fault

    def reset(self, gain_covariance: FloatArray | None = None) -> None:
        """Restart, as with another calibration; with the covariance of its gains if it changed."""
        if gain_covariance is not None:
            self._gain_covariance = gain_covariance
        self._sums[:] = 0
        self._fault = None
        self._contacts.clear()

    def _update_fault(self, suspected: NDArray[np.bool_]) -> None:
        if self._fault is not None and self._has_ended(self._fault):
            self.reset()
            return
        suspects = self._suspects(suspected & ~self._last_resort)
        best = self._compare(suspects) if suspects else None
        if best is not None and self._tables.is_long:
            best = self._compare([*suspects, *self._besides(best.hypothesis, suspects)])
        if best is None and self._fault is None and suspected[self._last_resort].any():
            best = self._unexplained(suspects)
        if best is not None and (best.rival is None or self._fault is None):
            self._contacts_since_fault = 0 if self._fault is None else self._contacts_since_fault
            self._fault = best

    def _suspects(self, suspected: NDArray[np.bool_]) -> list[int]:
        """Return the most likely hypotheses, few of each fault."""
        score = np.where(suspected, self._min_sums + self._prior, -np.inf)
        alike: Counter[tuple[FaultKind, tuple[str, ...]]] = Counter()
        suspects: list[int] = []
        for index in np.argsort(-score)[: suspected.sum()].tolist():
            hypothesis = self._tables.hypotheses[index]
            alike[hypothesis.kind, hypothesis.electrodes] += 1
            if alike[hypothesis.kind, hypothesis.electrodes] <= _MAX_SUSPECTS_ALIKE:
                suspects.append(index)
        return suspects[:_MAX_SUSPECTS]

    def _besides(self, found: Hypothesis, suspects: Sequence[int]) -> list[int]:
        """Return hypotheses that a fault of a long pad must beat without their being suspected."""
        kinds = self._tables.kinds
        also = np.flatnonzero(kinds == FaultKind.DEAD_ELECTRODE).tolist()
        if found.kind in _SIMILAR_KINDS:
            for kind in sorted(_SIMILAR_KINDS):
                also += np.flatnonzero(kinds == kind)[::_SIMILAR_STEP].tolist()
        return sorted(set(also) - set(suspects))

    def _silent_nats(self, hypothesis: Hypothesis, count: int) -> float:
        """Return what a dead electrode gains if its channel carried nothing in nearly all of the contacts.

        Other faults can explain each of them by where the pad was pressed, but not that none was elsewhere.
        """
        if not self._tables.is_long or hypothesis.kind != FaultKind.DEAD_ELECTRODE:
            return 0.0
        currents = np.array([one.contact.currents for one in list(self._contacts)[-count:]])
        channel = self._tables.electrodes.index(hypothesis.electrodes[0])
        silent = np.abs(currents[:, channel]) < _MAX_SILENT_FRACTION * currents.sum(axis=1)
        return _SILENT_NATS if silent.mean() >= _MIN_SILENT_SHARE else 0.0

    def _compare(self, suspects: Sequence[int]) -> ContactFault | None:
        """Return the fault that explains the contacts best, each with its likeliest begin; None if none does
        by far."""
        hypotheses = [self._tables.hypotheses[index] for index in suspects]
        similar = np.array([h.kind in _SIMILAR_KINDS for h in hypotheses])
        counts = np.array(self._counts_since_begin(suspects))
        nats = np.stack([self._explain([None, *suspects], count).nats for count in counts.tolist()])
        every = np.where(
            similar & (counts < _MIN_CONTACTS_SIMILAR)[:, None], -np.inf, nats[:, 1:] - nats[:, :1]
        )
        margins, counts = every.max(axis=0), counts[every.argmax(axis=0)]
        silent = [self._silent_nats(h, count) for h, count in zip(hypotheses, counts.tolist(), strict=True)]
        standing = margins + np.where(margins >= MIN_EVIDENCE_NATS, silent, 0.0)
        best = int(standing.argmax())
        if margins[best] < MIN_EVIDENCE_NATS:
            return None
        found = hypotheses[best]
        if found.kind in _SIMILAR_KINDS and margins[best] < _MIN_EVIDENCE_SIMILAR_NATS:
            return None
        same = np.array([h.kind == found.kind for h in hypotheses])
        apart = np.full(len(hypotheses), MIN_SEPARATION_NATS)
        if self._tables.is_long and found.kind in _SIMILAR_KINDS:
            apart[similar & ~same] = _MIN_SEPARATION_LONG_NATS
        near = standing > standing[best] - apart
        rivals = [hypotheses[k] for k in np.argsort(-standing).tolist() if near[k] and not same[k]]
        also = tuple(h for h, close in zip(hypotheses, near & same, strict=True) if close and h is not found)
        clear = margins[best] > 2 * MIN_EVIDENCE_NATS
        if rivals and not (clear and {found.kind, rivals[0].kind} == _SIMILAR_KINDS):
            return None  # more contacts may decide
        if any(h.electrodes != found.electrodes for h in also) and found.kind not in _KINDS_WITH_ALTERNATIVES:
            return None
        logits = np.append((standing - standing[best])[~same], -margins[best]) / _NATS_PER_LOGIT
        return ContactFault(
            found,
            also,
            float(margins[best]),
            float(1 / (1 + np.exp(logits).sum())),
            int(self._since_ns[suspects[best]]),
            int(counts[best]),
            rivals[0] if rivals else None,
        )

    def _counts_since_begin(self, suspects: Sequence[int]) -> list[int]:
        """Return numbers of last contacts among which a fault may have begun."""
        begins = dict.fromkeys(self._since_ns[suspects].tolist())
        since = [sum(one.contact.sample_ns >= begin for one in self._contacts) for begin in begins]
        counts = {min(count, len(self._contacts)) for count in (*_WINDOWS, *since[:_MAX_BEGINS])}
        return sorted(max(count, _MIN_CONTACTS) for count in counts)

    def _unexplained(self, suspects: Sequence[int]) -> ContactFault | None:
        """Return the diagnosis that contacts are no points, with or without a fault that is known."""
        share = float(self._explain([None, *suspects], len(self._contacts)).non_point_share.min())
        if share < _MIN_UNEXPLAINED_SHARE:
            return None
        index = int(np.flatnonzero(self._last_resort)[0])
        since_ns, nats = int(self._since_ns[index]), float(self._min_sums[index])
        return ContactFault(self._tables.hypotheses[index], (), nats, share, since_ns, len(self._contacts))

    def _has_ended(self, fault: ContactFault) -> bool:
        """Return whether recent contacts contradict a fault, or none in memory supports it any more."""
        recent = min(self._contacts_since_fault, _MAX_CONTACTS_TO_END)
        if recent < _MIN_CONTACTS_TO_END:
            return False
        if fault.hypothesis.kind == FaultKind.UNEXPLAINED:
            return bool(self._explain([None], recent, before=False).non_point_share[0] < _MAX_EXPLAINED_SHARE)
        named = (fault.hypothesis, *fault.alternatives, *((fault.rival,) if fault.rival else ()))
        indices = [None, *map(self._tables.hypotheses.index, named)]
        nats = self._explain(indices, recent, before=False).nats
        if nats[1:].max() < nats[0] - CLEAR_NATS:
            return True
        if self._contacts_since_fault < _WINDOWS[0]:
            return False
        nats = self._explain(indices, _WINDOWS[0]).nats
        return bool(nats[1:].max() < nats[0] - CLEAR_NATS / 2)

    def _explain(self, indices: Sequence[int | None], count: int, before: bool = True) -> Evidence:
        """Return the evidence of contacts for hypotheses; None is a pad without a fault.

        A fault concerns the last contacts, `count`; those before show the tolerances of the same pad without
        it, or are left out.
        """
        memory = list(self._contacts)[-len(self._contacts) if before else -count :]
        since = len(memory) - count
        rows = [self._score(None, memory[:since]) + self._score(index, memory[since:]) for index in indices]
        scores = Scores(*(np.array([[one[part] for one in row] for row in rows]) for part in range(3)))
        electrodes = self._tables.electrodes
        gains, covariance = slice(-len(electrodes), None), np.eye(scores.slopes.shape[-1])
        covariance[gains, gains] = self._gain_covariance + _CALIBRATED_GAIN_STD**2 * np.eye(len(electrodes))
        covariances = np.repeat(_TOLERANCE_WIDENING**2 * covariance[None], len(indices), axis=0)
        for row, index in enumerate(indices):
            if index is not None and self._tables.kinds[index] == FaultKind.GAIN_STEP:
                channel = electrodes.index(self._tables.hypotheses[index].electrodes[0]) - len(electrodes)
                covariances[row, channel, channel] += _GAIN_STEP_STD**2
        cells = Counter(one.cell for one in memory)
        weights = np.array([(2 - 2.0 ** (1 - cells[one.cell])) / cells[one.cell] for one in memory])
        found = explain_contacts(scores, weights, covariances)
        # what the model neglects is common to the scores of a contact: they count as one
        return found._replace(nats=found.nats / scores.scores.shape[-1])

    def _score(self, index: int | None, memory: Sequence[_RememberedContact]) -> list[Scores]:
        """Return the scores of contacts under a hypothesis, each computed once."""
        new = [one for one in memory if index not in one.scores]
        if new:
            currents = np.array([one.contact.currents for one in new]).T
            noise = np.array([one.contact.noise for one in new]).T
            for one, *score in zip(new, *self._tables.score(index, currents, noise), strict=True):
                one.scores[index] = Scores(*score)
        return [one.scores[index] for one in memory]
