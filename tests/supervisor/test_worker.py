"""Supervisor worker: nodes are calibrated by contacts or from the store, and in quarantine until then."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from handtouch.calibration.calibration import (
    Calibration,
    Gains,
    LawParameters,
    Offsets,
    Provenance,
    StoredSheetState,
    matrix,
)
from handtouch.calibration.store import Store
from handtouch.calibration.store_client import MountingPoint, StoreClient
from handtouch.config import NamedPad
from handtouch.procedures.calibrate.store_law import store_new_sheet
from handtouch.sheet import S1, BankPrior, BankState, ModelBank
from handtouch.supervisor.ipc import (
    CalibrationAssessment,
    CalibrationUpdate,
    ManualCalibration,
    WorkerMessage,
    WorkerStatus,
)
from handtouch.supervisor.worker import SupervisorWorker

from .conftest import LINKS, NOW, PERIOD_NS, Bench

MOUNTING_POINT = MountingPoint("h", LINKS[0], "tables")
Session = list[Any]
Swapped = tuple[list[WorkerMessage], Path]


def make_worker(bench: Bench, path: Path) -> SupervisorWorker:
    return SupervisorWorker(bench.deployment, StoreClient(path))


def play(worker: SupervisorWorker, bench: Bench, session: Session, since: int = 0) -> list[WorkerMessage]:
    """Return all messages while the recording is played."""
    messages: list[WorkerMessage] = []
    for number, (counts, contact) in enumerate(session):
        message = bench.block(counts, contact, (since + number) * 13 * PERIOD_NS)
        messages += worker.process_message(message, NOW)
    return messages


def assessment(messages: list[WorkerMessage], pad: int) -> CalibrationAssessment:
    return [
        message for message in messages if isinstance(message, CalibrationAssessment) and message.pad == pad
    ][-1]


def calibrations(messages: list[WorkerMessage], pad: int) -> list[CalibrationUpdate]:
    return [message for message in messages if isinstance(message, CalibrationUpdate) and message.pad == pad]


@pytest.fixture(scope="module")
def swapped(
    bench: Bench, session: Session, tmp_path_factory: pytest.TempPathFactory
) -> tuple[list[WorkerMessage], Path]:
    """Replace three nodes; return the messages while their pads were touched, and the store."""
    path = tmp_path_factory.mktemp("swapped") / "c.db"
    worker = make_worker(bench, path)
    messages = worker.process_message(bench.introduce([11, 12, 13], [1, 2, 3]), NOW)
    messages += play(worker, bench, session)
    worker.finish(NOW)
    return messages, path


def test_replaced_node_is_in_quarantine_with_a_remedy(bench: Bench, tmp_path: Path) -> None:
    messages = make_worker(bench, tmp_path / "c.db").process_message(
        bench.introduce([11, 2, 3], [1, None, None]), NOW
    )
    reported = assessment(messages, 0)
    assert reported.calibration_state == "quarantined"
    assert reported.diagnoses[0].kind == "node_replaced"
    assert "node replaced: serial 1 -> 11" in reported.diagnoses[0].cause
    assert "touch the pad all over" in reported.diagnoses[0].remedy
    assert [assessment(messages, pad).calibration_state for pad in (1, 2)] == ["default", "default"]


def test_contacts_calibrate_a_replaced_node(bench: Bench, swapped: Swapped) -> None:
    messages, path = swapped
    for pad in (0, 1):
        assert assessment(messages, pad).calibration_state == "calibrated"
        assert assessment(messages, pad).diagnoses == ()
        last = calibrations(messages, pad)[-1]
        off = np.log(last.gains) - np.log(bench.gains[pad])
        deviation = np.sqrt(np.diag(np.reshape(last.covariance or (), (4, 4))))
        assert np.abs(off).max() < 0.01
        assert (np.abs(off) < 4 * deviation).all()
    with Store(path) as store:
        stored = store.versions(11)[0]
    assert stored.provenance.method == "gains from contacts"
    assert stored.provenance.contacts >= 32
    assert 0 < stored.provenance.residual < 2  # less than 1: the model is better than assumed
    assert (stored.provenance.hand, stored.provenance.link, stored.config) == (
        "h",
        "square",
        bench.ids["square"],
    )


def test_gains_are_corrected_before_the_node_is_calibrated(bench: Bench, swapped: Swapped) -> None:
    messages, _ = swapped
    first = calibrations(messages, 1)[0]
    before = np.abs(np.log(bench.gains[1])).max()
    assert np.abs(np.log(first.gains) - np.log(bench.gains[1])).max() < before / 2


def test_pad_without_observable_gains_requires_manual_calibration(swapped: Swapped) -> None:
    messages, _ = swapped
    reported = assessment(messages, LINKS.index("strip"))
    assert reported.calibration_state == "manual_required"
    assert "can't be calibrated by contacts" in reported.diagnoses[0].evidence
    assert "handtouch calibrate" in reported.diagnoses[0].remedy
    assert calibrations(messages, 2) == []


def test_stored_calibration_is_applied_at_once(bench: Bench, swapped: Swapped) -> None:
    _, path = swapped
    worker = make_worker(bench, path)
    messages = worker.process_message(bench.introduce([11, 12, 5], [7, None, None]), NOW + timedelta(hours=1))
    for pad, serial in ((0, 11), (1, 12)):
        assert assessment(messages, pad).calibration_state == "calibrated"
        (recalled,) = calibrations(messages, pad)
        assert recalled.calibration_id.startswith(f"{serial}-")
        assert np.log(recalled.gains) == pytest.approx(np.log(bench.gains[pad]), abs=0.01)
        assert recalled.offset_counts == (0.0,) * 4


def test_replacement_while_not_running_is_detected_by_the_store(bench: Bench, swapped: Swapped) -> None:
    _, path = swapped
    messages = make_worker(bench, path).process_message(bench.introduce([99, 12, 13]), NOW)
    assert assessment(messages, 0).calibration_state == "quarantined"
    assert "node replaced: serial 11 -> 99" in assessment(messages, 0).diagnoses[0].cause


def test_calibration_under_other_tables_is_refused_and_reported(bench: Bench, tmp_path: Path) -> None:
    path = tmp_path / "c.db"
    gains = Gains((1.1, 1.0, 1.0, 1.0), tuple((0.0,) * 4 for _ in range(4)))
    with Store(path) as store:
        store.write(11, "nominal-other", Calibration(gains), Provenance("by hand"), NOW)
    messages = make_worker(bench, path).process_message(bench.introduce([11, 2, 3]), NOW)
    assert calibrations(messages, 0) == []
    assert assessment(messages, 0).calibration_state == "default"
    assert "it was made under nominal-other" in assessment(messages, 0).calibration_progress


def later(bench: Bench, worker: SupervisorWorker, seconds: float) -> list[WorkerMessage]:
    """Return the messages after some seconds without contact."""
    nothing = np.zeros((13, 3, 4)), np.zeros((13, 3), np.uint32)
    return worker.process_message(bench.block(*nothing, round(seconds * 1e9)), NOW)


def test_version_stored_by_another_process_is_applied_within_seconds(bench: Bench, swapped: Swapped) -> None:
    """Applied as after a rollback: its gains are applied, and contacts refine them."""
    worker = make_worker(bench, swapped[1])
    worker.process_message(bench.introduce([11, 12, 5]), NOW)
    assert all(isinstance(message, WorkerStatus) for message in later(bench, worker, 3.0))
    gains = Gains((1.2, 1.0, 1.0, 0.9), matrix(1e-6 * np.eye(4)))
    with Store(swapped[1]) as store:
        newest = store.newest(11)
        assert newest is not None
        made = store.write(11, newest.config, Calibration(gains), Provenance("by hand"), NOW)
    (applied,) = calibrations(later(bench, worker, 6.0), 0)
    assert applied.calibration_id == made.calibration_id
    assert applied.gains == pytest.approx(gains.factors)
    with Store(swapped[1]) as store:  # for the tests after this one
        store.roll_back(11, newest.number, Provenance(""), NOW)
    (applied,) = calibrations(later(bench, worker, 9.0), 0)
    assert newest.calibration.gains is not None
    assert applied.gains == pytest.approx(newest.calibration.gains.factors)


def test_a_new_sheet_stored_by_another_process_is_announced_with_the_gains_of_the_node(
    bench: Bench, swapped: Swapped
) -> None:
    worker = make_worker(bench, swapped[1])
    worker.process_message(bench.introduce([11, 12, 5]), NOW)
    later(bench, worker, 3.0)
    pad = NamedPad("right", bench.deployment.pads[0].pad)
    with Store(swapped[1]) as store:
        before = store.newest(11)
    assert before is not None
    assert before.calibration.gains is not None
    made = store_new_sheet(swapped[1], pad, 11, before.config, NOW)
    with Store(swapped[1]) as store:
        after = store.newest(11)
    assert after is not None
    assert after.calibration == Calibration(
        Gains(before.calibration.gains.factors, before.calibration.gains.covariance)
    )
    (applied,) = calibrations(later(bench, worker, 6.0), 0)
    assert (applied.calibration_id, applied.new_sheet) == (made, True)
    assert applied.parts is not None  # as the deployment states, without what contacts taught
    assert not any(applied.parts.offsets)
    taught = np.array(applied.parts.covariance)[4:, 4:]
    np.testing.assert_allclose(np.diag(taught), 1.0)  # in units of the stated deviations
    assert applied.gains == pytest.approx(before.calibration.gains.factors)
    with Store(swapped[1]) as store:  # for the tests after this one
        store.roll_back(11, before.number, Provenance(""), NOW)
    (applied,) = calibrations(later(bench, worker, 9.0), 0)
    assert not applied.new_sheet


def test_manual_gains_end_quarantine_and_are_refined(bench: Bench, session: Session, tmp_path: Path) -> None:
    worker = make_worker(bench, tmp_path / "c.db")
    worker.process_message(bench.introduce([11, 12, 13], [1, 2, 3]), NOW)
    gains, wide = (1.5, 1.0, 1.0, 1.0), tuple((1e-4 * (np.eye(4) - 0.25)).ravel().tolist())
    message = CalibrationUpdate(pad=2, serial=13, calibration_id="bench.1", gains=gains, covariance=wide)
    messages = worker.process_message(ManualCalibration(given=("gains",), update=message), NOW)
    assert calibrations(messages, 2) == [message]  # sent again, as a stored version may have replaced it
    assert (assessment(messages, 2).calibration_state, assessment(messages, 2).diagnoses) == (
        "calibrated",
        (),
    )
    assert "gains set or stored, known to 0.87 %" in assessment(messages, 2).calibration_progress
    near = CalibrationUpdate(
        pad=0, serial=11, calibration_id="bench", gains=tuple(1.1 * bench.gains[0]), covariance=wide
    )
    worker.process_message(ManualCalibration(given=("gains",), update=near), NOW)
    last = calibrations(play(worker, bench, session), 0)[-1]
    assert np.log(last.gains) == pytest.approx(np.log(near.gains), abs=0.01)  # with their common factor
    assert (
        worker.process_message(
            ManualCalibration(given=("gains",), update=near.model_copy(update={"serial": 99})), NOW
        )
        == []
    )


def test_gains_out_of_range_are_reported_and_never_applied(
    bench: Bench, session: Session, tmp_path: Path
) -> None:
    worker = make_worker(bench, tmp_path / "c.db")
    worker.process_message(bench.introduce([11, 12, 13]), NOW)
    wide = tuple((1e-2 * (np.eye(4) - 0.25)).ravel().tolist())
    manual = CalibrationUpdate(pad=0, serial=11, calibration_id="bench", gains=(9.9,) * 4, covariance=wide)
    worker.process_message(ManualCalibration(given=("gains",), update=manual), NOW)
    messages = play(worker, bench, session)
    assert all(max(message.gains) <= 10 for message in calibrations(messages, 0))
    in_quarantine = [
        message
        for message in messages
        if isinstance(message, CalibrationAssessment) and message.pad == 0 and message.diagnoses
    ]
    assert "beyond any amplifier's" in in_quarantine[0].diagnoses[0].cause


def test_measured_law_ends_quarantine_of_a_pad_without_observable_gains(bench: Bench, tmp_path: Path) -> None:
    worker = make_worker(bench, tmp_path / "c.db")
    assert (
        assessment(worker.process_message(bench.introduce([11, 12, 13], [1, 2, 3]), NOW), 2).calibration_state
        == "manual_required"
    )
    law = LawParameters(21_000.0, 1.4, 2400.0, matrix(np.diag([1e-4, 1e-4, 1e-6])))
    with Store(tmp_path / "c.db") as store:
        store.write(13, bench.ids["strip"], Calibration(law=law), Provenance("guided session"), NOW)
    messages = later(bench, worker, 3.0)
    (applied,) = calibrations(messages, 2)
    assert applied.law is not None
    assert applied.law.alpha == 1.4
    (stated,) = {node.gain_std for node in bench.deployment.nodes.values()}
    assert np.diag(np.reshape(applied.covariance or (), (4, 4))) == pytest.approx([stated**2 * 0.75] * 4)
    assert assessment(messages, 2).calibration_state == "calibrated"


def test_a_stored_calibration_without_gains_leaves_their_stated_tolerances(
    bench: Bench, tmp_path: Path
) -> None:
    """Gains as in the deployment file are no exact ones."""
    offsets = Offsets((1.0,) * 4, (0.1,) * 4)
    with Store(tmp_path / "c.db") as store:
        store.write(11, bench.ids["square"], Calibration(offsets=offsets), Provenance("offsets"), NOW)
    messages = make_worker(bench, tmp_path / "c.db").process_message(
        bench.introduce([11, 12, 13], [None, None, None]), NOW
    )
    (applied,) = calibrations(messages, 0)
    assert applied.offset_counts == offsets.counts
    assert (applied.gains, applied.covariance, applied.parts) == ((1.0,) * 4, None, None)


def test_calibration_taken_over_from_another_node_is_applied_and_reported(
    bench: Bench, tmp_path: Path
) -> None:
    gains = Gains((1.1, 1.0, 1.0, 1.0), matrix(1e-6 * np.eye(4)))
    taken = Provenance("gains from contacts", foreign="it was made for serial 9, not for 11")
    with Store(tmp_path / "c.db") as store:
        store.write(11, bench.ids["square"], Calibration(gains), taken, NOW)
    worker = make_worker(bench, tmp_path / "c.db")
    messages = worker.process_message(bench.introduce([11, 12, 13], [1, None, None]), NOW)
    (applied,) = calibrations(messages, 0)
    assert applied.covariance is not None
    assert applied.covariance[0] > 0.04**2 * 0.75
    (diagnosis,) = assessment(messages, 0).diagnoses
    assert assessment(messages, 0).calibration_state == "default"
    assert (diagnosis.kind, diagnosis.evidence) == ("foreign_calibration", taken.foreign)
    assert "rollback" in diagnosis.remedy


def test_nodes_without_a_unique_serial_number_are_not_calibrated(
    bench: Bench, session: Session, tmp_path: Path
) -> None:
    worker = make_worker(bench, tmp_path / "c.db")
    messages = worker.process_message(bench.introduce([7, 7, 0], [None, None, 3]), NOW)
    assert "2 nodes have the serial number 7" in assessment(messages, 0).calibration_progress
    assert assessment(messages, 2).calibration_state == "manual_required"
    assert "no serial number" in assessment(messages, 2).calibration_progress
    messages = play(worker, bench, session[:40])
    assert not any(isinstance(message, CalibrationUpdate) for message in messages)
    worker.finish(NOW)
    with Store(tmp_path / "c.db") as store:
        assert store.newest_of_all() == []


def test_gain_step_puts_a_node_into_quarantine_until_recalibrated(
    bench: Bench, session: Session, swapped: Swapped
) -> None:
    worker = make_worker(bench, swapped[1])
    worker.process_message(bench.introduce([11, 12, 5]), NOW)
    jump = np.array([1.3, 1.0, 1.0, 0.8])
    messages = play(worker, bench, [(counts * jump, contact) for counts, contact in session])
    reported = [
        message for message in messages if isinstance(message, CalibrationAssessment) and message.pad == 0
    ]
    changed = next(message for message in reported if message.calibration_state == "quarantined")
    assert changed.diagnoses[0].kind == "gains_changed"
    assert reported[-1].calibration_state == "calibrated"


def test_damaged_store_is_reported_moved_aside_and_replaced(bench: Bench, tmp_path: Path) -> None:
    path = tmp_path / "c.db"
    with Store(path) as store:
        store.write(11, bench.ids["square"], Calibration(), Provenance("by hand"), NOW)
    data = bytearray(path.read_bytes())
    data[len(data) // 2 :] = bytes(len(data) - len(data) // 2)
    path.write_bytes(data)
    client = StoreClient(path)
    worker = SupervisorWorker(bench.deployment, client)
    messages = worker.process_message(bench.introduce([11, 2, 3]), NOW)
    assert "is damaged" in client.error
    assert any("store" in diagnosis.kind for diagnosis in assessment(messages, 0).diagnoses)
    assert len(list(tmp_path.glob("c.db.damaged-*"))) == 1
    assert client.store_parts(11, MOUNTING_POINT, Provenance("x"), NOW, gains=None) is not None


def test_calibration_works_without_a_usable_store(bench: Bench, session: Session, tmp_path: Path) -> None:
    path = tmp_path / "c.db"
    path.write_text("not a store")
    worker = make_worker(bench, path)
    messages = worker.process_message(bench.introduce([11, 2, 3], [1, None, None]), NOW) + play(
        worker, bench, session
    )
    assert assessment(messages, 0).calibration_state == "calibrated"
    assert path.read_text() == "not a store"


def test_storing_gains_keeps_parts_stored_before(tmp_path: Path) -> None:
    """A measured law, stored by another process meanwhile, stays when new gains are stored."""
    client, mounting_point = StoreClient(tmp_path / "c.db"), MOUNTING_POINT
    law = LawParameters(21_000.0, 1.4, 2400.0, matrix(np.diag([1e-4, 1e-4, 1e-6])))
    gains = Gains((1.1, 1.0, 1.0, 0.9), matrix(1e-6 * np.eye(4)))
    assert client.store_parts(11, mounting_point, Provenance("gains from contacts"), NOW, gains=gains)
    with Store(tmp_path / "c.db") as store:
        store.write(11, mounting_point.config, Calibration(gains=gains, law=law), Provenance("weights"), NOW)
    later = Gains((1.2, 1.0, 1.0, 0.9), matrix(1e-6 * np.eye(4)))
    stored = client.store_parts(11, mounting_point, Provenance("gains from contacts"), NOW, gains=later)
    assert stored is not None
    assert (stored.calibration.gains, stored.calibration.law) == (later, law)
    client.close()


@pytest.mark.skipif(os.geteuid() == 0 and not shutil.which("setpriv"), reason="root may write everywhere")
def test_store_that_can_only_be_read_is_reported_when_it_is_opened(tmp_path: Path) -> None:
    script = f"""
import datetime
from pathlib import Path
from handtouch.calibration.store_client import StoreClient
client = StoreClient(Path({str(tmp_path / "c.db")!r}))
client.changed(datetime.datetime.now(datetime.UTC))
print(client.error)
"""
    Store(tmp_path / "c.db").close()
    (tmp_path / "c.db").chmod(0o444)
    # root without its capabilities is bound by the file's mode
    bare = "setpriv --bounding-set=-all --inh-caps=-all --ambient-caps=-all"
    user = bare.split() if os.geteuid() == 0 else []
    done = subprocess.run([*user, sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert "calibrations are read, but new ones are not kept" in done.stdout, done.stderr


def learned_behaviour() -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return what a bank could have learned of a sheet."""
    learned = np.array(ModelBank(S1.adaptation, BankPrior(), BankState.empty(1)).learned[0], np.float64)
    learned[: len(learned) // 3] -= np.linspace(0.0, 6.0, len(learned) // 3)
    return learned


def store_sheet_state(bench: Bench, path: Path, back_n: float) -> None:
    """Let a session with node 11 at the first pad end with a back force and learned behaviour."""
    worker = make_worker(bench, path)
    worker.process_message(bench.introduce([11, 12, 13]), NOW)
    block = bench.block(np.zeros((5, 3, 4)), np.zeros((5, 3), np.uint32), 100)
    sheet = {"back_n": np.array([back_n, np.nan, np.nan]), "back_std_n": np.full(3, 0.1)}
    learned = {"learned_pad": np.array(0, np.int32), "learned": learned_behaviour()}
    changes: dict[str, Any] = {**sheet, **learned}
    worker.process_message(replace(block, **changes), NOW)
    worker.finish(NOW)


def test_learned_behaviour_of_a_sheet_is_kept_for_the_next_session(bench: Bench, tmp_path: Path) -> None:
    store_sheet_state(bench, tmp_path / "c.db", 0.4)
    messages = make_worker(bench, tmp_path / "c.db").process_message(bench.introduce([11, 12, 13]), NOW)
    (update,) = calibrations(messages, 0)
    assert update.back_n == pytest.approx(0.4)
    assert update.learned == tuple(learned_behaviour())


def test_replaced_node_gets_nothing_that_was_learned_of_the_former(bench: Bench, tmp_path: Path) -> None:
    store_sheet_state(bench, tmp_path / "c.db", 0.4)
    messages = make_worker(bench, tmp_path / "c.db").process_message(bench.introduce([21, 12, 13]), NOW)
    assert not any(update.learned for update in calibrations(messages, 0))


@pytest.mark.parametrize(
    ("version", "numbers", "restored"),
    [(1, [0.4, 0.1], True), (3, [0.4, 0.1], False), (2, [0.4, 0.1, *[-1.0] * 42], False)],
    ids=["without_learned_behaviour", "newer", "damaged"],
)
def test_sheet_state_of_another_version_restores_what_is_known_of_it(
    bench: Bench, tmp_path: Path, version: int, numbers: list[float], restored: bool
) -> None:
    state = StoredSheetState("back force", version, msgpack.packb(numbers))
    with Store(tmp_path / "c.db") as store:
        origin = Provenance("baseline and sheet state tracked", hand="h", link=LINKS[0])
        store.write(11, bench.ids[LINKS[0]], Calibration(sheet=state), origin, NOW)
    messages = make_worker(bench, tmp_path / "c.db").process_message(bench.introduce([11, 12, 13]), NOW)
    (update,) = calibrations(messages, 0)
    assert (update.back_n, update.learned) == (0.4 if restored else None, ())


def test_the_least_threshold_of_an_untouched_pad_is_known_after_a_minute_and_forgotten_with_its_node(
    bench: Bench, tmp_path: Path
) -> None:
    worker, rng = make_worker(bench, tmp_path / "c.db"), np.random.default_rng(8)
    messages = worker.process_message(bench.introduce([1, 2, 3], [1, 2, 3]), NOW)
    rest = np.zeros((200, 3), np.uint32)
    for number in range(72):
        noise = rng.normal(0, [[[1.0], [1.0], [3.0]]], (200, 3, 4))
        messages += worker.process_message(bench.block(noise, rest, number * 200 * PERIOD_NS), NOW)
    found = [assessment(messages, pad).least_begin_counts for pad in range(3)]
    rounded = np.sqrt(np.square([1.0, 1.0, 3.0]) + 1 / 12)
    two_of_four = rounded * np.sqrt(4 / 2)  # the mean of two samples of the sum of four channels
    np.testing.assert_allclose(np.array(found, float), 5.55 * two_of_four, rtol=0.1)
    messages = worker.process_message(bench.introduce([1, 9, 3], [1, 2, 3]), NOW)
    assert assessment(messages, 1).least_begin_counts is None
