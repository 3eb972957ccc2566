"""Potential theory of one resistive touch sensor: arrays in, arrays out; no I/O, no clock."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from handtouch.field.contact_law import (
    ContactLaw,
    ForceEstimate,
    ForceEstimateStatus,
    contact_stack_resistance,
)
from handtouch.field.estimate import PointEstimate, estimate
from handtouch.field.model import ForwardModel
from handtouch.field.network import Electrode, ElectrodeNetwork
from handtouch.field.outline import Outline
from handtouch.field.outline_network import BoundaryElectrode, OutlineNetwork
from handtouch.field.rectangle import Location, Rectangle
from handtouch.field.surface import (
    AnisotropicSurface,
    ConeSurface,
    CylinderSurface,
    MeshSurface,
    PlaneSurface,
    PrismSurface,
    RevolutionSurface,
    SphereSurface,
    Surface,
)

if TYPE_CHECKING:
    from handtouch.field.residual import PointTest, point_test

__all__ = [
    "AnisotropicSurface",
    "BoundaryElectrode",
    "ConeSurface",
    "ContactLaw",
    "CylinderSurface",
    "Electrode",
    "ElectrodeNetwork",
    "ForceEstimate",
    "ForceEstimateStatus",
    "ForwardModel",
    "Location",
    "MeshSurface",
    "Outline",
    "OutlineNetwork",
    "PlaneSurface",
    "PointEstimate",
    "PointTest",
    "PrismSurface",
    "Rectangle",
    "RevolutionSurface",
    "SphereSurface",
    "Surface",
    "contact_stack_resistance",
    "estimate",
    "point_test",
]

_LATER = dict.fromkeys(("PointTest", "point_test"), "residual")
"""Names that load their module when they are used: the daemon needs none of them"""


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module 'handtouch.field' has no attribute {name!r}")
    return getattr(import_module(f"handtouch.field.{_LATER[name]}"), name)
