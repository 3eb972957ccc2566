"""Forces and gravity that a robot tells are inputs of a tick: recorded so, and made again bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from handtouch import wire
from handtouch.config import parse
from handtouch.daemon.model import PadModel
from handtouch.daemon.pipeline import Pipeline
from handtouch.daemon.rerun import Again
from handtouch.record.read import Recording
from handtouch.supervise.strength import ForceReference

from .conftest import DEPLOYMENT, PERIOD_NS, RUN, Hand, Session, Taker


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    deployment = parse(DEPLOYMENT.replace("[touch]", "[sheet.s.behaviour]\ngain_std = 0.2\n\n[touch]"))
    model = PadModel(deployment)

    def make(take: Callable[[list[bytes]], None]) -> Hand:
        taker = Taker(take)
        return Hand(deployment, Pipeline(model, PERIOD_NS, 0.6, taker, RUN), taker)

    made = Session(make, tmp_path_factory.mktemp("told"))
    made.hand.step({})  # the state is told once
    return made


def test_what_a_robot_tells_is_replayed_from_ticks_and_costs_no_state(session: Session) -> None:
    hand, random = session.hand, np.random.default_rng(3)
    states = sum(isinstance(m, wire.State) for m in hand.taken.messages)
    touch = {0: hand.counts(0, 0.4, 0.3, 1e-3), 1: hand.counts(1, 0.5, 0.6, 2e-3)}
    for tick in range(600):
        if tick % 20 == 0:
            way = random.normal(size=(2, 3))
            hand.pipeline.told.turn(way / np.linalg.norm(way, axis=1, keepdims=True))
        if tick == 300:  # so that gravity has a say
            hand.pipeline.tick.baseline.by_gravity[:] = random.normal(0, 5, (2, 4, 3))
            hand.pipeline.tick.disturbed = True
        if tick % 30 == 15 and tick > 300:
            force = 1.3 * hand.pipeline.tick.strength.force_n
            hand.pipeline.told.refer(ForceReference(np.array([1, 0]), force[::-1], 0.02 * force, hand.t_ns))
        if tick == 450:
            hand.pipeline.tick.disturbed = True  # a state between what was told and the tick that takes it
            hand.pipeline.told.refer(ForceReference(np.array([0]), np.ones(1), np.ones(1), hand.t_ns))
        hand.step(touch if tick > 40 else {0: b"\0" * 8, 1: b"\0" * 8})
    gains = hand.pipeline.tick.strength.log_gain
    assert (np.abs(gains) > 0.02).all()
    assert hand.pipeline.tick.baseline.gravity is not None
    hand.pipeline.end(hand.t_ns + PERIOD_NS)
    session.recorder.finish()
    messages = hand.taken.messages
    assert sum(isinstance(m, wire.State) for m in messages) == states + 2
    assert sum("told" in m.others for m in messages if isinstance(m, wire.TickInputs)) < 60
    entries = list(Recording(Path(session.paths[0])))
    starts = [number for number, entry in enumerate(entries) if entry.topic == "state"]
    config = next(entry for entry in entries if entry.topic == "config")
    for start in starts:
        made: list[wire.Contact] = []
        again = Again(made.append)
        for entry in [config, *entries[start:]]:
            again.feed(entry)
        assert again.found.first is None
        assert again.found.same == again.found.compared == len(made) > 100
        assert again.pipeline is not None
        np.testing.assert_array_equal(again.pipeline.tick.strength.log_gain, gains)
