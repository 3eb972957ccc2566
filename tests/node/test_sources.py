"""Values from lines of numbers and raw CAN frames: each sample once, with its time, and every loss said."""

from __future__ import annotations

import ast
import os
import select
import socket
import subprocess
import sys
import termios
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
from handtouch.node.noise import measure_noise, noise_of
from handtouch.node.pad_input import PadInput
from handtouch.node.service import NodeService
from handtouch.node.settings import NodeFile, Trim, load
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
BO_ 516 ROWS: 5 HAND
 SG_ ROW M : 0|8@1+ (1,0) [0|0] "" HAND
 SG_ a0 m0 : 8|16@1- (1,0) [0|0] "" HAND
 SG_ a1 m0 : 24|16@1- (1,0) [0|0] "" HAND
 SG_ b0 m1 : 8|16@1- (1,0) [0|0] "" HAND
 SG_ b1 m1 : 24|16@1- (1,0) [0|0] "" HAND
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


def open_lines(url: str, clock: Clock, **keys: Any) -> LinesReader:
    source = LinesSource.model_validate(
        {"kind": "lines", "url": url, "rate_hz": 100.0, "start_s": 0.0, **keys}
    )
    reader = source.make_reader(CHANNELS, Path(), clock)
    reader.open()
    return reader


def read_lines(reader: LinesReader) -> list[float] | None:
    reading = reader.read()
    return None if reading is None else reading.raw.tolist()


# --- lines


@pytest.mark.parametrize(
    ("line", "values"),
    [
        ("1,2,3,4", [1, 2, 3, 4]),
        ("1 2\t3;4 9\r", [1, 2, 3, 4, 9]),
        ("1.5, -2e3, .5 , +4.", [1.5, -2000, 0.5, 4]),
        ("1,2,3,4,", [1, 2, 3, 4]),
        ("[1, 2, 3, 4]", [1, 2, 3, 4]),
        ("(1, 2, 3, 4)", [1, 2, 3, 4]),
        ("x0:1 xa:2 y0:3 yb:4", [1, 2, 3, 4]),
        ("x0: 1, xa = 2", [1, 2]),
        ('{"x0": 1, "xa": 2}', [1, 2]),
        ("1,,3,4", None),
        ("1,2,3,four", None),
        ("1,2,3,nan", None),
        ("1,2,3,1e999", None),
        ("1,2,3,1_0", None),
        ("1,2,3,0x1F", None),
        ("12:30:01,2,3", None),
        ("x0:1 x0:2", None),
        ("x0,xa,y0,yb", None),
        ("", None),
    ],
)
def test_a_line_is_its_numbers_and_nothing_else(line: str, values: list[float] | None) -> None:
    found = parse_line(line.encode())
    assert (found and [value for name, value in found.items() if name.isdigit()]) == values


def test_values_are_named_by_their_labels() -> None:
    found = parse_line(b"time:17, yb=4 x0:1 xa: 2 y0:3")
    assert found is not None
    assert [found[name] for name in ("x0", "xa", "y0", "yb", "time")] == [1, 2, 3, 4, 17]


@given(st.binary(max_size=200))
@example(b"\xff\xfe1,2,3,4")
@example(b"1__0,2,3,4")
def test_any_line_is_finite_numbers_or_nothing(line: bytes) -> None:
    values = parse_line(line)
    assert values is None or np.isfinite(list(values.values())).all()


def test_each_line_is_read_once_and_the_newest_of_several(board: Board, clock: Clock) -> None:
    reader = open_lines(board.path, clock)
    try:
        board.print("9,9,9\n1,2,3,4\n5,6,7")  # begins within a line, and ends within one
        assert read_lines(reader) == [1, 2, 3, 4]
        assert read_lines(reader) is None
        clock.now_ns += 7 * MS
        board.print(",8\n9,10,11,12\n")
        reading = reader.read()
        assert reading is not None
        assert reading.raw.tolist() == [9, 10, 11, 12]
        assert (reading.is_timed, reading.sample_ns) == (False, clock.now_ns)
        assert (reader.samples, reader.skipped, reader.malformed) == (3, 1, 0)
    finally:
        reader.close()


def test_the_newest_line_is_read_of_more_than_fit_into_one_read(board: Board, clock: Clock) -> None:
    reader = open_lines(board.path, clock)
    try:
        for number in range(2000):
            board.print(f"{number},2,3,4\n")
            if number % 200 == 0:
                reader.drain()
        assert read_lines(reader) == [1999, 2, 3, 4]
    finally:
        reader.close()


def test_a_line_with_another_count_of_numbers_than_most_is_dropped(board: Board, clock: Clock) -> None:
    """Numbers of a torn line, or of two joined ones, would be taken for those of other channels."""
    reader = open_lines(board.path, clock)
    try:
        for text, values in (
            ("\n1,2,3,4\n", [1, 2, 3, 4]),
            ("1,2,3,45,6,7,8\n", None),
            ("5,6,7,8\n", [5, 6, 7, 8]),
            ("5,6,7\n", None),
            ("# the sketch prints a temperature, too, from now on\n1,2,3,4,25\n", None),
            ("1,2,3,5,25\n", [1, 2, 3, 5]),
        ):
            board.print(text)
            assert read_lines(reader) == values, text
        assert (reader.samples, reader.malformed) == (3, 3)  # the comment is none
    finally:
        reader.close()


def test_silence_and_lines_of_anything_else_are_failures_that_say_so(board: Board, clock: Clock) -> None:
    reader = open_lines(board.path, clock)
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
        board.print("1,2,3,4\n1,2,3,4\n")
        assert read_lines(reader) == [1, 2, 3, 4]
    finally:
        reader.close()


def test_a_board_that_restarts_when_its_port_is_opened_has_time_to_start(board: Board, clock: Clock) -> None:
    """Its port is left so that it doesn't restart again when it is closed and opened once more."""
    reader = open_lines(board.path, clock, start_s=5.0)
    try:
        for _ in range(100):
            clock.now_ns += 49 * MS
            assert reader.read() is None
        port = reader.fileno()
        assert port is not None
        assert not termios.tcgetattr(port)[2] & termios.HUPCL
        board.print("\n1,2,3,4\n")
        assert read_lines(reader) == [1, 2, 3, 4]
        clock.now_ns += 40 * MS
        assert reader.read() is None
        clock.now_ns += 11 * MS
        with pytest.raises(AdcError, match="for 50 ms"):
            reader.read()
    finally:
        reader.close()


def test_what_came_in_a_pause_of_the_process_is_no_sample(board: Board, clock: Clock) -> None:
    """Nobody knows when it came; nor is the pause a silence of the board."""
    reader = open_lines(board.path, clock)
    try:
        board.print("\n1,2,3,4\n")
        assert read_lines(reader) == [1, 2, 3, 4]
        clock.now_ns += 1000 * MS
        board.print("5,6,7,8\n9,10")
        assert read_lines(reader) is None
        board.print(",11,12\n13,14,15,16\n")
        assert read_lines(reader) == [13, 14, 15, 16]
        assert (reader.samples, reader.skipped, reader.malformed) == (2, 1, 0)
    finally:
        reader.close()


def test_a_port_has_one_reader(board: Board, clock: Clock) -> None:
    """Two would each get a part of the lines."""
    reader = open_lines(board.path, clock)
    try:
        with pytest.raises(AdcError, match=f"{board.path}: .*; close the program that has it"):
            open_lines(board.path, clock)
    finally:
        reader.close()


def test_a_port_that_vanishes_is_a_failure_and_may_come_back(board: Board, clock: Clock) -> None:
    reader = open_lines(board.path, clock)
    board.unplug()
    with pytest.raises(AdcError, match=board.path):
        reader.read()
    reader.close()
    with pytest.raises(AdcError) as error:
        open_lines("/dev/no-such-port", clock)
    assert error.value.kind is AdcFaultKind.FILE_MISSING


def test_datagrams_are_lines(clock: Clock) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    reader = open_lines(f"udp://127.0.0.1:{port}", clock)
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for text in (b"0,0,0,0", b"1,2,3,4", b"5,6,7,8\n"):
                sender.sendto(text, ("127.0.0.1", port))
            assert read_lines(reader) == [5, 6, 7, 8]
            assert (reader.samples, reader.malformed) == (3, 0)
    finally:
        reader.close()


def test_a_connection_that_breaks_is_made_again(clock: Clock) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"socket://127.0.0.1:{server.getsockname()[1]}"
        for values in ([1, 2, 3, 4], [5, 6, 7, 8]):
            reader = open_lines(url, clock)
            board, _ = server.accept()
            try:
                board.sendall(b"\n" + ",".join(map(str, values)).encode() + b"\n")
                file = reader.fileno()
                assert file is not None
                select.select([file], [], [], 10.0)
                assert read_lines(reader) == values
                board.close()
                with pytest.raises(AdcError, match=url):
                    reader.read()
            finally:
                reader.close()


# --- CAN frames


@pytest.fixture
def hand_bus(tmp_path: Path) -> Iterator[Any]:
    (tmp_path / "hand.dbc").write_text(DBC)
    with can.Bus(interface="virtual", channel=str(tmp_path)) as bus:
        yield bus


def dbc_reader(folder: Path, clock: Clock, signals: tuple[str, ...] = SIGNALS) -> DbcReader:
    settings = {"file": "hand.dbc", "interface": "virtual", "channel": str(folder), "rate_hz": 100.0}
    reader = DbcSource.model_validate({"kind": "dbc", **settings}).make_reader(signals, folder, clock)
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
        assert reader.fileno() is None  # frames have the kernel's times
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


def test_a_multiplexed_message_is_a_sample_when_each_of_its_parts_has_come(
    hand_bus: Any, tmp_path: Path, clock: Clock
) -> None:
    """A part that hasn't come again is no value of the next sample."""
    reader = dbc_reader(tmp_path, clock, ("a0", "a1", "b0", "b1"))

    def send_row(row: int, *counts: int) -> None:
        data = bytes((row,)) + b"".join(value.to_bytes(2, "little") for value in counts)
        hand_bus.send(can.Message(arbitration_id=516, data=data, is_extended_id=False))

    try:
        for sample in (1, 2):
            clock.now_ns += 10 * MS
            send_row(0, sample, 20)
            assert reader.read() is None, sample
            send_row(1, 30, 40)
            reading = reader.read()
            assert reading is not None
            assert reading.raw.tolist() == [sample, 20, 30, 40]
    finally:
        reader.close()


def test_a_sample_that_has_waited_for_longer_than_three_periods_is_dropped(
    hand_bus: Any, tmp_path: Path, clock: Clock
) -> None:
    reader = dbc_reader(tmp_path, clock)
    try:
        send(hand_bus, 513, 2, 4)
        send(hand_bus, 514, 6, 8)
        reader.drain()
        clock.now_ns += 31 * MS
        assert reader.read() is None
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
        with pytest.raises(AdcError, match=r"no frame with TIP_A\.x0, xa for 50 ms; 1 frames"):
            reader.read()
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
        (LINES + "\nlimits = [0, 400]", PAD, ('"tip": full_scale_ma = 10', "channel 1 ends at 8 mA")),
        (LINES + "\nlimits = [-400, 900]", PAD.replace("0.02", "-0.02"), ('"tip": full_scale_ma', "at 8 mA")),
        (LINES, PAD.replace("board", "bord"), ('"tip": source = bord', "there is no [source.bord]")),
        (LINES, PAD.replace("ma_per_unit = 0.02", ""), ('"tip": ma_per_unit: is missing',)),
        (LINES, PAD.replace("ma_per_unit", "gain_ohm"), ('"tip": gain_ohm = 0.02', "write ma_per_unit")),
        (LINES, PAD.replace("ma_per_unit = 0.02", "full_scale = 0"), ("full_scale must not be 0",)),
        (LINES, PAD + "\nfull_scale = 99", ("takes the place of",)),
        (
            LINES + "\nlimits = [0, 4095]", PAD.replace("ma_per_unit = 0.02", "full_scale = 9000"),
            ('"tip": full_scale = 9000', "channel 1 ends at 4095:"),
        ),
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
from handtouch.node.source import Source, SourceReader

class Ramp(Source):
    kind: Literal["ramp"]
    step: float

    def problem_of(self, channel, folder):
        return "" if channel.isdigit() else "must be the number of a channel"

    def make_reader(self, channels, folder, clock):
        return Reader(self, channels, folder, clock)

class Reader(SourceReader):
    unit = "steps"
    def __init__(self, source, channels, folder, clock):
        super().__init__(source, channels, folder, clock)
        self.values, self.step, self.clock = np.zeros(len(channels)), source.step, clock
    def open(self):
        self._begin()
    def receive(self):
        self.values = self.values + self.step
        self._keep(AdcReading(self.values, self.clock()))
    def close(self): pass
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

    def serve(
        self,
        source: str = "",
        pad: str = "",
        ma_per_unit: float = 0.02,
        channels: bool = True,
        unit: bool = True,
    ) -> NodeFile:
        text = f'kind = "lines"\nurl = "{self.board.path}"\nrate_hz = 100.0\n{source}'
        own = PAD.replace("0.02", str(ma_per_unit)) if channels else PAD[: PAD.index("channels")]
        own = own if unit else own.replace(f"ma_per_unit = {ma_per_unit}\n", "")
        pad = f"node_id = 5\nserial = 77\n{own}\n{pad}"
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
        for said in ("2 samples", "0 replaced by newer ones", "0 malformed lines"):
            assert said in bench.service.status()
    finally:
        bench.service.close()


@pytest.mark.parametrize("sign", [1, -1])
def test_values_that_are_no_currents_have_a_full_scale_of_their_own(
    tmp_path: Path, board: Board, sign: int
) -> None:
    bench = SourceBench(tmp_path, board)
    bench.serve(pad=f"full_scale = {sign * 4000}", unit=False)
    try:
        board.print("\n" + ",".join(str(sign * value) for value in (0, 400, 2000, 4000)) + "\n")
        assert bench.counts() == pytest.approx([0, 3276.7, 16383.5, 32767], abs=1)
    finally:
        bench.service.close()


def test_noise_is_measured_at_any_period(tmp_path: Path, board: Board, clock: Clock) -> None:
    def sleep(time_s: float) -> None:
        clock.now_ns += round(time_s * 1e9)
        board.print("1,2,3,4\n")

    path = write_node(tmp_path, LINES.replace('"-"', f'"{board.path}"'), PAD)
    (noise,) = measure_noise(load(path), 3, 0.5, sleep, clock)
    assert noise.mean_ma == pytest.approx([0.02, 0.04, 0.06, 0.08])


def test_the_noise_of_whole_numbers_has_their_rounding(tmp_path: Path) -> None:
    """A channel that reads 0 while nothing touches shows no noise."""
    path = write_node(
        tmp_path, LINES.replace('"-"', f'"{tmp_path / "lines"}"'), f"{PAD}\nfull_scale_ma = 1.0"
    )
    pad = PadInput(load(path).settings.pads[0], Trim(), [0, 1, 2, 3])
    whole = noise_of(pad, 0.02 * np.array([[0, 0, 5, 0.5], [0, 1, 5, 0.25], [0, 2, 5, 0.75]]))
    step_counts = 0.02 * 32767
    assert whole.std_counts[[0, 2]] == pytest.approx(step_counts / 12**0.5)
    assert whole.std_counts[1] == pytest.approx(step_counts * (1 + 1 / 12) ** 0.5)
    assert whole.std_counts[3] == pytest.approx(step_counts * 0.25)


def test_a_line_is_read_when_it_comes_and_sent_at_the_next_sync(tmp_path: Path, board: Board) -> None:
    """So its age is known: the node's status tells it."""
    bench = SourceBench(tmp_path, board)
    idle, _ = os.pipe()
    bench.wire.file = idle  # a bus that is waited for together with the board
    bench.serve()
    try:
        board.print("\n1,2,3,4\n")
        bench.service.poll(10.0)
        bench.t_ns += 2 * MS
        assert bench.counts() is not None  # 5 ms later
        assert "board: sampled -7.00 ms from SYNC" in bench.service.status()
    finally:
        bench.service.close()
        os.close(idle)


def test_no_line_is_lost_after_a_sync_that_found_none(tmp_path: Path, board: Board) -> None:
    bench = SourceBench(tmp_path, board)
    bench.serve()
    try:
        board.print("\n1,2,3,4\n")
        assert bench.counts() is not None
        assert bench.counts() is None
        board.print("5,6,7,8\n")
        bench.run(25)  # the node looks after its sources meanwhile
        assert bench.counts() is not None
    finally:
        bench.service.close()


def test_a_silent_board_is_an_emcy_and_its_return_clears_it(tmp_path: Path, board: Board) -> None:
    bench = SourceBench(tmp_path, board)
    bench.serve("start_s = 0.0")
    try:
        sent = bench.run(70)
        kinds = [data[3] for identifier, data in sent if identifier == 0x85]
        assert kinds == [AdcFaultKind.NO_CONVERSION]
        codes = []
        for _ in range(240):
            board.print("1,2,3,4\n")
            codes += [data[:2] for identifier, data in bench.sync() if identifier == 0x85]
        assert codes == [b"\0\0"]
        assert bench.counts() is None  # it has been silent since the last SYNC
    finally:
        bench.service.close()


@pytest.mark.parametrize(("limits", "ma_per_unit"), [("[0, 600]", 0.02), ("[-600, 0]", -0.02)])
def test_a_value_at_its_limit_is_sent_and_reported_as_saturated(
    tmp_path: Path, board: Board, limits: str, ma_per_unit: float
) -> None:
    """The daemon knows a saturated channel by its count. A converter without values on the other side of
    zero reads it while nothing touches."""
    bench = SourceBench(tmp_path, board)
    bench.serve(f"limits = {limits}", ma_per_unit=ma_per_unit)
    sign = round(ma_per_unit / 0.02)
    try:
        board.print("\n")
        sent = []
        for _ in range(4):
            board.print(f"0,{600 * sign},3,0\n")
            sent += bench.sync()
        assert [data[3:5] for identifier, data in sent if identifier == 0x85] == [
            bytes((AdcFaultKind.SATURATED, 0b0010))
        ]
        board.print(f"0,{600 * sign},3,0\n")
        counts = bench.counts()
        assert counts is not None
        assert counts[:2] == (0, 32767)
        assert abs(counts[2]) < 500
    finally:
        bench.service.close()


@pytest.mark.parametrize("count", [3, 9, 16])
def test_a_line_may_have_as_many_numbers_as_a_pad_has_channels(
    tmp_path: Path, board: Board, count: int
) -> None:
    bench = SourceBench(tmp_path, board)
    names = ", ".join(f'"{k + 1}"' for k in range(count))
    bench.serve(pad=f"channels = [{names}]", channels=False)
    try:
        values = [10 * (k + 1) for k in range(count)]
        board.print("\n" + ",".join(map(str, values)) + "\n")
        bench.sync()
        read = [bench.read_object(0x6401, k + 1) for k in range(count)]
        assert read == pytest.approx([0.02 * value * 3276.7 for value in values], abs=1)
    finally:
        bench.service.close()
