"""Diagnoses of pads that aren't sheets with electrodes."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.hand_touches import draw_touches
from handtouch.config import load, shipped
from handtouch.simulate.faults import DeadElectrode
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, Family
from handtouch.supervisor.diagnose.hand_diagnostics import HandDiagnostics
from handtouch.supervisor.diagnose.model import DiagnosisModel, HandSamples

BLOCK = 50
DEAD = {"tip": "t5", "middle": "t2"}


@pytest.mark.parametrize("dead", [DEAD, {}], ids=["dead", "healthy"])
def test_dead_taxels_are_named_by_ordinary_contacts_and_healthy_ones_are_not(dead: dict[str, str]) -> None:
    drawn = WORLDS["default"].draw(Family.TUNING.seed(0))
    deployment = drawn.describe(load(shipped.path("taxels.toml")))
    stimulus = Scenario(touch=draw_touches(list(DEAD), 60, drawn.seed))
    faults = [DeadElectrode(link=link, electrode=name, from_s=0.0) for link, name in dead.items()]
    hand = VirtualHand(deployment, stimulus, drawn, faults=faults)
    times_s = np.arange(0.0, 2.0 + 60 * 0.65, 0.01)
    counts = np.zeros((len(times_s), len(DEAD), 9), np.int64)
    for row in range(len(DEAD)):
        own = hand.counts(row, times_s)
        counts[:, row, : own.shape[1]] = own
    model = DiagnosisModel.from_deployment(deployment, "finger")
    diagnostics = HandDiagnostics(model, offset_counts=np.zeros((len(DEAD), 9)))
    sample_ns = (1e9 * (1.0 + times_s)).astype(np.int64)
    for begin in range(0, len(times_s) - BLOCK, BLOCK):
        block = slice(begin, begin + BLOCK)
        stamps = np.repeat(sample_ns[block, None], len(DEAD), axis=1)
        diagnostics.process_block(HandSamples(stamps, counts[block], np.ones(stamps.shape, np.bool_)))
    found = {one.link: one.electrodes for one in diagnostics.diagnoses()}
    assert found == {link: (name,) for link, name in dead.items()}
    assert {model.links[row] for row in diagnostics.dead_electrodes()} == dead.keys()
