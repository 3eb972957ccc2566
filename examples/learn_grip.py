"""Learn to hold objects of unknown weight and friction with little force, with touch and without.

A linear policy in MuJoCo: the grip force is a constant, plus gains times how far and how fast the contact has
slid over the thumb's pad. The cross-entropy method tunes them; without touch only the constant. Each seed is
another sensor of the world, with other random candidates. Draws both learning curves, with 95 % intervals of
the mean over the seeds, and the forces for objects that weren't trained on. Needs the extras `gym` and
`figures`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student
from scipy.stats.qmc import Halton

from handtouch.simulate.tactile.grip_environment import (
    EPISODE_STEPS,
    FEATURES,
    MAX_RATE_N_S,
    PERIOD_S,
    GripEnvironments,
    objects_at,
)

FloatArray = NDArray[np.float64]

CANDIDATES, ELITES = 16, 4
TRAINED = np.array([[0.05, 0.05], [0.05, 0.95], [0.95, 0.05], [0.95, 0.95], [0.5, 0.5]])
"""Quantiles of mass and friction of the objects to learn with: light to heavy, slippery to rough."""
OBJECTS = len(TRAINED)
MEAN, STD = np.array([2.5, 1.0, 0.0]), np.array([1.5, 0.5, 0.02])
"""First distribution of the policies: constant [N], gain of the distance [N/mm] and of the speed [N s/mm]."""
MIN_STD = 0.1 * STD
WEIGHT_M_S2 = 9.81
TOUCH = FEATURES["observation.touch"]["names"]
COLUMNS = [TOUCH.index("thumb_tip.x_m"), TOUCH.index("thumb_tip.position_known")]


class GripPolicy:
    """Policies (count, 3) of as many grips, in one episode: the same in simulation and on a `Hand`."""

    def __init__(self, weights: FloatArray) -> None:
        self._weights = weights
        self._begin_mm = np.full(len(weights), np.nan)
        self._slid_mm = np.zeros(len(weights))

    def act(self, touch: NDArray[np.float32], force_n: FloatArray) -> NDArray[np.float32]:
        """Return actions (count, 1) for touch (count, size) and commanded forces (count,)."""
        x_m, known = touch[:, COLUMNS].T.astype(np.float64)
        self._begin_mm = np.where(np.isnan(self._begin_mm) & (known > 0), 1e3 * x_m, self._begin_mm)
        slid_mm = np.where(known > 0, 1e3 * x_m - self._begin_mm, self._slid_mm)
        speed_mm_s, self._slid_mm = (slid_mm - self._slid_mm) / PERIOD_S, slid_mm
        features = np.stack([np.ones(len(slid_mm)), slid_mm, speed_mm_s])
        target_n = np.einsum("nk,kn->n", self._weights, features)
        actions: FloatArray = np.clip((target_n - force_n) / (MAX_RATE_N_S * PERIOD_S), -1, 1)
        return actions.astype(np.float32)[:, None]


@dataclass(frozen=True)
class Outcome:
    """What policies (count, 3) achieved in an episode each; arrays (count,)."""

    cost: FloatArray
    force_n: FloatArray
    """at the end"""
    dropped: NDArray[np.bool_]


def other_objects(count: int) -> tuple[FloatArray, FloatArray]:
    """Return masses [kg] and coefficients of friction (count,) that cover the range evenly."""
    return objects_at(Halton(2, seed=2).random(count))


def run(grips: GripEnvironments, policies: FloatArray, objects: tuple[FloatArray, FloatArray]) -> Outcome:
    """Run an episode of each policy (count, 3) with its object."""
    observation, info = grips.reset(options={"objects": objects})
    policy, cost = GripPolicy(policies), np.zeros(grips.num_envs)
    for _ in range(EPISODE_STEPS):
        force_n = observation["observation.state"][:, 0].astype(np.float64)
        action = policy.act(observation["observation.touch"], force_n)
        observation, reward, dropped, _, info = grips.step(action)
        cost -= reward
    return Outcome(cost, info["grip_force_n"], dropped)


def learn(
    grips: GripEnvironments,
    touch: bool,
    generations: int,
    seed: int,
    report: Callable[[int, Outcome], None],
) -> FloatArray:
    """Return the policy (3,) found: the mean of a generation that cost least for the objects trained on, with
    all sensors: one found with a few may press too gently to be felt by others.

    `report` is given what the best one so far does with other objects.
    """
    random, used = np.random.default_rng(seed), np.array([1, touch, touch])
    mean: FloatArray = MEAN * used
    std: FloatArray = STD * used
    found, least = mean, np.inf
    test, (mass_kg, friction) = other_objects(grips.num_envs), objects_at(TRAINED)
    objects = np.tile(mass_kg, CANDIDATES), np.tile(friction, CANDIDATES)
    for generation in range(generations + 1):
        cost = run(grips, np.tile(mean, (grips.num_envs, 1)), objects).cost.mean()
        if cost < least:
            found, least = mean, cost
        report(generation, run(grips, np.tile(found, (grips.num_envs, 1)), test))
        candidates = mean + std * random.standard_normal((CANDIDATES, 3))
        costs = run(grips, np.repeat(candidates, OBJECTS, axis=0), objects).cost
        best = candidates[np.argsort(costs.reshape(CANDIDATES, OBJECTS).mean(axis=1))[:ELITES]]
        mean, std = best.mean(axis=0), np.maximum(best.std(axis=0), MIN_STD * used)
    return found


def mean_interval(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the mean of values (seeds, ...) and half of its 95 % interval, by Student's distribution."""
    count = len(values)
    return values.mean(axis=0), student.ppf(0.975, count - 1) * values.std(axis=0, ddof=1) / np.sqrt(count)


def mean_costs(outcomes: list[list[Outcome]]) -> FloatArray:
    """Return the mean cost of all objects, (seeds, generations)."""
    return np.array([[outcome.cost.mean() for outcome in found] for found in outcomes])


def draw(
    path: Path, outcomes: dict[str, list[list[Outcome]]], objects: tuple[FloatArray, FloatArray]
) -> None:
    """Draw learning curves, and final forces over the least force that holds each object."""
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot

    figure, (curves, forces) = pyplot.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    needed_n = 0.5 * WEIGHT_M_S2 * objects[0] / objects[1]
    for (name, found), colour in zip(outcomes.items(), ("tab:blue", "tab:orange"), strict=True):
        mean, half = mean_interval(mean_costs(found))
        curves.plot(mean, color=colour, marker="o", ms=3, label=name)
        curves.fill_between(np.arange(len(mean)), mean - half, mean + half, color=colour, alpha=0.2, lw=0)
        held = ~np.array([seed[-1].dropped for seed in found])
        force_n, least_n = np.array([seed[-1].force_n for seed in found]), np.tile(needed_n, (len(found), 1))
        forces.plot(least_n[held], force_n[held], "o", color=colour, ms=2, label=name)
        forces.plot(least_n[~held], force_n[~held], "x", color=colour, ms=6)
    curves.set(xlabel="generation", ylabel="mean cost of objects not trained on")
    line = np.array([0.0, needed_n.max()])
    forces.plot(line, line, "k--", lw=1, label="least force")
    forces.set(xlabel="least force that holds the object [N]", ylabel="final grip force [N]; x: dropped")
    curves.legend()
    forces.legend()
    figure.savefig(path, dpi=110)


def main() -> None:
    """Learn both policies and draw them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--generations", type=int, default=6)
    parser.add_argument("--seeds", type=int, default=5, help="number of repetitions, 2 or more (default: 5)")
    parser.add_argument("--world", default="default", help="imperfections of the sensor (default: default)")
    parser.add_argument("--figure", type=Path, default=Path("learn_grip.png"))
    arguments = parser.parse_args()
    if arguments.seeds < 2:
        parser.error("--seeds must be 2 or more: an interval needs repetitions")
    outcomes: dict[str, list[list[Outcome]]] = {"with touch": [], "without touch": []}
    for seed in range(1, 1 + arguments.seeds):
        grips = GripEnvironments(CANDIDATES * OBJECTS, arguments.world, seed)
        for name, repetitions in outcomes.items():
            found: list[Outcome] = []
            repetitions.append(found)

            def report(generation: int, outcome: Outcome, name: str = name, found: Any = found) -> None:
                found.append(outcome)
                print(
                    f"seed {len(outcomes[name])}, {name}, generation {generation:2}: cost "
                    f"{outcome.cost.mean():6.2f}, final force {outcome.force_n.mean():.2f} N, dropped "
                    f"{outcome.dropped.sum()} of {len(outcome.dropped)}",
                    flush=True,
                )

            policy = learn(grips, name == "with touch", arguments.generations, seed, report)
            print(f"{name}: {policy[0]:.2f} N + {policy[1]:.2f} N/mm x slid + {policy[2]:.3f} N s/mm x speed")
    final = {name: mean_costs(found)[:, -1] for name, found in outcomes.items()}
    saved = final["without touch"] - final["with touch"]
    for name, costs in {**final, "saved by touch": saved}.items():
        mean, half = mean_interval(costs)
        print(f"{name}: mean cost {mean:.2f} +- {half:.2f} (95 %, {len(costs)} seeds)")
    draw(arguments.figure, outcomes, other_objects(CANDIDATES * OBJECTS))
    print(f"figure: {arguments.figure}")


if __name__ == "__main__":
    main()
