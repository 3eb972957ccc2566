"""Compiled stages: which files hold them, and whether they are used.

Public names: `STAGES`, `SIMULATOR_STAGES`, `SHARED`, `MODULES`, `module_name`, `source_hash`,
`compiled_file`, `this_platform`, `CompiledFinder`, `Compilation`.

The modules of `handtouch.core.stages` and `handtouch.simulate.stages` are plain Python that Cython compiles
as it stands. A compiled module carries the hash of its sources in its file's name; one of other sources isn't
loaded, and Python runs all stages from their sources instead, with the same results to the last bit and some
fifty times slower.
"""

from __future__ import annotations

import hashlib
import os
import re
import sys
import sysconfig
from collections.abc import Sequence
from functools import cache
from importlib.abc import MetaPathFinder
from importlib.machinery import ExtensionFileLoader, ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

STAGES = (
    "tables",
    "tolerances",
    "locate",
    "elongation",
    "pairs",
    "receive",
    "force",
    "loads",
    "two_sheets",
    "solve",
    "slip",
    "detect",
    "sheets",
    "kinematics",
    "groups",
    "frames",
    "publish",
    "shear",
    "evidence",
)
"""Modules of `handtouch.core.stages`, lowest first."""
SIMULATOR_STAGES = ("patches", "histories")
"""Modules of `handtouch.simulate.stages`."""
SHARED = "_shared"
"""Module with what Cython needs for memoryviews, instead of in each stage: that halves the time to compile"""
MODULES = (SHARED, *STAGES, *SIMULATOR_STAGES)
DIRECTIVES = {
    "language_level": "3",
    "infer_types": "True",  # locals are C numbers, not objects
    "boundscheck": "False",
    "wraparound": "False",
    "initializedcheck": "False",
    "cdivision": "True",  # nothing may divide by zero
    "annotation_typing": "False",  # types are in the .pxd files
    "binding": "False",
}
CYTHON = (
    "from Cython.Compiler import Options; Options.buffer_max_dims = 2; "
    "from Cython.Compiler.Main import main; main(command_line=True)"
)
"""Program that translates a stage to C. Memoryviews are passed by value: with room for eight axes, which is
Cython's default, each is 208 bytes, of which one axis needs 40."""
FLAGS = ("-O3", "-fno-math-errno", "-fPIC", "-shared", "-s", "-ffp-contract=off", "-w")
LIMITED_API = ("-DCYTHON_LIMITED_API=1", "-DPy_LIMITED_API=0x030B0000")
"""The stable ABI of Python 3.11: one file for this and all later versions."""
DISABLE_VARIABLE = "HANDTOUCH_UNCOMPILED"
"""Environment variable that makes Python run the sources, for debugging."""
_ROOT = Path(__file__).parents[2]
_FOLDER = Path(__file__).parent / "stages" / "_compiled"
_CIMPORT = re.compile(r"^from handtouch\.core\.stages(?:\.(\w+) cimport .*| cimport (.*))$", re.MULTILINE)


class Compilation(NamedTuple):
    """State of the stages in this process: compiled, or the reason why not.

    `remedy`: where compiling isn't it, else empty.
    """

    compiled: bool
    reason: str
    remedy: str = ""

    @classmethod
    def current(cls) -> Compilation:
        """Return that of this process."""
        if os.environ.get(DISABLE_VARIABLE):
            return cls(False, f"{DISABLE_VARIABLE} is set", "unset it")
        missing = [name for name in MODULES if not compiled_file(name).exists()]
        if not missing:
            return cls(True, "")
        if any(_FOLDER.glob("*.so")):
            return cls(False, "the compiled modules are of other sources")
        return cls(False, "they were never compiled on this machine")


def module_name(stage: str) -> str:
    """Return the name of a stage's module, with its package."""
    return f"handtouch.{'simulate' if stage in SIMULATOR_STAGES else 'core'}.stages.{stage}"


@cache
def source_hash(stage: str) -> str:
    """Return the hash of what a stage is compiled from: source, declarations that it uses, and options."""
    digest = hashlib.sha256(repr((DIRECTIVES, CYTHON, FLAGS, LIMITED_API)).encode())
    if stage == SHARED:
        return digest.hexdigest()[:16]
    declarations, waiting = {stage}, [stage]
    while waiting:
        text = _source(waiting.pop(), "pxd").read_text()
        used = {name for found in _CIMPORT.findall(text) for name in re.findall(r"\w+", found[0] or found[1])}
        waiting += used - declarations
        declarations |= used
    digest.update(_source(stage, "py").read_bytes())
    for name in sorted(declarations):
        digest.update(_source(name, "pxd").read_bytes())
    return digest.hexdigest()[:16]


def _source(stage: str, suffix: str) -> Path:
    return (_ROOT / module_name(stage).replace(".", "/")).with_suffix(f".{suffix}")


def this_platform() -> str:
    """Return this machine's platform as the files name it, such as linux_x86_64."""
    return sysconfig.get_platform().replace("-", "_").replace(".", "_")


def compiled_file(stage: str, platform: str = "") -> Path:
    """Return the file that holds a stage compiled from the present sources, whether it exists or not.

    `platform` : this machine's by default
    """
    platform = platform or this_platform()
    return _FOLDER / f"{stage}-{source_hash(stage)}-{platform}.abi3.so"


class CompiledFinder(MetaPathFinder):
    """Finds the compiled modules of the stages where all are there; else leaves it to the sources."""

    @classmethod
    def install(cls) -> None:
        """Load compiled stages in this process from now on, if all are there."""
        if Compilation.current().compiled and not any(isinstance(finder, cls) for finder in sys.meta_path):
            sys.meta_path.insert(0, cls())

    def __init__(self) -> None:
        self._files = {module_name(name): str(compiled_file(name)) for name in MODULES}

    def find_spec(
        self,
        fullname: str,
        path: Sequence[str] | None = None,  # noqa: ARG002
        target: ModuleType | None = None,  # noqa: ARG002
    ) -> ModuleSpec | None:
        """Return the spec of a compiled stage; None for any other module."""
        file = self._files.get(fullname)
        if file is None:
            return None
        return spec_from_file_location(fullname, file, loader=ExtensionFileLoader(fullname, file))
