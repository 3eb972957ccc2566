"""`handtouch simulate`: a simulated hand on the buses of a deployment, in real time."""

from __future__ import annotations

import argparse
import contextlib
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

from handtouch import config
from handtouch.canbus.nodes.spec import check_nodes
from handtouch.cli.errors import CommandError, failing
from handtouch.cli.options import add_bus, add_config, add_number
from handtouch.config import shipped
from handtouch.config.problems import ConfigError
from handtouch.host.endpoints import GRIPPER_ENDPOINT
from handtouch.host.signals import stop_on_signals
from handtouch.simulate import truth as truth_file
from handtouch.simulate.grasp import grasp_stimulus
from handtouch.simulate.gripper import GripperStimulus
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.simulated_hand import SimulatedHand
from handtouch.simulate.stimulus import Stimulus
from handtouch.simulate.worlds import WORLDS, DrawnWorld, world_with

DEFAULT_SCENARIO = "utah_mit_session.toml"
_STATUS_PERIOD_S = 5.0
_POLL_PERIOD_S = 0.5


SCENARIOS = {
    "session": "touches, then a grasp",
    "gum": "chewing gum sticks to a finger",
    "swap": "a node is replaced",
    "faults": "several, one after another",
}
"""Content of the scenarios of `config.shipped`, which takes long to import."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `simulate`."""
    parser.set_defaults(command=run_command)
    add_config(parser)
    add_bus(parser)
    stimulus = parser.add_mutually_exclusive_group()
    add_scenario(
        stimulus,
        "scenario",
        "(default: session if the deployment has its links, else touches on every pad)",
    )
    add_grasp(stimulus)
    stimulus.add_argument(
        "--gripper",
        nargs="?",
        const=GRIPPER_ENDPOINT,
        metavar="ENDPOINT",
        help="simulate a gripper that clients command at this endpoint, for deployments such as "
        f"two_finger.toml (default: {GRIPPER_ENDPOINT})",
    )
    parser.add_argument(
        "--truth", type=Path, metavar="FILE", help="write the ground truth to this file, as JSON lines"
    )
    add_number(parser, "--seconds", "S", "duration (default: until Ctrl-C)")
    add_world(parser, "ideal")


def add_scenario(parser: argparse._ActionsContainer, dest: str, text: str) -> None:
    parser.add_argument(
        "--scenario",
        dest=dest,
        type=_existing_scenario,
        metavar="NAME",
        help=f"scenario to play: {_scenario_texts()}, or a file {text}",
    )


def _scenario_texts() -> str:
    return ", ".join(f"{name} ({content})" for name, content in SCENARIOS.items())


def _existing_scenario(name: str) -> Path:
    if not (path := shipped.scenario_path(name)).is_file():
        raise argparse.ArgumentTypeError(f"{name}: is neither a file nor one of {', '.join(SCENARIOS)}")
    return path


def add_grasp(parser: argparse._ActionsContainer) -> None:
    parser.add_argument(
        "--grasp",
        metavar="OBJECT",
        help="grasp a ball, box, pen or cup, simulated in MuJoCo (pip install 'handtouch[mujoco]')",
    )


def add_world(parser: argparse.ArgumentParser, default_world: str) -> None:
    parser.add_argument(
        "--world",
        choices=("ideal", "default", "harsh"),
        default=default_world,
        help="true properties of the hand, unknown to the daemon: ideal: exactly as in the file, with noise; "
        "default: with the tolerances, sheets and drift that a careful builder gets; harsh: two to three "
        f"times wider (default: {default_world})",
    )
    parser.add_argument(
        "--sheet",
        choices=("S1", "S2"),
        help="simulate the creep and adaptation of S1 or S2, the two sensor sheets measured in the paper, "
        "instead of the world's sheets",
    )
    parser.add_argument(
        "--drift",
        action="store_true",
        help="simulate drift of offsets, temperature and supply voltage also in an ideal world",
    )
    parser.add_argument(
        "--seed",
        type=_seed,
        default=1,
        metavar="N",
        help="random seed of the world and of the noise, below 2000000 (default: 1)",
    )


def _seed(text: str) -> int:
    if not text.isdecimal() or int(text) >= 2_000_000:
        raise argparse.ArgumentTypeError(f"{text}: must be an integer from 0 to 1999999")
    return int(text)


def run_command(
    config_path: Path,
    *,
    world: str,
    seed: int,
    sheet: str | None,
    drift: bool,
    gripper: str | None = None,
    **options: Any,
) -> int:
    """Run the command with the world of its options; the others are those of `run`."""
    if gripper and sheet:
        raise CommandError("--gripper excludes --sheet, which needs the contacts in advance", 2)
    hidden = world_with(WORLDS[world], sheet=sheet, drift=drift)
    if gripper:
        hidden = hidden.with_sheets()
    return run(config_path, world=hidden.draw(seed), gripper=gripper, **options)


def run(
    config_path: Path,
    *,
    buses: Sequence[str] = (),
    scenario: Path | None = None,
    gripper: str | None = None,
    grasp: str | None = None,
    truth: Path | None = None,
    world: DrawnWorld | None = None,
    seconds: float | None = None,
    stop: threading.Event | None = None,
    status_period_s: float = _STATUS_PERIOD_S,
) -> int:
    """Simulate the nodes of a deployment until `seconds` have passed, `stop` is set, or a signal arrives.

    Without `stop`, SIGINT and SIGTERM end it. The hand plays `scenario`; or executes commands received at
    the endpoint `gripper`; or grasps the object named `grasp`, repeatedly; else the shipped session if the
    deployment has its links, else a tour of all pads. `buses` replace those of the deployment, as
    `config.with_bus` does. Exit status 0; 1 for a bus, endpoint or file that can't be opened; 2 for a mistake
    in the deployment or scenario.
    """
    with failing(2, ValueError):  # ConfigError, or an EDS that can't be simulated
        deployment = config.load(config_path, buses)
        check_nodes(deployment, str(config_path))
        world = world or WORLDS["ideal"].draw(1)
        if gripper and truth:
            raise ValueError("--gripper excludes --truth, which needs the contacts in advance")
        stimulus: Stimulus
        if grasp:
            stimulus = grasp_stimulus(deployment, grasp, world, repeat=True)
        elif gripper:
            stimulus = GripperStimulus.from_deployment(deployment, str(config_path))
        else:
            stimulus = Scenario.load(scenario) if scenario else _default_scenario(deployment)
        hand = SimulatedHand.open(deployment, stimulus, world, record=truth is not None)
    with hand, contextlib.ExitStack() as stack:
        with failing(1, ValueError, prefix="--gripper "):
            if isinstance(stimulus, GripperStimulus) and gripper:
                hand.serve_gripper(stimulus, gripper)
        with failing(1, OSError):
            file = stack.enter_context(truth.open("w", encoding="utf-8")) if truth else None
        hand.publish_joints(deployment, stimulus, deployment.daemon.inputs.replace("//*:", "//127.0.0.1:"))
        _serve(hand, deployment, file, seconds, stop or stop_on_signals(), status_period_s)
    return 0


def _serve(
    hand: SimulatedHand,
    deployment: config.Deployment,
    truth: TextIO | None,
    seconds: float | None,
    stop: threading.Event,
    status_period_s: float,
) -> None:
    """Run the hand until it is stopped, print its status from time to time, then write the ground truth."""
    buses = ", ".join(f"{bus.name} ({bus.interface} {bus.channel})" for bus in deployment.buses)
    print(f"{len(hand.devices)} nodes on {buses}; the scenario starts with the first SYNC", flush=True)
    if truth:
        truth_file.write_header(truth, time.time_ns() - time.monotonic_ns())
    hand.start()
    begin_s = time.monotonic()
    status_s, status_syncs = begin_s, 0
    while not stop.wait(_POLL_PERIOD_S if seconds is None else min(_POLL_PERIOD_S, seconds / 4)):
        now_s = time.monotonic()
        if seconds is not None and now_s - begin_s >= seconds:
            break
        if now_s - status_s >= status_period_s:
            rate_hz = (hand.sync_count - status_syncs) / (now_s - status_s)
            print(_status_line(hand, deployment, now_s - begin_s, rate_hz), flush=True)
            status_s, status_syncs = now_s, hand.sync_count
    hand.stop()
    if truth:  # not earlier: computing it would delay the nodes
        truth_file.write_records(truth, hand.pop_truth())
    skipped = f", {hand.skipped_syncs} skipped: the nodes were late" if hand.skipped_syncs else ""
    print(f"{hand.sync_count} SYNCs answered{skipped}", flush=True)


def _status_line(hand: SimulatedHand, deployment: config.Deployment, elapsed_s: float, rate_hz: float) -> str:
    states = [device.state for device in hand.devices.values()]
    parts = [
        f"{elapsed_s:6.0f} s",
        f"{rate_hz:5.0f} SYNC/s",
        f"{states.count('OPERATIONAL')} of {len(states)} operational",
    ]
    silent = hand.buses_without_sync
    for sync, remedy in (
        ("producer", "start the daemon with `handtouch run`"),
        ("consumer", "start the SYNC producer of the bus"),
    ):
        if names := [bus.name for bus in deployment.buses if bus.name in silent and bus.sync == sync]:
            parts.append(f'{", ".join(names)}: no SYNC received; {remedy} (sync = "{sync}")')
    return "  ".join(parts)


def _default_scenario(deployment: config.Deployment) -> Scenario:
    """Return the shipped session, repeating, if the deployment has its links; else a tour of all pads."""
    session = Scenario.load(shipped.path(DEFAULT_SCENARIO))
    with contextlib.suppress(ConfigError):
        session.check_links(entry.pad.link for entry in deployment.pads)
        return session.model_copy(update={"repeat": True})
    return Scenario.tour(deployment)
