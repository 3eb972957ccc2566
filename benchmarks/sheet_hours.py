"""Force errors of sheets in hours of mixed use, by kind, for bench_supervise and soak_sheets.

Public names: `used`, `kinds_of`, `of_kinds`, `force_row`, `rms`; `PADS`, `SEEDS`; `CUTS`, `COMPLETE`,
`UNLEARNED`, parts of the compensation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.scores import ClusterShare, Estimates, Share
from benchmarks.sheet_use import drawn_sheets, score_use
from handtouch.simulate.worlds import SHEET_KINDS, WORLDS, Family, SheetKind

FloatArray = NDArray[np.float64]
PADS, SEEDS = 8, (31, 32)
"""Sheets of each kind, and seeds of worlds and use."""
CUTS: dict[str, dict[str, Any]] = {
    "no adaptation compensation": {"adaptation_share": 0.0},
    "no creep compensation": {"creep_share": 0.0},
    "no parameter uncertainty": {"parameter_std_fraction": 0.0},
}
"""Changes of what the deployment file states."""
COMPLETE, UNLEARNED = "", "nothing learned"
PAPER = ("S1", "S2")


def kinds_of(world: str) -> tuple[SheetKind, ...]:
    """Return the kinds of sheets that are measured in a world, those of the paper among them."""
    kinds = () if world == "harsh" else tuple(SHEET_KINDS[name] for name in PAPER)
    return (*WORLDS[world].sheets.kinds(Family.REPORTING), *kinds)


def used(
    world: str, part: str, hours: float, seeds: Sequence[int], pads: int, kinds: Sequence[SheetKind] = ()
) -> Estimates:
    """Return force errors of kinds of sheets of a world, by default all, without a part of the compensation.

    `pads` sheets of each kind and seed are used side by side, by the first seed.
    """
    drawn = [WORLDS[world].draw(Family.REPORTING.seed(seed)) for seed in seeds]
    sheets = [drawn_sheets(one, kind, pads) for one in drawn for kind in kinds or kinds_of(world)]
    if part in CUTS:
        sheets = [replace(some, behaviour=some.behaviour.model_copy(update=CUTS[part])) for some in sheets]
    return score_use([replace(some, learns=part != UNLEARNED) for some in sheets], hours, drawn[0].seed)


def of_kinds(world: str, every: Estimates) -> Estimates:
    """Return the rows of the world's own kinds."""
    own = [kind.name for kind in WORLDS[world].sheets.kinds(Family.REPORTING)]
    return every.where(np.isin(every.columns["kind"], own or PAPER))


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else math.nan


def force_row(some: Estimates, **names: str) -> dict[str, Any]:
    """Return a row of a table: forces with and without compensation."""
    good = some.where(some.valid)
    inside = good.distances() <= 1.96
    raw, error = rms(good.columns["uncompensated"]), rms(good.error)
    pads = good.columns["pad"]
    return {
        **names,
        "touches": len(some),
        "pads": len(np.unique(some.columns["pad"])),
        "uncompensated, N": raw,
        "compensated, N": error,
        "ratio": f"{error / raw:.2f}",
        "in 95 %": str(Share.of_mask(inside)),
        "by pad": str(ClusterShare.of_mask(inside, pads)) if len(np.unique(pads)) > 1 else "-",
        "median width, N": 2 * 1.96 * float(np.median(np.sqrt(good.covariance))) if len(good) else math.nan,
        "valid, %": f"{100 * some.valid.mean():.1f}" if len(some) else "-",
    }
