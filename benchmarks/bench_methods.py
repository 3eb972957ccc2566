"""Run time against error of every way to locate a contact, and where the compiled core stands among them.

On an ideal pad, on one with gaps and series resistors (both without noise, exact currents), and in the world
`default`, whose tolerances and noise no way knows; for 1, 15, 60 and 960 contacts in one call and in bulk.
Writes docs/benchmarks/methods.{md,json,png}.
"""

from __future__ import annotations

import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from tests.exact_pads import ExactPads

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import matplotlib
import numpy as np
import scipy
from numpy.typing import NDArray

from benchmarks.locators import CORE_PADS, LENGTH_MM, WAYS, WIDTH_MM, Locator, Setup
from benchmarks.oracle import PadOracle
from benchmarks.page import made_by, options, output_folder, table
from benchmarks.scores import laplace_covariance
from handtouch.core.stages import solve
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, Family, MountSpread

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

FloatArray = NDArray[np.float64]
CALLS = (1, 15, 60, 960)
BULK = 20_000
MARGIN = 0.05
TOTAL_A = 1e-3
"""Current of a contact: about that of a touch of 1 N on this pad."""
SLIDE_M = 1e-4
"""Between two samples: 20 mm/s at 200 Hz."""
BATCH_S, BATCHES, FEW_BATCHES = 0.02, 15, 3
IDEAL, BUILT = Setup(0.0, 0.0), Setup(1.2, 120.0)
WORLD_PADS, WORLD_TOUCHES, STEP_S = 30, 40, 0.5
FORCES_N = (0.5, 5.0)
COLOURS = {"core": "#c23b22", "handtouch": "#1f6fb4", "paper": "#8a8a8a", "instead": "#e08214"}
LEGEND = {
    "core": "the daemon's core",
    "handtouch": "other ways in handtouch",
    "paper": "the paper's",
    "instead": "what one would take instead",
}
MIN_SHOWN_MM = 1e-16


@dataclass(frozen=True)
class Case:
    """Contacts on pads of one setup: currents (4, n) [A]; `error_m` returns the errors (n,) of positions."""

    name: str
    setup: Setup
    currents: FloatArray
    error_m: Callable[[FloatArray, FloatArray], FloatArray]
    floors_mm: dict[str, float]
    """Rms errors that no way can beat, by cause."""


@dataclass(frozen=True)
class Row:
    """One way in one case: errors [mm], microseconds a contact by contacts in a call, spread in %."""

    case: str
    method: str
    kind: str
    contacts: int
    rms_mm: float
    median_mm: float
    worst_mm: float
    no_answer_percent: float
    us_per_contact: dict[str, float]
    spread_percent: float


def position_bound_mm(setup: Setup, x: FloatArray, y: FloatArray, total_a: float) -> float:
    """Return the rms Cramer-Rao bound of positions from the noise of the channels."""
    fractions, jacobian = setup.pad.fractions_with_jacobian(x, y)
    design = np.moveaxis(np.concatenate([total_a * jacobian, fractions[:, None]], axis=1), 2, 0)
    covariance = laplace_covariance(design, setup.noise_a[:, 0], np.full(3, np.inf))[:, :2, :2]
    return 1e3 * float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean()))


def positions(setup: Setup, count: int, seed: int) -> tuple[FloatArray, FloatArray]:
    """Return random positions x, y (count,) [m], 5 % of a side and farther from the edges."""
    rng, sides = np.random.default_rng(seed), np.array([[setup.pad.a], [setup.pad.b]])
    x, y = sides * rng.uniform(MARGIN, 1 - MARGIN, (2, count))
    return x, y


def exact_case(name: str, setup: Setup, count: int) -> Case:
    """Return contacts whose currents are those of the exact field."""
    x, y = positions(setup, count, 0)

    def error_m(found_x: FloatArray, found_y: FloatArray) -> FloatArray:
        return np.hypot(found_x - x[: len(found_x)], found_y - y[: len(found_y)])

    floor = {"noise of the channels": position_bound_mm(setup, x, y, TOTAL_A)}
    return Case(name, setup, TOTAL_A * setup.pad.fractions(x, y), error_m, floor)


def world_case(setup: Setup, pads: int, touches: int) -> Case:
    """Return touches in the world `default`, simulated by finite elements: one sample of each."""
    deployment, world = setup.deployment(pads), replace(WORLDS["default"], mounts=MountSpread())
    drawn = world.with_sheets().draw(Family.REPORTING.seed(0))  # sheets change the force, no position
    hand_name, entries = deployment.hands[0].name, deployment.hands[0].pads
    rng, (low, high) = np.random.default_rng((drawn.seed, 6)), np.log(FORCES_N)
    scenario = Scenario(
        touch=tuple(
            ScenarioTouch(
                link=pad.link,
                from_s=1.0 + k * STEP_S,
                duration_s=0.4,
                path=((float(x), float(y)),),
                force_n=(float(np.exp(force)),),
            )
            for k in range(touches)
            for pad in entries
            for x, y, force in [(*rng.uniform(MARGIN, 1 - MARGIN, 2), rng.uniform(low, high))]
        )
    )
    hand = VirtualHand(deployment, scenario, drawn)
    times_s = 1.2 + STEP_S * np.arange(touches)
    counts = np.stack([hand.counts(row, times_s) for row in range(pads)], axis=1)  # (touches, pads, 4)
    truth = [{record.link: record for record in hand.truth(t_s)} for t_s in times_s.tolist()]
    points = np.array([[by_link[pad.link].position_m for pad in entries] for by_link in truth])
    model, flat = setup.model, points.reshape(-1, 3)
    exact = ExactPads(setup.deployment(CORE_PADS), model)
    currents = np.ascontiguousarray((counts * model.ampere_per_count[0]).reshape(-1, 4).T)

    def error_m(x: FloatArray, y: FloatArray) -> FloatArray:
        n = len(x)
        position_m = exact.position_m(np.zeros(n, np.intp), x, y)
        return np.asarray(np.linalg.norm(position_m - flat[:n], axis=1))

    variance, noise = [], []
    for row, pad in enumerate(entries):
        oracle = PadOracle.build(drawn, deployment, hand_name, pad, model.noise_a[0])
        own = [by_link[pad.link] for by_link in truth]
        u, v, force = np.array([(record.u_m, record.v_m, record.force_n) for record in own]).T
        variance.append(np.trace(oracle.covariances(u, v, force).position_m2, axis1=1, axis2=2))
        noise += [record.bound_m for record in own]
        print(f"world default: oracle of pad {row + 1} of {pads}", flush=True)
    floors = {
        "tolerances and noise": 1e3 * float(np.sqrt(np.mean(variance))),
        "noise of the channels": 1e3 * float(np.sqrt(np.mean(np.square(noise)))),
    }
    return Case("world default", setup, currents, error_m, floors)


def microseconds(call: Callable[[], Any], most: int) -> tuple[float, float]:
    """Return the median processor time of a call, and half its quartiles' distance in per cent."""
    begin = time.process_time()
    call()
    number = max(1, int(BATCH_S / max(time.process_time() - begin, 1e-6)))
    samples = []
    for _ in range(most if number > 1 else min(most, FEW_BATCHES)):
        begin = time.process_time()
        for _ in range(number):
            call()
        samples.append((time.process_time() - begin) / number * 1e6)
    middle = statistics.median(samples)
    low, high = np.percentile(samples, [25, 75])
    return middle, 100 * float(high - low) / 2 / middle


def times(setup: Setup, name: str, locate: Locator, quick: bool) -> tuple[dict[str, float], float]:
    """Return microseconds a contact by number of contacts, and the largest spread in %.

    Two samples take turns between which contacts slide by 0.1 mm.
    """
    way, found, spreads = WAYS[name], dict[str, float](), []
    slow = way.samples < max(CALLS)
    for count in CALLS[: 2 if slow or quick else None]:
        x, y = positions(setup, count, 2)
        pair = [np.ascontiguousarray(TOTAL_A * setup.pad.fractions(x + shift, y)) for shift in (0.0, SLIDE_M)]

        def both(pair: Sequence[FloatArray] = pair) -> None:
            locate(pair[0])
            locate(pair[1])

        us, spread = microseconds(both, 1 if quick else BATCHES)
        found[str(count)] = us / 2 / count
        spreads.append(spread)
    if not slow and not quick and "tracked" not in name:
        bulk = TOTAL_A * setup.pad.fractions(*positions(setup, BULK, 3))
        us, spread = microseconds(partial(locate, bulk), FEW_BATCHES)
        found["bulk"] = us / BULK
        spreads.append(spread)
    return found, max(spreads)


def errors_mm(case: Case, name: str, locate: Locator) -> FloatArray:
    """Return the errors (n,) of a way in a case, NaN without a position; positions are clipped to the pad."""
    currents = case.currents[:, : WAYS[name].samples]
    with np.errstate(all="ignore"):
        x, y = locate(currents)
    clipped = np.clip(x, 0, case.setup.pad.a), np.clip(y, 0, case.setup.pad.b)
    return 1e3 * case.error_m(*clipped)


def measure(cases: Sequence[Case], quick: bool) -> list[Row]:
    """Return the rows of all ways; cases of one setup share its tables and run times."""
    rows: list[Row] = []
    for setup in dict.fromkeys(case.setup for case in cases):
        for name, way in WAYS.items():
            if way.ideal_only and setup != IDEAL:
                continue
            began = time.monotonic()
            locate = way.make(setup)
            us, spread = times(setup, name, locate, quick)
            for case in (case for case in cases if case.setup == setup):
                error = errors_mm(case, name, locate)
                known = error[np.isfinite(error)]
                rows.append(
                    Row(
                        case.name, name, way.kind, len(error), float(np.sqrt(np.mean(known**2))),
                        float(np.median(known)), float(known.max()),
                        100 * (1 - len(known) / len(error)), us, spread,
                    )
                )  # fmt: skip
                print(
                    f"{case.name}: {name}: rms {rows[-1].rms_mm:.2g} mm; "
                    + ", ".join(f"{count}: {t:.3g} us" for count, t in us.items())
                    + f"; {time.monotonic() - began:.0f} s",
                    flush=True,
                )
    return rows


def section(case: Case, rows: Sequence[Row]) -> list[str]:
    floors = "; ".join(f"{name} {value:.3g} mm" for name, value in case.floors_mm.items())
    cells = [
        {
            "way": row.method,
            "rms, mm": f"{row.rms_mm:.1e}",
            "median": f"{row.median_mm:.1e}",
            "worst": f"{row.worst_mm:.1e}",
            "no answer, %": f"{row.no_answer_percent:.2g}",
            **{
                f"us each, {count}": f"{row.us_per_contact[key]:.3g}" if key in row.us_per_contact else ""
                for count, key in [*((f"{n} in a call", str(n)) for n in CALLS), ("bulk", "bulk")]
            },
            "spread, %": f"{row.spread_percent:.0f}",
        }
        for row in rows
        if row.case == case.name
    ]
    note = f"{case.currents.shape[1]} contacts. Least rms error: {floors}."
    return table(case.name.capitalize(), note, cells)


def draw(cases: Sequence[Case], rows: Sequence[Row], path: Path) -> None:
    """Draw a panel per case: each way is a line from its cost for single contacts to that in bulk."""
    figure, panels = plt.subplots(1, len(cases), figsize=(18, 7.5), layout="constrained")
    for axes, case in zip(panels, cases, strict=True):
        own = [row for row in rows if row.case == case.name]
        for row in own:
            draw_way(axes, row)
        axes.axhspan(1e-17, max(case.floors_mm.values()), color="#2e8b57", alpha=0.06, lw=0)
        for (name, floor), style in zip(case.floors_mm.items(), ("-", ":"), strict=False):
            axes.axhline(floor, color="#2e8b57", lw=1.2, ls=style, zorder=0)
            axes.annotate(
                f"{name}: {floor:.2g} mm", (0.995, floor), xycoords=("axes fraction", "data"), ha="right",
                va="bottom", fontsize=8, color="#2e8b57",
            )  # fmt: skip
        axes.set(xscale="log", yscale="log", xlabel="microseconds a contact", title=case.name)
        shown = [row.rms_mm for row in own] + list(case.floors_mm.values())
        axes.set_ylim(max(min(shown), MIN_SHOWN_MM) / 2, 2 * max(shown))
        axes.grid(alpha=0.25)
        axes.margins(x=0.12)
        label_ways(axes, own)
    panels[0].set_ylabel(f"rms error, mm, on a pad of {LENGTH_MM:g} x {WIDTH_MM:g} mm (5 % margin)")
    for kind, words in LEGEND.items():
        panels[0].plot([], [], "o-", color=COLOURS[kind], label=words)
    figure.legend(loc="outside lower center", ncols=4, frameon=False)
    figure.suptitle(
        "Ways to locate a contact. Dots from right to left: 1, 15, 60, 960 contacts in a call, bulk (ring). "
        "Shaded: below the noise or the tolerances"
    )
    figure.savefig(path, dpi=100)
    plt.close(figure)


def draw_way(axes: Axes, row: Row) -> None:
    us, height = list(row.us_per_contact.values()), max(row.rms_mm, MIN_SHOWN_MM)
    is_core = row.kind == "core"
    axes.plot(
        us, [height] * len(us), "o-", color=COLOURS[row.kind], ms=6 if is_core else 4,
        lw=2.5 if is_core else 1.2, zorder=3 if is_core else 2,
    )  # fmt: skip
    if "bulk" in row.us_per_contact:
        axes.plot(
            row.us_per_contact["bulk"], height, "o", ms=9, mfc="none", color=COLOURS[row.kind], zorder=4
        )


def label_ways(axes: Axes, rows: Sequence[Row]) -> None:
    """Write the names in a column right of the points, at least a line apart, with a thin leader."""
    ordered = sorted(rows, key=lambda row: row.rms_mm)
    low, high = np.log10(axes.get_ylim())
    wanted = np.array([(np.log10(max(row.rms_mm, MIN_SHOWN_MM)) - low) / (high - low) for row in ordered])
    gap = 0.03
    heights = wanted.copy()
    for k in range(1, len(heights)):
        heights[k] = max(heights[k], heights[k - 1] + gap)
    if (excess := heights[-1] - 0.985) > 0:
        heights[-1] -= excess
        for k in range(len(heights) - 2, -1, -1):
            heights[k] = min(heights[k], heights[k + 1] - gap)
    for row, height in zip(ordered, heights.tolist(), strict=True):
        axes.annotate(
            row.method, (max(row.us_per_contact.values()), max(row.rms_mm, MIN_SHOWN_MM)),
            xytext=(1.015, height), textcoords="axes fraction", fontsize=8, va="center",
            color=COLOURS[row.kind], weight="bold" if row.kind == "core" else "normal",
            arrowprops={"arrowstyle": "-", "lw": 0.5, "color": COLOURS[row.kind], "alpha": 0.6},
            annotation_clip=False,
        )  # fmt: skip


def findings(cases: Sequence[Case], rows: Sequence[Row]) -> list[str]:
    """Return what the figures say of core and exact inverse, beside the alternatives."""
    by = {(row.case, row.method): row for row in rows}
    best, fit = by["ideal pad", "exact inverse"], by["ideal pad", "least_squares, eqs. 4-5"]
    one = {name: by["gaps and resistors", name] for name in ("core, new contacts", "core, tracked contacts")}
    rival = by["gaps and resistors", "least_squares, exact field"]
    new, tracked = one.values()
    default, floors = by["world default", "core, new contacts"], cases[-1].floors_mm
    least, noise = floors.values()
    side_mm, each = min(LENGTH_MM, WIDTH_MM), best.us_per_contact.get("bulk", np.nan)
    return [
        f"* Core, 15 contacts in a call: {15 * new.us_per_contact['15']:.3g} us if new, "
        f"{15 * tracked.us_per_contact['15']:.3g} us if tracked; least_squares on the same field takes "
        f"{rival.us_per_contact['1'] / new.us_per_contact['15']:.0f} times as long as for new ones.",
        f"* Exact inverse on the ideal pad: worst error {best.worst_mm / side_mm:.0e} of a side, {each:.2g} "
        f"us each in bulk, {fit.us_per_contact['15'] / each:.0f} times faster than "
        f"least_squares on the paper's sums (worst error {fit.worst_mm / side_mm:.0e}).",
        f"* World `default`: rms error of the core {default.rms_mm:.2g} mm, of an oracle {least:.2g} "
        f"mm, from noise alone {noise:.2g} mm. There calibration matters more than "
        "the method, as long as it models gaps and resistors.",
    ]


HEAD = """\
A plane pad of {length:g} x {width:g} mm. *Ideal*: no gaps, no resistors; *gaps and resistors*: {gap:g} mm
bare at each end of an electrode, {ohm:g} ohm in series with each, all known; both without noise, exact
currents, and so the error is the method's own. *World default*: the same file, {pads} pads drawn for a
seed of the reporting family, {low:g} to {high:g} N, simulated by finite elements with noise and
quantisation: nothing that was drawn is known. All errors are of contacts 5 % of a side and farther from
the edges; positions off the pad are clipped to it. The paper's ways and the interpolator assume an ideal
pad.

* Microseconds are processor time per contact, medians; spread: half the distance of quartiles, the
  largest of the columns. least_squares takes one contact after the other and is timed for up to 15. Core:
  the daemon's stages ({compiled}), with covariance and place on the link, in calls of {core} contacts at
  most; *tracked*: from the last position, 0.1 mm away. Bulk: {bulk} contacts.
* Green lines: rms of the least error by noise (Cramer-Rao, at {total:g} mA), and of an oracle that knows
  the distributions of all tolerances, but no values. In the shaded area an error doesn't matter.
  Formulations of the exact inverse that were rejected are in [formulations](formulations.md)."""


def main() -> None:
    quick = options(__doc__).parse_args().quick
    count = 300 if quick else 20_000
    cases = [
        exact_case("ideal pad", IDEAL, count),
        exact_case("gaps and resistors", BUILT, count),
        world_case(BUILT, 2 if quick else WORLD_PADS, 5 if quick else WORLD_TOUCHES),
    ]
    rows = measure(cases, quick)
    compiled = "compiled" if solve.__file__.endswith(".so") else "NOT compiled"
    machine = (
        f"{os.cpu_count()} x {platform.machine()}, Python {platform.python_version()}, numpy "
        f"{np.__version__}, scipy {scipy.__version__}; load average {os.getloadavg()[0]:.1f}"
    )
    head = HEAD.format(
        length=LENGTH_MM, width=WIDTH_MM, gap=BUILT.gap_mm, ohm=BUILT.series_ohm, pads=WORLD_PADS,
        low=FORCES_N[0], high=FORCES_N[1], compiled=compiled, core=BUILT.model.size, bulk=BULK,
        total=1e3 * TOTAL_A,
    )  # fmt: skip
    page = [
        "# Run time against error of location",
        "",
        f"{made_by()}; {machine}.",
        "",
        *findings(cases, rows),
        "",
    ]
    page += ["![run time and error](methods.png)", "", head, ""]
    for case in cases:
        page += section(case, rows)
    out = output_folder(quick)
    (out / "methods.md").write_text("\n".join(page))
    record = {
        "machine": machine,
        "floors_mm": {case.name: case.floors_mm for case in cases},
        "rows": [asdict(row) for row in rows],
    }
    (out / "methods.json").write_text(json.dumps(record, indent=1) + "\n")
    draw(cases, rows, out / "methods.png")


if __name__ == "__main__":
    main()
