"""Notice that a held object begins to slip, and grip it harder.

A contact that sticks stays where it is on the pad; one that slips runs. `Slip` is the plainest test of that.
The controller holds a force, and raises it whenever the test says so.
"""

from __future__ import annotations

import asyncio
import math

from common import Options, fresh, options, touches
from keep_force import ForceControl
from stop_on_touch import stop_on_touch

from handtouch.simulate.gripper_client import Gripper
from handtouch.wire import Contact

HOLD_N, HARDER, MOST_N = 1.0, 1.3, 6.0
LEAST_M, SIGMAS = 0.1e-3, 6.0
PULL_N, PULL_S = 3.0, 2.0


class Slip:
    """Whether a contact has left the place where it was when it last stuck."""

    def __init__(self) -> None:
        self._x = self._y = math.nan

    def step(self, contact: Contact) -> bool:
        """By the newest sample; then the contact is taken to stick where it is now."""
        if contact.position_m is None or contact.covariance_m2 is None:
            return False
        x, y, _ = contact.position_m  # of a plate, whose normal is z of its link
        std_m = math.sqrt(contact.covariance_m2[0] + contact.covariance_m2[4])
        gone = math.hypot(x - self._x, y - self._y) > max(LEAST_M, SIGMAS * std_m)
        if gone or math.isnan(self._x):
            self._x, self._y = x, y
        return gone


async def hold(gripper: Gripper, live: str, seconds: float, *, careful: bool = True) -> int:
    """Grip with 1 N, more whenever it slips if `careful`; how often it did. RuntimeError when it is lost."""
    control, slip, slips, begin_ns = ForceControl(HOLD_N), Slip(), 0, None
    async for contact in touches(live, "thumb_tip"):
        if contact is None:
            gripper.move()
            continue
        if slip.step(contact):
            slips += 1
            if careful:
                control.force_n = min(HARDER * control.force_n, MOST_N)
        speed = control.speed_m_s(contact)
        gripper.move(sample_ns=contact.t_ns, thumb=speed, index=speed)
        begin_ns = begin_ns or contact.t_ns
        if contact.t_ns - begin_ns > 1e9 * seconds:
            break
    gripper.move()
    return slips


async def pulled(asked: Options, gripper: Gripper, *, careful: bool) -> str:
    """Grip the block, let somebody pull at it, and tell how it went."""
    await fresh(gripper, "block", asked.live)
    for finger in ("index", "thumb"):
        await stop_on_touch(gripper, asked.live, finger)
    await hold(gripper, asked.live, 0.7)
    before_m = gripper.pull(PULL_N, PULL_S).truth["slipped_m"]
    try:
        outcome = f"{await hold(gripper, asked.live, PULL_S + 0.5, careful=careful)} slips noticed"
    except RuntimeError as error:
        outcome = str(error)
    truth = gripper.move().truth
    slid_mm = 1e3 * (truth["slipped_m"] - before_m)
    return f"{outcome}; it slid {slid_mm:.1f} mm, gripped with {truth['thumb_force_n']:.1f} N"


async def main(asked: Options) -> None:
    """Without and with a reaction."""
    with Gripper(asked.robot) as gripper:
        print("even grip:   ", await pulled(asked, gripper, careful=False))
        gripper.latencies_ns.clear()
        print("careful grip:", await pulled(asked, gripper, careful=True))
        print(gripper.told_latency())


if __name__ == "__main__":
    asyncio.run(main(options(__doc__)))
