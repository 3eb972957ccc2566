"""Joints of a simulated hand: how a scenario moves them, told to the daemon as a robot's program would.

Public names: `Motion`, `Moved`, `JointFeed`.
"""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated

from pydantic import Field

from handtouch.config import Deployment
from handtouch.config.tables import Positive, Table
from handtouch.hand import urdf
from handtouch.robot import Robot
from handtouch.simulate.play import Moving

_EVERY_S = 0.01


class Motion(Table):
    """`[[joint]]`: some joints move together; before and after, they stand where it begins and ends."""

    joints: Annotated[tuple[str, ...], Field(strict=False, min_length=1)] = Field(
        description='joints of the URDF, as patterns: "index_*", "*_mcp"'
    )
    from_s: float = Field(0.0, ge=0, description="when they begin to move, from the start of the scenario")
    duration_s: Positive = Field(description="how long that takes")
    position_deg: Annotated[tuple[float, ...], Field(strict=False, min_length=1)] = Field(
        description="where they are at even times, smoothly joined; millimetres where they slide"
    )

    def position(self, t_s: float) -> float:
        """Where they are at `t_s`, in degrees."""
        legs = len(self.position_deg) - 1
        at = min(max((t_s - self.from_s) / self.duration_s, 0.0), 1.0) * legs
        leg = min(int(at), max(legs - 1, 0))
        part = at - leg
        before, after = self.position_deg[leg], self.position_deg[min(leg + 1, legs)]
        return before + (after - before) * part * part * (3 - 2 * part)


class Moved:
    """Joints with the motions that a scenario has for them."""

    def __init__(self, joints: Iterable[urdf.Joint], motions: Sequence[Motion]) -> None:
        self._motions = [
            (joint, [m for m in motions if any(fnmatchcase(joint.name, pattern) for pattern in m.joints)])
            for joint in joints
            if joint.kind in urdf.MOVABLE and not joint.mimic
        ]

    def at(self, t_s: float) -> dict[str, float]:
        """Where they are: radians, or metres. Of several motions of a joint the latest begun counts."""
        found = {}
        for joint, motions in self._motions:
            begun = [motion for motion in motions if motion.from_s <= t_s] or motions[:1]
            told = begun[-1].position(t_s) if begun else 0.0
            found[joint.name] = told * 1e-3 if joint.kind == "prismatic" else math.radians(told)
        return found


class JointFeed:
    """A thread that tells a daemon the joints of every hand with a URDF, until `close`.

    `moved` says how they move, if they do; `since_s` is the time in the scenario. A daemon that doesn't let
    us in is told about once.
    """

    def __init__(
        self,
        deployment: Deployment,
        moved: Callable[[urdf.Description], Moving | None],
        since_s: Callable[[], float],
        endpoint: str,
        key: Path | str | None = None,
    ) -> None:
        self._since_s, self._endpoint, self._key = since_s, endpoint, key
        self._hands = [
            (hand, moving)
            for hand in deployment.hands
            if hand.urdf and (moving := moved(urdf.read(Path(hand.urdf))))
        ]
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="simulated-joints", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Tell no more."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        if not self._hands:
            return
        try:
            with Robot(self._endpoint, self._key) as robot:
                while not self._stop.wait(_EVERY_S):
                    self._tell(robot)
        except (PermissionError, ValueError) as error:
            print(f"joint states are not told: {error}", file=sys.stderr)

    def _tell(self, robot: Robot) -> None:
        t_ns, t_s = time.monotonic_ns(), self._since_s()
        for hand, moving in self._hands:
            told = {hand.joint_names.get(n, hand.joint_prefix + n): x for n, x in moving.at(t_s).items()}
            robot.send_joints(hand.name, told, t_ns=t_ns)
