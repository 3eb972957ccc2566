"""Nodes in a process of their own that answer SYNC over pairs of Unix sockets, in place of SocketCAN.

The sockets carry `struct can_frame`, so that a daemon reads them as it does SocketCAN: in batches, with the
kernel's stamps. The kernel's CAN layer and its cyclic sender are left out.
"""

from __future__ import annotations

import multiprocessing
import select
import socket
import struct
import time
from typing import Any

import can
import numpy as np
from numpy.typing import NDArray

from handtouch.config import Deployment
from handtouch.daemon.daemon import HandtouchDaemon
from handtouch.device import DeviceBus

HEARTBEAT_S = 0.1
"""Period of a node's heartbeat"""
_FRAME = struct.Struct("=IB3x8s")
_SYNC = _FRAME.pack(0x80, 0, b"")
_QUEUE_BYTES = 4 << 20
_PAIRS: dict[str, tuple[socket.socket, socket.socket]] = {}
"""Ends of the daemon and of the nodes by channel"""


class PairBus(can.BusABC):
    """One end of a channel's pair of sockets: the daemon's, or with `of_nodes` the nodes'."""

    def __init__(self, channel: str, of_nodes: bool = False, **_: Any) -> None:
        super().__init__(channel=channel)
        self._end = _PAIRS[channel][of_nodes]

    def fileno(self) -> int:
        return self._end.fileno()

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        self._end.send(_FRAME.pack(msg.arbitration_id, msg.dlc, bytes(msg.data)))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not select.select([self._end], [], [], timeout)[0]:
            return None, False
        can_id, size, data = _FRAME.unpack(self._end.recv(_FRAME.size))
        return can.Message(arbitration_id=can_id, data=data[:size], is_extended_id=False), False

    def _send_periodic_internal(self, *_: Any, **__: Any) -> Any:
        raise NotImplementedError("the loop sends SYNC")


class SocketNodes:
    """Nodes of a deployment: simulated in this process until `feed`, then a process answers each SYNC.

    Make it before threads start: it forks. samples: (k, pads, 4), answers in turn.
    """

    def __init__(self, deployment: Deployment, samples: NDArray[np.int64]) -> None:
        can.interfaces.BACKENDS["socketcan"] = (__name__, "PairBus")
        pads = [entry.pad for entry in deployment.pads]
        self._simulated, ends, answers, heartbeats = [], [], [], []
        data = samples.astype("<i2")
        for bus in deployment.buses:
            channel = str(bus.channel)
            _PAIRS[channel] = pair = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
            pair[1].setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _QUEUE_BYTES)
            ends.append(pair[1])
            mine = [(n, pad.node_id) for n, pad in enumerate(pads) if pad.bus == bus.name]
            answers.append(
                [[_FRAME.pack(0x280 + node, 8, row[n].tobytes()) for n, node in mine] for row in data]
            )
            heartbeats.append([_FRAME.pack(0x700 + node, 1, b"\x05") for _, node in mine])
        self._counts = multiprocessing.Array("q", len(ends), lock=False)
        self._fed = multiprocessing.Event()
        self._process = multiprocessing.get_context("fork").Process(
            target=_answer, args=(ends, answers, heartbeats, self._counts, self._fed), daemon=True
        )
        self._process.start()
        for bus in deployment.buses:
            devices = DeviceBus(
                PairBus(str(bus.channel), of_nodes=True), lambda _: np.zeros((len(pads), 4), dtype=np.int64)
            )
            for pad in pads:
                if pad.bus == bus.name:
                    devices.add(pad.node_id, serial=pad.serial)
            devices.start()
            self._simulated.append(devices)

    def feed(self, daemon: HandtouchDaemon) -> None:  # noqa: ARG002
        """Replace the simulated nodes after the daemon has booted them all."""
        self._stop_simulated()
        self._fed.set()

    @property
    def answered(self) -> int:
        """Number of SYNC frames answered."""
        return min(int(count) for count in self._counts)

    def busy_s(self) -> float:
        """Time that the daemon's thread spent answering: none."""
        return 0.0

    def waiting(self) -> int:
        """Frames waiting for the daemon: the kernel doesn't report them."""
        return 0

    def stop(self) -> None:
        """Stop answering."""
        self._stop_simulated()
        self._process.terminate()
        self._process.join()
        for pair in _PAIRS.values():
            for end in pair:
                end.close()
        _PAIRS.clear()

    def _stop_simulated(self) -> None:
        for devices in self._simulated:
            devices.stop()
        self._simulated.clear()


def _answer(
    ends: list[socket.socket],
    answers: list[list[list[bytes]]],
    heartbeats: list[list[bytes]],
    counts: Any,
    fed: Any,
) -> None:
    """Answer each SYNC on each end; send the heartbeats of its nodes in turn."""
    fed.wait()
    sent_heartbeats, start_s = [0] * len(ends), time.monotonic()
    numbers = {end.fileno(): number for number, end in enumerate(ends)}
    poll = select.poll()
    for end in ends:
        poll.register(end, select.POLLIN)
    while True:
        for descriptor, _ in poll.poll():
            number = numbers[descriptor]
            end, count = ends[number], counts[number]
            if end.recv(_FRAME.size) != _SYNC:
                continue
            for frame in answers[number][count % len(answers[number])]:
                end.send(frame)
            counts[number] = count + 1
            nodes = len(heartbeats[number])
            due = int((time.monotonic() - start_s) / HEARTBEAT_S * nodes)
            for turn in range(max(sent_heartbeats[number], due - nodes), due):
                end.send(heartbeats[number][turn % nodes])
            sent_heartbeats[number] = due
