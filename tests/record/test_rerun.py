"""A recording made again: the same contacts to the last bit, or what another deployment would have told."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handtouch import connect, wire
from handtouch.config import Deployment
from handtouch.daemon import replay
from handtouch.daemon.rerun import Again, recorded_deployment
from handtouch.record.read import Recording

from .conftest import DEPLOYMENT, RUN, Hand, Session

LONGEST_S = 60.0


def _again(entries: Any) -> tuple[Again, list[wire.Contact]]:
    contacts: list[wire.Contact] = []
    again = Again(contacts.append)
    for entry in entries:
        again.feed(entry)
    return again, contacts


def test_a_recording_gives_the_same_contacts_bit_for_bit(recorded: Path) -> None:
    again, contacts = _again(Recording(recorded))
    recorded_messages = sum(not e.payload["repeat"] for e in Recording(recorded).read("contact"))
    assert again.found.first is None
    assert again.found.same == again.found.compared == len(contacts) == recorded_messages > 100
    assert again.found.skipped == 0
    assert again.found.other_build == []
    assert {contact.reason for contact in contacts if contact.event == "end"} >= {
        "released",
        "lost",
        "stopped",
    }


def test_it_does_so_from_any_state_within_it(recorded: Path) -> None:
    entries = list(Recording(recorded))
    states = [number for number, entry in enumerate(entries) if entry.topic == "state"]
    config = next(entry for entry in entries if entry.topic == "config")
    assert len(states) >= 3
    for first in states[1:]:
        again, contacts = _again([config, *entries[first:]])
        assert again.found.same == again.found.compared == len(contacts) > 0


def test_subscriptions_of_others_change_no_contact(make_hand: Callable[..., Hand]) -> None:
    messages = []
    for deaf in (False, True):
        hand = make_hand()
        if deaf:
            hand.taken.wants = lambda topic: topic.startswith("contact/")  # type: ignore[method-assign]
        hand.stroke(80)
        messages.append([wire.encode(contact) for contact in hand.taken.contacts()])
    assert messages[0] == messages[1]


def test_the_first_difference_is_told_with_both_values(recorded: Path) -> None:
    entries = list(Recording(recorded))
    number = [k for k, entry in enumerate(entries) if entry.topic.startswith("contact/")][20]
    changed = dict(entries[number].payload)
    changed["current_a"] = float(np.nextafter(changed["current_a"], 1))
    entries[number] = entries[number]._replace(payload=changed)
    found = _again(entries)[0].found
    assert found.compared - found.same == 1
    assert found.first is not None
    assert (found.first.key, found.first.recorded) == ("current_a", changed["current_a"])
    assert f"seq {changed['seq']}" in str(found.first)


def test_a_contact_that_only_one_side_has_is_a_difference(recorded: Path) -> None:
    entries = list(Recording(recorded))
    number = [k for k, entry in enumerate(entries) if entry.topic.startswith("contact/")][20]
    less = _again([*entries[:number], *entries[number + 1 :]])[0].found
    assert less.compared - less.same == 1
    assert "made again, but not recorded" in str(less.first)
    other = entries[number]._replace(payload={**entries[number].payload, "seq": 10**6})
    more = _again([*entries[: number + 1], other, *entries[number + 1 :]])[0].found
    assert "recorded, but not made again" in str(more.first)


def test_after_missing_ticks_it_goes_on_from_the_next_state(session: Session) -> None:
    session.hand.stroke(50)
    session.lose = lambda topic: topic == b"tick"
    session.hand.stroke(3)
    session.lose = lambda _: False
    session.hand.stroke(20)
    session.hand.pipeline.tick.disturbed = True
    session.hand.stroke(60)
    session.recorder.finish()
    found = _again(Recording(session.paths[0]))[0].found
    assert (found.ticks, found.skipped) == (110, 20)
    assert found.same == found.compared > 0


def test_another_build_is_told(recorded: Path) -> None:
    entries = [
        entry._replace(payload={**entry.payload, "build": {**entry.payload["build"], "numpy": "1.0"}})
        if entry.topic == "config"
        else entry
        for entry in Recording(recorded)
    ]
    (told,) = _again(entries)[0].found.other_build
    assert told.startswith("numpy: 1.0 then")


def test_the_recorded_deployment_has_its_files_with_it(deployment: Deployment) -> None:
    named = deployment.model_copy(
        update={"nodes": {"n": deployment.nodes["n"].model_copy(update={"eds": "/gone/node.eds"})}}
    )
    payload = {"deployment": named.model_dump_json(by_alias=True), "files": {"/gone/node.eds": b"[FileInfo]"}}
    with recorded_deployment(payload) as read:
        eds = read.nodes["n"].eds
        assert eds is not None
        assert Path(eds).read_bytes() == b"[FileInfo]"


def test_replay_compares_and_tells_with_status_0(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = tmp_path / "report.json"
    assert replay.run(recorded, as_json=True, report=report) == 0
    out, err = capsys.readouterr()
    told = json.loads(report.read_text())
    assert len(out.splitlines()) == told["compared"] == told["same"]
    assert "the same, bit for bit" in err


def test_replay_of_a_cut_recording_uses_what_is_there(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = tmp_path / "cut.mcap"
    data = recorded.read_bytes()
    cut.write_bytes(data[: len(data) * 3 // 4])
    status = replay.run(cut)
    told = capsys.readouterr().err
    assert "ends early" in told
    assert status == (0 if "bit for bit" in told else 1)


def test_with_another_law_the_same_touches_have_other_forces(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, report = tmp_path / "other.toml", tmp_path / "report.json"
    config.write_text(DEPLOYMENT.replace("contact_ohm_mm2 = 20000.0", "contact_ohm_mm2 = 40000.0"))
    assert replay.run(recorded, config, report=report) == 0
    assert "shift mm" in capsys.readouterr().err
    for link in json.loads(report.read_text())["links"].values():
        assert link["recorded"] == link["replayed"] > 0
        assert link["only_recorded"] == link["only_replayed"] == 0
        assert link["shift_mm"]["max"] < 0.1
        assert link["force_ratio"]["median"] == pytest.approx(2 ** (1 / 1.5), rel=0.05)


def test_without_its_calibrations_only_the_calibrated_pad_moves(recorded: Path, tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    assert replay.run(recorded, nominal=True, report=report) == 0
    links = json.loads(report.read_text())["links"]
    assert links["h/plane"]["samples"] > 50
    assert links["h/round"]["shift_mm"]["median"] < 1e-3


def test_a_deployment_with_other_pads_is_refused_by_their_names(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "other.toml"
    config.write_text(DEPLOYMENT.replace('link = "round"', 'link = "thumb"'))
    assert replay.run(recorded, config) == 1
    assert "h/round, h/thumb" in capsys.readouterr().err


def test_wrong_usage_is_status_2(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "a.log"
    log.write_text("(1.0) can0 080#\n")
    assert replay.run(log) == 2
    assert "needs the deployment file" in capsys.readouterr().err
    assert replay.run(recorded, tmp_path / "absent.toml") == 2
    assert "absent.toml" in capsys.readouterr().err


def test_a_recording_without_a_tick_is_status_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    empty = tmp_path / "empty.mcap"
    empty.write_bytes(b"")
    assert replay.run(empty) == 1
    assert "holds no tick" in capsys.readouterr().err


def _links(report: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(report.read_text())["links"]
    return found


def test_another_locator_finds_the_same_touches_elsewhere_by_what_it_leaves_out(
    recorded: Path, tmp_path: Path
) -> None:
    report = tmp_path / "report.json"
    shifts = {}
    for name in ("likelihood-tabulated", "exact", "log-ratio"):
        assert replay.run(recorded, locator=name, report=report) == 0
        links = _links(report)
        assert all(link["only_recorded"] == link["only_replayed"] == 0 for link in links.values())
        shifts[name] = max(link["shift_mm"]["median"] for link in links.values())
    assert shifts["likelihood-tabulated"] < 2e-3  # what live maps do to a place
    assert shifts["likelihood-tabulated"] < shifts["exact"] < shifts["log-ratio"]  # gaps; the geometry


def test_a_tolerance_moves_places_by_less_than_itself(recorded: Path, tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    assert replay.run(recorded, tolerance_mm=0.5, report=report) == 0
    shifts = [link["shift_mm"]["max"] for link in _links(report).values()]
    assert 0 < max(shifts) < 0.5


def test_a_locator_that_is_none_is_status_2_and_all_are_in_the_help(
    recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from handtouch.cli import main

    assert replay.run(recorded, locator="guess") == 2
    assert "log-ratio" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["replay", "--help"])
    told = " ".join(capsys.readouterr().out.split()).replace("- ", "-")
    assert all(name in told for name in replay.locator_names())


def test_a_recording_is_published_with_all_that_a_view_needs(
    recorded: Path, tmp_path: Path, endpoints: dict[str, str]
) -> None:
    config = tmp_path / "hand.toml"
    told = "".join(f'{name} = "{endpoint}"\n' for name, endpoint in endpoints.items())
    config.write_text(DEPLOYMENT.replace("[daemon]\n", f"[daemon]\n{told}"))
    command = [sys.executable, "-m", "handtouch", "replay", str(recorded), str(config)]
    topics = ("config", "service", "contact/*/*", "hand/*", "health/*/*")
    with (
        connect(*topics, endpoint=endpoints["live"], key="") as messages,
        subprocess.Popen([*command, "--publish", "--speed", "0.2"], stdout=subprocess.DEVNULL) as process,
    ):
        got: dict[str, Any] = {}
        while len(got) < len(topics):
            message = messages.recv(LONGEST_S)
            assert message is not None, sorted(got)
            got[type(message).__name__] = message
        process.terminate()
    assert got["HandFrame"].links == ("plane", "round")
    assert json.loads(got["Config"].deployment)["hand"][0]["name"] == "h"
    assert {message.run for message in got.values()} == {RUN}
