"""The commands that messages name work from where handtouch was installed."""

from __future__ import annotations

import importlib.metadata
import json
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from handtouch.host import installation


class _Distribution:
    def __init__(self, url: str) -> None:
        self._url = url

    def read_text(self, name: str) -> str | None:
        return json.dumps({"url": self._url}) if name == "direct_url.json" and self._url else None


@pytest.fixture
def installed_from(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    def install(url: str) -> None:
        monkeypatch.setattr(importlib.metadata, "distribution", lambda _: _Distribution(url))

    return install


def test_an_extra_of_a_clone_is_installed_from_the_clone(
    installed_from: Callable[[str], None], tmp_path: Path
) -> None:
    folder = tmp_path / "a clone"
    folder.mkdir()
    installed_from(folder.as_uri())
    assert shlex.split(installation.extra_command("ros2")) == ["pip", "install", f"{folder}[ros2]"]


@pytest.mark.parametrize(
    "url", ["", "https://example.org/handtouch-0.1.0-py3-none-any.whl", "file:///no/such"]
)
def test_an_extra_of_a_wheel_is_installed_by_its_name(
    installed_from: Callable[[str], None], url: str
) -> None:
    installed_from(url)
    assert installation.extra_command("ros2") == "pip install 'handtouch[ros2]'"


@pytest.mark.parametrize("has_compiler", [False, True])
def test_the_core_is_compiled_where_handtouch_was_installed_from(
    installed_from: Callable[[str], None], has_compiler: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: "/usr/bin/cc" if has_compiler else None)
    installed_from(tmp_path.as_uri())
    assert installation.compile_command().endswith(
        f"pip install --force-reinstall --no-deps --no-cache-dir {tmp_path}"
    )
    (tmp_path / "Makefile").touch()
    (tmp_path / ".venv").mkdir()
    assert installation.compile_command().endswith(f"make -C {tmp_path} dev")
    assert installation.compile_command().startswith("apt-get install gcc") is not has_compiler
