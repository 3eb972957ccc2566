"""Two sheets of different alpha under one contact: force and area both (paper 3.2).

Public names: `Sandwich`, `SandwichStrength`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handtouch.field._stack import stack_inverse
from handtouch.field.strength import LEAST_RATIO, NEAR_LIMIT, SURE, Status, contact_stack_resistance

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

_GRID, _STEPS = 33, 40
_SETTLED = 1e-10
_NEAR = 1 / NEAR_LIMIT - 1  # of the rest of the resistance: less under the contact no longer tells a force


@dataclass(frozen=True)
class SandwichStrength:
    """Force and radius of contacts; arrays of one shape (...).

    force_n, radius_m: NaN where the status is INVALID, and where a current is not positive. covariance: of
    (force [N], radius [m]), shape (..., 2, 2), from the noise of the currents; infinite variances where
    saturated. status, of `Status`:

    * VALID: one contact has such currents, and this is it.
    * SATURATED: more than one has, or the sheets carry all they can, or more than that. The force is a lower
      bound, the least at which both sheets carry so much.
    * BELOW: a current is not told from nothing, two standard deviations of its noise.
    * INVALID: an input is NaN, or no contact of an allowed radius has such currents.
    """

    force_n: FloatArray
    radius_m: FloatArray
    covariance: FloatArray
    status: npt.NDArray[np.uint8]


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
        currents = []
        with np.errstate(all="ignore"):
            pressure = force / radius / radius / np.pi
            outer = np.maximum(np.asarray(spreading_radius_m, np.float64), LEAST_RATIO * radius)
            for layer, alpha, sheet in self._sheets():
                sigma = layer * (self.reference_pa / pressure) ** alpha
                stack = contact_stack_resistance(sheet, sigma, radius, outer)
                currents.append(
                    np.asarray(drive_v, np.float64) / (stack + np.asarray(series_ohm, np.float64))
                )
        return np.stack(currents)

    @np.errstate(all="ignore")
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
        outer, series, drive = (
            np.broadcast_to(np.asarray(v, np.float64), shape).ravel()
            for v in (spreading_radius_m, series_ohm, drive_v)
        )
        noise = np.broadcast_to(np.asarray(current_std_a, np.float64), currents.shape).reshape(2, -1)
        read = currents.reshape(2, -1)
        current = np.where(read > 0, read, np.nan)
        whole = 2 * np.pi / sheets * drive / current
        resistors, largest = 2 * np.pi / sheets * series, np.log(outer) - np.log(LEAST_RATIO)
        stack = whole - resistors - np.log(outer)  # and ln radius
        least = _NEAR * (np.log(LEAST_RATIO) + resistors) - largest
        beyond = (stack < least).any(axis=0)
        log_radius, bounded = self._common_radius(np.maximum(stack, least), largest, beyond)
        # where both sheets are near their limits, the force at which they come near is all that is known
        near = _NEAR / (1 + _NEAR) * whole - log_radius
        limited = beyond | (stack < near).all(axis=0)
        log_force, by_radius, by_stack = self._log_force(
            np.where(limited, np.maximum(np.maximum(stack, least), near), stack), log_radius
        )
        force, radius = np.exp(log_force[0]), np.exp(log_radius)
        saturated = limited | bounded
        force = np.where(saturated, np.exp(log_force.max(axis=0)), force)
        by_current = -by_stack * whole  # d ln force / d ln current at given radius
        radius_rate = np.stack([-by_current[0], by_current[1]]) / (by_radius[0] - by_radius[1])
        force_rate = by_radius[0] * radius_rate + np.stack([by_current[0], np.zeros_like(by_current[0])])
        rates = np.stack([force * force_rate, radius * radius_rate]) * noise / current
        covariance = np.einsum("ikn,jkn->nij", rates, rates)
        covariance[saturated] = [[np.inf, 0.0], [0.0, np.inf]]
        status = np.where(
            np.isfinite(force), np.where(saturated, Status.SATURATED, Status.VALID), Status.INVALID
        )
        status = np.where((read <= SURE * noise).any(axis=0), Status.BELOW, status)
        return SandwichStrength(
            force.reshape(shape),
            radius.reshape(shape),
            covariance.reshape(*shape, 2, 2),
            status.astype(np.uint8).reshape(shape),
        )

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

    def _common_radius(
        self, stack: FloatArray, largest: FloatArray, beyond: BoolArray
    ) -> tuple[FloatArray, BoolArray]:
        """Ln radius at which both sheets give one force, and whether that is but a lower bound.

        A bound where there are more such radii, where two have just met and gone, and where the currents
        were beyond what the sheets carry: then it is the radius of the least force at which both carry so
        much. NaN where the forces would only agree beyond the allowed radii.
        """
        smallest = np.maximum(-stack.min(axis=0), np.log(self.least_radius_m))
        steps = np.linspace(1e-6, 1, _GRID)[:, None]
        grid = smallest + steps * (largest - smallest)
        log_force = self._log_force(np.tile(stack, _GRID), grid.ravel())[0].reshape(2, _GRID, -1)
        miss = log_force[0] - log_force[1]
        crossing = miss[:-1] * miss[1:] <= 0
        roots = crossing.sum(axis=0)
        # at the radius that saturates one sheet its force is infinite: a root may hide before the grid
        steep = np.where(stack[0] < stack[1], 1.0, -1.0) * (smallest > np.log(self.least_radius_m))
        hidden = steep * miss[0] < 0
        # at the radius that saturates one sheet its force is infinite: a root may hide before the grid
        steep = np.where(stack[0] < stack[1], 1.0, -1.0) * (smallest > np.log(self.least_radius_m))
        hidden = steep * miss[0] < 0
        nearest = np.argmin(np.abs(miss), axis=0)
        met = (nearest < _GRID - 1) & ((nearest > 0) | (steep != 0))
        bounded = (roots + hidden > 1) | ((roots == 0) & (beyond | hidden | met))
        cell, each = np.argmax(crossing, axis=0), np.arange(miss.shape[1])
        low, high = grid[cell, each], grid[cell + 1, each]
        at = np.where((roots == 1) & ~bounded & (smallest <= largest), (low + high) / 2, np.nan)
        at = self._meeting(stack, at, low, high, miss[cell, each] < 0)
        if bounded.any():
            least = np.argmin(log_force.max(axis=0)[:, bounded], axis=0)
            cells = np.clip([least - 1, least + 1], 0, _GRID - 1)
            at[bounded] = self._least(stack[:, bounded], *np.take_along_axis(grid[:, bounded], cells, axis=0))
        return at, bounded

    def _meeting(
        self, stack: FloatArray, at: FloatArray, low: FloatArray, high: FloatArray, rising: BoolArray
    ) -> FloatArray:
        """Newton's method for one force, kept between low and high by halving; NaN stays."""
        for _ in range(_STEPS):
            log_force, by_radius, _ = self._log_force(stack, at)
            off = log_force[0] - log_force[1]
            beyond = (off > 0) == rising
            low, high = np.where(beyond, low, at), np.where(beyond, at, high)
            new = at - off / (by_radius[0] - by_radius[1])
            new = np.where((new > low) & (new < high), new, (low + high) / 2)
            settled = np.abs(new - at) < _SETTLED
            at = new
            if (settled | np.isnan(at)).all():
                break
        return at

    def _least(self, stack: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
        """Ln radius of the least force at which both sheets carry so much, by thirds."""
        for _ in range(2 * _STEPS):
            left, right = low + (high - low) / 3, high - (high - low) / 3
            falls = self._log_force(stack, left)[0].max(axis=0) > self._log_force(stack, right)[0].max(axis=0)
            low, high = np.where(falls, left, low), np.where(falls, high, right)
        return (low + high) / 2
