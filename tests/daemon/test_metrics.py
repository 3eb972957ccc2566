"""What Prometheus reads is what the daemon says, in its format, from a process that no tick feels."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import time
import urllib.error
import urllib.request
from collections.abc import Iterator

import pytest
from prometheus_client.parser import text_string_to_metric_families

from handtouch import wire
from handtouch.daemon.histogram import Histogram, StageClock
from handtouch.daemon.metrics import CONTENT_TYPE, Exporter, render

LONGEST_S = 60.0
BUS = {
    "load": 0.43, "lost_hz": 0.0, "state": "passive", "since_ns": 0, "problem": "",
    "causes": {"bit error": 3},
    "sync": {"by": "loop", "jitter_us": {"p50": 10.0, "p99": 50.0, "max": 80.0}, "others": 2, "problem": ""},
    "frames": 1000, "sent": 20, "bits": 123456, "samples": 900, "short": 1, "foreign": 2, "errors": 3,
    "send_failures": 4, "queue_full": 5, "receive_failures": 6, "overflow": 7,
}  # fmt: skip


def service(**changes: object) -> wire.Service:
    values = {
        "v": 1, "run": 1, "seq": 1, "t_ns": 1, "wall_offset_ns": 0, "version": "1.2", "pid": 7,
        "uptime_s": 60.5, "period_s": 0.005, "hands": {"left": ["thumb_tip"]}, "ticks": 12_000, "overruns": 2,
        "rate_hz": 199.5, "tick_us": {}, "loop": StageClock(0).figures(), "contacts": 17,
        "refused": {"no_key": 3, "request": 1}, "buses": {"can0": BUS}, "drops": {"live": 9},
        "process": {
            "memory_bytes": 10**8, "cpu_s": 3.5, "loop_cpu_s": 3.0, "collections": [100, 10, 1],
            "log_dropped": 2, "log_silenced": 5,
        },
        "subscriptions": ("contact/",), "repeat": False, **changes,
    }  # fmt: skip
    return wire.Service(**values)  # type: ignore[arg-type]


def pad(link: str, state: str = "clear", **changes: object) -> wire.Health:
    values = {
        "v": 1, "run": 1, "seq": 1, "t_ns": 1, "hand": "left", "link": link, "bus": "can0", "node_id": 1,
        "state": state, "node": "operational", "since_ns": 0, "pace": "sync", "reason": "", "serial": None,
        "rate_hz": 200.0, "samples": 10, "missed": 4, "age_s": 0.002, "reboots": 1, "heartbeats_missed": 2,
        "emergencies": (), "repeat": False, **changes,
    }  # fmt: skip
    return wire.Health(**values)  # type: ignore[arg-type]


def parsed(text: str) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
    """Name and labels -> value, read by Prometheus' own parser."""
    return {
        (sample.name.removeprefix("handtouch_"), frozenset(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def one(values: dict[tuple[str, frozenset[tuple[str, str]]], float], name: str, **labels: str) -> float:
    return values[name, frozenset(labels.items())]


def test_what_the_supervisor_finds_is_there_by_pad_and_kind() -> None:
    figures = {"pid": 8, "restarts": 2, "dropped": 3, "malformed": 4}
    gum = {"kind": "stuck contact", "cause": "gum"}
    pads = [pad("thumb_tip", findings=(gum,)), pad("palm", trust="quarantined")]
    values = parsed(render(service(supervisor=figures), pads, 0.1))
    assert one(values, "supervisor_up") == 1
    assert one(values, "supervisor_restarts_total") == 2
    assert one(values, "supervisor_dropped_total") == 3
    assert one(values, "supervisor_malformed_total") == 4
    assert one(values, "pad_finding", hand="left", link="thumb_tip", kind="stuck contact") == 1
    assert one(values, "pad_trust", hand="left", link="palm", trust="quarantined") == 1
    assert one(values, "pad_trust", hand="left", link="palm", trust="trusted") == 0
    assert not any(name.startswith("supervisor") for name, _ in parsed(render(service(), [], 0.1)))


def test_every_figure_of_the_daemon_is_there_under_its_cause() -> None:
    values = parsed(render(service(), [pad("thumb_tip"), pad("palm", "lost")], 0.1))
    assert one(values, "up") == 1
    assert one(values, "ticks_total") == 12_000
    assert one(values, "contacts_total") == 17
    assert one(values, "bus_load_ratio", bus="can0") == 0.43
    assert one(values, "bus_state", bus="can0", state="passive") == 1
    assert one(values, "bus_state", bus="can0", state="active") == 0
    assert one(values, "bus_troubles_total", bus="can0", cause="overflow") == 7
    assert one(values, "bus_error_frames_total", bus="can0", cause="bit error") == 3
    assert one(values, "sync_jitter_seconds", bus="can0", quantile="0.99") == pytest.approx(50e-6)
    assert one(values, "dropped_messages_total", stream="live") == 9
    assert one(values, "refused_total", cause="no_key") == 3
    assert one(values, "memory_bytes") == 10**8
    assert one(values, "gc_collections_total", generation="0") == 100
    assert one(values, "log_lost_total", why="silenced") == 5
    assert one(values, "pad_missed_total", hand="left", link="palm") == 4
    for link, state in (("thumb_tip", "clear"), ("palm", "lost")):
        states = {
            dict(labels)["state"]: value
            for (name, labels), value in values.items()
            if name == "pad_state" and dict(labels)["link"] == link
        }
        assert [state for state, value in states.items() if value] == [state]
        assert set(states) == {state.name.lower() for state in wire.PadState}


def test_buckets_are_cumulative_and_end_at_the_count() -> None:
    latency = Histogram()
    for duration_ns in (500, 100_000, 100_000, 3_000_000):
        latency.add(duration_ns)
    loop = {"latency": latency.figures(), "stages": {"tick": latency.figures()}, "late": {"report": 3}}
    values = parsed(render(service(loop=loop), [], 0.1))
    buckets = [
        (float(dict(labels)["le"]), value)
        for (name, labels), value in values.items()
        if name == "tick_latency_seconds_bucket"
    ]
    assert [value for _, value in sorted(buckets)] == sorted(value for _, value in buckets)
    for end_s, value in buckets:
        assert value == sum(ns * 1e-9 < end_s for ns in (500, 100_000, 100_000, 3_000_000))
    assert one(values, "tick_latency_seconds_count") == 4
    assert one(values, "tick_latency_seconds_sum") == pytest.approx(3.2005e-3)
    assert one(values, "stage_seconds_count", stage="tick") == 4
    assert one(values, "late_ticks_total", part="report") == 3


def test_a_daemon_that_is_silent_is_down_and_one_never_heard_of_too() -> None:
    assert one(parsed(render(service(), [], 1.6)), "up") == 0
    assert parsed(render(None, [], float("inf"))) == {("up", frozenset()): 0}


def test_any_text_may_be_a_label() -> None:
    nasty = 'a "b" \\ c\nd'
    values = parsed(render(service(refused={nasty: 1}), [], 0.1))
    assert one(values, "refused_total", cause=nasty) == 1


def scrape(exporter: Exporter, path: str = "/metrics") -> str:
    with urllib.request.urlopen(f"http://{exporter.address}{path}", timeout=LONGEST_S) as answer:
        assert answer.headers["Content-Type"] == CONTENT_TYPE
        return str(answer.read().decode())


@pytest.fixture
def exporter() -> Iterator[Exporter]:
    with contextlib.closing(Exporter("127.0.0.1:0")) as made:
        yield made


def wait_until_up(exporter: Exporter) -> None:
    end_s = time.monotonic() + LONGEST_S
    while one(parsed(scrape(exporter)), "up") != 1:
        assert time.monotonic() < end_s
        exporter.take(service())


def test_a_scrape_gives_the_latest_messages(exporter: Exporter) -> None:
    exporter.take(service(ticks=1))
    exporter.take(pad("palm"))
    exporter.take(service(ticks=2))
    end_s = time.monotonic() + LONGEST_S
    while "handtouch_ticks_total 2" not in (text := scrape(exporter)):
        assert time.monotonic() < end_s
    assert 'handtouch_pad_samples_total{hand="left",link="palm"} 10' in text
    with pytest.raises(urllib.error.HTTPError, match="404"):
        scrape(exporter, "/")


def test_a_client_that_asks_for_nothing_keeps_nobody_waiting(exporter: Exporter) -> None:
    host, _, port = exporter.address.rpartition(":")
    with contextlib.ExitStack() as idle:
        for _ in range(20):
            idle.enter_context(socket.create_connection((host, int(port))))
        assert "handtouch_up" in scrape(exporter)


def test_a_process_that_does_not_read_is_dropped_for_and_one_that_died_is_started_again(
    exporter: Exporter,
) -> None:
    wait_until_up(exporter)
    process = exporter.process
    assert process is not None
    os.kill(process, signal.SIGSTOP)
    for _ in range(2000):
        exporter.take(service())  # would never return if it could wait
    assert exporter.dropped > 0
    os.kill(process, signal.SIGKILL)
    wait_until_up(exporter)
    assert exporter.process != process


def test_an_address_that_is_taken_is_named_with_a_remedy(exporter: Exporter) -> None:
    with pytest.raises(OSError, match=f"{exporter.address}: .*another daemon"):
        Exporter(exporter.address)
