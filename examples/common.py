"""Shared by the examples: command line, a new object in the gripper, contacts of one pad."""

from __future__ import annotations

import argparse
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass

import handtouch
from handtouch.client import CONTROL_ENDPOINT, LIVE_ENDPOINT
from handtouch.simulate.gripper_client import DEFAULT_ENDPOINT, GripperClient
from handtouch.wire import Contact, PadState

SAMPLE_TIMEOUT_S, CONTACT_TIMEOUT_S = 0.05, 5.0


@dataclass(frozen=True)
class Options:
    """Endpoints of the daemon and the robot."""

    live: str = LIVE_ENDPOINT
    control: str = CONTROL_ENDPOINT
    robot: str = DEFAULT_ENDPOINT


def options(description: str | None) -> Options:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="Start `handtouch simulate config/two_finger.toml --gripper` in one terminal and "
        "`handtouch run config/two_finger.toml` in another first. `make examples` runs everything.",
    )
    parser.add_argument(
        "--live", default=LIVE_ENDPOINT, help=f"the daemon's stream (default: {LIVE_ENDPOINT})"
    )
    parser.add_argument(
        "--control", default=CONTROL_ENDPOINT, help=f"its control endpoint (default: {CONTROL_ENDPOINT})"
    )
    parser.add_argument(
        "--robot", default=DEFAULT_ENDPOINT, help=f"the simulated gripper (default: {DEFAULT_ENDPOINT})"
    )
    arguments = parser.parse_args()
    return Options(arguments.live, arguments.control, arguments.robot)


async def contacts_on(live: str, link: str) -> AsyncIterator[Contact | None]:
    """Yield the contact on a pad, sample by sample; None while there is no sample: stop the robot then.

    Raises RuntimeError when the contact is released, or after CONTACT_TIMEOUT_S without a sample.
    """
    last_s = time.monotonic()
    async with handtouch.connect(f"contact/*/{link}", endpoint=live) as contacts:
        while time.monotonic() - last_s < CONTACT_TIMEOUT_S:
            contact = await contacts.arecv(SAMPLE_TIMEOUT_S)
            if contact is None or contact.event == "end":
                if contact is not None and contact.end_reason == "released":
                    raise RuntimeError(f"{link}: contact released")
                yield None  # a stale pad may recover at once, with a new contact
            else:
                last_s = time.monotonic()
                yield contact
    raise RuntimeError(f"{link}: no contact sample for {CONTACT_TIMEOUT_S:g} s; see `handtouch status`")


async def insert_object(gripper: GripperClient, kind: str, live: str, **parameters: float) -> None:
    """Open the gripper, insert a new object, and wait until no pad is touched."""
    gripper.reset(kind, **parameters)
    async with handtouch.Hand("gripper", endpoint=live) as hand:
        async for arrays in hand:
            if not arrays.frame.retained and set(arrays.state.values()) == {PadState.CLEAR}:
                return
