"""Measure stiffness, shape and texture on simulated contacts with hidden parameters.

Stiffness: squeezes on the shipped hand's 15 pads in the worlds `ideal`, `default` and `harsh`, through the
daemon's tick; depth with noise of encoders. Shape: touches of objects that lie
anyhow, with noise, and pads that sit a little askew. Texture: sines of force under a slide, through the
simulated pad's currents. Writes docs/benchmarks/percept.{md,json,png}; --quick tries it out.
"""

from __future__ import annotations

import json
import math
import os
import platform
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from daemon_settings import pipeline_of
from numpy.typing import NDArray
from page import made_by, options, output_folder
from scipy.optimize import least_squares

from handtouch.config import Deployment, load, shipped
from handtouch.core.pad_model import PadModel
from handtouch.field import Sandwich
from handtouch.percept.classify import classify_shape
from handtouch.percept.pipeline import PerceptPipeline
from handtouch.percept.primitives import SHAPE_CLASSES, fit_primitive
from handtouch.percept.primitives import ShapePrior as ShapePrior
from handtouch.percept.samples import ContactBuffer, ContactSamples
from handtouch.percept.spectrum import estimate_texture
from handtouch.percept.stiffness import (
    UNCOMPENSATED_SHEET_STD,
    estimate_stiffness,
    estimate_stiffness_from_area,
)
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, DrawnWorld, Family, MountSpread, World
from handtouch.wire import PERCEPT_KINDS

matplotlib.use("Agg")
from matplotlib import pyplot as plt

FloatArray = NDArray[np.float64]
Rows = list[dict[str, Any]]

PERIOD_NS, RATE_HZ = 5_000_000, 200.0
SQUEEZE_S, PAUSE_S, PRESSES = 2.4, 0.6, 4
ENCODER_M = 10e-6  # noise of depth: 0.25 mrad at 40 mm
STIFFNESSES = np.geomspace(100, 1e5, 7)
DRAWABLE = {name: replace(world, mounts=MountSpread()) for name, world in WORLDS.items()}
"""Pads are mounted as stated: shape has errors of mounts of its own."""
CONTACTS = (1, 5, 20, 100)
SPEEDS, RATES = (5e-3, 20e-3, 100e-3), (100.0, 200.0, 500.0, 1000.0)
OF_NYQUIST = (0.8, 0.95, 1.05, 1.2, 1.4, 1.7, 2.0, 3.0)
SLIDE, MODULATION, PATH_M = 512, 0.02, 2e-6


# Stiffness --------------------------------------------------------------------------------------------------


class Silent:
    """Publisher without subscribers."""

    subscriptions: frozenset[bytes] = frozenset()

    def has_subscriber(self, topic: str) -> bool:  # noqa: ARG002
        return False

    def send(self, message: Any) -> None:
        """Never called."""


def squeezes(links: list[str]) -> Scenario:
    """Every pad pressed with 1 N, squeezed to 4 N and let go, `PRESSES` times."""
    touches = [
        ScenarioTouch(
            link=link,
            from_s=0.5 + number * (SQUEEZE_S + PAUSE_S),
            duration_s=SQUEEZE_S,
            path=((0.5, 0.5),),
            force_n=(1.0, 1.0, 4.0, 1.0),
            ramp_s=0.2,
        )
        for number in range(PRESSES)
        for link in links
    ]
    return Scenario(touch=tuple(touches))


def play(deployment: Deployment, world: DrawnWorld) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Times, true forces, forces and deviations (ticks, pads) as published by the daemon's tick."""
    model = PadModel(deployment)
    scenario = squeezes(model.links)
    hand = VirtualHand(deployment, scenario, world)
    times = np.arange(0, 0.5 + PRESSES * (SQUEEZE_S + PAUSE_S), 1 / RATE_HZ)
    counts = np.stack([hand.counts(row, times) for row in range(model.size)], axis=1).astype("<i2")
    pipeline = pipeline_of(deployment, Silent(), model=model, period_ns=PERIOD_NS)
    estimates = np.full((2, len(times), model.size), np.nan)
    for number in range(len(times)):
        t_ns = 10**9 + number * PERIOD_NS
        pipeline.begin_cycle(t_ns, t_ns)
        for pad in range(model.size):
            pipeline.slab.write_pdo(pad, counts[number, pad].tobytes(), t_ns + 1000)
        if pipeline.tick_if_due(t_ns + 2000) is None:
            pipeline.tick_if_due(t_ns + PERIOD_NS - 1)
        touching = pipeline.tick.contacts.touching
        columns = pipeline.tick.columns
        estimates[0, number] = np.where(touching, columns.force_n, np.nan)
        estimates[1, number] = np.where(touching, columns.force_std_n, np.nan)
    truth = np.zeros((len(times), model.size))
    for touch in scenario.touches:
        truth[:, model.links.index(touch.link)] += touch.forces(times)
    return times, truth, estimates[0], estimates[1]


def stiffnesses(seeds: int) -> Rows:
    """A row a world, compensation and stiffness."""
    plain = load(shipped.path("utah_mit.toml"))
    rows: Rows = []
    for name, world in DRAWABLE.items():
        drawn = [world.draw(Family.REPORTING.seed(seed)) for seed in range(101, 101 + seeds)]
        for compensated in (False, True) if world.sheets.reporting_kinds else (False,):
            runs = [play(one.describe(plain) if compensated else plain, one) for one in drawn]
            for k in STIFFNESSES:
                rows.append(
                    {
                        "world": name,
                        "compensated": compensated,
                        "k": float(k),
                        **assess(runs, float(k), compensated),
                    }
                )
            print(
                name,
                compensated,
                [f"{row['error']:.2f}/{row['coverage']:.2f}" for row in rows[-7:]],
                flush=True,
            )
    return rows


def assess(
    runs: list[tuple[FloatArray, FloatArray, FloatArray, FloatArray]], k: float, compensated: bool
) -> dict[str, Any]:
    """Objects with stiffness k at 2 N, springs and spheres in turn."""
    sheet_std = 0.0 if compensated else UNCOMPENSATED_SHEET_STD  # as in the daemon
    chance = np.random.default_rng((101, int(k)))
    errors, held, known, widths, scales = [], 0, 0, [], []
    for times, truth, force, std in runs:
        for pad in range(truth.shape[1]):
            for press in range(PRESSES):
                begin = 0.5 + press * (SQUEEZE_S + PAUSE_S)
                at = np.flatnonzero((times > begin + 0.25) & (times < begin + SQUEEZE_S - 0.25))
                p = (1.0, 1.5)[(pad + press) % 2]
                c = (k / (p * 2.0 ** (1 - 1 / p))) ** p
                depth = (truth[at, pad] / c) ** (1 / p) + ENCODER_M * chance.normal(size=len(at))
                found = estimate_stiffness(force[at, pad], depth, std[at, pad], sheet_relative_std=sheet_std)
                if not found.samples:
                    errors.append(math.nan)
                    continue
                real = k * (found.at_force_n / 2.0) ** (1 - 1 / p)
                known += found.state == "estimated"
                held += found.low_n_per_m <= real <= found.high_n_per_m
                errors.append(math.log(found.stiffness_n_per_m / real))
                widths.append(math.log(found.high_n_per_m / found.low_n_per_m) / 2)
                scales.append(found.common_relative_std)
    n = len(errors)
    return {
        "squeezes": n,
        "bias": float(np.nanmedian(errors)),
        "error": float(np.sqrt(np.nanmean(np.square(errors)))),
        "coverage": held / n,
        "estimated": known / n,
        "half_width": float(np.median(widths)),
        "scale_std": float(np.median(scales)),
    }


# Force and area ---------------------------------------------------------------------------------------------

RADII_MM = (1.5, 3.0, 6.0)
PAIR = Sandwich((1e-3, 1e-3), (0.6, 1.8), (2400.0, 2400.0))
DRIVE_V, OUTER_M, OBJECT_M = 5.0, 0.02, 0.012


def alike() -> dict[str, list[float]]:
    """By alpha of a single sheet: forces on discs of RADII_MM that give one current: 2 N on the middle."""
    found = {}
    for alpha in PAIR.alpha:
        pair = Sandwich((1e-3, 1e-3), (alpha, alpha + 1), (2400.0, 2400.0))
        force = np.geomspace(1e-3, 1e4, 4000)
        aim = float(pair.currents(2.0, RADII_MM[1] * 1e-3, DRIVE_V, OUTER_M)[0])
        curves = [pair.currents(force, radius * 1e-3, DRIVE_V, OUTER_M)[0] for radius in RADII_MM]
        found[f"{alpha:g}"] = [
            float(np.interp(aim, curve, force)) if curve[-1] > aim else math.nan for curve in curves
        ]
    return found


def areas(seeds: int) -> dict[str, Any]:
    """Round objects pressed through two sheets that are a little other than the estimator takes them for."""
    rows: Rows = []
    for k in STIFFNESSES:
        for known, log_std in ((True, 0.05), (False, 0.7)):
            chance = np.random.default_rng((7, int(k)))
            errors, held, widths, estimates = [], 0, [], 0
            for _ in range(seeds):
                radius = OBJECT_M * math.exp((0.05 if known else 0.7) * chance.normal())
                reduced = math.sqrt(k**3 / (6 * radius * 2.0))  # Hertz: dF/dd = k at 2 N
                force = np.linspace(0.5, 4.0, 200)
                spot = (3 * force * radius / (4 * reduced)) ** (1 / 3)
                off = np.exp(0.02 * chance.normal(size=6))
                real = Sandwich(
                    (1e-3 * off[0], 1e-3 * off[1]),
                    (0.6 * off[2], 1.8 * off[3]),
                    (2400 * off[4], 2400 * off[5]),
                )
                currents = real.currents(force, spot, DRIVE_V, OUTER_M)
                noise = 2e-4 * currents
                read = PAIR.force(
                    currents + noise * chance.normal(size=currents.shape),
                    DRIVE_V,
                    OUTER_M,
                    current_std_a=noise,
                )
                std = np.sqrt(read.covariance[:, [0, 1], [0, 1]]) / np.stack(
                    [read.force_n, read.radius_m], axis=1
                )
                good = np.isfinite(std).all(axis=1)
                if np.count_nonzero(good) < 16:
                    continue
                found = estimate_stiffness_from_area(
                    read.force_n[good], read.radius_m[good], std[good].mean(axis=0), OBJECT_M, log_std
                )
                if not found.stiffness_n_per_m > 0:
                    continue
                truth = k * (found.at_force_n / 2.0) ** (1 / 3)
                estimates += found.state == "estimated"
                errors.append(math.log(found.stiffness_n_per_m / truth))
                held += found.low_n_per_m <= truth <= found.high_n_per_m
                widths.append(math.log(found.high_n_per_m / found.low_n_per_m) / 2)
            n = len(errors)
            rows.append(
                {
                    "k": float(k),
                    "radius_known": known,
                    "answered": n / seeds,
                    "estimated": estimates / seeds,
                    "error": float(np.sqrt(np.mean(np.square(errors)))) if n else math.nan,
                    "coverage": held / n if n else math.nan,
                    "half_width": float(np.median(widths)) if n else math.nan,
                }
            )
            print(rows[-1], flush=True)
    return {"one_sheet_n": alike(), "two_sheets": rows}


# Shape ------------------------------------------------------------------------------------------------------

TILT, NORMAL, SKIN_M = 0.03, 0.06, 0.3e-3


def touched(
    kind: str, n: int, chance: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Touches by five pads of an object that lies anyhow; its radius."""
    radius = float(chance.uniform(6e-3, 45e-3))
    along, angle = chance.uniform(-0.03, 0.03, (n, 2)), chance.uniform(-1.2, 1.2, n)
    if kind == "flat":
        outward, points = np.tile([0, 0, 1.0], (n, 1)), np.c_[along, np.zeros(n)]
    elif kind == "sphere":
        z, turn = chance.uniform(math.cos(1.2), 1, n), chance.uniform(0, 2 * np.pi, n)
        outward = np.c_[np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z]
        points = radius * outward
    else:
        angle = angle if kind == "cylinder" else angle * 0.6
        outward = np.c_[np.zeros(n), np.sin(angle), np.cos(angle)]
        points = (radius if kind == "cylinder" else 0.0) * outward
        points[:, 0] = along[:, 0]
    std = chance.uniform(0.2e-3, 1e-3, n)[:, None]
    across = np.eye(3) - outward[:, :, None] * outward[:, None]
    points = points + std * np.einsum("nij,nj->ni", across, chance.normal(size=(n, 3)))
    points += SKIN_M * chance.normal(size=(n, 1)) * outward
    askew = TILT * chance.normal(size=(5, 3))[chance.integers(0, 5, n)]
    normal = outward + askew + NORMAL * chance.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    turn3, _ = np.linalg.qr(chance.normal(size=(3, 3)))
    return (
        points @ turn3.T + 0.05 * chance.normal(size=3),
        -normal @ turn3.T,
        std[:, :, None] ** 2 * (turn3 @ across @ turn3.T),
        radius,
    )


def plain(points: FloatArray) -> dict[str, tuple[float, float]]:
    """Root mean square distance and radius of each class by least squares of the points alone."""
    away = points - points.mean(axis=0)
    _, _, axes = np.linalg.svd(away)
    if len(points) < 3:
        return dict.fromkeys(SHAPE_CLASSES, (0.0, math.nan))

    def sphere(v: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.norm(away - v[:3], axis=1) - v[3])

    def cylinder(v: FloatArray) -> FloatArray:
        axis = axes[0] + v[0] * axes[1] + v[1] * axes[2]
        axis = axis / np.linalg.norm(axis)
        off = away - v[2] * axes[1] - v[3] * axes[2]
        return np.asarray(np.linalg.norm(off - np.outer(off @ axis, axis), axis=1) - v[4])

    size = 0.02
    ball = least_squares(sphere, [*(-size * axes[2]), size], x_scale=0.01)
    rod = least_squares(cylinder, [0, 0, 0, -size, size], x_scale=[0.1, 0.1, 0.01, 0.01, 0.01])
    line = away - np.outer(away @ axes[0], axes[0])
    return {
        "flat": (float(np.std(away @ axes[2])), math.nan),
        "edge": (float(np.sqrt(np.mean((line**2).sum(axis=1)))), math.nan),
        "cylinder": (float(np.sqrt(np.mean(rod.fun**2))), abs(float(rod.x[4]))),
        "sphere": (float(np.sqrt(np.mean(ball.fun**2))), abs(float(ball.x[3]))),
    }


def shapes(objects: int) -> dict[str, Any]:
    """Confusion by contacts, and errors of radii, of the classifier and of plain least squares."""
    found: dict[str, Any] = {}
    for n in CONTACTS:
        table = {kind: dict.fromkeys((*SHAPE_CLASSES, "not enough yet", "none"), 0) for kind in SHAPE_CLASSES}
        by_points = {kind: dict.fromkeys(SHAPE_CLASSES, 0) for kind in SHAPE_CLASSES}
        sizes: dict[str, list[float]] = {"cylinder": [], "sphere": []}
        scores: list[float] = []
        others: dict[str, list[float]] = {"cylinder": [], "sphere": []}
        for kind in SHAPE_CLASSES:
            chance = np.random.default_rng((n, *kind.encode()))
            for _ in range(objects):
                points, normals, covariances, radius = touched(kind, n, chance)
                estimates = classify_shape(points, normals, covariances)
                answer = {"undetermined": "not enough yet", "invalid": "none"}.get(
                    estimates.state, estimates.label
                )
                table[kind][answer] += 1
                fits = plain(points)
                by_points[kind][min(fits, key=lambda name: fits[name][0]) if n > 2 else "flat"] += 1
                if kind in sizes:
                    own = estimates.fits[kind]
                    others[kind].append(abs(fits[kind][1] / radius - 1))
                    if estimates.label == kind:
                        sizes[kind].append(abs(own.radius_m / radius - 1))
                        scores.append((own.radius_m - radius) / own.radius_std_m)
        found[str(n)] = {
            "table": table,
            "plain": by_points,
            "radius_error": {k: float(np.median(v)) if v else None for k, v in sizes.items()},
            "plain_radius_error": {k: float(np.nanmedian(v)) if n > 2 else None for k, v in others.items()},
            "within_95": float(np.mean(np.abs(scores) < 1.96)) if scores else None,
        }
        print(n, {k: v[k] for k, v in table.items()}, {k: v[k] for k, v in by_points.items()}, flush=True)
    return found


# Texture ----------------------------------------------------------------------------------------------------


def textures(name: str, seeds: int, speeds: tuple[float, ...], rates: tuple[float, ...]) -> Rows:
    """The finest period that is found within 2 % in 4 of 5 slides, by speed and rate, on a kind of sheet."""
    deployment = load(shipped.path("utah_mit.toml"))
    hand = deployment.hands[0]
    pad = hand.pads[0]
    deployment = deployment.model_copy(update={"hands": (hand.model_copy(update={"pads": (pad,)}),)})
    model = PadModel(deployment)
    rows: Rows = []
    for speed in speeds:
        for rate in rates:
            nyquist = 2 * speed / rate
            periods = [nyquist * factor for factor in OF_NYQUIST]
            right = np.zeros(len(periods))
            for seed in range(seeds):
                right += [
                    found_right(*one)
                    for one in slid(deployment, pad.link, model, speed, rate, periods, seed, DRAWABLE[name])
                ]
            share = right / seeds
            good = [p for i, p in enumerate(periods) if share[i:].min() >= 0.8]
            rows.append(
                {
                    "world": name,
                    "speed_m_per_s": speed,
                    "rate_hz": rate,
                    "nyquist_m": nyquist,
                    "min_period_m": min(good, default=math.nan),
                    "share": share.tolist(),
                }
            )
            print(f"{name} {speed} m/s {rate} Hz", share, flush=True)
    return rows


def found_right(current: FloatArray, way: FloatArray, period: float) -> bool:
    found = estimate_texture(current, way)
    return found.label == "periodic" and abs(found.period_m / period - 1) < 0.02


def slid(
    deployment: Deployment,
    link: str,
    model: PadModel,
    speed: float,
    rate: float,
    periods: list[float],
    seed: int,
    world: World,
) -> list[tuple[FloatArray, FloatArray, float]]:
    """Total currents, ways with encoder noise, and the true period: one slide a period, on one pad."""
    chance = np.random.default_rng((seed, int(rate), int(1e4 * speed)))
    lasts = (SLIDE + 8) / rate
    ramp = 0.05
    touches, begins = [], []
    for number, period in enumerate(periods):
        begins.append(0.5 + number * (lasts + 2 * ramp + 0.2))
        steps = math.ceil(16 * lasts * speed / period) + 1
        way = speed * np.linspace(0, lasts, steps)
        force = 1 + MODULATION * np.sin(2 * np.pi * way / period + chance.uniform(0, 6))
        touches.append(
            ScenarioTouch(
                link=link,
                from_s=begins[-1],
                duration_s=lasts + 2 * ramp,
                path=((0.5, 0.5),),
                force_n=tuple(force.tolist()),
                ramp_s=ramp,
            )
        )
    hand = VirtualHand(
        deployment, Scenario(touch=tuple(touches)), world.draw(Family.REPORTING.seed(seed + 1))
    )
    row = model.links.index(link)
    found = []
    for begin, period in zip(begins, periods, strict=True):
        times = begin + ramp + (np.arange(SLIDE) + 2) / rate
        current = (hand.counts(row, times) * model.ampere_per_count[row]).sum(axis=1)
        way = speed * (times - times[0]) + PATH_M * chance.normal(size=SLIDE)
        found.append((current, way, period))
    return found


# Cost -------------------------------------------------------------------------------------------------------


def costs(repeats: int) -> dict[str, float]:
    """Microseconds of a call, median."""
    chance = np.random.default_rng(1)
    force = 0.1 + 3 * np.sin(np.pi * np.linspace(0, 1, 512)) ** 2
    depth = force / 1e3 + 1e-5 * chance.normal(size=512)
    force = force + 0.01 * chance.normal(size=512)
    way = 1e-4 * np.arange(512.0)
    current = 1e-3 * (1 + 0.01 * np.sin(way / 1e-4) + 1e-3 * chance.normal(size=512))
    contacts = {n: touched("cylinder", n, chance)[:3] for n in (20, 100)}
    found = {
        "stiffness of a squeeze of 512 samples": each(
            lambda: estimate_stiffness(force, depth, 0.1 * force), repeats
        ),
        "texture of a slide of 512 samples": each(lambda: estimate_texture(current, way), repeats),
    }
    for n, rows in contacts.items():
        for name in SHAPE_CLASSES:
            call = f"shape: {name}, {n} contacts, all steps"
            found[call] = each(partial(fit_primitive, name, *rows, ShapePrior()), repeats)
    return found


def ticks(kind: str, seconds: float) -> dict[str, float]:
    """Microseconds a tick of one part with 15 contacts at 200 Hz, with a slow fit and without."""
    pads, chance = np.arange(15), np.random.default_rng(2)
    perceiver = PerceptPipeline.build(ContactBuffer(15))
    requested = np.zeros((len(PERCEPT_KINDS), 15), dtype=np.bool_)
    requested[PERCEPT_KINDS.index(kind)] = True
    perceiver.set_requested(requested, np.zeros(15, dtype=np.bool_))
    angle = np.linspace(0, 2 * np.pi, 15, endpoint=False)
    facing = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    none, took, fitted = np.zeros(0, np.intp), [], []
    for number in range(round(seconds * RATE_HZ)):
        t_ns, t_s = 10**9 + number * PERIOD_NS, number / RATE_HZ
        sample = ContactSamples(pads, np.full(15, t_ns), np.full(15, 5, np.uint32))
        place = 1e-5 * chance.normal(size=(15, 2)) + 1e-3 * t_s * (kind == "texture")
        on_link = np.concatenate([place, np.zeros((15, 1))], axis=1)
        force = 1.5 + math.sin(3 * t_s) + 0.01 * chance.normal(size=15)
        sample["pad_m"], sample["position_m"], sample["force_n"] = place, on_link, force
        sample["pad_noise_m2"] = np.tile(1e-10 * np.eye(2), (15, 1, 1))
        sample["covariance_m2"] = sample["palm_covariance_m2"] = np.tile(1e-8 * np.eye(3), (15, 1, 1))
        sample["force_std_n"], sample["total_current_a"] = 0.1 * force, 1e-3 * force
        sample["residual"], sample["residual_std"] = 1e-3 * chance.normal(size=15), np.full(15, 1e-3)
        sample["palm_rotation"] = np.tile(np.eye(3), (15, 1, 1))
        spread = 0.02 * facing - 2e-3 * math.sin(3 * t_s) * facing
        sample["palm_position_m"] = spread + on_link + 1e-2 * t_s * (kind == "shape") * np.array([0, 0, 1.0])
        sample["palm_normal"], sample["normal"] = -facing, -facing
        fits, begun_s = perceiver.fit_count, time.perf_counter()
        perceiver.process_tick(sample, none, t_ns)
        fitted.append(perceiver.fit_count > fits)
        took.append(1e6 * (time.perf_counter() - begun_s))
    late = np.array(took[len(took) // 3 :])
    with_fit = np.array(fitted[len(took) // 3 :])
    return {
        "without": float(np.quantile(late[~with_fit], 0.1)),
        "with": float(np.quantile(late[with_fit], 0.1)) if with_fit.any() else math.nan,
        "share": float(with_fit.mean()),
    }


def each(call: Callable[[], Any], repeats: int) -> float:
    spent = []
    for _ in range(repeats):
        begin_ns = time.thread_time_ns()
        call()
        spent.append((time.thread_time_ns() - begin_ns) * 1e-3)
    return float(np.median(spent))


# Report -----------------------------------------------------------------------------------------------------

COLOURS = {"ideal": "#1a1a1a", "default": "#1f6fb4", "harsh": "#c0662b"}


def drawn(found: dict[str, Any], path: Path) -> None:
    figure, axes = plt.subplots(2, 2, figsize=(10, 7.5), layout="constrained")
    kinds = list(dict.fromkeys((row["world"], row["compensated"]) for row in found["stiffness"]))
    for name, compensated in kinds:
        rows = [r for r in found["stiffness"] if (r["world"], r["compensated"]) == (name, compensated)]
        label = name if name == "ideal" else f"{name}, {'compensated' if compensated else 'as read'}"
        style = {"color": COLOURS[name], "ls": "-" if compensated or name == "ideal" else ":", "label": label}
        k = [1e-3 * row["k"] for row in rows]
        axes[0, 0].semilogx(k, [row["error"] for row in rows], marker="o", ms=3, **style)
        axes[0, 1].semilogx(k, [row["coverage"] for row in rows], marker="o", ms=3, **style)
    axes[0, 1].axhline(0.95, color="#8a8a8a", lw=0.8)
    axes[0, 0].set(xlabel="stiffness, N/mm", ylabel="rms of ln(estimate / truth)", title="Stiffness: error")
    axes[0, 1].set(xlabel="stiffness, N/mm", ylabel="inside the 95 % interval", ylim=(0, 1.05))
    axes[0, 1].set_title("Stiffness: coverage")
    axes[0, 0].set_ylim(0, 0.5)
    axes[0, 0].legend(fontsize=8, ncol=2, loc="upper left")
    shape = found["shape"]
    at = np.arange(len(CONTACTS))
    for offset, key, colour, label in (
        (-0.2, "table", "#1f6fb4", "by evidence: right"),
        (0.2, "plain", "#8a8a8a", "least squares of points: right"),
    ):
        total = [sum(sum(row.values()) for row in shape[str(n)][key].values()) for n in CONTACTS]
        right = [sum(shape[str(n)][key][k][k] for k in SHAPE_CLASSES) for n in CONTACTS]
        axes[1, 0].bar(at + offset, np.divide(right, total), 0.38, color=colour, label=label)
    yet = [sum(shape[str(n)]["table"][k]["not enough yet"] for k in SHAPE_CLASSES) for n in CONTACTS]
    right = [sum(shape[str(n)]["table"][k][k] for k in SHAPE_CLASSES) for n in CONTACTS]
    total = [sum(sum(row.values()) for row in shape[str(n)]["table"].values()) for n in CONTACTS]
    axes[1, 0].bar(
        at - 0.2,
        np.divide(yet, total),
        0.38,
        bottom=np.divide(right, total),
        color="#cfe2f3",
        label="by evidence: not enough yet",
    )
    axes[1, 0].set_xticks(at, [str(n) for n in CONTACTS])
    axes[1, 0].set(xlabel="contacts", ylabel="part of objects", title="Shape", ylim=(0, 1.35))
    axes[1, 0].legend(fontsize=8, loc="upper left")
    for number, rate in enumerate(dict.fromkeys(row["rate_hz"] for row in found["texture"])):
        sheets = {
            name: [r for r in found["texture"] if (r["rate_hz"], r["world"]) == (rate, name)]
            for name in DRAWABLE
        }
        rows = sheets["ideal"]
        speed = [1e3 * row["speed_m_per_s"] for row in rows]
        colour = plt.get_cmap("viridis")(number / 3.5)
        axes[1, 1].loglog(speed, [1e3 * r["nyquist_m"] for r in rows], ls=":", color=colour)
        finest = [1e3 * row["min_period_m"] for row in rows]
        axes[1, 1].loglog(speed, finest, marker="o", ms=4, color=colour, label=f"{rate:.0f} Hz")
        for shift, (name, marker) in ((1.06, ("default", "^")), (1.12, ("harsh", "s"))):
            finest = [1e3 * row["min_period_m"] for row in sheets[name]]
            at_speed = [shift * 1e3 * row["speed_m_per_s"] for row in sheets[name]]
            axes[1, 1].loglog(at_speed, finest, marker, ms=4, color=colour, mfc="none")
    axes[1, 1].set(xlabel="slip speed, mm/s", ylabel="finest period found, mm")
    axes[1, 1].set_title("Texture (dotted: Nyquist; triangles default, squares harsh)")
    axes[1, 1].legend(fontsize=8)
    for ax in axes.flat:
        ax.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)


def table(head: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def report(found: dict[str, Any]) -> str:
    """The page."""
    stiff = table(
        ["world", "forces", "stiffness, N/mm", "median error", "rms error", "half of the 95 % interval",
         "inside it", "estimated"],
        [
            [row["world"], "compensated" if row["compensated"] else "as read", f"{1e-3 * row['k']:.3g}",
             f"{100 * row['bias']:+.0f} %", f"{100 * row['error']:.0f} %", f"{100 * row['half_width']:.0f} %",
             f"{100 * row['coverage']:.0f} %", f"{100 * row['estimated']:.0f} %"]
            for row in found["stiffness"]
        ],
    )  # fmt: skip
    parts = []
    for n in CONTACTS:
        one = found["shape"][str(n)]
        columns = [*SHAPE_CLASSES, "not enough yet", "none"]
        rows = [
            [kind, *(str(one["table"][kind][c]) for c in columns), str(one["plain"][kind][kind])]
            for kind in SHAPE_CLASSES
        ]
        sizes = ", ".join(
            f"{k} {100 * v:.1f} %"
            for k, v in one["radius_error"].items()
            if v is not None and math.isfinite(v)
        )
        plain_sizes = ", ".join(
            f"{k} {100 * v:.1f} %" for k, v in one["plain_radius_error"].items() if v is not None
        )
        inside = f"; {100 * one['within_95']:.0f} % within 1.96 deviations" if one["within_95"] else ""
        parts.append(
            f"{n} contacts. Median error of radii: {sizes or 'none'}{inside}; least squares:"
            f" {plain_sizes or 'none'}.\n\n" + table(["is", *columns, "right by least squares"], rows)
        )
    waves = table(
        ["world", "speed, mm/s", "rate, Hz", "Nyquist, mm", "finest found, mm", "of Nyquist"],
        [
            [
                r["world"],
                f"{1e3 * r['speed_m_per_s']:.0f}",
                f"{r['rate_hz']:.0f}",
                f"{1e3 * r['nyquist_m']:.3g}",
                f"{1e3 * r['min_period_m']:.3g}" if math.isfinite(r["min_period_m"]) else "none",
                f"{r['min_period_m'] / r['nyquist_m']:.2f}" if math.isfinite(r["min_period_m"]) else "",
            ]
            for r in found["texture"]
        ],
    )
    cost = table(["call", "us"], [[name, f"{us:.0f}"] for name, us in found["cost_us"].items()])
    head = HEAD.format(made_by=made_by(), **found["machine"])
    area = table(
        ["stiffness, N/mm", "radius of the object", "answered", "estimated", "rms error",
         "half of the 95 % interval", "inside it"],
        [
            [f"{1e-3 * row['k']:.3g}", "5 %" if row["radius_known"] else "a factor of 2",
             f"{100 * row['answered']:.0f} %", f"{100 * row['estimated']:.0f} %",
             *(f"{100 * row[key]:.0f} %" if math.isfinite(row[key]) else ""
               for key in ("error", "half_width", "coverage"))]
            for row in found["area"]["two_sheets"]
        ],
    )  # fmt: skip
    single = table(
        ["alpha", *(f"disc of {radius:g} mm" for radius in RADII_MM)],
        [
            [alpha, *(f"{force:.3g} N" if math.isfinite(force) else "no force" for force in row)]
            for alpha, row in found["area"]["one_sheet_n"].items()
        ],
    )
    turns = table(
        ["part", "us without a fit", "us with one", "ticks with one"],
        [
            [
                kind,
                f"{us['without']:.0f}",
                f"{us['with']:.0f}" if us["share"] else "",
                f"{100 * us['share']:.0f} %",
            ]
            for kind, us in found["ticks_us"].items()
        ],
    )
    pages = [
        head,
        "## Stiffness",
        STIFF,
        stiff,
        "## Stiffness from force and area",
        AREA,
        single,
        AREAS,
        area,
    ]
    pages += ["## Shape", SHAPE, *parts]
    cost = "\n\n".join([TICKS, turns, COST, cost])
    return "\n\n".join([*pages, "## Texture", WAVES, waves, "## Cost", cost]) + "\n"


HEAD = """\
# Stiffness, shape and texture

{made_by}: seeded simulation; the estimators don't know noise, tolerances, contact radii,
sheets. On {system}, Python {python}, numpy {numpy}.

![Stiffness, shape and texture](percept.png)"""
STIFF = """\
Worlds drawn for the reporting family. Squeezes from 1 to 4 N and back in 1.9 s at 200 Hz on 15 pads; 120
squeezes a row, half of the objects springs, half spheres; depths with 10 um of noise. Radii of contacts and
differences between presses can't be compensated; both are in the interval. *Compensated*: the deployment
file describes the sheets as their builder would; *as read*: it doesn't. Without compensation of creep the
interval contains ground truth less often than stated. Errors are of the logarithm."""
SHAPE = """\
40 objects of each class. Touches spread over the object (cylinder and sphere over 140 degrees), radii 6
to 45 mm, position errors of 0.2 to 1 mm, pads tilted by 0.03 rad per axis, normals by 0.06. A label needs a
probability of 0.9. Least squares: each class fitted to the points alone from one start each, the class of
least root mean square; with fewer than three contacts it returns flat."""
WAVES = """\
A sine of 2 % in a force of 1 N, 512 samples at even speed, distances with 2 um of noise;
finest: found within 2 % in at least 4 of 5 slides, as are all coarser periods tried (steps of 10 to
50 %). The contact presses as a whole: averaging over its own size, which limits real pads, isn't
simulated. At 5 mm/s and 1 kHz samples are 5 um apart: there the
noise of the distance breaks the slide into pieces (the daemon averages five distances; here they are
raw)."""
AREA = """\
Without joint states, area must replace depth. One sheet gives one total current, and the residual
of its four currents measures a contact's elongation, not its size. These forces give the same current of a
single sheet (eqs. 9 to 12, 2 N on the middle disc):"""
AREAS = """\
Two sheets of one sandwich, alphas of 0.6 and 1.8, measure both. Round objects of 12 mm radius (known within
5 %, or within a factor of 2), pressed from 0.5 to 4 N; the sheets' layers, alphas and resistances are each
2 % (1 sigma) off the estimator's values. Answered: the sandwich had a force and a radius for the
currents; harder objects make contacts too small for these sheets, softer ones too large. The daemon has one
sheet per pad: this is for hardware that reads two."""
TICKS = """\
One estimator at a time, 15 contacts at 200 Hz with joint states: wall time of a tick's percepts, with a slow
fit and without; 10 % quantiles, because the cores were shared and full. Percepts without
subscriber aren't called and cost nothing, as a test shows."""
COST = """\
Processor time, median of calls by themselves. At most one of these runs in 10 ms, and of a
shape's fit two steps at a time (a class takes 6 to 26); none of it without a subscriber."""


def main() -> None:
    quick = options(__doc__).parse_args().quick
    out = output_folder(quick)
    machine = {"system": platform.platform(), "python": platform.python_version(), "numpy": np.__version__}
    found: dict[str, Any] = {
        "machine": machine | {"cpus": os.cpu_count()},
        "stiffness": stiffnesses(1 if quick else 2),
        "shape": shapes(10 if quick else 40),
        "area": areas(8 if quick else 60),
        "texture": [
            row
            for name in DRAWABLE
            for row in (
                textures(name, 1, SPEEDS[::2], RATES[::2]) if quick else textures(name, 5, SPEEDS, RATES)
            )
        ],
        "ticks_us": {kind: ticks(kind, 2.0 if quick else 10.0) for kind in PERCEPT_KINDS[1:]},
        "cost_us": costs(10 if quick else 50),
    }
    (out / "percept.json").write_text(json.dumps(found, indent=1).replace("NaN", "null") + "\n")
    (out / "percept.md").write_text(report(found))
    drawn(found, out / "percept.png")
    print(report(found))


if __name__ == "__main__":
    main()
