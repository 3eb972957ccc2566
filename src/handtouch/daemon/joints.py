"""Tells subscribers where the joints are, now and then: for views, which know nothing of the inputs endpoint.

Public names: `JointTeller`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.hand.joints import Joints
from handtouch.hand.robot import Robots

_EVERY_NS = 33_000_000


class _Publisher(Protocol):
    run: int

    def wants(self, topic: str) -> bool: ...
    def send(self, message: wire.Message) -> None: ...


class JointTeller:
    """Sends `joints/<hand>` of the hands with a URDF; `joints_at`: a hand's joints at a time."""

    def __init__(
        self, robots: Robots, joints_at: Callable[[str, int], Joints | None], publisher: _Publisher
    ) -> None:
        self._names = {
            hand: kinematics.joints for hand, kinematics in zip(robots.hands, robots.kinematics, strict=True)
        }
        self._joints_at, self._publisher = joints_at, publisher
        self._told_ns = 0
        self._seq = 0

    def step(self, now_ns: int) -> None:
        """Tell, if somebody wants to hear and enough time has passed."""
        if now_ns - self._told_ns < _EVERY_NS:
            return
        self._told_ns = now_ns
        self._seq += 1
        for hand, names in self._names.items():
            if self._publisher.wants(f"joints/{hand}") and (joints := self._joints_at(hand, now_ns)):
                self._publisher.send(
                    wire.Joints(
                        v=wire.SCHEMA_VERSION,
                        run=self._publisher.run,
                        seq=self._seq,
                        t_ns=now_ns,
                        hand=hand,
                        names=names,
                        position_rad=_known(joints.position_rad),
                        age_s=_known(joints.age_s),
                        repeat=False,
                    )
                )


def _known(values: NDArray[np.float64]) -> tuple[float | None, ...]:
    return tuple(value if np.isfinite(value) else None for value in values.tolist())
