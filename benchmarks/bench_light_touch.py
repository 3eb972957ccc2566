"""Light touch: the least force that is detected, how soon, and how often nothing is.

The shipped hand in each [world](../worlds.md), seeds of the reporting family, through the daemon's own
detection and baseline. *Offered*: `begin_threshold_n` of each pad as `health` publishes it after ten minutes
without a touch, `least_begin_threshold_n`, and half of it as `end_threshold_n`; *shipped*: those of the file.

*Touches*: at uniform places, with patches of the world, forces that rise in a step or at a mean speed and
then stay for 0.6 s, at 200 Hz. *Seen*: a contact begins before the release; *within 50 ms*: of the time at
which the force is reached. Sheets have a least force that they respond to: *sheet responds* is the share of
touches under which any current flows at the end, the most that any detection can see. The paper's lightest is
2 gf, 0.0196 N. *False contacts*: hands that nothing touches, for hours of drift of zeros, temperature and
supply, tared at the beginning of each half hour, as it begins without a baseline. Sampled at 25 Hz, with
thresholds for that rate, 7 % lower than those for 200 Hz; *factor*: on the offered thresholds. *Held*: 0.1 N
for an hour on five pads of the hand, at 20 Hz; *not released*: touched two seconds after the end.
"""

from __future__ import annotations

import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy: matrices are small

import json
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.light_touch import (
    MEASURED_S,
    START_S,
    DetectionBench,
    QuietHand,
    Thresholds,
    deployment,
    measured_thresholds,
    shipped_thresholds,
    tick_times,
    touched_hand,
)
from benchmarks.page import ROOT, Report, options, progress
from benchmarks.scores import Rate, Share
from handtouch.host.units import GRAM_FORCE_N
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.worlds import WORLDS

FloatArray = NDArray[np.float64]
PADS = 15
TWO_GRAMS_N = round(2 * GRAM_FORCE_N, 4)
FORCES_N = (0.01, 0.015, TWO_GRAMS_N, 0.03, 0.05, 0.1)
SPEEDS_N_S: tuple[float | None, ...] = (None, 1.0, 0.1, 0.01)
"""Mean speeds at which forces rise; None: a step."""
STEP_S, STAY_S, PAUSE_S, REPEATS = 1e-3, 0.6, 0.6, 2
PROMPT_S = 0.05
TOUCH_NS, QUIET_NS, HOLD_NS = 5_000_000, 40_000_000, 50_000_000
TOUCH_SEEDS, QUIET_SEEDS, HOLD_SEEDS = (1, 2, 3), (1, 2, 3, 4, 5), (1, 2)
QUIET_HOURS = {"ideal": 1, "default": 4, "harsh": 1}
PIECES_PER_HOUR = 2
FACTORS = (0.7, 0.85, 1.0)
HOLD_ROWS, HOLD_N, HOLD_S = (0, 2, 5, 7, 13), 0.1, 3600.0
MAX_FALSE_PER_HOUR, MIN_SEEN = 0.01, 0.95
CACHE = ROOT / "build" / "light_touch"
Row = dict[str, Any]


def cached(name: str, make: Callable[[], Any]) -> Any:
    """Return the result of a piece, from build/light_touch if an interrupted run has left it there."""
    path = CACHE / f"{name}.json"
    if not path.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(make()))
        progress(name)
    return json.loads(path.read_text())


def offered(world: str, seeds: Sequence[int], period_ns: int) -> list[Thresholds]:
    """Return the offered thresholds of hands."""
    name = f"offered {world} {'-'.join(map(str, seeds))} {period_ns}"
    hands = [QuietHand(world, seed) for seed in seeds]
    found = cached(name, lambda: [pairs.tolist() for pairs in measured_thresholds(hands, period_ns)])
    return [np.array(pairs) for pairs in found]


# Touches ---------------------------------------------------------------------------------------------------


def drawn_touches(seed: int) -> tuple[list[ScenarioTouch], list[tuple[float, float | None, float]]]:
    """Return touches of all pads at once, slot after slot; and force, speed, time of that force of slots."""
    rng, at = np.random.default_rng((seed, 49)), START_S + MEASURED_S + 2.0
    touches, slots = [], []
    for _ in range(REPEATS):
        for force in FORCES_N:
            for speed in SPEEDS_N_S:
                ramp = STEP_S if speed is None else force / speed
                for _, pad in deployment().pads:
                    x, y = rng.uniform(0.1, 0.9, 2).tolist()
                    touches.append(
                        ScenarioTouch(
                            link=pad.link, from_s=at, duration_s=2 * ramp + STAY_S, path=((x, y),),
                            force_n=(force,), ramp_s=ramp,
                        )
                    )  # fmt: skip
                slots.append((force, speed, at + ramp))
                at += 2 * ramp + STAY_S + PAUSE_S
    return touches, slots


def touched(world: str, seed: int) -> list[Row]:
    """Return each touch of a hand: delays with offered and shipped thresholds, whether its sheet responds."""
    touches, slots = drawn_touches(seed)
    hand = touched_hand(world, seed, touches)
    pairs = offered(world, TOUCH_SEEDS, TOUCH_NS)[TOUCH_SEEDS.index(seed)]
    bench = DetectionBench([pairs, shipped_thresholds()], TOUCH_NS)
    began: list[tuple[float, int]] = []
    first = START_S + MEASURED_S
    last = max(touch.until_s for touch in touches) + 1.0
    for times_s in tick_times(first, last - first, TOUCH_NS):
        counts = np.stack([hand.counts(row, times_s) for row in range(PADS)], axis=1)
        for t_s, sample in zip(times_s.tolist(), np.tile(counts, (1, 2, 1)), strict=True):
            began += [(t_s, pad) for pad in bench.run_tick(sample, round(1e9 * t_s)).began.tolist()]
    found = []
    for number, touch in enumerate(touches):
        (force, speed, reached_s), pad = slots[number // PADS], number % PADS
        end_s = np.array([reached_s + STAY_S - 1e-6])
        row: Row = {
            "force": force, "speed": speed,
            "responds": bool(hand.virtual_pads[pad].force_ratio(end_s)[0] > 0),
        }  # fmt: skip
        for k, name in enumerate(("offered", "shipped")):
            times = [t for t, at in began if at == pad + k * PADS and touch.from_s <= t < reached_s + STAY_S]
            row[name] = times[0] - reached_s if times else None
        found.append(row)
    return found


def seen_rows(found: Sequence[Row]) -> list[Row]:
    """Return the share seen and the delay by force and speed."""
    rows = []
    for speed in SPEEDS_N_S:
        for force in FORCES_N:
            own = [row for row in found if (row["force"], row["speed"]) == (force, speed)]
            delays = {name: [row[name] for row in own] for name in ("offered", "shipped")}
            prompt = [d is not None and d <= PROMPT_S for d in delays["offered"]]
            responding = [p for p, row in zip(prompt, own, strict=True) if row["responds"]]
            known = [1e3 * d for d in delays["offered"] if d is not None]
            rows.append({
                "force, N": force, "speed, N/s": "step" if speed is None else speed, "touches": len(own),
                "sheet responds": Share.of_mask(np.array([row["responds"] for row in own])),
                "seen": Share.of_mask(np.array([d is not None for d in delays["offered"]])),
                "within 50 ms": Share.of_mask(np.array(prompt)),
                "of those that respond": Share.of_mask(np.array(responding, np.bool_)),
                "median delay, ms": float(np.median(known)) if known else None,
                "95 %, ms": float(np.percentile(known, 95)) if known else None,
                "seen as shipped": Share.of_mask(np.array([d is not None for d in delays["shipped"]])),
            })  # fmt: skip
    return rows


# Nothing ---------------------------------------------------------------------------------------------------


def quiet_piece(world: str, piece: int) -> list[Row]:
    """Return false contacts in a part of an hour of untouched hands, by the factor on offered thresholds."""
    hands = [QuietHand(world, seed, 1 + piece) for seed in QUIET_SEEDS]
    pairs = offered(world, QUIET_SEEDS, QUIET_NS)
    bench = DetectionBench([factor * own for factor in FACTORS for own in pairs], QUIET_NS)
    length_s = 3600.0 / PIECES_PER_HOUR
    from_s = START_S + MEASURED_S + piece * length_s
    began, touched_s = np.zeros(bench.model.size), np.zeros(bench.model.size)
    for times_s in [from_s - np.arange(1.0, 0.0, -1e-9 * QUIET_NS), *tick_times(from_s, length_s, QUIET_NS)]:
        counts = np.tile(
            np.concatenate([hand.counts(times_s) for hand in hands], axis=1), (1, len(FACTORS), 1)
        )
        if times_s[0] < from_s:
            bench.tare(counts)
            continue
        for t_s, row in zip(times_s.tolist(), counts, strict=True):
            began[bench.run_tick(row, round(1e9 * t_s)).began] += 1
        touched_s += bench.tick.state.touching * (times_s[-1] - times_s[0])
    shape = (len(FACTORS), -1)
    return [
        {"factor": factor, "false": count, "touched_s": lasted}
        for factor, count, lasted in zip(
            FACTORS,
            began.reshape(shape).sum(1).tolist(),
            touched_s.reshape(shape).sum(1).tolist(),
            strict=True,
        )
    ]


def quiet_rows(pieces: Sequence[Sequence[Row]], least_n: FloatArray) -> list[Row]:
    """Return false contacts by factor."""
    pad_hours = PADS * len(QUIET_SEEDS) * len(pieces) / PIECES_PER_HOUR
    return [
        {
            "factor": factor, "threshold, median, N": float(np.median(least_n) * factor),
            "pad-hours": pad_hours, "false contacts": count,
            "an hour and pad": Rate(count, pad_hours),
            "time touched, s": sum(rows[k]["touched_s"] for rows in pieces),
        }
        for k, factor in enumerate(FACTORS)
        for count in [int(sum(rows[k]["false"] for rows in pieces))]
    ]  # fmt: skip


# Held ------------------------------------------------------------------------------------------------------


def held(world: str, seed: int) -> list[Row]:
    """Return what becomes of light contacts that are held for an hour."""
    rng, from_s = np.random.default_rng((seed, 50)), START_S + MEASURED_S + 60.0
    pads = [pad for _, pad in deployment().pads]
    touches = [
        ScenarioTouch(
            link=pads[row].link, from_s=from_s, duration_s=HOLD_S, path=((x, y),), force_n=(HOLD_N,)
        )
        for row in HOLD_ROWS
        for x, y in [rng.uniform(0.2, 0.8, 2).tolist()]
    ]
    hand, quiet = touched_hand(world, seed, touches), QuietHand(world, seed, 100)
    pairs = offered(world, HOLD_SEEDS, HOLD_NS)[HOLD_SEEDS.index(seed)]
    bench, until_s = DetectionBench([pairs, shipped_thresholds()], HOLD_NS), from_s + HOLD_S
    events: list[tuple[float, int, bool]] = []
    for times_s in tick_times(START_S + MEASURED_S, HOLD_S + 180.0, HOLD_NS):
        counts = quiet.counts(times_s)
        for held in HOLD_ROWS:
            counts[:, held] = hand.counts(held, times_s)
        for t_s, sample in zip(times_s.tolist(), np.tile(counts, (1, 2, 1)), strict=True):
            result = bench.run_tick(sample, round(1e9 * t_s))
            events += [(t_s, pad, True) for pad in result.began.tolist()]
            events += [(t_s, pad, False) for pad in result.ended.tolist()]
    found = []
    for k, name in enumerate(("offered", "shipped")):
        row: Row = {"thresholds": name, "held": len(HOLD_ROWS), "seen": 0, "lost": 0, "not released": 0}
        row["false"] = sum(
            begins and (pad % PADS not in HOLD_ROWS or t_s > until_s + 0.2)
            for t_s, pad, begins in events
            if pad // PADS == k
        )
        for pad in HOLD_ROWS:
            own = [(t_s, begins) for t_s, at, begins in events if at == pad + k * PADS]
            row["seen"] += any(begins and t_s < from_s + 1 for t_s, begins in own)
            row["lost"] += any(not begins and t_s < until_s - 0.2 for t_s, begins in own)
            row["not released"] += [begins for t_s, begins in own if t_s < until_s + 2][-1:] == [True]
        found.append(row)
    return found


def held_rows(hands: Sequence[Sequence[Row]]) -> list[Row]:
    """Return the sums over hands."""
    return [
        {"thresholds": rows[0]["thresholds"]}
        | {key: sum(row[key] for row in rows) for key in ("held", "seen", "lost", "not released", "false")}
        for rows in zip(*hands, strict=True)
    ]


def report_touches(world: str, report: Report) -> None:
    """Measure touches, and report the thresholds offered."""
    found = [
        row
        for seed in TOUCH_SEEDS
        for row in cached(f"touched {world} {seed}", partial(touched, world, seed))
    ]
    least = np.array(offered(world, TOUCH_SEEDS, TOUCH_NS))[:, :, 0]
    sheets = [pad.sheet for _, pad in deployment().pads]
    report.table("Offered thresholds", [
        {"pads": kind, "least, N": float(own.min()), "median, N": float(np.median(own)),
         "greatest, N": float(own.max()), "shipped, N": float(shipped_thresholds()[0, 0])}
        for kind in dict.fromkeys(sheets)
        for own in [least[:, [sheet == kind for sheet in sheets]]]
    ])  # fmt: skip
    rows = seen_rows(found)
    report.table("Touches", rows)
    step = next(row for row in rows if (row["force, N"], row["speed, N/s"]) == (TWO_GRAMS_N, "step"))
    for what, column in (("all", "within 50 ms"), ("those whose sheet responds", "of those that respond")):
        report.limit(f"steps of 2 gf seen within 50 ms, {what}", step[column].value, MIN_SEEN, at_least=True)


def report_quiet(world: str, report: Report) -> None:
    """Measure false contacts."""
    pieces = [
        cached(f"quiet {world} {piece}", partial(quiet_piece, world, piece))
        for piece in range(PIECES_PER_HOUR * QUIET_HOURS[world])
    ]
    rows = quiet_rows(pieces, np.array(offered(world, QUIET_SEEDS, QUIET_NS))[:, :, 0])
    report.table("False contacts", rows)
    rate = rows[-1]["an hour and pad"].per_hour
    report.limit("false contacts an hour and pad, as offered", rate, MAX_FALSE_PER_HOUR)


def report_held(world: str, report: Report) -> None:
    """Measure light contacts that are held."""
    rows = held_rows([cached(f"held {world} {seed}", partial(held, world, seed)) for seed in HOLD_SEEDS])
    report.table("0.1 N held for an hour", rows)
    report.limit("contacts of 0.1 N lost within an hour, as offered", rows[0]["lost"], 0)


MEASURED = {"touches": report_touches, "false contacts": report_quiet, "held": report_held}


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--world", choices=[*WORLDS], action="append", help="default: all")
    parser.add_argument("--only", choices=[*MEASURED], action="append", help="default: all")
    args = parser.parse_args()
    for world in args.world or WORLDS:
        for name in args.only or MEASURED:
            report = Report(args.quick, part=f"{world}: {name}")
            MEASURED[name](world, report)
            report.keep()


if __name__ == "__main__":
    main()
