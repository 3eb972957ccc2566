"""Scan of buses: listen, query every node id, find nodes without a node id and assign one on request.

Public names: `ScanRequest`, `BusReport`, `scan_buses`, `scan_bus`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace

from handtouch import config
from handtouch.canbus.bus.port import Port
from handtouch.canbus.cia305 import LssAddress
from handtouch.canbus.find.lss import (
    MIN_WAIT_S,
    LssError,
    LssMaster,
)
from handtouch.canbus.find.survey import BusSurvey, NodeFacts
from handtouch.canbus.find.traffic import FrameStatistics
from handtouch.core.slab import Slab

_BOOT_TIMEOUT_S = 3.0  # time limit for the boot-up message of a node with a new id
_MAX_ASSIGNMENT_ROUNDS = 3

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class ScanRequest:
    """Options of a scan; `first_assigned_id`: assign node ids from this one upwards, None to assign none."""

    listen_only: bool = False
    lss: bool = False
    first_assigned_id: int | None = None
    listen_s: float = 1.0
    lss_wait_s: float = MIN_WAIT_S


@dataclass(slots=True)
class BusReport:
    """Result of one bus. `durations_s`: duration of each step; counts are of the whole scan."""

    bus: config.Bus
    bus_load: float = 0.0
    streams: dict[int, FrameStatistics] = field(default_factory=dict)
    other_frames: int = 0  # with 29-bit identifiers, remote and FD frames
    error_frames: int = 0
    nodes: list[NodeFacts] = field(default_factory=list)
    unconfigured: list[LssAddress] = field(default_factory=list)
    assigned: dict[LssAddress, int] = field(default_factory=dict)
    durations_s: dict[str, float] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)


def scan_buses(
    buses: Sequence[config.Bus],
    request: ScanRequest,
    deployment: config.Deployment | None = None,
    progress: Progress = lambda _: None,
) -> list[BusReport]:
    """Scan all buses at the same time. Raises BusError if one can't be opened."""
    with ExitStack() as stack, ThreadPoolExecutor(len(buses), "scan") as pool:
        ports = [_open_port(bus, stack) for bus in buses]
        return list(pool.map(lambda port: scan_bus(port, request, deployment, progress), ports))


def _open_port(bus: config.Bus, stack: ExitStack) -> Port:
    port = Port.open(bus, Slab(1))
    stack.callback(port.close)
    return port


def scan_bus(
    port: Port,
    request: ScanRequest,
    deployment: config.Deployment | None = None,
    progress: Progress = lambda _: None,
) -> BusReport:
    """Scan one open bus."""
    survey, report = BusSurvey(port), BusReport(port.bus)
    name = port.bus.name
    passive = request.listen_only or port.bus.role == "listener"
    if passive and request.lss:
        report.problems.append(f"{name}: no LSS, because its role is listener, which sends nothing")
    with _measure_duration(report, "listen"):
        progress(f"{name}: listening for {request.listen_s:g} s")
        _listen(survey, request.listen_s, report)
    present: set[int] = set()
    if not passive:
        with _measure_duration(report, "query"):
            progress(f"{name}: querying node ids 1 to 127")
            present = survey.probe_ids()
        with _measure_duration(report, "read"):
            report.nodes = survey.read_nodes(
                sorted(present), lambda done: progress(f"{name}: {done} of {len(present)} nodes read")
            )
        if request.lss:
            with _measure_duration(report, "lss"):
                _find_unconfigured(survey, report, request, deployment, progress)
    report.nodes += [
        survey.observed_facts(node_id)
        for node_id in sorted(survey.traffic.detected_nodes() - _node_ids(report))
    ]
    report.nodes.sort(key=lambda node: node.node_id)
    report.problems += _cob_id_conflicts(report)
    if not passive:
        report.problems += _other_client(report)
    counters = port.counters
    report.other_frames, report.error_frames = counters.unknown_frames, counters.error_frames
    if port.problem:
        report.problems.append(f"{name}: {port.problem}")
    if not report.nodes and not report.unconfigured:
        report.problems.append(
            f"{name}: no node {'detected' if passive else 'found'}; check power, bit rate "
            f"({port.bus.bitrate_bit_s} bit/s) and termination"
            + ("" if request.lss or passive else "; --lss finds nodes without a node id")
        )
    return report


def _cob_id_conflicts(report: BusReport) -> Iterator[str]:
    """Yield the COB-IDs that TPDOs of several nodes share: their frames collide."""
    users: dict[int, list[str]] = {}
    for node in report.nodes:
        for tpdo in node.tpdos:
            if tpdo.enabled and tpdo.cob_id is not None:
                users.setdefault(tpdo.cob_id, []).append(f"TPDO{tpdo.number} of node {node.node_id}")
    for cob_id, names in users.items():
        if len(names) > 1:
            yield f"{report.bus.name}: COB-ID 0x{cob_id:X} is used by {' and '.join(names)}"


def _other_client(report: BusReport) -> Iterator[str]:
    """Yield that another SDO client was heard, if a node didn't answer: each takes the other's answers."""
    asked = [can_id for can_id in report.streams if can_id - 0x600 in range(1, 128)]
    if asked and any(node.error or not node.answers for node in report.nodes):
        yield (
            f"{report.bus.name}: another program asks nodes by SDO, and answers are mixed up; "
            "if it is a daemon (`handtouch status`), stop it while you scan, or use --listen"
        )


def _listen(survey: BusSurvey, seconds: float, report: BusReport) -> None:
    """Listen, and keep the statistics of this phase apart from the traffic of our own requests."""
    bits = survey.port.counters.bits
    start_ns = time.monotonic_ns()
    survey.receive(seconds)
    elapsed_s = (time.monotonic_ns() - start_ns) * 1e-9
    report.bus_load = (survey.port.counters.bits - bits) / elapsed_s / survey.port.bus.bitrate_bit_s
    streams = survey.traffic.frame_statistics.items()
    report.streams = {
        can_id: replace(stream, data_lengths=set(stream.data_lengths)) for can_id, stream in streams
    }


def _find_unconfigured(
    survey: BusSurvey,
    report: BusReport,
    request: ScanRequest,
    deployment: config.Deployment | None,
    progress: Progress,
) -> None:
    """Find nodes without a node id, assign one if requested, and read these nodes."""
    name = report.bus.name
    progress(f"{name}: searching nodes without a node id")
    master = LssMaster(survey.exchange_lss, request.lss_wait_s)
    kinds: list[NodeFacts | config.Node] = [*report.nodes, *(deployment.nodes.values() if deployment else ())]
    report.unconfigured = master.scan(
        _without_none([node.vendor_id for node in kinds]),
        _without_none([node.product_code for node in kinds]),
        _without_none([node.revision for node in report.nodes]),
    )
    problems = master.problems
    if request.first_assigned_id is not None:
        boots = dict(survey.traffic.boot_up_counts)
        assignment = _Assignment(survey, report, request.first_assigned_id, deployment, progress)
        for _ in range(_MAX_ASSIGNMENT_ROUNDS):
            assignment.assign_all(master)
            left = set(master.scan())  # assigned nodes don't respond any more, and hide no other
            problems = master.problems
            assignment.report_remaining(left)
            found = left - set(report.unconfigured)
            report.unconfigured = sorted(found.union(report.unconfigured))
            if not found:
                break
        problems = [*problems, *assignment.failures.values()]
        new = set(report.assigned.values())
        survey.receive(
            _BOOT_TIMEOUT_S,
            lambda: all(survey.traffic.boot_up_counts.get(i, 0) > boots.get(i, 0) for i in new),
        )
        report.nodes += survey.read_nodes(sorted(survey.probe_ids(sorted(new))))
    report.problems += [f"{name}: LSS: {problem}" for problem in dict.fromkeys(problems)]


class _Assignment:
    """Assignment of node ids to the unconfigured nodes of a report; `failures`: reason for each node."""

    def __init__(
        self,
        survey: BusSurvey,
        report: BusReport,
        first_id: int,
        deployment: config.Deployment | None,
        progress: Progress,
    ) -> None:
        self.failures: dict[LssAddress, str] = {}
        self._report, self._first_id, self._progress = report, first_id, progress
        self._pads = (
            {entry.pad.node_id: entry for entry in deployment.pads_on(report.bus.name)} if deployment else {}
        )
        self._taken = _node_ids(report) | survey.traffic.detected_nodes()
        self._owners = {
            (node.vendor_id, node.product_code, node.revision, node.serial): node.node_id
            for node in report.nodes
        }

    def assign_all(self, master: LssMaster) -> None:
        """Assign an id to each node that was not tried yet, one by one in the order of the serial numbers."""
        for address in sorted(self._report.unconfigured, key=lambda each: each.serial):
            if address in self._report.assigned or address in self.failures:
                continue
            if problem := self._assign(master, address):
                self.failures[address] = problem

    def report_remaining(self, left: Collection[LssAddress]) -> None:
        """Report nodes that still respond as unconfigured ones although an id was assigned to them."""
        for address, node_id in self._report.assigned.items():
            if address in left:
                text = (
                    f"{address}: a node without an id still responds after id {node_id} was assigned; some "
                    "nodes use it only after NMT reset communication (identifier 0x000, data 82 00, which "
                    "resets all nodes of the bus) or a power cycle; or another node has its address (0x1018)"
                )
                stored = self.failures.get(address, "")
                self.failures[address] = f"{text}; {stored}" if stored else text

    def _assign(self, master: LssMaster, address: LssAddress) -> str:
        """Assign an id to a node; return the problem, empty if there is none."""
        owner = self._owners.get(address.parts)
        if owner is not None:
            return (
                f"{address}: node {owner} has the same identity and would change its id, too; give each its "
                "own serial number (0x1018 sub 4)"
            )
        node_id = _free_id(address, self._pads, self._taken, self._first_id)
        if node_id is None:
            return f"{address}: no free node id from {self._first_id} upwards"
        self._progress(f"{self._report.bus.name}: node id {node_id} for serial {address.serial}")
        try:
            lost = master.assign_node_id(address, node_id)
        except LssError as error:
            return str(error)
        self._taken.add(node_id)
        self._report.assigned[address] = node_id
        return lost and (
            f"node {node_id} (serial {address.serial}) can't store its node id, which is lost at power-off: "
            f"{lost}"
        )


def _free_id(
    address: LssAddress, pads: Mapping[int, config.NamedPad], taken: set[int], first: int
) -> int | None:
    """Return the deployment's node id for this serial number, else the first unused one."""
    for node_id, entry in pads.items():
        if entry.pad.serial == address.serial and node_id not in taken:
            return node_id
    return next((i for i in range(first, 128) if i not in taken and i not in pads), None)


def _node_ids(report: BusReport) -> set[int]:
    return {node.node_id for node in report.nodes}


def _without_none(values: Sequence[int | None]) -> list[int]:
    return [value for value in values if value is not None]


@contextmanager
def _measure_duration(report: BusReport, step: str) -> Iterator[None]:
    """Enter the duration of a step."""
    start_ns = time.monotonic_ns()
    yield
    report.durations_s[step] = (time.monotonic_ns() - start_ns) * 1e-9
