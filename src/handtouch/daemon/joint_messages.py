"""Publisher of joint states, at a limited rate, for views that don't read the inputs endpoint.

Public names: `JointPublisher`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.core.tick_messages import MessageSink
from handtouch.hand.joints import JointSnapshot
from handtouch.hand.robot_models import RobotModels

_PUBLISH_PERIOD_NS = round(wire.JOINTS.min_period_s * 1e9)


class JointPublisher:
    """Publishes `joints/<hand>` of the hands with a URDF; `joints_at` returns a hand's joints at a time."""

    def __init__(
        self,
        robots: RobotModels,
        joints_at: Callable[[str, int], JointSnapshot | None],
        publisher: MessageSink,
        session: int,
    ) -> None:
        self._names = {
            hand: kinematics.joints for hand, kinematics in zip(robots.hands, robots.kinematics, strict=True)
        }
        self._joints_at, self._publisher, self._session = joints_at, publisher, session
        self._last_publish_ns = 0
        self._seq = 0

    def publish_joints(self, now_ns: int) -> None:
        """Publish the joint states that are subscribed, every 33 ms."""
        if now_ns - self._last_publish_ns < _PUBLISH_PERIOD_NS:
            return
        self._last_publish_ns = now_ns
        self._seq += 1
        for hand, names in self._names.items():
            if self._publisher.has_subscriber(f"joints/{hand}") and (joints := self._joints_at(hand, now_ns)):
                self._publisher.send(
                    wire.JointPositions(
                        v=wire.SCHEMA_VERSION,
                        session=self._session,
                        seq=self._seq,
                        t_ns=now_ns,
                        hand=hand,
                        names=names,
                        position_rad=_finite_or_none(joints.position_rad),
                        age_s=_finite_or_none(joints.age_s),
                        retained=False,
                    )
                )


def _finite_or_none(values: NDArray[np.float64]) -> tuple[float | None, ...]:
    return tuple(value if np.isfinite(value) else None for value in values.tolist())
