"""Measure how far apart two contacts must be, and what switched resistors add, against the electrodes.

Prints its tables and writes docs/benchmarks/resolution.md, resolution.json and resolution.png.
"""

from __future__ import annotations

import json
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray
from page import made_by, options, output_folder, progress, table
from scipy.special import chdtri, chndtr
from scores import Share

from handtouch.field import (
    ContactShape,
    Electrode,
    ElectrodeNetwork,
    SwitchedNetwork,
    estimate,
    resolve_contacts,
)
from handtouch.field.model import ForwardModel
from handtouch.field.network import SIDES, Side

matplotlib.use("Agg")
from matplotlib import pyplot as plt

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Row = dict[str, Any]

SIDE = 20.0  # mm
SHEET = 2400.0
GAP = 0.2  # mm, bare at each end of an electrode
NOISE = 1e-4  # of the total, on each channel
FALSE_ALARM, DETECTION = 1e-3, 0.9
GAIN_STD, GAP_STD, ANISOTROPY_STD = 0.012, 0.12, 0.02  # mm for the gap; the defaults of deployments
ELECTRODES = {4: (1, 1), 6: (1, 2), 8: (2, 2), 12: (3, 3)}  # on each of x0 and xa, and of y0 and yb
SEPARATIONS = SIDE * np.geomspace(0.01, 0.75, 24)
MARGIN = 0.1  # of the side, of centres from the boundary
MAX_POWER = 12  # of the separation, to which the deviation is proportional
TIME_PERIODS = 16
LINE_LENGTH = 4.0  # mm
EVEN_NODES = (np.arange(16) + 0.5) / 8 - 1  # of a line
PAIR_NODES = np.array([-1.0, 1.0])
RESISTOR = SHEET
_BOOTSTRAPS = 2000


def divided(
    along_x: int, along_y: int, gaps: FloatArray | None = None, stretch: float = 1.0
) -> ElectrodeNetwork:
    """A square whose sides x0 and xa have `along_x` electrodes each, y0 and yb `along_y`.

    gaps: changes of the ends of all electrodes (electrodes, 2). stretch: of x, by the root of an anisotropy.
    """
    ends: list[tuple[Side, float, float]] = []
    for side, parts in zip(SIDES, (along_x, along_x, along_y, along_y), strict=True):
        pitch = SIDE / parts
        ends += [(side, k * pitch + GAP, (k + 1) * pitch - GAP) for k in range(parts)]
    moved = np.zeros((len(ends), 2)) if gaps is None else gaps
    electrodes = [
        Electrode(side, *(np.add((start, stop), move) * (stretch if side[0] == "y" else 1.0)))
        for (side, start, stop), move in zip(ends, moved, strict=True)
    ]
    return ElectrodeNetwork.from_electrodes(SIDE * stretch, SIDE, electrodes, SHEET)


def tolerance_std(parts: tuple[int, int], x: FloatArray, y: FloatArray) -> FloatArray:
    """Standard deviation of each fraction (channels, n) by gains, gaps and anisotropy of parts."""
    exact = divided(*parts).fractions(x, y)
    variance = (GAIN_STD * exact) ** 2
    for index in np.ndindex(len(exact), 2):
        moved = np.zeros((len(exact), 2))
        moved[index] = GAP_STD if index[1] == 0 else -GAP_STD
        variance += (divided(*parts, gaps=moved).fractions(x, y) - exact) ** 2
    stretch = 1 + ANISOTROPY_STD / 2
    return np.sqrt(variance + (divided(*parts, stretch=stretch).fractions(stretch * x, y) - exact) ** 2)


def needed_deviation(freedom: int) -> float:
    """Return the non-centrality that a test with a false-alarm rate detects with a probability."""
    low, high, threshold = 0.0, 1e4, chdtri(freedom, FALSE_ALARM)
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if chndtr(threshold, freedom, middle) < 1 - DETECTION else (middle, high)
    return high


def resolved_separations(
    model: ForwardModel, x: FloatArray, y: FloatArray, angle: FloatArray, noise: FloatArray | float
) -> tuple[FloatArray, FloatArray]:
    """Return the separations (n,) from which on equal pairs are more than a point, and two contacts.

    Infinite where they leave the pad first. noise: per total, (channels, n) or a number.
    """
    half = SEPARATIONS[:, None] / 2 * np.exp(1j * angle)
    currents = model.fractions(x + half.real, y + half.imag) + model.fractions(x - half.real, y - half.imag)
    channels = len(currents)
    on_pad = np.isfinite(currents[0])
    sigma = np.broadcast_to(
        np.asarray(noise).reshape(-1, 1, 1 if np.ndim(noise) < 2 else len(x)), currents.shape
    )
    deviation = np.full((2, *on_pad.shape), np.nan)
    shared = currents[:, on_pad] / 2, sigma[:, on_pad]
    if getattr(model, "independent_channels", channels) < 5:
        deviation[0, on_pad] = estimate(model, *shared).chi_squared
        freedom = 1
    else:
        found = resolve_contacts(model, *shared, 1e-12)
        deviation[0, on_pad] = found.line_ratio
        freedom = 2
        if found.pair is not None:
            deviation[1, on_pad] = found.line.chi_squared
    return tuple(  # type: ignore[return-value]
        np.array([_crossing(column, needed_deviation(k)) for column in rows.T])
        for rows, k in ((deviation[0], freedom), (deviation[1], 1))
    )


def _crossing(deviation: FloatArray, needed: float) -> float:
    """Return the separation from which on all have the needed deviation, which goes by powers of it."""
    known = np.isfinite(deviation)
    first = np.flatnonzero(known & (deviation < needed)).max(initial=-1) + 1
    if first == len(deviation) or not known[first]:
        return np.inf
    if first == 0:
        return float(SEPARATIONS[0])
    logs = np.log(np.maximum(deviation[first - 1 : first + 1], 1e-12))
    power = (logs[1] - logs[0]) / np.log(SEPARATIONS[first] / SEPARATIONS[first - 1])
    if power > MAX_POWER:  # a jump, where the line that is equivalent would leave the pad
        return float(SEPARATIONS[first])
    place = (np.log(needed) - logs[0]) / (logs[1] - logs[0])
    return float(SEPARATIONS[first - 1] * (SEPARATIONS[first] / SEPARATIONS[first - 1]) ** place)


def interval(values: FloatArray, scale: float = 1.0) -> str:
    """Return the median with its 95 % interval by bootstrap over positions."""
    draws = np.random.default_rng(0).integers(0, len(values), (_BOOTSTRAPS, len(values)))
    medians = np.quantile(values[draws], 0.5, axis=1, method="inverted_cdf")
    low, high = np.quantile(medians, [0.025, 0.975], method="inverted_cdf") * scale
    middle = np.quantile(values, 0.5, method="inverted_cdf") * scale
    return "-" if not np.isfinite(middle) else f"{middle:.3g} ({low:.3g}-{high:.3g})"


def quantile(values: FloatArray, at: float) -> str:
    found = np.quantile(values, at, method="inverted_cdf")
    return f"{found:.3g}" if np.isfinite(found) else "-"


def random_pairs(count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    rng = np.random.default_rng(7)
    x, y = rng.uniform(MARGIN, 1 - MARGIN, (2, count)) * SIDE
    return x, y, rng.uniform(0, np.pi, count)


def resolution(count: int) -> list[Row]:
    """Separations over random positions and directions, with noise alone and with tolerances."""
    rows = []
    x, y, angle = random_pairs(count)
    for number, parts in ELECTRODES.items():
        model = divided(*parts)
        for name, noise in (
            ("noise 1e-4", NOISE),
            ("noise 1e-4, tolerances", np.hypot(NOISE, tolerance_std(parts, x, y))),
        ):
            longer, two = resolved_separations(model, x, y, angle, noise)
            rows.append(
                {
                    "electrodes": number,
                    "errors": name,
                    "more than a point: median, mm": interval(longer),
                    "90 % of positions": quantile(longer, 0.9),
                    "two contacts: median, mm": interval(two),
                    "90 % of positions ": quantile(two, 0.9),
                }
            )
            progress(f"{number} electrodes, {name}")
    return rows


def reported_shapes(
    model: ForwardModel, at: ComplexArray, half: ComplexArray, nodes: FloatArray, rate: float
) -> NDArray[np.int8]:
    """Return shapes reported of contacts (n,) at nodes, in half their length, of currents with noise."""
    points = at + nodes[:, None] * half
    currents = model.fractions(points.real, points.imag).mean(axis=1)
    inside = np.isfinite(currents[0])
    noise = np.random.default_rng(5).normal(size=(len(currents), int(inside.sum())))
    return np.asarray(resolve_contacts(model, currents[:, inside] + NOISE * noise, NOISE, rate).shape)


def trials(count: int) -> list[Row]:
    """Rates at which simulated currents with noise are reported as each shape."""
    rows = []
    for number in (6, 8, 12):
        model = divided(*ELECTRODES[number])
        x, y, angle = random_pairs(count)
        at, direction = x + 1j * y, np.exp(1j * angle)
        points = reported_shapes(model, at, 0 * direction, np.zeros(1), 0.01)
        lines = reported_shapes(model, at, LINE_LENGTH / 2 * direction, EVEN_NODES, 0.01)
        separations = resolved_separations(model, x, y, angle, NOISE)
        longer, two = (
            reported_shapes(
                model, at, np.where(np.isfinite(s), s, 0) / 2 * direction, PAIR_NODES, FALSE_ALARM
            )
            for s in separations
        )
        possible = [np.isfinite(s) for s in separations]
        rows.append(
            {
                "electrodes": number,
                "points not reported as such, % (1 stated)": str(Share.of_mask(points != ContactShape.POINT)),
                "lines of 4 mm reported as two, % (at most 1)": str(
                    Share.of_mask(lines == ContactShape.PAIR)
                ),
                "pairs detected at their separation, % (90)": str(
                    Share.of_mask((longer >= ContactShape.LINE)[possible[0]])
                ),
                "pairs reported as two at theirs, % (90)": str(
                    Share.of_mask((two == ContactShape.PAIR)[possible[1]])
                ),
            }
        )
        progress(f"trials with {number} electrodes")
    return rows


def switching(count: int, parts: range) -> list[Row]:
    """Information and resolution of n segments a side: measured each, or by side with switched resistors."""
    rows = []
    x, y, angle = random_pairs(count)
    reference: FloatArray | None = None
    for n in parts:
        pad = divided(n, n)
        patterns = [[RESISTOR if state >> k & 1 else 0.0 for k in range(n)] * 4 for state in range(2**n)]
        by_side = [side for side in range(4) for _ in range(n)]
        for name, states, channels in (
            ("each segment, grounded", patterns[:1], None),
            ("each segment, all 2^n states", patterns, None),
            ("four sides, grounded", patterns[:1], by_side),
            ("four sides, all 2^n states", patterns, by_side),
        ):
            model = SwitchedNetwork(pad, states, channels)
            bits = period_information(model, x, y)
            reference = bits if reference is None else reference
            noise = NOISE / np.sqrt(TIME_PERIODS / len(states))
            longer, two = resolved_separations(model, x, y, angle, noise)
            gain = bits - reference
            spread = 1.96 * gain.std() / np.sqrt(len(gain))
            rows.append(
                {
                    "segments a side, n": n,
                    "measured": name,
                    "channels": len(set(channels or range(4 * n))),
                    "states": len(states),
                    "independent currents": model.independent_channels,
                    "bits a period over n = 1": f"{gain.mean():.2f} +- {spread:.2f}",
                    f"more than a point after {TIME_PERIODS} periods: median, mm": interval(longer),
                    "two contacts: median, mm": interval(two),
                }
            )
            progress(f"n = {n}: {name}")
    return rows


def period_information(model: SwitchedNetwork, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return -log2 of the area of the uncertainty (n,), with the mean information of one period.

    The total of each state is unknown.
    """
    f, jacobian = model.fractions_with_jacobian(x, y)
    states = len(model.states)
    f = f.reshape(states, -1, x.size)
    slopes = jacobian.reshape(states, -1, 2, x.size)
    share = np.einsum("scn,scdn->sdn", f, slopes) / (f * f).sum(axis=1)[:, None]
    free = slopes - f[:, :, None] * share[:, None]
    information = np.einsum("scdn,scen->nde", free, free) / NOISE**2 / states
    return np.asarray(0.5 * np.log2(np.linalg.det(information)))


def maps(size: int) -> dict[int, tuple[FloatArray, FloatArray]]:
    """Return for each number of electrodes the largest separations in four directions, (size, size)."""
    half = np.linspace(MARGIN, 0.5, size) * SIDE
    x, y = (c.ravel() for c in np.meshgrid(half, half))
    directions = np.pi / 8 * np.arange(1, 8, 2)  # off the axes of symmetry
    found = {}
    for number, parts in ELECTRODES.items():
        model = divided(*parts)
        each = [resolved_separations(model, x, y, np.full(x.size, q), NOISE) for q in directions]
        longer, two = (np.max([pair[k] for pair in each], axis=0).reshape(size, size) for k in (0, 1))
        found[number] = longer, two
        progress(f"map of {number} electrodes")
    return found


def whole(quadrant: FloatArray) -> FloatArray:
    """Return the map of the whole pad, symmetric to its middle lines."""
    upper = np.concatenate([quadrant, quadrant[:, -2::-1]], axis=1)
    return np.concatenate([upper, upper[-2::-1]])


def draw(path: Any, found: dict[int, tuple[FloatArray, FloatArray]], rows: list[Row]) -> None:
    figure, axes = plt.subplots(2, 4, figsize=(13, 6.4), layout="constrained")
    extent = [SIDE * MARGIN, SIDE * (1 - MARGIN)] * 2
    for column, (number, pair) in enumerate(found.items()):
        for row, title in enumerate(("more than a point", "two contacts")):
            ax = axes[row, column]
            if row and number == 4:
                continue
            values = np.where(np.isfinite(pair[row]), pair[row], np.nan)
            image = ax.imshow(
                whole(values), origin="lower", extent=extent, vmin=0, vmax=(4, 14)[row], cmap="viridis"
            )
            ax.set(title=f"{number}: {title}", xlabel="x, mm", ylabel="y, mm")
            ax.title.set_fontsize(9)
            figure.colorbar(image, ax=ax, label="separation, mm", shrink=0.8)
    ax = axes[1, 0]
    for name in dict.fromkeys(row["measured"] for row in rows):
        mine = [row for row in rows if row["measured"] == name]
        mean, spread = zip(
            *([float(v) for v in row["bits a period over n = 1"].split(" +- ")] for row in mine), strict=True
        )
        ax.errorbar(
            [row["segments a side, n"] for row in mine], mean, spread, fmt="o-", ms=3, capsize=2, label=name
        )
    ax.set(xlabel="segments a side, n", ylabel="bits of position a period over n = 1")
    ax.set_xticks([row["segments a side, n"] for row in rows])
    ax.legend(fontsize=6)
    ax.grid(alpha=0.3)
    figure.savefig(path, dpi=90)


def main() -> None:
    quick = options(__doc__).parse_args().quick
    apart = resolution(6 if quick else 40)
    rates = trials(20 if quick else 250)
    switched = switching(6 if quick else 30, range(1, 3 if quick else 5))
    found = maps(2 if quick else 5)
    page = [
        "# Resolution of two contacts, and information against electrodes",
        "",
        f"{made_by()}.",
        "",
        f"A square of {SIDE:g} mm with electrodes of equal length, {2 * GAP:g} mm bare between them. Two "
        "contacts of equal current have random centres and directions; a tenth of the side is left out at "
        f"the boundary. They are detected with a probability of {100 * DETECTION:g} % at a false-alarm rate "
        f"of {100 * FALSE_ALARM:g} %, by `resolve_contacts` (four electrodes: by `chi_squared` of a point). "
        "Medians over positions have 95 % intervals by bootstrap.",
        "",
        "![Maps of the separation; information against segments](resolution.png)",
        "",
        "Maps: number of electrodes, noise of 1e-4 of the total on each channel, the largest of four "
        "directions; white where no pair that is on the pad is resolved.",
        "",
        *table(
            "How far apart two contacts must be",
            "To be more than a point, and to be two contacts rather than a long one. Tolerances are the "
            f"defaults of deployments without calibration: gains {100 * GAIN_STD:g} %, each electrode's end "
            f"{GAP_STD:g} mm, anisotropy {100 * ANISOTROPY_STD:g} %, taken as independent errors of the "
            "channels.",
            apart,
        ),
        *table(
            "Simulated pairs, lines and points",
            "Shares of simulated currents with noise of 1e-4, with 95 % intervals; pairs at the separation "
            "computed for their position and direction.",
            rates,
        ),
        *table(
            "Switched resistors",
            f"Each of the n segments of a side is connected to ground directly or through {RESISTOR:g} ohm, "
            "the sheet's resistance per square; the same pattern on all sides, one state a period, the total "
            "of each state unknown. Bits: mean of -log2 of the area of the uncertainty of a point contact, "
            "with the information of an average period, noise of 1e-4 on each channel.",
            switched,
        ),
    ]
    folder = output_folder(quick)
    (folder / "resolution.md").write_text("\n".join(page))
    data = {"resolution": apart, "trials": rates, "switching": switched}
    (folder / "resolution.json").write_text(json.dumps(data, indent=1) + "\n")
    draw(folder / "resolution.png", found, switched)


if __name__ == "__main__":
    main()
