"""The slow half: units calibrate themselves, are known from the store, and wait in quarantine till then."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from handtouch.supervise.archive import Archive
from handtouch.supervise.calibration import Calibration, Gains, Law, Provenance, matrix
from handtouch.supervise.link import Alive, Calibrate, Judged, Word, put
from handtouch.supervise.slow import SlowHalf
from handtouch.supervise.store import Store

from .conftest import LINKS, NOW, PERIOD_NS, Bench

Session = list[Any]
Swapped = tuple[list[Word], Path]


def half(bench: Bench, path: Path) -> SlowHalf:
    return SlowHalf(bench.start, Archive(path))


def play(slow: SlowHalf, bench: Bench, session: Session, since: int = 0) -> list[Word]:
    """All that is said while the session is played."""
    words: list[Word] = []
    for number, (counts, contact) in enumerate(session):
        message = bench.block(counts, contact, (since + number) * 13 * PERIOD_NS)
        words += slow.take(message, NOW)
    return words


def judged(words: list[Word], pad: int) -> Judged:
    return [word for word in words if isinstance(word, Judged) and word.pad == pad][-1]


def calibrations(words: list[Word], pad: int) -> list[Calibrate]:
    return [word for word in words if isinstance(word, Calibrate) and word.pad == pad]


@pytest.fixture(scope="module")
def swapped(
    bench: Bench, session: Session, tmp_path_factory: pytest.TempPathFactory
) -> tuple[list[Word], Path]:
    """Three new units where others were, and what was said while their pads were touched; and the store."""
    path = tmp_path_factory.mktemp("swapped") / "c.db"
    slow = half(bench, path)
    words = slow.take(bench.introduce([11, 12, 13], [1, 2, 3]), NOW)
    words += play(slow, bench, session)
    slow.finish(NOW)
    return words, path


def test_a_swapped_unit_is_in_quarantine_and_says_what_helps(bench: Bench, tmp_path: Path) -> None:
    words = half(bench, tmp_path / "c.db").take(bench.introduce([11, 2, 3], [1, None, None]), NOW)
    told = judged(words, 0)
    assert told.trust == "quarantined"
    assert told.findings[0].kind == "swapped unit"
    assert "serial 1 was here, 11 is" in told.findings[0].cause
    assert "touch the pad all over" in told.findings[0].remedy
    assert [judged(words, pad).trust for pad in (1, 2)] == ["nominal", "nominal"]


def test_contacts_bring_a_swapped_unit_back_with_its_own_gains(bench: Bench, swapped: Swapped) -> None:
    words, path = swapped
    for pad in (0, 1):
        assert judged(words, pad).trust == "trusted"
        assert judged(words, pad).findings == ()
        last = calibrations(words, pad)[-1]
        off = np.log(last.gains) - np.log(bench.gains[pad])
        deviation = np.sqrt(np.diag(np.reshape(last.covariance, (4, 4))))
        assert np.abs(off).max() < 0.01
        assert (np.abs(off) < 4 * deviation).all()
    with Store(path) as store:
        kept = store.versions(11)[0]
    assert kept.provenance.method == "gains from contacts"
    assert kept.provenance.contacts >= 32
    assert 0 < kept.provenance.residual < 2  # less than 1: the model is better than is assumed
    assert (kept.provenance.hand, kept.provenance.link, kept.config) == ("h", "square", "nominal-square")


def test_gains_are_corrected_step_by_step_before_they_are_trusted(bench: Bench, swapped: Swapped) -> None:
    words, _ = swapped
    first = calibrations(words, 1)[0]
    assert first.name == "12-learning"
    before = np.abs(np.log(bench.gains[1])).max()
    assert np.abs(np.log(first.gains) - np.log(bench.gains[1])).max() < before / 2


def test_a_pad_whose_shape_hides_its_gains_asks_for_a_person(swapped: Swapped) -> None:
    words, _ = swapped
    told = judged(words, LINKS.index("strip"))
    assert told.trust == "person"
    assert "hides its gains" in told.findings[0].evidence
    assert "handtouch calibrate" in told.findings[0].remedy
    assert calibrations(words, 2) == []


def test_a_unit_that_is_known_is_trusted_at_once(bench: Bench, swapped: Swapped) -> None:
    _, path = swapped
    slow = half(bench, path)
    words = slow.take(bench.introduce([11, 12, 5], [7, None, None]), NOW + timedelta(hours=1))
    for pad, serial in ((0, 11), (1, 12)):
        assert judged(words, pad).trust == "trusted"
        (recalled,) = calibrations(words, pad)
        assert recalled.name.startswith(f"{serial}-")
        assert np.log(recalled.gains) == pytest.approx(np.log(bench.gains[pad]), abs=0.01)
        assert recalled.offset_counts == (0.0,) * 4


def test_a_swap_while_nobody_looked_is_noticed_by_the_store(bench: Bench, swapped: Swapped) -> None:
    _, path = swapped
    words = half(bench, path).take(bench.introduce([99, 12, 13]), NOW)
    assert judged(words, 0).trust == "quarantined"
    assert "serial 11 was here, 99 is" in judged(words, 0).findings[0].cause


def test_a_calibration_under_other_tables_is_not_applied_and_told(bench: Bench, tmp_path: Path) -> None:
    path = tmp_path / "c.db"
    gains = Gains((1.1, 1.0, 1.0, 1.0), tuple((0.0,) * 4 for _ in range(4)))
    with Store(path) as store:
        store.write(11, "nominal-other", Calibration(gains), Provenance("by hand"), NOW)
    words = half(bench, path).take(bench.introduce([11, 2, 3]), NOW)
    assert calibrations(words, 0) == []
    assert judged(words, 0).trust == "nominal"
    assert "it was made under nominal-other" in judged(words, 0).calibrating


def later(bench: Bench, slow: SlowHalf, seconds: float) -> list[Word]:
    """What is said when so long has gone by without a touch."""
    nothing = np.zeros((13, 3, 4)), np.zeros((13, 3), np.uint32)
    return slow.take(bench.block(*nothing, round(seconds * 1e9)), NOW)


def test_what_others_store_while_it_runs_is_taken_within_seconds(bench: Bench, swapped: Swapped) -> None:
    """By a rollback, say: its gains are applied, and contacts go on from them."""
    slow = half(bench, swapped[1])
    slow.take(bench.introduce([11, 12, 5]), NOW)
    assert all(isinstance(word, Alive) for word in later(bench, slow, 3.0))
    gains = Gains((1.2, 1.0, 1.0, 0.9), matrix(1e-6 * np.eye(4)))
    with Store(swapped[1]) as store:
        newest = store.newest(11)
        assert newest is not None
        made = store.write(11, newest.config, Calibration(gains), Provenance("by hand"), NOW)
    (applied,) = calibrations(later(bench, slow, 6.0), 0)
    assert applied.name == made.name
    assert applied.gains == pytest.approx(gains.factors)
    with Store(swapped[1]) as store:  # for the tests after this one
        store.roll_back(11, newest.number, Provenance(""), NOW)
    (applied,) = calibrations(later(bench, slow, 9.0), 0)
    assert newest.calibration.gains is not None
    assert applied.gains == pytest.approx(newest.calibration.gains.factors)


def test_gains_that_a_person_gave_end_a_quarantine_and_are_gone_on_from(
    bench: Bench, session: Session, tmp_path: Path
) -> None:
    slow = half(bench, tmp_path / "c.db")
    slow.take(bench.introduce([11, 12, 13], [1, 2, 3]), NOW)
    gains, wide = (1.5, 1.0, 1.0, 1.0), tuple((1e-4 * (np.eye(4) - 0.25)).ravel().tolist())
    word = Calibrate(pad=2, serial=13, name="bench.1", gains=gains, covariance=wide)
    words = slow.take(msgpack.unpackb(put(word, ["gains"])), NOW)
    assert calibrations(words, 2) == [word]  # told again, as what is stored may have undone it
    assert (judged(words, 2).trust, judged(words, 2).findings) == ("trusted", ())
    assert "gains given or stored, known to 0.87 %" in judged(words, 2).calibrating
    near = Calibrate(pad=0, serial=11, name="bench", gains=tuple(1.1 * bench.gains[0]), covariance=wide)
    slow.take(msgpack.unpackb(put(near, ["gains"])), NOW)
    last = calibrations(play(slow, bench, session), 0)[-1]
    assert np.log(last.gains) == pytest.approx(np.log(near.gains), abs=0.01)  # with the factor they share
    assert slow.take(msgpack.unpackb(put(near.model_copy(update={"serial": 99}), ["gains"])), NOW) == []


def test_gains_that_no_amplifier_has_are_told_and_never_applied(
    bench: Bench, session: Session, tmp_path: Path
) -> None:
    slow = half(bench, tmp_path / "c.db")
    slow.take(bench.introduce([11, 12, 13]), NOW)
    wide = tuple((1e-2 * (np.eye(4) - 0.25)).ravel().tolist())
    given = Calibrate(pad=0, serial=11, name="bench", gains=(9.9,) * 4, covariance=wide)
    slow.take(msgpack.unpackb(put(given, ["gains"])), NOW)
    words = play(slow, bench, session)
    assert all(max(word.gains) <= 10 for word in calibrations(words, 0))
    doubts = [word for word in words if isinstance(word, Judged) and word.pad == 0 and word.findings]
    assert "no amplifier has these" in doubts[0].findings[0].cause


def test_a_guided_session_ends_the_quarantine_of_a_pad_that_hides_its_gains(
    bench: Bench, tmp_path: Path
) -> None:
    slow = half(bench, tmp_path / "c.db")
    assert judged(slow.take(bench.introduce([11, 12, 13], [1, 2, 3]), NOW), 2).trust == "person"
    law = Law(21_000.0, 1.4, 2400.0, matrix(np.diag([1e-4, 1e-4, 1e-6])))
    with Store(tmp_path / "c.db") as store:
        store.write(13, "nominal-strip", Calibration(law=law), Provenance("guided session"), NOW)
    words = later(bench, slow, 3.0)
    (applied,) = calibrations(words, 2)
    assert applied.law is not None
    assert applied.law.alpha == 1.4
    assert np.diag(np.reshape(applied.covariance, (4, 4))) == pytest.approx([0.05**2 * 0.75] * 4)
    assert judged(words, 2).trust == "trusted"


def test_another_units_calibration_is_applied_where_a_person_took_it_over_and_says_so(
    bench: Bench, tmp_path: Path
) -> None:
    gains = Gains((1.1, 1.0, 1.0, 1.0), matrix(1e-6 * np.eye(4)))
    taken = Provenance("gains from contacts", foreign="it was made for serial 9, not for 11")
    with Store(tmp_path / "c.db") as store:
        store.write(11, "nominal-square", Calibration(gains), taken, NOW)
    slow = half(bench, tmp_path / "c.db")
    words = slow.take(bench.introduce([11, 12, 13], [1, None, None]), NOW)
    (applied,) = calibrations(words, 0)
    assert applied.covariance[0] > 0.04**2 * 0.75
    (finding,) = judged(words, 0).findings
    assert judged(words, 0).trust == "nominal"
    assert (finding.kind, finding.evidence) == ("foreign calibration", taken.foreign)
    assert "rollback" in finding.remedy


def test_units_that_share_a_number_or_have_none_learn_nothing(
    bench: Bench, session: Session, tmp_path: Path
) -> None:
    slow = half(bench, tmp_path / "c.db")
    words = slow.take(bench.introduce([7, 7, 0], [None, None, 3]), NOW)
    assert "2 nodes tell the serial number 7" in judged(words, 0).calibrating
    assert judged(words, 2).trust == "person"
    assert "no serial number" in judged(words, 2).calibrating
    words = play(slow, bench, session[:40])
    assert not any(isinstance(word, Calibrate) for word in words)
    slow.finish(NOW)
    with Store(tmp_path / "c.db") as store:
        assert store.units() == []


def test_gains_that_jump_put_a_trusted_unit_into_quarantine_and_out_again(
    bench: Bench, session: Session, swapped: Swapped
) -> None:
    slow = half(bench, swapped[1])
    slow.take(bench.introduce([11, 12, 5]), NOW)
    jump = np.array([1.3, 1.0, 1.0, 0.8])
    words = play(slow, bench, [(counts * jump, contact) for counts, contact in session])
    told = [word for word in words if isinstance(word, Judged) and word.pad == 0]
    changed = next(word for word in told if word.trust == "quarantined")
    assert changed.findings[0].kind == "changed gains"
    assert told[-1].trust == "trusted"


def test_a_damaged_store_is_told_put_aside_and_the_work_goes_on(bench: Bench, tmp_path: Path) -> None:
    path = tmp_path / "c.db"
    with Store(path) as store:
        store.write(11, "nominal-square", Calibration(), Provenance("by hand"), NOW)
    data = bytearray(path.read_bytes())
    data[len(data) // 2 :] = bytes(len(data) - len(data) // 2)
    path.write_bytes(data)
    archive = Archive(path)
    slow = SlowHalf(bench.start, archive)
    words = slow.take(bench.introduce([11, 2, 3]), NOW)
    assert "is damaged" in archive.trouble
    assert any("store" in finding.kind for finding in judged(words, 0).findings)
    assert len(list(tmp_path.glob("c.db.damaged-*"))) == 1
    assert archive.keep(11, slow._rows[0].place, Provenance("x"), NOW, gains=None) is not None


def test_a_store_that_cannot_be_used_stops_nothing(bench: Bench, session: Session, tmp_path: Path) -> None:
    path = tmp_path / "c.db"
    path.write_text("not a store")
    slow = half(bench, path)
    words = slow.take(bench.introduce([11, 2, 3], [1, None, None]), NOW) + play(slow, bench, session)
    assert judged(words, 0).trust == "trusted"
    assert path.read_text() == "not a store"


def test_what_is_kept_later_drops_nothing_that_was_stored_before(bench: Bench, tmp_path: Path) -> None:
    """A law of a guided session, stored by another process while the slow half runs, outlives new gains."""
    archive, place = Archive(tmp_path / "c.db"), half(bench, tmp_path / "c.db")._rows[0].place
    law = Law(21_000.0, 1.4, 2400.0, matrix(np.diag([1e-4, 1e-4, 1e-6])))
    gains = Gains((1.1, 1.0, 1.0, 0.9), matrix(1e-6 * np.eye(4)))
    assert archive.keep(11, place, Provenance("gains from contacts"), NOW, gains=gains)
    with Store(tmp_path / "c.db") as store:
        store.write(11, place.config, Calibration(gains=gains, law=law), Provenance("weights"), NOW)
    later = Gains((1.2, 1.0, 1.0, 0.9), matrix(1e-6 * np.eye(4)))
    kept = archive.keep(11, place, Provenance("gains from contacts"), NOW, gains=later)
    assert kept is not None
    assert (kept.calibration.gains, kept.calibration.law) == (later, law)
    archive.close()
