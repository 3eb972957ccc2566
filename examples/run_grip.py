"""Hold objects on the daemon with a policy that examples/learn_grip.py found, without change.

The simulated nodes sense the same MuJoCo scene, which runs in real time; the policy reads the touch of a
`Hand`. Run `handtouch run config/two_finger.toml` beside it. Needs the extra `gym`.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from learn_grip import GripPolicy, other_objects

from handtouch import Hand, config
from handtouch.config import shipped
from handtouch.simulate import TactileNodes
from handtouch.simulate.tactile.grip_environment import EPISODE_STEPS, PERIOD_S, TOUCH, GripScene

TIMEOUT_S = 60.0
"""Time for the daemon's start, or for sheets that were pressed to settle"""


def wait_until_clear(hand: Hand) -> None:
    """Wait until both pads are sampled and untouched. Raises TimeoutError."""
    end_s = time.monotonic() + TIMEOUT_S
    sampled, touched = (
        [TOUCH.names.index(f"{link}.{name}") for link in TOUCH.links] for name in ("sampled", "touched")
    )
    while time.monotonic() < end_s:
        if hand.wait(1.0):
            touch = TOUCH.of(hand)
            if touch[sampled].all() and not touch[touched].any():
                return
    raise TimeoutError(f"pads aren't clear after {TIMEOUT_S:g} s; does `handtouch run` serve the gripper?")


def episode(
    scene: GripScene, nodes: TactileNodes, hand: Hand, policy: GripPolicy
) -> tuple[float, float, bool]:
    """Run an episode in real time; return its cost, final force and whether the object was dropped."""
    cost, due_s = 0.0, time.monotonic()
    for _ in range(EPISODE_STEPS):
        hand.latest()
        action = policy.act(TOUCH.of(hand)[None], np.array([scene.force_n]))
        cost -= scene.step(float(action[0, 0]))
        nodes.update(scene.data)
        due_s += PERIOD_S
        time.sleep(max(0.0, due_s - time.monotonic()))
    return cost, scene.force_n, scene.dropped


def main() -> None:
    """Hold some objects."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "weights",
        type=float,
        nargs=3,
        help="constant [N], N per mm slid, N s per mm, as learn_grip.py prints",
    )
    parser.add_argument("--objects", type=int, default=5)
    parser.add_argument("--seed", type=int, default=7, help="of the sensor in the world `default`")
    arguments = parser.parse_args()
    scene, weights = GripScene(), np.array([arguments.weights])
    deployment = config.load(shipped.path("two_finger.toml"))
    with TactileNodes(deployment, scene.model, "default", arguments.seed) as nodes, Hand("gripper") as hand:
        for mass_kg, friction in zip(*other_objects(arguments.objects), strict=True):
            nodes.update(None)
            wait_until_clear(hand)
            scene.reset(float(mass_kg), float(friction))
            cost, force_n, dropped = episode(scene, nodes, hand, GripPolicy(weights))
            outcome = "dropped" if dropped else f"held with {force_n:.2f} N"
            print(f"{1e3 * mass_kg:3.0f} g, friction {friction:.2f}: {outcome}, cost {cost:.2f}", flush=True)


if __name__ == "__main__":
    main()
