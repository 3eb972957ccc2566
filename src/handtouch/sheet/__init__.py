"""Sheet behaviour over time: forward models for simulation, inverse ones for compensation. No I/O."""

from handtouch.sheet.adaptation import Adaptation
from handtouch.sheet.bank import (
    BANK_LEARNED,
    BANK_MODELS,
    BANK_WINDOW,
    BankPrior,
    BankState,
    ModelBank,
    check_learned,
)
from handtouch.sheet.behaviour import (
    SheetModel,
    SheetModelState,
    TemperatureResponse,
)
from handtouch.sheet.compensator import (
    CompensatorState,
    ParameterUncertainty,
    SheetCompensator,
)
from handtouch.sheet.creep import Creep
from handtouch.sheet.fluctuation import Fluctuation
from handtouch.sheet.hysteresis import PrandtlIshlinskii
from handtouch.sheet.presets import (
    S1,
    S2,
    UNKNOWN,
)

__all__ = [
    "BANK_LEARNED",
    "BANK_MODELS",
    "BANK_WINDOW",
    "S1",
    "S2",
    "UNKNOWN",
    "Adaptation",
    "BankPrior",
    "BankState",
    "CompensatorState",
    "Creep",
    "Fluctuation",
    "ModelBank",
    "ParameterUncertainty",
    "PrandtlIshlinskii",
    "SheetCompensator",
    "SheetModel",
    "SheetModelState",
    "TemperatureResponse",
    "check_learned",
]
