"""Makes the contacts of a recording again, from what each tick was made from.

Public names: `Rerun`, `Again`, `Anew`.

With the recorded deployment on the same build and processor every contact message must come out the same, bit
for bit (`Again`). With another deployment, or without its calibrations, the ticks are made anew (`Anew`).
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.canbus.bus.slab import Slab
from handtouch.config import Deployment
from handtouch.daemon import state
from handtouch.daemon.journal import build
from handtouch.daemon.messages import Outlet
from handtouch.daemon.model import PadModel
from handtouch.daemon.pipeline import Pipeline
from handtouch.daemon.scene import Scenes, Wanted
from handtouch.hand.robot import Robots
from handtouch.record.read import Entry

Take = Callable[[wire.Contact], None]


class FedSlab(Slab):
    """A slab that holds counts as they were read, instead of what came from a bus."""

    def feed(self, columns: dict[str, NDArray[Any]], limits: NDArray[np.int64]) -> None:
        """What one tick found in it."""
        self._counts[:] = columns["counts"]
        self._bottom[:], self._top[:] = limits[:, :4], limits[:, 4:]
        self.t_ns[:], self.fresh[:] = columns["arrived_ns"], columns["fresh"]
        self.fresh_count = int(np.count_nonzero(self.fresh))

    def read(self) -> NDArray[np.int64]:
        return self._counts


@dataclass
class Difference:
    """A contact message that came out otherwise than it was recorded."""

    topic: str
    seq: int
    t_ns: int
    key: str
    """what differs, "" where only one of the two is there"""
    recorded: Any
    replayed: Any

    def __str__(self) -> str:
        if not self.key:
            there = (
                "recorded, but not made again" if self.replayed is None else "made again, but not recorded"
            )
            return f"{self.topic} seq {self.seq} (t_ns {self.t_ns}): {there}"
        return (
            f"{self.topic} seq {self.seq} (t_ns {self.t_ns}): {self.key} was {self.recorded!r}, "
            f"is {self.replayed!r}"
        )


@dataclass
class Rerun:
    """What making ticks again found; `skipped` could not be made again, for want of a state to go on from."""

    ticks: int = 0
    skipped: int = 0
    contacts: int = 0
    """that began"""
    compared: int = 0
    """contact messages"""
    same: int = 0
    first: Difference | None = None
    log_s: float = 0.0
    build: dict[str, Any] = field(default_factory=dict)
    """of the daemon that was recorded"""

    @property
    def other_build(self) -> list[str]:
        """What differs between that build and processor and the present ones, in words."""
        here = build()
        return [
            f"{key}: {_words(self.build.get(key))} then, {_words(here[key])} now"
            for key in here
            if self.build.get(key) != here[key]
        ]


class Again:
    """Feed it the entries of a recording, in their order; `take` gets the contacts that are made.

    `found` tells how they compare with those that were recorded. `publisher` gets all messages, too.
    """

    def __init__(self, take: Take, publisher: Outlet | None = None) -> None:
        self.found = Rerun()
        self.pipeline: Pipeline | None = None
        self.now_ns = 0
        """time of the latest tick, on the daemon's clock"""
        self._outlet = _Outlet(take, publisher)
        self._deployment: Deployment | None = None
        self._model: PadModel | None = None
        self._robots: Robots | None = None
        self._told = ""
        self._limits: NDArray[np.int64] | None = None
        self._recorded: dict[tuple[str, int], dict[str, Any]] = {}
        self._run: int | None = None
        self._first_ns = 0

    def feed(self, entry: Entry) -> None:
        """Take an entry in. Raises ValueError for what no daemon of this version tells."""
        payload, prefix = entry.payload, entry.topic.split("/")[0]
        if payload["run"] != self._run:
            self._run, self.pipeline, self._told = payload["run"], None, ""
            self._recorded.clear()
        if prefix == "config":
            self._configure(payload)
        elif prefix == "state":
            self._restore(payload)
        elif prefix == "contact" and not payload["repeat"] and self.pipeline is not None:
            self._recorded[entry.topic, payload["seq"]] = payload
        elif prefix == "tick":
            self._first_ns = self._first_ns or payload["now_ns"]
            self.now_ns = payload["now_ns"]
            self.found.log_s = (self.now_ns - self._first_ns) * 1e-9
            self._tick(payload)

    def _configure(self, payload: dict[str, Any]) -> None:
        self.found.build = payload["build"]
        if payload["deployment"] == self._told:
            return
        self._told = payload["deployment"]
        with recorded_deployment(payload) as deployment:
            self._deployment, self._model, self._robots = deployment, PadModel(deployment), Robots(deployment)
        self.pipeline = None  # the state follows

    def _restore(self, payload: dict[str, Any]) -> None:
        if self._model is None:
            return
        if self.pipeline is None:
            self.pipeline = self._new_pipeline(payload["run"], self._robots)
        state.restore(self.pipeline, state.unpack(payload["state"]))
        self._limits = _limits(payload["limits"])

    def _new_pipeline(self, run: int, robots: Robots | None) -> Pipeline:
        """Of the recorded deployment."""
        assert self._model is not None
        assert self._deployment is not None
        settings = self._deployment.daemon
        period_ns = round(settings.sync_period_ms * 1e6)
        pipeline = Pipeline(self._model, period_ns, settings.window, self._outlet, run, robots)
        pipeline.slab = FedSlab(self._model.size)
        return pipeline

    def _tick(self, payload: dict[str, Any]) -> None:
        pipeline = self.pipeline
        if pipeline is not None and payload["tick"] != pipeline.ticks + (not payload["stopped"]):
            pipeline = self.pipeline = None  # ticks are missing
        if pipeline is None or self._limits is None:
            self.found.skipped += 1
            self._recorded.clear()
            return
        if payload["limits"] is not None:
            self._limits = _limits(payload["limits"])
        fill(pipeline, payload, columns_of(payload), self._limits)
        if payload["stopped"]:
            pipeline.end(payload["now_ns"])
        else:
            pipeline.tick_again(payload["now_ns"], payload["until_ns"])
            self.found.ticks += 1
        self._compare()

    def _compare(self) -> None:
        made, recorded, found = self._outlet.made, self._recorded, self.found
        for contact in made:
            topic, data = wire.encode(contact)
            replayed = msgpack.unpackb(data)
            found.contacts += contact.event == "begin"
            before = recorded.pop((topic.decode(), contact.seq), None)
            found.compared += 1
            if before == replayed:
                found.same += 1
            elif found.first is None:
                found.first = _difference(topic.decode(), before, replayed)
        for (name, _), before in recorded.items():
            found.compared += 1
            if found.first is None:
                found.first = _difference(name, before, None)
        made.clear()
        recorded.clear()


class Anew(Again):
    """As `Again`, but with another deployment of the same pads; `nominal`: without recorded calibrations.

    What was kept from tick to tick is taken over at the beginning, as by a daemon that reads its deployment
    again. `recorded` gets the contact messages as they were recorded.
    """

    def __init__(
        self,
        deployment: Deployment,
        take: Take,
        publisher: Outlet | None = None,
        *,
        nominal: bool = False,
        recorded: Callable[[dict[str, Any]], None] = lambda _: None,
    ) -> None:
        super().__init__(take, publisher)
        self._new, self._nominal, self._tell = deployment, nominal, recorded
        self._shadow: Pipeline | None = None  # what was recorded
        self._corrections: dict[str, Any] = {}

    def _restore(self, payload: dict[str, Any]) -> None:
        if self._model is None:
            return
        saved = state.unpack(payload["state"])
        self._limits = _limits(payload["limits"])
        corrections = {path: value for path, value in saved.items() if path.startswith("model.")}
        if self.pipeline is None:
            self._shadow = self._new_pipeline(payload["run"], self._robots)
            self.pipeline = self._adopted(saved, payload["run"])
        elif corrections != self._corrections and self._shadow is not None and not self._nominal:
            state.restore(self._shadow, saved)
            self.pipeline.model.take_over(self._model)
            self.pipeline.adopt(self.pipeline.model, np.arange(self._model.size))
        self._corrections = corrections

    def _adopted(self, saved: dict[str, Any], run: int) -> Pipeline:
        """A pipeline that goes on with our deployment. Raises ValueError where the pads differ."""
        assert self._model is not None
        model = PadModel(self._new)
        names = [list(zip(m.hands, m.links, strict=True)) for m in (self._model, model)]
        if names[0] != names[1]:
            told = ["/".join(name) for name in sorted(set(names[0]) ^ set(names[1]))]
            raise ValueError(f"its pads differ from the recording's: {', '.join(told) or 'in their order'}")
        pipeline = self._new_pipeline(run, Robots(self._new))
        state.restore(pipeline, saved)
        if not self._nominal:
            model.take_over(self._model)
        pipeline.adopt(model, np.arange(model.size))
        needs = Scenes(self._new.scene, names[1]).needs
        every = np.ones(model.size, dtype=np.int64)
        strength = needs.pads & needs.strength
        pipeline.want(Wanted(needs.pads, strength, needs.tolerance_m, every, needs.palm, needs.base))
        return pipeline

    def _compare(self) -> None:
        for payload in self._recorded.values():
            self._tell(payload)
        self.found.contacts += sum(contact.event == "begin" for contact in self._outlet.made)
        self._outlet.made.clear()
        self._recorded.clear()


class _Outlet:
    """Keeps contacts until they are compared; everything goes to subscribers too if there are any."""

    def __init__(self, take: Take, publisher: Outlet | None) -> None:
        self.made: list[wire.Contact] = []
        self._take, self._publisher = take, publisher

    def wants(self, topic: str) -> bool:
        return topic.startswith("contact/") or (self._publisher is not None and self._publisher.wants(topic))

    def send(self, message: wire.Outgoing) -> None:
        if isinstance(message, wire.Contact):
            self.made.append(message)
            self._take(message)
        if self._publisher is not None:
            self._publisher.send(message)


@contextmanager
def recorded_deployment(payload: dict[str, Any]) -> Iterator[Deployment]:
    """The deployment of a `config` message; the files that it names are there while in the context."""
    told = json.loads(payload["deployment"])
    with tempfile.TemporaryDirectory(prefix="handtouch-") as folder:
        for number, (name, data) in enumerate(payload["files"].items()):
            path = Path(folder) / f"{number}-{Path(name).name}"
            path.write_bytes(data)
            for table, key in [(node, "eds") for node in told["node"].values()] + [
                (hand, "urdf") for hand in told["hand"]
            ]:
                if table.get(key) == name:
                    table[key] = str(path)
        yield Deployment.model_validate_json(json.dumps(told))


def columns_of(payload: dict[str, Any]) -> dict[str, NDArray[Any]]:
    """Columns of a `tick` message by name. Raises ValueError where they don't fit one another."""
    columns = {
        name: np.frombuffer(payload[name], dtype=kind).reshape((-1, elements) if elements > 1 else -1)
        for name, (kind, elements) in wire.INPUTS.items()
    }
    if len({len(column) for column in columns.values()}) != 1:
        raise ValueError(f"tick {payload['tick']}: its columns differ in length")
    return columns


def fill(
    pipeline: Pipeline, payload: dict[str, Any], columns: dict[str, NDArray[Any]], limits: NDArray[np.int64]
) -> None:
    """Put what a tick was made from where the tick looks for it."""
    assert isinstance(pipeline.slab, FedSlab)
    pipeline.slab.feed(columns, limits)
    pipeline.frames.recall(payload["others"].get("joints", ()))
    pipeline.told.recall(payload["others"].get("told", {}))
    pipeline.node_state[:] = columns["node_state"]
    pipeline.cycle.t_ns, pipeline.cycle.previous_ns = payload["t_ns"], payload["previous_ns"]
    tick = pipeline.tick
    tick.synchronous[:] = columns["synchronous"].astype(np.bool_)
    tick.period_ns[:], tick.paced_ns[:] = columns["period_ns"], columns["paced_ns"]


def _limits(data: bytes) -> NDArray[np.int64]:
    return np.frombuffer(data, dtype="<i8").reshape(-1, 8)


def _difference(topic: str, recorded: dict[str, Any] | None, replayed: dict[str, Any] | None) -> Difference:
    there = recorded or replayed or {}
    keys = [key for key in there if recorded and replayed and recorded.get(key) != replayed.get(key)]
    key = keys[0] if keys else ""
    return Difference(
        topic,
        there["seq"],
        there["t_ns"],
        key,
        recorded and (recorded.get(key) if key else True),
        replayed and (replayed.get(key) if key else True),
    )


def _words(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)
