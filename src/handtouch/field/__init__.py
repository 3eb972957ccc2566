"""Potential theory of one area touch sensor: arrays in, arrays out; no I/O, no clock."""

from handtouch.field.bank import LocatorBank
from handtouch.field.estimate import PointEstimate, estimate
from handtouch.field.model import ForwardModel
from handtouch.field.network import Electrode, ElectrodeNetwork
from handtouch.field.rectangle import Location, Rectangle
from handtouch.field.surface import Anisotropic, Cone, Cylinder, Plane, Prism, Revolution, Sphere, Surface

__all__ = [
    "Anisotropic",
    "Cone",
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
    "Sphere",
    "Surface",
    "estimate",
]
