"""A deployment of three pads, and blocks of ticks as a daemon would send of it, from finite elements."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import msgpack
import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.config import Deployment, parse
from handtouch.simulate.hand import VirtualHand
from handtouch.simulate.scenario import Scenario, Touch
from handtouch.simulate.world import World
from handtouch.supervise.link import Block, Start, serials

NOW = datetime(2026, 3, 1, tzinfo=UTC)
PERIOD_NS = 5_000_000
DEPLOYMENT = """
[[bus]]
name = "can0"
interface = "virtual"
channel = "test"

[node.n]
drive_v = 5.0
full_scale_ma = 10.0
noise_counts = 1.0

[sheet.s]
ohm_per_square = 2400.0
contact_ohm_mm2 = 20000.0
alpha = 1.5
contact_radius_mm = 2.5
contact_radius_std_mm = 0.5

[[hand]]
name = "h"
"""
PAD = """
[[hand.pad]]
link = "{link}"
bus = "can0"
node_id = {node_id}
node = "n"
sheet = "s"
surface = {{ kind = "plane", length_mm = {length}, width_mm = 20.0 }}
gap_mm = 0.6
"""
LINKS = ("square", "oblong", "strip")
LENGTHS = (20.0, 41.0, 80.0)


@dataclass(frozen=True)
class Bench:
    """A deployment, its start message, and a hand whose channels have other gains than it says."""

    deployment: Deployment
    start: Start
    gains: NDArray[np.float64]

    def introduce(self, now: list[int | None], before: list[int | None] | None = None) -> dict[str, Any]:
        message: dict[str, Any] = msgpack.unpackb(serials(now, before or [None] * 3, 0))
        return message

    def block(self, counts: NDArray[np.float64], contact: NDArray[np.uint32], t_ns: int) -> dict[str, Any]:
        """Counts (k, 3, 4) of contacts (k, 3) as a message of the daemon's, from a time on."""
        k = len(counts)
        times = t_ns + PERIOD_NS * np.arange(k, dtype=np.int64)
        block = Block(
            times,
            np.repeat(times[:, None], 3, axis=1),
            np.rint(counts).astype(np.int32),
            np.ones((k, 3), np.bool_),
            (contact > 0).astype(np.uint8),
            contact.astype(np.uint32),
            np.zeros((3, 4)),
            np.full(3, 0.5),
            np.ones((3, 4)),
            np.full(3, np.nan),
            np.full(3, np.nan),
        )
        message: dict[str, Any] = msgpack.unpackb(block.dump())
        return message


@pytest.fixture(scope="session")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    pads = "".join(
        PAD.format(link=link, node_id=number + 1, length=length)
        for number, (link, length) in enumerate(zip(LINKS, LENGTHS, strict=True))
    )
    deployment = parse(DEPLOYMENT + pads)
    scale = np.full((3, 4), 10e-3 / 32767)
    store = str(tmp_path_factory.mktemp("store") / "calibrations.db")
    start = Start(deployment, store, tuple(f"nominal-{link}" for link in LINKS), scale, np.ones(3))
    logs = np.random.default_rng(2).normal(0, 0.03, (3, 4))
    return Bench(deployment, start, np.exp(logs - logs.mean(axis=1, keepdims=True)))


@pytest.fixture(scope="session")
def session(bench: Bench) -> list[tuple[NDArray[np.float64], NDArray[np.uint32]]]:
    """Touches all over all pads, each of 12 ticks and one without, as counts (13, 3, 4) and contacts."""
    generator = np.random.default_rng(4)
    count, step_s = 160, PERIOD_NS * 1e-9
    touches = [
        Touch(
            link=link,
            from_s=number * 0.065,
            duration_s=0.06,
            ramp_s=0.001,
            path=((float(x), float(y)),),
            force_n=(float(force),),
        )
        for number in range(count)
        for link, x, y, force in zip(
            LINKS, *generator.uniform(0.08, 0.92, (2, 3)), generator.uniform(0.5, 4.0, 3), strict=True
        )
    ]
    hand = VirtualHand(bench.deployment, Scenario(touch=tuple(touches)), World.ideal_parts())
    made = []
    for number in range(count):
        counts = np.array([hand.sample(number * 0.065 + (k + 0.5) * step_s) for k in range(13)])
        contact = np.full((13, 3), number + 1, np.uint32)
        contact[12] = 0
        made.append((counts / bench.gains, contact))
    return made
