"""Contact laws: eq. 11 at every scale, currents and forces that invert each other, valid uncertainties."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch.field.contact_law import (
    ContactLaw,
    ForceEstimate,
    ForceEstimateStatus,
    contact_stack_resistance,
)
from handtouch.field.network import ElectrodeNetwork

FloatArray = npt.NDArray[np.float64]

REFERENCE: list[dict[str, Any]] = json.loads((Path(__file__).parent / "data" / "contact.json").read_text())
SHEET, DRIVE, SPREADING, SERIES = 2400.0, 12.0, 0.017, 50.0  # S1 near its middle

scales = st.floats(-6, 6).map(lambda e: 10.0**e)
laws = st.builds(
    ContactLaw,
    st.floats(1e-3, 1.0),
    st.floats(0.5, 3.0),
    st.floats(5e-4, 5e-3),
    hertz_n=st.one_of(st.none(), st.floats(0.1, 10.0)),
)


def estimate_force(law: ContactLaw, current: npt.ArrayLike, **doubts: npt.ArrayLike) -> ForceEstimate:
    return law.force(current, DRIVE, SHEET, SPREADING, SERIES, **doubts)


def conduct(law: ContactLaw, force: npt.ArrayLike) -> FloatArray:
    return law.current(force, DRIVE, SHEET, SPREADING, SERIES)


class TestStack:
    def test_reference_values_to_1e_12(self) -> None:
        """Twenty-five digits, rho A^2 / (w sigma) from 1e-14 to 1e16."""
        columns = {key: np.array([float(case[key]) for case in REFERENCE]) for key in REFERENCE[0]}
        expected = columns.pop("resistance_ohm")
        assert np.abs(contact_stack_resistance(**columns) / expected - 1).max() < 1e-14

    def test_the_erratum_of_eq_13(self) -> None:
        """For small rho A^2 / (w sigma) the constant beside 2 ln(B/A) is 1/2, not 1."""
        exact = float(contact_stack_resistance(2400.0, 1e5, 0.5, 6.0))
        spread, layer = 2 * math.log(12.0), 1e5 / (math.pi * 0.25)
        assert exact == pytest.approx(128368.588, abs=1e-3)
        assert layer + 2400 / (4 * math.pi) * (spread + 0.5) == pytest.approx(exact, rel=1e-6)
        assert layer + 2400 / (4 * math.pi) * (spread + 1.0) == pytest.approx(128464, abs=1)

    def test_series_of_the_paper(self) -> None:
        """Eq. 11 summed as it is written, where it can be."""
        x2 = np.array([1e-3, 0.3, 5.0, 60.0])
        m = np.arange(1, 60)[:, None]
        terms = (x2 / 4) ** (m - 1) / (
            np.array([math.factorial(int(k)) * float(math.factorial(int(k) - 1)) for k in m.ravel()])[:, None]
        )
        below = 1 / (np.pi * x2) + (terms * (2 * math.log(7.0) + 1 / m)).sum(axis=0) / (4 * np.pi)
        series = below / terms.sum(axis=0)
        assert contact_stack_resistance(1.0, 1 / x2, 1.0, 7.0) == pytest.approx(series, rel=1e-13)

    @given(sheet=scales, layer=scales, radius=scales, ratio=st.floats(1.0, 1e6), more=st.floats(1.001, 10.0))
    def test_resistance_grows_with_sheet_layer_and_distance(
        self, sheet: float, layer: float, radius: float, ratio: float, more: float
    ) -> None:
        here = contact_stack_resistance(sheet, layer, radius, radius * ratio) * (1 - 1e-14)
        assert contact_stack_resistance(sheet * more, layer, radius, radius * ratio) >= here
        assert contact_stack_resistance(sheet, layer * more, radius, radius * ratio) >= here
        assert contact_stack_resistance(sheet, layer, radius, radius * ratio * more) >= here
        assert here >= contact_stack_resistance(sheet, 0.0, radius, radius * ratio)

    def test_limits(self) -> None:
        bare = SHEET / (2 * math.pi) * math.log(5.0)
        assert contact_stack_resistance(SHEET, 0.0, 1.0, 5.0) == pytest.approx(bare)
        assert contact_stack_resistance(SHEET, math.inf, 1.0, 5.0) == math.inf
        assert contact_stack_resistance(SHEET, 1e9, 1.0, 1.0) == pytest.approx(1e9 / math.pi, rel=1e-6)
        assert np.isnan(contact_stack_resistance(SHEET, 1.0, 1.0, 0.5))

    def test_shape_and_nan(self) -> None:
        found = contact_stack_resistance([SHEET, math.nan, SHEET], 1e-2, [[1e-3], [2e-3]], 1e-2)
        assert found.shape == (2, 3)
        assert np.isnan(found[:, 1]).all()
        assert np.isfinite(found[:, [0, 2]]).all()
        assert contact_stack_resistance([], 1e-2, 1e-3, 1e-2).shape == (0,)


class TestLaw:
    @given(law=laws, force=st.floats(1e-3, 30.0))
    def test_force_inverts_current(self, law: ContactLaw, force: float) -> None:
        found = estimate_force(law, conduct(law, force))
        if found.status == ForceEstimateStatus.VALID:
            assert found.force_n == pytest.approx(force, rel=1e-7)
            assert found.radius_m == pytest.approx(law.radius(force), rel=1e-7)
        else:
            assert found.status == ForceEstimateStatus.LOWER_BOUND
            assert found.force_n <= force * (1 + 1e-7)

    @given(law=laws, force=st.floats(1e-3, 30.0), more=st.floats(1.01, 3.0))
    def test_more_force_is_more_current(self, law: ContactLaw, force: float, more: float) -> None:
        assert conduct(law, force * more) > conduct(law, force)

    def test_at_low_force_the_current_grows_as_force_to_the_alpha(self) -> None:
        law = ContactLaw(2e-2, 1.5, 3e-3)
        low, high = conduct(law, [1e-4, 2e-4])
        assert math.log2(high / low) == pytest.approx(1.5, abs=1e-3)

    def test_area_makes_no_difference_at_alpha_1(self) -> None:
        """While the layer dominates: I = V F / k."""
        small, large = (ContactLaw(2e-2, 1.0, radius) for radius in (1e-3, 4e-3))
        assert conduct(small, 1e-4) == pytest.approx(conduct(large, 1e-4), rel=1e-3)
        assert conduct(small, 1e-4) == pytest.approx(DRIVE * 1e-4 / (2e-2 * 1e5), rel=2e-3)

    def test_hertz_contact_has_its_radius_at_its_force(self) -> None:
        law = ContactLaw(2e-2, 1.5, 3e-3, hertz_n=2.0)
        assert law.radius([2.0, 16.0]) == pytest.approx([3e-3, 6e-3])
        assert law.resistivity(2.0) == pytest.approx(2e-2 * (1e5 * math.pi * 9e-6 / 2.0) ** 1.5)

    def test_no_force_no_current(self) -> None:
        for hertz in (None, 1.0):
            law = ContactLaw(2e-2, 1.5, 3e-3, hertz_n=hertz)
            assert conduct(law, 0.0) == 0
            assert np.isnan(conduct(law, -1.0))

    def test_series_resistors_are_compensated(self) -> None:
        """Forward by Kirchhoff: the potential under the contact is lifted by sum phi_i R_i I_i."""
        pad = ElectrodeNetwork(0.062, 0.035, 0.002, SHEET, (0.0, 0.0, 336.0, 336.0))
        law = ContactLaw(2e-2, 1.5, 2e-3)
        x, y = 0.02, 0.012
        grounded = law.current(0.5, DRIVE, SHEET, pad.spreading_radius(x, y))
        lifted = law.current(0.5, DRIVE, SHEET, pad.spreading_radius(x, y), pad.series_resistance(x, y))
        assert lifted < grounded
        stack = DRIVE / grounded
        lift = pad.ideal_fractions(x, y) @ (np.array(pad.series_ohm) * pad.currents(x, y) * lifted)
        assert (DRIVE - lift) / lifted == pytest.approx(stack)
        found = law.force(lifted, DRIVE, SHEET, pad.spreading_radius(x, y), pad.series_resistance(x, y))
        assert found.force_n == pytest.approx(0.5)

    @pytest.mark.parametrize("hertz", [None, 1.0])
    def test_many_contacts_equal_single_ones(self, hertz: float | None) -> None:
        ohm, radius, std = [1e-2, 2e-2, 3e-2], [2e-3, 3e-3, 1e-3], [0.0, 1e-4, 2e-4]
        law = ContactLaw(ohm, 1.5, radius, std, hertz_n=hertz)
        current = np.array([1e-3, 2e-3, 5e-4])
        together = estimate_force(law, current, current_std_a=1e-5)
        for i in range(3):
            single = ContactLaw([ohm[i]], 1.5, [radius[i]], [std[i]], hertz_n=hertz)
            alone = estimate_force(single, current[[i]], current_std_a=1e-5)
            assert alone.force_n[0] == together.force_n[i]
            assert alone.std_n[0] == together.std_n[i]

    @pytest.mark.parametrize(
        ("make", "name"),
        [
            (lambda: ContactLaw(0.0, 1.5, 1e-3), "contact_ohm_m2"),
            (lambda: ContactLaw(1.0, -1.0, 1e-3), "alpha"),
            (lambda: ContactLaw(1.0, 1.0, [1e-3, math.nan]), "radius_m"),
            (lambda: ContactLaw(1.0, 1.0, 1e-3, -1.0), "radius_std_m"),
            (lambda: ContactLaw(1.0, 1.0, 1e-3, reference_pa=0), "reference_pa"),
            (lambda: ContactLaw(1.0, 1.0, 1e-3, hertz_n=0.0), "hertz_n"),
            (lambda: ContactLaw(1.0, [1.0, 2.0], 1e-3, hertz_n=1.0), "alpha"),
        ],
    )
    def test_invalid_parameters_are_rejected_by_name(self, make: Callable[[], ContactLaw], name: str) -> None:
        with pytest.raises(ValueError, match=name):
            make()


class TestDoubt:
    """Standard deviations hold what a simulation scatters."""

    @pytest.mark.parametrize("hertz", [None, 1.0])
    @pytest.mark.parametrize("force", [0.05, 0.5, 2.0])
    def test_noise_of_the_current(self, hertz: float | None, force: float) -> None:
        law = ContactLaw(2e-2, 1.5, 3e-3, hertz_n=hertz)
        current, noise = conduct(law, force), 0.01 * conduct(law, force)
        drawn = current + noise * np.random.default_rng(3).standard_normal(20_000)
        scatter = np.std(estimate_force(law, drawn).force_n)
        assert estimate_force(law, current, current_std_a=noise).std_n == pytest.approx(scatter, rel=0.05)

    @pytest.mark.parametrize("hertz", [None, 1.0])
    @pytest.mark.parametrize("alpha", [0.8, 1.0, 2.0])
    def test_unknown_radius(self, hertz: float | None, alpha: float) -> None:
        law = ContactLaw(2e-2, alpha, 3e-3, 3e-5, hertz_n=hertz)
        radii = 3e-3 + 3e-5 * np.random.default_rng(4).standard_normal(20_000)
        current = conduct(law, 0.3)
        scatter = np.std(estimate_force(ContactLaw(2e-2, alpha, radii, hertz_n=hertz), current).force_n)
        assert estimate_force(law, current).std_n == pytest.approx(scatter, rel=0.03)

    def test_unknown_position(self) -> None:
        law = ContactLaw(2e-2, 1.5, 2e-3)
        spreading = SPREADING * np.exp(0.05 * np.random.default_rng(5).standard_normal(20_000))
        current = conduct(law, 2.0)
        scatter = np.std(law.force(current, DRIVE, SHEET, spreading, SERIES).force_n)
        assert estimate_force(law, current, spreading_std=0.05).std_n == pytest.approx(scatter, rel=0.03)

    def test_current_beyond_the_sheets_limit_gives_a_lower_bound(self) -> None:
        law = ContactLaw(2e-2, 1.5, 3e-3)
        limit = DRIVE / (SERIES + SHEET / (2 * math.pi) * math.log(SPREADING / 3e-3))
        found = estimate_force(law, limit * np.array([0.9, 0.985, 1.0, 1.5, 100.0]))
        assert list(found.status) == [ForceEstimateStatus.VALID] + [ForceEstimateStatus.LOWER_BOUND] * 4
        bound = estimate_force(law, 0.98 * limit * (1 - 1e-9)).force_n
        assert found.force_n[1:] == pytest.approx(np.full(4, float(bound)), rel=1e-4)
        assert np.isinf(found.std_n[1:]).all()

    def test_noise_extends_saturation_and_lowers_the_bound(self) -> None:
        law = ContactLaw(2e-2, 1.5, 3e-3)
        current = conduct(law, 10.0)
        assert estimate_force(law, current).status == ForceEstimateStatus.VALID
        noisy = estimate_force(law, current, current_std_a=0.1 * current)
        assert noisy.status == ForceEstimateStatus.LOWER_BOUND
        assert noisy.force_n < 10.0

    def test_lower_bound_holds(self) -> None:
        """No more than the 2.3 % of readings beyond two standard deviations overstate the force."""
        law = ContactLaw(2e-2, 1.5, 3e-3)
        current = conduct(law, 20.0)
        drawn = current * (1 + 0.05 * np.random.default_rng(6).standard_normal(20_000))
        found = estimate_force(law, drawn, current_std_a=0.05 * current)
        saturated = found.status == ForceEstimateStatus.LOWER_BOUND
        assert saturated.mean() > 0.4
        assert (saturated & (found.force_n > 20.0)).mean() < 0.025

    def test_hertz_contact_reaching_the_edge_gives_a_lower_bound(self) -> None:
        law = ContactLaw(2e-2, 1.5, 3e-3, hertz_n=1.0)
        found = estimate_force(law, conduct(law, 100.0))
        assert found.status == ForceEstimateStatus.LOWER_BOUND
        assert found.radius_m <= SPREADING / 2 * (1 + 1e-9)

    def test_current_within_noise_is_below_threshold(self) -> None:
        law = ContactLaw(2e-2, 1.5, 3e-3)
        noise = conduct(law, 0.01)
        found = estimate_force(law, np.array([-1.0, 0.0, 0.5, 1.9, 2.1]) * noise, current_std_a=noise)
        assert list(found.status) == [ForceEstimateStatus.BELOW_THRESHOLD] * 4 + [ForceEstimateStatus.VALID]
        assert (found.force_n[:2] == 0).all()
        assert (found.std_n > 0).all()
        assert (
            estimate_force(law, conduct(law, 0.015), threshold_n=0.02).status
            == ForceEstimateStatus.BELOW_THRESHOLD
        )
        assert estimate_force(law, conduct(law, 0.025), threshold_n=0.02).status == ForceEstimateStatus.VALID
        assert estimate_force(law, 0.0).force_n == 0

    def test_contact_near_an_edge_is_treated_as_at_its_own_radius(self) -> None:
        law = ContactLaw(2e-2, 1.5, 3e-3)
        near, at = (law.force(1e-3, DRIVE, SHEET, outer, SERIES) for outer in (1e-4, 6e-3))
        assert near.force_n == at.force_n
        assert law.current(0.5, DRIVE, SHEET, 1e-4) == law.current(0.5, DRIVE, SHEET, 6e-3)

    @pytest.mark.parametrize("bad", [math.nan, math.inf])
    def test_impossible_contact_is_invalid_in_its_own_element(self, bad: float) -> None:
        law = ContactLaw(2e-2, 1.5, 3e-3)
        found = estimate_force(law, np.array([1e-3, bad, 2e-3]), current_std_a=1e-6)
        alone = estimate_force(law, np.array([1e-3, 2e-3]), current_std_a=1e-6)
        assert (found.force_n[[0, 2]] == alone.force_n).all()
        assert found.status[1] in (ForceEstimateStatus.INVALID, ForceEstimateStatus.LOWER_BOUND)
        assert (found.status[1] == ForceEstimateStatus.INVALID) == math.isnan(bad)
        assert law.force(1e-3, DRIVE, SHEET, math.nan).status == ForceEstimateStatus.INVALID
