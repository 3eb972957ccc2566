"""Force and contact radius of pads with two sheets, beside the same hand with one.

Hands of the [worlds](../worlds.md) `default` and `harsh`, seeds of the reporting family: the shipped one, and
the same with a second sheet of alpha 1 on every pad (as in `config/two_sheets.toml`). Touches of 0.1 to 5 N
(log-uniform) anywhere from 2 % of a side inside the edges, on patches whose radii the world draws: 3 mm with
a standard deviation of 1 mm (`default`) or 2 mm (`harsh`), of all its profiles, elongated as it has them. All
go through the daemon's own pipeline; one sample of each, 0.32 s after it began, is compared. 16 touches come
first, as evidence for the compensation of sheets. Both files state the same range of radii, and what their
builder knows of parts and sheets. Sheets are fresh, and stated to be.

The true radius is that of a disc as large as the part of the patch that presses on the pad: a ring counts
without its hole, a contact over an edge without what hangs over it. *Of radius assumed*: the first sheet's
table has the radius with its standard deviation; 3 mm, whatever the contact. *Calibrated*: by laws that
`handtouch calibrate` fits to weights of 20 to 500 gf on each pad, each placed twice on feet of 2 and 4 mm
radius, known within 3 % and stated within 5 %.

*Least errors*: those of an estimator that knows the true laws, resistances and history of a pad's sheets and
how radii are distributed, for even discs in its middle: what is left is the scatter of the sheets from press
to press, their flicker and noise.

*Grasps*: those of [grasp](grasp.md), in which MuJoCo's patches have radii of 0.5 to 5 mm; samples of one
patch on a pad, up to 5 N. With one sheet the file states 2.5 +- 0.5 mm as there; with two 3 +- 1.5 mm. The
hand has been used before: its sheets are fresh, and stored as such.

*Hours*: mixed use in `default`, all pads at once: round contacts of 0.1 to 5 N, 2 to 40 s long (log-uniform)
and 2 to 120 s apart, with breaks of 5 to 20 minutes. *Radii unknown*: of 1 to 5 mm (log-uniform), stated as 3
+- 1 mm. *As stated*: 3 mm, stated within 0.1 mm. One sample of each contact, at a random age.
"""

from __future__ import annotations

import itertools
import os
from argparse import Namespace
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import replace
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from benchmarks import hand_touches
from benchmarks.bench_worlds import with_stated_touches
from benchmarks.grasp_run import drawn_world, served
from benchmarks.hand_touches import TouchReadings, draw_touches
from benchmarks.known_sheets import known_sheets
from benchmarks.page import Report, options, progress
from benchmarks.scores import MANY_SIGMA, Share
from benchmarks.two_sheets import weigh, with_radii, with_second_sheets
from handtouch import wire
from handtouch.config import Deployment, load, shipped
from handtouch.core.pad_model import PadModel
from handtouch.simulate.contact_patch import PROFILES
from handtouch.simulate.grasp.grasp_objects import GRASP_OBJECTS
from handtouch.simulate.grasp.mujoco_scene import TIME_STEP_S
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.solved_contact import PatchNodes
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, DrawnWorld, Family, MountSpread

FloatArray = NDArray[np.float64]
SHEETS = ("one sheet", "two sheets")
CASES = tuple(f"{sheets}{calibrated}" for sheets in SHEETS for calibrated in ("", ", calibrated"))
NAMED = ("default", "harsh")
FORCES_N = (0.1, 5.0)
RADIUS_MM, RADIUS_STD_MM = 3.0, 1.0
GRASP_RADII = {"one sheet": (2.5, 0.5), "two sheets": (3.0, 1.5)}
WARM_UP = 16
LEAST_DRAWS = 20
"""Of each pad"""
COLUMNS = (
    "true_n", "force_n", "force_std_n", "force_valid", "true_m", "radius_m", "radius_std_m", "radius_valid",
    "pad", "profile", "elongation",
)  # fmt: skip
_WITHIN_95 = 1.96


def deployment_with(sheets: str) -> Deployment:
    """Return the hand with one or two sheets on every pad."""
    return with_second_sheets() if sheets == SHEETS[1] else load(shipped.path("utah_mit.toml"))


def row_of(
    contact: wire.Contact | None,
    true_n: float,
    true_m: float,
    pad: int,
    profile: float = np.nan,
    elongation: float = np.nan,
) -> tuple[float, ...]:
    """Return the values of COLUMNS of a touch; NaN where nothing was published."""
    shape = pad, profile, elongation
    if contact is None:
        return (true_n, np.nan, np.nan, 0.0, true_m, np.nan, np.nan, 0.0, *shape)
    values = [
        np.nan if value is None else value
        for value in (
            *(contact.force_n, contact.force_std_n),
            *(contact.contact_radius_m, contact.contact_radius_std_m),
        )
    ]
    valid = contact.force_status == "valid", contact.contact_radius_status == "valid"
    return (true_n, *values[:2], float(valid[0]), true_m, *values[2:], float(valid[1]), *shape)


def play(task: tuple[str, int, int, str]) -> list[FloatArray]:
    """Return the touches (n, COLUMNS) of a hand, as configured and by laws fitted to weights: name of the
    world, number, touches of a pad, its sheets."""
    name, number, touches, sheets = task
    drawn = replace(WORLDS[name], mounts=MountSpread()).draw(Family.REPORTING.seed(number))
    hand_touches.FORCES_N = FORCES_N
    deployment = drawn.describe(with_radii(deployment_with(sheets), RADIUS_MM, RADIUS_STD_MM))
    stated = with_stated_touches(deployment, drawn)
    model, numbers = PadModel(stated), range(WARM_UP, WARM_UP + touches)
    drawn_touches = draw_touches(model.links, numbers.stop, drawn.seed)
    hand = VirtualHand(deployment, Scenario(touch=drawn_touches), drawn)
    readings = TouchReadings.of_hand(hand, deployment, numbers)
    true_m, shapes = {}, {}
    for key, truth in readings.truths.items():
        pad = model.links.index(key[1])
        index = key[0] * len(model.links) + pad
        place = drawn_touches[index].path[0]
        true_m[key] = radius_on_pad(hand, deployment, drawn, pad, index, place, truth.force_n)
        contact = drawn.contact(deployment.sheets[deployment.pads[pad].pad.sheet], index)
        shapes[key] = 1000 * number + pad, PROFILES.index(contact.profile), contact.elongation
    tables, laws = [], weigh(deployment, drawn)
    for is_calibrated in (False, True):
        for pad, own in enumerate(laws if is_calibrated else ()):
            fitted: dict[str, Any] = dict(zip(("law", "second_law"), own, strict=False))
            model.set_calibration(pad, replace(model.calibrations[pad], **fitted))
        contacts = readings.contacts(model, stated)
        tables.append(
            [
                row_of(contacts.get(key), truth.force_n, true_m[key], *shapes[key])
                for key, truth in readings.truths.items()
            ]
        )
    return [np.array(rows) for rows in tables]


def radius_on_pad(
    hand: VirtualHand,
    deployment: Deployment,
    drawn: DrawnWorld,
    pad: int,
    touch: int,
    position: tuple[float, float],
    force_n: float,
) -> float:
    """Return the radius [m] of a disc as large as what of a touch's patch presses on the pad."""
    sheet = deployment.sheets[deployment.pads[pad].pad.sheet]
    patch = drawn.contact(sheet, touch).patch.column(np.array([force_n]))
    nodes = PatchNodes.of_patches(hand.virtual_pads[pad].shape, np.array(position)[:, None], patch)
    return float(np.sqrt(nodes.area_m2.sum() / np.pi))


def grasp_rows(name: str, seed: int, sheets: str, world: str) -> FloatArray:
    """Return the samples (n, COLUMNS) of one patch on a pad, up to 5 N, of a grasp."""
    deployment = with_radii(deployment_with(sheets), *GRASP_RADII[sheets])
    run = served(deployment, name, seed, drawn_world(world, seed), used_before=True)
    links, rows = [pad.link for pad in deployment.hands[0].pads], []
    for contact in run.contacts:
        pad = links.index(contact.link)
        step = round((contact.t_ns - 1_000_000_000) * 1e-9 / TIME_STEP_S)
        discs = run.patches.force_n[step, pad]
        single = np.count_nonzero(discs) == 1
        if contact.event == "end" or not single or not FORCES_N[0] <= discs.max() <= FORCES_N[1]:
            continue
        radius_m = float(run.patches.radius_m[step, pad][discs.argmax()])
        rows.append(row_of(contact, float(discs.max()), radius_m, 1000 * seed + pad))
    return np.array(rows).reshape(-1, len(COLUMNS))


def least_errors(task: tuple[str, int, str]) -> FloatArray:
    """Return relative errors (n, 2) of force and radius of the best estimator: name of the world, number of
    the hand, its sheets."""
    name, number, sheets = task
    drawn = replace(WORLDS[name], mounts=MountSpread()).draw(Family.REPORTING.seed(number))
    deployment = drawn.describe(with_radii(deployment_with(sheets), RADIUS_MM, RADIUS_STD_MM))
    rng, (low, high) = np.random.default_rng((drawn.seed, 11)), np.log(FORCES_N)
    return np.concatenate(
        [
            pad.errors(np.exp(rng.uniform(low, high, LEAST_DRAWS)), rng)
            for pad in known_sheets(deployment, drawn)
        ]
    )


def least_row(case: str, errors: FloatArray) -> dict[str, Any]:
    """Return a row of the least errors of force and radius."""
    force, radius = 100 * np.median(np.abs(errors), axis=0)
    return {"case": case, "draws": len(errors), "force, median error, %": force, "radius, %": radius}


def use_for_hours(task: tuple[int, float, bool, str]) -> FloatArray:
    """Return the contacts (n, COLUMNS) of hours of mixed use: number of the hand, hours, whether radii are
    unknown, its sheets."""
    number, hours, unknown, sheets = task
    drawn = replace(WORLDS["default"], mounts=MountSpread()).draw(Family.REPORTING.seed(number))
    stated_mm = (RADIUS_MM, RADIUS_STD_MM) if unknown else (RADIUS_MM, 0.1)
    deployment = drawn.describe(with_radii(deployment_with(sheets), *stated_mm))
    links = [entry.pad.link for entry in deployment.pads]
    rng, t_s = np.random.default_rng((drawn.seed, 7)), 30.0
    touches, times, ages = [], [np.arange(0.0, 30.0, 0.1)], []
    while t_s < 3600 * hours:
        lasts_s, rest_s = np.exp(rng.uniform(np.log([2.0, 2.0]), np.log([40.0, 120.0]))).tolist()
        if rng.random() < 1 / 15:
            rest_s = float(rng.uniform(300.0, 1200.0))
        low, high = np.log(FORCES_N)
        forces_n = np.exp(rng.uniform(low, high, len(links)))
        radii_mm = np.exp(rng.uniform(0.0, np.log(5.0), len(links))) if unknown else np.full(len(links), 3.0)
        places = rng.uniform(0.1, 0.9, (len(links), 2))
        touches += [
            ScenarioTouch(
                link=link,
                from_s=t_s,
                duration_s=lasts_s,
                path=((float(x), float(y)),),
                force_n=(float(force_n),),
                radius_mm=float(radius_mm),
            )
            for link, (x, y), force_n, radius_mm in zip(links, places, forces_n, radii_mm, strict=True)
        ]
        ages.append(t_s + float(rng.uniform(0.5, lasts_s - 0.5)))
        times += [
            np.arange(t_s, t_s + lasts_s + 1.0, 0.1),
            np.arange(t_s + lasts_s + 1.0, t_s + lasts_s + rest_s, 0.5),
        ]
        t_s += lasts_s + rest_s
    times_s = np.concatenate(times)
    hand = VirtualHand(deployment, Scenario(touch=tuple(touches)), drawn)
    at = {int(tick): k for k, tick in enumerate(np.searchsorted(times_s, ages))}
    readings = TouchReadings.at_times(hand, times_s, at)
    contacts = readings.contacts(PadModel(deployment), deployment)
    return np.array(
        [
            row_of(contacts.get(key), truth.force_n, truth.radius_m, 1000 * number + links.index(key[1]))
            for key, truth in readings.truths.items()
        ]
    )


def score(case: str, rows: FloatArray, quantity: str) -> dict[str, Any]:
    """Return a row of the errors of force or radius, with coverage and sharpness."""
    true, value, std, valid = rows[:, 0:4].T if quantity == "force" else rows[:, 4:8].T
    known = (valid > 0) & np.isfinite(value) & np.isfinite(std)
    error, unit = (value - true)[known], 1.0 if quantity == "force" else 1e3
    sigma = np.abs(error) / std[known]
    made: dict[str, Any] = {"case": case, "touches": len(rows), "valid": Share.of_mask(known)}
    if not len(error):
        return made
    return made | {
        f"rms, {'N' if unit == 1.0 else 'mm'}": unit * float(np.sqrt(np.mean(error**2))),
        "median error, %": 100 * float(np.median(np.abs(error) / true[known])),
        "median std, %": 100 * float(np.median(std[known] / true[known])),
        "bias, %": 100 * float(np.median(error / true[known])),
        "within 95 %": Share.of_mask(sigma < _WITHIN_95),
        "beyond 5 sigma": Share.of_mask(sigma > MANY_SIGMA),
    }


def by_radius(case: str, rows: FloatArray, quantity: str) -> list[dict[str, Any]]:
    """Return rows of errors by true radius."""
    edges_mm = (0.0, 2.0, 3.5, np.inf)
    return [
        score(
            f"{case}, {low:g} to {high:g} mm",
            rows[(rows[:, 4] >= 1e-3 * low) & (rows[:, 4] < 1e-3 * high)],
            quantity,
        )
        for low, high in itertools.pairwise(edges_mm)
    ]


def by_shape(case: str, rows: FloatArray, quantity: str) -> list[dict[str, Any]]:
    """Return rows of errors by pressure profile, and of elongated contacts."""
    profiles = [
        score(f"{case}, {profile}", rows[rows[:, 9] == number], quantity)
        for number, profile in enumerate(PROFILES)
    ]
    return [*profiles, score(f"{case}, elongated 1.4 or more", rows[rows[:, 10] >= 1.4], quantity)]


def add_tables(report: Report, found: dict[tuple[str, str], FloatArray], title: str) -> None:
    """Add the tables of force and radius."""
    for quantity in ("force", "radius"):
        cases = [(f"{world}, {sheets}", rows) for (world, sheets), rows in found.items()]
        if quantity == "radius":
            cases = [(case, rows) for case, rows in cases if SHEETS[1] in case]
        table = [score(case, rows, quantity) for case, rows in cases]
        for case, rows in cases:
            table += by_radius(case, rows, quantity)
            if case.endswith(CASES[-1]) and np.isfinite(rows[:, 9]).all():
                table += by_shape(case, rows, quantity)
        report.table(f"{title}: {quantity}", table)


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--hands", type=int, default=4, help="of each world")
    parser.add_argument("--touches", type=int, default=10, help="of each pad")
    parser.add_argument("--seeds", type=int, default=2, help="of each grasp")
    parser.add_argument("--hours", type=float, default=12.0, help="of mixed use")
    parser.add_argument("--objects", nargs="+", default=list(GRASP_OBJECTS), choices=list(GRASP_OBJECTS))
    parser.add_argument("--only", nargs="+", default=list(PARTS), choices=list(PARTS))
    asked = parser.parse_args()
    if asked.quick:
        asked.hands, asked.touches, asked.seeds, asked.objects = 1, 2, 1, asked.objects[:1]
        asked.hours = min(asked.hours, 0.2)
    with ProcessPoolExecutor(os.cpu_count() or 1) as pool:
        for name in asked.only:
            PARTS[name](pool, asked)


def report_touches(pool: Executor, asked: Namespace) -> None:
    """Measure touches, and the least errors of their hands."""
    tasks = [
        (world, number, asked.touches, sheets) for world, sheets in KEYS for number in range(asked.hands)
    ]
    parts: dict[tuple[str, str], list[FloatArray]] = {(world, case): [] for world in NAMED for case in CASES}
    for task, tables in zip(tasks, pool.map(play, tasks), strict=True):
        for case, rows in zip([case for case in CASES if case.startswith(task[3])], tables, strict=True):
            parts[task[0], case].append(rows)
        progress(f"{task[0]}, {task[3]}: hand {task[1] + 1}")
    report = Report(asked.quick, part="touches", hands=asked.hands, touches_of_a_pad=asked.touches)
    add_tables(report, {key: np.concatenate(made) for key, made in parts.items()}, "Touches")
    report.table(
        "Least errors",
        [
            least_row(
                f"{world}, {sheets}",
                np.concatenate([least_errors((world, number, sheets)) for number in range(asked.hands)]),
            )
            for world, sheets in KEYS
        ],
    )
    report.keep()


def report_grasps(pool: Executor, asked: Namespace) -> None:
    """Measure MuJoCo's grasps."""
    grasps = {}
    for world, sheets in KEYS:
        tasks = [(name, seed, sheets, world) for seed in range(1, asked.seeds + 1) for name in asked.objects]
        grasps[world, sheets] = np.concatenate(list(pool.map(grasp_rows, *zip(*tasks, strict=True))))
        progress(f"grasps, {world}, {sheets}")
    report = Report(asked.quick, part="grasps", seeds=asked.seeds, objects=", ".join(asked.objects))
    add_tables(report, grasps, "Grasps")
    report.keep()


def report_hours(pool: Executor, asked: Namespace) -> None:
    """Measure hours of mixed use."""
    rows = []
    for unknown, name in ((True, "radii unknown"), (False, "radii as stated")):
        for sheets in SHEETS:
            tasks = [(number, asked.hours, unknown, sheets) for number in range(asked.hands)]
            found = np.concatenate(list(pool.map(use_for_hours, tasks)))
            rows.append(score(f"{sheets}, {name}", found, "force"))
            progress(f"hours, {sheets}, {name}")
    report = Report(asked.quick, part="hours", hands=asked.hands, hours_of_each=asked.hours)
    report.table("Hours of mixed use: force", rows)
    report.keep()


PARTS = {"touches": report_touches, "grasps": report_grasps, "hours": report_hours}
KEYS = [(world, sheets) for world in NAMED for sheets in SHEETS]


if __name__ == "__main__":
    main()
