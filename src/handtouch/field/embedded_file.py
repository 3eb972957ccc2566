"""Files named in a deployment, embedded in it so that what is recorded and sent is complete.

Public names: `embed_file`, `read_embedded`.
"""

from __future__ import annotations

import base64
import binascii
import zlib
from pathlib import Path

_PREFIX = "data:application/zlib;base64,"


def embed_file(name: str, folder: Path) -> str:
    """Return the data: URL of the compressed content of a file, its path relative to `folder`.

    What is embedded stays as it is; a file that can't be read gives its path in the folder.
    """
    if name.startswith(_PREFIX):
        return name
    path = folder / name
    try:
        return _PREFIX + base64.b64encode(zlib.compress(path.read_bytes(), 9)).decode()
    except OSError:
        return str(path)


def read_embedded(name: str) -> bytes:
    """Return the content of a path or a data: URL of `embed_file`. Raises ValueError."""
    if not name.startswith(_PREFIX):
        try:
            return Path(name).read_bytes()
        except OSError as error:
            raise ValueError(
                f"{error.strerror or error}: {name}; give its path relative to the folder of the deployment "
                "file"
            ) from error
    try:
        return zlib.decompress(base64.b64decode(name.removeprefix(_PREFIX), validate=True))
    except (binascii.Error, zlib.error) as error:
        raise ValueError("the embedded file is damaged") from error
