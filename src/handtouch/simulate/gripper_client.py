"""Command the simulated gripper, as a controller commands a robot; programs in `examples/` use it.

    with Gripper() as gripper:
        gripper.move(index=0.01)  # m/s, for 50 ms

Public names: `Gripper`, `State`, `GRIPPER`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import msgpack
import zmq

GRIPPER = "tcp://127.0.0.1:5590"
"""Where `handtouch simulate --gripper` listens."""


@dataclass(frozen=True)
class State:
    """The gripper when it took a request."""

    t_ns: int
    """of time.monotonic_ns()"""
    position_m: dict[str, float]
    """of the joints reach, lift, thumb and index; home is 0"""
    truth: dict[str, float]
    """what really happens to the object; no robot knows it, so use it for judging alone"""


class Gripper:
    """One controller's connection. A velocity holds for 50 ms: who falls silent stops the joints.

    Requests raise TimeoutError when no gripper answers, and ValueError for what it can't do.
    """

    def __init__(self, endpoint: str = GRIPPER, timeout_s: float = 2.0) -> None:
        self.endpoint, self.timeout_s = endpoint, timeout_s
        self.latencies_ns: list[int] = []
        """of moves that named their sample: from the sample to the gripper's taking the command"""
        self._socket = self._connect()

    def move(self, *, sample_ns: int | None = None, **velocity_m_s: float) -> State:
        """Move joints by name; those that aren't named stop. `sample_ns`: of the touch that it answers."""
        state = self._ask(do="move", velocity_m_s=velocity_m_s)
        if sample_ns is not None:
            self.latencies_ns.append(state.t_ns - sample_ns)
        return state

    def look(self) -> State:
        """Where it is."""
        return self._ask(do="look")

    def reset(self, thing: str, **numbers: float) -> State:
        """Joints home, and another object in front of it: "block" or "edge", with numbers of its own."""
        return self._ask(do="reset", object=thing, numbers=numbers)

    def pull(self, force_n: float, ramp_s: float = 0.0) -> State:
        """Let somebody pull at the object, along the base's x; the force rises in `ramp_s`."""
        return self._ask(do="pull", force_n=force_n, ramp_s=ramp_s)

    def told_latency(self) -> str:
        """The loop's latency, in words."""
        if not self.latencies_ns:
            return "no command answered a touch"
        ordered = sorted(self.latencies_ns)
        middle, late = (1e-6 * ordered[int(part * (len(ordered) - 1))] for part in (0.5, 0.95))
        return f"from sample to command {middle:.1f} ms, 95 % in {late:.1f} ms ({len(ordered)} commands)"

    def close(self) -> None:
        """Leave."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _ask(self, **request: Any) -> State:
        self._socket.send(msgpack.packb(request))
        if not self._socket.poll(round(1e3 * self.timeout_s)):
            self._socket.close()  # a request without an answer leaves its socket unusable
            self._socket = self._connect()
            raise TimeoutError(
                f"no gripper answers at {self.endpoint} within {self.timeout_s} s; "
                "is `handtouch simulate config/two_finger.toml --gripper` up?"
            )
        answer = msgpack.unpackb(self._socket.recv())
        if not answer["ok"]:
            raise ValueError(f"the gripper refuses: {answer['error']}")
        return State(answer["t_ns"], answer["position_m"], answer["truth"])

    def _connect(self) -> zmq.Socket[bytes]:
        socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.REQ)
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(self.endpoint)
        return socket
