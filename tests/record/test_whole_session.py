"""Supervisor, journal and replay together: whatever happens to a hand, a replay repeats every message."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import msgpack
import numpy as np
import pytest

from handtouch import wire
from handtouch.calibration.calibration import CalibrationState, LawParameters
from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.canbus.nodes.master import Master
from handtouch.canbus.nodes.spec import SerialChanged
from handtouch.config import Deployment, parse
from handtouch.config.files import deployment_files
from handtouch.config.tables import SceneRequest
from handtouch.core.events import SamplingEvent
from handtouch.core.pipeline import Pipeline
from handtouch.core.scene import ActiveScenes, Demand
from handtouch.core.sheet_force import ForceReference
from handtouch.daemon.child_process import ChildProcess
from handtouch.daemon.sampling import SamplingController
from handtouch.daemon.supervisor_client import SupervisorClient
from handtouch.daemon.table_cache import build_pad_model
from handtouch.daemon.tare import TareJob
from handtouch.host.build import build_info
from handtouch.record.exact_replay import ExactReplay
from handtouch.record.recording import RecordedMessage, Recording
from handtouch.supervisor.ipc import (
    CalibrationAssessment,
    CalibrationUpdate,
    WorkerMessage,
    pack_message,
)
from handtouch.wire import PadState
from handtouch.wire.faults import FaultKind
from handtouch.wire.health import Diagnosis

from .conftest import DEPLOYMENT, PERIOD_NS, SESSION, CollectingSink, Hand, RecordingSession

WITH_SHEETS = DEPLOYMENT.replace("[touch]", "[sheet.s.behaviour]\ngain_std = 0.2\n\n[touch]")
RELOADED = WITH_SHEETS.replace("end_ms = 5.0", "end_ms = 15.0").replace(
    "gain_std = 0.2", "gain_std = 0.2\ncreep_time_s = 0.4"
)
TORN = Diagnosis(
    kind=FaultKind.TORN_CORNER, cause="torn", evidence="-", remedy="-", since_ns=1, position_valid=False
)


class Worker:
    """A stand-in for the supervisor process, with messages from the test."""

    def __init__(self) -> None:
        self.waiting: list[bytes] = []
        self.pid, self.state, self.restarts, self.dropped, self.exit_reason = 1, "running", 0, 0, ""

    def poll(self, now_ns: int) -> bool:  # noqa: ARG002
        return False

    def send(self, message: bytes) -> bool:  # noqa: ARG002
        return True

    def receive(self, now_ns: int) -> list[bytes]:  # noqa: ARG002
        received, self.waiting = self.waiting, []
        return received


class Nodes:
    """A master with given serial numbers."""

    def __init__(self) -> None:
        self.serials = [11, 12]

    def status(self) -> list[Any]:
        return [
            type("Status", (), {"serial": serial, "state": NodeState.OPERATIONAL}) for serial in self.serials
        ]


class FullRate:
    """A sampling controller of pads that are always sampled."""

    def request_full_rate(self, pads: Any, now_ns: int) -> None: ...


class Session:
    """A hand under supervision, with scenes, and its recording."""

    def __init__(self, folder: Path) -> None:
        deployment = parse(WITH_SHEETS)
        scene = deployment.scene.model_copy(update={"excitation_off_after_s": 0.5})
        self.deployment = deployment.model_copy(update={"scene": scene})
        self.recording = RecordingSession(self._make_hand, folder)
        self.hand = self.recording.hand
        self.pipeline, self.worker, self.nodes = self.hand.pipeline, Worker(), Nodes()
        self.supervisor = SupervisorClient(
            self.deployment,
            self.pipeline,
            cast(Master, self.nodes),
            "",
            cast(ChildProcess, self.worker),
        )
        self.swap(0, None, 11)
        names = list(zip(self.pipeline.model.hands, self.pipeline.model.links, strict=True))
        self.demand = Demand(
            ActiveScenes(self.deployment.scene, names),
            cast(Any, self.hand.sink),
            200.0,
            lambda requested, *_: self.pipeline.apply_demand(requested, self.demand.ticks_per_hand_frame),
        )

    def _make_hand(self, take: Callable[[list[bytes]], None]) -> Hand:
        sink = CollectingSink(take)
        sink.subscriptions = frozenset({b"contact/"})  # type: ignore[attr-defined]
        pipeline = Pipeline(build_pad_model(self.deployment), PERIOD_NS, 0.6, sink, SESSION)
        return Hand(self.deployment, pipeline, sink)

    def swap(self, pad: int, before: int | None, after: int) -> None:
        self.nodes.serials[pad] = after
        self.supervisor.handle_node_events(
            [SerialChanged(pad, self.hand.t_ns, before, after)], self.hand.t_ns
        )

    def receive(self, *messages: WorkerMessage) -> None:
        self.worker.waiting += [pack_message(message) for message in messages]

    def stroke(self, ticks: int, seed: int) -> None:
        for _ in range(ticks // 10):
            self.hand.stroke(10, seed)
            self.supervisor.process_tick(self.hand.t_ns)
            seed += 1

    def rest(self, ticks: int, node_state: PadState = PadState.CLEAR) -> None:
        for _ in range(ticks):
            samples = {} if node_state else {0: b"\0" * 8, 1: b"\0" * 8}
            self.hand.step(samples, node_state=node_state)
            self.supervisor.process_tick(self.hand.t_ns)

    def set_scene(self, *outputs: str, rate_hz: float | None = None) -> None:
        scene = SceneRequest(outputs=cast(Any, outputs), rate_hz=rate_hz)
        self.demand.scenes.set_base(scene)
        self.demand.update(self.hand.t_ns)

    def reload(self, deployment: Deployment) -> None:
        self.pipeline.replace_model(build_pad_model(deployment), [0, 1])
        self.pipeline.journal.publish_config(
            deployment, deployment_files(deployment), build_info(), self.hand.t_ns
        )


@pytest.fixture(scope="module")
def entries(tmp_path_factory: pytest.TempPathFactory) -> list[RecordedMessage]:
    """Return the recording of a session in which everything happens."""
    session = Session(tmp_path_factory.mktemp("session"))
    hand, pipeline = session.hand, session.pipeline
    session.set_scene("position", "force")
    session.stroke(60, 1)
    law = LawParameters(
        contact_ohm_mm2=2.2e4,
        alpha=1.4,
        ohm_per_square=2500.0,
        covariance=((0.01, 0, 0), (0, 0.01, 0), (0, 0, 0)),
    )
    covariance = tuple((1e-4 * np.eye(4)).ravel().tolist())
    learned = CalibrationUpdate(
        pad=0, serial=11, calibration_id="11-1", gains=(1.02, 1.0, 1.0, 0.98), covariance=covariance, law=law,
        offset_counts=(1.0, 2.0, 0.0, 1.0), offset_std=(0.5,) * 4, back_n=0.05, back_std_n=0.02,
    )  # fmt: skip
    session.receive(learned)
    session.stroke(60, 2)
    session.receive(  # rolled back, in one batch with a diagnosis
        CalibrationUpdate(pad=0, serial=11, calibration_id="11-0", gains=(1.0,) * 4, covariance=covariance),
        CalibrationAssessment(
            pad=0, serial=11, calibration_state=CalibrationState.CALIBRATED, diagnoses=(TORN,)
        ),
    )
    session.stroke(60, 3)
    session.recording.send_retained()
    session.rest(30)
    tare = TareJob([("h", "plane"), ("h", "round")], np.ones(2, np.bool_), pipeline,
                   cast(SamplingController, FullRate()), hand.t_ns)  # fmt: skip
    for _ in range(210):
        session.rest(1)
        if (done := tare.poll(hand.t_ns)) is not None:
            assert [pad["tared"] for pad in done["pads"]] == [True, True]
            break
    session.set_scene("position", "force", rate_hz=100.0)
    session.stroke(40, 4)
    session.reload(parse(RELOADED))
    session.stroke(60, 5)
    manual = LawParameters(1.9e4, 1.5, 2400.0, ((0.0,) * 3,) * 3)
    calibration = pipeline.calibrations[1]
    pipeline.set_calibration(1, type(calibration)("bench", (1.01,) * 4, manual))
    session.supervisor.register_manual_calibration(1, {"gains", "law"})
    force = 1.2 * pipeline.tick.sheet_force.force_n
    pipeline.add_force_reference(ForceReference(np.array([0, 1]), force, 0.02 * force, hand.t_ns))
    session.stroke(60, 6)
    session.swap(1, 12, 22)  # quarantined
    session.stroke(60, 7)
    session.receive(
        CalibrationUpdate(
            pad=0, serial=11, calibration_id="11-2", gains=(1.0,) * 4, covariance=covariance, back_n=1.0
        )
    )
    session.rest(260)
    assert session.supervisor.excitation.off.any()
    session.recording.send_retained()
    session.stroke(60, 8)
    assert not session.supervisor.excitation.off.any()
    session.rest(10, PadState.LOST)
    session.stroke(40, 9)
    down = np.array([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0]])
    pipeline.set_felt_gravity(down)
    pipeline.add_event(SamplingEvent((True, False), (PERIOD_NS, 20 * PERIOD_NS), (1,)))
    session.stroke(60, 10)
    pipeline.end_session(hand.t_ns + PERIOD_NS)
    session.recording.recorder.finish()
    (path,) = session.recording.paths
    return list(Recording(path))


def _frames(entries: list[RecordedMessage]) -> list[dict[str, Any]]:
    return [entry.payload for entry in entries if entry.topic == "hand/h" and not entry.payload["retained"]]


def test_everything_happened_in_the_session(entries: list[RecordedMessage]) -> None:
    events = [event["kind"] for e in entries if e.topic == "tick" for event in e.payload["events"]]
    assert set(events) >= {
        *("baseline", "calibration", "replacement", "back_force", "model", "excitation", "demand"),
        *("sampling", "gravity", "force"),
    }
    ends = {e.payload["end_reason"] for e in entries if e.topic.startswith("contact/")}
    assert ends >= {"released", "lost", "stopped"}


def test_a_reload_publishes_the_configuration_once(entries: list[RecordedMessage]) -> None:
    # recorded once more before each later state, for readers that begin there
    changes = [e.payload for e in entries if e.topic == "config" and not e.payload["retained"]]
    states = [e for e in entries if e.topic == "state"]
    distinct = [payload for number, payload in enumerate(changes) if payload not in changes[:number]]
    assert [payload["seq"] for payload in distinct] == [1, 2]
    assert len(changes) <= len(distinct) + len(states) - 1


@pytest.mark.parametrize("start", [0, 2])
def test_a_replay_repeats_every_message_bit_for_bit(entries: list[RecordedMessage], start: int) -> None:
    """From the first state, and from any later one."""
    states = [number for number, entry in enumerate(entries) if entry.topic == "state"]
    configs = [number for number, entry in enumerate(entries) if entry.topic == "config"]
    first = states[start]
    config = entries[max(number for number in configs if number < first)]
    replayed = CollectingSink()
    replay = ExactReplay(lambda _: None, replayed)
    for entry in [config, *entries[first:]]:
        replay.process_message(entry)
    assert replay.result.first_difference is None
    assert replay.result.skipped_ticks == 0
    assert replay.result.equal == replay.result.compared > 100
    expected = _frames(entries[first:])
    frames = [wire.encode(m)[1] for m in replayed.messages if isinstance(m, wire.HandFrame)]
    assert len(frames) == len(expected)
    for frame, recorded in zip(frames, expected, strict=True):
        assert msgpack.unpackb(frame) == recorded


def test_the_replayed_state_is_the_recorded_one(entries: list[RecordedMessage]) -> None:
    replay = ExactReplay(lambda _: None)
    compared = 0
    for entry in entries:
        if entry.topic == "state" and replay.pipeline is not None:
            compared += 1
            assert replay.pipeline.save_state() == entry.payload["state"]
        replay.process_message(entry)
    assert compared == 2


def test_a_recording_of_another_layout_is_rejected_with_a_remedy(entries: list[RecordedMessage]) -> None:
    replay = ExactReplay(lambda _: None)
    config, state = (next(e for e in entries if e.topic == topic) for topic in ("config", "state"))
    replay.process_message(config)
    for without in ({"layout": "0-abc"}, {"layout": None, "calibrations": None}):
        payload = {**state.payload, **{key: value for key, value in without.items() if value}}
        for key, value in without.items():
            if value is None:
                del payload[key]
        with pytest.raises(ValueError, match=r"recorded by handtouch .* can replay it.*export"):
            replay.process_message(state._replace(payload=payload))
