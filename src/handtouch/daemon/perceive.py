"""From a tick's columns to samples for perception, and from percepts to messages.

Public names: `Perceiving`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.percept.closing import Commanded
from handtouch.percept.stream import KINDS, Sample, Stream

if TYPE_CHECKING:
    from handtouch.daemon.messages import Outlet
    from handtouch.daemon.pipeline import Pipeline
    from handtouch.daemon.scene import Wanted
    from handtouch.daemon.tick import Ticked
    from handtouch.hand.joints import Joints
    from handtouch.percept.ask import Ask
    from handtouch.percept.percept import Perceiver
    from handtouch.percept.stream import Percept

_AGAIN_NS = {"motion": 50_000_000}
"""From one message of what goes on as it was to the next; news are told at once."""
_AGAIN_ANY_NS = 500_000_000


class Perceiving:
    """Perception of all hands of a pipeline. While `wanted` is False nothing is made, called or imported."""

    def __init__(self, pipeline: Pipeline, outlet: Outlet, run: int = 0) -> None:
        self.wanted = False
        self._pipeline, self._outlet, self._run = pipeline, outlet, run
        self._perceiver: Perceiver | None = None
        self._hands = list(pipeline.model.rows_of_hand)
        self._felt: NDArray[np.bool_] = np.zeros(pipeline.model.size, dtype=np.bool_)
        self._squeezed = self._felt
        self._seq: Counter[str] = Counter()
        self.commands_at: Callable[[str, int], Joints | None] = lambda _, __: None
        """a hand's joints as they were told to be at a time, None where nobody tells; the daemon sets it"""
        self._commanded = Commanded(pipeline.model.size)
        self._told: dict[tuple[str, int, int], tuple[int, str, str]] = {}  # kind, hand, pad -> time, state

    def want(self, wanted: Wanted) -> None:
        """Perceive what is wanted from now on."""
        self.wanted = wanted.percepts is not None
        if wanted.percepts is None:
            self._perceiver = None  # what was known goes stale: begin anew when somebody asks again
            self._told.clear()
            return
        if self._perceiver is None:
            self._perceiver = self._made()
        none = np.zeros(self._pipeline.model.size, dtype=np.bool_)
        self._felt = np.asarray(wanted.percepts.any(axis=0))
        self._squeezed = wanted.percepts[KINDS.index("hardness")]
        self._perceiver.want(wanted.percepts, none if wanted.asks is None else wanted.asks)

    def step(self, ticked: Ticked) -> None:
        """Perceive what a tick brought, and tell it; after its contacts were sent."""
        if self._perceiver is None:
            return
        found, asks = self._perceiver.step(self._sample(ticked), ticked.ended, ticked.t_ns)
        for percept in found:
            self._tell(percept)
        for ask in asks:
            self._ask(ask)

    def _made(self) -> Perceiver:
        from handtouch.percept.parts import made

        rows = self._pipeline.model.rows_of_hand.values()
        hand_of = np.zeros(self._pipeline.model.size, dtype=np.intp)
        for hand, pads in enumerate(rows):
            hand_of[pads] = hand
        return made(Stream(len(hand_of), hand_of.tolist()), self._pipeline.cycle.period_ns, self._pair_m)

    def _pair_m(self, pad: int, residual: float, residual_std: float) -> tuple[float, float]:
        """`pair_distance` in metres."""
        from handtouch.percept.shape import pair_distance

        model, (x, y) = self._pipeline.model, self._pipeline.tick.columns.xy[pad].tolist()
        if not math.isfinite(x + y):
            return math.nan, math.inf
        distance, std = pair_distance(model.locator, pad, x, y, residual, residual_std)
        step = 0.02 * float(model.locator.sides[pad].min())
        way = step * np.array([0.0, 1.0])
        xs, ys = x + way * (residual >= 0), y + way * (residual < 0)
        placed = model.placement.place(np.full(2, pad), xs, ys, np.zeros((2, 2, 2))).position_m
        scale = float(np.linalg.norm(placed[1] - placed[0])) / step
        return scale * distance, scale * std

    def _sample(self, ticked: Ticked) -> Sample:
        tick, frames = self._pipeline.tick, self._pipeline.frames
        columns = tick.columns
        rows = np.concatenate([ticked.began, ticked.updated])
        rows = rows[self._felt[rows]]
        sample = Sample(rows, columns.sample_ns[rows], tick.contacts.id[rows])
        if not len(rows):
            return sample
        for name in ("pad_m", "position_m", "normal", "covariance_m2", "force_n", "force_std_n"):
            sample[name] = getattr(columns, name)[rows]
        sample["raw_force_n"] = np.where(tick.strength.modelled[rows], columns.raw_force_n[rows], np.nan)
        for name in ("current_a", "residual", "residual_std"):
            sample[name] = getattr(columns, name)[rows]
        sample["pad_noise_m2"] = tick.place_noise(rows)
        if frames.wanted:
            placed, rotation, age_s, joints_m2 = frames.in_palm(rows)
            sample["palm_position_m"], sample["palm_normal"] = placed[:, :3], placed[:, 3:6]
            sample["palm_covariance_m2"], sample["palm_rotation"] = placed[:, 6:], rotation
            sample["joints_age_s"], sample["palm_joints_m2"] = age_s, joints_m2
        self._follow_commands(sample, ticked.t_ns)
        return sample

    def _follow_commands(self, sample: Sample, t_ns: int) -> None:
        """Where joint states don't tell how far a hand closes, commands may."""
        blind = np.flatnonzero(np.isnan(sample["palm_position_m"][:, 0]) & self._squeezed[sample.pads])
        if not len(blind):
            return
        poses = self._pipeline.frames.told_poses(sample.pads[blind], t_ns, self.commands_at)
        on_link, normal = sample["position_m"][blind], sample["normal"][blind]
        way, facing = self._commanded.step(sample.pads[blind], sample.contact[blind], poses, on_link, normal)
        sample["commanded_m"][blind], sample["commanded_normal"][blind] = way, facing

    def _tell(self, percept: Percept) -> None:
        what = percept.kind, percept.hand, percept.pad
        state = percept.state, percept.label
        told_ns, *before = self._told.get(what, (-(10**18), "", ""))
        again_ns = _AGAIN_NS.get(percept.kind, _AGAIN_ANY_NS)
        news = percept.at_once or tuple(before) != state
        if not news and percept.t_ns - told_ns < again_ns:
            return
        self._told[what] = percept.t_ns, *state
        hand = self._hands[percept.hand]
        self._send(
            hand,
            percept.kind,
            percept.t_ns,
            link=self._pipeline.model.links[percept.pad] if percept.pad >= 0 else "",
            contact=percept.contact,
            state=percept.state,
            label=percept.label,
            confidence=percept.probabilities.get(percept.label),
            probabilities=dict(percept.probabilities),
            values=dict(percept.values),
            evidence=dict(percept.evidence),
            reason=percept.reason,
        )

    def _ask(self, ask: Ask) -> None:
        question, action = ask.question, ask.action
        self._send(
            self._hands[question.hand],
            "ask",
            ask.t_ns,
            link=self._pipeline.model.links[question.pad] if question.pad >= 0 else "",
            contact=question.contact,
            state="open",
            label=action.do,
            confidence=None,
            probabilities=dict(question.hypotheses),
            values={**action.amount, "bits": ask.bits},
            evidence={},
            reason=ask.why,
            question=question.name,
            expires_ns=ask.expires_ns,
        )

    def _send(self, hand: str, kind: str, t_ns: int, **told: object) -> None:
        topic = f"percept/{hand}/{kind}"
        self._seq[topic] += 1
        if self._outlet.wants(topic):
            self._outlet.send(
                wire.Percept(
                    v=wire.SCHEMA_VERSION,
                    run=self._run,
                    seq=self._seq[topic],
                    t_ns=t_ns,
                    hand=hand,
                    kind=kind,
                    repeat=False,
                    **told,  # type: ignore[arg-type]
                )
            )
