"""Faults of nodes in a scenario: each is played at its time, on its node, and removed."""

from __future__ import annotations

from typing import Any

import can
import numpy as np
import pytest

from handtouch.config.problems import ConfigError
from handtouch.device import DeviceBus
from handtouch.simulate.scenario import Scenario

TOUCH = """
[[touch]]
link = "tip"
from_s = 0.1
duration_s = 1.0
path = [[0.4, 0.6]]
force_n = [1.0]
"""
MS = 1_000_000


class Bench:
    """One node on a bus that keeps the frames sent, and simulated time."""

    def __init__(self) -> None:
        self.t_ns = 0
        self.sent: list[tuple[int, bytes]] = []
        self.nodes = DeviceBus(self, lambda _: np.zeros((1, 4), np.int64), clock=lambda: self.t_ns)  # type: ignore[arg-type]
        self.device = self.nodes.add(5)
        self.device.plug()
        self.run(1)
        self.nmt(1)

    def send(self, message: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        self.sent.append((message.arbitration_id, bytes(message.data)))

    def recv(self, timeout: float | None = None) -> None:
        """Return nothing: frames are passed to the node directly."""

    def nmt(self, command: int) -> None:
        self.nodes.handle_frame(
            can.Message(arbitration_id=0, data=[command, 5], is_extended_id=False), self.t_ns
        )

    def run(self, ms: int) -> None:
        for _ in range(ms):
            self.t_ns += MS
            self.nodes.advance(self.t_ns)

    def played(self, keys: str) -> Any:
        table = f'{TOUCH}\n[[node_fault]]\nlink = "tip"\nfrom_s = 1.0\nuntil_s = 2.0\n{keys}'
        (fault,) = Scenario.parse(table).node_faults
        self.sent.clear()
        return fault


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_emcy_is_sent_and_reset(bench: Bench) -> None:
    fault = bench.played('kind = "emcy"\ncode = 0x4210\nregister_bits = 9')
    fault.begin(bench.device)
    assert bench.device.read_object(0x1001, 0) == 9
    assert [bench.device.read_object(0x1003, sub) for sub in (0, 1)] == [1, 0x4210]
    fault.end(bench.device)
    assert bench.sent == [(0x85, bytes.fromhex("1042090000000000")), (0x85, bytes(8))]
    assert bench.device.state == "OPERATIONAL"


def test_refusing_node_can_be_started_after_the_end_only(bench: Bench) -> None:
    fault = bench.played('kind = "refuses_operational"')
    fault.begin(bench.device)
    assert bench.device.state == "PRE-OPERATIONAL"
    for command in (1, 130, 1, 129, 1):
        bench.nmt(command)
        assert bench.device.state == "PRE-OPERATIONAL"
    assert bench.device.read_object(0x1001, 0) == 1
    fault.end(bench.device)
    bench.nmt(1)
    assert bench.device.state == "OPERATIONAL"


def test_boot_loop_boots_at_its_period_until_the_end(bench: Bench) -> None:
    fault = bench.played('kind = "boot_loop"\nperiod_s = 0.1')
    fault.begin(bench.device)
    bench.run(450)
    assert bench.sent.count((0x705, b"\0")) == 5
    fault.end(bench.device)
    bench.run(450)
    assert bench.sent.count((0x705, b"\0")) == 5


def test_illegal_state_is_in_the_heartbeats(bench: Bench) -> None:
    bench.device.write_object(0x1017, 0, 100)
    fault = bench.played('kind = "illegal_nmt_state"\nstate = 42')
    fault.begin(bench.device)
    bench.run(110)
    fault.end(bench.device)
    bench.run(110)
    assert bench.sent == [(0x705, bytes([42])), (0x705, bytes([5]))]


def test_changed_setting_stays_until_it_is_written_again(bench: Bench) -> None:
    fault = bench.played('kind = "changed_setting"\nchanged_object = "0x1801:2"\nvalue = 255')
    fault.begin(bench.device)
    fault.end(bench.device)
    assert bench.device.read_object(0x1801, 2) == 255


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ('kind = "no_such"', "kind"),
        ('kind = "emcy"\ncode = 0', "code"),
        ('kind = "emcy"\nuntil_s = 0.5', "until_s = 0.5 must come after from_s = 1.0"),
        ('kind = "changed_setting"\nchanged_object = "transmission type"', "is no object"),
        ('kind = "boot_loop"\nperiod_s = 0.0', "period_s"),
    ],
)
def test_mistakes_are_named(keys: str, expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        Scenario.parse(f'{TOUCH}\n[[node_fault]]\nlink = "tip"\nfrom_s = 1.0\n{keys}')


def test_link_without_a_pad_is_named() -> None:
    scenario = Scenario.parse(f'{TOUCH}\n[[node_fault]]\nkind = "emcy"\nlink = "elbow"\nfrom_s = 1.0')
    with pytest.raises(ConfigError, match=r"\[\[node_fault\]\] 1: link = \"elbow\": carries no pad"):
        scenario.check_links(["tip"])
