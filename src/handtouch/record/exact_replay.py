"""Replay of recorded ticks from their inputs.

Public names: `ReplayResult`, `ExactReplay`, `Recomputation`, `DeploymentReplay`, `recorded_deployment`.

With the recorded deployment on the same build and processor every contact message is the same, bit for bit
(`ExactReplay`). With another deployment the ticks are computed with its parameters (`DeploymentReplay`). The
inputs of a recording by another version are recomputed from an empty state (`Recomputation`).
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.config import Deployment
from handtouch.config.former_keys import replace_former_keys
from handtouch.core.events import (
    DemandEvent,
    Event,
    ModelEvent,
    decode_calibration,
    decode_event,
)
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.core.scene import ActiveScenes, RequestedOutputs
from handtouch.core.slab import Slab
from handtouch.core.state import StateLayoutError
from handtouch.core.tick_messages import MessageSink
from handtouch.hand.robot_models import RobotModels
from handtouch.host.build import build_info
from handtouch.record.recording import RecordedMessage
from handtouch.record.replay_sink import ContactCallback, ReplaySink


class ReplaySlab(Slab):
    """A slab with recorded counts instead of samples from a bus."""

    def load_columns(self, columns: dict[str, NDArray[Any]], limits: NDArray[np.int64]) -> None:
        """Load the slab's content at a tick."""
        self._counts[:] = columns["counts"]
        self._low_limits[:], self._high_limits[:] = np.hsplit(limits, 2)
        self.arrival_ns[:], self.fresh[:] = columns["arrival_ns"], columns["fresh"]
        self.fresh_count = int(np.count_nonzero(self.fresh))

    def unpack_counts(self) -> NDArray[np.int64]:
        return self._counts


@dataclass
class MessageDifference:
    """A contact message that differs from the recorded one."""

    topic: str
    seq: int
    t_ns: int
    key: str
    """first key that differs, "" if only one of the two messages exists"""
    recorded: Any
    replayed: Any

    def __str__(self) -> str:
        if not self.key:
            which = "recorded, but not replayed" if self.replayed is None else "replayed, but not recorded"
            return f"{self.topic} seq {self.seq} (t_ns {self.t_ns}): {which}"
        return (
            f"{self.topic} seq {self.seq} (t_ns {self.t_ns}): {self.key} recorded {self.recorded!r}, "
            f"replayed {self.replayed!r}"
        )


@dataclass
class ReplayResult:
    """Outcome of a replay; `skipped_ticks` couldn't be replayed for lack of a state before them."""

    ticks: int = 0
    skipped_ticks: int = 0
    contacts: int = 0
    """contacts begun"""
    compared: int = 0
    """contact messages compared"""
    equal: int = 0
    first_difference: MessageDifference | None = None
    log_s: float = 0.0
    build: dict[str, Any] = field(default_factory=dict)
    """build facts of the recorded daemon"""

    @property
    def build_differences(self) -> list[str]:
        """Differences between the recorded build and processor and the present ones, as text."""
        here = build_info()
        return [
            f"{key}: recorded {_value_text(self.build.get(key))}, now {_value_text(here[key])}"
            for key in here
            if self.build.get(key) != here[key]
        ]


class ExactReplay:
    """Replay of a recording's entries in their order; `on_contact` gets every replayed contact message.

    `result`: comparison with the recorded messages. `publisher` gets all replayed messages.
    """

    def __init__(self, on_contact: ContactCallback, publisher: MessageSink | None = None) -> None:
        self.result = ReplayResult()
        self.pipeline: Pipeline | None = None
        self.now_ns = 0
        """time of the latest tick, on the daemon's clock"""
        self._on_contact = on_contact
        self._replayed: list[wire.Contact] = []  # until they are compared
        self._sink = ReplaySink(self._keep, publisher)
        self._deployment: Deployment | None = None
        self._model: PadModel | None = None
        self._robots: RobotModels | None = None
        self._config_text = ""
        self._limits: NDArray[np.int64] | None = None
        self._recorded: dict[tuple[str, int], dict[str, Any]] = {}
        self._session: int | None = None
        self._first_ns = 0

    def process_message(self, entry: RecordedMessage) -> None:
        """Process an entry. Raises ValueError for a payload that no daemon of this version publishes."""
        payload, prefix = entry.payload, entry.topic.split("/")[0]
        if payload["session"] != self._session:
            self._session, self.pipeline, self._config_text = payload["session"], None, ""
            self._recorded.clear()
        if prefix == "config":
            self._configure(payload)
        elif prefix == "state":
            self._restore(payload)
        elif prefix == "contact" and not payload["retained"] and self.pipeline is not None:
            self._recorded[entry.topic, payload["seq"]] = payload
        elif prefix == "tick":
            self._first_ns = self._first_ns or payload["now_ns"]
            self.now_ns = payload["now_ns"]
            self.result.log_s = (self.now_ns - self._first_ns) * 1e-9
            self._replay_tick(payload)

    def _keep(self, contact: wire.Contact) -> None:
        self._replayed.append(contact)
        self._on_contact(contact)

    def _configure(self, payload: dict[str, Any]) -> None:
        self.result.build = payload["build"]
        if payload["deployment"] == self._config_text:
            return
        self._config_text = payload["deployment"]
        self._read_deployment(payload)

    def _read_deployment(self, payload: dict[str, Any]) -> None:
        with recorded_deployment(payload) as deployment:
            self._deployment, self._model, self._robots = (
                deployment,
                PadModel(deployment),
                RobotModels(deployment),
            )
        if self.pipeline is not None:
            self.pipeline.next_model = self._model  # an event of the next tick applies it

    def _restore(self, payload: dict[str, Any]) -> None:
        """Load a state, unless replay has come to the same. Raises ValueError for one of another version."""
        if self._model is None or self._is_at(payload):
            return
        self._recorded.clear()  # contacts of ticks that were lost before it
        pipeline = self._new_pipeline(payload["session"], self._robots)
        load_state(pipeline, payload, self.result.build)
        self.pipeline, self._limits = pipeline, _limits(payload["limits"], pipeline.model.size)

    def _is_at(self, payload: dict[str, Any]) -> bool:
        """Return True if replay has come to the tick of a `state` message."""
        return self.pipeline is not None and self.pipeline.ticks == payload["tick"]

    def _new_pipeline(self, session: int, robots: RobotModels | None) -> Pipeline:
        """Build a pipeline of the recorded deployment."""
        assert self._model is not None
        assert self._deployment is not None
        settings = self._deployment.daemon
        period_ns = round(settings.sync_period_ms * 1e6)
        window = settings.sample_window_fraction
        pipeline = Pipeline(self._model, period_ns, window, self._sink, session, robots)
        pipeline.slab = ReplaySlab(self._model.size, self._model.slab_channels)
        return pipeline

    def _replay_tick(self, payload: dict[str, Any]) -> None:
        pipeline = self.pipeline
        if pipeline is not None and payload["tick"] != pipeline.ticks + (not payload["stopped"]):
            pipeline = self.pipeline = None  # ticks are missing
        if pipeline is None or self._limits is None:
            self.result.skipped_ticks += 1
            self._recorded.clear()
            return
        if payload["limits"] is not None:
            self._limits = _limits(payload["limits"], pipeline.model.size)
        load_tick(pipeline, payload, tick_columns(payload), self._limits)
        for event in self._events(payload):
            pipeline.add_event(event)
        if payload["stopped"]:
            pipeline.end_session(payload["now_ns"])
        else:
            pipeline.replay_tick(payload["now_ns"], payload["cycle_end_ns"])
            self.result.ticks += 1
        self._compare()

    def _events(self, payload: dict[str, Any]) -> list[Event]:
        return [decode_event(event) for event in payload["events"]]

    def _compare(self) -> None:
        recorded, result = self._recorded, self.result
        for contact in self._replayed:
            topic, data = wire.encode(contact)
            replayed = msgpack.unpackb(data)
            result.contacts += contact.event == "begin"
            before = recorded.pop((topic.decode(), contact.seq), None)
            result.compared += 1
            if before == replayed:
                result.equal += 1
            elif result.first_difference is None:
                result.first_difference = _difference(topic.decode(), before, replayed)
        for (name, _), before in recorded.items():
            result.compared += 1
            if result.first_difference is None:
                result.first_difference = _difference(name, before, None)
        self._replayed.clear()
        recorded.clear()


class Recomputation(ExactReplay):
    """Replay of a recording's inputs from an empty state: also by another version, whose state can't be read.

    What a daemon learns is learned again, from where the recording begins or ticks are missing; calibrations
    are those recorded, if they can be read. Nothing is compared.
    """

    def _restore(self, payload: dict[str, Any]) -> None:
        if self._model is None or self.pipeline is not None:
            return
        with suppress(LookupError, TypeError, ValueError):  # of another version
            for pad, calibration in enumerate(map(decode_calibration, payload["calibrations"])):
                self._model.set_calibration(pad, calibration)
        self.pipeline = self._new_pipeline(payload["session"], self._robots)
        self.pipeline.state.ticks[0] = payload["tick"]
        self._limits = _limits(payload["limits"], self.pipeline.model.size)

    def _compare(self) -> None:
        self.result.contacts += sum(contact.event == "begin" for contact in self._replayed)
        self._replayed.clear()
        self._recorded.clear()


class DeploymentReplay(ExactReplay):
    """Replay with another deployment of the same pads.

    The recorded state and calibrations are taken over, as by a daemon that reloads its deployment.
    `on_recorded` gets the recorded contact messages.
    """

    def __init__(
        self,
        deployment: Deployment,
        on_contact: ContactCallback,
        publisher: MessageSink | None = None,
        *,
        on_recorded: Callable[[dict[str, Any]], None] = lambda _: None,
    ) -> None:
        super().__init__(on_contact, publisher)
        self._new_deployment, self._on_recorded = deployment, on_recorded

    def _restore(self, payload: dict[str, Any]) -> None:
        if self._model is None or self._is_at(payload):
            return
        self._recorded.clear()  # contacts of ticks that were lost before it
        model = self._other_model(self._model)
        super()._restore(payload)
        assert self.pipeline is not None
        names = list(zip(model.hands, model.links, strict=True))
        needed = ActiveScenes(self._new_deployment.scene, names).requirements
        every = np.ones(model.size, dtype=np.int64)
        force = needed.pads & needed.force
        self.pipeline.replace_model(model, range(model.size))
        self.pipeline.apply_demand(RequestedOutputs(needed.pads, force, every, needed.palm, needed.base))

    def _read_deployment(self, payload: dict[str, Any]) -> None:
        if self.pipeline is None:  # else a reload, which doesn't concern the other deployment
            super()._read_deployment(payload)
            self._robots = RobotModels(self._new_deployment)

    def _other_model(self, recorded: PadModel) -> PadModel:
        """Return the model of the other deployment. Raises ValueError for other pads."""
        model = PadModel(self._new_deployment)
        names = [list(zip(m.hands, m.links, strict=True)) for m in (recorded, model)]
        if names[0] != names[1]:
            differing = ["/".join(name) for name in sorted(set(names[0]) ^ set(names[1]))]
            raise ValueError(
                f"its pads differ from the recording's: {', '.join(differing) or 'in their order'}"
            )
        return model

    def _events(self, payload: dict[str, Any]) -> list[Event]:
        """Return the recorded events without those of scenes and reloads."""
        return [
            event for event in super()._events(payload) if not isinstance(event, DemandEvent | ModelEvent)
        ]

    def _compare(self) -> None:
        for payload in self._recorded.values():
            self._on_recorded(payload)
        self.result.contacts += sum(contact.event == "begin" for contact in self._replayed)
        self._replayed.clear()
        self._recorded.clear()


@contextmanager
def recorded_deployment(payload: dict[str, Any]) -> Iterator[Deployment]:
    """Context manager of a `config` message's deployment; inside it, the files that it names exist."""
    tables = json.loads(payload["deployment"])
    with tempfile.TemporaryDirectory(prefix="handtouch-") as folder:
        for number, (name, data) in enumerate(payload["files"].items()):
            path = Path(folder) / f"{number}-{Path(name).name}"
            path.write_bytes(data)
            for table, key in [(node, "eds") for node in tables["node"].values()] + [
                (hand, "urdf") for hand in tables["hand"]
            ]:
                if table.get(key) == name:
                    table[key] = str(path)
        named = [node.get("eds") for node in tables["node"].values()]
        for name in [*named, *(hand.get("urdf") for hand in tables["hand"])]:  # never a file of this machine
            if name and Path(name).parent != Path(folder):
                raise ValueError(f"the recording names the file {name!r}, but doesn't contain it")
        replace_former_keys(tables)
        yield Deployment.model_validate_json(json.dumps(tables))


def tick_columns(payload: dict[str, Any]) -> dict[str, NDArray[Any]]:
    """Return the columns of a `tick` message by name. Raises ValueError if they differ in length."""
    pads = len(payload["arrival_ns"]) // 8
    columns = {
        name: column.to_array(payload[name], pads if name == "counts" else None)
        for name, column in wire.COLUMNS[wire.TickInputs].items()
    }
    if len({len(column) for column in columns.values()}) != 1:
        raise ValueError(f"tick {payload['tick']}: its columns differ in length")
    return columns


def load_tick(
    pipeline: Pipeline, payload: dict[str, Any], columns: dict[str, NDArray[Any]], limits: NDArray[np.int64]
) -> None:
    """Load the inputs of a recorded tick into the pipeline."""
    assert isinstance(pipeline.slab, ReplaySlab)
    pipeline.slab.load_columns(columns, limits)
    pipeline.transforms.replay_joints(payload["joints"])
    pipeline.node_state[:] = columns["node_state"]
    pipeline.cycle.sync_ns, pipeline.cycle.previous_sync_ns = payload["t_ns"], payload["previous_sync_ns"]


def load_state(pipeline: Pipeline, payload: dict[str, Any], build: dict[str, Any]) -> None:
    """Load the state of a `state` message. Raises ValueError for one of another layout or version."""
    try:
        calibrations = [decode_calibration(calibration) for calibration in payload["calibrations"]]
        pipeline.load_state(payload["state"], payload["layout"], calibrations)
    except (KeyError, ValueError) as error:
        reason = error if isinstance(error, StateLayoutError) else "state or calibrations have another form"
        raise ValueError(
            f"recorded by handtouch {build.get('handtouch', '?')} ({build.get('source', '?')}), which can "
            f"replay it: {reason}; `handtouch replay --recompute` computes its contacts anew from an empty "
            "state, `handtouch export` reads those recorded with any version"
        ) from error


def _limits(data: bytes, pads: int) -> NDArray[np.int64]:
    return np.frombuffer(data, dtype="<i8").reshape(pads, -1)


def _difference(
    topic: str, recorded: dict[str, Any] | None, replayed: dict[str, Any] | None
) -> MessageDifference:
    present = recorded or replayed or {}
    keys = [key for key in present if recorded and replayed and recorded.get(key) != replayed.get(key)]
    key = keys[0] if keys else ""
    return MessageDifference(
        topic,
        present["seq"],
        present["t_ns"],
        key,
        recorded and (recorded.get(key) if key else True),
        replayed and (replayed.get(key) if key else True),
    )


def _value_text(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)
