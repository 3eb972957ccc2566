"""Follow an edge: slide a round fingertip along it so that it stays under the middle of the pad.

Where the edge lies on the pad says how to turn; where contacts were in the base's frame says where it leads.
The latter needs joint states, which the gripper tells, and `pip install 'handtouch[urdf]'`.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque

from common import Options, fresh, options, touches
from stop_on_touch import stop_on_touch

import handtouch
from handtouch.simulate.gripper_client import Gripper

SPEED_M_S, FORCE_N = 0.015, 1.0
CENTRE_PER_S, PRESS_M_S_N = 6.0, 0.004
TRAIL_M = 0.003
Place = tuple[float, float]


class Trail:
    """The latest millimetres of the edge in the base's frame (x, z), and which way it leads."""

    def __init__(self) -> None:
        self._places: deque[Place] = deque()
        self.way: Place = (1.0, 0.0)
        self.length_m = 0.0

    def add(self, place: Place) -> None:
        """The edge is here too."""
        if self._places and math.dist(place, self._places[-1]) < TRAIL_M / 10:
            return  # too near for a direction: noise
        if self._places:
            self.length_m += math.dist(place, self._places[-1])
        self._places.append(place)
        while len(self._places) > 2 and math.dist(place, self._places[1]) > TRAIL_M:
            self._places.popleft()
        first, far = self._places[0], math.dist(place, self._places[0])
        if far > TRAIL_M / 2:
            self.way = ((place[0] - first[0]) / far, (place[1] - first[1]) / far)


async def follow_edge(gripper: Gripper, live: str, length_m: float) -> list[tuple[float, float]]:
    """Slide along for `length_m`; how far it was each time, and how far the edge really lay from the middle.

    Metres. Raises RuntimeError when the edge is lost; all stops then.
    """
    trail, errors = Trail(), []
    async for contact in touches(live, "index_tip"):
        if contact is None or contact.position_m is None or contact.base_position_m is None:
            gripper.move()  # no place, or joint states that are late: wait
            continue
        trail.add((contact.base_position_m[0], contact.base_position_m[2]))
        aside = contact.position_m[:2]  # from the tip's axis: x, y of the link are x, z of the base
        reach, lift = (SPEED_M_S * w + CENTRE_PER_S * a for w, a in zip(trail.way, aside, strict=True))
        press = PRESS_M_S_N * (FORCE_N - (contact.force_n or FORCE_N))
        state = gripper.move(sample_ns=contact.t_ns, reach=reach, lift=lift, index=press)
        errors.append((trail.length_m, state.truth["aside_m"]))
        if trail.length_m >= length_m:
            break
    gripper.move()
    return errors


async def main(asked: Options) -> None:
    """Along a winding rim."""
    handtouch.request("scene", outputs=["location", "strength", "base"], endpoint=asked.control)
    with Gripper(asked.robot) as gripper:
        await fresh(gripper, "edge", asked.live)
        await stop_on_touch(gripper, asked.live, "index")
        errors = await follow_edge(gripper, asked.live, 0.05)
        settled = [error for along, error in errors if along > 0.01]
        print(
            f"followed {1e3 * errors[-1][0]:.0f} mm; middle of the pad to the edge at most "
            f"{1e3 * max(settled):.2f} mm, at first {1e3 * errors[0][1]:.2f} mm"
        )
        print(gripper.told_latency())


if __name__ == "__main__":
    asyncio.run(main(options(__doc__)))
