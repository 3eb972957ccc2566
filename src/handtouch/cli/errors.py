"""Errors that end a command.

Any exception with an `exit_status`, as `ConfigError` and `BusError` have one, ends the command with that
status and its text on standard error; see `handtouch.cli.main`.

Public names: `CommandError`, `failing`, `needing`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from handtouch.host.installation import extra_command


class CommandError(Exception):
    """The end of a command by an error: its text and exit status."""

    def __init__(self, text: str, exit_status: int) -> None:
        super().__init__(text)
        self.exit_status = exit_status


@contextmanager
def failing(exit_status: int, *errors: type[Exception], prefix: str = "") -> Iterator[None]:
    """Context manager in which these errors end the command with a status; `prefix` comes before their text.

    An error of the operating system about a file becomes "FILE: reason".
    """
    try:
        yield
    except errors as error:
        text = str(error)
        if isinstance(error, OSError) and error.filename is not None:
            text = f"{error.filename}: {(error.strerror or text).lower()}"
        raise CommandError(prefix + text, exit_status) from error


@contextmanager
def needing(extra: str, prefix: str = "") -> Iterator[None]:
    """Context manager in which a missing package ends the command with status 2.

    The error names the command that installs the extra of that package.
    """
    try:
        yield
    except ImportError as error:
        raise CommandError(f"{prefix}{error}; {extra_command(extra)}", 2) from error
