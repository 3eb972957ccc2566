"""Detect faults that show in every contact: dead and merged electrodes, swapped cables, wrong gains.

Public: `ContactFaultDetector`. A contact has three unknowns (position and total) and four currents, so each
alternative to the nominal pad is tested by how well *its* pad explains the same currents:

    dead      the electrode floats, the other three share all
    merged    two electrodes are one; each channel gets half (observable with series resistors only)
    swapped   the channels are permuted; permutations that mirror the pad are not observable and left out
    gain      a channel is multiplied by a factor beyond tolerances of parts
    torn      a cut across a corner removes a part of both its sides
    (none)    no contact is a point: a fault that isn't in this list

Each contact adds the logarithm of its likelihood ratio to a sum kept above zero (Page's CUSUM). Gains within
tolerance enter as noise in proportion to the currents. A contact may be no point at all, with a probability
of its own, which bounds the influence of any one contact; repeated contacts at one position count less and
less. A sum above `ALARM_NATS` is a fault. Lorden's bound: less than (contacts x hypotheses) e^-ALARM_NATS
false positives.
"""

from __future__ import annotations

import itertools
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.config.channels import ELECTRODES
from handtouch.field.network import ElectrodeNetwork
from handtouch.field.surface import Surface
from handtouch.supervisor.diagnose.corner_cut import CORNERS, cut_share_changes
from handtouch.supervisor.diagnose.model import FloatArray
from handtouch.wire.faults import FaultKind

ALARM_NATS = 20.0
"""A hand of 15 pads has at most some 3 million contacts per week: 3e6 x 225 x e^-20 = 1.4 per week is the
bound; sums of a healthy pad fall much faster than the bound assumes."""
FLEXIBLE_ALARM_NATS = 28.0
"""Threshold of torn corners and gain steps: one of their many sizes sometimes fits two objects, to 20
nats."""
CLEAR_NATS = 12.0
MIN_SEPARATION_NATS = 10.0
"""Margin between a torn corner and a gain step; far from the corner they look alike."""
_MAX_SUM_NATS = 4 * ALARM_NATS
GAIN_TOLERANCE_STD = 0.02
"""Relative standard deviation of a channel's gain; twice that of parts, as one error is common to all
contacts but counts in each."""

_NODES_PER_SIDE = 25
_NODE_FRACTIONS = np.linspace(0.02, 0.98, _NODES_PER_SIDE)
_MODEL_ERROR_FRACTION = 1e-3  # of the total: what the model neglects
_TORN_MODEL_ERROR_FRACTION = 5e-3  # of the total: few sizes of cuts, coarse grids
_NON_POINT_PROBABILITIES = np.array(
    [0.03, 0.5]
)  # of all contacts: usually, and while two objects are handled
_MIN_LOG_LIKELIHOOD = -1e3
_LOG_NON_POINT_SPREAD = np.log(40.0)  # log ratio of the scatter of contacts that are no points
_CUT_FRACTIONS = (
    0.2,
    0.35,
    0.5,
    0.65,
    0.8,
    0.92,
)  # of a side; the short side of a fingertip may be cut off whole
_SIMILAR_KINDS = (FaultKind.GAIN_STEP, FaultKind.TORN_CORNER)
_POSITION_MEMORY_CONTACTS = 40  # among which contacts at one position share their weight
_GAIN_STEP_FACTORS = np.exp(np.append(np.arange(-19.5, -1), np.arange(1.5, 20)) * 0.07)
_ORDINARY_GAINS = np.exp(np.array([s for s in itertools.product((-0.02, 0, 0.02), repeat=4) if any(s)]))
"""Gains of ordinary parts: no faults, but a gain step or a torn corner must explain the contacts better."""


class Hypothesis(NamedTuple):
    """Possible fault: kind, electrodes; factor of a gain, or fractions of the sides that a cut removes."""

    kind: FaultKind
    electrodes: tuple[str, ...]
    factor: float = 1.0
    cut: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class ContactCurrents:
    """Currents (4,) and noise (4,) [A] of a contact; position (2,) as fractions of the pad, nominal fit."""

    sample_ns: int
    currents: FloatArray
    noise: FloatArray
    position: FloatArray


class HypothesisTables:
    """Current shares under each hypothesis, for one design of pad."""

    def __init__(self, network: ElectrodeNetwork, surface: Surface) -> None:
        self.hypotheses: list[Hypothesis] = []
        x, y = (
            v.ravel()
            for v in np.meshgrid(_NODE_FRACTIONS * network.a, _NODE_FRACTIONS * network.b, indexing="ij")
        )
        nominal = network.fractions(x, y).T
        series = np.array(network.series_ohm)
        orders, factors = [np.arange(4)], [np.ones(4)]
        for order, names in _swap_permutations():
            self.hypotheses.append(Hypothesis(FaultKind.SWAPPED_CABLES, names))
            orders.append(order)
            factors.append(np.ones(4))
        for channel, factor in itertools.product(range(4), _GAIN_STEP_FACTORS):
            self.hypotheses.append(Hypothesis(FaultKind.GAIN_STEP, (ELECTRODES[channel],), float(factor)))
            orders.append(np.arange(4))
            factors.append(np.where(np.arange(4) == channel, 1 / factor, 1.0))
        for gains in _ORDINARY_GAINS:
            self.hypotheses.append(Hypothesis(FaultKind.GAIN_STEP, ()))
            orders.append(np.arange(4))
            factors.append(1 / gains)
        self._orders, self._factors = np.array(orders).T, np.array(factors).T
        self._nominal = _FractionTable(nominal[None])
        others = []
        for channel in range(4):
            floating = network.with_series_ohm(np.where(np.arange(4) == channel, np.inf, series).tolist())
            self.hypotheses.append(Hypothesis(FaultKind.DEAD_ELECTRODE, (ELECTRODES[channel],)))
            others.append(floating.fractions(x, y).T)
        if series.any():
            for i, j in itertools.combinations(range(4), 2):
                merged = nominal.copy()
                merged[:, [i, j]] = nominal[:, [i, j]].mean(axis=1, keepdims=True)
                self.hypotheses.append(
                    Hypothesis(FaultKind.SHORTED_ELECTRODE, (ELECTRODES[i], ELECTRODES[j]))
                )
                others.append(merged)
        self._electrode_faults, torn_ones = _FractionTable(np.stack(others)), []
        cuts = list(itertools.product(CORNERS, _CUT_FRACTIONS, _CUT_FRACTIONS))
        changes = cut_share_changes(
            network, surface, [(CORNERS[corner], p, q) for corner, p, q in cuts], _NODE_FRACTIONS
        )
        for (corner, p, q), (change, beyond) in zip(cuts, changes, strict=True):
            self.hypotheses.append(Hypothesis(FaultKind.TORN_CORNER, corner, 1.0, (p, q)))
            torn = nominal + change.reshape(-1, 4)
            torn[beyond.ravel()] = 0.0
            torn_ones.append(torn)
        self._torn = _FractionTable(np.stack(torn_ones))
        self.hypotheses.append(Hypothesis(FaultKind.UNEXPLAINED, ()))
        self.kinds = np.array([h.kind for h in self.hypotheses])
        self.healthy = np.array([h.kind is FaultKind.GAIN_STEP and not h.electrodes for h in self.hypotheses])

    def log_likelihood_ratios(self, contact: ContactCurrents, left_out: NDArray[np.bool_]) -> FloatArray:
        """Return log likelihood ratios (2, hypotheses) to a nominal pad with few contacts that are no points,
        and to one with many; channels (4,) with a known fault are left out."""
        data = contact.currents
        total = max(float(data.sum()), 1e-30)
        sigma = np.sqrt(
            contact.noise**2 + (GAIN_TOLERANCE_STD * data) ** 2 + (_MODEL_ERROR_FRACTION * total) ** 2
        )
        sigma = np.where(left_out, 1e6 * total, sigma)
        rescaled = data[self._orders] * self._factors, sigma[self._orders] * self._factors
        level, volume = self._nominal.fit(*rescaled)
        level = level + np.log(self._factors).sum(axis=0)
        torn_sigma = np.hypot(sigma, _TORN_MODEL_ERROR_FRACTION * total)
        torn = self._torn.fit(data[:, None], torn_sigma[:, None])[0] - np.log(torn_sigma / sigma).sum()
        others = self._electrode_faults.fit(data[:, None], sigma[:, None])[0]
        level = np.concatenate([level, others, torn]) - volume[0]
        level = np.append(level, -_LOG_NON_POINT_SPREAD)
        few, many = (
            np.logaddexp(np.log1p(-part) + level, np.log(part) - _LOG_NON_POINT_SPREAD)
            for part in _NON_POINT_PROBABILITIES
        )
        return np.stack([few[1:] - few[0], few[1:] - many[0]])


class _FractionTable:
    """Fractions (t, P, 4) of t pads on the grid, and their slopes."""

    def __init__(self, fractions: FloatArray) -> None:
        self._fractions = fractions
        cube = fractions.reshape(len(fractions), _NODES_PER_SIDE, _NODES_PER_SIDE, 4)
        self._slopes = np.stack([v.reshape(fractions.shape) for v in np.gradient(cube, axis=(1, 2))])
        self._coarse = (
            np.arange(_NODES_PER_SIDE**2).reshape(_NODES_PER_SIDE, _NODES_PER_SIDE)[::2, ::2].ravel()
        )
        self._coarse_fractions = np.ascontiguousarray(fractions[:, self._coarse])
        self._coarse_squares = self._coarse_fractions**2

    def fit(self, data: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return log likelihoods, up to a constant, of point contacts anywhere, and their volume terms.

        Of data (4, k) with standard deviations sigma: (k,) for one pad, (t,) for t pads and k = 1. The
        nearest node of a coarse grid, then two Gauss-Newton steps.
        """
        weight = 1 / sigma**2
        along, norm = self._coarse_fractions @ (weight * data), self._coarse_squares @ weight  # (t, P, k)
        best = np.argmax(np.maximum(along, 0) * along / (norm + 1e-300), axis=1)
        table = np.indices(best.shape)[0].ravel()
        node = np.stack(np.divmod(self._coarse[best.ravel()], _NODES_PER_SIDE))
        for reach in (2, 1):  # not beyond the next node
            jacobian, misfit = self._linearise(table, node, data, sigma)
            gram = np.einsum("pck,qck->kpq", jacobian, jacobian)
            size = np.trace(gram, axis1=1, axis2=2)
            undetermined = size <= 0  # no node collects such currents
            gram += np.eye(3) * np.where(undetermined, 1.0, 1e-9 * size)[:, None, None]
            step = np.linalg.solve(gram, np.einsum("pck,ck->kp", jacobian, misfit)[:, :, None])[:, :, 0]
            step[:, 1:] = np.clip(step[:, 1:], -reach, reach)
            if reach > 1:
                moved = np.clip(node + np.rint(step[:, 1:].T).astype(np.intp), 0, _NODES_PER_SIDE - 1)
                there = (
                    self._fractions[table, moved[0] * _NODES_PER_SIDE + moved[1], 0] > 0
                )  # and not cut off
                node = np.where(there, moved, node)
        misfit = misfit - np.einsum("kp,pck->ck", step, jacobian)
        volume = np.where(undetermined, _MIN_LOG_LIKELIHOOD, -0.5 * np.linalg.slogdet(gram)[1])
        return np.asarray(volume - 0.5 * (misfit**2).sum(axis=0)), np.asarray(volume)

    def _linearise(
        self, table: NDArray[np.intp], node: NDArray[np.intp], data: FloatArray, sigma: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return whitened Jacobian (3, 4, k) by log total and position, and misfit, at nodes (2, k)."""
        flat = node[0] * _NODES_PER_SIDE + node[1]
        f = self._fractions[table, flat].T
        slopes = self._slopes[:, table, flat].transpose(0, 2, 1)
        total = np.maximum((f * data / sigma**2).sum(0) / ((f / sigma) ** 2).sum(0).clip(1e-300), 1e-12)
        return np.stack([f, slopes[0], slopes[1]]) * total / sigma, (data - total * f) / sigma


def _swap_permutations() -> list[tuple[NDArray[np.intp], tuple[str, ...]]]:
    """Return permutations up to mirroring: the four swaps of neighbours, and both pairs at once."""
    pairs = [(0, 2), (0, 3), (1, 2), (1, 3)]
    found = []
    for i, j in pairs:
        order = np.arange(4)
        order[[i, j]] = j, i
        found.append((order, (ELECTRODES[i], ELECTRODES[j])))
    return [*found, (np.array([2, 3, 0, 1]), ELECTRODES)]


@dataclass(frozen=True)
class ContactFault:
    """Most likely hypothesis. nats: its sum. probability: that its kind is right."""

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


class ContactFaultDetector:
    """Detector of faults of one pad by its contacts, one after another."""

    def __init__(self, tables: HypothesisTables) -> None:
        self._tables = tables
        n = len(tables.hypotheses)
        self._sums, self._recovery_nats = np.zeros((2, n)), 0.0
        self._since_ns = np.zeros(n, dtype=np.int64)
        self._contact_counts = np.zeros(n, dtype=np.int64)
        self._recent_cells: deque[tuple[int, int]] = deque(maxlen=_POSITION_MEMORY_CONTACTS)
        self._prior = -np.log([(tables.kinds == kind).sum() for kind in tables.kinds])
        self._alarm_nats = np.where(np.isin(tables.kinds, _SIMILAR_KINDS), FLEXIBLE_ALARM_NATS, ALARM_NATS)
        self._alarm_nats[tables.kinds == FaultKind.UNEXPLAINED] = 2 * ALARM_NATS
        self._prior[tables.kinds == FaultKind.UNEXPLAINED] = -ALARM_NATS  # last resort
        self._fault: ContactFault | None = None

    def add_contact(self, contact: ContactCurrents, left_out: NDArray[np.bool_]) -> None:
        """Update the sums by one contact."""
        ratios = self._tables.log_likelihood_ratios(contact, left_out)
        cell = (int(8 * contact.position[0]), int(8 * contact.position[1]))
        weight = 0.5 ** self._recent_cells.count(cell)
        self._recent_cells.append(cell)
        fresh = self._min_sums <= 0
        self._since_ns[fresh], self._contact_counts[fresh] = contact.sample_ns, 0
        self._sums += weight * ratios
        self._sums -= max(self._min_sums.max() - _MAX_SUM_NATS, 0.0)
        np.maximum(self._sums, 0.0, out=self._sums)
        self._contact_counts += 1
        if self._fault is not None:
            same = (self._tables.kinds == self._fault.hypothesis.kind) & ~self._tables.healthy
            self._recovery_nats = min(
                max(self._recovery_nats - weight * float(ratios[0, same].max()), 0.0), _MAX_SUM_NATS
            )
        self._update_fault()

    @property
    def _min_sums(self) -> FloatArray:
        return np.asarray(self._sums.min(axis=0))

    @property
    def fault(self) -> ContactFault | None:
        """Fault found, if any."""
        return self._fault

    def reset(self) -> None:
        """Restart, as with another calibration."""
        self._sums[:] = 0
        self._recovery_nats = 0.0
        self._fault = None
        self._recent_cells.clear()

    def _update_fault(self) -> None:
        sums = self._min_sums
        score = sums + self._prior
        ordinary = float(score[self._tables.healthy].max())
        score[self._tables.healthy] = -np.inf
        best = int(np.argmax(score))
        if self._fault is not None and self._recovery_nats > CLEAR_NATS:
            self.reset()
            return
        if sums[best] < self._alarm_nats[best]:
            return
        hypothesis, kinds = self._tables.hypotheses[best], self._tables.kinds
        if hypothesis.kind in _SIMILAR_KINDS and ordinary > score[best] - MIN_SEPARATION_NATS:
            return
        odds = np.exp(score - score[best])
        same = kinds == hypothesis.kind
        share = float(odds[same].sum() / odds.sum())
        also = tuple(self._tables.hypotheses[i] for i in np.flatnonzero(same & (odds > 0.05)) if i != best)
        one = all(h.electrodes == hypothesis.electrodes for h in also)
        if (share < 0.95 or not one) and sums[best] < 2 * ALARM_NATS:
            return
        rival = None
        if hypothesis.kind in _SIMILAR_KINDS:
            other = np.isin(kinds, _SIMILAR_KINDS) & ~same
            second = int(np.argmax(np.where(other, score, -np.inf)))
            if score[second] > score[best] - MIN_SEPARATION_NATS:
                rival = self._tables.hypotheses[second]
        if rival and (sums[best] < 2 * ALARM_NATS or self._fault is not None):
            return  # more contacts may decide
        if self._fault is None or self._fault.hypothesis.kind != hypothesis.kind:
            self._recovery_nats = 0.0
        self._fault = ContactFault(
            hypothesis,
            also,
            float(sums[best]),
            share,
            int(self._since_ns[best]),
            int(self._contact_counts[best]),
            rival,
        )
