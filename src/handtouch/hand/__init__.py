"""Hands: pads on links, robot descriptions (URDF), kinematics, joint states and contact groups.

Public names: `pad_surface`, `mount_transform`, `electrode_network`, `networks_with_other_parts`,
`PadGeometry`, `LinkContacts`.
"""

from handtouch.hand.pad_geometry import LinkContacts, PadGeometry
from handtouch.hand.pads import (
    electrode_network,
    mount_transform,
    networks_with_other_parts,
    pad_surface,
)

__all__ = [
    "LinkContacts",
    "PadGeometry",
    "electrode_network",
    "mount_transform",
    "networks_with_other_parts",
    "pad_surface",
]
