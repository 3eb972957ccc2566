"""Laws that every tick keeps, whatever pads, counts, clocks, rates and events: 100,000 ticks of pads."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from tests.core.pipeline_fuzz import LAWS, SHAPES, Fuzz, Law

TICKS = 100_000
QUICK_SHAPES = tuple(name for name in SHAPES if name not in ("3 x 2 mm", "cone", "sphere"))
"""Without those whose tables no other test needs."""
HUGE = (
    "node.full_scale_ma = 1000, node.noise_counts = 300, sheet.contact_ohm_mm2 = 1e8, sheet.alpha = 0.2, "
    "sheet.reference_kpa = 1e4, sheet.contact_radius_mm = 50, sheet.contact_radius_std_mm = 10, "
    "sheet.max_force_n = 1000, sheet.ohm_per_square_std = 1, sheet.contact_ohm_std = 1"
)
TINY = (
    "node.drive_v = 0.1, node.full_scale_ma = 0.001, node.noise_counts = 300, sheet.ohm_per_square = 1, "
    "sheet.contact_ohm_mm2 = 1, sheet.alpha = 5, sheet.reference_kpa = 1e4, sheet.contact_radius_mm = 50, "
    "sheet.contact_radius_std_mm = 10, sheet.hertz_force_n = 0.01, sheet.max_force_n = 1000"
)
SHARP = (
    "node.drive_v = 100, node.full_scale_ma = 1000, node.noise_counts = 0.001, sheet.contact_ohm_mm2 = 1e8, "
    "sheet.alpha = 5, sheet.reference_kpa = 0.1, sheet.contact_radius_mm = 50, sheet.hertz_force_n = 0.01"
)
FOUND: tuple[tuple[str, str, Sequence[int]], ...] = (
    ("1 m x 1 m", "usual", (30, -1, -1, 32766)),
    ("30 x 24 mm", TINY, (543, 985, 1, 9568)),
    ("30 x 24 mm, 1 Mohm at one side", SHARP, (8, 30, 32766, 5)),
    ("30 x 24 mm, 1 Mohm at one side", SHARP, (29, 29, 29, 32765)),
    ("six arcs", "usual", (30000, -2, -1, 32766, 30, 30000)),
    ("cylinder", f"node.drive_v = 0.1, sheet.ohm_per_square = 1e6, {HUGE}", (32766, -2, 1, 1)),
    (
        "24 x 24 mm without gaps",
        f"node.drive_v = 0.1, sheet.ohm_per_square = 1, {HUGE}",
        (30000, 1000, 30, 32767),
    ),
)
"""Pads and counts that broke laws once: variances of zero beyond what the search resolves, forces beyond the
greatest one, valid ones at the top of a range, and numbers beyond single precision."""


@pytest.fixture(scope="module")
def laws() -> dict[str, Law]:
    return {law.name: law for law in Fuzz(seed=1, kinds=5, shapes=QUICK_SHAPES).run(TICKS)}


@pytest.mark.parametrize("name", LAWS)
def test_every_tick_keeps_the_law(laws: dict[str, Law], name: str) -> None:
    law = laws[name]
    assert law.checked > 500
    assert not law.broken, f"{law.broken} of {law.checked}: {law.first}"


def test_every_tick_keeps_the_laws_with_inputs_that_broke_them() -> None:
    pads, counts = [(shape, keys) for shape, keys, _ in FOUND], [row for _, _, row in FOUND]
    for law in Fuzz(seed=0, pads=pads).hold(counts):
        assert not law.broken, f"{law.name}: {law.first}"
