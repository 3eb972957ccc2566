"""Look at the buses: listen, ask every id who it is, find nodes without an id; change none without `assign`.

Public names: `Request`, `BusReport`, `scan`, `look`, `pads_on`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace

from handtouch import config
from handtouch.canbus.bus.port import Port
from handtouch.canbus.bus.slab import Slab
from handtouch.canbus.find.lss import LEAST_WAIT_S, LssAddress, LssError, LssMaster
from handtouch.canbus.find.survey import NodeFacts, Survey
from handtouch.canbus.find.traffic import Stream

_BOOT_S = 3.0  # a node that was given an id says that it is there within this

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Request:
    """What is wanted of a scan; `assign` is the first id to give, None to give none."""

    listen_only: bool = False
    lss: bool = False
    assign: int | None = None
    seconds: float = 1.0
    lss_wait_s: float = LEAST_WAIT_S


@dataclass(slots=True)
class BusReport:
    """What one bus holds. `took_s` names each step's seconds; counts are those of the whole scan."""

    bus: config.Bus
    load: float = 0.0
    streams: dict[int, Stream] = field(default_factory=dict)
    others: int = 0  # frames of 29-bit identifiers, remote and FD frames
    error_frames: int = 0
    nodes: list[NodeFacts] = field(default_factory=list)
    unconfigured: list[LssAddress] = field(default_factory=list)
    assigned: dict[LssAddress, int] = field(default_factory=dict)
    took_s: dict[str, float] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)


def scan(
    buses: Sequence[config.Bus],
    request: Request,
    deployment: config.Deployment | None = None,
    progress: Progress = lambda _: None,
) -> list[BusReport]:
    """Look at all buses at the same time. Raises BusError if one can't be opened."""
    with ExitStack() as opened, ThreadPoolExecutor(len(buses), "scan") as pool:
        ports = [_opened(bus, opened) for bus in buses]
        return list(pool.map(lambda port: look(port, request, deployment, progress), ports))


def _opened(bus: config.Bus, stack: ExitStack) -> Port:
    port = Port.open(bus, Slab(1))
    stack.callback(port.close)
    return port


def look(
    port: Port,
    request: Request,
    deployment: config.Deployment | None = None,
    progress: Progress = lambda _: None,
) -> BusReport:
    """Look at one bus that is open."""
    survey, report = Survey(port), BusReport(port.bus)
    name = port.bus.name
    silent = request.listen_only or port.bus.role == "listener"
    if silent and request.lss:
        report.problems.append(f"{name} has the role of a listener, which sends nothing: no LSS there")
    with _timed(report, "listen"):
        progress(f"{name}: listening for {request.seconds:g} s")
        _listen(survey, request.seconds, report)
    present: set[int] = set()
    if not silent:
        with _timed(report, "ask"):
            progress(f"{name}: asking ids 1 to 127")
            present = survey.ask()
        with _timed(report, "read"):
            told = lambda done: progress(f"{name}: {done} of {len(present)} nodes read")  # noqa: E731
            report.nodes = survey.read(sorted(present), told)
        if request.lss:
            with _timed(report, "lss"):
                _name_nodes(survey, report, request, deployment, progress)
    report.nodes += [survey.silent(node_id) for node_id in sorted(survey.traffic.nodes() - _ids(report))]
    report.nodes.sort(key=lambda node: node.node_id)
    report.problems += _clashes(report)
    counters = port.counters
    report.others, report.error_frames = counters.foreign, counters.errors
    if port.problem:
        report.problems.append(f"{name}: {port.problem}")
    if not report.nodes and not report.unconfigured:
        report.problems.append(
            f"{name}: no node was {'heard' if silent else 'found'}; are they powered, is the bit rate "
            f"{port.bus.bitrate_bit_s}, is the bus terminated?"
            + ("" if request.lss or silent else " Nodes without an id are found with --lss")
        )
    return report


def _clashes(report: BusReport) -> Iterator[str]:
    """Identifiers that TPDOs of several nodes have: their frames would destroy one another."""
    users: dict[int, list[str]] = {}
    for node in report.nodes:
        for tpdo in node.tpdos:
            if tpdo.enabled and tpdo.cob_id is not None:
                users.setdefault(tpdo.cob_id, []).append(f"TPDO{tpdo.number} of node {node.node_id}")
    for cob_id, names in users.items():
        if len(names) > 1:
            yield f"{report.bus.name}: identifier 0x{cob_id:X} is used by {' and '.join(names)}"


def _listen(survey: Survey, seconds: float, report: BusReport) -> None:
    """Listen, and keep what was heard apart from what our own requests will cause."""
    bits = survey.port.counters.bits
    start_ns = time.monotonic_ns()
    survey.listen(seconds)
    passed_s = (time.monotonic_ns() - start_ns) * 1e-9
    report.load = (survey.port.counters.bits - bits) / passed_s / survey.port.bus.bitrate_bit_s
    streams = survey.traffic.streams.items()
    report.streams = {can_id: replace(stream, sizes=set(stream.sizes)) for can_id, stream in streams}


def _name_nodes(
    survey: Survey,
    report: BusReport,
    request: Request,
    deployment: config.Deployment | None,
    progress: Progress,
) -> None:
    """Find nodes without an id, give them one if that is wanted, and read those."""
    name = report.bus.name
    progress(f"{name}: looking for nodes without an id")
    master = LssMaster(survey.exchange, request.lss_wait_s)
    kinds: list[NodeFacts | config.Node] = [*report.nodes, *(deployment.nodes.values() if deployment else ())]
    report.unconfigured = master.scan(
        _known([node.vendor_id for node in kinds]),
        _known([node.product_code for node in kinds]),
        _known([node.revision for node in report.nodes]),
    )
    if master.problem:
        report.problems.append(f"{name}: LSS: {master.problem}")
    if request.assign is None:
        return
    pads = pads_on(deployment, name)
    taken = _ids(report) | survey.traffic.nodes()
    boots = dict(survey.traffic.boots)
    for address in sorted(report.unconfigured, key=lambda each: each.serial):
        node_id = _free_id(address, pads, taken, request.assign)
        if node_id is None:
            report.problems.append(f"{name}: no id from {request.assign} upwards is free for {address}")
            continue
        progress(f"{name}: node id {node_id} for serial {address.serial}")
        try:
            lost = master.assign(address, node_id)
        except LssError as error:
            report.problems.append(f"{name}: LSS: {error}")
            continue
        taken.add(node_id)
        report.assigned[address] = node_id
        if lost:
            report.problems.append(
                f"{name}: node {node_id} (serial {address.serial}) can't store its id, which is lost with "
                f"the power: {lost}"
            )
    new = set(report.assigned.values())
    survey.listen(_BOOT_S, lambda: all(survey.traffic.boots.get(i, 0) > boots.get(i, 0) for i in new))
    report.nodes += survey.read(sorted(survey.ask(sorted(new))))


def _free_id(
    address: LssAddress, pads: Mapping[int, tuple[str, config.Pad]], taken: set[int], first: int
) -> int | None:
    """The id that the deployment has for this serial number, else the first that is nobody's."""
    for node_id, (_, pad) in pads.items():
        if pad.serial == address.serial and node_id not in taken:
            return node_id
    return next((i for i in range(first, 128) if i not in taken and i not in pads), None)


def pads_on(deployment: config.Deployment | None, bus: str) -> dict[int, tuple[str, config.Pad]]:
    """Pads on a bus with their names, by node id."""
    hands = deployment.hands if deployment else ()
    return {
        pad.node_id: (f"{hand.name}/{pad.link}", pad) for hand in hands for pad in hand.pads if pad.bus == bus
    }


def _ids(report: BusReport) -> set[int]:
    return {node.node_id for node in report.nodes}


def _known(values: Sequence[int | None]) -> list[int]:
    return [value for value in values if value is not None]


@contextmanager
def _timed(report: BusReport, step: str) -> Iterator[None]:
    """Enter how long a step took."""
    start_ns = time.monotonic_ns()
    yield
    report.took_s[step] = (time.monotonic_ns() - start_ns) * 1e-9
