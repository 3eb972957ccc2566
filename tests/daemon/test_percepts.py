"""Percepts from ticks to messages: complete, at the documented rate, and nothing without a request."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.daemon_settings import InlineProcess
from handtouch import wire
from handtouch.config.tables import SceneRequest
from handtouch.core.pipeline import Pipeline
from handtouch.core.scene import (
    ActiveScenes,
    Demand,
    RequestedOutputs,
)
from handtouch.daemon.percepts import PerceptPublisher
from handtouch.percept.messages import PerceptMessageError, pack_message, unpack_input, unpack_output
from handtouch.percept.shape import pair_distance
from handtouch.view.message_lines import message_line
from handtouch.wire import PERCEPT_KINDS, PadState

PERIOD_NS, PLANE = 5_000_000, 0


class ObservedProcess(InlineProcess):
    """The worker in this process; what is sent to it can be read, and refused."""

    def __init__(self, deployment: Any) -> None:
        super().__init__(deployment)
        self.received: list[wire.PerceptInput] = []
        self.full = False
        """messages to it are dropped"""

    def send(self, message: bytes) -> bool:
        if self.full:
            return False
        self.received.append(unpack_input(message))
        return super().send(message)


class Rig:
    """A pad with a contact that starts to move, while some topics are subscribed."""

    def __init__(self, bench: Any, subscriptions: frozenset[bytes], scene: SceneRequest) -> None:
        self.subscriptions = subscriptions
        self.sent: list[Any] = []
        self._bench = bench
        self.pipeline = Pipeline(bench.model, PERIOD_NS, 0.6, self)
        self.pipeline.node_state[:] = PadState.CLEAR
        self.process = ObservedProcess(bench.deployment)
        self.percepts = PerceptPublisher(
            bench.deployment,
            self.pipeline,
            self,
            session=7,
            process=self.process,
        )
        self.t_ns = 10**9
        names = list(zip(bench.model.hands, bench.model.links, strict=True))
        self.demand = Demand(ActiveScenes(scene, names), self, 200.0, self._apply)
        self.demand.transformable[:] = False
        self.demand.update(0)

    def has_subscriber(self, topic: str) -> bool:
        return any(topic.encode().startswith(prefix) for prefix in self.subscriptions)

    def send(self, message: wire.OutgoingMessage) -> None:
        self.sent.append(message)

    def _apply(self, requested: RequestedOutputs, *_: object) -> None:
        self.pipeline.apply_demand(requested)
        self.percepts.set_requested(requested, self.t_ns)

    def run_contact(self, ticks: int, current_a: float = 1e-3, m_per_s: float = 0.0) -> list[wire.Percept]:
        already = len(self.sent)
        for k in range(ticks):
            self.t_ns += PERIOD_NS
            x = 0.4 + m_per_s * k * PERIOD_NS * 1e-9 / 0.03
            counts = self._bench.counts(PLANE, x, 0.5, current_a)
            self.pipeline.begin_cycle(self.t_ns, self.t_ns)
            for pad in range(3):
                touch = counts.tobytes() if pad == PLANE else bytes(8)
                self.pipeline.slab.write_pdo(pad, touch, self.t_ns + 1000 + pad)
            ticked = self.pipeline.tick_if_due(self.t_ns + PERIOD_NS * 7 // 10)
            assert ticked is not None
            if self.percepts.enabled:
                self.percepts.process_tick(ticked, self.t_ns)
            self.pipeline.prepare_next_tick()
        return [message for message in self.sent[already:] if isinstance(message, wire.Percept)]


MOTION = frozenset([b"percept/h/motion"])
PLAIN = SceneRequest()


def test_slip_is_published_within_samples(bench: Any) -> None:
    rig = Rig(bench, MOTION, PLAIN)
    before = rig.run_contact(200)
    assert {percept.label for percept in before[2:]} == {"sticking"}
    onset_ns = rig.t_ns
    after = rig.run_contact(20, m_per_s=20e-3)
    slip = next(percept for percept in after if percept.label == "sliding")
    assert slip.t_ns - onset_ns <= 4 * PERIOD_NS
    assert (slip.link, slip.hand, slip.kind, slip.session) == ("plane", "h", "motion", 7)
    assert slip.evidence["samples"] > 190
    assert [percept.seq for percept in before + after] == list(range(1, 1 + len(before + after)))


def test_percepts_survive_the_wire_and_format_as_text(bench: Any) -> None:
    rig = Rig(bench, MOTION, PLAIN)
    percepts = rig.run_contact(100) + rig.run_contact(3, current_a=0.0)
    assert percepts[-1].label == "lift-off"
    for percept in percepts:
        assert wire.decode(wire.encode(percept)) == percept
    assert "lift-off 100%" in message_line(percepts[-1])
    assert "velocity (" in message_line(percepts[0])
    assert " mm/s" in message_line(percepts[0])


def test_no_percepts_without_a_request(bench: Any) -> None:
    rig = Rig(bench, frozenset([b"contact/", b"hand/"]), PLAIN)
    rig.run_contact(20)
    assert not rig.percepts.enabled
    assert not rig.process.received
    assert rig.demand.requested.percepts is None


def test_percepts_stop_with_the_last_subscriber(bench: Any) -> None:
    rig = Rig(bench, MOTION, PLAIN)
    rig.run_contact(20)
    assert rig.percepts.enabled
    rig.subscriptions = frozenset()
    rig.demand.update(rig.t_ns)
    assert not rig.percepts.enabled
    assert rig.run_contact(20) == []


def test_scene_without_subscriber_keeps_percepts_running(bench: Any) -> None:
    rig = Rig(bench, frozenset(), SceneRequest(links=("plane",), outputs=("motion",)))
    assert rig.run_contact(50) == []
    rig.subscriptions = MOTION
    rig.demand.update(rig.t_ns)
    (first, *_) = rig.run_contact(20)
    assert first.evidence["samples"] > 50


@pytest.mark.parametrize(
    ("topic", "kinds"), [(b"percept/h/shape", {"shape"}), (b"percept/h/action_request", set(PERCEPT_KINDS))]
)
def test_only_subscribed_percepts_of_pads_in_the_scene_are_requested(
    bench: Any, topic: bytes, kinds: set[str]
) -> None:
    rig = Rig(bench, frozenset([topic]), SceneRequest(links=("plane",)))
    percepts = rig.demand.requested.percepts
    assert percepts is not None
    assert {kind for kind, pads in zip(PERCEPT_KINDS, percepts, strict=True) if pads.any()} == kinds
    assert not percepts[:, 1:].any()
    assert rig.demand.requested.position[PLANE]
    assert rig.demand.requested.action_requests is not None
    assert np.array_equal(
        rig.demand.requested.action_requests, [topic.endswith(b"action_request"), False, False]
    )
    computed = rig.demand.describe_pads()[PLANE]["computed"]
    assert kinds <= set(computed)


@pytest.mark.parametrize(("residual", "axis"), [(0.02, 0), (-0.02, 1)])
def test_pair_distance_follows_from_the_residual(bench: Any, residual: float, axis: int) -> None:
    """In metres on the surface, along x of the pad or along y."""
    rig = Rig(bench, frozenset([b"percept/h/shape"]), PLAIN)
    worker = rig.process.worker
    assert np.isinf(worker.pair_distance_m(PLANE, residual, 1e-3)[1])  # no contact, no position
    rig.run_contact(20)
    x, y = rig.pipeline.tick.columns.xy[PLANE].tolist()
    on_sheet, std = pair_distance(bench.model.networks[PLANE], x, y, residual, 1e-3)
    points = np.array([x, y]) + np.outer([-0.5, 0.5], np.eye(2)[axis]) * on_sheet
    placed = bench.exact.position_m(np.full(2, PLANE), points[:, 0], points[:, 1])
    distance_m, std_m = worker.pair_distance_m(PLANE, residual, 1e-3)
    assert distance_m == pytest.approx(float(np.linalg.norm(placed[1] - placed[0])), rel=1e-6)
    assert std_m == pytest.approx(std * distance_m / on_sheet)


# The stream to the percept process, and back ------------------------------------------------------------

SHAPE = frozenset([b"percept/h/shape"])


def test_motion_alone_needs_no_percept_process(bench: Any) -> None:
    rig = Rig(bench, MOTION, PLAIN)
    assert rig.run_contact(50)
    assert rig.process.state == "stopped"
    assert not rig.process.received


def test_stream_carries_what_the_tick_computed(bench: Any) -> None:
    rig = Rig(bench, SHAPE | MOTION, PLAIN)
    rig.run_contact(20)
    columns, last = rig.pipeline.tick.columns, rig.process.received[-1]
    sent = {
        name: column.to_array(data)
        for name, column in wire.COLUMNS[wire.PerceptInput].items()
        if (data := getattr(last, name))
    }
    assert (last.hand, last.t_ns, last.seq) == ("h", rig.t_ns, len(rig.process.received))
    assert sent["row"].tolist() == [PLANE]
    assert sent["contact_id"].tolist() == [1, 0, 0]
    for name in ("xy", "pad_m", "position_m", "normal", "force_n", "force_std_n", "residual"):
        assert np.array_equal(sent[name][0], getattr(columns, name)[PLANE]), name
    assert sent["covariance_m2"][0].tolist() == columns.covariance_m2[PLANE].ravel().tolist()
    assert np.isfinite(sent["slip_log_odds"]).all()
    assert "palm_position_m" not in sent


def test_percepts_of_the_process_are_published_with_session_and_sequence(bench: Any) -> None:
    rig = Rig(bench, SHAPE, PLAIN)
    percepts = rig.run_contact(400)
    assert {(percept.kind, percept.link) for percept in percepts} == {("shape", "plane")}
    assert [percept.seq for percept in percepts] == list(range(1, 1 + len(percepts)))
    assert {percept.session for percept in percepts} == {7}


def test_stream_continues_without_contacts_so_that_the_process_knows_the_time(bench: Any) -> None:
    rig = Rig(bench, SHAPE, PLAIN)
    rig.run_contact(200, current_a=0.0)
    times = np.array([message.t_ns for message in rig.process.received])
    assert np.diff(times).max() <= 50_000_000
    assert len(times) <= 25


def test_lost_messages_hide_no_end_of_a_contact(bench: Any) -> None:
    rig = Rig(bench, SHAPE, PLAIN)
    rig.run_contact(20)
    contacts = rig.process.worker.contacts
    assert contacts.contact_id[PLANE] == 1
    rig.process.full = True
    rig.run_contact(20, current_a=0.0)
    rig.process.full = False
    rig.run_contact(20)
    assert contacts.contact_id[PLANE] == 2
    assert contacts.sample_count[PLANE] <= 20


@pytest.mark.parametrize(
    "change",
    [
        {"kind": "motion"},
        {"hand": "another"},
        {"link": "another"},
        {"probabilities": {"flat": 2.0}},
        {"probabilities": {"flat": "often"}},
        {"evidence": {"samples": "many"}},
        {"values": {"radius_m": [[1.0]]}},
        {"values": {str(k): 1.0 for k in range(1000)}},
        {"reason": "x" * 10_000},
    ],
)
def test_malformed_messages_of_the_process_are_counted_and_ignored(
    bench: Any, change: dict[str, Any]
) -> None:
    rig = Rig(bench, SHAPE, PLAIN)
    percept = rig.run_contact(400)[0]
    assert rig.percepts.client.malformed == 0
    rig.process.waiting = [pack_message(percept), pack_message(replace(percept, **change))]
    rig.process.full = True
    assert len(rig.run_contact(1)) == 1
    assert rig.percepts.client.malformed == 1


@given(st.binary(max_size=200), st.sampled_from([b"", b"status\0", b"percept/h/shape\0"]))
def test_any_bytes_of_the_process_are_a_message_or_an_error(data: bytes, start: bytes) -> None:
    with contextlib.suppress(PerceptMessageError):
        unpack_output(start + data)


def test_process_stops_half_a_minute_after_the_last_request(bench: Any) -> None:
    rig = Rig(bench, SHAPE, PLAIN)
    rig.run_contact(20)
    rig.subscriptions = frozenset()
    rig.demand.update(rig.t_ns)
    rig.run_contact(20)
    assert rig.process.enabled
    assert rig.percepts.enabled
    assert rig.process.worker.contacts.contact_id.tolist() == [0, 0, 0]
    rig.t_ns += 31 * 10**9
    rig.run_contact(2)
    assert rig.process.state == "stopped"
    assert not rig.percepts.enabled
    assert rig.percepts.client.statistics()["lag_s"] is None
