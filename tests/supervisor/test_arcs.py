"""Diagnosis and calibration of a pad with six electrodes on arcs, beside one with four sides."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.config import parse
from handtouch.field.model import FractionModel
from handtouch.supervisor.diagnose.hand_diagnostics import HandDiagnostics
from handtouch.supervisor.diagnose.model import DiagnosisModel, HandSamples
from handtouch.wire.faults import FaultKind
from tests.deployments import SIX_ARCS, THREE_ARCS, arcs_text
from tests.exact_pads import electrodes_of

Counts = NDArray[np.float64]
SIDES, DISC = 0, 1


@lru_cache
def model(channels: int = 6) -> DiagnosisModel:
    return DiagnosisModel.from_deployment(parse(arcs_text(SIX_ARCS if channels == 6 else THREE_ARCS)), "h")


def diagnose(
    pad: int,
    change: Callable[[Counts], Counts] = lambda counts: counts,
    length_s: float = 40.0,
    network: FractionModel | None = None,
    channels: int = 6,
) -> tuple[HandDiagnostics, list[tuple[int, FaultKind, tuple[str, ...]]]]:
    """Press a pad once a second, its counts changed, in blocks of half a second; return the diagnoses."""
    known, rng = model(channels), np.random.default_rng(1)
    diagnostics, shape = HandDiagnostics(known), known.ampere_per_count.shape
    used, network = known.ampere_per_count > 0, network or known.networks[pad]
    own = slice(known.channel_counts[pad])
    for first in np.arange(0, length_s, 0.5):
        counts = rng.normal(size=(50, *shape))
        if first % 1 == 0:
            x, y = rng.uniform(0.1, 0.9, 2)
            shares = network.fractions(x * network.a, y * network.b)
            counts[:, pad, own] += shares * np.exp(rng.uniform(7, 9))
        counts[:, pad, own] = change(counts[:, pad, own])
        stamps = np.rint((first + 1 + np.arange(50) / 100) * 1e9).astype(np.int64)
        read = np.clip(np.rint(counts), -32768, 32767).astype(np.int64) * used
        diagnostics.process_block(
            HandSamples(np.repeat(stamps[:, None], 2, axis=1), read, np.ones((50, 2), np.bool_))
        )
    return diagnostics, [(row, f.kind, f.electrodes) for row, f in diagnostics.diagnoses_by_pad()]


def test_ordinary_presses_of_either_pad_give_no_diagnosis() -> None:
    assert diagnose(SIDES)[1] == diagnose(DISC)[1] == []


def test_a_dead_electrode_among_six_is_named_and_left_out() -> None:
    floating = electrodes_of(model())[DISC].with_series_ohm([np.inf if k == 3 else 0.0 for k in range(6)])
    diagnostics, found = diagnose(DISC, network=floating)
    assert found == [(DISC, FaultKind.DEAD_ELECTRODE, ("d",))]
    assert diagnostics.dead_electrodes() == {DISC: 3}
    (diagnosis,) = diagnostics.diagnoses()
    assert diagnosis.published.position_valid
    assert diagnosis.published.force_valid


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda counts: counts[:, [0, 4, 2, 3, 1, 5]], (FaultKind.SWAPPED_CABLES, ("b", "e"))),
        (lambda counts: counts * [1, 1, 1, 1, 1, 1.6], (FaultKind.GAIN_STEP, ("f",))),
        (lambda counts: counts + 80 * np.eye(6)[2], (FaultKind.OFFSET, ("c",))),
        (lambda counts: np.where(np.arange(6) == 5, 7, counts), (FaultKind.STUCK_CHANNEL, ("f",))),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_other_faults_of_six_electrodes_are_named(
    change: Callable[[Counts], Counts], expected: tuple[FaultKind, tuple[str, ...]]
) -> None:
    diagnostics, found = diagnose(DISC, change)
    assert found == [(DISC, *expected)]
    assert diagnostics.dead_electrodes() == {}


def test_contacts_of_three_electrodes_contradict_nothing_but_channels_are_diagnosed() -> None:
    assert diagnose(DISC, lambda counts: counts[:, [1, 0, 2]], channels=3)[1] == []
    stuck = diagnose(DISC, lambda counts: np.where(np.arange(3) == 1, 7, counts), channels=3)[1]
    assert stuck == [(DISC, FaultKind.STUCK_CHANNEL, ("left",))]
