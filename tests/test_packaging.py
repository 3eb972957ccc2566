"""Source archive and wheel are complete: the wheel is built from it, installs and finds its files."""

from __future__ import annotations

import json
import re
import subprocess
import tarfile
import tomllib
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import handtouch

from .conftest import ROOT, Installation

pytestmark = pytest.mark.timeout(900)  # the first of these tests waits for a wheel, which compiles

TABLES = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT = TABLES["project"]


LOCKS = sorted(path.stem for path in (ROOT / "locks").glob("*.lock"))


def locked(name: str) -> Iterator[tuple[Requirement, list[str]]]:
    """Yield the requirements of a lock, and the algorithms of their hashes."""
    text = (ROOT / f"locks/{name}.lock").read_text().replace("\\\n", " ")
    for line in text.splitlines():
        requirement, *hashes = line.split(" --hash=")
        yield Requirement(requirement), [item.partition(":")[0] for item in hashes]


def pins(name: str) -> dict[str, set[str]]:
    """Return the versions in a lock by package."""
    found: dict[str, set[str]] = {}
    for requirement, _ in locked(name):
        found.setdefault(canonicalize_name(requirement.name), set()).add(str(requirement.specifier))
    return found


def test_source_archive_is_complete(archives: Path) -> None:
    (archive,) = archives.glob("*.tar.gz")
    with tarfile.open(archive) as opened:
        names = {name.partition("/")[2] for name in opened.getnames()}
    assert {
        "pyproject.toml",
        "locks/run.lock",
        "Makefile",
        "README.md",
        "LICENSE",
        "CHANGELOG.md",
        "config/utah_mit.toml",
        "services/install.sh",
        "docker/Dockerfile",
        "tests/socketcan/vcan-run",
        "src/handtouch/py.typed",
    } <= names
    assert not [name for name in names if name.startswith((".venv", ".git/", "dist/"))]


def test_wheel_has_only_the_package_and_its_files(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as opened:
        names = set(opened.namelist())
    shipped = {f"handtouch/shipped_files/{path.name}" for path in (ROOT / "config").glob("*.*")}
    assert {"handtouch/cli/__init__.py", "handtouch/py.typed"} | shipped <= names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert {name.split("/")[0].split("-")[0] for name in names} == {"handtouch"}


def test_version_is_the_same_everywhere(wheel: Path) -> None:
    changes = (ROOT / "CHANGELOG.md").read_text()
    newest = re.search(r"^## (\S+)", changes, re.MULTILINE)
    assert newest is not None
    debian = re.match(r"handtouch \(([^)]+)\)", (ROOT / "debian/changelog").read_text())
    assert debian is not None
    versions = {PROJECT["version"], newest[1], wheel.name.split("-")[1], debian[1]}
    assert versions == {handtouch.__version__}


def test_clients_in_other_languages_have_the_version_of_the_package() -> None:
    package = json.loads((ROOT / "clients/js/package.json").read_text())
    project = re.search(
        r"project\(handtouch VERSION (\S+)", (ROOT / "clients/cpp/CMakeLists.txt").read_text()
    )
    assert project is not None
    assert package["version"] == project[1] == handtouch.__version__


@pytest.mark.parametrize("name", LOCKS)
def test_every_file_of_a_lock_has_a_hash_and_no_index(name: str) -> None:
    for requirement, hashes in locked(name):
        assert re.fullmatch(r"==[^,*]+", str(requirement.specifier)), requirement
        assert hashes, requirement
        assert set(hashes) == {"sha256"}, requirement
    assert "://" not in (ROOT / f"locks/{name}.lock").read_text()


def test_every_requirement_is_locked() -> None:
    extras, groups = PROJECT["optional-dependencies"], TABLES["dependency-groups"]
    for name, required in {
        "run": PROJECT["dependencies"],
        "view": [*PROJECT["dependencies"], *extras["urdf"]],
        "dev": [*PROJECT["dependencies"], *groups["build"], *(i for items in extras.values() for i in items)],
        "build": [*groups["build"], *TABLES["build-system"]["requires"]],
        "dist": [*groups["build"], *(item for item in groups["dist"] if isinstance(item, str))],
    }.items():
        versions = pins(name)
        for text in required:
            requirement = Requirement(text)
            package = canonicalize_name(requirement.name)
            if package != "handtouch":
                assert package in versions, f"{package} is not in locks/{name}.lock: run `make lock`"
                for version in versions[package]:
                    assert requirement.specifier.contains(version[2:]), f"{package} in locks/{name}.lock"


def test_locks_agree_on_versions() -> None:
    tested = pins("dev")
    for name in set(LOCKS) - {"dev"}:
        for package, versions in pins(name).items():
            assert versions <= tested.get(package, versions), f"{package} in locks/{name}.lock"


def test_installed_program_prints_help(installation: Installation) -> None:
    done = subprocess.run(
        [installation.prefix / "bin/handtouch", "--help"],
        env=installation.environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert "run" in done.stdout
    assert "doctor" in done.stdout


def test_help_imports_no_numerical_package(installation: Installation) -> None:
    code = "import sys, handtouch.cli as cli; cli.build_parser().format_help(); print(*sys.modules)"
    done = subprocess.run(
        [installation.prefix / "lib/handtouch/bin/python", "-c", code],
        env=installation.environment,
        cwd="/",
        capture_output=True,
        text=True,
        check=True,
    )
    assert not {"numpy", "scipy", "can", "zmq", "pydantic"} & set(done.stdout.split())


def test_installed_program_finds_its_files(installation: Installation) -> None:
    code = (
        "from handtouch import config\nfrom handtouch.config import shipped\n"
        "path = shipped.path('utah_mit.toml')\n"
        "print(path, len(config.load(path).hands[0].pads))"
    )
    done = subprocess.run(
        [installation.prefix / "lib/handtouch/bin/python", "-c", code],
        env=installation.environment,
        cwd="/",
        capture_output=True,
        text=True,
        check=True,
    )
    path, pads = done.stdout.split()
    assert Path(path).is_relative_to(installation.root)
    assert pads == "15"
