"""The daemon's side of the slow half: it does what is said whole or not at all, and never waits for it."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest

from handtouch import wire
from handtouch.canbus.nodes.master import SerialChanged
from handtouch.config import Behaviour
from handtouch.daemon.pipeline import Pipeline
from handtouch.daemon.process import Process
from handtouch.daemon.supervisor import Supervisor
from handtouch.supervise.link import Alive, Calibrate, Finding, Judged, Word, write_word
from handtouch.wire import PadState

PERIOD_NS = 5_000_000
SECOND_NS = 1_000_000_000
GUM = Finding(kind="stuck contact", cause="chewing gum", evidence="60 s", remedy="wipe it", since_ns=1)


class Said:
    """Stands for a process whose words are the test's."""

    def __init__(self) -> None:
        self.waiting: list[bytes] = []
        self.sent: list[bytes] = []
        self.pid, self.state, self.restarts, self.dropped, self.why = 1, "running", 0, 0, ""

    def step(self, now_ns: int) -> bool:  # noqa: ARG002
        return False

    def send(self, message: bytes) -> bool:
        self.sent.append(message)
        return True

    def words(self, now_ns: int) -> list[bytes]:  # noqa: ARG002
        said, self.waiting = self.waiting, []
        return said


class Nodes:
    """A master that knows the serial numbers that it is told."""

    def __init__(self, serials: list[int | None]) -> None:
        self.serials = serials

    def status(self) -> list[Any]:
        return [type("Status", (), {"serial": serial}) for serial in self.serials]


class Listener:
    """Keeps the last message of each topic."""

    def __init__(self) -> None:
        self.last: dict[str, Any] = {}

    def wants(self, topic: str) -> bool:
        return topic.startswith(("contact/", "hand/"))

    def send(self, message: Any) -> None:
        sent = wire.decode(wire.encode(message))
        self.last[wire.topic_of(sent)] = sent


class Rig:
    def __init__(self, bench: Any) -> None:
        self.heard = Listener()
        self.pipeline = Pipeline(type(bench.model)(bench.deployment), PERIOD_NS, 0.6, self.heard)
        self.pipeline.node_state[:] = PadState.CLEAR
        self.nodes, self.process = Nodes([11, 12, 13]), Said()
        arguments: tuple[Any, ...] = (bench.deployment, self.pipeline, self.nodes, "", self.process)
        self.supervisor = Supervisor(*arguments)
        self.t_ns = SECOND_NS
        self.touched = False
        """whether somebody touches the first pad"""
        self._counts = bench.counts(0, 0.4, 0.6, 1e-3).astype("<i2").tobytes()
        self.swap(0, None, 11)  # the first time that anybody is known

    def swap(self, pad: int, before: int | None, after: int | None) -> None:
        self.nodes.serials[pad] = after
        self.supervisor.note([SerialChanged(pad, self.t_ns, before, after)], self.t_ns)

    def hear(self, *words: Word | bytes) -> None:
        """Until the next words are taken."""
        self.process.waiting = [word if isinstance(word, bytes) else write_word(word) for word in words]
        while self.process.waiting:
            self.step()
        for _ in range(10):
            self.step()

    def step(self) -> None:
        self.t_ns += PERIOD_NS
        self.pipeline.begin(self.t_ns, self.t_ns)
        for pad in range(3):
            counts = self._counts if self.touched and pad == 0 else b"\0" * 8
            self.pipeline.slab.write(pad, counts, self.t_ns + 1000)
        self.pipeline.advance(self.t_ns + PERIOD_NS)
        self.supervisor.step(self.t_ns)

    def contact(self) -> Any:
        return self.heard.last["contact/h/plane"]

    def frame(self) -> Any:
        return self.heard.last["hand/h"]


@pytest.fixture
def rig(bench: Any) -> Rig:
    return Rig(bench)


def calibrate(pad: int, serial: int, **changes: Any) -> Calibrate:
    gains = {"gains": (1.1, 1.0, 1.0, 0.9), "covariance": tuple((1e-4 * np.eye(4)).ravel().tolist())}
    return Calibrate(**{"pad": pad, "serial": serial, "name": f"{serial}-1", **gains, **changes})


def test_a_calibration_is_applied_whole(rig: Rig) -> None:
    rig.hear(calibrate(1, 12, offset_counts=(3.0, 4.0, 5.0, 6.0), offset_std=(0.5,) * 4))
    model = rig.pipeline.model
    assert model.gains[1].tolist() == [1.1, 1.0, 1.0, 0.9]
    assert model.calibration[1] == "12-1"
    assert np.diag(model.gain_covariance[1]).tolist() == [1e-4] * 4
    assert rig.pipeline.tick.baseline.expected[1].tolist() == [3.0, 4.0, 5.0, 6.0]
    assert rig.supervisor.changed >= {1}


def test_what_a_person_gave_is_told_to_the_slow_half_until_it_knows_better(rig: Rig) -> None:
    def told() -> list[dict[str, Any]]:
        return [m for m in map(msgpack.unpackb, rig.process.sent) if m["kind"] == "put"]

    rig.pipeline.model.calibrate(1, np.array([1.1, 1.0, 1.0, 0.9]), "bench-1")
    rig.supervisor.put(1, {"gains"})
    assert told()[-1]["given"] == ["gains"]
    word = Calibrate.model_validate(told()[-1]["word"])
    assert (word.serial, word.name, word.gains) == (12, "bench-1", (1.1, 1.0, 1.0, 0.9))
    assert np.diag(rig.pipeline.model.gain_covariance[1]) == pytest.approx([0.01**2 * 0.75] * 4)
    rig.swap(0, 11, 11)  # as after a new start of the slow half, which applies what is stored first
    rig.hear(calibrate(1, 12), word)
    assert (len(told()), rig.pipeline.model.calibration[1]) == (2, "bench-1")
    rig.hear(calibrate(1, 12))  # contacts have told more
    rig.swap(0, 11, 11)
    assert len(told()) == 2


@pytest.mark.parametrize(
    ("word", "counter"),
    [
        (b"\xc1 no word", "malformed"),
        (calibrate(3, 13), "malformed"),  # no such pad
        (calibrate(1, 12, offset_counts=(2e4, 0.0, 0.0, 0.0)), "malformed"),  # beyond half the range
        (calibrate(1, 99), "late"),  # another unit's
        (Judged(pad=1, serial=99, trust="trusted"), "late"),
    ],
)
def test_what_makes_no_sense_is_counted_and_changes_nothing(
    rig: Rig, word: Word | bytes, counter: str
) -> None:
    rig.hear(word)
    assert rig.supervisor.figures()[counter] == 1
    assert (rig.pipeline.model.gains == 1).all()
    assert rig.pipeline.model.calibration == rig.pipeline.model.nominal


def test_a_swapped_unit_is_in_quarantine_before_anybody_says_so(rig: Rig) -> None:
    rig.hear(calibrate(0, 11))
    rig.swap(0, 11, 21)
    model = rig.pipeline.model
    assert model.quarantined.tolist() == [True, False, False]
    assert model.gains[0].tolist() == [1.0] * 4
    assert model.calibration[0] == model.nominal[0]
    assert rig.supervisor.told(0)["trust"] == "quarantined"
    rig.hear(calibrate(0, 11))  # said of the one before
    assert rig.supervisor.late == 1
    assert model.gains[0].tolist() == [1.0] * 4
    rig.hear(calibrate(0, 21), Judged(pad=0, serial=21, trust="trusted"))
    assert model.quarantined.tolist() == [False] * 3
    assert rig.supervisor.told(0) == {
        "trust": "trusted", "calibration": "21-1", "calibrating": "", "findings": (),
    }  # fmt: skip


def test_a_unit_without_a_number_is_a_swap_too(rig: Rig) -> None:
    rig.swap(0, 11, None)
    assert rig.pipeline.model.quarantined[0]


def test_a_finding_is_told_with_all_its_words_and_its_end_too(rig: Rig, caplog: Any) -> None:
    caplog.set_level("INFO", "handtouch.supervise")
    rig.hear(Judged(pad=2, serial=13, trust="nominal", findings=(GUM,)))
    assert rig.supervisor.told(2)["findings"][0]["remedy"] == "wipe it"
    assert "chewing gum (60 s): wipe it" in caplog.text
    rig.hear(Judged(pad=2, serial=13, trust="nominal"))
    assert rig.supervisor.told(2)["findings"] == ()
    assert "stuck contact: over" in caplog.text


def test_a_fault_takes_force_and_certainty_and_gives_them_back(rig: Rig) -> None:
    rig.hear(calibrate(2, 13))
    before = rig.pipeline.model.gain_covariance[2].copy()
    broken = GUM.model_copy(update={"location": False, "strength": False})
    rig.hear(Judged(pad=2, serial=13, trust="trusted", findings=(broken,)))
    assert rig.pipeline.model.quarantined[2]
    assert rig.pipeline.model.gain_covariance[2].max() > 100 * before.max()
    rig.hear(Judged(pad=2, serial=13, trust="trusted"))
    assert not rig.pipeline.model.quarantined[2]
    assert (rig.pipeline.model.gain_covariance[2] == before).all()


def test_contacts_say_of_what_findings_make_of_them_while_those_last(rig: Rig) -> None:
    spoiled = {"location": False, "strength": False}
    rig.hear(calibrate(0, 11), Judged(pad=0, serial=11, trust="trusted"))
    rig.touched = True
    rig.hear(Judged(pad=0, serial=11, trust="trusted", findings=(GUM,)))
    assert rig.contact().location == rig.contact().strength == "valid"
    assert (rig.contact().findings, rig.frame().doubtful) == ((), b"")
    torn = GUM.model_copy(update={"kind": "torn corner", **spoiled})
    rig.hear(Judged(pad=0, serial=11, trust="trusted", findings=(GUM, torn)))
    contact = rig.contact()
    assert (contact.location, contact.strength, contact.force_n) == ("doubtful", "invalid", None)
    assert contact.position_m is not None
    assert contact.findings == ("torn corner",)
    assert rig.frame().doubtful == b"\1\0\0"
    rig.hear(Judged(pad=0, serial=11, trust="trusted"))
    contact = rig.contact()
    assert (contact.location, contact.strength, contact.findings) == ("valid", "valid", ())
    rig.swap(0, 11, 21)
    rig.hear()
    rig.step()
    contact = rig.contact()
    assert (contact.location, contact.strength, contact.findings) == ("valid", "invalid", ("swapped unit",))


def test_a_fading_sheet_rests_tells_so_and_wakes_when_the_hand_is_touched(bench: Any, caplog: Any) -> None:
    caplog.set_level("INFO", "handtouch.supervise")
    sheet = bench.deployment.sheets["s"].model_copy(update={"behaviour": Behaviour()})
    scene = bench.deployment.scene.model_copy(update={"rest_after_s": 1.0})
    fading = bench.deployment.model_copy(update={"sheets": {"s": sheet}, "scene": scene})
    rig = Rig(replace(bench, deployment=fading))
    rested: list[int] = []
    rig.supervisor.rested = rested.append
    rig.pipeline.tick.strength.assume(1, 2.0, 0.1)
    for _ in range(450):
        rig.step()
    assert rig.supervisor.turns.resting.tolist() == [False, True, False]
    (finding,) = rig.supervisor.told(1)["findings"]
    assert finding["kind"] == "fading sheet"
    assert "2.00 N" in finding["evidence"]
    assert "touch another pad" in finding["remedy"]
    assert 1 in rig.supervisor.changed
    assert "h/round: rests without potential" in caplog.text
    rig.touched = True
    rig.hear()
    rig.step()
    assert not rig.supervisor.turns.resting.any()
    assert rig.supervisor.told(1)["findings"] == ()
    assert "h/round: is awake again" in caplog.text
    assert len(rested) == 2


def test_its_state_is_told(rig: Rig) -> None:
    rig.hear(Alive(t_ns=rig.t_ns - SECOND_NS, word="3 nominal", store="the store is damaged"))
    figures = rig.supervisor.figures()
    assert figures["word"] == "3 nominal"
    assert figures["store"] == "the store is damaged"
    assert figures["lag_s"] >= 1.0


# The process itself -----------------------------------------------------------------------------------


@pytest.fixture
def process() -> Iterator[Process]:
    made = Process(lambda: b"this is no deployment")
    yield made
    made.close()


def until(process: Process, state: str, t_ns: int) -> int:
    for _ in range(3000):
        process.step(t_ns)
        process.words(t_ns)
        if process.state == state:
            return t_ns
        time.sleep(0.01)
    raise AssertionError(f"never {state}: {process.state}")


def test_one_that_dies_is_started_again_after_growing_pauses(process: Process) -> None:
    process.start(0)
    pauses = []
    now_ns = 0
    for _ in range(3):
        until(process, "running", now_ns)
        os.kill(process.pid or 0, signal.SIGKILL)
        until(process, "waiting", now_ns)
        pause_ns = 0
        while process.state == "waiting":
            now_ns += SECOND_NS // 2
            pause_ns += SECOND_NS // 2
            process.step(now_ns)
        pauses.append(pause_ns / SECOND_NS)
    assert pauses == [1.0, 2.0, 4.0]
    assert process.restarts == 3


def test_one_that_is_not_there_takes_nothing_and_says_nothing(process: Process) -> None:
    assert process.state == "stopped"
    assert process.pid is None
    assert not process.send(b"x")
    assert process.words(0) == []
