"""Grasps in MuJoCo: what the hand holds, where it touches, and how hard, computed by nobody here.

Public names: `played` (a grasp as what happens to a simulated hand), `grasp` -> `Grasp` (how one went),
`THINGS`, `available`. Needs the extra `handtouch[mujoco]`.
"""

from importlib.util import find_spec

from handtouch import config
from handtouch.simulate.grasp.episode import Grasp, grasp
from handtouch.simulate.grasp.patches import patches
from handtouch.simulate.grasp.things import THINGS
from handtouch.simulate.grasp.timeline import Timeline
from handtouch.simulate.world import World

INSTALL = "pip install 'handtouch[mujoco]'"

__all__ = ["INSTALL", "THINGS", "Grasp", "available", "grasp", "played"]


def available() -> bool:
    """Whether MuJoCo is installed."""
    return find_spec("mujoco") is not None


def played(deployment: config.Deployment, thing: str, world: World, *, repeat: bool = False) -> Timeline:
    """The first hand of a deployment grasps a thing, drawn by the world's seed.

    Raises ValueError, in words for a user, where that can't be.
    """
    if not available():
        raise ValueError(f"--grasp {thing}: a package is missing that isn't installed by default: {INSTALL}")
    if thing not in THINGS:
        raise ValueError(f"--grasp {thing}: there is no such thing; there are {', '.join(THINGS)}")
    went = grasp(deployment.hands[0], thing, world.seed, world)
    return Timeline.play(went, patches(went), repeat=repeat)
