"""Measure slip detection in the worlds `ideal`, `default` and `harsh`, and detection by force alone.

Recall, delay and false alarms of grips with tremor. Writes docs/benchmarks/slip.{md,json,png}.
"""

from __future__ import annotations

import json
import math
import os
import platform
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import numpy.typing as npt

from benchmarks.page import made_by, options, output_folder, progress
from benchmarks.scores import EventScore, Rate, Share, score_events
from benchmarks.slip_runs import DEPLOYMENT, Record, pads_of, run
from handtouch.core.slip import GripModel
from handtouch.simulate.grip_touch import GripTouch
from handtouch.simulate.worlds import WORLDS, DrawnWorld, Family

matplotlib.use("Agg")
from matplotlib import pyplot as plt

FloatArray = npt.NDArray[np.float64]
PADS = pads_of(DEPLOYMENT)
SPEEDS, FORCES = (1.0, 3.0, 10.0, 30.0, 100.0), (0.5, 2.0, 5.0)
DRAWN = {name: world.draw(Family.REPORTING.seed(21)) for name, world in WORLDS.items()}
CASES = (
    *((name, 200.0) for name in WORLDS), ("ideal", 500.0), ("default", 500.0), ("default", 1000.0),
)  # fmt: skip
Slips = list[tuple[float, float, Record, int]]
"""Speed [mm/s], force [N], record and pad of each."""
LOADS = {0: 1.0, 1: 0.7}
GRIPPED_S, SLIPS_S, RUN_S, LATEST_S = 0.3, 1.8, 2.3, 0.5
SMOOTH_S = (0.0, 0.01, 0.03)
BURST_MM = 0.1
HOLD_HANDS, HOLD_S, HOLD_SLIPS, FAST_MM_PER_S = (31, 32), 125.0, 4, 10.0
"""Hands of the reporting family in `default` for an hour of grips with chatter: length of the grips of each
hand, and rounds of slips; speed from which the share found is stated."""
ALARMS = ("incipient", "sliding")
DEAD_S = 0.2  # alarms closer than that are one
INK, FAINT, ACCENT = "#1a1a1a", "#8a8a8a", "#1f6fb4"
Rows = list[dict[str, Any]]


def slip_all(world: DrawnWorld, hz: float, repeats: int, seed: int = 0) -> Slips:
    """Speed, force, record and pad of every slip; all speeds and forces go round all pads."""
    found = []
    for repeat in range(repeats):
        from_s, combos = 10.0 * repeat, [(v, f) for v in SPEEDS for f in FORCES]
        combos = combos[repeat % 15 :] + combos[: repeat % 15]
        grips = [
            grip(
                number,
                from_s,
                RUN_S,
                force,
                seed + 100 * repeat,
                slip_mm_per_s=speed,
                slip_from_s=from_s + SLIPS_S,
                slip_load=LOADS[repeat % 2],
            )
            for number, (speed, force) in enumerate(combos)
        ]
        record = run(grips, world, hz, RUN_S, from_s, SLIPS_S - 0.02)
        record.load = LOADS[repeat % 2]
        found += [(speed, force, record, pad) for pad, (speed, force) in enumerate(combos)]
    return found


def hold(world: DrawnWorld, hz: float, seconds: float, burst_mm: float = 0.0, seed: int = 9000) -> Record:
    """A firm grip that doesn't slip; with bursts of chatter of 9 Hz and this amplitude."""
    grips = [grip(k, 0.0, seconds + 1, FORCES[k % 3], seed, burst_mm=burst_mm) for k in range(len(PADS))]
    return run(grips, world, hz, seconds)


def grip(number: int, from_s: float, seconds: float, force_n: float, seed: int, **more: Any) -> GripTouch:
    link, size_mm = PADS[number]
    return GripTouch(
        link=link,
        size_mm=size_mm,
        from_s=from_s + GRIPPED_S,
        duration_s=seconds,
        path=((0.5, 0.5),),
        force_n=(force_n,),
        seed=seed + number,
        **more,
    )


def derivative(record: Record, smooth_s: float) -> FloatArray:
    """(k, pads) relative rate of force, |dF/dt| / F, smoothed: what a plain detector watches."""
    force = np.where(np.isfinite(record.force_n), record.force_n, 0.0)
    dt_s = record.t_s[1] - record.t_s[0]
    part = 1 - math.exp(-dt_s / smooth_s) if smooth_s else 1.0
    smooth, rates = force[0].copy(), np.zeros_like(force)
    for k in range(1, len(force)):
        before = smooth.copy()
        smooth += part * (force[k] - smooth)
        rates[k] = np.abs(smooth - before) / dt_s / np.maximum(smooth, 0.05)
    return rates


def false_per_minute(value: FloatArray, threshold: float, t_s: FloatArray) -> float:
    """Alarms per minute and contact, from a second after the grip closed."""
    held = t_s > GRIPPED_S + 1.0
    minutes = value.shape[1] * float(t_s[-1] - GRIPPED_S - 1.0) / 60
    above = value[held] > threshold
    count = 0
    for pad in range(above.shape[1]):
        last = -1e9
        for at in t_s[held][above[:, pad]].tolist():
            count += at - last > DEAD_S
            last = at
    return float(count / minutes)


def latency_s(value: FloatArray, threshold: float, t_s: FloatArray) -> float:
    """From the onset to the first value above the threshold; inf when none comes in time."""
    after = (t_s > SLIPS_S) & (t_s <= SLIPS_S + LATEST_S)
    above = np.flatnonzero(value[after] > threshold)
    return float(t_s[after][above[0]]) - SLIPS_S if len(above) else math.inf


def bound_s(record: Record, pad: int, mm_per_s: float) -> float:
    """Mean detection time of a ramp of known onset, speed and direction, in tremor as modelled: as
    ln of its likelihood ratio reaches the threshold's (G. Lorden 1971); inf: not in half a second."""
    ages, information = (of[pad] for of in record.information)
    enough = 0.5 * (1e-3 * mm_per_s) ** 2 * information >= math.log(record.samples_per_false_alarm)
    return float(ages[enough].min()) if enough.any() else math.inf


def curve(made: list[tuple[FloatArray, FloatArray]], held: FloatArray, t_s: FloatArray) -> Rows:
    """Thresholds that give many or few false alarms: what share of slips is found then, and how soon."""
    lasting = held[t_s > GRIPPED_S + 1.0]
    parts = [0.5, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999, 0.9995, 0.9998, 0.9999, 0.99995, 1.0]
    thresholds = np.unique(np.quantile(lasting, parts))
    rows = []
    for threshold in thresholds.tolist():
        late = np.array([latency_s(value, threshold, times) for value, times in made])
        rows.append(
            {
                "threshold": threshold,
                "false_per_min": false_per_minute(held, threshold, t_s),
                "found": float(np.isfinite(late).mean()),
                "median_ms": 1e3 * float(np.median(late)),
            }
        )
    return rows


def measure(quick: bool, out: Path) -> dict[str, Any]:
    seconds, burst_s = (10.0, 10.0) if quick else (20.0, 80.0)
    results: dict[str, Any] = {
        "worlds": [],
        "latency": [],
        "curves": {},
        "cost": [],
    }
    results["chatter"] = chatter(quick)
    progress(f"{results['chatter']}")
    for name, hz in CASES[: 3 if quick else None]:
        repeats = 2 if quick or hz > 200 else 4
        made, firm = slip_all(DRAWN[name], hz, repeats), hold(DRAWN[name], hz, min(seconds, 5e3 / hz))
        held, first = false_alarms(firm)
        bursts = false_alarms(hold(DRAWN[name], hz, burst_s, BURST_MM))[0] if hz <= 200 else None
        results["worlds"].append(
            {
                "world": name,
                "Hz": f"{hz:.0f}",
                **slip_score(made).row(),
                "firm grip, contact hours": f"{held.hours:.2f}",
                "its false alarms per hour": str(held),
                "in its first second": first,
                "bursts, contact hours": f"{bursts.hours:.2f}" if bursts else "-",
                "their false alarms per hour": str(bursts) if bursts else "-",
            }
        )
        results["latency"] += latencies(name, hz, made)
        if (name, hz) == ("ideal", 200.0):
            for load, which in ((1.0, "force stays"), (0.7, "force falls to 70 %")):
                results["curves"][which] = curves([slip for slip in made if slip[2].load == load], firm)
        results["cost"].append(cost(hz, firm))
        progress(f"{results['worlds'][-1]}")
        keep(results, out)
    return results


def chatter(quick: bool) -> dict[str, Any]:
    """Return false alarms of an hour of grips with tremor and chatter in `default`, and fast slips found.

    Also the false alarms of published percepts that are `incipient` only.
    """
    hours, false, published, slips, found = 0.0, 0, 0, 0, 0
    for number in HOLD_HANDS[:1] if quick else HOLD_HANDS:
        world = WORLDS["default"].draw(Family.REPORTING.seed(number))
        held = hold(world, 200.0, 5.0 if quick else HOLD_S, BURST_MM, 1000 * number)
        alarms, _ = false_alarms(held)
        hours, false, published = hours + alarms.hours, false + alarms.count, published + percept_alarms(held)
        made = slip_all(world, 200.0, 1 if quick else HOLD_SLIPS, 1000 * number + 500)
        recall = slip_score([slip for slip in made if slip[0] >= FAST_MM_PER_S]).recall
        slips, found = slips + recall.total, found + recall.count
    return {"minutes": 60 * hours, "false": false, "published": published, "slips": slips, "found": found}


def percept_alarms(firm: Record) -> int:
    """Return how often a percept became `incipient` or `sliding`, from a second after the grip closed."""
    count, alarmed = 0, set[str]()
    for percept in firm.percepts:
        raised = percept.label in ALARMS
        late = (percept.t_ns - 10**9) * 1e-9 > GRIPPED_S + 1.0
        count += raised and late and percept.link not in alarmed
        (alarmed.add if raised else alarmed.discard)(percept.link)
    return count


def false_alarms(firm: Record) -> tuple[Rate, int]:
    """Return the false alarms from a second after the grip closed, and their number before."""
    rising = firm.running & ~np.vstack([firm.running[:1], firm.running[:-1]])
    lasting = firm.t_s > GRIPPED_S + 1.0
    hours = rising.shape[1] * float(firm.t_s[-1] - GRIPPED_S - 1.0) / 3600
    return Rate(int(rising[lasting].sum()), hours), int(rising[~lasting].sum())


def slip_score(made: Slips) -> EventScore:
    """Score the alarms of slips: true events are the onsets; the first second of a grip doesn't count."""
    truth, detected, seconds = [], [], 0.0
    for number, (_, _, record, pad) in enumerate(made):
        ran = record.running[:, pad]
        rising = ran & ~np.concatenate([[False], ran[:-1]]) & (record.t_s > GRIPPED_S + 1.0)
        truth.append((number, SLIPS_S))
        detected += [(number, float(t_s)) for t_s in record.t_s[rising & (record.t_s <= SLIPS_S + LATEST_S)]]
        seconds += SLIPS_S - GRIPPED_S - 1.0
    return score_events(truth, detected, hours=seconds / 3600, late_s=LATEST_S)


def latencies(name: str, hz: float, made: Slips) -> Rows:
    rows = []
    for speed in SPEEDS:
        for force in FORCES:
            own = [slip for slip in made if slip[:2] == (speed, force)]
            score = slip_score(own)
            late = np.full(len(own), math.inf)
            late[: len(score.delays_s)] = score.delays_s
            bound = float(np.median([bound_s(record, pad, speed) for _, _, record, pad in own]))
            rows.append(
                {
                    "world": name,
                    "hz": hz,
                    "mm_per_s": speed,
                    "force_n": force,
                    "slips": len(own),
                    "found": score.recall.value,
                    "median_ms": 1e3 * float(np.median(late)),
                    "p90_ms": 1e3 * float(np.quantile(late, 0.9, method="higher")),
                    "bound_ms": 1e3 * bound,
                }
            )
    return rows


def curves(made: list[tuple[float, float, Record, int]], firm: Record) -> dict[str, Rows]:
    """Ours, and the rate of force, smoothed over several times; of forces that saturate no sheet."""
    made = [slip for slip in made if slip[1] < FORCES[-1]]
    light = [pad for pad in range(len(PADS)) if FORCES[pad % 3] < FORCES[-1]]
    ours = [(record.log_odds[:, pad], record.t_s) for _, _, record, pad in made]
    found = {"sequential test": curve(ours, firm.log_odds[:, light], firm.t_s)}
    for smooth_s in SMOOTH_S:
        rates = {id(record): derivative(record, smooth_s) for _, _, record, _ in made}
        plain = [(rates[id(record)][:, pad], record.t_s) for _, _, record, pad in made]
        name = f"rate of force over {1e3 * smooth_s:.0f} ms" if smooth_s else "rate of force"
        found[name] = curve(plain, derivative(firm, smooth_s)[:, light], firm.t_s)
    return found


def cost(hz: float, firm: Record) -> dict[str, Any]:
    """Medians of a tick with all pads touched, and what slip detection and motion percepts add."""
    held = firm.t_s > GRIPPED_S + 1.0
    tick, slip, reports = (
        1e6 * float(np.median(of[held])) for of in (firm.tick_s, firm.slip_s, firm.report_s)
    )
    return {
        "hz": hz,
        "contacts": len(PADS),
        "tick_us": tick,
        "slip_us": slip,
        "slip_p99_us": 1e6 * float(np.quantile(firm.slip_s[held], 0.99)),
        "reports_us": reports,
    }


def draw(results: dict[str, Any], path: Path) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 5.2))
    styles = {0.5: ":", 2.0: "-", 5.0: "--"}
    for hz, colour in ((200.0, ACCENT), (500.0, INK)):
        for force in FORCES:
            rows = [
                row
                for row in results["latency"]
                if (row["world"], row["hz"], row["force_n"]) == ("ideal", hz, force)
            ]
            if rows:
                left.loglog(
                    [row["mm_per_s"] for row in rows],
                    [row["median_ms"] for row in rows],
                    styles[force],
                    color=colour,
                    marker="o",
                    ms=4,
                    label=f"{force:g} N, {hz:.0f} Hz",
                )
    left.set(xlabel="slip speed [mm/s]", ylabel="median latency [ms]", title="From onset to alarm")
    left.legend(frameon=False, fontsize=8)
    colours = (ACCENT, INK, FAINT, "#c46a1b")
    for (slips, named), line in zip(results["curves"].items(), ("-", "--"), strict=True):
        for (name, rows), colour in zip(named.items(), colours, strict=True):
            right.plot(
                [max(row["false_per_min"], 0.03) for row in rows],
                [100 * row["found"] for row in rows],
                line,
                color=colour,
                marker="o",
                ms=4,
                label=f"{name}, {slips}",
            )
    right.set(
        xscale="log",
        xlabel="false alarms per minute and contact (0.03: none)",
        ylabel="slips found within 0.5 s [%]",
        title="At the same rate of false alarms (200 Hz)",
        ylim=(0, 103),
    )
    right.legend(frameon=False, fontsize=7, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.13))
    figure.tight_layout()
    figure.savefig(path, dpi=130)


def at_one_a_minute(rows: Rows) -> dict[str, Any]:
    """The least threshold with one false alarm a minute at most."""
    return next(row for row in rows if row["false_per_min"] <= 1.0)


def table(head: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "| " + " | ".join("---" for _ in head) + " |"]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def report(results: dict[str, Any]) -> str:
    late = [
        [
            row["world"],
            f"{row['hz']:.0f}",
            f"{row['mm_per_s']:g}",
            f"{row['force_n']:g}",
            f"{100 * row['found']:.0f} %",
            f"{row['median_ms']:.0f}",
            f"{row['p90_ms']:.0f}",
            f"{row['bound_ms']:.0f}",
        ]
        for row in results["latency"]
    ]
    held = results["chatter"]
    hour = {
        "contact minutes": f"{held['minutes']:.0f}",
        "false alarms": str(held["false"]),
        "per hour": str(Rate(held["false"], held["minutes"] / 60)),
        "percepts": str(held["published"]),
        "slips": str(held["slips"]),
        "found, %": str(Share(held["found"], held["slips"])),
    }
    worlds = [[str(cell) for cell in row.values()] for row in results["worlds"]]
    roc = [
        [slips, name, f"{row['false_per_min']:.2f}", f"{100 * row['found']:.0f} %", f"{row['median_ms']:.0f}"]
        for slips, named in results["curves"].items()
        for name, rows in named.items()
        for row in [at_one_a_minute(rows)]
    ]
    cost = [
        [f"{row['hz']:.0f}", str(row["contacts"]), f"{row['tick_us']:.0f}", f"{row['slip_us']:.0f}",
         f"{row['slip_p99_us']:.0f}", f"{row['reports_us']:.0f}"]
        for row in results["cost"]
    ]  # fmt: skip
    return f"""# Slip: delay and false alarms

The shipped hand, 15 pads at once, drawn in each [world](../worlds.md) for a seed of the reporting family,
through the daemon's own pipeline and percepts. A grip has tremor: 10 % ripple of force and 15 um of sway,
both of eight tones from 1 to 10 Hz, and the centroid rolls 0.1 mm a newton. In half of the slips the force
stays constant, in half it falls to 70 % within 20 ms. {made_by()}
on {platform.machine()}, Python {platform.python_version()}, {os.cpu_count()}
shared cores.

![latency over speed, and slips found over false alarms](slip.png)

## By world

Sequential test at a stated mean time between false alarms of 600 s. Slips of all speeds and forces, found
within {LATEST_S:g} s of the onset; false alarms before the onset. Then a firm grip, from a second after it
closed; alarms in the second before, while force rises and the tremor isn't learnt yet, are in a column of
their own. *Bursts*: such grips with chatter of 9 Hz and {BURST_MM:g} mm amplitude, 0.6 s in every 2 s. A slip
counts once it has moved farther than such chatter does, {1e3 * GripModel().chatter_m:g} mm or 8 mm/s,
also from where it was in the 0.12 s before its onset, which costs 10 mm/s about 20 ms. Shares in %, rates
per hour of a contact, with 95 % intervals.

{table([*results["worlds"][0]], worlds)}

## An hour of chatter

{len(HOLD_HANDS)} other hands of `default` at 200 Hz hold {len(PADS)} grips each with tremor and these bursts.
Then such grips, without bursts, slip at {FAST_MM_PER_S:g} mm/s and faster; found: within {LATEST_S:g} s of
the onset.

{table([*hour], [[*hour.values()]])}

*Percepts*: times that a published percept became `incipient` or `sliding`, without joint states; `incipient`
has a lower threshold than the alarm.

## From onset to alarm

*Bound*: when ln of the likelihood ratio of a slip of known onset, speed and direction would reach the
threshold in the mean (Lorden), with the test's own estimates of tremor and noise. The test knows none of the
three, and allows for creep and tremor that deviate from the model, at the expense of slow slips.

{table(["world", "Hz", "mm/s", "N", "found", "median ms", "90 % ms", "bound ms"], late)}

## Against a threshold on the derivative of force

All speeds at 0.5 and 2 N together (at 5 N some sheets saturate, and the rate of force is noise), 200 Hz,
world `ideal`; thresholds with at most one false alarm a minute and contact. The rate is relative,
|dF/dt| / F. A slip at constant force shows in no rate of force, and ripple does.

{table(["slips", "detector", "false a minute", "found", "median ms"], roc)}

## Cost

Of a tick with {len(PADS)} contacts: samples to contacts; then, after contacts are sent, the slip stage
and the messages of motion percepts. Medians of processor time. Nothing is called without a
subscriber, as a test shows.

{table(["Hz", "contacts", "tick us", "slip us", "99 % us", "messages us"], cost)}
"""


def keep(results: dict[str, Any], folder: Path) -> None:
    """Write what there is so far: a run takes minutes."""
    finite = json.loads(json.dumps(results).replace("Infinity", "null"))
    (folder / "slip.json").write_text(json.dumps(finite, indent=1) + "\n")
    (folder / "slip.md").write_text(report(results))
    draw(results, folder / "slip.png")


def main() -> None:
    quick = options(__doc__).parse_args().quick
    print(report(measure(quick, output_folder(quick))))


if __name__ == "__main__":
    main()
