"""A policy learned in the Gymnasium task, on the real daemon without change: how often it holds the object.

examples/learn_grip.py tunes a linear policy in `handtouch/Grip-v0`, with a sensor of the
[world](../worlds.md) `default` of the tuning family. Then it holds objects that it wasn't trained on, with
sensors of the reporting family: in the task, and on the daemon, `handtouch run` with the shipped gripper's
nodes on a bus of udp_multicast. The nodes sense the same MuJoCo scene, which runs in real time; the policy
reads `TouchFeatures.of(hand)` every 10 ms.

*Held*: slid by less than 8 mm within 1.2 s while the support is taken away, with the 95 % interval of Clopper
and Pearson. *Constant*: the policy without touch that the same search finds. Forces are those at the end,
over the least force that holds the object. Intervals of means are 1.96 standard errors. On the daemon a
sensor's sheets aren't fresh after its first object, and a sample is some 10 ms older than in the task.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.page import Report, options, progress
from benchmarks.scores import Share
from benchmarks.served_hand import daemon_process, in_own_network, on_loopback
from handtouch.client.hand import Hand
from handtouch.config import load
from handtouch.simulate import TactileNodes
from handtouch.simulate.tactile.grip_environment import GripEnvironments, GripScene
from handtouch.simulate.worlds import Family

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
from learn_grip import CANDIDATES, TRAINED, WEIGHT_M_S2, GripPolicy, Outcome, learn, other_objects, run
from run_grip import episode, wait_until_clear

FloatArray = NDArray[np.float64]
WORLD, PORT = "default", 43998
LEARNED_WITH = 1  # seed of a sensor, of the family for tuning
GENERATIONS, SENSORS, OBJECTS = 6, 4, 20


def in_task(weights: FloatArray, objects: tuple[FloatArray, FloatArray], seed: int) -> Outcome:
    """Return what a policy achieves in the task, with one sensor."""
    grips = GripEnvironments(len(objects[0]), WORLD, seed)
    return run(grips, np.tile(weights, (grips.num_envs, 1)), objects)


@contextmanager
def served(seed: int) -> Iterator[tuple[GripScene, TactileNodes, Hand]]:
    """Run nodes and daemon of a sensor."""
    with tempfile.TemporaryDirectory() as name:
        config = on_loopback(Path(name), PORT, "two_finger.toml")
        deployment, scene = load(config), GripScene()
        with (
            TactileNodes(deployment, scene.model, WORLD, seed) as nodes,
            daemon_process(config),
            Hand("gripper", endpoint=deployment.daemon.live, control=deployment.daemon.control) as hand,
        ):
            yield scene, nodes, hand


def on_daemon(weights: FloatArray, objects: tuple[FloatArray, FloatArray], seed: int) -> Outcome:
    """Return what a policy achieves on the daemon, with one sensor."""
    outcomes = []
    with served(seed) as (scene, nodes, hand):
        for mass_kg, friction in zip(*objects, strict=True):
            nodes.update(None)
            wait_until_clear(hand)
            scene.reset(float(mass_kg), float(friction))
            outcomes.append(episode(scene, nodes, hand, GripPolicy(weights[None])))
    cost, force_n, dropped = map(np.array, zip(*outcomes, strict=True))
    return Outcome(cost, force_n, dropped)


def row(policy: str, where: str, outcomes: list[Outcome], needed_n: FloatArray) -> dict[str, Any]:
    """Return the row of a table for the outcomes of some sensors."""
    cost = np.concatenate([outcome.cost for outcome in outcomes])
    held = ~np.concatenate([outcome.dropped for outcome in outcomes])
    over = np.concatenate([outcome.force_n / needed_n for outcome in outcomes])[held]
    return {
        "policy": policy,
        "on": where,
        "held, %": str(Share.of_mask(held)),
        "mean cost": f"{cost.mean():.2f} +- {1.96 * cost.std(ddof=1) / np.sqrt(len(cost)):.2f}",
        "force over least, median": float(np.median(over)) if len(over) else np.nan,
    }


def show(generation: int, found: Outcome) -> None:
    progress(f"generation {generation}: cost {found.cost.mean():.2f}")


def main() -> int:
    """Learn, run and report; return the exit code."""
    asked = options(__doc__).parse_args()
    in_own_network()
    generations, sensors, count = (1, 1, 4) if asked.quick else (GENERATIONS, SENSORS, OBJECTS)
    report = Report(asked.quick, generations=generations, sensors=sensors, objects=count)
    tuning = GripEnvironments(CANDIDATES * len(TRAINED), WORLD, LEARNED_WITH)
    objects, rows, shares = other_objects(count), [], {}
    needed_n = 0.5 * WEIGHT_M_S2 * objects[0] / objects[1]
    for name, touch in (("with touch", True), ("constant", False)):
        weights = learn(tuning, touch, generations, 1, show)
        seeds = [Family.REPORTING.seed(number) for number in range(sensors)]
        for where, achieved in (("task", in_task), ("daemon", on_daemon)):
            outcomes = [achieved(weights, objects, seed) for seed in seeds]
            rows.append(row(name, where, outcomes, needed_n))
            shares[name, where] = Share.of_mask(~np.concatenate([one.dropped for one in outcomes]))
            progress(rows[-1])
    report.table("", rows)
    for name in ("with touch", "constant"):
        task, daemon = shares[name, "task"].interval, shares[name, "daemon"].interval
        gap = max(task[0], daemon[0]) - min(task[1], daemon[1])
        report.limit(f"gap between the intervals of held, {name}", max(100 * gap, 0.0), 0.0, "%")
    return 0 if report.keep() else 1


if __name__ == "__main__":
    sys.exit(main())
