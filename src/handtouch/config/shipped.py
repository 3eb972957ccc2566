"""Paths of the files shipped with this installation: deployments, scenarios, the node's EDS."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).parents[1]
_FOLDERS = (_PACKAGE / "shipped_files", _PACKAGE.parents[1] / "config")  # a wheel's; a checkout's


SCENARIO_NAMES = ("session", "gum", "swap", "faults")
"""Names of the scenarios of the shipped hand."""


def scenario_path(name: str) -> Path:
    """Return the path of a shipped scenario by its name, such as "gum"; other names are paths themselves."""
    return path(f"utah_mit_{name}.toml") if name in SCENARIO_NAMES else Path(name)


def path(name: str) -> Path:
    """Return the path of a shipped file by its name in `config/`, e.g. "handtouch-node.eds".

    Raises FileNotFoundError naming the folders searched.
    """
    for folder in _FOLDERS:
        if (folder / name).is_file():
            return folder / name
    raise FileNotFoundError(f"{name} is not among the shipped files in {' or '.join(map(str, _FOLDERS))}")
