"""CURVE keys in files: the daemon's, and those of the clients that it authorises.

    FOLDER/server.key         the daemon's own secret; only its user may read it
    FOLDER/clients/NAME.pub   an authorised client: its public key and its rights
    NAME.key                  that client's own keys; secret, to be moved to the client's machine

All are TOML. Public names: `load_server`, `load_client`, `load_clients`, `check_name`, `KeyFileError`.
Keys are made by `key_maker`.
"""

from __future__ import annotations

import os
import re
import stat
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

RIGHTS = ("read", "control")
"""`read`: the live and the complete stream; `control`: all endpoints."""
SERVER_FILE = "server.key"
CLIENTS_FOLDER = "clients"
_NAME_PATTERN = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.\-]{0,63}")
_KEY_PATTERN = re.compile(r"[0-9A-Za-z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")  # Z85 of 32 bytes


class KeyFileError(ValueError):
    """An unusable key or key file; the text includes the remedy."""

    exit_status = 2


@dataclass(frozen=True)
class ServerKey:
    """A daemon's pair of keys, as Z85 text."""

    name: str
    public_key: str
    secret_key: str = field(repr=False)


@dataclass(frozen=True)
class ClientKey:
    """A client's pair of keys and the public key of its daemon, as Z85 text."""

    name: str
    public_key: str
    secret_key: str = field(repr=False)
    server: str
    server_key: str


@dataclass(frozen=True)
class AuthorisedClient:
    """A client that a daemon authorises."""

    name: str
    rights: str
    public_key: str


def load_server(folder: Path) -> ServerKey:
    """Load the daemon's keys. Raises KeyFileError, also when other users can read them or add clients.

    Secrets passed by a service manager take precedence: $CREDENTIALS_DIRECTORY/server.key.
    """
    for path in (folder, folder / CLIENTS_FOLDER):
        if not path.is_dir():
            raise KeyFileError(f"{path}: no such folder; make it with `handtouch keys make {folder}`")
        _check_not_writable_by_others(path)
    handed = os.environ.get("CREDENTIALS_DIRECTORY")
    path = folder / SERVER_FILE
    if handed and (Path(handed) / SERVER_FILE).is_file():
        path = Path(handed) / SERVER_FILE
        values = _parse(path, path.read_bytes())  # its permissions are the service manager's responsibility
    else:
        values = _parse(path, _read_secret(path))
    (name,) = _get_texts(path, values, "name")
    return ServerKey(name, *_get_key_pair(path, values))


def load_client(path: Path) -> ClientKey:
    """Load a client's keys. Raises KeyFileError, also when other users can read them."""
    values = _parse(path, _read_secret(path))
    name, server = _get_texts(path, values, "name", "server")
    return ClientKey(name, *_get_key_pair(path, values), server, _get_key(path, values, "server_key"))


def load_clients(folder: Path) -> tuple[dict[str, AuthorisedClient], list[str]]:
    """Return the authorised clients by public key, and the problems of unusable entries."""
    clients: dict[str, AuthorisedClient] = {}
    problems: list[str] = []
    try:
        _check_not_writable_by_others(folder)
        _check_not_writable_by_others(folder / CLIENTS_FOLDER)
        paths = sorted((folder / CLIENTS_FOLDER).glob("*.pub"))
    except (KeyFileError, OSError) as error:
        return {}, [str(error)]
    for path in paths:
        try:
            client = _load_client_entry(path)
            if client.public_key in clients:
                raise KeyFileError(
                    f"{path} has the key of {clients[client.public_key].name}; remove one of them"
                )
            clients[client.public_key] = client
        except KeyFileError as error:
            problems.append(str(error))
    return clients, problems


def _load_client_entry(path: Path) -> AuthorisedClient:
    check_name(path.stem)
    try:
        _check_not_writable_by_others(path)
        values = _parse(path, path.read_bytes())
    except OSError as error:
        raise KeyFileError(f"{path}: {error.strerror}") from error
    (rights,) = _get_texts(path, values, "rights")
    if rights not in RIGHTS:
        raise KeyFileError(f"{path}: rights = {rights!r} must be {' or '.join(map(repr, RIGHTS))}")
    return AuthorisedClient(path.stem, rights, _get_key(path, values, "public_key"))


def _read_secret(path: Path) -> bytes:
    """Read a file that only its owner can read; permissions are checked on the open file, not by name."""
    try:
        with path.open("rb") as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise KeyFileError(f"{path} is not a file; give the path of a key file")
            _check_owner(path, status)
            if status.st_mode & 0o077:
                raise KeyFileError(
                    f"{path} is secret, but accessible to others (mode {stat.S_IMODE(status.st_mode):04o}): "
                    f"chmod 600 {path}"
                )
            return file.read(10_000)
    except OSError as error:
        remedy = {
            "FileNotFoundError": "make keys with `handtouch keys`",
            "PermissionError": "it must be owned by the user of this program",
        }.get(type(error).__name__, "give the path of a key file")
        raise KeyFileError(f"{path}: {error.strerror}; {remedy}") from error


def _check_not_writable_by_others(path: Path) -> None:
    """Raise KeyFileError if other users can write here, and so authorise themselves."""
    status = path.stat()
    _check_owner(path, status)
    if status.st_mode & 0o022:
        raise KeyFileError(
            f"{path}: others may write there (mode {stat.S_IMODE(status.st_mode):04o}), and so authorise "
            f"themselves: chmod go-w {path}"
        )


def _check_owner(path: Path, status: os.stat_result) -> None:
    if status.st_uid not in (0, os.geteuid()):
        raise KeyFileError(
            f"{path} is owned by user {status.st_uid}, not by root or the user of this program: "
            f"chown {os.geteuid()} {path}"
        )


def _parse(path: Path, data: bytes) -> dict[str, Any]:
    try:
        return tomllib.loads(data.decode())
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise KeyFileError(f"{path}: not a key file ({error}); make one with `handtouch keys`") from error


def _get_texts(path: Path, values: Mapping[str, Any], *names: str) -> list[str]:
    for name in names:
        if not isinstance(values.get(name), str):
            raise KeyFileError(f"{path}: key {name!r} is missing; make key files with `handtouch keys`")
    return [values[name] for name in names]


def _get_key(path: Path, values: Mapping[str, Any], name: str) -> str:
    (key,) = _get_texts(path, values, name)
    if not _KEY_PATTERN.fullmatch(key):
        raise KeyFileError(f"{path}: {name} is not a key of 40 Z85 characters")
    return key


def _get_key_pair(path: Path, values: Mapping[str, Any]) -> tuple[str, str]:
    """Return public and secret key; raise KeyFileError unless they are a pair."""
    import zmq

    public, secret = _get_key(path, values, "public_key"), _get_key(path, values, "secret_key")
    try:
        right = zmq.curve_public(secret.encode()).decode() == public
    except zmq.ZMQError:
        right = False
    if not right:
        raise KeyFileError(
            f"{path}: public_key and secret_key are not a pair: the file was modified; make a new key"
        )
    return public, secret


def check_name(name: str) -> None:
    """Raise KeyFileError for a name that no file of keys can have."""
    if not _NAME_PATTERN.fullmatch(name):
        raise KeyFileError(
            f"{name!r}: a name consists of letters, digits, '.', '_' and '-', begins with a letter or digit "
            "and has at most 64 characters"
        )
