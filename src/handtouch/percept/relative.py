"""How the surface of a link moves against the object that it touches, from joint states and other contacts.

Public names: `Materials`, `relative_to_object`, `Relative`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.percept.stream import IntArray, Stream

FloatArray = NDArray[np.float64]
_OVER_S = 0.05  # that velocities are taken over
_LINK_STD = 1e-3  # of the velocity of a link's material, from what links give [m/s]
_TURNS, _MOVES = 3.0, 0.3  # prior of an object's motion in the palm: rad/s, m/s
_SLIDES = 0.02  # prior of relative speeds, when surfaces slide [m/s]
_SLIDES_ODDS = math.log(4.0)  # ln of the prior odds of sliding, not rolling, of a centroid that runs
_SURE_ODDS = -9.0  # ln of the prior odds of sliding where the centroid stands still on the pad


@dataclass(frozen=True, slots=True)
class Relative:
    """`velocity` of the link's surface against the object, in the palm's frame; `std` of each component."""

    velocity: tuple[float, float, float]
    std: float
    object: str
    """grasp: a rigid body moved by the other contacts; static: taken to stand still in the palm"""
    contacts: int
    """that tell how the object moves"""
    slides: float
    """probability of sliding rather than rolling, of a centroid that runs"""
    surely: float
    """the same of one that stands still on the pad"""

    def values(self) -> dict[str, float | str | list[float]]:
        """As the message has them."""
        return {
            "object": self.object,
            "object_contacts": self.contacts,
            "relative_m_per_s": list(self.velocity),
            "relative_m_per_s_std": self.std,
        }


class Materials(NamedTuple):
    """Of the links under all contacts of which the palm and joints tell: `pads` (k,), and in the palm's frame
    places, outward normals, and velocities of the links' material (k, 3); `std` (k,) of each way of these."""

    pads: IntArray
    place: FloatArray
    normal: FloatArray
    velocity: FloatArray
    std: FloatArray

    @classmethod
    def of(cls, stream: Stream, t_ns: int, period_s: float) -> Materials:
        """Over the last 50 ms of samples that come every `period_s`."""
        pads = np.flatnonzero(stream.count > 1)
        pads = pads[np.isfinite(stream.latest(pads, "palm_position_m")[:, 0])]
        if not len(pads):  # often: no joints are told
            none = np.zeros((0, 3))
            return cls(pads, none, none, none, np.zeros(0))
        back = np.minimum(max(round(_OVER_S / period_s), 1), stream.count[pads] - 1)
        now_ns, then_ns = stream.latest_ns(pads), stream.latest_ns(pads, back)
        palm, link, normal = (
            stream.latest(pads, name) for name in ("palm_position_m", "position_m", "palm_normal")
        )
        was, was_on_link, rotation = (
            stream.latest(pads, name, back) for name in ("palm_position_m", "position_m", "palm_rotation")
        )
        moved = palm - was - (rotation @ (link - was_on_link)[:, :, None])[:, :, 0]
        known = np.isfinite(moved).all(axis=1) & (t_ns - now_ns <= _OVER_S * 1e9) & (now_ns > then_ns)
        over_s = (now_ns - then_ns)[known] * 1e-9
        noise = sum(stream.latest(pads[known], "palm_joints_m2", b) for b in (0, back[known]))
        std = np.hypot(_LINK_STD, np.sqrt(np.nan_to_num(noise)) / over_s)  # as if fresh with every sample
        return cls(pads[known], palm[known], normal[known], moved[known] / over_s[:, None], std)


def relative_to_object(
    materials: Materials, pad: int, hand_of: IntArray, doubtful: NDArray[np.bool_]
) -> Relative | None:
    """Of the contact on a pad; None where joint states don't tell the places of its link.

    `doubtful` (n,) are contacts that aren't to be relied on to stick.
    """
    own = np.flatnonzero(materials.pads == pad)
    if not len(own):
        return None
    place, normal, velocity, own_std = (column[own[0]] for column in materials[1:])
    pads = materials.pads
    holds = (hand_of[pads] == hand_of[pad]) & ~doubtful[pads] & (pads != pad)
    others = int(np.count_nonzero(holds))
    moves, variance = np.zeros(3), 0.0
    if others:
        moves, covariance = _rigid(
            materials.place[holds] - place, materials.velocity[holds], materials.std[holds]
        )
        variance = float(np.trace(covariance) - normal @ covariance @ normal) / 2
    against = velocity - moves
    against -= normal * (normal @ against)
    std = math.sqrt(own_std**2 + variance)
    wide = std**2 + _SLIDES**2
    log_ratio = 0.5 * float(against @ against) * (1 / std**2 - 1 / wide) - math.log(wide / std**2)
    return Relative(
        tuple(against.tolist()),
        std,
        "grasp" if others else "static",
        others,
        _sigmoid((log_ratio if others else max(log_ratio, 0.0)) + _SLIDES_ODDS),  # it need not stand still
        _sigmoid(log_ratio + _SURE_ODDS) if others else 0.0,
    )


def _rigid(offset: FloatArray, velocity: FloatArray, std: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Velocity (3,) and covariance (3, 3) at a place of the body that moves as material (k, 3) at offsets,
    known within `std` (k,)."""
    x, y, z = offset.T
    rows = np.zeros((len(offset), 3, 6))
    rows[:, [0, 1, 2], [0, 1, 2]] = 1.0  # v + omega x offset
    rows[:, 0, 4], rows[:, 0, 5], rows[:, 1, 3] = z, -y, -z
    rows[:, 1, 5], rows[:, 2, 3], rows[:, 2, 4] = x, y, -x
    flat, weight = rows.reshape(-1, 6), np.repeat(std**-2, 3)
    precision = np.diag([1 / _MOVES**2] * 3 + [1 / _TURNS**2] * 3) + (flat.T * weight) @ flat
    covariance = np.asarray(np.linalg.inv(precision), dtype=np.float64)
    return (covariance @ ((flat.T * weight) @ velocity.ravel()))[:3], covariance[:3, :3]


def _sigmoid(log_odds: float) -> float:
    return 1 / (1 + math.exp(-max(-50.0, min(50.0, log_odds))))
