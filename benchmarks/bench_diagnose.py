"""Diagnosis of faults of pads, in the worlds `ideal`, `default` and `harsh`: recall, precision, delay, cost.

Episodes of a small hand in use, with and without a fault, on hands drawn for the reporting family. Prints its
tables and writes docs/benchmarks/diagnose.{md,json,png}. `--quick` plays one episode of each name;
`--episodes N` says how many of each fault in each world; `--journal FILE` keeps what was played: an
interrupted run continues from it.
"""

from __future__ import annotations

import json
import multiprocessing
import os

from benchmarks.page import made_by, options, output_folder, progress, table

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy: matrices are small, workers many

import platform
import time
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from benchmarks.diagnose_episodes import (
    EPISODES_OF_HAND,
    FAULT_FREE,
    FAULTY,
    LENGTH_S,
    PADS,
    Episode,
    episode,
    hand_of,
)
from benchmarks.scores import EventScore, Share, score_events
from handtouch import config
from handtouch.config import shipped
from handtouch.simulate.worlds import WORLDS
from handtouch.supervisor.diagnose import DiagnosisModel, HandDiagnostics, HandSamples
from handtouch.wire.faults import FaultKind

matplotlib.use("Agg")
from matplotlib import pyplot as plt

NAMES = (*FAULTY, *FAULT_FREE)
IDEAL_SHARE = 0.4
FAULT_FREE_SHARE = 0.4
"""Episodes of each use without a fault, of those of each fault: soak_alarms plays hours of it."""
NOTHING = "nothing"
FIRST_SEED = 2000
"""Of the use that is played; thresholds were tuned on seeds below 1100."""
SETTLED_S = 15.0
"""Time from the naming of a fault to the end of its episode, without a wrong diagnosis."""
Detected = tuple[str, str, float, float]
"""A diagnosis: link, kind, time [s], stated confidence."""
CONFIDENCES = (0.0, 0.7, 0.9, 0.97, 0.99, 0.999, 1.0)
_TABLES: dict[Any, Any] = {}
_MODELS: dict[tuple[str, int], DiagnosisModel] = {}


def play(task: tuple[str, str, int]) -> dict[str, Any]:
    """Play one episode of a world, name and seed; return its fault and all diagnoses with their times."""
    world, name, seed = task
    it = episode(name, seed, WORLDS[world])
    key = world, hand_of(seed)
    if key not in _MODELS:
        _MODELS[key] = DiagnosisModel.from_deployment(it.deployment, "right")
    diagnosis = HandDiagnostics(_MODELS[key], tables=_TABLES)
    truth = FAULTY[name].value if name in FAULTY else NOTHING
    detected: list[Detected] = []
    t_s, named_s = 0.0, None
    for block in it.blocks():
        t_s = float(block.sample_ns.max()) * 1e-9
        for fault in diagnosis.process_block(block):
            if not fault.is_fault or fault.until_ns is not None:
                continue
            detected.append((fault.link, fault.kind.value, t_s, fault.published.confidence))
            if is_right(it, truth, detected[-1]) and named_s is None:
                named_s = t_s
        named = [one for one in detected if one[1] != FaultKind.UNEXPLAINED]
        wrong = [one for one in named if not is_right(it, truth, one)]
        if named_s is not None and t_s > named_s + SETTLED_S and not wrong:
            break
    return {
        "world": world, "name": name, "seed": seed, "truth": truth, "link": it.link, "begin_s": it.begin_s,
        "detected": detected, "hours": t_s * len(PADS) / 3600,
        "details": it.details if name in FAULTY else {},
    }  # fmt: skip


def is_right(it: Episode, truth: str, found: Detected) -> bool:
    """Return whether a diagnosis names the played fault on its pad, after it began."""
    link, kind, at_s, _ = found
    return kind == truth and link == it.link and at_s >= it.begin_s


def episode_count(world: str, count: int) -> int:
    """Return the number of episodes of each fault in a world, for `count` in `default`; of exact parts, fewer
    tell as much."""
    return max(1, round(IDEAL_SHARE * count)) if world == "ideal" else count


def fault_free_count(count: int) -> int:
    """Return the number of episodes of each use without a fault, for `count` of each fault."""
    return max(1, round(FAULT_FREE_SHARE * count))


def run(count: int, workers: int, journal: Path | None) -> list[dict[str, Any]]:
    """Play all episodes, seed by seed; results in a journal aren't computed again."""
    lines = journal.read_text().splitlines() if journal and journal.exists() else []
    every = [
        (world, name, seed)
        for seed in range(FIRST_SEED, FIRST_SEED + count)
        for world in WORLDS
        for name in NAMES
        if seed < FIRST_SEED + (episode_count(world, count) if name in FAULTY else fault_free_count(count))
    ]
    requested = {*every}
    found = [r for r in map(json.loads, lines) if (r["world"], r["name"], r["seed"]) in requested]
    done = {(r["world"], r["name"], r["seed"]) for r in found}
    tasks = [task for task in every if task not in done]
    with multiprocessing.get_context("fork").Pool(workers) as pool:
        for number, result in enumerate(pool.imap_unordered(play, tasks, chunksize=1), 1):
            found.append(result)
            if journal:
                with journal.open("a") as file:
                    file.write(json.dumps(result) + "\n")
            if number % (3 * len(NAMES)) == 0 or number == len(tasks):
                progress(f"{len(found)} of {len(every)} episodes")
    return sorted(found, key=lambda r: (*WORLDS,).index(r["world"]))


def events(results: Sequence[dict[str, Any]]) -> EventScore:
    """Score named faults; a diagnosis `unexplained` is neither right nor a false alarm."""
    truth, detected = [], []
    for number, r in enumerate(results):
        if r["truth"] != NOTHING:
            truth.append(((number, r["link"], r["truth"]), r["begin_s"]))
        for link, kind, at_s, _ in r["detected"]:
            if kind != FaultKind.UNEXPLAINED:
                detected.append(((number, link, kind), at_s))
    return score_events(truth, detected, hours=sum(r["hours"] for r in results), late_s=LENGTH_S)


def last_diagnosis(r: dict[str, Any]) -> str:
    """Return the last diagnosis of the pad with the fault; of any pad if there is no fault."""
    kinds = [kind for link, kind, *_ in r["detected"] if r["truth"] == NOTHING or link == r["link"]]
    return kinds[-1] if kinds else NOTHING


def row(results: Sequence[dict[str, Any]], **names: str) -> dict[str, Any]:
    """Return a row of events, with the share of episodes that were left unexplained."""
    doubt = [any(kind == FaultKind.UNEXPLAINED for _, kind, *_ in r["detected"]) for r in results]
    wrong = Counter(
        kind
        for r in results
        for kind in {kind for _, kind, *_ in r["detected"]} - {r["truth"], FaultKind.UNEXPLAINED.value}
    )
    score = events(results)
    return {
        **names,
        "episodes": len(results),
        **score.row(),
        "unexplained, %": str(Share.of_mask(np.array(doubt))),
        "false alarms": ", ".join(f"{kind} {count}" for kind, count in wrong.most_common(3)),
    }


def reliability(results: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return how often named faults were right, by stated confidence: one row for each world and bin."""
    rows = []
    for world in WORLDS:
        stated = np.array([
            (confidence, kind == r["truth"] and link == r["link"] and at_s >= r["begin_s"])
            for r in chosen(results, world, NAMES)
            for link, kind, at_s, confidence in r["detected"]
            if kind != FaultKind.UNEXPLAINED
        ]).reshape(-1, 2)  # fmt: skip
        for low, high in pairwise(CONFIDENCES):
            here = stated[(stated[:, 0] > low) & (stated[:, 0] <= high)]
            if len(here):
                rows.append({
                    "world": world, "stated": f"{low:g} to {high:g}", "diagnoses": len(here),
                    "mean stated, %": 100 * here[:, 0].mean(),
                    "right, %": str(Share.of_mask(here[:, 1] > 0)),
                })  # fmt: skip
    return rows


def chosen(results: Sequence[dict[str, Any]], world: str, names: Sequence[str]) -> list[dict[str, Any]]:
    return [r for r in results if r["world"] == world and r["name"] in names]


def cost() -> list[dict[str, Any]]:
    """Share of a core for 15 pads at 200 Hz: half a minute of plain use on every pad."""
    model = DiagnosisModel.from_deployment(config.load(shipped.path("utah_mit.toml")), "right")
    blocks = list(episode("plain use", 1, WORLDS["ideal"]).blocks(30.0))
    diagnosis, pads, spent = HandDiagnostics(model), len(model.links), []
    for number in range(2):  # tables are made in the first round
        spent.append(0.0)
        for block in blocks:
            counts = np.tile(block.counts, (1, pads // len(PADS), 1)).repeat(2, axis=0)
            t = block.sample_ns[:, :1] + number * 30_000_000_000
            stamps = np.repeat(np.repeat(t, 2, axis=0), pads, axis=1)
            start = time.process_time()
            diagnosis.process_block(HandSamples(stamps, counts, np.ones(stamps.shape, np.bool_)))
            spent[-1] += time.process_time() - start
    return [{"round": k + 1, "share of a core, %": 100 * s / 30.0} for k, s in enumerate(spent)]


def draw(path: Path, results: Sequence[dict[str, Any]]) -> None:
    """Draw the confusion matrices of faults and last diagnoses, one for each world."""
    diagnoses = [*dict.fromkeys(kind.value for kind in FAULTY.values())]
    diagnoses = [*diagnoses, FaultKind.COMMON_DRIFT.value, FaultKind.UNEXPLAINED.value, NOTHING]
    figure, panels = plt.subplots(1, len(WORLDS), figsize=(22, 8.5), layout="constrained", sharey=True)
    for axes, world in zip(panels, WORLDS, strict=True):
        share = np.zeros((len(NAMES), len(diagnoses)))
        for r in chosen(results, world, NAMES):
            share[NAMES.index(r["name"]), diagnoses.index(last_diagnosis(r))] += 1
        share *= 100 / np.maximum(share.sum(axis=1, keepdims=True), 1)
        axes.imshow(np.sqrt(share), cmap="Blues", vmin=0, vmax=14)
        for (y, x), value in np.ndenumerate(share):
            if value:
                text = f"{value:.0f}" if value >= 1 else f"{value:.1f}"
                axes.text(x, y, text, ha="center", va="center", color="white" if value > 50 else "black")
        axes.set_xticks(range(len(diagnoses)), diagnoses, rotation=40, ha="right")
        axes.set_yticks(range(len(NAMES)), NAMES)
        axes.axhline(len(FAULTY) - 0.5, color="black", lw=0.8)
        axes.set(xlabel="diagnosis at the end of the episode", title=f"world {world}: % of each row")
    panels[0].set_ylabel("fault played")
    figure.savefig(path, dpi=80)
    plt.close(figure)


NOTE = (
    "Recall: the right kind was diagnosed on the right pad, within the episode; precision: of all diagnoses "
    "of any pad, except repeated ones and `unexplained`. False alarms per hour of one pad. Shares and rates "
    "with 95 % intervals (Clopper and Pearson, Poisson)."
)
HEAD = """\
{count} episodes of each fault in each [world](../worlds.md), {ideal} in `ideal`, and {fault_free} of each use
without one, {length:g} s on three pads of the shipped hand at 100 Hz: seeds of the reporting family, another
hand every {share} episodes, {hands} of `default`. One pad has a fault while all are in use. An episode ends
{settled:g} s after its fault was named, if there was no wrong diagnosis. The deployment file describes sheets
as their builder would; all that the world draws is hidden from the diagnosis. Left out as not observable:
cables of opposite electrodes swapped, which mirrors the pad, and short circuits between electrodes without
series resistors. Hours of a healthy hand are in [alarms](alarms.md)."""


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--episodes", type=int, default=25, help="of each fault in each world")
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--journal", type=Path, help="file to keep results in")
    asked = parser.parse_args()
    count = 1 if asked.quick else asked.episodes
    results = run(count, asked.workers, asked.journal)
    tables = {
        "By world": (
            NOTE,
            [
                row(chosen(results, world, names), world=world, of=label)
                for world in WORLDS
                for label, names in (("faults", (*FAULTY,)), ("use without a fault", FAULT_FREE))
            ],
        ),
        **{
            f"World {world}": ("", [row(chosen(results, world, (name,)), played=name) for name in NAMES])
            for world in WORLDS
        },
        "Reliability of the stated confidence": (
            "Every diagnosis of a fault that began or changed, `unexplained` aside; right: the kind that was "
            "played, on its pad, after it began.",
            reliability(results),
        ),
        "Cost": ("15 pads at 200 Hz, all in use; tables are made in the first round.", cost()),
    }
    page = [line for title, (note, rows) in tables.items() for line in table(title, note, rows)]
    machine = (
        f"{os.cpu_count()} x {platform.machine()}, Python {platform.python_version()}, numpy {np.__version__}"
    )
    head = HEAD.format(
        count=count,
        ideal=episode_count("ideal", count),
        fault_free=fault_free_count(count),
        length=LENGTH_S,
        settled=SETTLED_S,
        hands=len({hand_of(r["seed"]) for r in results}),
        share=EPISODES_OF_HAND,
    )
    out = output_folder(asked.quick)
    draw(out / "diagnose.png", results)
    lines = ["# Diagnosis of faults", "", f"{made_by()}; {machine}.", "", head, ""]
    (out / "diagnose.md").write_text("\n".join([*lines, "![confusion](diagnose.png)", "", *page]))
    misses = [
        {key: r[key] for key in ("world", "name", "seed", "detected", "details")}
        for r in results
        if last_diagnosis(r) != r["truth"]
    ]
    record = {"machine": machine, "tables": {t: rows for t, (_, rows) in tables.items()}, "misses": misses}
    (out / "diagnose.json").write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
