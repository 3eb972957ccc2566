"""Expected location error of a pad: its electrodes, contact law and electronics.

Public names: `PadDesign`, `expected_error`, `error_summary`, `pad_design`.

Errors are Cramer-Rao bounds, which the estimator reaches, for the converter's noise, quantisation included,
at the current that a given force causes at each position.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.field import (
    ContactLaw,
    ElectrodeNetwork,
    Surface,
)
from handtouch.hand.pads import electrode_network, pad_surface, sheet_law

FIRM_TOUCH_N = 1.0
EDGE_MARGIN = 0.1  # margin of each side, excluded from medians and worst cases
_WIRE_COUNT_BITS = 16  # counts are published as int16


@dataclass(frozen=True)
class PadDesign:
    """One pad: its surface, electrodes on the surface's rectangle, contact law and electronics.

    noise_counts: standard deviation of a channel's reading besides quantisation, in counts of 16 bits. bits:
    of the converter. light_touch_n: force of a light touch.
    """

    name: str
    surface: Surface
    network: ElectrodeNetwork
    law: ContactLaw
    drive_v: float
    full_scale_a: float
    noise_counts: float
    light_touch_n: float
    bits: int = _WIRE_COUNT_BITS

    @property
    def noise_a(self) -> float:
        """Standard deviation of a channel's current [A]."""
        per_count = self.full_scale_a / 2 ** (_WIRE_COUNT_BITS - 1)
        step = self.full_scale_a / 2 ** (self.bits - 1)
        return math.hypot(self.noise_counts * per_count, step / math.sqrt(12))


def expected_error(
    pad: PadDesign, force_n: float, x: npt.ArrayLike, y: npt.ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Return the standard deviation of position on the surface [m] and the total current [A], shape (...).

    The deviation is the root of the sum of both coordinates' variances. x, y: positions on the pad's
    rectangle.
    """
    x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    outer = pad.network.spreading_radius(x, y) * pad.surface.scale(x, y)
    total = pad.law.current(
        force_n, pad.drive_v, pad.network.sheet_ohm_per_square, outer, pad.network.series_resistance(x, y)
    )
    fractions, jacobian = pad.network.fractions_with_jacobian(x, y)
    slopes = jacobian / pad.surface.scales(x, y)
    columns = np.moveaxis(np.concatenate([slopes, fractions[:, None]], axis=1), (0, 1), (-2, -1))
    covariance = np.linalg.inv(np.swapaxes(columns, -1, -2) @ columns)
    spread = np.sqrt(covariance[..., 0, 0] + covariance[..., 1, 1])
    return np.asarray(spread * pad.noise_a / total), np.asarray(total)


def error_summary(pad: PadDesign, force_n: float) -> tuple[float, float]:
    """Return the median and worst expected error [m], `EDGE_MARGIN` of each side left out."""
    steps = np.linspace(EDGE_MARGIN, 1 - EDGE_MARGIN, 25)
    x, y = np.meshgrid(steps * pad.network.a, steps * pad.network.b)
    error, _ = expected_error(pad, force_n, x, y)
    return float(np.median(error)), float(error.max())


def pad_design(deployment: config.Deployment, link: str | None = None) -> PadDesign:
    """Return the design of the pad on a link, or of the first pad. Raises ValueError naming the known
    links.
    """
    pads = [entry.pad for entry in deployment.pads]
    chosen = next((pad for pad in pads if link in (None, pad.link)), None)
    if chosen is None:
        raise ValueError(f"no pad on link {link}; known links: {', '.join(pad.link for pad in pads)}")
    sheet, node = deployment.sheet_of(chosen), deployment.nodes[chosen.node]
    return PadDesign(
        chosen.link,
        pad_surface(chosen),
        electrode_network(chosen, sheet),
        sheet_law(sheet, sheet.contact_ohm_mm2, sheet.alpha, sheet.hertz_force_n),
        node.drive_v,
        node.full_scale_ma * 1e-3,
        node.noise_counts,
        deployment.touch_of(chosen).begin_threshold_n,
    )
