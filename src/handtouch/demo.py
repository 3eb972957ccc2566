"""`handtouch demo`: a simulated hand, the daemon and a live view in one process, on a bus inside it.

With `view` the hand is in the browser too, by a process of its own.

Nothing is needed but this machine, and nothing is in the way of a daemon that runs here already: the bus
is python-can's `virtual` one and the endpoints take free ports.
"""

from __future__ import annotations

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

from handtouch import shipped, wire
from handtouch.client import Subscriber, connect
from handtouch.config import Deployment, load
from handtouch.config.tables import Behaviour
from handtouch.daemon.daemon import Daemon
from handtouch.hand import kinematics
from handtouch.signals import stop_on_signals
from handtouch.simulate.grasp import played as grasped
from handtouch.simulate.play import Play
from handtouch.simulate.run import SimulatedHand
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.score import score
from handtouch.simulate.world import World
from handtouch.view.lines import finding_text
from handtouch.view.page import HOST, PORT
from handtouch.view.watch import Display, LineDisplay, LiveDisplay, follow

DEPLOYMENT = "utah_mit.toml"
SCENARIO = "utah_mit_session.toml"
_BOOT_S = 2.0
_WINDOW = 0.95  # the nodes answer when the interpreter lets them
_GIL_SWITCH_S = 0.0005
"""Hand, daemon and view share one interpreter here; the daemon must not wait long for the view."""


def run(
    *,
    config_path: Path | None = None,
    seconds: float | None = None,
    plain: bool = False,
    tolerances: bool = False,
    seed: int = 1,
    view: bool = False,
    grasp: str | None = None,
    scenario_path: Path | None = None,
    sheet: Literal["S1", "S2"] | None = None,
    drift: bool = False,
) -> int:
    """Play the scenario to its end, or for `seconds`, or until Ctrl-C; then compare contacts with the truth.

    With `grasp`, a thing, the hand grasps that instead. With `scenario_path`, sheets that behave as `sheet`
    or electronics that `drift`, the supervisor is at work, with a store that is gone afterwards. With `view`
    it is played again and again, until `seconds` are over or Ctrl-C comes. Exit status 0, 1 when no contact
    came through, 2 for a configuration that can't be used.
    """
    logging.basicConfig(level=logging.ERROR)
    try:
        deployment = _placed(in_process(load(config_path or shipped.path(DEPLOYMENT))))
        if scenario_path or sheet or drift:
            deployment = _supervised(deployment, sheet)
        world = World.named(seed, tolerances=tolerances, sheet=sheet, drift=drift)
        file = scenario_path or (None if config_path else shipped.path(SCENARIO))
        scenario = _scenario(deployment, file, grasp=grasp, world=world, repeat=view)
    except ValueError as error:  # of a file, or of a grasp that can't be
        print(error, file=sys.stderr)
        return 2
    endless = view and seconds is None
    length_s = float("inf") if endless else seconds or scenario.duration_s + _BOOT_S
    stop = stop_on_signals()
    sys.setswitchinterval(_GIL_SWITCH_S)
    print("building the simulated hand ...", file=sys.stderr)
    try:
        hand = SimulatedHand.open(deployment, scenario, world, record=not endless)
        with (
            hand,
            TemporaryDirectory(prefix="handtouch-demo-") as folder,
            Daemon(deployment, beside=Path(folder)) as daemon,
            _subscribe(daemon) as messages,
            _page(daemon) if view else nullcontext("") as url,
        ):
            keeper = _Keeper(_display(plain, url), keep=not endless)
            hand.tell_joints(deployment, scenario, daemon.inputs.endpoint)
            hand.start()
            with _serving(daemon, stop):
                end_s = time.monotonic() + length_s
                with keeper:
                    follow(messages, keeper, lambda: stop.is_set() or time.monotonic() > end_s)
    except ValueError as error:  # a scenario for another hand, an EDS that can't be simulated
        print(error, file=sys.stderr)
        return 2
    for told in keeper.findings.values():
        print(f"found {told}")
    if not endless:
        print(score(keeper.contacts, hand.truth))
    return 0 if keeper.count else 1


@contextmanager
def _serving(daemon: Daemon, stop: threading.Event) -> Iterator[None]:
    """The daemon at work in a thread of its own; it ends with the block, whatever ends that."""
    served = threading.Thread(target=daemon.run, args=(stop,), name="handtouch-daemon")
    served.start()
    try:
        yield
    finally:  # also when nobody reads our lines any more
        stop.set()
        served.join()


def _display(plain: bool, url: str) -> Display:
    """Lines or the live view, which tell where the page is, if there is one."""
    if sys.stdout.isatty() and not plain:
        return LiveDisplay(f"handtouch demo{f', in the browser at {url}' if url else ''}: Ctrl-C ends it")
    if url:
        print(f"in the browser at {url}", file=sys.stderr)
    return LineDisplay()


def _scenario(
    deployment: Deployment, file: Path | None, *, grasp: str | None, world: World, repeat: bool
) -> Play:
    """What is played: a grasp, a file, or a tour of the hand without one; `repeat`: again and again."""
    if grasp:
        return grasped(deployment, grasp, world, repeat=repeat)
    scenario = Scenario.load(file) if file else Scenario.tour(deployment)
    return scenario.model_copy(update={"repeat": True}) if repeat else scenario


@contextmanager
def _page(daemon: Daemon) -> Iterator[str]:
    """`handtouch view` of this daemon as a process of its own: the URL of its page; empty: none."""
    with socket.socket() as probe:
        taken = probe.connect_ex((HOST, PORT)) == 0
    command = [sys.executable, "-m", "handtouch", "view", "--key", "", "--port", "0" if taken else str(PORT)]
    endpoint = daemon.publisher.endpoints["live"]
    with subprocess.Popen(
        [*command, "--endpoint", endpoint], stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            assert process.stdout is not None
            words = process.stdout.readline().split()
            yield next((word for word in words if word.startswith("http")), "")
        finally:
            process.terminate()


class _Keeper:
    """A display that counts the contacts it is shown, and may keep them, to compare them with the truth."""

    def __init__(self, display: Display, keep: bool) -> None:
        self.contacts: list[wire.Contact] = []
        self.findings: dict[tuple[str, str], str] = {}
        self.count = 0
        self._display, self._keep = display, keep

    def take(self, message: wire.Message) -> None:
        if isinstance(message, wire.Contact):
            self.count += 1
            if self._keep:
                self.contacts.append(message)
        if isinstance(message, wire.Health):
            for finding in message.findings:
                told = f"{message.hand}/{message.link}: {finding_text(finding)}"
                self.findings.setdefault((message.link, finding["kind"]), told)
        if not (isinstance(message, wire.Service) and isinstance(self._display, LineDisplay)):
            self._display.take(message)

    def frame(self, alive: bool) -> None:
        self._display.frame(alive)

    def __enter__(self) -> Self:
        self._display.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._display.__exit__(None, None, None)


def _placed(deployment: Deployment) -> Deployment:
    """The deployment with contacts told in the palm, where that can be done."""
    if not kinematics.available() or not any(hand.urdf for hand in deployment.hands):
        return deployment
    scene = deployment.scene.model_copy(update={"outputs": (*deployment.scene.outputs, "palm")})
    return deployment.model_copy(update={"scene": scene})


def _supervised(deployment: Deployment, sheet: Literal["S1", "S2"] | None) -> Deployment:
    """The deployment with its supervisor at work, which needs to know one unit from another; and with sheets
    that the daemon knows to behave as those of a preset."""
    first = 1001
    hands = []
    for hand in deployment.hands:
        pads = tuple(pad.model_copy(update={"serial": first + k}) for k, pad in enumerate(hand.pads))
        hands.append(hand.model_copy(update={"pads": pads}))
        first += len(pads)
    daemon = deployment.daemon.model_copy(update={"supervise": True, "store": "calibrations.db"})
    sheets = deployment.sheets
    if sheet:
        behaviour = Behaviour(preset=sheet)
        sheets = {name: it.model_copy(update={"behaviour": behaviour}) for name, it in sheets.items()}
    return deployment.model_copy(update={"hands": tuple(hands), "daemon": daemon, "sheets": sheets})


def in_process(deployment: Deployment) -> Deployment:
    """The deployment with its buses inside this process and its endpoints on free ports."""
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
    settings = dict.fromkeys(("live", "complete", "control", "inputs"), "tcp://127.0.0.1:*")
    # simulated units have no place in the calibration store
    alone = {**settings, "keys": None, "window": _WINDOW, "supervise": False}
    daemon = deployment.daemon.model_copy(update=alone)
    return deployment.model_copy(update={"buses": buses, "daemon": daemon})


def _subscribe(daemon: Daemon) -> Subscriber[wire.Message]:
    endpoint = daemon.publisher.endpoints["live"]
    return connect("contact/*/*", "health/*/*", "service", endpoint=endpoint, key="", queue=100_000)
