"""The clients in C++ and JavaScript read what the Python client reads."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import subprocess
import threading
import time
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from handtouch import wire
from handtouch.client import columns, connect
from tests.client.hand_messages import LINKS, make_contact, make_frame, make_service

LONGEST_S = 120.0
MESSAGES = 1500
LANGUAGES = ("cpp", "javascript")
NOT_IN_CPP = ("v", "frame")


@pytest.fixture
def programs(cpp: Path, javascript: Path) -> dict[str, list[str]]:
    """Commands that run the dump programs."""
    return {"cpp": [str(cpp / "dump")], "javascript": ["node", str(javascript / "dump.mjs")]}


@pytest.fixture
def program(request: pytest.FixtureRequest, programs: dict[str, list[str]]) -> list[str]:
    """Command of one language."""
    return programs[request.param]


Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def start() -> Iterator[Start]:
    """Return a function that starts a program; it ends with the test."""
    with contextlib.ExitStack() as stack:

        def started(program: list[str], *arguments: str) -> subprocess.Popen[str]:
            pipe = subprocess.PIPE
            process = subprocess.Popen(
                [*program, *arguments], stdin=pipe, stdout=pipe, stderr=pipe, text=True
            )
            stack.enter_context(process)
            stack.callback(process.kill)
            return process

        yield started


def _lines(process: subprocess.Popen[str]) -> list[dict[str, Any]]:
    output, _ = process.communicate(timeout=LONGEST_S)
    assert process.returncode == 0
    return [_with_integers(json.loads(line)) for line in output.splitlines()]


def _with_integers(line: dict[str, Any]) -> dict[str, Any]:
    """Times as integers: JavaScript prints them as text."""
    for key, value in line.items():
        if key.endswith("_ns"):
            line[key] = [int(item) for item in value] if isinstance(value, list) else int(value)
    return line


def _expected(message: wire.Message) -> dict[str, Any]:
    """All fields of a message; columns as flat lists, nil for NaN."""
    if isinstance(message, wire.HandFrame):
        values = wire.to_map(message)
        flat = {name: array.ravel().tolist() for name, array in columns(message).items()}
        values |= {name: [None if item != item else item for item in column] for name, column in flat.items()}
    else:
        values = dataclasses.asdict(message)
    return {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}


def _assert_same(line: dict[str, Any], message: wire.Message) -> None:
    expected = _expected(message)
    defaults = {f.name: f.default for f in dataclasses.fields(message)}
    for key, value in expected.items():
        if key not in line and key in NOT_IN_CPP:
            continue
        default = defaults[key]
        got = _as(value, line.get(key, [] if default == () else default))
        assert got == value, (key, got, value)


def _as(value: Any, got: Any) -> Any:
    """Floats where these are expected: JSON of JavaScript has no ".0"."""
    if isinstance(value, dict) and isinstance(got, dict) and value.keys() == got.keys():
        return {name: _as(item, got[name]) for name, item in value.items()}
    if isinstance(value, list) and isinstance(got, list):
        return [_as(*pair) for pair in zip(value, got, strict=True)]
    return float(got) if isinstance(value, float) and isinstance(got, int) else got


def _random_messages(count: int) -> Iterator[wire.Message]:
    """Contacts and frames with every field, of all magnitudes; half of the optional ones are absent."""
    rng = np.random.default_rng(7)

    def real(*shape: int) -> Any:
        return rng.normal(size=shape) * 10.0 ** rng.integers(-30, 30, size=shape)

    def maybe(*shape: int) -> Any:
        if rng.random() < 0.5:
            return None
        return tuple(real(*shape).tolist()) if shape else float(real())

    def part() -> wire.ContactPart:
        sizes = {"position_m": 3, "normal": 3, "covariance_m2": 9}
        frames = [prefix for prefix in ("", "palm_", "base_") if not prefix or rng.random() < 0.5]
        vectors = {f"{frame}{name}": real(size).tolist() for frame in frames for name, size in sizes.items()}
        return typing.cast(wire.ContactPart, {"force_n": maybe(), "force_std_n": maybe(), "id": 1, **vectors})

    def pick(codes: Any) -> Any:
        return list(codes)[rng.integers(len(codes))].text

    optional = [field.name for field in dataclasses.fields(wire.HandFrame) if field.default == b""]
    for seq in range(1, count + 1):
        t_ns = int(rng.integers(2**62))
        if seq % 2:
            values = {}
            for name, column in wire.COLUMNS[wire.HandFrame].items():
                if name in optional and rng.random() < 0.5:
                    continue
                shape = (len(LINKS), column.elements)
                if column.dtype == "<f4":
                    array = real(*shape)
                    array[rng.random(shape) < 0.2] = np.nan
                else:
                    array = rng.integers(
                        0, np.iinfo(column.dtype).max, shape, endpoint=True, dtype=column.dtype
                    )
                values[name] = array
            yield make_frame(seq, t_ns=t_ns, session=int(rng.integers(2**53)), **values)
        else:
            contact = make_contact(
                "index_tip", ("begin", "update", "end")[seq % 3], int(rng.integers(2**32)), seq
            )
            places = {
                f"{prefix}{name}": maybe(size)
                for prefix in ("", "palm_", "base_")
                for name, size in (("position_m", 3), ("normal", 3), ("covariance_m2", 9))
            }
            places["mount_covariance_m2"] = maybe(9)
            numbers = ("force_n", "force_std_n", "peak_force_n", "residual", "residual_std", "joints_age_s")
            yield dataclasses.replace(
                contact,
                **places,
                **{name: maybe() for name in (*numbers, "uncompensated_force_n")},
                t_ns=t_ns,
                begin_ns=int(rng.integers(2**62)),
                pad_m=maybe(2),
                total_current_a=float(real()),
                group=int(rng.integers(2)),
                fresh=bool(rng.integers(2)),
                position_status=pick(wire.PositionStatus),
                force_status=pick(wire.ForceStatus),
                palm_status=pick(wire.FrameStatus),
                base_status=pick(wire.FrameStatus),
                diagnoses=("gum", "worn")[: rng.integers(3)],
                parts=(part(), part()) if rng.random() < 0.5 else (),
            )


def test_every_message_is_read_as_python_reads_it(
    publisher: Any, endpoints: dict[str, str], programs: dict[str, list[str]], start: Start
) -> None:
    processes = [start(program, "all", endpoints["live"], str(MESSAGES)) for program in programs.values()]
    with connect("contact/*/*", "hand/*", endpoint=endpoints["live"], queue=2 * MESSAGES) as messages:
        for _ in range(len(processes) + 3):  # each has one subscription, the Python client three
            assert publisher.poll(1000 * LONGEST_S)
            publisher.recv()
        for message in _random_messages(MESSAGES):
            publisher.send_multipart(wire.encode(message))
        outputs = [_lines(process) for process in processes]
        for lines in zip(*outputs, strict=True):
            read = messages.recv(LONGEST_S)
            assert read is not None
            for line in lines:
                _assert_same(line, read)
        assert len(outputs[0]) == MESSAGES
        assert messages.malformed_messages == 0


@pytest.mark.parametrize("program", LANGUAGES, indirect=True)
def test_the_newest_frames_of_a_daemon_are_those_of_its_messages(
    working: Any, program: list[str], start: Start
) -> None:
    endpoint = working.endpoints["live"]
    with connect("contact/right/*", "hand/right", endpoint=endpoint, queue=100_000) as messages:
        assert messages.recv(LONGEST_S) is not None
        lines = _lines(start(program, "newest", endpoint, "100"))
        frames = [line for line in lines if line["kind"] == "hand"]
        assert len(frames) == 100
        seqs = [line["seq"] for line in frames]
        assert seqs == sorted(set(seqs))
        by_topic = {(line["kind"], line.get("link"), line["seq"]): line for line in lines}
        compared = 0
        while (message := messages.recv(LONGEST_S)) is not None:
            assert isinstance(message, wire.Contact | wire.HandFrame)
            kind, link = ("hand", None) if isinstance(message, wire.HandFrame) else ("contact", message.link)
            line = by_topic.get((kind, link, message.seq))
            if line is not None and not line["retained"] and not message.retained:
                _assert_same(line, message)
                compared += 1
            if kind == "hand" and message.seq >= seqs[-1]:
                break
    assert compared > 90
    active: dict[str, int] = {}
    shown = 0
    for line in lines:
        if line["kind"] == "hand":
            assert line["contacts"] in (active, {})  # none when the program stalled for 1.5 s
            shown += line["contacts"] == active != {}
        elif line["event"] == "end":
            active.pop(line["link"], None)
        else:
            active[line["link"]] = line["id"]
    assert shown > 10


@pytest.mark.parametrize("ends", [False, True], ids=["hangs", "ends"])
def test_no_frame_is_old_after_the_daemon_hung_or_ended_while_programs_computed(
    publisher: Any, endpoints: dict[str, str], programs: dict[str, list[str]], start: Start, ends: bool
) -> None:
    running = [start(program, "ages", endpoints["live"], "100") for program in programs.values()]
    seqs, ready = itertools.count(1), threading.Event()

    def publish() -> None:
        t_ns = time.monotonic_ns()
        publisher.send_multipart(wire.encode(make_frame(next(seqs), t_ns=t_ns)))
        time.sleep(0.005)

    def await_ready() -> None:
        for process in running:
            assert process.stdout is not None
            process.stdout.readline()
        ready.set()

    reader = threading.Thread(target=await_ready)
    reader.start()
    end_s = time.monotonic() + LONGEST_S
    while not ready.is_set() and time.monotonic() < end_s:
        publish()
    for _ in range(100):  # these wait in the programs
        publish()
    if ends:
        publisher.close(linger=1000)
    else:
        time.sleep(1.0)
    for process in running:
        output, _ = process.communicate("\n", timeout=LONGEST_S)
        lines = [json.loads(line) for line in output.splitlines()]
        assert len(lines) == 100
        assert all(line["kind"] == "none" or line["age_s"] < 0.1 for line in lines)
        assert lines[-1]["kind"] == "none"


@pytest.mark.parametrize("program", LANGUAGES, indirect=True)
def test_an_unknown_hand_is_an_error_that_names_those_of_the_daemon(
    program: list[str], start: Start, publisher: Any, endpoints: dict[str, str]
) -> None:
    reader = start(program, "unknown", endpoints["live"])
    for _ in range(3):
        assert publisher.poll(1000 * LONGEST_S)
        publisher.recv()
    publisher.send_multipart(wire.encode(make_service(hands={"right": [], "left": []})))
    assert reader.communicate(timeout=LONGEST_S)[0] == "the daemon has no hand 'rigth'; it has right, left\n"


def test_the_absence_of_a_daemon_is_logged(
    programs: dict[str, list[str]], start: Start, endpoints: dict[str, str]
) -> None:
    running = [start(program, "newest", endpoints["live"], "1") for program in programs.values()]
    for reader in running:
        assert reader.stderr is not None
        line = reader.stderr.readline()
        assert line == f"handtouch: no daemon at {endpoints['live']}; start `handtouch run FILE`\n"


@pytest.mark.parametrize("program", LANGUAGES, indirect=True)
def test_a_pad_that_is_not_sampled_is_neither_touched_nor_clear(program: list[str]) -> None:
    text = "".join(f"{wire.encode(make_frame(state=(state,) * 3))[1].hex()}\n" for state in range(9))
    done = subprocess.run([*program, "touched"], input=text, capture_output=True, text=True, check=False)
    lines = done.stdout.splitlines()
    assert lines[:2] == ["clear", "touched"], done.stderr
    assert len(lines) == 9
    assert all("thumb_tip is touched isn't known" in line for line in lines[2:])


@pytest.mark.parametrize("program", LANGUAGES, indirect=True)
def test_malformed_frames_are_refused(program: list[str]) -> None:
    """Cut off, altered, of another version, nested without end, with a column of another length."""
    good = wire.encode(make_frame())[1]
    rng = np.random.default_rng(5)
    payloads = [good, *(good[:size] for size in range(0, len(good), 7)), b"\xc1", b"", b"\x07"]
    payloads += [b"\x91" * 100_000, b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", good + b"\xc0"]
    for _ in range(300):
        altered = bytearray(good)
        altered[rng.integers(len(good))] = rng.integers(256)
        payloads.append(bytes(altered))
    for change in ({"v": 2}, {"force_n": bytes(11)}, {"links": 3}, {"session": None}):
        payloads.append(msgpack.packb({**msgpack.unpackb(good), **change}))
    text = "".join(f"{payload.hex()}\n" for payload in payloads)
    done = subprocess.run([*program, "decode"], input=text, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    answers = done.stdout.split()
    assert len(answers) == len(payloads)
    assert answers[0] == "ok"
    cut_off = len(range(0, len(good), 7)) + 7
    assert set(answers[1 : 1 + cut_off]) == {"refused"}
    assert set(answers[-4:]) == {"refused"}


UNKNOWN_VALUES = (
    None,
    True,
    -1,
    2**63 + 1,
    2**64 - 1,
    1.5,
    "text",
    b"binary",
    [1, [2, None]],
    {"key": {1: 2, "a": [1]}},
    msgpack.Timestamp(1, 2),
    msgpack.ExtType(5, b"x" * 300),
    msgpack.ExtType(6, b"1"),
)


@pytest.mark.parametrize("program", LANGUAGES, indirect=True)
def test_keys_of_a_later_version_are_skipped_whatever_their_type(program: list[str]) -> None:
    good = msgpack.unpackb(wire.encode(make_frame())[1])
    payloads = [msgpack.packb(good | {"added_later": value}) for value in UNKNOWN_VALUES]
    text = "".join(f"{payload.hex()}\n" for payload in payloads)
    done = subprocess.run([*program, "decode"], input=text, capture_output=True, text=True, check=False)
    assert done.stdout.split() == ["ok"] * len(payloads), done.stderr
    for payload in payloads:
        assert isinstance(wire.decode([b"hand/right", payload]), wire.HandFrame)


def test_the_javascript_client_is_typed_and_complete_as_a_package(javascript: Path) -> None:
    options = ["--noEmit", "--strict", "--module", "nodenext", "--target", "es2022", "--lib", "es2022,dom"]
    compiler = ["node", str(javascript / "node_modules/typescript/bin/tsc"), *options, "typed.ts"]
    done = subprocess.run(compiler, cwd=javascript, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    package = javascript / "node_modules/handtouch"
    packed = subprocess.run(
        ["npm", "pack", "--dry-run", "--json"], cwd=package, capture_output=True, text=True, check=True
    )
    (listed,) = json.loads(packed.stdout)
    names = {f"{name}.js" for name in ("index", "messages", "fields")} | {"index.d.ts", "fields.d.ts"}
    assert {file["path"] for file in listed["files"]} == names | {"README.md", "package.json"}


def test_the_cpp_example_stops_on_touch(working: Any, cpp: Path) -> None:
    example = cpp / "package/stop_on_touch"
    arguments = ["right", "index_distal", working.endpoints["live"]]
    done = subprocess.run(
        [example, *arguments], capture_output=True, text=True, timeout=LONGEST_S, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "index_distal touched: " in done.stdout
    unknown = [example, "right", "index_tip", working.endpoints["live"]]
    done = subprocess.run(unknown, capture_output=True, text=True, timeout=LONGEST_S, check=False)
    assert (done.returncode, done.stderr[:48]) == (1, "no link index_tip; the links are thumb_proximal,")
