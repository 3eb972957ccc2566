"""Impossible schedules of switched electrodes are refused with file, option, value and remedy."""

from __future__ import annotations

import pytest

from handtouch.canbus.nodes.spec import check_nodes, node_specs, sync_overflows
from handtouch.config import ConfigError, parse, shipped

TEXT = shipped.path("switched.toml").read_text()
SECOND = '["front_right", "right_right", "back_right", "left_right"]'


def test_each_channel_has_the_state_that_it_is_measured_in() -> None:
    deployment = parse(TEXT)
    tip, middle = node_specs(deployment)
    assert tip.channel_states == (0, 1) * 4  # electrodes alternate around the pad
    assert [channel.sub for channel in tip.channels] == [1, 5, 2, 6, 3, 7, 4, 8]
    assert middle.channel_states == ()
    assert sync_overflows(deployment) == {"can0": 2}
    assert (tip.sync_overflow, middle.sync_overflow) == (2, 2)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (SECOND, SECOND.replace("left_right", "front_left"), "must name each of front_left"),
        (
            '"back_left", "left_left"],\n    ' + SECOND,
            '"back_left"],\n    ' + SECOND.replace("]", ', "left_left"]'),
            "name as many in each state",
        ),
        (
            "[sheet.soft]",
            "[node.switched.idle]\ndelta_counts = 5\n\n[sheet.soft]",
            r"\[node.switched.idle\] makes the node event-driven",
        ),
        ('node = "four_channel"', f'switch_states = [["x0", "xa", "y0"], {SECOND}]\nnode = "four_channel"',
         "which the pad lacks"),
    ],
)  # fmt: skip
def test_impossible_schedules_are_refused(old: str, new: str, message: str) -> None:
    assert old in TEXT
    with pytest.raises(ConfigError, match=message) as refused:
        parse(TEXT.replace(old, new))
    assert "switch_states" in str(refused.value)


def test_a_state_that_no_pdo_holds_is_refused() -> None:
    wide = TEXT
    for sub in range(1, 9):
        wide = wide.replace(f'"0x6401:{sub}"', f'"0x6402:{sub}:i32"')
    with pytest.raises(ConfigError, match="channels of 128 bits, but a TPDO carries 64"):
        check_nodes(parse(wide), "switched.toml")
