"""The commands `handtouch record`, `replay`, `export` and `plot`."""

from __future__ import annotations

import argparse
from pathlib import Path

from handtouch.commands.options import Commands, add_key, add_percepts, command, positive


def add(commands: Commands) -> None:
    """Add them to the command line."""
    _add_record(commands)
    _add_replay(commands)
    _add_export(commands)
    _add_plot(commands)


def _add_record(commands: Commands) -> None:
    record = command(commands, "record", _record, "keep what a running daemon publishes, as MCAP files")
    record.add_argument("config", type=Path, nargs="?", help="deployment file of the daemon; kept too")
    record.add_argument(
        "-o", "--out", type=Path, default=Path(), help="new file .mcap, or folder (default: this folder)"
    )
    record.add_argument(
        "--endpoint",
        help="complete stream of the daemon (default: the deployment's, or tcp://127.0.0.1:5582)",
    )
    add_key(record)
    record.add_argument(
        "--seconds", type=positive, default=0.0, help="end after so long (default: on Ctrl-C)"
    )
    record.add_argument(
        "--hand", action="store_true", help="frames of the whole hand too (replay can make them again)"
    )
    add_percepts(record)
    record.add_argument(
        "--rotate-mb", type=positive, default=0.0, metavar="MB", help="go on in a new file after so many MB"
    )
    record.add_argument(
        "--rotate-minutes",
        type=positive,
        default=0.0,
        metavar="MIN",
        help="go on in a new file after so long",
    )
    record.add_argument(
        "--keep-free-mb",
        type=positive,
        default=200.0,
        metavar="MB",
        help="end before less is free (default: 200)",
    )


def _add_replay(commands: Commands) -> None:
    replay = command(
        commands,
        "replay",
        _replay,
        "make the contacts of a recording or a CAN log again, by the same pipeline as live",
    )
    replay.add_argument(
        "recording", type=Path, help="MCAP recording, or log of python-can: candump .log, .asc, .blf, .gz ..."
    )
    replay.add_argument(
        "config",
        type=Path,
        nargs="?",
        help="deployment file: of a CAN log, or to compare with a recording (default: the recording's own, "
        "and every contact must be the same to the last bit)",
    )
    replay.add_argument(
        "--speed",
        type=_speed,
        help="1 as recorded, 2 twice as fast, max (default: max, with --publish 1)",
    )
    replay.add_argument(
        "--nominal",
        action="store_true",
        help="without the calibrations of the recording, as the deployment file alone has it",
    )
    replay.add_argument(
        "--locator",
        metavar="NAME",
        help="find contacts another way, to compare: log-ratio, log-ratio-adjusted, ratio-table, "
        "log-ratio-corrected, exact, likelihood-tabulated (as live, but at every sample) or likelihood",
    )
    replay.add_argument(
        "--tolerance-mm",
        type=positive,
        metavar="MM",
        help="with this error of a location allowed, as [scene] tolerance_mm does",
    )
    replay.add_argument("--json", action="store_true", help="every contact message as a JSON line")
    replay.add_argument("--report", type=Path, metavar="FILE", help="write the comparison as JSON")
    replay.add_argument("--publish", action="store_true", help="publish on the deployment's endpoints too")


def _add_export(commands: Commands) -> None:
    export = command(commands, "export", _export, "a recording as tables")
    export.add_argument("recording", type=Path, help="MCAP recording")
    export.add_argument(
        "--format",
        choices=("csv", "parquet"),
        default="csv",
        help="parquet needs handtouch[export] (default: csv)",
    )
    export.add_argument("-o", "--out", type=Path, default=Path("tables"), help="folder (default: tables)")


def _add_plot(commands: Commands) -> None:
    plot = command(commands, "plot", _plot, "draw a recording: contacts in time, on pads, forces, health")
    plot.add_argument("recording", type=Path, help="MCAP recording")
    plot.add_argument("-o", "--out", type=Path, default=Path("plots"), help="folder (default: plots)")
    plot.add_argument("--from", dest="from_s", type=float, default=0.0, metavar="S", help="begin there")
    plot.add_argument("--to", dest="to_s", type=positive, metavar="S", help="end there (default: all of it)")


def _record(asked: argparse.Namespace) -> int:
    from handtouch.record import run

    return run.run(
        run.Options(
            config=asked.config,
            out=asked.out,
            endpoint=asked.endpoint,
            key=asked.key,
            seconds=asked.seconds,
            hand=asked.hand,
            percepts=asked.percepts,
            rotate_mb=asked.rotate_mb,
            rotate_minutes=asked.rotate_minutes,
            keep_free_mb=asked.keep_free_mb,
        )
    )


def _replay(asked: argparse.Namespace) -> int:
    from handtouch.daemon import replay

    return replay.run(
        asked.recording,
        asked.config,
        speed=asked.speed,
        nominal=asked.nominal,
        as_json=asked.json,
        report=asked.report,
        publish=asked.publish,
        locator=asked.locator,
        tolerance_mm=asked.tolerance_mm,
    )


def _export(asked: argparse.Namespace) -> int:
    from handtouch.record import export

    return export.run(asked.recording, asked.out, asked.format)


def _plot(asked: argparse.Namespace) -> int:
    from handtouch.record import plot

    return plot.run(asked.recording, asked.out, asked.from_s, asked.to_s)


def _speed(text: str) -> float:
    return 0.0 if text == "max" else positive(text)
