"""The two sheets of the paper, and one that wasn't measured.

Public names: `S1`, `S2`, `UNKNOWN`. docs/theory.md states the source of each number.
"""

from __future__ import annotations

from handtouch.host.units import GRAM_FORCE_N
from handtouch.sheet.adaptation import Adaptation
from handtouch.sheet.behaviour import SheetModel, TemperatureResponse
from handtouch.sheet.creep import Creep
from handtouch.sheet.fluctuation import Fluctuation

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
