"""Hands: pads on links, robot descriptions (URDF), kinematic trees and joint states."""

from handtouch.hand.pads import (
    MountUncertainty,
    channel_gain_std,
    electrode_network,
    models_with_other_parts,
    mount_transform,
    network_parameters,
    pad_channels,
    pad_network,
    pad_surface,
    part_limits,
    part_stds,
)

__all__ = [
    "MountUncertainty",
    "channel_gain_std",
    "electrode_network",
    "models_with_other_parts",
    "mount_transform",
    "network_parameters",
    "pad_channels",
    "pad_network",
    "pad_surface",
    "part_limits",
    "part_stds",
]
