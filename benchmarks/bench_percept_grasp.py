"""What is perceived of grasps in MuJoCo, against MuJoCo's truth: slip, stiffness, shape.

The shipped hand closes on a ball, a box, a pen and a cup, squeezes twice, and each is pulled off, slipping;
places, joints and sheets err as in bench_grasp. Writes docs/benchmarks/percept_grasp.{md,json}. Quick:
--seeds 1 --things ball.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from grasp_run import Served, Setting, served
from numpy.typing import NDArray

from handtouch import shipped, wire
from handtouch.config import Deployment, load
from handtouch.simulate.grasp.episode import Grasp
from handtouch.simulate.grasp.scene import STEP_S, Pad
from handtouch.simulate.grasp.shapes import foot
from handtouch.simulate.grasp.things import THINGS

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
OUT = Path(__file__).parents[1] / "docs" / "benchmarks"
STATED = {"mount_std_mm": 0.2, "mount_std_deg": 0.5, "joint_std_deg": 0.2}
_START_NS = 1_000_000_000
REST_M_S, SLIPS_M_S = 2e-3, 10e-3
"""Slower is a grip, whose soft contacts creep; faster a slip; between, neither."""
ROLLS_M = 0.2e-3
_SMOOTH, _FIRM_STEPS, _AFTER_S = 11, 100, 0.3
_EARLY_S = 0.010
HELD_S, SQUEEZED_S = (1.8, 3.85), (2.0, 3.65)
SHAPES = {"ball": "sphere", "box": "flat", "pen": "cylinder", "cup": "cylinder"}
ALARMS = ("incipient", "sliding")
OFTEN = (20.0, 40.0)
"""False alarms a minute that a threshold on the rate of force is allowed, besides as many as ours."""
RATES_HZ = np.geomspace(0.5, 200, 40)


# Slip -------------------------------------------------------------------------------------------------------


def speeds(went: Grasp) -> FloatArray:
    """How fast the thing's surface moves along each pad's (n, p) [m/s], in the mean over the force, smoothed;
    NaN where nothing touches."""
    n, p = went.link_m.shape[:2]
    mine = (went.pad >= 0) & (went.step > 0) & (went.step < n - 1)
    step, pad, point = went.step[mine], went.pad[mine], went.point_m[mine]
    on_link = np.einsum("kji,kj->ki", went.link_rotation[step, pad], point - went.link_m[step, pad])

    def at(when: NDArray[np.intp]) -> FloatArray:
        return np.asarray(
            np.einsum("kij,kj->ki", went.link_rotation[when, pad], on_link) + went.link_m[when, pad]
        )

    link = (at(step + 1) - at(step - 1)) / (2 * STEP_S)
    thing = went.thing_m_s[step] + np.cross(went.thing_rad_s[step], point - went.thing_m[step])
    normal = np.empty_like(point)
    for row, of in enumerate(went.pads):
        at_pad = pad == row
        on_pad = foot(of.shape, (on_link[at_pad] - of.translation_m) @ of.rotation).normal @ of.rotation.T
        normal[at_pad] = np.einsum("kij,kj->ki", went.link_rotation[step[at_pad], row], on_pad)
    force = np.maximum(-np.einsum("ki,ki->k", went.force_n[mine], normal), 0.0)
    against = thing - link
    against -= normal * np.einsum("ki,ki->k", against, normal)[:, None]
    total, moved = np.zeros((n, p)), np.zeros((n, p, 3))
    np.add.at(total, (step, pad), force)
    np.add.at(moved, (step, pad), force[:, None] * against)
    with np.errstate(invalid="ignore", divide="ignore"):
        speed = np.linalg.norm(moved, axis=2) / total
    return np.stack([_smooth(speed[:, row]) for row in range(p)], axis=1)


def _smooth(speed: FloatArray) -> FloatArray:
    """Mean over `_SMOOTH` ms of what is known; NaN where nothing was known at the time."""
    known = np.isfinite(speed)
    ones = np.ones(_SMOOTH)
    weight = np.convolve(known, ones, "same")
    mean = np.convolve(np.where(known, speed, 0.0), ones, "same") / np.maximum(weight, 1)
    return np.asarray(np.where(known, mean, np.nan))


def onsets(speed: FloatArray) -> list[int]:
    """Steps at which a pad's contact, firm for 100 ms, begins to slip."""
    found = []
    firm = 0
    for step, now in enumerate(speed.tolist()):
        if now > SLIPS_M_S and firm >= _FIRM_STEPS:
            still = np.flatnonzero(speed[:step] < REST_M_S)
            onset = int(still[-1]) + 1 if len(still) else step
            if onset not in found:  # slower for a while, but never at rest: it is the same slip
                found.append(onset)
        firm = firm + 1 if now < SLIPS_M_S else 0
    return found


def slips(run: Served, labels: Sequence[str] = ALARMS) -> dict[str, Any]:
    """Delays [s] of alarms after slips' onsets, inf for none, by sequential test and by the rate of force;
    the seconds of firm grip, and alarms in them."""
    speed, links = speeds(run.grasp), [pad.link for pad in run.grasp.pads]
    alarms: list[list[float]] = [[] for _ in links]
    label = [""] * len(links)
    for percept in run.percepts:
        if percept.kind != "motion":
            continue
        row = links.index(percept.link)
        moves = percept.label in labels
        if moves and label[row] != "moves":
            alarms[row].append((percept.t_ns - _START_NS) * 1e-9)
        label[row] = "moves" if moves else percept.label
    by_rate = [_rates(run, row) for row in range(len(links))]
    found: dict[str, Any] = {"delays": [], "firm_s": 0.0, "false": 0, "rolls": 0, "between": 0, "late": 0}
    found |= {"rate_delays": [[] for _ in RATES_HZ], "rate_false": [0] * len(RATES_HZ), "short": 0}
    for row, pad in enumerate(run.grasp.pads):
        told = np.zeros(len(speed), np.bool_)
        for begin, end in run.spans[row]:
            told[round(begin / STEP_S) : round(end / STEP_S)] = True
        firm = _lasting(told & (speed[:, row] < REST_M_S), _FIRM_STEPS)
        slipping = speed[:, row] > SLIPS_M_S
        found["firm_s"] += firm.sum() * STEP_S
        for when in alarms[row]:
            kind = _kind(when, firm, slipping)
            found[kind] += 1
            found["rolls"] += kind == "false" and _rolls(run, row, pad, round(when / STEP_S))
        for number, rate in enumerate(RATES_HZ.tolist()):
            crossings = _crossings(by_rate[row], rate)
            found["rate_false"][number] += sum(_kind(when, firm, slipping) == "false" for when in crossings)
        for onset in onsets(np.where(told, speed[:, row], np.nan)):
            left = np.flatnonzero(~told[onset:])
            until = (onset + int(left[0]) if len(left) else len(told)) * STEP_S
            if until - onset * STEP_S < 0.02:
                found["short"] += 1
                continue
            found["delays"].append(_delay(onset * STEP_S, until, alarms[row]))
            for number, rate in enumerate(RATES_HZ.tolist()):
                found["rate_delays"][number].append(
                    _delay(onset * STEP_S, until, _crossings(by_rate[row], rate))
                )
    return found


def _rates(run: Served, row: int) -> tuple[FloatArray, FloatArray]:
    """Times (k,) [s] of a pad's samples and how fast its force changes there, relative to it [1/s]."""
    mine = np.flatnonzero((run.pad == row) & np.isfinite(run.force_n))
    order = mine[np.argsort(run.step[mine], kind="stable")]
    when, force = run.step[order] * STEP_S, run.force_n[order]
    since = np.diff(when)
    rate = np.where(since < 0.008, np.abs(np.diff(force)) / np.maximum(since, 1e-3) / force[1:], 0.0)
    return np.asarray(when[1:]), np.asarray(rate)


def _crossings(series: tuple[FloatArray, FloatArray], rate: float) -> list[float]:
    """When a rate of force is first above a threshold, each time."""
    when, rates = series
    above = rates > rate
    first = above & ~np.concatenate([[False], above[:-1]]) if len(above) else above
    return list(when[first].tolist())


def _delay(onset_s: float, until_s: float, alarms: Sequence[float]) -> float:
    return min(
        (at - onset_s for at in alarms if onset_s - _EARLY_S <= at <= min(until_s, onset_s + _AFTER_S)),
        default=np.inf,
    )


def _lasting(on: BoolArray, least: int) -> BoolArray:
    """Where `on` has been so for `least` steps, and stays so for 50 more."""
    count, found = 0, np.zeros_like(on)
    for step, now in enumerate(on.tolist()):
        count = count + 1 if now else 0
        found[step] = count > least
    ahead = np.concatenate([on[50:], np.zeros(50, np.bool_)])
    return np.asarray(found & ahead)


def _rolls(run: Served, row: int, pad: Pad, step: int) -> bool:
    """Whether the centre of force runs on the pad about then, without a slip: by 0.2 mm in 0.1 s."""
    sides = np.array([pad.shape.length_m, pad.shape.arc * float(pad.shape.radius(pad.shape.length_m / 2))])
    path = run.patches.centre[max(step - 100, 0) : step + 1, row] * sides
    known = path[np.isfinite(path).all(axis=1)]
    return bool(len(known) and np.linalg.norm(known[-1] - known[0]) > ROLLS_M)


def _kind(when_s: float, firm: BoolArray, slipping: BoolArray) -> str:
    """What an alarm was: false, of a slip, or of something between."""
    step = min(round(when_s / STEP_S), len(firm) - 1)
    if firm[step]:
        return "false"
    return "late" if slipping[max(step - 50, 0) : step + 10].any() else "between"


# Hardness ---------------------------------------------------------------------------------------------------


def squeezed(run: Served) -> list[dict[str, float]]:
    """Of each pad that was squeezed: what was told last of the thing's stiffness, and MuJoCo's own [N/m], as
    two fingers that pinch it would feel it: half of the median of its contacts'."""
    went, links = run.grasp, [pad.link for pad in run.grasp.pads]
    last: dict[int, wire.Percept] = {}
    for percept in run.percepts:
        t_s = (percept.t_ns - _START_NS) * 1e-9
        if percept.kind == "hardness" and SQUEEZED_S[0] < t_s < HELD_S[1]:
            last[links.index(percept.link)] = percept
    inside = slice(*(round(s / STEP_S) for s in SQUEEZED_S))
    overlap = np.zeros((len(went.times_s), len(links)))
    on_pads = went.pad >= 0
    np.maximum.at(overlap, (went.step[on_pads], went.pad[on_pads]), went.overlap_m[on_pads])
    forces = run.patches.total_n[inside]
    rows = [row for row, force in enumerate(forces.T) if force.min() > 0 and force.max() > 1.5 * force.min()]
    contacts = np.array([_slope(overlap[inside, row], forces[:, row]) for row in rows])
    true = float(np.median(contacts[contacts > 0])) / 2 if (contacts > 0).any() else np.nan
    return [
        {
            "contact": contact,
            "true": true,
            "told": _number(last[row], "stiffness_n_per_m"),
            "low": _number(last[row], "low_n_per_m"),
            "high": _number(last[row], "high_n_per_m"),
            "estimated": float(last[row].state == "estimated"),
        }
        for row, contact in zip(rows, contacts.tolist(), strict=True)
        if row in last
    ]


def _slope(depth_m: FloatArray, force_n: FloatArray) -> float:
    """Of force against depth."""
    depth, force = (values - values.mean() for values in (depth_m, force_n))
    return float(depth @ force / max(float(depth @ depth), 1e-18))


def _number(percept: wire.Percept, name: str) -> float:
    value = percept.values.get(name)
    return float(value) if isinstance(value, int | float) else float("nan")


# Shape ------------------------------------------------------------------------------------------------------


def shaped(run: Served) -> dict[str, Any]:
    """What was told last of the shape of what is held, before it is pulled off."""
    last = None
    for percept in run.percepts:
        held = (percept.t_ns - _START_NS) * 1e-9 < HELD_S[1]
        if percept.kind == "shape" and not percept.link and held:
            last = percept
    thing = run.grasp.thing
    true_mm = 0.0 if thing.kind == "box" else 1e3 / thing.curvature / (1 if thing.kind == "sphere" else 2)
    if last is None:
        return {"thing": thing.name, "state": "nothing", "true_mm": true_mm}
    return {
        "thing": thing.name,
        "state": last.state,
        "label": last.label or max(last.probabilities, key=last.probabilities.__getitem__, default="-"),
        "reason": last.reason,
        "probability": last.probabilities.get(SHAPES[thing.name], 0.0),
        "radius_mm": 1e3 * _number(last, "radius_m"),
        "radius_std_mm": 1e3 * _number(last, "radius_m_std"),
        "true_mm": true_mm,
        "contacts": last.evidence.get("contacts", 0),
        "object": last.values.get("object", "-"),
    }


# The page ---------------------------------------------------------------------------------------------------


def gathered(runs: Sequence[Served]) -> dict[str, Any]:
    """All figures."""
    by_run = [(run.grasp.thing.name, slips(run)) for run in runs]
    names = list(dict.fromkeys(name for name, _ in by_run))
    figures: dict[str, Any] = {"slip": {}, "hardness": {}, "shape": [shaped(run) for run in runs]}
    for name in [*names, "**all**"]:
        some = [of for thing, of in by_run if name in (thing, "**all**")]
        figures["slip"][name] = _together(some)
    figures["slip"]["all, `sliding` alone"] = _together([slips(run, ALARMS[1:]) for run in runs])
    figures["rate"] = _of_rate([of for _, of in by_run], figures["slip"]["**all**"])
    minutes = figures["slip"]["**all**"]["minutes"]
    figures["rates"] = [
        _of_rate([of for _, of in by_run], {"false": often * minutes, "minutes": minutes}) for often in OFTEN
    ]
    for name in names:
        rows = [row for run in runs if run.grasp.thing.name == name for row in squeezed(run)]
        figures["hardness"][name] = _hardness(rows)
    return figures


def _together(some: Sequence[dict[str, Any]]) -> dict[str, Any]:
    delays = np.array([delay for of in some for delay in of["delays"]])
    minutes = sum(of["firm_s"] for of in some) / 60
    false = sum(of["false"] for of in some)
    return _delays(delays) | {
        "short": sum(of["short"] for of in some),
        "minutes": minutes,
        "false": false,
        "rolls": sum(of["rolls"] for of in some),
        "false_a_minute": false / minutes if minutes else np.nan,
        "between": sum(of["between"] for of in some),
    }


def _delays(delays: FloatArray) -> dict[str, Any]:
    found = np.isfinite(delays)
    low, high = np.percentile(1e3 * delays[found], [50, 95]) if found.any() else (np.nan, np.nan)
    return {
        "slips": len(delays),
        "found": float(found.mean()) if len(delays) else np.nan,
        "ms": float(low),
        "ms_95": float(high),
    }


def _of_rate(some: Sequence[dict[str, Any]], ours: dict[str, Any]) -> dict[str, Any]:
    """The threshold on the rate of force with no more false alarms than the sequential test had."""
    false = np.sum([of["rate_false"] for of in some], axis=0)
    allowed = np.flatnonzero(false <= ours["false"])
    number = int(allowed[0]) if len(allowed) else len(RATES_HZ) - 1
    delays = np.array([delay for of in some for delay in of["rate_delays"][number]])
    minutes = ours["minutes"]
    return _delays(delays) | {
        "threshold_per_s": float(RATES_HZ[number]),
        "false_a_minute": float(false[number] / minutes) if minutes else np.nan,
    }


def _hardness(rows: Sequence[dict[str, float]]) -> dict[str, Any]:
    known = [row for row in rows if row["estimated"]]
    if not known:
        return {"squeezes": len(rows), "estimated": 0}
    columns = {name: np.array([row[name] for row in known]) for name in known[0]}
    return {
        "squeezes": len(rows),
        "estimated": len(known),
        "true_n_per_mm": float(np.median(columns["true"]) * 1e-3),
        "told_n_per_mm": float(np.median(columns["told"]) * 1e-3),
        "wide": float(np.median(columns["high"] / columns["low"])),
        "log_rms": float(np.sqrt(np.nanmean(np.log(columns["told"] / columns["true"]) ** 2))),
        "inside": float(np.mean((columns["low"] <= columns["true"]) & (columns["true"] <= columns["high"]))),
    }


def write(figures: dict[str, Any], seeds: int) -> str:
    """The page; returns its text."""
    slip_rows = "\n".join(
        f"| {name} | {of['slips']} | {of['found']:.0%} | {of['ms']:.0f} / {of['ms_95']:.0f} "
        f"| {of['ms'] / 5:.0f} | {of['minutes']:.1f} | {of['false']} ({of['rolls']}) "
        f"| {of['false_a_minute']:.1f} | {of['between']} |"
        for name, of in figures["slip"].items()
    )
    rate = figures["rate"]
    rest, slip, after = f"{1e3 * REST_M_S:.0f}", f"{1e3 * SLIPS_M_S:.0f}", f"{_AFTER_S:.1f}"
    threshold, rate_false = f"{rate['threshold_per_s']:.0f}", f"{rate['false_a_minute']:.1f}"
    if_often = " and ".join(f"{of['found']:.0%} (median {of['ms']:.0f} ms)" for of in figures["rates"])
    rate_found, rate_ms = f"{rate['found']:.0%}", f"{rate['ms']:.0f}"
    on = f"MuJoCo {figures['mujoco']}, {platform.machine()}, Python {platform.python_version()}"
    hard_rows = "\n".join(
        f"| {name} | {of['squeezes']} | {of['estimated']} | "
        + (
            f"{of['true_n_per_mm']:.2f} | {of['told_n_per_mm']:.2f} | {of['log_rms']:.2f} "
            f"| {of['wide']:.1f} | {of['inside']:.0%} |"
            if of["estimated"]
            else "| | | | |"
        )
        for name, of in figures["hardness"].items()
    )
    shape_rows = "\n".join(
        f"| {of['thing']} | {SHAPES[of['thing']]} | {of.get('contacts', 0)} | {of['state']} "
        f"| {of.get('label', '-')} | {of.get('probability', 0):.2f} | {of['true_mm']:.1f} "
        f"| {_size(of)} | {of.get('object', '-')} |"
        for of in figures["shape"]
    )
    text = f"""# What is perceived of grasps, against MuJoCo's truth

The grasps of [grasp](grasp.md), {seeds} seeds, with the same hidden from the daemon; everything is
perceived, at 200 Hz, by the daemon's own pipeline. {on}.

## Slip

Truth is how fast the thing's surface moves along a pad's, smoothed over 11 ms. Below {rest} mm/s it is a
grip (soft contacts creep), above {slip} mm/s a slip; its onset is when it was last below the first,
after 0.1 s of grip. An alarm is `incipient` or `sliding`, told within {after} s and before the contact
ends.

| | slips | found | delay ms, median / 95 % | periods | minutes of grip | false (rolls) | a minute | others |
| --- | --- | --- | --- | --- | --- | --- | --- | --- |
{slip_rows}

*False*: while it was a grip for 0.1 s before and 50 ms after; in brackets, those of them while the
centre of force ran on the pad by more than 0.2 mm in 0.1 s, as squeezed fingers roll. *Others*: while it
moved with less than a slip, or was about to stop. A threshold on the rate of force, |dF/dt| / F >
{threshold} /s, set so that its false alarms are no more than those ({rate_false} a minute), finds
{rate_found}, median {rate_ms} ms; with {OFTEN[0]:.0f} and {OFTEN[1]:.0f} a minute, {if_often}.
Many of these slips move no centroid: a ball or a rod that is pulled along under a fingertip touches it
where it did before. Only joints and other contacts could show them.

## Hardness

Things here are rigid, and their contacts soft: half a millimetre deep. While the hand squeezes, force
against how deep MuJoCo lets thing and pad overlap is the stiffness of a contact: 4 N/mm at fingertips, three
times that at the palm. True is half of their median, what two fingers would feel that pinch the thing. In a
squeeze it goes aside by millimetres and gives by 0.1 or 0.2; most squeezes leave open by how much it does.

| | squeezes | told | true N/mm | told N/mm | error | interval, high / low | true inside |
| --- | --- | --- | --- | --- | --- | --- | --- |
{hard_rows}

Medians of what was told. *Error*: rms of the logarithm. *Inside*: within the 95 % interval that is told.

## Shape

What was told last before the thing is pulled off, 3.85 s after it was held out; the label is the most
probable class, whatever the state. The box has no class of its own: pads touch faces and edges of it,
and `invalid`, none of the shapes, is the right answer. The cup is a cone, its radius the mean. *Moves*: the
shape fits only if the thing moved by about 2 mm between touches, which makes the deviation larger.

| | truth | touches | state | label | probability of the truth | radius mm | told | thing |
| --- | --- | --- | --- | --- | --- | --- | --- | --- |
{shape_rows}

## What remains

* Most alarms in vain are pads that do roll on the thing, by some 2 mm/s and more, or two points of a pad
  between which the load goes over: the centroid runs as in a slip, and joints with such noise don't tell
  one from the other. Creep of some tenths of a millimetre a second, which soft contacts always have, is
  learnt and passed over.
* A relative velocity from joints is as good as their noise: one that tells 0.05 degrees leaves 5 to 15 mm/s
  over 50 ms, and more where one or two other contacts hold the thing. Slower slips that move no centroid
  aren't seen. With less deviation assumed more of them would be, and more grips taken for slips.
* Slips that are missed last less than 60 ms before the contact ends, or move no centroid: a flat side that
  is pulled along under flat pads. All pads slip at once then, and none is left to tell how the thing moves.
* Hardness of what many fingers hold rests on their sticking to it. Most squeezes here shift the thing by more
  than it gives, its contacts roll and creep, and nothing is told; what is told is known within a factor of 3
  or 4 either way.
* A thing that turns by more than a few degrees in the hand, as a thin rod does, blurs its shape, though
  older touches count less. A fit that needs a moving thing takes twice as long, the first time.

Made by `make bench ONLY=percept_grasp`.
"""
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "percept_grasp.md").write_text(text)
    (OUT / "percept_grasp.json").write_text(json.dumps(figures, indent=1) + "\n")
    return text


def _size(of: dict[str, Any]) -> str:
    radius, std = of.get("radius_mm", np.nan), of.get("radius_std_mm", np.nan)
    return f"{radius:.1f} +- {std:.1f}" if np.isfinite(radius) else "-"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--things", nargs="+", default=list(THINGS), choices=list(THINGS))
    asked = parser.parse_args()
    import mujoco

    plain: Deployment = load(shipped.path("utah_mit.toml"))
    hand = plain.hands[0].model_copy(update=STATED)
    deployment = plain.model_copy(update={"hands": (hand, *plain.hands[1:])})
    runs = []
    for seed in range(1, asked.seeds + 1):
        for name in asked.things:
            runs.append(served(deployment, name, seed, Setting.usual(seed), perceive=True))
            print(f"seed {seed}: {name}, {len(runs[-1].percepts)} percepts", flush=True)
    runs.sort(key=lambda run: asked.things.index(run.grasp.thing.name))
    print(write({"mujoco": mujoco.__version__} | gathered(runs), asked.seeds))


if __name__ == "__main__":
    main()
