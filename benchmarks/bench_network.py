"""Pads with real electrodes: effects of gaps, resistors and noise.

*Effect of gaps*: square, 10 % and more from the edges. *The 336 ohm experiment* of the paper (4.2): square of
12.5 cm, gaps of 7 mm, 2.4 kohm per square, 6 V, a plug of 0.5 mm radius with 200 ohm of contact; bend is the
greatest deviation of x_obs from its least-squares line over +-5.5 cm. *Expected location error*: Cramer-Rao
bound of the root of var x + var y, % of the short side; noise of 1 % of the total on every channel; 10 % of
each side left out; G: conductance between neighbours, for one ohm per square.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.page import Report, options
from handtouch.field import (
    Electrode,
    ElectrodeNetwork,
    Rectangle,
    contact_stack_resistance,
)
from handtouch.field.model import ForwardModel
from handtouch.field.network import SIDES

FloatArray = npt.NDArray[np.float64]
ROOT = Path(__file__).parent.parent
SHEET = 2400.0
PAPER_OHM = 336.0


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
    report.table("Effect of gaps", rows)


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
    report.table("The 336 ohm experiment (paper 4.2)", rows)


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
        ("square, every side in four", divided(1.0, 4)),
        ("3 : 1, ideal", Rectangle(3.0, 1.0)),
        (
            "3 : 1, gaps 0.01 %, 0.1 sheet on the long sides",
            ElectrodeNetwork(3.0, 1.0, 1e-4, SHEET, (0, 0, tenth, tenth)),
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
    report.table("Expected location error", rows)


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


def main() -> None:
    quick = options(__doc__).parse_args().quick
    report = Report(quick)
    for part in (gaps, straightness, noise_cost):
        part(report)
    report.keep()


if __name__ == "__main__":
    main()
