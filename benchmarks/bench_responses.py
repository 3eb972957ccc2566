"""Intervals of pads that aren't sheets with electrodes.

The pads of [taxels.toml](../../config/taxels.toml), nine cells around a fingertip and five barometers in
rubber, with hidden quantities drawn for seeds of the reporting family, as their builder states them: gains,
places and widths of the taxels, and what no estimator models, cross-talk among neighbours, a wide tail of the
response, creep and hysteresis of the elastomer, patches of seven shapes, drift of zeros and gains. Touches of
0.2 to 12 N (log-uniform) anywhere but 2 % of a side along the edges go through the daemon's own pipeline; one
sample of each is compared, else as in [worlds](worlds.md). Intervals are of touches on these pads, but those
"of fingers", which follow from how they differ.

*Two layers*: the films of [two_layers.toml](../../config/two_layers.toml), with leads, gaps, uneven films and
the layer's law drawn likewise.

*Measured* (`ARGS="--part measured"`): the sheets of [utah_mit.toml](../../config/utah_mit.toml) as stated,
and by 60 presses of 0.5 to 2 N at places known to 0.1 mm, as `handtouch calibrate --map` takes them; the
presses are round.

*Beyond the taxels*: the same barometers on a pad of 16 mm, which reaches 3 mm beyond the outermost ones.

*Zeros that move* (`ARGS="--part drifting"`, `"--part turning"`): an hour of each finger at 100 Hz in
`default`, both pads of taxels.toml. *Drifting*: each channel's zero by the signal of 0.5 N and its gain by 10
%, up in one hour, touches of 0.2 N every 30 s. *Turning*: magnetic ones, by 20 degrees in a second every 15
s, which shifts channels by the signal of up to 0.1 N; 0.2 N at rest, 0.3 N in the second after a turn.
"""

from __future__ import annotations

import os
import tempfile
from argparse import Namespace
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from benchmarks.bench_electrodes import ERRORS, estimates_of_finger, share_of
from benchmarks.bench_worlds import UNITS
from benchmarks.hand_touches import (
    FORCES_N,
    REST_S,
    SAMPLE_S,
    STEP_S,
    TouchReadings,
    draw_touches,
    estimates,
    position_error,
)
from benchmarks.page import Report, options, progress
from benchmarks.scores import Estimates, EstimateScore, Rate, Share, concatenate, slices
from benchmarks.untouched_zeros import Found, Zeros, play_zeros
from handtouch.config import Deployment, load, parse, shipped
from handtouch.core.pad_model import PadModel
from handtouch.field.embedded_file import embed_file
from handtouch.hand import mount_transform
from handtouch.procedures.calibrate.press_map import MapJob, Place
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, DrawnWorld, Family, MountSpread, World
from handtouch.simulate.worlds.spreads import ContactSpread

PRESSES, PRESS_FORCES_N, PRESS_STD_MM, PRESS_SAMPLES = 60, (0.5, 2.0), 0.1, 15
FIRST = 3  # touch that is sampled: zeros are known by then
MOVING = {"drifting": Zeros(drift_n=0.5, gain_drift=0.1), "turning": Zeros(turn_n=0.1)}


def larger() -> Deployment:
    """Return the deployment with barometers on a pad that reaches farther than they do."""
    text = shipped.path("taxels.toml").read_text(encoding="utf-8")
    return parse(text.replace("length_mm = 12.0, width_mm = 12.0", "length_mm = 16.0, width_mm = 16.0"))


def play(deployment: Deployment, world: str, number: int, touches: int) -> dict[str, Estimates]:
    """Return estimates of position and force of a drawn finger."""
    drawn = replace(WORLDS[world], mounts=MountSpread()).draw(Family.REPORTING.seed(number))
    stated = drawn.describe(deployment)
    model, numbers = PadModel(stated), range(FIRST, FIRST + touches)
    stimulus = Scenario(touch=draw_touches(model.links, numbers.stop, drawn.seed))
    readings = TouchReadings.of_hand(VirtualHand(stated, stimulus, drawn), stated, numbers)
    return estimates_of_finger(model, readings.contacts(model, stated), readings.truths, number, "channels")


def play_measured(world: World, number: int, touches: int) -> dict[str, Estimates]:
    """Return estimates of positions on the sheets of a drawn hand, as stated and by presses."""
    drawn = replace(world, mounts=MountSpread()).draw(Family.REPORTING.seed(number))
    stated = drawn.describe(load(shipped.path("utah_mit.toml")))
    mapped = with_press_maps(stated, replace(drawn, world=replace(drawn.world, contacts=ContactSpread())))
    model, numbers = PadModel(stated), range(FIRST, FIRST + touches)
    stimulus = Scenario(touch=draw_touches(model.links, numbers.stop, drawn.seed))
    readings = TouchReadings.of_hand(VirtualHand(stated, stimulus, drawn), stated, numbers)
    parts = []
    for name, deployment in (("as stated", stated), ("by 60 presses", mapped)):
        contacts = readings.contacts(PadModel(deployment), deployment)
        found = [(contacts.get(key), truth) for key, truth in readings.truths.items()]
        columns = {"pad": np.full(len(found), name), "finger": np.full(len(found), number)}
        errors = [position_error(*pair) for pair in found]
        bound_m = np.array([truth.bound_m for _, truth in found])
        parts.append(estimates(errors, bound_m, np.full((len(found), 2, 2), np.nan), columns))
    return {"position": concatenate(parts)}


def with_press_maps(deployment: Deployment, drawn: DrawnWorld) -> Deployment:
    """Return a deployment whose pads have maps of presses."""
    links = [entry.pad.link for entry in deployment.pads]
    power = np.log(PRESS_FORCES_N[1] / PRESS_FORCES_N[0]) / np.log(FORCES_N[1] / FORCES_N[0])
    presses = tuple(
        touch.model_copy(update={"force_n": (PRESS_FORCES_N[0] * (touch.force_n[0] / FORCES_N[0]) ** power,)})
        for touch in draw_touches(links, PRESSES, drawn.seed + 1)
    )
    hand, rng = VirtualHand(deployment, Scenario(touch=presses), drawn), np.random.default_rng(drawn.seed)
    begins_s = REST_S + STEP_S * np.arange(PRESSES)
    truths = {
        (number, truth.link): truth
        for number, begin_s in enumerate(begins_s.tolist())
        for truth in hand.truth(begin_s + SAMPLE_S)
    }
    spans = [np.linspace(*span, PRESS_SAMPLES) for span in ((-0.1, -0.02), (0.25, 0.45))]
    pads = {}
    for row, entry in enumerate(deployment.pads):
        zero, held = (
            hand.all_counts(row, (begins_s[:, None] + span).ravel()).reshape(PRESSES, PRESS_SAMPLES, -1)
            for span in spans
        )
        turn, origin = mount_transform(entry.pad)
        at = np.array([truths[number, entry.pad.link].position_m for number in range(PRESSES)])
        at = (at - origin) @ turn + rng.normal(0.0, PRESS_STD_MM * 1e-3, at.shape)
        places = [Place(tuple(place), np.nan) for place in at.tolist()]
        counts = list(held.mean(axis=1) - zero.mean(axis=1))
        table = MapJob(deployment, entry).presses(counts, places, PRESS_SAMPLES, PRESS_STD_MM)
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "presses.npz").write_bytes(table.data)
            file = embed_file("presses.npz", Path(folder))
        pads[entry.pad.link] = entry.pad.model_copy(update={"press_map": file})
    hands = tuple(
        one.model_copy(update={"pads": tuple(pads[pad.link] for pad in one.pads)}) for one in deployment.hands
    )
    return deployment.model_copy(update={"hands": hands})


def rows_of(every: Estimates, quantity: str) -> list[dict[str, Any]]:
    """Return the scores of each pad."""
    rows = []
    for pad, own in slices(every, "pad"):
        row = EstimateScore.of_estimates(own).row(UNITS[quantity][1], bounds=quantity == "position")
        hits = own.where(own.valid)
        row["in 95 %, of fingers"] = share_of(hits.stated_levels() <= 0.95, hits.columns["finger"])
        rows.append({"case": pad, **row})
    return rows


def measure_zeros(name: str, asked: Namespace) -> None:
    """Measure false contacts, and light touches, while zeros move in one way of `MOVING`."""
    fingers, hours = (1, 0.1) if asked.quick else (asked.moving, 1.0)
    report, found = Report(asked.quick, name, fingers=fingers, hours_of_a_finger=hours), Found()
    for number in range(fingers):
        found.add(play_zeros(MOVING[name], number, hours))
        progress(f"{name}: {number + 1} of {fingers}")
    shares = {f"{force} found, %": Share(found.found[force], count) for force, count in found.touches.items()}
    row = {"hours": found.hours, "false contacts": found.false, "an hour": Rate(found.false, found.hours)}
    report.table(f"Zeros that move: {name}", [row | shares])
    report.limit(f"{name}: false contacts", found.false, 0)
    report.keep()


def measure_intervals(asked: Namespace) -> None:
    """Measure intervals of positions and forces by what is stated of the responses."""
    fingers, touches = (2, 3) if asked.quick else (asked.fingers, asked.touches)
    report = Report(asked.quick, fingers=fingers, touches_of_a_pad=touches)
    taxels, films = (load(shipped.path(f"{name}.toml")) for name in ("taxels", "two_layers"))
    for title, deployment, world in [
        ("`default`", taxels, "default"),
        ("`harsh`", taxels, "harsh"),
        ("two layers, `default`", films, "default"),
        ("two layers, `harsh`", films, "harsh"),
        ("`default`, beyond the taxels", larger(), "default"),
    ]:
        made = [play(deployment, world, number, touches) for number in range(fingers)]
        progress(f"{title}: {fingers} fingers")
        for quantity in ERRORS:
            every = concatenate([finger[quantity] for finger in made])
            report.table(f"{quantity.capitalize()} in {title}", rows_of(every, quantity))
    report.keep()


def measure_presses(asked: Namespace) -> None:
    """Measure intervals of positions by presses."""
    hands, touches = (1, 3) if asked.quick else (asked.hands, asked.touches)
    report = Report(asked.quick, "measured", hands=hands, touches_of_a_pad=touches)
    default, harsh = WORLDS["default"], WORLDS["harsh"]
    round_ones = replace(harsh, contacts=ContactSpread())
    for title, world in [("`default`", default), ("round contacts, `harsh`", round_ones), ("`harsh`", harsh)]:
        made = []
        for number in range(hands):
            made.append(play_measured(world, number, touches)["position"])
            progress(f"measured, {title}: {number + 1} of {hands} hands")
        report.table(f"Position on measured sheets, {title}", rows_of(concatenate(made), "position"))
    report.keep()


PARTS: dict[str, Callable[[Namespace], None]] = {
    "intervals": measure_intervals,
    "measured": measure_presses,
    **{name: partial(measure_zeros, name) for name in MOVING},
}


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--part", choices=list(PARTS), help="by default all")
    parser.add_argument("--fingers", type=int, default=40)
    parser.add_argument("--hands", type=int, default=3, help="with measured sheets")
    parser.add_argument("--touches", type=int, default=20, help="of each pad")
    parser.add_argument("--moving", type=int, default=10, help="fingers whose zeros move")
    asked = parser.parse_args()
    for part, measure in PARTS.items():
        if asked.part in (None, part):
            measure(asked)


if __name__ == "__main__":
    main()
