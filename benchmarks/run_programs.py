"""Run programs of this folder: `python run_programs.py bench|soak|stress [NAME] [options of the programs]`.

One named program writes to the terminal. All of a kind: those in `SIDE_BY_SIDE` as many at a time as there
are cores, then the others one by one, as they time something. What each prints goes to build/measured/. The
run goes on after a failure, and ends with what failed. `make bench`, `make soak` and `make stress` call it.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from benchmarks.page import OUT, keep_run_time, run_time

ROOT = Path(__file__).parents[1]
OUTPUT = ROOT / "build" / "measured"
SIDE_BY_SIDE = (
    "diagnose", "worlds", "contacts", "grasp", "electrodes", "diagnose_cases", "supervise", "slip",
    "swap", "shear_slip", "stability", "percept_grasp", "object", "shear", "design", "switched",
    "shape",
)  # fmt: skip
"""Benchmarks of errors and events, whose figures don't depend on what else runs (processor times aside); the
longest first, so that none of them is the last for long."""


class Runner:
    """Runs programs and reports how each went.

    `output` is the folder for what they print, `options` go to each of them.
    """

    def __init__(self, output: Path, options: list[str]) -> None:
        self.output = output
        self.options = options
        self.failed: list[Path] = []
        self.began_s = time.monotonic()
        output.mkdir(parents=True, exist_ok=True)

    @property
    def minutes(self) -> float:
        """Minutes since the runner was made."""
        return (time.monotonic() - self.began_s) / 60

    def run(self, programs: list[Path], at_once: int) -> None:
        """Run programs, `at_once` at a time; failed ones are added to `failed`."""
        with ThreadPoolExecutor(at_once) as threads:
            list(threads.map(self._run, programs))

    def _run(self, program: Path) -> None:
        path = self.output / f"{program.stem}.txt"
        self._report(f"{program.stem}: begins")
        began_s = time.monotonic()
        with path.open("w") as file:
            done = subprocess.run(
                command(program, self.options), cwd=ROOT, stdout=file, stderr=subprocess.STDOUT, check=False
            )
        took = f"{(time.monotonic() - began_s) / 60:.1f} min"
        if done.returncode:
            self.failed.append(program)
            last = "\n    ".join(path.read_text(errors="replace").splitlines()[-12:])
            self._report(f"{program.stem}: FAILED after {took}, exit code {done.returncode}\n    {last}")
        else:
            self._report(f"{program.stem}: done in {took}")

    def _report(self, text: str) -> None:
        print(f"[{self.minutes:5.1f} min] {text}", flush=True)


def command(program: Path, options: list[str]) -> list[str]:
    """Return the command line that runs a program."""
    return [sys.executable, str(program), *options]


def found(folder: Path, kind: str, name: str) -> list[Path]:
    """Return the programs of a kind in a folder, sorted; `name` may be a pattern such as `*`."""
    return sorted(folder.glob(f"{kind}_{name}.py"))


def main(arguments: list[str] | None = None) -> int:
    """Run what the command line names; return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kind", choices=("bench", "soak", "stress"))
    parser.add_argument("name", nargs="?", default="*", help="without it: all of this kind")
    asked, options = parser.parse_known_args(arguments)
    programs = found(ROOT / "benchmarks", asked.kind, asked.name)
    if not programs:
        known = ", ".join(path.stem.partition("_")[2] for path in found(ROOT / "benchmarks", asked.kind, "*"))
        print(f"no program benchmarks/{asked.kind}_{asked.name}.py; there are: {known}", file=sys.stderr)
        return 2
    if len(programs) == 1:
        return subprocess.run(command(programs[0], options), cwd=ROOT, check=False).returncode
    order = {f"bench_{name}": place for place, name in enumerate(SIDE_BY_SIDE)}
    beside = sorted((path for path in programs if path.stem in order), key=lambda path: order[path.stem])
    runner = Runner(OUTPUT, options)
    print(f"{len(programs)} programs; what they print goes to {OUTPUT.relative_to(ROOT)}", flush=True)
    runner.run(beside, os.cpu_count() or 1)
    runner.run([path for path in programs if path not in beside], 1)
    print(f"{len(programs)} programs in {runner.minutes:.0f} min, {len(runner.failed)} failed", flush=True)
    for path in runner.failed:
        print(f"failed: {path.stem}", flush=True)
    if not runner.failed and not options and asked.name == "*":
        keep_run_time(OUT, f"all of {asked.kind}", run_time(runner.began_s, sum(os.times()[2:4])))
    return 1 if runner.failed else 0


if __name__ == "__main__":
    sys.exit(main())
