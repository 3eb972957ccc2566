"""Where this installation keeps the files that come with it: deployments, scenarios, the node's EDS."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).parent
_PLACES = (_PACKAGE / "shipped_files", _PACKAGE.parents[1] / "config")  # a wheel's; a checkout's


SCENARIOS = ("session", "gum", "swap", "faults")
"""Those of the shipped hand that have a name of their own."""


def scenario(name: str) -> Path:
    """Path of the scenario of that name, such as "gum"; else `name` is a path itself."""
    return path(f"utah_mit_{name}.toml") if name in SCENARIOS else Path(name)


def path(name: str) -> Path:
    """Path of a shipped file by its name in `config/`, e.g. "handtouch-node.eds".

    Raises FileNotFoundError naming the places looked in.
    """
    for place in _PLACES:
        if (place / name).is_file():
            return place / name
    raise FileNotFoundError(f"{name} is not among the shipped files in {' or '.join(map(str, _PLACES))}")
