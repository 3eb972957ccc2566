"""Build hook: compile the stages of the core into the wheel; without a compiler the wheel is pure Python."""

from __future__ import annotations

import importlib.util
import os
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

REQUIRE_VARIABLE = "HANDTOUCH_REQUIRE_COMPILED"
"""Environment variable that makes a build without compiled stages fail."""
MACHINE_VARIABLE = "HANDTOUCH_WHEEL_MACHINE"
"""Environment variable with the machine that a wheel is for, x86_64 or aarch64; by default this one."""


class CustomBuildHook(BuildHookInterface):  # type: ignore[type-arg]
    """Compiles the stages before files are collected."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and tag the wheel with its platform and the stable ABI of Python 3.11."""
        if self.target_name != "wheel":
            return
        source = Path(self.root) / "src"
        spec = importlib.util.spec_from_file_location("_build", source / "handtouch/core/build.py")
        assert spec is not None
        assert spec.loader is not None
        build = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(build)
        machine = os.environ.get(MACHINE_VARIABLE, "")
        try:
            # a wheel for others depends on the sources alone
            cache = build.user_cache() if version == "editable" else None
            files = build.build_stages(source, machine, cache=cache)
        except build.BuildError as error:
            if machine or os.environ.get(REQUIRE_VARIABLE):
                raise
            self.app.display_warning(f"handtouch will run uncompiled: {error}")
            return
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        if machine:
            platform = "manylinux_{}_{}_{}".format(*build.MIN_GLIBC, machine)
        build_data["pure_python"] = False
        build_data["tag"] = f"cp311-abi3-{platform}"
        folder = "handtouch/core/stages/_compiled"
        build_data["force_include"].update({str(file): f"{folder}/{file.name}" for file in files})
