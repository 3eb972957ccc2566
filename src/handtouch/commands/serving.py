"""The commands that make or serve a hand: `demo`, `run`, `simulate`."""

from __future__ import annotations

import argparse
from pathlib import Path

from handtouch.commands.options import Commands, add_bus, add_config, command, positive

GRIPPER = "tcp://127.0.0.1:5590"


def add(commands: Commands) -> None:
    """Add `demo`, `run` and `simulate`."""
    _add_demo(commands)
    run = command(commands, "run", _run, "serve the pads of a deployment until told to stop")
    add_config(run)
    add_bus(run)
    _add_simulate(commands)


def _add_demo(commands: Commands) -> None:
    demo = command(commands, "demo", _demo, "a simulated hand, the daemon and a live view, for half a minute")
    demo.add_argument("--seconds", type=positive, help="end after so long (default: when the scenario ends)")
    demo.add_argument("--plain", action="store_true", help="lines instead of the live view")
    demo.add_argument(
        "--tolerances", action="store_true", help="hide tolerances of parts from the estimator too"
    )
    demo.add_argument("--seed", type=_seed, default=1, help="seed of noise and tolerances (default: 1)")
    demo.add_argument("--config", type=Path, help="deployment to simulate (default: the shipped hand)")
    acting = demo.add_mutually_exclusive_group()
    _add_scenario(acting, "its faults and swaps are told in words")
    _add_grasp(acting)
    _add_sheets(demo)
    demo.add_argument(
        "--view", action="store_true", help="show it in the browser too, again and again until Ctrl-C"
    )


def _add_simulate(commands: Commands) -> None:
    simulate = command(commands, "simulate", _simulate, "simulated nodes for a deployment, on its real buses")
    add_config(simulate)
    add_bus(simulate)
    playing = simulate.add_mutually_exclusive_group()
    _add_scenario(playing, "touches, faults and swaps (default: the session, or a tour)")
    _add_grasp(playing)
    playing.add_argument(
        "--gripper",
        nargs="?",
        const=GRIPPER,
        metavar="ENDPOINT",
        help=f"a gripper that is commanded there, for deployments like two_finger.toml (default: {GRIPPER})",
    )
    simulate.add_argument("--truth", type=Path, help="write what really happened to this file, as JSON lines")
    simulate.add_argument("--seconds", type=positive, help="end after so long (default: on Ctrl-C)")
    simulate.add_argument("--tolerances", action="store_true", help="tolerances of parts besides the noise")
    _add_sheets(simulate)
    simulate.add_argument("--seed", type=_seed, default=1, help="seed of noise and tolerances (default: 1)")


def _add_scenario(parser: argparse._ActionsContainer, text: str) -> None:
    from handtouch import shipped

    names = ", ".join(shipped.SCENARIOS)

    def known(text: str) -> Path:
        if not (path := shipped.scenario(text)).is_file():
            raise argparse.ArgumentTypeError(f"{text}: is neither a file nor one of {names}")
        return path

    parser.add_argument("--scenario", type=known, metavar="NAME", help=f"play {names}, or a file: {text}")


def _add_grasp(parser: argparse._ActionsContainer) -> None:
    parser.add_argument(
        "--grasp",
        metavar="THING",
        help="let the hand close on a ball, box, pen or cup in MuJoCo (pip install 'handtouch[mujoco]')",
    )


def _add_sheets(parser: argparse._ActionsContainer) -> None:
    parser.add_argument(
        "--sheet", choices=("S1", "S2"), help="sheets that creep and fade as this one of the paper"
    )
    parser.add_argument(
        "--drift", action="store_true", help="zeros, temperature and supply that wander slowly"
    )


def _demo(asked: argparse.Namespace) -> int:
    from handtouch import demo

    return demo.run(
        config_path=asked.config,
        seconds=asked.seconds,
        plain=asked.plain,
        tolerances=asked.tolerances,
        seed=asked.seed,
        view=asked.view,
        grasp=asked.grasp,
        scenario_path=asked.scenario,
        sheet=asked.sheet,
        drift=asked.drift,
    )


def _run(asked: argparse.Namespace) -> int:
    from handtouch.daemon import daemon

    return daemon.run(asked.config, tuple(asked.bus))


def _simulate(asked: argparse.Namespace) -> int:
    from handtouch.simulate import run as simulate
    from handtouch.simulate.world import World

    world = World.named(asked.seed, tolerances=asked.tolerances, sheet=asked.sheet, drift=asked.drift)
    return simulate.run(
        asked.config,
        buses=tuple(asked.bus),
        scenario=asked.scenario,
        gripper=asked.gripper,
        grasp=asked.grasp,
        truth=asked.truth,
        world=world,
        seconds=asked.seconds,
    )


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text}: must be a whole number, 0 or above")
    return int(text)
