"""Send joint states and forces of a robot to a handtouch daemon.

    with handtouch.Robot() as robot:
        robot.send_joints("right", {"index_mcp": 0.4, "index_pip": 0.7}, t_ns=time.monotonic_ns())
        robot.send_joints("right", positions)   # an array in the order of robot.joints("right")

Public names: `Robot`.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import zmq
from numpy.typing import NDArray

from handtouch.client.connection import Connection
from handtouch.client.socket_options import RECONNECT_OPTIONS
from handtouch.host.closing import Closing
from handtouch.host.endpoints import INPUTS_ENDPOINT
from handtouch.wire.inputs import (
    InputMessage,
    JointState,
    LinkForces,
    encode,
    hands_in_prefix,
    joints_in_prefix,
)

JointValues = Mapping[str, float] | Sequence[float] | NDArray[np.float64]
"""Values by joint name, or of all joints in the hand's order"""
_QUEUE_MESSAGES = 16
_LINGER_MS = 200


class Robot(Closing):
    """The robot's connection to a daemon's inputs endpoint; sending never blocks, and there are no answers.

    Messages sent before the connection is up are lost: call `wait_connected` where the first one matters.
    `key` as for `connect`; it needs the right `control`. Messages that the daemon can't use are counted by
    cause in `inputs` of its `service` message. Raises ValueError for an invalid endpoint or an unusable key
    file; sending raises PermissionError when the daemon rejects this client, and, once connected, ValueError
    for a hand that the daemon doesn't have.
    """

    def __init__(self, endpoint: str = INPUTS_ENDPOINT, key: Path | str | None = None) -> None:
        self.endpoint = endpoint
        self._hands: frozenset[str] = frozenset()  # hands of the connected daemon
        self._joints: dict[str, tuple[str, ...]] = {}
        options = {zmq.SNDHWM: _QUEUE_MESSAGES, zmq.LINGER: _LINGER_MS, **RECONNECT_OPTIONS}
        options[zmq.XPUB_VERBOSE] = 1  # report also what a daemon before a restart had subscribed to
        self._connection = Connection.open(zmq.XPUB, endpoint, key, options)

    def joints(self, hand: str) -> tuple[str, ...]:
        """Return the joints of a hand in the daemon's order, those of its URDF that move its links.

        Raises LookupError before a daemon has connected, and for a hand without joints.
        """
        self._connection.poll(0)
        self._read_subscriptions()
        if hand not in self._joints:
            raise LookupError(
                f"the joints of hand {hand!r} aren't known: call wait_connected() first; it needs a URDF in "
                "the deployment"
            )
        return self._joints[hand]

    def send_joints(
        self,
        hand: str,
        position_rad: JointValues,
        *,
        t_ns: int | None = None,
        velocity_rad_s: JointValues | None = None,
        position_std_rad: JointValues | float | None = None,
        gravity: Sequence[float] | None = None,
        orientation: Sequence[float] | None = None,
    ) -> None:
        """Send joint positions of a hand, by joint name, at `t_ns` of time.monotonic_ns() (None: now).

        A sequence has the order of `joints(hand)`, and all of them. Prismatic joints in metres. Velocities
        and standard deviations are of the same joints; a single deviation applies to all. gravity: (3,) its
        direction in the frame of the hand's base, of any length; overrides the deployment's, for a hand on an
        arm that its URDF doesn't contain. orientation: quaternion x, y, z, w of the base's frame, likewise,
        for magnetic pads. Raises ValueError for mappings with different joints and for sequences of another
        length, LookupError as `joints`. The daemon leaves out joints whose position isn't finite, and counts
        them.
        """
        names = tuple(position_rad) if isinstance(position_rad, Mapping) else self.joints(hand)
        std = position_std_rad
        if isinstance(std, (int, float)):
            std = dict.fromkeys(names, float(std))
        std_rad = None if std is None else _to_array(std, names)
        velocity = None if velocity_rad_s is None else _to_array(velocity_rad_s, names)
        t_ns = time.monotonic_ns() if t_ns is None else t_ns
        base = [None if pose is None else np.asarray(pose, np.float64) for pose in (gravity, orientation)]
        angles = _to_array(position_rad, names)
        self._send(JointState(hand, t_ns, names, angles, velocity, None, std_rad, *base))

    def send_forces(
        self,
        hand: str,
        force_n: Mapping[str, float],
        std_n: Mapping[str, float] | float,
        *,
        t_ns: int | None = None,
    ) -> None:
        """Send reference forces on links, from another sensor, and their deviations; as `send_joints`."""
        links = tuple(force_n)
        std = std_n if isinstance(std_n, Mapping) else dict.fromkeys(links, float(std_n))
        t_ns = time.monotonic_ns() if t_ns is None else t_ns
        self._send(LinkForces(hand, t_ns, links, _to_array(force_n, links), _to_array(std, links)))

    def wait_connected(self, timeout_s: float = 2.0) -> bool:
        """Wait until a daemon has connected; return False after `timeout_s`.

        Raises PermissionError when the daemon rejects this client.
        """
        end_s = time.monotonic() + timeout_s
        while not self._hands:
            left_ms = max(0, round((end_s - time.monotonic()) * 1000))
            if not self._connection.poll(left_ms) and left_ms == 0:
                break
            self._read_subscriptions()
        return bool(self._hands)

    def close(self) -> None:
        """Disconnect; queued messages have 0.2 s to be sent."""
        self._connection.close()

    def _send(self, message: InputMessage) -> None:
        self._connection.poll(0)
        self._read_subscriptions()
        if self._hands and message.hand not in self._hands:
            known = ", ".join(sorted(self._hands))
            raise ValueError(f"hand {message.hand!r} is unknown; the hands of the daemon are {known}")
        self._connection.socket.send_multipart(encode(message), zmq.NOBLOCK)  # dropped when the queue is full

    def _read_subscriptions(self) -> None:
        while True:
            try:
                request = self._connection.socket.recv(zmq.NOBLOCK)
            except zmq.Again:
                return
            hands = hands_in_prefix(request[1:].decode("utf-8", "replace"))
            if hands and request[:1] == b"\x01":
                self._hands = hands
            elif joints := joints_in_prefix(request[1:].decode("utf-8", "replace")):
                self._joints |= joints if request[:1] == b"\x01" else {}
            elif hands == self._hands:  # the daemon disconnected
                self._hands = frozenset()


def _to_array(values: JointValues, names: tuple[str, ...]) -> NDArray[np.float64]:
    if not isinstance(values, Mapping):
        if np.shape(values) != (len(names),):
            raise ValueError(f"{len(values)} values for {len(names)} joints: {', '.join(names)}")
        return np.array(values, np.float64)
    if not names or values.keys() != set(names):
        differ = ", ".join(sorted(set(names) ^ values.keys())) or "none given"
        raise ValueError(f"all mappings must have the same names, one or more: {differ}")
    return np.array([values[name] for name in names], np.float64)
