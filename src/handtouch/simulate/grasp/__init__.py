"""Grasps simulated in MuJoCo, as an independent source of contact positions and forces.

Public names: `grasp_stimulus` (a grasp as input of a simulated hand), `simulate_grasp` -> `GraspRecord`,
`GRASP_OBJECTS`, `available`. Needs the extra `handtouch[mujoco]`.
"""

from importlib.util import find_spec

from handtouch import config
from handtouch.host.installation import extra_command
from handtouch.simulate.grasp.grasp_objects import GRASP_OBJECTS
from handtouch.simulate.grasp.grasp_stimulus import GraspStimulus
from handtouch.simulate.grasp.patches import contact_patches
from handtouch.simulate.grasp.simulation import GraspRecord, simulate_grasp
from handtouch.simulate.worlds import DrawnWorld

__all__ = ["GRASP_OBJECTS", "GraspRecord", "available", "grasp_stimulus", "simulate_grasp"]


def available() -> bool:
    """Return whether MuJoCo is installed."""
    return find_spec("mujoco") is not None


def grasp_stimulus(
    deployment: config.Deployment, object_name: str, world: DrawnWorld, *, repeat: bool = False
) -> GraspStimulus:
    """Let the first hand of a deployment grasp an object, randomised by the world's seed.

    Raises ValueError, with a message for the user, without MuJoCo and for an unknown object or unfit hand.
    """
    if not available():
        raise ValueError(
            f"--grasp {object_name}: needs MuJoCo, which isn't installed by default: "
            + extra_command("mujoco")
        )
    if object_name not in GRASP_OBJECTS:
        raise ValueError(f"--grasp {object_name}: unknown object; known: {', '.join(GRASP_OBJECTS)}")
    grasp = simulate_grasp(deployment.hands[0], object_name, world.seed, world)
    return GraspStimulus.from_grasp(grasp, contact_patches(grasp), repeat=repeat)
