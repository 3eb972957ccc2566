"""Measure pads as they are built: cost and error of networks, resistors, noise, curved pads.

Prints its tables and writes them to docs/benchmarks/network.md and network.json.
"""

from __future__ import annotations

import importlib.util
import itertools
import json
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from benchmarks.page import made_by, options, output_folder
from handtouch.field import (
    ContactLaw,
    Electrode,
    ElectrodeNetwork,
    ForceEstimateStatus,
    Rectangle,
    Sandwich,
    contact_stack_resistance,
)
from handtouch.field.model import ForwardModel
from handtouch.field.network import SIDES

FloatArray = npt.NDArray[np.float64]
ROOT = Path(__file__).parent.parent
SHEET = 2400.0
PAPER_OHM = 336.0


class Report:
    """Tables, printed as they come and kept for the page."""

    def __init__(self, quick: bool) -> None:
        self.quick = quick
        self.page: list[str] = []
        self.data: dict[str, list[dict[str, Any]]] = {}

    def table(self, title: str, note: str, rows: Sequence[dict[str, Any]]) -> None:
        heads = list(rows[0])
        lines = [f"## {title}", "", note, "", "| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
        lines += ["| " + " | ".join(_text(row[head]) for head in heads) + " |" for row in rows]
        print("\n".join(lines), end="\n\n", flush=True)
        self.page += [*lines, ""]
        self.data[title] = list(rows)

    def write(self, out: Path) -> None:
        machine = f"{platform.machine()}, Python {platform.python_version()}, numpy {np.__version__}, "
        machine += f"scipy {scipy.__version__}"
        head = ["# Pads with real electrodes", "", f"{made_by()}; {machine}.", ""]
        (out / "network.md").write_text("\n".join(head + self.page))
        (out / "network.json").write_text(
            json.dumps({"machine": machine, "tables": self.data}, indent=1) + "\n"
        )


def _text(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def microseconds(call: Callable[[], object], repeat: int = 15) -> tuple[float, float]:
    """Median time of a call and half the distance between its quartiles."""
    call()
    once = time.perf_counter()
    call()
    number = max(1, int(5e-3 / max(time.perf_counter() - once, 1e-7)))
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        for _ in range(number):
            call()
        times.append((time.perf_counter() - start) / number * 1e6)
    low, middle, high = statistics.quantiles(times, n=4)
    return middle, (high - low) / 2


def build(report: Report) -> None:
    """Time to build against gap, with what the boundary conditions say of the error."""
    rows = []
    for gap in (0.2, 0.056) if report.quick else (0.2, 0.056, 0.01, 0.002, 1e-4):
        for aspect in (1.0, 3.0):

            def make(gap: float = gap, aspect: float = aspect) -> ElectrodeNetwork:
                return ElectrodeNetwork(aspect, 1.0, gap, SHEET, (PAPER_OHM,) * 4)

            time_us, noise_us = microseconds(make, 7)
            pad = make()
            rows.append(
                {
                    "aspect": aspect,
                    "gap, % of the short side": 100 * gap,
                    "terms per gap": pad._potentials.terms,
                    "build, ms": time_us / 1e3,
                    "+-": noise_us / 1e3,
                    "error on the boundary": boundary_error(pad, gap, aspect),
                    "G asymmetry": float(np.abs(pad.conductance - pad.conductance.T).max()),
                }
            )
    report.table(
        "Building a network",
        "Error: deviation from 1 and 0 on the electrodes and from an insulated gap (normal over "
        "tangential slope). Expansion on the electrodes needs 40 (gap 5.6 %) to 400 (1 %) functions each.",
        rows,
    )


def boundary_error(pad: ElectrodeNetwork, gap: float, aspect: float) -> float:
    along = gap + (aspect - 2 * gap) * np.linspace(0.001, 0.999, 201)
    on_side = pad.ideal_fractions(along, np.zeros_like(along)) - np.array([[0.0], [0.0], [1.0], [0.0]])
    _, slopes = pad.with_series_ohm((0.0,) * 4).fractions_with_jacobian(
        gap * np.linspace(0.02, 0.98, 101), 0.0
    )
    leak = np.abs(slopes[:, 1]).max() / np.abs(slopes[:, 0]).max()
    return float(max(np.abs(on_side).max(), leak))


def gaps(report: Report) -> None:
    """Effect of gaps, and the error of neglecting them."""
    steps = np.linspace(0.1, 0.9, 33)
    x, y = np.meshgrid(steps, steps)
    ideal, rows = Rectangle(1.0, 1.0), []
    for gap in (0.2, 0.1, 0.05, 0.02, 0.01):
        fractions = ElectrodeNetwork(1.0, 1.0, gap, SHEET).currents(x, y)
        taken = ideal.locate(fractions)
        rows.append(
            {
                "gap, %": 100 * gap,
                "largest change of a fraction": float(np.abs(fractions - ideal.side_fractions(x, y)).max()),
                "location off by if ignored, % of the side": float(
                    100 * np.hypot(taken.x - x, taken.y - y).max()
                ),
            }
        )
    report.table("Effect of gaps", "Square, 10 % and more from the edges.", rows)


def evaluate(report: Report) -> None:
    pad = ElectrodeNetwork(1.0, 1.0, 0.05, SHEET, (PAPER_OHM,) * 4)
    rng = np.random.default_rng(1)
    rows = []
    for count in (1, 16) if report.quick else (1, 16, 60, 100_000):
        x, y = rng.uniform(0.03, 0.97, (2, count))
        currents = pad.currents(x, y)
        calls: dict[str, Callable[[], object]] = {
            "currents": lambda x=x, y=y: pad.currents(x, y),  # type: ignore[misc]
            "with jacobian": lambda x=x, y=y: pad.fractions_with_jacobian(x, y),  # type: ignore[misc]
            "spreading radius": lambda x=x, y=y: pad.spreading_radius(x, y),  # type: ignore[misc]
            "locate": lambda c=currents: pad.locate(c),  # type: ignore[misc]
        }
        row: dict[str, Any] = {"contacts": count}
        row |= {f"{name}, us": microseconds(call, 5)[0] for name, call in calls.items()}
        found = pad.locate(currents)
        row["locate: worst error"] = float(np.hypot(found.x - x, found.y - y).max())
        rows.append(row)
    report.table("Using a network", "Unit square, gaps 5 %, 336 ohm; the whole call.", rows)


def weigh(report: Report) -> None:
    """Force of contacts on pads with laws of their own, noise and doubt included."""
    rows, rng = [], np.random.default_rng(2)
    pair = Sandwich((2e-2, 2e-2), (1.0, 2.0), (SHEET, SHEET))
    for count in (1, 15) if report.quick else (1, 15, 60, 100_000):
        layer, force = rng.uniform(1e-2, 3e-2, count), rng.uniform(0.05, 2.0, count)
        law = ContactLaw(layer, np.full(count, 1.5), np.full(count, 2.5e-3), np.full(count, 5e-4))
        current = law.current(force, 5.0, SHEET, 0.017, 50.0)
        both = pair.currents(0.2 * force, 2.5e-3, 5.0, 0.017)
        found = replace(law, radius_std_m=0.0).force(current, 5.0, SHEET, 0.017, 50.0)
        valid = found.status == ForceEstimateStatus.VALID
        calls: dict[str, Callable[[], object]] = {
            "eq. 11": lambda c=layer: contact_stack_resistance(SHEET, c, 2.5e-3, 0.017),  # type: ignore[misc]
            "ContactLaw.force": lambda law=law, i=current: law.force(  # type: ignore[misc]
                i, 5.0, SHEET, 0.017, 50.0, current_std_a=1e-6, spreading_std=0.01, threshold_n=0.02
            ),
            "Sandwich.force": lambda i=both: pair.force(i, 5.0, 0.017),  # type: ignore[misc]
        }
        row: dict[str, Any] = {"contacts": count}
        row |= {f"{name}, us": microseconds(call, 5)[0] for name, call in calls.items()}
        row["force: worst relative error"] = float(np.abs(found.force_n / force - 1)[valid].max())
        rows.append(row)
    report.table("Force of contacts", "The whole call; force by table, without iteration.", rows)


def straightness(report: Report) -> None:
    """The paper's experiment, 4.2: resistors make the log-ratio straighter and the currents smaller."""
    side, points = 0.125, np.linspace(-0.055, 0.055, 45)
    rows = []
    for ohm in (0.0, 100.0, PAPER_OHM, 1000.0):
        pad = ElectrodeNetwork(side, side, 0.007, SHEET, (ohm,) * 4)
        x, y = side / 2 + points, np.full(45, side / 2)
        fractions = pad.currents(x, y)
        observed = np.log(fractions[1] / fractions[0]) / (2 * np.pi)
        line = np.polyfit(points, observed, 1)
        bend = float(np.abs(observed - np.polyval(line, points)).max())
        sheet = contact_stack_resistance(SHEET, 200.0 * np.pi * 5e-4**2, 5e-4, pad.spreading_radius(x, y))
        fall = 1 - sheet / (sheet + pad.series_resistance(x, y))
        rows.append(
            {
                "R, ohm": ohm,
                "bend of x_obs": bend,
                "the same as position, mm": float(1e3 * bend / line[0]),
                "total current falls by, %": f"{100 * fall.min():.1f} - {100 * fall.max():.1f}",
                "side current at centre, mA": float(
                    6.0 / (sheet + pad.series_resistance(x, y))[22] / 4 * 1e3
                ),
            }
        )
    report.table(
        "The 336 ohm experiment (paper 4.2)",
        "Square of 12.5 cm, gaps of 7 mm, 2.4 kohm per square, 6 V, a plug of 0.5 mm radius with 200 ohm of "
        "contact. Bend: greatest deviation of x_obs from its least-squares line over +-5.5 cm. The paper "
        "found 3 times straighter, and half the current, which a resistor of this size doesn't explain.",
        rows,
    )


def expected_error(model: ForwardModel, noise: float = 0.01, margin: float = 0.1) -> FloatArray:
    """Root of var x + var y at the Cramer-Rao bound, over the shorter side, on a grid within the margin."""
    steps = np.linspace(margin, 1 - margin, 33)
    x, y = np.meshgrid(steps * model.a, steps * model.b)
    fractions, jacobian = model.fractions_with_jacobian(x, y)
    columns = np.moveaxis(np.concatenate([jacobian, fractions[:, None]], axis=1), (0, 1), (-2, -1))
    covariance = noise**2 * np.linalg.inv(np.swapaxes(columns, -1, -2) @ columns)
    spread = np.sqrt(covariance[..., 0, 0] + covariance[..., 1, 1])
    return np.asarray(spread / min(model.a, model.b))


def noise_cost(report: Report) -> None:
    """Effect of resistors, gaps, divided sides and anisotropy on noise."""
    tenth = 0.1 * SHEET
    cases: list[tuple[str, ForwardModel]] = [
        ("square, ideal", Rectangle(1.0, 1.0)),
        ("square, gaps 5.6 %", ElectrodeNetwork(1.0, 1.0, 0.056, SHEET)),
        ("square, gaps 5.6 %, 336 ohm", ElectrodeNetwork(1.0, 1.0, 0.056, SHEET, (PAPER_OHM,) * 4)),
        ("square, gaps 5.6 %, 1 kohm", ElectrodeNetwork(1.0, 1.0, 0.056, SHEET, (1000.0,) * 4)),
        ("square, gaps 20 %", ElectrodeNetwork(1.0, 1.0, 0.2, SHEET)),
        ("square, every side in two", divided(1.0, 2)),
        ("square, every side in four", divided(1.0, 4)),
        ("1.77 : 1, ideal", Rectangle(1.77, 1.0)),
        ("3 : 1, ideal", Rectangle(3.0, 1.0)),
        ("3 : 1, gaps 5 %", ElectrodeNetwork(3.0, 1.0, 0.05, SHEET)),
        (
            "3 : 1, gaps 0.01 %, 0.1 sheet on the long sides",
            ElectrodeNetwork(3.0, 1.0, 1e-4, SHEET, (0, 0, tenth, tenth)),
        ),
        (
            "3 : 1, gaps 5 %, 0.1 sheet on the long sides",
            ElectrodeNetwork(3.0, 1.0, 0.05, SHEET, (0, 0, tenth, tenth)),
        ),
        ("3 : 1, long sides in three", divided(3.0, 1, 3)),
    ]
    rows = [
        {
            "pad": name,
            "G": neighbours(model),
            "median, %": float(100 * np.median(error)),
            "worst, %": float(100 * error.max()),
        }
        for name, model, error in ((name, model, expected_error(model)) for name, model in cases)
    ]
    stretched = expected_error_anisotropic(3.0)
    rows.append(
        {
            "pad": "3 : 1, anisotropic to be electrically square",
            "G": "",
            "median, %": float(100 * np.median(stretched)),
            "worst, %": float(100 * stretched.max()),
        }
    )
    report.table(
        "Expected location error",
        "Cramer-Rao bound of the root of var x + var y, % of the short side; noise of 1 % of the total "
        "on every channel; 10 % of each side left out. G: conductance between neighbours, for one ohm per "
        "square. It grows without limit as gaps close, and with it the mixing by resistors, and their cost.",
        rows,
    )


def neighbours(model: ForwardModel) -> float | str:
    """Conductance between electrodes x0 and y0; nothing to say of divided sides, or without gaps."""
    if isinstance(model, ElectrodeNetwork) and len(model.series_ohm) == len(SIDES):
        return float(-model.conductance[0, 2])
    return ""


def divided(aspect: float, across: int, along: int | None = None) -> ElectrodeNetwork:
    """A pad whose x sides are cut into `across` pieces and whose y sides into `along`; all gaps 2 %."""
    pieces = []
    for side in SIDES:
        length, count = (1.0, across) if side[0] == "x" else (aspect, along or across)
        cuts = np.linspace(0.01, length - 0.01, count + 1)
        pieces += [Electrode(side, low + 0.01, high - 0.01) for low, high in itertools.pairwise(cuts)]
    return ElectrodeNetwork.from_sides(aspect, 1.0, pieces, SHEET)


def expected_error_anisotropic(aspect: float) -> FloatArray:
    """On the electrically square rectangle, errors along x carried back to the pad."""
    model = Rectangle(1.0, 1.0)
    steps = np.linspace(0.1, 0.9, 33)
    x, y = np.meshgrid(steps, steps)
    fractions, jacobian = model.fractions_with_jacobian(x, y)
    columns = np.moveaxis(np.concatenate([jacobian, fractions[:, None]], axis=1), (0, 1), (-2, -1))
    covariance = 0.01**2 * np.linalg.inv(np.swapaxes(columns, -1, -2) @ columns)
    return np.asarray(np.sqrt(aspect**2 * covariance[..., 0, 0] + covariance[..., 1, 1]))


def curved(report: Report) -> None:
    """Conformal map and shortcut against the finite elements of the tests."""
    spec = importlib.util.spec_from_file_location("fem", ROOT / "tests" / "field" / "test_fem.py")
    assert spec is not None
    assert spec.loader is not None
    fem = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(fem)
    rows = []
    for name, shape in (("cone", fem.CONE), ("sphere", fem.SPHERE)):
        surface = shape.surface
        exact, flat = Rectangle(surface.a, surface.b), Rectangle(*surface.extent_m)
        places = [fem.mapped(shape, at) for at in fem.INSIDE]
        answer = np.stack([exact.side_fractions(*place) for place in places])
        shortcut = np.stack([flat.side_fractions(at[0] * flat.a, at[1] * flat.b) for at in fem.INSIDE])
        for cells in (16,) if report.quick else (16, 32, 64, 128):
            elements = np.stack([fem.collected(shape, cells, at) for at in fem.INSIDE])
            wrong = flat.locate(elements.T)
            off = [
                np.hypot(float(wrong.x[i]) - at[0] * flat.a, float(wrong.y[i]) - at[1] * flat.b)
                for i, at in enumerate(fem.INSIDE)
            ]
            rows.append(
                {
                    "surface": name,
                    "mesh": f"{cells} x {cells}",
                    "elements - conformal map": float(np.abs(elements - answer).max()),
                    "elements - shortcut": float(np.abs(elements - shortcut).max()),
                    "shortcut's location off by, mm": float(1e3 * max(off)),
                }
            )
    report.table(
        "Curved pads",
        "Largest difference of a fraction, three places. The approximation is the rectangle of the pad's "
        "length and its mid-length arc (20 x 17 mm and 13 x 18 mm).",
        rows,
    )


def main() -> None:
    quick = options(__doc__).parse_args().quick
    report = Report(quick)
    for part in (build, gaps, evaluate, weigh, straightness, noise_cost, curved):
        part(report)
    report.write(output_folder(quick))


if __name__ == "__main__":
    main()
