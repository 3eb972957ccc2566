"""Run time against error: every way from four currents to position and force, and from wire to wire.

A plane pad of 30 x 24 mm, contacts of 0.5 to 5 N, 5 % of a side and farther from the edges. *Ideal pad*: no
gaps, no resistors; *gaps and resistors*: 1.2 mm bare at each end of an electrode, 120 ohm in series with
each, all known; both exact currents without noise, and so the error is the method's own. *Solved contacts*:
the same pads in the world `ideal`, currents of contacts solved with the sheet by finite elements, with
noise and quantisation. *World default*: pads drawn for a seed of the reporting family, with sheets; nothing
that was drawn is known. Estimates off the pad are clipped to it, forces to 20 N. Errors of forces are
relative.

*Paper*: its formulas, for an ideal pad; forces by eqs. 11 and 12 from the total current and the resistance
at the pad's centre. *Common*: what one would take instead. *Labelled*: learned from presses of the same
pad, each the mean of 12 samples with its true place and force: a polynomial whose degree is chosen by
presses left out, a Gaussian process by marginal likelihood, a network of 16 and 16 units. *Theory*: exact,
`handtouch.field`. *Core*: the daemon's stages as configured, and with what its calibration learned from 32
contacts without labels; in the worlds contacts pass the daemon's pipeline, and errors are those of its
messages. *Wire to wire*: from the last sample to encoded messages of all contacts.

Microseconds are processor time per contact, medians; spread: half the distance of quartiles, the largest of
the columns. least_squares takes one contact after the other. *Floors*: least rms error by noise (Cramer-
Rao, at 1 mA), and of an oracle that knows the distributions of all tolerances, but no values.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.optimize import least_squares

from benchmarks.bench_worlds import DRAWN_MORE, DRAWN_PER_LEARNT, HELD_SAMPLES, REST_SAMPLES, learn
from benchmarks.hand_touches import REST_S, SAMPLE_S, STEP_S, TOUCH_S, TouchReadings
from benchmarks.learned_ways import LEARNERS, Presses, learned
from benchmarks.oracle import PadOracle
from benchmarks.page import Report, Rows, options, progress
from benchmarks.paper_methods import LogRatioTable, single_sum_fractions
from benchmarks.scores import laplace_covariance
from benchmarks.touched_pads import PipelineCase, Touches, in_turns_of
from handtouch import config, wire
from handtouch.config.tables import SceneRequest
from handtouch.core.pad_model import PadModel, contact_law, law_of
from handtouch.core.stages import solve
from handtouch.core.stages.rows import VALUE_COUNT, VALUE_SLICES
from handtouch.core.stages.solve import ContactSolver
from handtouch.daemon.table_cache import build_pad_model
from handtouch.field import ElectrodeNetwork, Rectangle
from handtouch.field.figures import log_ratio
from handtouch.hand import electrode_network
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, Family, MountSpread, World
from tests.deployments import PLAIN_SHEET, deployment_text, pad_text
from tests.exact_pads import ExactPads

FloatArray = NDArray[np.float64]
Estimator = Callable[[FloatArray], FloatArray]
"""Places x, y [m] and forces [N] (3, n) from currents (4, n) [A] of x0, xa, y0, yb."""
Position = tuple[FloatArray, FloatArray]
Kind = Literal["core", "theory", "paper", "common", "labelled"]

LENGTH_MM, WIDTH_MM, DRIVE_V = 30.0, 24.0, 5.0
CORE_PADS = 60
"""Pads of the core's model; more contacts are solved in several calls."""
CELLS, MARGIN, MAX_FORCE_N = 64, 0.05, 20.0
FORCES_N = (0.5, 5.0)
CALLS = (1, 15, 60)
SLIDE_M = 1e-4
"""Between two samples: 20 mm/s at 200 Hz."""
BATCH_S, BATCHES, FEW_BATCHES = 0.02, 15, 3
LABELLED, UNLABELLED, WARM_UP = (16, 64, 256, 512), 32, 12
FEW, MANY = 100, 2000
"""Contacts of which errors are measured, of slow ways and of others, of exact currents"""
AS_CONFIGURED, AFTER = "core, as configured", f"core, after {UNLABELLED} unlabelled contacts"


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
        return config.parse(deployment_text(*texts, daemon="").replace(PLAIN_SHEET, ""))

    @cached_property
    def model(self) -> PadModel:
        """`CORE_PADS` such pads as the daemon has them."""
        return build_pad_model(self.deployment(CORE_PADS))

    @cached_property
    def pad(self) -> Rectangle | ElectrodeNetwork:
        """The exact forward model."""
        if not self.gap_mm:
            return self.rectangle
        pad = self.deployment(1).pads[0].pad
        return electrode_network(pad, self.deployment(1).sheets[pad.sheet])

    @property
    def rectangle(self) -> Rectangle:
        """The pad without gaps and resistors, which the paper's methods assume."""
        return Rectangle(1e-3 * LENGTH_MM, 1e-3 * WIDTH_MM)

    @property
    def noise_a(self) -> FloatArray:
        """Standard deviations (4, 1) of the channels."""
        return np.asarray(self.model.noise_a[0][:, None])

    @cached_property
    def law(self) -> tuple[Any, float]:
        """The contact law and the sheet resistance of the file."""
        sheet = self.deployment(1).sheets["s"]
        return contact_law(sheet, law_of(sheet)), sheet.ohm_per_square

    def spreading(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the spreading radius [m] and the resistance of the resistors [ohm] (n,) there."""
        pad = self.pad
        if isinstance(pad, Rectangle):
            return np.asarray(pad.conformal_radius(x, y)), np.zeros_like(x)
        fractions, form = pad.fractions(x, y), pad.series_quadratic_form
        series = np.einsum("in,ij,jn->n", fractions, form, fractions)
        return np.asarray(pad.spreading_radius(x, y)), series

    def currents(self, truth: FloatArray) -> FloatArray:
        """Return the exact currents (4, n) of contacts (3, n)."""
        law, sheet_ohm = self.law
        x, y, force = truth
        return np.asarray(
            law.current(force, DRIVE_V, sheet_ohm, *self.spreading(x, y)) * self.pad.fractions(x, y)
        )

    def force(self, total_a: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the force (n,) of currents at these places, by the law of the file."""
        law, sheet_ohm = self.law
        sides = self.pad.a, self.pad.b
        inside = [np.clip(at, 1e-3 * side, 0.999 * side) for at, side in zip((x, y), sides, strict=True)]
        found = law.force(np.maximum(total_a, 1e-12), DRIVE_V, sheet_ohm, *self.spreading(*inside))
        return np.asarray(found.force_n)

    def draw(self, count: int, seed: int) -> FloatArray:
        """Return random contacts (3, count)."""
        rng, sides = np.random.default_rng(seed), np.array([[self.pad.a], [self.pad.b]])
        places = sides * rng.uniform(MARGIN, 1 - MARGIN, (2, count))
        low, high = np.log(FORCES_N)
        return np.concatenate([places, np.exp(rng.uniform(low, high, (1, count)))])


@dataclass(frozen=True)
class Way:
    """One way; `make` builds its tables, of a setup and of labelled presses of a pad."""

    kind: Kind
    make: Callable[[Setup, Presses], Estimator]
    labels: int | None = None
    """Presses that it learns from."""
    is_slow: bool = False
    """It takes one contact after the other."""


# Of the paper and of handtouch


def at_centre(locate: Callable[[Setup], Callable[[FloatArray], Position]]) -> Callable[..., Estimator]:
    """Return the maker of a way whose force is that of a contact at the pad's centre."""

    def make(setup: Setup, _: Presses) -> Estimator:
        located = locate(setup)
        middle = np.array([setup.rectangle.a / 2]), np.array([setup.rectangle.b / 2])
        law, sheet_ohm = setup.law
        radius = setup.rectangle.conformal_radius(*middle)

        def estimate(currents: FloatArray) -> FloatArray:
            force = law.force(np.maximum(currents.sum(axis=0), 1e-12), DRIVE_V, sheet_ohm, radius).force_n
            return np.stack([*located(currents), np.asarray(force)])

        return estimate

    return make


def at_place(locate: Callable[[Setup], Callable[[FloatArray], Position]]) -> Callable[..., Estimator]:
    """Return the maker of a way whose force is that of a contact at the place found."""

    def make(setup: Setup, _: Presses) -> Estimator:
        located = locate(setup)

        def estimate(currents: FloatArray) -> FloatArray:
            x, y = located(currents)
            return np.stack([x, y, setup.force(currents.sum(axis=0), x, y)])

        return estimate

    return make


def exact(setup: Setup) -> Callable[[FloatArray], Position]:
    def locate(currents: FloatArray) -> Position:
        found = setup.pad.locate(currents)
        return found.x, found.y

    return locate


def likelihood(setup: Setup) -> Callable[[FloatArray], Position]:
    def locate(currents: FloatArray) -> Position:
        found = setup.pad.estimate(currents, setup.noise_a)
        return found.x, found.y

    return locate


def core(setup: Setup, *, tracked: bool) -> Estimator:
    """Return the daemon's stages, compiled where they are: position, force, covariance and place on the link.

    If tracked, the contact in a column is located from its last position.
    """
    size = setup.model.size
    rows, xy, force = np.arange(size), VALUE_SLICES["xy"], VALUE_SLICES["force_n"].start
    parts: list[tuple[ContactSolver, FloatArray, FloatArray]] = []

    def part(number: int) -> tuple[ContactSolver, FloatArray, FloatArray]:
        while len(parts) <= number:
            given, values = np.zeros((size, 4)), np.full((size, VALUE_COUNT), np.nan)
            wanted = np.ones(size, np.bool_)
            parts.append((ContactSolver(setup.model, given, np.zeros(size), wanted, values), given, values))
        return parts[number]

    def estimate(currents: FloatArray) -> FloatArray:
        found = np.empty((currents.shape[1], 3))
        for number, first in enumerate(range(0, len(found), size)):
            solver, given, values = part(number if tracked else 0)
            columns_now = currents[:, first : first + size].T
            n = len(columns_now)
            given[:n] = columns_now
            if not tracked:
                values[:n] = np.nan
            solver.solve_contacts(rows[:n].data)
            found[first : first + n, :2], found[first : first + n, 2] = values[:n, xy], values[:n, force]
        return np.asarray(found.T)

    return estimate


# What a user would take instead


def grid_interpolator(setup: Setup) -> Callable[[FloatArray], Position]:
    """Return eq. 8 corrected by scipy's cubic RegularGridInterpolator, as in a look-up table of one's own."""
    adjusted, table = LogRatioTable(setup.rectangle, cells=0), LogRatioTable(setup.rectangle, CELLS)
    places, origin, steps = table.correction_table
    axes = [origin[i] + steps[i] * np.arange(CELLS + 1) for i in range(2)]
    interpolator = RegularGridInterpolator(axes, places, method="cubic", bounds_error=False, fill_value=None)

    def locate(currents: FloatArray) -> Position:
        found = interpolator(np.stack(adjusted.locate(currents), axis=-1))
        return found[..., 0], found[..., 1]

    return locate


def one_by_one(
    setup: Setup, forward: Callable[[float, float], FloatArray]
) -> Callable[[FloatArray], Position]:
    """Return scipy's least_squares on a forward model."""
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


def fit_of_sums(setup: Setup) -> Callable[[FloatArray], Position]:
    return one_by_one(setup, lambda x, y: single_sum_fractions(setup.rectangle, x, y))


def fit_of_field(setup: Setup) -> Callable[[FloatArray], Position]:
    return one_by_one(setup, lambda x, y: setup.pad.fractions(x, y))


def _learned(fit: Callable[..., Any], _: Setup, presses: Presses) -> Any:
    return learned(fit, presses)


WAYS: dict[str, Way] = {
    "log-ratio (eq. 8)": Way("paper", at_centre(lambda setup: partial(log_ratio, setup.rectangle))),
    "log-ratio, adjusted (fig. 3)": Way(
        "paper", at_centre(lambda setup: LogRatioTable(setup.rectangle, cells=0).locate)
    ),
    "log-ratio, table of 32 cells": Way(
        "paper", at_centre(lambda setup: LogRatioTable(setup.rectangle).locate)
    ),
    "RegularGridInterpolator": Way("common", at_centre(grid_interpolator)),
    "least_squares, eqs. 4-5": Way("common", at_centre(fit_of_sums), is_slow=True),
    "least_squares, exact field": Way("common", at_place(fit_of_field), is_slow=True),
    **{
        f"{name}, {count} presses": Way("labelled", partial(_learned, fit), count)
        for name, fit in LEARNERS.items()
        for count in LABELLED
    },
    "exact inverse": Way("theory", at_place(exact)),
    "likelihood, exact field": Way("theory", at_place(likelihood)),
    "core, new contacts": Way("core", lambda setup, _: core(setup, tracked=False)),
    AS_CONFIGURED: Way("core", lambda setup, _: core(setup, tracked=True)),
}
"""By name."""
IDEAL, BUILT = Setup(0.0, 0.0), Setup(1.2, 120.0)


# Cases


@dataclass(frozen=True)
class PadCase:
    """Contacts of one pad, presses that ways may learn from, and what the daemon's messages say, by state."""

    contacts: Presses
    labelled: Presses
    served: Mapping[str, FloatArray]


@dataclass(frozen=True)
class Case:
    """Contacts on pads of one setup, and the least errors by cause: of positions [mm] and of forces."""

    name: str
    setup: Setup
    pads: Sequence[PadCase]
    floors: dict[str, tuple[float, float | None]]


def exact_case(name: str, setup: Setup, count: int) -> Case:
    """Return contacts whose currents are those of the exact field."""
    truth, labels = setup.draw(count, 0), setup.draw(max(LABELLED), 11)
    pad = PadCase(Presses(setup.currents(truth), truth), Presses(setup.currents(labels), labels), {})
    fractions, jacobian = setup.pad.fractions_with_jacobian(*truth[:2])
    design = np.moveaxis(np.concatenate([1e-3 * jacobian, fractions[:, None]], axis=1), 2, 0)
    covariance = laplace_covariance(design, setup.noise_a[:, 0], np.full(3, np.inf))[:, :2, :2]
    floor = 1e3 * float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean()))
    return Case(name, setup, [pad], {"noise of the channels": (floor, None)})


def draw_touches(links: Sequence[str], count: int, seed: int) -> tuple[ScenarioTouch, ...]:
    """Return `count` touches of each pad, one after the other."""
    rng, low_high = np.random.default_rng((seed, 6)), np.log(FORCES_N)
    return tuple(
        ScenarioTouch(
            link=link,
            from_s=REST_S + number * STEP_S,
            duration_s=TOUCH_S,
            path=(tuple(rng.uniform(MARGIN, 1 - MARGIN, 2)),),
            force_n=(float(np.exp(rng.uniform(*low_high))),),
        )
        for number in range(count)
        for link in links
    )


def world_case(name: str, world: World, setup: Setup, pads: int, touches: int) -> Case:
    """Return touches of so many pads in a world, through the daemon's pipeline: one sample of each."""
    drawn = replace(world, mounts=MountSpread()).draw(Family.REPORTING.seed(0))
    deployment = drawn.describe(setup.deployment(pads))
    model = build_pad_model(deployment)
    tests = range(WARM_UP, WARM_UP + touches)
    others = range(tests.stop, tests.stop + round(DRAWN_PER_LEARNT * UNLABELLED) + DRAWN_MORE)
    labels = range(others.stop, others.stop + max(LABELLED))
    hand = VirtualHand(deployment, Scenario(touch=draw_touches(model.links, labels.stop, drawn.seed)), drawn)
    readings = TouchReadings.of_hand(hand, deployment, tests)
    truths = readings.truths | {
        (k, truth.link): truth for k in labels for truth in hand.truth(REST_S + k * STEP_S + SAMPLE_S)
    }
    served = {AS_CONFIGURED: readings.contacts(model, deployment)}
    for row in range(pads):
        calibration = learn(hand, deployment, model, row, others, (UNLABELLED,))[0].calibration
        if calibration:
            model.set_calibration(row, calibration)
    served[AFTER] = readings.contacts(model, deployment)
    plane = ExactPads(deployment, model)
    corner, along, across = plane.position_m([0] * 3, [0.0, setup.pad.a, 0.0], [0.0, 0.0, setup.pad.b])
    axes = np.stack([(along - corner) / setup.pad.a, (across - corner) / setup.pad.b])

    def truth_of(numbers: range, link: str) -> FloatArray:
        own = [truths[k, link] for k in numbers]
        return np.array([[*(axes @ (np.array(one.position_m) - corner)), one.force_n] for one in own]).T

    def answer(contact: wire.Contact | None) -> list[float]:
        if contact is None or contact.position_m is None:
            return [np.nan] * 3
        force = np.nan if contact.force_n is None else contact.force_n
        return [*(axes @ (np.array(contact.position_m) - corner)), force]

    found, variance = [], []
    for row, (hand_name, pad) in enumerate(deployment.pads):
        amperes = setup.model.ampere_per_count[0][:, None]
        presses = [
            Presses(amperes * counts_of(hand, row, numbers, samples), truth_of(numbers, pad.link))
            for numbers, samples in ((tests, 1), (labels, HELD_SAMPLES))
        ]
        answers = {
            state: np.array([answer(contacts.get((k, pad.link))) for k in tests]).T
            for state, contacts in served.items()
        }
        found.append(PadCase(presses[0], presses[1], answers))
        oracle = PadOracle.build(drawn, deployment, hand_name, pad, model.noise_a[row])
        own = [truths[k, pad.link] for k in tests]
        u, v, force = np.array([(one.u_m, one.v_m, one.force_n) for one in own]).T
        least = oracle.covariances(u, v, force)
        position2 = np.trace(least.position_m2, axis1=1, axis2=2)
        variance.append(
            (position2, least.force_n2[:, 0, 0] / force**2, np.square([one.bound_m for one in own]))
        )
        progress(f"{name}: pad {row + 1} of {pads}")
    position, relative, noise = (float(np.sqrt(np.mean(part))) for part in zip(*variance, strict=True))
    floors = {
        "tolerances and noise": (1e3 * position, relative),
        "noise of the channels": (1e3 * noise, None),
    }
    return Case(name, setup, found, floors)


def counts_of(hand: VirtualHand, row: int, numbers: range, samples: int) -> FloatArray:
    """Return the means (4, n) of the last samples of touches, less their zeros before."""
    begin_s = REST_S + np.array(numbers)[:, None] * STEP_S
    held_s = begin_s + SAMPLE_S - 0.005 * np.arange(samples)
    rest_s = begin_s - 0.005 * np.arange(1, REST_SAMPLES + 1)
    held, rest = (
        hand.counts(row, times.ravel()).reshape(*times.shape, -1).mean(axis=1) for times in (held_s, rest_s)
    )
    return np.asarray((held - rest).T)


# Measuring


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


def times(setup: Setup, way: Way, estimate: Estimator, quick: bool) -> dict[str, Any]:
    """Return microseconds a contact by number of contacts, and the largest spread in %.

    Two samples take turns between which contacts slide by 0.1 mm.
    """
    found, spreads = dict[str, Any](), []
    for count in CALLS[: 2 if way.is_slow or quick else None]:
        truth = setup.draw(count, 2)
        slid = truth + np.array([[SLIDE_M], [0.0], [0.0]])
        pair = [np.ascontiguousarray(setup.currents(contacts)) for contacts in (truth, slid)]

        def both(pair: Sequence[FloatArray] = pair) -> None:
            estimate(pair[0])
            estimate(pair[1])

        us, spread = microseconds(both, 1 if quick else BATCHES)
        found[f"us each, {count} in a call"] = us / 2 / count
        spreads.append(spread)
    return found | {"spread, %": max(spreads)}


def wire_times(setup: Setup, quick: bool) -> dict[str, Any]:
    """Return the microseconds a contact from the last sample to encoded messages."""
    found, spreads = dict[str, Any](), []
    for count in CALLS:
        case = PipelineCase(setup.model, ("contact/",), SceneRequest())
        (row,) = in_turns_of({"": case}, Touches(setup.model, count), 20 if quick else 1000)
        found[f"us each, {count} in a call"] = row["us a tick"] / count
        low, high = np.percentile(case.spent_ns, [25, 75])
        spreads.append(50 * float(high - low) / float(np.median(case.spent_ns)))
    return found | {"spread, %": max(spreads)}


def errors(setup: Setup, found: FloatArray, truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return errors of positions [mm] and of forces, relative (n,) each; NaN without an answer."""
    truth = truth[:, : found.shape[1]]
    x, y = np.clip(found[0], 0, setup.pad.a), np.clip(found[1], 0, setup.pad.b)
    force = np.clip(found[2], 0.0, MAX_FORCE_N)
    return 1e3 * np.hypot(x - truth[0], y - truth[1]), force / truth[2] - 1


def scored(parts: Sequence[tuple[FloatArray, FloatArray]]) -> dict[str, Any]:
    """Return the cells of the errors of all pads."""
    position, force = (np.concatenate(column) for column in zip(*parts, strict=True))
    some, relative = position[np.isfinite(position)], np.abs(force[np.isfinite(force)])
    return {
        "position rms, mm": f"{np.sqrt(np.mean(some**2)):.1e}",
        "median, mm": f"{np.median(some):.1e}",
        "force rms, %": f"{100 * np.sqrt(np.mean(relative**2)):.1e}",
        "median, %": f"{100 * np.median(relative):.1e}",
        "no answer, %": 100 * (1 - len(some) / len(position)),
    }


def measure_setup(cases: Sequence[Case], quick: bool) -> dict[str, Rows]:
    """Return the rows of the cases of one setup, which share run times."""
    setup, rows = cases[0].setup, {case.name: Rows() for case in cases}
    spent = {}
    for name, way in WAYS.items():
        if quick and way.labels not in (None, LABELLED[0]):
            continue
        presses = cases[0].pads[0].labelled
        spent[name] = times(setup, way, way.make(setup, presses.first(way.labels or 1)), quick)
        for case in cases:
            parts = []
            for pad in case.pads:
                found = pad.served.get(name)
                if found is None:
                    estimate = way.make(setup, pad.labelled.first(way.labels or 1))
                    with np.errstate(all="ignore"):
                        found = estimate(pad.contacts.currents[:, : FEW if way.is_slow else None])
                parts.append(errors(setup, found, pad.contacts.truth))
            rows[case.name].append({"kind": way.kind, "way": name, **scored(parts), **spent[name]})
            progress(rows[case.name][-1])
    wired = wire_times(setup, quick)
    for case in cases:
        own = rows[case.name]
        for state, name in (
            (AS_CONFIGURED, "wire to wire, as configured"),
            (AFTER, f"wire to wire, {AFTER[6:]}"),
        ):
            if state in case.pads[0].served:
                if state == AFTER:
                    parts = [errors(setup, pad.served[state], pad.contacts.truth) for pad in case.pads]
                    own.append({"kind": "core", "way": AFTER, **scored(parts), **spent[AS_CONFIGURED]})
                same = next(row for row in own if row["way"] == state)
                own.append(same | {"way": name} | wired)
    return rows


def main() -> None:
    quick = options(__doc__).parse_args().quick
    count, pads, touches = (200, 1, 6) if quick else (MANY, 12, 40)
    cases = [
        exact_case("ideal pad", IDEAL, count),
        exact_case("gaps and resistors", BUILT, count),
        world_case("solved contacts", WORLDS["ideal"], BUILT, max(1, pads // 3), touches),
        world_case("world default", WORLDS["default"], BUILT, pads, touches),
    ]
    report = Report(
        quick,
        contacts=[sum(pad.contacts.truth.shape[1] for pad in case.pads) for case in cases],
        compiled=solve.__file__.endswith(".so"),
    )
    rows: dict[str, Rows] = {}
    for setup in (IDEAL, BUILT):
        rows |= measure_setup([case for case in cases if case.setup == setup], quick)
    for name, of_case in rows.items():
        report.table(name.capitalize(), of_case)
    report.table(
        "Floors",
        [
            {
                "case": case.name,
                "cause": cause,
                "position rms, mm": at[0],
                "force rms, %": at[1] and 100 * at[1],
            }
            for case in cases
            for cause, at in case.floors.items()
        ],
    )
    report.keep()


if __name__ == "__main__":
    main()
