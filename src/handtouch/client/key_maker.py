"""Making and revoking the CURVE keys that `keys` describes.

Public names: `make_server_keys`, `add_client`, `revoke`.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import zmq

from handtouch.client.keys import (
    CLIENTS_FOLDER,
    RIGHTS,
    SERVER_FILE,
    ClientKey,
    KeyFileError,
    ServerKey,
    check_name,
    load_server,
)


def make_server_keys(folder: Path, name: str) -> ServerKey:
    """Make a daemon's keys in a new folder. Raises KeyFileError; never overwrites a key."""
    check_name(name)
    public, secret = _new_key_pair()
    made = ServerKey(name, public, secret)
    if (folder / SERVER_FILE).exists():
        raise KeyFileError(
            f"{folder / SERVER_FILE} exists already, and clients identify the daemon by it; "
            "to replace it, make keys in a new folder"
        )
    try:
        for path in (folder, folder / CLIENTS_FOLDER):
            if not path.exists():
                path.mkdir(parents=True)
                path.chmod(0o755)  # regardless of the umask: the daemon may run as another user
        _write_new_file(
            folder / SERVER_FILE,
            asdict(made),
            "Secret keys of a daemon: readable by its user only.",
            0o600,
        )
    except OSError as error:
        raise KeyFileError(
            f"{error.filename}: {error.strerror}; make the keys as a user with write permission there"
        ) from error
    return made


def add_client(folder: Path, name: str, rights: str, file: Path) -> ClientKey:
    """Make keys for a client: its own key file `file`, and its entry in the daemon's folder.

    Raises KeyFileError; never overwrites a key.
    """
    check_name(name)
    if rights not in RIGHTS:
        raise KeyFileError(f"rights {rights!r}: must be {' or '.join(RIGHTS)}")
    server = load_server(folder)
    entry = folder / CLIENTS_FOLDER / f"{name}.pub"
    for path in (entry, file):
        if path.exists():
            raise KeyFileError(f"{path} exists already; revoke that client first, or choose another name")
    public, secret = _new_key_pair()
    made = ClientKey(
        name=name, public_key=public, secret_key=secret, server=server.name, server_key=server.public_key
    )
    try:
        _write_new_file(
            file,
            asdict(made),
            f"Secret keys of client {name} of {server.name}.",
            0o600,
        )
        try:
            _write_new_file(
                entry,
                {"rights": rights, "public_key": public},
                f"Authorises {name}; revoke it by deleting this file (`handtouch keys revoke`).",
                0o644,
            )
        except OSError:
            file.unlink()
            raise
    except OSError as error:
        raise KeyFileError(
            f"{error.filename}: {error.strerror}; choose a folder with write permission"
        ) from error
    return made


def revoke(folder: Path, name: str) -> None:
    """Remove a client's authorisation. Raises KeyFileError for an unknown client or a failed removal."""
    path = folder / CLIENTS_FOLDER / f"{name}.pub"
    known = sorted(entry.stem for entry in (folder / CLIENTS_FOLDER).glob("*.pub"))
    if name not in known:
        raise KeyFileError(f"{folder} has no client {name}; its clients: {', '.join(known) or 'none'}")
    try:
        path.unlink()
    except OSError as error:
        raise KeyFileError(f"{path}: {error.strerror}; retry with write permission") from error


def _new_key_pair() -> tuple[str, str]:
    if not zmq.has("curve"):
        raise KeyFileError("this pyzmq was built without CURVE; pip install --force-reinstall pyzmq")
    public, secret = zmq.curve_keypair()
    return public.decode(), secret.decode()


def _write_new_file(path: Path, values: Mapping[str, str], comment: str, mode: int) -> None:
    """Create a file atomically with its final mode. Raises FileExistsError if it exists."""
    text = f"# {comment}\n" + "".join(f'{key} = "{value}"\n' for key, value in values.items())
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w") as file:
        file.write(text)
        file.flush()
        os.fchmod(file.fileno(), mode)
