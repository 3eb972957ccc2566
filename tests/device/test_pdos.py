"""TPDOs of any four-channel node: contents by the EDS and by mapping over SDO."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import canopen
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from handtouch.config import eds
from handtouch.device import DeviceBus

FOUR = tuple((0x2001, sub) for sub in (1, 2, 3, 4))
OFF = 0x80000000
UNSUPPORTED, NO_MAPPING, TOO_LONG, READ_ONLY, NOT_NOW = (
    0x06010000,
    0x06040041,
    0x06040042,
    0x06010002,
    0x08000022,
)


@st.composite
def kinds(draw: st.DrawFn) -> tuple[Any, Any, Any]:
    """Four integer types, their places in PDOs with gaps between, and counts, some beyond their ranges."""
    types = [(draw(st.sampled_from([8, 16, 24, 32, 40, 48, 56, 64])), draw(st.booleans())) for _ in range(4)]
    channels = [(0x2001, sub, bits, signed) for sub, (bits, signed) in enumerate(types, 1)]
    pdos: list[list[tuple[int, int, int]]] = [[]]
    for channel in draw(st.permutations(range(4))):
        gap = draw(st.sampled_from([None, (5, 0, 8), (6, 0, 16), (0x1001, 0, 8)]))
        entries = [*([gap] if gap else []), (0x2001, channel + 1, types[channel][0])]
        if sum(e[2] for e in entries) > 64:
            entries = entries[-1:]
        if sum(e[2] for e in pdos[-1] + entries) > 64 or draw(st.booleans()):
            pdos.append([])
        pdos[-1] += entries
    counts = draw(st.lists(st.integers(-(2**63), 2**63 - 1), min_size=4, max_size=4))
    return channels, pdos, counts


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(kind=kinds())
def test_any_mapping_carries_the_counts_clipped_to_their_types(
    kind: Any, bench: Any, write_eds: Callable[..., Path]
) -> None:
    channels, pdos, counts = kind
    bench.bus = DeviceBus(bench.wire, bench.read_channels, clock=lambda: 0)
    bench.counts = np.array([counts])
    bench.running(5, eds=write_eds(channels, pdos), channels=FOUR)
    sent = bench.sync()
    assert [identifier for identifier, _ in sent] == [0x185 + 0x100 * n for n, pdo in enumerate(pdos) if pdo]
    seen = {}
    for (_, data), entries in zip(sent, [pdo for pdo in pdos if pdo], strict=True):
        assert len(data) * 8 == sum(bits for _, _, bits in entries)
        for index, sub, bits in entries:
            signed = index == 0x2001 and channels[sub - 1][3]
            value = int.from_bytes(data[: bits // 8], "little", signed=signed)
            data = data[bits // 8 :]
            if index == 0x2001:
                seen[sub] = value
            else:
                assert value == 0
    for (_, sub, bits, signed), count in zip(channels, counts, strict=True):
        low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
        assert seen[sub] == min(max(count, low), high)


def test_the_usual_node_clips_to_16_bits_whatever_the_samplers_type(bench: Any) -> None:
    bench.running()
    bench.counts = np.array([[-40000, 40000, -1, 1 << 40]])
    assert bench.sync() == [(0x281, struct.pack("<4h", -32768, 32767, -1, 32767))]
    bench.counts = np.array([[1, -2, 3, -4]], np.int16)
    assert bench.sync() == [(0x281, struct.pack("<4h", 1, -2, 3, -4))]


@pytest.mark.parametrize(
    ("name", "channels", "layouts"),
    [
        ("feldmann-ai4w.eds", [(0x6401, s) for s in (1, 2, 3, 4)], {0x285: "<4h"}),
        ("norsens-quad404.eds", [(0x9130, s) for s in (1, 2, 3, 4)], {0x185: "<2i", 0x285: "<2i"}),
        ("tactor-q16.eds", [(i, 0) for i in (0x2110, 0x2120, 0x2130, 0x2140)], None),
        ("hapt24.dcf", [(0x8130, s) for s in (1, 2, 3, 4)], None),
        ("noname-4ch.eds", [(0x6401, s) for s in (1, 2, 3, 4)], {0x185: "<4h"}),
    ],
)
def test_nodes_of_other_vendors_send_their_channels(
    bench: Any, name: str, channels: Any, layouts: dict[int, str] | None
) -> None:
    path = Path(__file__).parents[1] / "data" / "eds" / name
    bench.counts = np.array([[1, 2, 3, 4]])
    bench.running(5, eds=path, channels=tuple(channels))
    sent = bench.sync() + [frame for _, frame in bench.data(2)]  # with SYNC, or by themselves
    assert sent
    for index, sub in channels:
        assert bench.read(5, index, sub) == channels.index((index, sub)) + 1
    if layouts:
        found = {i: struct.unpack(layouts[i], data) for i, data in sent if i in layouts}
        assert [value for i in sorted(found) for value in found[i]] == [1, 2, 3, 4]


def test_a_mapping_is_changed_in_the_order_of_cia_301(bench: Any, write_eds: Callable[..., Path]) -> None:
    channels = [(0x2001, sub, 16, True) for sub in (1, 2, 3, 4)]
    bench.running(eds=write_eds(channels, [[(0x2001, 1, 16)]]), channels=FOUR)
    assert bench.sync() == [(0x181, struct.pack("<h", 10))]
    assert bench.write(1, 0x1A00, 0, 0, 1) == UNSUPPORTED  # the PDO is still on
    assert bench.write(1, 0x1800, 1, OFF | 0x181, 4) == 0
    assert bench.write(1, 0x1A00, 1, 0x20010410, 4) == UNSUPPORTED  # the count isn't 0
    assert bench.write(1, 0x1A00, 0, 0, 1) == 0
    for sub, entry in enumerate((0x20010410, 0x00050008, 0x20010110, 0x10010008), 1):
        assert bench.write(1, 0x1A00, sub, entry, 4) == 0
    assert bench.write(1, 0x1A00, 0, 4, 1) == 0
    assert bench.sync() == []
    assert bench.write(1, 0x1800, 1, 0x181, 4) == 0
    bench.bus.devices[1].send_emergency(0x1000, 0x81)
    bench.take()
    assert bench.sync() == [(0x181, struct.pack("<hBhB", 40, 0, 10, 0x81))]
    bench.nmt(129, 1)
    assert bench.read(1, 0x1A00, 0) == 1


@pytest.mark.parametrize(
    ("entry", "code"),
    [
        (0x20020110, NO_MAPPING),  # no such object
        (0x20010510, NO_MAPPING),  # no such sub-index
        (0x10180420, NO_MAPPING),  # not for PDOs
        (0x20010108, NO_MAPPING),  # not its length
        (0x00020008, NO_MAPPING),  # a dummy that the node hasn't got
    ],
)
def test_unmappable_objects_are_refused(
    bench: Any, write_eds: Callable[..., Path], entry: int, code: int
) -> None:
    channels = [(0x2001, sub, 16, True) for sub in (1, 2, 3, 4)]
    bench.running(eds=write_eds(channels, [[]]), channels=FOUR)
    assert bench.sync() == []  # a PDO of nothing isn't sent
    assert bench.write(1, 0x1800, 1, OFF | 0x181, 4) == 0
    assert bench.write(1, 0x1A00, 1, entry, 4) == code
    assert bench.read(1, 0x1A00, 1) == 0


def test_more_than_a_pdo_holds_is_refused(bench: Any, write_eds: Callable[..., Path]) -> None:
    channels = [(0x2001, sub, 32, True) for sub in (1, 2, 3, 4)]
    bench.running(eds=write_eds(channels, [[]]), channels=FOUR)
    assert bench.write(1, 0x1800, 1, OFF | 0x181, 4) == 0
    for sub in (1, 2, 3):
        assert bench.write(1, 0x1A00, sub, 0x20010020 | sub << 8, 4) == 0
    assert bench.write(1, 0x1A00, 0, 3, 1) == TOO_LONG
    assert bench.write(1, 0x1A00, 0, 9, 1) == TOO_LONG
    assert bench.write(1, 0x1A00, 0, 4, 1) == NO_MAPPING  # the fourth entry is empty
    assert bench.write(1, 0x1A00, 0, 2, 1) == 0


@pytest.mark.parametrize("access", ["ro", "const"])
def test_a_fixed_mapping_stays(bench: Any, write_eds: Callable[..., Path], access: str) -> None:
    channels = [(0x2001, sub, 16, True) for sub in (1, 2, 3, 4)]
    bench.running(eds=write_eds(channels, [[(0x2001, 1, 16)]], access=access), channels=FOUR)
    assert bench.write(1, 0x1800, 1, OFF | 0x181, 4) == 0
    assert bench.write(1, 0x1A00, 0, 0, 1) == READ_ONLY
    assert bench.write(1, 0x1A00, 1, 0x20010210, 4) == READ_ONLY


def test_a_strict_node_changes_a_pdo_only_while_it_is_disabled(bench: Any) -> None:
    bench.running(1)
    bench.running(2, strict_pdo=True)
    for sub, value, size in ((2, 4, 1), (3, 5, 2), (5, 7, 2), (1, 0x3A2, 4)):
        assert bench.write(1, 0x1801, sub, value, size) == 0
        assert bench.write(2, 0x1801, sub, value, size) == NOT_NOW
    assert bench.write(2, 0x1801, 1, OFF | 0x282, 4) == 0
    for sub, value, size in ((2, 4, 1), (3, 5, 2), (5, 7, 2), (1, 0x3A2, 4)):
        assert bench.write(2, 0x1801, sub, value, size) == 0


def test_limits_of_the_eds_are_kept(bench: Any) -> None:
    bench.running()
    assert bench.write(1, 0x2100, 0, 2, 1) == 0x06090031


@pytest.mark.parametrize(
    ("channels", "expected"),
    [
        (tuple((0x6401, sub) for sub in (1, 2, 3, 5)), "0x6401:05"),
        (tuple((0x6401, sub) for sub in (1, 2, 3, 3)), "3 to 32 different"),
        (((0x6401, 1),), "3 to 32 different"),
    ],
)
def test_unsuitable_channels_are_refused(bench: Any, channels: Any, expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        bench.bus.add(1, channels=channels)


def test_an_eds_that_maps_too_much_is_refused(bench: Any, write_eds: Callable[..., Path]) -> None:
    channels = [(0x2001, sub, 32, True) for sub in (1, 2, 3, 4)]
    path = write_eds(channels, [[(0x2001, sub, 32) for sub in (1, 2, 3)]])
    with pytest.raises(ValueError, match=r"node\.eds: TPDO1 maps 96 bits"):
        bench.bus.add(1, eds=path, channels=FOUR)
    assert bench.bus.devices == {}


def test_an_eds_without_pdo_is_refused(bench: Any, write_eds: Callable[..., Path]) -> None:
    path = write_eds([(0x2001, sub, 16, True) for sub in (1, 2, 3, 4)], [])
    with pytest.raises(ValueError, match="no TPDO"):
        bench.bus.add(1, eds=path, channels=FOUR)


def test_the_librarys_own_master_maps_and_receives(write_eds: Callable[..., Path]) -> None:
    kinds = [(0x2001, sub, bits, True) for sub, bits in enumerate((16, 24, 16, 8), 1)]
    path = write_eds(kinds, [[(0x2001, 1, 16)]])
    with can.Bus("maps", interface="virtual") as side, can.Bus("maps", interface="virtual") as other:
        nodes = DeviceBus(side, lambda _: np.array([[-1, 70000, 3, -4]]))
        nodes.add(2, eds=path, channels=FOUR)
        network = canopen.Network(other)
        network.connect()
        try:
            remote = network.add_node(2, eds.load_eds(path, 2))
            nodes.start()
            tpdo = remote.tpdo[1]
            tpdo.read()
            tpdo.clear()
            for sub in (4, 2, 1, 3):
                tpdo.add_variable(0x2001, sub)
            tpdo.save()
            remote.nmt.state = "OPERATIONAL"
            for _ in range(50):
                network.sync.transmit()
                if tpdo.wait_for_reception(0.1) is not None:
                    break
            assert [variable.raw for variable in tpdo] == [-4, 70000, -1, 3]
        finally:
            nodes.stop()
            network.notifier.stop()
    assert nodes.bus_errors == nodes.rejected == 0


def test_kept_values_outlast_a_power_cycle(bench: Any) -> None:
    device = bench.running()
    device.write_object(0x1801, 1, OFF | 0x3F0, keep=True)
    device.write_object(0x1801, 2, 10)
    assert (device.read_object(0x1801, 1), device.read_object(0x1801, 2)) == (OFF | 0x3F0, 10)
    device.reboot()
    assert (device.read_object(0x1801, 1), device.read_object(0x1801, 2)) == (OFF | 0x3F0, 1)
