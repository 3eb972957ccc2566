"""Faults that show in every contact: dead and merged electrodes, swapped cables, wrong gains.

Public: `ContactWitness`. A contact has three unknowns (place and total) and four currents, so each
alternative to the nominal pad is tested by how well *its* pad explains the same currents:

    dead      the electrode floats, the other three share all
    merged    two electrodes are one; each channel gets half (seen only through series resistors)
    swapped   the channels are permuted; permutations that mirror the pad leave no trace and are left out
    gain      a channel is multiplied by a factor, more than tolerances of parts explain
    torn      a cut across a corner takes a part of both its sides
    (none)    no contact is a point: something that isn't in this list

Each contact adds the logarithm of its likelihood ratio to a sum kept above zero (Page's CUSUM). Gains within
tolerance enter as noise in proportion to the currents. A contact may be no point at all, with a probability
of its own, which bounds what any one contact can say; and contacts at one place count less and less.
A sum that passes `ALARM` is a finding. Lorden's bound: less than (contacts x hypotheses) e^-ALARM false ones.
"""

from __future__ import annotations

import itertools
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.canbus.objects.channels import ELECTRODES
from handtouch.field.network import ElectrodeNetwork
from handtouch.field.surface import Surface
from handtouch.supervise.diagnose.cut import CORNERS, cut_changes
from handtouch.supervise.diagnose.findings import FloatArray, Kind

ALARM = 20.0
"""Nats. A hand of 15 pads has some 3 million contacts a week at most: 3e6 x 225 x e^-20 = 1.4 a week is the
bound; sums of a healthy pad fall much faster than the bound supposes."""
FLEXIBLE_ALARM = 28.0
"""That of torn corners and gain steps: of so many sizes one fits two objects now and then, up to 20 nats."""
CLEAR = 12.0
DOUBT = 10.0
"""Nats by which a torn corner and a gain step must differ; far from the corner they look alike."""
_MOST = 4 * ALARM
GAIN_TOLERANCE = 0.02
"""Standard deviation of a channel's gain, relative; twice what parts have, as it is the same in all contacts
and counts anew in each."""

_SIDE = 25
_AT = np.linspace(0.02, 0.98, _SIDE)
_FLOOR = 1e-3  # of the total: what the model leaves out
_TORN_FLOOR = 5e-3  # of the total: sizes of cuts are few, and their sheets coarse
_NO_POINT = np.array([0.03, 0.5])  # of all contacts: as it is mostly, and while two objects are handled
_NEVER = -1e3  # nats
_SPREAD = np.log(40.0)  # log of how much wider contacts that are no points scatter
_CUTS = (0.2, 0.35, 0.5, 0.65, 0.8, 0.92)  # parts of a side; the short side of a fingertip may be gone
_ALIKE = (Kind.GAIN_STEP, Kind.TORN_CORNER)
_SOME = 40  # contacts among which those at one place share
_FACTORS = np.exp(np.append(np.arange(-19.5, -1), np.arange(1.5, 20)) * 0.07)
_ORDINARY = np.exp(np.array([s for s in itertools.product((-0.02, 0, 0.02), repeat=4) if any(s)]))
"""Gains of ordinary parts: no faults, but what a gain step or a torn corner has to outdo."""


class Hypothesis(NamedTuple):
    """What may be wrong: kind, electrodes concerned; factor of a gain, lost parts of the sides of a cut."""

    kind: Kind
    electrodes: tuple[str, ...]
    factor: float = 1.0
    cut: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Contact:
    """currents (4,) and their noise (4,) [A]; place (2,) as fractions of the pad, of a nominal fit."""

    t_ns: int
    currents: FloatArray
    noise: FloatArray
    place: FloatArray


class Tables:
    """Alternatives of one make of pad."""

    def __init__(self, network: ElectrodeNetwork, surface: Surface) -> None:
        self.hypotheses: list[Hypothesis] = []
        x, y = (v.ravel() for v in np.meshgrid(_AT * network.a, _AT * network.b, indexing="ij"))
        nominal = network.fractions(x, y).T
        series = np.array(network.series_ohm)
        orders, factors = [np.arange(4)], [np.ones(4)]
        for order, names in _swaps():
            self.hypotheses.append(Hypothesis(Kind.SWAPPED_ELECTRODES, names))
            orders.append(order)
            factors.append(np.ones(4))
        for channel, factor in itertools.product(range(4), _FACTORS):
            self.hypotheses.append(Hypothesis(Kind.GAIN_STEP, (ELECTRODES[channel],), float(factor)))
            orders.append(np.arange(4))
            factors.append(np.where(np.arange(4) == channel, 1 / factor, 1.0))
        for gains in _ORDINARY:
            self.hypotheses.append(Hypothesis(Kind.GAIN_STEP, ()))
            orders.append(np.arange(4))
            factors.append(1 / gains)
        self._orders, self._factors = np.array(orders).T, np.array(factors).T
        self._nominal = _Table(nominal[None])
        others = []
        for channel in range(4):
            floating = network.with_series(np.where(np.arange(4) == channel, np.inf, series).tolist())
            self.hypotheses.append(Hypothesis(Kind.DEAD_ELECTRODE, (ELECTRODES[channel],)))
            others.append(floating.fractions(x, y).T)
        if series.any():
            for i, j in itertools.combinations(range(4), 2):
                merged = nominal.copy()
                merged[:, [i, j]] = nominal[:, [i, j]].mean(axis=1, keepdims=True)
                self.hypotheses.append(Hypothesis(Kind.SHORTED_ELECTRODE, (ELECTRODES[i], ELECTRODES[j])))
                others.append(merged)
        self._others, torn_ones = _Table(np.stack(others)), []
        cuts = list(itertools.product(CORNERS, _CUTS, _CUTS))
        changes = cut_changes(network, surface, [(CORNERS[corner], p, q) for corner, p, q in cuts], _AT)
        for (corner, p, q), (change, beyond) in zip(cuts, changes, strict=True):
            self.hypotheses.append(Hypothesis(Kind.TORN_CORNER, corner, 1.0, (p, q)))
            torn = nominal + change.reshape(-1, 4)
            torn[beyond.ravel()] = 0.0
            torn_ones.append(torn)
        self._torn = _Table(np.stack(torn_ones))
        self.hypotheses.append(Hypothesis(Kind.UNEXPLAINED, ()))
        self.kinds = np.array([h.kind for h in self.hypotheses])
        self.healthy = np.array([h.kind is Kind.GAIN_STEP and not h.electrodes for h in self.hypotheses])

    def log_ratios(self, contact: Contact, left_out: NDArray[np.bool_]) -> FloatArray:
        """Log likelihood ratios (2, hypotheses) to a nominal pad with few contacts that are no points, and
        to one with many; channels (4,) that are known to be wrong are left out."""
        data = contact.currents
        total = max(float(data.sum()), 1e-30)
        sigma = np.sqrt(contact.noise**2 + (GAIN_TOLERANCE * data) ** 2 + (_FLOOR * total) ** 2)
        sigma = np.where(left_out, 1e6 * total, sigma)
        rescaled = data[self._orders] * self._factors, sigma[self._orders] * self._factors
        level, volume = self._nominal.fit(*rescaled)
        level = level + np.log(self._factors).sum(axis=0)
        vaguer = np.hypot(sigma, _TORN_FLOOR * total)
        torn = self._torn.fit(data[:, None], vaguer[:, None])[0] - np.log(vaguer / sigma).sum()
        others = self._others.fit(data[:, None], sigma[:, None])[0]
        level = np.concatenate([level, others, torn]) - volume[0]
        level = np.append(level, -_SPREAD)
        few, many = (np.logaddexp(np.log1p(-part) + level, np.log(part) - _SPREAD) for part in _NO_POINT)
        return np.stack([few[1:] - few[0], few[1:] - many[0]])


class _Table:
    """Fractions (t, P, 4) of t pads over the grid, and their slopes."""

    def __init__(self, fractions: FloatArray) -> None:
        self._f = fractions
        cube = fractions.reshape(len(fractions), _SIDE, _SIDE, 4)
        self._slopes = np.stack([v.reshape(fractions.shape) for v in np.gradient(cube, axis=(1, 2))])
        self._coarse = np.arange(_SIDE**2).reshape(_SIDE, _SIDE)[::2, ::2].ravel()
        self._few = np.ascontiguousarray(fractions[:, self._coarse])
        self._square = self._few**2

    def fit(self, data: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Log likelihoods, but for a constant, under points anywhere on the pad; and their volumes' part.

        Of data (4, k) with standard deviations sigma: (k,) for one pad, (t,) for t pads and k = 1. The
        nearest of a coarse grid of places, then two steps of Gauss and Newton.
        """
        weight = 1 / sigma**2
        along, norm = self._few @ (weight * data), self._square @ weight  # (t, P, k)
        best = np.argmax(np.maximum(along, 0) * along / (norm + 1e-300), axis=1)
        table = np.indices(best.shape)[0].ravel()
        node = np.stack(np.divmod(self._coarse[best.ravel()], _SIDE))
        for reach in (2, 1):  # not beyond the next node
            jacobian, misfit = self._linear(table, node, data, sigma)
            gram = np.einsum("pck,qck->kpq", jacobian, jacobian)
            size = np.trace(gram, axis1=1, axis2=2)
            nowhere = size <= 0  # no node collects anything of such currents
            gram += np.eye(3) * np.where(nowhere, 1.0, 1e-9 * size)[:, None, None]
            step = np.linalg.solve(gram, np.einsum("pck,ck->kp", jacobian, misfit)[:, :, None])[:, :, 0]
            step[:, 1:] = np.clip(step[:, 1:], -reach, reach)
            if reach > 1:
                moved = np.clip(node + np.rint(step[:, 1:].T).astype(np.intp), 0, _SIDE - 1)
                there = self._f[table, moved[0] * _SIDE + moved[1], 0] > 0  # and not cut off
                node = np.where(there, moved, node)
        misfit = misfit - np.einsum("kp,pck->ck", step, jacobian)
        volume = np.where(nowhere, _NEVER, -0.5 * np.linalg.slogdet(gram)[1])
        return np.asarray(volume - 0.5 * (misfit**2).sum(axis=0)), np.asarray(volume)

    def _linear(
        self, table: NDArray[np.intp], node: NDArray[np.intp], data: FloatArray, sigma: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Whitened Jacobian (3, 4, k) by total (logarithm) and place (nodes), and misfit, at nodes (2, k)."""
        flat = node[0] * _SIDE + node[1]
        f = self._f[table, flat].T
        slopes = self._slopes[:, table, flat].transpose(0, 2, 1)
        total = np.maximum((f * data / sigma**2).sum(0) / ((f / sigma) ** 2).sum(0).clip(1e-300), 1e-12)
        return np.stack([f, slopes[0], slopes[1]]) * total / sigma, (data - total * f) / sigma


def _swaps() -> list[tuple[NDArray[np.intp], tuple[str, ...]]]:
    """Permutations up to mirroring: the four swaps of neighbours, and both pairs at once."""
    pairs = [(0, 2), (0, 3), (1, 2), (1, 3)]
    found = []
    for i, j in pairs:
        order = np.arange(4)
        order[[i, j]] = j, i
        found.append((order, (ELECTRODES[i], ELECTRODES[j])))
    return [*found, (np.array([2, 3, 0, 1]), ELECTRODES)]


@dataclass(frozen=True)
class Verdict:
    """The likeliest of the hypotheses. nats: its sum. share: probability that its kind is right."""

    hypothesis: Hypothesis
    also: tuple[Hypothesis, ...]
    """of the same kind, as likely as makes no difference"""
    nats: float
    share: float
    since_ns: int
    contacts: int
    rival: Hypothesis | None = None
    """of another kind, about as likely"""

    @property
    def kind(self) -> Kind:
        """What to call it."""
        return Kind.UNEXPLAINED if self.rival else self.hypothesis.kind


class ContactWitness:
    """One pad's contacts, one after another."""

    def __init__(self, tables: Tables) -> None:
        self._tables = tables
        n = len(tables.hypotheses)
        self._sums, self._back = np.zeros((2, n)), 0.0
        self._since = np.zeros(n, dtype=np.int64)
        self._count = np.zeros(n, dtype=np.int64)
        self._places: deque[tuple[int, int]] = deque(maxlen=_SOME)
        self._prior = -np.log([(tables.kinds == kind).sum() for kind in tables.kinds])
        self._needed = np.where(np.isin(tables.kinds, _ALIKE), FLEXIBLE_ALARM, ALARM)
        self._needed[tables.kinds == Kind.UNEXPLAINED] = 2 * ALARM
        self._prior[tables.kinds == Kind.UNEXPLAINED] = -ALARM  # the last resort
        self._settled: Verdict | None = None

    def take(self, contact: Contact, left_out: NDArray[np.bool_]) -> None:
        """One more contact."""
        ratios = self._tables.log_ratios(contact, left_out)
        cell = (int(8 * contact.place[0]), int(8 * contact.place[1]))
        weight = 0.5 ** self._places.count(cell)
        self._places.append(cell)
        fresh = self._sum <= 0
        self._since[fresh], self._count[fresh] = contact.t_ns, 0
        self._sums += weight * ratios
        self._sums -= max(self._sum.max() - _MOST, 0.0)
        np.maximum(self._sums, 0.0, out=self._sums)
        self._count += 1
        if self._settled is not None:
            same = (self._tables.kinds == self._settled.hypothesis.kind) & ~self._tables.healthy
            self._back = min(max(self._back - weight * float(ratios[0, same].max()), 0.0), _MOST)
        self._judge()

    @property
    def _sum(self) -> FloatArray:
        return np.asarray(self._sums.min(axis=0))

    @property
    def verdict(self) -> Verdict | None:
        """What is the matter, if anything."""
        return self._settled

    def forget(self) -> None:
        """Begin anew, as with another calibration."""
        self._sums[:] = 0
        self._back = 0.0
        self._settled = None
        self._places.clear()

    def _judge(self) -> None:
        sums = self._sum
        score = sums + self._prior
        ordinary = float(score[self._tables.healthy].max())
        score[self._tables.healthy] = -np.inf
        best = int(np.argmax(score))
        if self._settled is not None and self._back > CLEAR:
            self.forget()
            return
        if sums[best] < self._needed[best]:
            return
        hypothesis, kinds = self._tables.hypotheses[best], self._tables.kinds
        if hypothesis.kind in _ALIKE and ordinary > score[best] - DOUBT:
            return
        odds = np.exp(score - score[best])
        same = kinds == hypothesis.kind
        share = float(odds[same].sum() / odds.sum())
        also = tuple(self._tables.hypotheses[i] for i in np.flatnonzero(same & (odds > 0.05)) if i != best)
        one = all(h.electrodes == hypothesis.electrodes for h in also)
        if (share < 0.95 or not one) and sums[best] < 2 * ALARM:
            return
        rival = None
        if hypothesis.kind in _ALIKE:
            other = np.isin(kinds, _ALIKE) & ~same
            second = int(np.argmax(np.where(other, score, -np.inf)))
            if score[second] > score[best] - DOUBT:
                rival = self._tables.hypotheses[second]
        if rival and (sums[best] < 2 * ALARM or self._settled is not None):
            return  # more contacts may decide it
        if self._settled is None or self._settled.hypothesis.kind != hypothesis.kind:
            self._back = 0.0
        self._settled = Verdict(
            hypothesis, also, float(sums[best]), share, int(self._since[best]), int(self._count[best]), rival
        )
