"""Cost of a tick: 15 to 960 pads, none, a tenth or all of them touched, static and sliding contacts.

Microseconds, medians. A tick is timed in two parts: from the last sample to columns that are ready to be
sent, and the work done after sending (*prepare*). Each is timed hot, one tick after another, and cold, after
a sleep of 3 ms as between two SYNCs, in which caches are lost. The *floor*, in the same run, is the least
work: counts to currents, their sums, and one comparison. Contacts have 20 times the threshold's current;
sliding ones move 0.1 mm a tick and turn back near edges. *Shear pads*: what the force vectors of 15 touched
pads above shear pads add to a tick, by pattern of electrodes.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from benchmarks.page import Report, Row, Rows, options, progress
from benchmarks.touched_pads import PERIOD_NS, SLIDING_M, Touches, hands
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import run_tick
from handtouch.core.slab import Cycle, Slab
from handtouch.core.tick import TickProcessor
from tests.core.shear_bench import PATTERNS, ShearBench

PADS = (15, 60, 240, 960)
PARTS = (0.1, 1.0)
SPEEDS = {"static": 0.0, "sliding": SLIDING_M}
STATES = {"": 0.0, " cold": 0.003}
SHEAR_PADS = 15
SHEAR_M, SHEAR_FORCES_N = 1e-4, (1.0, 2.0)  # of displacements and of normal forces, by turns


class Driver:
    """Runs ticks of many pads with contacts on some."""

    def __init__(self, model: PadModel, touched: int, sliding_m: float) -> None:
        self.model, self.touched = model, touched
        self.tick, self.slab = TickProcessor(model, PERIOD_NS), Slab(model.size)
        self.cycle, self._up = Cycle(PERIOD_NS, 0.6), np.zeros(model.size, dtype=np.uint8)
        self._touches, self._t_ns = Touches(model, touched, sliding_m), 10**9

    def sample(self) -> None:
        """Write the next samples."""
        self._t_ns += PERIOD_NS
        self.slab.begin_cycle(self._t_ns)
        self.cycle.begin_cycle(self._t_ns)
        for slot, data in enumerate(self._touches.counts()):
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
        assert np.count_nonzero(self.tick.state.touching) == self.touched
        return {name: float(np.median(times)) * 1e-3 for name, times in spent.items()}


def measure(ticks: int) -> Rows:
    rows = []
    for pads in PADS:
        model = hands(pads)
        scenes = [(round(part * pads), kind) for part in PARTS for kind in SPEEDS]
        for touched, kind in [(0, "none"), *scenes]:
            row: Row = {"pads": pads, "touched": touched, "contacts": kind}
            for state, pause_s in STATES.items():
                spent = Driver(model, touched, SPEEDS.get(kind, 0.0)).measure(ticks, pause_s)
                row |= {f"{name}{state}": us for name, us in spent.items()}
            row["hot, per contact"] = (row["tick"] + row["prepare"]) / touched if touched else None
            rows.append(row)
            progress(row)
    return rows


def measure_shear(ticks: int) -> Rows:
    """Return rows with the microseconds of the force vectors of touched pads above shear pads."""
    rows = []
    for kind in PATTERNS:
        row: Row = {"pattern": kind}
        for state, pause_s in (("hot", 0.0), ("cold", STATES[" cold"])):
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
    return rows


def main() -> None:
    quick = options(__doc__).parse_args().quick
    ticks = 5 if quick else 200
    report = Report(quick, ticks=ticks)
    report.table("Microseconds", measure(ticks))
    report.table("Shear pads", measure_shear(ticks))
    report.keep()


if __name__ == "__main__":
    main()
