"""Least errors of force and radius that two sheets allow: those of an estimator that knows nearly everything.

Public names: `KnownSheets`, `known_sheets`.

It knows the true law, resistance and history of both sheets, that the contact is an even disc in the middle
of the pad, and the distribution of its radius; all forces are equally likely by their logarithm. It doesn't
know how the sheets scatter from press to press and flicker, nor the noise of the channels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.config import Deployment
from handtouch.core.pad_model import ampere_per_count_of
from handtouch.field import ContactLaw
from handtouch.procedures.calibrate.readings import PadCircuitModel
from handtouch.simulate.worlds import DrawnWorld

FloatArray = NDArray[np.float64]
_RADII, _FORCES = 81, 160
_LOG_FORCES = np.log(np.geomspace(0.01, 60.0, _FORCES))


@dataclass(frozen=True)
class _Sheet:
    """ln of the current at radii and forces (_RADII, _FORCES), relative deviations of the load, and noise."""

    log_current: FloatArray
    press_std: float
    flicker_std: float
    noise_a: float


@dataclass(frozen=True)
class KnownSheets:
    """Sheets of a pad, and the radii (_RADII,) [m] that its contacts have, with their probabilities."""

    sheets: tuple[_Sheet, ...]
    log_radius: FloatArray
    probability: FloatArray

    def errors(self, forces_n: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return relative errors (n, 2) of force and radius for contacts of these forces (n,)."""
        true = rng.choice(_RADII, len(forces_n), p=self.probability)
        rows = [
            self._estimate(float(np.log(force)), int(k), rng) for force, k in zip(forces_n, true, strict=True)
        ]
        found = np.array(rows) - np.column_stack([np.log(forces_n), self.log_radius[true]])
        return np.asarray(np.expm1(found))

    def _estimate(self, log_force: float, radius: int, rng: np.random.Generator) -> tuple[float, float]:
        """Return means of ln force and ln radius after a contact's currents."""
        weight, total, mean = self.probability.copy(), np.zeros(_RADII), np.zeros(_RADII)
        square = np.zeros(_RADII)
        for sheet in self.sheets:
            scatter = np.hypot(sheet.press_std, sheet.flicker_std * np.exp(-0.5 * log_force))
            current = np.interp(log_force + scatter * rng.normal(), _LOG_FORCES, sheet.log_current[radius])
            noise = sheet.noise_a * np.exp(-current)
            current += noise * rng.normal()
            found = np.array(
                [np.interp(current, own, _LOG_FORCES, np.nan, np.nan) for own in sheet.log_current]
            )
            slope = np.gradient(sheet.log_current, _LOG_FORCES, axis=1)
            slopes = np.array(
                [np.interp(x, _LOG_FORCES, own) for x, own in zip(np.nan_to_num(found), slope, strict=True)]
            )
            variance = scatter**2 + (noise / slopes) ** 2
            known = np.isfinite(found)
            weight[known] /= slopes[known]
            weight[~known] = 0.0
            found = np.nan_to_num(found)
            total += 1 / variance
            mean += found / variance
            square += found**2 / variance
            weight /= np.sqrt(variance)
        weight *= np.exp(-0.5 * (square - mean**2 / total)) / np.sqrt(total)
        weight /= weight.sum()
        return float(weight @ (mean / total)), float(weight @ self.log_radius)


def known_sheets(deployment: Deployment, drawn: DrawnWorld) -> Iterator[KnownSheets]:
    """Yield the sheets of each pad as they truly are; deployment: with the stated radii, as described."""
    for entry in deployment.pads:
        pad = entry.pad
        model = PadCircuitModel(deployment, pad)
        of_pads = [pad]
        if pad.second_sheet is not None:
            joined: dict[str, Any] = {
                "link": f"{pad.link}/second",
                "sheet": pad.second_sheet,
                "second_sheet": None,
                "series_ohm": (0.0,) * len(pad.electrode_names),
            }
            of_pads.append(pad.model_copy(update=joined))
        stated = deployment.sheets[pad.sheet]
        log_radius, probability = _radii(stated, drawn)
        yield KnownSheets(
            tuple(_sheet(deployment, drawn, entry.hand, one, model, log_radius) for one in of_pads),
            log_radius,
            probability,
        )


def _radii(sheet: config.Sheet, drawn: DrawnWorld) -> tuple[FloatArray, FloatArray]:
    """Return ln of the radii [m] that contacts have in a world, and their probabilities."""
    spread = drawn.world.contacts.radius_sigma
    drawn_sigma = spread.sample(np.random.default_rng(0), 20_000)
    radii = sheet.contact_radius_mm + drawn_sigma * sheet.contact_radius_std_mm
    logs = np.log(1e-3 * np.maximum(radii, 0.3 * sheet.contact_radius_mm))
    counts, edges = np.histogram(logs, _RADII, range=(logs.min() - 1e-9, logs.max() + 1e-9))
    return 0.5 * (edges[1:] + edges[:-1]), counts / counts.sum()


def _sheet(
    deployment: Deployment,
    drawn: DrawnWorld,
    hand: str,
    pad: config.Pad,
    model: PadCircuitModel,
    log_radius: FloatArray,
) -> _Sheet:
    """Return one sheet of a pad as it truly is."""
    table = drawn.sheet(hand, pad, deployment.sheets[pad.sheet])
    length_m, width_m = pad.surface.build().extent_m
    circuit = model.circuit_at((0.5 * length_m, 0.5 * width_m))
    law = ContactLaw(
        1e-6 * table.contact_ohm_mm2,
        table.alpha,
        np.exp(log_radius)[:, None],
        reference_pa=1e3 * table.reference_kpa,
    )
    series = 0.0 if pad.link.endswith("/second") else circuit.series_ohm
    current = law.current(
        np.exp(_LOG_FORCES), circuit.drive_v, table.ohm_per_square, circuit.spreading_m, series
    )
    own = drawn.pad(hand, pad).sheet_law
    node = deployment.nodes[pad.node]
    channels = 1 if pad.link.endswith("/second") else len(pad.electrode_names)
    noise_a = node.noise_counts * ampere_per_count_of(pad, deployment)[0] * channels**0.5
    return _Sheet(np.log(current), own.press_std if own else 0.0, own.noise_std if own else 0.0, noise_a)
