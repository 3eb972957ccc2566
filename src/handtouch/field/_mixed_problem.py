"""Laplace's equation in a region with electrodes on its boundary: a single layer on graded panels.

The potential is a constant less the integral of ln |x - y| times a density over the boundary, divided by 2
pi; its densities solve potential = given on the electrodes, normal slope = given elsewhere, and have integral
zero (which makes the solution unique for any size and any number of holes). Panels are halved where the
Legendre coefficients of a density haven't decayed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from handtouch.arrays import BoolArray, FloatArray
from handtouch.field._boundary_panels import NODES, TO_LEGENDRE, Panel
from handtouch.field.outline import ComplexArray

MAX_UNKNOWNS = 6000
_AHEAD_COSINE = 0.8
_MAX_LENGTH_WIDTHS = 1.5
_TWO_PI = 2 * np.pi
_TARGET_BATCH = 2048


class MixedProblem:
    """Unit potentials of `count` electrodes on panels, and the operators that follow.

    tolerance: contribution of the last Legendre coefficients of a panel, relative to the largest density, at
    which it isn't halved any more. Raises ValueError if more than MAX_UNKNOWNS are needed.
    """

    def __init__(self, panels: Sequence[Panel], count: int, tolerance: float) -> None:
        self.count = count
        self.panels = list(panels)
        while self._divide(tolerance):
            if self.unknowns > MAX_UNKNOWNS:
                raise ValueError(
                    f"outline: {self.unknowns} unknowns are needed, {MAX_UNKNOWNS} are the limit; "
                    "an electrode, a gap or a neck is too small"
                )

    @property
    def unknowns(self) -> int:
        """Number of unknowns of each density."""
        return len(self.panels) * NODES

    @property
    def nodes(self) -> ComplexArray:
        """Points of the boundary at which the densities are known (unknowns,), finer towards corners."""
        return np.asarray(self._anchor + self._offset)

    def potentials(self, z: ComplexArray) -> FloatArray:
        """Return the unit potentials at points (n,), shape (count, n)."""
        return np.concatenate([self._values(part)[0] for part in _batches(z)], axis=1)

    def potentials_and_slope(self, z: ComplexArray) -> tuple[FloatArray, ComplexArray]:
        """Return unit potentials and d/dx - i d/dy of them, both (count, n)."""
        parts = [self._values(part) for part in _batches(z)]
        return np.concatenate([p[0] for p in parts], axis=1), np.concatenate([p[1] for p in parts], axis=1)

    def log_spread(self, z: ComplexArray, image: ComplexArray, sign: FloatArray) -> FloatArray:
        """Return 2 pi times the regular part of Green's function at z (n,): ln of the spreading radius.

        image: reflections of z by the nearest edge, outside; sign: -1 for one that is an electrode, 1 for a
        bare one, 0 for none. The remainder is smooth at the boundary.
        """
        parts = zip(_batches(z), _batches(image), _batches(sign), strict=True)
        return np.concatenate([self._regular_part(*part) for part in parts])

    def _values(self, z: ComplexArray) -> tuple[FloatArray, ComplexArray]:
        logs, cauchy = self._kernels(z)
        values = self._density.T @ logs.T / -_TWO_PI + self._constant[:, None]
        return np.asarray(values), np.asarray(self._density.T @ cauchy.T / -_TWO_PI)

    def _regular_part(self, z: ComplexArray, image: ComplexArray, sign: FloatArray) -> FloatArray:
        from scipy.linalg import lu_solve

        data = np.zeros((self.unknowns + 1, z.size))
        for source, strength in ((z, 1.0), (image, sign)):
            distance = (self._anchor + self._offset)[:, None] - source
            data[:-1] += strength * np.where(
                self._on_electrode[:, None],
                np.log(np.abs(distance)),
                self._speed[:, None] * (self._normal[:, None] / distance).real,
            )
        solution = lu_solve(self._factors, data)
        logs, _ = self._kernels(z)
        smooth = solution[-1] - (logs.T * solution[:-1]).sum(axis=0) / _TWO_PI
        return np.asarray(smooth - sign * np.log(np.abs(z - image)))

    def _divide(self, tolerance: float) -> bool:
        """Solve on the present panels, unless some are too long; divide panels, and return True if any."""
        self._arrange()
        rough = self._long_panels()
        if not rough.any():
            self._solve()
            rough = self._rough_panels(tolerance)
        self.panels = [
            part
            for panel, divide in zip(self.panels, rough, strict=True)
            for part in (panel.divided() if divide else [panel])
        ]
        return bool(rough.any())

    def _arrange(self) -> None:
        panels = self.panels
        self._anchor = np.repeat([p.stretch.anchor for p in panels], NODES)
        self._offset = np.concatenate([p.offset for p in panels])
        self._weight = np.concatenate([p.weights for p in panels])
        self._normal = np.concatenate([p.normal for p in panels])
        self._speed = np.concatenate([p.speed for p in panels])
        self._electrode = np.repeat([p.stretch.electrode for p in panels], NODES)
        self._on_electrode = self._electrode >= 0

    def _solve(self) -> None:
        from scipy.linalg import lu_factor, lu_solve  # not loaded with the package

        size = self.unknowns
        distance = (self._anchor[:, None] - self._anchor) + (self._offset[:, None] - self._offset)
        np.fill_diagonal(distance, 1.0)
        with np.errstate(divide="ignore"):
            logs = np.log(np.abs(distance)) * self._weight
        slopes = (self._normal[:, None] / distance).real * self._weight
        del distance
        for index, panel in enumerate(self.panels):
            own = slice(index * NODES, (index + 1) * NODES)
            diagonal = np.arange(own.start, own.stop)
            slopes[diagonal, diagonal] = panel.half_curvature * panel.weights
            logs[own, own] = panel.self_log()
            relative = (self._anchor - panel.stretch.anchor) + self._offset
            near = panel.is_near(relative)
            near[own] = False
            targets = np.flatnonzero(near)
            if targets.size:
                log_block, cauchy = panel.near_blocks(relative[targets])
                logs[targets, own] = log_block
                slopes[targets, own] = (self._normal[targets, None] * cauchy).real
        outflow = np.diag(np.full(size, 0.5)) - slopes * (self._speed[:, None] / _TWO_PI)
        system = np.zeros((size + 1, size + 1))
        system[:size, :size] = np.where(self._on_electrode[:, None], logs / -_TWO_PI, outflow)
        system[:size, size] = self._on_electrode
        system[size, :size] = self._weight
        drive = np.zeros((size + 1, self.count))
        drive[:size] = self._electrode[:, None] == np.arange(self.count)
        self._factors = lu_factor(system, overwrite_a=True, check_finite=False)
        solution = lu_solve(self._factors, drive)
        self._density, self._constant = solution[:size], solution[size]
        collected = (self._electrode == np.arange(self.count)[:, None]) * self._weight
        self.conductance: FloatArray = collected @ (outflow @ self._density)
        self.boundary_potentials: FloatArray = (logs @ self._density / -_TWO_PI + self._constant).T
        """(count, unknowns), at `nodes`"""

    def _rough_panels(self, tolerance: float) -> BoolArray:
        by_panel = self._density.reshape(len(self.panels), NODES, self.count)
        tail = np.abs(np.einsum("kj,pjc->pkc", TO_LEGENDRE[-2:], by_panel)).max(axis=(1, 2))
        width = np.array([p.stop - p.start for p in self.panels])
        return np.asarray(tail * width > tolerance * np.abs(self._density).max())

    def _long_panels(self) -> BoolArray:
        """Return True for panels longer than the region is wide there, seen along their normals.

        Where it narrows towards a common corner, panels are graded already.
        """
        points, inward = self._anchor + self._offset, -self._normal
        chord = points - points[:, None]
        distance = np.abs(chord)
        ahead = (np.conj(inward)[:, None] * chord).real > _AHEAD_COSINE * distance
        ahead &= self._anchor != self._anchor[:, None]
        width = np.where(ahead, distance, np.inf).min(axis=1).reshape(-1, NODES)
        length = np.array([panel.length for panel in self.panels])
        return np.asarray(length > _MAX_LENGTH_WIDTHS * np.median(width, axis=1))

    def _kernels(self, z: ComplexArray) -> tuple[FloatArray, ComplexArray]:
        """Return the matrices (n, unknowns) that integrate ln |z - y| and 1 / (z - y) times a density."""
        distance = z[:, None] - (self._anchor + self._offset)
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.log(np.abs(distance)) * self._weight
            cauchy = self._weight / distance
        for index, panel in enumerate(self.panels):
            relative = z - panel.stretch.anchor
            targets = np.flatnonzero(panel.is_near(relative))
            if targets.size:
                own = slice(index * NODES, (index + 1) * NODES)
                logs[targets, own], cauchy[targets, own] = panel.near_blocks(relative[targets])
        return logs, cauchy


def _batches(values: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
    return np.array_split(values, max(1, -(-values.size // _TARGET_BATCH)))
