"""Adapter of the percept pipeline: ticks to contact samples, percepts and action requests to messages.

Public name: `PerceptPublisher`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.percept.indentation import CommandedMotion
from handtouch.percept.samples import ContactBuffer, ContactSamples
from handtouch.wire import PERCEPT_KINDS

if TYPE_CHECKING:
    from handtouch.core.pipeline import Pipeline
    from handtouch.core.scene import RequestedOutputs
    from handtouch.core.tick import TickResult
    from handtouch.core.tick_messages import MessageSink
    from handtouch.hand.joints import JointSnapshot
    from handtouch.percept.action_request import ActionRequest
    from handtouch.percept.pipeline import PerceptPipeline
    from handtouch.percept.samples import PerceptEstimate

_REPEAT_PERIOD_NS = {"motion": 50_000_000}
"""Period of messages while a percept doesn't change; changes are published at once."""
_DEFAULT_REPEAT_PERIOD_NS = 500_000_000


class PerceptPublisher:
    """Computes and publishes percepts of all hands; while `enabled` is False nothing is computed or imported.

    `commanded_joints_at` returns a hand's commanded joint state at a time, None if none was received.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        publisher: MessageSink,
        session: int = 0,
        commanded_joints_at: Callable[[str, int], JointSnapshot | None] = lambda _, __: None,
    ) -> None:
        self.enabled = False
        self.contacts: ContactBuffer | None = None
        """latest samples of every contact; None while no percept is requested"""
        self._pipeline, self._publisher, self._session = pipeline, publisher, session
        self._perceiver: PerceptPipeline | None = None
        self._hands = list(pipeline.model.rows_of_hand)
        self._percept_pads: NDArray[np.bool_] = np.zeros(pipeline.model.size, dtype=np.bool_)
        self._stiffness_pads = self._percept_pads
        self._seq: Counter[str] = Counter()
        self._commanded_joints_at = commanded_joints_at
        self._commanded_motion = CommandedMotion(pipeline.model.size)
        # kind, hand, pad -> time [ns], state, label
        self._last_published: dict[tuple[str, int, int], tuple[int, str, str]] = {}

    def set_requested(self, requested: RequestedOutputs) -> None:
        """Compute the requested percepts from now on."""
        self.enabled = requested.percepts is not None
        if requested.percepts is None:
            self._perceiver = self.contacts = None  # goes stale: start afresh with the next request
            self._last_published.clear()
            return
        if self._perceiver is None:
            self._perceiver = self._make_perceiver()
        none = np.zeros(self._pipeline.model.size, dtype=np.bool_)
        self._percept_pads = np.asarray(requested.percepts.any(axis=0))
        self._stiffness_pads = requested.percepts[PERCEPT_KINDS.index("stiffness")]
        self._perceiver.set_requested(
            requested.percepts, none if requested.action_requests is None else requested.action_requests
        )

    def process_tick(self, ticked: TickResult) -> None:
        """Update percepts with a tick's result and publish them; call it after the contacts are sent."""
        if self._perceiver is None:
            return
        percepts, requests = self._perceiver.process_tick(
            self._make_sample(ticked), ticked.ended, ticked.sync_ns
        )
        for percept in percepts:
            self._publish_percept(percept)
        for request in requests:
            self._publish_action_request(request)

    def _make_perceiver(self) -> PerceptPipeline:
        from handtouch.percept.registry import build_percept_pipeline

        rows = self._pipeline.model.rows_of_hand.values()
        hand_of = np.zeros(self._pipeline.model.size, dtype=np.intp)
        for hand, pads in enumerate(rows):
            hand_of[pads] = hand
        self.contacts = ContactBuffer(len(hand_of), hand_of.tolist())
        return build_percept_pipeline(
            self.contacts,
            self._pipeline.cycle.period_ns,
            self.pair_distance_m,
        )

    def pair_distance_m(self, pad: int, residual: float, residual_std: float) -> tuple[float, float]:
        """Return `pair_distance` and its standard deviation in metres on the surface."""
        from handtouch.percept.shape import pair_distance

        model, (x, y) = self._pipeline.model, self._pipeline.tick.columns.xy[pad].tolist()
        if not math.isfinite(x + y):
            return math.nan, math.inf
        distance, std = pair_distance(model.locator, pad, x, y, residual, residual_std)
        step = 0.02 * float(model.locator.sides[pad].min())
        offset = step * np.array([0.0, 1.0])
        xs, ys = x + offset * (residual >= 0), y + offset * (residual < 0)
        placed = model.placement.to_link_frame(np.full(2, pad), xs, ys, np.zeros((2, 2, 2))).position_m
        scale = float(np.linalg.norm(placed[1] - placed[0])) / step
        return scale * distance, scale * std

    def _make_sample(self, ticked: TickResult) -> ContactSamples:
        tick, frames = self._pipeline.tick, self._pipeline.transforms
        columns = tick.columns
        rows = np.concatenate([ticked.began, ticked.updated])
        rows = rows[self._percept_pads[rows]]
        sample = ContactSamples(rows, columns.sample_ns[rows], tick.contacts.id[rows])
        if not len(rows):
            return sample
        for name in ("pad_m", "position_m", "normal", "covariance_m2", "force_n", "force_std_n"):
            sample[name] = getattr(columns, name)[rows]
        sample["uncompensated_force_n"] = np.where(
            tick.sheet_force.modelled[rows], columns.uncompensated_force_n[rows], np.nan
        )
        for name in ("total_current_a", "residual", "residual_std"):
            sample[name] = getattr(columns, name)[rows]
        sample["pad_noise_m2"] = tick.position_noise_covariance(rows)
        if frames.any_requested:
            placed, rotation, age_s, joints_m2 = frames.in_palm(rows)
            sample["palm_position_m"], sample["palm_normal"] = placed[:, :3], placed[:, 3:6]
            sample["palm_covariance_m2"], sample["palm_rotation"] = placed[:, 6:], rotation
            sample["joints_age_s"], sample["palm_joints_m2"] = age_s, joints_m2
        self._add_commanded_motion(sample, ticked.sync_ns)
        return sample

    def _add_commanded_motion(self, sample: ContactSamples, t_ns: int) -> None:
        """Add the commanded motion of contacts whose position in the palm frame is unknown."""
        unknown = np.flatnonzero(
            np.isnan(sample["palm_position_m"][:, 0]) & self._stiffness_pads[sample.pads]
        )
        if not len(unknown):
            return
        poses = self._pipeline.transforms.poses_from_joints(
            sample.pads[unknown], t_ns, self._commanded_joints_at
        )
        on_link, normal = sample["position_m"][unknown], sample["normal"][unknown]
        motion, normals = self._commanded_motion.accumulate(
            sample.pads[unknown], sample.contact_id[unknown], poses, on_link, normal
        )
        sample["commanded_m"][unknown], sample["commanded_normal"][unknown] = motion, normals

    def _publish_percept(self, percept: PerceptEstimate) -> None:
        key = percept.kind, percept.hand, percept.pad
        state = percept.state, percept.label
        last_ns, *before = self._last_published.get(key, (-(10**18), "", ""))
        period_ns = _REPEAT_PERIOD_NS.get(percept.kind, _DEFAULT_REPEAT_PERIOD_NS)
        changed = percept.urgent or tuple(before) != state
        if not changed and percept.estimate_ns - last_ns < period_ns:
            return
        self._last_published[key] = percept.estimate_ns, *state
        hand = self._hands[percept.hand]
        self._send_message(
            hand,
            percept.kind,
            percept.estimate_ns,
            link=self._pipeline.model.links[percept.pad] if percept.pad >= 0 else "",
            contact_id=percept.contact,
            state=percept.state,
            label=percept.label,
            confidence=percept.probabilities.get(percept.label),
            probabilities=dict(percept.probabilities),
            values=dict(percept.values),
            evidence=dict(percept.evidence),
            reason=percept.reason,
        )

    def _publish_action_request(self, request: ActionRequest) -> None:
        question, action = request.question, request.action
        self._send_message(
            self._hands[question.hand],
            "action_request",
            request.request_ns,
            link=self._pipeline.model.links[question.pad] if question.pad >= 0 else "",
            contact_id=question.contact,
            state="open",
            label=action.kind,
            confidence=None,
            probabilities=dict(question.hypotheses),
            values={**action.parameters, "expected_information_bits": request.expected_information_bits},
            evidence={},
            reason=request.explanation,
            question=question.name,
            expires_ns=request.expires_ns,
        )

    def _send_message(self, hand: str, kind: str, t_ns: int, **fields: object) -> None:
        topic = f"percept/{hand}/{kind}"
        self._seq[topic] += 1
        if self._publisher.has_subscriber(topic):
            self._publisher.send(
                wire.Percept(
                    v=wire.SCHEMA_VERSION,
                    session=self._session,
                    seq=self._seq[topic],
                    t_ns=t_ns,
                    hand=hand,
                    kind=cast(wire.PerceptKind, kind),
                    retained=False,
                    **fields,  # type: ignore[arg-type]
                )
            )
