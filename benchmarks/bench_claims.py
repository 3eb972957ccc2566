"""Claims about accuracy that an independent check found to hold in some worlds only, measured again.

Each row repeats a figure of that check, made with its own seeds, pads, sheets and scenes, in worlds of the
reporting family with the daemon's settings. `--as-found` keeps the figures as those before estimators
changed; later runs are shown beside them, and without them that column is empty. Writes
docs/benchmarks/claims.{md,json}.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import bench_gains
import bench_worlds
import hand_touches
import numpy as np
from claim_table import Claim, Figure, write_page
from diagnose_episodes import FAULTY, episode
from numpy.typing import NDArray
from page import made_by, options, output_folder, progress
from scores import ClusterShare, Estimates, Share, concatenate
from sheet_use import FULL_N, drawn_sheets, score_use

from handtouch.config import load, shipped
from handtouch.core.pad_model import PadModel, networks_of
from handtouch.field import ContactLaw, ForceEstimateStatus
from handtouch.field.model import spreading_radius
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.sheet_physics import PowerCreep
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import SHEET_KINDS, WORLDS, Family, SheetKind, World
from handtouch.supervisor.diagnose import DiagnosisModel, HandDiagnostics
from handtouch.wire import Contact

FloatArray = NDArray[np.float64]
AS_FOUND = "claims_as_found.json"
RADIUS_FORCES_N = {"firm": (4.0, 10.0), "soft": (3.0, 8.0)}
SHEET_PADS = 24


# Position: touches on hands of the named worlds and of worlds in which only some quantities are hidden


def position_parts(tasks: Sequence[tuple[str, int]], workers: int, touches: int) -> dict[str, Estimates]:
    """Return positions by world, uncalibrated hands."""
    parts: dict[str, list[Estimates]] = {}
    with ProcessPoolExecutor(workers) as pool:
        every = [(name, number, touches, ()) for name, number in tasks]
        for (name, number, *_), found in zip(every, pool.map(bench_worlds.play, every), strict=True):
            own = found["position"]
            mask = own.columns["state"] == bench_worlds.CONFIGURED
            parts.setdefault(name, []).append(own.where(mask))
            progress(f"position: {name}, hand {number + 1}")
    return {name: concatenate(some) for name, some in parts.items()}


def in_95(some: Estimates) -> ClusterShare:
    """Return the coverage of valid estimates' 95 % regions; touches of one pad are a cluster."""
    good = some.where(some.valid)
    return ClusterShare.of_mask(good.stated_levels() <= 0.95, good.columns["pad"])


def position_figures(hands: int, touches: int, workers: int) -> Iterator[tuple[Claim, Figure]]:
    names = ("ideal", "default", "gaps 0.2 mm", "gains 0.5 %, gaps 0.05 mm")
    found = position_parts([(name, number) for name in names for number in range(hands)], workers, touches)
    ideal, default, gaps, small = (found[name] for name in names)
    middle = ideal.where(ideal.columns["edge distance"] == "3: 15 and more %")
    edge = ideal.where(ideal.columns["edge distance"] == "1: below 5 %")
    region = "95 % region of position"
    by_force = (
        "the share inside depends on the force of the touches: noise, and with it the region, is smaller for "
        "larger forces. From 0.2 to 2 N both figures agree with the check (below)."
    )
    yield (
        Claim(f"{region}: ideal parts, middle of the pad", "% inside", (94.8,), "15 % of a side inwards"),
        Figure.of_share(in_95(middle)),
    )
    yield (
        Claim(
            f"{region}: ideal parts, within 5 % of an edge", "% inside", (74.0, 92.0), "2 to 5 % of a side",
            why="the simulator's touches end 2 % of a side inside. From currents alone, without it, fewer "
            "are inside nearer than that, and with more noise (below).",
        ),
        Figure.of_share(in_95(edge)),
    )  # fmt: skip
    yield (
        Claim(
            f"{region}: world `default`, shipped hand",
            "% inside",
            (27.0,),
            "0.2 to 12 N; sheets and drift",
        ),
        Figure.of_share(in_95(default)),
    )
    good = default.where(default.valid)
    yield (
        Claim("position off by more than 5 sigma: world `default`", "%", (49.0,), "the same touches"),
        Figure.of_share(ClusterShare.of_mask(good.distances() > 5, good.columns["pad"])),
    )
    yield (
        Claim(f"{region}: perfect gains, gaps ±0.2 mm", "% inside", (67.0,), "0.2 to 12 N", why=by_force),
        Figure.of_share(in_95(gaps)),
    )
    yield (
        Claim(f"{region}: gains ±0.5 %, gaps ±0.05 mm", "% inside", (51.0,), "0.2 to 12 N", why=by_force),
        Figure.of_share(in_95(small)),
    )


# Force with a hidden radius


def radius_hand(task: tuple[int, int]) -> list[tuple[str, float, str, bool]]:
    """Return sheet, force, pad and whether the 95 % interval of force holds, of valid forces of a hand."""
    number, touches = task
    drawn = bench_worlds.drawn_world("radius", number)
    deployment = drawn.describe(load(shipped.path("utah_mit.toml")))
    model, rng = PadModel(deployment), np.random.default_rng((drawn.seed, 10))
    sheet_of = {pad.link: pad.sheet for pad in deployment.hands[0].pads}
    made = tuple(
        ScenarioTouch(
            link=link,
            from_s=hand_touches.REST_S + k * hand_touches.STEP_S,
            duration_s=hand_touches.TOUCH_S,
            path=(tuple(rng.uniform(0.2, 0.8, 2).tolist()),),
            force_n=(RADIUS_FORCES_N[sheet_of[link]][k % 2],),
        )
        for k in range(touches)
        for link in model.links
    )
    hand = VirtualHand(deployment, Scenario(touch=made), drawn)
    contacts, truths = hand_touches.sampled(hand, model, deployment, range(touches))
    rows = []
    for (k, link), truth in truths.items():
        error, variance = hand_touches.force_error(contacts.get((k, link)), truth)
        if np.isfinite(error[0]):
            inside = bool(abs(error[0]) <= 1.96 * math.sqrt(variance[0, 0]))
            rows.append((sheet_of[link], truth.force_n, f"{number}/{link}", inside))
    return rows


def slope_shares(touches: int = 2000) -> dict[tuple[str, float], float]:
    """Return the share in % of valid forces within 95 % intervals whose width is the slope by the radius.

    By the contact law alone, as forces were before their intervals were quadratures over the radius.
    """
    deployment, rng = load(shipped.path("utah_mit.toml")), np.random.default_rng(11)
    shares = {}
    for name, forces_n in RADIUS_FORCES_N.items():
        sheet = deployment.sheets[name]
        pads = [
            network
            for network, (_, pad) in zip(networks_of(deployment), deployment.pads, strict=True)
            if pad.sheet == name
        ]
        count = touches // len(pads)
        at = rng.uniform(0.2, 0.8, (len(pads), 2, count))
        outer_m = np.concatenate(
            [spreading_radius(pad, pad.a * x, pad.b * y) for pad, (x, y) in zip(pads, at, strict=True)]
        )
        stated_m, std_m = 1e-3 * sheet.contact_radius_mm, 1e-3 * sheet.contact_radius_std_mm
        radii_m = np.maximum(rng.normal(stated_m, std_m, len(outer_m)), 0.2 * stated_m)
        law = ContactLaw(
            1e-6 * sheet.contact_ohm_mm2, sheet.alpha, stated_m, std_m, 1e3 * sheet.reference_kpa
        )
        for force_n in forces_n:
            circuit = (1.0, sheet.ohm_per_square, outer_m)
            true_law = replace(law, radius_m=radii_m, radius_std_m=0.0)
            found = law.force(true_law.current(np.full(len(outer_m), force_n), *circuit), *circuit)
            valid = found.status == ForceEstimateStatus.VALID
            inside = np.abs(found.force_n - force_n) <= 1.96 * found.std_n
            shares[name, force_n] = 100 * float(inside[valid].mean())
    return shares


def radius_figures(hands: int, touches: int, workers: int) -> Iterator[tuple[Claim, Figure]]:
    with ProcessPoolExecutor(workers) as pool:
        tasks = [(number, touches) for number in range(hands)]
        rows = [row for rows in pool.map(radius_hand, tasks) for row in rows]
    progress(f"force with hidden radius: {len(rows)} valid forces")
    slopes = slope_shares()
    checks = {("firm", 4.0): 69.0, ("firm", 10.0): 64.0, ("soft", 3.0): 80.0, ("soft", 8.0): 54.0}
    for (sheet, force_n), check in checks.items():
        own = [row for row in rows if row[0] == sheet and abs(row[1] - force_n) < 0.01]
        claim = Claim(
            f"95 % interval of force, radius drawn as stated: {sheet} sheet, {force_n:g} N", "% inside",
            (check,), "20 % of a side inwards; valid forces",
            why="the checked intervals were the slope of the force by the radius; those of the commit as "
            f"found are quadratures over it. By the slope, {slopes[sheet, force_n]:.0f} % are inside.",
        )  # fmt: skip
        if len({row[2] for row in own}) > 1:
            hits, pads = np.array([row[3] for row in own]), np.array([row[2] for row in own])
            yield claim, Figure.of_share(ClusterShare.of_mask(hits, pads))


# Force on sheets unlike the presets


def unlike(preset: str, change: str) -> SheetKind:
    """Return a sheet of the paper with one property that its preset doesn't have."""
    kind = SHEET_KINDS[preset]
    adaptation = kind.law.adaptation
    laws = {
        "creep t^0.10": replace(kind.law, creep=PowerCreep(0.10)),
        "adaptation 3 times as fast": replace(
            kind.law,
            adaptation=replace(adaptation, times_s=tuple(time_s / 3 for time_s in adaptation.times_s)),
        ),
        "no adaptation": replace(kind.law, adaptation=replace(adaptation, shares=(), times_s=())),
    }
    return replace(kind, name=f"{preset}, {change}", law=laws[change])


def sheet_task(task: tuple[str, str, float, int]) -> Estimates:
    preset, change, hours, pads = task
    nominal = World("sheets")  # parameters and layers as in the file
    return score_use(
        [drawn_sheets(nominal.draw(Family.REPORTING.seed(0)), unlike(preset, change), pads)],
        hours,
        Family.REPORTING.seed(0),
    )


def sheet_figures(hours: float, pads: int, workers: int) -> Iterator[tuple[Claim, Figure]]:
    tasks = [
        (preset, change, hours, pads)
        for preset in ("S1", "S2")
        for change in ("creep t^0.10", "adaptation 3 times as fast", "no adaptation")
    ]
    with ProcessPoolExecutor(workers) as pool:
        found = dict(zip([task[:2] for task in tasks], pool.map(sheet_task, tasks), strict=True))
    progress(f"sheets unlike the presets: {', '.join(str(len(some)) for some in found.values())} contacts")
    use = "grips of 0.1 to 5 N for hours, file states the preset"
    longer = (
        "errors by creep that the file doesn't state grow with the duration of a grip: readings later than "
        "10 s after its begin have the check's share inside (S1), and the larger errors (below)."
    )
    by_preset = (
        "the presets are pooled here, and presses of S2 vary by 17 %, those of S1 by 7 %: S1 alone is nearer "
        "to the check (below)."
    )
    for preset, check in (("S1", 78.0), ("S2", 88.0)):
        yield (
            Claim(
                f"95 % interval of force: {preset} with creep t^0.10", "% inside", (check,), use, why=longer
            ),
            Figure.of_share(in_95(found[preset, "creep t^0.10"])),
        )
    creep = concatenate([found[preset, "creep t^0.10"] for preset in ("S1", "S2")])
    yield from errors("creep t^0.10", (27.0, 16.0), creep, use, longer)
    fast = concatenate([found[preset, "adaptation 3 times as fast"] for preset in ("S1", "S2")])
    yield (
        Claim("95 % interval of force: adaptation 3 times as fast", "% inside", (71.0,), use, why=by_preset),
        Figure.of_share(in_95(fast)),
    )
    still = concatenate([found[preset, "no adaptation"] for preset in ("S1", "S2")])
    yield from errors("a sheet that doesn't adapt", (15.0, 4.9), still, use, by_preset)


def errors(
    name: str, checks: tuple[float, float], some: Estimates, conditions: str, why: str
) -> Iterator[tuple[Claim, Figure]]:
    """Yield rms force errors in % of full scale, with and without compensation; a pad is one trial."""
    good = some.where(some.valid)
    columns = {"compensated": good.error[:, 0], "uncompensated": good.columns["uncompensated"]}
    for (label, error), check in zip(columns.items(), checks, strict=True):
        _, row = np.unique(good.columns["pad"], return_inverse=True)
        squares = np.bincount(row, weights=np.square(error)) / np.bincount(row)
        mean = Figure.of_ratios(squares)
        limits = [100 * math.sqrt(max(v, 0.0)) / FULL_N for v in (mean.value, mean.low, mean.high)]
        yield (
            Claim(
                f"force error, {name}: {label}",
                "% of 5 N, rms",
                (check,),
                conditions,
                as_share=False,
                why=why,
            ),
            Figure(*limits),
        )


# Gum, gains, location


def gum_episode(task: tuple[str, int]) -> tuple[str, bool]:
    """Play one episode of gum on a hand with sheets of a kind; return whether it is named."""
    kind, seed = task
    world = WORLDS["default"].only("parts", "contacts", "sheets")
    world = world.with_sheets(*((SHEET_KINDS[kind],) if kind in SHEET_KINDS else ()))
    it = episode("gum", seed, world)
    diagnosis = HandDiagnostics(DiagnosisModel.from_deployment(it.deployment, "right"))
    named = False
    for block in it.blocks():
        for fault in diagnosis.process_block(block):
            named |= fault.is_fault and fault.link == it.link and fault.kind == FAULTY["gum"]
    return kind, named


def gum_figures(episodes: int, workers: int) -> Iterator[tuple[Claim, Figure]]:
    tasks = [("ideal", seed) for seed in range(episodes)]
    tasks += [(kind, seed) for kind in ("S1", "S2") for seed in range(episodes)]
    named: dict[str, list[bool]] = {}
    with ProcessPoolExecutor(workers) as pool:
        for number, (kind, is_named) in enumerate(pool.map(gum_episode, tasks), 1):
            named.setdefault("ideal" if kind == "ideal" else "S1/S2", []).append(is_named)
            if number % 16 == 0:
                progress(f"gum: {number} of {len(tasks)} episodes")
    for name, count, of in (("ideal", 8, 8), ("S1/S2", 12, 64)):
        yield (
            Claim(
                f"gum is named: {name} sheets", "% of episodes", (100 * count / of,),
                "use of three pads, 110 s", trials=of,
            ),
            Figure.of_share(Share.of_mask(np.array(named[name]))),
        )  # fmt: skip


def gain_figures(trials: int) -> Iterator[tuple[Claim, Figure]]:
    ratios = []
    for label in bench_gains.PADS:
        rows = bench_gains.trials(label, 1e-4, 0.0, trials)
        row = next(row for row in rows if row["contacts"] == 400)
        ratios.append(row["error / bound"])
        progress(f"gains: {label}")
    value = float(np.sqrt(np.mean(np.square(ratios))))
    reach = 1.96 * value / math.sqrt(2 * 3 * trials * len(ratios))  # 3 independent log gains a trial
    yield (
        Claim(
            "gains at the Fisher bound: error / bound after 400 contacts", "with the daemon's settings",
            (1.2, math.inf),
            "ideal pads, point contacts, noise 1e-4; the check gave no figure: aim 1 to 1.2, "
            "which the estimator reaches with `model_error` 0, as the bound assumes",
            as_share=False,
        ),
        Figure(value, value - reach, value + reach),
    )  # fmt: skip


def session(number: int, seconds: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return errors and bounds [m] of all contact samples of the demo's session, and the touch of each."""
    drawn = WORLDS["ideal"].draw(Family.REPORTING.seed(number))
    deployment = drawn.describe(load(shipped.path("utah_mit.toml")))
    scenario = Scenario.load(shipped.path("utah_mit_session.toml"))
    hand, model = VirtualHand(deployment, scenario, drawn), PadModel(deployment)
    period_s = deployment.daemon.sync_period_ms * 1e-3
    times_s = period_s * np.arange(1, round(min(seconds, scenario.duration_s) / period_s))
    counts = np.stack([hand.counts(row, times_s) for row in range(model.size)], axis=1)
    contacts = hand_touches.serve(model, deployment, counts, {k: k for k in range(len(times_s))})
    begun: dict[str, int] = {}
    found = []
    for k, t_s in enumerate(times_s.tolist()):
        for truth in hand.truth(t_s):
            contact: Contact | None = contacts.get((k, truth.link))
            if contact and contact.event == "begin":
                begun[truth.link] = k
            error, _ = hand_touches.position_error(contact, truth)
            if np.isfinite(error).all():
                touch = 1000 * begun.get(truth.link, 0) + model.links.index(truth.link)
                found.append((float(np.linalg.norm(error)), truth.bound_m, touch))
    error_m, bound_m, touches = np.array(found).T
    return error_m, bound_m, touches


def location_figures(seeds: int, seconds: float) -> Iterator[tuple[Claim, Figure]]:
    runs = [session(number, seconds) for number in range(seeds)]
    progress(f"location in the demo's session: {sum(len(run[0]) for run in runs)} samples")
    of_rms = np.array([math.sqrt(np.mean(e**2) / np.mean(b**2)) for e, b, _ in runs])
    squares = np.sort(np.concatenate([b for _, b, _ in runs]) ** 2)[::-1]
    weakest = 100 * float(squares[: max(len(squares) // 100, 1)].sum() / squares.sum())
    ratio = np.concatenate([e / b for e, b, _ in runs])
    touch = np.concatenate([t + 1e7 * k for k, (_, _, t) in enumerate(runs)])
    _, row = np.unique(touch, return_inverse=True)
    by_touch = Figure.of_ratios(np.bincount(row, weights=ratio**2) / np.bincount(row))
    mean = float(np.sqrt(np.mean(ratio**2)))
    reach = max(by_touch.high - by_touch.value, 0.0) / (2 * mean)
    session_of = "demo's session, ideal world"
    yield (
        Claim("location: ratio of rms error and rms bound", "", (0.98,), session_of, as_share=False),
        Figure.of_ratios(of_rms),
    )
    yield (
        Claim("share of the squared bound in the weakest 1 % of samples", "%", (89.0,), session_of),
        Figure(weakest, weakest, weakest),
    )
    yield (
        Claim("location: error / bound of each sample, rms", "", (1.0, 1.03), session_of, as_share=False),
        Figure(mean, mean - reach, mean + reach),
    )


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--as-found", action="store_true", help="keep as figures of the checked estimators")
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1))
    asked = parser.parse_args()
    quick, workers = asked.quick, asked.workers
    parts: list[Callable[[], Iterator[tuple[Claim, Figure]]]] = [
        lambda: position_figures(1 if quick else 4, 4 if quick else 20, workers),
        lambda: radius_figures(1 if quick else 4, 4 if quick else 20, workers),
        lambda: sheet_figures(0.5 if quick else 4.0, 4 if quick else SHEET_PADS, workers),
        lambda: gum_figures(2 if quick else 16, workers),
        lambda: gain_figures(2 if quick else 60),
        lambda: location_figures(2 if quick else 3, 10.0 if quick else math.inf),
    ]
    rows = [row for part in parts for row in part()]
    out, stamp = output_folder(quick), made_by()
    figures = {claim.title: asdict(figure) for claim, figure in rows}
    kept = out / AS_FOUND
    if asked.as_found:
        commit = stamp.split("commit `")[1].split("`")[0]
        kept.write_text(json.dumps({"commit": commit, "figures": figures}, indent=1) + "\n")
    before = json.loads(kept.read_text()) if kept.exists() else {"commit": "not measured", "figures": {}}
    write_page(rows, before, stamp, out)


if __name__ == "__main__":
    main()
