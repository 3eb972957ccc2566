"""A small hand with a pipeline driven tick by tick, and a recording of it, without sockets."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from handtouch import wire
from handtouch.config import Deployment, parse
from handtouch.config.files import deployment_files
from handtouch.core.active_calibration import ActiveCalibration
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.daemon.table_cache import build_pad_model
from handtouch.host.build import build_info
from handtouch.record.foxglove import FoxgloveConverter
from handtouch.record.mcap_file import RecordingFile
from handtouch.record.recorder import MessageRecorder, RotationLimits
from handtouch.wire import PadState
from tests.deployments import CYLINDER, deployment_text, pad_text

DEPLOYMENT = deployment_text(pad_text("plane", 1), pad_text("round", 2, CYLINDER))
PERIOD_NS = 5_000_000
WALL_NS = 1_700_000_000_000_000_000
SESSION = 7


class CollectingSink:
    """Collects messages, and passes on their encoded form."""

    def __init__(self, take: Callable[[list[bytes]], None] = lambda _: None) -> None:
        self.messages: list[Any] = []
        self.take = take

    def has_subscriber(self, topic: str) -> bool:
        return not topic.startswith("raw/")

    def send(self, message: wire.OutgoingMessage) -> None:
        sent = wire.encode(message)
        self.messages.append(wire.decode(sent))
        self.take(sent)

    def contacts(self) -> list[wire.Contact]:
        return [message for message in self.messages if isinstance(message, wire.Contact)]


@dataclass
class Hand:
    """A pipeline of two pads; `step` is a period in which a pad may be touched, late or silent."""

    deployment: Deployment
    pipeline: Pipeline
    sink: CollectingSink
    t_ns: int = 10**9

    def counts(self, pad: int, x: float, y: float, current_a: float) -> bytes:
        """Return the PDO of a contact at (x, y), fractions of the rectangle, with a current."""
        model = self.pipeline.model
        network = model.networks[pad]
        fractions = network.fractions(x * network.a, y * network.b)
        counts = fractions * (current_a / model.ampere_per_count[pad])
        return bytes(np.rint(counts).astype("<i2").tobytes())

    def step(self, samples: dict[int, bytes], delay_ns: int = 1000, node_state: int = PadState.CLEAR) -> None:
        """Run one cycle: SYNC, samples, tick."""
        pipeline = self.pipeline
        pipeline.node_state[:] = node_state
        self.t_ns += PERIOD_NS
        pipeline.begin_cycle(self.t_ns, self.t_ns)
        for pad, data in samples.items():
            pipeline.slab.write_pdo(pad, data, self.t_ns + delay_ns + pad)
        pipeline.tick_if_due(self.t_ns + PERIOD_NS * 3 // 4)
        pipeline.prepare_next_tick()

    def stroke(self, ticks: int, seed: int = 1) -> None:
        """Stroke over both pads, with lost and late samples."""
        random = np.random.default_rng(seed)
        for tick in range(ticks):
            self.stroke_step(tick % 40 / 40, random)

    def stroke_step(self, phase: float, random: np.random.Generator) -> None:
        """Run one cycle of a stroke, at a phase of 0 to 1."""
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
    return build_pad_model(deployment)


@pytest.fixture(scope="session")
def make_hand(deployment: Deployment, model: PadModel) -> Callable[..., Hand]:
    """Return a function that makes a hand with a model of its own."""

    def make(take: Callable[[list[bytes]], None] = lambda _: None) -> Hand:
        sink = CollectingSink(take)
        pipeline = Pipeline(copy.deepcopy(model), PERIOD_NS, 0.6, sink, SESSION)
        return Hand(deployment, pipeline, sink)

    return make


def service(seq: int, t_ns: int, session: int = SESSION) -> list[bytes]:
    """Return a `service` message, which has the wall clock's offset."""
    message = wire.Service(
        v=wire.SCHEMA_VERSION, session=session, seq=seq, t_ns=t_ns, wall_offset_ns=WALL_NS, version="0",
        pid=1, uptime_s=1.0, period_s=5e-3, hands={"h": ["plane", "round"]}, ticks=1, overruns=0,
        rate_hz=200.0, core_compiled=True, tick_us={}, loop={}, contacts=0, rejected={}, process={}, buses={},
        congestion_episodes={"complete": 0},
        subscriptions=(), retained=False,
    )  # fmt: skip
    return wire.encode(message)


def health(seq: int, t_ns: int, state: str = "clear", reason: str = "") -> list[bytes]:
    """Return a `health` message of a pad."""
    message = wire.Health(
        v=wire.SCHEMA_VERSION,
        session=SESSION,
        seq=seq,
        t_ns=t_ns,
        hand="h",
        link="plane",
        bus="can0",
        node_id=1,
        state=cast(wire.PadStateName, state),
        node_state="operational",
        node_state_since_ns=1,
        sampling="sync",
        reason=reason,
        serial=None,
        rate_hz=200.0,
        samples=3,
        missed_samples=0,
        age_s=None,
        reboots=0,
        heartbeats_missed=0,
        emergencies=({"text": "0x3100 mains voltage"}, {"text": "0x4200 device temperature"}),
        retained=False,
    )
    return wire.encode(message)


class RecordingSession:
    """A recorder fed by a hand, beginning with the daemon's state."""

    def __init__(
        self, make_hand: Callable[..., Hand], folder: Path, limits: RotationLimits | None = None
    ) -> None:
        self.paths: list[Path] = []
        self.lose: Callable[[bytes], bool] = lambda _: False
        self.send: Callable[[list[bytes]], object] = lambda _: None
        self.recorder = MessageRecorder(self._open, limits or RotationLimits(), FoxgloveConverter)
        self._folder = folder
        self.hand = make_hand(self.take)
        self.start()

    def start(self) -> None:
        """Record the messages at the daemon's start."""
        self.take(service(1, self.hand.t_ns))
        deployment = self.hand.deployment
        self.hand.pipeline.journal.publish_config(
            deployment, deployment_files(deployment), build_info(), self.hand.t_ns
        )

    def take(self, parts: list[bytes]) -> None:
        """Record a message of the daemon."""
        if not parts or not self.lose(parts[0]):
            self.recorder.add_message(parts, self.hand.t_ns if hasattr(self, "hand") else 0)
            self.send(parts)

    def send_retained(self) -> None:
        """Record the retained messages, as after a new subscription."""
        for topic in ("config", "state"):
            message = self.hand.pipeline.journal.retained_messages()[topic](self.hand.t_ns)
            assert message is not None
            self.take(wire.encode(message))

    def _open(self, _: int) -> RecordingFile:
        self.paths.append(self._folder / f"{len(self.paths)}.mcap")
        return RecordingFile(self.paths[-1], {"part": str(len(self.paths))})


@pytest.fixture
def session(make_hand: Callable[..., Hand], tmp_path: Path) -> RecordingSession:
    return RecordingSession(make_hand, tmp_path)


@pytest.fixture(scope="session")
def recorded(make_hand: Callable[..., Hand], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of two seconds: strokes, calibration, tare, a lost pad, shutdown."""
    session = RecordingSession(make_hand, tmp_path_factory.mktemp("recording"))
    hand = session.hand
    hand.stroke(130)
    session.take(health(1, hand.t_ns))
    hand.pipeline.set_calibration(0, ActiveCalibration("another", (1.05,) * 4))
    hand.stroke(130, seed=2)
    session.take(health(2, hand.t_ns, "lost", "its heartbeat timed out"))
    for _ in range(5):
        hand.step({}, node_state=PadState.LOST)
    session.send_retained()
    hand.stroke(60, seed=3)
    session.send_retained()
    hand.stroke(65, seed=4)
    session.take(service(2, hand.t_ns))
    hand.pipeline.end_session(hand.t_ns + PERIOD_NS)
    session.recorder.poll(hand.t_ns)
    session.recorder.finish()
    return session.paths[0]
