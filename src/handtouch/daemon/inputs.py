"""The inputs endpoint: what the robot tells, joint states and forces from other sensors.

Public names: `Inputs`, `CAUSES`. The daemon binds a SUB socket, robots connect with PUB: they never
wait for the daemon. What is malformed or belongs to nothing here is counted, told now and then, and dropped.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import zmq
from numpy.typing import NDArray

from handtouch.daemon.publisher import bind
from handtouch.daemon.security import Gate, ready
from handtouch.hand.joints import Joints, JointStates
from handtouch.inputs import Input, InputError, JointCommand, JointState, LinkForces, decode
from handtouch.supervise.strength import ForceReference

CAUSES = {
    "malformed": "that doesn't keep the contract",
    "unknown_hand": "of a hand that isn't served here",
    "no_urdf": "joint states of a hand that has no URDF",
    "unknown_joints": "that tells none of the joints of its hand",
    "unknown_link": "with a link that carries no pad",
    "clock": "whose t_ns is not of this machine's monotonic clock",
    "late": "not newer than the one before of the same names",
    "flood": "that had to wait: more come than are read in a period",
}
"""Why a message, or a part of it, was of no use: name of the counter -> words."""

_QUEUE = 64
_PER_POLL = 32
_AHEAD_NS, _BEHIND_NS = 1_000_000_000, 10_000_000_000
_TOLD_AGAIN_NS = 10_000_000_000
_log = logging.getLogger("handtouch.inputs")


class Inputs:
    """Takes what robots tell; `poll` it once a period, before the samples come.

    `joints` (hand -> states) of the hands with a URDF; `pads` (hand, link) of all. Forces are handed
    to `refer`. `received` and `dropped` count messages by topic and by cause (`CAUSES`), `problem` is the
    last one in words. Raises OSError naming the endpoint when it can't be bound.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        endpoint: str,
        gate: Gate,
        joints: Mapping[str, JointStates],
        pads: Sequence[tuple[str, str]],
    ) -> None:
        self.received: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self.problem = ""
        self.refer: Callable[[ForceReference], object] = lambda _: None
        self._joints = joints
        self._commands = {hand: states.like() for hand, states in joints.items()}
        self._down: dict[str, NDArray[np.float64]] = {}  # by hand, as last told
        self._pads = {name: pad for pad, name in enumerate(pads)}
        self._hands = {hand for hand, _ in pads}
        self._told: dict[str, tuple[int, int]] = {}
        self._newest_ns: dict[str, int] = {}
        self._socket: zmq.Socket[bytes] = context.socket(zmq.SUB)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RCVHWM, _QUEUE)
        self._socket.subscribe("joints/")
        self._socket.subscribe("command/")
        self._socket.subscribe("force/")
        try:
            self.endpoint = bind(self._socket, endpoint, "the inputs endpoint", gate, "inputs")
        except OSError:
            self._socket.close()
            raise

    def poll(self, now_ns: int) -> None:
        """Take what has come, a bounded number of messages."""
        for _ in range(_PER_POLL):
            if not ready(self._socket):
                return
            self.take(self._socket.recv_multipart(zmq.NOBLOCK), now_ns)
        self._drop("flood", "", now_ns)

    def take(self, parts: Sequence[bytes], now_ns: int) -> None:
        """Take one message, whatever its bytes."""
        try:
            message = decode(parts)
        except InputError as error:
            self._drop("malformed", str(error), now_ns)
            return
        topic = parts[0].decode()
        if message.hand not in self._hands:
            self._drop("unknown_hand", f"{topic}; there are {', '.join(sorted(self._hands))}", now_ns)
            return
        t_ns = now_ns if message.t_ns is None else message.t_ns
        if not -_BEHIND_NS <= t_ns - now_ns <= _AHEAD_NS:
            off = (
                f"{topic}: t_ns is {(t_ns - now_ns) * 1e-9:.3g} s off; leave it nil if there is no such clock"
            )
            self._drop("clock", off, now_ns)
            return
        if self._keep(message, t_ns, now_ns):
            self.received[topic] += 1
            self._newest_ns[topic] = t_ns

    def joints_at(self, hand: str, t_ns: int) -> Joints | None:
        """The joints of a hand at a time."""
        states = self._joints.get(hand)
        return None if states is None else states.at(t_ns)

    def commands_at(self, hand: str, t_ns: int) -> Joints | None:
        """Where the joints of a hand were told to be at a time, None where nobody ever told."""
        states = self._commands.get(hand)
        return states.at(t_ns) if states is not None and f"command/{hand}" in self._newest_ns else None

    def down_at(self, hand: str) -> NDArray[np.float64] | None:
        """Which way gravity points in the base of a hand (3,), as joint states told last, None: never."""
        return self._down.get(hand)

    def figures(self, now_ns: int) -> dict[str, Any]:
        """For `service`."""
        return {
            "received": dict(self.received),
            "age_s": {topic: (now_ns - t_ns) * 1e-9 for topic, t_ns in self._newest_ns.items()},
            "dropped": dict(self.dropped),
            "problem": self.problem,
        }

    def close(self) -> None:
        """Close the endpoint."""
        self._socket.close()

    def _keep(self, message: Input, t_ns: int, now_ns: int) -> bool:
        if isinstance(message, LinkForces):
            return self._keep_forces(message, t_ns, now_ns)
        told = isinstance(message, JointState)
        topic = f"{'joints' if told else 'command'}/{message.hand}"
        states = (self._joints if told else self._commands).get(message.hand)
        if states is None:
            self._drop("no_urdf", topic, now_ns)
            return False
        return self._keep_joints(message, states, topic, t_ns, now_ns)

    def _keep_joints(
        self, message: JointState | JointCommand, states: JointStates, topic: str, t_ns: int, now_ns: int
    ) -> bool:
        late, names, position = states.late, message.names, message.position_rad
        if isinstance(message, JointState):
            kept = states.take(t_ns, names, position, message.velocity_rad_s, message.position_std_rad)
            if kept and message.gravity is not None:
                self._down[message.hand] = message.gravity
        else:
            kept = states.take(t_ns, names, position)
        if not kept and states.late > late:
            self._drop("late", topic, now_ns)
        elif not kept:
            said = f"{topic} tells {', '.join(message.names[:4])}; the URDF has " + ", ".join(states.names)
            self._drop("unknown_joints", said, now_ns)
        return kept

    def _keep_forces(self, message: LinkForces, t_ns: int, now_ns: int) -> bool:
        pads = [self._pads.get((message.hand, link)) for link in message.links]
        for link, pad in zip(message.links, pads, strict=True):
            if pad is None:
                self._drop("unknown_link", f"force/{message.hand}: {link!r:.80}", now_ns)
        known = np.array([pad is not None for pad in pads])
        if known.any():
            rows = np.array([pad for pad in pads if pad is not None], dtype=np.intp)
            self.refer(ForceReference(rows, message.force_n[known], message.std_n[known], t_ns))
        return bool(known.any())

    def _drop(self, cause: str, detail: str, now_ns: int) -> None:
        """Count, and tell: the first at once, then from time to time with the number since."""
        self.dropped[cause] += 1
        last_ns, last_count = self._told.get(cause, (now_ns - _TOLD_AGAIN_NS, 0))
        if now_ns - last_ns >= _TOLD_AGAIN_NS:
            count = self.dropped[cause] - last_count
            self.problem = f"a message {CAUSES[cause]}" + (f": {detail}" if detail else "")
            _log.warning(
                "inputs: %s%s", self.problem, f"; {count} such since it was last told" if count > 1 else ""
            )
            self._told[cause] = now_ns, self.dropped[cause]
