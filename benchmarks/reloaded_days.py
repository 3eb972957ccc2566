"""Two pipelines with the same samples: one is reloaded every few minutes, with random keys of some pads.

Public names: `compare_reloads`. What is published of the other pads must be the same, bit for bit. They are
another hand: pads of one hand share the drift of those that aren't touched, which thresholds decide.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from typing import Any

import numpy as np

from benchmarks.compressed_days import PERIOD_NS, SEED, Days, from_process
from benchmarks.page import progress
from handtouch import wire
from handtouch.config import Deployment
from handtouch.config.tables import Sheet
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.core.scene import RequestedOutputs
from handtouch.daemon.reload import find_changes, find_restart_changes
from handtouch.wire import PadState

RELOAD_PERIOD_S = 180.0
OWN_SHEET = "reloaded"
SHEET_KEYS = ("ohm_per_square", "contact_ohm_mm2", "alpha", "contact_radius_std_mm", "gap_std_mm")
BEHAVIOUR_KEYS = ("slow_creep", "forget_time_s", "back_force_std_n")


class Rows:
    """The sink of a pipeline: what it publishes of some pads, until it is compared."""

    subscriptions = frozenset({b"contact/", b"hand/"})

    def __init__(self, hand: str) -> None:
        self._hand = hand
        self.waiting: deque[tuple[str, Any]] = deque()

    def has_subscriber(self, topic: str) -> bool:
        """Return True for contacts and hand frames."""
        return topic.startswith(("contact/", "hand/"))

    def send(self, message: wire.OutgoingMessage) -> None:
        """Keep what is of these pads."""
        sent = wire.encode(message)
        if not sent[0].startswith((b"contact/", b"hand/")):
            return
        received = wire.decode(sent)
        if isinstance(received, wire.Contact) and received.hand == self._hand:
            self.waiting.append((f"contact of {received.link}", dataclasses.asdict(received)))
        elif isinstance(received, wire.HandFrame) and received.hand == self._hand:
            for name in wire.COLUMNS[wire.HandFrame]:
                self.waiting.append((f"{name} of a frame", getattr(received, name)))


def with_own_sheet(deployment: Deployment, sheet: Sheet, gap_mm: float | None = None) -> Deployment:
    """Return the deployment with every second pad in another hand, on a sheet of its own, perhaps with
    another gap."""
    (hand,) = deployment.hands
    update: dict[str, Any] = {"sheet": OWN_SHEET} | ({} if gap_mm is None else {"gap_mm": gap_mm})
    kept = tuple(pad for row, pad in enumerate(hand.pads) if row % 2)
    changing = tuple(pad.model_copy(update=update) for row, pad in enumerate(hand.pads) if not row % 2)
    hands = (
        hand.model_copy(update={"pads": kept}),
        hand.model_copy(update={"name": OWN_SHEET, "pads": changing}),
    )
    return deployment.model_copy(update={"sheets": {**deployment.sheets, OWN_SHEET: sheet}, "hands": hands})


def random_change(deployment: Deployment, sheet: Sheet, random: np.random.Generator) -> Deployment:
    """Return the deployment with one to three random keys of the changing pads' sheet, or their gap."""
    behaviour = sheet.behaviour
    for _ in range(int(random.integers(1, 4))):
        factor = float(random.uniform(0.9, 1.1))
        if behaviour is not None and random.random() < 0.4:
            key = str(random.choice(BEHAVIOUR_KEYS))
            behaviour = behaviour.model_copy(update={key: getattr(behaviour, key) * factor})
        else:
            key = str(random.choice(SHEET_KEYS))
            sheet = sheet.model_copy(update={key: getattr(sheet, key) * factor})
    gap_mm = float(random.uniform(0.6, 0.9)) if random.random() < 0.3 else None
    return with_own_sheet(deployment, sheet.model_copy(update={"behaviour": behaviour}), gap_mm)


def describe_difference(value: Any, expected: Any) -> str:
    """Return what differs of a contact, by key, or of a column."""
    if isinstance(value, dict):
        differing = [key for key in expected if repr(value[key]) != repr(expected[key])]
        return "; ".join(f"{key} {value[key]!r:.80} instead of {expected[key]!r:.80}" for key in differing)
    return f"{value!r:.200} instead of {expected!r:.200}"


def compare_reloads(hours: float) -> dict[str, Any]:
    """Run `hours` of use; return the numbers of reloads and of equal messages, and the first difference."""
    days = Days(hours)
    days.use.faults.clear()
    days.use.swaps.clear()
    deployment = days.use.deployment
    sheet = deployment.sheets[deployment.pads[0].pad.sheet]
    present = with_own_sheet(deployment, sheet)
    count, kept = len(present.pads), range(len(present.hands[0].pads))
    order = [*range(1, count, 2), *range(0, count, 2)]  # of the samples in the deployment's rows
    sinks = [Rows(present.hands[0].name) for _ in range(2)]
    pipelines = [Pipeline(PadModel(present), PERIOD_NS, 0.8, sink, 1) for sink in sinks]
    every = np.ones(count, np.bool_)
    for pipeline in pipelines:
        requested = RequestedOutputs(every, every, np.ones(count, np.int64), ~every, ~every)
        pipeline.apply_demand(requested, 1)
    random = np.random.default_rng(SEED)
    found: dict[str, Any] = {"hours": hours, "pads": len(kept), "reloads": 0, "equal": 0, "difference": ""}
    for times, counts, _ in from_process(days.batches):
        now_s = float(times[0]) * 1e-9
        if now_s >= RELOAD_PERIOD_S * (found["reloads"] + 1):
            new = random_change(deployment, sheet, random)
            assert not find_restart_changes(present, new)
            rows = sorted(find_changes(present, new)[0])
            assert set(rows).isdisjoint(kept)
            if rows:
                pipelines[0].replace_model(PadModel(new), rows)
            present, found["reloads"] = new, found["reloads"] + 1
            progress(f"{now_s / 3600:.1f} h, {found['reloads']} reloads, {found['equal']} messages equal")
        for pipeline in pipelines:
            pipeline.node_state[:] = PadState.CLEAR
            for sync_ns, sample in zip((times + 10**9).tolist(), counts[:, order].astype("<i2"), strict=True):
                pipeline.begin_cycle(sync_ns, sync_ns)
                for pad, data in enumerate(sample):
                    pipeline.slab.write_pdo(pad, data.tobytes(), sync_ns + 1000 + 100 * pad)
                pipeline.tick_if_due(sync_ns + PERIOD_NS - 1)
                pipeline.prepare_next_tick()
        first, second = (sink.waiting for sink in sinks)
        if len(first) != len(second):
            found["difference"] = f"at {now_s:.1f} s: {len(first)} messages instead of {len(second)}"
        while first and second and not found["difference"]:
            (name, value), (_, expected) = first.popleft(), second.popleft()
            if repr(value) != repr(expected):  # NaN differs from itself
                found["difference"] = f"at {now_s:.1f} s: {name}: {describe_difference(value, expected)}"
            found["equal"] += 1
        if found["difference"]:
            break
    return found
