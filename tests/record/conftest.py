"""A small hand whose pipeline is driven tick by tick, and a recording of it, made without a socket."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handtouch import wire
from handtouch.config import Deployment, parse
from handtouch.daemon.model import PadModel
from handtouch.daemon.pipeline import Pipeline
from handtouch.record.file import RecordingFile
from handtouch.record.recorder import Limits, Recorder
from handtouch.wire import PadState

DEPLOYMENT = """
[daemon]
sync_period_ms = 5.0

[[bus]]
name = "can0"
interface = "virtual"
channel = "test"

[node.n]
drive_v = 5.0
full_scale_ma = 10.0
noise_counts = 1.0

[sheet.s]
ohm_per_square = 2400.0
contact_ohm_mm2 = 20000.0
alpha = 1.5
contact_radius_mm = 2.5
contact_radius_std_mm = 0.5

[touch]
on_n = 0.1
off_n = 0.05
begin_samples = 2
end_samples = 2

[[hand]]
name = "h"

[[hand.pad]]
link = "plane"
bus = "can0"
node_id = 1
node = "n"
sheet = "s"
surface = { kind = "plane", length_mm = 30.0, width_mm = 24.0 }
gap_mm = 0.6

[[hand.pad]]
link = "round"
bus = "can0"
node_id = 2
node = "n"
sheet = "s"
surface = { kind = "cylinder", radius_mm = 10.0, length_mm = 30.0, arc_deg = 150.0 }
gap_mm = 0.6
"""
PERIOD_NS = 5_000_000
WALL_NS = 1_700_000_000_000_000_000
RUN = 7


class Taker:
    """Keeps messages, and hands on what they are on the wire."""

    def __init__(self, take: Callable[[list[bytes]], None] = lambda _: None) -> None:
        self.messages: list[Any] = []
        self._take = take

    def wants(self, topic: str) -> bool:
        return not topic.startswith("raw/")

    def send(self, message: wire.Outgoing) -> None:
        sent = wire.encode(message)
        self.messages.append(wire.decode(sent))
        self._take(sent)

    def contacts(self) -> list[wire.Contact]:
        return [message for message in self.messages if isinstance(message, wire.Contact)]


@dataclass
class Hand:
    """A pipeline of two pads; `step` is a period in which a pad may be touched, be late or be gone."""

    deployment: Deployment
    pipeline: Pipeline
    taken: Taker
    t_ns: int = 10**9

    def counts(self, pad: int, x: float, y: float, current_a: float) -> bytes:
        """What the pad's node sends when a contact at (x, y), parts of its rectangle, injects a current."""
        model = self.pipeline.model
        side_a, side_b = model.locator.sides[pad]
        at = np.array([pad]), np.array([x * side_a]), np.array([y * side_b])
        fractions = model.locator.fractions(*at)[:, 0]
        counts = fractions * (current_a / model.ampere_per_count[pad])
        return bytes(np.rint(counts).astype("<i2").tobytes())

    def step(self, samples: dict[int, bytes], delay_ns: int = 1000, node_state: int = PadState.CLEAR) -> None:
        """One SYNC, the samples that answer it, the tick."""
        pipeline = self.pipeline
        pipeline.node_state[:] = node_state
        self.t_ns += PERIOD_NS
        pipeline.begin(self.t_ns, self.t_ns)
        for pad, data in samples.items():
            pipeline.slab.write(pad, data, self.t_ns + delay_ns + pad)
        pipeline.advance(self.t_ns + PERIOD_NS * 3 // 4)
        pipeline.settle()

    def stroke(self, ticks: int, seed: int = 1) -> None:
        """Strokes over both pads, with what happens on a bus in between."""
        random = np.random.default_rng(seed)
        for tick in range(ticks):
            phase = tick % 40 / 40
            samples = {
                0: self.counts(0, 0.2 + 0.6 * phase, 0.3, 1e-3 * (phase > 0.2) * (0.5 + phase)),
                1: self.counts(1, 0.5, 0.8 - 0.5 * phase, 2e-3 * (phase < 0.7)),
            }
            if random.random() < 0.1:
                samples.pop(int(random.integers(2)))
            self.step(samples, int(random.integers(1000, 4_000_000)))


@pytest.fixture(scope="session")
def deployment() -> Deployment:
    return parse(DEPLOYMENT)


@pytest.fixture(scope="session")
def model(deployment: Deployment) -> PadModel:
    return PadModel(deployment)


@pytest.fixture(scope="session")
def make_hand(deployment: Deployment, model: PadModel) -> Callable[..., Hand]:
    """A function that makes a hand; what it does to its model stays with it."""

    def make(take: Callable[[list[bytes]], None] = lambda _: None) -> Hand:
        taker = Taker(take)
        pipeline = Pipeline(copy.deepcopy(model), PERIOD_NS, 0.6, taker, RUN)
        return Hand(deployment, pipeline, taker)

    return make


def service(seq: int, t_ns: int, run: int = RUN) -> list[bytes]:
    """The daemon's heartbeat, which tells the time."""
    message = wire.Service(
        v=wire.SCHEMA_VERSION, run=run, seq=seq, t_ns=t_ns, wall_offset_ns=WALL_NS, version="0", pid=1,
        uptime_s=1.0, period_s=5e-3, hands={"h": ["plane", "round"]}, ticks=1, overruns=0, rate_hz=200.0,
        tick_us={}, loop={}, contacts=0, refused={}, process={}, buses={}, drops={"complete": 0},
        subscriptions=(), repeat=False,
    )  # fmt: skip
    return wire.encode(message)


def health(seq: int, t_ns: int, state: str = "clear", reason: str = "") -> list[bytes]:
    """How a pad fares."""
    message = wire.Health(
        v=wire.SCHEMA_VERSION, run=RUN, seq=seq, t_ns=t_ns, hand="h", link="plane", bus="can0", node_id=1,
        state=state, node="operational", since_ns=1, pace="sync", reason=reason, serial=None, rate_hz=200.0,
        samples=3, missed=0, age_s=None, reboots=0, heartbeats_missed=0, emergencies=("low supply", "hot"),
        repeat=False,
    )  # fmt: skip
    return wire.encode(message)


class Session:
    """A recorder that is fed by a hand, as by a daemon of which somebody asked for the state first."""

    def __init__(self, make_hand: Callable[..., Hand], folder: Path, limits: Limits | None = None) -> None:
        self.paths: list[Path] = []
        self.lose: Callable[[bytes], bool] = lambda _: False
        self.recorder = Recorder(self._open, limits or Limits())
        self._folder = folder
        self.hand = make_hand(self.take)
        self.take(service(1, self.hand.t_ns))
        self.hand.pipeline.journal.serve(self.hand.deployment, self.hand.t_ns)
        self.hand.pipeline.tick.disturbed = True

    def take(self, parts: list[bytes]) -> None:
        """What the daemon sends."""
        if not parts or not self.lose(parts[0]):
            self.recorder.take(parts, self.hand.t_ns if hasattr(self, "hand") else 0)

    def tell_state(self) -> None:
        """As to somebody who has just subscribed."""
        for topic in ("config", "state"):
            message = self.hand.pipeline.journal.present()[topic](self.hand.t_ns)
            assert message is not None
            self.take(wire.encode(message))

    def _open(self, _: int) -> RecordingFile:
        self.paths.append(self._folder / f"{len(self.paths)}.mcap")
        return RecordingFile(self.paths[-1], {"part": str(len(self.paths))})


@pytest.fixture
def session(make_hand: Callable[..., Hand], tmp_path: Path) -> Session:
    return Session(make_hand, tmp_path)


@pytest.fixture(scope="session")
def recorded(make_hand: Callable[..., Hand], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of two seconds: strokes, a calibration, a tare, a pad that is gone, the daemon's end."""
    session = Session(make_hand, tmp_path_factory.mktemp("recording"))
    hand = session.hand
    hand.stroke(130)
    session.take(health(1, hand.t_ns))
    hand.pipeline.tick.model.gains[0] *= 1.05
    hand.pipeline.tick.model.calibration[0] = "another"
    hand.pipeline.tick.forget(np.array([0]))
    hand.stroke(130, seed=2)
    session.take(health(2, hand.t_ns, "lost", "its heartbeat timed out"))
    for _ in range(5):
        hand.step({}, node_state=PadState.LOST)
    hand.pipeline.tick.solve_all()
    hand.stroke(125, seed=3)
    session.take(service(2, hand.t_ns))
    hand.pipeline.end(hand.t_ns + PERIOD_NS)
    session.recorder.poll(hand.t_ns)
    session.recorder.finish()
    return session.paths[0]
