"""CANopen nodes with four channels, of any kind that has an EDS, on one bus: for simulation and as a device.

Public names: `DeviceBus` hosts the nodes; `Device` is one of them, with fault switches; `LineFaults` are
faults of its cable; `UnconfiguredDevice` is a node without an id; `Sampler` returns the counts that the nodes
measure.

The EDS defines the objects and PDOs of a node; SDO may change them as CiA 301 allows.
`DeviceBus.handle_frame` and `DeviceBus.advance` drive everything with the time that they are given; `poll`
and `start` call them by the clock.
"""

from handtouch.device.bus import DeviceBus, Sampler
from handtouch.device.faults import LineFaults
from handtouch.device.node import Device
from handtouch.device.unconfigured import UnconfiguredDevice

__all__ = ["Device", "DeviceBus", "LineFaults", "Sampler", "UnconfiguredDevice"]
