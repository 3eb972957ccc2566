"""The supervisor at work in a daemon: a swapped unit calibrates itself and is trusted again, faults are named
in words, and when the slow half is killed nobody who listens to contacts notices."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handtouch import wire
from handtouch.client import connect
from handtouch.config import parse
from handtouch.daemon.daemon import Daemon
from handtouch.demo import in_process
from handtouch.simulate.run import SimulatedHand
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.truth import Truth
from handtouch.simulate.world import World
from handtouch.supervise.store import Store

PERIOD_MS = 5.0
LONGEST_S = 60.0
"""Nothing waits so long when all is well."""
DEPLOYMENT = f"""
[daemon]
sync_period_ms = {PERIOD_MS}
window = 0.9
store = "calibrations.db"

[[bus]]
name = "can0"
interface = "virtual"
channel = "x"

[node.n]
drive_v = 5.0
full_scale_ma = 10.0
noise_counts = 2.0

[sheet.s]
ohm_per_square = 2400.0
contact_ohm_mm2 = 20000.0
alpha = 1.5
contact_radius_mm = 2.0
contact_radius_std_mm = 0.2

[[hand]]
name = "h"
"""
PAD = """
[[hand.pad]]
link = "{link}"
bus = "can0"
node_id = {node_id}
serial = {serial}
node = "n"
sheet = "s"
surface = {{ kind = "plane", length_mm = 24.0, width_mm = 20.0 }}
gap_mm = 0.6
"""
LINKS = ("swapped", "other", "broken")
SCENARIO = """
repeat = true
pause_s = 0.2

[[swap]]
link = "swapped"
at_s = 3.0
serial = 2002
gain = [1.1, 0.95, 1.0, 0.93]

[[fault]]
kind = "stuck_channel"
link = "broken"
from_s = 0.4
electrode = "xa"

[[touch]]
link = "swapped"
from_s = 0.0
duration_s = 1.2
ramp_s = 0.05
path = [[0.15, 0.15], [0.85, 0.3], [0.2, 0.5]]
force_n = [2.0]

[[touch]]
link = "swapped"
from_s = 1.3
duration_s = 1.2
ramp_s = 0.05
path = [[0.8, 0.6], [0.15, 0.8], [0.85, 0.85]]
force_n = [2.0]

[[touch]]
link = "other"
from_s = 0.3
duration_s = 0.4
path = [[0.4, 0.6]]
force_n = [1.5]
"""


@dataclass
class Bench:
    """A daemon at work, and all that it said since."""

    daemon: Daemon
    hand: SimulatedHand
    store: Path
    contacts: list[wire.Contact] = field(default_factory=list)
    health: list[wire.Health] = field(default_factory=list)
    malformed: int = 0

    def listen(self, stop: threading.Event) -> None:
        endpoint = self.daemon.publisher.endpoints["complete"]
        with connect("contact/*/*", "health/*/*", endpoint=endpoint, key="", queue=100_000) as messages:
            while not stop.is_set():
                message = messages.recv(0.1)
                if isinstance(message, wire.Contact):
                    self.contacts.append(message)
                elif isinstance(message, wire.Health):
                    self.health.append(message)
                self.malformed = messages.malformed

    def wait(self, what: str, met: Callable[[], Any]) -> Any:
        end_s = time.monotonic() + LONGEST_S
        while not (found := met()):
            assert time.monotonic() < end_s, f"never {what}: {self.daemon.report.status()}"
            time.sleep(0.05)
        return found

    @property
    def figures(self) -> dict[str, Any]:
        assert self.daemon.supervisor is not None
        return self.daemon.supervisor.figures()

    def told(self, link: str, trust: str, after_ns: int = 0) -> wire.Health | None:
        """The first that health said so of a pad since then."""
        said = (h for h in self.health if (h.link, h.trust) == (link, trust) and h.t_ns > after_ns)
        return next(said, None)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    folder = tmp_path_factory.mktemp("supervised")
    pads = "".join(PAD.format(link=link, node_id=k + 1, serial=1001 + k) for k, link in enumerate(LINKS))
    deployment = in_process(parse(DEPLOYMENT + pads))
    settings = deployment.daemon.model_copy(update={"supervise": True})
    deployment = deployment.model_copy(update={"daemon": settings})
    stop = threading.Event()
    hand = SimulatedHand.open(deployment, Scenario.parse(SCENARIO), World.ideal_parts())
    with hand, Daemon(deployment, beside=folder) as daemon:
        for number, device in enumerate(hand.devices.values()):
            device.swap(1001 + number)
        hand.start()
        made = Bench(daemon, hand, folder / "calibrations.db")
        threads = [
            threading.Thread(target=daemon.run, args=(stop,)),
            threading.Thread(target=made.listen, args=(stop,)),
        ]
        for thread in threads:
            thread.start()
        try:
            yield made
        finally:
            stop.set()
            for thread in threads:
                thread.join()


def _errors_mm(contacts: list[wire.Contact], truth: list[Truth]) -> list[float]:
    """Distance of each located contact on the swapped pad from where the touch was at that time."""
    there = sorted((t.t_ns, t.position_m) for t in truth if t.link == "swapped")
    times = np.array([t_ns for t_ns, _ in there])
    errors = []
    for contact in contacts:
        if contact.link != "swapped" or contact.position_m is None or contact.event != "update":
            continue
        nearest = int(np.abs(times - contact.t_ns).argmin())
        if abs(int(times[nearest]) - contact.t_ns) < 0.4e6 * PERIOD_MS:
            errors.append(1e3 * float(np.linalg.norm(np.subtract(contact.position_m, there[nearest][1]))))
    return errors


def test_a_swapped_unit_is_told_calibrates_itself_and_is_trusted_again(bench: Bench) -> None:
    told = bench.wait("quarantined", lambda: bench.told("swapped", "quarantined"))
    assert told.serial == 2002
    finding = bench.wait(
        "told why", lambda: next((f for h in bench.health for f in h.findings if h.link == "swapped"), None)
    )
    assert finding["kind"] == "swapped unit"
    assert "serial 1001 was here, 2002 is" in finding["cause"]
    assert "touch the pad all over" in finding["remedy"]
    trusted = bench.wait("trusted", lambda: bench.told("swapped", "trusted", told.t_ns))
    assert trusted.findings == ()
    assert trusted.calibration.startswith("2002-")
    end_ns = trusted.t_ns + 2_000_000_000
    bench.wait("touched since", lambda: bench.contacts[-1].t_ns > end_ns)
    contacts, truth = list(bench.contacts), bench.hand.truth
    quarantined = [c for c in contacts if told.t_ns < c.t_ns < trusted.t_ns and c.link == "swapped"]
    unknown = [c for c in quarantined if c.calibration.startswith("nominal-")]
    since = [c for c in contacts if c.t_ns > trusted.t_ns + 200_000_000]
    before_mm, after_mm = _errors_mm(unknown, truth), _errors_mm(since, truth)
    assert np.median(after_mm) < 0.5 * np.median(before_mm)
    assert all(c.strength == "invalid" and c.force_n is None for c in quarantined)
    assert any(c.strength == "valid" for c in since if c.link == "swapped")
    # the stated covariance knew of it
    wide = [float(np.sqrt(np.trace(np.reshape(c.covariance_m2, (3, 3))))) for c in unknown if c.covariance_m2]
    assert 0.3 < np.median(before_mm) / (1e3 * np.median(wide)) < 3
    with Store(bench.store) as store:
        kept = store.newest(2002)
    assert kept is not None
    assert kept.provenance.method == "gains from contacts"


def test_a_fault_is_named_in_words_while_it_lasts(bench: Bench) -> None:
    def found() -> tuple[wire.Health, dict[str, Any]] | None:
        told = ((h, f) for h in bench.health if h.link == "broken" for f in h.findings)
        return next((pair for pair in told if pair[1]["kind"] == "stuck channel"), None)

    health, finding = bench.wait("named", found)
    assert "channel xa" in finding["cause"]
    assert finding["remedy"]
    assert finding["evidence"]
    assert health.trust == "nominal"
    bench.wait("over", lambda: any(h.t_ns > health.t_ns and not h.findings for h in bench.health))
    others = [f["kind"] for h in bench.health for f in h.findings if h.link != "broken"]
    assert set(others) <= {"swapped unit"}


def test_killing_the_slow_half_costs_no_contact_and_no_tick(bench: Bench) -> None:
    bench.wait("at work", lambda: bench.figures["lag_s"] is not None)
    pid, restarts = bench.figures["pid"], bench.figures["restarts"]
    seen, since_ns = len(bench.contacts), time.monotonic_ns()
    periods = bench.daemon.pipeline.ticks + bench.daemon.sync.overruns
    os.kill(pid, signal.SIGKILL)
    bench.wait("started again", lambda: bench.figures["restarts"] > restarts and bench.figures["pid"])
    bench.wait("at work again", lambda: bench.figures["lag_s"] is not None)
    assert bench.figures["pid"] != pid
    assert bench.figures["died_of"] == "killed by signal 9"
    gone = (time.monotonic_ns() - since_ns) // round(PERIOD_MS * 1e6)
    # a busy machine overruns some, whether anybody is killed or not; nothing else is missing
    assert bench.daemon.pipeline.ticks + bench.daemon.sync.overruns - periods >= gone - 2
    seqs: dict[str, list[int]] = {}
    for contact in bench.contacts[seen:]:
        seqs.setdefault(contact.link, []).append(contact.seq)
    assert bench.malformed == 0
    for link, numbers in seqs.items():
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), link
    bench.wait("contacts go on", lambda: bench.contacts[-1].t_ns > since_ns + 1_000_000_000)
    assert bench.daemon.report.status()["pads"][0]["trust"] == "trusted"


def test_another_unit_is_refused_where_the_deployment_says_so(tmp_path: Path) -> None:
    made_of = "".join(PAD.format(link=link, node_id=k + 1, serial=1001 + k) for k, link in enumerate(LINKS))
    deployment = in_process(parse(DEPLOYMENT + made_of))
    settings = deployment.daemon.model_copy(update={"supervise": True, "another_unit": "refuse"})
    deployment = deployment.model_copy(update={"daemon": settings})
    stop = threading.Event()
    hand = SimulatedHand.open(deployment, Scenario.parse(SCENARIO), World.ideal_parts())
    with hand, Daemon(deployment, beside=tmp_path) as daemon:
        next(iter(hand.devices.values())).swap(2002)
        hand.start()
        made = Bench(daemon, hand, tmp_path / "calibrations.db")
        thread = threading.Thread(target=daemon.run, args=(stop,))
        thread.start()
        try:
            pads = daemon.report.status
            made.wait("refused", lambda: pads()["pads"][0]["node"] == "faulted")
            pad = pads()["pads"][0]
        finally:
            stop.set()
            thread.join()
    assert (pad["link"], pad["trust"]) == ("swapped", "nominal")
    assert "1001" in pad["reason"]
    assert "2002" in pad["reason"]
