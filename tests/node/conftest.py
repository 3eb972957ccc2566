"""A node on stand-ins for the kernel's files, on a recording bus, with a simulated clock."""

from __future__ import annotations

import struct
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import can
import pytest

from handtouch.node.service import NodeService
from handtouch.node.settings import load
from tests.node.stand_in import AdcStandIn

MS = 1_000_000
Frame = tuple[int, bytes]


class Wire:
    """A bus that remembers what was sent, and gives what is put in `incoming`; `file`: to wait for."""

    def __init__(self) -> None:
        self.sent: list[Frame] = []
        self.incoming: list[can.Message] = []
        self.filters: Any = None
        self.file: int | None = None

    def recv(self, timeout: float | None = None) -> can.Message | None:  # noqa: ARG002
        return self.incoming.pop(0) if self.incoming else None

    def send(self, message: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        self.sent.append((message.arbitration_id, bytes(message.data)))

    def set_filters(self, filters: Any) -> None:
        self.filters = filters

    def fileno(self) -> int:
        if self.file is None:
            raise NotImplementedError
        return self.file


class NodeBench:
    """Service of one file; `adc` is its first ADC, of which voltage0 to 3 are the first pad's channels."""

    def __init__(self, folder: Path, adc: AdcStandIn) -> None:
        self.folder, self.adc = folder, adc
        self.t_ns = 10**12
        self.wire = Wire()
        self.service: Any = None

    def write(self, adc: str = "", pad: str = "", more: str = "") -> Path:
        """Write the file of a node with one pad, id 5, serial number 77."""
        path = self.folder / "node.toml"
        lines = [
            f'sysfs = "{self.folder}/sysfs"',
            f'devices = "{self.folder}/dev"',
            "[bus]",
            'channel = "can0"',
        ]
        lines += ["[adc.main]", 'device = "adc0"', textwrap.dedent(adc)]
        if "name =" not in pad:
            lines += ["[[pad]]", 'name = "tip"', "node_id = 5", "serial = 77", 'adc = "main"']
            lines += ['channels = ["voltage0", "voltage1", "voltage2", "voltage3"]', "gain_ohm = -240.0"]
        path.write_text("\n".join([*lines, textwrap.dedent(pad), textwrap.dedent(more)]))
        return path

    def start(self, adc: str = "", pad: str = "") -> list[Frame]:
        """Start the node and make it operational; what it sends."""
        bus: Any = self.wire
        self.service = NodeService(load(self.write(adc, pad)), bus, clock=lambda: self.t_ns)
        self.service.start()
        return self.send(0, bytes((1, 5)))

    def send(self, identifier: int, data: bytes = b"") -> list[Frame]:
        """Put a frame on the bus; what the node sends."""
        message = can.Message(arbitration_id=identifier, data=data, is_extended_id=False)
        self.wire.incoming.append(message)
        self.service.poll(0.0)
        return self.take()

    def sync(self) -> list[Frame]:
        """A SYNC, five milliseconds after the last."""
        self.t_ns += 5 * MS
        return self.send(0x80)

    def run(self, ms: int) -> list[Frame]:
        """Let time pass, in steps of a millisecond; what was sent, without heartbeats."""
        for _ in range(ms):
            self.t_ns += MS
            self.service.poll(0.0)
        return [frame for frame in self.take() if frame[0] < 0x700]

    def take(self) -> list[Frame]:
        sent, self.wire.sent = self.wire.sent, []
        return sent

    def counts(self) -> Sequence[int] | None:
        """Counts sent after a SYNC, None without a TPDO."""
        data = [data for identifier, data in self.sync() if identifier == 0x285]
        return struct.unpack("<4h", data[0]) if data else None

    def read_object(self, index: int, sub: int) -> int:
        ((_, data),) = self.send(0x605, struct.pack("<BHB4x", 0x40, index, sub))
        return int.from_bytes(data[4:], "little")


@pytest.fixture
def adc(tmp_path: Path) -> Iterator[AdcStandIn]:
    made = AdcStandIn(tmp_path)
    yield made
    made.close()


@pytest.fixture
def bench(tmp_path: Path, adc: AdcStandIn) -> Iterator[NodeBench]:
    made = NodeBench(tmp_path, adc)
    yield made
    if made.service is not None:
        made.service.close()
