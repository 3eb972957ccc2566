"""Two sheets of different alpha under one contact: force and area both (paper 3.2).

Public names: `Sandwich`, `SandwichEstimate`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handtouch.field.contact_law import (
    BOUND_SIGMA,
    MAX_CURRENT_FRACTION,
    MIN_SPREADING_RATIO,
    ForceEstimateStatus,
    contact_stack_resistance,
)
from handtouch.field.contact_stack import stack_inverse

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

_GRID_POINTS, _MAX_STEPS = 33, 40
_LOG_RADIUS_TOLERANCE = 1e-10
_MIN_STACK_FRACTION = 1 / MAX_CURRENT_FRACTION - 1
"""Least part of the contact over the rest of the resistance that determines a force."""


@dataclass(frozen=True)
class SandwichEstimate:
    """Force and radius of contacts; arrays of one shape (...).

    force_n, radius_m: NaN where the status is INVALID, and where a current isn't positive. covariance: of
    (force [N], radius [m]), shape (..., 2, 2), from the noise of the currents; infinite variances at a lower
    bound. status, of `ForceEstimateStatus`:

    * VALID: exactly one contact has such currents.
    * LOWER_BOUND: several contacts have, or the sheets are at their limit or beyond. The force is the
      least at which both sheets carry such currents.
    * BELOW_THRESHOLD: a current is within two standard deviations of its noise.
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
    have radii from min_radius_m to half the spreading radius. Raises ValueError unless all are positive and
    finite and the alphas differ.
    """

    contact_ohm_m2: tuple[float, float]
    alpha: tuple[float, float]
    sheet_ohm_per_square: tuple[float, float]
    reference_pa: float = 1e5
    min_radius_m: float = 2e-4

    def __post_init__(self) -> None:
        for name in ("contact_ohm_m2", "alpha", "sheet_ohm_per_square", "reference_pa", "min_radius_m"):
            value = np.asarray(getattr(self, name), np.float64)
            if not ((value > 0) & np.isfinite(value)).all():
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)}")
        if self.alpha[0] == self.alpha[1]:
            raise ValueError("alpha must differ between the sheets, or force and area can't be separated")

    def currents(
        self,
        force_n: npt.ArrayLike,
        radius_m: npt.ArrayLike,
        drive_v: npt.ArrayLike,
        spreading_radius_m: npt.ArrayLike,
        series_ohm: npt.ArrayLike = 0.0,
    ) -> FloatArray:
        """Return the total currents of the two sheets [A], shape (2, ...), for arguments of broadcast shape
        (...).
        """
        force, radius = np.broadcast_arrays(np.asarray(force_n, np.float64), np.asarray(radius_m, np.float64))
        currents = []
        with np.errstate(all="ignore"):
            pressure = force / radius / radius / np.pi
            outer = np.maximum(np.asarray(spreading_radius_m, np.float64), MIN_SPREADING_RATIO * radius)
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
    ) -> SandwichEstimate:
        """Return force and radius for the two total currents (2, ...), the inverse of `currents` to 1e-8.

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
        resistors, largest = 2 * np.pi / sheets * series, np.log(outer) - np.log(MIN_SPREADING_RATIO)
        stack = whole - resistors - np.log(outer)  # and ln radius
        least = _MIN_STACK_FRACTION * (np.log(MIN_SPREADING_RATIO) + resistors) - largest
        beyond = (stack < least).any(axis=0)
        log_radius, bounded = self._common_radius(np.maximum(stack, least), largest, beyond)
        # with both sheets near their limits, only a bound of the force is known
        near = _MIN_STACK_FRACTION / (1 + _MIN_STACK_FRACTION) * whole - log_radius
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
            np.isfinite(force),
            np.where(saturated, ForceEstimateStatus.LOWER_BOUND, ForceEstimateStatus.VALID),
            ForceEstimateStatus.INVALID,
        )
        status = np.where(
            (read <= BOUND_SIGMA * noise).any(axis=0), ForceEstimateStatus.BELOW_THRESHOLD, status
        )
        return SandwichEstimate(
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
        """Return ln force by each sheet (2, n), its derivative by ln radius, and by the stack's factor
        alone.
        """
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
        """Return ln radius at which both sheets give one force, and whether it is a lower bound only.

        A bound where there are several such radii, where two have just merged, and where the currents exceed
        what the sheets carry: then it is the radius of the least force at which both carry as much. NaN where
        the forces would only agree beyond the allowed radii.
        """
        smallest = np.maximum(-stack.min(axis=0), np.log(self.min_radius_m))
        steps = np.linspace(1e-6, 1, _GRID_POINTS)[:, None]
        grid = smallest + steps * (largest - smallest)
        log_force = self._log_force(np.tile(stack, _GRID_POINTS), grid.ravel())[0].reshape(
            2, _GRID_POINTS, -1
        )
        miss = log_force[0] - log_force[1]
        crossing = miss[:-1] * miss[1:] <= 0
        roots = crossing.sum(axis=0)
        # the force is infinite at the radius that saturates one sheet: a root may lie before the grid
        steep = np.where(stack[0] < stack[1], 1.0, -1.0) * (smallest > np.log(self.min_radius_m))
        hidden = steep * miss[0] < 0
        nearest = np.argmin(np.abs(miss), axis=0)
        met = (nearest < _GRID_POINTS - 1) & ((nearest > 0) | (steep != 0))
        bounded = (roots + hidden > 1) | ((roots == 0) & (beyond | hidden | met))
        cell, each = np.argmax(crossing, axis=0), np.arange(miss.shape[1])
        low, high = grid[cell, each], grid[cell + 1, each]
        at = np.where((roots == 1) & ~bounded & (smallest <= largest), (low + high) / 2, np.nan)
        at = self._equal_force_radius(stack, at, low, high, miss[cell, each] < 0)
        if bounded.any():
            least = np.argmin(log_force.max(axis=0)[:, bounded], axis=0)
            cells = np.clip([least - 1, least + 1], 0, _GRID_POINTS - 1)
            at[bounded] = self._min_force_radius(
                stack[:, bounded], *np.take_along_axis(grid[:, bounded], cells, axis=0)
            )
        return at, bounded

    def _equal_force_radius(
        self, stack: FloatArray, at: FloatArray, low: FloatArray, high: FloatArray, rising: BoolArray
    ) -> FloatArray:
        """Solve for one force by Newton's method, bracketed between low and high; NaN stays."""
        for _ in range(_MAX_STEPS):
            log_force, by_radius, _ = self._log_force(stack, at)
            off = log_force[0] - log_force[1]
            beyond = (off > 0) == rising
            low, high = np.where(beyond, low, at), np.where(beyond, at, high)
            new = at - off / (by_radius[0] - by_radius[1])
            new = np.where((new > low) & (new < high), new, (low + high) / 2)
            settled = np.abs(new - at) < _LOG_RADIUS_TOLERANCE
            at = new
            if (settled | np.isnan(at)).all():
                break
        return at

    def _min_force_radius(self, stack: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
        """Return ln radius of the least force at which both sheets carry as much, by ternary search."""
        for _ in range(2 * _MAX_STEPS):
            left, right = low + (high - low) / 3, high - (high - low) / 3
            falls = self._log_force(stack, left)[0].max(axis=0) > self._log_force(stack, right)[0].max(axis=0)
            low, high = np.where(falls, left, low), np.where(falls, high, right)
        return (low + high) / 2
