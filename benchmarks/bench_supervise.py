"""Measure effect and cost of baseline tracking and sheet force compensation.

Drift, presses and sheets are drawn with fixed seeds, others than anything was tuned with; drift is the
simulator's. The estimator knows presets, never the drawn parameters. Two processes share the work.
Writes docs/benchmarks/supervise.{md,json,png}; `--quick` tries it out in a minute and writes nothing.
"""

from __future__ import annotations

import json
import math
import os
import platform
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import supervise_day
from numpy.typing import NDArray
from page import made_by, options, output_folder

from handtouch import sheet
from handtouch.config import Behaviour, load, shipped
from handtouch.core.cycle import Cycle
from handtouch.core.pad_model import PadModel
from handtouch.core.sheet_force import SheetForceCompensation, sheet_behaviour_of
from handtouch.core.slab import Slab
from handtouch.core.tick import TickProcessor
from handtouch.simulate.electronics_drift import ElectronicsDrift
from handtouch.simulate.worlds import WORLDS, Family

matplotlib.use("Agg")
from matplotlib import pyplot as plt

FloatArray = NDArray[np.float64]
Rows = list[dict[str, Any]]
PERIOD_NS, TICK_NS = 100_000_000, 5_000_000
DRIFT = WORLDS["default"].only("electronics").draw(Family.REPORTING.seed(71))
SPAN_S = 60.0  # of drift that is drawn at once
HELD = 5  # pads
FULL_N = 5.0
DT_S = 0.1
PART_H = 1.0  # of a day, for what is compared with it
SEEDS = (31, 32)
DAY, PARTS = "A day of mixed use of sheets with creep and adaptation", "Effect of the parts"
WARM, TURNED = "A hand that gets warm", "A hand that is turned over"
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
        self.model, self.tick, self.slab = model, TickProcessor(model, PERIOD_NS), Slab(model.size)
        self.cycle = Cycle(PERIOD_NS, 0.6)
        self._rng = np.random.default_rng(seed)
        names = list(zip(model.hands, model.links, strict=True))
        self._climate = ElectronicsDrift(
            DRIFT if drifts else WORLDS["ideal"].draw(Family.REPORTING.seed(1)), names
        )
        self._zeros = np.zeros((0, model.size, 4))
        self._at = 0
        pads = np.arange(model.size)
        self.fractions = model.locator.fractions(pads, *(0.5 * model.locator.sides).T).T
        self._up = np.zeros(model.size, np.uint8)
        self.t_ns = 10**9

    def step(self, contact_counts: FloatArray, zero: FloatArray | float = 0.0) -> None:
        """A period under contacts of these sums of channels (n,), with zeros off by `zero` (n, 4)."""
        self.t_ns += PERIOD_NS
        if self._at == len(self._zeros):
            times_s = self.t_ns * 1e-9 - 1 + np.arange(0, SPAN_S, PERIOD_NS * 1e-9)
            self._zeros, self._at = self._climate.zero_counts(times_s), 0
        counts = self.fractions * contact_counts[:, None] + self._zeros[self._at] + zero
        self._at += 1
        counts += self._rng.standard_normal(counts.shape)
        self.tick.prepare_next_tick()
        self.slab.begin_cycle(self.t_ns)
        self.cycle.begin_cycle(self.t_ns)
        for slot, data in enumerate(np.rint(counts).astype("<i2")):
            self.slab.write_pdo(slot, data.tobytes(), self.t_ns + 1000)
        self.tick.run_tick(self.slab, self._up, self.cycle, self.t_ns + 2000)


# Held object


def without_common(tick: TickProcessor) -> None:
    tick.baseline._hand_membership[:] = 0.0


def without_baseline(tick: TickProcessor) -> None:
    tick.baseline.update_baseline = lambda *_: False  # type: ignore[method-assign]


def without_following(tick: TickProcessor) -> None:
    """The first minute's baseline is the last."""
    baseline, learn, ends_ns = tick.baseline, tick.baseline.update_baseline, [0]

    def still(sync_ns: int, touching: NDArray[np.bool_]) -> bool:
        ends_ns[0] = ends_ns[0] or sync_ns + 50 * 10**9
        return sync_ns < ends_ns[0] and learn(sync_ns, touching)

    baseline.update_baseline = still  # type: ignore[method-assign]


def without_gate(tick: TickProcessor) -> None:
    """Baselines follow in contact too."""
    baseline, learn = tick.baseline, tick.baseline.update_baseline

    def ungated(sync_ns: int, touching: NDArray[np.bool_]) -> bool:
        baseline.held[:] = False
        return learn(sync_ns, touching & False)

    baseline.update_baseline = ungated  # type: ignore[method-assign]

    def gather() -> None:
        if not tick._baseline_samples_added:
            tick._baseline_samples_added = True
            baseline.add_samples(tick._excess, tick._sampled & tick._trusted)

    tick._add_baseline_samples = gather  # type: ignore[method-assign]


HALVES: dict[str, Callable[[TickProcessor], None]] = {
    "all compensation": lambda _: None,
    "without the common mode": without_common,
    "followed for a minute only": without_following,
    "without any baseline": without_baseline,
    "followed in contact too": without_gate,
}


def held(name: str, seconds: float) -> Rows:
    """An object held in five pads of fifteen: forces at the end against those at the start."""
    rig = Rig(hands(1), 71, True)
    HALVES[name](rig.tick)
    none = np.zeros(rig.model.size)
    grip = grips(rig.model)
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
    begun = rig.tick.contacts.begun_count
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


# A hand that gets warm, and one that is turned over


def grips(model: PadModel) -> FloatArray:
    grip = np.zeros(model.size)
    grip[:HELD] = model.begin_threshold_counts[:HELD] * np.geomspace(5, 60, HELD)
    return grip


def follow(rig: Rig, seconds: float, zero: Callable[[float], FloatArray]) -> dict[str, Any]:
    """Five pads of fifteen hold on for so long while zeros move, and the others are touched lightly before
    and during that: force errors, and contacts that are none."""
    light = np.where(np.arange(rig.model.size) < HELD, 0.0, 2 * rig.model.begin_threshold_counts)
    again = 600 + round(seconds * 4)
    held, touches = [], []
    begun = rig.tick.contacts.begun_count
    for number in range(600 + round(seconds * 10)):
        touched = 300 <= number < 350 or again <= number < again + 50
        rig.step(grips(rig.model) * (number >= 600) + light * touched, zero(0.1 * number))
        if number >= 620:
            held.append(rig.tick.columns.force_n[:HELD].copy())
        if number in (349, again + 49):
            touches.append(rig.tick.columns.force_n[HELD:].copy())
    force = np.array(held)
    off = force / np.median(force[:50], axis=0) - 1
    return {
        "held, rms": f"{100 * float(np.sqrt(np.nanmean(off**2))):.2f} %",
        "held, worst": f"{100 * float(np.nanmax(np.abs(off))):.2f} %",
        "light touch, rms": f"{100 * float(np.sqrt(np.mean((touches[1] / touches[0] - 1) ** 2))):.1f} %",
        "contacts lost or false": int(
            abs(rig.tick.contacts.begun_count - begun - 2 * rig.model.size + HELD) + np.isnan(force).any()
        ),
    }


def warm(alike: float, name: str) -> Rows:
    """8 K more within minutes, and back; channels drift by 2 counts/K rms, `alike` of it in common."""
    rig, rng = Rig(hands(1), 74, False), np.random.default_rng(74)
    HALVES[name](rig.tick)
    own = rng.normal(size=(rig.model.size, 4))
    own *= np.sqrt((1 - alike**2) / np.mean(own**2))
    per_k = 2.0 * (alike + own)

    def zero(t_s: float) -> FloatArray:
        warmth = 8 * (-np.expm1(-max(t_s - 180, 0) / 180) + np.expm1(-max(t_s - 900, 0) / 180))
        return np.asarray(per_k * warmth)

    return [{"in common": f"{100 * alike:.0f} %", "": name, **follow(rig, 1500, zero)}]


def turned(known: bool) -> Rows:
    """Turned over every quarter of a minute or so; gravity causes 4 counts rms along each axis."""
    rig, rng = Rig(hands(1), 75, False), np.random.default_rng(75)
    by_gravity = rng.normal(0, 4.0, (rig.model.size, 4, 3))
    ways, speeds = rng.normal(size=(2, 3)), np.array([0.21, 0.34, 0.55])

    def zero(t_s: float) -> FloatArray:
        way = ways[0] * np.sin(speeds * t_s) + ways[1] * np.cos(speeds[::-1] * t_s)
        way /= np.linalg.norm(way)
        if known:
            rig.tick.set_gravity(np.tile(way, (rig.model.size, 1)))
        return np.asarray(by_gravity @ way)

    none = np.zeros(rig.model.size)
    for number in range(6000):
        rig.step(none, zero(0.1 * number))
    return [{"joint states": "known" if known else "unknown", **follow(rig, 600, zero)}]


# Slow presses


def slow(quick: bool) -> Rows:
    """A press that grows at a steady speed: where it is found, and what the baseline has taken of it."""
    rows = []
    for speed in (3e-3, 1e-2, 1e-1) if quick else (3e-4, 1e-3, 3e-3, 1e-2, 1e-1):
        rig = Rig(hands(1), 72, False)
        model = rig.model
        per_law = (
            model.begin_threshold_counts[0] / model.begin_threshold_n[0] ** 1.5
        )  # light contacts: the layer dominates
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
        taken = float(rig.tick.baseline.expected_counts[0].sum()) / press[0]
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


CUTS: dict[str, dict[str, Any]] = {
    "complete": {},
    "no forgetting": {"forget_time_s": 1e9},
    "no parameter uncertainty": {"parameter_std_fraction": 0.0},
    "no adaptation compensation": {"adaptation_share": 0.0},
    "no creep compensation": {"creep_share": 0.0},
    "no compensation": {"adaptation_share": 0.0, "creep_share": 0.0},
}


def day(preset: str, hours: float, seed: int, changes: dict[str, Any]) -> dict[str, Any]:
    behaviour = Behaviour.model_validate({"preset": preset, **changes})
    result: dict[str, Any] = supervise_day.day(preset, behaviour, hours, seed)
    return result


def pooled(days: list[dict[str, Any]], part: Callable[[dict[str, Any]], dict[str, float]]) -> dict[str, Any]:
    """Figures of several seeds: errors are rms over them, shares are means; the worst interval of any."""
    rows = [part(found) for found in days]
    table: dict[str, Any] = {}
    for head in rows[0]:
        column = np.array([row[head] for row in rows])
        whole = column.mean() if head in ("inside 95 %", "valid") else np.sqrt(np.mean(column**2))
        table[head] = float(whole)
    table["inside, each day"] = " ".join(f"{100 * row['inside 95 %']:.1f}" for row in rows)
    return table


def loops() -> Rows:
    """Width of a loop 0 - 5 N - 0 half-way, of sheets whose loop and creep are a fifth more than assumed."""
    rows = []
    for preset in ("S1", "S2"):
        base = {"S1": sheet.S1, "S2": sheet.S2}[preset]
        assumed = Behaviour(preset=preset, hysteresis_width=0.1, gain_std=0.0, back_force_std_n=0.0)
        true = replace(
            base,
            hysteresis=sheet.PrandtlIshlinskii.from_width(0.12, FULL_N),
            creep=sheet.Creep.first_order(0.3, 0.3),
            fluctuation=sheet.Fluctuation(),
        )
        state, step = true.initial_state(1), true.discretise(DT_S)
        strength = SheetForceCompensation([sheet_behaviour_of(assumed)], round(DT_S * 1e9))
        ramp = np.concatenate([np.linspace(0, FULL_N, 601), np.linspace(FULL_N, 0, 601)[1:]])
        raw, found, t_ns, one = np.zeros(1201), np.zeros(1201), 10**9, np.ones(1)
        for number, force in enumerate(ramp):
            t_ns += round(DT_S * 1e9)
            apparent = step.forward(state, force * one)
            strength.compensate_forces(apparent, 0 * one, apparent > 0, t_ns)
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


def median_us(call: Callable[[], object], prepare: Callable[[], object], times: int) -> float:
    spent = []
    for _ in range(times):
        prepare()
        begin_ns = time.perf_counter_ns()
        call()
        spent.append(time.perf_counter_ns() - begin_ns)
    return 1e-3 * statistics.median(spent)


class Parts:
    """Parts of a tick that track baselines and compensate sheets, after presses."""

    def __init__(self, hand_count: int) -> None:
        rig = Rig(hands(hand_count), 73, False)
        self.size = rig.model.size
        grip = rig.model.begin_threshold_counts * 10 * (np.arange(self.size) % 2)
        for _ in range(60):
            rig.step(grip)
        self._tick, self._t_ns = rig.tick, rig.t_ns
        self._excess, self._free = np.zeros((self.size, 4)), np.ones(self.size, np.bool_)
        self._sheets = SheetForceCompensation([sheet_behaviour_of(Behaviour())] * self.size, TICK_NS)
        self._raw = np.ones(self.size)

    def add_samples(self) -> None:
        self._tick.baseline.add_samples(self._excess, self._free)

    def add_block(self) -> None:
        self._t_ns += 10**8
        for _ in range(20):
            self.add_samples()

    def update_baseline(self) -> None:
        self._tick.baseline.update_baseline(self._t_ns, self._tick.contacts.touching)

    def each_tick(self) -> None:
        self.add_samples()
        self.update_baseline()

    def wait(self) -> None:
        self._t_ns += TICK_NS

    def compensate(self) -> None:
        touching = self._tick.contacts.touching
        self._sheets.compensate_forces(self._raw, 0.1 * self._raw, touching, self._t_ns)


def costs(quick: bool) -> Rows:
    rows: Rows = []
    times = 20 if quick else 2000
    for count in (1, 4, 16):
        made = Parts(count)
        parts = (
            median_us(made.each_tick, lambda: None, times),
            median_us(made.update_baseline, made.add_block, times // 4),
            median_us(made.compensate, made.wait, times),
        )
        rows.append(
            {
                "pads": made.size,
                "baseline, each tick": f"{parts[0]:.1f}",
                "baseline, each tenth of a second": f"{parts[1]:.0f}",
                "sheets, if modelled": f"{parts[2]:.1f}",
                "mean of a tick at 200 Hz": f"{parts[0] + parts[1] / 20 + parts[2]:.1f}",
            }
        )
        print(rows[-1], flush=True)
    return rows


# The page


def draw(curves: dict[str, list[list[float]]], presses: Rows, path: Path) -> None:
    figure, axes = plt.subplots(1, 3, figsize=(14, 4.4), layout="constrained")
    for axis, (preset, curve) in zip(axes, curves.items(), strict=False):
        hour, raw, off, std = np.array(curve).T
        axis.plot(hour, raw, color=FAINT, label="uncompensated")
        axis.plot(hour, off, color=ACCENT, label="compensated")
        axis.plot(hour, std, color=RED, ls="--", label="stated")
        axis.set(title=f"{preset}: mixed use", xlabel="hour", ylabel="force error, rms, % of 5 N")
        axis.set_ylim(0, None)
        axis.legend(frameon=False)
    speed = [row["speed, N/s"] for row in presses]
    detected_n = [row["found at, N"] for row in presses]
    axes[2].plot(speed, [math.nan if newton is None else newton for newton in detected_n], "o-", color=ACCENT)
    axes[2].axhline(0.06, color=FAINT, lw=0.8)
    axes[2].text(speed[-1], 0.0615, "begin_threshold_n", ha="right", va="bottom", color=FAINT)
    axes[2].set(title="Slow presses", xscale="log", xlabel="speed of the press, N/s", ylabel="found at, N")
    axes[2].set_ylim(0, None)
    figure.savefig(path, dpi=110)


def table(rows: Rows) -> list[str]:
    lines = ["| " + " | ".join(rows[0]) + " |", "|" + " --- |" * len(rows[0])]
    for row in rows:
        cells = [
            "none" if cell is None else f"{cell:.3g}" if isinstance(cell, float) else str(cell)
            for cell in row.values()
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def notes(hours: float, held_s: float) -> dict[str, str]:
    machine = (
        f"{os.cpu_count()} x {platform.machine()}, Python {platform.python_version()}, numpy {np.__version__}"
    )
    drift = DRIFT.world.electronics
    return {
        "Held object": f"""Five pads of fifteen hold something for {held_s:g} s. The drift is the
simulator's: each zero wanders by {drift.zero_drift_counts_per_s} counts a second at most, and the hand's
temperature by {drift.temperature_drift_k_per_s} K a second, for {drift.offset_counts_per_k.std:g} counts/K
of either
sign. The error is that of the force at the end against the same grip at its start; below, without parts of
the compensation. With so slow a drift it matters only that it isn't tracked in contact; the next two
sections show the effect of the other parts.""",
        WARM: """8 K more within some minutes, and back 12 minutes later, with the same grip held for 25. The
other pads are touched lightly, with twice the current of the threshold, before and while it is warm. Channels
drift by 2 counts/K (rms), a part of it common to all, as with amplifiers of one type on one supply.
Errors are against the grip's first seconds, and against the touch before.""",
        TURNED: """The whole hand is turned over four times a minute, untouched for ten minutes and then
with the same grip for ten. Each channel reads 4 counts (rms) more for a unit of gravity along each axis of
its link.""",
        "Slow presses": "On a pad of the shipped hand, begin_threshold_n 0.06 N, max_rise_time_s 20.",
        DAY: f"""{supervise_day.PADS} sheets of each kind, {hours:g} h each, seeds {SEEDS}: grips
of 2 to 40 s, some of minutes, 0.1 to 5 N, half of them waxing and waning; breaks, and a night from hour 16.
The estimator knows the preset only. Truths: the preset with its parameters off by 20 or 50 % (1 sigma);
or, besides 20 %, creep by a power law (t / 1 s)^{supervise_day.POWER:g} for hours, a Preisach operator with a
loop of {100 * supervise_day.LOOP:g} % unknown to the estimator, or adaptation of two speeds.
Gains are off by 5 %. Errors in % of 5 N (rms), with valid force status; `first second`: of a touch;
`inside 95 %`: part of those readings whose interval holds the ground truth, then that of each seed in %;
`valid`: part of the time touched.""",
        PARTS: f"""The first {min(hours, PART_H):g} h of another such day, all kinds together, without
some parts.""",
        "Loop": """0 to 5 N and back in two minutes. True loop and creep are a fifth more than the
estimator assumes.""",
        "Cost": f"Medians in us; {machine}. Sheets: S1, half of the pads touched.",
    }


def page(parts: dict[str, Rows], hours: float, held_s: float) -> str:
    lines = [
        "# Baseline and sheet force compensation",
        "",
        "![mixed use of two sheets, slow presses](supervise.png)",
        "",
    ]
    texts = notes(hours, held_s)
    for title, rows in parts.items():
        lines += [f"## {title}", "", texts[title], "", *table(rows), ""]
    return "\n".join([*lines, f"{made_by()}.", ""])


def days(found: dict[tuple[str, str], list[dict[str, Any]]]) -> tuple[Rows, Rows]:
    """Rows of the day and of its parts, from what was found by preset and cut."""
    whole: Rows = []
    for preset in supervise_day.PRESETS:
        of = found[preset, ""]
        for kind in supervise_day.KINDS:
            row = pooled(of, lambda one, kind=kind: one["kinds"][kind])  # type: ignore[misc]
            whole.append({"sheets": preset, "truth": kind, **row})
        whole.append({"sheets": preset, "truth": "all", **pooled(of, lambda one: one["all"])})
    parts = [
        {"sheets": preset, "": cut, **pooled(of, lambda one: one["all"])}
        for (preset, cut), of in found.items()
        if cut
    ]
    return whole, parts


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--hours", type=float, default=24.0, help="length of the day (default: 24)")
    asked = parser.parse_args()
    quick = asked.quick
    hours, held_s = (0.25, 120.0) if quick else (asked.hours, 3600.0)
    names = list(HALVES)
    tasks: list[tuple[str, Callable[..., Any], tuple[Any, ...]]] = []
    tasks += [("Held object", held, (name, held_s)) for name in names]
    tasks += [(WARM, warm, (alike, name)) for alike in (0.0, 0.5, 0.9) for name in names[:3]]
    tasks += [(TURNED, turned, (known,)) for known in (True, False)]
    tasks += [("Slow presses", slow, (quick,)), ("Loop", loops, ())]
    with ProcessPoolExecutor(2) as pool:
        presets, seeds = list(supervise_day.PRESETS), SEEDS[: 1 if quick else None]
        used = {(p, ""): [pool.submit(day, p, hours, seed, {}) for seed in seeds] for p in presets}
        for cut, changes in CUTS.items():
            for p in presets:
                used[p, cut] = [pool.submit(day, p, min(hours, PART_H), SEEDS[-1] + 1, changes)]
        waiting = [(title, pool.submit(call, *given)) for title, call, given in tasks]
        parts: dict[str, Rows] = {title: [] for title in ("Held object", WARM, TURNED, "Slow presses")}
        for title, future in waiting:
            parts.setdefault(title, []).extend(future.result())
            print(title, parts[title][-1], flush=True)
        found = {key: [future.result() for future in futures] for key, futures in used.items()}
    loop = parts.pop("Loop")
    parts[DAY], parts[PARTS] = days(found)
    parts |= {"Loop": loop, "Cost": costs(quick)}
    text = page(parts, hours, held_s)
    print(text)
    out = output_folder(quick)
    curves = {p: np.mean([one["curve"] for one in found[p, ""]], axis=0).tolist() for p in presets}
    (out / "supervise.md").write_text(text)
    (out / "supervise.json").write_text(json.dumps({**parts, "curves": curves}, indent=1) + "\n")
    draw(curves, parts["Slow presses"], out / "supervise.png")


if __name__ == "__main__":
    main()
