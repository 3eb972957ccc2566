"""Potential theory of one area touch sensor: arrays in, arrays out; no I/O, no clock."""

from handtouch.field.bank import LocatorBank
from handtouch.field.chooser import Choice, choose
from handtouch.field.estimate import PointEstimate, estimate
from handtouch.field.model import ForwardModel
from handtouch.field.network import Electrode, ElectrodeNetwork
from handtouch.field.ratio_table import RatioTable
from handtouch.field.rectangle import Location, Rectangle
from handtouch.field.residual import PointTest, point_test, resolvable_separation
from handtouch.field.sandwich import Sandwich, SandwichStrength
from handtouch.field.strength import ContactLaw, Status, Strength, contact_stack_resistance
from handtouch.field.surface import Anisotropic, Cone, Cylinder, Plane, Prism, Revolution, Sphere, Surface

__all__ = [
    "Anisotropic",
    "Choice",
    "Cone",
    "ContactLaw",
    "Cylinder",
    "Electrode",
    "ElectrodeNetwork",
    "ForwardModel",
    "Location",
    "LocatorBank",
    "Plane",
    "PointEstimate",
    "PointTest",
    "Prism",
    "RatioTable",
    "Rectangle",
    "Revolution",
    "Sandwich",
    "SandwichStrength",
    "Sphere",
    "Status",
    "Strength",
    "Surface",
    "choose",
    "contact_stack_resistance",
    "estimate",
    "point_test",
    "resolvable_separation",
]
