"""Potential theory of one area touch sensor: arrays in, arrays out; no I/O, no clock."""

from handtouch.field.bank import LocatorBank
from handtouch.field.estimate import PointEstimate, estimate
from handtouch.field.model import ForwardModel
from handtouch.field.rectangle import Location, Rectangle

__all__ = ["ForwardModel", "Location", "LocatorBank", "PointEstimate", "Rectangle", "estimate"]
