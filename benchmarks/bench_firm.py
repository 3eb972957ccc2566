"""Presses up to `max_force_n`, anywhere on the pads of the shipped file, through the daemon's pipeline.

Hands of the world `default` ([worlds](../worlds.md)), seeds of the reporting family, mounts drawn, described
with sheets and tolerances as their builder would, at a SYNC of 10 ms. Presses of 0.5 s with ramps of 0.1 s,
every 0.65 s on each pad, places uniform from 2 % of a side inside the edges, patches of the world's sizes,
shapes and profiles. Forces are log-uniform below 5 N, and uniform up to 20 N in every other press. 12 come
first, as evidence for the compensation of sheets.

*Ended or unknown*: at one of the 20 samples under the full force, from 0.15 s after the begin on, without a
contact, with another than at the others, or without a number for position or force. Force and position are
judged at 0.32 s; a force is *true* if the 95 % interval of a valid one holds it, or a lower bound is below
it. Positions are those in the link's frame, `covariance_m2` with the mount's.
"""

from __future__ import annotations

import itertools
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from benchmarks.hand_touches import position_error, serve
from benchmarks.page import Report, options, progress
from benchmarks.scores import ClusterShare
from handtouch import wire
from handtouch.config import load, shipped
from handtouch.daemon.table_cache import build_pad_model
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.truth import GroundTruth
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, Family

FloatArray = NDArray[np.float64]
BANDS_N = (0.15, 1.0, 2.0, 3.3, 5.0, 10.0, 20.0)
"""Limits of the rows; the last is the shipped file's `max_force_n`."""
FIRM_N = 5.0
PERIOD_MS, REST_S, STEP_S, PRESS_S, RAMP_S = 10.0, 1.0, 0.65, 0.5, 0.1
READ_S = tuple(0.01 * tick for tick in range(15, 35))
JUDGED = READ_S.index(0.32)
WARM_UP = 12
VALID, BOUND = "valid", "lower_bound"
IN_REGION = 5.991  # chi-squared of two degrees of freedom, 95 %
COLUMNS = ("force_n", "lost", "located", "inside", "force valid", "bound", "true")


def draw_presses(links: list[str], count: int, seed: int) -> tuple[ScenarioTouch, ...]:
    """Return `count` presses of each pad, one after the other; every other one is firm."""
    rng = np.random.default_rng((seed, 17))
    ends = np.log([BANDS_N[0], FIRM_N])
    return tuple(
        ScenarioTouch(
            link=link,
            from_s=REST_S + number * STEP_S,
            duration_s=PRESS_S,
            ramp_s=RAMP_S,
            path=(tuple(rng.uniform(0.02, 0.98, 2)),),
            force_n=(float(np.exp(rng.uniform(*ends)) if number % 2 else rng.uniform(FIRM_N, BANDS_N[-1])),),
        )
        for number in range(count)
        for link in links
    )


def play(task: tuple[int, int]) -> tuple[FloatArray, NDArray[np.str_]]:
    """Return columns (n, COLUMNS) of the presses of a hand, and their pads: number, presses of each pad."""
    number, count = task
    drawn = WORLDS["default"].draw(Family.REPORTING.seed(number))
    deployment = drawn.describe(load(shipped.path("utah_mit.toml")))
    daemon = deployment.daemon.model_copy(update={"sync_period_ms": PERIOD_MS})
    deployment = deployment.model_copy(update={"daemon": daemon})
    model = build_pad_model(deployment)
    hand = VirtualHand(deployment, Scenario(touch=draw_presses(model.links, count, drawn.seed)), drawn)
    times_s = 1e-3 * PERIOD_MS * np.arange(round((REST_S + count * STEP_S) / (1e-3 * PERIOD_MS)))
    counts = np.stack([hand.counts(row, times_s) for row in range(model.size)], axis=1)
    ticks = {
        round((REST_S + k * STEP_S + at_s) / (1e-3 * PERIOD_MS)): len(READ_S) * k + step
        for k in range(count)
        for step, at_s in enumerate(READ_S)
    }
    contacts = serve(model, deployment, counts, ticks)
    rows, pads = [], []
    for tick, key in ticks.items():
        if key % len(READ_S) != JUDGED or key < WARM_UP * len(READ_S):
            continue
        for truth in hand.truth(float(times_s[tick])):
            found = [contacts.get((key - JUDGED + step, truth.link)) for step in range(len(READ_S))]
            rows.append(columns_of(found, truth))
            pads.append(f"{number}/{truth.link}")
    return np.array(rows, dtype=np.float64), np.array(pads)


def columns_of(found: list[wire.Contact | None], truth: GroundTruth) -> tuple[float, ...]:
    """Return the COLUMNS of a press: its contact at READ_S, and its truth at the judged one."""
    judged = found[JUDGED]
    known = [one for one in found if one and one.position_m is not None and one.force_n is not None]
    lost = len(known) < len(found) or len({one.id for one in known}) > 1
    with_mounts = judged and replace(judged, mount_covariance_m2=None)  # they are drawn here
    error, covariance = position_error(with_mounts, truth)
    located = bool(np.isfinite(error).all())
    inside = located and bool(error @ np.linalg.solve(covariance, error) < IN_REGION)
    valid = judged is not None and judged.force_status == VALID and judged.force_std_n is not None
    bound = judged is not None and judged.force_status == BOUND
    true = False
    if judged is not None and judged.force_n is not None:
        off_n = judged.force_n - truth.force_n
        true = abs(off_n) < 1.96 * (judged.force_std_n or 0.0) if valid else bound and off_n < 0
    return truth.force_n, lost, located, inside, valid, bound, true


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--hands", type=int, default=8)
    parser.add_argument("--presses", type=int, default=124, help="of each pad of a hand; 12 come first")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    asked = parser.parse_args()
    if asked.quick:
        asked.hands, asked.presses = 1, WARM_UP + 8
    tasks = [(number, asked.presses) for number in range(asked.hands)]
    with ProcessPoolExecutor(asked.processes) as pool:
        made = []
        for task, result in zip(tasks, pool.map(play, tasks), strict=True):
            progress(f"hand {task[0] + 1}")
            made.append(result)
    values, pads = (np.concatenate(parts) for parts in zip(*made, strict=True))
    column = dict(zip(COLUMNS, values.T, strict=True))
    limits = [*itertools.pairwise(BANDS_N), (BANDS_N[1], BANDS_N[-1])]
    rows = []
    for low, high in limits:
        of_row = (column["force_n"] >= 0.99 * low) & (column["force_n"] <= high)
        located = of_row & (column["located"] > 0)
        stated = of_row & (column["force valid"] + column["bound"] > 0)
        rows.append(
            {
                "force": f"{low:g} to {high:g} N",
                "presses": int(of_row.sum()),
                "ended or unknown": int(column["lost"][of_row].sum()),
                "position valid, %": 100 * column["located"][of_row].mean(),
                "valid positions in 95 %": ClusterShare.of_mask(column["inside"][located] > 0, pads[located]),
                "force valid, %": 100 * column["force valid"][of_row].mean(),
                "lower bound, %": 100 * column["bound"][of_row].mean(),
                "interval or bound true": ClusterShare.of_mask(column["true"][stated] > 0, pads[stated]),
            }
        )
    report = Report(asked.quick, hands=asked.hands, presses_of_a_pad=asked.presses)
    report.table("Presses", rows)
    every = rows[-1]
    report.limit("presses whose contact ended or lost a number", every["ended or unknown"], 0)
    true = 100 * every["interval or bound true"].value
    report.limit("interval or bound true", true, 95.0, "%", at_least=True)
    report.keep()


if __name__ == "__main__":
    main()
