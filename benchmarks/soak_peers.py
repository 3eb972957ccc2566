"""A hand beside other masters, floods, pauses and failing interfaces: no healthy node is lost.

On the host: 15 simulated nodes, master and SYNC on an injected bus with the program's own clock. Under
`tests/socketcan/vcan-run`: daemon and nodes as processes on vcan0, in real time. Acts follow one another,
each with a time to recover: NMT commands of another master (`nmt`), another SYNC producer (`sync`), SDO
client (`sdo`), unknown identifiers (`flood`), EMCY messages and frames of wrong length of the hand's nodes
(`emcy`, `short`), a pause of the host of 0.3, 0.6 or 2 s (`pause`), an interface that is down for up to 5 s
(`down`), and with --master coctl of Lely's CANopen stack (`gateway`): it boots as NMT master with a heartbeat
of its own, resets all nodes, commands some and reads one. Nodes may leave OPERATIONAL only by `nmt`,
`gateway` and `down`; a promise is broken by a node that is lost or faulted, that leaves it for another
reason, or that doesn't return. In the guest all processes share one processor: an event is counted apart (*no
processor*) if most nodes sent nothing in the two seconds before, by the kernel's stamps of their frames, and
its reason names host, bus or silence. Exit status 1 if a promise is broken.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import random
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import can

from benchmarks.page import Report, options, progress
from benchmarks.served_hand import PORT, VCAN, on_loopback
from handtouch.canbus import cia301
from handtouch.canbus.bus.bus_state import fault_from_exception
from handtouch.canbus.bus.loop_pause import LoopPause
from handtouch.canbus.bus.receivers import grow_receive_buffer
from handtouch.canbus.bus.sync import Sync
from handtouch.canbus.nodes import master as master_module
from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.canbus.nodes.spec import NodeEvent
from handtouch.canbus.objects import sdo
from handtouch.client import connect, request
from tests.canbus.conftest import MS, SYNC_PERIOD_MS, Jobs, Rig

GATEWAY = "gateway"
"""Act of a program of another stack, which the injected bus can't have."""
SHORT_BYTES = 2
ACCUSED = ("absent", "faulted")
COMMON_CAUSE = re.compile(
    "as from every|no SYNC on bus|bus can|no answer within|are being checked|settings can't be read"
)
"""Reasons that name the host or the bus, report silence without a cause, or wait for a check."""
INJECTED_SHORT = f"its PDO has {SHORT_BYTES} bytes"
"""Frames of the act `short`, if a node without processor time sends none of its own between them."""
MISSED_PERIODS, RECENT_S = 2.5, 2.0
SAMPLE_BYTES = 8


class Starvation(threading.Thread):
    """Times at which most nodes of vcan0 sent no sample, by the kernel's stamps: their process didn't run."""

    def __init__(self, ids: Sequence[int], period_s: float) -> None:
        super().__init__(daemon=True)
        self._limit_s = MISSED_PERIODS * period_s
        filters = [{"can_id": 0x280, "can_mask": 0x780}]
        self._bus = can.Bus(interface="socketcan", channel="vcan0", can_filters=filters)
        grow_receive_buffer(self._bus.socket)  # type: ignore[attr-defined]
        now_s = time.time()
        self._newest_s = dict.fromkeys(ids, now_s)
        self._gaps: deque[tuple[float, float, int]] = deque(maxlen=100_000)  # from, to, node id
        self._ended = threading.Event()

    def run(self) -> None:
        while not self._ended.is_set():
            try:
                message = self._bus.recv(0.1)
            except can.CanOperationError:  # the interface is down
                self._ended.wait(0.05)
                continue
            node_id = message.arbitration_id & 0x7F if message is not None else 0
            if message is None or node_id not in self._newest_s or message.dlc != SAMPLE_BYTES:
                continue
            before_s, self._newest_s[node_id] = self._newest_s[node_id], message.timestamp
            if message.timestamp - before_s > self._limit_s:
                self._gaps.append((before_s, message.timestamp, node_id))

    def was_recent(self, t_s: float) -> bool:
        """Return True if most nodes had a gap in the last seconds before a time (`time.time`)."""
        silent = {
            node for since_s, to_s, node in list(self._gaps) if since_s <= t_s and to_s >= t_s - RECENT_S
        }
        silent |= {node for node, newest_s in self._newest_s.items() if t_s - newest_s > self._limit_s}
        return 2 * len(silent) > len(self._newest_s)

    def close(self) -> None:
        """End the thread."""
        self._ended.set()
        self.join()
        self._bus.shutdown()


class Verdicts:
    """Counts acts and node events, and keeps what must not happen."""

    def __init__(self) -> None:
        self.starved: Counter[str] = Counter()  # events of nodes without processor time, by act
        self.acts: Counter[str] = Counter()
        self.left: Counter[str] = Counter()  # nodes that left OPERATIONAL, by act
        self.broken: list[str] = []

    def judge(self, act: str, node: str, old: str, new: str, reason: str, was_starved: bool = False) -> None:
        """Judge a node's event during an act or its recovery."""
        left = old == "operational" != new
        self.left[act] += left
        if act == "down" and (new == "absent" or old == "absent") and "bus can" in reason:
            return
        if new in ACCUSED or (act not in ("nmt", GATEWAY, "down") and (left or new == "stale")):
            named = COMMON_CAUSE.search(reason) or (act == "short" and INJECTED_SHORT in reason)
            self.record(act, f"{node}: {old} -> {new}: {reason}", was_starved and named)

    def record(self, act: str, what: str, excused: object) -> None:
        """Record what may happen only for want of processor time."""
        if excused:
            self.starved[act] += 1
        else:
            self.broken.append(f"{act}: {what}")

    def rows(self) -> list[dict[str, Any]]:
        """Return a row for each act."""
        return [
            {
                "act": act,
                "number": number,
                "left OPERATIONAL": self.left[act],
                "no processor": self.starved[act],
            }
            for act, number in self.acts.items()
        ]


SECOND = 1_000_000_000
NODES = range(1, 16)
PERIOD_NS, STEP_NS = SYNC_PERIOD_MS * MS, 5 * MS
RECOVERY_S = 10.0
ACTS = ("nmt", "sync", "sdo", "flood", "emcy", "short", "pause", "down", "nothing")
COMMANDS = (cia301.STOP_NODE, cia301.ENTER_PREOPERATIONAL, cia301.RESET_COMMUNICATION, cia301.RESET_NODE)
GUEST_PERIOD_MS, GUEST_HEARTBEAT_TIMEOUT_MS = 50, 1000


class InjectedHand(Rig):
    """The tests' nodes and master on an injected bus and clock, with SYNC and the daemon's order of work."""

    def __init__(self) -> None:
        super().__init__(len(NODES))
        self._sync = Sync([self.port], PERIOD_NS)
        self._pause = LoopPause(PERIOD_NS)
        self.plug_all()
        self._sync.start(self.t_ns)
        self.start()

    @property
    def is_operational(self) -> bool:
        """True if all nodes are."""
        return bool((self.master.states == NodeState.OPERATIONAL).all())

    def advance(self, seconds: float, during: Callable[[], None] = lambda: None) -> Iterator[NodeEvent]:
        """Advance the clock, with something in every step; yield the nodes' events."""
        for _ in range(round(seconds * SECOND / STEP_NS)):
            during()
            self._pause.begin_wait(self.t_ns)
            self._pass_time()
            yield from self._work(self.t_ns)

    def stop_for(self, seconds: float) -> Iterator[NodeEvent]:
        """Stop the loop while the nodes go on."""
        self._pause.begin_wait(self.t_ns)
        wake_ns = self.t_ns + STEP_NS
        for _ in range(round(seconds * SECOND / STEP_NS)):
            self._pass_time()
        yield from self._work(wake_ns)

    def take_down(self, seconds: float) -> Iterator[NodeEvent]:
        """Take the interface down for a time."""

        def fail() -> None:
            self.wire.fault = fault_from_exception(OSError(errno.ENETDOWN, "Network is down"))

        self.wire.down, self.wire.cut = True, {*NODES}
        yield from self.advance(seconds, fail)
        self.wire.down, self.wire.cut = False, set()

    def send_to_nodes(self, can_id: int, data: bytes) -> None:
        """Pass a frame to the nodes only."""
        self.devices.handle_frame(
            can.Message(arbitration_id=can_id, data=data, is_extended_id=False), self.t_ns
        )

    def send_to_all(self, can_id: int, data: bytes) -> None:
        """Send a frame of another device."""
        self.send_to_nodes(can_id, data)
        message = can.Message(arbitration_id=can_id, data=data, is_extended_id=False)
        self.wire.to_master.append((message, self.t_ns))

    def _pass_time(self) -> None:
        self.t_ns += STEP_NS
        self.devices.advance(self.t_ns)

    def _work(self, wake_ns: int) -> Iterator[NodeEvent]:
        if paused_ns := self._pause.end_wait(wake_ns, self.t_ns):
            self._sync.excuse_pause(paused_ns)
            self.master.excuse_pause(paused_ns, self.t_ns)
        self.pump()
        self._pause.end_receive(self.t_ns)
        for sync_ns in self._sync.poll(self.t_ns, self.t_ns):
            self.slab.begin_cycle(sync_ns)
        self.port.update_state(self.t_ns)
        self.master.poll(self.t_ns)
        assert isinstance(self.master._workers, Jobs)
        self.master._workers.work()
        self.pump()
        self.master.poll(self.t_ns)
        self.wire.sent.clear()
        yield from (event for event in self.master.drain_events() if isinstance(event, NodeEvent))

    def pump(self) -> None:
        """Receive what waits."""
        for can_id, data, arrival_ns in self.port.drain():
            if can_id == cia301.SYNC:
                self._sync.handle_sync("can", arrival_ns)
            else:
                self.master.handle_frame("can", can_id, data, arrival_ns)


def injected(hours: float) -> Verdicts:
    """Run the acts for so many hours of the injected clock."""
    master_module.ThreadPoolExecutor = Jobs  # type: ignore[attr-defined, assignment]
    sdo.SDO_TIMEOUT_S = 0.005  # of real time, while the injected clock stands still
    hand, verdicts, generator = InjectedHand(), Verdicts(), random.Random(1)
    list(hand.advance(2.0))
    assert hand.is_operational, hand.master.status()
    end_ns = hand.t_ns + round(hours * 3600 * SECOND)
    for act in itertools.cycle(ACTS):
        if hand.t_ns >= end_ns:
            break
        verdicts.acts[act] += 1
        if act == ACTS[0]:
            progress(
                f"{(hand.t_ns - end_ns) / 3600e9 + hours:.2f} of {hours:g} h, {len(verdicts.broken)} broken"
            )
        events = itertools.chain(_act_injected(hand, act, generator), hand.advance(RECOVERY_S))
        for event in events:
            old, new = event.old_state.name.lower(), event.new_state.name.lower()
            if old != new:
                verdicts.judge(act, f"node {event.slot + 1}", old, new, event.reason)
        if not hand.is_operational:
            verdicts.broken.append(f"{act}: not operational after {RECOVERY_S} s")
    hand.master.stop(hand.t_ns)
    return verdicts


def _act_injected(hand: InjectedHand, act: str, generator: random.Random) -> Iterator[NodeEvent]:
    choose = generator.choice
    if act == "nmt":
        hand.send_to_all(cia301.NMT, bytes((choose(COMMANDS), choose((0, *NODES)))))
        return iter(())
    if act == "pause":
        return hand.stop_for(choose((0.3, 0.6, 2.0)))
    if act == "down":
        return hand.take_down(generator.uniform(0.1, 5.0))

    def send() -> None:
        match act:
            case "sync":
                hand.send_to_all(cia301.SYNC, b"")
            case "sdo":
                hand.send_to_nodes(cia301.SDO_REQUEST + choose(NODES), b"\x40\x18\x10\x01" + bytes(4))
            case "flood":
                for _ in range(40):
                    hand.send_to_all(
                        generator.choice(FOREIGN_IDS), generator.randbytes(generator.randrange(9))
                    )
            case "emcy":
                hand.send_to_all(cia301.EMCY + choose(NODES), b"\x00\x10\x00" + bytes(5))
            case "short":
                hand.send_to_all(
                    choose((0x80, 0x280, 0x580, 0x700)) + choose(NODES), generator.randbytes(SHORT_BYTES)
                )

    return hand.advance(5.0, send)


FOREIGN_IDS = [
    can_id
    for can_id in range(1, 0x780)
    if can_id not in (cia301.SYNC, cia301.TIME) and can_id & 0x7F not in NODES
]
"""Identifiers that no node of the hand and no command has."""


def socketcan(minutes: float, gateway: Path | None) -> Verdicts:
    """Run the acts on vcan0 for so many minutes, against the daemon's own process."""
    verdicts, generator = Verdicts(), random.Random(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config = _guest_deployment(folder)
        with (folder / "run.txt").open("w") as output:
            command = [sys.executable, "-m", "handtouch"]
            nodes = subprocess.Popen([*command, "simulate", str(config)], stdout=output)
            daemon = subprocess.Popen([*command, "run", str(config)], stderr=output)
            try:
                return _run_guest(folder, daemon, verdicts, generator, minutes, gateway)
            finally:
                for process in (daemon, nodes):
                    process.terminate()
                    process.wait()
                log = (folder / "run.txt").read_text()
                print("\n".join(re.findall(r"^(?:WARNING|ERROR) (?!handtouch.loop).*", log, re.M)[-40:]))


def _guest_deployment(folder: Path) -> Path:
    config = on_loopback(folder, PORT)
    text = config.read_text().replace("[daemon]\n", "[daemon]\nsupervise = false\n")
    text = re.sub(r"sync_period_ms = [\d.]+", f"sync_period_ms = {GUEST_PERIOD_MS}", text)
    timeout = f"heartbeat_timeout_ms = {GUEST_HEARTBEAT_TIMEOUT_MS}"
    config.write_text(re.sub(r"heartbeat_timeout_ms = \d+", timeout, text))
    return config


def _run_guest(
    folder: Path,
    daemon: subprocess.Popen[bytes],
    verdicts: Verdicts,
    generator: random.Random,
    minutes: float,
    gateway: Path | None,
) -> Verdicts:
    endpoint = f"ipc://{folder}/control"
    pads = _wait_operational(endpoint, 300.0)
    ids = [pad["node_id"] for pad in pads]
    states = {pad["link"]: pad["node_state"] for pad in pads}
    starvation = Starvation(ids, GUEST_PERIOD_MS * 1e-3)
    starvation.start()
    began_s = time.monotonic()
    with (
        contextlib.closing(starvation),
        connect("health/*/*", endpoint=f"ipc://{folder}/live", queue=100_000) as health,
        can.Bus(interface="socketcan", channel="vcan0") as other,
    ):
        for act in itertools.cycle((*ACTS, GATEWAY) if gateway else ACTS):
            passed_s = time.monotonic() - began_s
            if passed_s > 60 * minutes:
                break
            progress(f"{passed_s / 60:.1f} of {minutes:g} min, {len(verdicts.broken)} broken; {act}")
            verdicts.acts[act] += 1
            if act == GATEWAY and gateway:
                _command_by_gateway(gateway, folder, ids, generator)
            else:
                _act_guest(act, daemon, other, ids, generator)
            time.sleep(3.0)
            try:
                _wait_operational(endpoint, 60.0)
            except TimeoutError as error:
                verdicts.record(act, str(error), starvation.was_recent(time.time()))
            since_boot_s = time.time() - time.monotonic()
            while (message := health.recv(0.1)) is not None:
                old, states[message.link] = states[message.link], message.node_state
                if old != message.node_state:
                    starved = starvation.was_recent(since_boot_s + message.t_ns * 1e-9)
                    verdicts.judge(act, message.link, old, message.node_state, message.reason, starved)
    return verdicts


def _act_guest(
    act: str,
    daemon: subprocess.Popen[bytes],
    other: can.BusABC,
    ids: list[int],
    generator: random.Random,
) -> None:
    def cangen(*words: str) -> None:
        subprocess.run(["cangen", "vcan0", *words], check=True, timeout=60)

    def send(can_id: int, data: bytes) -> None:
        message = can.Message(arbitration_id=can_id, data=data, is_extended_id=False)
        try:
            other.send(message, timeout=5)
        except can.CanOperationError:  # the socket's error of an interface that was down is reported once
            other.send(message, timeout=5)

    match act:
        case "nmt":
            send(cia301.NMT, bytes((generator.choice(COMMANDS), generator.choice((0, *ids)))))
        case "sync":
            cangen("-g", "70", "-n", "50", "-I", "80", "-L", "0")
        case "sdo":
            for node_id in ids * 3:
                send(cia301.SDO_REQUEST + node_id, b"\x40\x18\x10\x01" + bytes(4))
        case "flood":
            cangen("-g", "1", "-n", "3000", "-I", "37F", "-L", "8")
        case "emcy":
            for _ in range(300):
                send(cia301.EMCY + generator.choice(ids), b"\x00\x10\x00" + bytes(5))
        case "short":
            for _ in range(300):
                base = generator.choice((0x80, 0x280, 0x580, 0x700))
                send(base + generator.choice(ids), generator.randbytes(SHORT_BYTES))
        case "pause":
            daemon.send_signal(signal.SIGSTOP)
            time.sleep(generator.choice((0.3, 0.6, 2.0)))
            daemon.send_signal(signal.SIGCONT)
        case "down":
            subprocess.run(["ip", "link", "set", "vcan0", "down"], check=True)
            time.sleep(generator.uniform(0.1, 5.0))
            subprocess.run(["ip", "link", "set", "vcan0", "up"], check=True)


def _command_by_gateway(gateway: Path, folder: Path, ids: list[int], generator: random.Random) -> None:
    """Have a CiA 309-3 gateway that is NMT master, Lely's coctl, boot the bus, command nodes and read one.

    It produces a heartbeat meanwhile, resets communication of all nodes when it begins, and ends by itself.
    """
    objects = {"1000": (7, 0), "1001": (5, 0), "1017": (6, 200), "1F80": (7, 1)}  # data type, value
    lists = (("Mandatory", ("1000", "1001")), ("Optional", ("1017", "1F80")))
    sections = [
        f"[{name}Objects]\nSupportedObjects={len(own)}\n"
        + "".join(f"{k}=0x{o}\n" for k, o in enumerate(own, 1))
        for name, own in lists
    ]
    sections += [
        f"[{name}]\nParameterName=x\nDataType={kind}\nAccessType=rw\nDefaultValue={value}\n"
        for name, (kind, value) in objects.items()
    ]
    dcf = folder / "gateway.dcf"
    dcf.write_text(
        "[DeviceInfo]\nBaudRate_1000=1\n" + "".join(sections) + "[DeviceComissioning]\nNodeID=127\n"
    )
    names = ("start", "stop", "preop", "reset comm", "reset node")
    commands = [f"1 {generator.choice((0, *ids))} {generator.choice(names)}" for _ in range(3)]
    lines = ["1 init 0", *commands, f"1 {generator.choice(ids)} r 0x1018 4 u32", ""]
    done = subprocess.run(
        [str(gateway), "-i", "300", "vcan0", str(dcf)],
        input="\n".join(lines), text=True, capture_output=True, timeout=60, check=False,
    )  # fmt: skip
    if done.returncode or "[1] OK" not in done.stdout:
        raise RuntimeError(f"{gateway} ended with status {done.returncode}: {done.stdout}{done.stderr}")


def _wait_operational(endpoint: str, seconds: float) -> list[dict[str, Any]]:
    end_s = time.monotonic() + seconds
    while True:
        pads: list[dict[str, Any]] = []
        with contextlib.suppress(TimeoutError):
            pads = request("status", endpoint=endpoint, timeout_s=10)["pads"]
        if pads and all(pad["node_state"] == "operational" for pad in pads):
            return pads
        if time.monotonic() > end_s:
            raise TimeoutError(f"not operational: {[pad['reason'] for pad in pads]}")
        time.sleep(0.2)


def main() -> int:
    parser = options(__doc__)
    parser.add_argument("--hours", type=float, default=2.0, help="of the injected clock (default: 2)")
    parser.add_argument("--minutes", type=float, default=20.0, help="on vcan0 (default: 20)")
    parser.add_argument(
        "--master", type=Path, help="path of coctl of Lely's CANopen stack, a second NMT master on vcan0"
    )
    arguments = parser.parse_args()
    report = Report(arguments.quick, "socketcan" if VCAN.exists() else "injected")
    if VCAN.exists():
        verdicts = socketcan(1.0 if arguments.quick else arguments.minutes, arguments.master)
    else:
        verdicts = injected(0.02 if arguments.quick else arguments.hours)
    skipped = [] if VCAN.exists() and arguments.master else [{"act": GATEWAY, "number": "skipped"}]
    report.table("Acts", [*verdicts.rows(), *skipped])
    report.table("Broken promises", [{"promise": line} for line in verdicts.broken[:20]])
    report.limit("broken promises", len(verdicts.broken), 0)
    return int(not report.keep())


if __name__ == "__main__":
    sys.exit(main())
