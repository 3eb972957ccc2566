"""The master's side of a hand's CANopen nodes: boots each one, watches it, brings it back when it was away.

Public names: `Master`, `NodeSpec`, `NodeStatus`, `NodeEvent`, `SerialChanged`. One thread receives and calls
`handle` and `poll`; whatever has to wait for a node's answer is done in worker threads of the master's own,
so that one that is silent keeps none of the others waiting. Nodes are addressed one by one, never by a
broadcast.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from handtouch.canbus.bus.port import Port
from handtouch.canbus.bus.router import IDENTIFIERS, NOBODY
from handtouch.canbus.objects import emergency
from handtouch.canbus.objects.eds import EdsError
from handtouch.canbus.objects.mapping import Mapping as PdoMapping

from . import boot
from .life import (
    NMT_BOOT_UP,
    Action,
    Answer,
    Babble,
    Beats,
    BootUp,
    Event,
    Failed,
    Heartbeat,
    NodeState,
    Rest,
    Role,
    Sample,
    Silence,
    Stop,
    Tick,
)
from .lifecycle import advance, due_ns, is_supervised
from .member import NMT_COMMANDS, Member, Outcome, Result, command, member, outcome
from .spec import NodeEvent, NodeSpec, NodeStatus, SerialChanged

__all__ = ["Master", "NodeEvent", "NodeSpec", "NodeState", "NodeStatus", "SerialChanged"]

STALE_PERIODS = 3
"""Periods without a sample after which an operational node is stale."""
_LEAST_SILENCE_NS = 15_000_000
"""And as long at least: at 1 kHz three periods are a pause of our own, in which nobody was asked."""
BEATS_WATCHED = 10
"""Heartbeat periods over which it is judged whether they come twice as often as they should."""
CROWDED = 2
"""Times in a row that they do before two nodes are said to have its id: late ones come in a burst once."""
_TWICE = 1.6  # times as many
BABBLE = 2
"""Samples beyond one for each SYNC from which on a node is said to babble; duplicates are at most one."""
_BABBLE_NS = 500_000_000  # over which they are counted
_WORKERS = 32
_EVENTS_KEPT = 1024
_NEVER_NS = 1 << 62
_HASTE_NS = 30_000_000
"""How long an answer to a request of the receiving thread's own is waited for."""
_SDO_WRITTEN, _SDO_REFUSED = 0x60, 0x80

_NMT, _SYNC, _TIME, _LSS_ANSWER, _LSS_REQUEST = 0x000, 0x080, 0x100, 0x7E4, 0x7E5
_EMCY, _SDO_ANSWER, _SDO_REQUEST, _HEARTBEAT = 0x080, 0x580, 0x600, 0x700
_PDOS = (0x180, 0x200, 0x280, 0x300, 0x380, 0x400, 0x480, 0x500)
_PROBE = bytes(
    (0x40, 0x00, 0x10, 0x00, 0, 0, 0, 0)
)  # SDO: read 0x1000, the device type, which all nodes have

_FOREIGN, _IGNORED = -1, -2
_STARTED = (NodeState.SETTLING, NodeState.OPERATIONAL, NodeState.STALE)


class Master:
    """Boots and watches nodes on one or several buses that share a slab.

    `states` (slots,) uint8 holds the NodeState of each slot; samples are to be trusted in OPERATIONAL alone.
    `period_ns` (slots,) int64 is how long it is between two samples at most: a SYNC period, or longer for an
    event-driven node, `idle`; `paced_ns` since when. `paces` counts the changes.
    """

    def __init__(
        self, ports: Mapping[str, Port], nodes: Sequence[NodeSpec], sync_period_ns: int | None = None
    ) -> None:
        """Read the nodes' EDS files; nothing is sent before `start`.

        With `sync_period_ns` an operational node without samples for three periods, and 15 ms, becomes STALE.
        Raises EdsError for an EDS that can't be used, ValueError for nodes that contradict each other.
        """
        slabs = {id(port.slab): port.slab for port in ports.values()}
        if len(slabs) != 1:
            raise ValueError("the ports must share one slab")
        (self._slab,) = slabs.values()
        self._ports = ports
        self.states: NDArray[np.uint8] = np.zeros(self._slab.size, dtype=np.uint8)
        self._sync_period_ns = sync_period_ns or 0
        self.period_ns: NDArray[np.int64] = np.full(self._slab.size, self._sync_period_ns, dtype=np.int64)
        self.paced_ns: NDArray[np.int64] = np.zeros(self._slab.size, dtype=np.int64)
        self.idle: NDArray[np.bool_] = np.zeros(self._slab.size, dtype=np.bool_)
        self.paces = 0
        self._nodes = [member(spec, ports, sync_period_ns or 0) for spec in nodes]
        self._by_slot = {node.spec.slot: node for node in self._nodes}
        self._owners = _owners(ports, self._nodes)
        self._waiting: dict[int, int] = {}  # slots whose next sample matters -> stamp of the last one
        self._next_due_ns = 0
        self._repeats = (0, self._slab.repeats.copy())  # since when they are counted, and how many had come
        self._babbling: set[int] = set()
        self._neighbours = [  # slots of each bus's nodes, and whether its SYNC has our period
            (np.array(slots), port.bus.sync == "producer")
            for port in ports.values()
            if (slots := [node.spec.slot for node in self._nodes if node.port is port])
        ]
        self._events: deque[NodeEvent | SerialChanged] = deque(maxlen=_EVENTS_KEPT)
        self._results: deque[tuple[Member, Outcome | None, Result | None]] = deque()  # from the workers
        self._workers: ThreadPoolExecutor | None = None

    def start(self, t_ns: int) -> None:
        """Begin to look for the nodes."""
        self._workers = ThreadPoolExecutor(
            max_workers=min(_WORKERS, max(len(self._nodes), 1)), thread_name_prefix="canopen-sdo"
        )
        for node in self._nodes:
            if node.timing.role is Role.LISTENER and node.mapping is not None:
                self._route(node, node.mapping)
                self._changed(node)
        self._next_due_ns = t_ns
        self.poll(t_ns)

    def handle(self, bus_name: str, can_id: int, data: bytes, t_ns: int) -> None:
        """Take a frame that was no sample. What no configured node sends is counted as foreign.

        Before `start` and after `stop` nothing but that is done with it.
        """
        owner = self._owners[bus_name][can_id]
        if owner >= 0 and self._workers is not None:
            self._from_node(self._nodes[owner], can_id & 0x780, data, t_ns)
        elif owner == _FOREIGN:
            self._ports[bus_name].counters.foreign += 1
        if self._results:
            self._collect(t_ns)

    def poll(self, t_ns: int) -> None:
        """Time-outs, retries and results of the worker; once a tick, after `drain` and `handle`."""
        if self._workers is None:
            return
        if self._results:
            self._collect(t_ns)
        self._watch_samples(t_ns)
        if t_ns - self._repeats[0] >= _BABBLE_NS and self._sync_period_ns:
            self._watch_repeats(t_ns)
        if t_ns >= self._next_due_ns:
            self._tick(t_ns)

    @property
    def wake_ns(self) -> int:
        """When to `poll` at the latest, were ticks far apart: a time-out, a retry, a node to be guarded."""
        return self._next_due_ns

    def rest(self, slot: int, resting: bool, t_ns: int) -> None:
        """A node isn't needed for now: excitation off, stopped; or it is again."""
        node = self._by_slot[slot]
        if node.life.resting != resting:
            self._advance(node, Rest(resting), t_ns)

    def pace(self, slot: int, idle: bool, t_ns: int) -> None:
        """Make an operational node event-driven (`idle`), where it can be, or a started one synchronous.

        Back to synchronous is asked for at once, before the next SYNC; ask again until `idle` tells that it
        is so. Whatever else has to be said to the node is said by a worker.
        """
        node = self._by_slot[slot]
        may = self.can_idle(slot) if idle else node.life.state in _STARTED
        if self._workers is None or node.idle == idle or not may:
            return
        unanswered = node.asked_ns and t_ns - node.asked_ns > _HASTE_NS
        if node.pacing and not unanswered:
            return
        node.pacing, node.asked_ns = True, 0
        if idle or unanswered or node.working.locked() or node.mapping is None:
            self._workers.submit(self._work, node, Action.PACE, node.life.attempt, idle)
            return
        node.asked_ns, node.request = t_ns, boot.synchronous_request(node.mapping.tpdos[0])
        node.port.send(_SDO_REQUEST + node.spec.node_id, node.request)

    def can_idle(self, slot: int) -> bool:
        """Whether the node can be made event-driven: configured so, operational, and it hasn't refused."""
        node = self._by_slot[slot]
        return node.may_idle and node.life.state is NodeState.OPERATIONAL

    def status(self) -> list[NodeStatus]:
        """Every node as it is now, in the order given."""
        return [node.status() for node in self._nodes]

    def status_of(self, slot: int) -> NodeStatus:
        """The node of a slot as it is now."""
        return self._by_slot[slot].status()

    def take_events(self) -> list[NodeEvent | SerialChanged]:
        """What has happened since the last call, oldest first; the latest thousand if nobody asked."""
        events = list(self._events)
        self._events.clear()
        return events

    def stop(self, t_ns: int) -> None:
        """NMT stop to each configured node, one by one; returns when the workers have ended (in 0.2 s)."""
        for node in self._nodes:
            self._advance(node, Stop(), t_ns)
        if self._workers is not None:
            self._workers.shutdown(wait=True, cancel_futures=True)
            self._workers = None
        self._results.clear()

    def _from_node(self, node: Member, service: int, data: bytes, t_ns: int) -> None:
        size = {_HEARTBEAT: 1}.get(service, 8)
        if len(data) != size:
            node.port.counters.short += 1
        elif service == _HEARTBEAT:
            self._heartbeat(node, data[0] & 0x7F, t_ns)
        elif service == _EMCY:
            if (message := emergency.decode(data, t_ns)) is not None:
                node.emergencies.append(message)
        elif node.sdo.waiting:
            node.sdo.deliver(data)
        else:
            if node.asked_ns and data[1:4] == node.request[1:4]:
                self._pace_answered(node, data[0], t_ns)
            self._advance(node, Answer(), t_ns)

    def _heartbeat(self, node: Member, nmt: int, t_ns: int) -> None:
        if nmt == NMT_BOOT_UP:
            node.booted, node.watched = True, None  # its heartbeat time is its own until it is configured
            self._advance(node, BootUp(), t_ns)
            return
        node.heartbeats += 1
        self._watch_rate(node, t_ns)
        if node.life.heartbeat_ns is not None:
            node.missed += max(round((t_ns - node.life.heartbeat_ns) / node.timing.heartbeat_ns) - 1, 0)
        self._advance(node, Heartbeat(nmt), t_ns)

    def _watch_rate(self, node: Member, t_ns: int) -> None:
        """Two nodes of one id give themselves away by their heartbeats, which come twice as often."""
        if node.watched is None:
            return
        since_ns, before = node.watched
        periods = (t_ns - since_ns) / node.timing.heartbeat_ns
        if periods < BEATS_WATCHED:
            return
        node.watched = (t_ns, node.heartbeats)
        twice = node.heartbeats - before > _TWICE * periods
        node.crowded = node.crowded + 1 if twice else 0
        if not twice or node.crowded >= CROWDED:
            self._advance(node, Beats(twice), t_ns)

    def _watch_samples(self, t_ns: int) -> None:
        stamps = self._slab.t_ns
        for slot, seen_ns in list(self._waiting.items()):
            if stamps[slot] != seen_ns:
                self._waiting[slot] = int(stamps[slot])
                self._advance(self._by_slot[slot], Sample(), t_ns)
        if self._sync_period_ns:
            ages = t_ns - np.maximum(stamps, self.paced_ns)
            patience_ns = np.maximum(STALE_PERIODS * self.period_ns, _LEAST_SILENCE_NS)
            silent = (self.states == NodeState.OPERATIONAL) & (ages > patience_ns)
            if silent.any():
                for slot in np.flatnonzero(silent).tolist():
                    self._advance(self._by_slot[slot], Silence(int(ages[slot])), t_ns)

    def _watch_repeats(self, t_ns: int) -> None:
        """Which nodes send far more samples than SYNC asks for.

        A SYNC too many, or one that somebody else sends as often as he likes, shows in most of a bus's nodes.
        """
        since_ns, before = self._repeats
        self._repeats = (t_ns, self._slab.repeats.copy())
        extra = self._slab.repeats - before
        periods = max((t_ns - since_ns) / self._sync_period_ns, 1.0)
        babbling: set[int] = set()
        for slots, is_ours in self._neighbours:
            alone = len(slots) == 1 and is_ours
            usual = 0 if alone else np.sort(extra[slots])[(len(slots) - 1) // 2]
            babbling.update(slots[extra[slots] - usual > BABBLE * periods].tolist())
        for slot in babbling | self._babbling:
            times = 1 + round(extra[slot] / periods) if slot in babbling else 0
            self._advance(self._by_slot[slot], Babble(times), t_ns)
        self._babbling = babbling

    def _tick(self, t_ns: int) -> None:
        self._next_due_ns = _NEVER_NS
        for node in self._nodes:
            due = due_ns(node.life, node.timing)
            if due is not None and due <= t_ns:
                self._advance(node, Tick(), t_ns)
                due = due_ns(node.life, node.timing)
            if node.guarded and is_supervised(node.life):
                self._guard(node, t_ns)
                due = min(node.guard_ns, due) if due is not None else node.guard_ns
            if due is not None:
                self._next_due_ns = min(self._next_due_ns, due)

    def _guard(self, node: Member, t_ns: int) -> None:
        """Ask a node that has no heartbeat for its state, once a period."""
        if t_ns >= node.guard_ns:
            node.port.send(_HEARTBEAT + node.spec.node_id, b"", remote=True)
            node.guard_ns = t_ns + node.timing.heartbeat_ns

    def _advance(self, node: Member, event: Event, t_ns: int) -> None:
        before = node.life
        node.life, actions = advance(before, event, t_ns, node.timing)
        after = node.life
        if (before.state, before.reason) != (after.state, after.reason):
            self._changed(node)
            self._tell(node, before.state, after.reason, t_ns)
        due = due_ns(after, node.timing)
        if due is not None and due < self._next_due_ns:
            self._next_due_ns = due
        for action in actions:
            self._act(node, action)

    def _changed(self, node: Member) -> None:
        """Keep what is derived from a node's state."""
        slot, state = node.spec.slot, node.life.state
        self.states[slot] = state
        overheard = node.timing.role is Role.LISTENER and state is NodeState.ABSENT
        if overheard or state in (NodeState.SETTLING, NodeState.STALE):
            self._waiting.setdefault(slot, int(self._slab.t_ns[slot]))
        else:
            self._waiting.pop(slot, None)

    def _tell(self, node: Member, old: NodeState, reason: str, t_ns: int) -> None:
        self._events.append(NodeEvent(node.spec.slot, t_ns, old, node.life.state, reason))

    def _act(self, node: Member, action: Action) -> None:
        if action in NMT_COMMANDS:
            command(node, action)
        elif action is Action.PROBE:
            node.port.send(_SDO_REQUEST + node.spec.node_id, _PROBE)
            # stopped, it serves no SDO; without heartbeat it tells its state only when it is asked
            node.port.send(_HEARTBEAT + node.spec.node_id, b"", remote=True)
        elif self._workers is not None:
            self._workers.submit(self._work, node, action, node.life.attempt)

    def _work(self, node: Member, step: Action, attempt: int, idle: bool = False) -> None:
        """In a worker: carry out a step; its outcome goes to the receiving thread."""
        with node.working:
            self._results.append((node, *outcome(node, step, attempt, idle)))

    def _collect(self, t_ns: int) -> None:
        while self._results:
            node, outcome, result = self._results.popleft()
            if outcome is None or outcome.attempt != node.life.attempt:
                continue
            if outcome.step is Action.PACE:
                self._paced(node, outcome, result, t_ns)
                continue
            if isinstance(result, boot.Identity):
                self._take_identity(node, result, t_ns)
            elif isinstance(result, boot.Configured):
                node.guarded = result.guarded
                node.booted, node.may_idle = False, result.may_idle
                self._set_pace(node, False, t_ns)
                self._next_due_ns = t_ns
                if node.watched is None:
                    node.watched, node.crowded = (t_ns, node.heartbeats), 0
                if result.refusal:
                    self._tell(node, node.life.state, result.refusal, t_ns)
            elif isinstance(result, PdoMapping) and (clash := self._route(node, result)):
                outcome = Failed(outcome.step, outcome.attempt, clash)
            self._advance(node, outcome, t_ns)

    def _paced(self, node: Member, outcome: Outcome, result: Result | None, t_ns: int) -> None:
        node.pacing = False
        if isinstance(result, boot.Paced):
            self._set_pace(node, result.idle, t_ns)
        elif isinstance(outcome, Failed):
            # one that refuses to be event-driven isn't asked again until it boots
            node.may_idle = node.idle
            if outcome.silent:
                self._advance(node, outcome, t_ns)
                return
            kind = "event-driven" if node.idle else "synchronous"
            self._tell(node, node.life.state, f"stays {kind}: {outcome.reason}", t_ns)

    def _pace_answered(self, node: Member, command: int, t_ns: int) -> None:
        """A node that doesn't let a PDO be changed while it is on needs more than one request."""
        if command == _SDO_WRITTEN:
            self._set_pace(node, False, t_ns)
        elif command == _SDO_REFUSED and self._workers is not None:
            node.asked_ns = 0
            self._workers.submit(self._work, node, Action.PACE, node.life.attempt, False)

    def _set_pace(self, node: Member, idle: bool, t_ns: int) -> None:
        slot, spec = node.spec.slot, node.spec
        node.idle, node.pacing, node.asked_ns = idle, False, 0
        period_ns = spec.idle.period_ms * 1_000_000 if idle and spec.idle else 0
        self.period_ns[slot] = max(period_ns, self._sync_period_ns)
        self.paced_ns[slot] = t_ns
        self.idle[slot] = idle
        self.paces += 1

    def _take_identity(self, node: Member, identity: boot.Identity, t_ns: int) -> None:
        before = node.identity
        node.identity = identity
        if before is not None and before.serial != identity.serial:
            self._events.append(SerialChanged(node.spec.slot, t_ns, before.serial, identity.serial))

    def _route(self, node: Member, mapping: PdoMapping) -> str:
        """Route the node's samples; the reason where an identifier of theirs is another node's already."""
        router, slot = node.port.router, node.spec.slot
        for tpdo in mapping.tpdos:
            owner = router.slot(tpdo.cob_id)
            if owner not in (NOBODY, slot):
                return (
                    f"TPDO{tpdo.number} has identifier 0x{tpdo.cob_id:X}, as has "
                    f"{self._by_slot[owner].spec.name}; give one of them another, and store it"
                )
        for tpdo in node.mapping.tpdos if node.mapping else ():
            router.route(tpdo.cob_id, NOBODY)
        if node.mapping is None or node.mapping.layout != mapping.layout:
            node.port.slab.arrange(slot, mapping.layout)
        for number, tpdo in enumerate(mapping.tpdos):
            router.route(tpdo.cob_id, slot, number, tpdo.size)
        node.mapping = mapping
        return ""


def _owners(ports: Mapping[str, Port], nodes: Sequence[Member]) -> dict[str, list[int]]:
    """For each bus and identifier: which of `nodes` handles it, _IGNORED or _FOREIGN."""
    owners = {name: [_FOREIGN] * IDENTIFIERS for name in ports}
    for table in owners.values():
        for can_id in (_NMT, _SYNC, _TIME, _LSS_ANSWER, _LSS_REQUEST):
            table[can_id] = _IGNORED
    slots: set[int] = set()
    heard: dict[tuple[str, int], str] = {}  # a listener's nodes by the identifiers of their samples
    for number, node in enumerate(nodes):
        spec, table = node.spec, owners[node.spec.bus]
        if table[_HEARTBEAT + spec.node_id] != _FOREIGN or spec.slot in slots:
            raise ValueError(f'node "{spec.name}": node id {spec.node_id} or slot {spec.slot} is given twice')
        slots.add(spec.slot)
        for tpdo in node.mapping.tpdos if node.mapping else ():
            other = heard.setdefault((spec.bus, tpdo.cob_id), spec.name)
            if other != spec.name:
                raise EdsError(
                    f'nodes "{other}" and "{spec.name}" both send 0x{tpdo.cob_id:X} by their EDS; '
                    "give each an EDS, or DCF, with the identifiers that it has"
                )
        for service in (_EMCY, _SDO_ANSWER, _HEARTBEAT):
            table[service + spec.node_id] = number
        for service in (_SDO_REQUEST, *_PDOS):  # our own requests, echoed; PDOs before they are routed
            table[service + spec.node_id] = _IGNORED
    return owners
