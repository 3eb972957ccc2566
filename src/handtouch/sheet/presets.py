"""The two sheets of the paper, and the bench circuit they were measured with.

Public names: `S1`, `S2`, `UNKNOWN`, `S1_BENCH`, `S2_BENCH`, `BenchCircuit`.

docs/theory.md states the source of each number. The paper reports no contact law of S2 and only alpha of S1:
the loads at which layer and sheet have equal resistance are assumptions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handtouch.field import ContactLaw
from handtouch.host.units import GRAM_FORCE_N
from handtouch.sheet.adaptation import Adaptation
from handtouch.sheet.behaviour import SheetModel, TemperatureResponse
from handtouch.sheet.creep import Creep
from handtouch.sheet.fluctuation import Fluctuation

FloatArray = npt.NDArray[np.float64]


HOUR_S = 3600.0

S1 = SheetModel(
    Adaptation(
        share=1.0, time_s=3000.0, recovery_s=1.5 * HOUR_S, threshold_n=2 * GRAM_FORCE_N, fatigue_s=10_000.0
    ),
    Creep.first_order(0.4, 0.25),
    temperature=TemperatureResponse(gain_per_k=0.01),
    fluctuation=Fluctuation(press_std=0.072, noise_std=0.01),
)
S2 = SheetModel(
    Adaptation(share=0.851, time_s=3000.0, recovery_s=1.5 * HOUR_S, threshold_n=5 * GRAM_FORCE_N),
    Creep.first_order(0.4, 0.25),
    temperature=TemperatureResponse(gain_per_k=0.01),
    fluctuation=Fluctuation(press_std=0.171, noise_std=0.01),
)
UNKNOWN = SheetModel(
    Adaptation(share=0.85, time_s=3000.0, recovery_s=1.5 * HOUR_S, threshold_n=0.03),
    Creep.first_order(0.7, 0.25),
    fluctuation=Fluctuation(press_std=0.15, noise_std=0.01),
)
"""A sheet that wasn't measured: the paper's usual numbers, as probable as no adaptation at all."""


@dataclass(frozen=True)
class BenchCircuit:
    """The paper's circuit: a spacer pressed on the middle of a sheet of 6.2 x 3.5 cm, under potential.

    equal_resistance_n: load at which the layer has the resistance of the sheet [N].
    """

    ohm_per_square: float
    alpha: float
    equal_resistance_n: float
    drive_v: float = 12.0
    radius_m: float = 5.06e-3  # radius of a disc as large as the spacer: 1 cm^2 less four holes of 2.5 mm
    spreading_radius_m: float = 0.0222  # conformal radius of the middle of the sheet

    @property
    def law(self) -> ContactLaw:
        """The contact law of the fresh sheet."""
        area = np.pi * self.radius_m**2
        sheet_ohm = self.ohm_per_square / (2 * np.pi) * np.log(self.spreading_radius_m / self.radius_m)
        return ContactLaw(
            sheet_ohm * area, self.alpha, self.radius_m, reference_pa=self.equal_resistance_n / area
        )

    def current(self, apparent_n: npt.ArrayLike) -> FloatArray:
        """Total current [A] at an apparent load [N]."""
        return self.law.current(apparent_n, self.drive_v, self.ohm_per_square, self.spreading_radius_m)


S1_BENCH = BenchCircuit(2400.0, 1.5, 300 * GRAM_FORCE_N)
S2_BENCH = BenchCircuit(15_000.0, 1.5, 120 * GRAM_FORCE_N)
