"""Linearised contacts: affine functions of a pad's four currents, valid near its last solution.

A solution is expensive, and a contact moves little from one tick to the next. So every solution leaves a map,
affine in the currents, to all published values of the contact: a Gauss-Newton step from its last position,
with pad geometry and contact law differentiated. While the currents stay in the map's range a tick costs one
small matrix product per contact, and is as accurate as a solution; a position held constant would lag.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.core.pad_model import PadModel
from handtouch.field.bank import TableTangent
from handtouch.field.contact_law import ForceEstimateStatus
from handtouch.field.estimate import estimate_covariance

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]

VALUE_COUNT = 12
"""Number of values of a contact: xy (2), arc lengths (2), residual, position (3), normal (3), force."""
XY_COLUMNS, PAD_COLUMNS, RESIDUAL_COLUMN, POSITION_COLUMNS, NORMAL_COLUMNS, FORCE_COLUMN = (
    slice(0, 2),
    slice(2, 4),
    4,
    slice(5, 8),
    slice(8, 11),
    11,
)

_POSITION_DEPENDENT_COLUMNS = np.delete(np.arange(FORCE_COLUMN), RESIDUAL_COLUMN)
_RANGE_ROWS = 3  # rows of a map before the values: distance of x, y and total from its origin, 1 at range end
_TERM_COUNT = 7  # four currents over the relative total v, 1, v and v^2
_MAX_CURVATURE_SIGMA = 0.6  # error in a position from neglected curvature at range end [standard deviations]
_MIN_RANGE_SIGMA = 6.0  # range in standard deviations of a position
_MAX_POSITION_STD_REACH = 0.1  # standard deviation, in `reach`, above which a position has no useful tangent
_TOTAL_STEP_FRACTION = 0.05  # relative change of the total current that the force parabola is fitted over
_STENCIL_TOTALS = np.array([1, 1, 1, 1 - _TOTAL_STEP_FRACTION, 1 + _TOTAL_STEP_FRACTION])[:, None]
_STENCIL_POINTS = np.array([0, 1, 2, 0, 0])  # of these totals: at the position, along x, along y
MAX_GAUSS_NEWTON_DISTANCE = 8.0  # ranges from which one Gauss-Newton step leads back into the range
_MAX_FORCE_CURVATURE_FRACTION = 0.01  # of the force: where the parabola bends more, the range is smaller
_CURVATURE_TOLERANCE_FRACTION = 0.4  # of a tolerance: typical error at range end; twice that off the centre
_MAX_RANGE_REACH = 0.35  # range permitted by a tolerance, in `reach`
_MAX_SQUARED_MISFIT = 9.0
"""Squared misfit of a point contact, of one degree of freedom, that noise explains. Beyond it the covariance
is inflated by the excess (Birge, Phys. Rev. 40, 1932): where a contact is no point, or gains are off, the
errors of currents along the directions that move the position are as large as along the observable one."""
_MIN_INFORMATION = 1e-6  # of a position, per squared `reach`
_VALID, _SATURATED = int(ForceEstimateStatus.VALID), int(ForceEstimateStatus.LOWER_BOUND)


class ContactSolution(NamedTuple):
    """Results of a solution that hold within the range of its map; k rows."""

    covariance_m2: FloatArray
    force_std_n: FloatArray
    force_saturated: BoolArray
    residual_std: FloatArray


class ContactLinearisations:
    """Affine maps from currents to contact values, one for each pad of `model`."""

    def __init__(self, model: PadModel) -> None:
        self._model = model
        self._maps = np.full((model.size, _RANGE_ROWS + VALUE_COUNT, _TERM_COUNT), np.nan)
        self._per_total = np.full((model.size, 4), np.nan)
        self.force_requested = np.ones(model.size, dtype=np.bool_)
        """pads whose force is requested"""
        self.tolerance_m = np.zeros(model.size)
        """permitted position error from neglected curvature, where it exceeds what noise permits"""

    def share_state(self, other: ContactLinearisations) -> None:
        """Share the arrays of another object of the same pads."""
        self._maps, self._per_total = other._maps, other._per_total
        self.force_requested, self.tolerance_m = other.force_requested, other.tolerance_m

    def copy_state(self, other: ContactLinearisations) -> None:
        """Copy the arrays of another object of the same pads."""
        self._maps[:], self._per_total[:] = other._maps, other._per_total
        self.force_requested[:], self.tolerance_m[:] = other.force_requested, other.tolerance_m

    def discard(self, pads: IntArray) -> None:
        """Discard the maps of these pads."""
        self._maps[pads] = np.nan

    def evaluate(self, pads: IntArray, currents: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return values (k, VALUE_COUNT) for currents (k, 4) of pads (k,), and distances (k, 3) in ranges.

        A map is valid up to distance 1; NaN without a map.
        """
        terms = np.empty((len(pads), _TERM_COUNT, 1))
        total = np.matmul(self._per_total.take(pads, axis=0)[:, None], currents[:, :, None])[:, 0]
        np.divide(currents, total, out=terms[:, :4, 0])
        terms[:, 4] = 1.0
        terms[:, 5] = total
        np.multiply(total, total, out=terms[:, 6])
        found = np.matmul(self._maps.take(pads, axis=0), terms)[:, :, 0]
        return found[:, _RANGE_ROWS:], np.abs(found[:, :_RANGE_ROWS])

    def solve_contacts(self, pads: IntArray, currents: FloatArray, xy: FloatArray) -> ContactSolution:
        """Locate the contacts (k,), starting at xy (k, 2), NaN for new ones, and linearise there."""
        noise = self._model.noise_a[pads].T
        found = self._model.locator.estimate(pads, currents.T, noise, xy.T)
        return self.linearise(pads, currents, np.stack([found.x, found.y], axis=1), solved=True)

    @np.errstate(all="ignore")
    def linearise(
        self, pads: IntArray, currents: FloatArray, xy: FloatArray, solved: bool = False
    ) -> ContactSolution:
        """Linearise at the positions xy (k, 2): near the most likely ones, or at them when `solved`."""
        at = _LocalLeastSquares.from_tangent(
            self._model.locator.tangent(pads, *xy.T), currents, self._model.noise_a[pads]
        )
        spread = np.sqrt(np.diagonal(at.covariance, axis1=1, axis2=2)[:, :2])
        largest = spread.max(axis=1)
        ranges = np.maximum(np.sqrt(_MAX_CURVATURE_SIGMA * spread.min(axis=1)), _MIN_RANGE_SIGMA * largest)
        firm = largest <= _MAX_POSITION_STD_REACH
        if self._model.any_gain_uncertain:  # it widens the covariance, but not the range
            at.add_gain_covariance(currents, self._model.gain_covariance[pads])
        tolerance_m = self.tolerance_m.take(pads)
        if np.count_nonzero(tolerance_m):
            permitted = np.minimum(
                np.sqrt(_CURVATURE_TOLERANCE_FRACTION * tolerance_m / at.tangent.reach.max(axis=1)),
                _MAX_RANGE_REACH,
            )
            ranges = np.maximum(ranges, permitted)
        if solved:  # a most likely position held by an edge or a corner has no tangent
            step = np.matmul(at.by_current, currents[:, :, None])[:, :, 0]
            firm &= np.abs(step).max(axis=1) <= ranges
        at.by_current[~firm] = 0.0
        width = np.where(firm, ranges, _MAX_POSITION_STD_REACH)
        maps = np.zeros((len(pads), _RANGE_ROWS + VALUE_COUNT, _TERM_COUNT))
        values = maps[:, _RANGE_ROWS:]
        by_position, covariance_m2, scales = self._linearise_position(pads, at, width, values)
        requested = self.force_requested.take(pads)
        if self._model.any_gain_uncertain:
            requested &= ~self._model.quarantined.take(pads)
        if np.count_nonzero(requested):
            force = self._linearise_force(pads, currents, at, width, scales, by_position, maps)
        else:
            force = np.full(len(pads), np.nan), requested
        if np.count_nonzero(requested) < requested.size:
            maps[~requested, _RANGE_ROWS + FORCE_COLUMN] = np.nan
            maps[~requested, 2] = 0.0  # valid for any total
            force[0][~requested] = np.nan
        np.matmul(by_position, at.by_current, out=values[:, :, :4])
        values[:, RESIDUAL_COLUMN, :2] += 1 / at.total[:, None]
        maps[:, :2, :4] = at.by_current / np.where(firm, ranges, np.nan)[:, None, None]
        self._maps[pads] = maps
        self._per_total[pads] = at.per_total
        pair = currents[:, 0] + currents[:, 1]
        by_current = values[:, RESIDUAL_COLUMN, :4] - (pair / at.total)[:, None] * at.per_total
        variance = ((by_current * self._model.noise_a[pads]) ** 2).sum(axis=1)
        residual_std = np.sqrt(variance)
        if self._model.any_gain_uncertain:
            by_log_gain = by_current * currents
            variance += np.einsum("ki,kij,kj->k", by_log_gain, self._model.gain_covariance[pads], by_log_gain)
        misfit = (values[:, RESIDUAL_COLUMN, :4] * currents).sum(axis=1) + values[:, RESIDUAL_COLUMN, 4]
        inflation = 1 + np.fmax(misfit**2 / variance - _MAX_SQUARED_MISFIT, 0.0)
        return ContactSolution(covariance_m2 * inflation[:, None, None], *force, residual_std)

    def force_slopes(self, pads: IntArray) -> FloatArray:
        """Return the change of the force (k,) with relative change of the total at the map's origin [N]."""
        row = self._maps[pads, _RANGE_ROWS + FORCE_COLUMN]
        return np.asarray(row[:, 5] + 2 * row[:, 6])

    def position_noise_covariance(self, pads: IntArray, currents: FloatArray) -> FloatArray:
        """Return the covariance (k, 2, 2) of arc lengths from channel noise, independent in each sample."""
        total = (self._per_total.take(pads, axis=0) * currents).sum(axis=1)
        by_current = self._maps[pads, _RANGE_ROWS + PAD_COLUMNS.start : _RANGE_ROWS + PAD_COLUMNS.stop, :4]
        by_noise = by_current * (self._model.noise_a[pads] / total[:, None])[:, None]
        return np.asarray(by_noise @ by_noise.transpose(0, 2, 1))

    # Details: each fills its rows of `values` and of `by_position`, their change per reach along x and y ----

    def _linearise_position(
        self, pads: IntArray, at: _LocalLeastSquares, width: FloatArray, values: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return `by_position` (k, VALUE_COUNT, 2), the covariance (k, 3, 3), and stencil scales (3, k)."""
        k, tangent = len(pads), at.tangent
        points = np.empty((3, k, 2))  # the position, and a width along x and along y
        points[:] = tangent.point
        points[1, :, 0] += width * tangent.reach[:, 0]
        points[2, :, 1] += width * tangent.reach[:, 1]
        covariance = np.empty((3, k, 2, 2))
        covariance[:] = at.covariance[:, :2, :2] * (tangent.reach[:, :, None] * tangent.reach[:, None])
        flat = points.reshape(-1, 2)
        placed = self._model.placement.to_link_frame(
            np.concatenate((pads, pads, pads)), flat[:, 0], flat[:, 1], covariance.reshape(-1, 2, 2)
        )
        columns = np.concatenate((flat, placed.pad_m, placed.position_m, placed.normal), axis=1)
        columns = columns.reshape(3, k, -1)
        by_position = np.zeros((k, VALUE_COUNT, 2))
        differences = (columns[1:] - columns[0]).transpose(1, 2, 0)
        by_position[:, _POSITION_DEPENDENT_COLUMNS] = differences / width[:, None, None]
        by_position[:, RESIDUAL_COLUMN] = -tangent.slopes[:, :, 0] - tangent.slopes[:, :, 1]
        values[:, _POSITION_DEPENDENT_COLUMNS, 4] = columns[0]
        values[:, RESIDUAL_COLUMN, 4] = -tangent.fractions[:, 0] - tangent.fractions[:, 1]
        return by_position, placed.covariance_m2[:k], placed.scale_m_per_unit.reshape(3, k)

    def _linearise_force(
        self,
        pads: IntArray,
        currents: FloatArray,
        at: _LocalLeastSquares,
        width: FloatArray,
        scales: FloatArray,
        by_position: FloatArray,
        maps: FloatArray,
    ) -> tuple[FloatArray, BoolArray]:
        """Linearise the force as a parabola of the total; return its standard deviation and saturation."""
        tangent = at.tangent
        log_radius = tangent.log_radius + np.log(scales)
        log_radius[1:] += (width[:, None] * tangent.radius_slopes).T
        fractions = np.empty((5, len(pads), 4))
        fractions[:] = currents / at.total[:, None]
        fractions[1:3] += (width[:, None, None] * tangent.slopes).transpose(1, 0, 2)
        total_std = np.sqrt(at.covariance[:, 2, 2])
        radius_m = np.exp(log_radius)
        estimate = self._model.estimate_force(
            np.concatenate((pads,) * 5),
            fractions.reshape(-1, 4).T,
            (_STENCIL_TOTALS * at.total).ravel(),
            np.concatenate((total_std,) * 5),
            radius_m.take(_STENCIL_POINTS, axis=0).ravel(),
        )
        force, status = estimate.force_n.reshape(5, -1), estimate.status.reshape(5, -1)
        middle, along_x, along_y, less, more = np.where(
            (status[0] == _VALID) | (status[0] == _SATURATED), force, np.nan
        )
        same_beside = (status[1] == status[0]) & (status[2] == status[0])  # a bound and a value have no slope
        by_position[:, FORCE_COLUMN, 0] = np.where(same_beside, along_x - middle, 0.0) / width
        by_position[:, FORCE_COLUMN, 1] = np.where(same_beside, along_y - middle, 0.0) / width
        linear, square = (
            (more - less) / (2 * _TOTAL_STEP_FRACTION),
            ((more + less) / 2 - middle) / _TOTAL_STEP_FRACTION**2,
        )
        value = maps[:, _RANGE_ROWS + FORCE_COLUMN]
        value[:, 4], value[:, 5], value[:, 6] = middle - linear + square, linear - 2 * square, square
        same_all = same_beside & (status[3] == status[0]) & (status[4] == status[0])
        bend = np.abs(square) * (_TOTAL_STEP_FRACTION**2 / _MAX_FORCE_CURVATURE_FRACTION) / middle
        maps[:, 2, 5] = np.where(same_all, np.fmax(bend, 1.0) / _TOTAL_STEP_FRACTION, np.nan)
        maps[:, 2, 4] = -maps[:, 2, 5]
        by_law = self._model.law_force_std(pads, currents.T, at.total, radius_m[0], force[0])
        return np.hypot(estimate.std_n.reshape(5, -1)[0], by_law), status[0] == _SATURATED


class _LocalLeastSquares(NamedTuple):
    """Least squares about a position of each of k contacts; positions are relative to it, in `reach`.

    covariance (k, 3, 3) of (x, y, total). by_current (k, 2, 4): derivative of the position at the present
    total. total (k,): most likely; per_total (k, 4): its derivative by each current, relative to itself.
    """

    tangent: TableTangent
    covariance: FloatArray
    by_current: FloatArray
    total: FloatArray
    per_total: FloatArray

    @classmethod
    def from_tangent(
        cls, tangent: TableTangent, currents: FloatArray, noise: FloatArray
    ) -> _LocalLeastSquares:
        weight = 1 / noise
        fractions, data = tangent.fractions * weight, currents * weight
        norm = (fractions * fractions).sum(axis=1)
        total = (fractions * data).sum(axis=1) / norm
        slopes = tangent.slopes * (weight * total[:, None])[:, None]
        mixing = np.matmul(slopes, (fractions / norm[:, None])[:, :, None])
        slopes -= mixing * fractions[:, None]
        covariance = estimate_covariance(
            slopes.transpose(1, 2, 0),
            mixing[:, :, 0].T,
            fractions.T,
            np.full(len(total), _MIN_INFORMATION),
        )
        by_current = np.matmul(covariance[:, :2, :2], slopes) * weight[:, None]
        by_total = fractions * weight / norm[:, None] - (mixing * by_current).sum(axis=1)
        total = (by_total * currents).sum(axis=1)
        return cls(tangent, covariance, by_current, total, by_total / total[:, None])

    def add_gain_covariance(self, currents: FloatArray, log_gain_covariance: FloatArray) -> None:
        """Add the covariance of log gains (k, 4, 4), propagated to (x, y, total)."""
        by_total = self.per_total * self.total[:, None]
        by_log_gain = np.concatenate([self.by_current, by_total[:, None]], axis=1) * currents[:, None]
        self.covariance[:] += by_log_gain @ log_gain_covariance @ np.swapaxes(by_log_gain, 1, 2)
