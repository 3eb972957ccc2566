"""Contact law: total current to force and back, through the sheet and a pressure-dependent contact.

Public names: `contact_stack_resistance`, `ContactLaw`, `ForceEstimate`, `ForceEstimateStatus`.

A contact of radius A meets three resistances in series: the pressed layer and the sheet under it, eq. 11; the
sheet from there to the electrodes, sheet / (2 pi) ln(R / A) with R the conformal or spreading radius at its
position; and the series resistors. The layer's specific resistance falls with pressure, eq. 12.

The radius of the contact is an assumption, returned with every force (`ForceEstimate.radius_m`).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray
from handtouch.field.contact_stack import stack_factor, stack_inverse

MAX_CURRENT_FRACTION = 0.98  # current over the sheet's maximum: beyond it a force is a lower bound
BOUND_SIGMA = 2.0  # standard deviations
MIN_SPREADING_RATIO = 2.0
"""Spreading over contact radius; nearer an edge the sheet's resistance is taken as here."""
_MIN_LOG_SPREADING_RATIO = float(np.log(MIN_SPREADING_RATIO))
_MIN_CURRENT_A = 1e-200


def contact_stack_resistance(
    sheet_ohm_per_square: npt.ArrayLike,
    contact_ohm_m2: npt.ArrayLike,
    radius_m: npt.ArrayLike,
    outer_m: npt.ArrayLike,
) -> FloatArray:
    """Resistance V / I of eq. 11 [ohm]: a disc pressed on the middle of a sheet through a resistive layer.

    sheet_ohm_per_square: rho / w. contact_ohm_m2: resistance times area of the layer, sigma; 0 and infinity
    are perfect contact and none. radius_m: of the disc, A. outer_m: where the sheet is grounded, B >= A; NaN
    if less. All positive, of broadcast shape (...), which is that of the answer. With x = A sqrt((rho/w) /
    sigma) the paper's series are (rho / 2 pi w) [I0(x) / (x I1(x)) + ln(B / A)]; relative error a few 1e-16
    for x^2 of 1e-12 to 1e12.
    """
    sheet, layer, radius, outer = np.broadcast_arrays(
        *(np.asarray(v, np.float64) for v in (sheet_ohm_per_square, contact_ohm_m2, radius_m, outer_m))
    )
    with np.errstate(all="ignore"):
        factor = stack_factor(radius * (np.sqrt(sheet) / np.sqrt(layer)))
        spread = np.where(outer >= radius, np.log1p((outer - radius) / radius), np.nan)
        return np.asarray(sheet * ((factor + spread) / (2 * np.pi)))[()]


def log_stack_inverse(factor: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return ln x^2 where I0(x) / (x I1(x)) is `factor` (> 0), and its derivative by the factor.

    The stack factor of eq. 11, without the spreading to the electrodes; relative error of x^2 below 1e-9.
    """
    return stack_inverse(0.0)(np.asarray(factor, np.float64))


class ForceEstimateStatus(IntEnum):
    """Status of a force estimate."""

    VALID = 0
    LOWER_BOUND = 1  # the sheet is at its limit: force_n is a lower bound (2 sigma), std_n infinite
    BELOW_THRESHOLD = 2  # within the noise, or below the threshold of useful response
    INVALID = 3  # an input was NaN, or no contact carries such a current
    WIDE = (
        4  # the daemon's: the current leaves the force open within a factor of three or more, as in corners
    )


_VALID, _LOWER_BOUND, _BELOW_THRESHOLD, _INVALID, _ = map(
    np.uint8, ForceEstimateStatus
)  # looking up a member takes a microsecond


@dataclass(frozen=True)
class ForceEstimate:
    """Force of contacts; arrays of one shape (...).

    force_n: newton; where saturated a lower bound of 2 sigma, 0 where no current flows. std_n: its standard
    deviation from noise of the current, of the radius and of the position. status: of `ForceEstimateStatus`.
    radius_m: the contact radius that the law assumed.
    """

    force_n: FloatArray
    std_n: FloatArray
    status: npt.NDArray[np.uint8]
    radius_m: FloatArray


@dataclass(frozen=True)
class ContactLaw:
    """Specific resistance of a layer by pressure, sigma = contact_ohm_m2 (pressure / reference_pa)^-alpha.

    That is eq. 12 with k = contact_ohm_m2 reference_pa^alpha. alpha: 1.5 for the paper's S1; at 1 the current
    doesn't depend on the area while the layer dominates. radius_m: of the contact: fixed if `hertz_n` is
    None, else that at the force `hertz_n`, from which it grows as force^(1/3). radius_std_m: its standard
    deviation.

    Every field but `hertz_n` may be an array (n,), one element for each contact; with `hertz_n` all must
    share one alpha. Raises ValueError for values that aren't positive and finite.
    """

    contact_ohm_m2: npt.ArrayLike
    alpha: npt.ArrayLike
    radius_m: npt.ArrayLike
    radius_std_m: npt.ArrayLike = 0.0
    reference_pa: npt.ArrayLike = 1e5
    hertz_n: float | None = None

    def __post_init__(self) -> None:
        for name in ("contact_ohm_m2", "alpha", "radius_m", "reference_pa"):
            value = np.asarray(getattr(self, name), np.float64)
            if not ((value > 0) & np.isfinite(value)).all():
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)}")
        spread = np.asarray(self.radius_std_m, np.float64)
        if not ((spread >= 0) & np.isfinite(spread)).all():
            raise ValueError(f"radius_std_m must be at least 0 and finite, got {self.radius_std_m}")
        if self.hertz_n is not None and not 0 < self.hertz_n < np.inf:
            raise ValueError(f"hertz_n must be positive and finite, got {self.hertz_n}")
        if self.hertz_n is not None and np.ptp(np.asarray(self.alpha, np.float64)) > 0:
            raise ValueError("alpha must be one number where hertz_n is given")

    @np.errstate(all="ignore")
    def radius(self, force_n: npt.ArrayLike) -> FloatArray:
        """Return the radius of the contact [m] at a force [N]."""
        force = np.asarray(force_n, np.float64)
        radius = np.asarray(self.radius_m, np.float64)
        if self.hertz_n is None:
            return np.asarray(np.where(np.isnan(force), np.nan, radius))
        return np.asarray(radius * np.cbrt(force / self.hertz_n))

    @np.errstate(all="ignore")
    def resistivity(self, force_n: npt.ArrayLike) -> FloatArray:
        """Return the specific resistance of the layer [ohm m^2] under a force [N]; infinite without force."""
        force = np.asarray(force_n, np.float64)
        pressure = np.where(force == 0, 0.0, force / (np.pi * self.radius(force) ** 2))
        ratio = np.asarray(self.reference_pa, np.float64) / pressure
        return np.asarray(np.asarray(self.contact_ohm_m2, np.float64) * ratio ** np.asarray(self.alpha))

    def current(
        self,
        force_n: npt.ArrayLike,
        drive_v: npt.ArrayLike,
        sheet_ohm_per_square: npt.ArrayLike,
        spreading_radius_m: npt.ArrayLike,
        series_ohm: npt.ArrayLike = 0.0,
    ) -> FloatArray:
        """Return the total current [A] under a force [N], NaN if negative; other arguments as for `force`."""
        force, sheet = np.asarray(force_n, np.float64), np.asarray(sheet_ohm_per_square, np.float64)
        with np.errstate(all="ignore"):
            radius = self.radius(force)
            outer = np.maximum(np.asarray(spreading_radius_m, np.float64), MIN_SPREADING_RATIO * radius)
            stack = contact_stack_resistance(sheet, self.resistivity(force), radius, outer)
            current = np.asarray(drive_v, np.float64) / (stack + np.asarray(series_ohm, np.float64))
            return np.asarray(np.where(force == 0, 0.0 * current, current))

    def force(
        self,
        current_a: npt.ArrayLike,
        drive_v: npt.ArrayLike,
        sheet_ohm_per_square: npt.ArrayLike,
        spreading_radius_m: npt.ArrayLike,
        series_ohm: npt.ArrayLike = 0.0,
        *,
        current_std_a: npt.ArrayLike = 0.0,
        spreading_std: npt.ArrayLike = 0.0,
        threshold_n: npt.ArrayLike = 0.0,
    ) -> ForceEstimate:
        """Return the force for a total current [A]; the inverse of `current` to 1e-9, without iteration.

        drive_v: potential of the conducting layer [V]. spreading_radius_m: R at the position,
        `conformal_radius` or `ElectrodeNetwork.spreading_radius`, times the surface's scale [m]. series_ohm:
        resistance added by series resistors there, `ElectrodeNetwork.series_resistance`. current_std_a: noise
        of the current. spreading_std: standard deviation of ln R, from that of the position. threshold_n:
        least force of useful response. All broadcast to the result's shape.

        Where the current, or the current and two standard deviations of noise, reach the limit of the sheet,
        the status is `LOWER_BOUND`: a bound with a margin of two standard deviations (of noise, position and
        radius). Contacts nearer an edge than their own radius are treated as at that distance.
        """
        terms = self._terms
        with np.errstate(all="ignore"):
            current, noise, sheet = (
                np.asarray(v, np.float64) for v in (current_a, current_std_a, sheet_ohm_per_square)
            )
            log_sheet, per_sheet = np.log(sheet), 2 * np.pi / sheet
            log_radius = terms.log_radius - terms.growth * log_sheet
            spread = np.log(np.asarray(spreading_radius_m, np.float64)) - log_radius
            resistors = per_sheet * np.asarray(series_ohm, np.float64)
            spread, least = self._min_stack(spread, resistors)
            effective = np.maximum(np.maximum(current, noise), _MIN_CURRENT_A)
            whole = per_sheet * np.asarray(drive_v, np.float64) / effective
            stack = whole - resistors - spread
            ratio = noise / effective
            variance = (whole * ratio) ** 2 + np.asarray(spreading_std, np.float64) ** 2
            margin = BOUND_SIGMA * np.sqrt(variance + terms.radius_weight**2 * terms.radius_variance)
            saturated = stack - margin <= least
            margin = margin / np.maximum(
                1 - BOUND_SIGMA * ratio, 0.1
            )  # the stack factor is inverse to the current
            log_x2, slope = stack_inverse(terms.growth)(
                np.where(saturated, np.maximum(stack + margin, least), stack)
            )
            force = np.exp(terms.power * (log_x2 - log_sheet) + terms.offset)
            by_stack = terms.power * slope
            by_radius = by_stack * terms.radius_weight + terms.direct_weight
            std = force * np.sqrt(by_stack**2 * variance + by_radius**2 * terms.radius_variance)
            force = np.where(current > 0, force, 0.0 * current)
            below = (current <= BOUND_SIGMA * noise) | (force < threshold_n)
            status = np.where(below, _BELOW_THRESHOLD, np.where(saturated, _LOWER_BOUND, _VALID))
            return ForceEstimate(
                force,
                np.where(saturated, np.inf, std),
                np.where(np.isfinite(force), status, _INVALID),
                np.exp(log_radius + terms.growth * log_x2),
            )

    def _min_stack(self, spread: FloatArray, resistors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ln(R / A) at x = 1, limited near edges, and the least stack factor that determines a
        force.
        """
        if self.hertz_n is None:
            spread = np.maximum(spread, _MIN_LOG_SPREADING_RATIO)
            return spread, (1 / MAX_CURRENT_FRACTION - 1) * (spread + resistors)
        beyond = spread - _MIN_LOG_SPREADING_RATIO
        return spread, stack_factor(np.exp(beyond / (2 * self._terms.growth))) - beyond

    @cached_property
    @np.errstate(all="ignore")
    def _terms(self) -> _LogLawTerms:
        layer, alpha, radius, spread, reference = (
            np.asarray(getattr(self, name), np.float64) for name in _LAW_COLUMNS
        )
        log_k, log_s = np.log(layer) + alpha * np.log(reference), np.log(radius)
        variance = (spread / radius) ** 2
        if self.hertz_n is None:
            offset = np.log(np.pi) + 2 * log_s + (log_k - 2 * log_s) / alpha
            return _LogLawTerms(
                power=1 / alpha,
                growth=0.0,
                offset=offset,
                log_radius=log_s,
                radius_variance=variance,
                radius_weight=np.ones_like(alpha),
                direct_weight=2 - 2 / alpha,
            )
        growth = 1 / (2 + float(alpha.flat[0]))
        log_s = log_s - np.log(self.hertz_n) / 3  # radius = s force^(1/3)
        offset = 3 * growth * (log_k - (2 - 2 * alpha) * log_s + alpha * np.log(np.pi))
        return _LogLawTerms(
            power=np.full_like(alpha, 3 * growth),
            growth=growth,
            offset=offset,
            log_radius=log_s + offset / 3,
            radius_variance=variance,
            radius_weight=3 * alpha * growth,
            direct_weight=6 * (alpha - 1) * growth,
        )


class _LogLawTerms(NamedTuple):
    """A law in logarithms, x as in eq. 11.

    ln force = power (ln x^2 - ln sheet) + offset, ln radius = log_radius + growth (ln x^2 - ln sheet).
    radius_variance: of ln radius. radius_weight, direct_weight: derivatives of ln radius at x = 1, and of ln
    force at given x, by it.
    """

    power: FloatArray
    growth: float
    offset: FloatArray
    log_radius: FloatArray
    radius_variance: FloatArray
    radius_weight: FloatArray
    direct_weight: FloatArray


_LAW_COLUMNS = ("contact_ohm_m2", "alpha", "radius_m", "radius_std_m", "reference_pa")
