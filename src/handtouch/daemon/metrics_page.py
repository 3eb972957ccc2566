"""Prometheus text page from the daemon's `service` and `health` messages.

Public names: `render_metrics`, `CONTENT_TYPE`, `METRICS_PATH`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from handtouch import wire
from handtouch.daemon.stage_timer import FIRST_BUCKET_NS

METRICS_PATH = "/metrics"
CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_CALIBRATION_STATES = ("default", "calibrated", "quarantined", "manual_required")
_PAD_STATES = tuple(state.name.lower() for state in wire.PadState)
_NODE_STATES = (
    *("absent", "booting", "identified", "configuring", "settling"),
    *("operational", "stale", "faulted", "stopped"),
)
_BUS_STATES = ("active", "warning", "passive", "bus-off", "down")
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

Labels = Mapping[str, object]


def render_metrics(service: wire.Service | None, pads: Iterable[wire.Health], age_s: float) -> str:
    """Return all metrics in Prometheus' text format 0.0.4; `age_s`: age of the newest `service` message."""
    page = _MetricsPage()
    page.add_value(
        "up", "gauge", "1 while the daemon publishes its service message", int(age_s < wire.SERVICE.timeout_s)
    )
    if service is not None:
        _add_loop_metrics(page, service)
        _add_bus_metrics(page, service.buses)
        _add_loss_metrics(page, service)
        _add_process_metrics(page, service.process)
        _add_child_metrics(page, "supervisor", service.supervisor)
        _add_child_metrics(page, "percept", service.percepts)
    _add_pad_metrics(page, list(pads))
    return page.text()


def _add_loop_metrics(page: _MetricsPage, service: wire.Service) -> None:
    page.add_value("info", "gauge", "version of the daemon", 1, version=service.version, pid=service.pid)
    page.add_value("uptime_seconds", "gauge", "time since the daemon started", service.uptime_s)
    page.add_value("period_seconds", "gauge", "configured period of SYNC and tick", service.period_s)
    page.add_value("ticks_total", "counter", "ticks", service.ticks)
    page.add_value("tick_rate_hertz", "gauge", "ticks per second over the last 0.5 s", service.rate_hz)
    page.add_value("contacts_total", "counter", "contacts begun", service.contacts)
    page.add_values(
        "late_ticks_total",
        "counter",
        "ticks later than one period, by the longest part of the loop",
        [({"part": part}, count) for part, count in service.loop.get("late", {}).items()],
    )
    latency = service.loop.get("latency")
    if latency:
        page.add_histograms(
            "tick_latency_seconds", "latency from a tick's last sample to its last message", [({}, latency)]
        )
    stages = [({"stage": stage}, value) for stage, value in service.loop.get("stages", {}).items()]
    page.add_histograms("stage_seconds", "time per period of each stage of the loop", stages)
    page.add_value("subscriptions", "gauge", "subscribed topic prefixes", len(service.subscriptions))


def _add_bus_metrics(page: _MetricsPage, buses: Mapping[str, Any]) -> None:
    page.add_values(
        "bus_load_ratio",
        "gauge",
        "bus load as a fraction of the bit rate, over the last 0.5 s",
        [({"bus": bus}, statistics["load"]) for bus, statistics in buses.items()],
    )
    page.add_states("bus_state", "error state of the bus", "state", _BUS_STATES, _bus_values(buses, "state"))
    for name in _TRAFFIC_COUNTERS:
        rows = [({"bus": bus}, statistics[name]) for bus, statistics in buses.items()]
        page.add_values(
            f"bus_{name}_total", "counter", f"{name}: see buses of `service` in docs/wire.md", rows
        )
    page.add_values(
        "bus_errors_total",
        "counter",
        "lost, rejected or unusable frames, by cause",
        [
            ({"bus": bus, "cause": n}, statistics[n])
            for bus, statistics in buses.items()
            for n in _ERROR_COUNTERS
        ],
    )
    page.add_values(
        "bus_error_frames_total",
        "counter",
        "error frames by reported cause",
        [
            ({"bus": bus, "cause": cause}, count)
            for bus, statistics in buses.items()
            for cause, count in statistics["causes"].items()
        ],
    )
    page.add_values(
        "sync_jitter_seconds",
        "gauge",
        "deviation of SYNC intervals from the period, over the last second",
        [
            ({"bus": bus, "quantile": quantile}, statistics["sync"]["jitter_us"][name] * 1e-6)
            for bus, statistics in buses.items()
            for name, quantile in (("p50", "0.5"), ("p99", "0.99"), ("max", "1"))
            if statistics["sync"]["jitter_us"]
        ],
    )
    rows = [({"bus": bus}, statistics["sync"]["other_syncs"]) for bus, statistics in buses.items()]
    page.add_values(
        "sync_other_producer_total", "counter", "SYNC frames of another producer on our bus", rows
    )


def _add_loss_metrics(page: _MetricsPage, service: wire.Service) -> None:
    rows: list[tuple[Labels, float]] = [
        ({"stream": stream}, n) for stream, n in service.congestion_episodes.items()
    ]
    text = "times that a subscriber's queue was found full; it loses messages until it has caught up"
    page.add_values("congestion_episodes_total", "counter", text, rows)
    rows = [({"cause": cause}, n) for cause, n in service.rejected.items()]
    page.add_values("refused_total", "counter", "refused connections and requests", rows)


def _add_process_metrics(page: _MetricsPage, process: Mapping[str, Any]) -> None:
    page.add_value("memory_bytes", "gauge", "resident memory of the daemon", process["memory_bytes"])
    rows: list[tuple[Labels, float]] = [
        ({"scope": "loop"}, process["loop_cpu_s"]),
        ({"scope": "process"}, process["cpu_s"]),
    ]
    page.add_values(
        "cpu_seconds_total", "counter", "CPU time of the loop's thread and of the whole process", rows
    )
    rows = [({"generation": number}, n) for number, n in enumerate(process["collections"])]
    page.add_values("gc_collections_total", "counter", "garbage collections", rows)
    rows = [({"reason": reason}, process[f"log_{reason}"]) for reason in ("dropped", "suppressed")]
    page.add_values(
        "log_lost_total", "counter", "log messages dropped by a full queue or suppressed as repeated", rows
    )


def _add_pad_metrics(page: _MetricsPage, pads: list[wire.Health]) -> None:
    names: list[Labels] = [{"hand": pad.hand, "link": pad.link} for pad in pads]

    def rows(field: str) -> list[tuple[Labels, float]]:
        values = [(name, getattr(pad, field)) for name, pad in zip(names, pads, strict=True)]
        return [(name, value) for name, value in values if value is not None]

    for metric, kind, field, text in (
        ("pad_samples_total", "counter", "samples", "samples received"),
        ("pad_missed_samples_total", "counter", "missed_samples", "ticks without the sample of their SYNC"),
        ("pad_rate_hertz", "gauge", "rate_hz", "samples per second over the last second"),
        ("pad_sample_age_seconds", "gauge", "age_s", "age of the newest sample when last published"),
        ("node_reboots_total", "counter", "reboots", "boot-up messages after the first"),
        ("node_heartbeats_missed_total", "counter", "heartbeats_missed", "heartbeats that timed out"),
    ):
        page.add_values(metric, kind, text, rows(field))
    pad_states = [(name, pad.state) for name, pad in zip(names, pads, strict=True)]
    page.add_states("pad_state", "state of the pad", "state", _PAD_STATES, pad_states)
    node_states = [(name, pad.node_state) for name, pad in zip(names, pads, strict=True)]
    page.add_states("node_state", "state of the pad's node", "state", _NODE_STATES, node_states)
    _add_diagnosis_metrics(page, pads, names)


def _add_diagnosis_metrics(page: _MetricsPage, pads: list[wire.Health], names: list[Labels]) -> None:
    states = [(name, pad.calibration_state) for name, pad in zip(names, pads, strict=True)]
    page.add_states(
        "pad_calibration_state", "state of the pad's calibration", "state", _CALIBRATION_STATES, states
    )
    rows = [
        ({**name, "kind": kind}, 1.0)
        for name, pad in zip(names, pads, strict=True)
        for kind in sorted({diagnosis["kind"] for diagnosis in pad.diagnoses})
    ]
    page.add_values("pad_diagnosis", "gauge", "1 while the supervisor diagnoses this fault", rows)


def _add_child_metrics(page: _MetricsPage, name: str, statistics: Mapping[str, Any] | None) -> None:
    """Add the state of a child process, the supervisor or the percept process."""
    if statistics is None:
        return
    process = f"the {name} process"
    page.add_value(f"{name}_up", "gauge", f"1 while {process} runs", int(statistics["pid"] is not None))
    for key, meaning in (
        ("restarts", f"restarts of {process}"),
        ("dropped", f"messages dropped because {process} was too slow"),
        ("malformed", f"malformed messages of {process}"),
    ):
        page.add_value(f"{name}_{key}_total", "counter", meaning, statistics[key])


def _bus_values(buses: Mapping[str, Any], key: str) -> list[tuple[Labels, str]]:
    return [({"bus": bus}, statistics[key]) for bus, statistics in buses.items()]


class _MetricsPage:
    """Lines of the text format, one metric family after another."""

    def __init__(self) -> None:
        self._lines: list[str] = []

    def add_value(self, name: str, kind: str, text: str, value: float, **labels: object) -> None:
        self.add_values(name, kind, text, [(labels, value)])

    def add_values(self, name: str, kind: str, text: str, rows: Iterable[tuple[Labels, float]]) -> None:
        self._add_header(name, kind, text)
        self._lines += [
            f"handtouch_{name}{_format_labels(labels)} {float(value):.17g}" for labels, value in rows
        ]

    def add_states(
        self, name: str, text: str, label: str, known: Iterable[str], rows: Iterable[tuple[Labels, str]]
    ) -> None:
        """Add a series for every known state, 1 for the present one."""
        self.add_values(
            name,
            "gauge",
            f"{text}: 1 for the present state",
            [({**labels, label: state}, state == now) for labels, now in rows for state in known],
        )

    def add_histograms(self, name: str, text: str, rows: Iterable[tuple[Labels, Mapping[str, Any]]]) -> None:
        """Add cumulative buckets from `Histogram.statistics`."""
        self._add_header(name, "histogram", text)
        for labels, statistics in rows:
            total = 0
            for k, count in enumerate(statistics["counts"]):
                total += count
                end = f"{FIRST_BUCKET_NS * 2**k * 1e-9:.12g}"
                self._lines.append(f"handtouch_{name}_bucket{_format_labels({**labels, 'le': end})} {total}")
            self._lines += [
                f"handtouch_{name}_bucket{_format_labels({**labels, 'le': '+Inf'})} {total}",
                f"handtouch_{name}_sum{_format_labels(labels)} {statistics['sum_s']:.17g}",
                f"handtouch_{name}_count{_format_labels(labels)} {total}",
            ]

    def text(self) -> str:
        return "\n".join(self._lines) + "\n"

    def _add_header(self, name: str, kind: str, text: str) -> None:
        self._lines += [f"# HELP handtouch_{name} {text}", f"# TYPE handtouch_{name} {kind}"]


def _format_labels(labels: Labels) -> str:
    if not labels:
        return ""
    escaped = {
        name: str(value).replace("\\", "\\\\").replace("\n", "\\n").replace('"', '\\"')
        for name, value in labels.items()
    }
    return "{" + ",".join(f'{name}="{value}"' for name, value in escaped.items()) + "}"
