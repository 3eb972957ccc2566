"""Node guarding (CiA 301), for nodes without a heartbeat."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

FOUR = tuple((0x2001, sub) for sub in (1, 2, 3, 4))
GUARDED = (
    "[100C]\nParameterName=Guard time\nDataType=0x0006\nAccessType=rw\nDefaultValue=100\n"
    "[100D]\nParameterName=Life time factor\nDataType=0x0005\nAccessType=rw\nDefaultValue={factor}\n"
)


@pytest.fixture
def guarded(bench: Any, write_eds: Callable[..., Path]) -> Callable[..., Any]:
    """Node 1, operational, with node guarding and as much as `factor` says."""

    def make(factor: int = 0, more: str = "") -> Any:
        text = GUARDED.format(factor=factor) + more
        path = write_eds([(*c, 16, True) for c in FOUR], [[(*c, 16) for c in FOUR]], more=text)
        return bench.running(eds=path, channels=FOUR)

    return make


def ask(bench: Any, node_id: int = 1) -> list[int]:
    sent = bench.send(0x700 + node_id, bytes(1), remote=True)
    assert all(identifier == 0x700 + node_id and len(data) == 1 for identifier, data in sent)
    return [data[0] for _, data in sent]


def test_a_guarded_node_reports_its_state_and_toggles(bench: Any, guarded: Callable[..., Any]) -> None:
    guarded()
    assert [ask(bench) for _ in range(3)] == [[0x05], [0x85], [0x05]]
    bench.nmt(128, 1)
    assert ask(bench) == [0xFF]
    bench.nmt(2, 1)
    assert ask(bench) == [0x04]


def test_the_toggle_bit_starts_at_0_after_a_reset(bench: Any, guarded: Callable[..., Any]) -> None:
    guarded()
    ask(bench)
    assert bench.nmt(130, 1) == [(0x701, b"\0")]
    assert ask(bench) == [0x7F]


def test_other_nodes_do_not_respond(bench: Any, guarded: Callable[..., Any]) -> None:
    node = guarded()
    bench.running(2)  # has a heartbeat
    assert ask(bench, 2) == ask(bench, 3) == []
    assert bench.send(0x181, remote=True) == bench.send(0x80, remote=True) == []
    node.send_heartbeat = False
    assert ask(bench) == []
    node.send_heartbeat = True
    node.unplug()
    assert ask(bench) == []


def test_a_node_with_both_is_guarded_while_its_heartbeat_is_off(
    bench: Any, guarded: Callable[..., Any]
) -> None:
    guarded(more="[1017]\nParameterName=Heartbeat\nDataType=0x0006\nAccessType=rw\nDefaultValue=0\n")
    assert ask(bench) == [0x05]
    bench.write(1, 0x1017, 0, 100, 2)
    assert ask(bench) == []


def test_an_expired_life_time_sends_an_emergency_and_stops_pdos(
    bench: Any, guarded: Callable[..., Any]
) -> None:
    node = guarded(factor=3)
    bench.run(1000)  # life guarding starts with the first request
    assert node.state == "OPERATIONAL"
    ask(bench)
    bench.run(299)
    ask(bench)
    assert bench.run(299) == []
    assert bench.run(1) == [(bench.t_ns // 10**6, (0x81, b"\x30\x81\x11\0\0\0\0\0"))]
    assert node.state == "PRE-OPERATIONAL"
