"""Potential theory of one resistive touch sensor: arrays in, arrays out; no I/O, no clock."""

from handtouch.field.bank import LocatorBank
from handtouch.field.contact_law import (
    ContactLaw,
    ForceEstimate,
    ForceEstimateStatus,
    contact_stack_resistance,
)
from handtouch.field.estimate import PointEstimate, estimate
from handtouch.field.mesh_network import MeshNetwork, read_stl
from handtouch.field.model import ForwardModel
from handtouch.field.network import Electrode, ElectrodeNetwork
from handtouch.field.outline import Outline
from handtouch.field.outline_network import BoundaryElectrode, OutlineNetwork
from handtouch.field.perimeter_network import PerimeterNetwork
from handtouch.field.rectangle import Location, Rectangle
from handtouch.field.residual import PointTest, point_test, resolvable_separation
from handtouch.field.resolve import ContactShape, ResolvedContacts, ShapeEstimate, resolve_contacts
from handtouch.field.sandwich import Sandwich, SandwichEstimate
from handtouch.field.scheduled_network import ScheduledNetwork
from handtouch.field.surface import (
    AnisotropicSurface,
    ConeSurface,
    CylinderSurface,
    PlaneSurface,
    PrismSurface,
    RevolutionSurface,
    SphereSurface,
    Surface,
)
from handtouch.field.switched import SwitchedNetwork

__all__ = [
    "AnisotropicSurface",
    "BoundaryElectrode",
    "ConeSurface",
    "ContactLaw",
    "ContactShape",
    "CylinderSurface",
    "Electrode",
    "ElectrodeNetwork",
    "ForceEstimate",
    "ForceEstimateStatus",
    "ForwardModel",
    "Location",
    "LocatorBank",
    "MeshNetwork",
    "Outline",
    "OutlineNetwork",
    "PerimeterNetwork",
    "PlaneSurface",
    "PointEstimate",
    "PointTest",
    "PrismSurface",
    "Rectangle",
    "ResolvedContacts",
    "RevolutionSurface",
    "Sandwich",
    "SandwichEstimate",
    "ScheduledNetwork",
    "ShapeEstimate",
    "SphereSurface",
    "Surface",
    "SwitchedNetwork",
    "contact_stack_resistance",
    "estimate",
    "point_test",
    "read_stl",
    "resolvable_separation",
    "resolve_contacts",
]
