"""Processor time of a hand's reading by `TactileSensor`, 256 environments at once, beside MuJoCo's own steps.

The links of the shipped hand in a scene of their own, each with a plate beneath its pad; in each environment
a ball is pressed onto one pad, or onto none. *Reading*: of a hand of 15 pads, 200 a second, in processor
time. *MuJoCo*: the steps between two readings of this scene. *Readings a second*: of hands, by two processes
side by side, as a training on two cores has them; MuJoCo's steps not included.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import multiprocessing
import sys
import time
from typing import Any

import mujoco

from benchmarks.page import Report, options, progress
from handtouch.config import Deployment, load, shipped
from handtouch.hand.pads import mount_transform
from handtouch.simulate import TactileSensor
from handtouch.simulate.worlds import Family

ENVIRONMENTS, READINGS, PROCESSES = 256, 100, 2
SETTLING_READINGS = 40
APART_M, BALL_M, FORCE_N = 0.3, 0.006, 1.0
GOALS = {"untouched": 100_000, "one pad touched": 35_000}
"""readings a second in `default` by two processes"""


def scene(deployment: Deployment, touched: bool) -> Any:
    """Return a model with a plate beneath each pad, and a ball above the first."""
    bodies = []
    for number, (_, pad) in enumerate(deployment.pads):
        rotation, at = mount_transform(pad)
        axes = " ".join(map(str, [*rotation[:, 0], *rotation[:, 1]]))
        x, y, z = at - 0.002 * rotation[:, 2]
        bodies.append(
            f'<body name="{pad.mount.link or pad.link}" pos="{APART_M * number} 0 0">'
            f'<geom type="box" size="0.02 0.02 0.002" pos="{x} {y} {z}" xyaxes="{axes}"/></body>'
        )
        if touched and not number:  # whose link is at the origin
            x, y, z = at + BALL_M * rotation[:, 2]
            bodies.append(
                f'<body name="ball" pos="{x} {y} {z}" xyaxes="{axes}"><joint type="slide" axis="0 0 1"/>'
                f'<geom type="sphere" size="{BALL_M}" mass="0.05"/></body>'
            )
    head = '<mujoco><option timestep="0.001" gravity="0 0 0"/><worldbody>'
    return mujoco.MjModel.from_xml_string(f"{head}{''.join(bodies)}</worldbody></mujoco>")


def measure(world: str, touched: bool, readings: int) -> dict[str, Any]:
    """Return times of a hand's reading, and of the steps between two."""
    deployment = load(shipped.path("utah_mit.toml"))
    model = scene(deployment, touched)
    states = [mujoco.MjData(model) for _ in range(ENVIRONMENTS)]
    sensor = TactileSensor(deployment, model, world, Family.REPORTING.seed(1), environments=ENVIRONMENTS)
    if touched:
        ball = model.body("ball").id
        for data in states:
            mujoco.mj_forward(model, data)
            data.xfrc_applied[ball, :3] = -FORCE_N * data.xmat[ball].reshape(3, 3)[:, 2]
    step_s = read_s = wall_s = 0.0
    seen = 0
    for number in range(-SETTLING_READINGS, readings):
        began = time.process_time(), time.monotonic()
        for data in states:
            mujoco.mj_step(model, data, sensor.steps)
        between = time.process_time(), time.monotonic()
        reading = sensor.read(states)
        if number >= 0:
            step_s += between[0] - began[0]
            read_s += time.process_time() - between[0]
            wall_s += time.monotonic() - between[1]
            seen += int(reading.touched.sum())
    count = ENVIRONMENTS * readings
    if seen != touched * count:
        raise RuntimeError(f"{seen} touches were read, not {touched * count}")
    return {
        "reading, us": 1e6 * read_s / count,
        "MuJoCo, us": 1e6 * step_s / count,
        "readings a second": count / wall_s,
    }


def _measure_into(queue: Any, arguments: tuple[str, bool, int]) -> None:
    queue.put(measure(*arguments))


def side_by_side(world: str, touched: bool, readings: int) -> dict[str, Any]:
    """Measure in processes side by side: means of times, sum of rates."""
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    processes = [
        context.Process(target=_measure_into, args=(queue, (world, touched, readings)))
        for _ in range(PROCESSES)
    ]
    for process in processes:
        process.start()
    found = [queue.get(timeout=600) for _ in processes]
    for process in processes:
        process.join()
    total = {key: sum(one[key] for one in found) for key in found[0]}
    return {key: value if "second" in key else value / PROCESSES for key, value in total.items()}


def main() -> int:
    """Measure and report; return the exit code."""
    asked = options(__doc__).parse_args()
    readings = 20 if asked.quick else READINGS
    report = Report(asked.quick, environments=ENVIRONMENTS, readings=readings)
    rows = []
    for world in ("ideal", "default"):
        for touch, touched in (("untouched", False), ("one pad touched", True)):
            rows.append({"world": world, "hand": touch, **side_by_side(world, touched, readings)})
            progress(rows[-1])
    report.table("", rows)
    for row in rows:
        if row["world"] == "default":
            goal = GOALS[row["hand"]]
            report.limit(f"readings a second, {row['hand']}", row["readings a second"], goal, at_least=True)
    return 0 if report.keep() else 1


if __name__ == "__main__":
    sys.exit(main())
