"""How does its surface feel, as a part of perception: slides on the stream of contacts.

Public names: `Texture`, `slide_m`; what a slide tells is worked out in `handtouch.percept.spectrum`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from handtouch.percept.ask import Action, Question
from handtouch.percept.spectrum import CLASSES, Found, detrended, texture
from handtouch.percept.stream import IntArray, Percept, Sample, Stream, Turns, Window

FloatArray = NDArray[np.float64]

_LEAST = 48  # samples
_AGAIN_NS = 250_000_000
_LEAST_M = 1e-3
_ASK_S = 1.0
_OTHERS = 3  # contacts that tell how the object moves
_COST = 3.0  # a held object may fall


def slide_m(window: Window, others: Sequence[Window] = ()) -> tuple[FloatArray, str]:
    """Way (k,) of a contact along the line that it slid, and by what it is known: joints, place or nothing.

    By joint states it is that of the link's surface against the object, which moves as the hand's other
    contacts (`others`) do on average, or stands still where there are none.
    """
    known: list[tuple[FloatArray, str]] = []
    palm = window["palm_position_m"]
    if len(window) > 2 and np.isfinite(palm).all():
        moved = _material(window)
        t = np.asarray(window.t_ns - window.t_ns[0], np.float64)
        held = [other for other in others if len(other) > 2 and np.isfinite(other["palm_position_m"]).all()]
        for other in held:
            there, when = _material(other), np.asarray(other.t_ns - window.t_ns[0], np.float64)
            for axis in range(3):
                moved[:, axis] -= np.interp(t, when, there[:, axis]) / len(held)
        known.append((_along(moved, 5), "joints"))
    place = window["pad_m"]
    if len(window) > 2 and np.isfinite(place).all():
        known.append((_smooth(_along(place, 1)), "place"))
    if not known:
        return np.zeros(len(window)), ""
    return max(known, key=lambda one: float(np.ptp(one[0])))


def _material(window: Window) -> FloatArray:
    """Where a point of the link went (k, 3)."""
    link = window["position_m"]
    turned = np.einsum("kij,kj->ki", window["palm_rotation"], link - link.mean(axis=0))
    return np.asarray(window["palm_position_m"] - turned)


def _along(points: FloatArray, width: int) -> FloatArray:
    """Way along the direction in which points (k, d) are spread most, over a moving mean of `width`."""
    away = points - points.mean(axis=0)
    way = away @ np.linalg.eigh(away.T @ away)[1][:, -1]
    if width > 1 and len(way) > 2 * width:
        padded = np.concatenate([np.full(width // 2, way[0]), way, np.full(width // 2, way[-1])])
        way = np.convolve(padded, np.full(width, 1 / width), mode="valid")
    return np.asarray(way)


def _smooth(way: FloatArray) -> FloatArray:
    """A cubic in time: places on a pad are too noisy to count steps."""
    return way - detrended(way, np.linspace(0, 1, len(way)))


class Texture:
    """Texture of what slides over each pad, as a part of perception."""

    kind = "texture"

    def __init__(self, pads: int) -> None:
        self.wanted = np.zeros(pads, dtype=np.bool_)
        self._turns = Turns(pads, _AGAIN_NS)
        self._best: dict[int, tuple[int, int, Found, str]] = {}
        self._noise: dict[int, float] = {}
        self._rate_hz = np.full(pads, np.nan)

    def step(self, stream: Stream, sample: Sample, began: IntArray) -> Sequence[Percept]:  # noqa: ARG002
        """A contact that is another one has nothing known of it."""
        for pad in began.tolist():
            self._best.pop(pad, None)
            self._noise.pop(pad, None)
        return ()

    def due(self, stream: Stream, t_ns: int) -> int | None:
        """The pad that has waited longest."""
        return self._turns.due(self.wanted & (stream.contact > 0) & (stream.count >= _LEAST), t_ns)

    def fit(self, stream: Stream, pad: int, t_ns: int) -> Sequence[Percept]:
        """Look at the pad's window: while it rests for its noise, while it slides for texture."""
        self._turns.took(pad, t_ns)
        contact, hand = int(stream.contact[pad]), int(stream.hand_of[pad])
        window = stream.window(pad)
        others = np.flatnonzero((stream.hand_of == hand) & (stream.contact > 0))
        few = others[others != pad][:_OTHERS].tolist()
        way, by = slide_m(window, [stream.window(other) for other in few])
        self._rate_hz[pad] = (len(window) - 1) / max(-float(window.t_s[0]), 1e-9)
        current = window["current_a"]
        if not by:
            found = Found("unestimated", reason="no place: how far it slides isn't known")
        elif float(np.ptp(way)) < _LEAST_M:
            found = Found("unestimated", reason="it doesn't slide", samples=len(window))
            if (current > 0).all():
                rest = detrended(np.log(current), np.linspace(0, 1, len(current)))
                self._noise[pad] = float(np.sqrt(rest @ rest / len(rest)))
        else:
            found = texture(current, way, self._noise.get(pad))
        before = self._best.get(pad)
        if before is not None and before[0] == contact and _worth(before[2]) > _worth(found):
            found, by = before[2], before[3]
        self._best[pad] = contact, hand, found, by
        return [_told(found, by, hand, pad, contact, t_ns)]

    def end(self, stream: Stream, pads: IntArray, t_ns: int) -> Sequence[Percept]:
        """A last look at what slid."""
        last: list[Percept] = []
        for pad in pads.tolist():
            if stream.count[pad] >= _LEAST:
                last += self.fit(stream, pad, t_ns)
            self._best.pop(pad, None)
        return last

    def questions(self, t_ns: int) -> Sequence[Question]:  # noqa: ARG002
        """Of contacts that slid too fast, too little, or not at all: how does it feel?"""
        return [
            _question(hand, pad, contact, found, float(self._rate_hz[pad]))
            for pad, (contact, hand, found, by) in self._best.items()
            if found.state == "unestimated" and by and self.wanted[pad]
        ]


def _worth(found: Found) -> float:
    """How well it is known: first whether, then by how long a slide."""
    return (1.0 if found.state == "estimated" else 0.0) + min(found.distance_m, 0.5)


def _told(found: Found, by: str, hand: int, pad: int, contact: int, t_ns: int) -> Percept:
    numbers = {
        "period_m": found.period_m if found.label == "periodic" else math.nan,
        "period_m_std": found.period_std_m if found.label == "periodic" else math.nan,
        "amplitude": found.amplitude if found.label == "periodic" else math.nan,
        "roughness": found.roughness,
        "roughness_std": found.roughness_std,
        "finest_m": found.finest_m,
        "longest_m": found.longest_m,
    }
    values: dict[str, float | str | Sequence[float] | None] = {
        name: value for name, value in numbers.items() if math.isfinite(value)
    }
    if values:
        values["distance_by"] = by
    if found.label == "periodic":
        values["may_be_finer"] = "yes" if found.aliased else "no"
    evidence = {"samples": found.samples, "distance_m": found.distance_m}
    return Percept(
        "texture",
        hand,
        pad,
        contact,
        t_ns,
        found.state,
        found.label,
        found.probabilities,
        values,
        evidence,
        found.reason,
    )


def _question(hand: int, pad: int, contact: int, found: Found, rate_hz: float) -> Question:
    """Slide so that a fifth of a millimetre can be told; outcome: ln of the peak over the floor."""
    hypotheses = found.probabilities or {name: 1 / len(CLASSES) for name in CLASSES}
    speed = 0.1e-3 * rate_hz if math.isfinite(rate_hz) else 0.02
    distance = min(max(_ASK_S * speed, 5e-3), 20e-3)
    outcomes = {"periodic": (3.5, 0.7), "rough": (1.6, 0.4), "smooth": (1.4, 0.4)}
    amount: dict[str, float | str] = {"distance_m": distance, "speed_m_per_s": min(speed, 0.05)}
    slide = Action("slide", amount, outcomes, _COST, "ln of the peak over the floor")
    return Question("which texture", hand, pad, contact, hypotheses, [slide])
