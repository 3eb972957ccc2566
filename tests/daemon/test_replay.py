"""Replay: a recorded session through the live pipeline, the same contacts every time and in every format."""

from __future__ import annotations

import gzip
import json
from collections import Counter
from pathlib import Path

import can
import pytest

from handtouch import shipped
from handtouch.config import Deployment, load
from handtouch.daemon.replay import Summary, pacer, replay, run
from handtouch.simulate.score import score
from handtouch.simulate.truth import Truth, read
from handtouch.wire import Contact

DATA = Path(__file__).parents[1] / "data"
PERIOD_MS = 20.0


@pytest.fixture(scope="module")
def deployment() -> Deployment:
    made = load(shipped.path("utah_mit.toml"))
    daemon = made.daemon.model_copy(update={"sync_period_ms": PERIOD_MS})
    return made.model_copy(update={"daemon": daemon})


@pytest.fixture(scope="module")
def session(deployment: Deployment) -> tuple[list[Contact], Summary]:
    contacts: list[Contact] = []
    summary = replay(DATA / "session.log.gz", deployment, contacts.append)
    return contacts, summary


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> list[Truth]:
    file = tmp_path_factory.mktemp("truth") / "session.truth"
    file.write_bytes(gzip.decompress((DATA / "session.truth.gz").read_bytes()))
    return read(file, wall=True)


def test_a_recorded_session_gives_its_touches_within_the_noise_bound(
    session: tuple[list[Contact], Summary], truth: list[Truth]
) -> None:
    contacts, summary = session
    result = score(contacts, truth)
    assert result.total.missed == 0
    assert result.total.invented == 0
    assert result.total.rms_error_m < 1.5 * result.total.rms_bound_m
    assert result.total.force_rms_n < 0.05
    assert summary.contacts == sum(contact.event == "begin" for contact in contacts) == 24
    assert {contact.reason for contact in contacts if contact.event == "end"} == {"released"}
    assert summary.buses["can0"].short == 0


def test_the_same_log_gives_identical_contacts_each_time(
    session: tuple[list[Contact], Summary], deployment: Deployment
) -> None:
    again: list[Contact] = []
    replay(DATA / "session.log.gz", deployment, again.append)
    assert again == session[0]


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".trc", ".csv"])
def test_other_formats_of_python_can_give_the_same_touches(
    session: tuple[list[Contact], Summary], deployment: Deployment, tmp_path: Path, suffix: str
) -> None:
    copy = tmp_path / f"session{suffix}"
    with can.LogReader(DATA / "session.log.gz") as reader, can.Logger(copy) as writer:
        for message in reader:
            message.channel = 0  # some formats know numbers only
            writer.on_message_received(message)
    got: list[Contact] = []
    replay(copy, deployment, got.append)
    assert Counter((c.link, c.event) for c in got) == Counter((c.link, c.event) for c in session[0])
    for one, other in zip(got, session[0], strict=True):  # some round their stamps
        assert one.position_m == pytest.approx(other.position_m, abs=1e-6)


def test_a_log_that_is_none_is_named_with_what_can_be_read(deployment: Deployment, tmp_path: Path) -> None:
    log = tmp_path / "session.txt"
    log.write_text("not a log")
    with pytest.raises(ValueError, match=r"session\.txt.*candump"):
        replay(log, deployment, lambda _: None)
    with pytest.raises(OSError, match="no such log"):
        replay(tmp_path / "absent.log", deployment, lambda _: None)


def test_pacing_sleeps_until_a_stamp_is_due(monkeypatch: pytest.MonkeyPatch) -> None:
    slept: list[float] = []
    monkeypatch.setattr("time.sleep", slept.append)
    monkeypatch.setattr("time.monotonic_ns", lambda: 7_000_000_000)
    pace = pacer(2.0)
    pace(1_000_000_000)
    pace(3_000_000_000)
    assert slept == [pytest.approx(1.0)]
    pacer(0)(10**18)
    assert len(slept) == 1


def test_the_period_is_the_logs_own(session: tuple[list[Contact], Summary]) -> None:
    again: list[Contact] = []
    summary = replay(DATA / "session.log.gz", load(shipped.path("utah_mit.toml")), again.append)  # says 5 ms
    assert summary.period_s == pytest.approx(PERIOD_MS * 1e-3, rel=0.05)
    assert [c.position_m for c in again] == [c.position_m for c in session[0]]


def test_a_log_without_a_sample_of_the_deployment_is_status_1_and_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "other.log"
    log.write_text("(1.000000) can7 080#\n(1.000500) can7 1F1#00\n(1.020000) can7 080#\n")
    assert run(log, shipped.path("utah_mit.toml")) == 1
    told = capsys.readouterr().err
    assert "no frame is a sample" in told
    assert "1 foreign" in told


def test_a_log_without_sync_is_ticked_by_the_timer(deployment: Deployment, tmp_path: Path) -> None:
    log = tmp_path / "event_driven.log"
    with can.LogReader(DATA / "session.log.gz") as reader, can.Logger(log) as writer:
        for message in reader:
            if message.arbitration_id != 0x80:
                writer.on_message_received(message)
    got: list[Contact] = []
    summary = replay(log, deployment, got.append)
    assert summary.contacts == 24


def test_replay_prints_contacts_or_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(DATA / "session.log.gz", shipped.path("utah_mit.toml"), as_json=True) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum(json.loads(text)["event"] == "begin" for text in lines) == 24
