"""Number and shape of the contacts that currents support: a point, an elongated contact, or two contacts.

Public names: `resolve_contacts`, `ResolvedContacts`, `ShapeEstimate`, `ContactShape`.

A contact with centre z and second moments M sends, to second order, the currents of a point and the two
combinations M_xx - M_yy and 2 M_xy times second derivatives (fractions are harmonic). More than three
independent currents show them: each is tested by its likelihood ratio.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch.field._shape_fit import LINE, BoolArray, ShapeFit, ShapeSolution
from handtouch.field.model import FloatArray, ForwardModel, channel_noise

MIN_LINE_CHANNELS, MIN_PAIR_CHANNELS = 5, 6


class ContactShape(IntEnum):
    """Shape of what touches a pad."""

    UNKNOWN = 0
    POINT = 1
    LINE = 2
    PAIR = 3


@dataclass(frozen=True)
class ShapeEstimate:
    """Most likely contacts of one shape; arrays of one shape (...), or scalars.

    position: (parameters, ...). Of a point x, y. Of a line x, y of its centre, then M_xx - M_yy and 2 M_xy of
    its second moments M, which are those of every contact that sends these currents: of a line of length L at
    angle q from x towards y they are L^2 / 12 times cos 2q and sin 2q. Of a pair x, y of the one, then x, y
    of the other, in order of x.

    total: current of each contact in each state of the schedule, (contacts, states, ...); not negative.

    chi_squared: sum of squared residuals in standard deviations. freedom: its degrees of freedom.

    covariance: of (position, total), (..., k, k): the Cramer-Rao bound at the estimate. NaN where the
    currents don't determine it.

    converged: False where the iteration stopped before the maximum, or a total is zero.
    """

    position: FloatArray
    total: FloatArray
    chi_squared: FloatArray
    freedom: int
    covariance: FloatArray
    converged: BoolArray

    @property
    def length(self) -> FloatArray:
        """Length of the line; of an elongated contact, of the line with its moments."""
        return np.asarray(np.sqrt(12 * np.hypot(self.position[2], self.position[3])))

    @property
    def axis(self) -> FloatArray:
        """Direction of the line [rad] from x towards y, in (-pi / 2, pi / 2]."""
        return np.asarray(np.arctan2(self.position[3], self.position[2]) / 2)


@dataclass(frozen=True)
class ResolvedContacts:
    """Result of `resolve_contacts`; arrays (...), or scalars.

    shape: `ContactShape` of the simplest shape that the currents don't contradict. point, line, pair: the
    estimates; pair is NaN where a point or a line explains the currents, None for fewer than six currents.

    line_ratio, pair_ratio: twice the logarithm of the likelihood ratio of the line over the point, and of
    the pair over the line.
    """

    shape: NDArray[np.int8]
    point: ShapeEstimate
    line: ShapeEstimate
    pair: ShapeEstimate | None
    line_ratio: FloatArray
    pair_ratio: FloatArray


def resolve_contacts(
    model: ForwardModel, currents: ArrayLike, noise: ArrayLike, false_alarm: float = 1e-3
) -> ResolvedContacts:
    """Return the shape of the contacts that send `currents`, and the most likely ones of that shape.

    currents, noise: (channels, ...), as for `estimate`; for a `SwitchedNetwork` those of all its states, the
    total of each state being free. false_alarm: probability that a point is taken for a line, and a line for
    a pair, each; 0 < false_alarm < 1. The ratios are compared with quantiles of chi-squared of two degrees of
    freedom and of one.

    Two contacts at unequal distances from the electrodes, or far from each other, differ from a line; close
    ones are a line whose moments are theirs. A pair needs six independent currents, a line five.

    Raises ValueError for an impossible false-alarm rate, a wrong number of channels, and models with fewer
    than five independent currents, for which there is `point_test`.
    """
    from scipy.special import chdtri

    if not 0 < false_alarm < 1:
        raise ValueError(f"false_alarm = {false_alarm}: a rate lies between 0 and 1")
    currents = np.asarray(currents, np.float64)
    channels = len(model.fractions(model.a / 2, model.b / 2))
    if currents.shape[:1] != (channels,):
        raise ValueError(f"currents have shape {currents.shape}: the first axis is the {channels} channels")
    independent = getattr(model, "independent_channels", channels)
    if independent < MIN_LINE_CHANNELS:
        raise ValueError(f"the model has {independent} independent currents: the test needs five")
    shape = currents.shape[1:]
    sigma = channel_noise(noise, currents.shape).reshape(channels, -1)
    fit = ShapeFit(model, currents.reshape(channels, -1), sigma, len(getattr(model, "states", (0,))))
    point = fit.fit_point()
    line = fit.fit_line(point)
    line_ratio = point.cost - line.cost
    found = np.where(fit.known, ContactShape.POINT, ContactShape.UNKNOWN).astype(np.int8)
    elongated = line_ratio > chdtri(2, false_alarm)
    found[elongated] = ContactShape.LINE
    pair_ratio, pair = np.full(len(found), np.nan), None
    if independent >= MIN_PAIR_CHANNELS:
        least = chdtri(1, false_alarm)
        solved = fit.fit_pair(line, np.flatnonzero(elongated & (line.cost > least)))
        pair = _estimate(fit, solved, shape)
        pair_ratio = line.cost - solved.cost
        found[pair_ratio > least] = ContactShape.PAIR
    return ResolvedContacts(
        found.reshape(shape)[()],
        _estimate(fit, point, shape),
        _estimate(fit, line, shape),
        pair,
        line_ratio.reshape(shape)[()],
        pair_ratio.reshape(shape)[()],
    )


def _estimate(fit: ShapeFit, found: ShapeSolution, shape: tuple[int, ...]) -> ShapeEstimate:
    """Return a solution in the unit of the pad."""
    places = found.place.shape[1]
    units = np.full(places, fit.unit)
    if found.shape is LINE:
        units[2:] = fit.unit**2
    covariance = fit.covariance(found)
    size = covariance.shape[1]
    scale = np.concatenate([units, np.ones(size - places)])
    total = np.moveaxis(found.total, 0, 2).swapaxes(0, 1)
    return ShapeEstimate(
        (found.place * units).T.reshape(places, *shape),
        total.reshape(*total.shape[:2], *shape),
        found.cost.reshape(shape)[()],
        fit.channels - size,
        (covariance * scale * scale[:, None]).reshape(*shape, size, size),
        found.converged.reshape(shape)[()],
    )
