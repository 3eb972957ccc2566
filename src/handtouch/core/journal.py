"""Recording of ticks: publish the inputs of each tick, so that a replay repeats it bit for bit.

Public name: `TickJournal`. A recording is a state and the inputs of every tick since, events included;
nothing else exists. Nothing is encoded without a subscriber.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.config import Deployment
from handtouch.core.events import Event, encode_calibration, encode_event
from handtouch.core.slab import Cycle, Slab
from handtouch.core.stages.frames import ContactTransforms
from handtouch.core.state import TickState
from handtouch.core.tick import TickProcessor
from handtouch.core.tick_messages import MessageSink

_NO_LIMIT_NS = np.iinfo(np.int64).max


class _Pipeline(Protocol):
    """The part of `Pipeline` that is recorded."""

    state: TickState
    tick: TickProcessor
    cycle: Cycle
    slab: Slab
    transforms: ContactTransforms
    node_state: NDArray[np.uint8]

    @property
    def ticks(self) -> int: ...
    def save_state(self) -> bytes: ...


class TickJournal:
    """Publisher of a pipeline's `tick`, `state` and `config`."""

    def __init__(self, pipeline: _Pipeline, session: int, sink: MessageSink) -> None:
        self._pipeline, self._session, self._sink = pipeline, session, sink
        self._state_seq = self._config_seq = 0  # seq of each topic
        self._published_limits = b""
        self._config: tuple[str, Mapping[str, bytes], Mapping[str, Any]] | None = None

    def retained_messages(self) -> dict[str, Callable[[int], wire.Message | None]]:
        """Return topic -> function that makes its retained message."""
        return {
            "config": lambda now_ns: self._config_message(now_ns, retained=True),
            "state": lambda now_ns: self._state_message(now_ns, retained=True),
        }

    def publish_config(
        self, deployment: Deployment, files: Mapping[str, bytes], build: Mapping[str, Any], now_ns: int
    ) -> None:
        """Publish the deployment that applies from now on, with its files (path -> bytes) and the build."""
        self._config = deployment.model_dump_json(by_alias=True), files, build
        self._config_seq += 1
        message = self._config_message(now_ns, retained=False)
        if message is not None and self._sink.has_subscriber("config"):
            self._sink.send(message)

    def publish_first_state(self, now_ns: int) -> None:
        """Publish config and state before the tick that the messages `tick` begin with."""
        self._state_seq += 1
        if (config := self._config_message(now_ns, retained=True)) is not None:
            self._sink.send(config)
        self._sink.send(self._state_message(now_ns, retained=False))

    def publish_tick_inputs(
        self, events: Sequence[Event], now_ns: int, until_ns: int, stopped: bool = False
    ) -> None:
        """Publish the inputs of the last tick, or with `stopped` the end of the session."""
        pipeline = self._pipeline
        tick, cycle, slab = pipeline.tick, pipeline.cycle, pipeline.slab
        limits = slab.limits.tobytes()
        changed, self._published_limits = limits != self._published_limits, limits
        self._sink.send(
            wire.TickInputs(
                v=wire.SCHEMA_VERSION,
                session=self._session,
                seq=pipeline.ticks + stopped,
                t_ns=cycle.sync_ns,
                tick=pipeline.ticks,
                previous_sync_ns=cycle.previous_sync_ns,
                now_ns=now_ns,
                cycle_end_ns=None if until_ns == _NO_LIMIT_NS else until_ns,
                stopped=stopped,
                counts=tick.channel_counts.astype("<i8", copy=False).tobytes(),
                arrival_ns=slab.arrival_ns.astype("<i8", copy=False).tobytes(),
                fresh=slab.fresh.tobytes(),
                node_state=pipeline.node_state.tobytes(),
                limits=limits if changed else None,
                events=tuple(map(encode_event, events)),
                joints=pipeline.transforms.recorded_joints(),
                retained=False,
            )
        )

    def _state_message(self, now_ns: int, retained: bool) -> wire.StateSnapshot:
        return wire.StateSnapshot(
            v=wire.SCHEMA_VERSION,
            session=self._session,
            seq=self._state_seq,
            t_ns=now_ns,
            tick=self._pipeline.ticks,
            layout=self._pipeline.state.layout(),
            state=self._pipeline.save_state(),
            calibrations=tuple(map(encode_calibration, self._pipeline.tick.model.calibrations)),
            limits=self._pipeline.slab.limits.tobytes(),
            retained=retained,
        )

    def _config_message(self, now_ns: int, retained: bool) -> wire.Config | None:
        if self._config is None:
            return None
        deployment, files, build = self._config
        return wire.Config(
            v=wire.SCHEMA_VERSION,
            session=self._session,
            seq=self._config_seq,
            t_ns=now_ns,
            deployment=deployment,
            files=dict(files),
            build=dict(build),
            retained=retained,
        )
