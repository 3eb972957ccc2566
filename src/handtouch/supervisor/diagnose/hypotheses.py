"""Pads with and without a fault, tabulated: how well each explains the currents of a contact.

Public: `Hypothesis`, `HypothesisTables`, `ContactCurrents`, `MIN_CHANNELS`. A contact has three unknowns
(position and total) and c currents, four as a rule. The c - 3 numbers left over are its scores under a
hypothesis.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray
from handtouch.config.tables import SIDE_ELECTRODES
from handtouch.field.model import ChannelModel, FractionModel
from handtouch.field.network import ElectrodeNetwork
from handtouch.field.surface_base import Surface
from handtouch.supervisor.diagnose.sheet_changes import CORNERS, SheetChanges
from handtouch.wire.faults import FaultKind

# Constants without an origin beside them were chosen; docs/benchmarks/diagnose.md and soak_alarms.md measure
# what they yield.
_UNKNOWNS = 3
MIN_CHANNELS = _UNKNOWNS + 1
"""Channels of a pad whose contacts can contradict a hypothesis."""
_GAIN_TOLERANCE_STD = 0.02
"""Error of a channel's gain, as noise of log likelihood ratios, which raise suspicions only."""
_SEARCH_TOLERANCE = 0.02  # relative error of each current in the search of the first node
_BOUND_STIFFNESS = 1e4
_SEARCH_REACH = (1 / 6, 1 / 6, 1 / 8, 1 / 12, 1 / 24, 1 / 24)
"""Fractions of the sides that the steps of the search for scores go at most."""
_NODES_PER_SIDE, _MAX_NODES_PER_SIDE = 25, 73
"""Nodes along the shorter side, and along the longer one of a long pad."""
_LONG_RATIO = 2.0
"""Ratio of the sides from which the nodes of the longer side are as close as those of the shorter one: the
current of an electrode far along a strip falls by a factor e within a third of its width."""
_FIRST_NODE, _LAST_NODE = 0.02, 0.98  # fractions of a side
_MODEL_ERROR_FRACTION = 1e-3  # what the model neglects, over the total current
_TORN_MODEL_ERROR_FRACTION = 5e-3  # the same for torn corners: few sizes of cuts, coarse grids
_SCORE_MODEL_ERROR_FRACTION = 3e-3  # the same for scores, equal for all hypotheses
_LONG_MODEL_ERROR_FRACTION, _LONG_MODEL_ERROR_OF_CURRENT = 5e-4, 0.03
"""Errors of the model on a long pad over the total and over a channel's current, up to the above: far from an
electrode, its current and the model's error decay alike, and carry the evidence."""
_NON_POINT_PROBABILITIES = np.array([0.03, 0.5])
"""Fractions of all contacts that are no points: usually, and while two objects are handled; chosen."""
_MIN_LOG_LIKELIHOOD, _MAX_SQUARED_MISFIT = -1e3, 1e6
_LOG_NON_POINT_SPREAD = np.log(40.0)  # log ratio of the scatter of each score of contacts that are no points
_CUT_FRACTIONS = (0.2, 0.35, 0.5, 0.65, 0.8, 0.92)
"""Sizes of cuts as fractions of a side; the short side of a fingertip may be cut off whole."""
_CUT_STEP_STD = 0.5
"""Standard deviation of a cut's sizes about those of a hypothesis, in steps between these."""
_GAIN_STEP_FACTORS = np.exp(np.append(np.arange(-19.5, -1), np.arange(1.5, 20)) * 0.07)
"""0.26 to 0.9 and 1.11 to 3.9."""


class Hypothesis(NamedTuple):
    """Possible fault: kind, electrodes; factor of a gain, or fractions of the sides that a cut removes."""

    kind: FaultKind
    electrodes: tuple[str, ...]
    factor: float = 1.0
    cut: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class ContactCurrents:
    """Currents (c,) and noise (c,) [A] of a contact; position (2,) as fractions of the pad, nominal fit."""

    sample_ns: int
    currents: FloatArray
    noise: FloatArray
    position: FloatArray


class Scores(NamedTuple):
    """Misfits of k contacts under one hypothesis, in standard deviations.

    scores (k, s): along the directions that no position and total explains. slopes (k, s, t): their change by
    one
    standard deviation of each tolerance of the sheet and its electrodes, of both sizes of a cut, which are 0
    for other hypotheses, then by the log gain of each channel. rest (k,): squared misfit along the
    other directions, where no position fits.
    """

    scores: FloatArray
    slopes: FloatArray
    rest: FloatArray


class HypothesisTables:
    """Current shares under each hypothesis, for one design of pad with at least `MIN_CHANNELS`.

    electrodes: names of the c electrodes. is_long: whether currents of far sides are small over much of the
    pad. parts: networks in each of which one part differs by one standard
    deviation.
    """

    def __init__(
        self,
        network: ChannelModel,
        surface: Surface,
        parts: Sequence[FractionModel] = (),
        electrodes: tuple[str, ...] = SIDE_ELECTRODES,
    ) -> None:
        self.hypotheses: list[Hypothesis] = []
        self.electrodes, c = electrodes, len(electrodes)
        self._freedom = c - _UNKNOWNS
        self._sides = sides = _node_fractions(network)
        self.is_long = max(network.a, network.b) >= _LONG_RATIO * min(network.a, network.b)
        self._least_model_error = _LONG_MODEL_ERROR_FRACTION if self.is_long else _SCORE_MODEL_ERROR_FRACTION
        x, y = _nodes(network, sides)
        shape = len(sides[0]), len(sides[1])
        nominal = network.fractions(x, y).T
        series = np.array(network.series_ohm)
        orders, factors = [np.arange(c)], [np.ones(c)]
        for order in _swap_permutations(electrodes):
            names = tuple(electrodes[k] for k in np.flatnonzero(order != np.arange(c)))
            self.hypotheses.append(Hypothesis(FaultKind.SWAPPED_CABLES, names))
            orders.append(order)
            factors.append(np.ones(c))
        for channel, factor in itertools.product(range(c), _GAIN_STEP_FACTORS):
            self.hypotheses.append(Hypothesis(FaultKind.GAIN_STEP, (electrodes[channel],), float(factor)))
            orders.append(np.arange(c))
            factors.append(np.where(np.arange(c) == channel, 1 / factor, 1.0))
        self._orders, self._factors = np.array(orders).T, np.array(factors).T
        self._nominal = _FractionTable(nominal[None], shape)
        others = []
        for channel in range(c):
            self.hypotheses.append(Hypothesis(FaultKind.DEAD_ELECTRODE, (electrodes[channel],)))
            others.append(network.with_open_electrode(channel).fractions(x, y).T)
        if series.any():
            for i, j in itertools.combinations(range(c), 2):
                merged = nominal.copy()
                merged[:, [i, j]] = nominal[:, [i, j]].mean(axis=1, keepdims=True)
                self.hypotheses.append(
                    Hypothesis(FaultKind.SHORTED_ELECTRODE, (electrodes[i], electrodes[j]))
                )
                others.append(merged)
        self._electrode_faults = _FractionTable(np.stack(others), shape)
        is_sheet = electrodes == SIDE_ELECTRODES and isinstance(network, ElectrodeNetwork)
        torn = self._torn_pads(network, surface, nominal) if is_sheet else []
        self._torn = _FractionTable(np.reshape(torn, (len(torn), *nominal.shape)), shape)
        self.hypotheses.append(Hypothesis(FaultKind.UNEXPLAINED, ()))
        self.kinds = np.array([h.kind for h in self.hypotheses])
        varied = (part for part in parts if part is not network)
        tolerances = [part.fractions(*_nodes(part, sides)).T - nominal for part in varied]
        no_cut = np.zeros((2, *nominal.shape))
        self._tolerances = np.array([*tolerances, *no_cut, *(nominal * channel for channel in np.eye(c))])

    def _torn_pads(self, network: ChannelModel, surface: Surface, nominal: FloatArray) -> list[FloatArray]:
        """Add the hypotheses of torn corners; return their fractions (P, c)."""
        assert isinstance(network, ElectrodeNetwork)
        pads = []
        sheet = SheetChanges(network, surface, self._sides)
        cuts = list(itertools.product(CORNERS, _CUT_FRACTIONS, _CUT_FRACTIONS))
        changes = sheet.by_cuts((CORNERS[corner], p, q) for corner, p, q in cuts)
        for (corner, p, q), (change, beyond) in zip(cuts, changes, strict=True):
            self.hypotheses.append(Hypothesis(FaultKind.TORN_CORNER, corner, 1.0, (p, q)))
            torn = nominal + change.reshape(nominal.shape)
            torn[beyond.ravel()] = 0.0
            pads.append(torn)
        return pads

    def log_likelihood_ratios(self, contact: ContactCurrents, left_out: NDArray[np.bool_]) -> FloatArray:
        """Return log likelihood ratios (2, hypotheses) to a nominal pad with few contacts that are no points,
        and to one with many; channels (c,) with a known fault are left out."""
        data = contact.currents
        total = max(float(data.sum()), 1e-30)
        sigma = np.sqrt(
            contact.noise**2 + (_GAIN_TOLERANCE_STD * data) ** 2 + (_MODEL_ERROR_FRACTION * total) ** 2
        )
        sigma = np.where(left_out, 1e6 * total, sigma)
        rescaled = data[self._orders] * self._factors, sigma[self._orders] * self._factors
        level, volume = self._nominal.fit(*rescaled)
        level = level + np.log(self._factors).sum(axis=0)
        torn_sigma = np.hypot(sigma, _TORN_MODEL_ERROR_FRACTION * total)
        torn = self._torn.fit(data[:, None], torn_sigma[:, None])[0] - np.log(torn_sigma / sigma).sum()
        others = self._electrode_faults.fit(data[:, None], sigma[:, None])[0]
        level = np.concatenate([level, others, torn]) - volume[0]
        non_point = -self._freedom * _LOG_NON_POINT_SPREAD
        level = np.append(level, non_point)
        few, many = (
            np.logaddexp(np.log1p(-part) + level, np.log(part) + non_point)
            for part in _NON_POINT_PROBABILITIES
        )
        return np.stack([few[1:] - few[0], few[1:] - many[0]])

    def score(self, index: int | None, currents: FloatArray, noise: FloatArray) -> Scores:
        """Return the scores of contacts (c, k) with their noise under a hypothesis; None: no fault."""
        table, pad, tolerances = self._nominal, 0, self._tolerances
        permuted, others = self._orders.shape[1] - 1, self._electrode_faults.pads
        if index is not None and index < permuted:
            order, factor = self._orders[:, index + 1], self._factors[:, index + 1, None]
            currents, noise = currents[order] * factor, noise[order] * factor
        elif index is not None and index < permuted + others:
            table, pad = self._electrode_faults, index - permuted
        elif index is not None:
            table, pad = self._torn, index - permuted - others
            tolerances = tolerances.copy()
            gains = len(tolerances) - len(self.electrodes)
            tolerances[gains - 2 : gains] = _CUT_STEP_STD * self._torn.changes_by_cut(pad)
        total = currents.sum(axis=0)
        model_error = np.clip(
            _LONG_MODEL_ERROR_OF_CURRENT * np.abs(currents),
            self._least_model_error * total,
            _SCORE_MODEL_ERROR_FRACTION * total,
        )
        sigma = np.hypot(noise, model_error)
        return table.score(pad, currents, sigma, tolerances)


def _node_fractions(network: FractionModel) -> tuple[FloatArray, FloatArray]:
    """Return the nodes along x and along y, as fractions of the sides."""
    sides = np.array([network.a, network.b])
    ratios = sides / sides.min()
    intervals = (_NODES_PER_SIDE - 1) * np.where(ratios < _LONG_RATIO, 1.0, ratios)
    counts = np.minimum(1 + 2 * np.ceil(intervals / 2).astype(int), _MAX_NODES_PER_SIDE).tolist()
    x, y = (np.linspace(_FIRST_NODE, _LAST_NODE, count) for count in counts)
    return x, y


def _nodes(network: FractionModel, sides: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
    x, y = np.meshgrid(sides[0] * network.a, sides[1] * network.b, indexing="ij")
    return x.ravel(), y.ravel()


class _Fit(NamedTuple):
    """Fits of k contacts: nodes (2, k), steps (k, 3) from these by log total and position, whitened Jacobian
    (3, c, k), misfit (c, k) that is left, Gram matrix (k, 3, 3), and where undetermined (k,)."""

    node: NDArray[np.intp]
    step: FloatArray
    jacobian: FloatArray
    misfit: FloatArray
    gram: FloatArray
    undetermined: NDArray[np.bool_]

    def better_of(self, other: _Fit) -> _Fit:
        """Return the fits that leave less, contact by contact."""
        mine, its = ((fit.misfit**2).sum(axis=0) + 1e9 * fit.undetermined for fit in (self, other))
        take = its < mine
        return _Fit(
            np.where(take, other.node, self.node),
            np.where(take[:, None], other.step, self.step),
            np.where(take, other.jacobian, self.jacobian),
            np.where(take, other.misfit, self.misfit),
            np.where(take[:, None, None], other.gram, self.gram),
            np.where(take, other.undetermined, self.undetermined),
        )


class _FractionTable:
    """Fractions (t, P, c) of t pads on the grid, and their slopes: in single precision, as they are many.

    shape: nodes along x and y, P of them, odd numbers.
    """

    def __init__(self, exact: FloatArray, shape: tuple[int, int]) -> None:
        self._fractions = fractions = exact.astype(np.float32)
        self._shape, self._is_long = shape, max(shape) > _NODES_PER_SIDE
        cube = fractions.reshape(-1, *shape, fractions.shape[2])
        self._slopes = np.stack([v.reshape(fractions.shape) for v in np.gradient(cube, axis=(1, 2))])
        self._coarse = np.arange(shape[0] * shape[1]).reshape(shape)[::2, ::2].ravel()
        self._coarse_fractions = np.ascontiguousarray(fractions[:, self._coarse])
        self._coarse_squares = self._coarse_fractions**2

    def fit(self, data: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return log likelihoods, up to a constant, of point contacts anywhere, and their volume terms.

        Of data (c, k) with standard deviations sigma: (k,) for one pad, (t,) for t pads and k = 1. The
        nearest node of a coarse grid, then two Gauss-Newton steps.
        """
        table, node = self._nearest_nodes(data, sigma)
        fit = self._refine(table, node, data, sigma)
        volume = np.where(fit.undetermined, _MIN_LOG_LIKELIHOOD, -0.5 * np.linalg.slogdet(fit.gram)[1])
        return np.asarray(volume - 0.5 * (fit.misfit**2).sum(axis=0)), np.asarray(volume)

    def score(self, pad: int, data: FloatArray, sigma: FloatArray, tolerances: FloatArray) -> Scores:
        """Return the scores of data (c, k) with standard deviations on one pad; tolerances (t, P, c)."""
        node = self._nearest_nodes(data, np.hypot(sigma, _SEARCH_TOLERANCE * data), pad)[1]
        table = np.full(data.shape[1], pad)
        node, _, jacobian, misfit, _, undetermined = (
            self._search(table, node, data, sigma)
            if self._is_long
            else self._refine(table, node, data, sigma)
        )
        null = np.linalg.svd(jacobian.transpose(2, 1, 0), full_matrices=True)[0][:, :, _UNKNOWNS:]
        flat = self._flat(node)
        total = np.maximum(data.sum(axis=0), 1e-30)
        slopes = np.einsum("kcs,tkc->kst", null * (total / sigma).T[:, :, None], tolerances[:, flat])
        scores = np.einsum("kcs,ck->ks", null, misfit)
        rest = np.maximum((misfit**2).sum(axis=0) - (scores**2).sum(axis=1), 0.0)
        return Scores(scores, slopes, np.where(undetermined, _MAX_SQUARED_MISFIT, rest))

    @property
    def pads(self) -> int:
        """Number of pads."""
        return len(self._fractions)

    def changes_by_cut(self, pad: int) -> FloatArray:
        """Return changes (2, P, 4) by one step more of each size of a cut; 0 where either is cut off."""
        steps, along, changes = (
            len(_CUT_FRACTIONS),
            divmod(pad % len(_CUT_FRACTIONS) ** 2, len(_CUT_FRACTIONS)),
            [],
        )
        for at, stride in zip(along, (steps, 1), strict=True):
            first, last = max(at - 1, 0) - at, min(at + 1, steps - 1) - at
            less, more = self._fractions[pad + first * stride], self._fractions[pad + last * stride]
            there = (less.sum(axis=1) > 0) & (more.sum(axis=1) > 0)
            changes.append((more - less) * there[:, None] / (last - first))
        return np.array(changes)

    def _nearest_nodes(
        self, data: FloatArray, sigma: FloatArray, pad: int | None = None
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return tables (j,) and best nodes (2, j) of the coarse grid for each table and contact."""
        one = slice(None) if pad is None else slice(pad, pad + 1)
        weight = 1 / sigma**2
        along = self._coarse_fractions[one] @ (weight * data)  # (t, P, k)
        norm = self._coarse_squares[one] @ weight
        best = np.argmax(np.maximum(along, 0) * along / (norm + 1e-300), axis=1)
        node = np.stack(np.divmod(self._coarse[best.ravel()], self._shape[1]))
        return np.indices(best.shape)[0].ravel(), node

    def _refine(
        self, table: NDArray[np.intp], node: NDArray[np.intp], data: FloatArray, sigma: FloatArray
    ) -> _Fit:
        """Return a fit after two Gauss-Newton steps, of two nodes and one."""
        return self._step(table, self._move(self._step(table, node, data, sigma, 2), table), data, sigma, 1)

    def _search(
        self, table: NDArray[np.intp], node: NDArray[np.intp], data: FloatArray, sigma: FloatArray
    ) -> _Fit:
        """Return the best fit of several Gauss-Newton steps, for where the first node may be far off."""
        best = self._step(table, node, data, sigma, 1)
        fit = best
        intervals = np.array(self._shape) - 1.0
        for part in _SEARCH_REACH:
            node = self._move(self._step(table, fit.node, data, sigma, part * intervals), table)
            fit = self._step(table, node, data, sigma, 1)
            best = best.better_of(fit)
        return best

    def _move(self, fit: _Fit, table: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the nodes (2, k) nearest to the ends of the steps; the same where those are cut off."""
        moved = fit.node + np.rint(fit.step[:, 1:].T).astype(np.intp)
        moved = np.clip(moved, 0, np.array(self._shape)[:, None] - 1)
        there = self._fractions[table, self._flat(moved), 0] > 0
        return np.where(there, moved, fit.node)

    def _step(
        self,
        table: NDArray[np.intp],
        node: NDArray[np.intp],
        data: FloatArray,
        sigma: FloatArray,
        reach: float | FloatArray,
    ) -> _Fit:
        """Return the fit by one Gauss-Newton step from nodes (2, k), by some nodes at most."""
        jacobian, misfit = self._linearise(table, node, data, sigma)
        gram = np.einsum("pck,qck->kpq", jacobian, jacobian)
        size = np.trace(gram, axis1=1, axis2=2)
        undetermined = size <= 0  # no node collects such currents
        gram += np.eye(3) * np.where(undetermined, 1.0, 1e-9 * size)[:, None, None]
        gradient = np.einsum("pck,ck->kp", jacobian, misfit)
        step = np.linalg.solve(gram, gradient[:, :, None])[:, :, 0]
        if self._is_long:
            step = _solve_within(gram, gradient, reach)
        else:
            step[:, 1:] = np.clip(step[:, 1:], -reach, reach)
        misfit = misfit - np.einsum("kp,pck->ck", step, jacobian)
        return _Fit(node, step, jacobian, misfit, gram, undetermined)

    def _flat(self, node: NDArray[np.intp]) -> NDArray[np.intp]:
        return np.asarray(node[0] * self._shape[1] + node[1])

    def _linearise(
        self, table: NDArray[np.intp], node: NDArray[np.intp], data: FloatArray, sigma: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return whitened Jacobian (3, c, k) by log total and position, and misfit, at nodes (2, k)."""
        flat = self._flat(node)
        f = self._fractions[table, flat].T
        slopes = self._slopes[:, table, flat].transpose(0, 2, 1)
        total = np.maximum((f * data / sigma**2).sum(0) / ((f / sigma) ** 2).sum(0).clip(1e-300), 1e-12)
        return np.stack([f, slopes[0], slopes[1]]) * total / sigma, (data - total * f) / sigma


def _solve_within(gram: FloatArray, gradient: FloatArray, reach: float | FloatArray) -> FloatArray:
    """Return steps (k, 3) with positions within +-reach: one that is at its bound is kept there for the
    others."""
    step = np.linalg.solve(gram, gradient[:, :, None])[:, :, 0]
    limit = np.append(np.inf, np.broadcast_to(reach, 2))
    for _ in range(2):
        bound = np.zeros(step.shape)
        bound[:, 1:] = _BOUND_STIFFNESS * np.trace(gram, axis1=1, axis2=2)[:, None]
        bound[:, 1:] *= np.abs(step[:, 1:]) >= reach
        if not bound.any():
            break
        held = gradient + bound * np.clip(step, -limit, limit)
        step = np.linalg.solve(gram + bound[:, :, None] * np.eye(3), held[:, :, None])[:, :, 0]
    step[:, 1:] = np.clip(step[:, 1:], -reach, reach)
    return np.asarray(step)


def _swap_permutations(electrodes: tuple[str, ...]) -> list[NDArray[np.intp]]:
    """Return swaps of two cables, except those that mirror a pad of four; and, of four sides, both pairs."""
    by_sides, channels = electrodes == SIDE_ELECTRODES, len(electrodes)
    opposite = {(0, 1), (2, 3)} if by_sides else {(0, 2), (1, 3)}
    found = []
    for pair in itertools.combinations(range(channels), 2):
        if channels > 4 or pair not in opposite:
            order = np.arange(channels)
            order[list(pair)] = pair[::-1]
            found.append(order)
    return [*found, np.array([2, 3, 0, 1])] if by_sides else found
