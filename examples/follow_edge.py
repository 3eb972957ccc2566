"""Follow an edge: slide a round fingertip along it so that it stays under the middle of the pad.

The contact position on the pad corrects the course; past positions in the base's frame give the direction
of the edge. The latter need joint states, which the gripper sends.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque

from common import Options, contacts_on, insert_object, options
from stop_on_touch import stop_on_touch

import handtouch
from handtouch.simulate.gripper_client import GripperClient

SPEED_M_S, FORCE_N = 0.015, 1.0
CENTRE_PER_S, PRESS_M_S_N = 6.0, 0.004
TRAIL_M = 0.003
Point = tuple[float, float]


class Trail:
    """The latest millimetres of the edge in the base's frame (x, z), and its direction."""

    def __init__(self) -> None:
        self._points: deque[Point] = deque()
        self.direction: Point = (1.0, 0.0)
        self.length_m = 0.0

    def add(self, point: Point) -> None:
        """Add a point of the edge."""
        if self._points and math.dist(point, self._points[-1]) < TRAIL_M / 10:
            return  # below the noise
        if self._points:
            self.length_m += math.dist(point, self._points[-1])
        self._points.append(point)
        while len(self._points) > 2 and math.dist(point, self._points[1]) > TRAIL_M:
            self._points.popleft()
        first, length = self._points[0], math.dist(point, self._points[0])
        if length > TRAIL_M / 2:
            self.direction = ((point[0] - first[0]) / length, (point[1] - first[1]) / length)


async def follow_edge(gripper: GripperClient, live: str, length_m: float) -> list[tuple[float, float]]:
    """Slide along for `length_m`; return the distance and the true offset of the edge [m] at each sample.

    Raises RuntimeError, stopped, when the contact is lost.
    """
    trail, errors = Trail(), []
    async for contact in contacts_on(live, "index_tip"):
        if contact is None or contact.position_m is None or contact.base_position_m is None:
            gripper.move()  # no position, or joint states too old: wait
            continue
        trail.add((contact.base_position_m[0], contact.base_position_m[2]))
        offset = contact.position_m[:2]  # from the tip's axis: x, y of the link are x, z of the base
        reach, lift = (SPEED_M_S * w + CENTRE_PER_S * a for w, a in zip(trail.direction, offset, strict=True))
        press = PRESS_M_S_N * (FORCE_N - (contact.force_n or FORCE_N))
        state = gripper.move(sample_ns=contact.t_ns, reach=reach, lift=lift, index=press)
        errors.append((trail.length_m, state.truth["offset_m"]))
        if trail.length_m >= length_m:
            break
    gripper.move()
    return errors


async def main(endpoints: Options) -> None:
    """Follow a curved rim."""
    handtouch.request("scene", outputs=["position", "force", "base"], endpoint=endpoints.control)
    with GripperClient(endpoints.robot) as gripper:
        await insert_object(gripper, "edge", endpoints.live)
        await stop_on_touch(gripper, endpoints.live, "index")
        errors = await follow_edge(gripper, endpoints.live, 0.05)
        settled = [error for along, error in errors if along > 0.01]
        print(
            f"followed {1e3 * errors[-1][0]:.0f} mm; offset of the edge from the pad centre at most "
            f"{1e3 * max(settled):.2f} mm, initially {1e3 * errors[0][1]:.2f} mm"
        )
        print(gripper.latency_summary())


if __name__ == "__main__":
    asyncio.run(main(options(__doc__)))
