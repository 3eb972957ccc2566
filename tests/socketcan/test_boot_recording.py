"""The boot in docs/firmware.md is that of a real daemon on SocketCAN, too."""

from __future__ import annotations

import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import can
import numpy as np
import pytest

from handtouch.config import shipped
from handtouch.device import Device, DeviceBus
from tests.minimal_node import minimal_eds
from tests.starter import Starter

pytestmark = [pytest.mark.socketcan, pytest.mark.timeout(240)]

PAGE = Path(__file__).parents[2] / "docs" / "firmware.md"
LONGEST_S = 60.0
MAX_BOOTS = 5
NODE, SERIAL = 1, 101
BOOT_UP, START = (0x701, b"\0"), (0x000, bytes((1, NODE)))
PROBE = re.compile(rb"[\x40\x43]\x00\x10\x00")
Frame = tuple[int, bytes]


def recorded() -> list[Frame]:
    """The frames of the page from the boot-up message to NMT start."""
    block = PAGE.read_text(encoding="utf-8").split("<!-- recording: boot -->")[1].split("```")[1]
    lines = re.findall(r"^([0-9A-F]{3})   \[\d\]  ((?:[0-9A-F]{2} ?)*)", block, re.MULTILINE)
    frames = [(int(can_id, 16), bytes.fromhex(data)) for can_id, data in lines]
    return frames[: frames.index(START) + 1]


@pytest.fixture
def device(tmp_path: Path) -> Iterator[Device]:
    (tmp_path / "minimal.eds").write_text(minimal_eds())
    with can.Bus("vcan0", interface="socketcan", ignore_config=True) as bus:
        nodes = DeviceBus(bus, lambda _: np.zeros((1, 4), np.int64))
        device = nodes.add(NODE, eds=tmp_path / "minimal.eds", serial=SERIAL)
        nodes.start()
        device.unplug()
        yield device
        nodes.stop()


@pytest.fixture
def daemon(tmp_path: Path, endpoints: dict[str, str], host_starter: Starter) -> Iterator[None]:
    settings = "".join(f'{stream} = "{endpoint}"\n' for stream, endpoint in endpoints.items())
    text = shipped.path("two_finger.toml").read_text()
    text = text.replace("[daemon]\n", f"[daemon]\nsupervise = false\n{settings}")
    text = text.replace("[node.four_channel]", '[node.four_channel]\neds = "minimal.eds"')
    text = text.replace("\nserial = 1\n", f"\nserial = {SERIAL}\n")
    (tmp_path / "hand.toml").write_text(text)
    shutil.copy(shipped.path("two_finger.urdf"), tmp_path)
    with (tmp_path / "printed.txt").open("w") as output:
        arguments = ["run", str(tmp_path / "hand.toml"), "--bus", "can0=socketcan:vcan0"]
        process = host_starter.start(arguments, output)
    yield
    process.terminate()
    process.wait(LONGEST_S)


def test_a_daemon_boots_a_node_as_recorded(device: Device, daemon: None) -> None:  # noqa: ARG001
    """Compared from the boot-up message to NMT start, without probes; a boot with a timeout is repeated."""
    boots = []
    with can.Bus("vcan0", interface="socketcan", ignore_config=True) as witness:
        _wait_for_sync(witness)
        for _ in range(MAX_BOOTS):
            boots.append(_boot(device, witness))
            if boots[-1] == recorded():
                return
    raise AssertionError(boots)


def _wait_for_sync(witness: can.BusABC) -> None:
    end_s = time.monotonic() + LONGEST_S
    while time.monotonic() < end_s:
        message = witness.recv(1.0)
        if message is not None and message.arbitration_id == 0x080:
            return
    raise AssertionError("the daemon sends no SYNC")


def _boot(device: Device, witness: can.BusABC) -> list[Frame]:
    """Power-cycle the node; the frames to and from it up to NMT start."""
    device.reboot()
    frames: list[Frame] = []
    end_s = time.monotonic() + LONGEST_S
    while time.monotonic() < end_s:
        message = witness.recv(1.0)
        if message is None or message.is_remote_frame:
            continue
        frame = (message.arbitration_id, bytes(message.data))
        if frame == BOOT_UP:
            frames = [frame]
        elif frames and _concerns_boot(frame):
            frames.append(frame)
            if frame == START:
                break
    return frames


def _concerns_boot(frame: Frame) -> bool:
    can_id, data = frame
    if can_id in (0x580 + NODE, 0x600 + NODE):
        return not PROBE.match(data)
    return can_id == 0 and data[1:] == bytes((NODE,))
