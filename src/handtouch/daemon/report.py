"""How the daemon and every pad fare: health and service messages, and the answer to `status`."""

from __future__ import annotations

import gc
import logging
import os
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, fields, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch import __version__, wire
from handtouch.canbus.bus.port import Port
from handtouch.canbus.bus.sync import Sync, summary_us
from handtouch.canbus.nodes.life import NodeState
from handtouch.canbus.nodes.master import Master
from handtouch.config import Deployment
from handtouch.daemon.control import Control
from handtouch.daemon.histogram import StageClock
from handtouch.daemon.logs import Logs
from handtouch.daemon.pipeline import Pipeline
from handtouch.daemon.publisher import Publisher
from handtouch.daemon.security import Gate
from handtouch.daemon.supervisor import Supervisor
from handtouch.supervise.health import explain
from handtouch.wire import PadState

_SECOND_NS = 1_000_000_000
_SERVICE_NS = _SECOND_NS // 2
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
_log = logging.getLogger("handtouch.health")
_loop_log = logging.getLogger("handtouch.loop")

_PAD_OF_NODE = {
    NodeState.OPERATIONAL: PadState.CLEAR,
    NodeState.STALE: PadState.CLEAR,  # the tick sees by itself that no samples come
    NodeState.FAULTED: PadState.FAULTED,
    NodeState.STOPPED: PadState.OFF,
}


class Report:
    """Watches pipeline, master, buses and publisher; `poll` it after every tick.

    It keeps the pipeline's `node_state`: what the tick is to make of each node.
    """

    def __init__(
        self,
        deployment: Deployment,
        pipeline: Pipeline,
        master: Master,
        ports: Mapping[str, Port],
        sync: Sync,
        publisher: Publisher,
        gate: Gate,
        control: Control,
    ) -> None:
        n = pipeline.model.size
        self._deployment = deployment
        self._pipeline = pipeline
        self._master = master
        self._ports = ports
        self._sync = sync
        self._publisher = publisher
        self._gate, self._control = gate, control
        self.listener: Callable[[wire.Health | wire.Service], None] | None = None
        """is given every health and service message, subscribed or not"""
        self.inputs: Callable[[int], dict[str, Any]] = lambda _: {}
        """what came to the inputs endpoint until a time [ns]"""
        self.supervisor: Supervisor | None = None
        self._pads = [(hand.name, pad) for hand in deployment.hands for pad in hand.pads]
        self._names = [(hand, pad.link) for hand, pad in self._pads]
        self._topics = [f"health/{hand}/{link}" for hand, link in self._names]
        self._disabled_by: dict[int, str] = {}
        self._events_before: set[int] = set()
        self._told = np.full(n, PadState.STARTING, dtype=np.uint8)
        self._was_up = np.zeros(n, dtype=np.bool_)
        self._started_ns = time.monotonic_ns()
        self.stages = StageClock(self._started_ns)
        self._second = _Window(self._started_ns, np.zeros(n, dtype=np.int64))
        self._told_this_second = 0  # of all pads, in turn: told together, they would make a tick late
        self._seq: NDArray[np.int64] = np.zeros(n, dtype=np.int64)
        self._services = 0
        self._half_second = _Window(self._started_ns, self._totals())
        self._rate_hz = np.zeros(n)
        self._speeds: dict[str, float] = {}
        self._durations_ns: list[int] = []
        self._tick_us: dict[str, float] = {}

    def ticked(self, from_ns: int, to_ns: int) -> None:
        """A tick took from `from_ns`, its last sample read, to `to_ns`, its messages out."""
        self._durations_ns.append(to_ns - from_ns)
        self.stages.ticked(self._pipeline.cycle.t_ns, self._sync.period_ns, from_ns, to_ns)

    def set_disabled(self, disabled_by: Mapping[int, str]) -> None:
        """Pads that somebody switched off, with the names of who did; they are off at once."""
        if disabled_by != self._disabled_by:
            self._disabled_by = dict(disabled_by)
            self._translate()

    def poll(self, now_ns: int) -> None:
        """Take over the master's view of the nodes; tell what changed, and everything from time to time."""
        events = self._master.take_events()
        if events:
            for event in events:
                hand, link = self._names[event.slot]
                _log.info("%s/%s: %s", hand, link, event, extra={"fields": {"hand": hand, "link": link}})
            self._translate()
            if self.supervisor is not None:
                self.supervisor.note(events, now_ns)
        state = self._pipeline.tick.columns.state
        visible = np.where(state == PadState.TOUCHED, PadState.CLEAR, state)  # contacts have their own topic
        changed = self._events_before | set(np.flatnonzero(visible != self._told).tolist())
        self._events_before = {event.slot for event in events}  # told when a tick has taken them in
        self._told[:] = visible
        if self.supervisor is not None and self.supervisor.changed:
            changed |= self.supervisor.changed
            self.supervisor.changed.clear()
        for pad in sorted(changed.union(self._due(now_ns))):
            self._seq[pad] += 1
            self._tell(self._topics[pad], partial(self._health, pad, now_ns))
        if now_ns - self._half_second.since_ns >= _SERVICE_NS:
            rates = self._half_second.per_second(now_ns, self._totals())
            self._speeds = dict(zip(["ticks", *_of_buses(self._ports)], rates.tolist(), strict=True))
            self._tick_us = summary_us(np.array(self._durations_ns, dtype=np.int64))
            if late := self.stages.take_late():
                parts = (f"{name} {count} (up to {most_ns * 1e-6:.1f} ms)" for name, count, most_ns in late)
                about = {"fields": {"part": late[0][0]}}
                _loop_log.warning("late ticks, by what took the time: %s", ", ".join(parts), extra=about)
            self._durations_ns.clear()
            self._services += 1
            self._tell("service", partial(self._service, now_ns))

    def present(self) -> dict[str, Callable[[int], wire.Outgoing | None]]:
        """Topic -> what there is to repeat of it, at a time [ns]."""
        pads = {topic: partial(self._last_health, pad) for pad, topic in enumerate(self._topics)}
        return {**pads, "service": self._last_service}

    def status(self) -> dict[str, Any]:
        """Everything about the daemon and every pad, for the control endpoint."""
        now_ns = time.monotonic_ns()
        pads = (replace(self._health(pad, now_ns), seq=0) for pad in range(len(self._pads)))
        return {
            "service": _plain(replace(self._service(now_ns), seq=0)),
            "pads": [_plain(health) for health in pads],
        }

    def summary(self) -> str:
        """How the hands fare, in a line."""
        states = self._master.states
        up = int(np.count_nonzero((states == NodeState.OPERATIONAL) | (states == NodeState.STOPPED)))
        hands = ", ".join(hand.name for hand in self._deployment.hands)
        return f"{hands}: {up} of {len(self._pads)} nodes up, {self._speeds.get('ticks', 0.0):.0f} ticks/s"

    def _due(self, now_ns: int) -> range:
        """Pads whose turn it is to be told: each once a second."""
        passed_ns, first = now_ns - self._second.since_ns, self._told_this_second
        self._told_this_second = min(len(self._pads), len(self._pads) * passed_ns // _SECOND_NS)
        due = range(first, self._told_this_second)
        if passed_ns >= _SECOND_NS:
            self._rate_hz = self._second.per_second(now_ns, self._pipeline.tick.samples)
            self._told_this_second = 0
        return due

    def _tell(self, topic: str, make: Callable[[], wire.Health | wire.Service]) -> None:
        """Make a message only if it is of use to anybody."""
        wanted = self._publisher.wants(topic)
        if wanted or self.listener is not None:
            message = make()
            if self.listener is not None:
                self.listener(message)
            if wanted:
                self._publisher.send(message)

    def _last_health(self, pad: int, now_ns: int) -> wire.Health | None:
        return replace(self._health(pad, now_ns), repeat=True) if self._seq[pad] else None

    def _last_service(self, now_ns: int) -> wire.Service | None:
        return replace(self._service(now_ns), repeat=True) if self._services else None

    def _translate(self) -> None:
        """From node states to what the tick makes of them; a node that was up and is absent is lost."""
        for slot, state in enumerate(map(NodeState, self._master.states.tolist())):
            self._was_up[slot] |= state == NodeState.OPERATIONAL
            missing = PadState.LOST if self._was_up[slot] else PadState.STARTING
            self._pipeline.node_state[slot] = (
                missing if state == NodeState.ABSENT else _PAD_OF_NODE.get(state, PadState.STARTING)
            )
        self._pipeline.node_state[list(self._disabled_by)] = PadState.OFF

    def _health(self, pad: int, now_ns: int) -> wire.Health:
        hand, settings = self._pads[pad]
        status = self._master.status_of(pad)
        columns = self._pipeline.tick.columns
        sample_ns = int(columns.sample_ns[pad])
        state = PadState(int(columns.state[pad]))
        counts = self._pipeline.tick.counts[pad]
        railed = self._pipeline.slab.railed(self._pipeline.tick.counts)[pad]
        return wire.Health(
            v=wire.SCHEMA_VERSION,
            run=self._publisher.run,
            seq=int(self._seq[pad]),
            t_ns=now_ns,
            hand=hand,
            link=settings.link,
            bus=settings.bus,
            node_id=settings.node_id,
            state=state.name.lower(),
            node=status.state.name.lower(),
            since_ns=status.since_ns,
            pace="off" if state == PadState.OFF else "event" if status.idle else "sync",
            reason=self._why_disabled(pad) or explain(state, status.state, status.reason, counts, railed),
            serial=status.serial,
            rate_hz=float(self._rate_hz[pad]) if state <= PadState.TOUCHED else 0.0,
            samples=int(self._pipeline.tick.samples[pad]),
            missed=int(self._pipeline.tick.missed[pad]),
            age_s=(now_ns - sample_ns) * 1e-9 if sample_ns else None,
            reboots=status.reboots,
            heartbeats_missed=status.heartbeats_missed,
            emergencies=tuple(str(emergency) for emergency in status.emergencies),
            repeat=False,
            **(self.supervisor.told(pad) if self.supervisor is not None else {}),
        )

    def _why_disabled(self, pad: int) -> str:
        by = self._disabled_by.get(pad)
        return f"disabled by {by}; `handtouch enable` switches it on" if by else ""

    def _service(self, now_ns: int) -> wire.Service:
        bit_rates = {bus.name: bus.bitrate_bit_s for bus in self._deployment.buses}
        return wire.Service(
            v=wire.SCHEMA_VERSION,
            run=self._publisher.run,
            seq=self._services,
            t_ns=now_ns,
            wall_offset_ns=time.time_ns() - time.monotonic_ns(),
            version=__version__,
            pid=os.getpid(),
            uptime_s=(now_ns - self._started_ns) * 1e-9,
            period_s=self._deployment.daemon.sync_period_ms * 1e-3,
            hands={hand.name: [pad.link for pad in hand.pads] for hand in self._deployment.hands},
            ticks=self._pipeline.ticks,
            overruns=self._sync.overruns,
            rate_hz=self._speeds.get("ticks", 0.0),
            tick_us=self._tick_us,
            loop=self.stages.figures(),
            contacts=self._pipeline.tick.contacts.begun,
            refused={**self._gate.refused, "request": self._control.refused},
            process=_process(),
            buses={
                name: {
                    "load": self._speeds.get(f"{name} bits", 0.0) / bit_rates[name],
                    "lost_hz": self._speeds.get(f"{name} lost", 0.0),
                    **port.state.figures(),
                    "sync": self._sync.figures(name, now_ns),
                    **asdict(port.counters),
                }
                for name, port in self._ports.items()
            },
            drops=dict(self._publisher.drops),
            subscriptions=tuple(
                sorted(prefix.decode("utf-8", "replace") for prefix in self._publisher.subscriptions)
            ),
            repeat=False,
            supervisor=self.supervisor.figures() if self.supervisor is not None else None,
            inputs=self.inputs(now_ns),
        )

    def _totals(self) -> NDArray[np.int64]:
        counters = [port.counters for port in self._ports.values()]
        return np.array(
            [self._pipeline.ticks, *(n for bus in counters for n in (bus.bits, bus.overflow))], dtype=np.int64
        )


def _of_buses(names: Iterable[str]) -> list[str]:
    return [f"{name} {what}" for name in names for what in ("bits", "lost")]


class _Window:
    """Rates of counters that only grow, over the time since the last look."""

    def __init__(self, since_ns: int, totals: NDArray[np.int64]) -> None:
        self.since_ns = since_ns
        self._totals = totals

    def per_second(self, now_ns: int, totals: NDArray[np.int64]) -> NDArray[np.float64]:
        rates = (totals - self._totals).astype(np.float64) * (_SECOND_NS / max(1, now_ns - self.since_ns))
        self.since_ns, self._totals = now_ns, totals.copy()
        return rates


def _plain(message: wire.Health | wire.Service) -> dict[str, Any]:
    """Fields by name, not copied as `asdict` does: that takes the loop milliseconds."""
    return {field.name: getattr(message, field.name) for field in fields(message)}


def _process() -> dict[str, Any]:
    """What this process takes of the machine. Called by the loop's own thread."""
    with open("/proc/self/statm", "rb") as statm:
        resident_pages = int(statm.read().split()[1])
    logs = next((handler for handler in logging.getLogger().handlers if isinstance(handler, Logs)), None)
    return {
        "memory_bytes": resident_pages * _PAGE_BYTES,
        "cpu_s": time.process_time(),
        "loop_cpu_s": time.thread_time(),
        "collections": [generation["collections"] for generation in gc.get_stats()],
        "log_dropped": logs.dropped if logs else 0,
        "log_silenced": logs.silenced if logs else 0,
    }
