"""Length and direction of elongated contacts, through the daemon's pipeline.

Hands of the worlds `ideal` and `default` ([worlds](../worlds.md)), seeds of the reporting family, as their
builder describes them, uncalibrated: the shipped one with four electrodes a pad, and the pad of six of
`config/electrodes.toml`. Touches of 0.5 to 3 N (log-uniform), 20 % of a side and more inside the edges, on
evenly pressed ellipses of 2.5 mm mean radius in any direction, their length over their width 1 to 5
(log-uniform). One sample of each. The true length is that of the line with the same moments, the root of 3
(a^2 - b^2) for half axes a and b. *Held by the interval*: of four electrodes, its only end is the lower one.
*Width*: of the interval. *Direction*: of contacts longer than 6 mm, where it is stated; four electrodes state
26 degrees for it.
"""

from __future__ import annotations

import math
import os
from dataclasses import replace

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from benchmarks.bench_worlds import with_stated_touches
from benchmarks.hand_touches import REST_S, STEP_S, TOUCH_S, TouchReadings, tangent_basis
from benchmarks.page import Report, Row, options, progress
from benchmarks.scores import Share
from handtouch import wire
from handtouch.config import load, shipped
from handtouch.core.pad_model import PadModel
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.truth import GroundTruth
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.virtual_pad import VirtualPad
from handtouch.simulate.worlds import WORLDS, Family, MountSpread

FloatArray = NDArray[np.float64]
FILES = {"4": "utah_mit.toml", "6": "electrodes.toml"}
BANDS_M = ((0.0, 4e-3), (4e-3, 7e-3), (7e-3, 10e-3))
CASES = (("ideal", "4", 1, 12), ("ideal", "6", 4, 24), ("default", "4", 2, 12), ("default", "6", 8, 24))
"""World, electrodes, hands, touches of each pad"""
RADIUS_MM, LONG_M, STEP_M = 2.5, 6e-3, 1e-5


def draw_touches(links: list[str], count: int, seed: int) -> tuple[ScenarioTouch, ...]:
    """Return `count` touches of each pad, one after the other."""
    rng = np.random.default_rng((seed, 23))
    return tuple(
        ScenarioTouch(
            link=link,
            from_s=REST_S + number * STEP_S,
            duration_s=TOUCH_S,
            path=(tuple(rng.uniform(0.2, 0.8, 2)),),
            force_n=(float(np.exp(rng.uniform(*np.log([0.5, 3.0])))),),
            radius_mm=RADIUS_MM,
            profile="uniform",
            elongation=float(np.exp(rng.uniform(0.0, math.log(5.0)))),
            direction_deg=float(rng.uniform(-90.0, 90.0)),
        )
        for number in range(count)
        for link in links
    )


def play(world: str, electrodes: str, number: int, count: int) -> FloatArray:
    """Return true length, its estimate, both ends [m], and error and deviation of the direction [rad] of the
    touches (n, 6) of a hand of this number; NaN where nothing was published."""
    drawn = replace(WORLDS[world], mounts=MountSpread()).draw(Family.REPORTING.seed(number))
    deployment = drawn.describe(load(shipped.path(FILES[electrodes])))
    stated = with_stated_touches(deployment, drawn)
    model = PadModel(stated)
    used = [link for row, link in enumerate(model.links) if model.electrode_counts[row] == int(electrodes)]
    touches = draw_touches(used, count, drawn.seed)
    hand = VirtualHand(deployment, Scenario(touch=touches), drawn)
    readings = TouchReadings.of_hand(hand, deployment, range(count))
    contacts = readings.contacts(model, stated)
    return np.array(
        [
            row_of(contacts.get(key), truth, touches[truth.touch], hand)
            for key, truth in readings.truths.items()
        ]
    )


def row_of(
    contact: wire.Contact | None, truth: GroundTruth, touch: ScenarioTouch, hand: VirtualHand
) -> tuple[float, ...]:
    """Return the values of a touch."""
    ratio = touch.elongation or 1.0
    true_m = 1e-3 * RADIUS_MM * math.sqrt(3 * (ratio - 1 / ratio))
    if contact is None:
        return (true_m, *[np.nan] * 5)
    values = [
        np.nan if value is None else value
        for value in (contact.length_m, contact.min_length_m, contact.max_length_m)
    ]
    error = std = np.nan
    if contact.length_axis is not None and contact.length_axis_std_rad is not None:
        (pad,) = (one for one in hand.virtual_pads if one.pad.link == truth.link)
        basis = tangent_basis(np.array(truth.normal))
        found, true = basis @ contact.length_axis, basis @ long_axis(pad, touch)
        error = math.atan2(abs(found[0] * true[1] - found[1] * true[0]), abs(found @ true))
        std = contact.length_axis_std_rad
    return (true_m, *values, error, std)


def long_axis(pad: VirtualPad, touch: ScenarioTouch) -> FloatArray:
    """Return the unit vector (3,) along a touch's patch, in its link's frame."""
    shape, (x, y), angle = pad.shape, touch.path[0], math.radians(touch.direction_deg or 0.0)
    step_m = STEP_M * np.array([math.cos(angle), math.sin(angle)])
    dx, dy = np.linalg.solve(shape.metres_per_fraction(x, y), step_m).tolist()
    ends = [
        shape.point((x + sign * dx) * shape.length_m, (y + sign * dy) * shape.arc) for sign in (-1.0, 1.0)
    ]
    return np.asarray(pad.rotation @ (ends[1] - ends[0])) / np.linalg.norm(ends[1] - ends[0])


def rows_of(world: str, electrodes: str, touches: FloatArray) -> list[Row]:
    """Return the rows of a table: touches (n, 6) of a world and number of electrodes, by true length."""
    rows = []
    for low, high in BANDS_M:
        true, length, least, most, error, std = touches[(touches[:, 0] >= low) & (touches[:, 0] < high)].T
        known = np.isfinite(length)
        held = (least <= true) & ((true <= most) | np.isnan(most))
        directed = np.isfinite(error) & (true > LONG_M)
        ends = known & np.isfinite(most)
        rows.append(
            {
                "world": world,
                "electrodes": electrodes,
                "true length": f"{1e3 * low:g} to {1e3 * high:g} mm",
                "touches": len(true),
                "stated, %": 100 * known.mean() if len(true) else math.nan,
                "held by the interval": Share.of_mask(held[known]),
                "median lower end, mm": 1e3 * _median(least[known]),
                "median width, mm": 1e3 * _median((most - least)[ends]),
                "median error, mm": 1e3 * _median(np.abs(length - true)[ends]),
                "direction stated, %": 100 * directed[true > LONG_M].mean()
                if (true > LONG_M).any()
                else math.nan,
                "its median error, deg": math.degrees(_median(error[directed])),
                "error below 2 std": Share.of_mask((error < 2 * std)[directed]),
            }
        )
    return rows


def _median(values: FloatArray) -> float:
    return float(np.median(values)) if len(values) else math.nan


def main() -> None:
    asked = options(__doc__).parse_args()
    rows: list[Row] = []
    for world, electrodes, hands, count in CASES:
        hands, count = (1, 4) if asked.quick else (hands, count)
        made = []
        for number in range(hands):
            made.append(play(world, electrodes, number, count))
            progress(f"{world}, {electrodes} electrodes: hand {number + 1}")
        rows += rows_of(world, electrodes, np.concatenate(made))
    report = Report(asked.quick)
    report.table("Elongated contacts", rows)
    report.keep()


if __name__ == "__main__":
    main()
