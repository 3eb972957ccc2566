"""Diagnosis of faults beyond the episodes of bench_diagnose: gum on S1 and S2, several faults at once, loose
electrodes, drift, series resistors, small and long pads, mended faults; reliability of stated confidences.

Hands are drawn for the reporting family. Prints its tables and writes
docs/benchmarks/diagnose_cases.{md,json,png}. `--quick` plays one episode of each case; `--journal FILE` keeps
what was played: an interrupted run continues from it.
"""

from __future__ import annotations

import json
import multiprocessing
import os

from benchmarks.page import made_by, options, output_folder, progress, table

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy: matrices are small, workers many

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from benchmarks.diagnose_cases import (
    CASES,
    DRYING_S,
    HAND_EPISODES,
    MENDED_S,
    SERIES_OHM,
    SETTLED_S,
    hides,
    matches,
    play_case,
)
from benchmarks.scores import Share, score_events
from handtouch.supervisor.diagnose.static_load import MIN_LOAD_COUNTS
from handtouch.wire.faults import FaultKind

matplotlib.use("Agg")
from matplotlib import pyplot as plt

Episode = dict[str, Any]
CONFIDENCES = (0.0, 0.7, 0.9, 0.97, 0.99, 0.999, 1.0)
GUM_MM = 3.0
"""Bound of the distance of gum from where it is."""


def play_all(workers: int, journal: Path | None, share: float) -> list[Episode]:
    """Play a share of the episodes of each case; results in a journal aren't computed again."""
    lines = journal.read_text().splitlines() if journal and journal.exists() else []
    found: list[Episode] = [json.loads(line) for line in lines]
    done = {(it["case"], it["name"], it["number"]) for it in found}
    tasks = [
        (not case.name.endswith("centre lines"), number // HAND_EPISODES, index, name, number)
        for index, case in enumerate(CASES)
        for name, number in case.episodes[: max(1, round(share * len(case.episodes)))]
        if (case.name, name, number) not in done
    ]
    tasks = sorted(tasks)  # cases side by side, hand by hand, so that a journal has some of each
    with multiprocessing.get_context("fork").Pool(workers) as pool:
        for number, result in enumerate(
            pool.imap_unordered(play_case, [task[2:] for task in tasks], chunksize=1), 1
        ):
            found.append(result)
            if journal:
                with journal.open("a") as file:
                    file.write(json.dumps(result) + "\n")
            if number % 40 == 0 or number == len(tasks):
                progress(f"{number} of {len(tasks)} episodes, {result['case']}")
    order = [case.name for case in CASES]
    return sorted(found, key=lambda it: (order.index(it["case"]), it["number"], it["name"]))


def of_case(episodes: Sequence[Episode], case: str) -> list[Episode]:
    return [it for it in episodes if it["case"] == case]


def is_right(episode: Episode, one: dict[str, Any]) -> bool:
    """Return whether a diagnosis names a fault that was played, on its pad, after it began."""
    return any(matches(event, one) for event in episode["events"])


def row(episodes: Sequence[Episode], **names: str) -> dict[str, Any]:
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
        "unexplained, %": str(Share.of_mask(np.array(unexplained))),
        "false alarms": ", ".join(f"{kind} {count}" for kind, count in wrong.most_common(4)),
    }


def pair_rows(episodes: Sequence[Episode]) -> list[dict[str, Any]]:
    """Return a row of the pairs of faults that are observable side by side, and of the others."""
    some = of_case(episodes, "two faults on one pad")
    kinds = {"each observable beside the other": False, "one hides the other": True}
    split = {label: [it for it in some if hides(it["events"]) == hidden] for label, hidden in kinds.items()}
    return [row(part, pairs=label) for label, part in split.items() if part]


def gum_rows(episodes: Sequence[Episode]) -> list[dict[str, Any]]:
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
                "named, %": str(Share.of_mask(np.array([bool(ones) for ones in named]))),
                f"named and within {GUM_MM:g} mm, %": str(Share.of_mask(np.array(near))),
                "error, median, mm": float(np.median(off)) if len(off) else np.nan,
                "95 %": float(np.quantile(off, 0.95)) if len(off) else np.nan,
                "greatest": float(off.max()) if len(off) else np.nan,
            }
        )
    return rows


def end_rows(episodes: Sequence[Episode]) -> list[dict[str, Any]]:
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
                "ended, %": str(Share.of_mask(ended)),
                "time to the end, median, s": float(np.median(times)) if len(times) else np.nan,
                "greatest, s": float(times[-1]) if len(times) else np.nan,
            }
        )
    return rows


def shorted_rows(episodes: Sequence[Episode]) -> list[dict[str, Any]]:
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
        rows.append({"reported": label, "runs": len(some), "runs with it": share.count, "%": str(share)})
    return rows


def stated(episodes: Sequence[Episode]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return stated confidence and whether it was right (n, 2) of all diagnoses, `unexplained` aside."""
    return np.array(
        [
            (one["confidence"], is_right(it, one))
            for it in episodes
            for one in it["found"]
            if one["kind"] != FaultKind.UNEXPLAINED
        ],
        np.float64,
    ).reshape(-1, 2)


def reliability(episodes: Sequence[Episode]) -> list[dict[str, Any]]:
    """Return how often diagnoses were right, by stated confidence."""
    rows, every = [], stated(episodes)
    for low, high in (*pairwise(CONFIDENCES), (0.0, 1.0)):
        here = every[(every[:, 0] > low) & (every[:, 0] <= high)]
        if len(here):
            rows.append(
                {
                    "stated": "all" if (low, high) == (0.0, 1.0) else f"{low:g} to {high:g}",
                    "diagnoses": len(here),
                    "mean stated, %": 100 * here[:, 0].mean(),
                    "right, %": str(Share.of_mask(here[:, 1] > 0)),
                }
            )
    return rows


def draw(path: Path, episodes: Sequence[Episode]) -> None:
    """Draw stated against observed confidence, with intervals, and errors of gum by sheet."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 5), layout="constrained")
    every = stated(episodes)
    left.plot([0.5, 1], [0.5, 1], color="#8a8a8a", lw=0.8)
    for low, high in pairwise(CONFIDENCES):
        here = every[(every[:, 0] > low) & (every[:, 0] <= high)]
        if len(here):
            share = Share.of_mask(here[:, 1] > 0)
            limits = np.abs(np.array(share.interval) - share.value)[:, None]
            left.errorbar(here[:, 0].mean(), share.value, limits, fmt="o", color="#1f6fb4", capsize=3)
            at = here[:, 0].mean(), share.value
            left.annotate(str(len(here)), at, (6, -12), textcoords="offset points")
    left.set(
        xlabel="stated confidence, mean of a bin", ylabel="share of right diagnoses", title="Reliability"
    )
    left.set_ylim(0, 1.03)
    for case, colour in (("gum, sheets S1", "#1f6fb4"), ("gum, sheets S2", "#c23b22")):
        found = [one for it in of_case(episodes, case) for one in it["found"]]
        off = sorted(one["off_mm"] for one in found if one["off_mm"] is not None)
        right.step(off, np.arange(1, len(off) + 1), where="post", color=colour, label=case.split()[-1])
    right.axvline(GUM_MM, color="#8a8a8a", lw=0.8)
    right.set(xlabel="distance of gum from where it is, mm", ylabel="episodes", title="Gum", xlim=(0, None))
    right.legend(frameon=False)
    figure.savefig(path, dpi=90)
    plt.close(figure)


HEAD = f"""\
Use of three pads of the shipped hand, as in the [episodes](diagnose.md), in the world `default` of
[worlds](../worlds.md) unless stated; hands drawn for seeds of the reporting family. Each case has changed
what it names: pads or sheets, which the deployment file describes, drift, or the faults. 110 s at 100 Hz;
an episode ends {SETTLED_S:g} s after all its faults were named, if there was no wrong diagnosis. *Long* and
*small* pads are plane. *Series resistors*: {SERIES_OHM[0]:g} to {SERIES_OHM[1]:g} ohm at each electrode; two
electrodes shorted to one another are among the faults. *Loose electrode*: one that is open and connected in
turn, each for 0.1 to 3 s; `dead_electrode` is right. *Two faults*: of different kinds, 10 s one after the
other."""
NOTES = {
    "By case": "Recall, precision and false alarms as in [diagnose](diagnose.md), with 95 % intervals "
    "(Clopper and Pearson, Poisson); an event is a fault.",
    "Two faults on one pad": "A contact has three unknowns and four currents. Faults that show in contacts "
    "need all channels: one that is stuck, saturated, shorted or dead hides swapped cables, gains, torn "
    "corners and dead electrodes. The current of a short to the layer hides gum, moisture and offsets.",
    "Gum on S1 and S2": "Error: from `pad_m` at its first diagnosis to the middle of the gum.",
    "Healthy pads touched along a centre line": "Presses and slow strokes along one line midway between "
    "opposite electrodes of pads with series resistors. Both read the same there, which is no evidence that "
    "they are shorted.",
    "Mended faults": f"Faults that end {MENDED_S:g} s after they began, in use for up to 6 more minutes. "
    "Those of single channels and static loads end by themselves, those of contacts after 20 of them. "
    f"Moisture dries, with a time constant of {DRYING_S:g} s: its diagnosis ends when its leak is below "
    f"{MIN_LOAD_COUNTS:g} counts.",
    "Reliability of the stated confidence": "All diagnoses above, `unexplained` aside; right: a fault that "
    "was played, on its pad, after it began.",
}


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument(
        "--share", type=float, default=0.5, help="of the episodes that are played (default: 0.5)"
    )
    parser.add_argument("--journal", type=Path, help="file to keep results in")
    asked = parser.parse_args()
    episodes = play_all(asked.workers, asked.journal, 0.0 if asked.quick else asked.share)
    tables = {
        "By case": [row(of_case(episodes, case.name), case=case.name) for case in CASES],
        "Two faults on one pad": pair_rows(episodes),
        "Gum on S1 and S2": gum_rows(episodes),
        "Healthy pads touched along a centre line": shorted_rows(episodes),
        "Mended faults": end_rows(episodes),
        "Reliability of the stated confidence": reliability(episodes),
    }
    lines = [line for title, rows in tables.items() for line in table(title, NOTES[title], rows)]
    out = output_folder(asked.quick)
    draw(out / "diagnose_cases.png", episodes)
    head = ["# Diagnosis in more cases", "", f"{made_by()}.", "", HEAD, ""]
    (out / "diagnose_cases.md").write_text(
        "\n".join([*head, "![reliability of confidences, location of gum](diagnose_cases.png)", "", *lines])
    )
    wrong = [it for it in episodes if it["events"] and not all(
        any((event["kind"], event["link"]) == (one["kind"], one["link"]) for one in it["found"])
        for event in it["events"]
    )]  # fmt: skip
    record = {"tables": tables, "misses": wrong}
    (out / "diagnose_cases.json").write_text(json.dumps(record, indent=1).replace("NaN", "null") + "\n")


if __name__ == "__main__":
    main()
