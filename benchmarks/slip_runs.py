"""Grips on a simulated hand through the daemon's own pipeline and perception, tick by tick."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from handtouch import wire
from handtouch.config import Deployment, load
from handtouch.daemon.model import PadModel
from handtouch.daemon.perceive import Perceiving
from handtouch.daemon.pipeline import Pipeline
from handtouch.daemon.scene import Wanted
from handtouch.percept.motion import Motion
from handtouch.percept.stream import KINDS
from handtouch.simulate.grip import Grip
from handtouch.simulate.hand import VirtualHand
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.world import World
from handtouch.wire import PadState

FloatArray = npt.NDArray[np.float64]
ROOT = Path(__file__).parent.parent
DEPLOYMENT = load(ROOT / "config" / "utah_mit.toml")


class Taker:
    """Keeps percepts."""

    def __init__(self) -> None:
        self.percepts: list[wire.Percept] = []

    def wants(self, topic: str) -> bool:
        return topic.startswith("percept/")

    def send(self, message: wire.Outgoing) -> None:
        if isinstance(message, wire.Percept):
            self.percepts.append(message)


@dataclass
class Record:
    """Of a run, by tick: times [s] (k,) from its begin, and (k, pads): ln R, force [N], who runs."""

    t_s: FloatArray
    log_odds: FloatArray
    force_n: FloatArray
    running: npt.NDArray[np.bool_]
    tick_s: FloatArray
    """(k,) that samples to contacts took, and the next: what perception added"""
    perceive_s: FloatArray
    percepts: list[wire.Percept]
    information: tuple[FloatArray, FloatArray]
    """at `look_s`: ages [s] of ramps (pads, onsets), and what a ramp of 1 m/s along either axis would have
    told by then, in the mean: twice the mean of ln of its likelihood ratio"""
    per_alarm: float
    """threshold on R of an alarm"""
    load: float = 1.0
    """force while slipping, as a part of that before"""


def pads_of(deployment: Deployment) -> list[tuple[str, tuple[float, float]]]:
    """Link and size [mm], along x and at the middle along y, of every pad."""
    found = []
    for hand in deployment.hands:
        for pad in hand.pads:
            surface: Any = pad.surface
            width = getattr(surface, "width_mm", None)
            if width is None:
                radius = getattr(surface, "radius_mm", None) or surface.near_radius_mm
                width = radius * np.radians(surface.arc_deg)
            length = getattr(surface, "length_mm", None) or getattr(surface, "slant_mm", None)
            if length is None:
                length = surface.radius_mm * np.radians(surface.to_deg - surface.from_deg)
            found.append((pad.link, (float(length), float(width))))
    return found


def run(
    grips: list[Grip], world: World, hz: float, seconds: float, from_s: float = 0.0, look_s: float = 0.0
) -> Record:
    """Every grip is one contact on its link's pad; the run begins at `from_s` of the scenario."""
    deployment, period_ns = DEPLOYMENT, round(1e9 / hz)
    hand = VirtualHand(deployment, Scenario.model_validate({"touch": grips}), world)
    times = from_s + np.arange(1, round(seconds * hz) + 1) / hz
    counts = np.stack([hand.counts(row, times) for row in range(len(hand.pads))], axis=1)
    taker, model = Taker(), PadModel(deployment)
    pipeline = Pipeline(model, period_ns, 0.6, taker)
    pipeline.node_state[:] = PadState.CLEAR
    perceiving = Perceiving(pipeline, taker)
    every = np.ones(model.size, dtype=np.bool_)
    percepts = np.zeros((len(KINDS), model.size), dtype=np.bool_)
    percepts[KINDS.index("motion")] = True
    wanted = Wanted(every, every, np.zeros(model.size), np.ones(model.size, np.int64), ~every, ~every)
    pipeline.want(wanted)
    perceiving.want(wanted._replace(percepts=percepts))
    motion = next(part for part in perceiving._perceiver.parts if isinstance(part, Motion))  # type: ignore[union-attr]
    shape = len(times), model.size
    log_odds, force, running = np.empty(shape), np.empty(shape), np.empty(shape, dtype=np.bool_)
    took = np.empty((2, len(times)))
    payload, known = counts.astype("<i2"), (np.zeros((model.size, 0)), np.zeros((model.size, 0)))
    for k, t_s in enumerate(times.tolist()):
        t_ns = 10**9 + round(t_s * 1e9)
        pipeline.begin(t_ns, t_ns)
        for pad in range(model.size):
            pipeline.slab.write(pad, payload[k, pad].tobytes(), t_ns + 1000 + pad)
        began_s = time.perf_counter()
        ticked = pipeline.advance(t_ns + round(0.7 * period_ns))
        assert ticked is not None
        ticked_s = time.perf_counter()
        perceiving.step(ticked)
        perceived_s = time.perf_counter()
        pipeline.settle()
        took[:, k] = ticked_s - began_s, perceived_s - ticked_s
        log_odds[k], running[k] = motion.test.log_odds, motion.running
        if k == round(look_s * hz):
            known = motion.test.told()
        force[k] = pipeline.tick.columns.force_n
    return Record(
        times - from_s,
        log_odds,
        force,
        running,
        took[0],
        took[1],
        taker.percepts,
        known,
        motion.test.per_alarm,
    )
