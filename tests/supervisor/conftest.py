"""Deployment of three pads, and blocks of ticks as sent by a daemon, simulated by finite elements."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.config import Deployment, parse
from handtouch.core.pad_model import default_calibration_id_of
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS
from handtouch.supervisor.ipc import NodeSerials, SampleBlock
from tests.deployments import deployment_text, pad_text

NOW = datetime(2026, 3, 1, tzinfo=UTC)
PERIOD_NS = 5_000_000
LINKS = ("square", "oblong", "strip")
LENGTHS = (20.0, 41.0, 80.0)


@dataclass(frozen=True)
class Bench:
    """A deployment, ids of its calibrations by link, and the actual gains of the channels."""

    deployment: Deployment
    ids: dict[str, str]
    gains: NDArray[np.float64]

    def introduce(self, now: list[int | None], before: list[int | None] | None = None) -> NodeSerials:
        return NodeSerials(now=tuple(now), before=tuple(before or [None] * 3), sync_ns=0)

    def block(self, counts: NDArray[np.float64], contact: NDArray[np.uint32], t_ns: int) -> SampleBlock:
        """Return a message of the daemon with counts (k, 3, 4) and contact identifiers (k, 3)."""
        k = len(counts)
        times = t_ns + PERIOD_NS * np.arange(k, dtype=np.int64)
        return SampleBlock(
            times,
            np.repeat(times[:, None], 3, axis=1),
            np.rint(counts).astype(np.int64),
            np.ones((k, 3), np.bool_),
            (contact > 0).astype(np.uint8),
            contact.astype(np.uint32),
            np.zeros((3, 4)),
            np.full(3, 0.5),
            np.ones((3, 4)),
            np.full(3, np.nan),
            np.full(3, np.nan),
        )


@pytest.fixture(scope="session")
def bench() -> Bench:
    pads = [
        pad_text(link, number, f'{{ kind = "plane", length_mm = {length}, width_mm = 20.0 }}')
        for number, (link, length) in enumerate(zip(LINKS, LENGTHS, strict=True), 1)
    ]
    deployment = parse(deployment_text(*pads, touch=""))
    ids = {pad.link: default_calibration_id_of(pad, deployment) for _, pad in deployment.pads}
    logs = np.random.default_rng(2).normal(0, 0.03, (3, 4))
    return Bench(deployment, ids, np.exp(logs - logs.mean(axis=1, keepdims=True)))


@pytest.fixture(scope="session")
def session(bench: Bench) -> list[tuple[NDArray[np.float64], NDArray[np.uint32]]]:
    """Contacts all over all pads, of 12 ticks and one without, as counts (13, 3, 4) and identifiers."""
    generator = np.random.default_rng(4)
    count, step_s = 160, PERIOD_NS * 1e-9
    touches = [
        ScenarioTouch(
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
    hand = VirtualHand(bench.deployment, Scenario(touch=tuple(touches)), WORLDS["ideal"].draw(1))
    made = []
    for number in range(count):
        counts = np.array([hand.sample(number * 0.065 + (k + 0.5) * step_s) for k in range(13)])
        contact = np.full((13, 3), number + 1, np.uint32)
        contact[12] = 0
        made.append((counts / bench.gains, contact))
    return made
