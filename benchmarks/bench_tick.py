"""Cost of a tick: 15 to 960 pads, none, a tenth or all of them touched, static and sliding contacts.

A tick is timed in two parts: from the last sample to columns that are ready to be sent, and the work done
after sending (`prepare`). Each is timed hot, one tick after another, and cold, after a sleep as between two
SYNCs, in which caches are lost. The floor, in the same run, is the least work: counts to currents, their
sums, and one comparison. Writes docs/benchmarks/tick.{md,json}.
"""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.page import made_by, options, output_folder
from handtouch.config import Deployment, load, shipped
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import run_tick
from handtouch.core.slab import Cycle, Slab
from handtouch.core.tick import TickProcessor
from tests.core.shear_bench import PATTERNS, ShearBench
from tests.exact_pads import ExactNetworks

PADS = (15, 60, 240, 960)
PARTS = (0.1, 1.0)
PERIOD_NS = 5_000_000
SLIDING_M = 1e-4  # a tick: 20 mm/s at 200 Hz
SPEEDS = {"static": 0.0, "sliding": SLIDING_M}
CURRENT_RATIO = 20.0  # of the threshold's current
PAUSE_S = 0.003
SHEAR_PADS = 15
SHEAR_M, SHEAR_FORCES_N = 1e-4, (1.0, 2.0)  # of displacements and of normal forces, by turns

FloatArray = NDArray[np.float64]
Row = dict[str, Any]


def hands(pads: int) -> PadModel:
    """Return a model of as many copies of the shipped hand as needed."""
    deployment: Deployment = load(shipped.path("utah_mit.toml"))
    (hand,) = deployment.hands
    many = [hand.model_copy(update={"name": f"hand{k}"}) for k in range(pads // len(hand.pads))]
    return PadModel(deployment.model_copy(update={"hands": tuple(many)}))


class Driver:
    """Runs ticks of many pads with contacts on some."""

    def __init__(self, model: PadModel, touched: int, sliding_m: float) -> None:
        self.model, self.touched = model, touched
        self.tick, self.slab = TickProcessor(model, PERIOD_NS), Slab(model.size)
        self.cycle = Cycle(PERIOD_NS, 0.6)
        self._up = np.zeros(model.size, dtype=np.uint8)
        self._random = np.random.default_rng(model.size + touched)
        self._exact = ExactNetworks(model)
        self._position = self._random.uniform(0.3, 0.7, (model.size, 2))
        angle = self._random.uniform(0, 2 * np.pi, model.size)
        self._velocity = sliding_m * np.stack([np.cos(angle), np.sin(angle)], axis=1) / self._exact.sides
        self._t_ns = 10**9

    def sample(self) -> None:
        """Write the next samples, with a noise of one count."""
        self._t_ns += PERIOD_NS
        self._position += self._velocity
        self._velocity[(self._position < 0.2) | (self._position > 0.8)] *= -1
        pads = np.arange(self.touched)
        at = self._position[pads] * self._exact.sides[pads]
        counts = self._random.normal(size=(self.model.size, 4))
        current = self._exact.fractions(pads, *at.T).T * (
            CURRENT_RATIO * self.model.begin_threshold_a[pads, None]
        )
        counts[pads] += current / self.model.ampere_per_count[pads]
        self.slab.begin_cycle(self._t_ns)
        self.cycle.begin_cycle(self._t_ns)
        for slot, data in enumerate(np.rint(counts).astype("<i2")):
            self.slab.write_pdo(slot, data.tobytes(), self._t_ns + 1000)

    def run_tick(self) -> None:
        """Run the measured tick."""
        run_tick(self.tick, self.slab, self._up, self.cycle)

    def floor(self) -> None:
        """Convert counts to currents and find touched pads."""
        currents = self.slab.unpack_counts() * self.model.ampere_per_count
        np.count_nonzero(currents @ np.ones(4) > self.model.begin_threshold_a)

    def measure(self, ticks: int, pause_s: float) -> dict[str, float]:
        """Return the median microseconds of each part."""
        spent: dict[str, list[int]] = {"floor": [], "tick": [], "prepare": []}
        parts: list[tuple[str, Callable[[], None]]] = [
            ("tick", self.run_tick),
            ("prepare", self.tick.prepare_next_tick),
        ]
        for number in range(ticks + 10):
            self.sample()
            for name, part in [("floor", self.floor)] * (number % 4 == 0) + parts:
                if name != "prepare" and pause_s:
                    time.sleep(pause_s)
                begin_ns = time.perf_counter_ns()
                part()
                if number >= 10:
                    spent[name].append(time.perf_counter_ns() - begin_ns)
        assert np.count_nonzero(self.tick.contacts.touching) == self.touched
        return {name: float(np.median(times)) * 1e-3 for name, times in spent.items()}


def measure(ticks: int) -> list[Row]:
    rows = []
    for pads in PADS:
        model = hands(pads)
        scenes = [(round(part * pads), kind) for part in PARTS for kind in SPEEDS]
        for touched, kind in [(0, "none"), *scenes]:
            for state, pause_s in (("hot", 0.0), ("cold", PAUSE_S)):
                spent = Driver(model, touched, SPEEDS.get(kind, 0.0)).measure(ticks, pause_s)
                rows.append({"pads": pads, "touched": touched, "contacts": kind, "state": state, **spent})
                times = ", ".join(f"{name} {us:.1f} us" for name, us in spent.items())
                print(f"{pads} pads, {touched} touched, {kind}, {state}: {times}", flush=True)
    return rows


def measure_shear(ticks: int) -> list[Row]:
    """Return rows with the microseconds of the force vectors of touched pads above shear pads."""
    rows = []
    for kind in PATTERNS:
        row: Row = {"pattern": kind}
        for state, pause_s in (("hot", 0.0), ("cold", PAUSE_S)):
            pads, spent = ShearBench([kind] * SHEAR_PADS), []
            samples = [(n, pads.counts(0, (SHEAR_M * n, -SHEAR_M), n)) for n in SHEAR_FORCES_N]
            for number in range(ticks + 10):
                normal_n, counts = samples[number % 2]
                for pad in range(SHEAR_PADS):
                    pads.touch(pad, normal_n, (1e-3, 0.0), counts)
                if pause_s:
                    time.sleep(pause_s)
                spent.append(pads.tick())
            row[state] = float(np.median(spent[10:])) * 1e-3
        rows.append(row | {"hot, per contact": row["hot"] / SHEAR_PADS})
        print(rows[-1], flush=True)
    return rows


def pick(rows: list[Row], state: str, pads: int, touched: int, contacts: str) -> Row:
    key = (state, pads, touched, contacts)
    return next(r for r in rows if (r["state"], r["pads"], r["touched"], r["contacts"]) == key)


def line(rows: list[Row], row: Row) -> str:
    """Return a line of the table, from a hot row and the cold one."""
    cold = pick(rows, "cold", row["pads"], row["touched"], row["contacts"])
    each = f"{whole(row) / row['touched']:.1f}" if row["touched"] else ""
    columns = [row["pads"], row["touched"], row["contacts"]]
    columns += [f"{row[part]:.1f}" for part in ("floor", "tick", "prepare")] + [each]
    columns += [f"{cold[part]:.1f}" for part in ("floor", "tick", "prepare")]
    return "| " + " | ".join(map(str, columns)) + " |"


def whole(row: Row) -> float:
    """Return the time of both parts."""
    return float(row["tick"] + row["prepare"])


def write(rows: list[Row], shear: list[Row], machine: str, out: Path) -> str:
    table = "\n".join(line(rows, row) for row in rows if row["state"] == "hot")
    idle = "\n".join(
        f"* {pads} pads: {whole(none) / whole(pick(rows, 'hot', pads, pads, 'static')):.0%} of all static, "
        f"{whole(none) / whole(pick(rows, 'hot', pads, pads, 'sliding')):.0%} of all sliding"
        for pads in PADS
        for none in [pick(rows, "hot", pads, 0, "none")]
    )
    vectors = "\n".join(
        f"| {row['pattern']} | {row['hot']:.1f} | {row['hot, per contact']:.2f} | {row['cold']:.1f} |"
        for row in shear
    )
    few, many = PADS[0], PADS[-1]
    growth = {kind: whole(pick(rows, "hot", many, many, kind)) for kind in SPEEDS}
    growth = {kind: growth[kind] / whole(pick(rows, "hot", few, few, kind)) for kind in SPEEDS}
    text = f"""# Cost of a tick

Microseconds, medians; {machine}.
Contacts at {CURRENT_RATIO:.0f} times the threshold, noise of one count a channel; sliding ones move
{SLIDING_M * 1e3:.1f} mm a tick and turn back near edges. Hot: one tick after another.
Cold: {PAUSE_S * 1e3:.0f} ms of sleep before each tick. *tick* is the latency from samples to messages;
*prepare* runs after they were sent. The floor converts counts to currents and compares them.

| pads | touched | contacts | floor | tick | prepare | both, per contact | floor cold | tick | prepare |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |
{table}

Cost of untouched pads as a fraction of that of touched ones:

{idle}

Growth from {few} to {many} pads, {many // few} times as many, all touched: {growth["static"]:.1f}
times static, {growth["sliding"]:.1f} times sliding.

## Shear pads

What the force vectors of {SHEAR_PADS} touched pads above shear pads add to a tick, by pattern of electrodes.

| pattern | hot | hot, per contact | cold |
| --- | --- | --- | --- |
{vectors}

{made_by()}.
"""
    (out / "tick.md").write_text(text)
    (out / "tick.json").write_text(
        json.dumps({"machine": machine, "rows": rows, "shear": shear}, indent=1) + "\n"
    )
    return text


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--ticks", type=int, default=200)
    asked = parser.parse_args()
    machine = f"{platform.machine()}, {os.cpu_count()} processors, Python {platform.python_version()}"
    ticks = 5 if asked.quick else asked.ticks
    print(write(measure(ticks), measure_shear(ticks), machine, output_folder(asked.quick)))


if __name__ == "__main__":
    main()
