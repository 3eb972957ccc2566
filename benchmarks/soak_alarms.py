"""False positives of a hand in ordinary use: hours of hands without faults in each world.

Each hour is on a hand of its own: the shipped one, drawn in each [world](../worlds.md) for seeds of the
reporting family. The deployment file describes sheets as their builder would; parts, sheets, drift of zeros,
temperature and supply are hidden. As a hand's week is, it mostly rests; between, bouts of 10 to 180 s: single
touches and slides, things taken and put down, long grasps, wipes, hot cups (10 to 30 K), two objects on a
pad. Sampled at 100 Hz in use and 5 s longer, and at 20 Hz at rest, as the daemon's own idling does. Each
diagnosed fault counts, as no pad has one. Wet objects are in the [episodes](diagnose.md).
"""

from __future__ import annotations

import multiprocessing
import os

from benchmarks.page import Report, options, progress

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy: matrices are small, workers many

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.scores import Rate
from handtouch import config
from handtouch.config import shipped
from handtouch.simulate.faults import INFLUENCES, Fault
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.stimulus import NodeReplacement
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, Family, World
from handtouch.supervisor.diagnose import DiagnosisModel, HandDiagnostics, HandSamples

ROOT = Path(__file__).parent.parent
FIRST_SEED = 7000  # no other benchmark's, nor a test's
WORLD_HOURS = {"ideal": 4, "default": 34, "harsh": 7}
PADS = 15
LENGTH_S = 3600.0
BUSY_HZ, IDLE_HZ = 100, 20  # idle: as `[scene] idle_sync_period_ms` has it by default
LINGER_S = 5.0
BLOCK_S = 0.5
IN_USE = 0.15
"""Of the time that the hand is in use, pauses of seconds included."""
_TABLES: dict[Any, Any] = {}
Place = tuple[float, float]
Spans = list[tuple[float, float]]


@lru_cache(maxsize=1)
def deployment() -> config.Deployment:
    """The shipped hand of 15 pads."""
    return config.load(shipped.path("utah_mit.toml"))


class Hour:
    """An hour, or another time, of a hand of a world: bouts of use between long rests.

    `faults`, `swaps`: faults that are added to the heat of its bouts, and replaced nodes.
    """

    def __init__(self, world: World, seed: int, length_s: float = LENGTH_S) -> None:
        self._rng = np.random.default_rng((FIRST_SEED, seed))
        self.links = [pad.link for hand in deployment().hands for pad in hand.pads]
        self.touches: list[ScenarioTouch] = []
        self.faults: list[Fault] = []
        self.swaps: list[NodeReplacement] = []
        self.length_s = length_s
        self.busy: Spans = []
        self.bouts: Counter[str] = Counter()
        bouts: dict[str, Callable[[float, float], None]] = {
            "use": self._use, "grasps": self._grasps, "long grasp": self._long_grasp, "wipes": self._wipes,
            "hot cup": self._hot_cup, "two objects": self._two,
        }  # fmt: skip
        at = float(self._rng.uniform(0, 300))
        while at < length_s - 30:
            name = str(self._rng.choice([*bouts], p=[0.35, 0.3, 0.1, 0.1, 0.1, 0.05]))
            lasts = min(float(np.exp(self._rng.uniform(np.log(10), np.log(180)))), length_s - at - 5)
            self.bouts[name] += 1
            bouts[name](at, at + lasts)
            self.busy.append((at, at + lasts + LINGER_S))
            at += lasts + LINGER_S + float(self._rng.exponential(lasts * (1 / IN_USE - 1)))
        self.world = world.draw(Family.REPORTING.seed(FIRST_SEED + seed))
        self.deployment = self.world.describe(deployment())

    def hand(self) -> VirtualHand:
        """Return the hand in this use."""
        touches = tuple(self.touches) or (self._touch(self.links[0], 1.0, 0.5, [0.5]),)
        scenario = Scenario(touch=touches, swap=tuple(self.swaps))
        return VirtualHand(self.deployment, scenario, self.world, faults=tuple(self.faults))

    def blocks(self, hand: VirtualHand | None = None) -> Iterator[HandSamples]:
        """Samples of all pads, block after block: dense while in use, sparse while at rest."""
        hand = hand or self.hand()
        for from_s, until_s, rate in self._stretches():
            per_block = round(BLOCK_S * rate)
            count = int((until_s - from_s) * rate) // per_block * per_block
            for first in range(0, count, 40 * per_block):
                times = from_s + np.arange(first, min(first + 40 * per_block, count)) / rate
                counts = np.stack([hand.counts(row, times) for row in range(len(self.links))], axis=1)
                stamps = np.rint(times * 1e9).astype(np.int64)
                stamps = np.repeat(stamps[:, None], len(self.links), axis=1)
                fresh = np.ones((per_block, len(self.links)), np.bool_)
                for k in range(0, len(times), per_block):
                    part = slice(k, k + per_block)
                    yield HandSamples(stamps[part], counts[part], fresh)

    def _stretches(self) -> Iterator[tuple[float, float, int]]:
        at = 0.0
        for begin_s, end_s in self.busy:
            yield at, begin_s, IDLE_HZ
            yield begin_s, end_s, BUSY_HZ
            at = end_s
        yield at, self.length_s, IDLE_HZ

    # bouts, each from a time to a time

    def _use(self, from_s: float, until_s: float) -> None:
        """Taps, presses and slides on some pads, each by itself."""
        for link in self._some(2, 10):
            self._single(link, from_s, until_s)

    def _single(self, link: str, from_s: float, until_s: float) -> None:
        rng, at = self._rng, from_s + float(self._rng.uniform(0, 4))
        while at < until_s - 0.5:
            lasts = min(float(np.exp(rng.uniform(np.log(0.3), np.log(4)))), until_s - at)
            places = [self._place() for _ in range(int(rng.choice([1, 1, 2, 3])))]
            self.touches.append(self._touch(link, at, lasts, self._forces(int(rng.integers(1, 4))), places))
            at += lasts + float(np.exp(rng.uniform(np.log(0.5), np.log(10))))

    def _grasps(self, from_s: float, until_s: float) -> None:
        """Things are taken, held for seconds and put down."""
        at = from_s
        while at < until_s - 2:
            lasts = min(float(np.exp(self._rng.uniform(np.log(1), np.log(20)))), until_s - at)
            self._grasp(at, lasts)
            at += lasts + float(self._rng.uniform(1, 8))

    def _long_grasp(self, from_s: float, until_s: float) -> None:
        self._grasp(from_s, until_s - from_s)

    def _hot_cup(self, from_s: float, until_s: float) -> None:
        """A grasp that warms the pads that hold it, and leaves them warm for a while."""
        warmer = float(self._rng.uniform(10, 30))
        for link in self._grasp(from_s, until_s - from_s):
            heat = {"link": link, "from_s": from_s, "until_s": until_s, "time_s": 40.0}
            part = float(self._rng.uniform(0.6, 1))
            self.faults.append(
                INFLUENCES["heat"].model_validate({"kind": "heat", **heat, "warmer_by_k": part * warmer})
            )

    def _wipes(self, from_s: float, until_s: float) -> None:
        """To and fro over some pads without letting go."""
        rng = self._rng
        for link in self._some(1, 4):
            at = from_s
            while at < until_s - 2:
                lasts = min(float(rng.uniform(2, 10)), until_s - at)
                places = [self._place() for _ in range(max(int(lasts / rng.uniform(0.4, 1.5)), 2))]
                self.touches.append(self._touch(link, at, lasts, self._forces(4), places))
                at += lasts + float(rng.uniform(0.5, 4))

    def _two(self, from_s: float, until_s: float) -> None:
        """Two things on one pad, now and then together."""
        for link in self._some(1, 3):
            self._single(link, from_s, until_s)
            self._single(link, from_s, until_s)

    def _grasp(self, from_s: float, lasts_s: float) -> list[str]:
        """Hold an object with tremor in position and force, at about 3 Hz; and release it at once."""
        rng, links = self._rng, self._some(2, 10)
        for link in links:
            delay = float(rng.uniform(0, min(0.5, lasts_s / 4)))
            steps = max(int(3 * (lasts_s - delay)), 2)
            wander = float(np.exp(rng.uniform(np.log(0.002), np.log(0.03))))
            tremor = float(np.exp(rng.uniform(np.log(0.005), np.log(0.1))))
            middle = np.array(self._place(0.15))
            places = np.clip(middle + wander * rng.normal(size=(steps, 2)), 0.02, 0.98).tolist()
            force = self._forces(1)[0] * np.exp(tremor * rng.normal(size=steps))
            way = [(float(x), float(y)) for x, y in places]
            self.touches.append(self._touch(link, from_s + delay, lasts_s - delay, force.tolist(), way))
        return links

    def _touch(
        self,
        link: str,
        from_s: float,
        lasts_s: float,
        force: list[float],
        path: Sequence[Place] = ((0.5, 0.5),),
    ) -> ScenarioTouch:
        return ScenarioTouch(
            link=link, from_s=from_s, duration_s=lasts_s, path=tuple(path), force_n=tuple(force)
        )

    def _forces(self, count: int) -> list[float]:
        rng = self._rng
        forces = np.exp(rng.uniform(np.log(0.3), np.log(5)) + rng.uniform(-0.5, 0.5, count))
        return [float(force) for force in forces]

    def _place(self, margin: float = 0.06) -> Place:
        x, y = self._rng.uniform(margin, 1 - margin, 2).tolist()
        return x, y

    def _some(self, least: int, most: int) -> list[str]:
        count = int(self._rng.integers(least, most + 1))
        return [str(link) for link in self._rng.permutation(self.links)[:count]]


def play(task: tuple[str, int]) -> dict[str, Any]:
    """Return the diagnoses in one hour of a hand without faults: world and number."""
    world, seed = task
    hour, alarms = Hour(WORLDS[world], seed), []
    model = DiagnosisModel.from_deployment(hour.deployment, "right")
    diagnosis = HandDiagnostics(model, tables=_TABLES)
    for block in hour.blocks():
        found = [
            fault for fault in diagnosis.process_block(block) if fault.is_fault and fault.until_ns is None
        ]
        alarms += [
            {
                "world": world,
                "seed": seed,
                "kind": f.kind.value,
                "link": f.link,
                "s": f.published.since_ns * 1e-9,
            }
            for f in found
        ]
    return {
        "world": world, "alarms": alarms, "bouts": dict(hour.bouts),
        "touches": len(hour.touches), "busy_s": sum(end - begin for begin, end in hour.busy),
    }  # fmt: skip


def run(hours: Mapping[str, int], workers: int) -> list[dict[str, Any]]:
    """Play hours by world."""
    tasks = [(world, seed) for seed in range(max(hours.values())) for world in WORLDS if seed < hours[world]]
    found = []
    with multiprocessing.get_context("fork").Pool(workers) as pool:
        for result in pool.imap_unordered(play, tasks):
            found.append(result)
            progress(
                f"{len(found)} of {len(tasks)} hours, {sum(len(r['alarms']) for r in found)} false positives"
            )
    return found


def counted(results: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return false positives by world and kind, and all together."""
    rows = []
    for world in WORLDS:
        own = [r for r in results if r["world"] == world]
        hours = len(own) * LENGTH_S / 3600
        kinds = Counter(alarm["kind"] for r in own for alarm in r["alarms"])
        for kind, count in [*kinds.most_common(), ("all", kinds.total())]:
            row = {"world": world, "diagnosis": kind, "pad-hours": PADS * hours, "false positives": count}
            rows.append({**row, "per 100 pad-hours": Rate(count, PADS * hours / 100)})
    return rows


def used(results: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Use of the hand meanwhile."""
    bouts = sum((Counter(r["bouts"]) for r in results), Counter[str]())
    hours = len(results) * LENGTH_S / 3600
    return [
        {"touches": sum(r["touches"] for r in results),
         "in use, %": sum(r["busy_s"] for r in results) / hours / 36,
         **{f"bouts: {name}": count for name, count in bouts.most_common()}}
    ]  # fmt: skip


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--hours", type=int, help="in each world")
    args = parser.parse_args()
    hours = 1 if args.quick else args.hours
    results = run(WORLD_HOURS if hours is None else dict.fromkeys(WORLDS, hours), os.cpu_count() or 1)
    report = Report(args.quick, hours=len(results))
    report.table("False positives", counted(results))
    report.table("Each of them", [alarm for r in results for alarm in r["alarms"]])
    report.table("Use of the hand", used(results))
    report.keep()


if __name__ == "__main__":
    main()
