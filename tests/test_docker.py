"""Image and compose file, checked without a container engine."""

from __future__ import annotations

import fnmatch
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
import zipfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import yaml

from handtouch.cli import build_parser
from handtouch.core.compiled import MODULES

from .conftest import ROOT, Installation, copy_compiled

pytestmark = pytest.mark.timeout(900)  # the first of these tests waits for a wheel, which compiles

COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "docker/compose.yaml").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]


def stages() -> list[list[tuple[str, str]]]:
    """Return the instructions of the Dockerfile by stage, from the first FROM on, with ARG inserted."""
    text = (ROOT / "docker/Dockerfile").read_text().replace("\\\n", " ")
    for name, value in re.findall(r"^ARG (\w+)=(\S+)", text, re.MULTILINE):
        text = text.replace(f"${{{name}}}", value)
    found: list[list[tuple[str, str]]] = []
    for line in text.splitlines():
        name, _, rest = line.strip().partition(" ")
        if name == "FROM":
            found.append([])
        if found and name and not name.startswith("#"):
            found[-1].append((name, rest.strip()))
    return found


def ignored(path: str) -> bool:
    """Return True if the build context excludes a path; the last matching rule decides."""
    verdict = False
    for line in (ROOT / "docker/Dockerfile.dockerignore").read_text().splitlines():
        rule = line.removeprefix("!")
        if line and not line.startswith("#"):
            parts = [str(parent) for parent in (Path(path), *Path(path).parents)]
            if any(fnmatch.fnmatch(part, rule) for part in parts):
                verdict = not line.startswith("!")
    return verdict


def copies() -> list[str]:
    """Return the sources of every COPY from the build context."""
    lines = [rest.split() for stage in stages() for name, rest in stage if name == "COPY"]
    return [source for words in lines if not words[0].startswith("--from") for source in words[:-1]]


def test_every_copied_file_exists_and_reaches_the_build() -> None:
    assert copies()
    for source in copies():
        assert (ROOT / source).exists(), source
        assert not ignored(source), source
    assert ignored(".venv")
    assert ignored("tests")


def test_the_image_is_slim_pinned_by_digest_and_not_run_by_root() -> None:
    build, final = stages()
    for stage in (build, final):
        assert re.match(r"python:3\.\d+\.\d+-slim-\w+@sha256:[0-9a-f]{64}( |$)", stage[0][1])
    users = [rest for name, rest in final if name == "USER"]
    assert users
    assert int(users[-1].split(":")[0]) > 0
    assert [name for name, _ in final].index("USER") > max(
        index for index, (name, _) in enumerate(final) if name in ("RUN", "COPY")
    )


def copy_context(stage: list[tuple[str, str]], root: Path, workdir: str, wheel: Path | None) -> None:
    """Replay the COPY instructions of a stage in a folder instead of /."""
    for name, rest in stage:
        *sources, target = rest.split()
        if name != "COPY":
            continue
        folder = root / workdir / target.lstrip("/")
        for source in sources:
            if source.startswith("--from"):
                assert wheel is not None
                folder.mkdir(parents=True, exist_ok=True)
                shutil.copy(wheel, folder)
                break
            if (ROOT / source).is_dir():
                shutil.copytree(ROOT / source, folder, ignore=lambda at, names: [
                    item for item in names if ignored(str((Path(at) / item).relative_to(ROOT)))
                ])  # fmt: skip
            else:
                place = folder / Path(source).name if target.endswith(("/", ".")) else folder
                place.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(ROOT / source, place)


def test_the_build_stage_makes_a_compiled_wheel(tmp_path: Path) -> None:
    build, _ = stages()
    (workdir,) = [rest.lstrip("/") for name, rest in build if name == "WORKDIR"]
    copy_context(build, tmp_path, workdir, None)
    folder = "src/handtouch/core/stages/_compiled"
    assert not (tmp_path / workdir / folder).exists()  # compiled for the host's C library
    copy_compiled(tmp_path / workdir)
    installs, script = [rest for name, rest in build if name == "RUN" and "pip" in rest]
    assert "--require-hashes" in installs
    assert script.startswith("HANDTOUCH_REQUIRE_COMPILED=1 python -m pip wheel ")
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    done = subprocess.run(
        ["sh", "-ec", script.replace("/wheels", f"{tmp_path}/wheels")],
        cwd=tmp_path / workdir, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    (made,) = (tmp_path / "wheels").iterdir()
    with zipfile.ZipFile(made) as opened:
        compiled = [name for name in opened.namelist() if "/_compiled/" in name]
    assert len(compiled) == len(MODULES)


def test_image_installs_like_a_controller(wheel: Path, tmp_path: Path) -> None:
    """Replay COPY and RUN in a folder instead of /."""
    _, final = stages()
    (run,) = [rest for name, rest in final if name == "RUN"]
    copy_context(final, tmp_path, "", wheel)
    assert "services/install.sh program" in run
    assert (tmp_path / "install/locks/run.lock").exists()
    offline = run.replace(
        "PIP_ARGS=--no-cache-dir", "LOCK= PIP_ARGS='--no-cache-dir --no-index --no-compile'"
    )
    assert offline != run
    environment = {**os.environ, "PREFIX": f"{tmp_path}/usr", "PYTHON": sys.executable}
    script = offline.replace("/install", f"{tmp_path}/install").replace(
        f"services{tmp_path}/install", "services/install"
    )
    done = subprocess.run(["sh", "-ec", script], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "usr/bin/handtouch").exists()
    assert (tmp_path / "etc/handtouch/hand.toml").exists()
    assert not (tmp_path / "install").exists()


def test_every_command_is_one_of_handtouch() -> None:
    parser = build_parser()
    default = next(rest for name, rest in stages()[-1] if name == "CMD")
    commands = [yaml.safe_load(default), *(service["command"] for service in SERVICES.values())]
    (image,) = [rest.partition("CMD ")[2] for name, rest in stages()[-1] if name == "HEALTHCHECK"]
    checks = [["CMD", *yaml.safe_load(image)], SERVICES["daemon"]["healthcheck"]["test"]]
    assert [words[:2] for words in checks] == [["CMD", "handtouch"]] * 2
    for words in [*commands, *(check[2:] for check in checks)]:
        parser.parse_args(words)  # leaves with SystemExit if it isn't


@pytest.mark.parametrize("name", SERVICES)
def test_a_service_has_no_privileges(name: str) -> None:
    service = SERVICES[name]
    assert (service["read_only"], service["cap_drop"]) == (True, ["ALL"])
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert "privileged" not in service


def test_the_services_share_one_network_and_one_bus() -> None:
    assert {name: service.get("network_mode") for name, service in SERVICES.items()} == {
        "daemon": None,
        "hand": "service:daemon",
        "watch": "service:daemon",
    }
    buses = {name: SERVICES[name]["command"][-2:] for name in ("daemon", "hand")}
    assert buses["daemon"] == buses["hand"]
    assert shlex.join(buses["hand"]).startswith("--bus can0=udp_multicast:239.")


def test_the_build_finds_its_dockerfile() -> None:
    build = SERVICES["daemon"]["build"]
    context = (ROOT / "docker" / build["context"]).resolve()
    assert context == ROOT
    assert (context / build["dockerfile"]).is_file()


def test_composed_processes_connect(installation: Installation, network: list[str], tmp_path: Path) -> None:
    """Run the commands of compose.yaml in one network, without containers, until the daemon is healthy."""

    def command(words: list[str]) -> list[str]:
        settings = str(installation.settings)
        return [*network, program, *(word.replace("/etc/handtouch", settings) for word in words)]

    program = str(installation.prefix / "bin/handtouch")
    healthy = command(SERVICES["daemon"]["healthcheck"]["test"][2:])
    output = (tmp_path / "watched").open("w")
    running: list[subprocess.Popen[bytes]] = []
    with ExitStack() as stack:
        stack.enter_context(output)
        for name in ("daemon", "hand", "watch"):
            process = subprocess.Popen(
                command(SERVICES[name]["command"]), env=installation.environment, stdout=output
            )
            running.append(process)
            stack.callback(process.wait, 15)
            stack.callback(process.terminate)
        deadline = time.monotonic() + 90
        while time.monotonic() < deadline and all(process.poll() is None for process in running):
            asked = subprocess.run(
                healthy, env=installation.environment, capture_output=True, text=True, check=False
            )
            if asked.returncode == 0:
                break
            time.sleep(1.0)  # each question starts an interpreter
        assert [process.poll() for process in running] == [None, None, None], "one of them ended"
        assert asked.returncode == 0, asked.stdout + asked.stderr
