"""Recording of ticks: publish the inputs of each tick, so that a replay repeats it bit for bit.

Public name: `TickJournal`.

Whatever changes the state between two ticks, other than what `wire.TickInputs` holds, sets
`tick.state_changed`; the whole state is published then. Nothing is encoded without a subscriber.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.config import Deployment
from handtouch.core import state
from handtouch.core.cycle import Cycle
from handtouch.core.slab import Slab
from handtouch.core.tick import TickProcessor
from handtouch.core.tick_messages import MessageSink

_NO_LIMIT_NS = np.iinfo(np.int64).max


class _Pipeline(Protocol):
    """The part of `Pipeline` that is recorded."""

    tick: TickProcessor
    cycle: Cycle
    slab: Slab
    node_state: NDArray[np.uint8]
    ticks: int


class TickJournal:
    """Publisher of a pipeline's `tick`, `state` and `config`.

    `extra_inputs`: name -> further inputs of a tick as msgpack values, empty if there are none.
    """

    def __init__(
        self,
        pipeline: _Pipeline,
        session: int,
        sink: MessageSink,
        extra_inputs: Mapping[str, Callable[[], Any]],
    ) -> None:
        self._pipeline, self._session, self._sink = pipeline, session, sink
        self._extra_inputs = dict(extra_inputs)
        self._tick_seq = self._state_seq = self._config_seq = 0  # seq of each topic
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
            self._sink.send(message)

    def publish_changed_state(self, now_ns: int) -> None:
        """Publish the state if something other than a tick changed it, before samples of the next one."""
        tick = self._pipeline.tick
        if tick.state_changed:
            tick.state_changed = False
            self._state_seq += 1
            if self._sink.has_subscriber("state"):
                self._sink.send(self._state_message(now_ns, retained=False))

    def publish_tick_inputs(self, now_ns: int, until_ns: int, stopped: bool = False) -> None:
        """Publish the inputs of the last tick."""
        self._tick_seq += 1
        if not self._sink.has_subscriber("tick"):
            return
        pipeline = self._pipeline
        tick, cycle, slab = pipeline.tick, pipeline.cycle, pipeline.slab
        limits = slab.limits.tobytes()
        changed, self._published_limits = limits != self._published_limits, limits
        self._sink.send(
            wire.TickInputs(
                v=wire.SCHEMA_VERSION,
                session=self._session,
                seq=self._tick_seq,
                t_ns=cycle.sync_ns,
                tick=pipeline.ticks,
                previous_sync_ns=cycle.previous_sync_ns,
                now_ns=now_ns,
                cycle_end_ns=None if until_ns == _NO_LIMIT_NS else until_ns,
                stopped=stopped,
                counts=tick.counts.astype("<i8", copy=False).tobytes(),
                arrival_ns=slab.arrival_ns.astype("<i8", copy=False).tobytes(),
                fresh=slab.fresh.tobytes(),
                node_state=pipeline.node_state.tobytes(),
                synchronous=tick.synchronous.tobytes(),
                period_ns=tick.max_sample_period_ns.astype("<i8", copy=False).tobytes(),
                period_since_ns=tick.period_since_ns.astype("<i8", copy=False).tobytes(),
                limits=limits if changed else None,
                extra_inputs={name: value for name, read in self._extra_inputs.items() if (value := read())},
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
            state=state.pack(state.save(self._pipeline)),
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
