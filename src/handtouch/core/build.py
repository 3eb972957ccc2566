"""Compile the stages of the core: `python -m handtouch.core.build`.

Public names: `build_stages`, `user_cache`, `BuildError`, `MIN_GLIBC`. Needs Cython, a C compiler and Python's
headers, and nothing else of handtouch, so that a build of the package can use it before that is installed.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType

MIN_GLIBC = (2, 17)
"""Oldest C library that files compiled for other machines run with, as manylinux2014 has it."""
MAX_CACHED_FILES = 100
"""Compiled files kept for a user: of six versions, 22 MB"""
_ELF_MACHINES = {"x86_64": 62, "aarch64": 183}


class BuildError(Exception):
    """The stages can't be compiled here; says what is missing and which package has it."""


def build_stages(
    source: Path,
    machine: str = "",
    *,
    cache: Path | None = None,
    on_progress: Callable[[str], object] = lambda _: None,
) -> list[Path]:
    """Compile the stages of a source tree's `handtouch` package whose sources changed; return all files.

    Files of other sources are removed. Equal sources and compilers give equal bytes, in any folder. With
    `machine`, x86_64 or aarch64, the files are for any Linux on it that has MIN_GLIBC, and are in the folder
    `build` beside `source`. With `cache`, files that were compiled of the same sources before are taken from
    that folder, and new ones put into it. Files of another version of Cython are compiled again. Raises
    BuildError.

    A machine's own Python.h isn't needed: within the stable ABI, it is the same on all 64-bit Linux.
    """
    compiled = _load_compiled(source)
    names = compiled.MODULES
    files = [compiled.compiled_file(name, f"linux_{machine}" if machine else "") for name in names]
    if machine:
        files = [source.parent / "build" / machine / file.name for file in files]
    for old in set(files[0].parent.glob("*.so")) - set(files):
        old.unlink()
    files[0].parent.mkdir(parents=True, exist_ok=True)
    if all(file.exists() for file in files):
        return files
    version, stamp = _cython_version(), files[0].parent / "cython.txt"
    if version and version != (stamp.read_text() if stamp.exists() else ""):
        for file in files:  # they share a module, which must be of their version
            file.unlink(missing_ok=True)
        stamp.write_text(version)
    cache = cache and cache / f"cython-{version}"
    missing = [(name, file) for name, file in zip(names, files, strict=True) if not file.exists()]
    missing = [(name, file) for name, file in missing if not _copy(cache, file)]
    if not missing:
        return files
    on_progress(f"compiling {len(missing)} modules of the core")
    compiler, include = _find_compiler(machine), sysconfig.get_path("include")
    if not version:
        raise BuildError("Cython is missing; pip install cython")
    if not (Path(include) / "Python.h").exists():
        raise BuildError(f"{include}/Python.h is missing; on Debian: apt-get install python3-dev")
    command = [*compiler, *compiled.FLAGS, *compiled.LIMITED_API, f"-I{include}"]
    processors = len(os.sched_getaffinity(0))
    with (
        tempfile.TemporaryDirectory(prefix="work-", dir=files[0].parent) as folder,
        ThreadPoolExecutor(processors) as pool,
    ):
        work = Path(folder)

        def compile_module(module: tuple[str, Path]) -> None:
            name, file = module
            _run([*command, f"{name}.c", "-o", f"{name}.so", "-lm"], work)  # its path is in no file
            built = work / f"{name}.so"
            if machine:
                _check_portable(built, machine)
            built.replace(file)  # never half written where another process loads it
            on_progress(f"compiled {name}")
            _keep(cache, file)

        parts = [missing[first::processors] for first in range(processors)]
        list(pool.map(lambda part: _translate(compiled, [name for name, _ in part], source, work), parts))
        compile_module(missing[0])  # by itself: what fails here would fail for all
        list(pool.map(compile_module, missing[1:]))
    return files


def _translate(compiled: ModuleType, names: Sequence[str], source: Path, folder: Path) -> None:
    """Translate modules to C, into a folder."""
    cython = [sys.executable, "-c", compiled.CYTHON]
    if compiled.SHARED in names:
        _run([*cython, f"--generate-shared={folder}/{compiled.SHARED}.c"], source)
    modules = [compiled.module_name(name) for name in names if name != compiled.SHARED]
    if stages := [f"{name.replace('.', '/')}.py" for name in modules]:
        options = [f"-X{key}={value}" for key, value in compiled.DIRECTIVES.items()]
        shared = f"--shared={compiled.module_name(compiled.SHARED)}"
        _run([*cython, *options, shared, "-o", str(folder), *stages], source)


def main() -> int:
    """Compile the stages of this installation; return the exit status."""
    try:
        files = build_stages(Path(__file__).parents[2], cache=user_cache(), on_progress=_ProgressLine())
    except BuildError as error:
        print(f"handtouch runs uncompiled, some fifty times slower per contact: {error}", file=sys.stderr)
        return 1
    print(f"{len(files)} compiled modules are up to date in {files[0].parent}")
    return 0


def user_cache() -> Path:
    """Return the folder of this user's compiled files, shared by all clones."""
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home) / "handtouch" / "compiled"


class _ProgressLine:
    """Shows steps on standard error: on one line of a terminal with their number, else the first only."""

    def __init__(self) -> None:
        self._steps = 0

    def __call__(self, text: str) -> None:
        if sys.stderr.isatty():
            print(
                f"\r\x1b[K  {text} ({self._steps})",
                end="" if self._steps else "\n",
                file=sys.stderr,
                flush=True,
            )
        elif not self._steps:
            print(f"{text} ...", file=sys.stderr, flush=True)
        self._steps += 1


def _copy(cache: Path | None, file: Path) -> bool:
    """Copy a file of this name from the cache; return False if there is none."""
    if cache is None or not (cache / file.name).is_file():
        return False
    with tempfile.TemporaryDirectory(prefix="copy-", dir=file.parent) as work:
        copied = shutil.copy(cache / file.name, work)
        Path(copied).replace(file)
    return True


def _keep(cache: Path | None, file: Path) -> None:
    """Put a file into the cache, and delete the oldest ones beyond MAX_CACHED_FILES; best effort."""
    if cache is None:
        return
    with contextlib.suppress(OSError):
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="keep-", dir=cache) as work:
            Path(shutil.copy(file, work)).replace(cache / file.name)
        for old in sorted(cache.glob("*.so"), key=lambda path: path.stat().st_mtime)[:-MAX_CACHED_FILES]:
            old.unlink(missing_ok=True)


def _load_compiled(source: Path) -> ModuleType:
    """Load `handtouch.core.compiled` of the source tree, without importing handtouch."""
    spec = importlib.util.spec_from_file_location("_compiled", source / "handtouch/core/compiled.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _cython_version() -> str:
    """Return Cython's version, empty where it is missing."""
    try:
        return importlib.metadata.version("cython")
    except importlib.metadata.PackageNotFoundError:
        return ""


def _find_compiler(machine: str) -> list[str]:
    """Return the command of a C compiler: CC, the system's, or that of the package ziglang.

    Of these only ziglang's is for another machine, or an older C library.
    """
    if os.environ.get("CC"):
        return os.environ["CC"].split()
    for name in ("cc", "gcc", "clang"):
        if shutil.which(name) and not machine:
            return [name]
    if importlib.util.find_spec("ziglang") is not None:
        target = ["-target", f"{machine}-linux-gnu.{MIN_GLIBC[0]}.{MIN_GLIBC[1]}"] if machine else []
        return [sys.executable, "-m", "ziglang", "cc", *target]
    if machine:
        raise BuildError(f"there is no C compiler for {machine}; pip install ziglang")
    raise BuildError("there is no C compiler; on Debian: apt-get install build-essential")


def _check_portable(file: Path, machine: str) -> None:
    """Raise BuildError unless a compiled file is for this machine and MIN_GLIBC."""
    content = file.read_bytes()
    if int.from_bytes(content[18:20], "little") != _ELF_MACHINES[machine]:
        raise BuildError(f"the C compiler compiles for another machine than {machine}")
    versions = re.findall(rb"GLIBC_(\d+)\.(\d+)", content)
    newest = max(((int(major), int(minor)) for major, minor in versions), default=MIN_GLIBC)
    if newest > MIN_GLIBC:
        raise BuildError(f"the compiled modules need glibc {newest[0]}.{newest[1]}")


def _run(command: list[str], folder: Path) -> None:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise BuildError(f"{command[0]} failed:\n{done.stderr.strip() or done.stdout.strip()}")


if __name__ == "__main__":
    sys.exit(main())
