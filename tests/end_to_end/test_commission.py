"""`handtouch commission` as a process, on a bus with a hand wired differently from its deployment file.

Run as a program, this file simulates that hand's nodes and makes the presses read from standard input.
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import os
import pty
import random
import re
import signal
import struct
import subprocess
import sys
import termios
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch import config
from handtouch.canbus.bus.port import open_bus
from handtouch.config.tables import SIDE_ELECTRODES
from handtouch.device import DeviceBus
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS

REQUESTED = {
    "anywhere": (0.5, 0.5),
    "x0": (0.15, 0.5),
    "xa": (0.85, 0.5),
    "y0": (0.5, 0.15),
    "yb": (0.5, 0.85),
}
FORCE_RANGES_N = {"hard": (0.8, 4.0), "gently": (0.3, 0.5)}  # the hard presses saturate some pads
MAX_OFFSET = 0.15  # greatest offset of a press from its requested position, of a side
PROMPT = re.compile(r"\[\d+/\d+\] right/(\w+): press (?:it (anywhere)|near electrode (\w+))")

pytestmark = pytest.mark.timeout(400)


class PressableHand:
    """The nodes of a deployment; `press` and `release` determine the next samples."""

    def __init__(self, deployment: config.Deployment, seed: int) -> None:
        chance = random.Random(seed)
        pads = deployment.hands[0].pads
        touches: list[dict[str, Any]] = []
        self._times: dict[tuple[str, str, str], float] = {}
        for pad in pads:
            for near, hard in itertools.product(REQUESTED, FORCE_RANGES_N):
                place = [
                    min(max(c + chance.uniform(-MAX_OFFSET, MAX_OFFSET), 0.03), 0.97) for c in REQUESTED[near]
                ]
                self._times[pad.link, near, hard] = len(touches) + 0.5
                touches.append(
                    {
                        "link": pad.link,
                        "from_s": float(len(touches)),
                        "duration_s": 0.95,
                        "path": [place],
                        "force_n": [chance.uniform(*FORCE_RANGES_N[hard])],
                    }
                )
        scenario = Scenario.model_validate({"touch": touches})
        self._hand = VirtualHand(deployment, scenario, WORLDS["default"].only("parts", "contacts").draw(seed))
        self._idle_s = self._now_s = len(touches) + 10.0
        self._bus = open_bus(deployment.buses[0])
        self.nodes = DeviceBus(self._bus, self._sample)
        for pad in pads:
            device = self.nodes.add(pad.node_id, serial=pad.serial)
            device.wiring = tuple(map(SIDE_ELECTRODES.index, pad.electrodes))
        self.nodes.start()

    def press(self, link: str, near: str, hard: str) -> None:
        self._now_s = self._times[link, near, hard]

    def release(self) -> None:
        self._now_s = self._idle_s

    def _sample(self, t_ns: int) -> NDArray[np.int64]:
        return self._hand.sample(self._now_s + t_ns % 100_000_000 * 1e-9)  # noise is another at every time


def serve(path: str, bus: str, seed: str) -> None:
    """Press what standard input says, "LINK NEAR HOW" or "release", until it ends."""
    hand = PressableHand(config.with_bus(config.load(path), bus), int(seed))
    print("ready", flush=True)
    for line in sys.stdin:
        words = line.split()
        if words == ["release"]:
            hand.release()
        else:
            hand.press(*words)


def scramble(text: str, seed: int) -> tuple[str, str]:
    """Return a deployment file with many wrong keys, and the correct one."""
    chance = random.Random(seed)
    head, *blocks = re.split(r"(?m)^(?=\[\[hand\.pad\]\])", text)
    kind = 'node = "four_channel" # the kind\n'
    ids = [found[1] for block in blocks if (found := re.search(r"node_id = (\w+)", block))]
    serials = [found[1] for block in blocks if (found := re.search(r"serial = (\d+)", block))]
    other_ids, other_serials = chance.sample(ids, len(ids)), chance.sample(serials, len(serials))
    wrong, right = [head], [head]
    for number, block in enumerate(blocks):
        block = block.replace('node = "four_channel"\n', kind)
        block = block.replace(f"= {ids[number]}\n", f"= {ids[number]} # as printed on it\n")
        guessed = number % 3 == 0  # the file has some order
        order, guess = chance.sample(SIDE_ELECTRODES, 4), chance.sample(SIDE_ELECTRODES, 4)
        stated = guessed or order != list(SIDE_ELECTRODES)
        right.append(block.replace(kind, kind + _key(order)) if stated else block)
        block = block.replace(f"= {ids[number]} ", f"= {other_ids[number]} ")
        block = block.replace(f"serial = {serials[number]}", f"serial = {other_serials[number]}")
        if number % 5 == 1:  # the file has no serial number
            block = re.sub(r"serial = \d+\n", "", block)
        wrong.append(block.replace(kind, kind + _key(guess)) if guessed else block)
    return "".join(wrong), "".join(right)


def _key(order: Sequence[str]) -> str:
    return f"electrodes = [{', '.join(f'{chr(34)}{name}{chr(34)}' for name in order)}]\n"


def first_pads(text: str, count: int) -> str:
    """Return the deployment with its first pads only."""
    return "".join(re.split(r"(?m)^(?=\[\[hand\.pad\]\])", text)[: count + 1])


class Presser:
    """The nodes in a separate process, and a simulated user who follows the printed prompts."""

    def __init__(self, rig: Any, truth: Path, seed: int) -> None:
        self._how = "hard"
        command = [*rig.command()[:-2], __file__, str(truth), *rig.bus, str(seed)]
        self._nodes = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._nodes.stdout is not None
        assert self._nodes.stdout.readline() == "ready\n"

    def follow(self, line: str) -> None:
        """Follow a prompt."""
        if prompt := PROMPT.search(line):
            self.do(f"{prompt[1]} {prompt[2] or prompt[3]} {self._how}")
        elif "let go" in line:
            self._how = "gently" if "more lightly" in line else "hard"
            self.do("release")

    def do(self, command: str) -> None:
        assert self._nodes.stdin is not None
        print(command, file=self._nodes.stdin, flush=True)

    def close(self) -> None:
        assert self._nodes.stdin is not None
        assert self._nodes.stdout is not None
        self._nodes.stdin.close()
        self._nodes.wait(30)
        self._nodes.stdout.close()


@contextlib.contextmanager
def pressed(rig: Any, truth: str, seed: int = 5) -> Iterator[Presser]:
    path = rig.folder / "truth.toml"
    path.write_text(truth)
    presser = Presser(rig, path, seed)
    try:
        yield presser
    finally:
        presser.close()


def commission(rig: Any, presser: Presser, *arguments: str, stop_at: str = "") -> tuple[int, str]:
    """Return exit status and output; interrupted at a line with `stop_at`."""
    command = rig.command("commission", str(rig.config), "--bus", rig.bus[0], *arguments)
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert process.stdin is not None
    assert process.stdout is not None
    printed = []
    with process:
        for line in process.stdout:
            printed.append(line)
            if stop_at and stop_at in line:
                process.send_signal(signal.SIGINT)
            else:
                presser.follow(line)
    return process.wait(), "".join(printed)


def commission_in_terminal(rig: Any, presser: Presser, *arguments: str) -> tuple[int, str]:
    """Do the same on a pseudo-terminal, answering every question with Enter."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(
        theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 400, 0, 0)
    )  # so that lines aren't wrapped
    command = rig.command("commission", str(rig.config), "--bus", rig.bus[0], *arguments)
    process = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs)
    os.close(theirs)
    printed = rest = ""
    with contextlib.suppress(OSError):  # at the end of a pseudo-terminal
        while data := os.read(ours, 4096):
            printed += data.decode(errors="replace")
            *lines, rest = (rest + data.decode(errors="replace")).split("\n")
            for line in lines:
                presser.follow(line)
                if "Enter: accept as swapped" in line:
                    os.write(ours, b"\n")
    os.close(ours)
    return process.wait(), printed


def test_randomly_wired_hand_is_commissioned_and_only_its_lines_change(rig: Any) -> None:
    wrong, right = scramble(first_pads(rig.config.read_text(), 4), seed=3)
    rig.config.write_text(wrong)
    truth, folder = config.parse(right), rig.folder
    with pressed(rig, right) as presser:
        status, printed = commission(rig, presser, "--yes")
    assert status == 0, printed
    found = config.load(rig.config)
    assert [pad.link for pad in found.hands[0].pads] == [pad.link for pad in truth.hands[0].pads]
    for pad, true in zip(found.hands[0].pads, truth.hands[0].pads, strict=True):
        assert (pad.node_id, pad.serial, pad.electrodes) == (true.node_id, true.serial, true.electrodes)
    assert found == truth
    shown = [line for line in printed.splitlines() if re.match(r"[-+](?!--|\+\+)", line)]
    assert shown
    assert all(re.match(r"[-+](node_id|serial|electrodes) = ", line) for line in shown), printed
    assert rig.config.read_text() == right  # identical: comments, order, hexadecimal numbers
    assert (folder / "hand.toml.bak").read_text() == wrong
    assert not (folder / "hand.toml.commissioned").exists()


def test_interrupted_commissioning_is_resumed(rig: Any) -> None:
    wrong, right = scramble(first_pads(rig.config.read_text(), 3), seed=2)
    rig.config.write_text(wrong)
    with pressed(rig, right) as presser:
        status, printed = commission(rig, presser, "--yes", stop_at="[2/3]")
        assert status == 130
        assert "Interrupted" in printed, printed
        half = config.load(rig.config)
        assert half.hands[0].pads[0] == config.parse(right).hands[0].pads[0]
        assert (rig.folder / "hand.toml.commissioned").read_text() == "right/thumb_proximal\n"
        status, printed = commission(rig, presser, "--yes")
    assert status == 0, printed
    assert "1 pads were done before" in printed
    assert "[1/2] right/thumb_middle" in printed
    assert rig.config.read_text() == right
    assert (rig.folder / "hand.toml.bak").read_text() == wrong
    assert not (rig.folder / "hand.toml.commissioned").exists()


def test_swap_is_confirmed_on_a_terminal_and_dry_run_writes_nothing(rig: Any) -> None:
    wrong, right = scramble(first_pads(rig.config.read_text(), 3), seed=6)
    assert config.parse(wrong).hands[0].pads[0].node_id != config.parse(right).hands[0].pads[0].node_id
    rig.config.write_text(wrong)
    with pressed(rig, right) as presser:
        status, printed = commission_in_terminal(rig, presser, "--dry-run", "--link", "thumb_proximal")
    assert status == 0, printed
    assert "accept as swapped" in printed
    assert "█" in printed  # live feedback
    assert "+node_id = 0x11 # as printed on it" in printed
    assert "Nothing was written" in printed
    assert rig.config.read_text() == wrong
    assert {path.name for path in rig.folder.glob("hand.toml*")} == {"hand.toml"}


def test_commissioning_is_refused_while_a_daemon_runs(rig: Any) -> None:
    rig.config.write_text(first_pads(rig.config.read_text(), 1))
    rig.start("run")
    rig.status()
    status, printed = rig.call("commission", str(rig.config), "--bus", rig.bus[0])
    assert status == 1
    assert "a daemon is running at" in printed


if __name__ == "__main__":
    serve(*sys.argv[1:])
