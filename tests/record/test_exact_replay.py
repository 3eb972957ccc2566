"""Replay of recordings: contacts equal bit for bit, or compared with those of another deployment."""

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
from handtouch.cli import main
from handtouch.config import Deployment
from handtouch.record.exact_replay import ExactReplay, Recomputation, recorded_deployment
from handtouch.record.recording import RecordedMessage, Recording

from .conftest import DEPLOYMENT, SESSION, Hand, RecordingSession

LONGEST_S = 60.0


def _replayed(entries: Any) -> tuple[ExactReplay, list[wire.Contact]]:
    contacts: list[wire.Contact] = []
    replay = ExactReplay(contacts.append)
    for entry in entries:
        replay.process_message(entry)
    return replay, contacts


def test_a_recording_gives_the_same_contacts_bit_for_bit(recorded: Path) -> None:
    replay, contacts = _replayed(Recording(recorded))
    recorded_messages = sum(not e.payload["retained"] for e in Recording(recorded).read("contact"))
    assert replay.result.first_difference is None
    assert replay.result.equal == replay.result.compared == len(contacts) == recorded_messages > 100
    assert replay.result.skipped_ticks == 0
    assert replay.result.build_differences == []
    assert {contact.end_reason for contact in contacts if contact.event == "end"} >= {
        "released",
        "lost",
        "stopped",
    }


def test_replay_from_any_recorded_state_is_exact(recorded: Path) -> None:
    entries = list(Recording(recorded))
    states = [number for number, entry in enumerate(entries) if entry.topic == "state"]
    config = next(entry for entry in entries if entry.topic == "config")
    assert len(states) >= 3
    for first in states[1:]:
        replay, contacts = _replayed([config, *entries[first:]])
        assert replay.result.equal == replay.result.compared == len(contacts) > 0


def test_subscriptions_change_no_contact(make_hand: Callable[..., Hand]) -> None:
    messages = []
    for contacts_only in (False, True):
        hand = make_hand()
        if contacts_only:
            hand.sink.has_subscriber = lambda topic: topic.startswith("contact/")  # type: ignore[method-assign]
        hand.stroke(80)
        messages.append([wire.encode(contact) for contact in hand.sink.contacts()])
    assert messages[0] == messages[1]


def test_the_first_difference_has_both_values(recorded: Path) -> None:
    entries = list(Recording(recorded))
    number = [k for k, entry in enumerate(entries) if entry.topic.startswith("contact/")][20]
    changed = dict(entries[number].payload)
    changed["total_current_a"] = float(np.nextafter(changed["total_current_a"], 1))
    entries[number] = entries[number]._replace(payload=changed)
    result = _replayed(entries)[0].result
    assert result.compared - result.equal == 1
    assert result.first_difference is not None
    assert (result.first_difference.key, result.first_difference.recorded) == (
        "total_current_a",
        changed["total_current_a"],
    )
    assert f"seq {changed['seq']}" in str(result.first_difference)


def test_a_contact_that_only_one_side_has_is_a_difference(recorded: Path) -> None:
    entries = list(Recording(recorded))
    number = [k for k, entry in enumerate(entries) if entry.topic.startswith("contact/")][20]
    less = _replayed([*entries[:number], *entries[number + 1 :]])[0].result
    assert less.compared - less.equal == 1
    assert "replayed, but not recorded" in str(less.first_difference)
    other = entries[number]._replace(payload={**entries[number].payload, "seq": 10**6})
    more = _replayed([*entries[: number + 1], other, *entries[number + 1 :]])[0].result
    assert "recorded, but not replayed" in str(more.first_difference)


def test_after_missing_ticks_replay_continues_from_the_next_state(session: RecordingSession) -> None:
    session.hand.stroke(50)
    session.lose = lambda topic: topic == b"tick"
    session.hand.stroke(3)
    session.lose = lambda _: False
    session.hand.stroke(20)
    session.send_retained()
    session.hand.stroke(60)
    session.recorder.finish()
    result = _replayed(Recording(session.paths[0]))[0].result
    assert (result.ticks, result.skipped_ticks) == (110, 20)
    assert result.equal == result.compared > 0


def test_another_build_is_reported(recorded: Path) -> None:
    entries = [
        entry._replace(payload={**entry.payload, "build": {**entry.payload["build"], "numpy": "1.0"}})
        if entry.topic == "config"
        else entry
        for entry in Recording(recorded)
    ]
    (difference,) = _replayed(entries)[0].result.build_differences
    assert difference.startswith("numpy: recorded 1.0, now")


def of_another_version(recorded: Path) -> list[RecordedMessage]:
    """Return the entries as another version may have written them: its layout, its keys, no calibrations."""

    def changed(entry: RecordedMessage) -> RecordedMessage:
        payload = dict(entry.payload)
        if entry.topic == "state":
            payload |= {"layout": "1-0123456789ab", "state": b"\1\2", "calibrations": [{"id": "x"}]}
        elif entry.topic == "config":
            tables = json.loads(payload["deployment"])
            del tables["touch"]["begin_ms"]
            payload["deployment"] = json.dumps({**tables, "touch": {**tables["touch"], "begin_samples": 2}})
            payload["build"] = {**payload["build"], "handtouch": "0.0.7", "source": "abc"}
        return entry._replace(payload=payload)

    return [changed(entry) for entry in Recording(recorded)]


def test_a_recording_of_another_version_names_it_and_the_way_to_recompute_it(recorded: Path) -> None:
    with pytest.raises(ValueError, match=r"by handtouch 0\.0\.7 \(abc\).*another form.*replay --recompute"):
        _replayed(of_another_version(recorded))


def test_the_inputs_of_another_version_are_recomputed_from_an_empty_state(recorded: Path) -> None:
    contacts: list[wire.Contact] = []
    replay = Recomputation(contacts.append)
    for entry in of_another_version(recorded):
        replay.process_message(entry)
    exact, as_recorded = _replayed(Recording(recorded))
    assert (replay.result.ticks, replay.result.skipped_ticks) == (exact.result.ticks, 0)
    assert (replay.result.compared, replay.result.contacts) == (0, exact.result.contacts)
    begins = [[c.begin_ns for c in found if c.event == "begin"] for found in (contacts, as_recorded)]
    assert begins[0] == begins[1]
    assert len(begins[0]) > 2


def test_recomputing_says_what_it_did_and_needs_a_recording_with_its_own_deployment(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(recorded), "--recompute"]) == 0
    printed = capsys.readouterr()
    assert "from an empty state, nothing compared; recorded by handtouch" in printed.err
    assert "begin" in printed.out
    config = tmp_path / "hand.toml"
    config.write_text(DEPLOYMENT)
    assert main(["replay", str(recorded), str(config), "--recompute"]) == 2
    assert "--recompute is for an MCAP recording with its own deployment" in capsys.readouterr().err


def test_the_recorded_deployment_has_its_files(deployment: Deployment) -> None:
    named = deployment.model_copy(
        update={"nodes": {"n": deployment.nodes["n"].model_copy(update={"eds": "/gone/node.eds"})}}
    )
    payload = {"deployment": named.model_dump_json(by_alias=True), "files": {"/gone/node.eds": b"[FileInfo]"}}
    with recorded_deployment(payload) as read:
        eds = read.nodes["n"].eds
        assert eds is not None
        assert Path(eds).read_bytes() == b"[FileInfo]"


def test_an_exact_replay_is_reported_with_status_0(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = tmp_path / "report.json"
    assert main(["replay", str(recorded), "--json", "--report", str(report)]) == 0
    out, err = capsys.readouterr()
    outcome = json.loads(report.read_text())
    assert len(out.splitlines()) == outcome["compared"] == outcome["equal"]
    assert "equal, bit for bit" in err


def test_a_truncated_recording_is_replayed_up_to_its_end(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = tmp_path / "cut.mcap"
    data = recorded.read_bytes()
    cut.write_bytes(data[: len(data) * 3 // 4])
    status = main(["replay", str(cut)])
    err = capsys.readouterr().err
    assert "ends early" in err
    assert status == (0 if "bit for bit" in err else 1)


def test_with_another_law_the_same_contacts_have_other_forces(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, report = tmp_path / "other.toml", tmp_path / "report.json"
    config.write_text(DEPLOYMENT.replace("contact_ohm_mm2 = 20000.0", "contact_ohm_mm2 = 40000.0"))
    assert main(["replay", str(recorded), str(config), "--report", str(report)]) == 0
    assert "shift mm" in capsys.readouterr().err
    for link in json.loads(report.read_text())["links"].values():
        assert link["recorded"] == link["replayed"] > 0
        assert link["only_recorded"] == link["only_replayed"] == 0
        assert link["shift_mm"]["max"] < 0.1
        assert link["force_ratio"]["median"] == pytest.approx(2 ** (1 / 1.5), rel=0.05)


def test_a_deployment_with_other_pads_is_rejected_by_their_names(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "other.toml"
    config.write_text(DEPLOYMENT.replace('link = "round"', 'link = "thumb"'))
    assert main(["replay", str(recorded), str(config)]) == 1
    assert "h/round, h/thumb" in capsys.readouterr().err


def test_wrong_usage_is_status_2(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "a.log"
    log.write_text("(1.0) can0 080#\n")
    assert main(["replay", str(log)]) == 2
    assert "needs a deployment file" in capsys.readouterr().err
    assert main(["replay", str(recorded), str(tmp_path / "absent.toml")]) == 2
    assert "absent.toml" in capsys.readouterr().err


def test_a_recording_without_a_tick_is_status_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    empty = tmp_path / "empty.mcap"
    empty.write_bytes(b"")
    assert main(["replay", str(empty)]) == 1
    assert "no tick can be replayed" in capsys.readouterr().err


def test_a_replay_is_published_with_all_topics_of_a_view(
    recorded: Path, tmp_path: Path, endpoints: dict[str, str]
) -> None:
    config = tmp_path / "hand.toml"
    keys = "".join(f'{name} = "{endpoint}"\n' for name, endpoint in endpoints.items())
    config.write_text(DEPLOYMENT.replace("[daemon]\n", f"[daemon]\n{keys}"))
    command = [sys.executable, "-m", "handtouch", "replay", str(recorded), str(config)]
    topics = ("config", "service", "contact/*/*", "hand/*", "health/*/*")
    with (
        connect(*topics, endpoint=endpoints["live"], key="") as messages,
        subprocess.Popen([*command, "--publish", "--speed", "0.2"], stdout=subprocess.DEVNULL) as process,
    ):
        received: dict[str, Any] = {}
        while len(received) < len(topics):
            message = messages.recv(LONGEST_S)
            assert message is not None, sorted(received)
            received[type(message).__name__] = message
        process.terminate()
    assert received["HandFrame"].links == ("plane", "round")
    assert json.loads(received["Config"].deployment)["hand"][0]["name"] == "h"
    assert {message.session for message in received.values()} == {SESSION}
