"""Percepts of all hands: motion from the core's slip stage, all others from the percept process.

Public name: `PerceptPublisher`.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.config import Deployment
from handtouch.core.columns import TickResult
from handtouch.core.pipeline import Pipeline
from handtouch.core.scene import RequestedOutputs
from handtouch.core.tick_messages import MessageSink
from handtouch.daemon.child_process import ChildProcess
from handtouch.daemon.percept_client import PerceptClient
from handtouch.percept.messages import make_percept_message
from handtouch.percept.motion import MotionReporter
from handtouch.percept.samples import ContactBuffer, ContactSamples
from handtouch.percept.slip_evidence import FEATURE_WINDOW_S


class PerceptPublisher:
    """Publishes percepts of all hands; while `enabled` is False there is nothing to do.

    `process`: a stand-in for the percept process, for tests.
    """

    def __init__(
        self,
        deployment: Deployment,
        pipeline: Pipeline,
        publisher: MessageSink,
        session: int = 0,
        process: ChildProcess | None = None,
    ) -> None:
        self.client = PerceptClient(deployment, pipeline, self._publish_percept, process)
        self._pipeline, self._publisher, self._session = pipeline, publisher, session
        self._hands = list(pipeline.model.rows_of_hand)
        self._motion_pads: NDArray[np.bool_] = np.zeros(pipeline.model.size, dtype=np.bool_)
        self._motion_requested = False
        self._seq: Counter[str] = Counter()
        hand_index = np.zeros(pipeline.model.size, dtype=np.intp)
        for hand, rows in enumerate(pipeline.model.rows_of_hand.values()):
            hand_index[rows] = hand
        period_s = pipeline.cycle.period_ns * 1e-9
        length = round(FEATURE_WINDOW_S / period_s) + 2
        self._poses = ContactBuffer(pipeline.model.size, hand_index.tolist(), length)
        """latest poses of links in the palm frame"""
        self._motion = MotionReporter(pipeline.tick.slip, self._poses, period_s)

    @property
    def enabled(self) -> bool:
        """Some percept is requested, or the percept process still runs."""
        return self._motion_requested or self.client.active

    def set_requested(self, requested: RequestedOutputs, now_ns: int) -> None:
        """Publish the requested percepts from now on."""
        self._poses.end_contacts(np.flatnonzero(requested.motion != self._motion_pads))
        self._motion_pads = requested.motion
        self._motion_requested = bool(self._motion_pads.any())
        self.client.set_requested(requested, now_ns)

    def process_tick(self, result: TickResult, now_ns: int) -> None:
        """Publish percepts of a tick's contacts; call it after the contacts are sent."""
        if self._motion_requested:
            ended = result.ended[self._motion_pads[result.ended]]
            percepts = self._motion.end_contacts(ended, result.sync_ns) if len(ended) else []
            self._poses.end_contacts(ended)
            rows = np.concatenate([result.began, result.updated])
            if len(rows := rows[self._motion_pads[rows]]):
                self._add_poses(rows)
                percepts += self._motion.report_contacts(rows, result.sync_ns)
            for percept in percepts:
                hand, link = self._hands[percept.hand], self._pipeline.model.links[percept.pad]
                self._publish_percept(make_percept_message(percept, hand, link))
        self.client.process_tick(result, now_ns)

    def close(self) -> None:
        """Stop the percept process."""
        self.client.close()

    def _add_poses(self, rows: NDArray[np.intp]) -> None:
        tick, transforms = self._pipeline.tick, self._pipeline.transforms
        if not transforms.any_requested:
            return
        sample = ContactSamples(rows, tick.columns.sample_ns[rows], tick.state.contact_id[rows])
        placed, rotation, _, joints_m2 = transforms.in_palm(rows)
        sample["position_m"], sample["pad_m"] = tick.columns.position_m[rows], tick.columns.pad_m[rows]
        sample["total_current_a"] = tick.columns.total_current_a[rows]
        sample["palm_position_m"], sample["palm_normal"] = placed[:, :3], placed[:, 3:6]
        sample["palm_rotation"], sample["palm_joints_m2"] = rotation, joints_m2
        self._poses.add_samples(sample)

    def _publish_percept(self, percept: wire.Percept) -> None:
        topic = wire.topic_of(percept)
        self._seq[topic] += 1
        if self._publisher.has_subscriber(topic):
            self._publisher.send(replace(percept, session=self._session, seq=self._seq[topic]))
