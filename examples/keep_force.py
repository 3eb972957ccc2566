"""Grip with a given force and keep it, while the object gives way.

`ForceControl` is a PI controller of the closing speed. Within the force's standard deviation nothing is known
to be wrong, so nothing moves: it doesn't chase noise. Where the force isn't to be relied on it gives up.
"""

from __future__ import annotations

import asyncio
import math

from common import Options, fresh, options, touches
from stop_on_touch import stop_on_touch

from handtouch.simulate.gripper_client import Gripper
from handtouch.wire import Contact

P_M_S_N = 0.004  # times the object's stiffness, some 2 N/mm, it is 8 per second
I_M_S_NS = 0.004
FASTEST_M_S = 0.02
LONGEST_S = 0.05  # between two samples that the integral believes in


class ForceControl:
    """Closing speed from contacts of one pad."""

    def __init__(self, force_n: float) -> None:
        self.force_n = force_n
        self._sum_ns = 0.0
        self._last_ns: int | None = None

    def speed_m_s(self, contact: Contact) -> float:
        """Of both fingers; raises RuntimeError where the force isn't to be relied on."""
        if contact.strength != "valid" or contact.force_n is None or contact.force_std_n is None:
            raise RuntimeError(f"the force of {contact.link} is {contact.strength}")
        wrong_n = self.force_n - contact.force_n
        error_n = math.copysign(max(abs(wrong_n) - contact.force_std_n, 0.0), wrong_n)
        passed_s = 0.0 if self._last_ns is None else min(1e-9 * (contact.t_ns - self._last_ns), LONGEST_S)
        self._last_ns = contact.t_ns
        self._sum_ns = self._sum_ns + error_n * passed_s if error_n else 0.0
        speed = P_M_S_N * error_n + I_M_S_NS * self._sum_ns
        if abs(speed) > FASTEST_M_S:
            self._sum_ns -= error_n * passed_s  # at full speed the integral would only wind up
        return max(-FASTEST_M_S, min(speed, FASTEST_M_S))


async def keep_force(gripper: Gripper, live: str, control: ForceControl, seconds: float) -> Contact:
    """Hold on for so long; the last contact. Raises RuntimeError, all stopped, when it can't go on."""
    begin_ns: int | None = None
    contact: Contact | None
    async for contact in touches(live, "index_tip"):
        if contact is None:
            gripper.move()
            continue
        speed = control.speed_m_s(contact)
        gripper.move(sample_ns=contact.t_ns, thumb=speed, index=speed)
        begin_ns = begin_ns or contact.t_ns
        if contact.t_ns - begin_ns > 1e9 * seconds:
            break
    gripper.move()
    assert contact is not None
    return contact


async def main(asked: Options) -> None:
    """Two forces, on a block that gives way by a quarter within seconds."""
    with Gripper(asked.robot) as gripper:
        for force_n in (1.0, 3.0):
            await fresh(gripper, "block", asked.live)
            for finger in ("thumb", "index"):
                await stop_on_touch(gripper, asked.live, finger)
            contact = await keep_force(gripper, asked.live, ForceControl(force_n), 3.0)
            truth = gripper.look().truth["index_force_n"]
            felt = f"{contact.force_n:.2f} +- {contact.force_std_n:.2f} N"
            print(f"wanted {force_n:.2f} N: felt {felt}, really {truth:.2f} N")
        print(gripper.told_latency())


if __name__ == "__main__":
    asyncio.run(main(options(__doc__)))
