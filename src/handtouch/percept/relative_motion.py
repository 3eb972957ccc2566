"""Velocity of a link's surface relative to the object it touches, from joint states and other contacts.

Public names: `ContactLinkPoses`, `LinkMotions`, `relative_to_object`, `RelativeMotion`, `VELOCITY_WINDOW_S`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.percept.samples import ContactBuffer, IntArray

FloatArray = NDArray[np.float64]
VELOCITY_WINDOW_S = 0.05
"""Time over which velocities of links are measured."""
_LINK_VELOCITY_STD_M_PER_S = 1e-3  # from the elasticity of links
_OBJECT_ROTATION_STD_RAD_PER_S = 0.5  # prior of a held object's rotation in the palm frame
_OBJECT_VELOCITY_STD_M_PER_S = 0.3
_SLIDING_SPEED_STD_M_PER_S = 0.02  # prior of relative speeds while surfaces slide
_SLIDING_LOG_ODDS = math.log(4.0)  # ln of the prior odds of sliding over rolling, of a moving centroid
_SLIDING_AT_REST_LOG_ODDS = -9.0  # ln of the prior odds of sliding while the centroid rests


@dataclass(frozen=True, slots=True)
class RelativeMotion:
    """Velocity of the link's surface relative to the object, in the palm frame; `std` of each component."""

    velocity: tuple[float, float, float]
    std: float
    object: str
    """grasp: a rigid body moved by the other contacts; static: assumed at rest in the palm frame"""
    contacts: int
    """number of contacts that determine the object's motion"""
    sliding_probability: float
    """probability of sliding rather than rolling, if the centroid moves"""
    sliding_at_rest_probability: float
    """probability of sliding, if the centroid is at rest on the pad"""

    def message_values(self) -> dict[str, float | str | list[float]]:
        """Return the values as published."""
        return {
            "object_reference": self.object,
            "reference_contacts": self.contacts,
            "relative_velocity_m_per_s": list(self.velocity),
            "relative_velocity_m_per_s_std": self.std,
        }


class ContactLinkPoses(NamedTuple):
    """Poses of the links under contacts at one sample, NaN where unknown.

    Positions of the contacts in the palm frame and in the links' frames (k, 3), and the links' rotations in
    the palm (k, 3, 3).
    """

    palm_m: FloatArray
    link_m: FloatArray
    rotation: FloatArray

    @classmethod
    def from_buffer(cls, buffer: ContactBuffer, pads: IntArray, back: IntArray | int = 0) -> ContactLinkPoses:
        """Return those of the last sample of pads (k,), or of `back` samples earlier."""
        names = ("palm_position_m", "position_m", "palm_rotation")
        return cls(*(buffer.latest_field(pads, name, back) for name in names))

    def material_way_m(self, before: ContactLinkPoses) -> FloatArray:
        """Return the ways (k, 3) in the palm frame, since then, of the links' points now in contact."""
        on_link = (before.rotation @ (self.link_m - before.link_m)[:, :, None])[:, :, 0]
        return np.asarray(self.palm_m - before.palm_m - on_link)


class LinkMotions(NamedTuple):
    """Motion of the links under all contacts of known pose, in the palm frame.

    `pads` (k,); positions, outward normals and material velocities (k, 3); `std` (k,) of each velocity
    component.
    """

    pads: IntArray
    position_m: FloatArray
    normal: FloatArray
    velocity: FloatArray
    std: FloatArray

    @classmethod
    def from_buffer(cls, buffer: ContactBuffer, now_ns: int, period_s: float) -> LinkMotions:
        """Return the motions over the last 50 ms of samples that come every `period_s`."""
        pads = np.flatnonzero(buffer.sample_count > 1)
        pads = pads[np.isfinite(buffer.latest_field(pads, "palm_position_m")[:, 0])]
        if not len(pads):  # common case: no joint states
            none = np.zeros((0, 3))
            return cls(pads, none, none, none, np.zeros(0))
        back = np.minimum(max(round(VELOCITY_WINDOW_S / period_s), 1), buffer.sample_count[pads] - 1)
        last_ns, then_ns = buffer.latest_sample_ns(pads), buffer.latest_sample_ns(pads, back)
        now, normal = ContactLinkPoses.from_buffer(buffer, pads), buffer.latest_field(pads, "palm_normal")
        moved = now.material_way_m(ContactLinkPoses.from_buffer(buffer, pads, back))
        known = (
            np.isfinite(moved).all(axis=1)
            & (now_ns - last_ns <= VELOCITY_WINDOW_S * 1e9)
            & (last_ns > then_ns)
        )
        over_s = (last_ns - then_ns)[known] * 1e-9
        noise = sum(buffer.latest_field(pads[known], "palm_joints_m2", b) for b in (0, back[known]))
        std = np.hypot(
            _LINK_VELOCITY_STD_M_PER_S, np.sqrt(np.nan_to_num(noise)) / over_s
        )  # as if independent in every sample
        return cls(pads[known], now.palm_m[known], normal[known], moved[known] / over_s[:, None], std)


def relative_to_object(
    link_motions: LinkMotions, pad: int, hand_index: IntArray, uncertain: NDArray[np.bool_]
) -> RelativeMotion | None:
    """Return the relative motion of the contact on a pad; None if its link's pose isn't known.

    uncertain: contacts (n,) that can't be relied on to stick.
    """
    own = np.flatnonzero(link_motions.pads == pad)
    if not len(own):
        return None
    position_m, normal, velocity, own_std = (column[own[0]] for column in link_motions[1:])
    pads = link_motions.pads
    holds = (hand_index[pads] == hand_index[pad]) & ~uncertain[pads] & (pads != pad)
    others = int(np.count_nonzero(holds))
    moves, variance = np.zeros(3), 0.0
    if others:
        moves, covariance = _rigid_body_velocity(
            link_motions.position_m[holds] - position_m, link_motions.velocity[holds], link_motions.std[holds]
        )
        variance = float(np.trace(covariance) - normal @ covariance @ normal) / 2
    against = velocity - moves
    against -= normal * (normal @ against)
    std = math.sqrt(own_std**2 + variance)
    wide = std**2 + _SLIDING_SPEED_STD_M_PER_S**2
    log_ratio = 0.5 * float(against @ against) * (1 / std**2 - 1 / wide) - math.log(wide / std**2)
    return RelativeMotion(
        tuple(against.tolist()),
        std,
        "grasp" if others else "static",
        others,
        _sigmoid(
            (log_ratio if others else max(log_ratio, 0.0)) + _SLIDING_LOG_ODDS
        ),  # a static object is only an assumption
        _sigmoid(log_ratio + _SLIDING_AT_REST_LOG_ODDS) if others else 0.0,
    )


def _rigid_body_velocity(
    offset: FloatArray, velocity: FloatArray, std: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return velocity (3,) and covariance (3, 3) at a point of a rigid body.

    From the velocities (k, 3) of its material at offsets (k, 3) from that point, known within `std` (k,).
    """
    x, y, z = offset.T
    rows = np.zeros((len(offset), 3, 6))
    rows[:, [0, 1, 2], [0, 1, 2]] = 1.0  # v + omega x offset
    rows[:, 0, 4], rows[:, 0, 5], rows[:, 1, 3] = z, -y, -z
    rows[:, 1, 5], rows[:, 2, 3], rows[:, 2, 4] = x, y, -x
    flat, weight = rows.reshape(-1, 6), np.repeat(std**-2, 3)
    precision = (
        np.diag([1 / _OBJECT_VELOCITY_STD_M_PER_S**2] * 3 + [1 / _OBJECT_ROTATION_STD_RAD_PER_S**2] * 3)
        + (flat.T * weight) @ flat
    )
    covariance = np.asarray(np.linalg.inv(precision), dtype=np.float64)
    return (covariance @ ((flat.T * weight) @ velocity.ravel()))[:3], covariance[:3, :3]


def _sigmoid(log_odds: float) -> float:
    return 1 / (1 + math.exp(-max(-50.0, min(50.0, log_odds))))
