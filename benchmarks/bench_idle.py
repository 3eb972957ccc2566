"""Savings by scenes: bus load, ticks and processor time of unneeded pads, and wake-up of idle ones.

15 pads at 200 Hz on one bus of 1 Mbit/s; nodes and daemon run in processes of their own, with udp_multicast
over loopback. A node outside the scene is stopped with its excitation off; it sends heartbeats only. A node
in the scene that is untouched for `idle_after_s` transmits when a channel changes by `delta_counts`, and at
least ten times a second; when all nodes do so, SYNC slows down to `idle_sync_period_ms`. *Wake-up*: periods
from the first event frame of a touched pad to its next sample, which follows SYNC at full rate, touched at
random times; then the share of the full rate.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import can
import numpy as np
from numpy.typing import NDArray

from benchmarks.page import Report, options
from benchmarks.served_hand import PORT, ProcessorShare, in_own_network, on_loopback, open_bus
from handtouch.client import request
from handtouch.config import Deployment, load
from handtouch.device import DeviceBus

TOUCH = np.array([900, 700, 800, 600])
IDLE_AFTER_S = 0.5
FOLLOWED = 40  # periods that a woken pad's samples are followed for


class Nodes:
    """Nodes of a deployment with settable touches, and a receiver that records the send times of frames."""

    def __init__(self, deployment: Deployment) -> None:
        self.pads = [pad for hand in deployment.hands for pad in hand.pads]
        self.touched: set[int] = set()
        self.seen: list[tuple[int, float]] = []
        self._noise = np.random.default_rng(4)
        self._buses = [open_bus(), open_bus()]
        self._devices = DeviceBus(self._buses[0], self._sample)
        for pad in self.pads:
            self._devices.add(pad.node_id, serial=pad.serial)
        self._notifier = can.Notifier(self._buses[1], [self._record_frame])

    def start(self) -> None:
        self._devices.start()

    def stop(self) -> None:
        self._devices.stop()
        self._notifier.stop()
        for bus in self._buses:
            bus.shutdown()

    def _record_frame(self, message: can.Message) -> None:
        if 0x280 < message.arbitration_id < 0x300:
            self.seen.append((message.arbitration_id - 0x280, message.timestamp))

    def _sample(self, t_ns: int) -> NDArray[np.int64]:  # noqa: ARG002
        counts = np.rint(self._noise.standard_normal((len(self.pads), 4))).astype(np.int64)
        for slot in self.touched:
            counts[slot] += TOUCH
        return counts


class Daemon:
    """Run `handtouch run` for a scene."""

    def __init__(self, folder: Path, *, links: str, idle: bool) -> None:
        self.config = on_loopback(folder, PORT)
        text = self.config.read_text()
        kind = 'excitation_object = "0x2100:0:u8"\n' + ("idle = { delta_counts = 12 }\n" if idle else "")
        text = text.replace("heartbeat_ms = 100\n", f"heartbeat_ms = 100\n{kind}")
        scene = f"[scene]\nlinks = {links}\nidle_after_s = {IDLE_AFTER_S}\n\n[touch]"
        self.config.write_text(text.replace("[touch]", scene))
        self.deployment = load(self.config)
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        command = [sys.executable, "-m", "handtouch", "run", str(self.config)]
        self._process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        end_s = time.monotonic() + 60
        while any(pad["node_state"] not in ("operational", "stopped") for pad in self.status()["pads"]):
            if time.monotonic() > end_s:
                raise RuntimeError("the hand never became operational")
            time.sleep(0.1)

    def status(self) -> dict[str, Any]:
        return request("status", endpoint=self.deployment.daemon.control, timeout_s=60)

    def measure(self, seconds: float) -> dict[str, float]:
        """Return means over a time."""
        assert self._process is not None
        share = ProcessorShare()
        before, start_s = self.status(), time.monotonic()
        share.start(self._process.pid)
        time.sleep(seconds)
        processor = share.stop()
        after, took_s = self.status(), time.monotonic() - start_s
        (bus,) = after["service"]["buses"]
        grown = {
            k: after["service"]["buses"][bus][k] - before["service"]["buses"][bus][k]
            for k in ("bits", "samples")
        }
        return {
            "bus load, %": 100 * grown["bits"] / took_s / self.deployment.buses[0].bitrate_bit_s,
            "samples/s": grown["samples"] / took_s,
            "ticks/s": (after["service"]["ticks"] - before["service"]["ticks"]) / took_s,
            "daemon, % of a core": 100 * processor,
        }

    def stop(self) -> None:
        if self._process is not None:
            self._process.terminate()
            self._process.wait()


def loads(folder: Path, seconds: float) -> list[dict[str, Any]]:
    """Measure all cases; return one row each."""
    rows = []
    scenes = (
        ("all pads, SYNC only", '["*"]', False, (0, 1, 15)),
        ("all pads, event-driven while untouched", '["*"]', True, (0, 1, 15)),
        ("thumb and index only, event-driven", '["thumb_*", "index_*"]', True, (0, 1)),
    )
    for name, links, idle, touches in scenes:
        daemon = Daemon(folder, links=links, idle=idle)
        nodes = Nodes(daemon.deployment)
        nodes.start()
        daemon.start()
        for touched in touches:
            nodes.touched = set(range(touched))
            time.sleep(2 * IDLE_AFTER_S + 0.5)
            rows.append({"scene": name, "touched": touched, **daemon.measure(seconds)})
            print(rows[-1], flush=True)
        daemon.stop()
        nodes.stop()
    return rows


def wakes(folder: Path, trials: int) -> dict[str, Any]:
    """Measure the periods from the first event frame of a touched idle pad to sampling at full rate."""
    daemon = Daemon(folder, links='["*"]', idle=True)
    nodes = Nodes(daemon.deployment)
    nodes.start()
    daemon.start()
    period_s = daemon.deployment.daemon.sync_period_ms * 1e-3
    chance = np.random.default_rng(7)
    found = []
    for _ in range(trials):
        nodes.touched = set()
        time.sleep(IDLE_AFTER_S + 0.4 + chance.uniform(0, 0.1))
        slot = int(chance.integers(len(nodes.pads)))
        first, touched_s = len(nodes.seen), time.time()
        nodes.touched = {slot}
        time.sleep((FOLLOWED + 5) * period_s)
        node_id = nodes.pads[slot].node_id
        stamps = np.array([at for who, at in nodes.seen[first:] if who == node_id and at > touched_s])
        found.append(full_rate_after(stamps, period_s))
    daemon.stop()
    nodes.stop()
    delays = np.array([delay for delay, _ in found])
    rates = np.array([rate for _, rate in found])
    return {
        "trials": trials,
        "period, ms": period_s * 1e3,
        "median, periods": float(np.median(delays)),
        "95 %": float(np.percentile(delays, 95)),
        "worst": float(delays.max()),
        "within two periods, %": 100 * float((delays <= 2).mean()),
        "rate after": float(np.median(rates)),
    }


def full_rate_after(stamps: NDArray[np.float64], period_s: float) -> tuple[float, float]:
    """Return the periods from the first frame to the second, and the fraction of the full rate afterwards.

    Event frames come when something moves; a pad that is pressed and held sends its second frame because of
    the SYNC that it follows from then on.
    """
    since = (stamps - stamps[0]) / period_s
    later = since[(since > 0) & (since < FOLLOWED)]
    if not len(later):
        return np.inf, 0.0
    return float(later[0]), len(later) / (FOLLOWED - float(later[0]))


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--seconds", type=float, default=6.0, help="of each case")
    parser.add_argument("--trials", type=int, default=30, help="touches of an idle hand")
    asked = parser.parse_args()
    if asked.quick:
        asked.seconds, asked.trials = 1.0, 3
    in_own_network()
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:
        report = Report(asked.quick, seconds_of_a_case=asked.seconds)
        report.table("Load", loads(Path(folder), asked.seconds))
        report.table("Wake-up", [wakes(Path(folder), asked.trials)])
    report.keep()


if __name__ == "__main__":
    main()
