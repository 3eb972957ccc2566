"""The command `commission`: the guided session on the terminal, and the report at its end."""

from __future__ import annotations

import argparse
import difflib
import logging
import signal
import sys
from collections.abc import Sequence
from contextlib import ExitStack, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from handtouch import config
from handtouch.canbus.nodes.spec import check_nodes
from handtouch.cli.options import add_bus, add_config, add_json, add_number
from handtouch.cli.tables import make_table, table_lines
from handtouch.host.json_output import print_json
from handtouch.procedures.commission import refuse_beside_daemon, select_rows
from handtouch.procedures.commission.outcome import PadOutcome
from handtouch.procedures.commission.procedure import CommissioningProcedure
from handtouch.procedures.commission.record import CommissioningRecord
from handtouch.procedures.commission.sample_source import open_sample_source
from handtouch.procedures.dialogue import open_dialogue

_COLUMN_TITLES = ("pad", "node", "serial", "electrodes", "noise", "least threshold", "result")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `commission`."""
    parser.set_defaults(command=run)
    add_config(parser)
    add_bus(parser)
    parser.add_argument(
        "--link",
        dest="links",
        action="append",
        default=[],
        metavar="PATTERN",
        help='pads to commission, such as "thumb_*" or "left/index_distal"; repeatable (default: all that '
        "are not done yet)",
    )
    parser.add_argument(
        "--dry-run", action="store_true", help="print the changes of the file instead of writing them"
    )
    parser.add_argument(
        "--yes",
        dest="assume_yes",
        action="store_true",
        help="accept nodes found on each other's links without confirmation",
    )
    add_number(parser, "--seconds", "S", "time limit for a press or a key", default=60.0, dest="timeout_s")
    add_json(parser)


def run(
    config_path: Path,
    buses: Sequence[str] = (),
    *,
    links: Sequence[str] = (),
    dry_run: bool = False,
    assume_yes: bool = False,
    timeout_s: float = 60.0,
    as_json: bool = False,
) -> int:
    """Commission the pads of a deployment that match `links`, all that are not done by default.

    Exit status: 0 success, 1 a problem was found, a pad was skipped or not done, 2 wrong usage.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # stop nodes, restore the terminal
    logging.getLogger("canopen").setLevel(logging.CRITICAL)  # the master reports these errors itself
    deployment = config.load(config_path, buses)
    rows = select_rows(deployment, links)
    refuse_beside_daemon(deployment.daemon.control)
    deployment = check_nodes(deployment, str(config_path))
    record = CommissioningRecord(config_path, dry_run)
    saved, interrupted = True, False
    with ExitStack() as stack:
        if as_json:  # standard output is for the result alone
            stack.enter_context(redirect_stdout(sys.stderr))
        source = stack.enter_context(open_sample_source(deployment))
        dialogue = stack.enter_context(open_dialogue())
        procedure = CommissioningProcedure(
            deployment, source, dialogue, record.save, rows, assume_yes=assume_yes, timeout_s=timeout_s
        )
        if done := record.restore_progress(procedure, rows if links else ()):
            dialogue.print_line(f"{done} pads were done before; --link NAME repeats one.")
        try:
            procedure.run()
        except KeyboardInterrupt:
            dialogue.print_line("Interrupted; results so far are kept.")
            interrupted = True
        except (OSError, ValueError, KeyError) as error:  # disk full; file edited meanwhile
            dialogue.print_line(f"{config_path} can't be written: {error}", "bad")
            saved = False
        text = "" if as_json else format_table(procedure) + _format_changes(record)
        result = _as_json(procedure, record) if as_json else None
    if as_json:
        print_json(result)
    else:
        print(text, end="")
    if interrupted:
        raise KeyboardInterrupt
    return 0 if saved and all(procedure.outcomes[row].ok for row in rows) else 1


def _as_json(procedure: CommissioningProcedure, record: CommissioningRecord) -> dict[str, Any]:
    """Return the outcome of each pad and of the file as JSON values."""
    pads = []
    for row in procedure.selected_rows:
        outcome, node, rest = procedure.outcomes[row], procedure.node_of(row), procedure.rest_of(row)
        known = outcome.slot is not None
        pads.append(
            {
                "pad": outcome.name,
                "ok": outcome.ok,
                "result": outcome.result.value,
                "bus": node.bus if known else None,
                "node_id": node.node_id if known else None,
                "serial": (node.serial or None) if known else None,
                "electrodes": outcome.electrodes,
                "noise_counts": float(np.max(rest.std)) if rest is not None and rest.samples else None,
                "least_begin_threshold_n": procedure.least_begin_threshold_n(row),
                "problems": outcome.problems,
            }
        )
    changed = record.text != record.original
    backup = record.backup if changed and not record.dry_run else None
    return {
        "file": record.path,
        "changed": changed,
        "dry_run": record.dry_run,
        "backup": backup,
        "pads": pads,
    }


def _format_changes(record: CommissioningRecord) -> str:
    difference = format_difference(record.original, record.text, str(record.path))
    if not difference:
        return f"{record.path}: no changes.\n"
    if record.dry_run:
        return f"{difference}Nothing was written (--dry-run).\n"
    return f"{difference}{record.path}: written; backup of the original: {record.backup}\n"


def format_table(procedure: CommissioningProcedure) -> str:
    """Format a line per pad with its problems below; noise in counts, measured (configured)."""
    outcomes = [procedure.outcomes[row] for row in procedure.selected_rows]
    table = make_table(*_COLUMN_TITLES)
    for row, outcome in zip(procedure.selected_rows, outcomes, strict=True):
        table.add_row(*_cells(procedure, row, outcome))
    header, *rows = table_lines(table)
    lines = [header]
    for outcome, line in zip(outcomes, rows, strict=True):
        lines += [line, *(f"    {problem}" for problem in outcome.problems)]
    ok = sum(outcome.ok for outcome in outcomes)
    lines.append(f"{ok} of {len(rows)} pads are ok.")
    return "\n".join(lines) + "\n"


def format_difference(before: str, after: str, name: str) -> str:
    """Format the changed lines of each table as a diff; empty without changes.

    Tables are compared one by one: a diff of the whole text would show swapped nodes as moved pads.
    """
    shown, line = [], 1
    for old, new in zip(_split_tables(before), _split_tables(after), strict=True):
        if old != new:
            link = next((text.partition("=")[2].strip() for text in old if text.startswith("link")), "")
            shown.append(f"@@ line {line} @@ {old[0].strip()} {link}".rstrip())
            body = list(difflib.unified_diff(old, new, n=1, lineterm=""))[2:]
            shown += [text for text in body if not text.startswith("@@")]
        line += len(old)
    return "\n".join([f"--- {name}", f"+++ {name}, as found", *shown]) + "\n" if shown else ""


def _split_tables(text: str) -> list[list[str]]:
    """Split a text into lists of lines, one for each table."""
    tables: list[list[str]] = [[]]
    for line in text.splitlines():
        if line.startswith("["):
            tables.append([])
        tables[-1].append(line)
    return tables


def _cells(procedure: CommissioningProcedure, row: int, outcome: PadOutcome) -> tuple[str, ...]:
    node, rest = procedure.node_of(row), procedure.rest_of(row)
    known = outcome.slot is not None
    configured = procedure.configured_noise_counts(row)
    noise, least = "-", procedure.least_begin_threshold_n(row)
    if rest is not None and rest.samples:
        noise = f"{float(np.max(rest.std)):.1f} ({configured:g})"
    return (
        outcome.name,
        f"{node.bus} 0x{node.node_id:02X}" if known else "-",
        str(node.serial) if known and node.serial else "-",
        " ".join(outcome.electrodes) if outcome.electrodes else "-",
        noise,
        "-" if least is None else f"{least:.2g} N",
        outcome.result.value,
    )
