"""`handtouch node` on SocketCAN: the daemon boots it, and touches on stand-ins for its ADCs are contacts."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handtouch import config
from handtouch.client import connect, request
from handtouch.config import shipped
from handtouch.hand import pad_surface
from tests.node.stand_in import AdcStandIn, node_text, raw_of_ma, touch_ma
from tests.starter import Started, Starter

pytestmark = [pytest.mark.socketcan, pytest.mark.timeout(240)]

LONGEST_S = 60.0
PERIOD_MS = 50.0  # all processes share the guest's one processor
X, Y, TOTAL_MA = 0.4, 0.7, 2.0


class Bench:
    """Daemon, and a node with two pads."""

    def __init__(self, folder: Path, endpoints: dict[str, str], starter: Starter) -> None:
        self.folder, self.endpoints, self._starter = folder, endpoints, starter
        settings = "".join(f'{stream} = "{endpoint}"\n' for stream, endpoint in endpoints.items())
        text = shipped.path("two_finger.toml").read_text()
        text = text.replace(
            "sync_period_ms = 10.0", f"{settings}supervise = false\nsync_period_ms = {PERIOD_MS}"
        )
        text = text.replace('interface = "udp_multicast"', 'interface = "socketcan"')
        text = text.replace('channel = "239.74.163.2"', 'channel = "vcan0"')
        text = text.replace("noise_counts = 1.0", "noise_counts = 1.0\nheartbeat_timeout_ms = 2000")
        shutil.copy(shipped.path("two_finger.urdf"), folder)
        self.config = folder / "hand.toml"
        self.config.write_text(text)
        self.deployment = config.load(self.config)
        self.adcs = [AdcStandIn(folder, number) for number in range(2)]
        (folder / "node.toml").write_text(node_text(self.deployment, folder, "vcan0"))
        self.processes: list[Started] = []

    def touch(self, number: int, total_ma: float) -> None:
        """Let a pad be touched at fractions X, Y of its sides, or not with 0 mA."""
        pad = self.deployment.pads[number].pad
        currents_ma = touch_ma(pad, self.deployment.sheets[pad.sheet], X, Y, total_ma)
        self.adcs[number].set_raw(raw_of_ma(currents_ma))

    def start(self, *arguments: str) -> None:
        with (self.folder / f"{arguments[0]}.txt").open("w") as output:
            self.processes.append(self._starter.start(list(arguments), output))

    def wait_operational(self) -> None:
        end_s = time.monotonic() + LONGEST_S
        while True:
            pads = request("status", endpoint=self.endpoints["control"], timeout_s=LONGEST_S)["pads"]
            if all(pad["node_state"] == "operational" for pad in pads):
                return
            assert time.monotonic() < end_s, self.printed()
            time.sleep(0.05)

    def tare(self) -> None:
        """Measure the baselines of all pads, once they have enough samples."""
        pads = [entry.pad.link for entry in self.deployment.pads]
        tared = request("tare", pads=pads, endpoint=self.endpoints["control"], timeout_s=LONGEST_S)["pads"]
        assert all(pad["tared"] for pad in tared), tared

    def printed(self) -> str:
        return "\n".join(path.read_text() for path in self.folder.glob("*.txt"))

    def close(self) -> None:
        for process in self.processes:
            process.terminate()
        for process in self.processes:
            process.wait(LONGEST_S)
        for adc in self.adcs:
            adc.close()


@pytest.fixture
def bench(tmp_path: Path, endpoints: dict[str, str], host_starter: Starter) -> Iterator[Bench]:
    made = Bench(tmp_path, endpoints, host_starter)
    yield made
    made.close()


def test_touches_on_a_node_with_an_adc_are_contacts_and_a_failure_ends(bench: Any) -> None:
    bench.start("node", str(bench.folder / "node.toml"))
    bench.start("run", str(bench.config))
    bench.wait_operational()
    bench.tare()  # the force of a touch before the first baseline would be unreliable, for want of one
    with connect("contact/*/*", endpoint=bench.endpoints["live"], queue=100_000) as contacts:
        for number, entry in enumerate(bench.deployment.pads):
            surface = pad_surface(entry.pad)
            expected = surface.point(X * surface.a, Y * surface.b)
            bench.touch(number, TOTAL_MA)
            update = _wait_for(bench, contacts, entry.pad.link, "update")
            assert update.force_n > 0.1
            bench.touch(number, 0.0)
            _wait_for(bench, contacts, entry.pad.link, "end")
            mount = entry.pad.mount.position_mm if entry.pad.mount else (0.0, 0.0, 0.0)
            distance_m = np.linalg.norm(np.array(update.position_m) - 1e-3 * np.array(mount) - expected)
            assert distance_m < 1e-3
    away = bench.folder / "away"
    bench.adcs[0].folder.rename(away)
    _wait_for_emergency(bench, cleared=False)
    away.rename(bench.adcs[0].folder)
    _wait_for_emergency(bench, cleared=True)
    bench.wait_operational()


def _wait_for(bench: Bench, contacts: Any, link: str, event: str) -> Any:
    """Return the first message of a link with this event; of updates the first with a valid force."""
    end_s = time.monotonic() + LONGEST_S
    while True:
        contact = contacts.recv(0.5)
        is_valid = contact is not None and (event != "update" or contact.force_status == "valid")
        if is_valid and (contact.link, contact.event) == (link, event):
            return contact
        assert time.monotonic() < end_s, bench.printed()


def _wait_for_emergency(bench: Bench, *, cleared: bool) -> None:
    """Wait for the EMCY message of the failed ADC, or for its clearing."""
    end_s = time.monotonic() + LONGEST_S
    with connect("health/*/*", endpoint=bench.endpoints["live"], queue=1000) as health:
        while True:
            message = health.recv(0.5)
            errors = [] if message is None or message.link != "thumb_tip" else message.emergencies
            if any(
                error["code"] == 0x5000 and (error["cleared_ns"] is not None) is cleared for error in errors
            ):
                return
            assert time.monotonic() < end_s, bench.printed()
