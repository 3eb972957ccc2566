"""How the surface of a link moves against the object that it touches, from joint states and other contacts.

Public names: `relative_to_object`, `Relative`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtouch.percept.stream import Stream

FloatArray = NDArray[np.float64]
_OVER_S = 0.05  # that velocities are taken over
_LINK_STD = 1e-3  # of the velocity of a link's material, from encoders and what links give [m/s]
_TURNS, _MOVES = 3.0, 0.3  # prior of an object's motion in the palm: rad/s, m/s
_SLIDES = 0.02  # prior of relative speeds, when surfaces slide [m/s]
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


def relative_to_object(stream: Stream, pad: int, running: NDArray[np.bool_], t_ns: int) -> Relative | None:
    """Of the contact on a pad; None where joint states don't tell the places of its link.

    `running` (n,) are contacts that aren't to be relied on to stick.
    """
    mine = _material(stream, pad, t_ns)
    if mine is None:
        return None
    place, normal, velocity = mine
    sticks = (stream.contact > 0) & (stream.hand_of == stream.hand_of[pad]) & ~running
    sticks[pad] = False
    all_held = [_material(stream, other, t_ns) for other in np.flatnonzero(sticks).tolist()]
    others = [held for held in all_held if held is not None]
    moves, variance = np.zeros(3), 0.0
    if others:
        moves, covariance = _rigid(place, [(p - place, v) for p, _, v in others])
        variance = float(np.trace(covariance) - normal @ covariance @ normal) / 2
    against = velocity - moves
    against -= normal * (normal @ against)
    std = math.sqrt(_LINK_STD**2 + variance)
    wide = std**2 + _SLIDES**2
    log_ratio = 0.5 * float(against @ against) * (1 / std**2 - 1 / wide) - math.log(wide / std**2)
    return Relative(
        tuple(against.tolist()),
        std,
        "grasp" if others else "static",
        len(others),
        _sigmoid(log_ratio),
        _sigmoid(log_ratio + _SURE_ODDS) if others else 0.0,
    )


def _material(stream: Stream, pad: int, t_ns: int) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Place, normal and velocity of the link's material under a contact, in the palm; None if not known."""
    window = stream.window(pad, 64)
    if len(window) < 2 or t_ns - window.t_ns[-1] > _OVER_S * 1e9:
        return None
    then = int(np.searchsorted(window.t_s, -_OVER_S))
    then = min(then, len(window) - 2)
    palm, link, rotation = window["palm_position_m"], window["position_m"], window["palm_rotation"]
    moved = palm[-1] - palm[then] - rotation[then] @ (link[-1] - link[then])
    if not np.isfinite(moved).all():
        return None
    return palm[-1].copy(), window["palm_normal"][-1].copy(), moved / -window.t_s[then]


def _rigid(place: FloatArray, held: list[tuple[FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    """Velocity (3,) and covariance (3, 3) at a place of the body that moves as material at offsets does."""
    precision = np.diag([1 / _MOVES**2] * 3 + [1 / _TURNS**2] * 3)
    right = np.zeros(6)
    for offset, velocity in held:
        x, y, z = offset
        row = np.hstack([np.eye(3), np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])])  # v + omega x offset
        precision += row.T @ row / _LINK_STD**2
        right += row.T @ velocity / _LINK_STD**2
    covariance = np.linalg.inv(precision)
    return (covariance @ right)[: len(place)], covariance[:3, :3]


def _sigmoid(log_odds: float) -> float:
    return 1 / (1 + math.exp(-max(-50.0, min(50.0, log_odds))))
