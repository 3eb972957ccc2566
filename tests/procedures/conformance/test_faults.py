"""Every fault switch of a node that is observable on the bus is named by a check."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest

from handtouch.device import Device, LineFaults
from handtouch.device.faults import FaultSwitch, FaultSwitches
from handtouch.procedures.conformance import NodeReport

MS = 1_000_000
NODE = 5

Apply = Callable[[Any, Device], None]


def _set(name: str, value: Any) -> Apply:
    return lambda _, device: setattr(device, name, value)


def _stick(line: Any, device: Device) -> None:
    line.at(200, lambda: device.stick_channel(2))


CASES: dict[str, tuple[Apply, str]] = {
    "send_heartbeat = False": (_set("send_heartbeat", False), "heartbeat.period"),
    "heartbeat_state = 99": (_set("heartbeat_state", 99), "heartbeat.format"),
    "heartbeat_state = 5": (_set("heartbeat_state", 5), "nmt.preoperational"),
    "send_data = False": (_set("send_data", False), "pdo.complete"),
    "frame_bytes = 6": (_set("frame_bytes", 6), "pdo.length"),
    "line = LineFaults(lost=0.1)": (_set("line", LineFaults(lost=0.1)), "pdo.complete"),
    "line = LineFaults(lost_every=10)": (_set("line", LineFaults(lost_every=10)), "pdo.complete"),
    "line = LineFaults(late_ns=4_000_000)": (_set("line", LineFaults(late_ns=4 * MS)), "pdo.delay"),
    "line = LineFaults(duplicate=0.2)": (_set("line", LineFaults(duplicate=0.2)), "pdo.complete"),
    "line = LineFaults(corrupt=0.2)": (_set("line", LineFaults(corrupt=0.2)), "channels.noise"),
    "line = LineFaults(lost=0.2, data_only=False)": (
        _set("line", LineFaults(lost=0.2, data_only=False)),
        "sdo.response",
    ),
    "line = LineFaults(duplicate=0.2, data_only=False)": (
        _set("line", LineFaults(duplicate=0.2, data_only=False)),
        "sdo.single",
    ),
    "line = LineFaults(corrupt=0.2, data_only=False)": (
        _set("line", LineFaults(corrupt=0.2, data_only=False)),
        "sdo.protocol",
    ),
    "stuck_counts = {0: 7}": (_set("stuck_counts", {0: 7}), "channels.noise"),
    "stick_channel(2)": (_stick, "channels.noise"),
    "saturate_channels()": (lambda _, device: device.saturate_channels(), "channels.range"),
    "sdo.frozen = True": (lambda _, device: setattr(device.sdo, "frozen", True), "sdo.response"),
    "sdo.fail[0x1018, 4] = 0x06090011": (
        lambda _, device: device.sdo.fail.update({(0x1018, 4): 0x06090011}),
        "identity.read",
    ),
    "sdo.fail[0x1001, 0] = None": (
        lambda _, device: device.sdo.fail.update({(0x1001, 0): None}),
        "objects.read",
    ),
    "sdo.fail_write[0x1801, 1] = 0x06010002": (
        lambda _, device: device.sdo.fail_write.update({(0x1801, 1): 0x06010002}),
        "pdo.configure",
    ),
    "sdo.fail_write[0x1017, 0] = 0x08000022": (
        lambda _, device: device.sdo.fail_write.update({(0x1017, 0): 0x08000022}),
        "objects.write",
    ),
    "sdo.fail_nth[20] = None": (lambda _, device: device.sdo.fail_nth.update({20: None}), "sdo.response"),
    'sdo.garble = "toggle"': (lambda _, device: setattr(device.sdo, "garble", "toggle"), "sdo.protocol"),
    'sdo.garble = "object"': (lambda _, device: setattr(device.sdo, "garble", "object"), "sdo.protocol"),
    'sdo.garble = "noise"': (lambda _, device: setattr(device.sdo, "garble", "noise"), "sdo.protocol"),
    "unplug()": (lambda _, device: device.unplug(), "sdo.response"),
    "reboot()": (lambda line, device: line.at(1500, device.reboot), "nmt.no_reboot"),
    "brown_out(50 ms)": (
        lambda line, device: line.at(1500, lambda: device.brown_out(50 * MS)),
        "nmt.no_reboot",
    ),
    "start_boot_loop(700 ms)": (lambda _, device: device.start_boot_loop(700 * MS), "nmt.no_reboot"),
    "bus_off(300 ms)": (
        lambda line, device: line.at(800, lambda: device.bus_off(300 * MS)),
        "heartbeat.period",
    ),
    "replace_device(9)": (
        lambda line, device: line.at(400, lambda: device.replace_device(9)),
        "identity.read",
    ),
    "add_twin(serial=6)": (
        lambda line, _: line.bus.add_twin(NODE, serial=6).plug(),
        "sdo.single",
    ),
    "send_emergency(0x3100)": (
        lambda line, device: line.at(300, lambda: device.send_emergency(0x3100, 4)),
        "emcy.none",
    ),
    "latch_error(0x5000)": (lambda _, device: device.latch_error(0x5000), "nmt.operational"),
    "start_babbling(500 Hz)": (lambda _, device: device.start_babbling(500.0), "pdo.without_sync"),
    "write_object(0x1018, 4, 0, keep=True)": (
        lambda _, device: device.write_object(0x1018, 4, 0, keep=True),
        "identity.serial",
    ),
}
"""Switch -> how it is set, and the check that names it."""

NOT_ON_THE_BUS = {"open_electrodes", "wiring"}
"""Switches that show nothing without a press; `handtouch commission` determines the wiring."""


@pytest.mark.parametrize("switch", CASES)
def test_a_fault_switch_is_named_by_its_check(
    switch: str, line: Any, check: Callable[..., NodeReport]
) -> None:
    apply, name = CASES[switch]
    device = line.add()
    apply(line, device)
    line.frames.clear()
    report = check()
    failed = {result.name for result in report.failures}
    assert name in failed, [(result.name, result.detail) for result in report.results]


def test_the_table_has_every_fault_switch() -> None:
    switches = {name for name, value in vars(FaultSwitches).items() if isinstance(value, FaultSwitch)}
    switches |= {"sdo.frozen", "sdo.fail", "sdo.fail_write", "sdo.fail_nth", "sdo.garble", "add_twin"}
    switches |= {"unplug", "reboot", "brown_out", "bus_off", "replace_device", "saturate_channels"}
    switches |= {"stick_channel", "send_emergency", "latch_error", "start_boot_loop", "start_babbling"}
    named = {re.split(r" = |\(|\[", case)[0] for case in CASES} | NOT_ON_THE_BUS
    assert named == switches | {"write_object"}


def test_an_open_electrode_is_named_by_a_press(line: Any, check: Callable[..., NodeReport]) -> None:
    device = line.add()
    device.open_electrodes = {3}
    report = check(operator=Presser(line, device))
    assert [(result.name, result.detail[:9]) for result in report.failures] == [
        ("operator.press", "channel 4")
    ]


def test_a_press_and_a_power_cycle_of_a_good_node_pass(line: Any, check: Callable[..., NodeReport]) -> None:
    device = line.add()
    report = check(operator=Presser(line, device))
    assert not report.failures
    for name in ("operator.press", "operator.power_cycle", "operator.error"):
        assert report.verdict(name) == "passed"


def test_an_error_that_is_never_cleared_is_named(line: Any, check: Callable[..., NodeReport]) -> None:
    device = line.add()
    operator = Presser(line, device)
    operator.clears = False
    report = check(operator=operator)
    assert [(result.name, result.detail) for result in report.failures] == [
        ("operator.error", "no EMCY 0x0000 after the error was removed")
    ]


class Presser:
    """An operator who does what is requested half a second later."""

    def __init__(self, line: Any, device: Device) -> None:
        self.line, self.device = line, device
        self.clears = True

    def print_line(self, text: str, style: str = "") -> None:  # noqa: ARG002
        if "power" in text:
            self.line.at(500, lambda: self.device.brown_out(200 * MS))
        elif text.startswith("Cause"):
            self.line.at(500, lambda: self.device.send_emergency(0x3200, 5))
        elif text.startswith("Remove the error."):
            if self.clears:
                self.line.at(500, lambda: self.device.send_emergency(0))
        elif text.startswith("Press"):
            self.line.at(500, lambda: self.line.counts.__setitem__(slice(None), (900, 700, 800, 600)))
        else:
            self.line.at(500, lambda: self.line.counts.fill(0))

    def read_key(self) -> None:
        return None
