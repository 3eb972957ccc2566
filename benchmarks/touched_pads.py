"""Pads that are touched: their counts, and the daemon's pipeline that gets them without a bus.

Public names: `hands`, `Touches`, `PipelineCase`, `in_turns_of`; `PERIOD_NS`, `CURRENT_RATIO`, `SLIDING_M`.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.config import Deployment, load, shipped
from handtouch.config.tables import SceneRequest
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.core.scene import ActiveScenes, Demand
from handtouch.hand.joints import JointStateBuffer
from handtouch.hand.robot_models import RobotModels
from tests.exact_pads import ExactNetworks

PERIOD_NS = 5_000_000
JOINTS_EVERY_NS = 1_000_000
SLIDING_M = 1e-4  # a tick: 20 mm/s at 200 Hz
CURRENT_RATIO = 20.0  # of the threshold's current
WARM_UP = 20
Counts = NDArray[np.int16]


def hands(pads: int) -> PadModel:
    """Return a model of as many copies of the shipped hand as needed."""
    deployment: Deployment = load(shipped.path("utah_mit.toml"))
    (hand,) = deployment.hands
    many = [hand.model_copy(update={"name": f"hand{k}"}) for k in range(pads // len(hand.pads))]
    return PadModel(deployment.model_copy(update={"hands": tuple(many)}))


class Touches:
    """Contacts of `CURRENT_RATIO` on the first pads, with a count of noise.

    They move by `moving_m` a tick and turn where the middle of a pad ends.
    """

    def __init__(self, model: PadModel, touched: int | None = None, moving_m: float = SLIDING_M) -> None:
        self._model, self._exact = model, ExactNetworks(model)
        self._pads = np.arange(model.size if touched is None else touched)
        self._chance = np.random.default_rng(model.size + len(self._pads))
        angle = self._chance.uniform(0, 2 * np.pi, model.size)
        self._place = self._chance.uniform(0.3, 0.7, (model.size, 2))
        self._way = moving_m * np.stack([np.cos(angle), np.sin(angle)], axis=1) / self._exact.sides

    def counts(self) -> Counts:
        """Return the next sample (pads, 4)."""
        model, pads = self._model, self._pads
        self._place += self._way
        self._way[(self._place < 0.2) | (self._place > 0.8)] *= -1
        counts = self._chance.normal(size=(model.size, 4))
        at = self._place[pads] * self._exact.sides[pads]
        current = self._exact.fractions(pads, *at.T).T * (CURRENT_RATIO * model.begin_threshold_a[pads, None])
        counts[pads] += current / model.ampere_per_count[pads]
        return np.asarray(np.rint(counts), dtype="<i2")


class PipelineCase:
    """The pipeline of the daemon with a scene and subscriptions, all of whose messages are encoded.

    `robots`: with joint states at 1 kHz. `spent_ns`: processor time of each tick, from the last sample to
    encoded messages, with the preparation of the next.
    """

    def __init__(
        self,
        model: PadModel,
        subscribed: tuple[str, ...],
        scene: SceneRequest,
        robots: RobotModels | None = None,
    ) -> None:
        self.pipeline = Pipeline(model, PERIOD_NS, 0.6, self, robots=robots)
        self.pipeline.node_state[:] = 0
        self.subscriptions = frozenset(prefix.encode() for prefix in subscribed)
        self.spent_ns: list[int] = []
        self.sent_bytes = 0
        self._subscribed, self._is_subscribed = subscribed, dict[str, bool]()
        self._joints = JointStateBuffer(robots.joint_names[0]) if robots else None
        if self._joints is not None:
            joints = self._joints
            self.pipeline.transforms.joints_at = lambda _, t_ns: joints.interpolate(t_ns)
        scenes = ActiveScenes(scene, list(zip(model.hands, model.links, strict=True)))
        self.demand = Demand(scenes, self, 1e9 / PERIOD_NS, self._apply)
        self.demand.update(0)
        self._needed = np.flatnonzero(scenes.requirements.pads)

    def has_subscriber(self, topic: str) -> bool:
        if topic not in self._is_subscribed:
            self._is_subscribed[topic] = topic.startswith(self._subscribed)
        return self._is_subscribed[topic]

    def send(self, message: wire.OutgoingMessage) -> None:
        self.sent_bytes += sum(map(len, wire.encode(message)))

    def _apply(self, requested: Any, needed: Any, *_: Any) -> None:
        self.pipeline.apply_demand(requested, self.demand.ticks_per_hand_frame)
        self.pipeline.node_state[~needed.pads] = wire.PadState.OFF

    def tick(self, t_ns: int, counts: Counts) -> None:
        """Run a tick with the counts of the pads that aren't switched off."""
        pipeline = self.pipeline
        if self._joints is not None:
            for joints_ns in range(t_ns - PERIOD_NS, t_ns, JOINTS_EVERY_NS):
                angle = 0.5 + 0.4 * np.sin(joints_ns * 1e-9 + np.arange(16))
                self._joints.add_state(joints_ns, self._joints.names, angle)
        pipeline.begin_cycle(t_ns, t_ns)
        for pad in self._needed.tolist():
            pipeline.slab.write_pdo(pad, counts[pad].tobytes(), t_ns + 1000)
        begin_ns = time.thread_time_ns()
        if pipeline.tick_if_due(t_ns + 2000) is None:
            pipeline.tick_if_due(t_ns + PERIOD_NS - 1)
        pipeline.prepare_next_tick()
        self.demand.update(t_ns)
        self.spent_ns.append(time.thread_time_ns() - begin_ns)


def in_turns_of(cases: dict[str, PipelineCase], touches: Touches, ticks: int) -> list[dict[str, Any]]:
    """Run cases by turns on the same samples; return the median microseconds and bytes of a tick of each, and
    quartiles and median of its ratio to the first case in the same tick."""
    order: Sequence[PipelineCase] = list(cases.values())
    for number in range(ticks + WARM_UP):
        t_ns, counts = 10**9 + number * PERIOD_NS, touches.counts()
        for case in [*order[number % len(order) :], *order[: number % len(order)]]:
            case.tick(t_ns, counts)
    spent_us = {name: 1e-3 * np.array(case.spent_ns[WARM_UP:]) for name, case in cases.items()}
    first_us = next(iter(spent_us.values()))
    return [
        {
            "case": name,
            "us a tick": float(np.median(us)),
            "of everything on, %": (100 * np.percentile(us / first_us, [25, 50, 75])).tolist(),
            "bytes a tick": cases[name].sent_bytes / cases[name].pipeline.ticks,
        }
        for name, us in spent_us.items()
    ]
