"""The command `keys`: a daemon's keys and its clients' authorisations."""

from __future__ import annotations

import argparse
import platform
import sys
from pathlib import Path

from handtouch.cli.errors import CommandError
from handtouch.cli.options import add_command, add_json, add_output
from handtouch.client import key_maker, keys
from handtouch.host.json_output import print_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the subcommands of `keys`."""
    actions = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    make = add_command(actions, "make", run_make, "create a daemon's keys in a new folder")
    make.add_argument(
        "folder",
        metavar="FOLDER",
        type=Path,
        help="folder to create; name it as [daemon] keys in the deployment file",
    )
    make.add_argument("--name", help="name of the daemon in its clients' key files (default: the host name)")
    add_json(make)

    client = add_command(actions, "client", run_client, "create a client's key and authorise it")
    client.add_argument("folder", metavar="FOLDER", type=Path, help="folder of the daemon's keys")
    client.add_argument("name", metavar="NAME", help="name of the client")
    client.add_argument(
        "--rights",
        choices=("read", "control"),
        default="read",
        help="read: subscribe; control: also send control requests and inputs (default: read)",
    )
    add_output(
        client,
        "file",
        "key file to write, to be copied to the client's machine (default: NAME.key)",
        metavar="FILE",
    )
    add_json(client)

    listed = add_command(actions, "list", run_list, "list the authorised clients")
    listed.add_argument("folder", metavar="FOLDER", type=Path, help="folder of the daemon's keys")
    add_json(listed)

    revoke = add_command(actions, "revoke", run_revoke, "remove a client's authorisation")
    revoke.add_argument("folder", metavar="FOLDER", type=Path, help="folder of the daemon's keys")
    revoke.add_argument("name", metavar="NAME", help="name of the client")


def run_make(folder: Path, name: str | None, as_json: bool = False) -> int:
    """Create a daemon's keys, named after the host by default; exit status 0, or 2 (failed)."""
    made = key_maker.make_server_keys(folder, name or platform.node())
    if as_json:
        print_json({"folder": folder, "name": made.name, "public_key": made.public_key})
        return 0
    print(
        f"created {folder}: keys of daemon {made.name}; public key {made.public_key}\n"
        f'name the folder in the deployment file: [daemon] keys = "{folder.name}"\n'
        f"then authorise a client: handtouch keys client {folder} NAME --rights read"
    )
    return 0


def run_client(folder: Path, name: str, rights: str, file: Path | None, as_json: bool = False) -> int:
    """Create a client's keys; exit status 0, or 2 (failed)."""
    file = file or Path(f"{name}.key")
    key_maker.add_client(folder, name, rights, file)
    if as_json:
        print_json({"file": file, "name": name, "rights": rights})
        return 0
    print(
        f"created {file}: authorises {name} to {'read' if rights == 'read' else 'read and control'}\n"
        "move it to the client's machine, readable by its user only, and name it there: "
        f"export HANDTOUCH_KEY=$PWD/{file.name}"
    )
    return 0


def run_list(folder: Path, as_json: bool) -> int:
    """List the authorised clients; exit status 0, 1 (unusable entries), 2 (no such folder)."""
    if not (folder / keys.CLIENTS_FOLDER).is_dir():
        raise CommandError(
            f"{folder}: not a folder of keys; create one with `handtouch keys make {folder}`", 2
        )
    clients, problems = keys.load_clients(folder)
    if as_json:
        print_json({"clients": list(clients.values()), "problems": problems})
    else:
        for client in clients.values():
            print(f"{client.rights:<8} {client.public_key}  {client.name}")
        for problem in problems:
            print(problem, file=sys.stderr)
    return 1 if problems else 0


def run_revoke(folder: Path, name: str) -> int:
    """Revoke a client's authorisation; exit status 0, or 2 (failed)."""
    key_maker.revoke(folder, name)
    print(f"revoked {name}; a running daemon closes its connections within a second")
    return 0
