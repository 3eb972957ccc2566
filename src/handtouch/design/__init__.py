"""Design of a pad's electrodes: the best layout for a goal, its check, drawings and tables.

Public names: `PadTask`, `PartTolerances`, `FabricationLimits`, `ElectrodeLayout`, `GOALS`, `optimise_layout`,
`DesignResult`, `goal_map`, `goal_value`, `simulated_goal_map`, `fabrication_drawing`, `deployment_text`.
"""

from handtouch.design.deployed import deployment_text, pad_with_layout
from handtouch.design.fabrication import fabrication_drawing
from handtouch.design.goals import GOALS, Goal, Statistic, goal_map, goal_value
from handtouch.design.layout import ElectrodeLayout, FabricationLimits
from handtouch.design.optimise import DesignResult, optimise_layout
from handtouch.design.pad_task import PadTask, PartTolerances
from handtouch.design.simulated_check import CHECKED_GOALS, simulated_goal_map

__all__ = [
    "CHECKED_GOALS",
    "GOALS",
    "DesignResult",
    "ElectrodeLayout",
    "FabricationLimits",
    "Goal",
    "PadTask",
    "PartTolerances",
    "Statistic",
    "deployment_text",
    "fabrication_drawing",
    "goal_map",
    "goal_value",
    "optimise_layout",
    "pad_with_layout",
    "simulated_goal_map",
]
