"""Close a finger and stop it when it touches something.

The whole loop is `stop_on_touch`: listen to one pad, and while it feels nothing, go on.
"""

from __future__ import annotations

import asyncio
import time

from common import Options, fresh, options

import handtouch
from handtouch.simulate.gripper_client import Gripper, State
from handtouch.wire import PadState

CLOSED_M = 0.029
PATIENCE_NS = 5_000_000_000


async def stop_on_touch(gripper: Gripper, live: str, finger: str, speed_m_s: float = 0.01) -> State:
    """Close a finger until its pad is touched; raises RuntimeError when it can't feel, or there is nothing.

    The hand frame tells at every tick how the pad fares, so silence is never taken for "no touch": each
    command answers a sample, and without any the gripper stops by itself.
    """
    link, felt_ns = f"{finger}_tip", time.monotonic_ns()
    async with handtouch.connect("hand/*", endpoint=live) as frames:
        async for frame in frames:
            row, columns = frame.links.index(link), handtouch.columns(frame)
            pad, sample_ns = columns["state"][row], int(columns["sample_ns"][row])
            if pad == PadState.TOUCHED:
                return gripper.move(sample_ns=sample_ns)  # at no speed: all joints stop
            if pad == PadState.CLEAR:
                felt_ns = frame.t_ns
                state = gripper.move(sample_ns=sample_ns, **{finger: speed_m_s})
                if state.position_m[finger] > CLOSED_M:
                    raise RuntimeError("the finger is closed, and there was nothing")
            elif frame.t_ns - felt_ns > PATIENCE_NS:
                raise RuntimeError(f"{link} is {PadState(pad).name.lower()}: it can't feel what it touches")
            else:
                gripper.move()  # numb for a moment: wait
    raise RuntimeError("the stream of hand frames ended")


async def main(asked: Options) -> None:
    """Do it at two speeds, and tell how deep the finger went in."""
    with Gripper(asked.robot) as gripper:
        for speed_m_s in (0.01, 0.03):
            await fresh(gripper, "block", asked.live)
            await stop_on_touch(gripper, asked.live, "index", speed_m_s)
            await asyncio.sleep(0.1)
            truth = gripper.look().truth
            print(
                f"{1e3 * speed_m_s:.0f} mm/s: stopped {1e3 * truth['index_depth_m']:.2f} mm deep, "
                f"pressing {truth['index_force_n']:.2f} N"
            )
        print(gripper.told_latency())


if __name__ == "__main__":
    asyncio.run(main(options(__doc__)))
