"""Control commands of a running daemon, on the command line and over the wire, with loads set by the test."""

from __future__ import annotations

import json
import math
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import pytest

from handtouch import wire
from handtouch.cli import main
from handtouch.client import request
from handtouch.config import load
from tests.starter import Starter

from .conftest import own_rig

LONGEST_S = 60.0
PRESS = [1311, 1021, 415, 253]  # as of a point near the middle of palm_heel
BASELINE = [6, -5, 4, 6]
COUNT_A = 10e-3 / 32767
NODES = """
import sys, time
from pathlib import Path
import can, numpy as np
from handtouch.device import DeviceBus
from handtouch.config import load

config, loads, port = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
pads = [pad for hand in load(config).hands for pad in hand.pads]
chance = np.random.default_rng(5)

def sample(t_ns):
    counts = np.rint(chance.standard_normal((len(pads), 4))).astype(np.int64)
    return counts + np.loadtxt(loads, dtype=np.int64)

with can.Bus("239.74.163.2", interface="udp_multicast", port=port) as bus:
    nodes = DeviceBus(bus, sample)
    for pad in pads:
        nodes.add(pad.node_id, serial=pad.serial)
    nodes.start()
    while True:
        time.sleep(1)
"""


class Served:
    """A daemon and nodes whose readings the test sets."""

    def __init__(self, rig: Any) -> None:
        self.rig = rig
        self.links = [pad.link for hand in load(rig.config).hands for pad in hand.pads]
        self._loads = rig.folder / "loads.dat"
        self.load({})
        port = rig.bus[0].split("port=")[1]
        command = [*rig.command()[:-2], "-c", NODES, str(rig.config), str(self._loads), port]
        with (rig.folder / "nodes.txt").open("w") as output:
            rig.processes["nodes"] = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
        rig.start("run")
        before = {pad["link"]: pad["samples"] for pad in rig.wait_operational()["pads"]}
        # a pad pressed from the start has no baseline: its force is unreliable until it is released
        rig.wait(
            "baselines learned",
            lambda status: all(pad["samples"] > before[pad["link"]] + 15 for pad in status["pads"]),
        )

    def load(self, counts: Mapping[str, list[int]]) -> None:
        """Set the counts of pads' channels, without noise; other pads read 0."""
        rows = np.array([counts.get(link, [0] * 4) for link in self.links])
        fresh = self._loads.with_suffix(".new")
        np.savetxt(fresh, rows, fmt="%d")
        fresh.replace(self._loads)

    def ask(self, command: str, **arguments: Any) -> dict[str, Any]:
        return request(command, endpoint=self.rig.endpoints["control"], timeout_s=LONGEST_S, **arguments)

    def call(self, *arguments: str) -> tuple[int, str]:
        """Return exit status and output of a handtouch command."""
        status, output = self.rig.call(*arguments, "--endpoint", self.rig.endpoints["control"])
        return status, output

    def pad(self, link: str) -> Any:
        return next(pad for pad in self.rig.status()["pads"] if pad["link"] == link)

    def until_touched(self, *links: str) -> None:
        self.rig.wait(
            f"{links} touched",
            lambda status: {p["link"] for p in status["pads"] if p["state"] == "touched"} == set(links),
        )

    def edit(self, change: Callable[[str], str]) -> None:
        text = self.rig.config.read_text()
        assert change(text) != text
        self.rig.config.write_text(change(text))


@pytest.fixture(scope="module")
def shared(
    tmp_path_factory: pytest.TempPathFactory, network: list[str], starter: Starter
) -> Iterator[Served]:
    with own_rig(tmp_path_factory.mktemp("controlled"), network, starter) as rig:
        yield Served(rig)


@pytest.fixture
def served(shared: Served) -> Iterator[Served]:
    """The daemon of all tests here, untouched and as configured; only gains that were set stay."""
    text = shared.rig.config.read_text()
    yield shared
    shared.load({})
    shared.rig.config.write_text(text)
    shared.ask("reload")
    shared.until_touched()


def test_tare_sets_a_baseline_and_refuses_a_loaded_pad(served: Served) -> None:
    served.load({"index_distal": BASELINE, "palm_heel": PRESS})
    served.until_touched("palm_heel")
    status, output = served.call("tare", "--json")
    assert status == 1, output
    pads = {pad["link"]: pad for pad in json.loads(output)["pads"]}
    assert [link for link, pad in pads.items() if not pad["tared"]] == ["palm_heel"]
    assert "touched" in pads["palm_heel"]["reason"]
    np.testing.assert_allclose(pads["index_distal"]["offset_counts"], BASELINE, atol=0.8)
    served.load({"index_distal": [count + 15 for count in BASELINE]})
    served.until_touched()
    # requested directly: while a command starts, for seconds, the baseline would track such a drift
    (pad,) = served.ask("tare", pads=["index_distal"])["pads"]
    assert not pad["tared"]
    assert "from the baseline" in pad["reason"]
    served.load({"index_distal": BASELINE})
    deadline_s = time.monotonic() + LONGEST_S
    current = math.inf
    # the loaded pad's 60 counts may be those of the last tick still
    while abs(current) > 40 * COUNT_A and time.monotonic() < deadline_s:
        frame = next(iter(served.ask("snapshot")["hands"].values()))
        current = np.frombuffer(frame["total_current_a"], "<f4")[frame["links"].index("index_distal")]
    assert abs(current) < 12 * COUNT_A  # four of noise; it was 11 +- 2
    assert served.call("tare", "palm_heel")[0] == 0


def test_a_disabled_pad_is_off_until_it_is_enabled(served: Served) -> None:
    served.load({"index_distal": PRESS, "palm_heel": PRESS})
    served.until_touched("index_distal", "palm_heel")
    with served.rig.subscribe("contact/*/index_distal") as contacts:
        assert contacts.recv(LONGEST_S).event == "update"
        status, output = served.call("disable", "index_*", "--name", "planner")
        assert status == 0
        assert "index_distal: disabled by planner" in output
        # a pause of the machine makes a pad stale for a moment, and its contact begins again
        while (contact := contacts.recv(LONGEST_S)).event != "end" or contact.end_reason == "stale":
            pass
        assert contact.end_reason == "off"
    served.until_touched("palm_heel")
    off = served.rig.wait(
        "nodes stopped", lambda s: [p["node_state"] for p in s["pads"]].count("stopped") == 3
    )
    assert all(
        pad["reason"].startswith("disabled by planner")
        for pad in off["pads"]
        if pad["link"].startswith("index_")
    )
    assert served.call("enable", "index_*") == (0, "all pads are enabled\n")
    served.until_touched("index_distal", "palm_heel")


def test_reload_changes_one_pad_and_leaves_the_contact_on_another(served: Served) -> None:
    served.load({"index_distal": PRESS, "palm_heel": PRESS})
    served.until_touched("index_distal", "palm_heel")
    with served.rig.subscribe("contact/*/*") as contacts:
        before = {contact.link: contact for contact in (contacts.recv(LONGEST_S) for _ in range(8))}
        served.edit(
            lambda text: text.replace(
                'link = "index_distal"',
                'link = "index_distal"\ntouch = { begin_threshold_n = 50.0, end_threshold_n = 40.0 }',
            )
        )
        dry_run = served.ask("reload", dry_run=True)
        assert (dry_run["applied"], list(dry_run["pads"].values())) == (False, [["touch"]])
        status, output = served.call("reload")
        assert (status, "index_distal: changed: touch" in output) == (0, True), output
        events: list[wire.Contact] = []
        while not any(c.event == "end" and c.end_reason != "stale" for c in events):
            events.append(contacts.recv(LONGEST_S))
        events += [contacts.recv(LONGEST_S) for _ in range(20)]
    # a pause of the machine makes a pad stale for a moment, and its contact begins again
    ended = [c.link for c in events if c.event == "end" and c.end_reason != "stale"]
    assert ended == ["index_distal"]  # its force is below the new threshold
    kept = [c for c in events if c.link == "palm_heel" and c.event == "update"]
    assert kept
    if not any(c.end_reason == "stale" for c in events):
        assert {c.id for c in kept} == {before["palm_heel"].id}
    assert {c.calibration_id for c in kept} == {before["palm_heel"].calibration_id}
    assert contacts.lost_messages == 0
    assert all(math.dist(c.position_m or (), before["palm_heel"].position_m or ()) < 1e-3 for c in kept)


def test_invalid_reload_or_one_that_needs_a_restart_changes_nothing(served: Served) -> None:
    text = served.rig.config.read_text()
    served.edit(lambda text: text.replace("\nbegin_threshold_n", "\nbegin_threshold_m", 1))
    status, output = served.call("reload")
    assert status == 1
    assert "nothing changed" in output
    assert "begin_threshold_m" in output
    served.rig.config.write_text(text)
    served.edit(lambda text: text.replace("sync_period_ms = 20.0", "sync_period_ms = 10.0"))
    status, output = served.call("reload")
    assert (status, "[daemon] sync_period_ms" in output, "restart" in output) == (1, True, True), output
    served.rig.config.write_text(text)
    assert served.call("reload") == (0, "no changes\n")
    assert served.rig.status()["service"]["period_s"] == 0.02


def test_unsubscribed_outputs_are_computed_for_a_snapshot_only(served: Served) -> None:
    served.load({"palm_heel": PRESS})
    served.until_touched("palm_heel")
    row = next(pad for pad in served.rig.status()["scene"]["pads"] if pad["link"] == "palm_heel")
    assert row["computed"] == ["contact"]
    assert row["not_computed"]["position"] == "no subscriber"
    (contact,) = served.ask("snapshot")["contacts"]
    assert (contact["link"], contact["position_status"], contact["force_status"]) == (
        "palm_heel",
        "valid",
        "valid",
    )
    status, output = served.call("snapshot")
    assert status == 0
    assert "palm_heel: touched at (" in output
    assert set(json.loads(served.call("snapshot", "--json")[1])["hands"]) == {contact["hand"]}
    with served.rig.subscribe("contact/*/palm_heel") as contacts:
        assert contacts.recv(LONGEST_S).position_status == "valid"  # the retained message
        row = next(pad for pad in served.rig.status()["scene"]["pads"] if pad["link"] == "palm_heel")
        assert row["computed"] == ["contact", "position", "force"]


def test_scene_limits_outputs_and_a_client_scene_extends_them_for_its_lease(served: Served) -> None:
    served.load({"palm_heel": PRESS})
    status, output = served.call("scene", "--links", "palm_*", "--outputs", "position", "--rate-hz", "10")
    assert status == 0, output
    assert "scene of control: links palm_*; position; 10 Hz" in output
    served.rig.wait("12 pads off", lambda s: [p["state"] for p in s["pads"]].count("off") == 12)
    with served.rig.subscribe("contact/*/palm_heel", "hand/*") as messages:
        got = [messages.recv(LONGEST_S) for _ in range(40)][10:]
        updates = [m for m in got if isinstance(m, wire.Contact)]
        assert {(m.position_status, m.force_status, m.force_n) for m in updates} == {
            ("valid", "not_computed", None)
        }
        steps = np.diff([m.t_ns for m in got if isinstance(m, wire.HandFrame)])
        assert np.median(steps) == pytest.approx(5 * 20e6, rel=0.05)  # 50 Hz, thinned to 10
        assert served.call("scene", "--name", "planner", "--links", "palm_*", "--lease-s", "1.5")[0] == 0
        ends_s = time.monotonic() + 1.5
        while (m := messages.recv(LONGEST_S)).__class__ is not wire.Contact or m.force_status != "valid":
            assert time.monotonic() < ends_s + LONGEST_S
        while (
            m := messages.recv(LONGEST_S)
        ).__class__ is not wire.Contact or m.force_status != "not_computed":
            assert time.monotonic() < ends_s + LONGEST_S
    assert [scene["owner"] for scene in served.ask("scene")["scenes"]] == ["control"]
    assert served.call("scene", "--reset")[0] == 0
    served.rig.wait_operational()


def test_calibration_applies_to_the_next_contact_message(served: Served) -> None:
    served.load({"palm_heel": PRESS})
    with served.rig.subscribe("contact/*/palm_heel") as contacts:
        before = contacts.recv(LONGEST_S)
        while before.position_status != "valid":
            before = contacts.recv(LONGEST_S)
        command = ["calibrate", "palm_heel", "--name", "bench-1", "--gains", "2", "2", "2", "2"]
        status, output = served.call(*command)
        assert (status, before.calibration_id in output) == (0, True), output
        while (after := contacts.recv(LONGEST_S)).calibration_id != "bench-1":
            assert after.id == before.id
        assert after.id == before.id
        assert after.total_current_a == pytest.approx(2 * before.total_current_a, rel=0.02)
    assert served.call("calibrate", "palm_heel", "--name", "x", "--gains", "0", "1", "1", "1")[0] == 1


def test_every_request_prints_json(served: Served, capsys: pytest.CaptureFixture[str]) -> None:
    requests = (
        *(["status"], ["scene"], ["snapshot"], ["tare"], ["calibrate", "right/palm_heel"]),
        *(["disable", "palm_heel"], ["enable", "palm_heel"], ["reload", "--dry-run"], ["log", "info"]),
    )
    for arguments in requests:
        main([*arguments, "--json", "--endpoint", served.rig.endpoints["control"]])
        printed = capsys.readouterr()
        assert isinstance(json.loads(printed.out), dict), (arguments, printed.err)
