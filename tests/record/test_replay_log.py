"""Replay of CAN logs through the live pipeline: the same contacts every time and in every format."""

from __future__ import annotations

import gzip
import itertools
import json
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import pytest

from handtouch import wire
from handtouch.cli import main
from handtouch.cli.replay import speed_limiter
from handtouch.config import Deployment, load, shipped
from handtouch.record.replay_log import LogReplaySummary, replay_log
from handtouch.simulate.score import score_contacts
from handtouch.simulate.truth import GroundTruth, read_records
from handtouch.wire import Contact

DATA = Path(__file__).parents[1] / "data"
PERIOD_MS = 20.0


@pytest.fixture(scope="module")
def deployment() -> Deployment:
    made = load(shipped.path("utah_mit.toml"))
    daemon = made.daemon.model_copy(update={"sync_period_ms": PERIOD_MS})
    return made.model_copy(update={"daemon": daemon})


@pytest.fixture(scope="module")
def session(deployment: Deployment) -> tuple[list[Contact], LogReplaySummary]:
    contacts: list[Contact] = []
    summary = replay_log(DATA / "session.log.gz", deployment, contacts.append)
    return contacts, summary


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> list[GroundTruth]:
    file = tmp_path_factory.mktemp("truth") / "session.truth"
    file.write_bytes(gzip.decompress((DATA / "session.truth.gz").read_bytes()))
    return read_records(file, wall=True)


def test_contacts_of_a_recorded_session_are_within_the_noise_bound(
    session: tuple[list[Contact], LogReplaySummary], truth: list[GroundTruth]
) -> None:
    contacts, summary = session
    result = score_contacts(contacts, truth)
    assert result.total.missed == 0
    assert result.total.false_positives == 0
    assert result.total.rms_error_m < 1.5 * result.total.rms_bound_m
    # near the sheet's maximum current a force is hardly known, which its standard deviation states
    stated = [(contact, contact.force_std_n or 0.0, contact.force_n or 0.0) for contact in contacts]
    known = [contact for contact, std_n, force_n in stated if std_n <= 0.25 * force_n]
    assert len(known) > 0.8 * len(contacts)
    assert score_contacts(known, truth).total.rms_force_error_n < 0.05
    assert summary.contacts == sum(contact.event == "begin" for contact in contacts) == 24
    assert {contact.end_reason for contact in contacts if contact.event == "end"} == {"released"}
    assert summary.buses["can0"].wrong_length == 0


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".trc", ".csv"])
def test_other_formats_of_python_can_give_the_same_contacts(
    session: tuple[list[Contact], LogReplaySummary], deployment: Deployment, tmp_path: Path, suffix: str
) -> None:
    copy = tmp_path / f"session{suffix}"
    with can.LogReader(DATA / "session.log.gz") as reader, can.Logger(copy) as writer:
        for message in reader:
            message.channel = 0  # some formats know numbers only
            writer.on_message_received(message)
    contacts: list[Contact] = []
    replay_log(copy, deployment, contacts.append)
    assert Counter((c.link, c.event) for c in contacts) == Counter((c.link, c.event) for c in session[0])
    for one, other in zip(contacts, session[0], strict=True):  # some round their stamps
        assert one.position_m == pytest.approx(other.position_m, abs=1e-6)


class _Publisher:
    """A publisher without a subscriber, which keeps what is sent."""

    def __init__(self) -> None:
        self.sent: list[wire.OutgoingMessage] = []
        self.retained_messages: dict[str, Any] = {}

    def has_subscriber(self, _: str) -> bool:
        return False

    def send(self, message: wire.OutgoingMessage) -> None:
        self.sent.append(message)


def test_the_same_log_gives_identical_contacts_and_says_when_published_that_it_is_a_replay(
    session: tuple[list[Contact], LogReplaySummary], deployment: Deployment
) -> None:
    """Twice a second: without that, clients judge its frames by their own time, as old."""
    publisher, repeated = _Publisher(), list[Contact]()
    summary = replay_log(DATA / "session.log.gz", deployment, repeated.append, publisher=publisher)
    assert repeated == session[0]
    services = [message for message in publisher.sent if isinstance(message, wire.Service)]
    assert all(service.replay for service in services)
    assert len(services) == pytest.approx(2 * summary.log_s, abs=3)
    assert publisher.retained_messages["service"](0).replay


def test_an_unreadable_log_is_named_with_the_supported_formats(
    deployment: Deployment, tmp_path: Path
) -> None:
    log = tmp_path / "session.txt"
    log.write_text("not a log")
    with pytest.raises(ValueError, match=r"session\.txt.*candump"):
        replay_log(log, deployment, lambda _: None)
    with pytest.raises(OSError, match="no such log"):
        replay_log(tmp_path / "absent.log", deployment, lambda _: None)


def test_pacing_sleeps_until_a_stamp_is_due(monkeypatch: pytest.MonkeyPatch) -> None:
    slept: list[float] = []
    monkeypatch.setattr("time.sleep", slept.append)
    monkeypatch.setattr("time.monotonic_ns", lambda: 7_000_000_000)
    pace = speed_limiter(2.0)
    pace(1_000_000_000)
    pace(3_000_000_000)
    assert slept == [pytest.approx(1.0)]
    speed_limiter(0)(10**18)
    assert len(slept) == 1


def test_the_period_is_taken_from_the_syncs_of_the_log(
    session: tuple[list[Contact], LogReplaySummary],
) -> None:
    repeated: list[Contact] = []
    summary = replay_log(
        DATA / "session.log.gz", load(shipped.path("utah_mit.toml")), repeated.append
    )  # states 5 ms
    assert summary.period_s == pytest.approx(PERIOD_MS * 1e-3, rel=0.05)
    assert [c.position_m for c in repeated] == [c.position_m for c in session[0]]


def test_a_log_without_a_sample_of_the_deployment_is_status_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "other.log"
    log.write_text("(1.000000) can7 080#\n(1.000500) can7 1F1#00\n(1.020000) can7 080#\n")
    assert main(["replay", str(log), str(shipped.path("utah_mit.toml"))]) == 1
    err = capsys.readouterr().err
    assert "no frame is a sample" in err
    assert "1 unknown" in err


def test_a_log_without_sync_is_ticked_by_the_timer(deployment: Deployment, tmp_path: Path) -> None:
    log = tmp_path / "event_driven.log"
    with can.LogReader(DATA / "session.log.gz") as reader, can.Logger(log) as writer:
        for message in reader:
            if message.arbitration_id != 0x80:
                writer.on_message_received(message)
    contacts: list[Contact] = []
    summary = replay_log(log, deployment, contacts.append)
    assert summary.contacts == 24


def test_replay_prints_contacts_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    config = str(shipped.path("utah_mit.toml"))
    status = main(["replay", str(DATA / "session.log.gz"), config, "--json"])
    assert status == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum(json.loads(text)["event"] == "begin" for text in lines) == 24


def _rewritten(tmp_path: Path, change: Callable[[int, float], float], channel: str = "can0") -> Path:
    """Return a copy of the session's first seconds with other stamps, by number of the frame and stamp."""
    lines = []
    with can.LogReader(DATA / "session.log.gz") as reader:
        for number, message in enumerate(itertools.islice(reader, 4000)):
            stamp = change(number, message.timestamp)
            lines.append(f"({stamp:.6f}) {channel} {message.arbitration_id:03X}#{message.data.hex()}\n")
    copy = tmp_path / "changed.log"
    copy.write_text("".join(lines))
    return copy


def test_log_whose_stamps_do_not_advance_is_refused(deployment: Deployment, tmp_path: Path) -> None:
    log = _rewritten(tmp_path, lambda _, __: 0.0)
    with pytest.raises(ValueError, match="stamps don't advance"):
        replay_log(log, deployment, lambda _: None)
    assert main(["replay", str(log), str(shipped.path("utah_mit.toml"))]) == 2


def _going_back(tmp_path: Path, back_s: float) -> Path:
    return _rewritten(tmp_path, lambda number, stamp: stamp - back_s * (number > 2000))


def test_stamps_that_go_back_continue_with_a_warning(deployment: Deployment, tmp_path: Path) -> None:
    whole: list[Contact] = []
    first = replay_log(_rewritten(tmp_path, lambda _, stamp: stamp), deployment, whole.append)
    for back_s, cause in ((3600.0, "the clock was set"), (2**32 * 1e-6, "32 bits wrapped")):
        contacts: list[Contact] = []
        summary = replay_log(_going_back(tmp_path, back_s), deployment, contacts.append)
        (warning,) = summary.warnings
        assert cause in warning
        assert summary.log_s == pytest.approx(first.log_s, abs=0.1)
        assert all(contact.duration_s >= 0 for contact in contacts)
        begun = [[c.link for c in some if c.event == "begin"] for some in (contacts, whole)]
        assert begun[0] == begun[1]


def test_frames_of_a_foreign_channel_belong_to_no_pad_where_the_log_has_the_buss(
    deployment: Deployment, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (bus,) = deployment.buses
    own = deployment.model_copy(update={"buses": (bus.model_copy(update={"channel": "can0"}),)})
    foreign = _rewritten(tmp_path, lambda _, stamp: stamp, channel="can1")
    assert replay_log(foreign, own, lambda _: None).samples > 0  # the only channel: it is the bus
    both = tmp_path / "both.log"
    lines = foreign.read_text().splitlines()
    syncs = [line.replace("can1", "can0") for line in lines if " 080#" in line]
    both.write_text("\n".join(sorted([*lines, *syncs])) + "\n")
    summary = replay_log(both, own, lambda _: None)
    assert summary.samples == 0
    assert summary.unmatched["can1"] > 0
    assert main(["replay", str(both), str(shipped.path("utah_mit.toml"))]) == 1
    assert "can1 (" in capsys.readouterr().err
