"""An untouched pad is healthy, and a channel at its converter's end saturated, with channels of any type."""

from __future__ import annotations

from collections.abc import Hashable

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.config import Deployment, parse
from handtouch.config.channels import node_channels
from handtouch.supervisor.diagnose import DiagnosisModel, HandDiagnostics, HandSamples, PadDiagnosis
from handtouch.supervisor.diagnose.hypotheses import HypothesisTables
from handtouch.wire.faults import FaultKind
from tests.deployments import deployment_text, pad_text

_TABLES: dict[Hashable, HypothesisTables] = {}
"""Of the one pad of all deployments"""
INTEGERS = [f"{sign}{bits}" for sign in "iu" for bits in (8, 16, 24, 32)]


def deployment(kind: str, **keys: float) -> Deployment:
    channels = ", ".join(f'"0x2000:{sub}:{kind}"' for sub in range(1, 5))
    lines = "".join(f"{key} = {value}\n" for key, value in keys.items())
    text = deployment_text(pad_text("plane", 1))
    return parse(text.replace("[node.n]\n", f"[node.n]\nchannels = [{channels}]\n{lines}"))


def diagnose(made: Deployment, counts: NDArray[np.int64]) -> list[PadDiagnosis]:
    """Return what is diagnosed in 60 s of counts (6000, 4) at 100 Hz."""
    diagnosis, changes = HandDiagnostics(DiagnosisModel.from_deployment(made, "h"), tables=_TABLES), []
    stamps = (1 + np.arange(len(counts), dtype=np.int64))[:, None] * 10_000_000
    for first in range(0, len(counts), 50):
        rows = slice(first, first + 50)
        changes += diagnosis.process_block(
            HandSamples(stamps[rows], counts[rows, None], np.ones((50, 1), np.bool_))
        )
    return changes


@pytest.mark.parametrize("kind", INTEGERS)
@pytest.mark.parametrize("offset", [0, 3, 20])
def test_untouched_pad_has_no_fault_with_channels_of_any_type(kind: str, offset: int) -> None:
    noise = np.random.default_rng(1).normal(offset, 1, (6000, 4))
    low = node_channels(deployment(kind).nodes["n"])[0].limits[0]
    assert diagnose(deployment(kind), np.maximum(np.rint(noise), low).astype(np.int64)) == []


@pytest.mark.parametrize("kind", ["u8", "u16", "u24", "u32"])
def test_converter_that_clips_at_zero_is_no_stuck_channel(kind: str) -> None:
    assert diagnose(deployment(kind), np.zeros((6000, 4), np.int64)) == []


@pytest.mark.parametrize(
    ("kind", "keys", "end"),
    [
        *((kind, {}, (1 << int(kind[1:]) - (kind[0] == "i")) - 1) for kind in INTEGERS),
        ("i16", {"full_scale_counts": 4095}, 4095),
        ("u16", {"full_scale_counts": 4096}, 4095),
        ("i16", {"full_scale_counts": 4000, "max_count": 4095}, 4095),
        ("u24", {"max_count": 1_000_000}, 1_000_000),
    ],
)
def test_channel_at_the_end_of_its_converter_is_saturated(
    kind: str, keys: dict[str, float], end: int
) -> None:
    made = deployment(kind, **keys)
    counts = np.rint(np.random.default_rng(2).normal(1, 1, (6000, 4))).clip(0).astype(np.int64)
    counts[:, 2] = end
    (found,) = diagnose(made, counts)
    assert found.kind in (FaultKind.SATURATED_CHANNEL, FaultKind.SHORTED_ELECTRODE)
