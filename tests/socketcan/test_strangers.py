"""can-utils as strangers on the bus of a daemon at work: no sample is lost, and what is dropped is named."""

from __future__ import annotations

import contextlib
import signal
import socket
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from handtouch.canbus.bus.receivers import grow_receive_buffer
from handtouch.client import request
from handtouch.config import load, shipped
from handtouch.device import DeviceBus
from tests.starter import Starter

pytestmark = [pytest.mark.socketcan, pytest.mark.timeout(280)]

PERIOD_MS = 50
LONGEST_S = 60.0
RATES = (500, 1000, 2000, 4000, 8000, 16000)
FLOOD_S = 2.0
UNUSED = 0x1F0  # TPDO1 of an id that no node has
NODE_FILTERS = [  # as a node's controller is set: NMT, SYNC, SDO requests, node guarding
    {"can_id": can_id, "can_mask": mask, "extended": False}
    for can_id, mask in ((0x000, 0x7FF), (0x080, 0x7FF), (0x600, 0x780), (0x700, 0x780))
]


class Hand:
    """Fifteen nodes in this process, a daemon of its own, and candump as the witness of every TPDO."""

    def __init__(self, folder: Path, starter: Starter) -> None:
        endpoints = "\n".join(
            f'{s} = "ipc://{folder}/{s}"' for s in ("live", "complete", "control", "inputs")
        )
        endpoints += "\nsupervise = false"  # its process takes seconds to start in the guest
        text = shipped.path("utah_mit.toml").read_text().replace("[daemon]\n", f"[daemon]\n{endpoints}\n")
        text = text.replace("sync_period_ms = 5.0", f"sync_period_ms = {PERIOD_MS}")
        text = text.replace("heartbeat_timeout_ms = 350", "heartbeat_timeout_ms = 1000")
        config = folder / "hand.toml"
        config.write_text(text)
        self.deployment = load(config)
        self.nodes = [pad.node_id for hand in self.deployment.hands for pad in hand.pads]
        self.printed, self._log = folder / "daemon.txt", folder / "witness.log"
        with self._log.open("w") as file:
            self._witness = subprocess.Popen(["candump", "-L", "vcan0,280:780"], stdout=file)
        self._bus = can.Bus("vcan0", interface="socketcan", can_filters=NODE_FILTERS, ignore_config=True)
        noise = np.random.default_rng(1)
        self._devices = DeviceBus(
            self._bus, lambda _: np.rint(noise.standard_normal((len(self.nodes), 4))).astype(np.int64)
        )
        for hand in self.deployment.hands:
            for pad in hand.pads:
                self._devices.add(pad.node_id, serial=pad.serial)
        self._devices.start()
        with self.printed.open("w") as file:
            self._daemon = starter.start(["run", str(config), "--bus", "can0=socketcan:vcan0"], file)

    def status(self) -> dict[str, Any]:
        return request("status", endpoint=self.deployment.daemon.control, timeout_s=LONGEST_S)

    def counters(self) -> dict[str, Any]:
        (figures,) = self.status()["service"]["buses"].values()
        return dict(figures)

    def wait(self, what: str, met: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        end_s = time.monotonic() + LONGEST_S
        while not met(status := self.status()):
            assert time.monotonic() < end_s, f"never {what}: {status}\n{self.printed.read_text()}"
            time.sleep(0.05)
        return status

    def wait_operational(self) -> dict[str, Any]:
        return self.wait("operational", lambda s: all(p["node_state"] == "operational" for p in s["pads"]))

    def undisturbed_since(self, before: dict[str, Any]) -> None:
        """No node had to be started again, and no frame was lost.

        A pad may have been stale for a moment: the guest's one processor pauses for some periods at times.
        """
        after = self.wait_operational()
        for was, now in zip(before["pads"], after["pads"], strict=True):
            assert now["reboots"] == was["reboots"]
        (figures,) = after["service"]["buses"].values()
        assert figures["overflow"] == 0
        assert self._daemon.poll() is None

    def witnessed(self) -> Counter[int]:
        """Samples, by the length of their data, that candump has seen; the nodes are stopped for it."""
        self._devices.stop()
        time.sleep(0.5)
        self._witness.send_signal(signal.SIGTERM)
        self._witness.wait(LONGEST_S)
        with can.LogReader(self._log) as reader:
            return Counter(len(message.data) for message in reader)

    def end(self) -> int:
        self._daemon.terminate()
        status = self._daemon.wait(LONGEST_S)
        self._devices.stop()
        self._bus.shutdown()
        with contextlib.suppress(ProcessLookupError):
            self._witness.kill()
        self._witness.wait()
        return status


@pytest.fixture
def hand(host_starter: Starter) -> Iterator[Hand]:
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:
        made = Hand(Path(folder), host_starter)
        yield made
        status = made.end()
        printed = made.printed.read_text()
        assert status == 0, printed
        assert "Traceback" not in printed


def cansend(*frames: str) -> None:
    script = "; ".join(f"cansend vcan0 '{frame}'" for frame in frames)
    subprocess.run(["sh", "-ec", script], check=True, timeout=LONGEST_S)


def cangen(rate: int, seconds: float, *options: str) -> tuple[subprocess.Popen[bytes], int]:
    """Frames of an unused identifier, in a burst every 10 ms (the guest's clock knows nothing shorter)."""
    count = round(rate * seconds)
    command = ["cangen", "vcan0", "-g", "10", "-c", str(max(1, rate // 100)), "-n", str(count)]
    return subprocess.Popen([*command, "-I", f"{UNUSED:X}", "-L", "8", "-p", "100", *options]), count


def bare_rate() -> int:
    """The highest of RATES at which a loop that does nothing but receive gets every frame in time."""
    best = 0
    for rate in RATES:
        with can.Bus("vcan0", interface="socketcan", ignore_config=True) as bus:
            bare: socket.socket = bus.socket  # type: ignore[attr-defined]  # SocketcanBus has it
            grow_receive_buffer(bare)
            bare.settimeout(1.0)
            start_s, got = time.monotonic(), 0
            generator, count = cangen(rate, FLOOD_S)
            with contextlib.suppress(TimeoutError):
                while got < count:
                    bare.recv(16)
                    got += 1
            took_s = time.monotonic() - start_s
            generator.wait(LONGEST_S)
        if got < count or took_s > 1.5 * FLOOD_S:
            break
        best = rate
    return best


def test_flood_of_unused_identifiers_costs_no_sample_and_is_counted_to_the_frame(
    host_starter: Starter,
) -> None:
    rate = next(filter(None, (bare_rate() for _ in range(5))), 0)  # the guest may have had no processor
    assert rate >= RATES[0]
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:
        hand = Hand(Path(folder), host_starter)
        try:
            before = hand.wait_operational()
            foreign = hand.counters()["unknown_frames"]
            start_s = time.monotonic()
            generator, count = cangen(rate, 2 * FLOOD_S)
            generator.wait(LONGEST_S)
            took_s = time.monotonic() - start_s
            generator, more = cangen(100, 1.0, "-e")  # 29-bit ones
            generator.wait(LONGEST_S)
            hand.wait("counted", lambda _: hand.counters()["unknown_frames"] >= foreign + count + more)
            hand.undisturbed_since(before)
            seen = hand.witnessed()
            figures = hand.counters()
            assert figures["unknown_frames"] == foreign + count + more
            assert (figures["samples"], figures["wrong_length"]) == (seen[8], 0)
            print(f"bare receiver: {rate} frames/s; flood: {count / took_s:.0f} frames/s, {seen[8]} samples")
        finally:
            assert hand.end() == 0, hand.printed.read_text()


def test_frames_of_wrong_lengths_are_counted_and_change_nothing(hand: Hand) -> None:
    before = hand.wait_operational()
    short = hand.counters()["wrong_length"]
    frames = []
    for node_id in hand.nodes[:5]:
        samples = [f"{0x280 + node_id:03X}#{data}" for data in ("", "01", "01020304050607")]
        beats = [f"{0x700 + node_id:03X}#{data}" for data in ("", "0505", "0000000000000000")]
        others = [f"{0x580 + node_id:03X}#43181001", f"{0x080 + node_id:03X}#00"]
        frames += samples + beats + others
    cansend(*frames)
    hand.wait("counted", lambda _: hand.counters()["wrong_length"] == short + len(frames))
    hand.undisturbed_since(before)
    seen = hand.witnessed()
    assert hand.counters()["samples"] == seen[8]
    assert seen[0] == seen[1] == seen[7] == 5


def test_error_frames_are_counted_by_cause_and_change_nothing_else(hand: Hand) -> None:
    before = hand.wait_operational()
    expected = {
        "20000004#0001000000000000": "controller receive overflow",
        "20000088#0000080300000000": "bit error",
        "20000008#0000000800000000": "CRC error",
        "20000020#0000000000000000": "no acknowledge",
        "20000204#000C000000006060": "receive warning",
        "20000040#0000000000000000": "bus-off",
        "20000100#0000000000000000": "restarted",
    }
    cansend(*expected)
    hand.wait("expected", lambda _: hand.counters()["error_frames"] == len(expected))
    figures = hand.counters()
    assert set(expected.values()) <= set(figures["causes"])
    hand.wait("active again", lambda _: hand.counters()["state"] == "active")
    hand.undisturbed_since(before)
    assert hand.counters()["unknown_frames"] == 0
    seen = hand.witnessed()
    assert hand.counters()["samples"] == seen[8]
