"""Tell a handtouch daemon where the robot's joints are, and what its other sensors feel.

    with handtouch.Robot() as robot:
        robot.send_joints("right", {"index_mcp": 0.4, "index_pip": 0.7}, t_ns=time.monotonic_ns())

Public names: `Robot`.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Self

import numpy as np
import zmq
from numpy.typing import NDArray

from handtouch.client import _Door, _stay_connected
from handtouch.inputs import Input, JointCommand, JointState, LinkForces, encode

INPUTS = "tcp://127.0.0.1:5583"
_QUEUE = 16


class Robot:
    """The robot's side of a daemon's inputs endpoint; sending never waits, and nothing is answered.

    What is sent before the daemon is there is lost, so wait for `connected` where the first message matters.
    `key` as for `connect`; it needs the right `control`. What the daemon can't use it counts and names in
    `inputs` of `service`. Raises ValueError for an endpoint that is none or a key file that can't be used;
    sending raises PermissionError when the daemon doesn't let this client in.
    """

    def __init__(self, endpoint: str = INPUTS, key: Path | str | None = None) -> None:
        self.endpoint = endpoint
        self._subscribed: set[bytes] = set()
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.XPUB)
        self._socket.setsockopt(zmq.SNDHWM, _QUEUE)
        self._socket.setsockopt(zmq.LINGER, 200)
        _stay_connected(self._socket)
        self._door = _Door(self._socket, endpoint, key)

    def send_joints(
        self,
        hand: str,
        position_rad: Mapping[str, float],
        *,
        t_ns: int | None = None,
        velocity_rad_s: Mapping[str, float] | None = None,
        position_std_rad: Mapping[str, float] | float | None = None,
        gravity: Sequence[float] | None = None,
    ) -> None:
        """Where joints of a hand, by name, were at `t_ns` of time.monotonic_ns(), None: now.

        Metres for joints that slide. Velocities and standard deviations are of the same joints; one deviation
        may stand for all. gravity: (3,) which way it points in the frame of the hand's base, of any length,
        where that isn't what the deployment says, as of a hand on an arm that its URDF lacks. Raises
        ValueError for joints that only one of them has, and for NaN and infinity.
        """
        names = tuple(position_rad)
        std = position_std_rad
        if isinstance(std, (int, float)):
            std = dict.fromkeys(names, float(std))
        std_rad = None if std is None else _column(std, names)
        velocity = None if velocity_rad_s is None else _column(velocity_rad_s, names)
        t_ns = time.monotonic_ns() if t_ns is None else t_ns
        down = None if gravity is None else _direction(gravity)
        angles = _column(position_rad, names)
        self._send(JointState(hand, t_ns, names, angles, velocity, None, std_rad, down))

    def send_commands(self, hand: str, position_rad: Mapping[str, float], *, t_ns: int | None = None) -> None:
        """Where joints of a hand, by name, were told to be from `t_ns` on; as `send_joints`.

        For hands that don't know where their joints are: how far they close on an object tells how hard it
        is.
        """
        names = tuple(position_rad)
        t_ns = time.monotonic_ns() if t_ns is None else t_ns
        self._send(JointCommand(hand, t_ns, names, _column(position_rad, names)))

    def send_forces(
        self,
        hand: str,
        force_n: Mapping[str, float],
        std_n: Mapping[str, float] | float,
        *,
        t_ns: int | None = None,
    ) -> None:
        """Forces on links of a hand as another sensor has them, and their deviations; as `send_joints`."""
        links = tuple(force_n)
        std = std_n if isinstance(std_n, Mapping) else dict.fromkeys(links, float(std_n))
        t_ns = time.monotonic_ns() if t_ns is None else t_ns
        self._send(LinkForces(hand, t_ns, links, _column(force_n, links), _column(std, links)))

    def connected(self, timeout_s: float = 2.0) -> bool:
        """Whether a daemon listens, within `timeout_s`. Raises PermissionError."""
        end_s = time.monotonic() + timeout_s
        while not self._subscribed:
            left_ms = max(0, round((end_s - time.monotonic()) * 1000))
            if not self._door.poll(left_ms) and left_ms == 0:
                break
            self._take_subscriptions()
        return bool(self._subscribed)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave; what is queued has 0.2 s to go out."""
        self._door.close()
        self._socket.close()

    def _send(self, message: Input) -> None:
        self._door.poll(0)
        self._take_subscriptions()
        self._socket.send_multipart(encode(message), zmq.NOBLOCK)  # a full queue drops what comes

    def _take_subscriptions(self) -> None:
        while True:
            try:
                request = self._socket.recv(zmq.NOBLOCK)
            except zmq.Again:
                return
            (self._subscribed.add if request[:1] == b"\x01" else self._subscribed.discard)(request[1:])


def _direction(gravity: Sequence[float]) -> NDArray[np.float64]:
    way = np.asarray(gravity, np.float64)
    if way.shape != (3,) or not np.isfinite(way).all() or not way.any():
        raise ValueError(f"gravity must be three finite numbers that point somewhere, got {gravity}")
    return way


def _column(values: Mapping[str, float], names: tuple[str, ...]) -> NDArray[np.float64]:
    if not names or values.keys() != set(names):
        differ = ", ".join(sorted(set(names) ^ values.keys())) or "there are none"
        raise ValueError(f"values must be given for the same names, one or more: {differ}")
    column = np.array([values[name] for name in names], np.float64)
    if not np.isfinite(column).all():
        wrong = [name for name in names if not np.isfinite(values[name])]
        raise ValueError(f"not finite: {', '.join(wrong)}; leave out what isn't known")
    return column
