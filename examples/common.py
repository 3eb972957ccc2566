"""What the examples share: their command line, a fresh object to touch, and a touch to go by."""

from __future__ import annotations

import argparse
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass

import handtouch
from handtouch.client import CONTROL, LIVE
from handtouch.simulate.gripper_client import GRIPPER, Gripper
from handtouch.wire import Contact, PadState

SILENCE_S, PATIENCE_S = 0.05, 5.0


@dataclass(frozen=True)
class Options:
    """Where the daemon and the robot are."""

    live: str = LIVE
    control: str = CONTROL
    robot: str = GRIPPER


def options(description: str | None) -> Options:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="Before: `handtouch simulate config/two_finger.toml --gripper` in one terminal and "
        "`handtouch run config/two_finger.toml` in another. Or all at once: `make examples`.",
    )
    parser.add_argument("--live", default=LIVE, help=f"the daemon's stream (default: {LIVE})")
    parser.add_argument("--control", default=CONTROL, help=f"its control endpoint (default: {CONTROL})")
    parser.add_argument("--robot", default=GRIPPER, help=f"the simulated gripper (default: {GRIPPER})")
    asked = parser.parse_args()
    return Options(asked.live, asked.control, asked.robot)


async def touches(live: str, link: str) -> AsyncIterator[Contact | None]:
    """The touch on a pad, sample by sample; None when there is nothing to go by for the moment: then stop.

    Raises RuntimeError when the pad is released, or a moment has become seconds.
    """
    felt_s = time.monotonic()
    async with handtouch.connect(f"contact/*/{link}", endpoint=live) as contacts:
        while time.monotonic() - felt_s < PATIENCE_S:
            contact = await contacts.arecv(SILENCE_S)
            if contact is None or contact.event == "end":
                if contact is not None and contact.reason == "released":
                    raise RuntimeError(f"{link} touches nothing any more")
                yield None  # a pad that is stale may be back at once, with a new contact
            else:
                felt_s = time.monotonic()
                yield contact
    raise RuntimeError(f"nothing comes from {link}: `handtouch status` tells why")


async def fresh(gripper: Gripper, thing: str, live: str, **numbers: float) -> None:
    """Open the gripper, put in another object, and wait until no pad is touched any more."""
    gripper.reset(thing, **numbers)
    async with handtouch.connect("hand/*", endpoint=live) as frames:
        async for frame in frames:
            if not frame.repeat and set(handtouch.columns(frame)["state"]) == {PadState.CLEAR}:
                return
