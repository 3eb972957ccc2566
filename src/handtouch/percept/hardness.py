"""How hard is it, as a part of perception: squeezes on the stream of contacts.

Public names: `Hardness`, `closing_m`; the fit itself is in `handtouch.percept.stiffness`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from handtouch.percept.ask import Action, Question
from handtouch.percept.stiffness import BOUNDS_N_PER_M, CLASSES, RANGE_N_PER_M, Stiffness, stiffness
from handtouch.percept.stream import IntArray, Percept, Sample, Stream, Window

FloatArray = NDArray[np.float64]

_LEAST_SAMPLES = 16
_AGAIN_NS = 100_000_000
_OPPOSED = -0.7  # cosine between normals of two pads that hold something between them
_SQUEEZE_N = 1.0


def closing_m(window: Window, others: Sequence[Window] = ()) -> FloatArray:
    """How far the hand has closed on a contact, (k,) [m], in the palm's frame, along the contact's normal.

    Of the point of the link where the contact is, so that noise of the place on the pad doesn't count.
    others: of the same hand; those that press from the other side close, too. Without any, the object is
    taken to be at rest in the palm's frame. NaN where palm and joints aren't known.
    """
    moved, normal = _along(window)
    for other in others:
        if len(other) < 2:
            continue
        there, facing = _along(other)
        if float(facing @ normal) < _OPPOSED:
            t = np.asarray(window.t_ns - window.t_ns[0], np.float64)
            when, known = np.asarray(other.t_ns - window.t_ns[0], np.float64), np.isfinite(there)
            moved = moved + np.interp(t, when[known], there[known])
            break
    return moved


def _along(window: Window) -> tuple[FloatArray, FloatArray]:
    """Way of a link's point along the mean normal (k,), and that normal."""
    rotation, place, on_link = window["palm_rotation"], window["palm_position_m"], window["position_m"]
    known = np.flatnonzero(np.isfinite(place).all(axis=1) & np.isfinite(on_link).all(axis=1))
    if not len(known):
        return np.full(len(window), np.nan), np.full(3, np.nan)
    point = place - np.einsum("kij,kj->ki", rotation, on_link - on_link[known].mean(axis=0))
    normal = window["palm_normal"][known].mean(axis=0)
    normal = normal / np.linalg.norm(normal)
    return np.asarray((point - point[known[-1]]) @ normal), normal


class Hardness:
    """Stiffness of what each pad presses, as a part of perception. The best squeeze of a contact counts."""

    kind = "hardness"

    def __init__(self, pads: int, skin_m_per_n: float = 0.0, skin_std_m_per_n: float = 0.0) -> None:
        self.wanted = np.zeros(pads, dtype=np.bool_)
        self._fitted_ns = np.full(pads, -(10**18), dtype=np.int64)
        self._blind = np.zeros(pads, dtype=np.bool_)  # without joints a squeeze tells nothing
        self._best: dict[int, tuple[int, int, Stiffness]] = {}  # pad -> contact, hand, what is known
        self._skin = {"skin_m_per_n": skin_m_per_n, "skin_std_m_per_n": skin_std_m_per_n}

    def step(self, stream: Stream, sample: Sample, began: IntArray) -> Sequence[Percept]:  # noqa: ARG002
        """A contact that is another one has nothing known of it."""
        for pad in began.tolist():
            self._best.pop(pad, None)
        return ()

    def due(self, stream: Stream, t_ns: int) -> int | None:
        """The pad that has waited longest."""
        ready = self.wanted & (stream.contact > 0) & (stream.count >= _LEAST_SAMPLES)
        pads = np.flatnonzero(ready & (t_ns - self._fitted_ns >= _AGAIN_NS))
        return int(pads[np.argmin(self._fitted_ns[pads])]) if len(pads) else None

    def fit(self, stream: Stream, pad: int, t_ns: int) -> Sequence[Percept]:
        """Fit the pad's window."""
        self._fitted_ns[pad] = t_ns
        contact, hand = int(stream.contact[pad]), int(stream.hand_of[pad])
        window = stream.window(pad)
        near = np.flatnonzero((stream.hand_of == hand) & (stream.contact > 0))
        depth = closing_m(window, [stream.window(other) for other in near.tolist() if other != pad])
        self._blind[pad] = not np.isfinite(depth).any()
        if self._blind[pad]:
            found = Stiffness("unestimated", "no joint states, and one sheet can't tell area from force")
        else:
            found = stiffness(window["force_n"], depth, window["force_std_n"], **self._skin)
        before = self._best.get(pad)
        if before is not None and before[0] == contact and _worth(before[2]) > _worth(found):
            found = before[2]
        self._best[pad] = contact, hand, found
        modelled = bool(np.isfinite(window["raw_force_n"]).any())
        return [_told(found, hand, pad, contact, t_ns, modelled)]

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
            for pad, (contact, hand, found) in self._best.items()
            if found.state == "unestimated" and self.wanted[pad] and not self._blind[pad]
        ]


def _worth(found: Stiffness) -> float:
    if found.state != "estimated":
        return -math.inf if not found.samples else -1e9
    return -found.std_n_per_m / found.stiffness_n_per_m


def _told(found: Stiffness, hand: int, pad: int, contact: int, t_ns: int, modelled: bool) -> Percept:
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
