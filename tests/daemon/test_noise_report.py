"""Hum and noise are named with their size, their effect and a remedy, and nothing else is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from handtouch.daemon.pad_reports import NoiseReport
from handtouch.wire.health import Diagnosis
from tests.core.conftest import bench
from tests.core.test_room import Room, hum, steady, touch

__all__ = ["bench"]


def updated(report: NoiseReport, room: Room, pad: int, now_ns: int) -> Diagnosis | None:
    tick = room.pipeline.tick
    return report.update(tick, pad, "n", now_ns, noisy=report.find(tick)[pad])


def test_hum_is_named_with_its_size_and_the_raised_thresholds(bench: Any) -> None:
    room, report = Room(bench), NoiseReport(bench.model.size)
    room.run(1.0, steady(0.0))
    assert updated(report, room, 0, 1) is None
    room.run(5.0, hum(60.0))
    found = updated(report, room, 0, 2)
    assert found
    assert (found.kind, found.since_ns) == ("noise", 2)
    assert found.position_valid
    assert found.force_valid
    x0 = float(found.evidence.split("x0 ")[1].split(",")[0])
    assert x0 == pytest.approx(60 / np.sqrt(2), rel=0.1)
    factor = room.threshold_factor[0]
    assert f"begin and end at {factor:.1f} times the currents of the thresholds" in found.evidence
    assert "noise_counts = 4" in found.remedy
    assert found.remedy.endswith("in [node.n]")
    later = updated(report, room, 0, 3)
    assert later
    assert later.since_ns == 2
    room.run(300.0, steady(0.0))
    assert updated(report, room, 0, 4) is None


def test_noise_of_three_times_the_stated_is_named_and_of_half_more_is_not(bench: Any) -> None:
    for ratio, named in ((1.0, False), (1.5, False), (3.0, True)):
        room = Room(bench, noise=ratio)
        room.run(60.0, steady(0.0))
        found = [updated(NoiseReport(bench.model.size), room, pad, 1) for pad in range(3)]
        assert [one is not None for one in found] == [named] * 3, ratio


def test_touches_are_no_noise(bench: Any) -> None:
    room, report, light = Room(bench), NoiseReport(bench.model.size), touch(bench, 5.0)
    room.run(1.0, steady(0.0))
    room.run(30.0, lambda t_s: light * (1 + np.sin(2 * np.pi * 8 * t_s)))
    assert updated(report, room, 0, 1) is None
