"""Questions about contacts that may have begun to slip: holding still separates slip from tremor.

Public name: `slip_questions`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from handtouch.percept.action_request import CandidateAction, Question
from handtouch.percept.relative_motion import slip_probability
from handtouch.percept.samples import ContactBuffer

_MIN_LOG_ODDS = math.log(0.25)  # ln of the odds of slip above which a question is posed
_HOLD_S = 0.5


def slip_questions(buffer: ContactBuffer, requested: NDArray[np.bool_]) -> list[Question]:
    """Return a question for each contact on the requested pads (n,) that may slip and isn't known to."""
    pads = np.flatnonzero(requested & (buffer.contact_id > 0))
    log_odds = buffer.latest_field(pads, "slip_log_odds")
    uncertain = (log_odds > _MIN_LOG_ODDS) & np.isfinite(log_odds)
    return [
        _slip_question(buffer, pad, slip_probability(odds))
        for pad, odds in zip(pads[uncertain].tolist(), log_odds[uncertain].tolist(), strict=True)
    ]


def _slip_question(buffer: ContactBuffer, pad: int, slips: float) -> Question:
    tremor_m, velocity = (
        buffer.latest_field(np.array([pad]), name)[0] for name in ("tremor_std_m", "slip_velocity_m_per_s")
    )
    tremor, ramp = float(np.hypot(*tremor_m)), _HOLD_S * float(np.hypot(*velocity))
    hold = CandidateAction(
        "hold",
        {"duration_s": _HOLD_S},
        {"sticks": (0.0, tremor), "slides": (ramp, math.hypot(tremor, ramp / 2))},
        outcome_name="further displacement of the centroid in m",
    )
    hand, contact = int(buffer.hand_index[pad]), int(buffer.contact_id[pad])
    return Question("slip", hand, pad, contact, {"sticks": 1 - slips, "slides": slips}, [hold])
