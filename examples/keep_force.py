"""Grip an object that relaxes with a constant force.

`ForceControl` is a PI controller of the closing speed. Small deviations are ignored, so that it doesn't
follow noise; the force's standard deviation is no measure of noise, as it contains the tolerances of parts,
which don't change. It stops where the force isn't valid.
"""

from __future__ import annotations

import asyncio
import math

from common import Options, contacts_on, insert_object, options
from stop_on_touch import stop_on_touch

from handtouch.simulate.gripper_client import GripperClient
from handtouch.wire import Contact

P_M_S_N = 0.004  # times the object's stiffness, about 2 N/mm: 8 per second
I_M_S_NS = 0.004
NOISE_N = 0.02
MAX_SPEED_M_S = 0.02
MAX_STEP_S = 0.05  # integration step after a missed sample


class ForceControl:
    """Computes the closing speed from the contact on one pad."""

    def __init__(self, force_n: float) -> None:
        self.force_n = force_n
        self._sum_ns = 0.0
        self._last_ns: int | None = None

    def speed_m_s(self, contact: Contact) -> float:
        """Return the closing speed of both fingers. Raises RuntimeError where the force isn't valid."""
        if contact.force_status != "valid" or contact.force_n is None:
            raise RuntimeError(f"{contact.link}: force_status is {contact.force_status}")
        deviation_n = self.force_n - contact.force_n
        error_n = math.copysign(max(abs(deviation_n) - NOISE_N, 0.0), deviation_n)
        passed_s = 0.0 if self._last_ns is None else min(1e-9 * (contact.t_ns - self._last_ns), MAX_STEP_S)
        self._last_ns = contact.t_ns
        self._sum_ns = self._sum_ns + error_n * passed_s if error_n else 0.0
        speed = P_M_S_N * error_n + I_M_S_NS * self._sum_ns
        if abs(speed) > MAX_SPEED_M_S:
            self._sum_ns -= error_n * passed_s  # no integrator wind-up at full speed
        return max(-MAX_SPEED_M_S, min(speed, MAX_SPEED_M_S))


async def keep_force(gripper: GripperClient, live: str, control: ForceControl, seconds: float) -> Contact:
    """Hold for `seconds`; return the last contact. Raises RuntimeError, stopped, when the contact is lost."""
    begin_ns: int | None = None
    contact: Contact | None
    async for contact in contacts_on(live, "index_tip"):
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


async def main(endpoints: Options) -> None:
    """Hold a block with two forces; it relaxes by a quarter within seconds."""
    with GripperClient(endpoints.robot) as gripper:
        for force_n in (1.0, 3.0):
            await insert_object(gripper, "block", endpoints.live)
            for finger in ("thumb", "index"):
                await stop_on_touch(gripper, endpoints.live, finger)
            contact = await keep_force(gripper, endpoints.live, ForceControl(force_n), 3.0)
            truth = gripper.read_state().truth["index_force_n"]
            measured = f"{contact.force_n:.2f} +- {contact.force_std_n:.2f} N"
            print(f"target {force_n:.2f} N: measured {measured}, ground truth {truth:.2f} N")
        print(gripper.latency_summary())


if __name__ == "__main__":
    asyncio.run(main(options(__doc__)))
