"""The ground under the SocketCAN tests: python-can and can-utils meet on a real bus."""

from __future__ import annotations

import subprocess

import can
import pytest

pytestmark = pytest.mark.socketcan


def test_a_frame_from_can_utils_arrives_in_python() -> None:
    with can.Bus(interface="socketcan", channel="vcan0") as bus:
        subprocess.run(["cansend", "vcan0", "285#0100020003000400"], check=True, timeout=10)
        message = bus.recv(timeout=10)
    assert message is not None
    assert (message.arbitration_id, message.is_extended_id) == (0x285, False)
    assert message.data == bytes([1, 0, 2, 0, 3, 0, 4, 0])


def test_a_frame_from_python_arrives_in_candump() -> None:
    with (
        can.Bus(interface="socketcan", channel="vcan1") as bus,
        subprocess.Popen(
            ["candump", "-L", "-n", "1", "-T", "10000", "vcan1"], stdout=subprocess.PIPE, text=True
        ) as candump,
    ):
        message = can.Message(arbitration_id=0x80, is_extended_id=False, data=b"\x01")
        while candump.poll() is None:  # until candump, which says nothing when ready, has seen one
            bus.send(message)
            try:
                candump.wait(0.05)
            except subprocess.TimeoutExpired:
                continue
        assert candump.stdout is not None
        assert candump.stdout.read().split()[-2:] == ["vcan1", "080#01"]
