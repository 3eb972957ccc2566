"""Two sheets of different alpha under one contact: force and area both (paper 3.2).

Public names: `Sandwich`, `SandwichStrength`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handtouch.field._stack import stack_inverse
from handtouch.field.strength import LEAST_RATIO, contact_stack_resistance

FloatArray = npt.NDArray[np.float64]

_GRID, _STEPS = 33, 40
_SETTLED = 1e-10


@dataclass(frozen=True)
class SandwichStrength:
    """Force and radius of contacts; arrays of one shape (...), NaN where no contact has such currents.

    covariance: of (force [N], radius [m]), shape (..., 2, 2), from the noise of the currents.
    """

    force_n: FloatArray
    radius_m: FloatArray
    covariance: FloatArray


@dataclass(frozen=True)
class Sandwich:
    """Two sheets whose layers obey eq. 12 with different alpha and meet the same force on the same disc.

    contact_ohm_m2 at reference_pa, alpha and sheet_ohm_per_square have one number for each sheet. Contacts
    have radii from least_radius_m to half the spreading radius. Raises ValueError unless all are positive and
    finite and the alphas differ.
    """

    contact_ohm_m2: tuple[float, float]
    alpha: tuple[float, float]
    sheet_ohm_per_square: tuple[float, float]
    reference_pa: float = 1e5
    least_radius_m: float = 2e-4

    def __post_init__(self) -> None:
        for name in ("contact_ohm_m2", "alpha", "sheet_ohm_per_square", "reference_pa", "least_radius_m"):
            value = np.asarray(getattr(self, name), np.float64)
            if not ((value > 0) & np.isfinite(value)).all():
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)}")
        if self.alpha[0] == self.alpha[1]:
            raise ValueError("alpha must differ between the sheets, or force and area cannot be told apart")

    def currents(
        self,
        force_n: npt.ArrayLike,
        radius_m: npt.ArrayLike,
        drive_v: npt.ArrayLike,
        spreading_radius_m: npt.ArrayLike,
        series_ohm: npt.ArrayLike = 0.0,
    ) -> FloatArray:
        """Total currents of the two sheets [A], shape (2, ...); all arguments of broadcast shape (...)."""
        force, radius = np.broadcast_arrays(np.asarray(force_n, np.float64), np.asarray(radius_m, np.float64))
        pressure = force / (np.pi * radius**2)
        outer = np.maximum(np.asarray(spreading_radius_m, np.float64), LEAST_RATIO * radius)
        currents = []
        for layer, alpha, sheet in self._sheets():
            sigma = layer * (self.reference_pa / pressure) ** alpha
            stack = contact_stack_resistance(sheet, sigma, radius, outer)
            currents.append(np.asarray(drive_v, np.float64) / (stack + np.asarray(series_ohm, np.float64)))
        return np.stack(currents)

    def force(
        self,
        currents_a: npt.ArrayLike,
        drive_v: npt.ArrayLike,
        spreading_radius_m: npt.ArrayLike,
        series_ohm: npt.ArrayLike = 0.0,
        *,
        current_std_a: npt.ArrayLike = 0.0,
    ) -> SandwichStrength:
        """Force and radius from the two total currents (2, ...), the inverse of `currents` to 1e-8.

        Newton's method on ln(radius): each sheet by itself gives a force for an assumed radius, and the
        radius is right where both give the same. current_std_a: noise, broadcast against `currents_a`.
        """
        currents = np.asarray(currents_a, np.float64)
        if currents.shape[:1] != (2,):
            raise ValueError(f"currents_a has shape {currents.shape}: the first axis is the two sheets")
        shape = currents.shape[1:]
        sheets = np.asarray(self.sheet_ohm_per_square)[:, None]
        log_outer, resistors, drive = (
            np.broadcast_to(np.asarray(v, np.float64), shape).ravel()
            for v in (np.log(spreading_radius_m), series_ohm, drive_v)
        )
        noise = np.broadcast_to(np.asarray(current_std_a, np.float64), currents.shape).reshape(2, -1)
        with np.errstate(all="ignore"):
            current = np.where(currents > 0, currents, np.nan).reshape(2, -1)
            whole = 2 * np.pi / sheets * drive / current
            stack = whole - 2 * np.pi / sheets * resistors - log_outer  # and ln radius
            log_radius = self._common_radius(stack, log_outer - np.log(LEAST_RATIO))
            log_force, by_radius, by_stack = self._log_force(stack, log_radius)
            by_current = -by_stack * whole  # d ln force / d ln current at given radius
            radius_rate = np.stack([-by_current[0], by_current[1]]) / (by_radius[0] - by_radius[1])
            force_rate = by_radius[0] * radius_rate + np.stack([by_current[0], np.zeros_like(by_current[0])])
            force, radius = np.exp(log_force[0]), np.exp(log_radius)
            rates = np.stack([force * force_rate, radius * radius_rate]) * noise / current
            covariance = np.einsum("ikn,jkn->nij", rates, rates)
        return SandwichStrength(force.reshape(shape), radius.reshape(shape), covariance.reshape(*shape, 2, 2))

    def _sheets(self) -> zip[tuple[float, float, float]]:
        return zip(self.contact_ohm_m2, self.alpha, self.sheet_ohm_per_square, strict=True)

    def _log_force(
        self, stack: FloatArray, log_radius: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Ln force by each sheet (2, n), its derivative by ln radius, and by the stack's factor alone."""
        layer, alpha, sheet = (
            np.asarray(v)[:, None] for v in (self.contact_ohm_m2, self.alpha, self.sheet_ohm_per_square)
        )
        log_x2, slope = stack_inverse(0.0)(stack + log_radius)
        log_k = np.log(layer) + alpha * np.log(self.reference_pa)
        log_force = np.log(np.pi) + 2 * log_radius + (log_x2 + log_k - np.log(sheet) - 2 * log_radius) / alpha
        by_stack = slope / alpha
        return log_force, by_stack + 2 - 2 / alpha, by_stack

    def _common_radius(self, stack: FloatArray, largest: FloatArray) -> FloatArray:
        """Ln radius at which both sheets give one force; NaN where there is none, or more than one."""
        smallest = np.maximum(-stack.min(axis=0), np.log(self.least_radius_m))
        steps = np.linspace(1e-6, 1, _GRID)[:, None]
        grid = (smallest + steps * (largest - smallest)).ravel()
        log_force, _, _ = self._log_force(np.tile(stack, _GRID), grid)
        miss = (log_force[0] - log_force[1]).reshape(_GRID, -1)
        crossing = miss[:-1] * miss[1:] <= 0
        one = (crossing.sum(axis=0) == 1) & (smallest < largest)
        first, each = np.argmax(crossing, axis=0), np.arange(miss.shape[1])
        grid = grid.reshape(_GRID, -1)
        low, high = grid[first, each], grid[np.minimum(first + 1, _GRID - 1), each]
        rising = miss[first, each] < 0
        at = np.where(one, (low + high) / 2, np.nan)
        for _ in range(_STEPS):
            log_force, by_radius, _ = self._log_force(stack, at)
            off = log_force[0] - log_force[1]
            beyond = (off > 0) == rising
            low, high = np.where(beyond, low, at), np.where(beyond, at, high)
            new = at - off / (by_radius[0] - by_radius[1])
            new = np.where((new > low) & (new < high), new, (low + high) / 2)
            settled = np.abs(new - at) < _SETTLED
            at = new
            if (settled | ~one).all():
                break
        return at
