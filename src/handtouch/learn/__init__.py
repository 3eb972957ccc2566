"""Touch as features of a policy: one layout for robots, simulations and recordings.

Public names: `TouchFeatures`, `Feature`.
"""

from handtouch.learn.features import Feature, TouchFeatures

__all__ = ["Feature", "TouchFeatures"]
