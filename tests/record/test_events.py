"""Reference forces and gravity are inputs of a tick: recorded with it, and replayed bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from handtouch import wire
from handtouch.config import parse
from handtouch.core.events import ExcitationEvent
from handtouch.core.pipeline import Pipeline
from handtouch.core.sheet_force import ForceReference
from handtouch.daemon.table_cache import build_pad_model
from handtouch.record.exact_replay import ExactReplay
from handtouch.record.recording import Recording

from .conftest import DEPLOYMENT, PERIOD_NS, SESSION, CollectingSink, Hand, RecordingSession


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> RecordingSession:
    deployment = parse(DEPLOYMENT.replace("[touch]", "[sheet.s.behaviour]\ngain_std = 0.2\n\n[touch]"))
    model = build_pad_model(deployment)

    def make(take: Callable[[list[bytes]], None]) -> Hand:
        sink = CollectingSink(take)
        return Hand(deployment, Pipeline(model, PERIOD_NS, 0.6, sink, SESSION), sink)

    return RecordingSession(make, tmp_path_factory.mktemp("external"))


def test_reference_forces_and_gravity_are_replayed_from_any_state(session: RecordingSession) -> None:
    hand, random = session.hand, np.random.default_rng(3)
    load = hand.pipeline.tick.baseline.link_load
    load.coefficients[:] = random.normal(0, 5, load.coefficients.shape)  # so that it has an effect
    session.send_retained()
    samples = {0: hand.counts(0, 0.4, 0.3, 1e-3), 1: hand.counts(1, 0.5, 0.6, 2e-3)}
    for tick in range(600):
        if tick % 20 == 0:
            down = random.normal(size=(2, 3))
            hand.pipeline.set_felt_gravity(down / np.linalg.norm(down, axis=1, keepdims=True))
        if tick == 300:
            session.send_retained()
        if tick % 30 == 15 and tick > 300:
            force = 1.3 * hand.pipeline.tick.sheet_force.force_n
            hand.pipeline.add_force_reference(
                ForceReference(np.array([1, 0]), force[::-1], 0.02 * force, hand.t_ns)
            )
        if tick == 450:
            session.send_retained()  # a state between an input and its tick
            hand.pipeline.add_force_reference(
                ForceReference(np.array([0]), np.ones(1), np.ones(1), hand.t_ns)
            )
        hand.step(samples if tick > 40 else {0: b"\0" * 8, 1: b"\0" * 8})
    gains = hand.pipeline.tick.sheet_force.log_gain
    assert (np.abs(gains) > 0.02).all()
    assert hand.pipeline.tick.baseline.link_load.felt.any()
    hand.pipeline.end_session(hand.t_ns + PERIOD_NS)
    session.recorder.finish()
    with_events = sum(len(m.events) > 0 for m in hand.sink.messages if isinstance(m, wire.TickInputs))
    assert 30 < with_events < 60
    entries = list(Recording(Path(session.paths[0])))
    starts = [number for number, entry in enumerate(entries) if entry.topic == "state"][1:]
    assert len(starts) == 3
    config = next(entry for entry in entries if entry.topic == "config")
    for start in starts:
        contacts: list[wire.Contact] = []
        replay = ExactReplay(contacts.append)
        for entry in [config, *entries[start:]]:
            replay.process_message(entry)
        assert replay.result.first_difference is None
        assert replay.result.equal == replay.result.compared == len(contacts) > 100
        assert replay.pipeline is not None
        np.testing.assert_array_equal(replay.pipeline.tick.sheet_force.log_gain, gains)


def test_a_replay_is_exact_after_excitation_was_switched_off(tmp_path: Path) -> None:
    deployment = parse(DEPLOYMENT.replace("[touch]", "[sheet.s.behaviour]\ngain_std = 0.2\n\n[touch]"))
    model = build_pad_model(deployment)

    def make(take: Callable[[list[bytes]], None]) -> Hand:
        sink = CollectingSink(take)
        return Hand(deployment, Pipeline(model, PERIOD_NS, 0.6, sink, SESSION), sink)

    made = RecordingSession(make, tmp_path)
    hand, press = made.hand, {0: made.hand.counts(0, 0.4, 0.3, 1e-3)}
    for tick in range(600):
        if tick in (250, 400):
            hand.pipeline.add_event(ExcitationEvent((tick == 400,) * 2))
        hand.step(press if tick < 240 or tick > 420 else {})
    hand.pipeline.end_session(hand.t_ns + PERIOD_NS)
    made.recorder.finish()
    contacts: list[wire.Contact] = []
    replay = ExactReplay(contacts.append)
    for entry in Recording(Path(made.paths[0])):
        replay.process_message(entry)
    assert replay.result.first_difference is None
    assert replay.result.equal == replay.result.compared > 300
