"""Stiffness: modulus over radius from force and contact radius, or why there is none."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch.field import ContactLaw
from handtouch.percept.pipeline import PerceptPipeline
from handtouch.percept.samples import ContactBuffer, ContactSamples, PerceptEstimate
from handtouch.percept.stiffness_estimator import ExpectedRadius
from handtouch.wire import PERCEPT_KINDS

LAW = ContactLaw(2e-2, 1.5, 3e-3, 1.5e-3)
EXPECTED = ExpectedRadius(LAW, 0.05)
KEPT = 0.6
"""Part of the table's variance that the currents remove"""
RISING = np.geomspace(0.2, 2.0, 30)


def pressed(
    forces_n: Sequence[float] | np.ndarray,
    radii_m: Sequence[float] | np.ndarray,
    expected: ExpectedRadius | None = EXPECTED,
) -> list[PerceptEstimate]:
    """Return the estimates of a contact whose radii are published as drawn towards the table's."""
    pipeline = PerceptPipeline.build(ContactBuffer(1), radii=[expected])
    requested = np.zeros((len(PERCEPT_KINDS), 1), np.bool_)
    requested[PERCEPT_KINDS.index("stiffness")] = True
    pipeline.set_requested(requested, np.zeros(1, np.bool_))
    variance = (1 - KEPT) * math.log1p(0.5**2)
    found: list[PerceptEstimate] = []
    for k, (force_n, radius_m) in enumerate(zip(forces_n, radii_m, strict=True)):
        published_m = 3e-3 * (radius_m / 3e-3) ** KEPT
        sample = ContactSamples(np.array([0]), np.array([10**9 + k * 5_000_000]), np.array([7], np.uint32))
        sample["force_n"], sample["force_std_n"] = np.array([force_n]), np.array([0.05 * force_n])
        sample["contact_radius_m"] = np.array([published_m])
        sample["contact_radius_std_m"] = np.array([published_m * math.sqrt(math.expm1(variance))])
        found += pipeline.process_tick(sample, np.zeros(0, np.intp), 10**9 + k * 5_000_000)[0]
    return found


@given(modulus_per_radius=st.floats(1e7, 1e9))
def test_a_round_tip_gives_its_modulus_over_radius_whatever_the_table_expects(
    modulus_per_radius: float,
) -> None:
    *_, last = pressed(RISING, np.cbrt(0.75 * RISING / modulus_per_radius))
    assert last.state == "estimated"
    assert last.values["modulus_per_radius_pa_per_m"] == pytest.approx(modulus_per_radius, rel=1e-6)
    assert last.values["growth_exponent"] == pytest.approx(1 / 3, rel=1e-6)
    # errors of force and radius, of which the cube counts, add up
    alone = math.sqrt((1 - KEPT) / KEPT * math.log1p(0.5**2))
    assert last.values["modulus_per_radius_log_std"] == pytest.approx(0.05 + 3 * alone, rel=1e-6)


def test_a_flat_object_has_no_modulus_over_radius() -> None:
    *_, last = pressed(RISING, np.full(30, 2e-3))
    assert (last.state, dict(last.values)) == ("invalid", {})
    assert "grow" in last.reason


@pytest.mark.parametrize("radii_m", [np.full(30, 2e-3), np.cbrt(RISING) * 2e-3], ids=["flat", "round"])
def test_sheets_whose_laws_are_hardly_known_tell_no_round_object_from_a_flat_one(radii_m: np.ndarray) -> None:
    *_, last = pressed(RISING, radii_m, ExpectedRadius(LAW, 0.2))
    assert last.state == "undetermined"
    assert "calibrate" in last.reason


@pytest.mark.parametrize(
    ("forces_n", "radii_m", "expected", "reason"),
    [
        (np.linspace(1.0, 2.0, 30), np.full(30, 2e-3), EXPECTED, "2-fold"),
        (RISING, np.full(30, np.nan), EXPECTED, "contact_radius_status"),
        (RISING, np.full(30, 2e-3), None, "second_sheet"),
    ],
    ids=["steady force", "no radius", "one sheet"],
)
def test_what_is_missing_is_stated(
    forces_n: np.ndarray, radii_m: np.ndarray, expected: ExpectedRadius | None, reason: str
) -> None:
    *_, last = pressed(forces_n, radii_m, expected)
    assert last.state == "undetermined"
    assert reason in last.reason
