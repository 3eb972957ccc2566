"""Worlds of a simulated hand: its true properties, which its deployment file and the daemon don't know.

`WORLDS[name].draw(seed)` is the world of one seed, a `DrawnWorld`; seeds belong to a `Family`.
"""

from handtouch.simulate.worlds.distributions import (
    Distribution,
    Fixed,
    LogNormal,
    LogUniform,
    Normal,
    OneOf,
    Uniform,
)
from handtouch.simulate.worlds.families import Family
from handtouch.simulate.worlds.named import WORLDS, world_named, world_with
from handtouch.simulate.worlds.shear_spread import HiddenShear, ShearSpread
from handtouch.simulate.worlds.sheet_kinds import SHEET_KINDS, SheetKind
from handtouch.simulate.worlds.spreads import (
    ContactSpread,
    ElectronicsSpread,
    MountSpread,
    PartSpread,
)
from handtouch.simulate.worlds.world import (
    UNEVEN_MODES,
    DrawnWorld,
    HiddenJoints,
    HiddenPad,
    World,
)

__all__ = [
    "SHEET_KINDS",
    "UNEVEN_MODES",
    "WORLDS",
    "ContactSpread",
    "Distribution",
    "DrawnWorld",
    "ElectronicsSpread",
    "Family",
    "Fixed",
    "HiddenJoints",
    "HiddenPad",
    "HiddenShear",
    "LogNormal",
    "LogUniform",
    "MountSpread",
    "Normal",
    "OneOf",
    "PartSpread",
    "ShearSpread",
    "SheetKind",
    "Uniform",
    "World",
    "world_named",
    "world_with",
]
