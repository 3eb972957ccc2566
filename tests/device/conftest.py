"""Simulated nodes on a recording bus, with a simulated clock, and EDS files made to order."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.device import Device, DeviceBus

MS = 1_000_000
START, STOP, PRE_OPERATIONAL, RESET = 1, 2, 128, 129
SIGNED = {8: 0x02, 16: 0x03, 24: 0x10, 32: 0x04, 40: 0x12, 48: 0x13, 56: 0x14, 64: 0x15}
UNSIGNED = {8: 0x05, 16: 0x06, 24: 0x16, 32: 0x07, 40: 0x18, 48: 0x19, 56: 0x1A, 64: 0x1B}
Frame = tuple[int, bytes]


class Wire:
    """A bus that remembers what was sent on it, and when, and gives what is put in `incoming`."""

    def __init__(self, bench: Bench) -> None:
        self.sent: list[tuple[int, Frame]] = []
        self.incoming: list[can.Message] = []
        self.broken = False
        self._bench = bench

    def recv(self, timeout: float | None = None) -> can.Message | None:  # noqa: ARG002
        if self.broken:
            raise can.CanOperationError("network is down")
        return self.incoming.pop(0) if self.incoming else None

    def send(self, message: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        if self.broken:
            raise can.CanOperationError("no buffer space")
        assert message.dlc == len(message.data)
        self.sent.append((self._bench.t_ns, (message.arbitration_id, bytes(message.data))))


class Bench:
    """Nodes whose electrodes give `counts`; `samples` are the times at which these were asked for."""

    def __init__(self) -> None:
        self.t_ns = 0
        self.counts: NDArray[np.int64] = np.array([[10, 20, 30, 40]] * 3)
        self.samples: list[int] = []
        self.wire = Wire(self)
        self.bus = DeviceBus(self.wire, self.read_channels, clock=lambda: self.t_ns)  # type: ignore[arg-type]

    def running(self, node_id: int = 1, **kind: Any) -> Device:
        """A node that is operational."""
        device = self.bus.add(node_id, **kind)
        device.plug()
        self.nmt(START, node_id)
        self.take()
        return device

    def send(self, can_id: int, data: bytes = b"", remote: bool = False) -> list[Frame]:
        """Put a frame on the bus; what the nodes answer."""
        message = can.Message(
            arbitration_id=can_id, data=data, is_extended_id=False, is_remote_frame=remote, dlc=len(data)
        )
        self.bus.handle_frame(message, self.t_ns)
        return self.take()

    def nmt(self, command: int, node_id: int) -> list[Frame]:
        return self.send(0, bytes((command, node_id)))

    def sync(self) -> list[Frame]:
        """A SYNC, five milliseconds after the last."""
        self.t_ns += 5 * MS
        return self.send(0x80)

    def run(self, ms: int) -> list[tuple[int, Frame]]:
        """Let time pass, in steps of a millisecond: (ms, frame) of all that is sent."""
        for _ in range(ms):
            self.t_ns += MS
            self.bus.advance(self.t_ns)
        sent, self.wire.sent = self.wire.sent, []
        return [(t_ns // MS, frame) for t_ns, frame in sent]

    def data(self, ms: int) -> list[tuple[int, Frame]]:
        """Run, and return the frames without heartbeats."""
        return [(t_ms, frame) for t_ms, frame in self.run(ms) if frame[0] < 0x700]

    def take(self) -> list[Frame]:
        sent, self.wire.sent = self.wire.sent, []
        return [frame for _, frame in sent]

    def request(self, node_id: int, data: bytes) -> list[Frame]:
        """An SDO request; the answers."""
        return self.send(0x600 + node_id, data.ljust(8, b"\0"))

    def read(self, node_id: int, index: int, sub: int) -> int:
        """Expedited upload: the value, or the abort code as a negative number."""
        ((identifier, data),) = self.request(node_id, struct.pack("<BHB", 0x40, index, sub))
        assert identifier == 0x580 + node_id
        assert struct.unpack_from("<HB", data, 1) == (index, sub)
        value = int.from_bytes(data[4:], "little")
        return -value if data[0] == 0x80 else value

    def write(self, node_id: int, index: int, sub: int, value: int, size: int) -> int:
        """Expedited download: 0, or the abort code."""
        head = struct.pack("<BHB", 0x23 | (4 - size) << 2, index, sub)
        ((_, data),) = self.request(node_id, head + value.to_bytes(size, "little"))
        assert data[0] in (0x60, 0x80)
        return int.from_bytes(data[4:], "little")

    def read_channels(self, t_ns: int) -> NDArray[np.int64]:
        self.samples.append(t_ns)
        return self.counts


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.fixture(scope="session")
def make_bench() -> type[Bench]:
    """For tests that need several."""
    return Bench


def eds_text(
    channels: Sequence[tuple[int, int, int, bool]],
    pdos: Sequence[Sequence[tuple[int, int, int]]],
    *,
    access: str = "rw",
    more: str = "",
) -> str:
    """An EDS: channels (index, sub, bits, signed), PDOs of (index, sub, bits); `access` to the mappings."""
    kinds = {(i, s): SIGNED[b] if signed else UNSIGNED[b] for i, s, b, signed in channels}
    sections = ["[DeviceInfo]\nVendorName=x", "[DummyUsage]\nDummy0005=1\nDummy0006=1\nDummy0007=1"]
    sections += [_variable("1000", 7, "ro", "0x191"), _variable("1001", 5, "ro", "0", mapped=True)]
    sections += [_record("1018", 4)] + [_variable(f"1018sub{n}", 7, "ro", str(n)) for n in range(1, 5)]
    for index in sorted({index for index, _ in kinds}):
        subs = {sub: kind for (i, sub), kind in kinds.items() if i == index}
        sections.append(_record(f"{index:04X}", max(subs)))
        sections += [_variable(f"{index:04X}sub{s:X}", k, "ro", "0", mapped=True) for s, k in subs.items()]
    for number, entries in enumerate(pdos):
        sections += [
            _record(f"18{number:02X}", 2),
            _variable(f"18{number:02X}sub1", 7, "rw", f"$NODEID+0x{0x180 + 0x100 * number:X}"),
            _variable(f"18{number:02X}sub2", 5, "rw", "1"),
            f"[1A{number:02X}]\nParameterName=m\nObjectType=0x9\nSubNumber=9",
            _variable(f"1A{number:02X}sub0", 5, access, str(len(entries))),
        ]
        full = [index << 16 | sub << 8 | bits for index, sub, bits in entries]
        for sub, entry in enumerate((full + [0] * 8)[:8], 1):
            sections.append(_variable(f"1A{number:02X}sub{sub}", 7, access, f"0x{entry:X}"))
    return "\n".join([*sections, more])


def _variable(name: str, kind: int, access: str, default: str, mapped: bool = False) -> str:
    return (
        f"[{name}]\nParameterName={name}\nObjectType=0x7\nDataType=0x{kind:04X}\nAccessType={access}\n"
        f"DefaultValue={default}\nPDOMapping={mapped:d}"
    )


def _record(name: str, subs: int) -> str:
    head = f"[{name}]\nParameterName={name}\nObjectType=0x9\nSubNumber={subs + 1}"
    return head + "\n" + _variable(f"{name}sub0", 5, "const", str(subs))


@pytest.fixture
def write_eds(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Makes an EDS file of what `eds_text` takes."""
    folder = tmp_path_factory.mktemp("eds")

    def write(*arguments: Any, **more: Any) -> Path:
        path = folder / "node.eds"
        path.write_text(eds_text(*arguments, **more))
        return path

    return write
