"""Percept `texture`: slides among the samples of each contact.

Public names: `TextureEstimator`, `slide_distance_m`. The analysis is in `handtouch.percept.spectrum`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from handtouch.percept.action_request import CandidateAction, Question
from handtouch.percept.samples import ContactBuffer, PerceptEstimate, SampleWindow
from handtouch.percept.spectrum import (
    TEXTURE_CLASSES,
    TextureEstimate,
    detrended,
    estimate_texture,
)
from handtouch.percept.window_estimator import WindowEstimator

FloatArray = NDArray[np.float64]

_MIN_SAMPLES = 48
_FIT_PERIOD_NS = 250_000_000
_MIN_SLIDE_M = 1e-3
_REQUESTED_SLIDE_S = 1.0
_MAX_REFERENCE_CONTACTS = 3  # contacts that determine the object's motion
_SLIDE_COST = 3.0  # the object may be dropped


def slide_distance_m(window: SampleWindow, others: Sequence[SampleWindow] = ()) -> tuple[FloatArray, str]:
    """Return the displacement (k,) of a contact along the line it slid on, and its source.

    Source: joints, position, or "" if unknown. From joint states it is the displacement of the link's surface
    relative to the object, which moves with the mean of the hand's other contacts (`others`), or rests
    without any.
    """
    known: list[tuple[FloatArray, str]] = []
    palm = window["palm_position_m"]
    if len(window) > 2 and np.isfinite(palm).all():
        moved = _link_material_path(window)
        t = np.asarray(window.sample_ns - window.sample_ns[0], np.float64)
        held = [other for other in others if len(other) > 2 and np.isfinite(other["palm_position_m"]).all()]
        for other in held:
            there, when = (
                _link_material_path(other),
                np.asarray(other.sample_ns - window.sample_ns[0], np.float64),
            )
            for axis in range(3):
                moved[:, axis] -= np.interp(t, when, there[:, axis]) / len(held)
        known.append((_principal_path(moved, 5), "joints"))
    position = window["pad_m"]
    if len(window) > 2 and np.isfinite(position).all():
        known.append((_cubic_trend(_principal_path(position, 1)), "position"))
    if not known:
        return np.zeros(len(window)), ""
    return max(known, key=lambda one: float(np.ptp(one[0])))


def _link_material_path(window: SampleWindow) -> FloatArray:
    """Return the path (k, 3) of a point fixed to the link."""
    link = window["position_m"]
    turned = np.einsum("kij,kj->ki", window["palm_rotation"], link - link.mean(axis=0))
    return np.asarray(window["palm_position_m"] - turned)


def _principal_path(points: FloatArray, width: int) -> FloatArray:
    """Return the coordinate along the principal direction of points (k, d), smoothed over `width` samples."""
    away = points - points.mean(axis=0)
    way = away @ np.linalg.eigh(away.T @ away)[1][:, -1]
    if width > 1 and len(way) > 2 * width:
        padded = np.concatenate([np.full(width // 2, way[0]), way, np.full(width // 2, way[-1])])
        way = np.convolve(padded, np.full(width, 1 / width), mode="valid")
    return np.asarray(way)


def _cubic_trend(way: FloatArray) -> FloatArray:
    """Return the best-fitting cubic in time: positions on a pad are too noisy for single steps."""
    return way - detrended(way, np.linspace(0, 1, len(way)))


class TextureEstimator(WindowEstimator[tuple[int, int, TextureEstimate, str]]):
    """Estimates the texture of surfaces that slide over each pad; the best slide of a contact is kept.

    Kept are contact id, hand, estimate and the source of its slide distance.
    """

    kind = "texture"

    def __init__(self, pads: int) -> None:
        super().__init__(pads, _FIT_PERIOD_NS, _MIN_SAMPLES)
        self._noise: dict[int, float] = {}
        self._rate_hz = np.full(pads, np.nan)

    def _fit_window(self, buffer: ContactBuffer, pad: int, now_ns: int) -> PerceptEstimate:
        """Analyse the pad's window: noise while it is at rest, texture while it slides."""
        contact, hand = int(buffer.contact_id[pad]), int(buffer.hand_index[pad])
        window = buffer.window(pad)
        others = np.flatnonzero((buffer.hand_index == hand) & (buffer.contact_id > 0))
        few = others[others != pad][:_MAX_REFERENCE_CONTACTS].tolist()
        way, by = slide_distance_m(window, [buffer.window(other) for other in few])
        self._rate_hz[pad] = (len(window) - 1) / max(-float(window.relative_s[0]), 1e-9)
        current = window["total_current_a"]
        if not by:
            found = TextureEstimate("undetermined", reason="no position: the slide distance isn't known")
        elif float(np.ptp(way)) < _MIN_SLIDE_M:
            found = TextureEstimate("undetermined", reason="the contact doesn't slide", samples=len(window))
            if (current > 0).all():
                remainder = detrended(np.log(current), np.linspace(0, 1, len(current)))
                self._noise[pad] = float(np.sqrt(remainder @ remainder / len(remainder)))
        else:
            found = estimate_texture(current, way, self._noise.get(pad))
        before = self._best.get(pad)
        if before is not None and before[0] == contact and _quality(before[2]) > _quality(found):
            found, by = before[2], before[3]
        self._best[pad] = contact, hand, found, by
        return _texture_percept(found, by, hand, pad, contact, now_ns)

    def _discard(self, pad: int) -> None:
        super()._discard(pad)
        self._noise.pop(pad, None)

    def open_questions(self, now_ns: int) -> Sequence[Question]:  # noqa: ARG002
        """Return a question for each contact that slid too fast, too little, or not at all."""
        return [
            _texture_question(hand, pad, contact, found, float(self._rate_hz[pad]))
            for pad, (contact, hand, found, by) in self._best.items()
            if found.state == "undetermined" and by and self.requested[pad]
        ]


def _quality(found: TextureEstimate) -> float:
    """Return the rank of an estimate: determined first, then the length of the slide."""
    return (1.0 if found.state == "estimated" else 0.0) + min(found.distance_m, 0.5)


def _texture_percept(
    found: TextureEstimate, by: str, hand: int, pad: int, contact: int, now_ns: int
) -> PerceptEstimate:
    numbers = {
        "period_m": found.period_m if found.label == "periodic" else math.nan,
        "period_m_std": found.period_std_m if found.label == "periodic" else math.nan,
        "amplitude": found.amplitude if found.label == "periodic" else math.nan,
        "roughness": found.roughness,
        "roughness_std": found.roughness_std,
        "min_period_m": found.min_period_m,
        "max_period_m": found.max_period_m,
    }
    values: dict[str, float | str | Sequence[float] | None] = {
        name: value for name, value in numbers.items() if math.isfinite(value)
    }
    if values:
        values["distance_source"] = by
    if found.label == "periodic":
        values["aliasing_possible"] = found.aliased
    evidence = {"samples": found.samples, "distance_m": found.distance_m}
    return PerceptEstimate(
        "texture",
        hand,
        pad,
        contact,
        now_ns,
        found.state,
        found.label,
        found.probabilities,
        values,
        evidence,
        found.reason,
    )


def _texture_question(hand: int, pad: int, contact: int, found: TextureEstimate, rate_hz: float) -> Question:
    """Return the question of the texture class: a slide that resolves a fifth of a millimetre.

    The outcome is ln of the peak over the noise floor.
    """
    hypotheses = found.probabilities or {name: 1 / len(TEXTURE_CLASSES) for name in TEXTURE_CLASSES}
    speed = 0.1e-3 * rate_hz if math.isfinite(rate_hz) else 0.02
    distance = min(max(_REQUESTED_SLIDE_S * speed, 5e-3), 20e-3)
    outcomes = {"periodic": (3.5, 0.7), "rough": (1.6, 0.4), "smooth": (1.4, 0.4)}
    amount: dict[str, float | str] = {"distance_m": distance, "speed_m_per_s": min(speed, 0.05)}
    slide = CandidateAction("slide", amount, outcomes, _SLIDE_COST, "ln of the peak over the noise floor")
    return Question("texture_class", hand, pad, contact, hypotheses, [slide])
