"""Sensors without CANopen become contacts: a board that prints numbers, and a hand with raw CAN frames."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import pytest

from handtouch import connect, wire
from handtouch.config import Deployment, load, shipped
from handtouch.hand import pad_channels, pad_surface
from tests.deployments import arcs_text
from tests.starter import Started, Starter, find_port, own_endpoints

ROOT = Path(__file__).parents[2]
CHANNEL = "239.74.163.2"
PERIOD_MS, SYNC_PERIOD_MS = 20.0, 22.0
LONGEST_S = 90.0
MAX_TRIES = 10
MA_PER_COUNT, TOTAL_MA = 0.005, 2.0
FULL_SCALE_COUNTS = 2000  # of the sensor, 10 mA
LATE_NS = 1_000_000 * round(3 * PERIOD_MS + 50 + SYNC_PERIOD_MS)
"""Longest that a value may have waited, before its SYNC: in the node, and in its queue"""
SIXTEEN_ARCS = {f"e{k}": (56.55 * k / 16 + 0.2, 56.55 * (k + 1) / 16 - 0.3) for k in range(16)}
PRESSES = ((0.4, 0.6), (0.65, 0.45))
"""Positions, as fractions of the pad's rectangle"""


class Case(NamedTuple):
    """A pad of a deployment: its link and channels, their unit in the file of the node, their sum where it is
    pressed, and the greatest value of one."""

    text: str
    link: str
    channels: int
    unit: str = f"ma_per_unit = {MA_PER_COUNT}"
    total: float = TOTAL_MA / MA_PER_COUNT
    greatest: int = FULL_SCALE_COUNTS

    def values(self, deployment: Deployment, at: tuple[float, float]) -> list[int]:
        (pad,) = [entry.pad for entry in deployment.pads if entry.pad.link == self.link]
        model = pad_channels(pad, deployment.sheet_of(pad), deployment.nodes[pad.node])
        shares = model.fractions(at[0] * model.a, at[1] * model.b)
        return [round(self.total * float(share)) for share in shares]

    def position_m(self, deployment: Deployment, at: tuple[float, float]) -> Any:
        (pad,) = [entry.pad for entry in deployment.pads if entry.pad.link == self.link]
        surface = pad_surface(pad)
        return surface.point(at[0] * surface.a, at[1] * surface.b)


CASES = {
    "four electrodes": Case(shipped.path("two_finger.toml").read_text(), "thumb_tip", 4),
    "nine taxels": Case(
        shipped.path("taxels.toml").read_text(), "tip", 9, "full_scale = 32767", 2000.0, 32767
    ),
    "sixteen electrodes": Case(arcs_text(SIXTEEN_ARCS), "disc", 16),
}


class Sensor(Protocol):
    """A simulated board or hand; `counts` may be changed at any time."""

    counts: list[int]

    def plug(self) -> None: ...

    def unplug(self) -> None: ...


class PtyBoard:
    """A board that prints its values on a pseudo-terminal, which has another name each time it is plugged."""

    def __init__(self, folder: Path, channels: int) -> None:
        self.counts = [0] * channels
        self.port = folder / "ttyBoard"
        self._file = -1
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def plug(self) -> None:
        self._file, port = os.openpty()
        tty.setraw(port)
        self.port.unlink(missing_ok=True)
        self.port.symlink_to(os.ttyname(port))
        self._stop.clear()
        self._thread = threading.Thread(target=self._print, args=(port,))
        self._thread.start()

    def unplug(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
            os.close(self._file)

    def _print(self, port: int) -> None:
        os.set_blocking(self._file, False)  # a board doesn't wait for whoever reads
        while not self._stop.wait(1e-3 * PERIOD_MS):
            line = ", ".join(map(str, self.counts)) + "\r\n"
            try:
                os.write(self._file, line.encode())
            except BlockingIOError:
                continue
        os.close(port)


class CanHand:
    """A hand that sends its values as raw CAN frames, four in each."""

    PROGRAM = """
import struct, sys, threading, time, can
channel, port, period_s, count = sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4])
counts = [0] * count
def read():
    for line in sys.stdin:
        counts[:] = map(int, line.split())
threading.Thread(target=read, daemon=True).start()
bus = can.Bus(interface="udp_multicast", channel=channel, port=port)
while True:
    for k in range(0, count, 4):
        data = struct.pack("<4h", *(counts[k : k + 4] + [0] * 3)[:4])
        bus.send(can.Message(arbitration_id=300 + k, data=data, is_extended_id=False))
    time.sleep(period_s)
"""

    def __init__(self, start: Callable[..., subprocess.Popen[bytes]], port: int, channels: int) -> None:
        self._start, self._port, self._channels = start, port, channels
        self._process: subprocess.Popen[bytes] | None = None
        self._counts = [0] * channels

    @property
    def counts(self) -> list[int]:
        return self._counts

    @counts.setter
    def counts(self, counts: list[int]) -> None:
        self._counts = counts
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.write(" ".join(map(str, counts)).encode() + b"\n")
            self._process.stdin.flush()

    def plug(self) -> None:
        words = ["-c", self.PROGRAM, CHANNEL, str(self._port), str(1e-3 * PERIOD_MS), str(self._channels)]
        self._process = self._start(*words, stdin=subprocess.PIPE)

    def unplug(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


class Bench:
    """A deployment served by `handtouch node` on a bus of its own."""

    def __init__(self, folder: Path, endpoints: dict[str, str], prefix: list[str], starter: Starter) -> None:
        self.folder, self.endpoints, self._prefix, self._starter = folder, endpoints, prefix, starter
        self.bus = (
            f'interface = "udp_multicast"\nchannel = "{CHANNEL}"\noptions = {{ port = {find_port()} }}\n'
        )
        self.config = folder / "hand.toml"
        self._running: list[subprocess.Popen[bytes] | Started] = []

    def write_hand(self, text: str, *changes: tuple[str, str]) -> Deployment:
        settings = "".join(f'{name} = "{endpoint}"\n' for name, endpoint in self.endpoints.items())
        lines = [
            line for line in text.splitlines() if not line.startswith(("interface", "channel =", "sync_p"))
        ]
        text = "\n".join(lines)
        for old, new in (
            ("[daemon]", f"[daemon]\nsupervise = false\nsync_period_ms = {SYNC_PERIOD_MS}\n{settings}"),
            ('name = "can0"', f'name = "can0"\n{self.bus}'),
            *changes,
        ):
            assert old in text, old
            text = text.replace(old, new)
        self.config.write_text(text)
        return load(self.config)

    def write_node(self, tables: str) -> Path:
        """Write the file of a node on the hand's bus."""
        path = self.folder / "node.toml"
        path.write_text(f"[bus]\n{self.bus}\n{tables}")
        return path

    def start(self, *command: str, **options: Any) -> subprocess.Popen[bytes]:
        words = [*self._prefix, sys.executable, *command]
        with (self.folder / f"{len(self._running)}.txt").open("wb") as output:
            started = subprocess.Popen(words, **{"stdout": output, "stderr": output, **options})
        self._running.append(started)
        return started

    def serve(self, *nodes: Path) -> None:
        for words in (*(("node", str(node)) for node in nodes), ("run", str(self.config))):
            with (self.folder / f"{len(self._running)}.txt").open("w") as output:
                self._running.append(self._starter.start([*words], output))

    def outputs(self) -> list[str]:
        return [path.read_text() for path in sorted(self.folder.glob("*.txt"))]

    def wait_for_output(self, text: str) -> None:
        end_s = time.monotonic() + LONGEST_S
        while not any(text in output for output in self.outputs()):
            assert time.monotonic() < end_s, self.outputs()
            time.sleep(0.02)

    def end(self) -> None:
        for process in self._running:
            process.terminate()
        for process in self._running:
            process.wait(LONGEST_S)


class Client:
    """Messages of one link."""

    def __init__(self, bench: Bench, link: str) -> None:
        self._bench = bench
        self._messages = connect(
            f"contact/*/{link}", f"health/*/{link}", endpoint=bench.endpoints["live"], key=""
        )

    def __enter__(self) -> Client:
        self._messages.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._messages.__exit__(*error)

    def wait_for(self, condition: Callable[[Any], bool]) -> list[Any]:
        """Return the messages up to the first that fulfils a condition, that included."""
        end_s, found = time.monotonic() + LONGEST_S, list[Any]()
        while not found or not condition(found[-1]):
            assert time.monotonic() < end_s, (found[-3:], self._bench.outputs())
            message = self._messages.recv(1.0)
            if message is not None:
                found.append(message)
        return found

    def wait_for_state(self, state: str) -> list[Any]:
        return self.wait_for(lambda message: isinstance(message, wire.Health) and message.state == state)

    def wait_for_event(self, event: str) -> wire.Contact:
        found = self.wait_for(lambda message: isinstance(message, wire.Contact) and message.event == event)
        contact: wire.Contact = found[-1]
        return contact


@pytest.fixture
def bench(tmp_path: Path, network: list[str], starter: Starter) -> Iterator[Bench]:
    with own_endpoints() as endpoints:
        made = Bench(tmp_path, endpoints, network, starter)
        yield made
        made.end()


@pytest.fixture
def sensor(kind: str, case: Case, bench: Bench, tmp_path: Path) -> Iterator[Sensor]:
    made: Sensor
    if kind == "lines":
        made = PtyBoard(tmp_path, case.channels)
        keys = f'url = "{made.port}"\nlimits = [0, {case.greatest}]'
        channels = [str(k + 1) for k in range(case.channels)]
    else:
        port = find_port()
        made = CanHand(bench.start, port, case.channels)
        keys = f'file = "hand.dbc"\n{bench.bus.partition("options")[0]}options = {{ port = {port} }}'
        channels = [f"c{k}" for k in range(case.channels)]
        messages = [
            f"BO_ {300 + k} M{k}: 8 HAND\n"
            + "".join(f' SG_ c{k + i} : {16 * i}|16@1- (1,0) [0|0] "" HAND\n' for i in range(4))
            for k in range(0, case.channels, 4)
        ]
        (tmp_path / "hand.dbc").write_text('VERSION ""\nNS_ :\nBS_:\nBU_: HAND\n' + "".join(messages))
    deployment = bench.write_hand(case.text, *URDF_OF_SHIPPED if "urdf" in case.text else ())
    (pad,) = [entry.pad for entry in deployment.pads if entry.pad.link == case.link]
    node = bench.write_node(
        f'[source.sensor]\nkind = "{kind}"\nrate_hz = {1e3 / PERIOD_MS}\n{keys}\n'
        f'[[pad]]\nname = "{case.link}"\nnode_id = {pad.node_id}\nserial = {pad.serial or 1}\n'
        f'source = "sensor"\n{case.unit}\nchannels = {channels}\n'.replace("'", '"')
    )
    made.plug()
    bench.serve(node)
    yield made
    made.unplug()


URDF_OF_SHIPPED = (("two_finger.urdf", str(shipped.path("two_finger.urdf"))),)


@pytest.mark.parametrize(
    ("kind", "case"),
    [
        ("lines", CASES["four electrodes"]),
        ("dbc", CASES["nine taxels"]),
        pytest.param("lines", CASES["sixteen electrodes"], id="lines of sixteen"),
    ],
    ids=lambda value: getattr(value, "link", value),
)
def test_values_of_a_sensor_become_contacts_until_it_is_unplugged(
    sensor: Sensor, case: Case, bench: Bench
) -> None:
    """A contact begins, moves and ends. Unplugged, the pad is unknown, and no old value is shown for new;
    plugged in again, it detects contacts."""
    deployment = load(bench.config)

    def press(at: tuple[float, float]) -> Any:
        sensor.counts = case.values(deployment, at)
        return case.position_m(deployment, at)

    def is_near(message: Any, place: Any) -> bool:
        is_located = isinstance(message, wire.Contact) and message.position_m is not None
        return is_located and bool(np.linalg.norm(np.subtract(message.position_m, place)) < 0.5e-3)

    def press_until_located(at: tuple[float, float]) -> int:
        place = press(at)
        return int(client.wait_for(lambda message: is_near(message, place))[-1].id)

    with Client(bench, case.link) as client:
        client.wait_for_state("clear")
        first, second = PRESSES
        moved = (press_until_located(first) == press_until_located(second) for _ in range(MAX_TRIES))
        assert any(moved)  # a machine that pauses for ten samples ends a contact
        sensor.counts = [0] * case.channels
        client.wait_for_event("end")

        last_id = press_until_located(first)
        sensor.unplug()
        unplugged_ns = time.monotonic_ns()
        shown = client.wait_for_state("stale")
        shown += client.wait_for(lambda message: getattr(message, "event", "") == "end")
        updates = [message for message in shown if getattr(message, "event", "") == "update"]
        assert all(message.t_ns <= unplugged_ns + LATE_NS for message in updates if message.fresh)
        bench.wait_for_output(f"ERROR handtouch.node: pad {case.link}: ")

        sensor.counts = [0] * case.channels
        sensor.plug()
        client.wait_for_state("clear")
        assert press_until_located(second) > last_id


def test_the_commands_of_the_how_to_show_contacts_on_links(bench: Bench) -> None:
    """With the shipped files."""
    shipped_node = (ROOT / "config" / "board_node.toml").read_text()
    node = bench.write_node(shipped_node[shipped_node.index("[source.board]") :])
    bench.write_hand(CASES["four electrodes"].text, *URDF_OF_SHIPPED)
    board = bench.start(str(ROOT / "examples" / "print_board.py"), stdout=subprocess.PIPE)
    assert board.stdout is not None
    with board.stdout:
        bench.start("-m", "handtouch", "node", str(node), stdin=board.stdout)
    bench.serve()
    links = set()
    with Client(bench, "*") as client:
        for _ in range(60):
            found = client.wait_for(lambda message: getattr(message, "position_status", "") == "valid")
            contact: wire.Contact = found[-1]
            links.add(contact.link)
            assert contact.force_n is not None
            assert 0.2 < contact.force_n < 5
            if contact.link == "thumb_tip":  # a plate of 30 mm, touched along its middle
                assert contact.position_m is not None
                x_m, y_m, _ = contact.position_m
                assert abs(x_m) < 0.008 if abs(y_m) < 0.001 else abs(x_m) < 0.001
    assert links == {"thumb_tip", "index_tip"}
