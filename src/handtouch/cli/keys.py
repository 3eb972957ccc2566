"""Arguments of the commands of `handtouch keys`."""

from __future__ import annotations

from pathlib import Path

from handtouch.cli.options import Subparsers, add_command, add_command_group, add_json, add_output


def add(commands: Subparsers) -> None:
    """Add `keys`."""
    actions = add_command_group(
        commands,
        "keys",
        "manage the keys (ZeroMQ CURVE) with which clients on other machines connect to a daemon",
        "Manage the keys (ZeroMQ CURVE) with which clients on other machines connect to a daemon.",
    )

    make = add_command(
        actions, "make", "handtouch.cli.keys_text:run_make", "create a daemon's keys in a new folder"
    )
    make.add_argument(
        "folder",
        metavar="FOLDER",
        type=Path,
        help="folder to create; name it as [daemon] keys in the deployment file",
    )
    make.add_argument("--name", help="name of the daemon in its clients' key files (default: the host name)")
    add_json(make)

    client = add_command(
        actions, "client", "handtouch.cli.keys_text:run_client", "create a client's key and authorise it"
    )
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

    listed = add_command(actions, "list", "handtouch.cli.keys_text:run_list", "list the authorised clients")
    listed.add_argument("folder", metavar="FOLDER", type=Path, help="folder of the daemon's keys")
    add_json(listed)

    revoke = add_command(
        actions, "revoke", "handtouch.cli.keys_text:run_revoke", "remove a client's authorisation"
    )
    revoke.add_argument("folder", metavar="FOLDER", type=Path, help="folder of the daemon's keys")
    revoke.add_argument("name", metavar="NAME", help="name of the client")
