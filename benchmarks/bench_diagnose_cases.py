"""Diagnosis of faults in more cases: other sheets and pads, several faults, drift, resistors, mended ones.

Use of three pads of the shipped hand, as in the [episodes](diagnose.md), in the world `default` of
[worlds](../worlds.md) unless stated; hands drawn for seeds of the reporting family. Each case has changed
what it names: pads or sheets, which the deployment file describes, drift, or the faults. 110 s at 100 Hz; an
episode ends 15 s after all its faults were named, if there was no wrong diagnosis. Recall, precision and
false alarms as there; an event is a fault. *Long* and *small* pads are plane. *Loose electrode*: one that is
open and connected in turn, each for 0.1 to 3 s; `dead_electrode` is right. *Two faults*: of different kinds,
10 s one after the other. A contact has three unknowns and four currents, so some faults hide others: one
channel that is stuck, saturated, shorted or dead hides swapped cables, gains, torn corners and dead
electrodes; the current of a short to the layer hides gum, moisture and offsets. *Gum*: error from `pad_m` at
its first diagnosis to the middle of the gum. *Centre line*: presses and slow strokes along one line midway
between opposite electrodes of pads with series resistors. *Mended*: faults that end 120 s after they began,
in use for up to 6 more minutes. *Reliability*: all diagnoses above, `unexplained` aside; right is a fault
that was played, on its pad, after it began.
"""

from __future__ import annotations

import multiprocessing
import os

from benchmarks.page import Report, Row, Rows, options, progress

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy: matrices are small, workers many

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from benchmarks.diagnose_episodes import (
    CASES,
    HAND_EPISODES,
    MENDED_S,
    SERIES_OHM,
    hides,
    matches,
    play_case,
)
from benchmarks.scores import Share, score_events
from handtouch.wire.faults import FaultKind

Episode = dict[str, Any]
CONFIDENCES = (0.0, 0.7, 0.9, 0.97, 0.99, 0.999, 1.0)
GUM_MM = 3.0
"""Bound of the distance of gum from where it is."""


def play_all(workers: int, share: float) -> list[Episode]:
    """Play a share of the episodes of each case."""
    found: list[Episode] = []
    tasks = [
        (not case.name.endswith("centre lines"), number // HAND_EPISODES, index, name, number)
        for index, case in enumerate(CASES)
        for name, number in case.episodes[: max(1, round(share * len(case.episodes)))]
    ]
    tasks = sorted(tasks)  # cases side by side, hand by hand
    with multiprocessing.get_context("fork").Pool(workers) as pool:
        for number, result in enumerate(
            pool.imap_unordered(play_case, [task[2:] for task in tasks], chunksize=1), 1
        ):
            found.append(result)
            if number % 40 == 0 or number == len(tasks):
                progress(f"{number} of {len(tasks)} episodes, {result['case']}")
    order = [case.name for case in CASES]
    return sorted(found, key=lambda it: (order.index(it["case"]), it["number"], it["name"]))


def of_case(episodes: Sequence[Episode], case: str) -> list[Episode]:
    return [it for it in episodes if it["case"] == case]


def is_right(episode: Episode, one: dict[str, Any]) -> bool:
    """Return whether a diagnosis names a fault that was played, on its pad, after it began."""
    return any(matches(event, one) for event in episode["events"])


def row(episodes: Sequence[Episode], **names: str) -> Row:
    """Return a row of events; a diagnosis `unexplained` is neither right nor a false alarm."""
    truth, detected = [], []
    for number, it in enumerate(episodes):
        truth += [((number, event["link"], event["kind"]), event["begin_s"]) for event in it["events"]]
        detected += [
            ((number, one["link"], one["kind"]), one["at_s"])
            for one in it["found"]
            if one["kind"] != FaultKind.UNEXPLAINED
        ]
    late_s = max(it["length_s"] for it in episodes)
    score = score_events(truth, detected, hours=sum(it["hours"] for it in episodes), late_s=late_s)
    unexplained = [any(one["kind"] == FaultKind.UNEXPLAINED for one in it["found"]) for it in episodes]
    wrong = Counter(
        one["kind"]
        for it in episodes
        for one in it["found"]
        if one["kind"] != FaultKind.UNEXPLAINED and not is_right(it, one)
    )
    return {
        **names,
        "episodes": len(episodes),
        **score.row(),
        "unexplained, %": Share.of_mask(np.array(unexplained)),
        "false alarms": ", ".join(f"{kind} {count}" for kind, count in wrong.most_common(4)),
    }


def pair_rows(episodes: Sequence[Episode]) -> Rows:
    """Return a row of the pairs of faults that are observable side by side, and of the others."""
    some = of_case(episodes, "two faults on one pad")
    kinds = {"each observable beside the other": False, "one hides the other": True}
    split = {label: [it for it in some if hides(it["events"]) == hidden] for label, hidden in kinds.items()}
    return [row(part, pairs=label) for label, part in split.items() if part]


def gum_rows(episodes: Sequence[Episode]) -> Rows:
    """Return recall and location error of gum by sheet."""
    rows = []
    for case in (case.name for case in CASES if case.name.startswith("gum")):
        some = of_case(episodes, case)
        named = [[one for one in it["found"] if is_right(it, one)] for it in some]
        off = np.array([ones[0]["off_mm"] for ones in named if ones and ones[0]["off_mm"] is not None])
        near = [bool(ones) and (ones[0]["off_mm"] or np.inf) <= GUM_MM for ones in named]
        rows.append(
            {
                "sheets": case.split()[-1],
                "episodes": len(some),
                "named, %": Share.of_mask(np.array([bool(ones) for ones in named])),
                f"named and within {GUM_MM:g} mm, %": Share.of_mask(np.array(near)),
                "error, median, mm": float(np.median(off)) if len(off) else np.nan,
                "95 %": float(np.quantile(off, 0.95)) if len(off) else np.nan,
                "greatest": float(off.max()) if len(off) else np.nan,
            }
        )
    return rows


def end_rows(episodes: Sequence[Episode]) -> Rows:
    """Return how many diagnoses of mended faults ended within the episode, and how soon, by kind."""
    ends: dict[str, list[float]] = {}
    for it in of_case(episodes, "mended"):
        (event,) = it["events"]
        right = [one for one in it["found"] if is_right(it, one)]
        mended_s = event["begin_s"] + MENDED_S
        if not any(one["at_s"] < mended_s for one in right):
            continue  # wasn't named before it was mended
        until = [one["until_s"] for one in right]
        after = np.inf if None in until else max(until) - mended_s
        ends.setdefault(event["name"], []).append(after)
    rows = []
    for name, after in (*ends.items(), ("all", [s for some in ends.values() for s in some])):
        ended = np.isfinite(after)
        times = np.sort(np.maximum(np.array(after)[ended], 0.0))
        rows.append(
            {
                "fault": name,
                "named before": len(after),
                "ended, %": Share.of_mask(ended),
                "time to the end, median, s": float(np.median(times)) if len(times) else np.nan,
                "greatest, s": float(times[-1]) if len(times) else np.nan,
            }
        )
    return rows


def shorted_rows(episodes: Sequence[Episode]) -> Rows:
    """Return the runs of strokes along centre lines in which anything was reported."""
    some = of_case(episodes, "series resistors, no fault, centre lines")
    rows = []
    others = {kind.value for kind in FaultKind} - {FaultKind.UNEXPLAINED.value}
    for label, kinds in (
        ("shorted_electrode", {FaultKind.SHORTED_ELECTRODE.value}),
        ("any fault, `unexplained` aside", others),
        ("unexplained", {FaultKind.UNEXPLAINED.value}),
    ):
        hit = np.array([any(one["kind"] in kinds for one in it["found"]) for it in some])
        share = Share.of_mask(hit)
        rows.append({"reported": label, "runs": len(some), "runs with it": share.count, "%": share})
    return rows


def reliability(episodes: Sequence[Episode], **names: str) -> Rows:
    """Return how often diagnoses were right, by stated confidence, `unexplained` aside."""
    every = np.array(
        [
            (one["confidence"], is_right(it, one))
            for it in episodes
            for one in it["found"]
            if one["kind"] != FaultKind.UNEXPLAINED
        ],
        np.float64,
    ).reshape(-1, 2)
    rows: Rows = []
    for low, high in (*pairwise(CONFIDENCES), (0.0, 1.0)):
        here = every[(every[:, 0] > low) & (every[:, 0] <= high)]
        if len(here):
            label = "all" if (low, high) == (0.0, 1.0) else f"{low:g} to {high:g}"
            right = Share.of_mask(here[:, 1] > 0)
            means = {"diagnoses": len(here), "mean stated, %": 100 * here[:, 0].mean(), "right, %": right}
            rows.append({**names, "stated": label, **means})
    return rows


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--share", type=float, default=0.5, help="of the episodes that are played")
    asked = parser.parse_args()
    episodes = play_all(os.cpu_count() or 1, 0.0 if asked.quick else asked.share)
    report = Report(asked.quick, share_of_the_episodes=asked.share, series_resistors_ohm=SERIES_OHM)
    report.table("By case", [row(of_case(episodes, case.name), case=case.name) for case in CASES])
    report.table("Two faults on one pad", pair_rows(episodes))
    report.table("Gum on S1 and S2", gum_rows(episodes))
    report.table("Healthy pads touched along a centre line", shorted_rows(episodes))
    report.table("Mended faults", end_rows(episodes))
    report.table("Reliability of the stated confidence", reliability(episodes))
    report.keep()


if __name__ == "__main__":
    main()
