"""The command line; each command's work is done by the module that it names, loaded only when called."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from handtouch import __version__

GRIPPER = "tcp://127.0.0.1:5590"
LIVE = "tcp://127.0.0.1:5580"
CONTROL = "tcp://127.0.0.1:5581"

EXIT = (
    "Exit status: 0 all is well, 1 something failed or is not well (check: warnings), 2 wrong usage or file."
)

Command = Callable[[argparse.Namespace], int]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; exit status 0 (well), 1 (it failed) or 2 (wrong usage or configuration)."""
    # small arrays all through: threads of the linear algebra would only fight the hot thread for a core
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    asked = build_parser().parse_args(arguments)
    run: Command = asked.command
    try:
        return run(asked)
    except KeyboardInterrupt:
        return 0
    except BrokenPipeError:  # the reader of our output left, as `| head` does
        sys.stderr.close()
        return 0


def build_parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    from handtouch.control_cli import add_control
    from handtouch.record.cli import add_record
    from handtouch.supervise.calibrations_cli import add_calibrations

    parser = argparse.ArgumentParser(
        prog="handtouch",
        epilog=EXIT,
        description="Gives a robot hand a sense of touch: CANopen touch sensors in, contacts out.",
    )
    parser.add_argument("--version", action="version", version=f"handtouch {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _add_serving(commands)
    _add_looking(commands)
    add_record(commands)
    add_control(commands)
    _add_bridge(commands)
    _add_keys(commands)
    _add_checking(commands)
    add_calibrations(commands)
    return parser


def _add_serving(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
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

    run = command(commands, "run", _run, "serve the pads of a deployment until told to stop")
    _add_config(run)
    _add_bus(run)

    simulate = command(commands, "simulate", _simulate, "simulated nodes for a deployment, on its real buses")
    _add_config(simulate)
    _add_bus(simulate)
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


def _add_looking(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    watch = command(commands, "watch", _watch, "show what a running daemon publishes")
    watch.add_argument("pattern", nargs="*", help='topics such as "contact/*/thumb_*", "hand/*", "service"')
    add_endpoint(watch, LIVE, "stream to listen to")
    style = watch.add_mutually_exclusive_group()
    style.add_argument(
        "--plain", dest="style", action="store_const", const="plain", help="lines, in a terminal too"
    )
    style.add_argument("--json", dest="style", action="store_const", const="json", help="JSON lines")
    watch.add_argument("--seconds", type=positive, default=0.0, help="end after so long")

    view = command(commands, "view", _view, "show the hand of a running daemon in the browser, live")
    add_endpoint(view, LIVE, "stream to listen to")
    view.add_argument("--host", default="127.0.0.1", help="address to serve the page at (default: 127.0.0.1)")
    view.add_argument("--port", type=_port, default=5588, help="its port, 0 for a free one (default: 5588)")
    view.add_argument("--open", action="store_true", help="open the page in this machine's browser")
    view.add_argument("--seconds", type=positive, default=0.0, help="end after so long")
    view.add_argument(
        "--percepts",
        action="store_true",
        help="slip, hardness, shape and texture too, which the daemon then computes",
    )

    status = command(commands, "status", _status, "how the daemon, its buses and its pads fare")
    add_endpoint(status, CONTROL, "control endpoint")
    status.add_argument("--json", action="store_true", help="as JSON")


def add_endpoint(parser: argparse.ArgumentParser, default: str, text: str) -> None:
    parser.add_argument("--endpoint", default=default, help=f"{text} (default: {default})")
    parser.add_argument(
        "--key",
        metavar="FILE",
        help="key for a daemon that asks for one (default: the file that HANDTOUCH_KEY names, if set)",
    )


def _add_bridge(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    bridge = command(commands, "bridge", _bridge, "carry the topics of daemons over a Zenoh network")
    bridge.add_argument("config", type=Path, nargs="*", help="deployment files of daemons on this machine")
    bridge.add_argument(
        "--endpoint",
        action="append",
        default=[],
        metavar="NAME=ENDPOINT",
        help="a daemon by its complete stream, and what to call it on the network",
    )
    for option, text in (("connect", "of a router or peer to connect to"), ("listen", "to be reached at")):
        bridge.add_argument(
            f"--{option}", action="append", default=[], metavar="tcp/HOST:PORT", help=f"Zenoh endpoint {text}"
        )
    bridge.add_argument("--prefix", default="handtouch", help="before NAME/TOPIC (default: handtouch)")
    bridge.add_argument(
        "--topic",
        action="append",
        default=[],
        metavar="PATTERN",
        help="topics to carry (default: all but raw)",
    )
    bridge.add_argument(
        "--control",
        action="store_true",
        help="pass on commands too, whoever on the network gives them",
    )
    bridge.add_argument("--key", metavar="FILE", help="key for daemons that ask for one")
    bridge.add_argument("--zenoh", type=Path, metavar="FILE", help="Zenoh configuration: TLS, access control")


def _add_keys(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    keys = commands.add_parser(
        "keys",
        help="keys for a daemon that other machines reach",
        description="Keys for a daemon that other machines reach, and for its clients.",
        epilog=EXIT,
    )
    actions = keys.add_subparsers(title="commands", metavar="COMMAND", required=True)

    make = command(actions, "make", _keys_make, "make a daemon's keys, in a new folder")
    make.add_argument("folder", type=Path, help="to make; [daemon] keys in the deployment names it")
    make.add_argument("--name", help="what clients call this daemon (default: the name of this machine)")

    client = command(actions, "client", _keys_client, "make a client's key, and let it in")
    client.add_argument("folder", type=Path, help="the daemon's keys")
    client.add_argument("name", help="what the daemon calls the client")
    client.add_argument(
        "--rights", choices=("read", "control"), default="read", help="control includes read (default: read)"
    )
    client.add_argument("--out", type=Path, help="file for the client to take along (default: NAME.key)")

    listed = command(actions, "list", _keys_list, "who is let in")
    listed.add_argument("folder", type=Path, help="the daemon's keys")
    listed.add_argument("--json", action="store_true", help="as JSON")

    revoke = command(actions, "revoke", _keys_revoke, "let a client in no more")
    revoke.add_argument("folder", type=Path, help="the daemon's keys")
    revoke.add_argument("name", help="of the client")


def _add_checking(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    check = command(commands, "check", _check, "check a deployment, compute its bus load, warn")
    check.add_argument("config", type=Path, nargs="?", help="deployment file")
    check.add_argument("--json", action="store_true", help="as JSON")
    check.add_argument(
        "--schema", action="store_true", help="print the JSON schema of deployment files instead"
    )

    doctor = command(commands, "doctor", _doctor, "what this machine lacks to serve a deployment")
    doctor.add_argument("config", type=Path, nargs="?", help="deployment file")
    doctor.add_argument("--json", action="store_true", help="as JSON")

    _add_scan(commands)
    _add_commission(commands)

    figures = command(commands, "figures", _figures, "redraw the paper's theoretical figures")
    figures.add_argument("--out", type=Path, default=Path("figures"), help="folder (default: figures)")

    design = command(commands, "design", _design, "expected location error of a pad as configured")
    _add_config(design)
    design.add_argument("--link", help="pad to draw (default: the first)")
    design.add_argument("--out", type=Path, default=Path("design"), help="folder (default: design)")


def _add_scan(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    scan = command(
        commands, "scan", _scan, "who is on the buses, with what a deployment file needs to know of them"
    )
    scan.add_argument("config", type=Path, nargs="?", help="deployment file to compare with")
    _add_bus(scan, "a bus to look at, or another python-can interface for one of the deployment")
    scan.add_argument(
        "--seconds", type=positive, help="listen for so long first (default: 1, with --listen 5)"
    )
    scan.add_argument("--json", action="store_true", help="as JSON")
    asking = scan.add_mutually_exclusive_group()
    asking.add_argument("--listen", action="store_true", help="send nothing at all")
    asking.add_argument("--lss", action="store_true", help="find nodes without an id too; changes none")
    asking.add_argument(
        "--assign",
        type=_node_id,
        metavar="FIRST_ID",
        help="find nodes without an id and give them one, which they store: that of the deployment for their "
        "serial number, else the first free one from FIRST_ID upwards, in the order of their serial numbers",
    )
    scan.add_argument(
        "--lss-wait-ms",
        type=positive,
        default=5.0,
        help="wait at least so long for LSS answers (default: 5)",
    )


def _add_commission(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    commission = command(
        commands,
        "commission",
        _commission,
        "press one pad after another: finds swapped nodes, the order of electrodes and dead channels, and "
        "writes them to the deployment file",
    )
    _add_config(commission)
    _add_bus(commission)
    commission.add_argument(
        "--link",
        action="append",
        default=[],
        metavar="PATTERN",
        help='pads to do, such as "thumb_*" or "left/index_distal" (default: all that are not done yet)',
    )
    commission.add_argument("--dry-run", action="store_true", help="show what would change, write nothing")
    commission.add_argument("--yes", action="store_true", help="take swapped nodes over without asking")
    commission.add_argument(
        "--seconds", type=positive, default=60.0, help="wait so long for a press or a key (default: 60)"
    )


def command(
    commands: argparse._SubParsersAction[argparse.ArgumentParser], name: str, function: Command, text: str
) -> argparse.ArgumentParser:
    description = text[0].upper() + text[1:] + "."
    parser = commands.add_parser(name, help=text, description=description, epilog=EXIT)
    parser.set_defaults(command=function)
    return parser


def _add_config(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("config", type=Path, help="deployment file (TOML)")


def _add_bus(
    parser: argparse.ArgumentParser,
    text: str = "use another python-can interface for a bus of the deployment",
) -> None:
    parser.add_argument(
        "--bus",
        action="append",
        default=[],
        metavar="NAME=INTERFACE:CHANNEL[,OPTION=VALUE...]",
        help=text,
    )


def _add_scenario(parser: argparse._ActionsContainer, text: str) -> None:
    from handtouch import shipped

    names = ", ".join(shipped.SCENARIOS)

    def known(text: str) -> Path:
        if not (path := shipped.scenario(text)).is_file():
            raise argparse.ArgumentTypeError(f"{text}: is neither a file nor one of {names}")
        return path

    parser.add_argument("--scenario", type=known, metavar="NAME", help=f"play {names}, or a file: {text}")


def _add_sheets(parser: argparse._ActionsContainer) -> None:
    parser.add_argument(
        "--sheet", choices=("S1", "S2"), help="sheets that creep and fade as this one of the paper"
    )
    parser.add_argument(
        "--drift", action="store_true", help="zeros, temperature and supply that wander slowly"
    )


def _add_grasp(parser: argparse._ActionsContainer) -> None:
    parser.add_argument(
        "--grasp",
        metavar="THING",
        help="let the hand close on a ball, box, pen or cup in MuJoCo (pip install 'handtouch[mujoco]')",
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


def _watch(asked: argparse.Namespace) -> int:
    from handtouch.view import watch

    return watch.run(
        tuple(asked.pattern),
        endpoint=asked.endpoint,
        key=asked.key,
        style=asked.style or "auto",
        seconds=asked.seconds,
    )


def _view(asked: argparse.Namespace) -> int:
    from handtouch.view import page

    return page.run(
        endpoint=asked.endpoint,
        key=asked.key,
        host=asked.host,
        port=asked.port,
        show=asked.open,
        seconds=asked.seconds,
        percepts=asked.percepts,
    )


def _status(asked: argparse.Namespace) -> int:
    from handtouch.view import status

    return status.run(endpoint=asked.endpoint, key=asked.key, as_json=asked.json)


def _bridge(asked: argparse.Namespace) -> int:
    from handtouch import bridge

    return bridge.run(
        bridge.Options(
            configs=asked.config,
            endpoints=asked.endpoint,
            connect=asked.connect,
            listen=asked.listen,
            prefix=asked.prefix,
            topics=asked.topic,
            control=asked.control,
            key=asked.key,
            zenoh=asked.zenoh,
        )
    )


def _keys_make(asked: argparse.Namespace) -> int:
    import platform

    from handtouch import keys

    return keys.run_make(asked.folder, asked.name or platform.node())


def _keys_client(asked: argparse.Namespace) -> int:
    from handtouch import keys

    return keys.run_client(asked.folder, asked.name, asked.rights, asked.out)


def _keys_list(asked: argparse.Namespace) -> int:
    from handtouch import keys

    return keys.run_list(asked.folder, asked.json)


def _keys_revoke(asked: argparse.Namespace) -> int:
    from handtouch import keys

    return keys.run_revoke(asked.folder, asked.name)


def _check(asked: argparse.Namespace) -> int:
    from handtouch import check

    return check.run(asked.config, json=asked.json, schema=asked.schema)


def _doctor(asked: argparse.Namespace) -> int:
    from handtouch import doctor

    return doctor.run(asked.config, json=asked.json)


def _scan(asked: argparse.Namespace) -> int:
    from handtouch import scan

    request = scan.Request(
        listen_only=asked.listen,
        lss=asked.lss or asked.assign is not None,
        assign=asked.assign,
        seconds=asked.seconds or (5.0 if asked.listen else 1.0),
        lss_wait_s=asked.lss_wait_ms * 1e-3,
    )
    return scan.run(asked.config, asked.bus, request, as_json=asked.json)


def _commission(asked: argparse.Namespace) -> int:
    from handtouch import commission

    return commission.run(
        asked.config,
        asked.bus,
        links=asked.link,
        dry_run=asked.dry_run,
        yes=asked.yes,
        patience_s=asked.seconds,
    )


def _figures(asked: argparse.Namespace) -> int:
    from handtouch import figures

    return figures.run(asked.out)


def _design(asked: argparse.Namespace) -> int:
    from handtouch import design

    return design.run(asked.config, asked.out, link=asked.link)


def positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text}: must be a number above 0")
    return value


def _node_id(text: str) -> int:
    try:
        value = int(text, 0)
    except ValueError:
        value = 0
    if not 1 <= value <= 127:
        raise argparse.ArgumentTypeError(f"{text}: must be a node id, 1 to 127 (0x01 to 0x7F)")
    return value


def _port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"{text}: must be a port, 0 to 65535")
    return int(text)


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text}: must be a whole number, 0 or above")
    return int(text)
