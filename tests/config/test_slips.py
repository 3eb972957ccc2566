"""Slips of writing TOML, and files of other formats, are answered in plain words."""

from __future__ import annotations

import pytest

from handtouch import config
from tests.deployments import deployment_text, pad_text

TEXT = deployment_text(*(pad_text(f"link_{n}", n) for n in range(1, 5)))


def _problems(text: str) -> list[str]:
    with pytest.raises(config.ConfigError) as raised:
        config.parse(text)
    return str(raised.value).splitlines()


def _changed(old: str, new: str) -> str:
    assert old in TEXT
    return TEXT.replace(old, new, 1)


@pytest.mark.parametrize(
    ("old", "new", "remedy"),
    [
        ('interface = "virtual"', "interface = virtual # of python-can", 'write interface = "virtual"'),
        ('interface = "virtual"', "interface = “virtual”", 'write straight ones, "..."'),
        ("alpha = 1.5", "alpha = 1,5", "write alpha = 1.5"),
        ("alpha = 1.5", "alpha = None", "leave the key out"),
        ("alpha = 1.5", "alpha: 1.5", "write alpha = 1.5"),
        ("crowding = false", "crowding = False", "write crowding = false"),
        ("surface = { ", "surface = {\n ", "an inline table {...} stands on one line"),
        ("alpha = 1.5", 'alpha = "1.5"', "without quotes: write 1.5"),
        ("node_id = 1", 'node_id = "0x11"', "without quotes: write 0x11"),
        ("sync_period_ms = 5.0", "sync_hz = 100", "write sync_period_ms = 10"),
        ('kind = "plane"', 'kind = "plain"', 'did you mean "plane"?'),
    ],
)
def test_a_slip_is_answered_with_what_to_write(old: str, new: str, remedy: str) -> None:
    (problem,) = _problems(_changed(old, new))
    assert remedy in problem


@pytest.mark.parametrize(
    ("text", "remedy"),
    [
        ('<?xml version="1.0"?>\n<robot name="hand"></robot>\n', "belongs under urdf of a [[hand]]"),
        ("[FileInfo]\nFileName=node.eds\n[DeviceInfo]\n", "belongs under eds of a [node.NAME]"),
        ('{"daemon": {"sync_period_ms": 5}}\n', "this is JSON"),
        ("# a hand\ndaemon:\n  sync_period_ms: 5\nbus:\n  - name: can0\n", "this is YAML"),
        ("[adc]\ndevice = 0\n", "`handtouch node`"),
        ('repeat = false\n[[touch]]\nlink = "tip"\n', "--scenario FILE"),
    ],
)
def test_a_file_of_another_kind_is_named(text: str, remedy: str) -> None:
    (problem,) = _problems(text)
    assert remedy in problem


def test_the_same_mistake_of_many_pads_is_one_line() -> None:
    (problem,) = _problems(TEXT.replace('sheet = "s"', 'sheet = "t"'))
    assert problem.endswith("; the same in h/link_2, h/link_3, h/link_4")
