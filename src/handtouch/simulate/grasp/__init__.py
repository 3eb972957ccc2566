"""Grasps in MuJoCo: what the hand holds, where it touches, and how hard, computed by nobody here.

Public names: `Grasp` (how one went), `grasp` (let the hand close on a thing), `available`. Needs the extra
`handtouch[mujoco]`.
"""

from importlib.util import find_spec

from handtouch.simulate.grasp.episode import Grasp, grasp
from handtouch.simulate.grasp.things import THINGS

INSTALL = "pip install 'handtouch[mujoco]'"

__all__ = ["INSTALL", "THINGS", "Grasp", "available", "grasp"]


def available() -> bool:
    """Whether MuJoCo is installed."""
    return find_spec("mujoco") is not None
