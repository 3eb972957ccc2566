"""A recording of a hand with a shear pad repeats its force vectors, and has the counts of all channels."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from handtouch import wire
from handtouch.config import parse
from handtouch.core.events import BaselineEvent
from handtouch.core.pipeline import Pipeline
from handtouch.daemon.reload import find_changes
from handtouch.daemon.sampling import SamplingController
from handtouch.daemon.table_cache import build_pad_model
from handtouch.daemon.tare import TareJob
from handtouch.record.exact_replay import ExactReplay
from handtouch.record.export import rows_of
from handtouch.record.recording import Recording
from tests.core.shear_bench import LAYOUT, ShearBench, shear_deployment
from tests.record.conftest import PERIOD_NS, SESSION, CollectingSink, Hand, RecordingSession

KINDS = ("crossed",)


class ShearHand(Hand):
    """A pad above a shear pad; `press` is a cycle with both samples, or with the touch pad's PDO only."""

    bench = ShearBench(KINDS)

    faulty: int | None = None
    """counts of the first channel of the shear pad, None: as they are"""

    def press(self, current_a: float, moved_m: Any, *, complete: bool = True) -> None:
        """Press the middle of the pad with a current while the skin has moved (2,)."""
        self.t_ns += PERIOD_NS
        pipeline = self.pipeline
        pipeline.begin_cycle(self.t_ns, self.t_ns)
        shear = np.rint(self.bench.counts(0, moved_m, 0.0)).astype("<i2")
        if self.faulty is not None:
            shear[0] = self.faulty
        for number, data in enumerate((self.counts(0, 0.45, 0.5, current_a), shear.tobytes())):
            if complete or number == 0:
                pipeline.slab.write_pdo(0, data, self.t_ns + 1000 + number, number)
        pipeline.tick_if_due(self.t_ns + PERIOD_NS * 3 // 4)
        pipeline.prepare_next_tick()


@pytest.fixture(scope="module")
def make_shear_hand() -> Callable[..., ShearHand]:
    deployment = parse(shear_deployment(KINDS))
    model = build_pad_model(deployment)

    def make(take: Callable[[list[bytes]], None] = lambda _: None) -> ShearHand:
        sink = CollectingSink(take)
        pipeline = Pipeline(copy.deepcopy(model), PERIOD_NS, 0.6, sink, SESSION)
        pipeline.slab.set_layout(0, LAYOUT)
        pipeline.node_state[:] = wire.PadState.CLEAR
        return ShearHand(deployment, pipeline, sink)

    return make


@pytest.fixture(scope="module")
def recorded(
    make_shear_hand: Callable[..., ShearHand], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, list[wire.Contact]]:
    """A recording: rest, a pull, a tare, a pull in which the second PDO stays out."""
    session = RecordingSession(make_shear_hand, tmp_path_factory.mktemp("shear"))
    hand = session.hand
    assert isinstance(hand, ShearHand)
    for _ in range(100):
        hand.press(0.0, (0.0, 0.0))
    for tick in range(40):
        hand.press(1e-3, (5e-6 * tick, 0.0))
    for _ in range(30):
        hand.press(0.0, (0.03e-3, 0.0))
    rest = tuple(hand.bench.counts(0, (0.03e-3, 0.0), 0.0).tolist())
    hand.pipeline.add_event(BaselineEvent(0, (0.0,) * 4, (0.1,) * 4, rest))
    session.send_retained()
    for tick in range(20):
        hand.press(1e-3, (0.03e-3, 5e-6 * tick))
    for _ in range(12):
        hand.press(1e-3, (0.03e-3, 0.1e-3), complete=False)
    hand.pipeline.end_session(hand.t_ns + PERIOD_NS)
    session.recorder.finish()
    return session.paths[0], hand.sink.contacts()


def test_force_vectors_of_a_recording_are_repeated_bit_for_bit(recorded: Any) -> None:
    path, sent = recorded
    contacts: list[wire.Contact] = []
    replay = ExactReplay(contacts.append)
    for entry in Recording(path):
        replay.process_message(entry)
    assert replay.result.first_difference is None
    assert replay.result.equal == replay.result.compared == len(contacts) == len(sent)
    assert sum(contact.force_vector_n is not None for contact in contacts) > 50


def test_vectors_follow_the_skin_from_the_rest_position_of_the_last_tare(recorded: Any) -> None:
    _, sent = recorded
    first, second = ([c for c in sent if c.id == number and c.fresh] for number in (1, 2))
    pulls = [np.hypot(*np.subtract(c.force_vector_n, first[0].force_vector_n)[:2]) for c in first[:-1]]
    assert pulls[-1] == pytest.approx(max(pulls))
    assert max(pulls) > 1.0  # 0.19 mm of 12 N/mm
    assert second[0].peak_force_n is not None
    assert np.trace(np.reshape(second[0].force_vector_covariance_n2, (3, 3))) < np.trace(
        np.reshape(first[-2].force_vector_covariance_n2, (3, 3))
    )


class FullRate:
    """A sampling controller of pads that are always sampled."""

    def request_full_rate(self, pads: Any, now_ns: int) -> None: ...


def test_a_tare_measures_the_rest_position(make_shear_hand: Callable[..., ShearHand]) -> None:
    hand = make_shear_hand()
    for _ in range(100):
        hand.press(0.0, (0.0, 0.0))
    tare = TareJob(
        [("h", "tip0")], np.ones(1, np.bool_), hand.pipeline, cast(SamplingController, FullRate()), hand.t_ns
    )
    while (done := tare.poll(hand.t_ns)) is None:
        hand.press(0.0, (0.05e-3, -0.02e-3))
    assert [pad["tared"] for pad in done["pads"]] == [True]
    hand.press(0.0, (0.05e-3, -0.02e-3))  # the tick that applies it
    np.testing.assert_allclose(hand.pipeline.state.shear_rest_m[0, :2], (0.05e-3, -0.02e-3), atol=1e-6)


@pytest.mark.parametrize(("counts", "status"), [(32767, "saturated"), (0, "dead")])
def test_a_faulty_channel_of_a_shear_pad_is_no_rest_position(
    make_shear_hand: Callable[..., ShearHand], counts: int, status: str
) -> None:
    hand = make_shear_hand()
    hand.faulty = counts
    for _ in range(100):
        hand.press(0.0, (0.0, 0.0))
    before = hand.pipeline.state.shear_rest_m.copy()
    tare = TareJob(
        [("h", "tip0")], np.ones(1, np.bool_), hand.pipeline, cast(SamplingController, FullRate()), hand.t_ns
    )
    while (done := tare.poll(hand.t_ns)) is None:
        hand.press(0.0, (0.0, 0.0))
    assert done["pads"][0]["tared"] is False
    assert f"shear pad is {status}" in done["pads"][0]["reason"]
    hand.press(0.0, (0.0, 0.0))
    np.testing.assert_array_equal(hand.pipeline.state.shear_rest_m, before)


def test_a_missing_pdo_of_the_shear_pad_is_a_missing_sample_of_the_pad(recorded: Any) -> None:
    _, sent = recorded
    silent = [contact for contact in sent if not contact.fresh]
    assert silent
    before = next(contact for contact in reversed(sent) if contact.fresh and contact.event == "update")
    assert silent[0].force_vector_n == before.force_vector_n
    assert sent[-1].event == "end"
    assert sent[-1].end_reason == "stale"


def test_recorded_ticks_have_the_counts_of_all_channels(recorded: Any) -> None:
    rows = [row for table, row in rows_of(Recording(recorded[0])) if table == "raw"]
    assert rows[5]["channel5_counts"] > 1000
    assert rows[120]["x0_counts"] > 100


@pytest.mark.parametrize(
    ("change", "changed_keys", "is_kept"),
    [
        (("begin_threshold_n = 0.1", "begin_threshold_n = 0.2"), ["touch"], True),
        (("[12.0, 10.0]", "[11.0, 10.5]"), ["shear.crossed"], False),
    ],
    ids=["threshold", "calibrated stiffness"],
)
def test_a_reload_keeps_the_rest_position_unless_the_shear_pad_changed(
    make_shear_hand: Callable[..., ShearHand], change: tuple[str, str], changed_keys: list[str], is_kept: bool
) -> None:
    hand = make_shear_hand()
    for _ in range(100):
        hand.press(0.0, (0.05e-3, 0.0))
    deployment = parse(shear_deployment(KINDS).replace(*change))
    changes, _ = find_changes(hand.deployment, deployment)
    assert changes == {0: changed_keys}
    hand.pipeline.replace_model(build_pad_model(deployment), [*changes])
    hand.press(0.0, (0.05e-3, 0.0))
    assert np.isfinite(hand.pipeline.state.shear_rest_m[0, 0]) == is_kept
