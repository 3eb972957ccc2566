"""Train the trees that detect slip with joint states, on simulated grasps and grips of the tuning family.

Grasps in MuJoCo in the worlds `default`, `harsh` and `ideal`, and grips with tremor, chatter and slips on a
hand whose joints rest. Prints how the alarms score in cross-validation over seeds, the share of slips found
and false alarms per minute of grip, for several thresholds; and writes src/handtouch/percept/slip_trees.json.
Quick: few runs, nothing is written.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from benchmarks import bench_percept_grasp as scored
from benchmarks import bench_slip, grasp_run
from benchmarks.bench_slip import PerceptCollector
from benchmarks.daemon_settings import InlineProcess, pipeline_of, request_percepts
from benchmarks.grip_touch import GripTouch
from benchmarks.page import ROOT, progress
from handtouch.config import Deployment, load, shipped
from handtouch.core.columns import TickResult
from handtouch.core.pad_model import PadModel
from handtouch.core.stages.evidence import (
    ALONE_LOG_ODDS,
    MAX_OTHERS_LOG_ODDS,
    OTHERS_WEIGHT,
    SLIP_FEATURES,
)
from handtouch.daemon.percepts import PerceptPublisher
from handtouch.hand.joints import JointSnapshot
from handtouch.hand.robot_models import RobotModels
from handtouch.percept.slip_evidence import SlipEvidence, SlipTrees
from handtouch.simulate.grasp.grasp_objects import GRASP_OBJECTS
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, DrawnWorld, Family

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]
Slip = tuple[int, int, int]
"""Pad, step of the onset, step of the end; steps of 1 ms."""
Kept = list[tuple[int, IntArray, IntArray, FloatArray]]
"""Of each tick: time [ns], pads, ids of contacts, features."""

TREES = ROOT / "src" / "handtouch" / "percept" / "slip_trees.json"
GRASPS = {"default": range(1000, 1024), "harsh": range(1004, 1009), "ideal": range(1020, 1022)}
"""Seeds by world."""
GRIPS = (
    ("default", 0.05, 1100), ("ideal", 0.05, 1101), ("harsh", 0.12, 1102), ("default", 0.05, 1103),
    ("default", 0.02, 1104),
)  # fmt: skip
"""World, noise of the joints [deg], seed."""
ALARM_LOG_ODDS = 1.9
"""Subtracted from the trees' sums; chosen by cross-validation: two false alarms a minute in `default`."""
TREE_COUNT, DEPTH, RATE, PENALTY, BINS, SAMPLED = 160, 5, 0.12, 20.0, 48, 0.15
HARSH_WEIGHT, GRIP_SLIP_WEIGHT, ALONE_SLIP_WEIGHT, GRIPS_STRIDE = 3.0, 2.0, 8.0, 5
ALONE_SHARE = {True: 0.4, False: 0.1}
"""Of samples of grips, of grasps: learnt as if the hand touched nothing else."""
ALONE = {"others_slipping": 0.0, "others_log_ratio": -20.0, "others_current_change_20ms": np.nan} | {
    name: np.nan for name in SLIP_FEATURES if name.startswith(("relative_mm", "relative_std"))
}
"""Features of such a contact."""
GRIP_S, SLOWEST_MM_S, ONSET_STEPS, FOLDS = 12.0, 8.0, 150, 3
_STEP_S, _PERIOD_S, _START_NS = 1e-3, 0.005, 1_000_000_000
_DECAY_S, _MAX_LEAD_S, _MAX_DELAY_S = 0.05, 0.010, 0.3


@dataclass(frozen=True)
class Samples:
    """Features (k, len(SLIP_FEATURES)) of the contacts of one run, tick by tick, and its ground truth."""

    world: str
    """Name of the world; "grip" for grips."""
    seed: int
    features: NDArray[np.float32]
    t_s: FloatArray
    pad: IntArray
    contact: IntArray
    firm: BoolArray
    """(steps, pads), grip."""
    slips: list[Slip]

    @property
    def of_grip(self) -> bool:
        """It is a grip, not a grasp."""
        return self.world == "grip"

    def labels(self) -> IntArray:
        """Return (k,): 1 for slip, 0 for grip, -1 for neither."""
        step = np.minimum(np.round(self.t_s / _STEP_S).astype(np.intp), len(self.firm) - 1)
        found = np.where(self.firm[step, self.pad], 0, -1)
        for pad, onset, end in self.slips:
            last = end if self.of_grip else min(end, onset + ONSET_STEPS)
            found[(self.pad == pad) & (step >= onset) & (step <= last)] = 1
        return found


# Runs -------------------------------------------------------------------------------------------------------


class Recorder(PerceptPublisher):
    """Publisher that keeps the features of all contacts in `kept`."""

    kept: Kept = []  # noqa: RUF012, of the run in progress

    def process_tick(self, result: TickResult, now_ns: int) -> None:
        """Process a tick and keep the features."""
        super().process_tick(result, now_ns)
        tick = self._pipeline.tick
        rows = np.concatenate([result.began, result.updated])
        rows = rows[tick.slip.contact_id[rows] > 0]
        if len(rows):
            features = SlipEvidence(self._poses, tick.slip, _PERIOD_S).features(rows)
            self.kept.append((result.sync_ns, rows, tick.state.contact_id[rows].astype(np.intp), features))


def deployment() -> Deployment:
    """Return the shipped hand, with the deviations of its mounts and joints stated."""
    plain = load(shipped.path("utah_mit.toml"))
    hand = plain.hands[0].model_copy(update=scored.STATED)
    return plain.model_copy(update={"hands": (hand, *plain.hands[1:])})


def samples_of(world: str, seed: int, firm: BoolArray, slips: list[Slip]) -> Samples:
    """Return what the recorder has kept, and clear it."""
    kept = Recorder.kept
    count = [len(rows) for _, rows, _, _ in kept]
    t_s = np.repeat([(sync_ns - _START_NS) * 1e-9 for sync_ns, *_ in kept], count)
    pads, ids, features = (np.concatenate([tick[k] for tick in kept]) for k in (1, 2, 3))
    kept.clear()
    return Samples(world, seed, features.astype(np.float32), t_s, pads, ids, firm, slips)


def grasp(name: str, world: str, seed: int) -> Samples:
    """Return the samples of a grasp."""
    grasp_run.PerceptPublisher = Recorder  # type: ignore[attr-defined]
    drawn = WORLDS[world].draw(Family.TUNING.seed(seed))
    run = grasp_run.served(deployment(), name, seed, drawn, perceive=True)
    speed = scored.speeds(run.grasp)
    firm, slips = np.zeros(speed.shape, np.bool_), []
    for pad, spans in enumerate(run.spans):
        touches = np.zeros(len(speed), np.bool_)
        for begin_s, end_s in spans:
            touches[round(begin_s / _STEP_S) : round(end_s / _STEP_S)] = True
        grips = touches & (speed[:, pad] < scored.MAX_GRIP_M_S)
        firm[:, pad] = scored._lasting(grips, scored._FIRM_STEPS)
        for onset in scored.onsets(np.where(touches, speed[:, pad], np.nan)):
            lost = np.flatnonzero(~touches[onset:])
            end = onset + int(lost[0]) if len(lost) else len(speed)
            if end - onset >= 0.02 / _STEP_S:
                slips.append((pad, onset, end))
    return samples_of(world, seed, firm, slips)


def grips(world: str, noise_deg: float, seed: int) -> Iterator[tuple[str, Callable[[], Samples]]]:
    """Yield names and runs of grips: two without slip, one of them with chatter, and three with slips."""
    drawn = WORLDS[world].draw(Family.TUNING.seed(seed))
    pads = len(bench_slip.PADS)

    def held(burst_mm: float) -> Samples:
        touches = [
            bench_slip.grip(k, 0.0, GRIP_S + 1, bench_slip.FORCES[k % 3], 9000, burst_mm=burst_mm)
            for k in range(pads)
        ]
        process(touches, drawn, GRIP_S, noise_deg, seed)
        firm = np.zeros((round(GRIP_S / _STEP_S), pads), np.bool_)
        firm[1300:] = True
        return samples_of("grip", seed, firm, [])

    def slipping(repeat: int) -> Samples:
        combos = [(speed, force) for speed in bench_slip.SPEEDS for force in bench_slip.FORCES]
        first = (4 * repeat + seed % 5) % len(combos)
        combos = combos[first:] + combos[:first]
        run_s, slips_s, load = bench_slip.RUN_S, bench_slip.SLIPS_S, bench_slip.LOADS[repeat % 2]
        touches = [
            bench_slip.grip(k, 0.0, run_s, force, 100 * repeat + seed, slip_mm_per_s=speed,
                            slip_from_s=slips_s, slip_load=load)
            for k, (speed, force) in enumerate(combos)
        ]  # fmt: skip
        process(touches, drawn, run_s, noise_deg, seed)
        firm = np.zeros((round(run_s / _STEP_S), pads), np.bool_)
        firm[1300:1790] = True
        onset = round(slips_s / _STEP_S)
        slips = [
            (pad, onset, min(onset + round(4000 / speed), len(firm) - 10))
            for pad, (speed, _) in enumerate(combos)
            if speed >= SLOWEST_MM_S
        ]
        return samples_of("grip", seed, firm, slips)

    for burst_mm in (0.0, bench_slip.BURST_MM):
        yield f"hold{burst_mm}", partial(held, burst_mm)
    for repeat in range(3):
        yield f"slip{repeat}", partial(slipping, repeat)


def process(touches: list[GripTouch], world: DrawnWorld, seconds: float, noise_deg: float, seed: int) -> None:
    """Process grips of a hand whose joints rest, but for noise."""
    described = world.describe(deployment())
    hand = VirtualHand(described, Scenario.model_validate({"touch": touches}), world)
    times_s = np.arange(1, round(seconds / _PERIOD_S) + 1) * _PERIOD_S
    counts = np.stack([hand.counts(row, times_s) for row in range(len(hand.pads))], axis=1).astype("<i2")
    model, robots, sink = PadModel(described), RobotModels(described), PerceptCollector()
    pipeline = pipeline_of(described, sink, model=model, robots=robots, period_ns=round(1e9 * _PERIOD_S))
    pipeline.transforms.joints_at = resting_joints(len(robots.joint_names[0]), noise_deg, seed)
    recorder = Recorder(described, pipeline, sink, process=InlineProcess(described))
    request_percepts(pipeline, recorder, ["motion"], palm=True)
    for k, t_s in enumerate(times_s.tolist()):
        t_ns = _START_NS + round(t_s * 1e9)
        pipeline.begin_cycle(t_ns, t_ns)
        for pad in range(model.size):
            pipeline.slab.write_pdo(pad, counts[k, pad].tobytes(), t_ns + 1000 + pad)
        ticked = pipeline.tick_if_due(t_ns + round(0.7e9 * _PERIOD_S))
        assert ticked is not None
        recorder.process_tick(ticked, t_ns)
        pipeline.prepare_next_tick()


def resting_joints(joints: int, noise_deg: float, seed: int) -> Callable[[str, int], JointSnapshot]:
    """Return the joint states at a time: 100 a second of noise around one posture, interpolated."""
    rng = np.random.default_rng(seed)
    noise_rad = np.radians(noise_deg) * rng.normal(size=(6000, joints))
    posture_rad = np.radians(rng.uniform(5, 60, joints))

    def joints_at(_: str, t_ns: int) -> JointSnapshot:
        state = (t_ns - _START_NS + 20 * 10**9) / 1e7
        k, part = int(state) % 5000, state - int(state)
        position = posture_rad + (1 - part) * noise_rad[k] + part * noise_rad[k + 1]
        return JointSnapshot(t_ns, position, np.full(joints, 2e-3), np.full(joints, np.radians(0.2)))

    return joints_at


def collect(quick: bool) -> list[Samples]:
    """Return the samples of all runs."""
    tasks: dict[str, Callable[[], Samples]] = {}
    for world, seeds in GRASPS.items():
        for seed in seeds[:1] if quick else seeds:
            for name in sorted(GRASP_OBJECTS)[: 2 if quick else None]:
                tasks[f"{world}_{seed}_{name}"] = partial(grasp, name, world, seed)
    for settings in GRIPS[:1] if quick else GRIPS:
        tasks |= {f"grip_{settings[2]}_{name}": run for name, run in grips(*settings)}
    found = []
    for name, run in tasks.items():
        found.append(run())
        progress(name)
    return found


# Trees ------------------------------------------------------------------------------------------------------


def learnt(runs: Sequence[Samples]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return features, labels 0 or 1, and weights of the samples to learn."""
    rng = np.random.default_rng(3)
    parts = []
    for run in runs:
        labels = run.labels()
        features, labels = run.features[labels >= 0], labels[labels >= 0]
        if run.of_grip:  # grips are many and alike
            taken = (labels == 1) | (np.arange(len(labels)) % GRIPS_STRIDE == 0)
            features, labels = features[taken], labels[taken]
            weights = np.where(labels == 1, GRIP_SLIP_WEIGHT, 1.0)
        else:
            weights = np.full(len(labels), HARSH_WEIGHT if run.world == "harsh" else 1.0)
        features = features.copy()
        alone = rng.random(len(features)) < ALONE_SHARE[run.of_grip]
        if run.of_grip:
            weights = np.where(alone & (labels == 1), ALONE_SLIP_WEIGHT, weights)
        for name, value in ALONE.items():
            features[alone, SLIP_FEATURES.index(name)] = value
        parts.append((features, labels.astype(np.float64), weights))
    columns = zip(*parts, strict=True)
    return tuple(np.concatenate(column) for column in columns)  # type: ignore[return-value]


def train(features: FloatArray, labels: FloatArray, weights: FloatArray) -> SlipTrees:
    """Return trees boosted with Newton steps on the logistic loss (J. Friedman 2001)."""
    rng = np.random.default_rng(0)
    edges = [_quantiles(column[np.isfinite(column)]) for column in features.T]
    binned = np.empty(features.shape, np.uint8)
    for k, edge in enumerate(edges):
        binned[:, k] = np.where(np.isfinite(features[:, k]), np.searchsorted(edge, features[:, k]), 0)
    prior = float(np.log((weights * labels).sum() / (weights * (1 - labels)).sum()))
    log_odds = np.full(len(labels), prior)
    tests: list[list[tuple[int, int]]] = []
    values: list[FloatArray] = []
    for _ in range(TREE_COUNT):
        probability = 1 / (1 + np.exp(-log_odds))
        slope, curvature = weights * (probability - labels), weights * probability * (1 - probability)
        some = rng.random(len(labels)) < SAMPLED
        tests.append(_best_tests(binned[some], slope[some], curvature[some], edges))
        leaf = np.zeros(len(labels), np.intp)
        for level, (feature, edge_index) in enumerate(tests[-1]):
            leaf |= (binned[:, feature] > edge_index).astype(np.intp) << level
        of_leaf = [np.bincount(leaf, part, 1 << DEPTH) for part in (slope, curvature)]
        values.append(-RATE * of_leaf[0] / (of_leaf[1] + PENALTY))
        log_odds += values[-1][leaf]
    values[0] = values[0] + prior
    thresholds = [[float(f"{edges[feature][k]:.4g}") for feature, k in tree] for tree in tests]
    chosen = np.array([[feature for feature, _ in tree] for tree in tests], np.intp)
    return SlipTrees(chosen, np.array(thresholds), np.array(values))


def _quantiles(values: FloatArray) -> FloatArray:
    levels = np.linspace(0, 1, BINS + 1)[1:-1]
    return np.unique(np.nanquantile(values, levels)) if len(values) else np.zeros(1)


def _best_tests(
    binned: NDArray[np.uint8], slope: FloatArray, curvature: FloatArray, edges: Sequence[FloatArray]
) -> list[tuple[int, int]]:
    """Return feature and edge of each level of a tree, the best for all its nodes together."""
    bins, leaf = BINS + 1, np.zeros(len(slope), np.int64)
    found: list[tuple[int, int]] = []
    for level in range(DEPTH):
        nodes, best = 1 << level, (-np.inf, 0, 0)
        for feature, edge in enumerate(edges):
            cell = leaf * bins + binned[:, feature]
            below, below2 = (
                np.cumsum(np.bincount(cell, part, nodes * bins).reshape(nodes, bins), axis=1)
                for part in (slope, curvature)
            )
            rest, rest2 = below[:, -1:] - below, below2[:, -1:] - below2
            gain = (below**2 / (below2 + PENALTY) + rest**2 / (rest2 + PENALTY)).sum(axis=0)[: len(edge)]
            k = int(gain.argmax())
            if gain[k] > best[0]:
                best = float(gain[k]), feature, k
        found.append(best[1:])
        leaf |= (binned[:, best[1]] > best[2]).astype(np.int64) << level
    return found


# Score ------------------------------------------------------------------------------------------------------


def alarms(run: Samples, log_odds: FloatArray) -> list[tuple[int, float]]:
    """Return pad and time [s] of each alarm, as `MotionReporter` raises them."""
    found = []
    for pad in np.unique(run.pad).tolist():
        held, last_s, contact = -np.inf, 0.0, -1
        for k in np.flatnonzero(run.pad == pad).tolist():
            now_s = float(run.t_s[k])
            if run.contact[k] != contact:
                held, contact = -np.inf, int(run.contact[k])
            before, held = held, max(float(log_odds[k]), held - (now_s - last_s) / _DECAY_S)
            last_s = now_s
            if held > 0 >= before:
                found.append((pad, now_s))
    return found


def log_odds_of(trees: SlipTrees, run: Samples) -> FloatArray:
    """Return ln of the odds of slip of a run's samples (k,), as `SlipEvidence` does."""
    return pooled(trees.log_odds(run.features.astype(np.float64)), run.t_s)


def pooled(own: FloatArray, t_s: FloatArray) -> FloatArray:
    """Return the trees' sums (k,) with those of the other contacts at the same times."""
    _, tick, contacts = np.unique(t_s, return_inverse=True, return_counts=True)
    others = contacts[tick] - 1
    mean = (np.bincount(tick, own)[tick] - own) / np.maximum(others, 1)
    mean = np.clip(mean, -MAX_OTHERS_LOG_ODDS, MAX_OTHERS_LOG_ODDS)
    return np.asarray(own + np.where(others > 0, OTHERS_WEIGHT * mean, ALONE_LOG_ODDS))


def scores(runs: Sequence[Samples], log_odds: Sequence[FloatArray]) -> str:
    """Return the share of slips found, and false alarms per minute of grip."""
    slips = detected = false = 0
    minutes = 0.0
    for run, odds in zip(runs, log_odds, strict=True):
        raised = alarms(run, odds)
        minutes += run.firm.sum() * _STEP_S / 60
        false += sum(bool(run.firm[min(round(t / _STEP_S), len(run.firm) - 1), pad]) for pad, t in raised)
        for pad, onset, end in run.slips:
            from_s = onset * _STEP_S
            until_s = min(end * _STEP_S, from_s + _MAX_DELAY_S)
            slips += 1
            detected += any(p == pad and from_s - _MAX_LEAD_S <= t <= until_s for p, t in raised)
    return f"{100 * detected / max(slips, 1):.1f} % of {slips}, {false / max(minutes, 1e-9):.2f} a minute"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="few runs; writes nothing")
    args = parser.parse_args()
    runs = collect(args.quick)
    if not args.quick:
        own: list[FloatArray] = [np.zeros(0)] * len(runs)
        for fold in range(FOLDS):
            trees = train(*learnt([run for run in runs if run.seed % FOLDS != fold]))
            for k, run in enumerate(runs):
                if run.seed % FOLDS == fold:
                    own[k] = trees.log_odds(run.features.astype(np.float64))
            progress(f"fold {fold + 1} of {FOLDS}")
        for threshold in (1.3, 1.6, 1.8, ALARM_LOG_ODDS, 2.0, 2.2, 2.6):
            for world in (*GRASPS, "grip"):
                some = [k for k, run in enumerate(runs) if run.world == world]
                odds = [pooled(own[k] - threshold, runs[k].t_s) for k in some]
                text = scores([runs[k] for k in some], odds)
                print(f"threshold {threshold}, {world}: {text}")
    trees = train(*learnt(runs))
    trees.values[0] -= ALARM_LOG_ODDS
    trees = SlipTrees(trees.features, trees.thresholds, np.round(trees.values, 4))
    print("as trained:", scores(runs, [log_odds_of(trees, run) for run in runs]))
    if not args.quick:
        TREES.write_text(trees.to_text())


if __name__ == "__main__":
    main()
