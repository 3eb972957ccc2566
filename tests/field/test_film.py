"""Networks on films of measured resistance, beside first order theory and each other."""

from __future__ import annotations

import io
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.field import ElectrodeNetwork
from handtouch.field.film import Film, UnevenNetwork
from handtouch.field.surface import PlaneSurface
from handtouch.field.uneven_sheet import UNEVEN_WAVES, UnevenSheet

FloatArray = NDArray[np.float64]
LENGTH, WIDTH, OHM = 0.03, 0.024, 2400.0
SURFACE = PlaneSurface(LENGTH, WIDTH)
EVEN = ElectrodeNetwork(LENGTH, WIDTH, 1e-3, OHM)
CONTACT_RADIUS = 1.8e-3
INSIDE = np.meshgrid(np.linspace(0.1, 0.9, 9) * LENGTH, np.linspace(0.1, 0.9, 9) * WIDTH)


def archive(**columns: object) -> bytes:
    written = io.BytesIO()
    np.savez(written, **columns)  # type: ignore[arg-type]
    return written.getvalue()


def film(log_ratio: Callable[[FloatArray, FloatArray], FloatArray], count: int = 13) -> Film:
    s, t = np.meshgrid(np.linspace(0, 1, count), np.linspace(0, 1, count))
    ohm = OHM * np.exp(log_ratio(s, t))
    return Film(archive(x_mm=1e3 * LENGTH * s, y_mm=1e3 * WIDTH * t, ohm_per_square=ohm))


def on_film(log_ratio: Callable[[FloatArray, FloatArray], FloatArray]) -> UnevenNetwork:
    return UnevenNetwork.on_film(EVEN, film(log_ratio), SURFACE, CONTACT_RADIUS)


@pytest.mark.parametrize("wave", range(3))
def test_weak_waves_change_shares_as_first_order_theory_says(wave: int) -> None:
    (p, q), amplitude = UNEVEN_WAVES[wave], 0.02
    uneven = on_film(lambda s, t: amplitude * np.cos(p * np.pi * s) * np.cos(q * np.pi * t))
    found = uneven.fractions(*INSIDE) - EVEN.fractions(*INSIDE)
    expected = UnevenSheet(EVEN, wave, amplitude).fractions(*INSIDE) - EVEN.fractions(*INSIDE)
    assert np.abs(found).max() > 9e-4
    np.testing.assert_allclose(found, expected, atol=4e-5)


def test_a_film_of_another_resistance_everywhere_changes_no_share() -> None:
    uneven = on_film(lambda s, _: np.full_like(s, np.log(1.3)))
    np.testing.assert_allclose(uneven.fractions(*INSIDE), EVEN.fractions(*INSIDE), atol=1e-9)
    np.testing.assert_allclose(uneven.conductance, EVEN.conductance / 1.3, rtol=2e-2)
    ratio = uneven.spreading_radius(*INSIDE) / EVEN.spreading_radius(*INSIDE)
    # 30 % more of ln(radius / contact), less 1/4 or so: a smeared source's own part
    log_radius = np.log(EVEN.spreading_radius(*INSIDE) / CONTACT_RADIUS)
    np.testing.assert_allclose(np.log(ratio)[4, 4] / log_radius[4, 4], 0.3, atol=0.04)


def test_a_film_mirrored_across_x_swaps_the_shares_of_x() -> None:
    def slope(s: FloatArray, t: FloatArray) -> FloatArray:
        return 0.3 * (s - 0.5) + 0.1 * t

    one, other = on_film(slope), on_film(lambda s, t: slope(1 - s, t))
    np.testing.assert_allclose(
        one.fractions(*INSIDE), other.fractions(LENGTH - INSIDE[0], INSIDE[1])[[1, 0, 2, 3]], atol=1e-7
    )


def test_derivatives_of_shares_are_those_of_differences() -> None:
    uneven, step = on_film(lambda s, t: 0.2 * np.cos(np.pi * s) + 0.1 * t), 1e-7
    _, jacobian = uneven.fractions_with_jacobian(*INSIDE)
    x, y = INSIDE
    slopes = [
        (uneven.fractions(x + step, y) - uneven.fractions(x - step, y)) / (2 * step),
        (uneven.fractions(x, y + step) - uneven.fractions(x, y - step)) / (2 * step),
    ]
    np.testing.assert_allclose(jacobian, np.stack(slopes, axis=1), atol=1e-5)
    assert np.isnan(uneven.fractions(-LENGTH, np.nan)).all()


def test_other_parts_change_a_film_as_they_change_an_even_sheet() -> None:
    uneven = on_film(lambda s, t: 0.2 * np.cos(np.pi * s) + 0.1 * t)

    def moved(pad: ElectrodeNetwork) -> ElectrodeNetwork:
        return pad.with_moved_end(3, 2e-4)

    def longer(pad: ElectrodeNetwork) -> ElectrodeNetwork:
        return pad.stretched(1.01)

    for change in (moved, longer):
        one, other, scale = change(uneven), change(EVEN), change(EVEN).a / EVEN.a
        at = INSIDE[0] * scale, INSIDE[1]
        np.testing.assert_allclose(
            one.fractions(*at) - uneven.fractions(*INSIDE),
            other.fractions(*at) - EVEN.fractions(*INSIDE),
            atol=1e-9,
        )
    resisted = uneven.with_series_ohm((200.0, 0.0, 0.0, 0.0))
    assert (resisted.fractions(*INSIDE)[0] < uneven.fractions(*INSIDE)[0]).all()


def test_what_is_no_film_is_refused_with_a_reason() -> None:
    four = np.arange(4.0)
    for data, reason in (
        (b"no archive", "no NumPy archive"),
        (archive(x_mm=four, y_mm=four), "lacks ohm_per_square"),
        (archive(x_mm=four, y_mm=four, ohm_per_square=four), "positive"),
        (archive(x_mm=four[:3], y_mm=four[:3], ohm_per_square=1 + four[:3]), "4 places"),
        (archive(x_mm=four, y_mm=four[:3], ohm_per_square=1 + four), "one value for each"),
        (archive(x_mm=four * np.nan, y_mm=four, ohm_per_square=1 + four), "finite"),
    ):
        with pytest.raises(ValueError, match=reason):
            Film(data)
