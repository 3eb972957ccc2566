"""Currents of a layout, and how they change with the contact and with the pad's parts.

Public names: `ContactResponse`, `contact_response`.

Currents I_i = I f_i of a contact at (u, v) with force F; I is the total and f the fractions. With
derivatives J by (u, v, ln F), noise N and derivatives P by the parts, in their standard deviations, the
covariance of currents is V = N + P P', and that of the estimate (J' V^-1 J)^-1.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.design.layout import ElectrodeLayout
from handtouch.design.pad_task import PadTask
from handtouch.field import ContactLaw, ElectrodeNetwork

_POSITION_STEP = 1e-4  # step of differences over the shorter side
_FORCE_STEP = 1e-3  # step of differences over the force


@dataclass(frozen=True)
class ContactResponse:
    """Linear response of one layout at k positions; currents in units of the total there.

    fractions: (k, m). slopes: derivatives (k, m, 3) by u and v [1/m] and by ln F, where computed, else by
    the logarithm of the total. bends: second derivatives (k, m, 2) by u u and by u v [1/m^2], along the
    rectangle's directions; empty unless computed. covariance: V (k, m, m). total_a: (k,).
    """

    fractions: FloatArray
    slopes: FloatArray
    bends: FloatArray
    covariance: FloatArray
    total_a: FloatArray

    @property
    def estimate_covariance(self) -> FloatArray:
        """Covariance (k, 3, 3) of (u, v, ln F) [m, m, 1]."""
        information = np.swapaxes(self.slopes, -1, -2) @ np.linalg.solve(self.covariance, self.slopes)
        return np.asarray(np.linalg.inv(information))

    @property
    def position_std(self) -> FloatArray:
        """Root of the sum of both coordinates' variances (k,) [m]."""
        covariance = self.estimate_covariance
        return np.asarray(np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1]))


def contact_response(
    task: PadTask, layout: ElectrodeLayout, with_force: bool = False, with_bends: bool = False
) -> ContactResponse:
    """Return the response of a layout on the task's grid.

    with_force: how the total changes with position, force and parts, which positions don't depend on.
    Raises ValueError for an impossible layout.
    """
    x, y = task.grid
    network = layout.network(task.boundary, task.sheet.ohm_per_square)
    fractions, jacobian = network.fractions_with_jacobian(x, y)
    scales = task.surface.scales(x, y)
    total = _total(task, network, x, y)
    slopes = np.concatenate([jacobian / scales, fractions[:, None]], axis=1)
    if with_force:
        slopes += fractions[:, None] * _log_total_slopes(task, network, x, y, scales)
    columns = [
        column / total for column in _part_columns(task, layout, network, fractions, total, with_force)
    ]
    parts = np.stack(columns) if columns else np.zeros((0, *fractions.shape))
    covariance = np.einsum("pik,pjk->kij", parts, parts)
    covariance += np.eye(layout.count) * ((task.noise_a / total) ** 2)[:, None, None]
    bends = _bends(network, x, y, scales) if with_bends else np.zeros((layout.count, 0, len(x)))
    return ContactResponse(
        fractions=fractions.T,
        slopes=np.moveaxis(slopes, 2, 0),
        bends=np.moveaxis(bends, 2, 0),
        covariance=covariance,
        total_a=total,
    )


def _total(
    task: PadTask,
    network: ElectrodeNetwork,
    x: FloatArray,
    y: FloatArray,
    law: ContactLaw | None = None,
    force_ratio: float = 1.0,
) -> FloatArray:
    """Return the total current (k,) [A]."""
    outer = network.spreading_radius(x, y) * task.surface.scale(x, y)
    series = network.series_resistance(x, y)
    ohm = network.sheet_ohm_per_square
    current: FloatArray = (law or task.law).current(
        force_ratio * task.force_n, task.node.drive_v, ohm, outer, series
    )
    return current


def _log_total_slopes(
    task: PadTask, network: ElectrodeNetwork, x: FloatArray, y: FloatArray, scales: FloatArray
) -> FloatArray:
    """Return derivatives (3, k) of the logarithm of the total by u and v, and by ln F, less 1."""
    step = _POSITION_STEP * min(network.a, network.b)
    by_x = np.log(_total(task, network, x + step, y) / _total(task, network, x - step, y)) / (2 * step)
    by_y = np.log(_total(task, network, x, y + step) / _total(task, network, x, y - step)) / (2 * step)
    more, less = (_total(task, network, x, y, force_ratio=1 + sign * _FORCE_STEP) for sign in (1, -1))
    return np.stack([by_x / scales[0], by_y / scales[1], np.log(more / less) / (2 * _FORCE_STEP) - 1])


def _bends(network: ElectrodeNetwork, x: FloatArray, y: FloatArray, scales: FloatArray) -> FloatArray:
    """Return `ContactResponse.bends` (m, 2, k)."""
    step = _POSITION_STEP * min(network.a, network.b)
    ahead = network.fractions_with_jacobian(x + step, y)[1]
    behind = network.fractions_with_jacobian(x - step, y)[1]
    by_xx, by_xy = np.moveaxis(ahead - behind, 1, 0) / (2 * step)
    return np.asarray(np.stack([by_xx, by_xy], axis=1) / (scales[0] * scales[1]))


def _part_columns(
    task: PadTask,
    layout: ElectrodeLayout,
    network: ElectrodeNetwork,
    fractions: FloatArray,
    total: FloatArray,
    with_force: bool,
) -> Iterator[FloatArray]:
    """Yield the change of the currents (m, k) [A] by each part that differs by its standard deviation."""
    x, y = task.grid
    spreads, nominal = task.tolerances, fractions * total
    if spreads.gain:
        for channel in range(layout.count):
            yield spreads.gain * nominal * (np.arange(layout.count) == channel)[:, None]
    for other, factor in _networks_with_other_parts(task, layout, network, with_force):
        now = _total(task, other, factor * x, y) if with_force else total
        yield other.fractions(factor * x, y) * now - nominal
    if with_force:
        law = task.law
        layer, radius = np.asarray(law.contact_ohm_m2), np.asarray(law.radius_m)
        laws = (
            (spreads.contact_ohm, replace(law, contact_ohm_m2=layer * (1 + spreads.contact_ohm))),
            (spreads.alpha, replace(law, alpha=np.asarray(law.alpha) + spreads.alpha)),
            (spreads.radius, replace(law, radius_m=radius * (1 + spreads.radius))),
        )
        for spread, changed in laws:
            if spread:
                yield fractions * (_total(task, network, x, y, changed) - total)


def _networks_with_other_parts(
    task: PadTask, layout: ElectrodeLayout, network: ElectrodeNetwork, with_force: bool
) -> Iterator[tuple[ElectrodeNetwork, float]]:
    """Yield networks in which one part differs by one standard deviation, and their length along x over
    that of `network`."""
    spreads, boundary, ohm = task.tolerances, task.boundary, network.sheet_ohm_per_square
    if spreads.gap_m:
        for end in range(2 * layout.count):
            inward = np.zeros(2 * layout.count)
            inward[end] = spreads.gap_m if end % 2 == 0 else -spreads.gap_m
            moved = layout.stretches_m + inward.reshape(-1, 2)
            yield ElectrodeLayout(moved, layout.series_ohm).network(boundary, ohm), 1.0
    if spreads.log_aspect:
        factor = float(np.exp(spreads.log_aspect))
        yield network.stretched(factor), factor
    if spreads.resistor:
        for channel in np.flatnonzero(layout.series_ohm):
            changed = layout.series_ohm * np.exp(spreads.resistor * (np.arange(layout.count) == channel))
            yield network.with_series_ohm(changed.tolist()), 1.0
    if spreads.sheet_ohm and (with_force or layout.series_ohm.any()):
        yield layout.network(boundary, ohm * (1 + spreads.sheet_ohm)), 1.0
