"""The node's side of CANopen: simulated four-channel nodes on one bus, of any kind that has an EDS.

Public names: `DeviceBus` hosts the nodes, `Device` is one of them with its fault switches, `Line` what the
cable does to its frames, `Unnamed` a node without an id, `Sampler` what the nodes measure.

The EDS says which objects and PDOs a node has; SDO may change them as CiA 301 allows. `DeviceBus.handle` (a
frame came) and `DeviceBus.advance` (time has passed) drive everything and touch no clock but the one given;
`poll` and `start` do that for programs.
"""

from .bus import DeviceBus, Sampler
from .faults import Line
from .node import Device
from .unnamed import Unnamed

__all__ = ["Device", "DeviceBus", "Line", "Sampler", "Unnamed"]
