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
from handtouch.field.rectangle import Location, Rectangle
from handtouch.field.surface_base import Surface

if TYPE_CHECKING:
    from handtouch.field._prism import PrismSurface
    from handtouch.field._revolution import RevolutionSurface
    from handtouch.field.film import Film, UnevenNetwork
    from handtouch.field.measured import MapPrior, MeasuredMap, PressTable, unit_signal
    from handtouch.field.mesh_surface import MeshSurface
    from handtouch.field.outline import Outline
    from handtouch.field.outline_network import BoundaryElectrode, OutlineNetwork
    from handtouch.field.surface import (
        AnisotropicSurface,
        ConeSurface,
        CylinderSurface,
        PlaneSurface,
        SphereSurface,
    )
    from handtouch.field.taxels import TaxelArray, TaxelContact, TaxelTolerances
    from handtouch.field.triangulation import Triangulation, parse_stl
    from handtouch.field.two_layers import TwoLayers

_LATER = {
    **dict.fromkeys(("BoundaryElectrode", "OutlineNetwork"), "outline_network"),
    **dict.fromkeys(("PlaneSurface", "CylinderSurface", "ConeSurface", "SphereSurface"), "surface"),
    **dict.fromkeys(("Film", "UnevenNetwork"), "film"),
    **dict.fromkeys(("MapPrior", "MeasuredMap", "PressTable", "unit_signal"), "measured"),
    **dict.fromkeys(("TaxelArray", "TaxelContact", "TaxelTolerances"), "taxels"),
    "AnisotropicSurface": "surface",
    "MeshSurface": "mesh_surface",
    "Outline": "outline",
    "PrismSurface": "_prism",
    "RevolutionSurface": "_revolution",
    "Triangulation": "triangulation",
    "TwoLayers": "two_layers",
    "parse_stl": "triangulation",
}
"""Modules of the names that load them when they are used, as not every daemon needs them"""

__all__ = [
    "AnisotropicSurface",
    "BoundaryElectrode",
    "ConeSurface",
    "ContactLaw",
    "CylinderSurface",
    "Electrode",
    "ElectrodeNetwork",
    "Film",
    "ForceEstimate",
    "ForceEstimateStatus",
    "ForwardModel",
    "Location",
    "MapPrior",
    "MeasuredMap",
    "MeshSurface",
    "Outline",
    "OutlineNetwork",
    "PlaneSurface",
    "PointEstimate",
    "PressTable",
    "PrismSurface",
    "Rectangle",
    "RevolutionSurface",
    "SphereSurface",
    "Surface",
    "TaxelArray",
    "TaxelContact",
    "TaxelTolerances",
    "Triangulation",
    "TwoLayers",
    "UnevenNetwork",
    "contact_stack_resistance",
    "estimate",
    "parse_stl",
    "unit_signal",
]


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module 'handtouch.field' has no attribute {name!r}")
    return getattr(import_module(f"handtouch.field.{_LATER[name]}"), name)
