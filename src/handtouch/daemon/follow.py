"""Follows contacts: what a contact's four currents say of it, straightened at its last solution.

A solution is costly, and from one tick to the next a contact moves little. So every solution leaves behind
a map, affine in the currents, to all that is told of a contact: a Gauss-Newton step from where the contact
was, with placement and strength differentiated. While currents stay within the map's trust, a tick costs one
small matrix product a contact, and is as accurate as a solution: nothing lags, as a place that is kept would.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.daemon.model import PadModel
from handtouch.field.bank import Tangent
from handtouch.field.estimate import covariance_of
from handtouch.field.strength import Status

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]

VALUES = 12
"""xy (2), arc lengths (2), residual, position (3), normal (3) and force of a contact, in this order."""
XY, PAD, RESIDUAL, POSITION, NORMAL, FORCE = slice(0, 2), slice(2, 4), 4, slice(5, 8), slice(8, 11), 11

_PLACED = np.delete(np.arange(FORCE), RESIDUAL)
_TRUST = 3  # rows of a map before the values: how far off x, y and the total are, 1 at the end of trust
_TERMS = 7  # four currents over the relative total v, 1, v and v^2
_BEND = 0.6  # standard deviations that the bend of the model may add to a place where trust ends, at most
_NOISE = 6.0  # standard deviations of a place that trust spans at least
_VAGUE = 0.1  # of `reach`: a place less certain than this has no tangent worth the name
_TOTAL = 0.05  # relative change of the total that a parabola of the force spans
_TOTALS = np.array([1, 1, 1, 1 - _TOTAL, 1 + _TOTAL])[:, None]  # of the points that a force is fitted to
_STENCIL = np.array([0, 1, 2, 0, 0])  # and where they are: at the place, along x, along y
NEAR = 8.0  # ends of trust from which one Gauss-Newton step leads back into it
_FORCE_BEND = 0.01  # of the force: where the parabola bends more, trust spans less
_TOLERATED = 0.4  # of a tolerance: the bend as a rule where trust ends; off the middle it is up to twice that
_WIDEST = 0.35  # of `reach`: what a tolerance lets a map span at most
_FITS = 9.0
"""Squared misfit of a point, of one degree of freedom, that noise explains. What goes beyond widens the
covariance by as much (Birge, Phys. Rev. 40, 1932): where a contact is no point, or gains are off, currents
err along the directions that move its place as they do along the one that shows."""
_LEAST_INFORMATION = 1e-6  # of a place, per squared `reach`
_VALID, _SATURATED = int(Status.VALID), int(Status.SATURATED)


class Solved(NamedTuple):
    """What a solution tells beside the values, and what holds as long as its map is trusted; k rows."""

    covariance_m2: FloatArray
    force_std_n: FloatArray
    saturated: BoolArray
    residual_std: FloatArray


class Follower:
    """Maps of the contacts of a hand, one for each pad of `model`."""

    def __init__(self, model: PadModel) -> None:
        self._model = model
        self._maps = np.full((model.size, _TRUST + VALUES, _TERMS), np.nan)
        self._per_total = np.full((model.size, 4), np.nan)
        self.weighed = np.ones(model.size, dtype=np.bool_)
        """pads whose force is wanted"""
        self.tolerance_m = np.zeros(model.size)
        """error of a place that the bend of a map may add, where that is more than the noise allows"""

    def take_over(self, other: Follower) -> None:
        """Go on from what another one has of the same pads."""
        self._maps, self._per_total = other._maps, other._per_total
        self.weighed, self.tolerance_m = other.weighed, other.tolerance_m

    def imitate(self, other: Follower) -> None:
        """Have what another one of the same pads has; copied."""
        self._maps[:], self._per_total[:] = other._maps, other._per_total
        self.weighed[:], self.tolerance_m[:] = other.weighed, other.tolerance_m

    def forget(self, pads: IntArray) -> None:
        """The contacts on these pads are new."""
        self._maps[pads] = np.nan

    def read(self, pads: IntArray, currents: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Values (k, VALUES) for currents (k, 4) of the pads (k,), and how far from trusted (k, 3): up to 1.

        NaN where there is no map.
        """
        terms = np.empty((len(pads), _TERMS, 1))
        total = np.matmul(self._per_total.take(pads, axis=0)[:, None], currents[:, :, None])[:, 0]
        np.divide(currents, total, out=terms[:, :4, 0])
        terms[:, 4] = 1.0
        terms[:, 5] = total
        np.multiply(total, total, out=terms[:, 6])
        found = np.matmul(self._maps.take(pads, axis=0), terms)[:, :, 0]
        return found[:, _TRUST:], np.abs(found[:, :_TRUST])

    def solve(self, pads: IntArray, currents: FloatArray, xy: FloatArray) -> Solved:
        """Find the contacts (k,) anew, beginning at xy (k, 2), NaN for new ones, and draw their maps."""
        noise = self._model.noise_a[pads].T
        found = self._model.locator.estimate(pads, currents.T, noise, xy.T)
        return self.draw(pads, currents, np.stack([found.x, found.y], axis=1), solved=True)

    @np.errstate(all="ignore")
    def draw(self, pads: IntArray, currents: FloatArray, xy: FloatArray, solved: bool = False) -> Solved:
        """Draw the maps (k,) at the places xy (k, 2): near the most likely ones, or there when `solved`."""
        at = _Linear.of(self._model.locator.tangent(pads, *xy.T), currents, self._model.noise_a[pads])
        spread = np.sqrt(np.diagonal(at.covariance, axis1=1, axis2=2)[:, :2])
        vague = spread.max(axis=1)
        trust = np.maximum(np.sqrt(_BEND * spread.min(axis=1)), _NOISE * vague)
        firm = vague <= _VAGUE
        if self._model.doubted:  # wider, but a map is trusted no farther for it
            at.doubt(currents, self._model.gain_covariance[pads])
        tolerated = self.tolerance_m.take(pads)
        if np.count_nonzero(tolerated):
            widest = np.minimum(np.sqrt(_TOLERATED * tolerated / at.tangent.reach.max(axis=1)), _WIDEST)
            trust = np.maximum(trust, widest)
        if solved:  # where an edge or a corner holds the most likely place, it has no tangent
            step = np.matmul(at.by_current, currents[:, :, None])[:, :, 0]
            firm &= np.abs(step).max(axis=1) <= trust
        at.by_current[~firm] = 0.0
        width = np.where(firm, trust, _VAGUE)
        maps = np.zeros((len(pads), _TRUST + VALUES, _TERMS))
        values = maps[:, _TRUST:]
        by_place, covariance_m2, scales = self._place(pads, at, width, values)
        weighed = self.weighed.take(pads)
        if self._model.doubted:
            weighed &= ~self._model.quarantined.take(pads)
        if np.count_nonzero(weighed):
            strength = self._weigh(pads, currents, at, width, scales, by_place, maps)
        else:
            strength = np.full(len(pads), np.nan), weighed
        if np.count_nonzero(weighed) < weighed.size:
            maps[~weighed, _TRUST + FORCE] = np.nan
            maps[~weighed, 2] = 0.0  # any total will do
            strength[0][~weighed] = np.nan
        np.matmul(by_place, at.by_current, out=values[:, :, :4])
        values[:, RESIDUAL, :2] += 1 / at.total[:, None]
        maps[:, :2, :4] = at.by_current / np.where(firm, trust, np.nan)[:, None, None]
        self._maps[pads] = maps
        self._per_total[pads] = at.per_total
        pair = currents[:, 0] + currents[:, 1]
        by_current = values[:, RESIDUAL, :4] - (pair / at.total)[:, None] * at.per_total
        variance = ((by_current * self._model.noise_a[pads]) ** 2).sum(axis=1)
        residual_std = np.sqrt(variance)
        if self._model.doubted:
            by_log_gain = by_current * currents
            variance += np.einsum("ki,kij,kj->k", by_log_gain, self._model.gain_covariance[pads], by_log_gain)
        left_over = (values[:, RESIDUAL, :4] * currents).sum(axis=1) + values[:, RESIDUAL, 4]
        widened = 1 + np.fmax(left_over**2 / variance - _FITS, 0.0)
        return Solved(covariance_m2 * widened[:, None, None], *strength, residual_std)

    def force_slopes(self, pads: IntArray) -> FloatArray:
        """Change of the force (k,) with the relative change of the total, where the maps were drawn [N]."""
        row = self._maps[pads, _TRUST + FORCE]
        return np.asarray(row[:, 5] + 2 * row[:, 6])

    def place_noise(self, pads: IntArray, currents: FloatArray) -> FloatArray:
        """Covariance (k, 2, 2) that the noise of channels (k, 4) gives arc lengths, anew with each sample."""
        total = (self._per_total.take(pads, axis=0) * currents).sum(axis=1)
        by_current = self._maps[pads, _TRUST + PAD.start : _TRUST + PAD.stop, :4]
        by_noise = by_current * (self._model.noise_a[pads] / total[:, None])[:, None]
        return np.asarray(by_noise @ by_noise.transpose(0, 2, 1))

    # Details: each fills its rows of `values` and of `by_place`, their change per reach along x and y -------

    def _place(
        self, pads: IntArray, at: _Linear, width: FloatArray, values: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """`by_place` (k, VALUES, 2), the covariance (k, 3, 3), and scales (3, k) of the stencil."""
        k, tangent = len(pads), at.tangent
        points = np.empty((3, k, 2))  # the place, and a width along x and along y
        points[:] = tangent.point
        points[1, :, 0] += width * tangent.reach[:, 0]
        points[2, :, 1] += width * tangent.reach[:, 1]
        covariance = np.empty((3, k, 2, 2))
        covariance[:] = at.covariance[:, :2, :2] * (tangent.reach[:, :, None] * tangent.reach[:, None])
        flat = points.reshape(-1, 2)
        placed = self._model.placement.place(
            np.concatenate((pads, pads, pads)), flat[:, 0], flat[:, 1], covariance.reshape(-1, 2, 2)
        )
        told = np.concatenate((flat, placed.pad_m, placed.position_m, placed.normal), axis=1)
        told = told.reshape(3, k, -1)
        by_place = np.zeros((k, VALUES, 2))
        by_place[:, _PLACED] = (told[1:] - told[0]).transpose(1, 2, 0) / width[:, None, None]
        by_place[:, RESIDUAL] = -tangent.slopes[:, :, 0] - tangent.slopes[:, :, 1]
        values[:, _PLACED, 4] = told[0]
        values[:, RESIDUAL, 4] = -tangent.fractions[:, 0] - tangent.fractions[:, 1]
        return by_place, placed.covariance_m2[:k], placed.scale.reshape(3, k)

    def _weigh(
        self,
        pads: IntArray,
        currents: FloatArray,
        at: _Linear,
        width: FloatArray,
        scales: FloatArray,
        by_place: FloatArray,
        maps: FloatArray,
    ) -> tuple[FloatArray, BoolArray]:
        """The force as a parabola of the total; its standard deviation, and whether it is saturated."""
        tangent = at.tangent
        log_radius = tangent.log_radius + np.log(scales)
        log_radius[1:] += (width[:, None] * tangent.radius_slopes).T
        fractions = np.empty((5, len(pads), 4))
        fractions[:] = currents / at.total[:, None]
        fractions[1:3] += (width[:, None, None] * tangent.slopes).transpose(1, 0, 2)
        total_std = np.sqrt(at.covariance[:, 2, 2])
        radius_m = np.exp(log_radius)
        strength = self._model.force(
            np.concatenate((pads,) * 5),
            fractions.reshape(-1, 4).T,
            (_TOTALS * at.total).ravel(),
            np.concatenate((total_std,) * 5),
            radius_m.take(_STENCIL, axis=0).ravel(),
        )
        force, status = strength.force_n.reshape(5, -1), strength.status.reshape(5, -1)
        middle, along_x, along_y, less, more = np.where(
            (status[0] == _VALID) | (status[0] == _SATURATED), force, np.nan
        )
        beside = (status[1] == status[0]) & (status[2] == status[0])  # a bound and a value have no slope
        by_place[:, FORCE, 0] = np.where(beside, along_x - middle, 0.0) / width
        by_place[:, FORCE, 1] = np.where(beside, along_y - middle, 0.0) / width
        linear, square = (more - less) / (2 * _TOTAL), ((more + less) / 2 - middle) / _TOTAL**2
        value = maps[:, _TRUST + FORCE]
        value[:, 4], value[:, 5], value[:, 6] = middle - linear + square, linear - 2 * square, square
        alike = beside & (status[3] == status[0]) & (status[4] == status[0])
        bend = np.abs(square) * (_TOTAL**2 / _FORCE_BEND) / middle
        maps[:, 2, 5] = np.where(alike, np.fmax(bend, 1.0) / _TOTAL, np.nan)
        maps[:, 2, 4] = -maps[:, 2, 5]
        by_law = self._model.law_std(pads, currents.T, at.total, radius_m[0], force[0])
        return np.hypot(strength.std_n.reshape(5, -1)[0], by_law), status[0] == _SATURATED


class _Linear(NamedTuple):
    """Least squares about a place of each of k contacts; places are in `reach` from there.

    covariance (k, 3, 3) of (x, y, total). by_current (k, 2, 4): of the place, at the present total.
    total (k,): most likely; per_total (k, 4): what it changes by with each current, relative to itself.
    """

    tangent: Tangent
    covariance: FloatArray
    by_current: FloatArray
    total: FloatArray
    per_total: FloatArray

    @classmethod
    def of(cls, tangent: Tangent, currents: FloatArray, noise: FloatArray) -> _Linear:
        weight = 1 / noise
        fractions, data = tangent.fractions * weight, currents * weight
        norm = (fractions * fractions).sum(axis=1)
        total = (fractions * data).sum(axis=1) / norm
        slopes = tangent.slopes * (weight * total[:, None])[:, None]
        mixing = np.matmul(slopes, (fractions / norm[:, None])[:, :, None])
        slopes -= mixing * fractions[:, None]
        covariance = covariance_of(
            slopes.transpose(1, 2, 0),
            mixing[:, :, 0].T,
            fractions.T,
            np.full(len(total), _LEAST_INFORMATION),
        )
        by_current = np.matmul(covariance[:, :2, :2], slopes) * weight[:, None]
        by_total = fractions * weight / norm[:, None] - (mixing * by_current).sum(axis=1)
        total = (by_total * currents).sum(axis=1)
        return cls(tangent, covariance, by_current, total, by_total / total[:, None])

    def doubt(self, currents: FloatArray, log_gain_covariance: FloatArray) -> None:
        """Add to the covariance what gains (k, 4, 4) do that aren't known, all of (x, y, total) alike."""
        by_total = self.per_total * self.total[:, None]
        by_log_gain = np.concatenate([self.by_current, by_total[:, None]], axis=1) * currents[:, None]
        self.covariance[:] += by_log_gain @ log_gain_covariance @ np.swapaxes(by_log_gain, 1, 2)
