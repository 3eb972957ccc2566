"""Sampling control: nodes are stopped, transmit on change, or follow SYNC, as scenes and contacts need."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.config import Deployment
from handtouch.config.tables import Idle
from handtouch.core.pipeline import Pipeline
from handtouch.daemon.sampling import SamplingController
from handtouch.wire import PadState

MS = 1_000_000
PERIOD_NS = 5 * MS
IDLE_NS = 2000 * MS
SLOW_NS = 50 * MS


class Nodes:
    """Nodes that change mode at once; a stand-in for the master, which has its own tests."""

    def __init__(self, size: int) -> None:
        self.states = np.full(size, NodeState.OPERATIONAL, dtype=np.uint8)
        self.idle = np.zeros(size, dtype=np.bool_)
        self.sample_period_ns = np.full(size, PERIOD_NS, dtype=np.int64)
        self.transmission_since_ns = np.zeros(size, dtype=np.int64)
        self.transmission_changes = 0

    def set_standby(self, slot: int, standby: bool, _: int) -> None:
        self.states[slot] = NodeState.STOPPED if standby else NodeState.OPERATIONAL

    def set_transmission(self, slot: int, idle: bool, _: int) -> None:
        self.idle[slot] = idle
        self.transmission_changes += 1


class SyncPeriod:
    """SYNC with a settable period."""

    def __init__(self) -> None:
        self.period_ns = PERIOD_NS

    def set_period(self, period_ns: int, _: int) -> None:
        self.period_ns = period_ns


class Served:
    """A sampling controller with nodes that can idle; `wait` runs ticks with given counts."""

    def __init__(self, bench: Any, deployment: Deployment) -> None:
        self.pipeline = Pipeline(bench.model, PERIOD_NS, 0.6, self)
        self.nodes, self.sync = Nodes(3), SyncPeriod()
        self.sampling = SamplingController(
            deployment,
            np.ones(3, dtype=np.bool_),
            self.pipeline,
            self.nodes,  # type: ignore[arg-type]
            self.sync,  # type: ignore[arg-type]
        )
        self.t_ns = 10**9
        self.wait(1, counts=500)

    def has_subscriber(self, _: str) -> bool:
        return False

    def send(self, _: object) -> None:
        raise AssertionError("no subscriber")

    def wait(self, duration_ns: int, counts: Any = 0) -> None:
        end_ns = self.t_ns + duration_ns
        while self.t_ns < end_ns:
            self.t_ns += PERIOD_NS
            self.pipeline.tick.counts = np.full((3, 4), counts, dtype=np.int64)
            touched = self.pipeline.tick.counts.max(axis=1) > 100
            self.pipeline.tick.columns.state[:] = np.where(touched, PadState.TOUCHED, PadState.CLEAR)
            self.sampling.update_sampling(self.t_ns)


@pytest.fixture
def served(bench: Any) -> Served:
    kinds = {"n": bench.deployment.nodes["n"].model_copy(update={"idle": Idle(delta_counts=12)})}
    return Served(bench, bench.deployment.model_copy(update={"nodes": kinds}))


def test_untouched_pads_transmit_on_change_and_sync_slows_down(served: Served) -> None:
    served.wait(IDLE_NS - 200 * MS)
    assert not served.nodes.idle.any()
    served.wait(400 * MS)
    assert served.nodes.idle.all()
    assert served.sync.period_ns == SLOW_NS
    served.wait(100 * MS, counts=12)
    assert not served.nodes.idle.any()
    assert served.sync.period_ns == PERIOD_NS


def test_sync_stays_at_full_rate_until_a_woken_node_confirms(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Independent of when idle pads are checked next."""
    served.wait(IDLE_NS + 200 * MS)
    assert served.sync.period_ns == SLOW_NS
    monkeypatch.setattr(served.nodes, "set_transmission", lambda *_: None)
    for _ in range(40):
        served.wait(PERIOD_NS, counts=[[12] * 4, [0] * 4, [0] * 4])
        assert served.sync.period_ns == PERIOD_NS


def test_touched_pads_follow_sync(served: Served) -> None:
    served.wait(2 * IDLE_NS, counts=[[500] * 4, [0] * 4, [0] * 4])
    assert served.nodes.idle.tolist() == [False, True, True]
    assert served.sync.period_ns == PERIOD_NS


def test_full_rate_pads_follow_sync_untouched(served: Served) -> None:
    full_rate = np.array([False, True, False])
    served.sampling.set_needed_pads(np.ones(3, dtype=np.bool_), full_rate, served.t_ns)
    served.wait(2 * IDLE_NS)
    assert served.nodes.idle.tolist() == [True, False, True]
    served.sampling.set_needed_pads(np.ones(3, dtype=np.bool_), ~np.ones(3, dtype=np.bool_), served.t_ns)
    served.wait(2 * IDLE_NS)
    assert served.nodes.idle.all()


def test_requested_pads_wake_and_stay_awake_for_the_idle_time(served: Served) -> None:
    served.wait(2 * IDLE_NS)
    for _ in range(20):
        served.sampling.request_full_rate(np.array([True, False, False]), served.t_ns)
        served.wait(PERIOD_NS)
    assert served.nodes.idle.tolist() == [False, True, True]
    served.wait(2 * IDLE_NS)
    assert served.nodes.idle.all()


def test_pads_outside_the_scene_stop_and_an_empty_scene_slows_sync(served: Served) -> None:
    none = np.zeros(3, dtype=np.bool_)
    served.sampling.set_needed_pads(np.array([True, False, False]), none, served.t_ns)
    served.wait(PERIOD_NS)
    assert (served.nodes.states == NodeState.STOPPED).tolist() == [False, True, True]
    assert served.sync.period_ns == PERIOD_NS
    served.sampling.set_needed_pads(none, none, served.t_ns)
    served.wait(200 * MS)
    assert served.sync.period_ns == SLOW_NS
    served.sampling.set_needed_pads(~none, none, served.t_ns)
    served.wait(200 * MS)
    assert (served.nodes.states == NodeState.OPERATIONAL).all()
    assert served.sync.period_ns == PERIOD_NS


def test_new_idle_time_applies_at_once(served: Served, bench: Any) -> None:
    served.sampling.set_idle_settings(bench.deployment.scene.model_copy(update={"idle_after_s": 0.2}))
    served.wait(500 * MS)
    assert served.nodes.idle.all()
