"""From ticks to percepts and messages: whole, told as often as promised, and nothing at all for nobody."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from handtouch import wire
from handtouch.config.tables import Wants
from handtouch.daemon.perceive import Perceiving
from handtouch.daemon.pipeline import Pipeline
from handtouch.daemon.scene import Demand, Needs, Scenes, Wanted
from handtouch.percept.shape import pair_distance
from handtouch.percept.stream import KINDS
from handtouch.view.lines import line
from handtouch.wire import PadState

PERIOD_NS, PLANE = 5_000_000, 0


class Rig:
    """A pad touched at a place that moves on from a time, while some topics are subscribed."""

    def __init__(self, bench: Any, subscriptions: frozenset[bytes], scene: Wants) -> None:
        self.subscriptions = subscriptions
        self.sent: list[Any] = []
        self._bench = bench
        self.pipeline = Pipeline(bench.model, PERIOD_NS, 0.6, self)
        self.pipeline.node_state[:] = PadState.CLEAR
        self.perceiving = Perceiving(self.pipeline, self, run=7)
        names = list(zip(bench.model.hands, bench.model.links, strict=True))
        self.demand = Demand(Scenes(scene, names), self, 200.0, self._apply)
        self.demand.placeable[:] = False
        self.demand.step(0)
        self.t_ns = 10**9

    def wants(self, topic: str) -> bool:
        return any(topic.encode().startswith(prefix) for prefix in self.subscriptions)

    def send(self, message: wire.Outgoing) -> None:
        self.sent.append(message)

    def _apply(self, wanted: Wanted, needs: Needs, enabled: Any, now_ns: int) -> None:  # noqa: ARG002
        self.pipeline.want(wanted)
        self.perceiving.want(wanted)

    def feel(self, ticks: int, current_a: float = 1e-3, m_per_s: float = 0.0) -> list[wire.Percept]:
        already = len(self.sent)
        for k in range(ticks):
            self.t_ns += PERIOD_NS
            x = 0.4 + m_per_s * k * PERIOD_NS * 1e-9 / 0.03
            counts = self._bench.counts(PLANE, x, 0.5, current_a)
            self.pipeline.begin(self.t_ns, self.t_ns)
            for pad in range(3):
                touch = counts.tobytes() if pad == PLANE else bytes(8)
                self.pipeline.slab.write(pad, touch, self.t_ns + 1000 + pad)
            ticked = self.pipeline.advance(self.t_ns + PERIOD_NS * 7 // 10)
            assert ticked is not None
            if self.perceiving.wanted:
                self.perceiving.step(ticked)
            self.pipeline.settle()
        return [message for message in self.sent[already:] if isinstance(message, wire.Percept)]


MOTION = frozenset([b"percept/h/motion"])
PLAIN = Wants()


def test_a_subscriber_hears_of_a_slip_within_samples(bench: Any) -> None:
    rig = Rig(bench, MOTION, PLAIN)
    before = rig.feel(200)
    assert {percept.label for percept in before[2:]} == {"sticking"}
    onset_ns = rig.t_ns
    after = rig.feel(20, m_per_s=20e-3)
    slip = next(percept for percept in after if percept.label == "sliding")
    assert slip.t_ns - onset_ns <= 4 * PERIOD_NS
    assert (slip.link, slip.hand, slip.kind, slip.run) == ("plane", "h", "motion", 7)
    assert slip.evidence["samples"] > 190
    assert [percept.seq for percept in before + after] == list(range(1, 1 + len(before + after)))


def test_percepts_are_whole_on_the_wire_and_readable(bench: Any) -> None:
    rig = Rig(bench, MOTION, PLAIN)
    percepts = rig.feel(100) + rig.feel(3, current_a=0.0)
    assert percepts[-1].label == "lift-off"
    for percept in percepts:
        assert wire.decode(wire.encode(percept)) == percept
    assert "lift-off 100%" in line(percepts[-1])
    assert "velocity (" in line(percepts[0])
    assert " mm/s" in line(percepts[0])


def test_for_nobody_nothing_is_perceived(bench: Any) -> None:
    rig = Rig(bench, frozenset([b"contact/", b"hand/"]), PLAIN)
    rig.feel(20)
    assert not rig.perceiving.wanted
    assert rig.perceiving._perceiver is None
    assert rig.demand.wanted.percepts is None


def test_when_the_last_listener_leaves_it_ends(bench: Any) -> None:
    rig = Rig(bench, MOTION, PLAIN)
    rig.feel(20)
    assert rig.perceiving.wanted
    rig.subscriptions = frozenset()
    rig.demand.step(rig.t_ns)
    assert not rig.perceiving.wanted
    assert rig.feel(20) == []


def test_a_scene_alone_keeps_perception_running(bench: Any) -> None:
    rig = Rig(bench, frozenset(), Wants(links=("plane",), outputs=("motion",)))
    assert rig.feel(50) == []
    rig.subscriptions = MOTION
    rig.demand.step(rig.t_ns)
    (first, *_) = rig.feel(20)
    assert first.evidence["samples"] > 50


@pytest.mark.parametrize(
    ("topic", "kinds"), [(b"percept/h/shape", {"shape"}), (b"percept/h/ask", set(KINDS))]
)
def test_only_what_is_asked_for_is_wanted_and_pads_outside_the_scene_are_not(
    bench: Any, topic: bytes, kinds: set[str]
) -> None:
    rig = Rig(bench, frozenset([topic]), Wants(links=("plane",)))
    percepts = rig.demand.wanted.percepts
    assert percepts is not None
    assert {kind for kind, pads in zip(KINDS, percepts, strict=True) if pads.any()} == kinds
    assert not percepts[:, 1:].any()
    assert rig.demand.wanted.located[PLANE]
    assert rig.demand.wanted.asks is not None
    assert np.array_equal(rig.demand.wanted.asks, [topic.endswith(b"ask"), False, False])
    told = rig.demand.tell()[PLANE]["computed"]
    assert kinds <= set(told)


@pytest.mark.parametrize(("residual", "axis"), [(0.02, 0), (-0.02, 1)])
def test_two_points_are_as_far_apart_on_the_pad_as_their_residual_says(
    bench: Any, residual: float, axis: int
) -> None:
    """In metres on the surface, along x of the pad or along y."""
    rig = Rig(bench, MOTION, PLAIN)
    assert np.isinf(rig.perceiving._pair_m(PLANE, residual, 1e-3)[1])  # nothing touches: no place
    rig.feel(20)
    locator, (x, y) = bench.model.locator, rig.pipeline.tick.columns.xy[PLANE].tolist()
    on_sheet, std = pair_distance(locator, PLANE, x, y, residual, 1e-3)
    way = np.array([x, y]) + np.outer([-0.5, 0.5], np.eye(2)[axis]) * on_sheet
    placed = bench.model.placement.place(
        np.full(2, PLANE), way[:, 0], way[:, 1], np.zeros((2, 2, 2))
    ).position_m
    distance_m, std_m = rig.perceiving._pair_m(PLANE, residual, 1e-3)
    assert distance_m == pytest.approx(float(np.linalg.norm(placed[1] - placed[0])), rel=1e-6)
    assert std_m == pytest.approx(std * distance_m / on_sheet)


def test_where_no_joint_states_tell_commands_tell_how_far_the_link_closes(bench: Any) -> None:
    """Of pads whose hardness is wanted, since their contact began; along the pad's outward normal."""
    rig = Rig(bench, frozenset([b"percept/h/hardness"]), PLAIN)
    asked: list[tuple[list[int], int]] = []
    outward = np.array([0.0, 0.0, 1.0])

    def poses(pads: Any, t_ns: int, commands_at: Any) -> Any:
        asked.append((pads.tolist(), t_ns))
        assert commands_at is rig.perceiving.commands_at
        closed_m = 1e-3 * len(asked)
        return np.tile(np.c_[np.eye(3), closed_m * outward], (len(pads), 1, 1))

    rig.pipeline.frames.told_poses = poses  # type: ignore[method-assign,assignment]
    rig.feel(30)
    perceiver = rig.perceiving._perceiver
    assert perceiver is not None
    window = perceiver.stream.window(PLANE)
    assert asked[-1] == ([PLANE], rig.t_ns)
    facing = float(window["commanded_normal"][-1] @ outward)
    ways = window["commanded_m"]
    assert ways[0] == 0.0
    assert np.diff(ways) == pytest.approx(np.full(len(ways) - 1, 1e-3 * facing))
