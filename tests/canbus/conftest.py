"""A hand of simulated nodes and the master in one thread, on a simulated bus and clock."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import can
import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.canbus.bus.bus_state import BusFault
from handtouch.canbus.bus.port import Port
from handtouch.canbus.bus.router import CanFrame, Router
from handtouch.canbus.nodes import master
from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.canbus.nodes.master import Master
from handtouch.canbus.nodes.spec import ErrorChanged, NodeEvent, NodeSpec, NodeStatus, SerialChanged
from handtouch.canbus.objects import sdo
from handtouch.config import Bus
from handtouch.core.slab import Slab
from handtouch.device import Device, DeviceBus

MS = 1_000_000
SYNC_PERIOD_MS = 5


class Jobs:
    """Replacement of the master's workers; jobs run when `work` is called, in that thread."""

    def __init__(self, **_: object) -> None:
        self.waiting: deque[tuple[Callable[..., None], tuple[object, ...]]] = deque()

    def submit(self, job: Callable[..., None], *arguments: object) -> None:
        self.waiting.append((job, arguments))

    def work(self) -> None:
        for _ in range(len(self.waiting)):
            job, arguments = self.waiting.popleft()
            job(*arguments)

    def shutdown(self, **_: object) -> None:
        self.waiting.clear()


class Wire:
    """The bus between them: `DeviceBus` takes it for python-can's, `Port` for a receiver."""

    def __init__(self, rig: Rig) -> None:
        self.fault: BusFault | None = None
        self.backlog_ns: int | None = None
        self.to_master: deque[tuple[can.Message, int]] = deque()  # with arrival
        self.sent: list[tuple[int, bytes]] = []  # by the master
        self.asked: list[int] = []  # identifiers of its remote frames
        self.down = False
        self.cut: set[int] = set()  # node ids whose cable is out
        self.lose: set[int] = set()  # identifiers of frames that don't arrive
        self._rig = rig

    # the devices' side
    def recv(self, timeout: float | None = None) -> None:
        """Return nothing: frames are passed to the devices when they are sent."""

    def send(self, *frame: Any) -> None:
        if len(frame) == 1:
            identifier = frame[0].arbitration_id
            if identifier & 0x7F not in self.cut and identifier not in self.lose:
                self.to_master.append((_copy(frame[0]), self._rig.t_ns))
        else:
            self._from_master(*frame)

    # the port's side
    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        """Nothing to close."""

    def send_cyclically(self, *_: object) -> None:
        """No cyclic sender."""

    def drain(self, router: Router) -> list[CanFrame]:
        others = []
        while self.to_master:
            frame = router.accept_message(*self.to_master.popleft())
            if frame is not None:
                others.append(frame)
        return others

    def _from_master(self, can_id: int, data: bytes, remote: bool) -> None:
        if self.down:
            raise OSError("network is down")
        if remote:
            self.asked.append(can_id)
        else:
            self.sent.append((can_id, data))
        if (data[1] if can_id == 0 else can_id & 0x7F) in self.cut:
            return
        message = can.Message(
            arbitration_id=can_id, data=b"" if remote else data, is_remote_frame=remote, is_extended_id=False
        )
        self._rig.devices.handle_frame(message, self._rig.t_ns)
        if 0x600 < can_id < 0x680:
            self._answer(can_id - 0x80)

    def _answer(self, can_id: int) -> None:
        """Deliver responses to an SDO request to the waiting job; responses to a probe stay queued."""
        sdo = self._rig.sdo_of(can_id - 0x580)
        if sdo is None or not sdo.awaiting_response:
            return
        for entry in [entry for entry in self.to_master if entry[0].arbitration_id == can_id]:
            self.to_master.remove(entry)
            sdo.deliver_response(bytes(entry[0].data))


class Rig:
    """Nodes 1 to n in slots 0 to n - 1, the master, and simulated time.

    `device` are options of `DeviceBus.add`, `role` our part on the bus, `spec` changes of every NodeSpec.
    """

    def __init__(
        self, size: int = 3, role: str = "master", device: dict[str, Any] | None = None, **spec: Any
    ) -> None:
        self.t_ns = 1_000_000 * MS
        self.size = size
        self.counts = np.tile(np.array([10, 20, 30, 40], dtype=np.int64), (size, 1))
        self.wire = Wire(self)
        self.devices = DeviceBus(self.wire, self._sample, clock=lambda: self.t_ns)  # type: ignore[arg-type]
        for number in range(1, size + 1):
            self.devices.add(number, serial=100 + number, **(device or {}))
        self.slab = Slab(size)
        bus = Bus(name="can", interface="virtual", channel="rig", role=role)  # type: ignore[arg-type]
        self.port = Port(bus, self.wire, self.slab)
        self.specs = [self.spec(number, **spec) for number in range(1, size + 1)]
        self.errors: list[ErrorChanged] = []
        self.syncs = True
        self.foreign_sync = role == "listener"
        self.restart()

    def restart(self) -> None:
        """Make a new master, as after a restart of the daemon."""
        self.master = Master({"can": self.port}, self.specs, SYNC_PERIOD_MS * MS)

    def sdo_of(self, node_id: int) -> sdo.SdoTransport | None:
        """SDO transport that the master has for a node, None without one."""
        for node in self.master._nodes:
            if node.port is self.port and node.spec.node_id == node_id:
                return node.sdo
        return None

    def spec(self, number: int, **changes: Any) -> NodeSpec:
        spec = NodeSpec(slot=number - 1, bus="can", node_id=number, name=f"pad{number}")
        return replace(spec, **changes)

    def node(self, number: int) -> Device:
        return self.devices.devices[number]

    def state(self, number: int) -> NodeState:
        return NodeState(self.master.states[number - 1])

    def status(self, number: int) -> NodeStatus:
        return self.master.status()[number - 1]

    def plug_all(self) -> None:
        for device in self.devices.devices.values():
            device.plug()

    def start(self) -> None:
        self.master.start(self.t_ns)

    def boot(self) -> None:
        """Power up the hand and wait until it is operational."""
        self.plug_all()
        self.start()
        self.run(300)
        assert (self.master.states == NodeState.OPERATIONAL).all(), self.master.status()
        self.master.drain_events()
        self.wire.sent.clear()

    def nmt(self, command: int, node_id: int) -> None:
        """Send a command of another NMT master."""
        message = can.Message(arbitration_id=0, data=bytes((command, node_id)), is_extended_id=False)
        self.wire.to_master.append((message, self.t_ns))  # received before the node's response
        self.devices.handle_frame(message, self.t_ns)
        self.pump()

    def run(self, ms: int) -> list[NodeEvent | SerialChanged]:
        """Advance the time in steps of a millisecond; return the nodes' events, and add EMCY to `errors`."""
        for _ in range(ms):
            self.t_ns += MS
            self.step()
        events = self.master.drain_events()
        self.errors += [event for event in events if isinstance(event, ErrorChanged)]
        return [event for event in events if not isinstance(event, ErrorChanged)]

    def step(self) -> None:
        """Run what is due now."""
        if self.syncs and self.t_ns // MS % SYNC_PERIOD_MS == 0:
            self.sync()
        self.devices.advance(self.t_ns)
        self.pump()
        self.master.poll(self.t_ns)
        if isinstance(self.master._workers, Jobs):
            self.master._workers.work()

    def sync(self) -> None:
        """Send a SYNC, of the master or of another producer."""
        self.slab.begin_cycle(self.t_ns)
        self.port.last_sync_ns = self.t_ns
        if self.foreign_sync:
            self.devices.handle_frame(can.Message(arbitration_id=0x80, is_extended_id=False), self.t_ns)
        else:
            self.port.send(0x80, b"")

    def pump(self) -> None:
        for frame in self.port.drain():
            self.master.handle_frame("can", *frame)

    def inject(self, can_id: int, data: bytes) -> None:
        """Receive a frame of another device."""
        message = can.Message(arbitration_id=can_id, data=data, is_extended_id=False)
        self.wire.to_master.append((message, self.t_ns))
        self.pump()

    def pause(self, ms: int, kernel_sync: bool) -> None:
        """Stop the master for a time in which the nodes go on, and the kernel's SYNC if there is one."""
        for _ in range(ms):
            self.t_ns += MS
            if kernel_sync and self.t_ns // MS % SYNC_PERIOD_MS == 0:
                self.devices.handle_frame(can.Message(arbitration_id=0x80, is_extended_id=False), self.t_ns)
                self.port.last_sync_ns = self.t_ns
            self.devices.advance(self.t_ns)
        self.master.excuse_pause((ms - SYNC_PERIOD_MS) * MS, self.t_ns)

    def _sample(self, t_ns: int) -> NDArray[np.int64]:  # noqa: ARG002
        return self.counts


def _copy(message: can.Message) -> can.Message:
    return can.Message(
        arbitration_id=message.arbitration_id, data=bytes(message.data), is_extended_id=False, check=True
    )


@pytest.fixture
def make_rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Rig]]:
    """Make rigs in which an SDO timeout takes 5 ms of real time."""
    monkeypatch.setattr(master, "ThreadPoolExecutor", Jobs)
    monkeypatch.setattr(sdo, "SDO_TIMEOUT_S", 0.005)
    rigs: list[Rig] = []

    def make(size: int = 3, *more: Any, **options: Any) -> Rig:
        rigs.append(Rig(size, *more, **options))
        return rigs[-1]

    yield make
    for rig in rigs:
        rig.master.stop(rig.t_ns)


@pytest.fixture
def rig(make_rig: Callable[..., Rig]) -> Rig:
    """Three nodes, unplugged, and a master that hasn't started."""
    return make_rig()
