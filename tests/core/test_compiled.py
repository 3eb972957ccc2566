"""The stages give the same bits compiled and interpreted, and compiled ones belong to their sources."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from handtouch.core.compiled import DISABLE_VARIABLE, MODULES, Compilation, compiled_file

ROOT = Path(__file__).parents[2]
STATE = "from handtouch.core.compiled import Compilation; from handtouch.core.stages import solve; \
print(Compilation.current().compiled, solve.__file__.endswith('.so'), Compilation.current().reason)"

needs_compiled = pytest.mark.skipif(
    not Compilation.current().compiled and os.environ.get("CI") != "true",
    reason=f"the stages are not compiled: {Compilation.current().reason}",
)


def run(*arguments: str, source: Path = ROOT / "src", **environment: str) -> subprocess.CompletedProcess[str]:
    """Run Python on a source tree."""
    variables = {key: value for key, value in os.environ.items() if key != DISABLE_VARIABLE}
    variables |= {"PYTHONPATH": f"{source}{os.pathsep}{ROOT}", **environment}
    return subprocess.run(
        [sys.executable, *arguments], env=variables, capture_output=True, text=True, check=False, timeout=200
    )


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """A copy of the sources, with the compiled stages."""
    shutil.copytree(ROOT / "src", tmp_path / "src", ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path / "src"


COUNTS = {
    "solve": 200,
    "detect": 200,
    "frames": 600,
    "shear": 400,
    "pairs": 40,
    "evidence": 450,
    "simulator": 60,
}
"""Contacts, ticks or samples by program; a pair of contacts takes two seconds of the interpreter, of
which `pairs` takes a twentieth."""


@pytest.fixture(scope="module")
def digests() -> dict[str, list[str]]:
    """What the programs beside this file print, all in one process: compiled, then interpreted."""
    code = "".join(f"from tests.core.{name}_many import main; main({COUNTS[name]})\n" for name in COUNTS)
    both = run("-c", code), run("-c", code, HANDTOUCH_UNCOMPILED="1")
    for done in both:
        assert done.returncode == 0, done.stderr
    lines = zip(*(done.stdout.splitlines() for done in both), strict=True)
    return dict(zip(COUNTS, map(list, lines), strict=True))


@needs_compiled
@pytest.mark.parametrize("name", COUNTS)
def test_compiled_and_interpreted_stages_give_the_same_bits(digests: dict[str, list[str]], name: str) -> None:
    compiled, interpreted = (line.split() for line in digests[name])
    assert (compiled[0], interpreted[0]) == ("compiled", "interpreted")
    assert compiled[1] == interpreted[1]


@needs_compiled
def test_stages_compiled_from_other_sources_are_refused(copied: Path) -> None:
    assert run("-c", STATE, source=copied).stdout.split()[:2] == ["True", "True"]
    with (copied / "handtouch/core/stages/locate.py").open("a") as file:
        file.write("# edited\n")
    compiled, used, *reason = run("-c", STATE, source=copied).stdout.split()
    assert (compiled, used) == ("False", "False")
    assert "of other sources" in " ".join(reason)


@pytest.mark.parametrize(
    ("edited", "other"),
    [
        ("solve.py", {"solve"}),
        ("locate.py", {"locate"}),
        ("tables.pxd", {"tables", "tolerances", "locate", "elongation", "pairs", "solve"}),
        ("receive.pxd", {"receive", "detect", "shear", "two_sheets", "solve"}),
        ("../build.py", set()),
    ],
)
def test_an_edit_makes_those_modules_old_that_are_compiled_from_it(
    copied: Path, edited: str, other: set[str]
) -> None:
    hashes = "from handtouch.core.compiled import STAGES, source_hash; \
print(*(f'{stage}-{source_hash(stage)}' for stage in STAGES))"
    before = set(run("-c", hashes, source=copied).stdout.split())
    with (copied / "handtouch/core/stages" / edited).open("a") as file:
        file.write("# edited\n")
    after = set(run("-c", hashes, source=copied).stdout.split())
    assert {name.split("-")[0] for name in after - before} == other


@needs_compiled
def test_files_of_other_sources_are_removed_even_if_nothing_is_to_compile(copied: Path) -> None:
    folder = copied / "handtouch/core/stages/_compiled"
    files = set(folder.iterdir())
    (folder / "solve-0123456789abcdef-linux_x86_64.abi3.so").touch()
    done = run("-m", "handtouch.core.build", source=copied)
    assert done.returncode == 0, done.stderr
    assert set(folder.iterdir()) == files


@needs_compiled
def test_only_changed_modules_are_compiled_to_equal_bytes_and_reused_by_other_clones(copied: Path) -> None:
    folder = copied / "handtouch/core/stages/_compiled"
    files = {path.name.partition("-")[0]: path for path in folder.glob("*.so")}
    tables = files["tables"].read_bytes()
    untouched = {
        path.name: path.stat().st_ino for name, path in files.items() if name not in ("tables", "groups")
    }
    files["tables"].unlink()
    with (copied / "handtouch/core/stages/groups.py").open("a") as file:
        file.write("# edited\n")
    cache = copied.parent / "cache"
    done = run("-m", "handtouch.core.build", source=copied, XDG_CACHE_HOME=str(cache))
    assert done.returncode == 0, done.stderr
    after = {path.name: path.stat().st_ino for path in folder.glob("*.so")}
    assert len(after) == len(files)
    assert untouched.items() <= after.items()
    assert files["groups"].name not in after
    assert files["tables"].read_bytes() == tables
    assert run("-c", STATE, source=copied).stdout.split()[:2] == ["True", "True"]
    (of_version,) = (cache / "handtouch/compiled").iterdir()
    reused = list(of_version.iterdir())
    assert {path.name.partition("-")[0] for path in reused} == {"tables", "groups"}
    for path in reused:
        (folder / path.name).unlink()
    done = run("-m", "handtouch.core.build", source=copied, XDG_CACHE_HOME=str(cache), CC="/bin/false")
    assert done.returncode == 0, done.stderr
    assert run("-c", STATE, source=copied).stdout.split()[:2] == ["True", "True"]


def test_modules_for_another_machine_are_never_of_this_one(copied: Path) -> None:
    other = "x86_64" if platform.machine() == "aarch64" else "aarch64"
    built = copied.parent / "build" / other
    built.mkdir(parents=True)
    (built / "cython.txt").write_text(importlib.metadata.version("cython"))
    for stage in set(MODULES) - {"tables"}:  # the smallest is enough
        (built / compiled_file(stage, f"linux_{other}").name).touch()
    build = f"from pathlib import Path; from handtouch.core.build import build_stages; \
build_stages(Path({str(copied)!r}), {other!r})"
    failed = run("-c", build, source=copied, CC="cc")  # instead of a cross compiler
    assert f"compiles for another machine than {other}" in failed.stderr
    assert not list(built.glob("tables-*"))


def test_a_build_without_a_compiler_names_the_package_to_install(copied: Path) -> None:
    shutil.rmtree(copied / "handtouch/core/stages/_compiled", ignore_errors=True)
    build, cache = ("-m", "handtouch.core.build"), str(copied.parent)
    failed = run(*build, source=copied, PATH="/nowhere", CC="", XDG_CACHE_HOME=cache)
    assert failed.returncode == 1
    assert "apt-get install build-essential" in failed.stderr
    compiled, used, *reason = run("-c", STATE, source=copied).stdout.split()
    assert (compiled, used) == ("False", "False")
    assert "never compiled" in " ".join(reason)


@needs_compiled
def test_modules_of_another_version_of_cython_are_never_mixed(copied: Path) -> None:
    """All are removed before the first is compiled, which here fails."""
    folder = copied / "handtouch/core/stages/_compiled"
    (folder / "cython.txt").write_text("3.2.0")
    next(folder.glob("tables-*")).unlink()
    assert list(folder.glob("*.so"))
    cache = str(copied.parent / "cache")
    failed = run("-m", "handtouch.core.build", source=copied, PATH="/nowhere", CC="", XDG_CACHE_HOME=cache)
    assert failed.returncode == 1
    assert "there is no C compiler" in failed.stderr
    assert not list(folder.glob("*.so"))
    assert (folder / "cython.txt").read_text() == importlib.metadata.version("cython")
