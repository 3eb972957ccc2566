"""The pacer: nodes rest, wait for something to move, or follow SYNC, as scene and touches need it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from handtouch.canbus.nodes.life import NodeState
from handtouch.config import Deployment
from handtouch.config.tables import Idle
from handtouch.daemon.pacer import Pacer
from handtouch.daemon.pipeline import Pipeline
from handtouch.wire import PadState

MS = 1_000_000
PERIOD_NS = 5 * MS
IDLE_NS = 2000 * MS
SLOW_NS = 50 * MS


class Nodes:
    """Nodes that do at once what they are told; stands for the master, whose own tests show that they do."""

    def __init__(self, size: int) -> None:
        self.states = np.full(size, NodeState.OPERATIONAL, dtype=np.uint8)
        self.idle = np.zeros(size, dtype=np.bool_)
        self.period_ns = np.full(size, PERIOD_NS, dtype=np.int64)
        self.paced_ns = np.zeros(size, dtype=np.int64)
        self.paces = 0

    def rest(self, slot: int, resting: bool, _: int) -> None:
        self.states[slot] = NodeState.STOPPED if resting else NodeState.OPERATIONAL

    def pace(self, slot: int, idle: bool, _: int) -> None:
        self.idle[slot] = idle
        self.paces += 1


class Beat:
    """SYNC, whose period is set."""

    def __init__(self) -> None:
        self.period_ns = PERIOD_NS

    def set_period(self, period_ns: int, _: int) -> None:
        self.period_ns = period_ns


class Served:
    """A pacer with nodes that can idle; `wait` lets time pass, with what the pads read."""

    def __init__(self, bench: Any, deployment: Deployment) -> None:
        self.pipeline = Pipeline(bench.model, PERIOD_NS, 0.6, self)
        self.nodes, self.beat = Nodes(3), Beat()
        self.pacer = Pacer(deployment, np.ones(3, dtype=np.bool_), self.pipeline, self.nodes, self.beat)  # type: ignore[arg-type]
        self.t_ns = 10**9
        self.wait(1, counts=500)

    def wants(self, _: str) -> bool:
        return False

    def send(self, _: object) -> None:
        raise AssertionError("nobody asked")

    def wait(self, duration_ns: int, counts: Any = 0) -> None:
        end_ns = self.t_ns + duration_ns
        while self.t_ns < end_ns:
            self.t_ns += PERIOD_NS
            self.pipeline.tick.counts = np.full((3, 4), counts, dtype=np.int64)
            touched = self.pipeline.tick.counts.max(axis=1) > 100
            self.pipeline.tick.columns.state[:] = np.where(touched, PadState.TOUCHED, PadState.CLEAR)
            self.pacer.step(self.t_ns)


@pytest.fixture
def served(bench: Any) -> Served:
    kinds = {"n": bench.deployment.nodes["n"].model_copy(update={"idle": Idle(delta_counts=12)})}
    return Served(bench, bench.deployment.model_copy(update={"nodes": kinds}))


def test_untouched_pads_wait_for_something_to_move_and_sync_slows_down(served: Served) -> None:
    served.wait(IDLE_NS - 200 * MS)
    assert not served.nodes.idle.any()
    served.wait(400 * MS)
    assert served.nodes.idle.all()
    assert served.beat.period_ns == SLOW_NS
    served.wait(100 * MS, counts=12)
    assert not served.nodes.idle.any()
    assert served.beat.period_ns == PERIOD_NS


def test_sync_stays_at_full_rate_while_a_node_that_is_woken_has_not_answered(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whenever the next look at what may rest comes."""
    served.wait(IDLE_NS + 200 * MS)
    assert served.beat.period_ns == SLOW_NS
    monkeypatch.setattr(served.nodes, "pace", lambda *_: None)
    for _ in range(40):
        served.wait(PERIOD_NS, counts=[[12] * 4, [0] * 4, [0] * 4])
        assert served.beat.period_ns == PERIOD_NS


def test_touched_pads_follow_sync(served: Served) -> None:
    served.wait(2 * IDLE_NS, counts=[[500] * 4, [0] * 4, [0] * 4])
    assert served.nodes.idle.tolist() == [False, True, True]
    assert served.beat.period_ns == PERIOD_NS


def test_pads_that_a_scene_keeps_follow_sync_untouched(served: Served) -> None:
    kept = np.array([False, True, False])
    served.pacer.set_needs(np.ones(3, dtype=np.bool_), kept, served.t_ns)
    served.wait(2 * IDLE_NS)
    assert served.nodes.idle.tolist() == [True, False, True]
    served.pacer.set_needs(np.ones(3, dtype=np.bool_), ~np.ones(3, dtype=np.bool_), served.t_ns)
    served.wait(2 * IDLE_NS)
    assert served.nodes.idle.all()


def test_pads_that_are_attended_to_wake_and_stay_awake_for_so_long(served: Served) -> None:
    served.wait(2 * IDLE_NS)
    for _ in range(20):
        served.pacer.attend(np.array([True, False, False]), served.t_ns)
        served.wait(PERIOD_NS)
    assert served.nodes.idle.tolist() == [False, True, True]
    served.wait(2 * IDLE_NS)
    assert served.nodes.idle.all()


def test_pads_outside_the_scene_rest_and_a_scene_of_none_slows_sync(served: Served) -> None:
    none = np.zeros(3, dtype=np.bool_)
    served.pacer.set_needs(np.array([True, False, False]), none, served.t_ns)
    served.wait(PERIOD_NS)
    assert (served.nodes.states == NodeState.STOPPED).tolist() == [False, True, True]
    assert served.beat.period_ns == PERIOD_NS
    served.pacer.set_needs(none, none, served.t_ns)
    served.wait(200 * MS)
    assert served.beat.period_ns == SLOW_NS
    served.pacer.set_needs(~none, none, served.t_ns)
    served.wait(200 * MS)
    assert (served.nodes.states == NodeState.OPERATIONAL).all()
    assert served.beat.period_ns == PERIOD_NS


def test_other_idle_times_hold_from_now_on(served: Served, bench: Any) -> None:
    served.pacer.set_idle(bench.deployment.scene.model_copy(update={"idle_after_s": 0.2}))
    served.wait(500 * MS)
    assert served.nodes.idle.all()
