"""Hardness felt by pads with two sheets: percept `stiffness`, contact modulus over tip radius.

The gripper of `config/two_sheets.toml`, with contacts of 3 mm and a standard deviation of 2 mm stated, in the
[worlds](../worlds.md) `default` and `harsh`, seeds of the reporting family. Each fingertip is pressed by
round objects of one shape, a tip of 10 mm radius, whose contact moduli are 0.1 to 10 MPa in half-decade
steps, skin included, and by a flat object of 2 mm radius; each at its own place on the inner 60 % of the pad.
The force rises from 0.2 to 2 N within half a second and stays; pressure is Hertz's, even under the flat
object. 16 touches come first, as evidence for the sheets. Samples go through the daemon's own pipeline and
its percept worker; the last estimate of each contact counts. *Inside*: ln(E / R) within 1.96 of its standard
deviation of the truth. *Pairs*: of objects whose moduli differ tenfold or more, pressed on the same pad, both
answered: those ordered rightly.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from benchmarks.bench_worlds import with_stated_touches
from benchmarks.daemon_settings import (
    InlineProcess,
    decoded,
    lay_out_channels,
    pipeline_of,
    request_percepts,
    write_counts,
)
from benchmarks.page import Report, options, progress
from benchmarks.scores import Share
from benchmarks.two_sheets import with_radii
from handtouch import wire
from handtouch.config import load, shipped
from handtouch.core.pad_model import PadModel
from handtouch.daemon.percepts import PerceptPublisher
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, Family

MODULI_PA = tuple(10 ** (5 + 0.5 * step) for step in range(5))
TIP_M, FLAT_MM, FORCES_N = 0.01, 2.0, (0.2, 2.0)
_WARM_UP, _REST_S, _STEP_S = 16, 2.0, 0.65
_OBJECT_S, _PRESS_S = 1.6, 1.2
_FIRST_S = _REST_S + _WARM_UP * _STEP_S + 1.0
OBJECTS = (*MODULI_PA, None)
"""Contact moduli; None: the flat object"""


class Collector:
    """Subscriber that keeps the last estimate of each link's contact."""

    def __init__(self) -> None:
        self.latest: dict[str, wire.Percept] = {}

    def has_subscriber(self, topic: str) -> bool:
        return topic.startswith("percept/")

    def send(self, message: wire.OutgoingMessage) -> None:
        percept = decoded(message)
        if isinstance(percept, wire.Percept) and percept.kind == "stiffness":
            self.latest[percept.link] = percept


def touches_of(links: list[str], number: int) -> tuple[ScenarioTouch, ...]:
    """Return the touches of a hand: evidence, then each object on each pad."""
    rng = np.random.default_rng((number, 3))

    def place(margin: float) -> tuple[tuple[float, float], ...]:
        x, y = rng.uniform(margin, 1 - margin, 2).tolist()
        return ((x, y),)

    warm_up = [
        ScenarioTouch(
            link=link,
            from_s=_REST_S + _STEP_S * k,
            duration_s=0.5,
            path=place(0.1),
            force_n=(float(np.exp(rng.uniform(-1.5, 1.0))),),
        )
        for k in range(_WARM_UP)
        for link in links
    ]
    low, high = FORCES_N
    objects = [
        ScenarioTouch(
            link=link,
            from_s=_FIRST_S + _OBJECT_S * k,
            duration_s=_PRESS_S,
            ramp_s=0.1,
            path=place(0.2),
            force_n=(low, high, high),
            **patch_of(modulus),
        )
        for k, modulus in enumerate(OBJECTS)
        for link in links
    ]
    return (*warm_up, *objects)


def patch_of(modulus_pa: float | None) -> dict[str, Any]:
    """Return the patch of an object in `[[touch]]`."""
    if modulus_pa is None:
        return {"radius_mm": FLAT_MM, "profile": "uniform"}
    at_1_n = (3 * TIP_M / (4 * modulus_pa)) ** (1 / 3)
    return {"radius_mm": 1e3 * at_1_n, "hertz_force_n": 1.0, "profile": "hertz"}


def feel(world: str, number: int) -> list[list[wire.Percept | None]]:
    """Return the last estimate of each object on each pad of a hand."""
    drawn = WORLDS[world].draw(Family.REPORTING.seed(number))
    stated = with_radii(load(shipped.path("two_sheets.toml")), 3.0, 2.0)
    deployment = with_stated_touches(drawn.describe(stated), drawn)
    model, collector = PadModel(deployment), Collector()
    period_s = deployment.daemon.sync_period_ms * 1e-3
    period_ns = round(period_s * 1e9)
    hand = VirtualHand(deployment, Scenario(touch=touches_of(model.links, number)), drawn)
    times_s = np.arange(round((_FIRST_S + _OBJECT_S * len(OBJECTS)) / period_s)) * period_s
    counts = np.stack([hand.all_counts(row, times_s) for row in range(model.size)], 1)
    pipeline = pipeline_of(deployment, collector, model=model)
    lay_out_channels(pipeline, deployment)
    perceiving = PerceptPublisher(deployment, pipeline, collector, process=InlineProcess(deployment))
    request_percepts(pipeline, perceiving, ["stiffness"])
    found: list[list[wire.Percept | None]] = []
    for t_s, rows in zip(times_s.tolist(), counts, strict=True):
        t_ns = 1_000_000_000 + round(t_s * 1e9)
        pipeline.begin_cycle(t_ns, t_ns)
        for pad, row in enumerate(rows):
            write_counts(pipeline, pad, row, t_ns + 1)
        if (ticked := pipeline.tick_if_due(t_ns + period_ns)) is not None:
            perceiving.process_tick(ticked, t_ns)
        pipeline.prepare_next_tick()
        if t_s >= _FIRST_S + _OBJECT_S * (len(found) + 1) - 2 * period_s:
            found.append([collector.latest.get(link) for link in model.links])
            collector.latest = {}
    return found


def object_row(world: str, modulus_pa: float | None, percepts: list[wire.Percept | None]) -> dict[str, Any]:
    """Return the row of one object."""
    answered = [one for one in percepts if one is not None and one.state == "estimated"]
    row = {
        "world": world,
        "modulus, MPa": "flat" if modulus_pa is None else f"{1e-6 * modulus_pa:.3g}",
        "contacts": len(percepts),
        "estimated": Share(len(answered), len(percepts)),
        "called flat": Share(
            sum(one is not None and one.state == "invalid" for one in percepts), len(percepts)
        ),
    }
    if modulus_pa is None or not answered:
        return row
    truth = math.log(modulus_pa / TIP_M)
    errors = np.array([math.log(one.values["modulus_per_radius_pa_per_m"]) - truth for one in answered])
    stds = np.array([one.values["modulus_per_radius_log_std"] for one in answered])
    return row | {
        "median of estimate / truth": float(np.exp(np.median(errors))),
        "rms of ln": float(np.sqrt(np.mean(errors**2))),
        "median std of ln": float(np.median(stds)),
        "inside 95 %": Share.of_mask(np.abs(errors) < 1.96 * stds),
    }


def pairs_row(world: str, hands: list[list[list[wire.Percept | None]]]) -> dict[str, Any]:
    """Return the row of pairs that differ tenfold or more."""
    right = answered = asked = 0
    for found in hands:
        for soft in range(len(MODULI_PA)):
            for hard in range(soft + 2, len(MODULI_PA)):
                for one, other in zip(found[soft], found[hard], strict=True):
                    asked += 1
                    if one is None or other is None or {one.state, other.state} != {"estimated"}:
                        continue
                    answered += 1
                    name = "modulus_per_radius_pa_per_m"
                    right += one.values[name] < other.values[name]
    return {
        "world": world, "pairs": asked, "answered": Share(answered, asked), "right": Share(right, answered),
    }  # fmt: skip


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--hands", type=int, default=12, help="of each world, two pads each")
    asked = parser.parse_args()
    report = Report(asked.quick, hands=2 if asked.quick else asked.hands)
    rows, pairs = [], []
    for world in ("default", "harsh"):
        hands = []
        for number in range(2 if asked.quick else asked.hands):
            progress(f"{world}: hand {number + 1}")
            hands.append(feel(world, number))
        for k, modulus in enumerate(OBJECTS):
            rows.append(object_row(world, modulus, [one for found in hands for one in found[k]]))
        pairs.append(pairs_row(world, hands))
    report.table("Objects", rows)
    report.table("Pairs that differ tenfold", pairs)
    report.keep()


if __name__ == "__main__":
    main()
