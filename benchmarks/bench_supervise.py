"""What the fast half of the supervisor is worth and costs: baseline, and strength of sheets that misbehave.

Drift, presses and sheets are drawn with fixed seeds, others than anything was tuned with; drift is the
simulator's. The estimator is told presets, never the numbers drawn. Two processes share the work.
Writes docs/benchmarks/supervise.{md,json,png}; `--quick` tries it out in a minute and writes nothing.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

from handtouch import sheet, shipped
from handtouch.canbus.slab import Slab
from handtouch.config import Behaviour, load
from handtouch.daemon.cycle import Cycle
from handtouch.daemon.model import PadModel
from handtouch.daemon.tick import Tick
from handtouch.simulate.world import Climate, World
from handtouch.supervise.strength import SheetStrength, StrengthState, behaviour_of

matplotlib.use("Agg")
from matplotlib import pyplot as plt

FloatArray = NDArray[np.float64]
Rows = list[dict[str, Any]]
OUT = Path(__file__).parents[1] / "docs" / "benchmarks"
PERIOD_NS, TICK_NS = 100_000_000, 5_000_000
DRIFT = World(seed=71, drift_counts_per_s=0.05, warmth_k_per_s=0.01, offset_counts_per_k=2.0)
SEED = 71
SPAN_S = 60.0  # of drift that is drawn at once
HELD = 5  # pads
FULL_N = 5.0
DT_S, PADS = 0.1, 120
PART_H = 0.5  # of a day, for what is compared with it
SPREAD = 0.2
DAY = "Mixed use of real sheets"
INK, FAINT, ACCENT, RED = "#1a1a1a", "#8a8a8a", "#1f6fb4", "#c23b22"


def hands(count: int) -> PadModel:
    """The shipped hand, that often."""
    deployment = load(shipped.path("utah_mit.toml"))
    (hand,) = deployment.hands
    many = tuple(hand.model_copy(update={"name": f"hand{k}"}) for k in range(count))
    return PadModel(deployment.model_copy(update={"hands": many}))


class Rig:
    """A hand whose channels drift; currents of contacts in the middle of its pads are given in counts."""

    def __init__(self, model: PadModel, seed: int, drifts: bool) -> None:
        self.model, self.tick, self.slab = model, Tick(model, PERIOD_NS), Slab(model.size)
        self.cycle = Cycle(PERIOD_NS, 0.6)
        self._rng = np.random.default_rng(seed)
        names = list(zip(model.hands, model.links, strict=True))
        self._climate = Climate(DRIFT if drifts else World.ideal_parts(), names)
        self._zeros = np.zeros((0, model.size, 4))
        self._at = 0
        pads = np.arange(model.size)
        self.fractions = model.locator.fractions(pads, *(0.5 * model.locator.sides).T).T
        self._up = np.zeros(model.size, np.uint8)
        self.t_ns = 10**9

    def step(self, contact_counts: FloatArray) -> None:
        """A period under contacts of these sums of channels (n,)."""
        self.t_ns += PERIOD_NS
        if self._at == len(self._zeros):
            times_s = self.t_ns * 1e-9 - 1 + np.arange(0, SPAN_S, PERIOD_NS * 1e-9)
            self._zeros, self._at = self._climate.zero(times_s), 0
        counts = self.fractions * contact_counts[:, None] + self._zeros[self._at]
        self._at += 1
        counts += self._rng.standard_normal(counts.shape)
        self.tick.settle()
        self.slab.begin_cycle(self.t_ns)
        self.cycle.begin(self.t_ns)
        for slot, data in enumerate(np.rint(counts).astype("<i2")):
            self.slab.write(slot, data.tobytes(), self.t_ns + 1000)
        self.tick.step(self.slab, self._up, self.cycle, self.t_ns + 2000)


# Held object


def without_common(tick: Tick) -> None:
    tick.baseline._member[:] = 0.0


def without_baseline(tick: Tick) -> None:
    tick.baseline.learn = lambda *_: False  # type: ignore[method-assign]


def without_gate(tick: Tick) -> None:
    """Baselines follow in contact too."""
    baseline, learn = tick.baseline, tick.baseline.learn

    def ungated(t_ns: int, touching: NDArray[np.bool_]) -> bool:
        baseline.waiting[:] = False
        return learn(t_ns, touching & False)

    baseline.learn = ungated  # type: ignore[method-assign]
    tick._gather = lambda trusted: baseline.gather(tick._excess, trusted)  # type: ignore[method-assign]


HALVES: dict[str, Callable[[Tick], None]] = {
    "the whole fast half": lambda _: None,
    "without the common mode": without_common,
    "without any baseline": without_baseline,
    "followed in contact too": without_gate,
}


def held(name: str, seconds: float) -> Rows:
    """An object held in five pads of fifteen: forces at the end against those at the start."""
    rig = Rig(hands(1), 71, True)
    HALVES[name](rig.tick)
    none = np.zeros(rig.model.size)
    grip = none.copy()
    grip[:HELD] = rig.model.on_counts[:HELD] * np.geomspace(5, 60, HELD)
    for _ in range(round(60e9 / PERIOD_NS)):
        rig.step(none)
    early, late, lost = [], [], set()
    total = round(seconds * 1e9 / PERIOD_NS)
    for number in range(total):
        rig.step(grip)
        if 20 <= number < 220:
            early.append(rig.tick.columns.force_n[:HELD].copy())
        elif number >= total - 200:
            late.append(rig.tick.columns.force_n[:HELD].copy())
        if number >= 20:
            lost |= set(np.flatnonzero(~rig.tick.contacts.touching[:HELD]).tolist())
    off = np.mean(late, axis=0) / np.mean(early, axis=0) - 1
    begun = rig.tick.contacts.begun
    for _ in range(round(60e9 / PERIOD_NS)):
        rig.step(none)
    return [
        {
            "": name,
            "force error, worst of five": f"{100 * float(np.abs(off).max()):.2f} %",
            "rms": f"{100 * float(np.sqrt(np.mean(off**2))):.2f} %",
            "contacts ever lost, of five": len(lost),
            "false contacts": int(begun - HELD),
            "not released after": int(np.count_nonzero(rig.tick.contacts.touching[:HELD])),
        }
    ]


# Slow presses


def slow(quick: bool) -> Rows:
    """A press that grows at a steady speed: where it is found, and what the baseline has taken of it."""
    rows = []
    for speed in (3e-3, 1e-2, 1e-1) if quick else (3e-4, 1e-3, 3e-3, 1e-2, 1e-1):
        rig = Rig(hands(1), 72, False)
        model = rig.model
        per_law = model.on_counts[0] / model.on_n[0] ** 1.5  # light contacts: the layer dominates
        none = np.zeros(model.size)
        for _ in range(round(10e9 / PERIOD_NS)):
            rig.step(none)
        found, force = math.nan, 0.0
        while force < 0.3:
            force += speed * PERIOD_NS * 1e-9
            press = none.copy()
            press[0] = per_law * force**1.5
            rig.step(press)
            if math.isnan(found) and rig.tick.contacts.touching[0]:
                found = force
        taken = float(rig.tick.baseline.expected[0].sum()) / press[0]
        rows.append(
            {
                "speed, N/s": speed,
                "found at, N": round(found, 3) if found == found else None,
                "part of its current taken for baseline, at 0.3 N": f"{100 * taken:.1f} %",
            }
        )
        print(rows[-1], flush=True)
    return rows


# A day on real sheets


def drawn(preset: sheet.SheetModel, rng: np.random.Generator) -> sheet.SheetModel:
    """Sheets whose numbers lie about the preset's."""
    spread = np.exp(rng.normal(0, SPREAD, (3, PADS)))
    was = preset.adaptation
    new = replace(
        was,
        time_s=np.asarray(was.time_s) * spread[0],
        fatigue_s=np.asarray(was.fatigue_s) * spread[1],
        share=np.minimum(np.asarray(was.share) * (1 + 0.1 * np.log(spread[2])), 1.0),
    )
    creep = sheet.Creep.first_order(preset.creep.instant, 0.25 * float(np.exp(rng.normal(0, SPREAD))))
    return replace(preset, adaptation=new, creep=creep)


def day(name: str, behaviour: Behaviour, hours: float, seed: int = SEED) -> dict[str, Any]:
    """Grips of 2 to 40 s and 0.1 to 5 N, pauses of 0.3 to 30 s; a half of the grips of a pad are alike."""
    rng = np.random.default_rng(seed)
    preset = {"S1": sheet.S1, "S2": sheet.S2}[behaviour.preset]
    model = drawn(preset, rng)
    gain = np.exp(rng.normal(0, behaviour.gain_std, PADS))
    state, step = model.start(PADS, seed), model.at(DT_S)
    strength = SheetStrength([behaviour_of(behaviour)] * PADS, round(DT_S * 1e9))
    usual = rng.uniform(0.5, 4.0, PADS)
    load, left = np.zeros(PADS), rng.uniform(0, 20, PADS)
    touching, none, t_ns = np.zeros(PADS, np.bool_), np.zeros(PADS), 10**9
    strength.step(none, none, touching, t_ns)
    told: list[tuple[FloatArray, ...]] = []
    for number in range(round(hours * 3600 / DT_S)):
        left -= DT_S
        if len(turn := np.flatnonzero(left <= 0)):
            free = load[turn] == 0
            fresh = np.where(rng.random(len(turn)) < 0.5, usual[turn], rng.uniform(0.1, FULL_N, len(turn)))
            load[turn] = np.where(free, fresh, 0.0)
            left[turn] = np.where(free, rng.uniform(2, 40, len(turn)), 30 * rng.random(len(turn)) ** 3 + 0.3)
        t_ns += round(DT_S * 1e9)
        apparent = gain * step.forward(state, load)
        now = apparent > 0.03
        if (began := np.flatnonzero(now & ~touching)).size:
            strength.begin(began)
        touching = now
        strength.step(apparent, 0 * apparent, touching, t_ns)
        if number % 20 == 0:
            seen = touching & (left < 38)
            told.append(
                (
                    np.full(seen.sum(), number * DT_S / 3600),
                    (apparent - load)[seen],
                    (strength.force_n - load)[seen],
                    strength.std_n[seen],
                    strength.state[seen] == StrengthState.ESTIMATED,
                )
            )
    hour, raw, off, std, valid = (np.concatenate(column) for column in zip(*told, strict=True))
    inside = np.abs(off) < 1.96 * std

    def rms(value: FloatArray) -> float:
        return 100 * float(np.sqrt(np.mean(np.square(value)))) / FULL_N

    edges = np.linspace(0, hours, 17)
    bins = [valid & (hour >= low) & (hour < high) for low, high in pairwise(edges)]
    return {
        "sheets": name,
        "hours": hours,
        "uncompensated": rms(raw[valid]),
        "compensated": rms(off[valid]),
        "stated": rms(std[valid]),
        "inside 95 %": float(inside[valid].mean()),
        "valid": float(valid.mean()),
        "curve": [
            [float(edges[k]), rms(raw[b]), rms(off[b]), rms(std[b])] for k, b in enumerate(bins) if b.any()
        ],
    }


CUTS: dict[str, dict[str, Any]] = {
    "": {},
    ", first part alone": {},
    ", silence forgets nothing": {"silence_s": 1e9},
    ", numbers not doubted": {"doubt": 0.0},
    ", no adaptation undone": {"adaptation_share": 0.0},
    ", no creep undone": {"creep_share": 0.0},
}


def loops() -> Rows:
    """Width of a loop 0 - 5 N - 0 half-way, of sheets whose loop and creep are a fifth more than is told."""
    rows = []
    for preset in ("S1", "S2"):
        base = {"S1": sheet.S1, "S2": sheet.S2}[preset]
        told = Behaviour(preset=preset, loop=0.1, gain_std=0.0, history_std_n=0.0)
        true = replace(
            base,
            hysteresis=sheet.PrandtlIshlinskii.of_loop(0.12, FULL_N),
            creep=sheet.Creep.first_order(0.3, 0.3),
            fluctuation=sheet.Fluctuation(),
        )
        state, step = true.start(1), true.at(DT_S)
        strength = SheetStrength([behaviour_of(told)], round(DT_S * 1e9))
        ramp = np.concatenate([np.linspace(0, FULL_N, 601), np.linspace(FULL_N, 0, 601)[1:]])
        raw, found, t_ns, one = np.zeros(1201), np.zeros(1201), 10**9, np.ones(1)
        for number, force in enumerate(ramp):
            t_ns += round(DT_S * 1e9)
            apparent = step.forward(state, force * one)
            strength.step(apparent, 0 * one, apparent > 0, t_ns)
            raw[number], found[number] = apparent[0], strength.force_n[0]
        rows.append(
            {
                "sheet": preset,
                "loop before, % of full scale": f"{100 * abs(raw[900] - raw[300]) / FULL_N:.1f}",
                "after": f"{100 * abs(found[900] - found[300]) / FULL_N:.1f}",
            }
        )
        print(rows[-1], flush=True)
    return rows


# Cost


def median_us(call: Callable[[], object], times: int = 2000) -> float:
    spent = []
    for _ in range(times):
        begin_ns = time.perf_counter_ns()
        call()
        spent.append(time.perf_counter_ns() - begin_ns)
    return 1e-3 * statistics.median(spent)


def costs() -> Rows:
    rows: Rows = []
    for count in (1, 4, 16):
        rig = Rig(hands(count), 73, False)
        model, tick = rig.model, rig.tick
        grip = model.on_counts * 10 * (np.arange(model.size) % 2)
        for _ in range(60):
            rig.step(grip)
        baseline, free = tick.baseline, np.ones(model.size, np.bool_)
        strength = SheetStrength([behaviour_of(Behaviour())] * model.size, TICK_NS)
        touching, raw = tick.contacts.touching, np.ones(model.size)
        clock = [rig.t_ns]

        def block(baseline: Any = baseline, touching: Any = touching, clock: list[int] = clock) -> None:
            clock[0] += 10**8
            baseline._count[:] = 20.0
            baseline.learn(clock[0], touching)

        def sheets(
            strength: Any = strength, touching: Any = touching, raw: Any = raw, clock: list[int] = clock
        ) -> None:
            clock[0] += TICK_NS
            strength.step(raw, 0.1 * raw, touching, clock[0])

        def each(tick: Any = tick, free: Any = free, baseline: Any = baseline) -> None:
            np.subtract(tick.counts, baseline.expected, out=tick._excess)
            tick._gather(free)
            baseline.learn(tick._cycle_ns, tick.contacts.touching)

        parts = median_us(each), median_us(block, 500), median_us(sheets)
        rows.append(
            {
                "pads": model.size,
                "baseline, each tick": f"{parts[0]:.1f}",
                "baseline, each tenth of a second": f"{parts[1]:.0f}",
                "sheets, if modelled": f"{parts[2]:.1f}",
                "mean of a tick at 200 Hz": f"{parts[0] + parts[1] / 20 + parts[2]:.1f}",
            }
        )
        print(rows[-1], flush=True)
    return rows


# The page


def draw(found: list[dict[str, Any]], presses: Rows, path: Path) -> None:
    figure, axes = plt.subplots(1, 3, figsize=(14, 4.4), layout="constrained")
    whole = [row for row in found if row["sheets"] in ("S1", "S2")]
    for axis, row in zip(axes, whole, strict=False):
        hour, raw, off, std = np.array(row["curve"]).T
        axis.plot(hour, raw, color=FAINT, label="uncompensated")
        axis.plot(hour, off, color=ACCENT, label="compensated")
        axis.plot(hour, std, color=RED, ls="--", label="stated")
        axis.set(title=f"{row['sheets']}: mixed use", xlabel="hour", ylabel="force error, rms, % of 5 N")
        axis.set_ylim(0, None)
        axis.legend(frameon=False)
    speed = [row["speed, N/s"] for row in presses]
    force = [row["found at, N"] for row in presses]
    axes[2].plot(speed, [math.nan if f is None else f for f in force], "o-", color=ACCENT)
    axes[2].axhline(0.06, color=FAINT, lw=0.8)
    axes[2].text(speed[-1], 0.0615, "on_n", ha="right", va="bottom", color=FAINT)
    axes[2].set(title="Slow presses", xscale="log", xlabel="speed of the press, N/s", ylabel="found at, N")
    axes[2].set_ylim(0, None)
    figure.savefig(path, dpi=110)


def table(rows: Rows) -> list[str]:
    heads = [head for head in rows[0] if head != "curve"]
    lines = ["| " + " | ".join(heads) + " |", "|" + " --- |" * len(heads)]
    for row in rows:
        cells = [
            "none" if row[h] is None else f"{row[h]:.3g}" if isinstance(row[h], float) else str(row[h])
            for h in heads
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def page(parts: dict[str, Rows], held_s: float) -> str:
    machine = (
        f"{os.cpu_count()} x {platform.machine()}, Python {platform.python_version()}, numpy {np.__version__}"
    )
    notes = {
        "Held object": f"""Five pads of fifteen hold something for {held_s:g} s. The drift is the
simulator's: each zero wanders by {DRIFT.drift_counts_per_s:g} counts a second at most, and the hand's
temperature by {DRIFT.warmth_k_per_s:g} K a second, for {DRIFT.offset_counts_per_k:g} counts/K. The
error is that of the force at the end against the same grip at its start; below, parts of the fast half
are taken out. In so slow a drift of either sign, following and common mode are worth nothing to a held
object; what counts is that it isn't followed in contact.""",
        "Slow presses": "On a pad of the shipped hand, on_n 0.06 N, slow_touch_s 20.",
        DAY: f"""{PADS} sheets each; grips of 2 to 40 s and 0.1 to 5 N.
Adaptation, fatigue and creep are spread by 20 % about the preset that the estimator is told, gains by
5 %. Errors in % of 5 N (rms), where strength is called valid; `inside 95 %`: part of those readings whose
stated interval holds the truth; `valid`: part of the time touched. Below each sheet, parts are
taken out, over its first {PART_H:g} hours.""",
        "Loop": """0 to 5 N and back in two minutes. True loop and creep are a fifth more than the
estimator is told.""",
        "Cost": f"Medians in us; {machine}. Sheets: S1, half of the pads touched.",
    }
    lines = [
        "# The fast half of the supervisor",
        "",
        "![mixed use of two sheets, slow presses](supervise.png)",
        "",
    ]
    for title, rows in parts.items():
        lines += [f"## {title}", "", notes[title], "", *table(rows), ""]
    return "\n".join([*lines, "Made by `make bench ONLY=supervise`.", ""])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="minutes instead of hours; write nothing")
    parser.add_argument("--hours", type=float, default=8.0, help="length of the day (default: 8)")
    asked = parser.parse_args()
    quick = asked.quick
    hours, held_s = (0.25, 120.0) if quick else (asked.hours, 3600.0)
    tasks: list[tuple[str, Callable[..., Any], tuple[Any, ...]]] = []
    tasks += [(DAY, day, (p, Behaviour(preset=p), hours)) for p in ("S1", "S2")]
    for preset in ("S1", "S2"):
        for cut, changes in list(CUTS.items())[1:]:
            behaviour = Behaviour(preset=preset, **changes)
            tasks.append((DAY, day, (preset + cut, behaviour, min(hours, PART_H))))
    tasks += [("Held object", held, (name, held_s)) for name in HALVES]
    tasks += [("Slow presses", slow, (quick,)), ("Loop", loops, ())]
    parts: dict[str, Rows] = {title: [] for title in ("Held object", "Slow presses", DAY, "Loop")}
    with ProcessPoolExecutor(2) as pool:
        waiting = [(title, pool.submit(call, *given)) for title, call, given in tasks]
        for title, future in waiting:
            found = future.result()
            parts[title] += found if isinstance(found, list) else [found]
            print(title, {k: v for k, v in parts[title][-1].items() if k != "curve"}, flush=True)
    parts["Cost"] = costs()
    text = page(parts, held_s)
    print(text)
    if not quick:
        (OUT / "supervise.md").write_text(text)
        (OUT / "supervise.json").write_text(json.dumps(parts, indent=1) + "\n")
        draw(parts[DAY], parts["Slow presses"], OUT / "supervise.png")


if __name__ == "__main__":
    main()
