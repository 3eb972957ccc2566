"""Compile the stages of the core: `python -m handtouch.core.build`.

Public names: `build_stages`, `BuildError`. Needs Cython, a C compiler and Python's headers, and nothing else
of handtouch, so that a build of the package can use it before that is installed.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path
from types import ModuleType

_DIRECTIVES = {
    "language_level": "3",
    "infer_types": "True",  # locals are C numbers, not objects
    "boundscheck": "False",
    "wraparound": "False",
    "initializedcheck": "False",
    "cdivision": "True",  # nothing may divide by zero
    "annotation_typing": "False",  # types are in the .pxd files
    "binding": "False",
}
_FLAGS = ("-O2", "-fPIC", "-shared", "-fno-strict-aliasing", "-ffp-contract=off", "-w")
_LIMITED_API = ("-DCYTHON_LIMITED_API=1", "-DPy_LIMITED_API=0x030B0000")
"""The stable ABI of Python 3.11: one file for this and all later versions."""


class BuildError(Exception):
    """The stages can't be compiled here; says what is missing and which package has it."""


def build_stages(source: Path) -> list[Path]:
    """Compile the stages of a source tree's `handtouch` package; return the files, new or up to date.

    Older files are removed. Raises BuildError.
    """
    compiled = _load_compiled(source)
    files = [compiled.compiled_file(name) for name in compiled.STAGES]
    if all(file.exists() for file in files):
        return files
    compiler, include = _find_compiler(), sysconfig.get_path("include")
    if importlib.util.find_spec("Cython") is None:
        raise BuildError("Cython is missing; pip install cython")
    if not (Path(include) / "Python.h").exists():
        raise BuildError(f"{include}/Python.h is missing; on Debian: apt-get install python3-dev")
    folder = files[0].parent
    folder.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as work:
        for name, file in zip(compiled.STAGES, files, strict=True):
            generated, built = Path(work) / f"{name}.c", Path(work) / f"{name}.so"
            options = [f"-X{key}={value}" for key, value in _DIRECTIVES.items()]
            source_file = f"handtouch/core/stages/{name}.py"
            _run([sys.executable, "-m", "cython", *options, "-o", str(generated), source_file], source)
            _run(
                [*compiler, *_FLAGS, *_LIMITED_API, f"-I{include}", str(generated), "-o", str(built), "-lm"],
                source,
            )
            shutil.copy(built, file.with_suffix(".new"))
            file.with_suffix(".new").replace(file)  # never half written where another process loads it
    for old in set(folder.glob("*.so")) - set(files):
        old.unlink()
    return files


def main() -> int:
    """Compile the stages of this installation; return the exit status."""
    try:
        files = build_stages(Path(__file__).parents[2])
    except BuildError as error:
        print(f"handtouch runs uncompiled, some fifty times slower per contact: {error}", file=sys.stderr)
        return 1
    print(f"compiled {len(files)} modules into {files[0].parent}")
    return 0


def _load_compiled(source: Path) -> ModuleType:
    """Load `handtouch.core.compiled` of the source tree, without importing handtouch."""
    spec = importlib.util.spec_from_file_location("_compiled", source / "handtouch/core/compiled.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _find_compiler() -> list[str]:
    """Return the command of a C compiler: CC, the system's, or that of the package ziglang."""
    if os.environ.get("CC"):
        return os.environ["CC"].split()
    for name in ("cc", "gcc", "clang"):
        if shutil.which(name):
            return [name]
    if importlib.util.find_spec("ziglang") is not None:
        return [sys.executable, "-m", "ziglang", "cc"]
    raise BuildError("there is no C compiler; on Debian: apt-get install build-essential")


def _run(command: list[str], folder: Path) -> None:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise BuildError(f"{command[0]} failed:\n{done.stderr.strip() or done.stdout.strip()}")


if __name__ == "__main__":
    sys.exit(main())
