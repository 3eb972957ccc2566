"""Links and mounts: a point on a pad -> the link's frame.

Public names: `surface_of`, `mount_of`, `Placement`, `Placed`.
"""

from handtouch.hand.mount import mount_of, surface_of
from handtouch.hand.placement import Placed, Placement

__all__ = ["Placed", "Placement", "mount_of", "surface_of"]
