"""From a deployment to what the master is told of every node."""

from __future__ import annotations

import pytest

from handtouch import shipped
from handtouch.canbus.boot import Idle
from handtouch.canbus.channels import STANDARD_CHANNELS, Channel, Object
from handtouch.canbus.eds import EdsError
from handtouch.canbus.nodes import NodeSpec, node_specs
from handtouch.config import parse

PATH = shipped.path("utah_mit.toml")
KIND = "[node.four_channel]"


def specs(more: str = "", tables: str = "") -> list[NodeSpec]:
    """Of the shipped hand, with something added to its kind of node."""
    text = PATH.read_text(encoding="utf-8")
    assert KIND in text
    head, tail = text.split(KIND)
    line, rest = tail.split("\n", 1)
    return node_specs(parse(f"{head}{KIND}{line}\n{more}\n{rest}\n{tables}", str(PATH), PATH.parent))


def test_every_pad_is_a_node_in_the_slot_of_its_order() -> None:
    made = specs()
    assert [spec.slot for spec in made] == list(range(len(made)))
    assert len({(spec.bus, spec.node_id) for spec in made}) == len(made)
    assert all("/" in spec.name for spec in made)
    assert made[0].channels == STANDARD_CHANNELS
    assert made[0].idle is None
    assert made[0].excitation is None


def test_idling_is_timed_by_the_sync_period() -> None:
    made = specs('excitation = "0x2100:0:u8"', "[node.four_channel.idle]\ndelta_counts = 40\nperiod_ms = 200")
    assert made[0].excitation == Object(0x2100, 0, 1)
    deltas = tuple(Object(0x6426, sub, 4) for sub in (1, 2, 3, 4))
    assert made[0].idle == Idle(40, 200, 50, deltas, Object(0x6423, 0, 1))


def test_delta_beyond_its_object_is_named() -> None:
    small = 'delta_objects = ["0x6426:1:u8", "0x6426:2:u8", "0x6426:3:u8", "0x6426:4:u8"]'
    with pytest.raises(
        EdsError, match=r'"0x6426:1:u8": delta_counts = 256 is beyond its type; choose a smaller'
    ):
        specs("", f"[node.four_channel.idle]\ndelta_counts = 256\n{small}")
    assert specs("", f"[node.four_channel.idle]\ndelta_counts = 255\n{small}")


def test_channels_of_the_configuration_are_those_of_every_node() -> None:
    made = specs('channels = ["0x6401:4", "0x6401:3", "0x6401:2", "0x6401:1"]')
    assert made[-1].channels == tuple(Channel(0x6401, sub) for sub in (4, 3, 2, 1))
