"""Which sheets make the force certain: one of each alpha, and pairs, by expected errors of force and radius.

Public names: `SheetCase`, `compare_sheets`.

The logarithms of the total currents change with those of force and contact radius, J, with noise N, and with
what the parts may differ by, P, in standard deviations: gains, the layers' resistance and alpha, the films.
The radius is known beforehand as the first sheet's table states it. With V = N + P P' the covariance of
(ln F, ln radius) is (J' V^-1 J + prior^-1)^-1, as linear as the other goals.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.design.pad_task import PadTask
from handtouch.field import ContactLaw

ALPHAS = (1.0, 1.5, 2.0)
"""Of films that are compared with the configured one"""
_SECOND_FILM = 0.25
"""Resistance of a second sheet's film over the first's where the pad has none: it locates nothing"""
_STEP = 1e-3
_FIRM_N = 1e6  # presses the layer to nothing
_MIN_VARIANCE = 1e-12


@dataclass(frozen=True)
class SheetCase:
    """One sheet, or two: alphas; at each force the root mean square over the pad of the relative standard
    deviations of force and radius, and the mean of the first sheet's current over the most it carries."""

    alpha: float
    second_alpha: float | None
    is_configured: bool
    force_std: tuple[float, ...]
    radius_std: tuple[float, ...]
    current_fraction: tuple[float, ...]


class _Sheets:
    """The total currents of one sheet or two under one contact, on a task's grid of k positions.

    The spreading to the electrodes and the resistors are those of the films as stated.
    """

    def __init__(self, task: PadTask, *sheets: config.Sheet) -> None:
        self.task, self.sheets = task, sheets
        self.channels = np.array([task.configured.count, 1][: len(sheets)])
        """of each sheet; a second one's electrodes are joined, and have no resistors"""
        joined = replace(task.configured, series_ohm=np.zeros(task.configured.count))
        x, y = task.grid
        self._paths = []
        for sheet, layout in zip(sheets, (task.configured, joined), strict=False):
            network = layout.network(task.boundary, sheet.ohm_per_square)
            spreading_m = network.spreading_radius(x, y) * task.surface.scale(x, y)
            self._paths.append((spreading_m, network.series_resistance(x, y)))

    def log_currents(self, force_n: float, change: FloatArray) -> FloatArray:
        """Return ln of the total currents (k, sheets).

        change: of ln F and ln radius, then of each sheet's ln(layer's resistance), alpha, ln(film's).
        """
        found = []
        for number, (sheet, (spreading_m, series_ohm)) in enumerate(
            zip(self.sheets, self._paths, strict=True)
        ):
            layer, alpha, film = change[2 + 3 * number : 5 + 3 * number].tolist()
            law = ContactLaw(
                1e-6 * sheet.contact_ohm_mm2 * math.exp(layer),
                sheet.alpha + alpha,
                1e-3 * self.sheets[0].contact_radius_mm * math.exp(change[1]),
                reference_pa=1e3 * sheet.reference_kpa,
            )
            ohm, force = sheet.ohm_per_square * math.exp(film), force_n * math.exp(change[0])
            found.append(np.log(law.current(force, self.task.node.drive_v, ohm, spreading_m, series_ohm)))
        return np.stack(found, axis=-1)

    def covariance(self, force_n: float) -> FloatArray:
        """Return the covariance (k, 2, 2) of (ln F, ln radius)."""
        count, tolerances = len(self.sheets), self.task.tolerances
        parts = (tolerances.contact_ohm, tolerances.alpha, tolerances.sheet_ohm)
        steps = _STEP * np.eye(2 + len(parts) * count)
        changes = [self.log_currents(force_n, step) - self.log_currents(force_n, -step) for step in steps]
        slopes = np.stack(changes, axis=-1) / (2 * _STEP)
        totals = np.exp(self.log_currents(force_n, np.zeros(len(steps))))
        noise = self.channels * (self.task.noise_a / totals) ** 2 + tolerances.gain**2 / self.channels
        spread = slopes[:, :, 2:] * np.tile(parts, count)
        covariance = noise[:, :, None] * np.eye(count) + spread @ np.swapaxes(spread, 1, 2)
        by_contact = slopes[:, :, :2]
        information = np.swapaxes(by_contact, 1, 2) @ np.linalg.solve(covariance, by_contact)
        first = self.sheets[0]
        prior = math.log1p((first.contact_radius_std_mm / first.contact_radius_mm) ** 2)
        information[:, 1, 1] += 1 / max(prior, _MIN_VARIANCE)
        return np.asarray(np.linalg.inv(information))


def compare_sheets(task: PadTask, forces_n: Sequence[float]) -> list[SheetCase]:
    """Return the pad as configured, then one sheet of each of ALPHAS, then each with a second one of alpha 1.

    Layers of another alpha have the configured one's resistance under the task's force at the expected
    radius; so has a second sheet that the pad lacks, on a film of a quarter of the resistance.
    """
    own = task.sheet
    name = task.pad.second_sheet
    second = None if name is None else task.deployment.sheets[name]
    cases = [_case(task, (own, second), forces_n, is_configured=True)]
    singles = {alpha: _with_alpha(own, alpha, task.force_n) for alpha in ALPHAS}
    film = own.model_copy(update={"ohm_per_square": _SECOND_FILM * own.ohm_per_square})
    even = second if second is not None and second.alpha == 1 else _with_alpha(film, 1.0, task.force_n)
    for alpha, sheet in singles.items():
        if second is not None or not math.isclose(alpha, own.alpha):
            cases.append(_case(task, (sheet, None), forces_n))
    for alpha, sheet in singles.items():
        if alpha != 1 and (second is None or not math.isclose(alpha, own.alpha)):
            cases.append(_case(task, (sheet, even), forces_n))
    return cases


def _with_alpha(sheet: config.Sheet, alpha: float, force_n: float) -> config.Sheet:
    """Return a sheet whose layer has another alpha, and the same resistance under a force."""
    pressure_pa = force_n / (math.pi * (1e-3 * sheet.contact_radius_mm) ** 2)
    ratio = (pressure_pa / (1e3 * sheet.reference_kpa)) ** (alpha - sheet.alpha)
    return sheet.model_copy(update={"alpha": alpha, "contact_ohm_mm2": sheet.contact_ohm_mm2 * ratio})


def _case(
    task: PadTask,
    pair: tuple[config.Sheet, config.Sheet | None],
    forces_n: Sequence[float],
    *,
    is_configured: bool = False,
) -> SheetCase:
    first, second = pair
    sheets = _Sheets(task, first) if second is None else _Sheets(task, first, second)
    at_rest = np.zeros(2 + 3 * len(sheets.sheets))
    most = sheets.log_currents(_FIRM_N, at_rest)[:, 0]
    covariances = [sheets.covariance(force_n) for force_n in forces_n]
    currents = [sheets.log_currents(force_n, at_rest)[:, 0] for force_n in forces_n]
    return SheetCase(
        first.alpha,
        None if second is None else second.alpha,
        is_configured,
        tuple(float(np.sqrt(covariance[:, 0, 0].mean())) for covariance in covariances),
        tuple(float(np.sqrt(covariance[:, 1, 1].mean())) for covariance in covariances),
        tuple(float(np.exp(current - most).mean()) for current in currents),
    )
