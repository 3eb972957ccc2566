"""Client of the simulated gripper: sends velocity commands as a controller sends them to a robot.

    with GripperClient() as gripper:
        gripper.move(index=0.01)  # m/s, for 50 ms

The programs in `examples/` use it. Public names: `GripperClient`, `GripperState`, `DEFAULT_ENDPOINT`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import msgpack
import zmq

from handtouch.host.endpoints import GRIPPER_ENDPOINT

DEFAULT_ENDPOINT = GRIPPER_ENDPOINT
"""Default endpoint of `handtouch simulate --gripper`."""


@dataclass(frozen=True)
class GripperState:
    """State of the gripper when it executed a request."""

    t_ns: int
    """Time of time.monotonic_ns()."""
    position_m: dict[str, float]
    """Positions of the joints reach, lift, thumb and index; home is 0."""
    truth: dict[str, float]
    """Ground truth about the object, for evaluation only: a real robot doesn't know it."""


class GripperClient:
    """Connection of one controller. A commanded velocity expires after 50 ms, then the joints stop.

    Requests raise TimeoutError if no gripper answers, and ValueError if it rejects them.
    """

    def __init__(self, endpoint: str = DEFAULT_ENDPOINT, timeout_s: float = 2.0) -> None:
        self.endpoint, self.timeout_s = endpoint, timeout_s
        self.latencies_ns: list[int] = []
        """For moves with `sample_ns`: time from the sample to the execution of the command."""
        self._socket = self._connect()

    def move(self, *, sample_ns: int | None = None, **velocity_m_s: float) -> GripperState:
        """Move joints by name, stop all others; `sample_ns`: time of the sample that caused it."""
        state = self._request(do="move", velocity_m_s=velocity_m_s)
        if sample_ns is not None:
            self.latencies_ns.append(state.t_ns - sample_ns)
        return state

    def read_state(self) -> GripperState:
        """Return the present state."""
        return self._request(do="state")

    def reset(self, object_name: str, **parameters: float) -> GripperState:
        """Move the joints home and replace the object: "block" or "edge", with its parameters."""
        return self._request(do="reset", object=object_name, parameters=parameters)

    def pull(self, force_n: float, ramp_s: float = 0.0) -> GripperState:
        """Apply an external force to the object, along the base's x; it rises linearly within `ramp_s`."""
        return self._request(do="pull", force_n=force_n, ramp_s=ramp_s)

    def latency_summary(self) -> str:
        """Return median and 95th percentile of the loop's latency as text."""
        if not self.latencies_ns:
            return "no command responded to a sample"
        ordered = sorted(self.latencies_ns)
        p50_ms, p95_ms = (1e-6 * ordered[int(part * (len(ordered) - 1))] for part in (0.5, 0.95))
        return f"from sample to command {p50_ms:.1f} ms (p95 {p95_ms:.1f} ms, {len(ordered)} commands)"

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _request(self, **request: Any) -> GripperState:
        self._socket.send(msgpack.packb(request))
        if not self._socket.poll(round(1e3 * self.timeout_s)):
            self._socket.close()  # a REQ socket without an answer is unusable
            self._socket = self._connect()
            raise TimeoutError(
                f"no gripper answers at {self.endpoint} within {self.timeout_s} s; "
                "start `handtouch simulate config/two_finger.toml --gripper`"
            )
        answer = msgpack.unpackb(self._socket.recv())
        if not answer["ok"]:
            raise ValueError(f"request rejected by the gripper: {answer['error']}")
        return GripperState(answer["t_ns"], answer["position_m"], answer["truth"])

    def _connect(self) -> zmq.Socket[bytes]:
        socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.REQ)
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(self.endpoint)
        return socket
