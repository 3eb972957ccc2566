"""The command `handtouch support`: one archive with what a bug report needs, without secrets.

Public name: `run`.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import io
import json
import os
import platform
import re
import subprocess
import sys
import tarfile
import tempfile
import threading
import time
import tomllib
from collections.abc import Callable, Iterable
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

from mcap.reader import make_reader

from handtouch import __version__, config
from handtouch.cli.errors import CommandError
from handtouch.cli.options import add_config, add_key, add_number, add_output
from handtouch.client import CONTROL_ENDPOINT, request
from handtouch.core.compiled import Compilation
from handtouch.host.endpoints import COMPLETE_ENDPOINT, to_connect
from handtouch.procedures.doctor import check_host
from handtouch.record.capture import Capture, RecordOptions

_UNITS = ("handtouch@*", "handtouch-can@*", "handtouch-node@*")
_MAX_LOG_LINES = 5000
_COMMAND_TIMEOUT_S = 20.0


class _MissingError(Exception):
    """A part that can't be collected; the text has the reason."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `support`."""
    parser.set_defaults(command=run)
    add_config(parser, "deployment file of the daemon, also for its endpoints", nargs="?")
    add_output(
        parser,
        "out",
        "new archive (default: handtouch-support-HOST-TIME.tar.gz in the current folder)",
        metavar="FILE",
    )
    add_number(parser, "--seconds", "S", "duration of the recording", default=5.0)
    parser.add_argument(
        "--log",
        dest="logs",
        action="append",
        type=Path,
        default=[],
        metavar="FILE",
        help="log file to add, where the journal doesn't have the daemon's log; repeatable",
    )
    add_key(parser)


def run(config_path: Path | None, out: Path | None, seconds: float, logs: list[Path], key: str | None) -> int:
    """Write the archive; exit status 0, 1 (a part is missing), 2 (the archive can't be written).

    `seconds`: duration of the recording; `logs`: log files to add to the journal's lines.
    """
    name = f"handtouch-support-{platform.node()}-{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    out = out or Path(f"{name}.tar.gz")
    source = _Source(config_path, seconds, logs, key)
    try:
        with open(out, "xb", opener=lambda path, flags: os.open(path, flags, 0o600)) as file:
            try:
                with tarfile.open(fileobj=file, mode="w:gz") as archive:
                    missing = _collect(source, name, archive)
            except BaseException:
                out.unlink()
                raise
    except OSError as error:
        raise CommandError(f"{out}: {error.strerror or error}; name another file with -o", 2) from error
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB; secrets are removed, but read it before you send it")
    return 1 if missing else 0


class _Source:
    """The parts of the archive: each method returns the content of one, or raises _MissingError."""

    def __init__(self, config_path: Path | None, seconds: float, logs: list[Path], key: str | None) -> None:
        self._path, self._seconds, self._logs, self._key = config_path, seconds, logs, key
        self._deployment: config.Deployment | None = None
        self._problem = ""
        if config_path is not None:
            try:
                self._deployment = config.load(config_path)
            except config.ConfigError as error:
                self._problem = str(error)
        self.secrets = _read_secrets(config_path, self._deployment, key)

    def parts(self) -> dict[str, Callable[[], str | bytes]]:
        """Return the parts by the name of their file, in the order of the archive."""
        parts: dict[str, Callable[[], str | bytes]] = {
            "versions.json": self._versions,
            "machine.txt": self._machine,
            "doctor.json": self._doctor,
            "status.json": self._status,
        }
        if self._path is not None:
            parts["deployment.toml"] = _reader(self._path)
            if (options := self._path.with_name("environment")).exists():
                parts["environment"] = _reader(options)
        if Path("/run/systemd/system").exists():
            parts.update({"services.txt": self._services, "journal.txt": self._journal})
        for number, path in enumerate(self._logs, 1):
            parts[f"log-{number}.txt"] = _reader(path)
        parts["recording.mcap"] = self._recording
        return parts

    def _versions(self) -> str:
        packages = {found.name: found.version for found in importlib.metadata.distributions()}
        versions = {
            "handtouch": __version__,
            "core": Compilation.current()._asdict(),
            "python": sys.version,
            "packages": dict(sorted(packages.items())),
        }
        return json.dumps(versions, indent=2)

    def _machine(self) -> str:
        lines = [" ".join(platform.uname()), f"{os.cpu_count()} CPUs"]
        for path in ("/etc/os-release", "/proc/meminfo", "/proc/loadavg"):
            if Path(path).exists():
                lines += [f"== {path}", *Path(path).read_text().splitlines()[:5]]
        for command in (["ip", "-details", "-statistics", "link", "show", "type", "can"], ["df", "-h"]):
            try:
                lines += [f"== {' '.join(command)}", _output(command)]
            except _MissingError as error:
                lines.append(str(error))
        return "\n".join(lines)

    def _doctor(self) -> str:
        checks = [asdict(check) for check in check_host(self._deployment)]
        return json.dumps({"deployment": self._problem or "valid", "checks": checks}, indent=2)

    def _status(self) -> str:
        try:
            endpoint = to_connect(self._deployment.daemon.control) if self._deployment else CONTROL_ENDPOINT
            return json.dumps(request("status", endpoint=endpoint, key=self._key), indent=2)
        except (OSError, RuntimeError, ValueError) as error:
            raise _MissingError(str(error)) from error

    def _services(self) -> str:
        texts = [_output(["systemctl", command, "--no-pager", *_UNITS]) for command in ("status", "cat")]
        if not any(texts):
            raise _MissingError("no handtouch service is loaded")
        return "\n".join(texts)

    def _journal(self) -> str:
        units = [f"--unit={unit}" for unit in _UNITS]
        lines = ["--no-pager", "--quiet", f"--lines={_MAX_LOG_LINES}", "--output=short-iso-precise"]
        text = _output(["journalctl", *units, *lines])
        if not text:
            raise _MissingError(
                "the journal has no line of a handtouch service, or this user may not read it"
            )
        return text

    def _recording(self) -> bytes:
        """Record without attaching the deployment's file, whose comments the messages don't have."""
        endpoint = COMPLETE_ENDPOINT
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "recording.mcap"
            try:
                if self._deployment is not None:
                    endpoint = to_connect(self._deployment.daemon.complete)
                options = RecordOptions(out=path, endpoint=endpoint, key=self._key, seconds=self._seconds)
                with Capture.open(options) as capture:
                    capture.run(threading.Event())
            except (OSError, ValueError) as error:
                raise _MissingError(str(error)) from error
            if not path.exists():
                raise _MissingError(capture.end_reason or f"no message on {endpoint} in {self._seconds:g} s")
            with path.open("rb") as file:
                for _, _, message in make_reader(file).iter_messages():
                    if any(secret.encode() in message.data for secret in self.secrets):
                        raise _MissingError("it would contain a secret key")
            return path.read_bytes()


def _collect(source: _Source, name: str, archive: tarfile.TarFile) -> dict[str, str]:
    """Add all parts to the archive, and a list of them; return the reasons of missing ones by name."""
    now_s = time.time()

    def add(part: str, content: bytes) -> None:
        entry = tarfile.TarInfo(f"{name}/{part}")
        entry.size, entry.mtime, entry.mode = len(content), int(now_s), 0o600
        archive.addfile(entry, io.BytesIO(content))

    missing: dict[str, str] = {}
    removed: dict[str, int] = {}
    for part, produce in source.parts().items():
        try:
            content = produce()
        except _MissingError as error:
            missing[part] = redact(str(error), source.secrets)[0]
            print(f"{part}: missing: {missing[part]}")
            continue
        if isinstance(content, str):
            content, removed[part] = redact(content, source.secrets)
            content = content.encode()
        add(part, content)
        print(f"{part}: {len(content) / 1e3:.1f} kB")
    contents = {
        "missing": missing,
        "secrets_removed": {key: count for key, count in removed.items() if count},
    }
    add("contents.json", json.dumps(contents, indent=2).encode())
    return missing


def _read_secrets(
    config_path: Path | None, deployment: config.Deployment | None, key: str | None
) -> set[str]:
    """Return the secret keys that this user can read: the daemon's, its clients', and the one in use."""
    folders = [config_path.parent] if config_path else []
    if deployment is not None and deployment.daemon.keys:
        folders.append(Path(deployment.daemon.keys))
    files = [path for folder in folders for path in folder.glob("*.key")]
    named = key or os.environ.get("HANDTOUCH_KEY")
    found = set()
    for path in [*files, *([Path(named)] if named else [])]:
        try:
            values = tomllib.loads(path.read_text())
        except (OSError, ValueError):
            continue
        found.add(str(values.get("secret_key", "")))
    return found - {""}


def _reader(path: Path) -> Callable[[], str]:
    def read() -> str:
        try:
            return "\n".join(path.read_text(errors="replace").splitlines()[-_MAX_LOG_LINES:])
        except OSError as error:
            raise _MissingError(f"{path}: {error.strerror}") from error

    return read


def _output(command: list[str]) -> str:
    """Return what a command of the system prints. Raises _MissingError where there is none."""
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=_COMMAND_TIMEOUT_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise _MissingError(f"{command[0]}: {error}") from error
    return done.stdout


REPLACEMENT = "<removed>"
_NAMES = r"secret|token|passw(?:or)?d|passphrase|api[_-]?key|private[_-]?key|credentials?|authori[sz]ation"
_RULES = (
    # a block of PEM
    (r"-----BEGIN [A-Z ]*PRIVATE KEY-----.*?(?:-----END [A-Z ]*PRIVATE KEY-----|\Z)", REPLACEMENT),
    # name = value, "name": "value", --name value; without quotes, all to the end of the line
    (
        rf"""(?i)((?:[\w.-]*(?:{_NAMES})[\w.-]*["']?[ \t]*[=:]|--[\w-]*(?:{_NAMES})[\w-]*)[ \t]*)"""
        r"""(?:\"{3}.*?\"{3}|'{3}.*?'{3}|"(?:\\.|[^"\\\n])+"|'[^'\n]+'|[^\n]+)""",
        rf'\1"{REPLACEMENT}"',
    ),
    (r"(?i)\b(bearer|basic)[ \t]+[A-Za-z0-9+/=._~-]{8,}", rf"\1 {REPLACEMENT}"),
    # scheme://user:password@host
    (r"(\w+://)[^\s/@:]*:[^\s/@]+@", rf"\1{REPLACEMENT}@"),
    # a quoted CURVE key, public or secret (32 bytes as Z85)
    (r"""(["'])[0-9A-Za-z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}\1""", f'"{REPLACEMENT}"'),
)
_PATTERNS = tuple((re.compile(pattern, re.DOTALL), by) for pattern, by in _RULES)


def redact(text: str, secrets: Iterable[str] = ()) -> tuple[str, int]:
    """Return the text without `secrets` and all that looks like one, and the number of replacements.

    Looks like one: a value named secret, token, password or similar; credentials in a URL or an HTTP header;
    a private key in PEM; a quoted CURVE key. Rather too much is removed than too little.
    """
    total = 0
    for secret in filter(None, secrets):
        total += text.count(secret)
        text = text.replace(secret, REPLACEMENT)
    for pattern, by in _PATTERNS:
        text, count = pattern.subn(by, text)
        total += count
    return text, total
