"""Friction: what sticking and slips teach about the limit, and alarms before it is reached."""

from __future__ import annotations

import numpy as np
import pytest

from handtouch.percept.friction import FrictionLimit, FrictionMonitor

NOTHING = np.zeros((2, 2))


def pulled(monitor: FrictionMonitor, limit: float, rate_per_s: float, pad: int = 0) -> float | None:
    """Pull a contact of 2 N until it slips at a limit; return the lead of the first alarm [s]."""
    alarm_s = None
    slip_s = limit / rate_per_s
    for t_s in np.arange(0.0, slip_s, 0.005).tolist():
        force = 2.0 * rate_per_s * t_s
        state = monitor.update(pad, t_s, (0.6 * force, 0.8 * force), 1e-4 * np.eye(2), 2.0, 0.1)
        if state.label == "incipient" and alarm_s is None:
            alarm_s = t_s
    monitor.confirm_slip(pad)
    monitor.end_contact(pad)
    return None if alarm_s is None else slip_s - alarm_s


def test_sticking_raises_the_bound_and_a_slip_states_the_limit() -> None:
    limit = FrictionLimit()
    assert limit.probability_below(0.8) == pytest.approx(0.5, abs=1e-6)
    stuck = limit.after_sticking(0.7)
    assert stuck.probability_below(0.7) == 0
    assert 0 < stuck.probability_below(0.8) < limit.probability_below(0.8)
    slipped = stuck.after_slip(0.6)
    assert slipped.mean == pytest.approx(0.61, abs=0.01)
    assert slipped.probability_below(0.7) > 0.85
    assert slipped.probability_below(0.5) < 0.05
    with pytest.raises(ValueError, match="ratio"):
        limit.after_slip(0.0)


@pytest.mark.parametrize("limit", [0.4, 0.6, 1.1])
def test_after_one_slip_the_next_is_announced_before_it_begins(limit: float) -> None:
    monitor = FrictionMonitor(2)
    pulled(monitor, limit, 2.0)
    lead_s = pulled(monitor, limit, 2.0, pad=1)
    assert lead_s is not None
    assert 0.005 < lead_s < 0.1


def test_a_steady_grip_far_below_the_limit_raises_no_alarm() -> None:
    monitor, rng = FrictionMonitor(1), np.random.default_rng(1)
    pulled(monitor, 0.8, 2.0)
    for k in range(2000):
        force = 1.0 + 0.02 * rng.standard_normal(2)
        state = monitor.update(0, 10 + 0.005 * k, force, NOTHING, 3.0, 0.1)
        assert state.label == "sticking"
    assert state.ratio == pytest.approx(0.47, abs=0.03)
    assert state.margin == pytest.approx(1 - 0.47 / 0.8, abs=0.06)


def test_the_ratio_has_the_error_of_both_forces() -> None:
    state = FrictionMonitor(1).update(0, 0.0, (1.0, 0.0), np.diag([0.04, 9.0]), 2.0, 0.2)
    assert state.ratio_std == pytest.approx(np.hypot(0.2 / 2, 0.5 * 0.1))


def test_without_normal_force_there_is_no_ratio() -> None:
    monitor = FrictionMonitor(1)
    assert monitor.update(0, 0.0, (1.0, 0.0), NOTHING, 0.1, 0.1).label == "unknown"
    assert monitor.update(0, 0.1, (np.nan, 0.0), NOTHING, 2.0, 0.1).label == "unknown"


def test_a_slipping_contact_teaches_no_bound() -> None:
    monitor = FrictionMonitor(1, FrictionLimit(0.5, 0.1))
    monitor.update(0, 0.0, (1.8, 0.0), NOTHING, 2.0, 0.1, slips=True)
    assert monitor.limit.stuck == 0
