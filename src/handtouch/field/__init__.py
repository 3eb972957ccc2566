"""Potential theory of one area touch sensor: arrays in, arrays out; no I/O, no clock."""

from handtouch.field.bank import LocatorBank
from handtouch.field.estimate import PointEstimate, estimate
from handtouch.field.model import ForwardModel
from handtouch.field.network import Electrode, ElectrodeNetwork
from handtouch.field.rectangle import Location, Rectangle
from handtouch.field.sandwich import Sandwich, SandwichStrength
from handtouch.field.strength import ContactLaw, Status, Strength, contact_stack_resistance
from handtouch.field.surface import Anisotropic, Cone, Cylinder, Plane, Prism, Revolution, Sphere, Surface

__all__ = [
    "Anisotropic",
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
    "Prism",
    "Rectangle",
    "Revolution",
    "Sandwich",
    "SandwichStrength",
    "Sphere",
    "Status",
    "Strength",
    "Surface",
    "contact_stack_resistance",
    "estimate",
]
