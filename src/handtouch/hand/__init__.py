"""Links and mounts: a point on a pad -> the link's frame.

Public names: `surface_of`, `mount_of`, `network_of`, `Placement`, `Placed`.
"""

from handtouch.hand.pads import mount_of, network_of, surface_of
from handtouch.hand.placement import Placed, Placement

__all__ = ["Placed", "Placement", "mount_of", "network_of", "surface_of"]
