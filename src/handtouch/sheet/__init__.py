"""How resistive sheets behave in time: forwards to simulate, backwards to compensate; no I/O, no clock."""

from handtouch.sheet.adaptation import Adaptation, AdaptationState
from handtouch.sheet.behaviour import SheetModel, SheetState, SheetStep, SheetTrack, Temperature
from handtouch.sheet.compensator import Compensator, Doubt
from handtouch.sheet.creep import Creep
from handtouch.sheet.fluctuation import Fluctuation, FluctuationState
from handtouch.sheet.hysteresis import PrandtlIshlinskii
from handtouch.sheet.presets import GRAM_FORCE, S1, S1_BENCH, S2, S2_BENCH, Bench

__all__ = [
    "GRAM_FORCE",
    "S1",
    "S1_BENCH",
    "S2",
    "S2_BENCH",
    "Adaptation",
    "AdaptationState",
    "Bench",
    "Compensator",
    "Creep",
    "Doubt",
    "Fluctuation",
    "FluctuationState",
    "PrandtlIshlinskii",
    "SheetModel",
    "SheetState",
    "SheetStep",
    "SheetTrack",
    "Temperature",
]
