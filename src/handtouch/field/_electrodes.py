"""Potentials of electrodes on the unit circle, insulated between them, to spectral accuracy.

Electrodes 0 .. m-1 follow each other counter-clockwise; gap j lies between electrode j and the next. With
e1, e2 the ends of a gap of half width h, s = sqrt(1 - zeta / e) and kappa = exp(i h / 2),

    D = s1 + kappa s2          Im 2 log D falls by pi across the gap, where its part that is the gap's own
    insulates K = (s1 - kappa s2) / D    Im K^n, n >= 1, vanishes on the circle outside the gap; Re K^n is
    T_n on it

The potential with electrode voltages V is the imaginary part of
Phi = - sum_j (V_j+1 - V_j) / pi * 2 log D_j + sum_jn c_jn K_j^n. It takes the voltages exactly, and real
coefficients c make Re Phi, the stream function, constant on every gap. Collocation at Chebyshev nodes of
the gaps gives c from a system that is the identity but for the gaps' influence on each other, so 8 to 32
terms are full precision for gaps of any smallness; as they close, c vanishes and the angles that electrodes
subtend remain. The steps of the stream function are the currents. (Expanding on the electrodes instead
needs about 400 functions each for gaps of 1 %.)
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray
from handtouch.field._disc import CirclePoints

ComplexArray = npt.NDArray[np.complex128]

_TERM_COUNTS = (8, 16, 32, 64, 128, 256, 512)  # tried in turn
_MIN_GAP_RAD = 1e-280  # rad: a gap of 1e-140 of a side, next to denormals
_MAX_TAIL, _MAX_ROUNDING_TAIL = 1e-14, 1e-9


class ElectrodePotentials:
    """Unit potentials phi_i of m electrodes: phi_i is 1 on electrode i and 0 on the others.

    `ends`, `starts`: points where electrode j ends and where the next one starts, counter-clockwise; a gap
    may be zero. `inside`: any point on electrode 0. Points are given by their defects from the corners, shape
    (4, ...). Raises ValueError when electrodes are so short beside the gaps that 512 terms per gap don't
    suffice.
    """

    def __init__(self, ends: CirclePoints, starts: CirclePoints, inside: ComplexArray) -> None:
        self.count = ends.angle.size
        self._ends = (ends, starts)
        width = np.diagonal(ends.angle_to(starts.corner, starts.angle))
        width = np.where(width < 0, width + 2 * np.pi, width)
        self._half = np.where(width > _MIN_GAP_RAD, width / 2, 0.0)
        self._kappa = np.exp(0.5j * self._half)
        # d K / d zeta = this / (s1 s2 D^2); the difference of the ends is formed without cancellation
        self._slope = self._kappa * ends.inverse * np.expm1(-2j * self._half)
        identity = np.eye(self.count)
        self._log_weights = (identity - np.roll(identity, -1, axis=1)) * (2 / np.pi)
        self._solve()
        self._offset = np.zeros(self.count)
        self._offset = identity[0] - self.potentials(inside)

    def potentials(self, defects: ComplexArray) -> FloatArray:
        """Return the unit potentials at points, shape (m, ...)."""
        flat = defects.reshape(4, -1)
        first, last = self._roots(flat)
        total = first + last
        values = self._log_weights @ np.angle(total) + self._offset[:, None]
        if self.terms:
            powers = _powers((first - last) / total, self.terms).imag
            values += self.coefficients @ powers.reshape(self.count * self.terms, -1)
        return np.asarray(values.reshape((self.count, *defects.shape[1:])))

    def potentials_and_slope(self, defects: ComplexArray) -> tuple[FloatArray, ComplexArray]:
        """Return unit potentials and d Phi / d zeta, both (m, ...); the slope is infinite at electrodes'
        ends.
        """
        flat = defects.reshape(4, -1)
        first, last = self._roots(flat)
        total = first + last
        values = self._log_weights @ np.angle(total) + self._offset[:, None]
        inverse = [ends.inverse[:, None] for ends in self._ends]
        with np.errstate(divide="ignore", invalid="ignore"):
            log_slope = -(inverse[0] / first + self._kappa[:, None] ** 2 * inverse[1] / last) / (2 * total)
        slope = self._log_weights @ log_slope
        if self.terms:
            powers = _powers((first - last) / total, self.terms)
            values += self.coefficients @ powers.imag.reshape(self.count * self.terms, -1)
            with np.errstate(divide="ignore", invalid="ignore"):
                inner = (self._slope * self._kappa)[:, None] / (first * last * total * total)
            order = np.arange(1, self.terms + 1)[:, None, None]
            lower = np.concatenate([np.ones_like(powers[:1]), powers[:-1]])
            slope += self.coefficients @ (order * lower * inner).reshape(self.count * self.terms, -1)
        shape = (self.count, *defects.shape[1:])
        return values.reshape(shape), slope.reshape(shape)

    def log_spread(self, defects: ComplexArray) -> FloatArray:
        """Return ln of the factor by which the gaps enlarge the disc's conformal radius at zeta.

        2 pi times the regular part of Green's function, gaps insulated, less that of the closed circle.
        """
        flat = defects.reshape(4, -1)
        first, last = self._roots(flat)
        inner = (first - last) / (first + last)
        with np.errstate(divide="ignore", invalid="ignore"):
            own = np.log(np.abs(1 - inner * inner) / (1 - np.abs(inner) ** 2))
        spread = 2 * own.sum(axis=0)
        if self.terms:
            data = _powers(inner, self.terms).imag.reshape(self.count * self.terms, -1)
            spread += (data * (self._mutual @ data)).sum(axis=0)
        return np.asarray(spread.reshape(defects.shape[1:]))

    def _roots(self, flat: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return s1 and kappa s2 of every gap, each (m, points)."""
        first, last = (np.sqrt(ends.factors(flat)) for ends in self._ends)
        return first, self._kappa[:, None] * last

    def _solve(self) -> None:
        """Solve for coefficients (m, terms * m), conductances (m, m), and the gaps' influence on each
        other.
        """
        previous = np.inf
        for terms in _TERM_COUNTS:
            unknowns, stream, response = self._collocate(terms)
            by_order = np.abs(unknowns.reshape(self.count, terms, -1)).max(axis=(0, 2))
            tail = by_order[3 * terms // 4 :].max()
            # the tail converges quadratically; a constant one is rounding, larger on long pads
            if tail < _MAX_TAIL or (tail < _MAX_ROUNDING_TAIL and tail > previous / 10):
                break
            previous = tail
        else:
            raise ValueError(
                f"electrodes: one is too short compared with its neighbouring gaps; "
                f"{terms} terms per gap leave {tail:.1e}"
            )
        self.terms = int(np.flatnonzero(by_order > max(tail, _MAX_TAIL / 100)).max(initial=-1)) + 1
        kept = self.terms * self.count
        self.coefficients = unknowns[:, :kept]
        self._mutual = (response - np.eye(response.shape[0]))[:kept, :kept] * np.repeat(
            4 / np.arange(1, self.terms + 1), self.count
        )
        self.conductance = np.roll(stream, 1, axis=1) - stream if (self._half > 0).all() else None

    def _collocate(self, terms: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return coefficients (m, terms * m), stream function on the gaps (m, m), and inverse of the
        system.
        """
        gaps = self.count
        polar = (np.arange(terms + 1) + 0.5) * np.pi / (terms + 1)
        project = np.cos(np.outer(np.arange(terms + 1), polar)) * (2 / (terms + 1))
        project[0] /= 2
        system = np.zeros((terms, gaps, terms, gaps))
        drive = np.zeros((terms, gaps, gaps))  # [term, gap, source of log D]
        level = np.zeros((gaps, gaps))
        influence = np.zeros((gaps, terms, gaps))  # constant part, by [gap, term, source]
        for gap in map(int, np.flatnonzero(self._half > 0)):
            first, last = self._roots_on(gap, np.cos(polar))
            total = first + last
            logs = project @ np.log(np.abs(total)).T
            powers = _powers((first - last) / total, terms).real  # (terms, gaps, nodes)
            fields = np.tensordot(project, powers, axes=(1, 2))
            fields[:, :, gap] = 0.0
            system[:, gap], influence[gap] = fields[1:], fields[0]
            drive[:, gap], level[gap] = logs[1:], logs[0]
        size = terms * gaps
        response = np.linalg.inv(np.eye(size) + system.reshape(size, size))
        unknowns = -response @ drive.reshape(size, gaps) @ self._log_weights.T
        unknowns[~np.tile(self._half > 0, terms)] = 0.0
        stream = level @ self._log_weights.T + influence.reshape(gaps, size) @ unknowns
        return unknowns.T, stream.T, np.asarray(response, np.float64)

    def _roots_on(self, gap: int, nodes: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Return `_roots` on a gap at nodes in (-1, 1), from angles that keep their small differences."""
        half = self._half[gap]
        aside = 2 * np.arctan(nodes * np.tan(half / 2))
        corner, angle = int(self._ends[0].corner[gap]), self._ends[0].angle[gap] + half + aside
        first, last = (_boundary_root(ends.angle_to(corner, angle)) for ends in self._ends)
        # on the gap itself from the angles directly: their sums would lose digits of a small gap
        first[gap], last[gap] = _boundary_root(half + aside), _boundary_root(aside - half)
        return first, self._kappa[:, None] * last


def _boundary_root(angle: FloatArray) -> ComplexArray:
    """sqrt(1 - exp(i angle)) for angles in (-pi, pi]."""
    size = np.abs(angle)
    return np.asarray(np.sqrt(2 * np.sin(size / 2)) * np.exp(0.25j * np.sign(angle) * (size - np.pi)))


def _powers(base: ComplexArray, count: int) -> ComplexArray:
    """Powers 1 .. count of base, along a new first axis."""
    return np.multiply.accumulate(np.broadcast_to(base, (count, *base.shape)), axis=0)
