"""Percept `stiffness`: squeezes among the samples of each contact.

Public names: `StiffnessEstimator`. The fit is in `handtouch.percept.stiffness`, the indentation depth in
`handtouch.percept.indentation`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from handtouch.percept.action_request import CandidateAction, Question
from handtouch.percept.indentation import Indentation, estimate_indentation, other_contacts_of_hand
from handtouch.percept.samples import ContactBuffer, PerceptEstimate, SampleWindow
from handtouch.percept.stiffness import (
    CLASS_BOUNDS_N_PER_M,
    PRIOR_RANGE_N_PER_M,
    STIFFNESS_CLASSES,
    UNCOMPENSATED_SHEET_STD,
    StiffnessEstimate,
    estimate_stiffness,
)
from handtouch.percept.window_estimator import WindowEstimator

FloatArray = NDArray[np.float64]

_MIN_SAMPLES = 16
_FIT_PERIOD_NS = 250_000_000  # a squeeze takes a second; the fit of a grasp takes milliseconds
_REQUESTED_FORCE_N = 1.0
_MAX_OBJECT_MOTION_FRACTION = 0.75  # of the depth: beyond this, squeezing doesn't help
_OBJECT_MOTION_FRACTION_LIMIT = 2.0  # upper limit passed to the fit: nothing is known


class StiffnessEstimator(WindowEstimator[tuple[int, int, StiffnessEstimate, Indentation]]):
    """Estimates the stiffness of what each pad presses on; the best squeeze of a contact is kept.

    Kept are contact id, hand, estimate and its indentation.
    """

    kind = "stiffness"

    def __init__(self, pads: int, skin_m_per_n: float = 0.0, skin_std_m_per_n: float = 0.0) -> None:
        super().__init__(pads, _FIT_PERIOD_NS, _MIN_SAMPLES)
        self._skin_compliance = {"skin_m_per_n": skin_m_per_n, "skin_std_m_per_n": skin_std_m_per_n}

    def _fit_window(self, buffer: ContactBuffer, pad: int, now_ns: int) -> PerceptEstimate:
        contact, hand = int(buffer.contact_id[pad]), int(buffer.hand_index[pad])
        window = buffer.window(pad)
        compensated = bool(np.isfinite(window["uncompensated_force_n"]).any())
        indentation = estimate_indentation(window, other_contacts_of_hand(buffer, pad))
        if indentation.source:
            found = self._fit_squeeze(window, indentation, compensated)
        else:
            reason = "no joint states or commands, and one sheet can't separate area from force"
            found = StiffnessEstimate("undetermined", reason)
        before = self._best.get(pad)
        # an object assumed at rest that other contacts hold now may have moved
        kept = (
            before is not None
            and before[0] == contact
            and before[3].contact_sides >= indentation.contact_sides
        )
        if before is not None and kept and _quality(before[2]) > _quality(found):
            found, indentation = before[2:]
        self._best[pad] = contact, hand, found, indentation
        return _percept(found, hand, pad, contact, now_ns, compensated, indentation.source)

    def _fit_squeeze(
        self, window: SampleWindow, indentation: Indentation, compensated: bool
    ) -> StiffnessEstimate:
        """Fit stiffness; undetermined if most of the depth may be motion of the object."""
        fraction = min(indentation.object_motion_fraction, _OBJECT_MOTION_FRACTION_LIMIT)
        force, std = (window[name][indentation.rows] for name in ("force_n", "force_std_n"))
        skin = {name: indentation.contact_sides * each for name, each in self._skin_compliance.items()}
        found = estimate_stiffness(
            force,
            indentation.depth_m,
            std,
            object_motion_fraction=fraction,
            sheet_relative_std=0.0 if compensated else UNCOMPENSATED_SHEET_STD,
            **skin,
        )
        if found.samples and fraction > _MAX_OBJECT_MOTION_FRACTION:
            reason = "other contacts move the object: the indentation of this one isn't known"
            return replace(found, state="undetermined", reason=reason)
        return found

    def open_questions(self, now_ns: int) -> Sequence[Question]:  # noqa: ARG002
        """Return a question for each contact of undetermined stiffness."""
        return [
            _stiffness_question(hand, pad, contact, found)
            for pad, (contact, hand, found, indentation) in self._best.items()
            if found.state == "undetermined"
            and self.requested[pad]
            and indentation.source  # a squeeze is useless without depth
        ]


def _quality(found: StiffnessEstimate) -> float:
    if found.state != "estimated":
        return -math.inf if not found.samples else -1e9
    return -found.std_n_per_m / found.stiffness_n_per_m


def _percept(
    found: StiffnessEstimate, hand: int, pad: int, contact: int, now_ns: int, compensated: bool, by: str
) -> PerceptEstimate:
    determined = found.state == "estimated"
    label = max(found.probabilities, key=found.probabilities.__getitem__) if determined else ""
    values: dict[str, float | str | Sequence[float] | None] = {}
    if found.samples:
        values = {
            "stiffness_n_per_m": found.stiffness_n_per_m if determined else None,
            "stiffness_n_per_m_std": found.std_n_per_m if determined else None,
            "low_n_per_m": found.low_n_per_m,
            "high_n_per_m": found.high_n_per_m,
            "at_force_n": found.at_force_n,
            "exponent": found.exponent,
            "unloading_n_per_m": found.unloading_n_per_m if math.isfinite(found.unloading_n_per_m) else None,
            "branch": found.branch,
            "sheet_compensated": compensated,
            "indentation_source": by,
        }
    return PerceptEstimate(
        "stiffness",
        hand,
        pad,
        contact,
        now_ns,
        found.state,
        label,
        found.probabilities,
        values,
        {"samples": found.samples},
        found.reason,
    )


def _stiffness_question(hand: int, pad: int, contact: int, found: StiffnessEstimate) -> Question:
    """Return the question of the stiffness class; the outcome of a squeeze is ln stiffness.

    Within a class the stiffness may be anywhere, about 0.6 either way.
    """
    hypotheses = found.probabilities or {name: 1 / len(STIFFNESS_CLASSES) for name in STIFFNESS_CLASSES}
    low, high = PRIOR_RANGE_N_PER_M[0] * 10, PRIOR_RANGE_N_PER_M[1] / 100
    edges = (low, *CLASS_BOUNDS_N_PER_M, high)
    outcomes = {
        name: (0.5 * math.log(edges[k] * edges[k + 1]), 0.3 * math.log(edges[k + 1] / edges[k]) + 0.1)
        for k, name in enumerate(STIFFNESS_CLASSES)
    }
    squeeze = CandidateAction(
        "squeeze", {"force_n": _REQUESTED_FORCE_N}, outcomes, outcome_name="ln of stiffness in N/m"
    )
    return Question("stiffness_class", hand, pad, contact, hypotheses, [squeeze])
