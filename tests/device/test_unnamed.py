"""A node without an id responds to LSS only, and boots when it gets one (CiA 305)."""

from __future__ import annotations

import struct
from typing import Any

import pytest
from canopen.objectdictionary import import_od

from handtouch.canbus.cia301 import LSS_REQUEST, LSS_RESPONSE
from handtouch.canbus.find.lss import LssMaster
from handtouch.config import shipped


class _Exchange:
    """An LSS master's way to the bench."""

    def __init__(self, bench: Any) -> None:
        self._bench, self._answers = bench, list[bytes]()
        self.others: list[tuple[int, bytes]] = []

    def __call__(self, request: bytes | None, wait_s: float) -> bytes | None:  # noqa: ARG002
        if request is not None:
            self._answers.clear()
            for identifier, data in self._bench.send(LSS_REQUEST, request):
                if identifier == LSS_RESPONSE:
                    self._answers.append(data)
                else:
                    self.others.append((identifier, data))
        return self._answers.pop(0) if self._answers else None


@pytest.fixture
def exchange(bench: Any) -> _Exchange:
    return _Exchange(bench)


@pytest.fixture
def master(bench: Any, exchange: _Exchange) -> LssMaster:
    return LssMaster(exchange, clock=lambda: bench.t_ns)


def test_without_an_id_it_responds_to_lss_only(bench: Any, master: LssMaster) -> None:
    node = bench.bus.add_unconfigured(serial=77)
    assert master.scan() == []  # not plugged in yet
    node.plug()
    assert bench.take() == bench.nmt(1, 0) == bench.sync() == bench.run(500) == []
    (address,) = master.scan()
    assert (address.product_code, address.revision, address.serial) == (0x401, 0x10000, 77)


def test_the_shipped_eds_states_that_its_node_supports_lss(bench: Any, master: LssMaster) -> None:
    eds = shipped.path("handtouch-node.eds")
    bench.bus.add_unconfigured(eds=str(eds), serial=77).plug()
    assert len(master.scan()) == 1
    assert import_od(str(eds)).device_information.LSS_supported


def test_it_boots_with_the_assigned_id_and_measures(
    bench: Any, exchange: _Exchange, master: LssMaster
) -> None:
    bench.bus.add(1)
    node = bench.bus.add_unconfigured(serial=77)
    node.plug()
    (address,) = master.scan()
    assert master.assign_node_id(address, 9) == ""
    assert exchange.others == [(0x709, b"\0")]
    assert bench.bus.devices[9] is node.device
    bench.counts[1] = (1, 2, 3, 4)
    bench.nmt(1, 9)
    assert bench.sync() == [(0x289, struct.pack("<4h", 1, 2, 3, 4))]
    assert bench.read(9, 0x1018, 4) == 77
    assert master.scan() == []


@pytest.mark.parametrize("stores", [True, False])
def test_after_a_power_cycle_it_has_the_stored_id(bench: Any, master: LssMaster, stores: bool) -> None:
    node = bench.bus.add_unconfigured(serial=77)
    node.lss.can_store = stores
    node.plug()
    assert bool(master.assign_node_id(master.scan()[0], 9)) is not stores
    node.unplug()
    bench.take()
    assert 9 not in bench.bus.devices
    assert bench.nmt(129, 9) == []
    node.plug()
    assert bench.take() == ([(0x709, b"\0")] if stores else [])
    assert len(master.scan()) == (not stores)


@pytest.mark.parametrize("addressed", [9, 0])
def test_a_changed_id_is_used_after_a_reset(bench: Any, master: LssMaster, addressed: int) -> None:
    node = bench.bus.add_unconfigured(serial=77)
    node.plug()
    (address,) = master.scan()
    master.assign_node_id(address, 9)
    master.assign_node_id(address, 10)
    assert list(bench.bus.devices) == [9]
    assert bench.nmt(130, addressed) == [(0x70A, b"\0")]
    assert list(bench.bus.devices) == [10]


def test_several_nodes_are_found_and_get_ids_one_by_one(bench: Any, master: LssMaster) -> None:
    nodes = [bench.bus.add_unconfigured(serial=1000 - 7 * n) for n in range(8)]
    for node in nodes:
        node.plug()
    found = master.scan()
    assert sorted(address.serial for address in found) == sorted(1000 - 7 * n for n in range(8))
    for node_id, address in enumerate(found, 1):
        master.assign_node_id(address, node_id)
    assert sorted(bench.bus.devices) == list(range(1, 9))
    assert {device.serial for device in bench.bus.devices.values()} == {a.serial for a in found}


def test_an_id_in_use_makes_two_nodes_with_one_id(bench: Any, master: LssMaster) -> None:
    bench.running(9, serial=1)
    node = bench.bus.add_unconfigured(serial=2)
    node.plug()
    master.assign_node_id(master.scan()[0], 9)
    assert [data[4] for _, data in bench.request(9, b"\x40\x18\x10\x04")] == [1, 2]
    node.unplug()
    assert [data[4] for _, data in bench.request(9, b"\x40\x18\x10\x04")] == [1]


def test_a_malformed_request_is_counted_and_dropped(bench: Any) -> None:
    node = bench.bus.add_unconfigured(serial=2)
    node.plug()
    assert bench.send(LSS_REQUEST, b"\x04") == []
    assert node.lss.rejected == 1
