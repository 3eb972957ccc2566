"""CANopen master of a hand's nodes: boots, supervises and recovers each of them.

Public name: `Master`. One thread receives and calls `handle_frame` and `poll`; steps that wait for a node's
response run in worker threads, so that a silent node doesn't delay the others. Nodes are addressed one by
one, never by a broadcast.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from handtouch.canbus import cia301
from handtouch.canbus.bus.port import Port
from handtouch.canbus.bus.router import NO_SLOT
from handtouch.canbus.nodes import boot
from handtouch.canbus.nodes.bus_cause import BusCauses
from handtouch.canbus.nodes.lifecycle import advance, due_ns, is_supervised
from handtouch.canbus.nodes.lifecycle_types import (
    BootUpReceived,
    BusRecovered,
    BusRole,
    ErrorsReported,
    ForeignNmtCommand,
    HeartbeatRate,
    HeartbeatReceived,
    IdentifierClash,
    LifecycleEvent,
    LoopPaused,
    NodeAction,
    NodeState,
    ProbeAnswered,
    SampleReceived,
    SamplesMissing,
    StandbyRequested,
    StepFailed,
    StopRequested,
    TimerExpired,
)
from handtouch.canbus.nodes.managed_node import (
    NMT_COMMAND,
    NMT_COMMANDS,
    UNKNOWN_SENDER,
    ManagedNode,
    StepOutcome,
    StepResult,
    find_owners,
    make_managed_node,
    run_step,
    send_nmt,
)
from handtouch.canbus.nodes.sample_rates import SampleRates
from handtouch.canbus.nodes.spec import (
    ErrorChanged,
    Identity,
    MasterEvent,
    NodeEvent,
    NodeSpec,
    NodeStatus,
    SerialChanged,
)
from handtouch.canbus.nodes.transitions import NEVER_NS, STARTED
from handtouch.canbus.objects.emergency import ReportedErrors, decode_emergency
from handtouch.canbus.objects.mapping import PdoMapping
from handtouch.wire.health import Emergency
from handtouch.wire.status import MAX_SILENT_PERIODS

_MIN_STALE_NS = 15_000_000
"""Shortest time until stale: at 1 kHz three periods may be a pause of this process, without a SYNC."""
HEARTBEAT_WINDOW_PERIODS = 10
"""Heartbeat periods over which the heartbeat rate is measured."""
MIN_DOUBLED_WINDOWS = 2
"""Consecutive windows with a doubled rate that show a duplicate id; delayed heartbeats double one at most."""
_MAX_SINGLE_REPEATS = 0.25  # repeated samples per SYNC of one node: two nodes have 1
_MIN_DOUBLED_RATIO = 1.6  # heartbeats received over expected: two nodes have 2
_MAX_WORKERS = 32
_MAX_EVENTS = 1024
_REQUEST_TIMEOUT_NS = 30_000_000
"""Timeout of a request sent by the receiving thread itself."""
_NMT_BYTES = 2
_SDO_WRITTEN, _SDO_REFUSED = 0x60, 0x80


class Master:
    """CANopen master of the nodes on one or several buses that share a slab.

    `states` : (slots,) uint8, the NodeState of each slot; samples are valid in OPERATIONAL only
    `sample_period_ns` : (slots,) int64, longest regular time between two samples: the SYNC period, or longer
    for an event-driven node
    `idle` : (slots,) bool, event-driven nodes
    `transmission_since_ns` : (slots,) int64, time since which samples are awaited: last change of `idle`, or
    later by the loop's pauses
    `transmission_changes` : number of these changes
    """

    def __init__(
        self, ports: Mapping[str, Port], nodes: Sequence[NodeSpec], sync_period_ns: int | None = None
    ) -> None:
        """Read the nodes' EDS files; nothing is sent before `start`.

        With `sync_period_ns` an operational node without samples for three periods, and 15 ms, becomes STALE.
        Raises EdsError for an unusable EDS, ValueError for nodes that contradict each other.
        """
        slabs = {id(port.slab): port.slab for port in ports.values()}
        if len(slabs) != 1:
            raise ValueError("the ports must share one slab")
        (self._slab,) = slabs.values()
        self._ports = ports
        self.states: NDArray[np.uint8] = np.zeros(self._slab.size, dtype=np.uint8)
        self._sync_period_ns = sync_period_ns or 0
        self.sample_period_ns: NDArray[np.int64] = np.full(
            self._slab.size, self._sync_period_ns, dtype=np.int64
        )
        self.transmission_since_ns: NDArray[np.int64] = np.zeros(self._slab.size, dtype=np.int64)
        self.idle: NDArray[np.bool_] = np.zeros(self._slab.size, dtype=np.bool_)
        self.transmission_changes = 0
        self._nodes = [make_managed_node(spec, ports, sync_period_ns or 0) for spec in nodes]
        self._by_slot = {node.spec.slot: node for node in self._nodes}
        self._owners = find_owners(ports, self._nodes)
        self._bus_causes = BusCauses(ports, self._nodes, sync_period_ns or 0)
        self._awaited_samples: dict[int, int] = {}  # slot -> arrival of its last sample
        self._next_due_ns = 0
        self._excused_ns = 0  # sum of all pauses
        self._sample_rates = SampleRates(self._slab, ports, self._nodes, sync_period_ns or 0)
        self._recovered_ns = {name: port.bus_state.recovered_ns for name, port in ports.items()}
        self._events: deque[MasterEvent] = deque(maxlen=_MAX_EVENTS)
        # from the workers
        self._results: deque[tuple[ManagedNode, StepOutcome | None, StepResult | None]] = deque()
        self._workers: ThreadPoolExecutor | None = None

    def start(self, now_ns: int) -> None:
        """Begin to boot the nodes."""
        self._workers = ThreadPoolExecutor(
            max_workers=min(_MAX_WORKERS, max(len(self._nodes), 1)), thread_name_prefix="canopen-sdo"
        )
        for node in self._nodes:
            if node.timing.role is BusRole.LISTENER and node.mapping is not None:
                self._route_samples(node, node.mapping, now_ns)
                self._update_node_state(node)
        self._next_due_ns = now_ns
        self.poll(now_ns)

    def handle_frame(self, bus_name: str, can_id: int, data: bytes, now_ns: int) -> None:
        """Handle a frame that isn't a sample; one that no configured node sends counts as unknown.

        Before `start` and after `stop` frames are only counted.
        """
        owner = self._owners[bus_name][can_id]
        if owner >= 0 and self._workers is not None:
            self._handle_node_frame(self._nodes[owner], can_id & 0x780, data, now_ns)
        elif owner == NMT_COMMAND:
            self._handle_nmt_command(bus_name, data, now_ns)
        elif owner == UNKNOWN_SENDER:
            self._ports[bus_name].counters.unknown_frames += 1
        if self._results:
            self._collect_results(now_ns)

    def excuse_pause(self, excused_ns: int, now_ns: int) -> None:
        """Extend all timeouts by a pause of the loop or the whole host; before its frames are handled.

        It costs the same for any number of nodes, as each takes over its pauses when it is next handled: a
        loop that can't keep up must not be delayed by excuses for it.
        """
        reference_ns = np.maximum(self._slab.arrival_ns, self.transmission_since_ns)
        np.add(reference_ns, excused_ns, out=self.transmission_since_ns)
        self._bus_causes.record_pause(excused_ns + self._sync_period_ns, now_ns)
        self._excused_ns += excused_ns

    def poll(self, now_ns: int) -> None:
        """Run timeouts and retries and collect the workers' results; once a tick, after `handle_frame`.

        Timeouts are assessed at `now_ns`: all frames that arrived before must have been handled.
        """
        if self._workers is None:
            return
        if self._results:
            self._collect_results(now_ns)
        self._check_recoveries(now_ns)
        self._check_samples(now_ns)
        for slot, rate in self._sample_rates.check(now_ns).items():
            self._advance(self._by_slot[slot], rate, now_ns)
        if now_ns >= self._next_due_ns:
            self._run_timers(now_ns)

    @property
    def is_booting(self) -> bool:
        """True while a node is being identified or configured, in requests that wait for its responses."""
        booting = (self.states >= NodeState.BOOTING) & (self.states <= NodeState.CONFIGURING)
        return bool(np.count_nonzero(booting))

    @property
    def wake_ns(self) -> int:
        """Latest time of the next `poll` that a timeout, retry or guarding request needs."""
        return self._next_due_ns

    def set_standby(self, slot: int, standby: bool, now_ns: int) -> None:
        """Put a node in standby (excitation off, stopped), or boot it again."""
        node = self._by_slot[slot]
        if node.lifecycle.standby != standby:
            self._advance(node, StandbyRequested(standby), now_ns)

    def set_transmission(self, slot: int, idle: bool, now_ns: int) -> None:
        """Make an operational node event-driven (`idle`), if it supports that, or a started one synchronous.

        The request for synchronous transmission is sent at once, before the next SYNC; call again until
        `self.idle` shows the change. All other requests are sent by a worker.
        """
        node = self._by_slot[slot]
        allowed = self.can_idle(slot) if idle else node.lifecycle.state in STARTED
        if self._workers is None or node.idle == idle or not allowed:
            return
        unanswered = node.request_ns and now_ns - node.request_ns > _REQUEST_TIMEOUT_NS
        if node.transmission_pending and not unanswered:
            return
        node.transmission_pending, node.request_ns = True, 0
        if idle or unanswered or node.sdo_lock.locked() or node.mapping is None:
            self._submit_step(node, NodeAction.SET_TRANSMISSION, idle)
            return
        node.request_ns, node.request_data = now_ns, boot.synchronous_request(node.mapping.tpdos[0])
        node.port.send(cia301.SDO_REQUEST + node.spec.node_id, node.request_data)

    def can_idle(self, slot: int) -> bool:
        """Return True if a node can be made event-driven: configured, operational, and it hasn't refused."""
        node = self._by_slot[slot]
        return node.can_idle and node.lifecycle.state is NodeState.OPERATIONAL

    def status(self) -> list[NodeStatus]:
        """Return the status of every node in the order given."""
        return [node.status() for node in self._nodes]

    def node_status(self, slot: int) -> NodeStatus:
        """Return the status of the node of a slot."""
        return self._by_slot[slot].status()

    def drain_events(self) -> list[MasterEvent]:
        """Return the events since the last call, oldest first; at most the latest 1024."""
        events = list(self._events)
        self._events.clear()
        return events

    def stop(self, now_ns: int) -> None:
        """Make each configured node pre-operational and wait for the workers to end (up to 0.2 s)."""
        for node in self._nodes:
            self._advance(node, StopRequested(), now_ns)
        if self._workers is not None:
            self._workers.shutdown(wait=True, cancel_futures=True)
            self._workers = None
        self._results.clear()

    def _handle_node_frame(self, node: ManagedNode, service: int, data: bytes, now_ns: int) -> None:
        size = {cia301.NMT_ERROR_CONTROL: 1}.get(service, 8)
        if len(data) != size:
            node.port.counters.wrong_length += 1
            if service == cia301.SDO_RESPONSE and node.sdo.awaiting_response:
                node.sdo.deliver_response(data)  # for the reason of the timeout
        elif service == cia301.NMT_ERROR_CONTROL:
            self._handle_heartbeat(node, data[0] & 0x7F, now_ns)
        elif service == cia301.EMCY:
            if (message := decode_emergency(data, now_ns)) is not None:
                self._report_errors(node, node.errors.add_emergency(message), now_ns)
        elif node.sdo.awaiting_response:
            node.sdo.deliver_response(data)
        else:
            if node.request_ns and data[1:4] == node.request_data[1:4]:
                self._handle_transmission_response(node, data[0], now_ns)
            self._advance(node, ProbeAnswered(), now_ns)

    def _handle_nmt_command(self, bus_name: str, data: bytes, now_ns: int) -> None:
        """Note a command of another NMT master: its effect is that of no fault."""
        if len(data) != _NMT_BYTES or self._workers is None:
            return
        command, node_id = data
        for node in self._nodes:
            if node.spec.bus == bus_name and node_id in (0, node.spec.node_id):
                self._advance(node, ForeignNmtCommand(command), now_ns)

    def _report_errors(self, node: ManagedNode, changed: tuple[Emergency, ...], now_ns: int) -> None:
        """Report errors that are new or cleared, and pass the present ones on to the lifecycle."""
        self._events.extend(ErrorChanged(node.spec.slot, now_ns, error) for error in changed)
        self._advance(node, ErrorsReported(node.errors.describe()), now_ns)

    def _handle_heartbeat(self, node: ManagedNode, nmt: int, now_ns: int) -> None:
        if nmt == cia301.BOOT_UP:
            node.booted = True
            node.heartbeat_window = None  # not configured yet: its heartbeat time is its default
            self._advance(node, BootUpReceived(), now_ns)
            return
        node.heartbeats += 1
        self._take_over_pauses(node, now_ns)
        self._check_heartbeat_rate(node, now_ns)
        if node.lifecycle.last_heartbeat_ns is not None:
            node.missed_heartbeats += max(
                round((now_ns - node.lifecycle.last_heartbeat_ns) / node.timing.heartbeat_period_ns) - 1, 0
            )
        self._advance(node, HeartbeatReceived(nmt), now_ns)

    def _check_heartbeat_rate(self, node: ManagedNode, now_ns: int) -> None:
        """Detect two nodes with one id by a doubled heartbeat rate."""
        if node.heartbeat_window is None:
            return
        since_ns, before, repeats_before = node.heartbeat_window
        periods = (now_ns - since_ns) / node.timing.heartbeat_period_ns
        if periods < HEARTBEAT_WINDOW_PERIODS:
            return
        repeats = int(self._slab.repeat_counts[node.spec.slot])
        node.heartbeat_window = (now_ns, node.heartbeats, repeats)
        doubled = node.heartbeats - before > _MIN_DOUBLED_RATIO * periods
        node.doubled_windows = node.doubled_windows + 1 if doubled else 0
        if not doubled or node.doubled_windows >= MIN_DOUBLED_WINDOWS:
            by_sync = self._sync_period_ns and not (
                node.idle or node.transmission_pending or node.event_timed
            )
            cycles = (now_ns - since_ns) / max(self._sync_period_ns or 0, 1)
            single = bool(by_sync) and repeats - repeats_before < _MAX_SINGLE_REPEATS * cycles
            self._advance(node, HeartbeatRate(doubled, single), now_ns)

    def _check_samples(self, now_ns: int) -> None:
        arrival_ns = self._slab.arrival_ns
        for slot, previous_ns in list(self._awaited_samples.items()):
            if arrival_ns[slot] != previous_ns:
                self._awaited_samples[slot] = int(arrival_ns[slot])
                self._advance(self._by_slot[slot], SampleReceived(), now_ns)
        if self._sync_period_ns:
            ages_ns = self._sample_ages_ns(now_ns)
            timeout_ns = np.maximum(MAX_SILENT_PERIODS * self.sample_period_ns, _MIN_STALE_NS)
            stale = (self.states == NodeState.OPERATIONAL) & (ages_ns > timeout_ns)
            if stale.any():
                states = self.states.copy()
                for slot in np.flatnonzero(stale).tolist():
                    node = self._by_slot[slot]
                    cause = self._sample_cause(node, states, ages_ns, now_ns)
                    self._advance(node, SamplesMissing(int(ages_ns[slot]), cause), now_ns)

    def _sample_cause(
        self, node: ManagedNode, states: NDArray[np.uint8], ages_ns: NDArray[np.int64], now_ns: int
    ) -> str:
        """Return why a node's samples are missing, empty if nothing but the node is known."""
        slot = node.spec.slot
        short = node.port.router.get_short_frames(slot)
        # one in each period but one: single ones may be somebody else's
        if short.frames and (short.frames + 2) * int(self.sample_period_ns[slot]) > ages_ns[slot]:
            return (
                f"its PDO has {short.size} bytes, its mapping {short.expected}; correct the mapping in the "
                "node (0x1A00 to 0x1BFF)"
            )
        return self._bus_causes.of_missing_samples(node, states, ages_ns, now_ns)

    def _sample_ages_ns(self, now_ns: int) -> NDArray[np.int64]:
        """Return the time (slots,) since the last sample, or since it is awaited."""
        return now_ns - np.maximum(self._slab.arrival_ns, self.transmission_since_ns)

    def _check_recoveries(self, now_ns: int) -> None:
        """Restart the timeouts of a bus that was down: its nodes could not be heard."""
        for name, port in self._ports.items():
            if self._recovered_ns[name] != port.bus_state.recovered_ns:
                self._recovered_ns[name] = port.bus_state.recovered_ns
                for node in self._nodes:
                    if node.port is port:
                        self._advance(node, BusRecovered(), now_ns)

    def _run_timers(self, now_ns: int) -> None:
        self._next_due_ns = NEVER_NS
        for node in self._nodes:
            self._take_over_pauses(node, now_ns)
            due = due_ns(node.lifecycle, node.timing)
            if due is not None and due <= now_ns:
                causes, ages_ns = self._bus_causes, self._sample_ages_ns(now_ns)
                sample_cause = self._sample_cause(node, self.states, ages_ns, now_ns)
                age_ns = now_ns - int(self._slab.arrival_ns[node.spec.slot])
                expired = TimerExpired(causes.of_timeout(node, now_ns), sample_cause, age_ns)
                self._advance(node, expired, now_ns)
                due = due_ns(node.lifecycle, node.timing)
            if node.guarded and is_supervised(node.lifecycle):
                self._send_guard_request(node, now_ns)
                due = min(node.next_guard_ns, due) if due is not None else node.next_guard_ns
            if due is not None:
                self._next_due_ns = min(self._next_due_ns, due)

    def _send_guard_request(self, node: ManagedNode, now_ns: int) -> None:
        """Send a guarding request to a node without heartbeat, once a period."""
        if now_ns >= node.next_guard_ns:
            node.port.send(cia301.NMT_ERROR_CONTROL + node.spec.node_id, b"", remote=True)
            node.next_guard_ns = now_ns + node.timing.heartbeat_period_ns

    def _take_over_pauses(self, node: ManagedNode, now_ns: int) -> None:
        """Extend a node's timeouts by the pauses since it was last handled."""
        if node.excused_ns != self._excused_ns:
            pause = LoopPaused(self._excused_ns - node.excused_ns)
            node.lifecycle, _ = advance(node.lifecycle, pause, now_ns, node.timing)
            node.excused_ns = self._excused_ns

    def _advance(self, node: ManagedNode, event: LifecycleEvent, now_ns: int) -> None:
        self._take_over_pauses(node, now_ns)
        before = node.lifecycle
        node.lifecycle, actions = advance(before, event, now_ns, node.timing)
        after = node.lifecycle
        if (before.state, before.reason) != (after.state, after.reason):
            self._update_node_state(node)
            self._append_event(node, before.state, after.reason, now_ns)
        due = due_ns(after, node.timing)
        if due is not None and due < self._next_due_ns:
            self._next_due_ns = due
        for action in actions:
            self._perform_action(node, action)

    def _update_node_state(self, node: ManagedNode) -> None:
        """Update the data derived from a node's state."""
        slot, state = node.spec.slot, node.lifecycle.state
        self.states[slot] = state
        may_appear = node.timing.role is BusRole.LISTENER and state is NodeState.ABSENT
        if may_appear or state in (NodeState.SETTLING, NodeState.STALE):
            self._awaited_samples.setdefault(slot, int(self._slab.arrival_ns[slot]))
        else:
            self._awaited_samples.pop(slot, None)

    def _append_event(self, node: ManagedNode, old: NodeState, reason: str, now_ns: int) -> None:
        self._events.append(NodeEvent(node.spec.slot, now_ns, old, node.lifecycle.state, reason))

    def _perform_action(self, node: ManagedNode, action: NodeAction) -> None:
        if action in NMT_COMMANDS:
            send_nmt(node, action)
        elif action is NodeAction.PROBE:
            node.port.send(cia301.SDO_REQUEST + node.spec.node_id, cia301.DEVICE_TYPE_REQUEST)
            # a stopped node serves no SDO; one without heartbeat reports its state only when guarded
            node.port.send(cia301.NMT_ERROR_CONTROL + node.spec.node_id, b"", remote=True)
        elif self._workers is not None:
            self._submit_step(node, action)

    def _submit_step(self, node: ManagedNode, step: NodeAction, idle: bool = False) -> None:
        """Have a worker run a step; it fails where this host can't start another thread."""
        assert self._workers is not None
        attempt = node.lifecycle.attempt
        try:
            self._workers.submit(self._run_step, node, step, attempt, idle)
        except RuntimeError as error:
            reason = (
                f"{error}: raise this host's limit of memory or of processes (ulimit, systemd's TasksMax)"
            )
            self._results.append((node, StepFailed(step, attempt, reason), None))

    def _run_step(self, node: ManagedNode, step: NodeAction, attempt: int, idle: bool = False) -> None:
        """Run a step in a worker; its outcome goes to the receiving thread."""
        with node.sdo_lock:
            self._results.append((node, *run_step(node, step, attempt, idle)))

    def _collect_results(self, now_ns: int) -> None:
        while self._results:
            node, outcome, result = self._results.popleft()
            if outcome is None or outcome.attempt != node.lifecycle.attempt:
                continue
            if outcome.step is NodeAction.SET_TRANSMISSION:
                self._finish_transmission(node, outcome, result, now_ns)
                continue
            errors = result.errors if isinstance(result, boot.Identification) else result
            if isinstance(errors, ReportedErrors):
                self._report_errors(node, node.errors.add_report(errors, now_ns), now_ns)
            if isinstance(result, boot.Identification):
                self._update_identity(node, result.identity, now_ns)
            elif isinstance(result, boot.NodeConfigured):
                node.guarded = result.guarded
                node.booted, node.can_idle, node.event_timed = False, result.can_idle, result.event_timed
                self._record_transmission(node, False, now_ns)
                self._next_due_ns = now_ns
                if node.heartbeat_window is None:
                    repeats = int(self._slab.repeat_counts[node.spec.slot])
                    node.heartbeat_window, node.doubled_windows = (now_ns, node.heartbeats, repeats), 0
                if result.refusal:
                    self._append_event(node, node.lifecycle.state, result.refusal, now_ns)
            elif isinstance(result, PdoMapping) and self._route_samples(node, result, now_ns):
                continue
            self._advance(node, outcome, now_ns)

    def _finish_transmission(
        self, node: ManagedNode, outcome: StepOutcome, result: StepResult | None, now_ns: int
    ) -> None:
        node.transmission_pending = False
        if isinstance(result, bool):
            self._record_transmission(node, result, now_ns)
        elif isinstance(outcome, StepFailed):
            # not requested again until the node boots
            node.can_idle = node.idle
            if outcome.timed_out:
                self._advance(node, outcome, now_ns)
                return
            kind = "event-driven" if node.idle else "synchronous"
            self._append_event(node, node.lifecycle.state, f"stays {kind}: {outcome.reason}", now_ns)

    def _handle_transmission_response(self, node: ManagedNode, command: int, now_ns: int) -> None:
        """Record the change, or have a worker make it: some nodes refuse to change an enabled PDO."""
        if command == _SDO_WRITTEN:
            self._record_transmission(node, False, now_ns)
        elif command == _SDO_REFUSED and self._workers is not None:
            node.request_ns = 0
            self._submit_step(node, NodeAction.SET_TRANSMISSION)

    def _record_transmission(self, node: ManagedNode, idle: bool, now_ns: int) -> None:
        slot, spec = node.spec.slot, node.spec
        node.idle, node.transmission_pending, node.request_ns = idle, False, 0
        period_ns = spec.idle.period_ms * 1_000_000 if idle and spec.idle else 0
        self.sample_period_ns[slot] = max(period_ns, self._sync_period_ns)
        self.transmission_since_ns[slot] = now_ns
        self.idle[slot] = idle
        self.transmission_changes += 1

    def _update_identity(self, node: ManagedNode, identity: Identity, now_ns: int) -> None:
        before = node.identity
        node.identity = identity
        if before is not None and before.serial != identity.serial:
            self._events.append(SerialChanged(node.spec.slot, now_ns, before.serial, identity.serial))

    def _route_samples(self, node: ManagedNode, mapping: PdoMapping, now_ns: int) -> bool:
        """Route the node's samples; return True if another node has one of their identifiers, which faults
        both."""
        router, slot = node.port.router, node.spec.slot
        for tpdo in node.mapping.tpdos if node.mapping else ():
            if router.get_slot(tpdo.cob_id) == slot:
                router.route(tpdo.cob_id, NO_SLOT)
        node.claimed_ids = frozenset(tpdo.cob_id for tpdo in mapping.tpdos)
        others = [
            (other, min(other.claimed_ids & node.claimed_ids))
            for other in self._nodes
            if other is not node and other.port is node.port and other.claimed_ids & node.claimed_ids
        ]
        for other, cob_id in others:
            router.route(cob_id, NO_SLOT)
            for one, two in ((node, other), (other, node)):
                reason = (
                    f"COB-ID 0x{cob_id:X} of its samples is also that of {two.spec.name}; "
                    "give one of them another COB-ID and store it"
                )
                state = one.lifecycle.state
                if one is node or state in (*STARTED, NodeState.CONFIGURING):  # others read theirs again
                    self._advance(one, IdentifierClash(reason), now_ns)
        if others:
            return True
        if node.mapping is None or node.mapping.layout != mapping.layout:
            node.port.slab.set_layout(slot, mapping.layout, bool(mapping.states))
        for number, tpdo in enumerate(mapping.tpdos):
            router.route(tpdo.cob_id, slot, number, tpdo.size_bytes)
        node.mapping = mapping
        return False
