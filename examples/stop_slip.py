"""Notice that a held object begins to slip, and grip it harder.

Two tasks share a force controller: one keeps its force, the other raises that whenever `percept/*/motion`
says that the contact on the thumb moves.
"""

from __future__ import annotations

import asyncio

from common import Options, fresh, options
from keep_force import ForceControl, keep_force
from stop_on_touch import stop_on_touch

import handtouch
from handtouch.simulate.gripper_client import Gripper, State

HOLD_N, HARDER, MOST_N = 1.0, 1.15, 6.0
PULL_N, PULL_S = 3.0, 2.0


async def harder_on_slip(live: str, control: ForceControl) -> None:
    """Raise the force at every word of a contact that slides, begins to, or rolls out of the grip."""
    async with handtouch.connect("percept/*/motion", endpoint=live) as percepts:
        async for motion in percepts:
            if motion.link == "thumb_tip" and motion.state == "estimated":
                stays = motion.probabilities["sticking"] + motion.probabilities["lift-off"]
                if stays < 0.5 and control.force_n < MOST_N:
                    control.force_n *= HARDER


async def hold(gripper: Gripper, live: str, control: ForceControl, seconds: float) -> None:
    """Keep a force, and raise it when the object slips; RuntimeError when it is lost all the same."""
    watching = asyncio.create_task(harder_on_slip(live, control))
    try:
        await keep_force(gripper, live, control, seconds)
    finally:
        watching.cancel()


async def pulled(gripper: Gripper, live: str, *, careful: bool) -> tuple[State, float]:
    """Grip the block while somebody pulls at it. Returns how it ended, and how far it slid [m]."""
    await fresh(gripper, "block", live)
    for finger in ("index", "thumb"):
        await stop_on_touch(gripper, live, finger)
    control = ForceControl(HOLD_N)
    await keep_force(gripper, live, control, 1.0)
    before = gripper.pull(PULL_N, PULL_S)
    try:
        await (hold if careful else keep_force)(gripper, live, control, PULL_S + 0.5)
    except RuntimeError as error:
        print(f"  {error}")
    state = gripper.move()
    return state, state.truth["slipped_m"] - before.truth["slipped_m"]


async def main(asked: Options) -> None:
    """Without and with a reaction."""
    with Gripper(asked.robot) as gripper:
        for careful in (False, True):
            state, slid_m = await pulled(gripper, asked.live, careful=careful)
            kind, force_n = "careful" if careful else "even", state.truth["thumb_force_n"]
            print(f"{kind} grip: it slid {1e3 * slid_m:.2f} mm; gripped with {force_n:.2f} N in the end")
        print(gripper.told_latency())


if __name__ == "__main__":
    asyncio.run(main(options(__doc__)))
