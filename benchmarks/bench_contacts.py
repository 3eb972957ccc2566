"""Positions of real contacts: firm, tilted, uneven, and with what no file states.

Hands of the world `default` ([worlds](../worlds.md)), seeds of the reporting family, 15 pads each, mounted as
stated, through the daemon's own pipeline; one sample of each touch, 0.32 s after it began. The shipped file
describes them, with the tolerances of parts of their builder. Touches of each pad are of seven profiles of
pressure and four ranges of force, equally often, anywhere from 2 % of a side inside the edges, with the
world's radii. The truth is the centre of the pressure that is on the pad. *Learned*: after automatic
calibration by 56 more such contacts of each pad.

*Disturbances*: evenly pressed round contacts of the same hands with one property more, or another one, which
the file doesn't state; leads and gains also after calibration by 56 such contacts. Errors and
deviations in mm; intervals of shares by pads. The oracle knows the distributions of the world and of its
patches, but no value; of disturbances nothing.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from benchmarks.bench_worlds import (
    DRAWN_MORE,
    DRAWN_PER_LEARNT,
    contact_noise_a,
    learn,
    true_contacts,
)
from benchmarks.hand_touches import (
    REST_S,
    SAMPLE_S,
    STEP_S,
    TOUCH_S,
    TouchReadings,
    compare,
)
from benchmarks.oracle import PadOracle, Patches
from benchmarks.page import Report, options, progress
from benchmarks.scores import ClusterShare, Estimates, EstimateScore, concatenate
from handtouch.config import load, shipped
from handtouch.config.tables import SIDE_ELECTRODES
from handtouch.daemon.table_cache import build_pad_model
from handtouch.simulate.contact_patch import PROFILES
from handtouch.simulate.faults import FAULTS, Fault
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import (
    WORLDS,
    Family,
    Fixed,
    MountSpread,
    Normal,
    Uniform,
    World,
)

FloatArray = NDArray[np.float64]
FORCES_N = (0.15, 1.0, 2.0, 3.3, 5.0)
SHAPES: dict[str, dict[str, Any]] = {
    name: {"profile": name, "elongation": 1.0} for name in PROFILES
} | {"ellipse 2:1": {"profile": "uniform", "elongation": 2.0}}  # fmt: skip
ROUND = {"uniform": SHAPES["uniform"]}
LEARNT = 56
WARM_UP, QUIET = 4, 100
"""Touches before those that are compared; times of touches without one before these, for noise to be
measured."""
CONFIGURED, LEARNED = "as configured", "learned"
WORLD = replace(WORLDS["default"].with_sheets(), mounts=MountSpread())


def parts(**changes: Any) -> World:
    return replace(WORLD, parts=replace(WORLD.parts, **changes))


def electronics(**changes: Any) -> World:
    return replace(WORLD, electronics=replace(WORLD.electronics, **changes))


@dataclass(frozen=True)
class Disturbance:
    """What the hands of a row have besides their world."""

    name: str
    world: World = WORLD
    fault: Mapping[str, Any] = field(default_factory=dict)
    """Of one electrode or channel of each pad, as in a scenario file."""
    beside: float = 0.0
    """Share of the force that presses right beside the touch, as a film of water might conduct."""
    over_edge: bool = False
    """Touches over an edge."""
    is_noise: bool = False
    """Its noise is measured before."""
    learns: bool = False
    """Contacts calibrate the pads, too."""


DISTURBANCES = (
    Disturbance("none"),
    Disturbance("over an edge", over_edge=True),
    *(
        Disturbance(f"film uneven, waves of {100 * amplitude:g} %", parts(unevenness=Normal(0.0, amplitude)))
        for amplitude in (0.02, 0.04)
    ),
    *(
        Disturbance(f"leads of 0 to {ohm:g} ohm", parts(lead_ohm=Uniform(0.0, ohm)), learns=True)
        for ohm in (5, 10, 30)
    ),
    *(Disturbance(f"noise times {n:g}", electronics(noise_ratio=Fixed(n)), is_noise=True) for n in (3, 10)),
    *(Disturbance(f"hum of {n:g} counts", electronics(hum_counts=Fixed(n)), is_noise=True) for n in (3, 10)),
    Disturbance("common noise of 10 counts", electronics(common_noise_counts=Fixed(10.0)), is_noise=True),
    *(
        Disturbance(f"non-linearity of {n:g} counts", electronics(nonlinearity_counts=Normal(0.0, n)))
        for n in (2, 8)
    ),
    Disturbance("crosstalk of 1 %", electronics(crosstalk=Fixed(0.01))),
    *(
        Disturbance(
            f"one gain wrong by {100 * step:g} %",
            fault={"kind": "gain_step", "factor": 1 + step},
            learns=True,
        )
        for step in (0.05, 0.1)
    ),
    Disturbance("one channel dead", fault={"kind": "gain_step", "factor": 1e-6}),
    Disturbance("one electrode unplugged", fault={"kind": "dead_electrode"}),
    Disturbance("water beside the contact, 10 %", beside=0.19),
)


@dataclass(frozen=True)
class Task:
    """One hand of a row: its number, and touches of each pad in each shape and range of force."""

    disturbance: Disturbance
    shapes: Mapping[str, Mapping[str, Any]]
    number: int
    each: int
    learns: bool


def draw_touches(task: Task, links: Sequence[str], count: int, seed: int) -> tuple[ScenarioTouch, ...]:
    """Return `count` touches of each pad, one after the other; shapes and forces follow each other."""
    rng = np.random.default_rng((seed, 11))
    shapes = list(task.shapes.values())
    found = []
    for number in range(QUIET if task.disturbance.is_noise else 0, count):
        shape, low = shapes[number % len(shapes)], number // len(shapes) % 4
        for link in links:
            place = rng.uniform(0.02, 0.98, 2)
            if task.disturbance.over_edge:
                place[rng.integers(2)] = rng.uniform(0.02, 0.06)
            force = np.exp(rng.uniform(*np.log(FORCES_N[low : low + 2])))
            common = {
                "link": link,
                "from_s": REST_S + number * STEP_S,
                "duration_s": TOUCH_S,
                "direction_deg": rng.uniform(0.0, 360.0),
                **shape,
            }
            wet = task.disturbance.beside
            found.append(ScenarioTouch(path=(tuple(place),), force_n=((1 - wet) * force,), **common))
            if wet:
                aside = np.clip(place + np.where(place > 0.5, -0.06, 0.06), 0.02, 0.98)
                found.append(ScenarioTouch(path=(tuple(aside),), force_n=(wet * force,), **common))
    return tuple(found)


def play(task: Task) -> dict[str, Estimates]:
    """Return estimates of position and of force of a hand, in each state."""
    drawn = task.disturbance.world.draw(Family.REPORTING.seed(task.number))
    builder = WORLD.draw(Family.REPORTING.seed(task.number))
    deployment = builder.describe(load(shipped.path("utah_mit.toml")))
    model = build_pad_model(deployment)
    first = WARM_UP + (QUIET if task.disturbance.is_noise else 0)
    numbers = range(first, first + 4 * task.each * len(task.shapes))
    more = round(DRAWN_PER_LEARNT * LEARNT) + DRAWN_MORE if task.learns else 0
    others = range(numbers.stop, numbers.stop + more)
    stimulus = Scenario(touch=draw_touches(task, model.links, others.stop, drawn.seed))
    rng = np.random.default_rng((drawn.seed, 12))
    fault, faults = task.disturbance.fault, list[Fault]()
    for link in model.links if fault else ():
        electrode = SIDE_ELECTRODES[rng.integers(4)]
        table = {"link": link, "from_s": 0.0, "electrode": electrode, **fault}
        faults.append(FAULTS[fault["kind"]].model_validate(table))
    hand = VirtualHand(deployment, stimulus, drawn, faults=faults)
    readings = TouchReadings.of_hand(hand, deployment, numbers)
    learnt_at = {
        (k, truth.link): truth
        for k in others
        for truth in hand.truth(REST_S + k * STEP_S + SAMPLE_S)
    }  # fmt: skip
    found: dict[str, list[Estimates]] = {"position": [], "force": []}
    for state in (CONFIGURED, LEARNED) if task.learns else (CONFIGURED,):
        given: list[list[int]] = [[]] * model.size
        if state == LEARNED:
            for row in range(model.size):
                learnt = learn(hand, deployment, model, row, others, (LEARNT,))[0]
                given[row] = learnt.touches
                if learnt.calibration:
                    model.set_calibration(row, learnt.calibration)
        contacts = readings.contacts(model, deployment)
        for row, (name, pad) in enumerate(deployment.pads):
            keys = [(k, pad.link) for k in numbers if (k, pad.link) in readings.truths]
            pairs = [(contacts.get(key), readings.truths[key]) for key in keys]
            labels = {"state": state, "pad": f"{task.number}/{pad.link}"}
            radius_m = 1e-3 * deployment.sheets[pad.sheet].contact_radius_mm
            forms = [(one["profile"], one["elongation"]) for one in task.shapes.values()]
            oracle = PadOracle.build(
                drawn, deployment, name, pad, model.noise_a[row], Patches(hand, row, radius_m, forms)
            )
            if given[row]:
                before = true_contacts(learnt_at, pad.link, given[row])
                oracle = oracle.with_contacts(before, contact_noise_a(model, row))
            position, force = compare(pairs, oracle, labels)
            shapes = list(task.shapes)
            cells = {
                "shape": np.array([shapes[k % len(shapes)] for k, _ in keys]),
                "range": np.array([k // len(shapes) % 4 for k, _ in keys]),
            }
            found["position"].append(with_columns(position, cells))
            found["force"].append(with_columns(force, cells))
    return {quantity: concatenate(some) for quantity, some in found.items()}


def with_columns(estimates: Estimates, more: Mapping[str, NDArray[Any]]) -> Estimates:
    return replace(estimates, columns={**estimates.columns, **more})


def row_of(part: Estimates, scale: float = 1e3) -> dict[str, Any]:
    """Return the cells of a row."""
    valid = part.where(part.valid)
    score = EstimateScore.of_estimates(part)
    pads = valid.columns["pad"]
    near = part.columns["edge distance"] == "1: below 5 %"
    share: Callable[[NDArray[np.bool_]], Any] = lambda mask: (  # noqa: E731
        ClusterShare.of_mask(mask, pads) if len(set(pads)) > 1 else "-"
    )
    return {
        "touches": len(part),
        "valid, %": 100 * part.valid.mean(),
        "valid within 5 % of an edge, %": 100 * part.valid[near].mean() if near.any() else None,
        "in 95 %": share(valid.stated_levels() <= 0.95),
        "> 5 sigma, %": score.beyond_5_sigma,
        "rms error": scale * score.rms_error,
        "median std": scale * score.median_std,
        "oracle": scale * score.oracle_std,
    }


def state_tables(report: Report, found: Mapping[str, Estimates]) -> None:
    """Add the tables of profiles and ranges of force."""
    for quantity, scale in (("position", 1e3), ("force", 1.0)):
        every = found[quantity]
        rows = []
        for state in dict.fromkeys(every.columns["state"].tolist()):
            of_state = every.where(every.columns["state"] == state)
            rows.append({"case": f"{state}, all"} | row_of(of_state, scale))
            shapes = of_state.columns["shape"]
            for shape in ("all shapes", *dict.fromkeys(shapes.tolist())):
                own = of_state.where((shapes == shape) | (shape == "all shapes"))
                for low in range(4):
                    cell = own.where(own.columns["range"] == low)
                    ends = f"{FORCES_N[low]:g} to {FORCES_N[low + 1]:g} N"
                    rows.append({"case": f"{state}, {shape}, {ends}"} | row_of(cell, scale))
        report.table(quantity.capitalize(), rows)


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--hands", type=int, default=6, help="of the profiles")
    parser.add_argument("--disturbed", type=int, default=3, help="hands of each disturbance")
    parser.add_argument("--each", type=int, default=5, help="touches of a pad in each profile and range")
    parser.add_argument(
        "--only", default="", help="profiles, disturbances, or those named so (keeps no page)"
    )
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    asked = parser.parse_args()
    if asked.quick:
        asked.hands, asked.disturbed, asked.each = 1, 1, 1
    named = "" if asked.only in ("profiles", "disturbances") else asked.only
    quick = asked.quick or bool(named)
    if asked.only in ("", "profiles"):
        tasks = [Task(DISTURBANCES[0], SHAPES, number, asked.each, True) for number in range(asked.hands)]
        made = played(tasks, asked.processes)
        report = Report(quick, "profiles", hands=asked.hands, touches_of_a_pad_in_a_cell=asked.each)
        state_tables(report, {q: concatenate([one[q] for one in made]) for q in ("position", "force")})
        report.keep()
    if asked.only != "profiles":
        tasks = [
            Task(one, ROUND, number, asked.each, one.learns)
            for one in DISTURBANCES
            if named in one.name
            for number in range(asked.disturbed)
        ]
        made = played(tasks, asked.processes)
        report = Report(quick, "disturbances", hands=asked.disturbed, touches_of_a_pad_in_a_range=asked.each)
        report.table("Disturbances", disturbance_rows(tasks, made))
        report.keep()


def played(tasks: Sequence[Task], processes: int) -> list[dict[str, Estimates]]:
    """Return the estimates of each hand."""
    made = []
    with ProcessPoolExecutor(processes) as pool:
        for task, result in zip(tasks, pool.map(play, tasks), strict=True):
            progress(f"{task.disturbance.name}, hand {task.number + 1}")
            made.append(result)
    return made


def disturbance_rows(tasks: Sequence[Task], made: Sequence[dict[str, Estimates]]) -> list[dict[str, Any]]:
    """Return a row for each disturbance and state."""
    rows = []
    for name in dict.fromkeys(task.disturbance.name for task in tasks):
        of_row = [one for task, one in zip(tasks, made, strict=True) if task.disturbance.name == name]
        position, force = (concatenate([one[what] for one in of_row]) for what in ("position", "force"))
        for state in dict.fromkeys(position.columns["state"].tolist()):
            own = row_of(force.where(force.columns["state"] == state), 1.0)
            rows.append(
                {"case": f"{name}, {state}"}
                | row_of(position.where(position.columns["state"] == state))
                | {f"force: {column}": own[column] for column in ("valid, %", "in 95 %", "> 5 sigma, %")}
            )
    return rows


if __name__ == "__main__":
    main()
