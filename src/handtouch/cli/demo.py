"""`handtouch demo`: a simulated hand, the daemon and a live view in one process, on a virtual bus.

With `view` another process shows the hand in the browser. It needs no hardware and doesn't interfere with a
daemon on the same machine: the bus is python-can's `virtual` interface, and endpoints are the default ones
where all of them are free, else free ports.
"""

from __future__ import annotations

import argparse
import itertools
import logging
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, Self

import numpy as np

from handtouch import wire
from handtouch.cli.errors import failing
from handtouch.cli.options import add_number
from handtouch.cli.simulate import add_grasp, add_scenario, add_world
from handtouch.client import Subscriber, connect
from handtouch.config import Deployment, load, shipped
from handtouch.core.compiled import Compilation
from handtouch.core.pad_model import PadModel
from handtouch.core.stages.rows import VALUE_COUNT
from handtouch.core.stages.solve import ContactSolver
from handtouch.daemon.daemon import HandtouchDaemon
from handtouch.daemon.table_cache import build_pad_model
from handtouch.host.endpoints import COMPLETE_ENDPOINT, CONTROL_ENDPOINT, INPUTS_ENDPOINT, LIVE_ENDPOINT
from handtouch.host.installation import compile_command
from handtouch.host.signals import stop_on_signals
from handtouch.simulate.grasp import grasp_stimulus as grasped
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.score import score_contacts
from handtouch.simulate.simulated_hand import SimulatedHand
from handtouch.simulate.stimulus import Stimulus
from handtouch.simulate.worlds import WORLDS, DrawnWorld, world_with
from handtouch.view.displays import (
    Display,
    LineDisplay,
    LiveDisplay,
    show_messages,
)
from handtouch.view.message_lines import diagnosis_text
from handtouch.view.page import HOST, PORT

DEFAULT_DEPLOYMENT = "utah_mit.toml"
DEFAULT_SCENARIO = "utah_mit_session.toml"
_ENDPOINTS = {
    "live": LIVE_ENDPOINT,
    "complete": COMPLETE_ENDPOINT,
    "control": CONTROL_ENDPOINT,
    "inputs": INPUTS_ENDPOINT,
}
_BOOT_ALLOWANCE_S = 2.0
_BUSY_SHARE = 0.01
"""Least share of ticks that came late or never to be named; fewer change no figure of the verdict"""
_SAMPLE_WINDOW_FRACTION = 0.95  # long, as the nodes share the interpreter
_GIL_SWITCH_INTERVAL_S = 0.0005
"""Short, as hand, daemon and view share one interpreter, and the daemon must not wait for the view."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `demo`."""
    parser.set_defaults(command=run)
    parser.add_argument("--plain", action="store_true", help="print lines instead of the live view")
    parser.add_argument("--view", action="store_true", help="also show the hand in the browser, until Ctrl-C")
    parser.add_argument(
        "--details", action="store_true", help="print the accuracy of each pad, too, when the demo ends"
    )
    add_number(parser, "--seconds", "S", "duration (default: that of the scenario)")
    parser.add_argument(
        "--config",
        dest="config_path",
        type=Path,
        metavar="CONFIG",
        help="deployment to simulate (default: the shipped hand)",
    )
    stimulus = parser.add_mutually_exclusive_group()
    add_scenario(stimulus, "scenario_path", "(default: session)")
    add_grasp(stimulus)
    add_world(parser, "default")


def run(
    *,
    config_path: Path | None = None,
    seconds: float | None = None,
    plain: bool = False,
    details: bool = False,
    world: str = "default",
    seed: int = 1,
    view: bool = False,
    grasp: str | None = None,
    scenario_path: Path | None = None,
    sheet: Literal["S1", "S2"] | None = None,
    drift: bool = False,
) -> int:
    """Play the scenario to its end, for `seconds`, or until Ctrl-C; then print the accuracy.

    With `details` also by pad. With `grasp`, an object, the hand grasps it instead. `world` is one of
    `WORLDS`, changed by `sheet` and `drift` as in `world_with`. The deployment gets the nominal behaviour of
    its sheets. Worlds other than the ideal one, and `scenario_path`, start the supervisor, with a temporary
    store. With `view` the scenario repeats until `seconds` have passed or Ctrl-C. The SYNC rate is that of
    `lower_rate`. Exit status 0; 1 if no contact was received; 2 for an unusable configuration.
    """
    logging.basicConfig(level=logging.ERROR)
    logging.getLogger("canopen").setLevel(logging.CRITICAL)  # the master reports these errors itself
    with failing(2, ValueError):  # an error in a file, or an impossible grasp
        deployment = _with_palm_output(
            in_process_deployment(load(config_path or shipped.path(DEFAULT_DEPLOYMENT)))
        )
        hidden = world_with(WORLDS[world], sheet=sheet, drift=drift).draw(seed)
        if scenario_path or hidden.world != WORLDS["ideal"]:
            deployment = _with_supervisor(hidden.describe(deployment))
        model = build_pad_model(deployment)
        deployment = lower_rate(deployment, model)
        file = scenario_path or (None if config_path else shipped.path(DEFAULT_SCENARIO))
        scenario = _scenario(deployment, file, grasp=grasp, world=hidden, repeat=view)
    endless = view and seconds is None
    length_s = float("inf") if endless else seconds or scenario.duration_s + _BOOT_ALLOWANCE_S
    stop = stop_on_signals()
    sys.setswitchinterval(_GIL_SWITCH_INTERVAL_S)
    print("building the simulated hand ...", file=sys.stderr)
    with failing(2, ValueError):  # a scenario for another hand, an EDS that can't be simulated
        hand = SimulatedHand.open(deployment, scenario, hidden, record=not endless)
    with (
        hand,
        TemporaryDirectory(prefix="handtouch-demo-") as folder,
        _open_daemon(deployment, model, Path(folder)) as daemon,
        _subscribe(daemon) as messages,
        _browser_view(daemon) if view else nullcontext("") as url,
    ):
        collector = _ContactCollector(_choose_display(plain, url), keep=not endless)
        print(_endpoints_text(daemon.publisher.endpoints["live"]), file=sys.stderr)
        hand.publish_joints(deployment, scenario, daemon.inputs.endpoint)
        hand.start()
        with _daemon_thread(daemon, stop):
            end_s = time.monotonic() + length_s
            with collector:
                show_messages(messages, collector, lambda: stop.is_set() or time.monotonic() > end_s)
    for text in collector.diagnoses.values():
        print(f"diagnosis: {text}")
    if not endless:
        score = score_contacts(collector.contacts, hand.truth)
        print(f"{score.table()}\n\n{score}" if details else score)
        if (share := collector.late_share) > _BUSY_SHARE:
            print(f"this computer was too busy for {100 * share:.0f} % of the ticks;")
            print("  a quieter one measures better")
    return 0 if collector.contact_count else 1


@contextmanager
def _daemon_thread(daemon: HandtouchDaemon, stop: threading.Event) -> Iterator[None]:
    """Run the daemon in a thread until the block ends."""
    thread = threading.Thread(target=daemon.run, args=(stop,), name="handtouch-daemon")
    thread.start()
    try:
        yield
    finally:  # also if stdout was closed
        stop.set()
        thread.join()


def _choose_display(plain: bool, url: str) -> Display:
    """Return the live view on a terminal, else lines; both show the URL of the page, if there is one."""
    if sys.stdout.isatty() and not plain:
        return LiveDisplay(f"handtouch demo{f', in the browser at {url}' if url else ''}: Ctrl-C ends it")
    if url:
        print(f"in the browser at {url}", file=sys.stderr)
    return LineDisplay()


def _scenario(
    deployment: Deployment, file: Path | None, *, grasp: str | None, world: DrawnWorld, repeat: bool
) -> Stimulus:
    """Return the stimulus: a grasp, a scenario file, or a tour of all pads."""
    if grasp:
        return grasped(deployment, grasp, world, repeat=repeat)
    scenario = Scenario.load(file) if file else Scenario.tour(deployment)
    return scenario.model_copy(update={"repeat": True}) if repeat else scenario


@contextmanager
def _browser_view(daemon: HandtouchDaemon) -> Iterator[str]:
    """Run `handtouch view` for this daemon in a process; yields the URL of its page, empty if it failed."""
    with socket.socket() as probe:
        taken = probe.connect_ex((HOST, PORT)) == 0
    command = [sys.executable, "-m", "handtouch", "view", "--key", "", "--port", "0" if taken else str(PORT)]
    endpoint = daemon.publisher.endpoints["live"]
    with subprocess.Popen(
        [*command, "--endpoint", endpoint], stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline().split()
            yield next((part for part in line if part.startswith("http")), "")
        finally:
            process.terminate()


class _ContactCollector:
    """Display that counts contacts and late ticks, keeps contacts for the score, and collects diagnoses."""

    def __init__(self, display: Display, keep: bool) -> None:
        self.contacts: list[wire.Contact] = []
        self.diagnoses: dict[tuple[str, str], str] = {}
        self.contact_count = 0
        self.late_share = 0.0
        """share of the periods so far whose tick came late or never"""
        self._display, self._keep_contacts = display, keep

    def show_message(self, message: wire.Message) -> None:
        if isinstance(message, wire.Contact):
            self.contact_count += 1
            if self._keep_contacts:
                self.contacts.append(message)
        if isinstance(message, wire.Health):
            for diagnosis in message.diagnoses:
                text = f"{message.hand}/{message.link}: {diagnosis_text(diagnosis)}"
                self.diagnoses.setdefault((message.link, diagnosis["kind"]), text)
        if isinstance(message, wire.Service):
            self.late_share = message.overruns / max(1, message.overruns + message.ticks)
        if not (isinstance(message, wire.Service) and isinstance(self._display, LineDisplay)):
            self._display.show_message(message)

    def refresh(self, problem: str) -> None:
        self._display.refresh(problem)

    def __enter__(self) -> Self:
        self._display.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._display.__exit__(None, None, None)


def _with_palm_output(deployment: Deployment) -> Deployment:
    """Return the deployment with contacts also in the palm's frame, if a hand has a URDF."""
    if not any(hand.urdf for hand in deployment.hands):
        return deployment
    scene = deployment.scene.model_copy(update={"outputs": (*deployment.scene.outputs, "palm")})
    return deployment.model_copy(update={"scene": scene})


def _with_supervisor(deployment: Deployment) -> Deployment:
    """Return the deployment with a supervisor, and serial numbers for it."""
    serials = itertools.count(1001)
    daemon = deployment.daemon.model_copy(update={"supervise": True, "store": "calibrations.db"})
    return deployment.model_copy(update={"daemon": daemon}).with_pads(
        lambda _, pad: pad.model_copy(update={"serial": next(serials)})
    )


def in_process_deployment(deployment: Deployment) -> Deployment:
    """Return the deployment with virtual buses in this process and endpoints on free ports."""
    buses = tuple(
        bus.model_copy(
            update={
                "interface": "virtual",
                "channel": f"handtouch-{os.getpid()}-{bus.name}",
                "options": {},
                "sync": "producer",
            }
        )
        for bus in deployment.buses
    )
    settings = dict.fromkeys(_ENDPOINTS, "tcp://127.0.0.1:*")
    # simulated nodes don't belong in the calibration store
    alone = {**settings, "keys": None, "sample_window_fraction": _SAMPLE_WINDOW_FRACTION, "supervise": False}
    daemon = deployment.daemon.model_copy(update=alone)
    return deployment.model_copy(update={"buses": buses, "daemon": daemon})


def _open_daemon(deployment: Deployment, model: PadModel, folder: Path) -> HandtouchDaemon:
    """Open the daemon on the default endpoints; where one is in use, on the deployment's free ports."""
    by_default = deployment.model_copy(update={"daemon": deployment.daemon.model_copy(update=_ENDPOINTS)})
    try:
        return HandtouchDaemon.open(by_default, model, folder=folder)
    except OSError:
        return HandtouchDaemon.open(deployment, model, folder=folder)


def _endpoints_text(live: str) -> str:
    """Return how programs and commands connect to the demo."""
    if live == LIVE_ENDPOINT:
        return "programs and `handtouch watch` connect to this hand by default"
    return f"the default endpoints are in use: connect to this hand by endpoint = {live}"


def _subscribe(daemon: HandtouchDaemon) -> Subscriber[wire.Message]:
    endpoint = daemon.publisher.endpoints["live"]
    return connect("contact/*/*", "health/*/*", "service", endpoint=endpoint, key="", queue=100_000)


_MAX_LOAD = 0.25
"""Part of a period for solving contacts; the simulated hand and the view share the interpreter."""
_MAX_PERIOD_MS = 1000.0  # longest period that a deployment may state
_MIN_PROCESSORS, _SHARED_PERIOD_MS = 4, 10.0
"""A simulated hand takes 2.2 ms for a sample with touches, on two processors of 2026: at 200 Hz, its nodes
answer too late while the supervisor builds its tables beside it"""
_TRIALS = 5
_CONTACT_RADII = 10.0  # current of a trial's contacts, in thresholds of detection


def lower_rate(deployment: Deployment, model: PadModel) -> Deployment:
    """Return the deployment with a SYNC rate that this machine holds, and report it on stderr if it is lower.

    With few processors the simulated hand, which shares the interpreter, gets half of them at most; with an
    uncompiled core a tick must have the time for a contact on every pad.
    """
    compilation = Compilation.current()
    configured_ms, processors = deployment.daemon.sync_period_ms, len(os.sched_getaffinity(0))
    if compilation.compiled:
        cause, period_ms = f"{processors} processors", configured_ms
        if processors < _MIN_PROCESSORS:
            period_ms = max(configured_ms, _SHARED_PERIOD_MS)
        remedy = "which simulation, daemon and learning hold together; `handtouch run` alone holds more"
    else:
        cause, period_ms = "core uncompiled", sustained_period_ms(configured_ms, solving_time_s(model))
        remedy = f"which this machine holds: {compilation.reason}; {compilation.remedy or compile_command()}"
    if period_ms == configured_ms:
        return deployment
    rates = f"from {1e3 / configured_ms:g} to {1e3 / period_ms:g} Hz"
    print(f"{cause}: SYNC rate lowered {rates}, {remedy}", file=sys.stderr)
    settings = deployment.daemon.model_copy(update={"sync_period_ms": period_ms})
    return deployment.model_copy(update={"daemon": settings})


def sustained_period_ms(configured_ms: float, solving_s: float) -> float:
    """Return the configured SYNC period, doubled until solving all contacts takes at most a quarter of it."""
    period_ms = configured_ms
    while solving_s * 1e3 > _MAX_LOAD * period_ms and 2 * period_ms <= _MAX_PERIOD_MS:
        period_ms *= 2
    return period_ms


def solving_time_s(model: PadModel) -> float:
    """Return the median time of a tick's contacts, one on every pad."""
    currents = np.zeros((model.size, model.channels))
    for row, network in zip(currents, model.networks, strict=True):
        row[: len(network.series_ohm)] = network.fractions(network.a / 3, network.b / 3)
    currents *= _CONTACT_RADII * model.begin_threshold_a[:, None]
    values = np.full((model.size, VALUE_COUNT), np.nan)
    requested = np.ones(model.size, dtype=np.bool_)
    solver = ContactSolver(model, currents, np.zeros(model.size), requested, values)
    pads = np.arange(model.size, dtype=np.intp).data
    times_s = []
    for _ in range(_TRIALS):
        start_s = time.perf_counter()
        solver.solve_contacts(pads)
        times_s.append(time.perf_counter() - start_s)
    return float(np.median(times_s))
