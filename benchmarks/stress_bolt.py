"""A bolt started in a hole by touch: how often, by what the program gets to know.

examples/start_bolt.py picks up a bolt that lies anywhere in 40 x 40 mm, either way round, and starts it in a
hole, in MuJoCo with the shipped hand and sensors of the [world](../worlds.md) named; see [bolt](../bolt.md).
Each seed of the reporting family is one place of the bolt and one sensor, the same for
all variants: the true pose (the ceiling); all that handtouch publishes; the same with 1 mm and a constant
instead of covariances; without forces; only whether a pad is touched, at the pad's middle with 8 mm; nothing.
The program and its effort are the same. *Daemon*: all that handtouch publishes, over a bus and by the daemon
in a process of its own, slower than the simulation's time by a factor (--daemon 4).

*Inserted*: by 5 mm, in truth, at its end; with the 95 % interval of Clopper and Pearson. *Minus*: difference
of the shares for the same seeds to the true pose and to all that handtouch publishes, in points, with the
95 % interval of paired differences after Newcombe. *Causes*, in truth: the bolt was never lifted (not found);
it lies somewhere (dropped); its head points to the hole (wrong end); it is held beside the hole; it is in the
hole by less than 5 mm (not deep enough). *Believed*: failures that the program takes for a success.

Episodes are kept in docs/benchmarks/stress_bolt.jsonl with their commit and a digest of program and scene;
a run that was broken off goes on, with two processes. All cases grow side by side. Quick: one episode.
"""

from __future__ import annotations

import ast
import dataclasses
import hashlib
import inspect
import json
import multiprocessing
import os
import sys
import time
from collections import Counter
from contextlib import closing
from functools import cache
from typing import Any, NamedTuple

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from benchmarks.page import ROOT, Report, options, progress
from benchmarks.scores import Share
from benchmarks.stale import measured_commit
from handtouch import config
from handtouch.config import shipped
from handtouch.hand.pads import mount_transform
from handtouch.simulate.tactile.bolt_scene import BOLTS, BoltStart
from handtouch.simulate.tactile.bolt_workcell import BoltWorkcell, Pose, Sensed, ServedTouch
from handtouch.simulate.tactile.reading import TactileReading
from handtouch.simulate.worlds import Family

sys.path.insert(0, str(ROOT / "examples"))
from start_bolt import BoltStarter, Step

VARIANTS = ("truth", "handtouch", "no covariance", "no force", "binary", "nothing")
SERVED = "daemon"
OTHERS = {
    "truth": "with the true pose",
    "no covariance": "without covariances",
    "no force": "without forces",
    "binary": "with binary contact",
    "nothing": "with nothing",
}
INSERTED_M = 5e-3
KEPT = ROOT / "docs" / "benchmarks" / "stress_bolt.jsonl"
PAGE, BEGIN, END = ROOT / "docs" / "bolt.md", "<!-- from `make stress ONLY=bolt` -->", "<!-- to here -->"
_PAD_STD_M = 8e-3  # of a contact anywhere on a pad of some 28 mm
load = cache(config.load)  # binary contact asks for the mounts in each reading
_HEAD_STARTS = (6, 6, 0, 0, 4, 0)
"""Seeds of the variants at 1 mm before other cases begin"""
Row = dict[str, Any]
BoolArray = NDArray[np.bool_]


class Case(NamedTuple):
    """What is the same for all seeds."""

    world: str
    clearance_mm: float
    variant: str
    bolt: str = "M10x40"


def plan() -> list[tuple[Case, int]]:
    """Return cases and numbers of seeds in an order that is useful wherever it ends."""
    at_1_mm = [Case("default", 1.0, variant) for variant in VARIANTS]
    other = [("default", 0.5), ("default", 0.2), ("harsh", 1.0), ("default", 3.0), ("ideal", 1.0)]
    twenty = [Case(*each, variant) for each in other for variant in ("truth", "handtouch")]
    twenty += [Case(*each, "binary") for each in other if each[0] == "default"]
    twenty += [
        Case("default", 1.0, variant, bolt)
        for bolt in ("M8x40", "M12x50")
        for variant in ("truth", "handtouch")
    ]
    # cases with their seeds, those before other cases begin, and those beside the 20 of others
    sizes = [
        (case, 60, first, 60 - first) for case, first in zip(at_1_mm, _HEAD_STARTS, strict=True) if first
    ]
    sizes += [(case, 20, 0, 20) for case in twenty]
    sizes += [(case, 60, 0, 20) for case, first in zip(at_1_mm, _HEAD_STARTS, strict=True) if not first]
    sizes += [(Case("default", 1.0, SERVED), 10, 0, 10)]
    sizes.sort(key=lambda each: each[0].variant == "binary")  # it takes longest
    due = [
        ((number - first) / beside, order, number, case)
        for order, (case, count, first, beside) in enumerate(sizes)
        for number in range(count)
    ]
    due.sort(key=lambda each: (each[2] - 60 if each[0] < 0 else each[0], each[1]))
    return [(case, number) for _, _, number, case in due]


class LimitedCell(BoltWorkcell):
    """A workcell that reports less than it senses."""

    variant = "handtouch"

    def move(self, flange: Pose, joint_rad: np.ndarray[Any, Any]) -> Sensed:
        """Move, and leave out what the variant doesn't know."""
        sensed = super().move(flange, joint_rad)
        knows = self.variant not in ("binary", "nothing")
        sliding = sensed.sliding if knows else np.zeros_like(sensed.sliding)
        return sensed._replace(touch=limited(sensed.touch, self.variant), sliding=sliding)


def limited(touch: TactileReading, variant: str) -> TactileReading:
    """Return a reading with what a variant knows."""
    unknown = np.full_like(touch.force_n, np.nan)
    equal = np.tile(np.diag(np.full(3, 1e-6, np.float32)), (len(unknown), 1, 1))
    if variant == "no covariance":
        return dataclasses.replace(touch, covariance_m2=equal)
    if variant == "no force":
        return dataclasses.replace(touch, force_n=unknown, force_std_n=unknown)
    if variant == "binary":
        mounts = [mount_transform(pad) for _, pad in load(shipped.path("utah_mit.toml")).pads]
        return dataclasses.replace(
            touch,
            position_m=np.array([offset for _, offset in mounts], np.float32),
            normal=np.array([rotation[:, 2] for rotation, _ in mounts], np.float32),
            covariance_m2=np.float32(1e6 * _PAD_STD_M**2) * equal,
            force_n=unknown,
            force_std_n=unknown,
        )
    if variant == "nothing":
        return dataclasses.replace(touch, contact_id=np.zeros_like(touch.contact_id))
    return touch


def episode(case: Case, number: int, slower: int = 0) -> Row:
    """Run a program; return its outcome."""
    began_s = time.process_time()
    seed = Family.REPORTING.seed(number)
    start, clearance_m = BoltStart.drawn(seed), 1e-3 * case.clearance_mm
    cell = LimitedCell(seed, start, case.world, clearance_m, bolt=BOLTS[case.bolt], slower=slower)
    cell.variant = case.variant
    told: list[str] = []
    truth = (lambda: cell.scene.bolt_pose) if case.variant == "truth" else None
    with closing(cell):
        program = BoltStarter(cell, truth, told.append)
        program.run()
    return {
        "inserted_mm": round(1e3 * cell.scene.inserted_m, 2),
        "ended": state(cell, program.steps),
        "believed": program.steps[-1] is Step.DONE,
        "attempts": program.steps.count(Step.GRASP),
        "simulated_s": round(cell.scene.data.time, 1),
        "cpu_s": round(time.process_time() - began_s, 1),
        "repeated": cell.touch.repeated if isinstance(cell.touch, ServedTouch) else 0,
        "told": [text for text in told if not text.startswith(("touched", "asks"))],
    }


def run(due: tuple[str, Case, int, int]) -> tuple[str, Row]:
    """Run what is due; return its key and outcome."""
    key, case, number, slower = due
    return key, episode(case, number, slower)


def state(cell: BoltWorkcell, steps: list[Step]) -> str:
    """Return where the bolt is in truth."""
    position, rotation = cell.scene.bolt_pose
    if cell.scene.inserted_m >= INSERTED_M:
        return "inserted"
    if cell.scene.inserted_m > 1e-3:
        return "not deep enough"
    if Step.LIFT not in steps:
        return "not found"
    if position[2] < 0.05:
        return "dropped"
    return "beside the hole" if rotation[1, 2] > 0.5 else "wrong end"


def digest() -> str:
    """Return a digest of the sources that the outcome depends on most."""
    files = [ROOT / "examples" / name for name in ("bolt_pose.py", "start_bolt.py")]
    tactile = ROOT / "src/handtouch/simulate/tactile"
    files += [tactile / "bolt_scene.py", tactile / "bolt_workcell.py"]
    sources = [file.read_text() for file in files]
    sources += [inspect.getsource(part) for part in (LimitedCell, limited, episode)]
    code = [ast.dump(ast.parse(source)) for source in sources]  # without comments and layout
    return hashlib.sha256("".join(code).encode()).hexdigest()[:12]


def kept() -> dict[str, Row]:
    """Return the episodes that were run before, by their key."""
    lines = KEPT.read_text().splitlines() if KEPT.exists() else []
    return {row["key"]: row for row in map(json.loads, lines)}


def is_in(rows: dict[int, Row]) -> dict[int, bool]:
    """Return by seed whether the bolt was inserted."""
    return {number: is_good(row) for number, row in rows.items()}


def is_good(row: Row) -> bool:
    """Return whether the bolt is in the hole."""
    return bool(row["inserted_mm"] >= 1e3 * INSERTED_M)


def paired_interval(mine: BoolArray, theirs: BoolArray) -> tuple[float, float]:
    """Return the 95 % interval of a difference of paired shares.

    Newcombe, Statistics in Medicine 17 (1998), p. 2635, method 10.
    """
    n = len(mine)
    both, one, other, none = (
        int(np.count_nonzero(each))
        for each in (mine & theirs, mine & ~theirs, ~mine & theirs, ~mine & ~theirs)
    )
    product = float(both * none - one * other)
    product = max(product - n / 2, 0.0) if product > 0 else product
    scale = float((both + one) * (other + none) * (both + other) * (one + none))
    phi = product / np.sqrt(scale) if scale else 0.0
    (low1, p1, high1), (low2, p2, high2) = wilson(mine), wilson(theirs)
    below, above = (p1 - low1, high2 - p2), (high1 - p1, p2 - low2)
    reach = [float(np.sqrt(max(a * a - 2 * phi * a * b + b * b, 0.0))) for a, b in (below, above)]
    return p1 - p2 - reach[0], p1 - p2 + reach[1]


def wilson(mask: BoolArray) -> tuple[float, float, float]:
    """Return a share between its limits after Wilson, 95 %."""
    n, p, z = len(mask), float(np.mean(mask)), 1.96
    middle, half = p + z * z / (2 * n), z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return (middle - half) / (1 + z * z / n), p, (middle + half) / (1 + z * z / n)


def minus(rows: dict[int, Row], others: dict[int, Row]) -> str | None:
    """Return the difference of the shares for common seeds, in points, with its interval."""
    mine, theirs = is_in(rows), is_in(others)
    common = sorted(set(mine) & set(theirs))
    if not common or rows is others:
        return None
    low, high = paired_interval(*(np.array([of[k] for k in common]) for of in (mine, theirs)))
    gain = np.mean([float(mine[k]) - theirs[k] for k in common])
    return f"{100 * gain:+.0f} ({100 * low:+.0f} to {100 * high:+.0f})"


def statements(found: dict[Case, dict[int, Row]]) -> list[str]:
    """Return what docs/bolt.md says of the episodes."""
    run = sum(map(len, found.values()))
    said = [f"* {run} of {len(plan())} episodes have been run; of cases that aren't named, none."]
    for case, rows in found.items():
        if case.variant != "handtouch":
            continue
        where = f"In `{case.world}` with a clearance of {case.clearance_mm:g} mm"
        text = f"* {where} the bolt {case.bolt} went in by touch {times(rows)}"
        for other, name in OTHERS.items():
            if others := found.get(case._replace(variant=other)):
                shared = len(set(rows) & set(others))
                seeds = "one seed" if shared == 1 else f"{shared} seeds"
                text += f"; {name} {times(others)}, {minus(others, rows)} points for the {seeds} in common"
        said.append(text + ".")
    served, same = found.get(Case("default", 1.0, SERVED)), found.get(Case("default", 1.0, "handtouch"), {})
    if served and (both := sorted(set(served) & set(same))):
        equal = sum(is_in(served)[k] == is_in(same)[k] for k in both)
        apart_mm = max(abs(float(served[k]["inserted_mm"] - same[k]["inserted_mm"])) for k in both)
        said.append(
            f"* Through the daemon it went in {times(served)}; {equal} of {len(both)} outcomes are those of "
            f"the simulation's own process, and depths differ by up to {apart_mm:.1f} mm."
        )
    failed = Counter(
        (case.variant, row["ended"])
        for case, rows in found.items()
        for row in rows.values()
        if not is_good(row)
    )
    causes = ", ".join(f"{why} {n} ({variant})" for (variant, why), n in failed.most_common())
    said.append(f"* Causes of failures: {causes or 'none'}.")
    return said


def times(rows: dict[int, Row]) -> str:
    """Return how often the bolt was inserted."""
    share = Share.of_mask(np.array(list(is_in(rows).values())))
    low, high = share.interval
    tries = "once" if share.count == share.total == 1 else f"{share.count} of {share.total} times"
    return f"{tries} ({100 * low:.0f} to {100 * high:.0f} %)"


def say(lines: list[str]) -> None:
    """Replace the lines between two comments of docs/bolt.md."""
    before, begin, rest = PAGE.read_text().partition(BEGIN)
    _, end, after = rest.partition(END)
    PAGE.write_text("\n".join([before + begin, "", *lines, "", end + after]))


def summary(case: Case, found: dict[Case, dict[int, Row]]) -> Row:
    """Return a row of the table."""
    rows = found[case]
    failed = [row for row in rows.values() if row["ended"] != "inserted"]
    return {
        "bolt": case.bolt,
        "world": case.world,
        "clearance, mm": case.clearance_mm,
        "known": case.variant,
        "episodes": len(rows),
        "inserted, %": Share.of_mask(np.array(list(is_in(rows).values()))),
        "minus true pose": minus(rows, found.get(case._replace(variant="truth"), {})),
        "minus handtouch": minus(rows, found.get(case._replace(variant="handtouch"), {})),
        "causes": ", ".join(f"{n} {why}" for why, n in Counter(row["ended"] for row in failed).most_common()),
        "believed": sum(row["believed"] for row in failed),
        "grasps": float(np.mean([row["attempts"] for row in rows.values()])),
        "simulated, s": float(np.median([row["simulated_s"] for row in rows.values()])),
        "processor, s": float(np.median([row["cpu_s"] for row in rows.values()])),
    }


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--episodes", type=int, default=10_000, help="at most; 0 reports those that are kept")
    parser.add_argument("--daemon", type=int, default=0, help="run those by a daemon, so many times slower")
    args = parser.parse_args()
    known, source, commit = kept(), digest(), measured_commit()
    keys = {
        (f"{source} {case.variant} {case.bolt} {case.world} {case.clearance_mm} {number}"): (case, number)
        for case, number in plan()
    }
    due = [
        (key, case, number, args.daemon)
        for key, (case, number) in keys.items()
        if key not in known and (case.variant == SERVED) == (args.daemon > 0)
    ]
    # an episode by a daemon is several processes of its own
    with multiprocessing.get_context("spawn").Pool(1 if args.quick or args.daemon else 2) as pool:
        for key, row in pool.imap_unordered(run, due[: 1 if args.quick else args.episodes]):
            known[key] = {"key": key, "commit": commit} | row
            with KEPT.open("a") as file:
                file.write(json.dumps(known[key]) + "\n")
            progress(known[key])
    found: dict[Case, dict[int, Row]] = {}
    for key, (case, number) in keys.items():
        if key in known:
            found.setdefault(case, {})[number] = known[key]
    import mujoco

    report = Report(args.quick, MuJoCo=mujoco.__version__, episodes=sum(map(len, found.values())))
    report.table("Bolts started", [summary(case, found) for case in found])
    report.keep()
    if not args.quick:
        say(statements(found))


if __name__ == "__main__":
    main()
