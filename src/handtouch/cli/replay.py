"""The command `handtouch replay`: publishing, and printing of the outcome.

Public names: `run`, `speed_limiter`.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import zmq

from handtouch import wire
from handtouch.cli.errors import CommandError, failing
from handtouch.cli.options import add_config, add_json, positive_number
from handtouch.cli.progress import ProgressLine
from handtouch.cli.tables import make_table, table_lines
from handtouch.client.keys import KeyFileError
from handtouch.config import ConfigError, Daemon, Deployment, load
from handtouch.config.checks import endpoint_problem
from handtouch.daemon.authentication import Authenticator
from handtouch.daemon.publisher import Publisher
from handtouch.host.endpoints import COMPLETE_ENDPOINT, LIVE_ENDPOINT
from handtouch.host.json_output import print_json_line, to_json
from handtouch.record.comparison import LinkComparison
from handtouch.record.exact_replay import ReplayResult, recorded_deployment
from handtouch.record.recording import Recording, is_recording
from handtouch.record.replay_log import LogReplaySummary, replay_log
from handtouch.record.replay_recording import first_config, replay_recording
from handtouch.view.message_lines import contact_line

_COMPARISON_COLUMNS = (
    "link",
    "contacts",
    "only recorded",
    "only replayed",
    "samples",
    "shift mm",
    "95 %",
    "force",
    "begin ms",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `replay`."""
    parser.set_defaults(command=run)
    parser.add_argument(
        "path",
        metavar="RECORDING",
        type=Path,
        help="MCAP recording, or CAN log readable by python-can: candump .log, .asc, .blf, .gz ...",
    )
    add_config(
        parser,
        "deployment file; required for a CAN log. Default for a recording: its own, and then every contact "
        "must be identical to the recorded one",
        nargs="?",
    )
    parser.add_argument(
        "--speed",
        type=_speed,
        metavar="FACTOR",
        help="1 as recorded, 2 twice as fast, max (default: max, with --publish 1)",
    )
    parser.add_argument(
        "--recompute",
        action="store_true",
        help="compute the contacts of a recording from an empty state and compare nothing: for one by "
        "another version",
    )
    add_json(parser, "print every contact message as a line of JSON")
    parser.add_argument("--report", type=Path, metavar="FILE", help="write the comparison as JSON")
    parser.add_argument(
        "--publish",
        action="store_true",
        help="also publish the messages, on the endpoints of DEPLOYMENT if it is given; those that a "
        "recording names are ignored",
    )
    for stream, default in (("live", LIVE_ENDPOINT), ("complete", COMPLETE_ENDPOINT)):
        text = f"with --publish: endpoint of the {stream} stream ({default})"
        parser.add_argument(f"--{stream}", metavar="ENDPOINT", help=text)


def _speed(text: str) -> float:
    return 0.0 if text == "max" else positive_number(text)


def run(
    path: Path,
    config_path: Path | None = None,
    *,
    speed: float | None = None,
    recompute: bool = False,
    as_json: bool = False,
    report: Path | None = None,
    publish: bool = False,
    live: str | None = None,
    complete: str | None = None,
) -> int:
    """Replay a recording or a log, print its contacts and the comparison with the recorded ones.

    `speed`: factor over the recorded speed, 0 without delays; None: 0, or 1 if published. `live`, `complete`:
    endpoints to publish on.

    Exit status 0; 1 for no sample of the deployment, or contacts that differ although the
    deployment is the recorded one; 2 for wrong usage, or a file that is missing or unreadable.
    """
    on_contact = print_json_line if as_json else _print_line
    if speed is None:
        speed = 1.0 if publish else 0.0
    with failing(2, OSError, ValueError):
        deployment = load(config_path) if config_path else None
        with path.open("rb"):  # a missing file is wrong usage
            pass
        recording = Recording(path) if is_recording(path) else None
        if recompute and (recording is None or deployment is not None):
            raise ValueError("--recompute is for an MCAP recording with its own deployment")
        settings = _publish_settings(deployment, live, complete) if publish else None
    with failing(1, OSError, ValueError), failing(2, ConfigError, KeyFileError), ExitStack() as stack:
        if recording is not None:
            return _replay_recording(
                recording, deployment, on_contact, settings, speed, report, stack, recompute=recompute
            )
        if deployment is None:
            raise CommandError(f"{path}: a CAN log needs a deployment file: handtouch replay LOG CONFIG", 2)
        if report:
            raise CommandError("--report is for MCAP recordings; a CAN log has no contacts to compare", 2)
        publisher, pace = _open_publisher(deployment, settings, speed, stack)
        with _progress_shown(pace) as shown, failing(2, ValueError):
            summary = replay_log(path, deployment, on_contact, pace=shown, publisher=publisher)
        return _print_log_summary(summary, path, config_path)


def _replay_recording(
    recording: Recording,
    deployment: Deployment | None,
    on_contact: Callable[[wire.Contact], None],
    settings: Daemon | None,
    speed: float,
    report: Path | None,
    stack: ExitStack,
    *,
    recompute: bool,
) -> int:
    stack.enter_context(recording.checked())
    recorded = stack.enter_context(recorded_deployment(first_config(recording)))
    publisher, pace = _open_publisher(deployment or recorded, settings, speed, stack)
    began_s = time.monotonic()
    with _progress_shown(pace) as shown:
        result, comparison = replay_recording(
            recording, on_contact, deployment, pace=shown, publisher=publisher, recompute=recompute
        )
    _print_result(recording, result, time.monotonic() - began_s)
    if recompute:
        build = result.build
        by = f"{build.get('handtouch', '?')} ({build.get('source', '?')})"
        print(f"from an empty state, nothing compared; recorded by handtouch {by}", file=sys.stderr)
        details: dict[str, Any] = {"recomputed": True}
        status = 0 if result.ticks else 1
    elif comparison is not None:
        links = comparison.links()
        if result.ticks:
            print(comparison_table(links), file=sys.stderr)
        details = {"links": {name: asdict(link) for name, link in links.items()}}
        status = 0 if result.ticks else 1
    else:
        if result.ticks:
            print(_equality_line(result), file=sys.stderr)
        first = result.first_difference
        details = {"equal": result.equal, "first_difference": None if first is None else asdict(first)}
        status = 0 if result.ticks and result.equal == result.compared else 1
    if report:
        report.write_text(to_json(_report(recording, result) | details, indent=1) + "\n")
    return status


def speed_limiter(speed: float) -> Callable[[int], None]:
    """Return a function that sleeps until a stamp is due at `speed` times the recorded speed; 0: no sleep."""
    if speed == 0:
        return lambda _: None
    start: list[int] = []

    def pace(t_ns: int) -> None:
        if not start:
            start.extend((time.monotonic_ns(), t_ns))
        ahead_s = (start[0] + (t_ns - start[1]) / speed - time.monotonic_ns()) * 1e-9
        if ahead_s > 1e-3:
            time.sleep(ahead_s)

    return pace


@contextmanager
def _progress_shown(pace: Callable[[int], None]) -> Iterator[Callable[[int], None]]:
    """Yield `pace` with a progress line, unless contacts are printed on the same terminal."""
    with ProgressLine() as progress:
        if not progress.shown or sys.stdout.isatty():
            yield pace
            return
        begin_ns: int | None = None

        def pace_and_show(t_ns: int) -> None:
            nonlocal begin_ns
            begin_ns = t_ns if begin_ns is None else begin_ns
            progress.update(f"{(t_ns - begin_ns) * 1e-9:.0f} s replayed")
            pace(t_ns)

        yield pace_and_show


def _publish_settings(deployment: Deployment | None, live: str | None, complete: str | None) -> Daemon:
    """Return endpoints and keys for publishing: of the options, the user's deployment, or the defaults.

    Never a recording's, which may come from anybody. Raises ValueError for an invalid endpoint.
    """
    settings = deployment.daemon if deployment is not None else Daemon()
    given = {name: value for name, value in (("live", live), ("complete", complete)) if value is not None}
    for name, endpoint in given.items():
        if problem := endpoint_problem(endpoint, settings.keys is not None):
            raise ValueError(f"--{name} {endpoint}: {problem}")
    return settings.model_copy(update=given)


def _open_publisher(
    deployment: Deployment, settings: Daemon | None, speed: float, stack: ExitStack
) -> tuple[Publisher | None, Callable[[int], None]]:
    """Return a publisher if requested, and the function that keeps the speed and serves subscriptions."""
    pace = speed_limiter(speed)
    if settings is None:
        return None, pace
    context = stack.enter_context(zmq.Context())
    topics = wire.topics_of(deployment.links_by_hand)
    authenticator = Authenticator.open(context, Path(settings.keys) if settings.keys else None)
    stack.callback(authenticator.close)
    publisher = Publisher.open(context, settings.live, settings.complete, topics, authenticator)
    stack.callback(publisher.close)

    def serve(t_ns: int) -> None:
        authenticator.poll(time.monotonic_ns())
        publisher.poll_subscriptions(t_ns)
        pace(t_ns)

    return publisher, serve


def _print_line(contact: wire.Contact) -> None:
    if contact.event != "update":
        print(contact_line(contact))


def _print_log_summary(summary: LogReplaySummary, path: Path, config_path: Path | None) -> int:
    counts = ", ".join(
        f"{name}: {c.frames} frames, {c.samples} samples, {c.wrong_length} of wrong length, "
        f"{c.unknown_frames} unknown"
        for name, c in summary.buses.items()
    )
    print(
        f"{summary.contacts} contacts in {summary.log_s:.1f} s of log, {summary.ticks} ticks "
        f"of {1e3 * summary.period_s:.4g} ms; {counts}",
        file=sys.stderr,
    )
    for warning in summary.warnings:
        print(f"{path}: {warning}", file=sys.stderr)
    if summary.unmatched:
        channels = ", ".join(f"{channel} ({count} frames)" for channel, count in summary.unmatched.items())
        print(f"{path}: channels of the log without a bus in {config_path}: {channels}", file=sys.stderr)
    if summary.samples:
        return 0
    print(
        f"{path}: no frame is a sample of {config_path}; check the channels of its buses and its node ids",
        file=sys.stderr,
    )
    return 1


def _print_result(recording: Recording, result: ReplayResult, seconds: float) -> None:
    speed = result.log_s / seconds if seconds else 0.0
    print(
        f"{result.ticks} ticks of {result.log_s:.1f} s replayed in {seconds:.1f} s "
        f"({speed:.1f} times as fast), {result.contacts} contacts",
        file=sys.stderr,
    )
    if result.build_differences:
        print("build or processor differ from the recorded ones; the last bits may differ:", file=sys.stderr)
        print("\n".join(f"  {line}" for line in result.build_differences), file=sys.stderr)
    if result.skipped_ticks:
        print(f"{result.skipped_ticks} ticks not replayed: no state recorded before them", file=sys.stderr)
    if not result.ticks:
        print(f"{recording.path}: holds no tick that can be replayed", file=sys.stderr)
    if recording.truncation:
        print(f"{recording.path}: {recording.truncation}; all else is used", file=sys.stderr)


def _equality_line(result: ReplayResult) -> str:
    if result.equal == result.compared:
        return f"all {result.compared} contact messages are equal, bit for bit"
    differing = result.compared - result.equal
    return f"{differing} of {result.compared} contact messages differ; first: {result.first_difference}"


def _report(recording: Recording, result: ReplayResult) -> dict[str, Any]:
    return {
        "recording": str(recording.path),
        "truncation": recording.truncation,
        "seconds": result.log_s,
        "ticks": result.ticks,
        "skipped_ticks": result.skipped_ticks,
        "contacts": result.contacts,
        "compared": result.compared,
        "build_differences": result.build_differences,
    }


def comparison_table(links: Mapping[str, LinkComparison]) -> str:
    """Format the comparison of each link as lines."""
    table = make_table(*_COMPARISON_COLUMNS)
    for name, link in links.items():
        table.add_row(
            name,
            f"{link.recorded} -> {link.replayed}",
            *map(str, (link.only_recorded, link.only_replayed, link.samples)),
            f"{link.shift_mm['median']:.3f}" if link.shift_mm else "-",
            f"{link.shift_mm['p95']:.3f}" if link.shift_mm else "-",
            f"x {link.force_ratio['median']:.3f}" if link.force_ratio else "-",
            f"{link.begin_delay_ms:+.1f}" if link.begin_delay_ms is not None else "-",
        )
    return "\n".join(table_lines(table))
