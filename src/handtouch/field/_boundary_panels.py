"""Quadrature of logarithmic and Cauchy kernels on graded panels of a contour.

A *stretch* is the part of an edge from a singular point (corner, end of an electrode) half-way to the next.
On it the distance from that point, the anchor, is t^p, 0 <= t <= 1, with a power p that makes densities
nearly smooth in t. Panels are intervals of t with Gauss nodes. Positions are an anchor plus an offset, so
that distances near the anchor keep their digits. Densities are per unit of t.

A target near a panel sees it divided in halves until every part is far: until the Bernstein ellipse of the
part that passes through the target, in the complex plane of t, is wide enough for the Gauss rule.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt

from handtouch.arrays import BoolArray, FloatArray
from handtouch.field.outline import ComplexArray, Edge

NODES = 16  # per panel
_MIN_ELLIPSE = 2.7  # sum of semi-axes from which the Gauss rule has 13 digits
_MAX_HALVINGS = 46  # for targets on the boundary
_LEAST_DISTANCE = 1e-100
_SELF_LEVELS = 48  # intervals towards the singularity of a panel's own nodes
_SELF_NODES = 10
_CORNER_PARTS = 4
_REENTRANT_LEVELS = 5

UNIT_NODES, UNIT_WEIGHTS = np.polynomial.legendre.leggauss(NODES)
TO_LEGENDRE = np.linalg.inv(np.polynomial.legendre.legvander(UNIT_NODES, NODES - 1))


@dataclass(frozen=True, eq=False)
class Stretch:
    """Part of an edge: point(t) = edge at s + reach t^power, 0 <= t <= 1, reach negative for the second half.

    anchor: point at t = 0. electrode: its index, -1 if bare. outward: 1 if the region is on the left of the
    edge, else -1.
    """

    edge: Edge
    s: float
    reach: float
    power: int
    anchor: complex
    electrode: int
    outward: float
    reentrant: bool = False

    def offset(self, t: FloatArray) -> ComplexArray:
        """Return points less the anchor."""
        return self.edge.chord(self.s, self.reach * t**self.power)

    def roots(self, relative: ComplexArray) -> ComplexArray:
        """Return the complex t, shape (roots, ...), at which the stretch meets anchor + relative."""
        ahead = self.edge.complex_parameters(self.s, relative) / self.reach
        first = ahead ** (1 / self.power)
        turns = np.exp(2j * np.pi * np.arange(self.power) / self.power)
        roots = turns.reshape(-1, *(1,) * first.ndim) * first
        return np.asarray(roots.reshape(self.power * len(first), *relative.shape))


@dataclass(frozen=True, eq=False)
class Panel:
    """An interval of a stretch with its Gauss nodes."""

    stretch: Stretch
    start: float
    stop: float

    @cached_property
    def t(self) -> FloatArray:
        """Parameters of the nodes."""
        return np.asarray(self.start + (self.stop - self.start) * (UNIT_NODES + 1) / 2)

    @cached_property
    def weights(self) -> FloatArray:
        """Gauss weights per unit of t."""
        return np.asarray(UNIT_WEIGHTS * (self.stop - self.start) / 2)

    @cached_property
    def offset(self) -> ComplexArray:
        """Nodes less the anchor."""
        return self.stretch.offset(self.t)

    @cached_property
    def s(self) -> FloatArray:
        """Parameters of the nodes on their edge."""
        line = self.stretch
        return np.asarray(line.s + line.reach * self.t**line.power)

    @cached_property
    def normal(self) -> ComplexArray:
        """Outward unit normals at the nodes."""
        slope = self.stretch.edge.derivative(self.s)
        return np.asarray(-1j * self.stretch.outward * slope / np.abs(slope))

    @cached_property
    def speed(self) -> FloatArray:
        """Arc length per unit of t at the nodes."""
        line = self.stretch
        rate = abs(line.reach) * line.power * self.t ** (line.power - 1)
        return np.asarray(np.abs(line.edge.derivative(self.s)) * rate)

    @cached_property
    def half_curvature(self) -> FloatArray:
        """Limit of the kernel Re(normal / (x - y)) on the panel itself."""
        return np.asarray(self.stretch.edge.curvature(self.s) * self.stretch.outward / 2)

    @cached_property
    def length(self) -> float:
        """Arc length."""
        return float(self.speed @ self.weights)

    def divided(self) -> list[Panel]:
        """Return the panel's halves; at a corner the first half in three more, graded towards it."""
        parts = _CORNER_PARTS if self.start == 0 and self.stretch.power > 2 else 2
        cuts = [
            self.start,
            *(self.start + (self.stop - self.start) * 0.5**k for k in range(parts - 1, -1, -1)),
        ]
        return [Panel(self.stretch, a, b) for a, b in itertools.pairwise(cuts)]

    def self_log(self) -> FloatArray:
        """Return the matrix (NODES, NODES) that integrates ln |node - y| times a density."""
        line, half = self.stretch, (self.stop - self.start) / 2
        ahead, weights, interpolate = _self_rule()
        t = self.t[:, None]
        with np.errstate(divide="ignore"):
            growth = np.expm1(line.power * np.log1p(np.maximum(half * ahead / t, -1.0)))
        distance = np.abs(line.edge.chord(self.s[:, None], line.reach * t**line.power * growth))
        return np.asarray(np.einsum("iq,iqj->ij", weights * np.log(distance), interpolate) * half)

    def is_near(self, relative: ComplexArray) -> BoolArray:
        """Return True for targets (anchor + relative) whose kernel the panel's nodes don't integrate."""
        near = np.zeros(relative.shape, np.bool_)
        middle = self.stretch.offset(np.array([(self.start + self.stop) / 2]))[0]
        reach = np.abs(self.offset - middle).max()
        close = np.abs(relative - middle) < 8 * reach
        near[close] = _too_near(self.stretch.roots(relative[close]), self.start, self.stop)
        return near

    def near_blocks(self, relative: ComplexArray) -> tuple[FloatArray, ComplexArray]:
        """Return matrices (targets, NODES) that integrate ln |x - y| and 1 / (x - y) times a density.

        For targets x = anchor + relative off the panel, at any distance.
        """
        logs = np.zeros((relative.size, NODES))
        cauchy = np.zeros((relative.size, NODES), np.complex128)
        roots = self.stretch.roots(relative)
        length = self.stop - self.start
        waiting: list[tuple[int, int, npt.NDArray[np.intp]]] = [(0, 0, np.arange(relative.size))]
        while waiting:
            depth, index, targets = waiting.pop()
            lo, hi = np.ldexp(float(index), -depth), np.ldexp(float(index + 1), -depth)
            start, stop = self.start + length * lo, self.start + length * hi
            near = _too_near(roots[:, targets], start, stop) & (depth < _MAX_HALVINGS)
            far = targets[~near]
            if far.size:
                t = start + (stop - start) * (UNIT_NODES + 1) / 2
                distance = relative[far, None] - self.stretch.offset(t)
                weights = _interpolation(depth, index) * ((stop - start) / 2 * UNIT_WEIGHTS)[:, None]
                distance[distance == 0] = _LEAST_DISTANCE
                logs[far] += np.log(np.abs(distance)) @ weights
                cauchy[far] += (1 / distance) @ weights
            if near.any():
                waiting += [(depth + 1, 2 * index + k, targets[near]) for k in (0, 1)]
        return logs, cauchy


def initial_panels(stretch: Stretch) -> list[Panel]:
    """Return the panels to begin with: one, or several graded towards a re-entrant corner.

    The response to a source near such a corner has the scale of its distance from there.
    """
    levels = _REENTRANT_LEVELS if stretch.reentrant else 1
    cuts = [0.0, *(0.5**k for k in range(levels - 1, -1, -1))]
    return [Panel(stretch, a, b) for a, b in itertools.pairwise(cuts)]


def _too_near(roots: ComplexArray, start: float, stop: float) -> BoolArray:
    w = (roots - (start + stop) / 2) / ((stop - start) / 2)
    root = np.sqrt(w - 1) * np.sqrt(w + 1)
    ellipse = np.maximum(np.abs(w + root), np.abs(w - root))
    return np.asarray((ellipse < _MIN_ELLIPSE).any(axis=0))


def _lagrange(points: FloatArray) -> FloatArray:
    """Return the matrix (points, NODES) that interpolates from the unit nodes."""
    return np.asarray(np.polynomial.legendre.legvander(points, NODES - 1) @ TO_LEGENDRE)


@lru_cache(maxsize=4096)
def _interpolation(depth: int, index: int) -> FloatArray:
    """Return the matrix that interpolates to the nodes of part `index` of 2^depth."""
    width = np.ldexp(2.0, -depth)
    return _lagrange(-1 + width * (index + (UNIT_NODES + 1) / 2))


@lru_cache(maxsize=1)
def _self_rule() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a rule for every node, graded towards it on either side.

    Distances ahead of the node (NODES, q), weights (NODES, q), interpolation (NODES, q, NODES).
    """
    nodes, weights = np.polynomial.legendre.leggauss(_SELF_NODES)
    stops = 0.5 ** np.arange(_SELF_LEVELS)
    starts = np.append(stops[1:], 0.0)
    u = (starts[:, None] + (stops - starts)[:, None] * (nodes + 1) / 2).ravel()
    w = ((stops - starts)[:, None] * weights / 2).ravel()
    left, right = UNIT_NODES[:, None] + 1, 1 - UNIT_NODES[:, None]
    ahead = np.concatenate([-left * u, right * u], axis=1)
    rule = np.concatenate([left * w, right * w], axis=1)
    return ahead, rule, np.stack([_lagrange(n + a) for n, a in zip(UNIT_NODES, ahead, strict=True)])
