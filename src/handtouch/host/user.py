"""Name of the user who runs a command, and of the program.

Public names: `user_name`, `program_name`.
"""

from __future__ import annotations

import getpass
import os

import handtouch


def user_name() -> str:
    """Return the user's name; the number of one without an entry in the user database, as in containers."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # OSError from Python 3.13 on
        return f"user {os.getuid()}"


def program_name() -> str:
    """Return the user's name and the program's version, as calibrations name their writer."""
    return f"{user_name()}, handtouch {handtouch.__version__}"
