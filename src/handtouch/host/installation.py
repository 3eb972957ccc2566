"""Commands that complete this installation, for error messages.

Public names: `extra_command`, `compile_command`.
"""

from __future__ import annotations

import importlib.metadata
import json
import shlex
import shutil
from pathlib import Path
from urllib.parse import unquote, urlparse


def extra_command(extra: str) -> str:
    """Return the command that installs the packages of an extra.

    It names the folder that handtouch was installed from, if that is still there, as handtouch itself may be
    in no index of packages.
    """
    return f"pip install '{_source() or 'handtouch'}[{extra}]'"


def compile_command() -> str:
    """Return the commands that compile the core, with those that install a C compiler where there is none."""
    source = _source()
    compiler = "" if shutil.which("cc") else "apt-get install gcc python3-dev, then "
    if source and (source / "Makefile").is_file() and (source / ".venv").is_dir():
        return f"{compiler}make -C {shlex.quote(str(source))} dev"
    return f"{compiler}pip install --force-reinstall --no-deps --no-cache-dir {source or 'handtouch'}"


def _source() -> Path | None:
    """Return the folder that handtouch was installed from; None for a wheel, or if it is gone."""
    try:
        text = importlib.metadata.distribution("handtouch").read_text("direct_url.json")
    except importlib.metadata.PackageNotFoundError:
        text = None
    url = urlparse(json.loads(text)["url"]) if text else None
    folder = Path(unquote(url.path)) if url is not None and url.scheme == "file" else None
    return folder if folder is not None and folder.is_dir() else None
