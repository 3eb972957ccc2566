"""Sensors without CANopen become contacts: a board that prints numbers, and a hand with raw CAN frames."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handtouch import connect, wire
from handtouch.config import load, shipped
from handtouch.hand import pad_network
from tests.starter import find_port, own_endpoints

ROOT = Path(__file__).parents[2]
CHANNEL = "239.74.163.2"
PERIOD_MS = 20.0
LONGEST_S = 90.0
MA_PER_UNIT = 0.01
DBC = """VERSION ""
NS_ :
BS_:
BU_: HAND
BO_ 300 TIP: 8 HAND
 SG_ x0 : 0|16@1- (1,0) [0|0] "" HAND
 SG_ xa : 16|16@1- (1,0) [0|0] "" HAND
 SG_ y0 : 32|16@1- (1,0) [0|0] "" HAND
 SG_ yb : 48|16@1- (1,0) [0|0] "" HAND
"""


class Bench:
    """The gripper of two_finger.toml, served by `handtouch node` on a bus of its own."""

    def __init__(self, folder: Path, endpoints: dict[str, str], prefix: list[str]) -> None:
        self.folder, self.endpoints, self._prefix = folder, endpoints, prefix
        self.options = f"options = {{ port = {find_port()} }}"
        self.bus = f'interface = "udp_multicast"\nchannel = "{CHANNEL}"\n{self.options}\n'
        text = shipped.path("two_finger.toml").read_text()
        urdf = shipped.path("two_finger.urdf")
        settings = "".join(f'{name} = "{endpoint}"\n' for name, endpoint in endpoints.items())
        for old, new in (
            ("two_finger.urdf", str(urdf)),
            ("[daemon]\n", f"[daemon]\nsupervise = false\n{settings}"),
            ("sync_period_ms = 10.0", f"sync_period_ms = {PERIOD_MS}"),
            (f'channel = "{CHANNEL}"', f'channel = "{CHANNEL}"\n{self.options}'),
        ):
            assert old in text
            text = text.replace(old, new)
        self.config = folder / "hand.toml"
        self.config.write_text(text)
        self._running: list[subprocess.Popen[bytes]] = []

    def write_node(self, tables: str) -> Path:
        """Write the file of a node on the hand's bus."""
        path = self.folder / "node.toml"
        path.write_text(f"[bus]\n{self.bus}\n{tables}")
        return path

    def start(self, *command: str, **options: Any) -> subprocess.Popen[bytes]:
        words = [*self._prefix, sys.executable, *command]
        with (self.folder / f"{len(self._running)}.txt").open("wb") as output:
            self._running.append(subprocess.Popen(words, **{"stdout": output, "stderr": output, **options}))
        return self._running[-1]

    def contacts(self, count: int) -> list[wire.Contact]:
        """Return the next updates with a valid position, of both fingers."""
        found: list[wire.Contact] = []
        end_s = time.monotonic() + LONGEST_S
        with connect("contact/*/*", endpoint=self.endpoints["live"], key="") as messages:
            while len(found) < count:
                assert time.monotonic() < end_s, [path.read_text() for path in self.folder.glob("*.txt")]
                message = messages.recv(1.0)
                if isinstance(message, wire.Contact) and message.position_status == "valid":
                    found.append(message)
        return found

    def end(self) -> None:
        for process in self._running:
            process.terminate()
        for process in self._running:
            process.wait(LONGEST_S)


@pytest.fixture
def bench(tmp_path: Path, network: list[str]) -> Iterator[Bench]:
    with own_endpoints() as endpoints:
        made = Bench(tmp_path, endpoints, network)
        yield made
        made.end()


def test_numbers_that_a_board_prints_become_contacts_on_links(bench: Bench) -> None:
    """The how-to's commands, with the shipped files."""
    shipped_node = (ROOT / "config" / "board_node.toml").read_text()
    node = bench.write_node(shipped_node[shipped_node.index("[source.board]") :])
    board = bench.start(str(ROOT / "examples" / "print_board.py"), stdout=subprocess.PIPE)
    assert board.stdout is not None
    with board.stdout:
        bench.start("-m", "handtouch", "node", str(node), stdin=board.stdout)
    bench.start("-m", "handtouch", "run", str(bench.config))
    found = bench.contacts(60)
    assert {contact.link for contact in found} == {"thumb_tip", "index_tip"}
    for contact in found:
        if contact.link == "thumb_tip":  # a plate of 30 mm, touched along its middle
            assert contact.position_m is not None
            x_m, y_m, _ = contact.position_m
            assert abs(x_m) < 0.008 if abs(y_m) < 0.001 else abs(x_m) < 0.001
        assert contact.force_n is not None
        assert 0.2 < contact.force_n < 5


def test_raw_can_frames_become_contacts_on_links(bench: Bench, tmp_path: Path) -> None:
    """A hand's own bus has its frames; here it is the same bus, between programs."""
    (tmp_path / "hand.dbc").write_text(DBC)
    node = bench.write_node(
        f'[source.hand]\nkind = "dbc"\nfile = "hand.dbc"\nrate_hz = {1e3 / PERIOD_MS}\n{bench.bus}'
        '[[pad]]\nname = "thumb_tip"\nnode_id = 1\nserial = 1\nsource = "hand"\n'
        f'ma_per_unit = {MA_PER_UNIT}\nchannels = ["x0", "xa", "y0", "yb"]\n'
    )
    sender = tmp_path / "hand.py"
    deployment = load(shipped.path("two_finger.toml"))
    pad = deployment.pads[0].pad
    network = pad_network(pad, deployment.sheets[pad.sheet])
    fractions = network.fractions(0.4 * network.a, 0.6 * network.b)
    counts = np.rint(fractions * 2.0 / MA_PER_UNIT).astype(int).tolist()
    sender.write_text(
        "import struct, time, can\n"
        f"bus = can.Bus(interface='udp_multicast', channel={CHANNEL!r}, {bench.options[12:-2]})\n"
        "while True:\n"
        f"    counts = {counts} if time.time() % 1 > 0.5 else [0] * 4\n"
        "    data = struct.pack('<4h', *counts)\n"
        "    bus.send(can.Message(arbitration_id=300, data=data, is_extended_id=False))\n"
        f"    time.sleep({1e-3 * PERIOD_MS})\n"
    )
    bench.start(str(sender))
    bench.start("-m", "handtouch", "node", str(node))
    bench.start("-m", "handtouch", "run", str(bench.config))
    found = bench.contacts(10)
    assert {contact.link for contact in found} == {"thumb_tip"}
    expected_m = (0.4 * network.a, 0.6 * network.b)
    for contact in found:
        assert contact.pad_m == pytest.approx(expected_m, abs=0.5e-3)
