"""From touches on simulated nodes to contacts on the wire, and behaviour under faults.

The nodes (`handtouch simulate`), the daemon (`handtouch run`) and the subscriber are processes of their own
that meet on a udp_multicast bus and on ZeroMQ.
"""

from __future__ import annotations

import asyncio
import bisect
import json
import math
import os
import re
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq

from handtouch import wire
from handtouch.simulate.truth import GroundTruth, read_records

LONGEST_S = 60.0
PERIOD_MS = 20.0


def _contacts(
    rig: Any, enough: Callable[[list[wire.Contact]], bool], longest_s: float = LONGEST_S
) -> list[wire.Contact]:
    """Receive contact messages until `enough` returns True."""
    got: list[wire.Contact] = []
    end_s = time.monotonic() + longest_s
    with rig.subscribe("contact/*/*") as messages:
        while not enough(got):
            assert time.monotonic() < end_s, f"only {len(got)} contact messages\n{rig.all_printed()}"
            next_s = time.monotonic() + 0.2
            while time.monotonic() < next_s:
                message = messages.recv(0.1)
                if message is not None:
                    got.append(message)
        assert messages.lost_messages == 0
        assert messages.malformed_messages == 0
    return got


def _time(row: GroundTruth) -> int:
    return row.t_ns


def _ends(count: int) -> Callable[[list[wire.Contact]], bool]:
    return lambda contacts: sum(contact.event == "end" for contact in contacts) >= count


def _times(contacts: list[wire.Contact]) -> dict[int, list[int]]:
    """Return the sample times [ns] of each contact."""
    times: dict[int, list[int]] = {}
    for contact in contacts:
        times.setdefault(contact.id, []).append(contact.t_ns)
    return times


def _steady(times_ns: list[int]) -> set[int]:
    """Return the times whose neighbours are a period away, so that the machine did not pause there."""
    steps = np.diff(np.unique(times_ns)) * 1e-6 / PERIOD_MS
    regular = np.abs(steps - 1) < 0.4
    return set(np.unique(times_ns)[1:-1][regular[1:] & regular[:-1]].tolist())


def _row(status: dict[str, Any], link: str) -> dict[str, Any]:
    return next(pad for pad in status["pads"] if pad["link"] == link)


def _send(rig: Any, can_id: int, data: bytes) -> None:
    """Send a frame on the rig's bus from an unknown node."""
    port = int(rig.bus[0].split("port=")[1])
    script = (
        "import can, sys\n"
        f"with can.Bus('239.74.163.2', interface='udp_multicast', port={port}) as bus:\n"
        f"    bus.send(can.Message(arbitration_id={can_id}, data={data!r}, is_extended_id=False))\n"
    )
    subprocess.run([*rig.command()[:-2], "-c", script], check=True, timeout=LONGEST_S)


def test_contacts_have_the_position_and_force_of_touches(rig: Any) -> None:
    truth_file = rig.folder / "truth.jsonl"
    rig.simulate("--truth", str(truth_file))
    rig.start("run")
    rig.wait_operational()
    contacts = _contacts(
        rig, lambda got: _ends(5)(got) and sum(len(_steady(times)) for times in _times(got).values()) > 120
    )
    rig.end("run")
    assert rig.end("simulate") == 0

    life: dict[int, list[wire.Contact]] = {}
    for contact in contacts:
        life.setdefault(contact.id, []).append(contact)
    whole = [c for c in life.values() if c[0].event == "begin" and c[-1].event == "end"]
    assert len(whole) >= 2
    reasons = {messages[-1].end_reason for messages in whole}
    assert "released" in reasons <= {"released", "stale"}  # stale: this machine paused for three periods
    for messages in whole:
        assert [c.event for c in messages[1:-1]] == ["update"] * (len(messages) - 2)
        assert [c.seq for c in messages] == list(range(messages[0].seq, messages[0].seq + len(messages)))
        assert messages[-1].duration_s > 0
        assert messages[-1].peak_force_n == pytest.approx(max(c.force_n or 0 for c in messages))

    truth: dict[str, list[GroundTruth]] = {}
    for row in read_records(truth_file):
        truth.setdefault(row.link, []).append(row)
    sampled = {link: _steady([row.t_ns for row in rows]) for link, rows in truth.items()}
    steady = {number: _steady(times) for number, times in _times(contacts).items()}
    # a pad whose first reading is of a light touch takes that for its baseline until it is released
    first = {contact.link: contact.id for contact in reversed(contacts)}.values()
    errors = []
    for contact in contacts:
        if contact.event == "end" or contact.position_m is None or contact.force_n is None:
            continue
        if contact.id in first:
            continue
        after = min(bisect.bisect(truth[contact.link], contact.t_ns, key=_time), len(truth[contact.link]) - 1)
        nearest = min(
            truth[contact.link][max(after - 1, 0) : after + 1], key=lambda row: abs(row.t_ns - contact.t_ns)
        )
        if contact.t_ns not in steady[contact.id] or nearest.t_ns not in sampled[contact.link]:
            continue
        if abs(nearest.t_ns - contact.t_ns) >= PERIOD_MS * 1e6 / 2:
            continue  # this machine paused
        assert contact.covariance_m2 is not None
        on_pad = np.subtract(contact.covariance_m2, contact.mount_covariance_m2 or ())  # mounts are exact
        variance = np.trace(on_pad.reshape(3, 3))
        errors.append(math.dist(contact.position_m, nearest.position_m) / math.sqrt(variance))
        assert np.dot(contact.normal or (), nearest.normal) > 0.99
        assert abs(contact.force_n - nearest.force_n) < 5 * (contact.force_std_n or 0)
    assert len(errors) > 30
    assert math.sqrt(np.mean(np.square(errors))) < 1.5  # the noise bound that each message states


def test_asyncio_subscribers_get_the_same_contacts(working: Any) -> None:

    async def first(count: int) -> list[wire.Contact]:
        got = []
        with working.subscribe("contact/*/*") as messages:
            async for message in messages:
                got.append(message)
                if len(got) == count:
                    break
        return got

    contacts = asyncio.run(asyncio.wait_for(first(20), LONGEST_S))
    assert len({contact.seq for contact in contacts if contact.link == contacts[0].link}) > 1


def test_frames_of_wrong_length_or_unknown_id_are_counted_and_dropped(working: Any) -> None:
    before = working.status()["service"]["buses"]["can0"]
    _send(working, 0x280 + 0x11, b"\x01\x02\x03")
    _send(working, 0x280 + 0x7F, bytes(8))
    working.wait(
        "counted",
        lambda status: (
            status["service"]["buses"]["can0"]["wrong_length"] == before["wrong_length"] + 1
            and status["service"]["buses"]["can0"]["unknown_frames"] == before["unknown_frames"] + 1
        ),
    )


def test_disconnected_node_is_stale_then_lost_and_recovers_without_restart(rig: Any) -> None:
    rig.simulate()
    rig.start("run")
    rig.wait_operational()
    with rig.subscribe("health/*/*") as messages:
        states: list[str] = []
        end_s = time.monotonic() + LONGEST_S
        rig.end("simulate", signal.SIGKILL)
        while "lost" not in states:
            assert time.monotonic() < end_s, states
            message = messages.recv(0.1)
            if message is not None and message.link == "thumb_distal" and message.state not in states[-1:]:
                states.append(message.state)
                reason = message.reason
        assert states[-2:] == ["stale", "lost"]
        assert "heartbeat" in reason
    rig.wait("lost", lambda status: _row(status, "palm_heel")["state"] == "lost")
    exit_status, printed = rig.call("status", "--endpoint", rig.endpoints["control"])
    assert (exit_status, "heartbeat" in printed) == (1, True), printed
    rig.simulate()
    rig.wait_operational()
    _contacts(rig, _ends(1))


def test_missing_nodes_are_reported_and_the_other_nodes_work(rig: Any) -> None:
    text = rig.config.read_text()
    others = rig.folder / "fewer.toml"
    cut = text.index('[[hand.pad]]\nlink = "thumb_middle"')
    upto = text.index("[[hand.pad]]", cut + 10)
    others.write_text(text[:cut] + text[upto:])
    buses = [argument for bus in rig.bus for argument in ("--bus", bus)]
    rig.start_command("simulate", str(others), "--scenario", str(rig.scenario), *buses)
    rig.start("run")
    status = rig.wait_operational(14)
    missing = _row(status, "thumb_middle")
    assert missing["state"] == "starting"
    assert missing["node_state"] == "absent"
    assert missing["reason"]
    _contacts(rig, _ends(1))


def test_stalled_or_killed_subscriber_affects_no_other(working: Any) -> None:
    context = zmq.Context()
    stalled = context.socket(zmq.SUB)
    stalled.setsockopt(zmq.RCVHWM, 1)
    stalled.setsockopt(zmq.RCVBUF, 1024)
    stalled.subscribe("")
    stalled.connect(working.endpoints["live"])
    dying = working.start_command(
        "watch", "--json", "--endpoint", working.endpoints["live"], "contact/*/*", "hand/*"
    )
    contacts = _contacts(working, _ends(1))
    dying.kill()
    dying.wait()
    before = working.status()["service"]
    contacts += _contacts(working, _ends(1))
    after = working.status()["service"]
    late = [service["loop"]["late"].get("send", 0) for service in (before, after)]
    # machine pauses may delay sending; a daemon that waits for a subscriber would be late every time
    assert late[1] - late[0] <= 2 + 0.1 * (after["ticks"] - before["ticks"])
    stalled.close(0)
    context.term()
    assert contacts


def test_sigterm_ends_contacts_and_stops_the_configured_nodes(rig: Any) -> None:
    rig.simulate()
    rig.start("run")
    rig.wait_operational()
    with rig.subscribe("contact/*/*", "service") as messages:
        begun = next(message for message in messages if isinstance(message, wire.Contact))
        assert rig.end("run") == 0
        received = []
        while (message := messages.recv(1.0)) is not None:
            received.append(message)
    last = [message for message in received if getattr(message, "link", "") == begun.link][-1]
    assert (last.event, last.end_reason) == ("end", "stopped")
    services = [message for message in received if isinstance(message, wire.Service)]
    assert [service.stopping for service in services] == [False] * (len(services) - 1) + [True]
    ends = [getattr(message, "end_reason", "") == "stopped" for message in received]
    assert received.index(services[-1]) < ends.index(True)
    assert not any(Path(endpoint.removeprefix("ipc://")).exists() for endpoint in rig.endpoints.values())
    assert "Traceback" not in rig.all_printed()
    rig.start("run")  # which finds the nodes stopped, and wakes them
    rig.wait_operational()


def test_after_sigkill_a_restart_finds_the_nodes_running_and_does_not_reset_them(rig: Any) -> None:
    rig.simulate()
    rig.start("run")
    rig.wait_operational()
    rig.end("run", signal.SIGKILL)
    for endpoint in rig.endpoints.values():
        os.unlink(endpoint.removeprefix("ipc://")) if os.path.exists(
            endpoint.removeprefix("ipc://")
        ) else None
    rig.start("run")
    status = rig.wait_operational()
    assert all(pad["emergencies"] == [] for pad in status["pads"])
    _contacts(rig, _ends(1))


def test_config_error_exits_with_status_2_before_the_bus_is_opened(rig: Any) -> None:
    rig.config.write_text(rig.config.read_text().replace("gap_mm = 0.8", "gap_mm = 80.0", 1))
    status, printed = rig.call("run", str(rig.config), "--bus", "can0=no_such_interface:can9")
    assert status == 2
    assert "hand.toml" in printed
    assert "gap_mm = 80" in printed
    assert "Traceback" not in printed


def test_missing_bus_exits_with_status_1_and_a_remedy(rig: Any) -> None:
    status, printed = rig.call("run", str(rig.config), "--bus", "can0=socketcan:can77")
    assert status == 1
    assert "can77" in printed
    assert "Traceback" not in printed


@pytest.mark.parametrize("request_bytes", [b"", b"\xc1", b"\x80", b"\x93\x01\x02\x03"])
def test_malformed_request_gets_an_error_and_ticks_continue(working: Any, request_bytes: bytes) -> None:
    import msgpack

    with zmq.Context() as context, context.socket(zmq.REQ) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(working.endpoints["control"])
        socket.send(request_bytes)
        assert socket.poll(5000)
        answer = msgpack.unpackb(socket.recv())
    assert answer["ok"] is False
    assert answer["error"]
    ticks = working.status()["service"]["ticks"]
    working.wait("ticking on", lambda status: status["service"]["ticks"] > ticks)


def test_status_prints_a_verdict_text_and_json(working: Any) -> None:
    command = ("status", "--endpoint", working.endpoints["control"])
    end_s = time.monotonic() + LONGEST_S
    while (answered := working.call(*command))[0] != 0:
        assert time.monotonic() < end_s, answered  # a pause of the machine makes a pad stale for a moment
    assert answered[1].startswith("15 of 15 pads ok")
    assert "thumb_distal" in answered[1]
    printed = working.call(*command, "--verbose")[1]
    assert re.search(r"bus can0: \w+, load", printed)
    answer = json.loads(working.call(*command, "--json")[1])
    assert {pad["state"] for pad in answer["pads"]} <= {"clear", "touched", "stale"}  # paused
    assert {pad["node_state"] for pad in answer["pads"]} <= {"operational", "stale"}
