"""Prometheus text page from the daemon's `service` and `health` messages.

Public names: `render_metrics`, `CONTENT_TYPE`.
"""

from __future__ import annotations

import typing
from collections.abc import Iterable, Iterator, Mapping
from itertools import accumulate
from typing import Any

from handtouch import wire
from handtouch.daemon.stage_timer import FIRST_BUCKET_NS
from handtouch.wire.health import CalibrationStateName
from handtouch.wire.service import BusStatistics

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_CALIBRATION_STATES = [state for state in typing.get_args(CalibrationStateName) if state]
_BUS_STATES = typing.get_args(typing.get_type_hints(BusStatistics)["state"])
_TRAFFIC_COUNTERS = ("frames", "sent", "bits", "samples")
_ERROR_COUNTERS = (
    "wrong_length",
    "unknown_frames",
    "error_frames",
    "send_failures",
    "queue_full",
    "receive_failures",
    "overflow",
)
_JITTER_QUANTILES = {"p50": "0.5", "p99": "0.99", "max": "1"}
_PAD_METRICS = (
    ("pad_samples_total", "samples", "samples received"),
    ("pad_missed_samples_total", "missed_samples", "ticks without the sample of their SYNC"),
    ("pad_rate_hertz", "rate_hz", "samples per second over the last second"),
    ("pad_sample_age_seconds", "age_s", "age of the newest sample when last published"),
    ("node_reboots_total", "reboots", "boot-up messages after the first"),
    ("node_heartbeats_missed_total", "heartbeats_missed", "heartbeats that timed out"),
)
"""Name of a metric, field of `health` and meaning"""

Labels = Mapping[str, object]
Rows = Iterable[tuple[Labels, Any]]


def render_metrics(service: wire.Service | None, pads: Iterable[wire.Health], age_s: float) -> str:
    """Return all metrics in Prometheus' text format 0.0.4; `age_s`: age of the newest `service` message."""
    up = age_s < wire.SERVICE.timeout_s
    lines = list(_metric("up", "1 while the daemon publishes its service message", [({}, up)]))
    if service is not None:
        lines += _loop_metrics(service)
        lines += _bus_metrics(service.buses)
        lines += _process_metrics(service)
        lines += _child_metrics("supervisor", service.supervisor)
        lines += _child_metrics("percept", service.percepts)
    lines += _pad_metrics(list(pads))
    return "\n".join(lines) + "\n"


def _loop_metrics(service: wire.Service) -> Iterator[str]:
    about = {"version": service.version, "pid": service.pid}
    yield from _metric("info", "version of the daemon", [(about, 1)])
    for name, text, value in (
        ("uptime_seconds", "time since the daemon started", service.uptime_s),
        ("period_seconds", "configured period of SYNC and tick", service.period_s),
        ("ticks_total", "ticks", service.ticks),
        ("tick_rate_hertz", "ticks per second over the last 0.5 s", service.rate_hz),
        ("contacts_total", "contacts begun", service.contacts),
        ("subscriptions", "subscribed topic prefixes", len(service.subscriptions)),
    ):
        yield from _metric(name, text, [({}, value)])
    late = _by("part", service.loop.get("late", {}))
    yield from _metric(
        "late_ticks_total", "ticks later than one period, by the longest part of the loop", late
    )
    latency: Rows = [({}, service.loop["latency"])] if "latency" in service.loop else []
    text = "latency from a tick's last sample to its last message"
    yield from _histograms("tick_latency_seconds", text, latency)
    stages = _by("stage", service.loop.get("stages", {}))
    yield from _histograms("stage_seconds", "time per period of each stage of the loop", stages)


def _bus_metrics(buses: Mapping[str, Any]) -> Iterator[str]:
    def each(key: str) -> Rows:
        return [({"bus": bus}, statistics[key]) for bus, statistics in buses.items()]

    text = "bus load as a fraction of the bit rate, over the last 0.5 s"
    yield from _metric("bus_load_ratio", text, each("load"))
    yield from _states("bus_state", "error state of the bus", _BUS_STATES, each("state"))
    for name in _TRAFFIC_COUNTERS:
        text = f"{name}: see buses of `service` in docs/wire.md"
        yield from _metric(f"bus_{name}_total", text, each(name))
    errors = [({**bus, "cause": name}, n) for name in _ERROR_COUNTERS for bus, n in each(name)]
    yield from _metric("bus_errors_total", "lost, rejected or unusable frames, by cause", errors)
    causes = [({**bus, "cause": cause}, n) for bus, found in each("causes") for cause, n in found.items()]
    yield from _metric("bus_error_frames_total", "error frames by reported cause", causes)
    jitter = [
        ({**bus, "quantile": quantile}, sync["jitter_us"][name] * 1e-6)
        for bus, sync in each("sync")
        for name, quantile in _JITTER_QUANTILES.items()
        if sync["jitter_us"]
    ]
    text = "deviation of SYNC intervals from the period, over the last second"
    yield from _metric("sync_jitter_seconds", text, jitter)
    others = [(bus, sync["other_syncs"]) for bus, sync in each("sync")]
    yield from _metric("sync_other_producer_total", "SYNC frames of another producer on our bus", others)


def _process_metrics(service: wire.Service) -> Iterator[str]:
    process = service.process
    scopes = {"loop": process["loop_cpu_s"], "process": process["cpu_s"]}
    lost = {reason: process[f"log_{reason}"] for reason in ("dropped", "suppressed")}
    for name, text, rows in (
        (
            "congestion_episodes_total",
            "times that a subscriber's queue was found full; it loses messages until it has caught up",
            _by("stream", service.congestion_episodes),
        ),
        ("refused_total", "refused connections and requests", _by("cause", service.rejected)),
        ("memory_bytes", "resident memory of the daemon", [({}, process["memory_bytes"])]),
        (
            "cpu_seconds_total",
            "CPU time of the loop's thread and of the whole process",
            _by("scope", scopes),
        ),
        (
            "gc_collections_total",
            "garbage collections",
            _by("generation", dict(enumerate(process["collections"]))),
        ),
        (
            "log_lost_total",
            "log messages dropped by a full queue or suppressed as repeated",
            _by("reason", lost),
        ),
    ):
        yield from _metric(name, text, rows)


def _pad_metrics(pads: list[wire.Health]) -> Iterator[str]:
    def each(field: str) -> list[tuple[dict[str, object], Any]]:
        return [({"hand": pad.hand, "link": pad.link}, getattr(pad, field)) for pad in pads]

    for metric, field, text in _PAD_METRICS:
        yield from _metric(metric, text, [(pad, value) for pad, value in each(field) if value is not None])
    pad_states = [state.text for state in wire.PadState]
    yield from _states("pad_state", "state of the pad", pad_states, each("state"))
    node_states = typing.get_args(wire.NodeStateName)
    yield from _states("node_state", "state of the pad's node", node_states, each("node_state"))
    text = "state of the pad's calibration"
    yield from _states("pad_calibration_state", text, _CALIBRATION_STATES, each("calibration_state"))
    kinds = [
        ({**pad, "kind": kind}, 1)
        for pad, diagnoses in each("diagnoses")
        for kind in sorted({diagnosis["kind"] for diagnosis in diagnoses})
    ]
    yield from _metric("pad_diagnosis", "1 while the supervisor diagnoses this fault", kinds)


def _child_metrics(name: str, statistics: Mapping[str, Any] | None) -> Iterator[str]:
    """Yield the state of a child process, the supervisor or the percept process."""
    if statistics is None:
        return
    process = f"the {name} process"
    up = statistics["pid"] is not None
    yield from _metric(f"{name}_up", f"1 while {process} runs", [({}, up)])
    for key, meaning in (
        ("restarts", f"restarts of {process}"),
        ("dropped", f"messages dropped because {process} was too slow"),
        ("malformed", f"malformed messages of {process}"),
    ):
        yield from _metric(f"{name}_{key}_total", meaning, [({}, statistics[key])])


def _by(label: str, values: Mapping[Any, Any]) -> Rows:
    return [({label: key}, value) for key, value in values.items()]


def _states(name: str, text: str, known: Iterable[str], rows: Rows) -> Iterator[str]:
    """Yield a series for every known state, 1 for the present one."""
    series = [({**labels, "state": state}, state == now) for labels, now in rows for state in known]
    return _metric(name, f"{text}: 1 for the present state", series)


def _metric(name: str, text: str, rows: Rows) -> Iterator[str]:
    """Yield the lines of a counter, whose name ends with "_total", or a gauge."""
    yield from _head(name, "counter" if name.endswith("_total") else "gauge", text)
    for labels, value in rows:
        yield f"handtouch_{name}{_format_labels(labels)} {float(value):.17g}"


def _histograms(name: str, text: str, rows: Rows) -> Iterator[str]:
    """Yield cumulative buckets from `Histogram.statistics`."""
    rows = list(rows)
    if rows:
        yield from _head(name, "histogram", text)
    for labels, statistics in rows:
        totals = list(accumulate(statistics["counts"]))
        ends = [f"{FIRST_BUCKET_NS * 2**k * 1e-9:.12g}" for k in range(len(totals))]
        whole = totals[-1] if totals else 0
        for end, total in zip([*ends, "+Inf"], [*totals, whole], strict=True):
            yield f"handtouch_{name}_bucket{_format_labels({**labels, 'le': end})} {total}"
        yield f"handtouch_{name}_sum{_format_labels(labels)} {statistics['sum_s']:.17g}"
        yield f"handtouch_{name}_count{_format_labels(labels)} {whole}"


def _head(name: str, kind: str, text: str) -> Iterator[str]:
    yield f"# HELP handtouch_{name} {text}"
    yield f"# TYPE handtouch_{name} {kind}"


def _format_labels(labels: Labels) -> str:
    if not labels:
        return ""
    escaped = {
        name: str(value).replace("\\", "\\\\").replace("\n", "\\n").replace('"', '\\"')
        for name, value in labels.items()
    }
    return "{" + ",".join(f'{name}="{value}"' for name, value in escaped.items()) + "}"
