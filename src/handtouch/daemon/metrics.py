"""Figures for Prometheus: a process beside the daemon takes its messages and answers scrapes.

Public names: `Exporter` (the daemon's side), `render`, `CONTENT_TYPE`, `PATH`.

A process of its own, because a thread that answers would hold the interpreter when the tick needs it; here a
scrape costs the tick nothing, and a daemon that hangs still shows: handtouch_up goes to 0.
"""

from __future__ import annotations

import contextlib
import http.server
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Mapping
from typing import Any

from handtouch import wire
from handtouch.daemon.histogram import UNIT_NS

PATH = "/metrics"
CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_SILENCE_S = 1.5
_RESTART_S = 2.0
_LARGEST_BYTES = 1 << 20
_CLIENT_S = 5.0
_TRUST = ("nominal", "trusted", "quarantined", "person")
_PAD_STATES = tuple(state.name.lower() for state in wire.PadState)
_NODE_STATES = (
    *("absent", "booting", "identified", "configuring", "settling"),
    *("operational", "stale", "faulted", "stopped"),
)
_BUS_STATES = ("active", "warning", "passive", "bus-off", "down")
_CARRIED = ("frames", "sent", "bits", "samples")
_TROUBLES = ("short", "foreign", "errors", "send_failures", "queue_full", "receive_failures", "overflow")
_log = logging.getLogger("handtouch.metrics")

Labels = Mapping[str, object]


class Exporter:
    """Serves http://HOST:PORT/metrics from a process of its own; `take`, for the hot thread, never waits.

    `dropped` counts messages that the process didn't read in time. Raises OSError naming the address and a
    remedy when it can't be had.
    """

    def __init__(self, address: str) -> None:
        host, _, port = address.rpartition(":")
        self.dropped = 0
        try:
            self._listener = socket.create_server((host, int(port)))
        except OSError as error:
            raise OSError(
                f"[daemon] metrics can't be served at {address}: {error.strerror}; is another daemon running "
                "there? Set another port, or leave it out"
            ) from error
        self.address = "{}:{}".format(*self._listener.getsockname())
        self._ours, self._theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._ours.setblocking(False)
        self._closing = threading.Event()
        self.process: int | None = None
        """id of the process, once it runs"""
        self._keeper = threading.Thread(target=self._keep, name="handtouch-metrics", daemon=True)
        self._keeper.start()

    def take(self, message: wire.Health | wire.Service) -> None:
        """Hand a message on."""
        topic, payload = wire.encode(message)
        try:
            self._ours.send(topic + b"\0" + payload)
        except OSError:
            self.dropped += 1

    def close(self) -> None:
        """End the process."""
        self._closing.set()
        for end in (self._ours, self._theirs, self._listener):
            end.close()
        self._keeper.join()

    def _keep(self) -> None:
        """Start the process, and again whenever it ends."""
        files = (self._listener.fileno(), self._theirs.fileno())
        command = [sys.executable, "-m", "handtouch.daemon.metrics", *map(str, files)]
        while not self._closing.is_set():
            with contextlib.suppress(OSError, ValueError):  # closed meanwhile
                started = subprocess.Popen(command, pass_fds=files, stdin=subprocess.DEVNULL)
                self.process = started.pid
                status = started.wait()
                if not self._closing.wait(_RESTART_S):
                    _log.warning(
                        "the process that serves metrics ended with status %d; started again", status
                    )


def render(service: wire.Service | None, pads: Iterable[wire.Health], age_s: float) -> str:
    """All figures in Prometheus' text format 0.0.4; `age_s`: since the daemon was last heard of."""
    page = _Page()
    page.one("up", "gauge", "1 while the daemon's heartbeat comes", int(age_s < _SILENCE_S))
    if service is not None:
        _loop(page, service)
        _buses(page, service.buses)
        _causes(page, service)
        _process(page, service.process)
        _supervisor(page, service.supervisor)
    _pads(page, list(pads))
    return page.text()


def _loop(page: _Page, service: wire.Service) -> None:
    page.one("info", "gauge", "version of the daemon", 1, version=service.version, pid=service.pid)
    page.one("uptime_seconds", "gauge", "since the daemon started", service.uptime_s)
    page.one("period_seconds", "gauge", "of SYNC and tick, as configured", service.period_s)
    page.one("ticks_total", "counter", "ticks", service.ticks)
    page.one("tick_rate_hertz", "gauge", "ticks per second, over half a second", service.rate_hz)
    page.one("contacts_total", "counter", "contacts that began", service.contacts)
    page.many(
        "late_ticks_total",
        "counter",
        "ticks later than a period, by the part of the loop that took longest",
        [({"part": part}, count) for part, count in service.loop.get("late", {}).items()],
    )
    latency = service.loop.get("latency")
    if latency:
        page.histograms(
            "tick_latency_seconds", "from a tick's last sample to its last message", [({}, latency)]
        )
    stages = [({"stage": stage}, value) for stage, value in service.loop.get("stages", {}).items()]
    page.histograms("stage_seconds", "what each part of the loop takes of a period", stages)
    page.one("subscriptions", "gauge", "prefixes that somebody subscribed to", len(service.subscriptions))


def _buses(page: _Page, buses: Mapping[str, Any]) -> None:
    page.many(
        "bus_load_ratio",
        "gauge",
        "part of the bit rate, over half a second",
        [({"bus": bus}, figures["load"]) for bus, figures in buses.items()],
    )
    page.states("bus_state", "condition of the bus", "state", _BUS_STATES, _told(buses, "state"))
    for name in _CARRIED:
        rows = [({"bus": bus}, figures[name]) for bus, figures in buses.items()]
        page.many(f"bus_{name}_total", "counter", f"{name}: see buses of `service` in docs/wire.md", rows)
    page.many(
        "bus_troubles_total",
        "counter",
        "frames that were lost, refused or of no use, by cause",
        [({"bus": bus, "cause": n}, figures[n]) for bus, figures in buses.items() for n in _TROUBLES],
    )
    page.many(
        "bus_error_frames_total",
        "counter",
        "causes that error frames told",
        [
            ({"bus": bus, "cause": cause}, count)
            for bus, figures in buses.items()
            for cause, count in figures["causes"].items()
        ],
    )
    page.many(
        "sync_jitter_seconds",
        "gauge",
        "distance of SYNC intervals from the period, over a second",
        [
            ({"bus": bus, "quantile": quantile}, figures["sync"]["jitter_us"][name] * 1e-6)
            for bus, figures in buses.items()
            for name, quantile in (("p50", "0.5"), ("p99", "0.99"), ("max", "1"))
            if figures["sync"]["jitter_us"]
        ],
    )
    rows = [({"bus": bus}, figures["sync"]["others"]) for bus, figures in buses.items()]
    page.many("sync_foreign_total", "counter", "SYNCs of another producer while we are one", rows)


def _causes(page: _Page, service: wire.Service) -> None:
    rows: list[tuple[Labels, float]] = [({"stream": stream}, n) for stream, n in service.drops.items()]
    page.many("dropped_messages_total", "counter", "messages that a subscriber's full queue lost", rows)
    rows = [({"cause": cause}, n) for cause, n in service.refused.items()]
    page.many("refused_total", "counter", "connections and requests that were refused", rows)


def _process(page: _Page, process: Mapping[str, Any]) -> None:
    page.one("memory_bytes", "gauge", "resident memory of the daemon", process["memory_bytes"])
    rows: list[tuple[Labels, float]] = [
        ({"of": "loop"}, process["loop_cpu_s"]),
        ({"of": "process"}, process["cpu_s"]),
    ]
    page.many("cpu_seconds_total", "counter", "processor time: of the loop, and of all threads", rows)
    rows = [({"generation": number}, n) for number, n in enumerate(process["collections"])]
    page.many("gc_collections_total", "counter", "garbage collections", rows)
    rows = [({"why": why}, process[f"log_{why}"]) for why in ("dropped", "silenced")]
    page.many("log_lost_total", "counter", "log messages not said: nobody read them, or too many alike", rows)


def _pads(page: _Page, pads: list[wire.Health]) -> None:
    names: list[Labels] = [{"hand": pad.hand, "link": pad.link} for pad in pads]

    def rows(of: str) -> list[tuple[Labels, float]]:
        values = [(name, getattr(pad, of)) for name, pad in zip(names, pads, strict=True)]
        return [(name, value) for name, value in values if value is not None]

    for what, kind, of, text in (
        ("pad_samples_total", "counter", "samples", "samples taken in"),
        ("pad_missed_total", "counter", "missed", "ticks without the sample of their SYNC"),
        ("pad_rate_hertz", "gauge", "rate_hz", "samples per second, over a second"),
        ("pad_sample_age_seconds", "gauge", "age_s", "age of the newest sample when last told"),
        ("node_reboots_total", "counter", "reboots", "boot-up messages after the first"),
        ("node_heartbeats_missed_total", "counter", "heartbeats_missed", "heartbeats that did not come"),
    ):
        page.many(what, kind, text, rows(of))
    states = [(name, pad.state) for name, pad in zip(names, pads, strict=True)]
    page.states("pad_state", "what to believe of the pad", "state", _PAD_STATES, states)
    states = [(name, pad.node) for name, pad in zip(names, pads, strict=True)]
    page.states("node_state", "state of the pad's node", "state", _NODE_STATES, states)
    _findings(page, pads, names)


def _findings(page: _Page, pads: list[wire.Health], names: list[Labels]) -> None:
    states = [(name, pad.trust) for name, pad in zip(names, pads, strict=True)]
    page.states("pad_trust", "how far the unit is relied upon", "trust", _TRUST, states)
    found = [
        ({**name, "kind": kind}, 1.0)
        for name, pad in zip(names, pads, strict=True)
        for kind in sorted({finding["kind"] for finding in pad.findings})
    ]
    page.many("pad_finding", "gauge", "1 while the supervisor finds this the matter with the pad", found)


def _supervisor(page: _Page, figures: Mapping[str, Any] | None) -> None:
    if figures is None:
        return
    running = int(figures["pid"] is not None)
    page.one("supervisor_up", "gauge", "1 while the supervisor's process runs", running)
    page.one("supervisor_restarts_total", "counter", "times that it was started again", figures["restarts"])
    page.one("supervisor_dropped_total", "counter", "blocks that it was too slow for", figures["dropped"])
    page.one("supervisor_malformed_total", "counter", "words of it that made no sense", figures["malformed"])


def _told(buses: Mapping[str, Any], key: str) -> list[tuple[Labels, str]]:
    return [({"bus": bus}, figures[key]) for bus, figures in buses.items()]


class _Page:
    """Lines of the text format, one family after another."""

    def __init__(self) -> None:
        self._lines: list[str] = []

    def one(self, name: str, kind: str, text: str, value: float, **labels: object) -> None:
        self.many(name, kind, text, [(labels, value)])

    def many(self, name: str, kind: str, text: str, rows: Iterable[tuple[Labels, float]]) -> None:
        self._head(name, kind, text)
        self._lines += [f"handtouch_{name}{_text(labels)} {float(value):.17g}" for labels, value in rows]

    def states(
        self, name: str, text: str, label: str, known: Iterable[str], rows: Iterable[tuple[Labels, str]]
    ) -> None:
        """A series for every state that is known, 1 for the one that it is."""
        self.many(
            name,
            "gauge",
            f"{text}: 1 for the state that it is in",
            [({**labels, label: state}, state == now) for labels, now in rows for state in known],
        )

    def histograms(self, name: str, text: str, rows: Iterable[tuple[Labels, Mapping[str, Any]]]) -> None:
        """Cumulative buckets of what `Histogram.figures` gives."""
        self._head(name, "histogram", text)
        for labels, figures in rows:
            total = 0
            for k, count in enumerate(figures["counts"]):
                total += count
                end = f"{UNIT_NS * 2**k * 1e-9:.12g}"
                self._lines.append(f"handtouch_{name}_bucket{_text({**labels, 'le': end})} {total}")
            self._lines += [
                f"handtouch_{name}_bucket{_text({**labels, 'le': '+Inf'})} {total}",
                f"handtouch_{name}_sum{_text(labels)} {figures['sum_s']:.17g}",
                f"handtouch_{name}_count{_text(labels)} {total}",
            ]

    def text(self) -> str:
        return "\n".join(self._lines) + "\n"

    def _head(self, name: str, kind: str, text: str) -> None:
        self._lines += [f"# HELP handtouch_{name} {text}", f"# TYPE handtouch_{name} {kind}"]


def _text(labels: Labels) -> str:
    if not labels:
        return ""
    escaped = {
        name: str(value).replace("\\", "\\\\").replace("\n", "\\n").replace('"', '\\"')
        for name, value in labels.items()
    }
    return "{" + ",".join(f'{name}="{value}"' for name, value in escaped.items()) + "}"


# The process ------------------------------------------------------------------------------------------------


class _Latest:
    """The latest of every message."""

    def __init__(self) -> None:
        self._messages: dict[str, wire.Message] = {}
        self._heard_s = float("-inf")
        self._lock = threading.Lock()

    def take(self, packet: bytes, now_s: float) -> None:
        topic, _, payload = packet.partition(b"\0")
        message = wire.decode([topic, payload])
        with self._lock:
            self._messages[topic.decode()] = message
            if isinstance(message, wire.Service):
                self._heard_s = now_s

    def page(self, now_s: float) -> bytes:
        with self._lock:
            messages = list(self._messages.values())
            age_s = now_s - self._heard_s
        service = next((message for message in messages if isinstance(message, wire.Service)), None)
        return render(service, [m for m in messages if isinstance(m, wire.Health)], age_s).encode()


class _Handler(http.server.BaseHTTPRequestHandler):
    latest: _Latest
    timeout = _CLIENT_S

    def do_GET(self) -> None:
        if self.path.partition("?")[0] != PATH:
            self.send_error(404, f"only {PATH} is here")
            return
        page = self.latest.page(time.monotonic())
        self.send_response(200)
        self.send_header("Content-Type", CONTENT_TYPE)
        self.send_header("Content-Length", str(len(page)))
        self.end_headers()
        self.wfile.write(page)

    def log_message(self, *_: object) -> None:
        """Nothing: the daemon's log is for the daemon."""


class _Server(http.server.ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, listener: socket.socket, latest: _Latest) -> None:
        handler = type("Handler", (_Handler,), {"latest": latest})
        super().__init__(listener.getsockname()[:2], handler, bind_and_activate=False)
        self.socket.close()
        self.socket = listener

    def handle_error(self, *_: object) -> None:
        """Whoever hangs up in between is no matter."""


def main(listener: int, feed: int) -> None:
    """Serve until the daemon is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the daemon, and its end is ours
    with contextlib.suppress(OSError):
        os.nice(10)
    latest = _Latest()
    server = _Server(socket.socket(fileno=listener), latest)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    messages = socket.socket(fileno=feed)
    while packet := messages.recv(_LARGEST_BYTES):
        with contextlib.suppress(wire.WireError):  # a daemon of another version, for the time of an update
            latest.take(packet, time.monotonic())


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
