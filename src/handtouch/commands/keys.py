"""The commands of `handtouch keys`."""

from __future__ import annotations

import argparse
from pathlib import Path

from handtouch.commands.options import Commands, add_json, command, family


def add(commands: Commands) -> None:
    """Add `keys`."""
    actions = family(
        commands,
        "keys",
        "keys for a daemon that other machines reach",
        "Keys for a daemon that other machines reach, and for its clients.",
    )

    make = command(actions, "make", _make, "make a daemon's keys, in a new folder")
    make.add_argument("folder", type=Path, help="to make; [daemon] keys in the deployment names it")
    make.add_argument("--name", help="what clients call this daemon (default: the name of this machine)")

    client = command(actions, "client", _client, "make a client's key, and let it in")
    client.add_argument("folder", type=Path, help="the daemon's keys")
    client.add_argument("name", help="what the daemon calls the client")
    client.add_argument(
        "--rights", choices=("read", "control"), default="read", help="control includes read (default: read)"
    )
    client.add_argument("--out", type=Path, help="file for the client to take along (default: NAME.key)")

    listed = command(actions, "list", _list, "who is let in")
    listed.add_argument("folder", type=Path, help="the daemon's keys")
    add_json(listed)

    revoke = command(actions, "revoke", _revoke, "let a client in no more")
    revoke.add_argument("folder", type=Path, help="the daemon's keys")
    revoke.add_argument("name", help="of the client")


def _make(asked: argparse.Namespace) -> int:
    import platform

    from handtouch import keys

    return keys.run_make(asked.folder, asked.name or platform.node())


def _client(asked: argparse.Namespace) -> int:
    from handtouch import keys

    return keys.run_client(asked.folder, asked.name, asked.rights, asked.out)


def _list(asked: argparse.Namespace) -> int:
    from handtouch import keys

    return keys.run_list(asked.folder, asked.json)


def _revoke(asked: argparse.Namespace) -> int:
    from handtouch import keys

    return keys.run_revoke(asked.folder, asked.name)
