"""Velocity of a link's surface relative to the object it touches, from joint states and other contacts.

Public names: `RelativeMotion`, `slip_probability`. `handtouch.core.stages.evidence` computes the velocities.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

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

    @classmethod
    def of_velocity(cls, velocity: tuple[float, float, float], std: float, others: int) -> RelativeMotion:
        """Return the motion at a velocity [m/s], relative to an object whose own `others` contacts show.

        Without any the object is assumed to rest in the palm.
        """
        wide = std**2 + _SLIDING_SPEED_STD_M_PER_S**2
        square = sum(component * component for component in velocity)
        log_ratio = 0.5 * square * (1 / std**2 - 1 / wide) - math.log(wide / std**2)
        return cls(
            velocity,
            std,
            "grasp" if others else "static",
            others,
            # that the object is static is only an assumption
            slip_probability((log_ratio if others else max(log_ratio, 0.0)) + _SLIDING_LOG_ODDS),
            slip_probability(log_ratio + _SLIDING_AT_REST_LOG_ODDS) if others else 0.0,
        )


def slip_probability(log_odds: float) -> float:
    """Return the probability of ln of odds."""
    return 1 / (1 + math.exp(-max(-50.0, min(50.0, log_odds))))
