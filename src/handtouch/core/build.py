"""Compile the stages of the core: `python -m handtouch.core.build`.

Public names: `build_stages`, `BuildError`, `MIN_GLIBC`. Needs Cython, a C compiler and Python's headers, and
nothing else of handtouch, so that a build of the package can use it before that is installed.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import ModuleType

MIN_GLIBC = (2, 17)
"""Oldest C library that files compiled for other machines run with, as manylinux2014 has it."""
_ELF_MACHINES = {"x86_64": 62, "aarch64": 183}


class BuildError(Exception):
    """The stages can't be compiled here; says what is missing and which package has it."""


def build_stages(source: Path, machine: str = "") -> list[Path]:
    """Compile the stages of a source tree's `handtouch` package whose sources changed; return all files.

    Files of other sources are removed. Equal sources and compilers give equal bytes, in any folder. With
    `machine`, x86_64 or aarch64, the files are for any Linux on it that has MIN_GLIBC, and are in the folder
    `build` beside `source`. Raises BuildError.

    A machine's own Python.h isn't needed: within the stable ABI, it is the same on all 64-bit Linux.
    """
    compiled = _load_compiled(source)
    files = [compiled.compiled_file(name, f"linux_{machine}" if machine else "") for name in compiled.STAGES]
    if machine:
        files = [source.parent / "build" / machine / file.name for file in files]
    for old in set(files[0].parent.glob("*.so")) - set(files):
        old.unlink()
    missing = [(name, file) for name, file in zip(compiled.STAGES, files, strict=True) if not file.exists()]
    if not missing:
        return files
    compiler, include = _find_compiler(machine), sysconfig.get_path("include")
    if importlib.util.find_spec("Cython") is None:
        raise BuildError("Cython is missing; pip install cython")
    if not (Path(include) / "Python.h").exists():
        raise BuildError(f"{include}/Python.h is missing; on Debian: apt-get install python3-dev")
    files[0].parent.mkdir(parents=True, exist_ok=True)
    cython = [sys.executable, "-c", compiled.CYTHON]
    command = [*compiler, *compiled.FLAGS, *compiled.LIMITED_API, f"-I{include}"]

    def compile_stage(stage: tuple[str, Path]) -> None:
        name, file = stage
        with tempfile.TemporaryDirectory(prefix=f"{name}-", dir=file.parent) as work:
            options = [f"-X{key}={value}" for key, value in compiled.DIRECTIVES.items()]
            source_file = f"handtouch/core/stages/{name}.py"
            _run([*cython, *options, "-o", f"{work}/{name}.c", source_file], source)
            _run([*command, f"{name}.c", "-o", f"{name}.so", "-lm"], Path(work))  # its path is in no file
            built = Path(work) / f"{name}.so"
            if machine:
                _check_portable(built, machine)
            built.replace(file)  # never half written where another process loads it

    compile_stage(missing[0])  # by itself: what fails here would fail for all
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        list(pool.map(compile_stage, missing[1:]))
    return files


def main() -> int:
    """Compile the stages of this installation; return the exit status."""
    try:
        files = build_stages(Path(__file__).parents[2])
    except BuildError as error:
        print(f"handtouch runs uncompiled, some fifty times slower per contact: {error}", file=sys.stderr)
        return 1
    print(f"{len(files)} compiled modules are up to date in {files[0].parent}")
    return 0


def _load_compiled(source: Path) -> ModuleType:
    """Load `handtouch.core.compiled` of the source tree, without importing handtouch."""
    spec = importlib.util.spec_from_file_location("_compiled", source / "handtouch/core/compiled.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


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
