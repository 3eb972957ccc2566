"""Inputs endpoint: joint states and reference forces that robots send to the daemon.

Public names: `InputReceiver`, `DROP_CAUSES`. The daemon binds a SUB socket and robots connect with PUB, so
they never wait for the daemon. Malformed messages and messages that match no hand, joint or pad are counted,
logged at a limited rate, and dropped.
"""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import zmq
from numpy.typing import NDArray

from handtouch.core.sheet_force import ForceReference
from handtouch.daemon.authentication import Authenticator
from handtouch.daemon.cause_counter import CauseCounter
from handtouch.daemon.endpoints import bind_endpoint, is_readable
from handtouch.hand.joints import JointLimitsError, JointSnapshot, JointStateBuffer
from handtouch.wire import UnknownTopicError, WireError
from handtouch.wire.inputs import (
    InputMessage,
    JointState,
    LinkForces,
    decode,
    hands_prefix,
    joints_prefix,
)

DROP_CAUSES = {
    "unknown_topic": "no such topic",
    "malformed": "message is malformed",
    "unknown_hand": "hand is not in the deployment",
    "no_urdf": "joint states of a hand without URDF",
    "unknown_joints": "none of the joints belongs to the hand",
    "joint_limits": "joint position is far beyond its limits in the URDF",
    "unknown_link": "link has no pad",
    "not_finite": "a joint's position is not a number",
    "disagreement": "two senders report different positions of a joint, which counts as unknown",
    "clock": "t_ns is not of this host's monotonic clock",
    "late": "t_ns is not newer than in the previous message with these names",
    "flood": "more messages waited than are read at once; the newest were used",
}
"""Causes of dropped messages or parts of them: name of the counter -> description."""

_QUEUE_MESSAGES = 64
_MAX_MESSAGES_PER_POLL = 128
"""Messages decoded at once, the newest that wait: more than arrive at 1 kHz in a period of 100 ms."""
_MAX_WAITING_MESSAGES = 10_000
_MAX_AHEAD_NS, _MAX_AGE_NS = 50_000_000, 10_000_000_000
"""A measurement isn't of the future: its sender's clock may be ahead of this one by as much."""
_log = logging.getLogger("handtouch.inputs")


class InputReceiver:
    """Receives robots' messages; `poll` it once per cycle, before samples arrive. Created by `open`.

    `joints` (hand -> states) are of the hands with a URDF, `pads` (hand, link) of all. Forces are passed to
    `on_force_reference`. `received` counts messages by topic, `dropped` by cause (`DROP_CAUSES`).
    """

    def __init__(
        self,
        socket: zmq.Socket[bytes],
        endpoint: str,
        joints: Mapping[str, JointStateBuffer],
        pads: Sequence[tuple[str, str]],
        on_force_reference: Callable[[ForceReference], object] = lambda _: None,
        authenticator: Authenticator | None = None,
    ) -> None:
        self._authenticator = authenticator
        self.endpoint = endpoint
        self.received: Counter[str] = Counter()
        self._socket = socket
        self._drops = CauseCounter(_log, "input dropped", DROP_CAUSES)
        self._on_force_reference = on_force_reference
        self._joints = joints
        self._base_poses: dict[tuple[str, str], NDArray[np.float64]] = {}  # from the newest joint state
        self._row_by_pad = {name: pad for pad, name in enumerate(pads)}
        self._hands = {hand for hand, _ in pads}
        self._newest_sample_ns: dict[str, int] = {}

    @classmethod
    def open(
        cls,
        context: zmq.Context[zmq.Socket[bytes]],
        endpoint: str,
        authenticator: Authenticator,
        joints: Mapping[str, JointStateBuffer],
        pads: Sequence[tuple[str, str]],
        on_force_reference: Callable[[ForceReference], object] = lambda _: None,
    ) -> InputReceiver:
        """Bind the endpoint. Raises OSError naming it and a remedy."""
        socket: zmq.Socket[bytes] = context.socket(zmq.SUB)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.RCVHWM, _QUEUE_MESSAGES)
        socket.subscribe("")  # everything, to count misspelt topics
        socket.subscribe(hands_prefix(hand for hand, _ in pads))
        for hand, buffer in joints.items():
            socket.subscribe(joints_prefix(hand, buffer.names))
        bound = bind_endpoint(socket, endpoint, "the inputs endpoint", authenticator, "inputs")
        return cls(socket, bound, joints, pads, on_force_reference, authenticator)

    @property
    def dropped(self) -> Counter[str]:
        """Dropped messages by cause."""
        return self._drops.counts

    @property
    def problem(self) -> str:
        """Cause of the message dropped last, as text; empty before the first."""
        return self._drops.last_problem

    def poll(self, now_ns: int) -> None:
        """Process the waiting messages; of very many, the newest."""
        waiting: deque[list[zmq.Frame]] = deque(maxlen=_MAX_MESSAGES_PER_POLL)
        for number in range(_MAX_WAITING_MESSAGES):
            if not is_readable(self._socket):
                break
            if number == _MAX_MESSAGES_PER_POLL:
                self._drops.add("flood", "", now_ns)
            waiting.append(self._socket.recv_multipart(zmq.NOBLOCK, copy=False))
        for frames in waiting:
            if self._authenticator is None or self._authenticator.authorise(
                frames[0], "control", self.endpoint, now_ns
            ):
                self.process_message([frame.bytes for frame in frames], now_ns)

    def process_message(self, parts: Sequence[bytes], now_ns: int) -> None:
        """Process one message; drop and count it if it is invalid."""
        try:
            message = decode(parts)
        except WireError as error:
            cause = "unknown_topic" if isinstance(error, UnknownTopicError) else "malformed"
            self._drops.add(cause, str(error), now_ns)
            return
        topic = parts[0].decode()
        if message.hand not in self._hands:
            self._drops.add(
                "unknown_hand", f"{topic}; the hands are {', '.join(sorted(self._hands))}", now_ns
            )
            return
        t_ns = now_ns if message.t_ns is None else message.t_ns
        if not -_MAX_AGE_NS <= t_ns - now_ns <= _MAX_AHEAD_NS:
            off_s = (t_ns - now_ns) * 1e-9
            detail = (
                f"{topic}: t_ns is {off_s:.3g} s off; send nil if the sender doesn't have this clock (in ROS "
                "a stamp of 0), or synchronise the clocks; simulated time isn't this clock"
            )
            self._drops.add("clock", detail, now_ns)
            return
        if self._store_message(message, t_ns, now_ns):
            self.received[topic] += 1
            self._newest_sample_ns[topic] = t_ns

    def joints_at(self, hand: str, t_ns: int) -> JointSnapshot | None:
        """Return the joint state of a hand at a time, None without URDF."""
        states = self._joints.get(hand)
        return None if states is None else states.interpolate(t_ns)

    def sent_joints_at(self, hand: str, t_ns: int) -> JointSnapshot | None:
        """Return the same, but positions sent last of joints about which senders disagree."""
        states = self._joints.get(hand)
        return None if states is None else states.interpolate(t_ns, as_sent=True)

    def base_pose(self, hand: str, key: str) -> NDArray[np.float64] | None:
        """Return the "gravity" (3,) or "orientation" (4,) of a hand's base; None if no joint state had it."""
        return self._base_poses.get((hand, key))

    def statistics(self, now_ns: int) -> dict[str, Any]:
        """Return the counters for the `service` message."""
        return {
            "received": dict(self.received),
            "age_s": {topic: (now_ns - t_ns) * 1e-9 for topic, t_ns in self._newest_sample_ns.items()},
            "dropped": dict(self.dropped),
            "problem": self.problem,
        }

    def close(self) -> None:
        """Close the endpoint."""
        self._socket.close()

    def _store_message(self, message: InputMessage, t_ns: int, now_ns: int) -> bool:
        if isinstance(message, LinkForces):
            return self._forward_forces(message, t_ns, now_ns)
        topic, states = f"joints/{message.hand}", self._joints.get(message.hand)
        if states is None:
            self._drops.add("no_urdf", topic, now_ns)
            return False
        return self._store_joints(message, states, topic, t_ns, now_ns)

    def _store_joints(
        self, message: JointState, states: JointStateBuffer, topic: str, t_ns: int, now_ns: int
    ) -> bool:
        late, names, position = states.late_count, message.names, message.position_rad
        velocity, std = message.velocity_rad_s, message.position_std_rad
        try:
            kept = states.add_state(t_ns, names, position, velocity, std, replace=message.t_ns is None)
        except JointLimitsError as error:
            self._drops.add("joint_limits", f"{topic}: {error}", now_ns)
            return False
        problems = states.pop_problems()
        for cause, text in problems:
            self._drops.add(cause, f"{topic}: {text}", now_ns)
        for key in ("gravity", "orientation"):
            if kept and (pose := getattr(message, key)) is not None:
                self._base_poses[message.hand, key] = pose
        if not kept and states.late_count > late:
            self._drops.add("late", topic, now_ns)
        elif not kept and not problems:
            detail = f"{topic} has {', '.join(message.names[:4])}; the URDF has " + ", ".join(states.names)
            self._drops.add("unknown_joints", detail, now_ns)
        return kept

    def _forward_forces(self, message: LinkForces, t_ns: int, now_ns: int) -> bool:
        pads = [self._row_by_pad.get((message.hand, link)) for link in message.links]
        for link, pad in zip(message.links, pads, strict=True):
            if pad is None:
                self._drops.add("unknown_link", f"force/{message.hand}: {link!r:.80}", now_ns)
        known = np.array([pad is not None for pad in pads])
        if known.any():
            rows = np.array([pad for pad in pads if pad is not None], dtype=np.intp)
            self._on_force_reference(ForceReference(rows, message.force_n[known], message.std_n[known], t_ns))
        return bool(known.any())
