"""Chewing gum on a simulated hand, from the counts of its nodes to the words that health carries."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from handtouch.simulate.hand import VirtualHand
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.world import World
from handtouch.supervise.archive import Archive
from handtouch.supervise.diagnoses import Diagnoses
from handtouch.supervise.link import Block, Judged
from handtouch.supervise.slow import SlowHalf

from .conftest import LINKS, NOW, Bench

PERIOD_NS, TOGETHER, SECONDS = 20_000_000, 5, 24.0
SCENARIO = """
repeat = false
pause_s = 60.0

[[fault]]
kind = "gum"
link = "square"
from_s = 3.0
place = [0.3, 0.6]
radius_mm = 2.5
force_n = 0.5

[[touch]]
link = "oblong"
from_s = 4.0
duration_s = 3.0
path = [[0.3, 0.4], [0.7, 0.6]]
force_n = [1.0]
"""


def block(counts: NDArray[np.int64], since: int) -> dict[str, Any]:
    k = len(counts)
    times = 10**9 + PERIOD_NS * np.arange(since, since + k, dtype=np.int64)
    made = Block(
        times,
        np.repeat(times[:, None], 3, axis=1),
        counts.astype(np.int32),
        np.ones((k, 3), np.bool_),
        np.zeros((k, 3), np.uint8),
        np.zeros((k, 3), np.uint32),
        np.zeros((3, 4)),
        np.full(3, 0.5),
        np.ones((3, 4)),
        np.full(3, np.nan),
        np.full(3, np.nan),
    )
    message: dict[str, Any] = msgpack.unpackb(made.dump())
    return message


def test_gum_is_told_with_its_place_its_size_and_since_when(bench: Bench, tmp_path: Path) -> None:
    hand = VirtualHand(bench.deployment, Scenario.parse(SCENARIO), World(seed=8))
    slow = SlowHalf(bench.start, Archive(tmp_path / "c.db"), Diagnoses(bench.deployment))
    words = slow.take(bench.introduce([1, 2, 3]), NOW)
    ticks = round(SECONDS * 1e9 / PERIOD_NS)
    times = PERIOD_NS * 1e-9 * np.arange(ticks)
    counts = np.stack([hand.counts(row, times) for row in range(len(LINKS))], axis=1)
    for since in range(0, ticks, TOGETHER):
        words += slow.take(block(counts[since : since + TOGETHER], since), NOW)
    slow.finish(NOW)
    told = [word for word in words if isinstance(word, Judged) and word.findings]
    assert {LINKS[word.pad] for word in told} == {"square"}
    (gum,) = told[-1].findings
    assert gum.kind == "stuck contact"
    assert "like gum" in gum.cause
    assert "clean it" in gum.remedy
    assert abs(gum.since_ns - 4e9) < 0.5e9
    assert gum.pad_m is not None
    assert np.abs(np.subtract(gum.pad_m, (0.3 * 20e-3, 0.6 * 20e-3))).max() < 1.5e-3
    assert gum.size_m is not None
    assert 2e-3 < gum.size_m < 12e-3
