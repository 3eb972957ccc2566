"""Savings of a tick by scenes: outputs, links, tolerance, rate, and missing subscriptions.

The pipeline of the daemon, from the last sample to encoded messages, with 15 and 60 pads that all are touched
by sliding contacts; every case has the same samples. Cases are interleaved, so that a slower machine affects
all. Also the cost of the cheapest locator for comparison with a contact's linearisation.
Writes docs/benchmarks/scene.{md,json}.
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
from bench_tick import hands
from numpy.typing import NDArray
from page import made_by, options, output_folder

from handtouch import wire
from handtouch.config.tables import SceneRequest
from handtouch.core.linearisation import ContactLinearisations
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.core.scene import ActiveScenes, Demand
from handtouch.field.paper_methods import log_ratio
from handtouch.field.rectangle import Rectangle

PERIOD_NS = 5_000_000
SLIDING_M = 1e-4  # a tick: 20 mm/s at 200 Hz
CURRENT_RATIO = 20.0  # of the threshold's current
CONTACTS_READ = 15
CONTACTS, EVERYTHING = ("contact/",), ("contact/", "hand/")
CASES: dict[str, tuple[tuple[str, ...], SceneRequest]] = {
    "all outputs, contacts and hand frames subscribed": (EVERYTHING, SceneRequest()),
    "contacts subscribed": (CONTACTS, SceneRequest()),
    "hand frames subscribed": (("hand/",), SceneRequest()),
    "no subscriber": ((), SceneRequest()),
    "no outputs: begin, current and end only": (EVERYTHING, SceneRequest(outputs=())),
    "position only": (EVERYTHING, SceneRequest(outputs=("position",))),
    "a fifth of the links": (EVERYTHING, SceneRequest(links=("thumb_*",))),
    "a fifth of the contacts subscribed": (("contact/hand0/thumb_",), SceneRequest()),
    "within 0.05 mm": (EVERYTHING, SceneRequest(tolerance_mm=0.05)),
    "within 0.2 mm": (EVERYTHING, SceneRequest(tolerance_mm=0.2)),
    "within 1 mm": (EVERYTHING, SceneRequest(tolerance_mm=1.0)),
    "half the rate": (EVERYTHING, SceneRequest(rate_hz=100.0)),
    "a tenth of the rate": (EVERYTHING, SceneRequest(rate_hz=20.0)),
    "position only within 0.2 mm at a tenth of the rate": (
        EVERYTHING,
        SceneRequest(outputs=("position",), tolerance_mm=0.2, rate_hz=20.0),
    ),
}
Counts = NDArray[np.int16]


class Case:
    """A pipeline with a scene and subscriptions."""

    def __init__(self, model: PadModel, subscriptions: tuple[str, ...], scene: SceneRequest) -> None:
        self.pipeline = Pipeline(model, PERIOD_NS, 0.6, self)
        self.pipeline.node_state[:] = 0
        self.subscriptions = frozenset(prefix.encode() for prefix in subscriptions)
        self.spent: list[int] = []
        self.sent_bytes = 0
        self._is_subscribed: dict[str, bool] = {}
        scenes = ActiveScenes(scene, list(zip(model.hands, model.links, strict=True)))
        self.demand = Demand(scenes, self, 1e9 / PERIOD_NS, self._apply)
        self.demand.update(0)
        self.needed = np.flatnonzero(scenes.requirements.pads)

    def has_subscriber(self, topic: str) -> bool:
        if topic not in self._is_subscribed:
            self._is_subscribed[topic] = any(
                topic.encode().startswith(prefix) for prefix in self.subscriptions
            )
        return self._is_subscribed[topic]

    def send(self, message: wire.OutgoingMessage) -> None:
        self.sent_bytes += sum(map(len, wire.encode(message)))

    def _apply(self, requested: Any, needed: Any, *_: Any) -> None:
        self.pipeline.apply_demand(requested)
        self.pipeline.ticks_per_hand_frame = self.demand.ticks_per_hand_frame
        self.pipeline.node_state[~needed.pads] = wire.PadState.OFF

    def tick(self, t_ns: int, counts: Counts) -> None:
        pipeline = self.pipeline
        pipeline.begin_cycle(t_ns, t_ns)
        for pad in self.needed.tolist():  # the others are switched off
            pipeline.slab.write_pdo(pad, counts[pad].tobytes(), t_ns + 1000)
        begin_ns = time.perf_counter_ns()
        if pipeline.tick_if_due(t_ns + 2000) is None:
            pipeline.tick_if_due(t_ns + PERIOD_NS - 1)
        pipeline.prepare_next_tick()
        self.demand.update(t_ns)
        self.spent.append(time.perf_counter_ns() - begin_ns)


class Slides:
    """Samples of contacts that slide over all pads and turn where the middle ends, with a count of noise."""

    def __init__(self, model: PadModel) -> None:
        self._model, self._chance = model, np.random.default_rng(model.size)
        angle = self._chance.uniform(0, 2 * np.pi, model.size)
        self._place = self._chance.uniform(0.3, 0.7, (model.size, 2))
        self._way = SLIDING_M * np.stack([np.cos(angle), np.sin(angle)], axis=1) / model.locator.sides

    def counts(self) -> Counts:
        model, pads = self._model, np.arange(self._model.size)
        self._place += self._way
        self._way[(self._place < 0.2) | (self._place > 0.8)] *= -1
        x, y = (self._place * model.locator.sides).T
        current = model.locator.fractions(pads, x, y).T * (CURRENT_RATIO * model.begin_threshold_a[:, None])
        noise = self._chance.normal(size=(model.size, 4))
        return np.asarray(np.rint(current / model.ampere_per_count + noise), dtype="<i2")


def measure(hand_count: int, ticks: int) -> list[dict[str, Any]]:
    """Return a row per case: mean microseconds of a tick, bytes sent, largest error of a position."""
    model = hands(15 * hand_count)
    cases = {name: Case(model, *case) for name, case in CASES.items()}
    slides, off = Slides(model), {name: [0.0] for name in cases}
    for number in range(ticks + 20):
        t_ns, counts = 10**9 + number * PERIOD_NS, slides.counts()
        order = list(cases.items())
        for _, case in order[number % len(order) :] + order[: number % len(order)]:
            case.tick(t_ns, counts)
        for name, case in order:
            if (
                "within" in name
                and number > 20
                and case.pipeline.ticks % case.demand.ticks_per_hand_frame == 0
            ):
                off[name].append(_apart(case, order[0][1]))
    rows = []
    for name, case in cases.items():
        spent = np.sort(case.spent[20:])[: -max(1, ticks // 100)]  # without the slowest, of other load
        rows.append(
            {
                "pads": model.size,
                "case": name,
                "tick_us": float(spent.mean()) * 1e-3,
                "bytes_per_tick": case.sent_bytes / case.pipeline.ticks,
                "off_mm": max(off[name]) * 1e3 if "within" in name else None,
            }
        )
        print(rows[-1], flush=True)
    return rows


def _apart(case: Case, reference: Case) -> float:
    """Return the largest distance [m] of positions of two cases."""
    a, b = (c.pipeline.tick.columns.position_m for c in (case, reference))
    return float(np.nanmax(np.linalg.norm(a - b, axis=1)))


def locators() -> dict[str, float]:
    """Return median microseconds of linearisations, of the cheapest locator, and of the transformation."""
    model, pads = hands(CONTACTS_READ), np.arange(CONTACTS_READ)
    place = 0.4 * model.locator.sides
    currents = (model.locator.fractions(pads, *place.T) * model.begin_threshold_a * CURRENT_RATIO).T
    linearisations = ContactLinearisations(model)
    linearisations.solve_contacts(pads, currents, place)
    rectangle, columns = Rectangle(*model.locator.sides[0]), np.ascontiguousarray(currents.T)
    unknown = np.zeros((CONTACTS_READ, 2, 2))
    x, y = place.T
    works: dict[str, Callable[[], object]] = {
        "read": lambda: linearisations.evaluate(pads, currents),
        "log-ratio": lambda: log_ratio(rectangle, columns),
        "place": lambda: model.placement.to_link_frame(pads, x, y, unknown),
    }
    costs = {}
    for name, work in works.items():
        spent = []
        for _ in range(2000):
            begin_ns = time.perf_counter_ns()
            work()
            spent.append(time.perf_counter_ns() - begin_ns)
        costs[name] = float(np.median(spent)) * 1e-3
    return costs


def write(rows: list[dict[str, Any]], costs: dict[str, float], machine: str, out: Path) -> str:
    sizes = sorted({row["pads"] for row in rows})
    first = {size: next(row for row in rows if row["pads"] == size) for size in sizes}

    def line(name: str) -> str:
        cells = []
        for size in sizes:
            row = next(r for r in rows if (r["pads"], r["case"]) == (size, name))
            part = row["tick_us"] / first[size]["tick_us"]
            cells.append(f"{row['tick_us']:.0f} | {part:.0%} | {row['bytes_per_tick']:.0f}")
        off = [r["off_mm"] for r in rows if r["case"] == name and r["off_mm"] is not None]
        return f"| {name} | {' | '.join(cells)} | {f'{max(off):.3f}' if off else ''} |"

    heads = " | ".join(f"{size} pads: us a tick | of the first | bytes" for size in sizes)
    text = f"""# Savings by scenes

From the last sample to encoded messages, including preparation of the next tick; mean. All pads are
touched; contacts slide {SLIDING_M * 1e3:.1f} mm a tick and have {CURRENT_RATIO:.0f} times
the threshold's current. Bytes are those encoded per tick. The last column is the largest distance of a
position from that of the first case.
{machine}.

| case | {heads} | largest error, mm |
| --- | {"--- | " * (3 * len(sizes))}--- |
{chr(10).join(map(line, CASES))}

With a larger tolerance the linearisation of a contact is used for longer (`core/linearisation.py`). Other
locators are no alternative, as none is cheaper: reading {CONTACTS_READ} linearisations takes
{costs["read"]:.1f} us and gives position, normal, arc lengths and force on the link; the cheapest locator,
the logarithm of two ratios, takes {costs["log-ratio"]:.1f} us for the position on an ideal pad, and its
transformation to the link {costs["place"]:.0f} us more. Savings of the bus are in [idle](idle.md).

{made_by()}.
"""
    (out / "scene.md").write_text(text)
    (out / "scene.json").write_text(
        json.dumps({"machine": machine, "rows": rows, "locators_us": costs}, indent=1) + "\n"
    )
    return text


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--ticks", type=int, default=1000)
    asked = parser.parse_args()
    ticks = 20 if asked.quick else asked.ticks
    machine = f"{platform.machine()}, {os.cpu_count()} processors, Python {platform.python_version()}"
    rows = [row for count in (1, 4) for row in measure(count, ticks)]
    print(write(rows, locators(), machine, output_folder(asked.quick)))


if __name__ == "__main__":
    main()
