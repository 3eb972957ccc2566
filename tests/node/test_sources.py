"""Values from lines of numbers and from raw CAN frames: each sample once, and every loss said."""

from __future__ import annotations

import ast
import os
import socket
import subprocess
import sys
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from handtouch.config.problems import ConfigError
from handtouch.node.adc_fault import AdcError, AdcFaultKind
from handtouch.node.dbc import DbcReader, DbcSource
from handtouch.node.lines import LinesReader, LinesSource, parse_line
from handtouch.node.service import NodeService
from handtouch.node.settings import NodeFile, load
from tests.node.conftest import MS, NodeBench

CHANNELS = ("1", "2", "3", "4")
DBC = """VERSION ""
NS_ :
BS_:
BU_: HAND
BO_ 513 TIP_A: 4 HAND
 SG_ x0 : 0|16@1- (0.5,0) [0|0] "" HAND
 SG_ xa : 16|16@1- (0.5,0) [0|0] "" HAND
BO_ 514 TIP_B: 4 HAND
 SG_ y0 : 0|16@1- (0.5,0) [0|0] "" HAND
 SG_ yb : 16|16@1- (0.5,0) [0|0] "" HAND
BO_ 515 PALM: 8 HAND
 SG_ x0 : 0|16@1- (1,0) [0|0] "" HAND
"""
SIGNALS = ("TIP_A.x0", "xa", "y0", "yb")


class Clock:
    """Monotonic time, which the test sets."""

    def __init__(self) -> None:
        self.now_ns = 10**12

    def __call__(self) -> int:
        return self.now_ns


@pytest.fixture
def clock() -> Clock:
    return Clock()


class Board:
    """A board on a serial port, which is a pseudo-terminal."""

    def __init__(self) -> None:
        self._board, self._port = os.openpty()
        tty.setraw(self._port)
        self.path = os.ttyname(self._port)

    def print(self, text: str) -> None:
        os.write(self._board, text.encode())

    def unplug(self) -> None:
        os.close(self._board)

    def close(self) -> None:
        os.close(self._port)


@pytest.fixture
def board() -> Iterator[Board]:
    made = Board()
    yield made
    made.close()


def read_lines(reader: LinesReader) -> list[float] | None:
    reading = reader.read()
    return None if reading is None else reading.raw.tolist()


# --- lines


@pytest.mark.parametrize(
    ("line", "values"),
    [
        ("1,2,3,4", [1, 2, 3, 4]),
        ("1 2\t3;4 9\r", [1, 2, 3, 4]),
        ("1.5, -2e3, 0, +4", [1.5, -2000, 0, 4]),
        ("x0:1 xa:2 y0:3 yb:4", [1, 2, 3, 4]),
        ("1,2,3", None),
        ("1,2,3,four", None),
        ("1,2,3,nan", None),
        ("1,2,3,4,inf", None),
        ("", None),
    ],
)
def test_a_line_is_a_sample_if_it_has_a_number_for_every_channel(
    line: str, values: list[float] | None
) -> None:
    assert parse_line(line.encode(), CHANNELS) == values


def test_values_are_named_by_their_labels() -> None:
    assert parse_line(b"time:17, yb=4 x0:1 xa:2 y0:3", ("x0", "xa", "y0", "yb")) == [1, 2, 3, 4]


@given(st.binary(max_size=200))
@example(b"\xff\xfe1,2,3,4")
@example(b"1__0,2,3,4")
def test_any_line_is_finite_numbers_or_nothing(line: bytes) -> None:
    values = parse_line(line, CHANNELS)
    assert values is None or (len(values) == 4 and np.isfinite(values).all())


def test_each_line_is_read_once_and_the_newest_of_several(board: Board, clock: Clock) -> None:
    reader = LinesReader(LinesSource(kind="lines", url=board.path, rate_hz=100.0), CHANNELS, clock)
    reader.open()
    try:
        board.print("9,9,9\n1,2,3,4\n5,6,7")  # begins within a line, and ends within one
        assert read_lines(reader) == [1, 2, 3, 4]
        assert read_lines(reader) is None
        clock.now_ns += 7 * MS
        board.print(",8\n9,10,11,12\n")
        reading = reader.read()
        assert reading is not None
        assert reading.raw.tolist() == [9, 10, 11, 12]
        assert (reading.is_timed, reading.span_ns) == (False, 7 * MS)
        assert (reader.samples, reader.malformed) == (3, 0)
    finally:
        reader.close()


def test_silence_and_lines_of_anything_else_are_failures_that_say_so(board: Board, clock: Clock) -> None:
    reader = LinesReader(LinesSource(kind="lines", url=board.path, rate_hz=100.0), CHANNELS, clock)
    reader.open()
    try:
        clock.now_ns += 49 * MS
        assert reader.read() is None
        board.print("\nhello\n1,2,3\n" + 3000 * "7")
        assert reader.read() is None
        board.print(3000 * "7")
        assert reader.read() is None
        board.print(",1,2,3\n")
        clock.now_ns += 2 * MS
        with pytest.raises(AdcError) as error:
            reader.read()
        assert error.value.kind is AdcFaultKind.NO_CONVERSION
        for said in (board.path, "1, 2, 3, 4", "50 ms", "3 lines"):
            assert said in str(error.value)
        board.print("1,2,3,4\n")
        assert read_lines(reader) == [1, 2, 3, 4]
    finally:
        reader.close()


def test_a_port_that_vanishes_is_a_failure_and_may_come_back(board: Board, clock: Clock) -> None:
    reader = LinesReader(LinesSource(kind="lines", url=board.path, rate_hz=100.0), CHANNELS, clock)
    reader.open()
    board.unplug()
    with pytest.raises(AdcError, match=board.path):
        reader.read()
    reader.close()
    missing = LinesSource(kind="lines", url="/dev/no-such-port", rate_hz=100.0)
    with pytest.raises(AdcError) as error:
        LinesReader(missing, CHANNELS, clock).open()
    assert error.value.kind is AdcFaultKind.FILE_MISSING


def test_datagrams_are_lines(clock: Clock) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    reader = LinesReader(
        LinesSource(kind="lines", url=f"udp://127.0.0.1:{port}", rate_hz=100.0), CHANNELS, clock
    )
    reader.open()
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for text in (b"0,0,0,0", b"1,2,3,4", b"5,6,7,8\n"):
                sender.sendto(text, ("127.0.0.1", port))
            assert read_lines(reader) == [5, 6, 7, 8]
            assert (reader.samples, reader.malformed) == (2, 0)  # the first may be the rest of one
    finally:
        reader.close()


# --- CAN frames


@pytest.fixture
def hand_bus(tmp_path: Path) -> Iterator[Any]:
    (tmp_path / "hand.dbc").write_text(DBC)
    with can.Bus(interface="virtual", channel=str(tmp_path)) as bus:
        yield bus


def dbc_reader(folder: Path, clock: Clock, **values: Any) -> DbcReader:
    settings = {"file": "hand.dbc", "interface": "virtual", "channel": str(folder), "rate_hz": 100.0}
    source = DbcSource.model_validate({"kind": "dbc", **settings, **values})
    reader = source.make_reader(SIGNALS, folder, clock)
    reader.open()
    return reader


def send(bus: Any, identifier: int, *counts: int, stamp_s: float = 0.0) -> None:
    data = b"".join(value.to_bytes(2, "little", signed=True) for value in counts)
    bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False, timestamp=stamp_s))


def test_a_sample_is_complete_when_all_its_frames_have_come(
    hand_bus: Any, tmp_path: Path, clock: Clock
) -> None:
    reader = dbc_reader(tmp_path, clock)
    try:
        assert reader.limits.tolist() == [[-16384.0, 16383.5]] * 4
        send(hand_bus, 513, 2, 4)
        assert reader.read() is None
        send(hand_bus, 515, 7, 7, 7, 7)
        send(hand_bus, 514, 6, -8)
        reading = reader.read()
        assert reading is not None
        assert reading.raw.tolist() == [1, 2, 3, -4]
        assert reader.read() is None
        assert reader.samples == 1
    finally:
        reader.close()


def test_frames_of_two_samples_never_make_one(hand_bus: Any, tmp_path: Path, clock: Clock) -> None:
    """One frame is lost: the others of that sample aren't joined with those of the next."""
    reader = dbc_reader(tmp_path, clock)
    try:
        send(hand_bus, 514, 30, 30)  # 513 before it was lost
        assert reader.read() is None
        for sample in (1, 2):
            clock.now_ns += 10 * MS
            send(hand_bus, 513, 2 * sample, 0)
            assert reader.read() is None, sample
            clock.now_ns += MS
            send(hand_bus, 514, 2 * sample, 0)
            reading = reader.read()
            assert reading is not None
            assert reading.raw.tolist() == [sample, 0, sample, 0]
    finally:
        reader.close()


def test_malformed_frames_are_counted_and_silence_names_the_frame(
    hand_bus: Any, tmp_path: Path, clock: Clock
) -> None:
    reader = dbc_reader(tmp_path, clock)
    try:
        send(hand_bus, 513, 1)  # too short
        send(hand_bus, 514, 1, 2)
        assert reader.read() is None
        clock.now_ns += 51 * MS
        with pytest.raises(AdcError, match="TIP_A") as error:
            reader.read()
        assert "TIP_B" not in str(error.value)
        assert reader.malformed == 1
    finally:
        reader.close()


# --- the file


def write_node(folder: Path, source: str, pad: str) -> Path:
    path = folder / "node.toml"
    path.write_text(f'[bus]\nchannel = "can0"\n[source.board]\n{source}\n[[pad]]\nname = "tip"\n{pad}\n')
    return path


LINES = 'kind = "lines"\nurl = "-"\nrate_hz = 100.0'
PAD = 'source = "board"\nma_per_unit = 0.02\nchannels = ["1", "2", "3", "4"]'


@pytest.mark.parametrize(
    ("source", "pad", "said"),
    [
        (LINES.replace("lines", "line"), PAD, ('[source.board]: kind = "line"', 'did you mean "lines"')),
        (LINES.replace("url", "port"), PAD, ("[source.board]: url: is missing",)),
        (LINES.replace('"-"', '"udp://0.0.0.0:5005"'), PAD, ("[source.board]: url", "this one's address")),
        (LINES.replace('"-"', '"udp://127.0.0.1"'), PAD, ("[source.board]: url", "udp://HOST:PORT")),
        (LINES.replace('"-"', '"http://x:1"'), PAD, ("[source.board]: url", "socket://HOST:PORT")),
        (LINES + "\nlimits = [5, 1]", PAD, ("[source.board]", "limits")),
        (LINES, PAD.replace("board", "bord"), ('"tip": source = bord', "there is no [source.bord]")),
        (LINES, PAD.replace("ma_per_unit = 0.02", ""), ('"tip": ma_per_unit: is missing',)),
        (LINES, PAD.replace("ma_per_unit", "gain_ohm"), ('"tip": gain_ohm = 0.02', "write ma_per_unit")),
        (LINES, PAD.replace('"4"', '"0"'), ('"tip": channels = 0', "number of a value")),
        (LINES, PAD.replace('source = "board"', ""), ("give either adc or source",)),
        (
            'kind = "dbc"\nfile = "no.dbc"\nchannel = "can1"\nrate_hz = 100.0', PAD,
            ("no.dbc: No such file", "give the path of the DBC file"),
        ),
        (
            'kind = "dbc"\nfile = "hand.dbc"\nchannel = "can1"\nrate_hz = 100.0',
            PAD.replace('"1", "2", "3"', '"TIP_A.x0", "xa", "y"'),
            ("channels = y", "TIP_B.y0", "channels = 4"),
        ),
        (
            'kind = "dbc"\nfile = "hand.dbc"\nchannel = "can1"\nrate_hz = 100.0',
            PAD.replace('"1"', '"x0"'), ("channels = x0", "several messages", "PALM.x0"),
        ),
    ],
)  # fmt: skip
def test_an_error_in_a_source_names_key_value_and_remedy(
    tmp_path: Path, source: str, pad: str, said: tuple[str, ...]
) -> None:
    (tmp_path / "hand.dbc").write_text(DBC)
    with pytest.raises(ConfigError) as error:
        load(write_node(tmp_path, source, pad))
    for text in said:
        assert text in str(error.value)


PLUG_IN = """
import numpy as np
from typing import Literal
from handtouch.node.iio import AdcReading
from handtouch.node.source import Source

class Ramp(Source):
    kind: Literal["ramp"]
    step: float

    def problem_of(self, channel, folder):
        return "" if channel.isdigit() else "must be the number of a channel"

    def make_reader(self, channels, folder, clock):
        return Reader(self.step, len(channels), clock)

class Reader:
    def __init__(self, step, count, clock):
        self._values, self._step, self._clock = np.zeros(count), step, clock
        self.limits, self.millivolts = np.tile((-9e9, 9e9), (count, 1)), (np.ones(count), np.zeros(count))
    def open(self): pass
    def read(self):
        self._values = self._values + self._step
        return AdcReading(self._values, self._clock())
    def drain(self): pass
    def close(self): pass
    def describe(self): return "a ramp"
"""


def test_a_kind_of_source_may_come_from_another_package(tmp_path: Path) -> None:
    """Installed as any package is, with an entry point; its table is checked as the others are."""
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "ramps.py").write_text(PLUG_IN)
    info = tmp_path / "site" / "ramps-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: ramps\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[handtouch.sources]\nramp = ramps:Ramp\n")
    good = write_node(tmp_path, 'kind = "ramp"\nstep = 2.0\nrate_hz = 100.0', PAD)
    program = (
        "import sys, pathlib\n"
        "from handtouch.node.noise import measure_noise\n"
        "from handtouch.node.settings import load\n"
        "(pad,) = measure_noise(load(pathlib.Path(sys.argv[1])), 3, 0.0)\n"
        "print(pad.mean_ma.tolist())\n"
    )
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path / 'site'}:{os.environ.get('PYTHONPATH', '')}"}

    def run(path: Path) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", program, str(path)]
        return subprocess.run(command, capture_output=True, text=True, check=False, env=environment)

    done = run(good)
    assert done.returncode == 0, done.stderr
    assert ast.literal_eval(done.stdout) == pytest.approx([0.08] * 4)
    done = run(write_node(tmp_path, 'kind = "ramp"\nstep = "2"\nrate_hz = 100.0', PAD))
    assert '[source.board]: step = "2": must be a number' in done.stderr


# --- the node


class SourceBench(NodeBench):
    """A node whose pad has a board's lines."""

    def __init__(self, folder: Path, board: Board) -> None:
        self.folder, self.board, self.t_ns = folder, board, 10**12
        super().__init__(folder, board)  # type: ignore[arg-type]

    def serve(self, source: str = "", pad: str = "") -> NodeFile:
        text = f'kind = "lines"\nurl = "{self.board.path}"\nrate_hz = 100.0\n{source}'
        pad = f"node_id = 5\nserial = 77\n{PAD}\n{pad}"
        file = load(write_node(self.folder, text, pad))
        bus: Any = self.wire
        self.service = NodeService(file, bus, clock=lambda: self.t_ns)
        self.service.start()
        self.send(0, bytes((1, 5)))
        return file


def test_a_board_s_numbers_are_the_currents_of_a_node_each_sent_once(tmp_path: Path, board: Board) -> None:
    bench = SourceBench(tmp_path, board)
    bench.serve()
    try:
        board.print("0,0,0,0\n10,20,30,40\n")
        assert bench.counts() == pytest.approx([0.02 * v * 3276.7 for v in (10, 20, 30, 40)], abs=1)
        assert bench.counts() is None  # no new line: no old value is sent for a new one
        board.print("11,20,30,40\n")
        assert bench.counts() is not None
        assert "2 lines, 0 malformed" in bench.service.status()
    finally:
        bench.service.close()


def test_a_silent_board_is_an_emcy_and_its_return_clears_it(tmp_path: Path, board: Board) -> None:
    bench = SourceBench(tmp_path, board)
    bench.serve()
    try:
        sent = bench.run(70)
        kinds = [data[3] for identifier, data in sent if identifier == 0x85]
        assert kinds == [AdcFaultKind.NO_CONVERSION]
        codes = []
        for _ in range(60):
            board.print("1,2,3,4\n")
            codes += [data[:2] for identifier, data in bench.run(20) if identifier == 0x85]
        assert codes == [b"\0\0"]
    finally:
        bench.service.close()


def test_a_value_at_its_limit_is_reported_as_saturated(tmp_path: Path, board: Board) -> None:
    bench = SourceBench(tmp_path, board)
    bench.serve("limits = [0, 400]")
    try:
        board.print("\n")
        sent = []
        for _ in range(4):
            board.print("1,400,3,4\n")
            sent += bench.sync()
        assert [data[3] for identifier, data in sent if identifier == 0x85] == [AdcFaultKind.SATURATED]
    finally:
        bench.service.close()
