"""Force over a day on sheets that creep and adapt, in mixed use, in `default` and `harsh`.

Sheets of each [kind](../worlds.md#kinds-of-sheets) of the reporting family: grips of 2 to 40 s, some of
minutes, half of them waxing and waning, and breaks of 5 to 60 minutes. Columns as in
[supervise](supervise.md#mixed-use-of-sheets): one reading of each contact, at a random age; errors rms of
valid forces; *ratio*: compensated over uncompensated; *in 95 %*: share of readings within the stated
interval, also with the scatter between pads; *nothing learned*: same seeds, creep and adaptation of the file
instead of learned ones.
"""

from __future__ import annotations

import os

from benchmarks.page import Report, options, progress

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy: matrices are small, workers many

from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np

from benchmarks.scores import Estimates, slices
from benchmarks.sheet_use import COMPLETE, FULL_N, PADS, SEEDS, UNLEARNED, force_row, rms, used
from handtouch.simulate.worlds import WORLDS, Family, SheetKind

PARTS = (("default", COMPLETE), ("default", UNLEARNED), ("harsh", COMPLETE))
PART_OF_DAY_H = 6.0
MIN_COVERED, MAX_COVERED = 93.0, 97.0
"""Share in % of readings within 95 % intervals in `default` that passes."""
MIN_COVERED_HARSH, MAX_RATIO_HARSH = 85.0, 1.1
"""Of each kind of sheet in `harsh`: the same share, and compensated over uncompensated."""


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


def compare(report: Report, found: dict[tuple[str, str], Estimates]) -> None:
    """Compare a day with its goals, of all sheets of the world or of each kind."""

    def state(some: Estimates) -> tuple[float, float, float]:
        good = some.where(some.valid)
        error = rms(good.error)
        return (
            error,
            error / rms(good.columns["uncompensated"]),
            100 * float((good.distances() <= 1.96).mean()),
        )

    error, _, covered = state(found["default", COMPLETE])
    kinds = {name: state(some) for name, some in slices(found["harsh", COMPLETE], "kind")}
    worst, least = max(kinds, key=lambda k: kinds[k][1]), min(kinds, key=lambda k: kinds[k][2])
    report.limit(
        "default: rms, to that with nothing learned", error, state(found["default", UNLEARNED])[0], "N"
    )
    report.limit("default: within 95 % intervals", covered, MIN_COVERED, "%", at_least=True)
    report.limit("default: within 95 % intervals", covered, MAX_COVERED, "%")
    report.limit(
        f"harsh, every kind ({worst}): over the uncompensated error", kinds[worst][1], MAX_RATIO_HARSH
    )
    covered = kinds[least][2]
    report.limit(
        f"harsh, every kind ({least}): within intervals", covered, MIN_COVERED_HARSH, "%", at_least=True
    )


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--hours", type=float, default=24.0, help="of mixed use (default: 24)")
    asked = parser.parse_args()
    hours, pads, seeds = (0.25, 2, SEEDS[:1]) if asked.quick else (asked.hours, PADS, SEEDS)
    with ProcessPoolExecutor(os.cpu_count() or 1) as pool:
        running = {
            (world, part): pool.submit(used, world, part, hours, seeds, pads, own_kinds(world))
            for world, part in PARTS
        }
        found = {}
        for key, future in running.items():
            found[key] = future.result()
            progress(f"sheets of {key[0]}, {key[1] or 'complete'}: {len(found[key])} contacts")
    report = Report(
        asked.quick, hours=hours, sheets_of_a_kind=pads, seeds=len(seeds), greatest_force_n=FULL_N
    )
    report.table("Forces", rows_of(found))
    compare(report, found)
    report.keep()


if __name__ == "__main__":
    main()
