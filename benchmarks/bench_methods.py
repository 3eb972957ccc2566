"""Run time against error of location: every way to locate a contact, and the compiled core among them.

A plane pad of 30 x 24 mm. *Ideal*: no gaps, no resistors; *gaps and resistors*: 1.2 mm bare at each end of an
electrode, 120 ohm in series with each, all known; both without noise, exact currents, and so the error is the
method's own. *World default*: the same file, pads drawn for a seed of the reporting family, 0.5 to 5 N,
simulated by finite elements with noise and quantisation: nothing that was drawn is known. All errors are of
contacts 5 % of a side and farther from the edges; positions off the pad are clipped to it. The paper's ways
and the interpolator assume an ideal pad.

Microseconds are processor time per contact, medians; spread: half the distance of quartiles, the largest of
the columns. least_squares takes one contact after the other and is timed for up to 15. Core: the daemon's
stages, with covariance and place on the link, in calls of 60 contacts at most; *tracked*: from the last
position, 0.1 mm away. Bulk: 20,000 contacts. *Floors*: rms of the least error by noise (Cramer-Rao, at 1 mA),
and of an oracle that knows the distributions of all tolerances, but no values.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.optimize import least_squares

from benchmarks.oracle import PadOracle
from benchmarks.page import Report, Rows, options, progress
from benchmarks.scores import laplace_covariance
from handtouch import config
from handtouch.core.contact_solver import VALUE_COUNT, VALUE_SLICES, ContactSolver, make_solver
from handtouch.core.pad_model import PadModel
from handtouch.core.stages import solve
from handtouch.field import ElectrodeNetwork, Rectangle
from handtouch.field.paper_methods import LogRatioTable, log_ratio, single_sum_fractions
from handtouch.hand import electrode_network
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, Family, MountSpread
from tests.deployments import deployment_text, pad_text
from tests.exact_pads import ExactPads

FloatArray = NDArray[np.float64]
Position = tuple[FloatArray, FloatArray]
Locator = Callable[[FloatArray], Position]
"""Positions x, y (n,) [m] from currents (4, n) [A] of x0, xa, y0, yb."""

LENGTH_MM, WIDTH_MM = 30.0, 24.0
CORE_PADS = 60
"""Pads of the core's model; more contacts are solved in several calls."""
CELLS, TRAINED, DEGREE = 64, 20_000, 11
MARGIN = 0.02


@dataclass(frozen=True)
class Setup:
    """A plane pad of 30 x 24 mm and what its builder knows of it."""

    gap_mm: float
    series_ohm: float

    def deployment(self, pads: int) -> config.Deployment:
        """Return a deployment with so many pads of this kind."""
        surface = f'{{ kind = "plane", length_mm = {LENGTH_MM}, width_mm = {WIDTH_MM} }}'
        extra = f"series_ohm = {[self.series_ohm] * 4}"
        texts = [pad_text(f"p{k}", k + 1, surface, extra, gap_mm=self.gap_mm) for k in range(pads)]
        return config.parse(deployment_text(*texts, daemon=""))

    @cached_property
    def model(self) -> PadModel:
        """`CORE_PADS` such pads as the daemon has them."""
        return PadModel(self.deployment(CORE_PADS))

    @cached_property
    def pad(self) -> Rectangle | ElectrodeNetwork:
        """The exact forward model."""
        if not self.gap_mm:
            return self.rectangle
        deployment = self.deployment(1)
        pad = deployment.pads[0].pad
        return electrode_network(pad, deployment.sheets[pad.sheet])

    @property
    def rectangle(self) -> Rectangle:
        """The pad without gaps and resistors, which the paper's methods assume."""
        return Rectangle(1e-3 * LENGTH_MM, 1e-3 * WIDTH_MM)

    @property
    def noise_a(self) -> FloatArray:
        """Standard deviations (4, 1) of the channels."""
        return np.asarray(self.model.noise_a[0][:, None])


@dataclass(frozen=True)
class Way:
    """One way to locate; `make` builds its tables."""

    make: Callable[[Setup], Locator]
    kind: Literal["core", "handtouch", "paper", "instead"]
    ideal_only: bool = False
    """For pads without gaps and resistors alone."""
    samples: int = 20_000
    """Contacts of which errors are measured; few for slow ones, which take one contact after the other."""


# Of the paper and of handtouch


def exact(setup: Setup) -> Locator:
    def locate(currents: FloatArray) -> Position:
        found = setup.pad.locate(currents)
        return found.x, found.y

    return locate


def likelihood(setup: Setup) -> Locator:
    def locate(currents: FloatArray) -> Position:
        found = setup.pad.estimate(currents, setup.noise_a)
        return found.x, found.y

    return locate


def core(setup: Setup, *, tracked: bool) -> Locator:
    """Return the daemon's stages, compiled where they are: position, covariance and place on the link.

    If tracked, the contact in a column is located from its last position.
    """
    size = setup.model.size
    rows, columns = np.arange(size), VALUE_SLICES["xy"]
    parts: list[tuple[ContactSolver, FloatArray, FloatArray]] = []

    def part(number: int) -> tuple[ContactSolver, FloatArray, FloatArray]:
        while len(parts) <= number:
            given, values = np.zeros((size, 4)), np.full((size, VALUE_COUNT), np.nan)
            force = np.zeros(size, np.bool_)
            parts.append((make_solver(setup.model, given, np.zeros(size), force, values), given, values))
        return parts[number]

    def locate(currents: FloatArray) -> Position:
        found = np.empty((currents.shape[1], 2))
        for number, first in enumerate(range(0, len(found), size)):
            solver, given, values = part(number if tracked else 0)
            columns_now = currents[:, first : first + size].T
            n = len(columns_now)
            given[:n] = columns_now
            if not tracked:
                values[:n] = np.nan
            solver.solve_contacts(rows[:n].data)
            found[first : first + n] = values[:n, columns]
        return found[:, 0], found[:, 1]

    return locate


# What a user would take instead


def nominal_contacts(setup: Setup, count: int) -> tuple[FloatArray, FloatArray]:
    """Return positions (2, count) [m] and fractions (4, count) of contacts by the forward model."""
    sides = np.array([[setup.pad.a], [setup.pad.b]])
    at = sides * np.random.default_rng(11).uniform(MARGIN, 1 - MARGIN, (2, count))
    return at, setup.pad.fractions(*at)


def polynomial(setup: Setup) -> Locator:
    """Return a regression on the two ratios of opposite sides, of degree 11, trained on 20 000 contacts."""
    powers = np.array([p for p in product(range(DEGREE + 1), repeat=2) if sum(p) <= DEGREE])

    def features(currents: FloatArray) -> FloatArray:
        low, high = currents[::2], currents[1::2]
        ratios = (high - low) / (high + low)
        x, y = ratios[:, None] ** np.arange(DEGREE + 1)[:, None]  # (powers, n) each
        return np.asarray((x[powers[:, 0]] * y[powers[:, 1]]).T)

    at, fractions = nominal_contacts(setup, TRAINED)
    weights, *_ = np.linalg.lstsq(features(fractions), at.T, rcond=None)

    def locate(currents: FloatArray) -> Position:
        x, y = (features(currents) @ weights).T
        return x, y

    return locate


def grid_interpolator(setup: Setup) -> Locator:
    """Return eq. 8 corrected by scipy's cubic RegularGridInterpolator, as in a look-up table of one's own."""
    adjusted, table = LogRatioTable(setup.rectangle, cells=0), LogRatioTable(setup.rectangle, CELLS)
    places, origin, steps = table.correction_table
    axes = [origin[i] + steps[i] * np.arange(CELLS + 1) for i in range(2)]
    interpolator = RegularGridInterpolator(axes, places, method="cubic", bounds_error=False, fill_value=None)

    def locate(currents: FloatArray) -> Position:
        found = interpolator(np.stack(adjusted.locate(currents), axis=-1))
        return found[..., 0], found[..., 1]

    return locate


def fit_of_sums(setup: Setup) -> Locator:
    """Return scipy's least_squares on the paper's eqs. 4-5, ten terms."""
    return _one_by_one(setup, lambda x, y: single_sum_fractions(setup.rectangle, x, y))


def fit_of_field(setup: Setup) -> Locator:
    """Return scipy's least_squares on the exact forward model."""
    return _one_by_one(setup, lambda x, y: setup.pad.fractions(x, y))


def _one_by_one(setup: Setup, forward: Callable[[float, float], FloatArray]) -> Locator:
    a, b = setup.rectangle.a, setup.rectangle.b
    bounds = (1e-3 * a, 1e-3 * b), (0.999 * a, 0.999 * b)

    def misfit(point: FloatArray, fractions: FloatArray) -> FloatArray:
        return forward(float(point[0]), float(point[1])) - fractions

    def locate(currents: FloatArray) -> Position:
        found = [
            least_squares(
                misfit, (a / 2, b / 2), bounds=bounds, args=(column / column.sum(),), x_scale=(a, b),
                xtol=1e-12, ftol=1e-12, gtol=1e-12,
            ).x
            for column in currents.T
        ]  # fmt: skip
        x, y = np.array(found).T
        return x, y

    return locate


WAYS: dict[str, Way] = {
    "log-ratio (eq. 8)": Way(lambda setup: lambda currents: log_ratio(setup.rectangle, currents), "paper"),
    "log-ratio, adjusted (fig. 3)": Way(
        lambda setup: LogRatioTable(setup.rectangle, cells=0).locate, "paper"
    ),
    "exact inverse": Way(exact, "handtouch"),
    "likelihood, exact field": Way(likelihood, "handtouch"),
    "core, new contacts": Way(lambda setup: core(setup, tracked=False), "core"),
    "core, tracked contacts": Way(lambda setup: core(setup, tracked=True), "core"),
    "polynomial regression": Way(polynomial, "instead"),
    "RegularGridInterpolator": Way(grid_interpolator, "instead"),
    "least_squares, eqs. 4-5": Way(fit_of_sums, "instead", samples=200),
    "least_squares, exact field": Way(fit_of_field, "instead", samples=100),
}
"""By name."""


os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


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


@dataclass(frozen=True)
class Case:
    """Contacts on pads of one setup: currents (4, n) [A]; `error_m` returns the errors (n,) of positions."""

    name: str
    setup: Setup
    currents: FloatArray
    error_m: Callable[[FloatArray, FloatArray], FloatArray]
    floors_mm: dict[str, float]
    """Rms errors that no way can beat, by cause."""


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


def measure(cases: Sequence[Case], quick: bool) -> dict[str, Rows]:
    """Return the rows of all ways; cases of one setup share its tables and run times."""
    rows: dict[str, Rows] = {case.name: [] for case in cases}
    for setup in dict.fromkeys(case.setup for case in cases):
        for name, way in WAYS.items():
            if way.ideal_only and setup != IDEAL:
                continue
            locate = way.make(setup)
            us, spread = times(setup, name, locate, quick)
            for case in (case for case in cases if case.setup == setup):
                error = errors_mm(case, name, locate)
                known = error[np.isfinite(error)]
                rows[case.name].append(
                    {
                        "kind": way.kind,
                        "way": name,
                        "rms, mm": f"{np.sqrt(np.mean(known**2)):.1e}",
                        "median": f"{np.median(known):.1e}",
                        "worst": f"{known.max():.1e}",
                        "no answer, %": 100 * (1 - len(known) / len(error)),
                        **{f"us each, {n} in a call": us.get(str(n)) for n in CALLS},
                        "us each, bulk": us.get("bulk"),
                        "spread, %": spread,
                    }
                )
                progress(rows[case.name][-1])
    return rows


def main() -> None:
    quick = options(__doc__).parse_args().quick
    count = 300 if quick else 20_000
    cases = [
        exact_case("ideal pad", IDEAL, count),
        exact_case("gaps and resistors", BUILT, count),
        world_case(BUILT, 2 if quick else WORLD_PADS, 5 if quick else WORLD_TOUCHES),
    ]
    report = Report(
        quick, contacts=[case.currents.shape[1] for case in cases], compiled=solve.__file__.endswith(".so")
    )
    for name, rows in measure(cases, quick).items():
        report.table(name.capitalize(), rows)
    report.table("Floors, mm", [{"case": case.name, **case.floors_mm} for case in cases])
    report.keep()


if __name__ == "__main__":
    main()
