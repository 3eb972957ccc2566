"""`handtouch commission CONFIG`: press one pad after another, find how the hand is wired, and write it down.

Public name: `run`. `session` is the dialogue, `bench` the buses, `press` and `order` the judgement, `words`
what a person is told, `ledger` who has which node, `edit` the deployment file, `report` the end.
"""

from __future__ import annotations

import logging
import shutil
import signal
import sys
from collections.abc import Collection, Sequence
from fnmatch import fnmatchcase
from pathlib import Path

from handtouch import client, config
from handtouch.canbus.bus.port import BusError
from handtouch.canbus.nodes.spec import checked
from handtouch.dialogue import open_dialogue

from . import report
from .bench import Bench
from .edit import applied, edited, write
from .outcome import Result
from .session import Session

__all__ = ["run"]

_ASK_S = 0.5


def run(
    path: Path,
    buses: Sequence[str] = (),
    *,
    links: Sequence[str] = (),
    dry_run: bool = False,
    yes: bool = False,
    patience_s: float = 60.0,
) -> int:
    """Commission the pads of a deployment, or those whose names match one of `links`.

    Exit status: 0 all is well, 1 something is wrong, was skipped or left, 2 usage.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # nodes are stopped, the terminal is given back
    logging.getLogger("canopen").setLevel(logging.CRITICAL)  # the master tells it in words of its own
    try:
        wired = config.load(path)
        for text in buses:
            wired = config.with_bus(wired, text)
        chosen = _chosen(wired, links)
        if (running := _daemon(wired.daemon.control)) is not None:
            print(running, file=sys.stderr)
            return 1
        bench = Bench(checked(wired, str(path)))
    except config.ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    except BusError as error:
        print(error, file=sys.stderr)
        return 1
    record = _Record(path, dry_run)
    with bench, open_dialogue() as dialogue:
        session = Session(wired, bench, dialogue, record.save, chosen, yes=yes, patience_s=patience_s)
        if before := record.recall(session, chosen if links else ()):
            dialogue.say(f"{before} pads were done before; --link NAME does them again.")
        saved = True
        try:
            session.run()
        except KeyboardInterrupt:
            dialogue.say("Interrupted; what was found is kept.")
        except (OSError, ValueError, KeyError) as error:  # full disk; a file that was edited meanwhile
            dialogue.say(f"{path} can't be written: {error}", "bad")
            saved = False
        table = report.table(session)
    print(table, end="")
    print(record.told(), end="")
    return 0 if saved and all(session.outcomes[row].well for row in chosen) else 1


class _Record:
    """The deployment file, and beside it a list of the pads that are done: the rest may be done later."""

    def __init__(self, path: Path, dry_run: bool) -> None:
        self._path, self._dry_run = path, dry_run
        self._folder = path.parent
        self._original = _text(path)
        self._text = self._original
        self._done_file = path.with_name(f"{path.name}.commissioned")
        self._backup = path.with_name(f"{path.name}.bak")

    def recall(self, session: Session, again: Collection[int]) -> int:
        """Mark the pads that an earlier run has done, but for those to be done again; how many there are."""
        try:
            done = set(self._done_file.read_text(encoding="utf-8").split())
        except OSError:
            return 0
        for row, outcome in enumerate(session.outcomes):
            if outcome.name in done and row not in again:
                outcome.result = Result.BEFORE
        return sum(outcome.result is Result.BEFORE for outcome in session.outcomes)

    def save(self, session: Session) -> None:
        """Write what was found so far. Raises OSError; ValueError, KeyError for a file that can't say it."""
        text = _text(self._path)  # as it is now: somebody may have edited it
        edits = session.ledger.edits()
        new = edited(text, edits)
        before = config.parse(text, str(self._path), self._folder)
        if config.parse(new, str(self._path), self._folder) != applied(before, edits):
            raise ValueError(f"{self._path}: can't be edited so that it says what was found")
        self._text = new
        if self._dry_run:
            return
        if new != text:
            if text == self._original and not self._done_file.exists():
                shutil.copy2(self._path, self._backup)
            write(self._path, new)
        done = [outcome.name for outcome in session.outcomes if outcome.well]
        if len(done) == len(session.outcomes):
            self._done_file.unlink(missing_ok=True)
        elif done:
            write(self._done_file, "\n".join(done) + "\n")

    def told(self) -> str:
        """What has become of the file."""
        difference = report.difference(self._original, self._text, str(self._path))
        if not difference:
            return f"{self._path}: nothing to change.\n"
        if self._dry_run:
            return f"{difference}Nothing was written (--dry-run).\n"
        return f"{difference}{self._path}: written; as it was before: {self._backup}\n"


def _text(path: Path) -> str:
    """With its line ends as they are."""
    return path.read_bytes().decode("utf-8")


def _chosen(deployment: config.Deployment, links: Sequence[str]) -> list[int]:
    """Rows of the pads that are asked for. Raises ConfigError for a pattern that fits none."""
    names = [f"{hand.name}/{pad.link}" for hand in deployment.hands for pad in hand.pads]
    rows: set[int] = set()
    for pattern in links:
        full = pattern if "/" in pattern else f"*/{pattern}"
        hits = {row for row, name in enumerate(names) if fnmatchcase(name, full)}
        if not hits:
            remedy = f"fits no pad; pads: {', '.join(names)}"
            raise config.ConfigError(
                "handtouch commission", (config.Problem("--link", f" {pattern}", remedy),)
            )
        rows |= hits
    return sorted(rows) if links else list(range(len(names)))


def _daemon(endpoint: str) -> str | None:
    """Why not to begin: a daemon serves these buses."""
    endpoint = endpoint.replace("//*:", "//127.0.0.1:").replace("//0.0.0.0:", "//127.0.0.1:")
    try:
        client.request("status", endpoint=endpoint, timeout_s=_ASK_S)
    except TimeoutError:
        return None
    except (PermissionError, RuntimeError):
        pass  # it is there, and says no
    return (
        f"a daemon answers at {endpoint}, and uses these buses: end it first "
        "(Ctrl-C, or systemctl stop handtouch), and start it again when this is done"
    )
