"""CURVE keys in files: the daemon's, and those of the clients that it lets in; `handtouch keys`.

    FOLDER/server.key         the daemon's own secret; only its user may read it
    FOLDER/clients/NAME.pub   a client that is let in, with its rights
    NAME.key                  what that client needs, secret: it belongs on the client's machine

All are TOML. Public names: `make`, `add_client`, `revoke`, `load_server`, `load_client`, `clients_in`.
"""

from __future__ import annotations

import json
import os
import re
import stat
import sys
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

RIGHTS = ("read", "control")
"""`read`: the live and the complete stream; `control`: everything."""
SERVER_FILE = "server.key"
CLIENTS = "clients"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.\-]{0,63}")
_KEY = re.compile(r"[0-9A-Za-z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")  # Z85 of 32 bytes


class KeysError(ValueError):
    """A key or a file of keys that can't be used, with the remedy."""


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
class Client:
    """Somebody whom a daemon lets in."""

    name: str
    rights: str
    public_key: str


def make(folder: Path, name: str) -> ServerKey:
    """Make a daemon's keys in a folder, which is created. Raises KeysError; never overwrites."""
    _check_name(name)
    public, secret = _pair()
    made = ServerKey(name, public, secret)
    if (folder / SERVER_FILE).exists():
        raise KeysError(
            f"{folder / SERVER_FILE} is there already, and clients know the daemon by it; "
            "to change it, make keys in a new folder"
        )
    try:
        for path in (folder, folder / CLIENTS):
            if not path.exists():
                path.mkdir(parents=True)
                path.chmod(0o755)  # whatever the umask: the daemon may run as another user
        _write(
            folder / SERVER_FILE, asdict(made), "The secret of a handtouch daemon: for its user only.", 0o600
        )
    except OSError as error:
        raise KeysError(
            f"{error.filename}: {error.strerror}; make keys as a user who may write there"
        ) from error
    return made


def add_client(folder: Path, name: str, rights: str, file: Path) -> ClientKey:
    """Make keys for a client: `file` for it to take along, and its entry in the daemon's folder.

    Raises KeysError; never overwrites.
    """
    _check_name(name)
    if rights not in RIGHTS:
        raise KeysError(f"rights {rights!r}: must be {' or '.join(RIGHTS)}")
    server = load_server(folder)
    entry = folder / CLIENTS / f"{name}.pub"
    for path in (entry, file):
        if path.exists():
            raise KeysError(f"{path} is there already; revoke that client first, or choose another name")
    public, secret = _pair()
    made = ClientKey(name, public, secret, server.name, server.public_key)
    try:
        _write(file, asdict(made), f"The secret of a client of {server.name}: for {name} only.", 0o600)
        try:
            _write(
                entry,
                {"rights": rights, "public_key": public},
                f"Lets {name} in; delete it (`handtouch keys revoke`) and it is let in no more.",
                0o644,
            )
        except OSError:
            file.unlink()
            raise
    except OSError as error:
        raise KeysError(
            f"{error.filename}: {error.strerror}; choose a folder that this user may write"
        ) from error
    return made


def revoke(folder: Path, name: str) -> None:
    """Let a client in no more. Raises KeysError when there is no such client or it can't be removed."""
    path = folder / CLIENTS / f"{name}.pub"
    known = sorted(entry.stem for entry in (folder / CLIENTS).glob("*.pub"))
    if name not in known:
        raise KeysError(f"{folder} has no client {name}; it has: {', '.join(known) or 'none'}")
    try:
        path.unlink()
    except OSError as error:
        raise KeysError(f"{path}: {error.strerror}; revoke as a user who may write there") from error


def load_server(folder: Path) -> ServerKey:
    """The daemon's keys. Raises KeysError, as when others could read them or add clients.

    A service manager may hand over the secret instead: $CREDENTIALS_DIRECTORY/server.key goes first.
    """
    for path in (folder, folder / CLIENTS):
        if not path.is_dir():
            raise KeysError(f"{path}: no such folder; `handtouch keys make {folder}` makes it")
        _check_only_ours_to_write(path)
    handed = os.environ.get("CREDENTIALS_DIRECTORY")
    path = folder / SERVER_FILE
    if handed and (Path(handed) / SERVER_FILE).is_file():
        path = Path(handed) / SERVER_FILE
        values = _parse(path, path.read_bytes())  # its rights are the service manager's business
    else:
        values = _parse(path, _read_secret(path))
    (name,) = _texts(path, values, "name")
    return ServerKey(name, *_checked_pair(path, values))


def load_client(path: Path) -> ClientKey:
    """A client's keys. Raises KeysError, as when others could read them."""
    values = _parse(path, _read_secret(path))
    name, server = _texts(path, values, "name", "server")
    return ClientKey(name, *_checked_pair(path, values), server, _key(path, values, "server_key"))


def clients_in(folder: Path) -> tuple[dict[str, Client], list[str]]:
    """Those who are let in, by public key; and what is wrong with entries that are not."""
    clients: dict[str, Client] = {}
    problems: list[str] = []
    try:
        _check_only_ours_to_write(folder)
        _check_only_ours_to_write(folder / CLIENTS)
        paths = sorted((folder / CLIENTS).glob("*.pub"))
    except (KeysError, OSError) as error:
        return {}, [str(error)]
    for path in paths:
        try:
            client = _client(path)
            if client.public_key in clients:
                raise KeysError(
                    f"{path} has the key of {clients[client.public_key].name}; remove one of them"
                )
            clients[client.public_key] = client
        except KeysError as error:
            problems.append(str(error))
    return clients, problems


def run_make(folder: Path, name: str) -> int:
    """`handtouch keys make`; exit status 0, or 2 (it can't be done)."""
    try:
        made = make(folder, name)
    except KeysError as error:
        return _fail(error)
    print(
        f"made {folder}, the keys of {made.name}; public key {made.public_key}\n"
        f'name the folder in the deployment: [daemon] keys = "{folder.name}"\n'
        f"then let somebody in: handtouch keys client {folder} NAME --rights read"
    )
    return 0


def run_client(folder: Path, name: str, rights: str, file: Path | None) -> int:
    """`handtouch keys client`; exit status 0, or 2 (it can't be done)."""
    file = file or Path(f"{name}.key")
    try:
        add_client(folder, name, rights, file)
    except KeysError as error:
        return _fail(error)
    print(
        f"made {file}, which lets {name} {'read' if rights == 'read' else 'read and control'}\n"
        "move it to that machine, for its user only, and name it there: "
        f"export HANDTOUCH_KEY=$PWD/{file.name}"
    )
    return 0


def run_list(folder: Path, as_json: bool) -> int:
    """`handtouch keys list`; exit status 0, 1 (some entries can't be used), 2 (no such folder)."""
    if not (folder / CLIENTS).is_dir():
        return _fail(KeysError(f"{folder}: no folder of keys; `handtouch keys make {folder}` makes one"))
    clients, problems = clients_in(folder)
    if as_json:
        print(json.dumps({"clients": [asdict(c) for c in clients.values()], "problems": problems}, indent=2))
    else:
        for client in clients.values():
            print(f"{client.rights:<8} {client.public_key}  {client.name}")
        for problem in problems:
            print(problem, file=sys.stderr)
    return 1 if problems else 0


def run_revoke(folder: Path, name: str) -> int:
    """`handtouch keys revoke`; exit status 0, or 2 (it can't be done)."""
    try:
        revoke(folder, name)
    except KeysError as error:
        return _fail(error)
    print(f"{name} is let in no more; a connection that it has now lasts until the daemon restarts")
    return 0


def _fail(error: KeysError) -> int:
    print(error, file=sys.stderr)
    return 2


def _pair() -> tuple[str, str]:
    import zmq  # costs 0.1 s, and most of this module does without

    if not zmq.has("curve"):
        raise KeysError("this pyzmq was built without CURVE; pip install --force-reinstall pyzmq")
    public, secret = zmq.curve_keypair()
    return public.decode(), secret.decode()


def _client(path: Path) -> Client:
    _check_name(path.stem)
    try:
        _check_only_ours_to_write(path)
        values = _parse(path, path.read_bytes())
    except OSError as error:
        raise KeysError(f"{path}: {error.strerror}") from error
    (rights,) = _texts(path, values, "rights")
    if rights not in RIGHTS:
        raise KeysError(f"{path}: rights = {rights!r} must be {' or '.join(map(repr, RIGHTS))}")
    return Client(path.stem, rights, _key(path, values, "public_key"))


def _write(path: Path, values: Mapping[str, str], comment: str, mode: int) -> None:
    """Create a file, whole and with its mode from the start; FileExistsError if it is there."""
    text = f"# {comment}\n" + "".join(f'{key} = "{value}"\n' for key, value in values.items())
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w") as file:
        file.write(text)
        file.flush()
        os.fchmod(file.fileno(), mode)


def _read_secret(path: Path) -> bytes:
    """The bytes of a file that nobody else can read; looks at the file that was opened, not at its name."""
    try:
        with path.open("rb") as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise KeysError(f"{path} is no file; give the path of a key file")
            _check_owner(path, status)
            if status.st_mode & 0o077:
                raise KeysError(
                    f"{path} is a secret, but others may use it (mode {stat.S_IMODE(status.st_mode):04o}): "
                    f"chmod 600 {path}"
                )
            return file.read(10_000)
    except OSError as error:
        remedy = {
            "FileNotFoundError": "`handtouch keys` makes keys",
            "PermissionError": "it must belong to the user of this program",
        }.get(type(error).__name__, "give the path of a key file")
        raise KeysError(f"{path}: {error.strerror}; {remedy}") from error


def _check_only_ours_to_write(path: Path) -> None:
    """Whoever may write here could let himself in."""
    status = path.stat()
    _check_owner(path, status)
    if status.st_mode & 0o022:
        raise KeysError(
            f"{path}: others may write there (mode {stat.S_IMODE(status.st_mode):04o}), and so let "
            f"themselves in: chmod go-w {path}"
        )


def _check_owner(path: Path, status: os.stat_result) -> None:
    if status.st_uid not in (0, os.geteuid()):
        raise KeysError(
            f"{path} belongs to user {status.st_uid}, not to root or the user of this program: "
            f"chown {os.geteuid()} {path}"
        )


def _parse(path: Path, data: bytes) -> dict[str, Any]:
    try:
        return tomllib.loads(data.decode())
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise KeysError(f"{path}: no key file ({error}); `handtouch keys` makes them") from error


def _texts(path: Path, values: Mapping[str, Any], *names: str) -> list[str]:
    for name in names:
        if not isinstance(values.get(name), str):
            raise KeysError(f"{path}: has no {name}; `handtouch keys` makes key files")
    return [values[name] for name in names]


def _key(path: Path, values: Mapping[str, Any], name: str) -> str:
    (key,) = _texts(path, values, name)
    if not _KEY.fullmatch(key):
        raise KeysError(f"{path}: {name} is no key: 40 characters of Z85 are one")
    return key


def _checked_pair(path: Path, values: Mapping[str, Any]) -> tuple[str, str]:
    """Public and secret key, which must belong together."""
    import zmq

    public, secret = _key(path, values, "public_key"), _key(path, values, "secret_key")
    try:
        right = zmq.curve_public(secret.encode()).decode() == public
    except zmq.ZMQError:
        right = False
    if not right:
        raise KeysError(
            f"{path}: public_key and secret_key are no pair; the file was changed: make a new key"
        )
    return public, secret


def _check_name(name: str) -> None:
    if not _NAME.fullmatch(name):
        raise KeysError(
            f"{name!r}: a name has letters, digits, '.', '_' and '-', begins with a letter or digit, "
            "and is 64 long at most"
        )
