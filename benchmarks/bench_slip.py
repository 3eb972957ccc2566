"""Slip: recall, delay and false alarms by world.

The shipped hand, 15 pads at once, drawn in each [world](../worlds.md) for a seed of the reporting family,
through the daemon's own pipeline and percepts. A grip has tremor: 10 % ripple of force and 15 um of sway,
both of eight tones from 1 to 10 Hz, and the centroid rolls 0.1 mm a newton. In half of the slips the force
stays constant, in half it falls to 70 % within 20 ms.

*By world*: sequential test at a stated mean time between false alarms of 600 s. Slips of all speeds and
forces, found within 0.5 s of the onset; false alarms before the onset. Then a firm grip, from a second after
it closed; alarms in the second before, while force rises and the tremor isn't learnt yet, are in a column of
their own. *Bursts*: such grips with chatter of 9 Hz and 0.1 mm amplitude, 0.6 s in every 2 s. A slip counts
once it has moved farther than such chatter does, 0.35 mm or 8 mm/s, also from where it was in the 0.12 s
before its onset. *An hour of chatter*: other hands of `default` at 200 Hz with tremor and these bursts; then
such grips, without bursts, slip at 10 mm/s and faster. *Percepts*: times that a published percept became
`incipient` or `sliding`, without joint states; `incipient` has a lower threshold than the alarm.

*More noise than is stated*: light grips at rest, 3.5 % ripple and 12 um of sway, with white noise added or
with hum of 50 Hz, and slips of 10 mm/s at 0.3, 1 and 3 N; the daemon has measured the noise on untouched pads
before. *Named*: pads with the diagnosis `noise` when they are touched. This and the next table are a part of
their own, `ARGS="--part noise"`.

*Light contacts whose force varies*: 0.15, 0.3 and 0.6 N, every two seconds to 15 % and back within a ramp;
noise as stated.

*Bound*: when ln of the likelihood ratio of a slip of known onset, speed and direction would reach the
threshold in the mean (Lorden), with the test's own estimates of tremor and noise.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.daemon_settings import InlineProcess, pipeline_of, request_percepts
from benchmarks.grip_touch import GripTouch
from benchmarks.page import Report, options, progress
from benchmarks.scores import EventScore, Rate, Share, score_events
from handtouch import wire
from handtouch.config import Deployment, load
from handtouch.core.pad_model import PadModel
from handtouch.core.stages.slip import INFORMATION
from handtouch.daemon.pad_reports import NoiseReport
from handtouch.daemon.percepts import PerceptPublisher
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, DrawnWorld, Family, Fixed

FloatArray = npt.NDArray[np.float64]
ROOT = Path(__file__).parent.parent
DEPLOYMENT = load(ROOT / "config" / "utah_mit.toml")


class PerceptCollector:
    """Publisher that collects percepts."""

    def __init__(self) -> None:
        self.percepts: list[wire.Percept] = []

    def has_subscriber(self, topic: str) -> bool:
        return topic.startswith("percept/")

    def send(self, message: wire.OutgoingMessage) -> None:
        if isinstance(message, wire.Percept):
            self.percepts.append(message)


@dataclass
class Record:
    """Results by tick: times [s] (k,) since the begin; running tests (k, pads)."""

    t_s: FloatArray
    running: npt.NDArray[np.bool_]
    percepts: list[wire.Percept]
    information: tuple[FloatArray, FloatArray]
    """At `information_s`: ages [s] of ramps (pads, onsets), and information of 1 m/s along either axis.

    The information is twice the mean logarithm of the likelihood ratio.
    """
    samples_per_false_alarm: float
    """Mean samples between false alarms, the threshold on R of an alarm."""
    named_noisy: Share
    """Pads with the diagnosis `noise`, at `named_s`."""


def pads_of(deployment: Deployment) -> list[tuple[str, tuple[float, float]]]:
    """Return link and size [mm] of every pad, along x, and at the middle along y."""
    found = []
    for hand in deployment.hands:
        for pad in hand.pads:
            surface: Any = pad.surface
            width = getattr(surface, "width_mm", None)
            if width is None:
                radius = getattr(surface, "radius_mm", None) or surface.near_radius_mm
                width = radius * np.radians(surface.arc_deg)
            length = getattr(surface, "length_mm", None) or getattr(surface, "slant_mm", None)
            if length is None:
                length = surface.radius_mm * np.radians(surface.to_deg - surface.from_deg)
            found.append((pad.link, (float(length), float(width))))
    return found


def run(
    grips: Sequence[GripTouch],
    world: DrawnWorld,
    hz: float,
    seconds: float,
    from_s: float = 0.0,
    information_s: float = 0.0,
    noise_ratio: float = 1.0,
    named_s: float = 0.0,
) -> Record:
    """Process grips, each one contact on its link's pad, from `from_s` of the scenario on.

    `noise_ratio`: true noise of the channels over what the deployment states. `named_s`: time at which
    diagnoses of noise are counted.
    """
    deployment, period_ns = world.describe(DEPLOYMENT), round(1e9 / hz)
    hand = VirtualHand(deployment, Scenario.model_validate({"touch": grips}), world)
    times = from_s + np.arange(1, round(seconds * hz) + 1) / hz
    counts = np.stack([hand.counts(row, times) for row in range(len(hand.pads))], axis=1)
    if noise_ratio > 1.0:
        stated = np.array([deployment.nodes[pad.node].noise_counts for _, pad in deployment.pads])
        more = np.sqrt(noise_ratio**2 - 1) * stated[:, None]
        counts = np.rint(counts + np.random.default_rng(5).normal(size=counts.shape) * more)
    collector, model = PerceptCollector(), PadModel(deployment)
    pipeline = pipeline_of(deployment, collector, model=model, period_ns=period_ns)
    perceiving = PerceptPublisher(deployment, pipeline, collector, process=InlineProcess(deployment))
    request_percepts(pipeline, perceiving, ["motion"])
    slip, running = pipeline.tick.slip, np.empty((len(times), model.size), dtype=np.bool_)
    named, report = Share(0, model.size), NoiseReport(model.size)
    payload, information = counts.astype("<i2"), (np.zeros((model.size, 0)), np.zeros((model.size, 0)))
    for k, t_s in enumerate(times.tolist()):
        t_ns = 10**9 + round(t_s * 1e9)
        pipeline.begin_cycle(t_ns, t_ns)
        for pad in range(model.size):
            pipeline.slab.write_pdo(pad, payload[k, pad].tobytes(), t_ns + 1000 + pad)
        ticked = pipeline.tick_if_due(t_ns + round(0.7 * period_ns))
        assert ticked is not None
        perceiving.process_tick(ticked, t_ns)
        pipeline.prepare_next_tick()
        contacts = slip.contacts()
        running[k] = contacts.slipping != 0
        if k == round(information_s * hz):
            information = contacts.onset_ages_s.copy(), contacts.ramps[:, :, INFORMATION].mean(axis=1)
        if k == round(named_s * hz):
            named = Share(sum(report.find(pipeline.tick)), model.size)
    return Record(
        times - from_s,
        running,
        collector.percepts,
        information,
        slip.samples_per_false_alarm,
        named,
    )


PADS = pads_of(DEPLOYMENT)
SPEEDS, FORCES = (1.0, 3.0, 10.0, 30.0, 100.0), (0.5, 2.0, 5.0)
DRAWN = {name: world.draw(Family.REPORTING.seed(21)) for name, world in WORLDS.items()}
CASES = (
    *((name, 200.0) for name in WORLDS), ("ideal", 500.0), ("default", 500.0), ("default", 1000.0),
)  # fmt: skip
Slips = list[tuple[float, float, Record, int]]
"""Speed [mm/s], force [N], record and pad of each."""
LOADS = {0: 1.0, 1: 0.7}
GRIPPED_S, SLIPS_S, RUN_S, LATEST_S = 0.3, 1.8, 2.3, 0.5
BURST_MM = 0.1
NOISES = (1.0, 0.0), (1.5, 0.0), (2.0, 0.0), (3.0, 0.0), (1.0, 10.0)
"""True noise over stated, and amplitude of hum in counts."""
LIGHT_FORCES, SLIP_FORCES = (0.3, 0.6, 1.0), (0.3, 1.0, 3.0)
RAMPS_S, RAMPED_FORCES = (0.05, 0.4), (0.15, 0.3, 0.6)
UNTOUCHED_S = 90.0
"""Time in which the noise is learned, before it matters"""
HOLD_HANDS, HOLD_S, HOLD_SLIPS, FAST_MM_PER_S = (31, 32), 125.0, 4, 10.0
"""Hands of the reporting family in `default` for an hour of grips with chatter: length of the grips of each
hand, and rounds of slips; speed from which the share found is stated."""
ALARMS = ("incipient", "sliding")
Rows = list[dict[str, Any]]


def slip_all(world: DrawnWorld, hz: float, repeats: int, seed: int = 0) -> Slips:
    """Speed, force, record and pad of every slip; all speeds and forces go round all pads."""
    found = []
    for repeat in range(repeats):
        from_s, combos = 10.0 * repeat, [(v, f) for v in SPEEDS for f in FORCES]
        combos = combos[repeat % 15 :] + combos[: repeat % 15]
        grips = [
            grip(
                number,
                from_s,
                RUN_S,
                force,
                seed + 100 * repeat,
                slip_mm_per_s=speed,
                slip_from_s=from_s + SLIPS_S,
                slip_load=LOADS[repeat % 2],
            )
            for number, (speed, force) in enumerate(combos)
        ]
        record = run(grips, world, hz, RUN_S, from_s, SLIPS_S - 0.02)
        found += [(speed, force, record, pad) for pad, (speed, force) in enumerate(combos)]
    return found


def hold(world: DrawnWorld, hz: float, seconds: float, burst_mm: float = 0.0, seed: int = 9000) -> Record:
    """A firm grip that doesn't slip; with bursts of chatter of 9 Hz and this amplitude."""
    grips = [grip(k, 0.0, seconds + 1, FORCES[k % 3], seed, burst_mm=burst_mm) for k in range(len(PADS))]
    return run(grips, world, hz, seconds)


def grip(number: int, from_s: float, seconds: float, force_n: float, seed: int, **more: Any) -> GripTouch:
    link, size_mm = PADS[number]
    return GripTouch(
        link=link,
        size_mm=size_mm,
        from_s=from_s + GRIPPED_S,
        duration_s=seconds,
        path=((0.5, 0.5),),
        force_n=(force_n,),
        seed=seed + number,
        **more,
    )


def bound_s(record: Record, pad: int, mm_per_s: float) -> float:
    """Mean detection time of a ramp of known onset, speed and direction, in tremor as modelled: as
    ln of its likelihood ratio reaches the threshold's (G. Lorden 1971); inf: not in half a second."""
    ages, information = (of[pad] for of in record.information)
    enough = 0.5 * (1e-3 * mm_per_s) ** 2 * information >= math.log(record.samples_per_false_alarm)
    return float(ages[enough].min()) if enough.any() else math.inf


def percept_alarms(firm: Record, from_s: float = GRIPPED_S + 1.0, alarms: tuple[str, ...] = ALARMS) -> int:
    """Return how often a percept became one of `alarms`, by default from a second after the grip closed."""
    count, alarmed = 0, set[str]()
    for percept in firm.percepts:
        raised = percept.label in alarms
        late = (percept.t_ns - 10**9) * 1e-9 > from_s
        count += raised and late and percept.link not in alarmed
        (alarmed.add if raised else alarmed.discard)(percept.link)
    return count


def false_alarms(firm: Record) -> tuple[Rate, int]:
    """Return the false alarms from a second after the grip closed, and their number before."""
    rising = firm.running & ~np.vstack([firm.running[:1], firm.running[:-1]])
    lasting = firm.t_s > GRIPPED_S + 1.0
    hours = rising.shape[1] * float(firm.t_s[-1] - GRIPPED_S - 1.0) / 3600
    return Rate(int(rising[lasting].sum()), hours), int(rising[~lasting].sum())


def noisy(ratio: float, hum_counts: float, quick: bool) -> dict[str, Any]:
    """Return false alarms of light grips, and slips of 10 mm/s found, with more noise than the file states.

    The daemon sees the untouched pads for `UNTOUCHED_S` before.
    """
    plain = WORLDS["default"]
    hums = replace(plain.electronics, hum_counts=Fixed(hum_counts)) if hum_counts else plain.electronics
    world = replace(plain, electronics=hums).draw(Family.REPORTING.seed(41))
    still, found, slips, delays = dict[str, int](), 0, 0, list[float]()
    seconds, rounds = (6.0, 1) if quick else (245.0, 4)
    minutes, hz = len(PADS) * (seconds - 1.0) / 60, 200.0
    begins_s = [UNTOUCHED_S + repeat * (RUN_S + 1.0) for repeat in range(rounds + 1)]
    grips = [
        grip(k, begin_s, RUN_S, SLIP_FORCES[k % 3], 900 + 100 * repeat, slip_from_s=begin_s + SLIPS_S)
        for repeat, begin_s in enumerate(begins_s[:-1])
        for k in range(len(PADS))
    ]
    grips += [
        grip(k, begins_s[-1], seconds, LIGHT_FORCES[k % 3], 700, ripple=0.035, sway_mm=0.012)
        for k in range(len(PADS))
    ]
    until_s = begins_s[-1] + GRIPPED_S + seconds
    record = run(grips, world, hz, until_s, noise_ratio=ratio, named_s=UNTOUCHED_S)
    for alarms in (ALARMS, ("sliding",)):
        since_s = begins_s[-1] + GRIPPED_S + 1.0
        still[alarms[-1] if len(alarms) == 1 else "any"] = percept_alarms(record, since_s, alarms)
    for begin_s in begins_s[:-1]:
        for pad in range(len(PADS)):
            ran = record.running[:, pad]
            rising = record.t_s[ran & ~np.concatenate([[False], ran[:-1]])] - begin_s - SLIPS_S
            after = rising[(rising > 0) & (rising <= LATEST_S)]
            slips, found = slips + 1, found + bool(len(after))
            delays += after[:1].tolist()
    return {
        "true noise over stated": ratio,
        "hum, counts": hum_counts,
        "named, %": record.named_noisy,
        "contact minutes": minutes,
        "false alarms a minute": Rate(still["any"], minutes),
        "of them `sliding`": Rate(still["sliding"], minutes),
        "10 mm/s found": Share(found, slips),
        "median ms": 1e3 * float(np.median(delays)) if delays else math.nan,
    }


class RampedGrip(GripTouch):
    """A grip whose force falls to 15 % and returns once in two seconds, each within `force_ramp_s`."""

    force_ramp_s: float

    def forces(self, times_s: FloatArray) -> FloatArray:
        """Return forces (n,), as `GripTouch.forces`."""
        phase = np.mod(times_s - self.from_s, 2.0)
        down = np.clip(phase / self.force_ramp_s, 0.0, 1.0)
        up = np.clip((phase - 1.0) / self.force_ramp_s, 0.0, 1.0)
        return np.asarray(super().forces(times_s) * (1 - 0.85 * (down - up)))


def ramped(force_ramp_s: float, quick: bool) -> dict[str, Any]:
    """Return false alarms of light contacts at constant places whose force varies."""
    world, seconds = WORLDS["default"].draw(Family.REPORTING.seed(42)), 6.0 if quick else 245.0
    grips = []
    for number, (link, size_mm) in enumerate(PADS):
        force = RAMPED_FORCES[number % len(RAMPED_FORCES)]
        settings: dict[str, Any] = {"ripple": 0.035, "sway_mm": 0.012, "seed": 1100 + number}
        grips.append(
            RampedGrip(
                link=link, size_mm=size_mm, from_s=GRIPPED_S, duration_s=seconds + 1, path=((0.5, 0.5),),
                force_n=(force,), roll_mm_per_n=0.0, force_ramp_s=force_ramp_s, **settings,
            )
        )  # fmt: skip
    held = run(grips, world, 200.0, seconds)
    minutes = len(PADS) * (seconds - GRIPPED_S - 1.0) / 60
    return {
        "ramps s": force_ramp_s,
        "contact minutes": minutes,
        "false alarms a minute": Rate(percept_alarms(held), minutes),
        "of them `sliding`": Rate(percept_alarms(held, alarms=("sliding",)), minutes),
    }


def slip_score(made: Slips) -> EventScore:
    """Score the alarms of slips: true events are the onsets; the first second of a grip doesn't count."""
    truth, detected, seconds = [], [], 0.0
    for number, (_, _, record, pad) in enumerate(made):
        ran = record.running[:, pad]
        rising = ran & ~np.concatenate([[False], ran[:-1]]) & (record.t_s > GRIPPED_S + 1.0)
        truth.append((number, SLIPS_S))
        detected += [(number, float(t_s)) for t_s in record.t_s[rising & (record.t_s <= SLIPS_S + LATEST_S)]]
        seconds += SLIPS_S - GRIPPED_S - 1.0
    return score_events(truth, detected, hours=seconds / 3600, late_s=LATEST_S)


def latencies(name: str, hz: float, made: Slips) -> Rows:
    rows = []
    for speed, force in itertools.product(SPEEDS, FORCES):
        own = [slip for slip in made if slip[:2] == (speed, force)]
        score = slip_score(own)
        late = np.full(len(own), math.inf)
        late[: len(score.delays_s)] = score.delays_s
        bound = float(np.median([bound_s(record, pad, speed) for _, _, record, pad in own]))
        rows.append(
            {
                "world": name,
                "Hz": hz,
                "mm/s": speed,
                "N": force,
                "found": score.recall,
                "median ms": 1e3 * float(np.median(late)),
                "90 % ms": 1e3 * float(np.quantile(late, 0.9, method="higher")),
                "bound ms": 1e3 * bound,
            }
        )
    return rows


def measure(report: Report) -> None:
    quick = report.quick
    seconds, burst_s = (10.0, 10.0) if quick else (20.0, 80.0)
    held_row = chatter(quick)
    worlds, late = [], []
    for name, hz in CASES[: 3 if quick else None]:
        repeats = 2 if quick or hz > 200 else 4
        made, firm = slip_all(DRAWN[name], hz, repeats), hold(DRAWN[name], hz, min(seconds, 5e3 / hz))
        held, first = false_alarms(firm)
        bursts = false_alarms(hold(DRAWN[name], hz, burst_s, BURST_MM))[0] if hz <= 200 else None
        worlds.append(
            {
                "world": name,
                "Hz": hz,
                **slip_score(made).row(),
                "firm grip, contact hours": held.hours,
                "its false alarms per hour": held,
                "in its first second": first,
                "bursts, contact hours": bursts and bursts.hours,
                "their false alarms per hour": bursts,
            }
        )
        late += latencies(name, hz, made)
        progress(worlds[-1])
    report.table("By world", worlds)
    report.table("An hour of chatter", [held_row])
    report.table("From onset to alarm", late)


def measure_noise(report: Report) -> None:
    rows = []
    for ratio, hum in NOISES:
        rows.append(noisy(ratio, hum, report.quick))
        progress(rows[-1])
    report.table("More noise than is stated", rows)
    report.table("Light contacts whose force varies", [ramped(ramp_s, report.quick) for ramp_s in RAMPS_S])


def chatter(quick: bool) -> dict[str, Any]:
    """Return false alarms of an hour of grips with tremor and chatter in `default`, and fast slips found.

    Also the false alarms of published percepts that are `incipient` only.
    """
    hours, false, published, slips, found = 0.0, 0, 0, 0, 0
    for number in HOLD_HANDS[:1] if quick else HOLD_HANDS:
        world = WORLDS["default"].draw(Family.REPORTING.seed(number))
        held = hold(world, 200.0, 5.0 if quick else HOLD_S, BURST_MM, 1000 * number)
        alarms, _ = false_alarms(held)
        hours, false, published = hours + alarms.hours, false + alarms.count, published + percept_alarms(held)
        made = slip_all(world, 200.0, 1 if quick else HOLD_SLIPS, 1000 * number + 500)
        recall = slip_score([slip for slip in made if slip[0] >= FAST_MM_PER_S]).recall
        slips, found = slips + recall.total, found + recall.count
    return {
        "contact minutes": 60 * hours,
        "false alarms": false,
        "per hour": Rate(false, hours),
        "percepts": published,
        "slips": slips,
        "found, %": Share(found, slips),
    }


PARTS = {"": measure, "noise": measure_noise}
"""What is measured in separate runs, by the part of the page."""


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--part", choices=list(PARTS), help="by default both")
    asked = parser.parse_args()
    for part, fill in PARTS.items():
        if asked.part in (None, part):
            report = Report(asked.quick, part)
            fill(report)
            report.keep()


if __name__ == "__main__":
    main()
