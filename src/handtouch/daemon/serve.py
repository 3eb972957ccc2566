"""Start of `handtouch run`: deployment file, logging, metrics, real-time settings, systemd.

Public name: `run`.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path

from handtouch.canbus.nodes.spec import check_nodes
from handtouch.config import Deployment, load
from handtouch.daemon.daemon import HandtouchDaemon
from handtouch.daemon.metrics import METRICS_PATH, MetricsExporter
from handtouch.hand.robot_models import drop_invalid_urdfs
from handtouch.host import logs, realtime
from handtouch.host.signals import stop_on_signals
from handtouch.host.systemd import ServiceWatchdog, SystemdNotifier

_log = logging.getLogger("handtouch.daemon")

_GIL_SWITCH_INTERVAL_S = 0.0005  # limits how long a thread that boots a node or builds a model holds the GIL


def run(config_path: Path, buses: Sequence[str] = ()) -> None:
    """Serve a deployment until SIGINT or SIGTERM.

    Raises ConfigError, EdsError, KeyFileError for wrong files, where a restart can't help; BusError,
    EndpointError for what can't be opened.
    """
    deployment = _read_deployment(config_path, buses)
    stop = stop_on_signals()
    log_handler = logs.start_logging(deployment.daemon.log_level)
    logging.getLogger("canopen").setLevel(logging.CRITICAL)  # the master logs these events itself
    try:
        _serve(deployment, stop, partial(_read_deployment, config_path, buses), config_path.parent)
    finally:
        log_handler.close()


def _serve(
    deployment: Deployment, stop: threading.Event, read: Callable[[], Deployment], folder: Path
) -> None:
    settings = deployment.daemon
    sys.setswitchinterval(_GIL_SWITCH_INTERVAL_S)
    with ExitStack() as stack:
        notifier = stack.enter_context(closing(SystemdNotifier.open()))
        exporter = None
        if settings.metrics is not None:
            exporter = stack.enter_context(closing(MetricsExporter.open(settings.metrics)))
        on_message = exporter.send if exporter is not None else None
        daemon = HandtouchDaemon.open(deployment, read=read, folder=folder, on_message=on_message)
        stack.enter_context(daemon)
        _log_endpoints(daemon)
        if exporter is not None:
            _log.info("metrics: http://%s%s", exporter.address, METRICS_PATH)
        for refused in realtime.apply_realtime_settings(settings):
            _log.warning("%s", refused)
        watchdog_ns = int(os.environ.get("WATCHDOG_USEC", "0")) * 1000
        daemon.run(stop, ServiceWatchdog(notifier, watchdog_ns, daemon.reporter.summary).notify_tick)
        notifier.send("STOPPING=1")


def _read_deployment(config_path: Path, buses: Sequence[str]) -> Deployment:
    """Read a deployment, with other buses if given; drop URDFs that don't fit. Raises ConfigError."""
    deployment = load(config_path, buses)
    deployment = check_nodes(deployment, str(config_path))  # report mistakes before a bus is opened
    deployment, problems = drop_invalid_urdfs(deployment, str(config_path))
    for problem in problems:
        _log.error("%s: %s; palm and base frame of that hand are unavailable", config_path, problem)
    return deployment


def _log_endpoints(daemon: HandtouchDaemon) -> None:
    endpoints = {**daemon.publisher.endpoints, "control": daemon.control.endpoint}
    hands = ", ".join(f"{hand.name} ({len(hand.pads)} pads)" for hand in daemon.deployment.hands)
    buses = ", ".join(f"{bus.name} ({bus.interface} {bus.channel})" for bus in daemon.deployment.buses)
    _log.info("hands: %s; buses: %s", hands, buses)
    _log.info("endpoints: %s", ", ".join(f"{name} {endpoint}" for name, endpoint in endpoints.items()))
