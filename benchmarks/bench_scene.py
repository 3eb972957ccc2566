"""Savings of a tick by scenes: outputs, links, rate, and missing subscriptions.

The pipeline of the daemon, from the last sample to encoded messages, with 15 and 60 pads that all are touched
by sliding contacts; every case has the same samples. Cases are interleaved, so that a slower machine affects
all.
Writes docs/benchmarks/scene.{md,json}.
"""

from __future__ import annotations

import json
import os
import platform
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.bench_tick import hands
from benchmarks.page import made_by, options, output_folder
from handtouch import wire
from handtouch.config.tables import SceneRequest
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.core.scene import ActiveScenes, Demand
from tests.exact_pads import ExactNetworks

PERIOD_NS = 5_000_000
SLIDING_M = 1e-4  # a tick: 20 mm/s at 200 Hz
CURRENT_RATIO = 20.0  # of the threshold's current
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
    "half the rate": (EVERYTHING, SceneRequest(rate_hz=100.0)),
    "a tenth of the rate": (EVERYTHING, SceneRequest(rate_hz=20.0)),
    "position only at a tenth of the rate": (
        EVERYTHING,
        SceneRequest(outputs=("position",), rate_hz=20.0),
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
        self.pipeline.apply_demand(requested, self.demand.ticks_per_hand_frame)
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
        self._model, self._exact, self._chance = (
            model,
            ExactNetworks(model),
            np.random.default_rng(model.size),
        )
        angle = self._chance.uniform(0, 2 * np.pi, model.size)
        self._place = self._chance.uniform(0.3, 0.7, (model.size, 2))
        self._way = SLIDING_M * np.stack([np.cos(angle), np.sin(angle)], axis=1) / self._exact.sides

    def counts(self) -> Counts:
        model, pads = self._model, np.arange(self._model.size)
        self._place += self._way
        self._way[(self._place < 0.2) | (self._place > 0.8)] *= -1
        x, y = (self._place * self._exact.sides).T
        current = self._exact.fractions(pads, x, y).T * (CURRENT_RATIO * model.begin_threshold_a[:, None])
        noise = self._chance.normal(size=(model.size, 4))
        return np.asarray(np.rint(current / model.ampere_per_count + noise), dtype="<i2")


def measure(hand_count: int, ticks: int) -> list[dict[str, Any]]:
    """Return a row per case: mean microseconds of a tick, bytes sent, largest error of a position."""
    model = hands(15 * hand_count)
    cases = {name: Case(model, *case) for name, case in CASES.items()}
    slides = Slides(model)
    for number in range(ticks + 20):
        t_ns, counts = 10**9 + number * PERIOD_NS, slides.counts()
        order = list(cases.items())
        for _, case in order[number % len(order) :] + order[: number % len(order)]:
            case.tick(t_ns, counts)
    rows = []
    for name, case in cases.items():
        spent = np.sort(case.spent[20:])[: -max(1, ticks // 100)]  # without the slowest, of other load
        rows.append(
            {
                "pads": model.size,
                "case": name,
                "tick_us": float(spent.mean()) * 1e-3,
                "bytes_per_tick": case.sent_bytes / case.pipeline.ticks,
            }
        )
        print(rows[-1], flush=True)
    return rows


def write(rows: list[dict[str, Any]], machine: str, out: Path) -> str:
    sizes = sorted({row["pads"] for row in rows})
    first = {size: next(row for row in rows if row["pads"] == size) for size in sizes}

    def line(name: str) -> str:
        cells = []
        for size in sizes:
            row = next(r for r in rows if (r["pads"], r["case"]) == (size, name))
            part = row["tick_us"] / first[size]["tick_us"]
            cells.append(f"{row['tick_us']:.0f} | {part:.0%} | {row['bytes_per_tick']:.0f}")
        return f"| {name} | {' | '.join(cells)} |"

    heads = " | ".join(f"{size} pads: us a tick | of the first | bytes" for size in sizes)
    text = f"""# Savings by scenes

From the last sample to encoded messages, including preparation of the next tick; mean. All pads are
touched; contacts slide {SLIDING_M * 1e3:.1f} mm a tick and have {CURRENT_RATIO:.0f} times
the threshold's current. Bytes are those encoded per tick.
{machine}.

| case | {heads} |
| --- | {"--- | " * (3 * len(sizes))}
{chr(10).join(map(line, CASES))}

Savings of the bus are in [idle](idle.md).

{made_by()}.
"""
    (out / "scene.md").write_text(text)
    (out / "scene.json").write_text(json.dumps({"machine": machine, "rows": rows}, indent=1) + "\n")
    return text


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--ticks", type=int, default=1000)
    asked = parser.parse_args()
    ticks = 20 if asked.quick else asked.ticks
    machine = f"{platform.machine()}, {os.cpu_count()} processors, Python {platform.python_version()}"
    rows = [row for count in (1, 4) for row in measure(count, ticks)]
    print(write(rows, machine, output_folder(asked.quick)))


if __name__ == "__main__":
    main()
