"""Process grips of a simulated hand with the daemon's pipeline and percepts, tick by tick."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.daemon_settings import pipeline_of
from benchmarks.inline_process import InlineProcess
from handtouch import wire
from handtouch.config import Deployment, load
from handtouch.core.pad_model import PadModel
from handtouch.core.scene import RequestedOutputs
from handtouch.daemon.percepts import PerceptPublisher
from handtouch.simulate.grip_touch import GripTouch
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import DrawnWorld
from handtouch.wire import PERCEPT_KINDS

FloatArray = npt.NDArray[np.float64]
ROOT = Path(__file__).parent.parent
DEPLOYMENT = load(ROOT / "config" / "utah_mit.toml")


class PerceptCollector:
    """Publisher that collects percepts."""

    def __init__(self) -> None:
        self.percepts: list[wire.Percept] = []

    def has_subscriber(self, topic: str) -> bool:
        return topic.startswith("percept/")

    def send(self, message: wire.OutgoingMessage) -> None:
        if isinstance(message, wire.Percept):
            self.percepts.append(message)


@dataclass
class Record:
    """Results by tick: times [s] (k,) since the begin; ln R, force [N], running tests (k, pads)."""

    t_s: FloatArray
    log_odds: FloatArray
    force_n: FloatArray
    running: npt.NDArray[np.bool_]
    tick_s: FloatArray
    """(k,), duration of the tick."""
    slip_s: FloatArray
    """(k,), duration of the slip stage, after the messages of the contacts."""
    report_s: FloatArray
    """(k,), duration of the motion percepts."""
    percepts: list[wire.Percept]
    information: tuple[FloatArray, FloatArray]
    """At `information_s`: ages [s] of ramps (pads, onsets), and information of 1 m/s along either axis.

    The information is twice the mean logarithm of the likelihood ratio.
    """
    samples_per_false_alarm: float
    """Mean samples between false alarms, the threshold on R of an alarm."""
    load: float = 1.0
    """Force during the slip, relative to that before."""


def pads_of(deployment: Deployment) -> list[tuple[str, tuple[float, float]]]:
    """Return link and size [mm] of every pad, along x, and at the middle along y."""
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
    grips: list[GripTouch],
    world: DrawnWorld,
    hz: float,
    seconds: float,
    from_s: float = 0.0,
    information_s: float = 0.0,
) -> Record:
    """Process grips, each one contact on its link's pad, from `from_s` of the scenario on."""
    deployment, period_ns = world.describe(DEPLOYMENT), round(1e9 / hz)
    hand = VirtualHand(deployment, Scenario.model_validate({"touch": grips}), world)
    times = from_s + np.arange(1, round(seconds * hz) + 1) / hz
    counts = np.stack([hand.counts(row, times) for row in range(len(hand.pads))], axis=1)
    collector, model = PerceptCollector(), PadModel(deployment)
    pipeline = pipeline_of(deployment, collector, model=model, period_ns=period_ns)
    perceiving = PerceptPublisher(deployment, pipeline, collector, process=InlineProcess(deployment))
    all_pads = np.ones(model.size, dtype=np.bool_)
    percepts = np.zeros((len(PERCEPT_KINDS), model.size), dtype=np.bool_)
    percepts[PERCEPT_KINDS.index("motion")] = True
    requested = RequestedOutputs(all_pads, all_pads, np.ones(model.size, np.int64), ~all_pads, ~all_pads)
    requested = requested._replace(percepts=percepts)
    pipeline.apply_demand(requested)
    perceiving.set_requested(requested, 0)
    slip, queued_s = pipeline.tick.slip, [0.0]
    pipeline.on_messages_queued = lambda: queued_s.append(time.thread_time())
    shape = len(times), model.size
    log_odds, force, running = np.empty(shape), np.empty(shape), np.empty(shape, dtype=np.bool_)
    durations_s = np.empty((3, len(times)))
    payload, information = counts.astype("<i2"), (np.zeros((model.size, 0)), np.zeros((model.size, 0)))
    for k, t_s in enumerate(times.tolist()):
        t_ns = 10**9 + round(t_s * 1e9)
        pipeline.begin_cycle(t_ns, t_ns)
        for pad in range(model.size):
            pipeline.slab.write_pdo(pad, payload[k, pad].tobytes(), t_ns + 1000 + pad)
        began_s = time.thread_time()
        ticked = pipeline.tick_if_due(t_ns + round(0.7 * period_ns))
        assert ticked is not None
        ticked_s = time.thread_time()
        perceiving.process_tick(ticked, t_ns)
        perceived_s = time.thread_time()
        pipeline.prepare_next_tick()
        durations_s[:, k] = queued_s[-1] - began_s, ticked_s - queued_s[-1], perceived_s - ticked_s
        log_odds[k], running[k] = slip.column("log_ratio"), slip.column("slipping") != 0
        if k == round(information_s * hz):
            per_axis = [slip.column(f"information_{axis}") for axis in "xy"]
            information = slip.column("onset_ages_s").copy(), np.mean(per_axis, axis=0)
        force[k] = pipeline.tick.columns.force_n
    return Record(
        times - from_s,
        log_odds,
        force,
        running,
        durations_s[0],
        durations_s[1],
        durations_s[2],
        collector.percepts,
        information,
        slip.samples_per_false_alarm,
    )
