"""Recordings of strangers: nothing of this machine is deleted, opened to others or read for them."""

from __future__ import annotations

import json
import random
import struct
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path
from typing import Any

import lz4.frame
import msgpack
import pytest
import zmq
import zstandard
from mcap.opcode import Opcode
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from handtouch.cli import main
from handtouch.client import connect
from handtouch.host.endpoints import check_ipc_path
from handtouch.record.recording import MAGIC, MAX_CHUNK_BYTES, Recording
from tests.starter import find_port

LONGEST_S = 60.0


def rewrite(source: Path, target: Path, change: Any) -> Path:
    """Copy a recording; `change` gets topic and payload of each message of handtouch, and may change it."""
    schemas: dict[int, int] = {}
    channels: dict[int, tuple[int, Channel]] = {}
    with source.open("rb") as file, target.open("wb") as out:
        writer = Writer(out, compression=CompressionType.ZSTD)
        writer.start(profile="", library="x")
        for record in StreamReader(file).records:
            if isinstance(record, Schema):
                schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            elif isinstance(record, Channel):
                schema_id = schemas.get(record.schema_id, 0)
                number = writer.register_channel(record.topic, record.message_encoding, schema_id)
                channels[record.id] = number, record
            elif isinstance(record, Message):
                number, channel = channels[record.channel_id]
                data = record.data
                if channel.message_encoding == "msgpack":
                    payload = msgpack.unpackb(data)
                    change(channel.topic, payload)
                    data = msgpack.packb(payload)
                writer.add_message(number, record.log_time, data, record.publish_time, record.sequence)
        writer.finish()
    return target


def change_deployment(change: Any) -> Any:
    def changed(topic: str, payload: dict[str, Any]) -> None:
        if topic == "config":
            deployment = json.loads(payload["deployment"])
            change(deployment)
            payload["deployment"] = json.dumps(deployment)

    return changed


def test_endpoints_of_a_recording_are_ignored(recorded: Path, tmp_path: Path) -> None:
    victim, port = tmp_path / "thesis.txt", find_port()
    victim.write_text("my thesis\n")

    def be_hostile(deployment: Any) -> None:
        deployment["daemon"] |= {"live": f"tcp://0.0.0.0:{port}", "complete": f"ipc://{victim}", "keys": None}

    hostile = rewrite(recorded, tmp_path / "hostile.mcap", change_deployment(be_hostile))
    live = f"tcp://127.0.0.1:{find_port()}"
    command = [sys.executable, "-m", "handtouch", "replay", str(hostile), "--publish", "--live", live]
    command += ["--complete", f"ipc://{tmp_path}/complete", "--speed", "0.2"]
    with (
        connect("hand/*", endpoint=live, key="") as frames,
        subprocess.Popen(command, stdout=subprocess.DEVNULL) as process,
    ):
        assert frames.recv(LONGEST_S) is not None
        assert f"00000000:{port:04X}" not in Path("/proc/net/tcp").read_text()
        process.terminate()
    assert victim.read_text() == "my thesis\n"


@pytest.mark.parametrize("option", ["--live", "--complete"])
def test_a_replay_listens_beyond_this_machine_only_with_keys(
    recorded: Path, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(recorded), "--publish", option, "tcp://0.0.0.0:5580"]) == 2
    assert "requires CURVE keys" in capsys.readouterr().err


def test_a_recording_names_no_file_of_this_machine(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def be_hostile(deployment: Any) -> None:
        deployment["hand"][0]["urdf"] = "/etc/passwd"

    hostile = rewrite(recorded, tmp_path / "hostile.mcap", change_deployment(be_hostile))
    assert main(["replay", str(hostile)]) == 1
    assert "'/etc/passwd', but doesn't contain it" in capsys.readouterr().err


def test_an_ipc_path_that_holds_anything_but_an_unused_socket_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x"
    endpoint = f"ipc://{path}"
    check_ipc_path(endpoint)
    path.write_text("kept")
    with pytest.raises(OSError, match="is a file"):
        check_ipc_path(endpoint)
    assert path.read_text() == "kept"
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "absent")
    with pytest.raises(OSError, match="is a file"):
        check_ipc_path(f"ipc://{link}")
    path.unlink()
    with zmq.Context() as context, context.socket(zmq.PUB) as socket:
        socket.bind(endpoint)
        with pytest.raises(OSError, match="is using it"):
            check_ipc_path(endpoint)
    end_s = time.monotonic() + LONGEST_S
    while time.monotonic() < end_s:
        try:
            check_ipc_path(endpoint)
            break
        except OSError:
            time.sleep(0.01)
    check_ipc_path(endpoint)
    with pytest.raises(OSError, match="doesn't exist"):
        check_ipc_path(f"ipc://{tmp_path}/absent/x")


# --- chunks


def write_chunk(
    path: Path, records: bytes, size: int | None = None, compression: CompressionType = CompressionType.ZSTD
) -> Path:
    """Write an MCAP file of one chunk that states a size."""
    packed = {
        CompressionType.ZSTD: zstandard.compress,
        CompressionType.LZ4: lz4.frame.compress,
        CompressionType.NONE: bytes,
    }[compression](records)
    name = b"" if compression == CompressionType.NONE else compression.name.lower().encode()
    body = struct.pack("<QQQI", 0, 0, len(records) if size is None else size, 0)
    body += struct.pack("<I", len(name)) + name + struct.pack("<Q", len(packed)) + packed
    head = MAGIC + struct.pack("<BQ", Opcode.HEADER, 8) + bytes(8)
    path.write_bytes(head + struct.pack("<BQ", Opcode.CHUNK, len(body)) + body)
    return path


@pytest.mark.parametrize("compression", CompressionType)
@pytest.mark.parametrize("states", [None, 100], ids=["true size", "false size"])
def test_a_chunk_that_unpacks_to_too_much_is_never_unpacked(
    tmp_path: Path, compression: CompressionType, states: int | None
) -> None:
    bomb = write_chunk(tmp_path / "bomb.mcap", bytes(100 << 20), states, compression)
    recording = Recording(bomb)
    tracemalloc.start()
    try:
        assert list(recording) == []
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(recording.damage) == 1
    assert "damaged" in recording.truncation
    most = 40 << 20 if compression != CompressionType.NONE else 250 << 20  # the file itself
    assert peak < most


def test_a_chunk_that_is_no_sequence_of_records_ends_at_once(tmp_path: Path) -> None:
    zeros = write_chunk(tmp_path / "zeros.mcap", bytes(MAX_CHUNK_BYTES))
    begin_s = time.process_time()
    assert list(Recording(zeros)) == []
    assert time.process_time() - begin_s < 1.0


def chunks(path: Path) -> list[tuple[int, int]]:
    """Begin and length of each chunk's data in a file."""
    data, at, found = path.read_bytes(), len(MAGIC), []
    while at < len(data) - len(MAGIC):
        opcode, length = struct.unpack_from("<BQ", data, at)
        if opcode == Opcode.CHUNK:
            found.append((at + 9, length))
        at += 9 + length
    return found


def small_chunks(source: Path, target: Path) -> Path:
    """Copy a recording with many chunks, and its state and configuration in several."""
    with source.open("rb") as file, target.open("wb") as out:
        writer = Writer(out, chunk_size=1 << 13)
        writer.start(profile="", library="x")
        schemas: dict[int, int] = {}
        numbers: dict[int, int] = {}
        for record in StreamReader(file).records:
            if isinstance(record, Schema):
                schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            elif isinstance(record, Channel) and record.id not in numbers:
                schema_id = schemas.get(record.schema_id, 0)
                numbers[record.id] = writer.register_channel(record.topic, record.message_encoding, schema_id)
            elif isinstance(record, Message):
                number = numbers[record.channel_id]
                writer.add_message(number, record.log_time, record.data, record.publish_time, record.sequence)
        writer.finish()
    return target


def test_a_damaged_chunk_costs_only_its_own_messages(recorded: Path, tmp_path: Path) -> None:
    copy = small_chunks(recorded, tmp_path / "copy.mcap")
    whole = list(Recording(copy))
    places = chunks(copy)
    assert len(places) > 10
    for begin, length in (places[0], places[len(places) // 2], places[-1]):
        data = bytearray(copy.read_bytes())
        data[begin + length // 2] ^= 0x10
        damaged = tmp_path / "damaged.mcap"
        damaged.write_bytes(data)
        recording = Recording(damaged)
        left = list(recording)
        assert len(recording.damage) == 1
        assert 0.8 * len(whole) < len(left) < len(whole)
        rest = iter(whole)
        assert all(message in rest for message in left)


FORMS: list[Any] = [[], {}, None, 1, "x", [1], {"x": 1}, -1, b"x", 2**63]


@pytest.mark.parametrize(
    ("command", "topics"),
    [
        ("replay", ("config", "state", "tick", "contact", "hand", "health")),
        ("export", ("config", "state", "tick", "contact", "hand", "health")),
        ("plot", ("config", "contact", "health service")),
    ],
)
def test_a_payload_of_any_form_is_an_error_without_traceback(
    recorded: Path,
    tmp_path: Path,
    command: str,
    topics: tuple[str, ...],
    capsys: pytest.CaptureFixture[str],
) -> None:
    rng = random.Random(3)
    for prefixes in topics:

        def be_hostile(topic: str, payload: dict[str, Any], prefixes: str = prefixes) -> None:
            if topic.split("/")[0] in prefixes.split() and rng.random() < 0.2:
                key = rng.choice(sorted(payload))
                if rng.random() < 0.5:
                    del payload[key]
                else:
                    payload[key] = rng.choice(FORMS)

        hostile = rewrite(recorded, tmp_path / "hostile.mcap", be_hostile)
        more = [] if command == "replay" else ["--out", str(tmp_path / "out")]
        assert main([command, str(hostile), *more]) in (0, 1, 2)
        said = capsys.readouterr().err
        assert "Traceback" not in said
        assert "errors.pydantic.dev" not in said


@pytest.mark.parametrize("error", [KeyError, TypeError, AttributeError, ZeroDivisionError, struct.error])
def test_what_a_reader_raises_for_a_payload_names_the_file(error: type[Exception], tmp_path: Path) -> None:
    file = tmp_path / "some.mcap"
    file.write_bytes(MAGIC)
    with pytest.raises(ValueError, match=rf"some\.mcap: .*{error.__name__}"), Recording(file).checked():
        raise error("n")


def test_a_replay_goes_on_without_differences_after_a_loss_between_contacts_and_their_tick(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The recorder lost everything from behind a contact message to before a state."""
    messages = list(Recording(recorded))
    states = [number for number, message in enumerate(messages) if message.topic == "state"]
    assert len(states) > 1
    contacts = [
        number
        for number, message in enumerate(messages[: states[-1]])
        if message.topic.startswith("contact/") and number > states[0]
    ]
    first, last = contacts[len(contacts) // 2] + 1, states[-1]
    dropped = iter(range(len(messages)))
    target = tmp_path / "gap.mcap"
    with recorded.open("rb") as file, target.open("wb") as out:
        writer = Writer(out)
        writer.start(profile="", library="x")
        numbers: dict[int, int] = {}
        topics: dict[int, str] = {}
        for record in StreamReader(file).records:
            if isinstance(record, Channel) and record.id not in numbers:
                numbers[record.id] = writer.register_channel(record.topic, record.message_encoding, 0)
                topics[record.id] = record.topic
            elif isinstance(record, Message):
                if not topics[record.channel_id].startswith("/") and first <= next(dropped) < last:
                    continue
                number = numbers[record.channel_id]
                writer.add_message(number, record.log_time, record.data, record.publish_time, record.sequence)
        writer.finish()
    assert main(["replay", str(target)]) == 0
    assert "all" in capsys.readouterr().err
