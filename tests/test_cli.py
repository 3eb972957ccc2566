"""The command line: quick, helpful, with the exit status that scripts rely on."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from handtouch.cli import build_parser, main

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


def test_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        build_parser().parse_args(["--help"])
    listed = capsys.readouterr().out
    assert all(command in listed for command in COMMANDS)


def test_wrong_usage_is_status_2() -> None:
    with pytest.raises(SystemExit) as ended:
        main(["no-such-command"])
    assert ended.value.code == 2


def test_help_loads_nothing_heavy() -> None:
    script = (
        "import sys\nfrom handtouch.cli import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "heavy = {'numpy', 'scipy', 'zmq', 'can', 'canopen', 'pydantic', 'rich'} & set(sys.modules)\n"
        "sys.exit(f'loaded {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


def test_status_without_a_daemon_is_status_1_with_a_remedy(
    endpoints: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["status", "--endpoint", endpoints["control"]]) == 1
    assert "is handtouch run up?" in capsys.readouterr().err


def test_watch_with_a_pattern_that_matches_no_topic_is_status_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["watch", "contacts/*"]) == 2
    assert "contact/*/*" in capsys.readouterr().err


@pytest.mark.parametrize("command", [["run"], ["simulate"], ["replay", "x.log"]])
def test_a_missing_deployment_is_status_2_and_named(
    command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command, "/nowhere/hand.toml"]) == 2
    assert "/nowhere/hand.toml" in capsys.readouterr().err


def test_a_reader_that_leaves_early_is_no_error() -> None:
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    shell = f"{sys.executable} -m handtouch --help | head -1"
    done = subprocess.run(["sh", "-c", shell], capture_output=True, text=True, timeout=60, env=environment)
    assert done.returncode == 0
    assert "Traceback" not in done.stderr
