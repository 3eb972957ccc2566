"""The demo's SYNC rate where the core is uncompiled."""

from __future__ import annotations

import pytest

from handtouch.cli.demo_rate import sustained_period_ms


@pytest.mark.parametrize(
    ("solving_s", "period_ms"),
    [(0.0, 5.0), (0.00125, 5.0), (0.00126, 10.0), (0.006, 40.0), (10.0, 640.0)],
)
def test_period_is_doubled_until_a_quarter_of_it_suffices_within_the_range_of_deployments(
    solving_s: float, period_ms: float
) -> None:
    assert sustained_period_ms(5.0, solving_s) == period_ms
