"""What a room does to pads: unknown zeros at a first start, warming up, hum; and what touches are like in it.

Hands of the world `default` with ideal sheets ([worlds](../worlds.md)), seeds of the reporting family, 15
pads each, with one property more, through the daemon's pipeline; no calibration store.

*First start*: zeros are normal, with the standard deviation of the row. Pads are untouched for 2 s, then
touched twice for 0.6 s by 0.5 to 3 N. *Loaded*: taken for a contact; its force is `unreliable`, and `health`
says to tare. *Warm-up*: by 10 K in two minutes; zeros move by a normal number of counts a kelvin. In use,
each pad is touched for 1 s every 7 s; held, for 80 s. *Stuck*: still touched 5 s after the last release.
*Hum* of 49.97 Hz from the start on, the same in all channels of a pad, which nothing touches; contacts of the
first second, in which it is measured, count apart; at 50 Hz it reads 0.03 Hz, which no sample tells from slow
touches: `handtouch check` warns of such periods. Times are pad-times.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from benchmarks.bench_contacts import WORLD
from benchmarks.daemon_settings import pipeline_of
from benchmarks.hand_touches import Collector, Key, position_error
from benchmarks.page import Report, options, progress
from benchmarks.scores import Share
from handtouch import wire
from handtouch.config import load, shipped
from handtouch.daemon.pad_reports import NoiseReport
from handtouch.daemon.table_cache import build_pad_model
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.truth import GroundTruth
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import Family, Fixed, Normal, World
from handtouch.wire import PadState

FloatArray = NDArray[np.float64]
Row = dict[str, Any]
FIRST_NS = 10**9
ZEROS_COUNTS = (20, 40, 80)
COUNTS_PER_K = (2, 5)
HUM_COUNTS = (3, 10, 30, 60, 100)
RATES_HZ = (50, 100, 200, 1000)
IN_REGION = 5.991  # chi-squared of two degrees of freedom, 95 %


def world(**electronics: Any) -> World:
    """Return the world with other electronics."""
    return replace(WORLD, electronics=replace(WORLD.electronics, **electronics))


@dataclass(frozen=True)
class Observed:
    """A hand in a room: states (ticks, pads) of its pads and contacts at the sampled times, with truths."""

    times_s: FloatArray
    states: NDArray[np.uint8]
    contacts: dict[Key, wire.Contact]
    truths: dict[Key, GroundTruth]
    contact_ids: NDArray[np.int64]
    """(ticks, pads) of present contacts, 0 for none."""
    is_noisy: NDArray[np.bool_]
    """(pads,), at the end."""

    def share(self, state: PadState, from_s: float = 0.0) -> float:
        """Return the share of pad-time from `from_s` on in a state, in %."""
        return float(100 * (self.states[self.times_s >= from_s] == state).mean())


def observe(
    of: World,
    number: int,
    touches: Callable[[Sequence[str], int], Sequence[ScenarioTouch]],
    rate_hz: float,
    duration_s: float,
    sampled_s: Sequence[float] = (),
) -> Observed:
    """Run a hand of a world through the pipeline; `touches` of its links and seed."""
    drawn = of.draw(Family.REPORTING.seed(number))
    deployment = WORLD.draw(Family.REPORTING.seed(number)).describe(load(shipped.path("utah_mit.toml")))
    model, period_ns = build_pad_model(deployment), round(1e9 / rate_hz)
    later = ScenarioTouch(link=model.links[0], from_s=1e4, path=((0.5, 0.5),), force_n=(1.0,), duration_s=1.0)
    scenario = Scenario(touch=(*touches(model.links, drawn.seed), later))  # has one, if there is no other
    hand = VirtualHand(deployment, scenario, drawn)
    times_s = np.asarray(np.arange(round(duration_s * rate_hz)) / rate_hz, np.float64)
    counts = np.stack([hand.counts(row, times_s) for row in range(model.size)], axis=1).astype("<i2")
    ticks = {round(at_s * rate_hz): k for k, at_s in enumerate(sampled_s)}
    collector = Collector()
    pipeline = pipeline_of(deployment, collector, model=model, period_ns=period_ns)
    states, ids = np.zeros(counts.shape[:2], np.uint8), np.zeros(counts.shape[:2], np.int64)
    for tick, rows in enumerate(counts):
        t_ns = FIRST_NS + tick * period_ns
        collector.sampled = ticks.get(tick)
        pipeline.begin_cycle(t_ns, t_ns)
        for pad, row in enumerate(rows):
            pipeline.slab.write_pdo(pad, row.tobytes(), t_ns + 1)
        pipeline.tick_if_due(t_ns + period_ns - 1)
        states[tick] = pipeline.state.pad_state
        ids[tick] = np.where(pipeline.state.touching, pipeline.state.contact_id, 0)
        pipeline.prepare_next_tick()
    truths = {
        (k, truth.link): truth
        for tick, k in ticks.items()
        for truth in hand.truth(float(times_s[tick]))
    }  # fmt: skip
    noisy = np.array(NoiseReport(model.size).find(pipeline.tick))
    return Observed(times_s, states, collector.contacts, truths, ids, noisy)


def inside(observed: Observed, number: int, *, force: bool) -> list[bool]:
    """Return which of the valid estimates at a sampled time have their truth in the 95 % region."""
    found = []
    for (k, link), truth in observed.truths.items():
        contact = observed.contacts.get((k, link))
        if k != number or contact is None:
            continue
        if force:
            if contact.force_status == "valid" and contact.force_n is not None and contact.force_std_n:
                found.append(abs(contact.force_n - truth.force_n) < 1.96 * contact.force_std_n)
            continue
        error, covariance = position_error(contact, truth)
        if np.isfinite(error).all():
            found.append(bool(error @ np.linalg.solve(covariance, error) < IN_REGION))
    return found


def place(rng: np.random.Generator) -> tuple[float, float]:
    x, y = rng.uniform(0.05, 0.95, 2).tolist()
    return x, y


# First start ------------------------------------------------------------------------------------------------

FIRST_S, SECOND_S, START_RATE_HZ = 2.0, 4.0, 200.0


def two_touches(links: Sequence[str], seed: int) -> list[ScenarioTouch]:
    """Return two touches of each pad after the start."""
    rng = np.random.default_rng((seed, 21))
    return [
        ScenarioTouch(
            link=link,
            from_s=from_s,
            duration_s=0.6,
            path=(place(rng),),
            force_n=(float(np.exp(rng.uniform(np.log(0.5), np.log(3.0)))),),
        )
        for from_s in (FIRST_S, SECOND_S)
        for link in links
    ]


def first_start(task: tuple[float, int]) -> Row:
    """Return counts of pads, and of touches in 95 %."""
    zeros, number = task
    of = world(zero_counts=Normal(0.0, zeros))
    seen = observe(of, number, two_touches, START_RATE_HZ, 5.0, (FIRST_S + 0.4, SECOND_S + 0.4))
    before = seen.states[round(1.9 * START_RATE_HZ)]
    loaded = before == PadState.TOUCHED
    touched = seen.states[[round((at_s + 0.4) * START_RATE_HZ) for at_s in (FIRST_S, SECOND_S)]]
    return {
        "pads": len(before),
        "faulted": int((seen.states == PadState.FAULTED).any(axis=0).sum()),
        "clear": int((before == PadState.CLEAR).sum()),
        "loaded": int(loaded.sum()),
        "starting": int((before == PadState.STARTING).sum()),
        "first touched": int((touched[0] == PadState.TOUCHED).sum()),
        "second touched": int((touched[1] == PadState.TOUCHED).sum()),
        **{
            f"{which} {what}": inside(seen, k, force=what == "force")
            for k, which in enumerate(("first", "second"))
            for what in ("position", "force")
        },
    }


def start_rows(parts: Mapping[float, Sequence[Row]]) -> list[Row]:
    rows = []
    for zeros, some in parts.items():
        pads = sum(one["pads"] for one in some)
        row: Row = {"zeros, counts": zeros, "pads": pads}
        for name in ("faulted", "clear", "loaded", "starting", "first touched", "second touched"):
            row[f"{name}, %"] = 100 * sum(one[name] for one in some) / pads
        for name in ("first position", "first force", "second position", "second force"):
            held = np.array([value for one in some for value in one[name]])
            row[f"{name}: valid, %"] = 100 * len(held) / pads
            row[f"{name}: in 95 %"] = Share.of_mask(held) if len(held) else None
        rows.append(row)
    return rows


# Warm-up ----------------------------------------------------------------------------------------------------

WARM_RATE_HZ, WARM_S, EVERY_S, LAST_S = 50.0, 140.0, 7.0, 133.0
USES = ("untouched", "in use", "held")


def touches_of(use: str) -> Callable[[Sequence[str], int], list[ScenarioTouch]]:
    """Return what draws the touches of a use."""

    def draw(links: Sequence[str], seed: int) -> list[ScenarioTouch]:
        rng = np.random.default_rng((seed, 22))
        begins = {"untouched": [], "in use": np.arange(5.0, LAST_S - 1.0, EVERY_S).tolist(), "held": [10.0]}
        length_s = 80.0 if use == "held" else 1.0
        return [
            ScenarioTouch(
                link=link,
                from_s=begin_s + float(rng.uniform(0, 1)),
                duration_s=length_s,
                path=(place(rng),),
                force_n=(float(np.exp(rng.uniform(np.log(0.3), np.log(3.0)))),),
            )
            for begin_s in begins[use]
            for link in links
        ]

    return draw


def warm_up(task: tuple[tuple[float, str], int]) -> Row:
    (counts_per_k, use), number = task
    of = world(warm_up_k=Fixed(10.0), offset_counts_per_k=Normal(0.0, counts_per_k))
    draw = touches_of(use)
    seen = observe(of, number, draw, WARM_RATE_HZ, WARM_S)
    links = [pad.link for _, pad in load(shipped.path("utah_mit.toml")).pads]
    pressed = np.zeros(seen.states.shape, np.bool_)  # a little longer than touched, for ramps and debounce
    firm = pressed.copy()
    wanted = 0
    for touch in draw(links, Family.REPORTING.seed(number)):
        pad, end_s = links.index(touch.link), touch.from_s + touch.duration_s
        pressed[(seen.times_s > touch.from_s - 0.05) & (seen.times_s < end_s + 0.3), pad] = True
        firm[(seen.times_s > touch.from_s + 0.2) & (seen.times_s < end_s - 0.2), pad] = True
        wanted += 1
    touched = seen.states == PadState.TOUCHED
    begun = sum(len(set(ids[ids > 0].tolist())) for ids in seen.contact_ids.T)
    return {
        "faulted": float(100 * (seen.states == PadState.FAULTED).mean()),
        "false": float(100 * (touched & ~pressed).sum() / max((~pressed).sum(), 1)),
        "missed": float(100 * (~touched & firm).sum() / max(firm.sum(), 1)),
        "touches": wanted,
        "contacts": begun,
        "stuck": int(touched[-1].sum()),
        "pads": len(links),
    }


def warm_rows(parts: Mapping[tuple[float, str], Sequence[Row]]) -> list[Row]:
    return [
        {
            "counts/K": counts_per_k,
            "use": use,
            "pads": sum(one["pads"] for one in some),
            "faulted, % of time": float(np.mean([one["faulted"] for one in some])),
            "touched though untouched, % of time": float(np.mean([one["false"] for one in some])),
            "missed, % of touches' time": float(np.mean([one["missed"] for one in some])),
            "touches": sum(one["touches"] for one in some),
            "contacts": sum(one["contacts"] for one in some),
            "stuck pads": sum(one["stuck"] for one in some),
        }
        for (counts_per_k, use), some in parts.items()
    ]


# Hum --------------------------------------------------------------------------------------------------------

HUM_S = 12.0


def hum(task: tuple[tuple[float, float], int]) -> Row:
    (amplitude, rate_hz), number = task
    of = world(hum_counts=Fixed(amplitude))
    seen = observe(of, number, lambda *_: [], rate_hz, HUM_S)
    later = seen.contact_ids[seen.times_s >= 1.0]
    return {
        "contacts at the begin": sum(len(set(ids.tolist()) - {0}) for ids in seen.contact_ids.T)
        - sum(len(set(ids.tolist()) - {0}) for ids in later.T),
        "contacts": sum(len(set(ids.tolist()) - {0}) for ids in later.T),
        "faulted": seen.share(PadState.FAULTED),
        "named": int(seen.is_noisy.sum()),
        "pads": later.shape[1],
    }


def hum_rows(parts: Mapping[tuple[float, float], Sequence[Row]]) -> list[Row]:
    rows = []
    for (amplitude, rate_hz), some in parts.items():
        pads = sum(one["pads"] for one in some)
        minutes = pads * (HUM_S - 1.0) / 60
        rows.append(
            {
                "hum, counts": amplitude,
                "rate, Hz": rate_hz,
                "pads": pads,
                "contacts in the first second": sum(one["contacts at the begin"] for one in some),
                "later, a pad-minute": sum(one["contacts"] for one in some) / minutes,
                "faulted, % of time": float(np.mean([one["faulted"] for one in some])),
                "named, % of pads": 100 * sum(one["named"] for one in some) / pads,
            }
        )
    return rows


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--hands", type=int, default=6)
    parser.add_argument("--only", default="", help="start, warm-up or hum")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    asked = parser.parse_args()
    hands = 1 if asked.quick else asked.hands
    warm = [(per_k, use) for per_k in COUNTS_PER_K for use in USES]
    hums = [(amplitude, rate) for rate in RATES_HZ for amplitude in HUM_COUNTS]
    parts: dict[str, tuple[str, Callable[[Any], Row], Sequence[Any], Callable[[Any], list[Row]]]] = {
        "start": ("First start", first_start, ZEROS_COUNTS, start_rows),
        "warm-up": ("Warm-up", warm_up, warm, warm_rows),
        "hum": ("Hum", hum, hums, hum_rows),
    }
    with ProcessPoolExecutor(asked.processes) as pool:
        for name, (title, play, cases, rows_of) in parts.items():
            if asked.only not in ("", name):
                continue
            tasks = [(case, number) for case in cases for number in range(hands)]
            made: dict[Any, list[Row]] = {case: [] for case in cases}
            for (case, _), result in zip(tasks, pool.map(play, tasks), strict=True):
                made[case].append(result)
            progress(title)
            report = Report(asked.quick, name, hands=hands)
            report.table(title, rows_of(made))
            report.keep()


if __name__ == "__main__":
    main()
