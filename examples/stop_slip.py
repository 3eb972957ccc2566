"""Detect that a held object begins to slip, and increase the grip force.

Two tasks share a force controller: one keeps its force, the other increases it whenever `percept/*/motion`
reports motion of the thumb's contact.
"""

from __future__ import annotations

import asyncio

from common import Options, insert_object, options
from keep_force import ForceControl, keep_force
from stop_on_touch import stop_on_touch

import handtouch
from handtouch.simulate.gripper_client import GripperClient, GripperState

INITIAL_N, INCREASE, MAX_N = 1.0, 1.15, 6.0
PULL_N, PULL_S = 3.0, 2.0


async def increase_on_slip(live: str, control: ForceControl) -> None:
    """Increase the force at every percept of a contact that slides, begins to, or rolls out of the grip."""
    async with handtouch.connect("percept/*/motion", endpoint=live) as percepts:
        async for motion in percepts:
            if motion.link == "thumb_tip" and motion.state == "estimated":
                stable = motion.probabilities["sticking"] + motion.probabilities["lift-off"]
                if stable < 0.5 and control.force_n < MAX_N:
                    control.force_n *= INCREASE


async def hold(gripper: GripperClient, live: str, control: ForceControl, seconds: float) -> None:
    """Keep a force and increase it on slip. Raises RuntimeError when the object is lost."""
    watching = asyncio.create_task(increase_on_slip(live, control))
    try:
        await keep_force(gripper, live, control, seconds)
    finally:
        watching.cancel()


async def pull_object(gripper: GripperClient, live: str, *, react: bool) -> tuple[GripperState, float]:
    """Grip the block while it is pulled; return the final state and the slip distance [m]."""
    await insert_object(gripper, "block", live)
    for finger in ("index", "thumb"):
        await stop_on_touch(gripper, live, finger)
    control = ForceControl(INITIAL_N)
    await keep_force(gripper, live, control, 1.0)
    before = gripper.pull(PULL_N, PULL_S)
    try:
        await (hold if react else keep_force)(gripper, live, control, PULL_S + 0.5)
    except RuntimeError as error:
        print(f"  {error}")
    state = gripper.move()
    return state, state.truth["slipped_m"] - before.truth["slipped_m"]


async def main(endpoints: Options) -> None:
    """Pull without and with reaction to slip."""
    with GripperClient(endpoints.robot) as gripper:
        for react in (False, True):
            state, slid_m = await pull_object(gripper, endpoints.live, react=react)
            kind, force_n = "with reaction" if react else "constant force", state.truth["thumb_force_n"]
            print(f"{kind}: slipped {1e3 * slid_m:.2f} mm; final grip force {force_n:.2f} N")
        print(gripper.latency_summary())


if __name__ == "__main__":
    asyncio.run(main(options(__doc__)))
