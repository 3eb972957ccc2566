"""Prometheus metrics: content, text format, and the server process."""

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
from handtouch.daemon.metrics import MetricsExporter
from handtouch.daemon.metrics_page import CONTENT_TYPE, render_metrics
from handtouch.daemon.stage_timer import Histogram, StageTimer

LONGEST_S = 60.0
BUS = {
    "load": 0.43, "lost_hz": 0.0, "state": "passive", "since_ns": 0, "problem": "",
    "causes": {"bit error": 3},
    "sync": {
        "by": "loop", "jitter_us": {"p50": 10.0, "p99": 50.0, "max": 80.0}, "other_syncs": 2, "problem": "",
    },
    "frames": 1000, "sent": 20, "bits": 123456, "samples": 900, "wrong_length": 1,
    "unknown_frames": 2, "error_frames": 3,
    "send_failures": 4, "queue_full": 5, "receive_failures": 6, "overflow": 7,
}  # fmt: skip


def service(**changes: object) -> wire.Service:
    values = {
        "v": 1, "session": 1, "seq": 1, "t_ns": 1, "wall_offset_ns": 0, "version": "1.2", "pid": 7,
        "uptime_s": 60.5, "period_s": 0.005, "hands": {"left": ["thumb_tip"]}, "ticks": 12_000, "overruns": 2,
        "rate_hz": 199.5, "core_compiled": True, "tick_us": {}, "loop": StageTimer(0).statistics(),
        "contacts": 17,
        "rejected": {"no_key": 3, "request": 1}, "buses": {"can0": BUS}, "congestion_episodes": {"live": 9},
        "process": {
            "memory_bytes": 10**8, "cpu_s": 3.5, "loop_cpu_s": 3.0, "collections": [100, 10, 1],
            "log_dropped": 2, "log_suppressed": 5,
        },
        "subscriptions": ("contact/",), "retained": False, **changes,
    }  # fmt: skip
    return wire.Service(**values)  # type: ignore[arg-type]


def pad(link: str, state: str = "clear", **changes: object) -> wire.Health:
    values = {
        "v": 1,
        "session": 1,
        "seq": 1,
        "t_ns": 1,
        "hand": "left",
        "link": link,
        "bus": "can0",
        "node_id": 1,
        "state": state,
        "node_state": "operational",
        "node_state_since_ns": 0,
        "sampling": "sync",
        "reason": "",
        "serial": None,
        "rate_hz": 200.0,
        "samples": 10,
        "missed_samples": 4,
        "age_s": 0.002,
        "reboots": 1,
        "heartbeats_missed": 2,
        "emergencies": (),
        "retained": False,
        **changes,
    }
    return wire.Health(**values)  # type: ignore[arg-type]


def parsed(text: str) -> dict[tuple[str, frozenset[tuple[str, str]]], float]:
    """Return (name, labels) -> value, read by Prometheus' own parser."""
    return {
        (sample.name.removeprefix("handtouch_"), frozenset(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def one(values: dict[tuple[str, frozenset[tuple[str, str]]], float], name: str, **labels: str) -> float:
    return values[name, frozenset(labels.items())]


@pytest.mark.parametrize(("key", "name"), [("supervisor", "supervisor"), ("percepts", "percept")])
def test_state_of_child_processes_is_exported(key: str, name: str) -> None:
    figures = {"pid": 8, "restarts": 2, "dropped": 3, "malformed": 4}
    values = parsed(render_metrics(service(**{key: figures}), [], 0.1))
    assert one(values, f"{name}_up") == 1
    assert one(values, f"{name}_restarts_total") == 2
    assert one(values, f"{name}_dropped_total") == 3
    assert one(values, f"{name}_malformed_total") == 4
    stopped = parsed(render_metrics(service(**{key: {**figures, "pid": None}}), [], 0.1))
    assert one(stopped, f"{name}_up") == 0
    assert not any(metric.startswith(name) for metric, _ in parsed(render_metrics(service(), [], 0.1)))


def test_diagnoses_are_exported_by_pad_and_kind() -> None:
    gum = {"kind": "gum", "cause": "gum"}
    pads = [pad("thumb_tip", diagnoses=(gum,)), pad("palm", calibration_state="quarantined")]
    values = parsed(render_metrics(service(), pads, 0.1))
    assert one(values, "pad_diagnosis", hand="left", link="thumb_tip", kind="gum") == 1
    assert one(values, "pad_calibration_state", hand="left", link="palm", state="quarantined") == 1
    assert one(values, "pad_calibration_state", hand="left", link="palm", state="calibrated") == 0


def test_all_statistics_of_the_daemon_are_exported() -> None:
    values = parsed(render_metrics(service(), [pad("thumb_tip"), pad("palm", "lost")], 0.1))
    assert one(values, "up") == 1
    assert one(values, "ticks_total") == 12_000
    assert one(values, "contacts_total") == 17
    assert one(values, "bus_load_ratio", bus="can0") == 0.43
    assert one(values, "bus_state", bus="can0", state="passive") == 1
    assert one(values, "bus_state", bus="can0", state="active") == 0
    assert one(values, "bus_errors_total", bus="can0", cause="overflow") == 7
    assert one(values, "bus_error_frames_total", bus="can0", cause="bit error") == 3
    assert one(values, "sync_jitter_seconds", bus="can0", quantile="0.99") == pytest.approx(50e-6)
    assert one(values, "congestion_episodes_total", stream="live") == 9
    assert one(values, "refused_total", cause="no_key") == 3
    assert one(values, "memory_bytes") == 10**8
    assert one(values, "gc_collections_total", generation="0") == 100
    assert one(values, "log_lost_total", reason="suppressed") == 5
    assert one(values, "pad_missed_samples_total", hand="left", link="palm") == 4
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
    loop = {"latency": latency.statistics(), "stages": {"tick": latency.statistics()}, "late": {"report": 3}}
    values = parsed(render_metrics(service(loop=loop), [], 0.1))
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


def test_silent_or_absent_daemon_is_down() -> None:
    assert one(parsed(render_metrics(service(), [], 1.6)), "up") == 0
    assert parsed(render_metrics(None, [], float("inf"))) == {("up", frozenset()): 0}


def test_labels_are_escaped() -> None:
    special = 'a "b" \\ c\nd'
    values = parsed(render_metrics(service(rejected={special: 1}), [], 0.1))
    assert one(values, "refused_total", cause=special) == 1


def scrape(exporter: MetricsExporter, path: str = "/metrics") -> str:
    with urllib.request.urlopen(f"http://{exporter.address}{path}", timeout=LONGEST_S) as answer:
        assert answer.headers["Content-Type"] == CONTENT_TYPE
        return str(answer.read().decode())


@pytest.fixture
def exporter() -> Iterator[MetricsExporter]:
    with contextlib.closing(MetricsExporter.open("127.0.0.1:0")) as made:
        yield made


def wait_until_up(exporter: MetricsExporter) -> None:
    end_s = time.monotonic() + LONGEST_S
    while one(parsed(scrape(exporter)), "up") != 1:
        assert time.monotonic() < end_s
        exporter.send(service())


def test_scrape_returns_the_latest_messages(exporter: MetricsExporter) -> None:
    exporter.send(service(ticks=1))
    exporter.send(pad("palm"))
    exporter.send(service(ticks=2))
    end_s = time.monotonic() + LONGEST_S
    while "handtouch_ticks_total 2" not in (text := scrape(exporter)):
        assert time.monotonic() < end_s
    assert 'handtouch_pad_samples_total{hand="left",link="palm"} 10' in text
    with pytest.raises(urllib.error.HTTPError, match="404"):
        scrape(exporter, "/")


def test_300_half_open_requests_hold_few_threads_and_block_no_scrape(exporter: MetricsExporter) -> None:
    host, _, port = exporter.address.rpartition(":")
    assert "handtouch_up" in scrape(exporter)
    with contextlib.ExitStack() as idle:
        for _ in range(300):
            idle.enter_context(socket.create_connection((host, int(port)))).sendall(b"GET /metrics")
        assert "handtouch_up" in scrape(exporter)
        assert len(os.listdir(f"/proc/{exporter.process_id}/task")) < 80


def test_a_scrape_by_another_host_name_is_rejected(exporter: MetricsExporter) -> None:
    request = urllib.request.Request(f"http://{exporter.address}/metrics", headers={"Host": "evil.example"})
    with pytest.raises(urllib.error.HTTPError, match="421"):
        urllib.request.urlopen(request, timeout=LONGEST_S)


def test_stopped_process_drops_messages_and_killed_one_is_restarted(
    exporter: MetricsExporter,
) -> None:
    wait_until_up(exporter)
    process = exporter.process_id
    assert process is not None
    os.kill(process, signal.SIGSTOP)
    for _ in range(2000):
        exporter.send(service())  # would never return if it could block
    assert exporter.dropped > 0
    os.kill(process, signal.SIGKILL)
    wait_until_up(exporter)
    assert exporter.process_id != process


def test_address_in_use_is_reported_with_a_remedy(exporter: MetricsExporter) -> None:
    with pytest.raises(OSError, match=f"{exporter.address}: .*another daemon"):
        MetricsExporter.open(exporter.address)
