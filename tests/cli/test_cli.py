"""The command line: help of every command, options, exit status."""

from __future__ import annotations

import argparse
import builtins
import contextlib
import inspect
import json
import os
import pty
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from handtouch.cli import build_parser, main, requests
from handtouch.cli.simulate import SCENARIOS
from handtouch.config import shipped
from tests.deployments import deployment_text, pad_text

COMMANDS = [
    *("demo", "run", "simulate", "watch", "status", "keys", "scan", "commission"),
    *("record", "replay", "export", "plot"),
    *("check", "doctor", "figures", "design"),
]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        build_parser().parse_args([command, "--help"])
    assert ended.value.code == 0
    assert command in capsys.readouterr().out


def commands_of(parser: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """All commands with their parsers, subcommands included."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, command in action.choices.items():
                command.add_own_arguments()
                nested = [(f"{name} {below}", found) for below, found in commands_of(command)]
                yield from nested or [(name, command)]


ALL_COMMANDS = dict(commands_of(build_parser()))


@pytest.mark.parametrize("name", ALL_COMMANDS)
def test_options_of_every_command_are_parameters_of_its_function(name: str) -> None:
    parser = ALL_COMMANDS[name]
    options = {action.dest for action in parser._actions} - {"help", "daemon_config"}  # `main` takes it
    parameters = inspect.signature(parser.get_default("command")).parameters.values()
    takes_any = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters)
    named = [parameter for parameter in parameters if parameter.kind is not parameter.VAR_KEYWORD]
    assert {parameter.name for parameter in named if parameter.default is parameter.empty} <= options
    assert takes_any or options <= {parameter.name for parameter in named}


@pytest.mark.parametrize("name", ALL_COMMANDS)
def test_what_a_command_does_not_know_is_an_error_of_that_command(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    parser = ALL_COMMANDS[name]
    option = [action.option_strings[-1] for action in parser._actions if action.option_strings][-1]
    with pytest.raises(SystemExit) as ended:
        parser.parse_args([f"{option}x"])
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith(f"usage: handtouch {name}")
    if "required" not in error:
        assert f"did you mean {option}" in error


def test_commands_of_a_deployment_s_buses_take_other_interfaces_for_them() -> None:
    of_buses = ("run", "simulate", "check", "doctor", "scan", "conformance", "commission", "init")
    assert all("--bus" in ALL_COMMANDS[name]._option_string_actions for name in of_buses)


def test_scenario_names_in_help_are_those_shipped() -> None:
    assert tuple(SCENARIOS) == shipped.SCENARIO_NAMES


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        build_parser().parse_args(["--help"])
    listed = capsys.readouterr().out
    assert all(command in listed for command in COMMANDS)
    assert main([]) == 2  # somebody who doesn't know a command yet
    assert capsys.readouterr().err == listed


def test_wrong_usage_exits_with_status_2() -> None:
    with pytest.raises(SystemExit) as ended:
        main(["no-such-command"])
    assert ended.value.code == 2


def test_help_imports_no_heavy_package() -> None:
    script = (
        "import sys\nfrom handtouch.cli import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "heavy = {'numpy', 'scipy', 'zmq', 'can', 'canopen', 'pydantic', 'rich'} & set(sys.modules)\n"
        "sys.exit(f'loaded {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


@pytest.fixture
def _short_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait 0.2 s for a daemon that isn't there."""
    monkeypatch.setattr(requests, "SHORT_TIMEOUT_S", 0.2)


@pytest.mark.usefixtures("_short_wait")
@pytest.mark.parametrize("command", [["status"], ["scene"], ["tare"], ["log", "info"]], ids="_".join)
def test_a_request_without_a_daemon_exits_with_status_1_and_a_remedy(
    command: list[str], endpoints: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command, "--endpoint", endpoints["control"]]) == 1
    assert "start `handtouch run FILE`" in capsys.readouterr().err


@pytest.mark.usefixtures("_short_wait")
@pytest.mark.parametrize("way", ["option", "environment"])
def test_a_client_command_finds_the_daemon_by_its_deployment_file(
    way: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "hand.toml"
    endpoints = f'control = "ipc://{tmp_path}/control"\nlive = "ipc://{tmp_path}/live"'
    file.write_text(deployment_text(pad_text("tip", 5), daemon=f"sync_period_ms = 5.0\n{endpoints}"))
    given = []
    if way == "environment":
        monkeypatch.setenv("HANDTOUCH_CONFIG", str(file))
    else:
        given = ["--config", str(file)]
    assert main(["status", *given]) == 1
    assert f"ipc://{tmp_path}/control" in capsys.readouterr().err
    assert main(["watch", "--seconds", "0.1", *given]) == 1
    assert f"ipc://{tmp_path}/live" in capsys.readouterr().err
    assert main(["status", "--endpoint", f"ipc://{tmp_path}/other", *given]) == 1  # an option comes first
    assert f"ipc://{tmp_path}/other" in capsys.readouterr().err


def test_a_client_command_with_an_unusable_deployment_exits_with_status_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["status", "--config", str(tmp_path / "none.toml")]) == 2
    assert "none.toml" in capsys.readouterr().err


def test_watch_with_an_unknown_topic_exits_with_status_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["watch", "contacts/*"]) == 2
    assert "contact/*/*" in capsys.readouterr().err


@pytest.mark.parametrize("command", [["run"], ["simulate"], ["replay", "x.log"]])
def test_missing_deployment_exits_with_status_2_and_is_named(
    command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command, "/nowhere/hand.toml"]) == 2
    assert "/nowhere/hand.toml" in capsys.readouterr().err


def test_closed_output_pipe_is_no_error() -> None:
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    shell = f"{sys.executable} -m handtouch --help | head -1"
    done = subprocess.run(["sh", "-c", shell], capture_output=True, text=True, timeout=60, env=environment)
    assert done.returncode == 0
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("arguments", "closest"),
    [(["statsu"], "status"), (["keys", "lst", "x"], "list"), (["log", "wanring"], "warning")],
)
def test_an_unknown_command_or_choice_is_reported_with_the_closest(
    arguments: list[str], closest: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert f"did you mean '{closest}'?" in capsys.readouterr().err


def test_an_unknown_command_like_no_other_refers_to_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["xyzzy"])
    assert ended.value.code == 2
    assert "invalid choice: 'xyzzy'; see `handtouch --help`" in capsys.readouterr().err


WITHOUT_DATA = {
    *("demo", "init", "run", "simulate", "view", "bridge ros2", "bridge zenoh", "keys revoke"),
    *("calibrations export", "support"),  # write files of JSON
}
ROOT = Path(__file__).parents[2]


def test_every_command_that_prints_data_prints_json_and_documents_its_shape() -> None:
    with_json = {name for name, parser in ALL_COMMANDS.items() if "--json" in parser.format_help()}
    assert with_json == set(ALL_COMMANDS) - WITHOUT_DATA
    rows = (ROOT / "docs/command_line.md").read_text().splitlines()
    documented = [row.split("|")[1] for row in rows if row.startswith("| `")]
    assert {name.strip("` ") for cell in documented for name in cell.split(",")} == with_json


@pytest.mark.parametrize(
    ("arguments", "keys"),
    [
        (["check", "config/utah_mit.toml"], {"file", "ok", "buses", "hands", "warnings"}),
        (["check", "config/utah_mit.toml", "--bus", "can0=socketcan:vcan0"], {"file", "ok", "warnings"}),
        (["check", "missing.toml"], {"file", "ok", "problems"}),
        (["keys", "make", "{new}"], {"folder", "name", "public_key"}),
    ],
)
def test_output_with_json_is_one_object_with_the_documented_keys(
    arguments: list[str],
    keys: set[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(ROOT)
    main([text.format(new=tmp_path / "new") for text in arguments] + ["--json"])
    assert keys <= json.loads(capsys.readouterr().out).keys()


def test_check_uses_the_interface_given_for_a_bus(capsys: pytest.CaptureFixture[str]) -> None:
    main(["check", str(ROOT / "config/utah_mit.toml"), "--bus", "can0=socketcan:vcan7", "--json"])
    assert json.loads(capsys.readouterr().out)["buses"][0]["channel"] == "vcan7"
    assert main(["check", str(ROOT / "config/utah_mit.toml"), "--bus", "can9=socketcan:vcan7"]) == 2


def test_every_command_writes_to_the_path_given_as_output() -> None:
    writing = (
        "record",
        "export",
        "plot",
        "figures",
        "design",
        "support",
        "calibrations export",
        "keys client",
    )
    for name in writing:
        assert {"-o", "--output"} <= set(ALL_COMMANDS[name].format_help().replace(",", " ").split()), name


@pytest.mark.parametrize(
    "command",
    [
        ["replay", "nope.mcap"],
        ["replay", "nope.log", "config/utah_mit.toml"],
        ["export", "nope.mcap"],
        ["plot", "nope.mcap"],
        ["calibrate", "right/palm_heel", "--config", "config/utah_mit.toml", "--from", "nope.jsonl"],
    ],
)
def test_a_missing_file_is_named_without_an_error_number(
    command: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT)
    assert main(command) == 2
    error = capsys.readouterr().err
    assert error.startswith("nope.")
    assert "Errno" not in error


@pytest.mark.parametrize("command", [["design", "config/utah_mit.toml"], ["figures"]])
def test_drawing_without_matplotlib_names_the_extra(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real = builtins.__import__

    def refuse(name: str, *rest: Any, **more: Any) -> Any:
        if name.startswith("matplotlib"):
            raise ImportError(f"No module named {name!r}")
        return real(name, *rest, **more)

    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(builtins, "__import__", refuse)
    assert main([*command, "--output", str(tmp_path)]) == 2
    assert "[figures]'" in capsys.readouterr().err


def test_completion_script_has_commands_options_and_paths(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--print-completion", "bash"])
    tried = (
        capsys.readouterr().out
        + '\ncomplete_words() { COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=(); _shtab_handtouch;'
        ' echo "${COMPREPLY[@]}"; }\n'
        "complete_words handtouch sna; complete_words handtouch calibrations ro; "
        "complete_words handtouch replay --rep; complete_words handtouch check pyproj\n"
    )
    done = subprocess.run(
        ["bash", "-c", tried], capture_output=True, text=True, timeout=60, cwd=ROOT, check=True
    )
    assert done.stdout.split() == ["snapshot", "rollback", "--report", "pyproject.toml"]


def on_a_terminal(*arguments: str, **variables: str) -> str:
    """Return what a command prints on a terminal."""
    terminal, end = pty.openpty()
    environment = {**os.environ, "TERM": "xterm-256color", "COLUMNS": "200", **variables}
    command = [sys.executable, "-m", "handtouch", *arguments]
    with subprocess.Popen(command, stdin=end, stdout=end, stderr=end, env=environment) as process:
        os.close(end)
        printed = b""
        with contextlib.suppress(OSError):  # the terminal's other end is closed
            while part := os.read(terminal, 65536):
                printed += part
        os.close(terminal)
        process.wait()
    return printed.decode()


def test_colour_and_progress_are_for_terminals_and_colour_obeys_no_color() -> None:
    scan = ("scan", "--bus", "can0=virtual:terminal-test", "--listen", "--seconds", "0.2")
    colour, erased = re.compile(r"\x1b\[[0-9;]*3[0-7]m"), "\r\x1b[2K"
    shown = on_a_terminal(*scan)
    assert colour.search(shown)
    assert erased in shown
    assert not colour.search(on_a_terminal(*scan, NO_COLOR="1"))
    command = [sys.executable, "-m", "handtouch", *scan]
    piped = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert "\x1b" not in piped.stdout + piped.stderr


def test_a_command_interrupted_before_its_result_exits_with_status_130(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(*_: object, **__: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr("handtouch.cli.check.run", interrupted)
    assert main(["check", "hand.toml"]) == 130
