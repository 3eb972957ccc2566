"""The command line: help of every command, options, exit status."""

from __future__ import annotations

import argparse
import inspect
import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

from handtouch.cli import build_parser, main
from handtouch.cli.daemons import SCENARIOS
from handtouch.config import shipped

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
                nested = [(f"{name} {below}", found) for below, found in commands_of(command)]
                yield from nested or [(name, command)]


ALL_COMMANDS = dict(commands_of(build_parser()))


@pytest.mark.parametrize("name", ALL_COMMANDS)
def test_options_of_every_command_are_parameters_of_its_function(name: str) -> None:
    parser = ALL_COMMANDS[name]
    options = {action.dest for action in parser._actions} - {"help"}
    parameters = inspect.signature(parser.get_default("command").load()).parameters.values()
    takes_any = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters)
    named = [parameter for parameter in parameters if parameter.kind is not parameter.VAR_KEYWORD]
    assert {parameter.name for parameter in named if parameter.default is parameter.empty} <= options
    assert takes_any or options <= {parameter.name for parameter in named}


def test_scenario_names_in_help_are_those_shipped() -> None:
    assert tuple(SCENARIOS) == shipped.SCENARIO_NAMES


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        build_parser().parse_args(["--help"])
    listed = capsys.readouterr().out
    assert all(command in listed for command in COMMANDS)


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


def test_status_without_a_daemon_exits_with_status_1_and_a_remedy(
    endpoints: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["status", "--endpoint", endpoints["control"]]) == 1
    assert "check that `handtouch run` is running" in capsys.readouterr().err


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
