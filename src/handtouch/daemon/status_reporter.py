"""Status of the daemon and its pads: health and service messages, and the reply to `status`.

Public names: `StatusReporter`, `Buses`, `Statistics`, `Workers`.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, fields, replace
from functools import cache, partial
from operator import attrgetter
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from handtouch import __version__, wire
from handtouch.canbus.bus.bus_state import ErrorState
from handtouch.canbus.bus.port import Port
from handtouch.canbus.bus.sync import Sync, percentiles_us
from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.canbus.nodes.master import Master
from handtouch.canbus.nodes.spec import ErrorChanged, MasterEvent, NodeEvent
from handtouch.config import Deployment
from handtouch.core.compiled import Compilation
from handtouch.core.pipeline import Pipeline
from handtouch.core.stages.rows import SHEAR_CHANNELS
from handtouch.daemon.pad_reports import LawReport, NoiseReport, explain_pad_state
from handtouch.daemon.percept_client import PerceptClient
from handtouch.daemon.publisher import Publisher
from handtouch.daemon.shear_channels import ShearChannels
from handtouch.daemon.stage_timer import StageTimer
from handtouch.daemon.supervisor_client import SupervisorClient
from handtouch.wire import (
    AdaptationStatusName,
    NodeStateName,
    PadState,
    SecondSheetStatusName,
    ShearStatusName,
)

_SECOND_NS = 1_000_000_000
_MAX_SUBSCRIPTIONS = 100  # in `service`
_HEALTH_PERIOD_NS = round(wire.HEALTH.period_s * _SECOND_NS)
_SERVICE_PERIOD_NS = round(wire.SERVICE.period_s * _SECOND_NS)
_log = logging.getLogger("handtouch.health")
_loop_log = logging.getLogger("handtouch.loop")
_bus_log = logging.getLogger("handtouch.bus")

_HEALTH_FIELDS, _SERVICE_FIELDS = (
    (names := [field.name for field in fields(kind)], attrgetter(*names))
    for kind in (wire.Health, wire.Service)
)
_MAX_NODES_NAMED = 3
"""Nodes of one event that a line of the log names; of more the first and the last"""
_WITHOUT_DIGITS = str.maketrans("", "", "0123456789")
_BUS_LEVELS = {
    ErrorState.WARNING: logging.WARNING,
    ErrorState.PASSIVE: logging.WARNING,
    ErrorState.BUS_OFF: logging.ERROR,
    ErrorState.DOWN: logging.ERROR,
}

_PAD_STATE_OF_NODE_STATE = {
    NodeState.OPERATIONAL: PadState.CLEAR,
    NodeState.STALE: PadState.CLEAR,  # the tick detects missing samples itself
    NodeState.FAULTED: PadState.FAULTED,
    NodeState.STOPPED: PadState.OFF,
}


class Buses(NamedTuple):
    """Master of all buses, and their ports by name."""

    master: Master
    ports: Mapping[str, Port]
    sync: Sync


class Statistics(NamedTuple):
    """Functions that return numbers from elsewhere in the daemon."""

    wall_offset_ns: Callable[[], int]
    """difference of wall clock and monotonic clock"""
    process: Callable[[], dict[str, Any]]
    """resource usage of this process"""
    refusals: Callable[[], Mapping[str, int]]
    """refused connections and requests by cause"""
    inputs: Callable[[int], dict[str, Any]]
    """counters of the inputs endpoint at a time [ns]"""


class Workers(NamedTuple):
    """Processes beside the daemon's, where they are configured."""

    supervisor: SupervisorClient | None = None
    percepts: PerceptClient | None = None


class StatusReporter:
    """Reports on pipeline, master, buses and publisher; `poll` it after every tick.

    It also maintains the pipeline's `node_state`, the pad state that follows from each node's state.
    `on_message` gets every message, subscribed or not.
    """

    def __init__(
        self,
        deployment: Deployment,
        pipeline: Pipeline,
        buses: Buses,
        publisher: Publisher,
        *,
        started_ns: int,
        statistics: Statistics,
        workers: Workers,
        on_message: Callable[[wire.Health | wire.Service], None] | None = None,
    ) -> None:
        n = pipeline.model.size
        self._deployment = deployment
        self._pipeline = pipeline
        self._master, self._ports, self._sync = buses
        self._publisher = publisher
        self._statistics = statistics
        self.supervisor, self.percepts = workers
        self._on_message = on_message
        self._pads = deployment.pads
        self._names = [(hand, pad.link) for hand, pad in self._pads]
        self._topics = [f"health/{hand}/{link}" for hand, link in self._names]
        self._disabled_by: dict[int, str] = {}
        self._previous_event_pads: set[int] = set()
        self._published_state = np.full(n, PadState.STARTING, dtype=np.uint8)
        self._was_up = np.zeros(n, dtype=np.bool_)
        self._started_ns = started_ns
        self.stage_timer = StageTimer(self._started_ns)
        self._sample_rate_window = _RateWindow(self._started_ns, np.zeros(n, dtype=np.int64))
        self._published_this_period = 0  # pads are published in turn, as all at once would delay a tick
        self._seq: NDArray[np.int64] = np.zeros(n, dtype=np.int64)
        self._core_compiled = Compilation.current().compiled
        self._service_seq = 0
        self._published_frame_period_ns = 0
        self._service_window = _RateWindow(self._started_ns, self._totals())
        self._sample_rate_hz = np.zeros(n)
        self._rates_hz: dict[str, float] = {}
        self._rejected_adaptation = np.zeros(n, dtype=np.bool_)
        self._shear_channels = ShearChannels()
        self._second_sheet: dict[int, SecondSheetStatusName] = {}
        """status of pads' second sheets under the last touch"""
        self._noise, self._law = NoiseReport(len(self._pads)), LawReport(len(self._pads))
        self._tick_durations_ns: list[int] = []
        self._tick_us: dict[str, float] = {}
        self._logged_problems = dict.fromkeys(buses.ports, "")  # last problem of each bus, without digits

    def record_tick(self, from_ns: int, to_ns: int, due_periods: int = 1) -> None:
        """Record a tick: last sample read at `from_ns`, messages sent at `to_ns`, due so many periods after
        its SYNC."""
        self._tick_durations_ns.append(to_ns - from_ns)
        due_ns = due_periods * self._sync.period_ns
        self.stage_timer.record_tick(self._pipeline.cycle.sync_ns, due_ns, from_ns, to_ns)

    def set_disabled(self, disabled_by: Mapping[int, str]) -> None:
        """Set the disabled pads and the names of the clients that disabled them; takes effect at once."""
        if disabled_by != self._disabled_by:
            self._disabled_by = dict(disabled_by)
            self._update_node_states()

    def poll(self, now_ns: int) -> None:
        """Copy node states from the master; publish changes at once and every pad once a second."""
        self._log_bus_transitions()
        events = self._master.drain_events()
        if events:
            self._log_events(events)
            self._update_node_states()
            if self.supervisor is not None:
                changes = [event for event in events if not isinstance(event, ErrorChanged)]
                self.supervisor.handle_node_events(changes, now_ns)
        state = self._pipeline.tick.columns.state
        visible = np.where(state == PadState.TOUCHED, PadState.CLEAR, state)  # contacts have their own topic
        changed = self._previous_event_pads | set(np.flatnonzero(visible != self._published_state).tolist())
        self._previous_event_pads = {event.slot for event in events}  # published once a tick has applied them
        self._published_state[:] = visible
        if self.supervisor is not None and self.supervisor.changed_pads:
            changed |= self.supervisor.changed_pads
            self.supervisor.changed_pads.clear()
        if due := sorted(changed.union(self._pads_due(now_ns))):
            self._seq[due] += 1
            columns = cache(self._read_columns)  # read once, and only for a message that is made

            def make(pad: int) -> wire.Health:
                return self._make_health(pad, columns(), now_ns)

            for pad in due:
                self._publish(self._topics[pad], partial(make, pad))
        if now_ns - self._service_window.since_ns >= _SERVICE_PERIOD_NS:
            rates = self._service_window.per_second(now_ns, self._totals())
            self._rates_hz = dict(
                zip(["ticks", *_bus_counter_names(self._ports)], rates.tolist(), strict=True)
            )
            self._tick_us = percentiles_us(np.array(self._tick_durations_ns, dtype=np.int64))
            if late := self.stage_timer.take_late_ticks():
                parts = (f"{name} {count} (up to {max_ns * 1e-6:.1f} ms)" for name, count, max_ns in late)
                about = {"fields": {"part": late[0][0]}}
                _loop_log.warning("late ticks by longest part: %s", ", ".join(parts), extra=about)
            self._tick_durations_ns.clear()
            self._log_bus_problems()
            self._log_rejected_adaptation()
            self._publish_service(now_ns)
        elif self._frame_period_ns() > self._published_frame_period_ns:
            self._publish_service(now_ns)  # before clients take the next frame for late

    def _publish_service(self, now_ns: int) -> None:
        self._service_seq += 1
        self._published_frame_period_ns = self._frame_period_ns()
        self._publish("service", partial(self._make_service, now_ns))

    def _frame_period_ns(self) -> int:
        return self._sync.period_ns * int(self._pipeline.state.ticks_per_hand_frame[0])

    def publish_stopping(self, now_ns: int) -> None:
        """Publish the last `service` message of the session."""
        self._service_seq += 1
        self._publish("service", lambda: replace(self._make_service(now_ns), stopping=True))

    def retained_messages(self) -> dict[str, Callable[[int], wire.OutgoingMessage | None]]:
        """Return, by topic, functions that make the retained message at a time [ns]."""
        pads = {topic: partial(self._retained_health, pad) for pad, topic in enumerate(self._topics)}
        return {**pads, "service": self._retained_service}

    def status(self, now_ns: int) -> dict[str, Any]:
        """Return service and health of all pads, for the control endpoint."""
        columns = self._read_columns()
        pads = (self._make_health(pad, columns, now_ns) for pad in range(len(self._pads)))
        return {
            "service": {**_message_fields(self._make_service(now_ns)), "seq": 0},
            "pads": [{**_message_fields(health), "seq": 0} for health in pads],
        }

    def summary(self) -> str:
        """Return a one-line summary for systemd."""
        states = self._master.states
        up = int(np.count_nonzero((states == NodeState.OPERATIONAL) | (states == NodeState.STOPPED)))
        hands = ", ".join(hand.name for hand in self._deployment.hands)
        return f"{hands}: {up} of {len(self._pads)} nodes up, {self._rates_hz.get('ticks', 0.0):.0f} ticks/s"

    def _log_events(self, events: Iterable[MasterEvent]) -> None:
        """Log events, in one line those of several nodes that differ in their numbers only."""
        alike: dict[tuple[int, str, str], list[MasterEvent]] = {}
        for event in events:
            text = str(event).translate(_WITHOUT_DIGITS)
            alike.setdefault((*_level_and_state(event), text), []).append(event)
        for (level, state, _), group in alike.items():
            names = [self._names[event.slot] for event in group]
            pads = {
                "hand": list(dict.fromkeys(hand for hand, _ in names)),
                "link": [link for _, link in names],
            }
            nodes = [
                f"0x{self._pads[event.slot][1].node_id:02X} ({hand}/{link})"
                for event, (hand, link) in zip(group, names, strict=True)
            ]
            if len(nodes) > _MAX_NODES_NAMED and level < logging.WARNING:
                nodes[1:-1] = ["..."]  # of warnings and errors, all nodes are named
            _log.log(
                level,
                "%s %s: %s",
                "node" if len(group) == 1 else f"{len(group)} nodes",
                ", ".join(nodes),
                group[0],
                extra={"fields": pads, "state": state},
            )

    def _log_rejected_adaptation(self) -> None:
        rejected = self._pipeline.tick.sheet_force.adaptation_rejected
        for pad in np.flatnonzero(rejected != self._rejected_adaptation).tolist():
            hand, link = self._names[pad]
            text = (
                "adaptation of its sheet is not compensated: steady holds drift less without; "
                "if other pads with this sheet show the same, set adaptation_share = 0"
                if rejected[pad]
                else "adaptation of its sheet is compensated again"
            )
            _log.info("%s/%s: %s", hand, link, text, extra={"fields": {"hand": hand, "link": link}})
        self._rejected_adaptation = rejected

    def _log_bus_transitions(self) -> None:
        for name, port in self._ports.items():
            for change in port.bus_state.drain_transitions():
                text = f"{change.old.value} -> {change.new.value}"
                if change.new is ErrorState.ACTIVE:
                    text += f" after {change.lasted_ns * 1e-9:.1f} s"
                self._log_bus_state(name, change.new, text, change.problem)

    def _log_bus_problems(self) -> None:
        """Log problems that have changed while the state hasn't."""
        for name, port in self._ports.items():
            state, problem = port.bus_state.error_state, port.bus_state.problem
            if problem.translate(_WITHOUT_DIGITS) != self._logged_problems[name]:
                self._log_bus_state(name, state, state.value, problem)

    def _log_bus_state(self, name: str, state: ErrorState, text: str, problem: str) -> None:
        self._logged_problems[name] = problem.translate(_WITHOUT_DIGITS)
        level = _BUS_LEVELS.get(state, logging.WARNING if problem else logging.INFO)
        extra = {"fields": {"bus": name}, "state": f"{state.value} {self._logged_problems[name]}"}
        _bus_log.log(level, "bus %s: %s", name, f"{text}: {problem}" if problem else text, extra=extra)

    def _pads_due(self, now_ns: int) -> range:
        """Return the pads due to be published: each once a period, spread over the period."""
        passed_ns, first = now_ns - self._sample_rate_window.since_ns, self._published_this_period
        self._published_this_period = min(len(self._pads), len(self._pads) * passed_ns // _HEALTH_PERIOD_NS)
        due = range(first, self._published_this_period)
        if passed_ns >= _HEALTH_PERIOD_NS:
            self._sample_rate_hz = self._sample_rate_window.per_second(
                now_ns, self._pipeline.tick.state.sample_counts
            )
            self._published_this_period = 0
        return due

    def _publish(self, topic: str, make: Callable[[], wire.Health | wire.Service]) -> None:
        """Make and send a message if its topic has a subscriber or `on_message` is set."""
        subscribed = self._publisher.has_subscriber(topic)
        if subscribed or self._on_message is not None:
            message = make()
            if self._on_message is not None:
                self._on_message(message)
            if subscribed:
                self._publisher.send(message)

    def _retained_health(self, pad: int, now_ns: int) -> wire.Health | None:
        if not self._seq[pad]:
            return None
        return replace(self._make_health(pad, self._read_columns(), now_ns), retained=True)

    def _retained_service(self, now_ns: int) -> wire.Service | None:
        return replace(self._make_service(now_ns), retained=True) if self._service_seq else None

    def _update_node_states(self) -> None:
        """Map node states to pad states; an absent node is lost if it was operational before."""
        for slot, state in enumerate(map(NodeState, self._master.states.tolist())):
            self._was_up[slot] |= state == NodeState.OPERATIONAL
            missing = PadState.LOST if self._was_up[slot] else PadState.STARTING
            self._pipeline.node_state[slot] = (
                missing
                if state == NodeState.ABSENT
                else _PAD_STATE_OF_NODE_STATE.get(state, PadState.STARTING)
            )
        self._pipeline.node_state[list(self._disabled_by)] = PadState.OFF

    def _read_columns(self) -> _PadColumns:
        pipeline, tick = self._pipeline, self._pipeline.tick
        return _PadColumns(
            seq=self._seq.tolist(),
            state=tick.columns.state.tolist(),
            sample_ns=tick.columns.sample_ns.tolist(),
            samples=tick.state.sample_counts.tolist(),
            missed_samples=tick.state.missed_sample_counts.tolist(),
            rate_hz=self._sample_rate_hz.tolist(),
            modelled=tick.sheet_force.modelled.tolist(),
            railed=pipeline.slab.saturated(tick.channel_counts),
            zeros_known=tick.state.known.tolist(),
            noisy=self._noise.find(tick),
        )

    def _make_health(self, pad: int, columns: _PadColumns, now_ns: int) -> wire.Health:
        hand, settings = self._pads[pad]
        status = self._master.node_status(pad)
        sample_ns, state = columns.sample_ns[pad], PadState(columns.state[pad])
        counts = self._pipeline.tick.counts[pad]
        assessment = self.supervisor.health_fields(pad) if self.supervisor is not None else {}
        noise = self._noise.update(self._pipeline.tick, pad, settings.node, now_ns, noisy=columns.noisy[pad])
        law = self._law.update(self._pipeline.tick.sheet_force, pad, now_ns)
        found = tuple(one.to_map() for one in (noise, law) if one is not None)
        if found:
            assessment["diagnoses"] = (*assessment.get("diagnoses", ()), *found)
        return wire.Health(
            v=wire.SCHEMA_VERSION,
            session=self._publisher.session,
            seq=columns.seq[pad],
            t_ns=now_ns,
            hand=hand,
            link=settings.link,
            bus=settings.bus,
            node_id=settings.node_id,
            state=state.text,
            node_state=cast(NodeStateName, status.state.name.lower()),
            node_state_since_ns=status.since_ns,
            sampling="off" if state == PadState.OFF else "event" if status.idle else "sync",
            reason=self._disabled_reason(pad)
            or explain_pad_state(
                state,
                status.state,
                status.reason,
                settings.electrode_names,
                counts,
                columns.railed[pad, : len(counts)],
                zeros_known=columns.zeros_known[pad],
            ),
            serial=status.serial,
            rate_hz=columns.rate_hz[pad] if state <= PadState.TOUCHED else 0.0,
            samples=columns.samples[pad],
            missed_samples=columns.missed_samples[pad],
            age_s=(now_ns - sample_ns) * 1e-9 if sample_ns else None,
            reboots=status.reboots,
            heartbeats_missed=status.heartbeats_missed,
            emergencies=tuple(emergency.to_map() for emergency in status.emergencies),
            retained=False,
            error_register=status.error_register,
            error_history=status.error_history,
            adaptation_status=self._adaptation_status(pad) if columns.modelled[pad] else "",
            shear_status=self._shear_status(pad, touched=state == PadState.TOUCHED),
            second_sheet_status=self._second_sheet_status(pad, touched=state == PadState.TOUCHED),
            **assessment,
        )

    def _second_sheet_status(self, pad: int, *, touched: bool) -> SecondSheetStatusName:
        """Return the status of a pad's second sheet; what only touches show is kept until the next touch."""
        tick = self._pipeline.tick
        if not tick.second.has_second(pad):
            return ""
        counts = tick.channel_counts
        status = tick.second.find_status(pad, counts, self._pipeline.slab.saturated(counts))
        if not touched and status == "operational":
            return self._second_sheet.get(pad, "operational")
        if touched:
            self._second_sheet[pad] = status
        return status

    def _adaptation_status(self, pad: int) -> AdaptationStatusName:
        return "rejected" if self._rejected_adaptation[pad] else "compensated"

    def _shear_status(self, pad: int, *, touched: bool) -> ShearStatusName:
        tick = self._pipeline.tick
        sample_ns = int(tick.columns.sample_ns[pad])
        for shear in tick.model.shear_pads:
            if shear.pad == pad:
                columns = slice(shear.column, shear.column + SHEAR_CHANNELS)
                counts = tick.channel_counts[pad, columns]
                saturated = self._pipeline.slab.saturated(tick.channel_counts)[pad, columns]
                noise, known = float(tick.model.noise_counts[pad]), tick.shear.rest_known(pad)
                return self._shear_channels.update(
                    pad, sample_ns, counts, saturated, noise, touched=touched, rest_known=known
                )
        return ""

    def _disabled_reason(self, pad: int) -> str:
        by = self._disabled_by.get(pad)
        return f"disabled by {by}; switch it on with `handtouch enable`" if by else ""

    def _make_service(self, now_ns: int) -> wire.Service:
        bit_rates = {bus.name: bus.bitrate_bit_s for bus in self._deployment.buses}
        return wire.Service(
            v=wire.SCHEMA_VERSION,
            session=self._publisher.session,
            seq=self._service_seq,
            t_ns=now_ns,
            wall_offset_ns=self._statistics.wall_offset_ns(),
            version=__version__,
            pid=os.getpid(),
            uptime_s=(now_ns - self._started_ns) * 1e-9,
            period_s=self._deployment.daemon.sync_period_ms * 1e-3,
            hands=self._deployment.links_by_hand,
            ticks=self._pipeline.ticks,
            overruns=self._sync.overruns,
            rate_hz=self._rates_hz.get("ticks", 0.0),
            core_compiled=self._core_compiled,
            tick_us=self._tick_us,
            loop=self.stage_timer.statistics(),
            contacts=self._pipeline.tick.contacts.begun_count,
            rejected=dict(self._statistics.refusals()),
            process=self._statistics.process(),
            buses={
                name: {
                    "load": self._rates_hz.get(f"{name} bits", 0.0) / bit_rates[name],
                    "lost_hz": self._rates_hz.get(f"{name} lost", 0.0),
                    **port.bus_state.report(),
                    "sync": self._sync.report(name, now_ns),
                    **asdict(port.counters),
                }
                for name, port in self._ports.items()
            },
            congestion_episodes=dict(self._publisher.congestion_episodes),
            subscriptions=tuple(
                sorted(prefix.decode("utf-8", "replace") for prefix in self._publisher.subscriptions)
            )[:_MAX_SUBSCRIPTIONS],
            retained=False,
            supervisor=self.supervisor.statistics() if self.supervisor is not None else None,
            percepts=self.percepts.statistics() if self.percepts is not None else None,
            inputs=self._statistics.inputs(now_ns),
            frame_period_s=self._frame_period_ns() * 1e-9,
        )

    def _totals(self) -> NDArray[np.int64]:
        counters = [port.counters for port in self._ports.values()]
        return np.array(
            [self._pipeline.ticks, *(n for bus in counters for n in (bus.bits, bus.overflow))], dtype=np.int64
        )


def _level_and_state(event: MasterEvent) -> tuple[int, str]:
    """Return the level of an event in the log, and the state that limits how often it is logged."""
    if isinstance(event, NodeEvent):
        return _event_level(event), f"{event.new_state.name} {event.reason.translate(_WITHOUT_DIGITS)}"
    if isinstance(event, ErrorChanged):
        cleared = event.emergency.cleared_ns is not None
        state = f"EMCY 0x{event.emergency.code:04X}{' cleared' if cleared else ''}"
        return logging.INFO if cleared else logging.WARNING, state
    return logging.WARNING, "node replaced"


def _event_level(event: NodeEvent) -> int:
    """Return the log level of a node event: errors for faults, warnings for a node that ceases to run."""
    if event.new_state == NodeState.FAULTED:
        return logging.ERROR
    lost = event.new_state == NodeState.ABSENT and event.old_state != NodeState.ABSENT
    was_running = event.old_state in (NodeState.OPERATIONAL, NodeState.STALE)
    restarted = was_running and event.new_state == NodeState.BOOTING
    return logging.WARNING if lost or restarted or event.new_state == NodeState.STALE else logging.INFO


def _bus_counter_names(names: Iterable[str]) -> list[str]:
    return [f"{name} {counter}" for name in names for counter in ("bits", "lost")]


class _PadColumns(NamedTuple):
    """What `health` tells of the pads, read at once: a tenth of the time of reading each pad's values."""

    seq: list[int]
    state: list[int]
    sample_ns: list[int]
    samples: list[int]
    missed_samples: list[int]
    rate_hz: list[float]
    modelled: list[bool]
    railed: NDArray[np.bool_]
    zeros_known: list[bool]
    noisy: list[bool]


class _RateWindow:
    """Rates of increasing counters over the time since the last call."""

    def __init__(self, since_ns: int, totals: NDArray[np.int64]) -> None:
        self.since_ns = since_ns
        self._totals = totals

    def per_second(self, now_ns: int, totals: NDArray[np.int64]) -> NDArray[np.float64]:
        rates = (totals - self._totals).astype(np.float64) * (_SECOND_NS / max(1, now_ns - self.since_ns))
        self.since_ns, self._totals = now_ns, totals.copy()
        return rates


def _message_fields(message: wire.Health | wire.Service) -> dict[str, Any]:
    """Return the fields by name without the deep copies of `asdict`, which take milliseconds."""
    names, values = _HEALTH_FIELDS if isinstance(message, wire.Health) else _SERVICE_FIELDS
    return dict(zip(names, values(message), strict=True))
