"""Friction: what sticking and slips teach about the limit, and alarms before it is reached."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from handtouch.percept.friction import PRIOR_LIMIT, FrictionLimit, FrictionMonitor
from handtouch.percept.pipeline import PerceptPipeline
from handtouch.percept.samples import ContactBuffer, ContactSamples, PerceptEstimate
from handtouch.wire import PERCEPT_KINDS

NORMAL = (2.0, 0.1)
STD_N = 0.02


def pulled(monitor: FrictionMonitor, limit: float, rate_per_s: float, pad: int = 0) -> float | None:
    """Pull a contact of 2 N until it slips at a limit; return the lead of the first alarm [s]."""
    alarm_s = None
    slip_s = limit / rate_per_s
    for t_s in np.arange(0.0, slip_s + 0.03, 0.005).tolist():
        ratio = min(rate_per_s * t_s, limit)
        state = monitor.update(pad, t_s, (2.0 * ratio, STD_N), NORMAL, slips=t_s > slip_s + 0.02)
        assert state is not None
        if state.label == "incipient" and alarm_s is None:
            alarm_s = t_s
    monitor.end_contact(pad)
    return None if alarm_s is None else slip_s - alarm_s


def test_sticking_raises_the_bound_and_a_slip_states_the_limit() -> None:
    limit = FrictionLimit()
    assert limit.probability_below(PRIOR_LIMIT) == pytest.approx(0.5, abs=1e-6)
    stuck = limit.after_sticking(0.7)
    assert stuck.probability_below(0.7) == 0
    assert 0 < stuck.probability_below(0.8) < limit.probability_below(0.8)
    slipped = limit.after_slip(0.5)
    assert 0.5 < slipped.mean < limit.mean
    assert slipped.probability_below(0.6) > limit.probability_below(0.6)
    with pytest.raises(ValueError, match="ratio"):
        limit.after_slip(0.0)


def test_a_motion_far_below_a_ratio_that_stuck_is_no_slip() -> None:
    stuck = FrictionLimit().after_sticking(0.7)
    assert stuck.after_slip(0.3) == stuck
    assert FrictionLimit().after_slip(0.2) == FrictionLimit()


def test_a_noisy_ratio_is_less_certain_to_be_below_the_limit() -> None:
    limit = FrictionLimit()
    assert limit.probability_below(0.4, 0.5) > 2 * limit.probability_below(0.4)


@pytest.mark.parametrize("limit", [0.35, 0.45, 0.6, 0.9, 1.3])
def test_after_slips_of_an_object_the_next_is_announced_before_it_begins(limit: float) -> None:
    monitor = FrictionMonitor()
    for _ in range(6):
        pulled(monitor, limit, 2.0)
    lead_s = pulled(monitor, limit, 2.0, pad=1)
    assert lead_s is not None
    assert 0 < lead_s < 0.25


def test_a_slippery_object_is_learned_from_its_slips() -> None:
    monitor = FrictionMonitor()
    pulled(monitor, 0.4, 2.0)
    first = monitor.limit.mean
    for _ in range(6):
        pulled(monitor, 0.4, 2.0)
    assert monitor.limit.mean < first < 0.8
    assert monitor.limit.mean == pytest.approx(0.4, rel=0.3)


def test_a_steady_grip_far_below_the_limit_raises_no_alarm() -> None:
    monitor, rng = FrictionMonitor(), np.random.default_rng(1)
    for k in range(2000):
        size_n = float(np.hypot(*(1.0 + 0.02 * rng.standard_normal(2))))
        state = monitor.update(0, 10 + 0.005 * k, (size_n, STD_N), (3.5, 0.1))
        assert state is not None
        assert state.label == "sticking"
    assert state is not None
    assert state.ratio == pytest.approx(0.4, abs=0.03)
    assert state.margin == pytest.approx(1 - 0.4 / PRIOR_LIMIT, abs=0.06)


def test_a_ratio_that_fluctuates_at_the_limit_raises_one_alarm() -> None:
    monitor, rng, raised, alarmed = FrictionMonitor(), np.random.default_rng(1), 0, False
    for k in range(100):
        ratio = 1.0 + 0.15 * rng.standard_normal()
        state = monitor.update(0, 0.005 * k, (2.0 * ratio, STD_N), NORMAL)
        assert state is not None
        raised += state.label == "incipient" and not alarmed
        alarmed = state.label == "incipient"
    assert raised == 1


@pytest.mark.parametrize(("tangential_std_n", "normal_std_n"), [(0.6, 0.1), (0.02, 0.6)])
def test_errors_of_either_force_make_an_alarm_less_probable(
    tangential_std_n: float, normal_std_n: float
) -> None:
    exact = FrictionMonitor().update(0, 0.0, (2.4, STD_N), NORMAL)
    rough = FrictionMonitor().update(0, 0.0, (2.4, tangential_std_n), (2.0, normal_std_n))
    assert exact is not None
    assert rough is not None
    assert 0.5 < rough.probability < exact.probability


def test_the_ratio_has_the_error_of_both_forces() -> None:
    state = FrictionMonitor().update(0, 0.0, (1.0, 0.2), (2.0, 0.2))
    assert state is not None
    assert state.ratio_std == pytest.approx(np.hypot(0.2 / 2, 0.5 * 0.1))


def test_without_normal_force_there_is_no_ratio() -> None:
    monitor = FrictionMonitor()
    assert monitor.update(0, 0.0, (1.0, 0.1), (0.1, 0.1)) is None
    assert monitor.update(0, 0.1, (math.nan, 0.1), NORMAL) is None


class Contacts:
    """Pads of one hand of which the first two are above shear pads, with all percepts requested."""

    def __init__(self) -> None:
        shear_pads = np.array([True, True, False])
        self.pipeline = PerceptPipeline.build(ContactBuffer(3), shear_pads=shear_pads)
        requested = np.zeros((len(PERCEPT_KINDS), 3), np.bool_)
        requested[PERCEPT_KINDS.index("friction")] = True
        self.pipeline.set_requested(requested, np.zeros(3, np.bool_))

    def sample(self, t_s: float, vectors_n: Sequence[Sequence[float]]) -> list[PerceptEstimate]:
        """Return the percepts of a sample of contacts on tilted pads."""
        t_ns = round(t_s * 1e9)
        count = len(vectors_n)
        sample = ContactSamples(
            np.arange(count), np.full(count, t_ns), np.arange(1, count + 1, dtype=np.uint32)
        )
        sample["normal"] = np.tile([0.6, 0.0, 0.8], (count, 1))
        sample["force_vector_n"] = np.array(vectors_n)
        sample["force_vector_covariance_n2"] = np.tile(np.diag([0.04, 0.01, 0.04]), (count, 1, 1))
        sample["force_n"], sample["force_std_n"] = np.full(count, 2.0), np.full(count, 0.1)
        found, _ = self.pipeline.process_tick(sample, np.zeros(0, np.intp), t_ns)
        return found


def test_the_percept_has_the_ratio_of_the_force_along_the_surface_above_shear_pads_only() -> None:
    along = [-1.2, 0.7, -1.6]  # 2 N against the normal, 0.7 N across
    first, second = Contacts().sample(1.0, [along, [np.nan] * 3, along])
    assert (first.kind, first.state, first.label) == ("friction", "estimated", "sticking")
    assert first.values["ratio"] == pytest.approx(0.35)
    assert first.values["tangential_force_n_std"] == pytest.approx(0.1)
    assert first.values["ratio_std"] == pytest.approx(np.hypot(0.1 / 2, 0.35 * 0.05))
    assert (second.state, second.label) == ("undetermined", "")
    assert "force vector" in second.reason


def test_pads_of_a_hand_share_the_limit_until_it_lets_go() -> None:
    contacts = Contacts()
    for k in range(100):
        contacts.sample(1.0 + 0.005 * k, [[-1.2, 0.8, -1.6]])  # pulled with 0.4 of the normal force
    _, other = contacts.sample(1.5, [[-1.2, 0.8, -1.6], [-1.2, 0.2, -1.6]])
    assert other.values["stuck_ratio"] == pytest.approx(0.4)
    _, later = contacts.sample(9.0, [[-1.2, 0.2, -1.6]] * 2)
    assert later.values["stuck_ratio"] == 0.0
