"""Location and force of the demo's session against its truth: noise alone, and tolerances of parts besides.

The simulator's samples go through the daemon's own pipeline, without waiting for the clock; several seeds.
What tolerances cause is reported apart: the mean error of a touch is bias, what is left is scatter. Writes
docs/benchmarks/location.{md,json}.
"""

from __future__ import annotations

import json
import os
import platform
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from daemon_settings import pipeline_of
from page import made_by, options, output_folder

from handtouch import wire
from handtouch.config import Deployment, load, shipped
from handtouch.core.pad_model import PadModel
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.score import Score, score_contacts
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, DrawnWorld, Family

_COLUMNS = (
    "hidden from the estimator", "rms error", "rms bound", "ratio (range)", "median", "bias", "scatter",
    "force", "touches", "missed", "invented",
)  # fmt: skip


class Collector:
    """Takes contacts as a subscriber to all of them would."""

    def __init__(self) -> None:
        self.contacts: list[wire.Contact] = []

    def has_subscriber(self, topic: str) -> bool:
        return topic.startswith("contact/")

    def send(self, message: wire.OutgoingMessage) -> None:
        if isinstance(message, wire.Contact):
            self.contacts.append(message)


def play(
    deployment: Deployment, model: PadModel, scenario: Scenario, world: DrawnWorld, seconds: float
) -> Score:
    """The session, up to a time, through the pipeline, as fast as it goes."""
    hand = VirtualHand(deployment, scenario, world)
    taken = Collector()
    period_ns = round(deployment.daemon.sync_period_ms * 1e6)
    pipeline = pipeline_of(deployment, taken, model=model)
    truth = []
    for t_ns in range(period_ns, round(seconds * 1e9), period_ns):
        pipeline.begin_cycle(t_ns, t_ns)
        for pad, counts in enumerate(hand.sample(t_ns * 1e-9)):
            pipeline.slab.write_pdo(pad, counts.astype("<i2").tobytes(), t_ns + 1)
        pipeline.tick_if_due(t_ns + period_ns)
        truth += hand.truth(t_ns * 1e-9, t_ns)
    return score_contacts(taken.contacts, truth)


def line(name: str, scores: list[Score]) -> str:
    def mean(field: str) -> float:
        return float(np.sqrt(np.mean([getattr(result.total, field) ** 2 for result in scores])))

    ratios = [result.total.rms_error_m / result.total.rms_bound_m for result in scores]
    return (
        f"| {name} | {1e6 * mean('rms_error_m'):.0f} | {1e6 * mean('rms_bound_m'):.0f} "
        f"| {np.mean(ratios):.2f} ({min(ratios):.2f}-{max(ratios):.2f}) | {1e6 * mean('median_error_m'):.1f} "
        f"| {1e6 * mean('bias_m'):.1f} | {1e6 * mean('scatter_m'):.0f} "
        f"| {1e3 * mean('rms_force_error_n'):.1f} "
        f"| {sum(r.total.touches for r in scores)} | {sum(r.total.missed for r in scores)} "
        f"| {sum(r.total.false_positives for r in scores)} |"
    )


def write(results: dict[str, list[Score]], samples: int, out: Path) -> str:
    rows = "\n".join(line(name, scores) for name, scores in results.items())
    seeds = len(next(iter(results.values())))
    header = f"| {' | '.join(_COLUMNS)} |"
    machine = f"{platform.machine()}, {os.cpu_count()} processors, Python {platform.python_version()}"
    text = f"""# Position and force: the demo's session against ground truth

15 pads at 200 Hz, touches 5 % or farther from the edges; {seeds} seeds each, {samples} contact samples a
seed. Lengths in um, force in mN. {machine}.

{header}
{"| --- " * len(_COLUMNS)}|
{rows}

* *bound*: the least rms error that an unbiased estimate can have from each sample's currents and noise
  (Cramer-Rao). Weak samples, where a touch begins and ends, carry most of both rms; the median is of the
  rest.
* *tolerances*: 2 % gain of each channel, 0.2 mm of each gap, 5 % of each resistor, and the contact's size.
  Their *bias* is the mean error of each touch; what noise does to it is the *scatter*.

{made_by()}.
"""
    (out / "location.md").write_text(text)
    content: dict[str, Any] = {name: [asdict(s.total) for s in scores] for name, scores in results.items()}
    (out / "location.json").write_text(json.dumps(content, indent=1) + "\n")
    return text


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    asked = parser.parse_args()
    deployment = load(shipped.path("utah_mit.toml"))
    scenario = Scenario.load(shipped.path("utah_mit_session.toml"))
    model = PadModel(deployment)
    seeds = range(1, 2 if asked.quick else asked.seeds + 1)
    seconds = 3.0 if asked.quick else scenario.duration_s
    results = {
        "noise and quantisation": [
            play(deployment, model, scenario, WORLDS["ideal"].draw(Family.REPORTING.seed(s)), seconds)
            for s in seeds
        ],
        "tolerances of parts too": [
            play(
                deployment,
                model,
                scenario,
                WORLDS["default"].only("parts", "contacts").draw(Family.REPORTING.seed(s)),
                seconds,
            )
            for s in seeds
        ],
    }
    print(write(results, next(iter(results.values()))[0].total.samples, output_folder(asked.quick)))


if __name__ == "__main__":
    main()
