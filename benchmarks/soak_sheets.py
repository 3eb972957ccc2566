"""Measure force on sheets that creep and adapt over a day of mixed use, in `default` and `harsh`.

Sheets, use and comparisons are those of bench_supervise, whose table of some hours is for every run of the
benchmarks. Seeds of the reporting family. Writes docs/benchmarks/soak_sheets.{md,json}; `--quick` plays some
minutes and writes nothing.
"""

from __future__ import annotations

import json
import math
import os

from benchmarks.page import made_by, options, output_folder, progress, table

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy: matrices are small, workers many

from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from typing import Any

import numpy as np

from benchmarks.scores import Estimates, EstimateScore, slices
from benchmarks.sheet_hours import COMPLETE, PADS, SEEDS, UNLEARNED, force_row, rms, used
from benchmarks.sheet_use import FULL_N
from handtouch.simulate.worlds import WORLDS, Family, SheetKind

PARTS = (("default", COMPLETE), ("default", UNLEARNED), ("harsh", COMPLETE))
PART_OF_DAY_H = 6.0
MIN_COVERED, MAX_COVERED = 0.93, 0.97
"""Share of readings within 95 % intervals in `default` that passes."""
MIN_COVERED_HARSH, MAX_RATIO_HARSH = 0.85, 1.1
"""Of each kind of sheet in `harsh`: the same share, and compensated over uncompensated."""

NOTE = f"""\
{PADS} sheets of each [kind](../worlds.md#kinds-of-sheets) of the reporting family, {len(SEEDS)} seeds:
grips of 2 to 40 s, some of minutes, 0.1 to {FULL_N:g} N, half of them waxing and waning, and breaks of 5 to
60 minutes. Columns as in [supervise](supervise.md#mixed-use-of-sheets): one reading of each contact, at a
random age; errors rms of valid forces; *ratio*: compensated over uncompensated; *in 95 %*: share of readings
within the stated interval, also with the scatter between pads; *nothing learned*: same seeds, creep and
adaptation of the file instead of learned ones."""


def own_kinds(world: str) -> tuple[SheetKind, ...]:
    """Return the world's kinds of sheets of the reporting family."""
    return tuple(WORLDS[world].sheets.kinds(Family.REPORTING))


def rows_of(found: dict[tuple[str, str], Estimates]) -> list[dict[str, Any]]:
    """Return a row of each kind of sheet, age of a contact and part of the day, and of all, by world."""
    rows = []
    for world in dict.fromkeys(world for world, _ in PARTS):
        every, before = found[world, COMPLETE], found.get((world, UNLEARNED))
        chosen = [(kind, every.columns["kind"] == kind) for kind, _ in slices(every, "kind")]
        chosen += [(f"all, {age}", every.columns["age"] == age) for age, _ in slices(every, "age")]
        hour = every.columns["hour"]
        for low in np.arange(0, hour.max(), PART_OF_DAY_H):
            label = f"all, hours {low:g} to {low + PART_OF_DAY_H:g}"
            chosen.append((label, (hour > low) & (hour <= low + PART_OF_DAY_H)))
        for name, here in (*chosen, ("all", np.ones(len(every), np.bool_))):
            row = force_row(every.where(here), world=world, sheet=name)
            row["nothing learned, N"] = rms(before.error[here & before.valid]) if before else "-"
            rows.append(row)
    return rows


def goals(found: dict[tuple[str, str], Estimates]) -> list[dict[str, Any]]:
    """Return each goal of a day with what was measured and whether it was met."""

    def state(some: Estimates) -> tuple[float, float, float]:
        good = some.where(some.valid)
        error = rms(good.error)
        return error, error / rms(good.columns["uncompensated"]), float((good.distances() <= 1.96).mean())

    error, _, covered = state(found["default", COMPLETE])
    unlearned, _, _ = state(found["default", UNLEARNED])
    kinds = {name: state(some) for name, some in slices(found["harsh", COMPLETE], "kind")}
    worst, least = max(kinds, key=lambda k: kinds[k][1]), min(kinds, key=lambda k: kinds[k][2])
    checked = (
        (
            "default: rms below that with nothing learned",
            f"{error:.3f} of {unlearned:.3f} N", error < unlearned,
        ),
        (
            f"default: {100 * MIN_COVERED:.0f} to {100 * MAX_COVERED:.0f} % within 95 % intervals",
            f"{100 * covered:.1f} %", MIN_COVERED <= covered <= MAX_COVERED,
        ),
        (
            f"harsh, every kind: at most {MAX_RATIO_HARSH:g} times the uncompensated error",
            f"{kinds[worst][1]:.2f} ({worst})", kinds[worst][1] <= MAX_RATIO_HARSH,
        ),
        (
            f"harsh, every kind: at least {100 * MIN_COVERED_HARSH:.0f} % within 95 % intervals",
            f"{100 * kinds[least][2]:.1f} % ({least})", kinds[least][2] >= MIN_COVERED_HARSH,
        ),
    )  # fmt: skip
    return [{"goal": goal, "measured": value, "met": "yes" if met else "no"} for goal, value, met in checked]


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--hours", type=float, default=24.0, help="of mixed use (default: 24)")
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1))
    asked = parser.parse_args()
    hours, pads, seeds = (0.25, 2, SEEDS[:1]) if asked.quick else (asked.hours, PADS, SEEDS)
    with ProcessPoolExecutor(asked.workers) as pool:
        running = {
            (world, part): pool.submit(used, world, part, hours, seeds, pads, own_kinds(world))
            for world, part in PARTS
        }
        found = {}
        for key, future in running.items():
            found[key] = future.result()
            progress(f"sheets of {key[0]}, {key[1] or 'complete'}: {len(found[key])} contacts")
    tables = {"Goals": goals(found), "Forces": rows_of(found)}
    out = output_folder(asked.quick)
    lines = table("Goals", "Of all sheets of the world, or of each kind.", tables["Goals"])
    lines += table("Forces", NOTE, tables["Forces"])
    title = f"# Force over {'a day' if math.isclose(hours, 24) else f'{hours:g} h'} on sheets"
    (out / "soak_sheets.md").write_text("\n".join([title, "", f"{made_by()}.", "", *lines]))
    scores = {", ".join(key): asdict(EstimateScore.of_estimates(some)) for key, some in found.items()}
    record = json.dumps({**tables, "scores": scores}, indent=1).replace("NaN", "null")
    (out / "soak_sheets.json").write_text(record + "\n")


if __name__ == "__main__":
    main()
