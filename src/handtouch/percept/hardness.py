"""How hard is it, as a part of perception: squeezes on the stream of contacts.

Public names: `Hardness`; the fit itself is in `handtouch.percept.stiffness`, its depth in `closing`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from handtouch.percept.ask import Action, Question
from handtouch.percept.closing import Closing, closing, held
from handtouch.percept.stiffness import BOUNDS_N_PER_M, CLASSES, RANGE_N_PER_M, Stiffness, stiffness
from handtouch.percept.stream import IntArray, Percept, Sample, Stream, Turns, Window

FloatArray = NDArray[np.float64]

_LEAST_SAMPLES = 16
_AGAIN_NS = 250_000_000  # a squeeze takes a second; what many fingers hold takes milliseconds to fit
_SQUEEZE_N = 1.0
_SWAYS = 0.75  # share of the depth: more isn't mended by squeezing
_NOTHING = 2.0  # so large a share leaves nothing known


class Hardness:
    """Stiffness of what each pad presses, as a part of perception. The best squeeze of a contact counts."""

    kind = "hardness"

    def __init__(self, pads: int, skin_m_per_n: float = 0.0, skin_std_m_per_n: float = 0.0) -> None:
        self.wanted = np.zeros(pads, dtype=np.bool_)
        self._turns = Turns(pads, _AGAIN_NS)
        self._best: dict[int, tuple[int, int, Stiffness, Closing]] = {}
        """pad -> contact, hand, what is known, and by how far the hand closed"""
        self._skin = {"skin_m_per_n": skin_m_per_n, "skin_std_m_per_n": skin_std_m_per_n}

    def step(self, stream: Stream, sample: Sample, began: IntArray) -> Sequence[Percept]:  # noqa: ARG002
        """A contact that is another one has nothing known of it."""
        for pad in began.tolist():
            self._best.pop(pad, None)
        return ()

    def due(self, stream: Stream, t_ns: int) -> int | None:
        """The pad that has waited longest."""
        return self._turns.due(self.wanted & (stream.contact > 0) & (stream.count >= _LEAST_SAMPLES), t_ns)

    def fit(self, stream: Stream, pad: int, t_ns: int) -> Sequence[Percept]:
        """Fit the pad's window."""
        self._turns.took(pad, t_ns)
        contact, hand = int(stream.contact[pad]), int(stream.hand_of[pad])
        window = stream.window(pad)
        closed = closing(window, held(stream, pad))
        if closed.by:
            found = self._squeeze(window, closed)
        else:
            reason = "no joint states, no commands, and one sheet can't tell area from force"
            found = Stiffness("unestimated", reason)
        before = self._best.get(pad)
        # what was taken to rest, and is held by others now, may have moved
        kept = before is not None and before[0] == contact and before[3].sides >= closed.sides
        if before is not None and kept and _worth(before[2]) > _worth(found):
            found, closed = before[2:]
        self._best[pad] = contact, hand, found, closed
        modelled = bool(np.isfinite(window["raw_force_n"]).any())
        return [_told(found, hand, pad, contact, t_ns, modelled, closed.by)]

    def _squeeze(self, window: Window, closed: Closing) -> Stiffness:
        """Fit; what may be the object's own way is no depth that is known."""
        share = min(closed.share, _NOTHING)
        force, std = (window[name][closed.rows] for name in ("force_n", "force_std_n"))
        skin = {name: closed.sides * each for name, each in self._skin.items()}
        found = stiffness(force, closed.depth_m, std, moves=share, **skin)
        if found.samples and share > _SWAYS:
            reason = "other fingers move what is held: how far this one goes in isn't known"
            return replace(found, state="unestimated", reason=reason)
        return found

    def end(self, stream: Stream, pads: IntArray, t_ns: int) -> Sequence[Percept]:
        """A last look at squeezes that no fit has seen to their end."""
        last: list[Percept] = []
        for pad in pads.tolist():
            if stream.count[pad] >= _LEAST_SAMPLES:
                last += self.fit(stream, pad, t_ns)
            self._best.pop(pad, None)
        return last

    def questions(self, t_ns: int) -> Sequence[Question]:  # noqa: ARG002
        """Of contacts whose stiffness isn't known: how hard?"""
        return [
            _question(hand, pad, contact, found)
            for pad, (contact, hand, found, closed) in self._best.items()
            if found.state == "unestimated"
            and self.wanted[pad]
            and closed.by  # without depth it tells nothing
        ]


def _worth(found: Stiffness) -> float:
    if found.state != "estimated":
        return -math.inf if not found.samples else -1e9
    return -found.std_n_per_m / found.stiffness_n_per_m


def _told(found: Stiffness, hand: int, pad: int, contact: int, t_ns: int, modelled: bool, by: str) -> Percept:
    sure = found.state == "estimated"
    label = max(found.probabilities, key=found.probabilities.__getitem__) if sure else ""
    values: dict[str, float | str | Sequence[float] | None] = {}
    if found.samples:
        values = {
            "stiffness_n_per_m": found.stiffness_n_per_m if sure else None,
            "stiffness_n_per_m_std": found.std_n_per_m if sure else None,
            "low_n_per_m": found.low_n_per_m,
            "high_n_per_m": found.high_n_per_m,
            "at_force_n": found.force_n,
            "exponent": found.exponent,
            "unloading_n_per_m": found.unloading_n_per_m if math.isfinite(found.unloading_n_per_m) else None,
            "branch": found.branch,
            "sheet": "compensated" if modelled else "taken as ideal",
            "depth_by": by,
        }
    return Percept(
        "hardness",
        hand,
        pad,
        contact,
        t_ns,
        found.state,
        label,
        found.probabilities,
        values,
        {"samples": found.samples},
        found.reason,
    )


def _question(hand: int, pad: int, contact: int, found: Stiffness) -> Question:
    """Outcome of a squeeze is ln stiffness: within a class it may be anywhere, about 0.6 either way."""
    hypotheses = found.probabilities or {name: 1 / len(CLASSES) for name in CLASSES}
    low, high = RANGE_N_PER_M[0] * 10, RANGE_N_PER_M[1] / 100
    edges = (low, *BOUNDS_N_PER_M, high)
    outcomes = {
        name: (0.5 * math.log(edges[k] * edges[k + 1]), 0.3 * math.log(edges[k + 1] / edges[k]) + 0.1)
        for k, name in enumerate(CLASSES)
    }
    squeeze = Action("squeeze", {"force_n": _SQUEEZE_N}, outcomes, outcome="ln of stiffness in N/m")
    return Question("how hard", hand, pad, contact, hypotheses, [squeeze])
