"""The demo's SYNC rate where the core is uncompiled."""

from __future__ import annotations

import pytest

from handtouch.cli.demo import solving_time_s, sustained_period_ms
from handtouch.config import parse
from handtouch.daemon.table_cache import build_pad_model
from tests.deployments import SIX_ARCS, arcs_text


@pytest.mark.parametrize(
    ("solving_s", "period_ms"),
    [(0.0, 5.0), (0.00125, 5.0), (0.00126, 10.0), (0.006, 40.0), (10.0, 640.0)],
)
def test_period_is_doubled_until_a_quarter_of_it_suffices_within_the_range_of_deployments(
    solving_s: float, period_ms: float
) -> None:
    assert sustained_period_ms(5.0, solving_s) == period_ms


def test_contacts_on_pads_with_different_numbers_of_electrodes_are_timed() -> None:
    assert solving_time_s(build_pad_model(parse(arcs_text(SIX_ARCS)))) > 0
