"""Node specifications from a deployment."""

from __future__ import annotations

import re

import pytest

from handtouch.canbus.nodes.spec import IdleSettings, NodeSpec, check_nodes, node_specs
from handtouch.config import (
    ConfigError,
    Deployment,
    parse,
    shipped,
)
from handtouch.config.channels import STANDARD_CHANNELS, Channel, WritableObject

PATH = shipped.path("utah_mit.toml")
KIND = "[node.four_channel]"


def deployment(more: str = "", tables: str = "", bus: str = "") -> Deployment:
    """The shipped hand, with something added to its kind of node or to its bus."""
    text = PATH.read_text(encoding="utf-8")
    assert KIND in text
    head, tail = text.split(KIND)
    line, rest = tail.split("\n", 1)
    head = head.replace("[[bus]]\n", f"[[bus]]\n{bus}\n")
    return parse(f"{head}{KIND}{line}\n{more}\n{rest}\n{tables}", str(PATH), PATH.parent)


def specs(more: str = "", tables: str = "") -> list[NodeSpec]:
    """Return the node specifications of the hand."""
    return node_specs(deployment(more, tables))


def test_every_pad_is_a_node_in_the_slot_of_its_order() -> None:
    made = specs()
    assert [spec.slot for spec in made] == list(range(len(made)))
    assert len({(spec.bus, spec.node_id) for spec in made}) == len(made)
    assert all("/" in spec.name for spec in made)
    assert made[0].channels == STANDARD_CHANNELS
    assert made[0].idle is None
    assert made[0].excitation is None


def test_idling_is_timed_by_the_sync_period() -> None:
    made = specs(
        'excitation_object = "0x2100:0:u8"', "[node.four_channel.idle]\ndelta_counts = 40\nperiod_ms = 200"
    )
    assert made[0].excitation == WritableObject(0x2100, 0, 1)
    deltas = tuple(WritableObject(0x6426, sub, 4) for sub in (1, 2, 3, 4))
    assert made[0].idle == IdleSettings(40, 200, 50, deltas, WritableObject(0x6423, 0, 1))


REAL = "channels = [" + ", ".join(f'"0x6403:{n}:f32/1000"' for n in (1, 2, 3, 4)) + "]"
IDLE = "\n[node.four_channel.idle]\ndelta_counts = 256\n"
SMALL = 'delta_objects = ["0x6426:1:u8", "0x6426:2:u32", "0x6426:3:u32", "0x6426:4:u32"]'


@pytest.mark.parametrize(
    ("more", "tables", "message"),
    [
        (
            'channels = ["0x6401:1", "0x6401:2", "0x6401:2", "0x6401:4"]',
            "",
            r'channels: "0x6401:2" is given twice',
        ),
        (
            'channels = ["6401:1", "0x6401:2", "0x6401:3", "0x6401:4"]',
            "",
            'channels: "6401:1" is no object; write',
        ),
        (
            'channels = ["0x2500:1", "0x2500:2", "0x2500:3", "0x2500:4"]',
            "",
            "channels: .* its type is unknown",
        ),
        (
            'channels = ["0x6403:1", "0x6403:2", "0x6403:3", "0x6403:4"]',
            "",
            'channels: "0x6403:1" is REAL32; add its counts per unit',
        ),
        (REAL, "", "full_scale_counts: missing; REAL32 channels have no greatest count"),
        (
            'excitation_object = "0x2100:0"',
            "",
            'excitation_object: "0x2100:0": its type is missing; add it',
        ),
        ('excitation_object = "on"', "", 'excitation_object: "on" is no object; write'),
        ("", IDLE + SMALL, r'idle\]: delta_objects: "0x6426:1:u8": delta_counts = 256 is beyond its type'),
        (
            "",
            IDLE + 'enable_object = "0x6423:0"',
            r"idle\]: enable_object: .* its type is missing; add it",
        ),
    ],
)
def test_invalid_objects_are_named_with_file_section_and_key(more: str, tables: str, message: str) -> None:
    with pytest.raises(
        ConfigError, match=rf"^{re.escape(str(PATH))}: \[node.four_channel.*{message}"
    ) as error:
        check_nodes(deployment(more, tables), str(PATH))
    assert len(error.value.problems) == 1


def test_real32_channels_with_a_full_scale_are_accepted() -> None:
    check_nodes(deployment(REAL + "\nfull_scale_counts = 10_000"), "hand.toml")


def test_listener_without_a_usable_eds_is_refused() -> None:
    wide = 'channels = ["0x6402:1", "0x6402:2", "0x6402:3", "0x6402:4"]'
    listener = deployment(wide, bus='role = "listener"')
    with pytest.raises(ConfigError, match="need several PDOs; give the node's eds"):
        check_nodes(listener, "hand.toml")
    assert check_nodes(deployment(wide), "hand.toml")


def test_channels_of_the_configuration_are_those_of_every_node() -> None:
    made = specs('channels = ["0x6401:4", "0x6401:3", "0x6401:2", "0x6401:1"]')
    assert made[-1].channels == tuple(Channel(0x6401, sub) for sub in (4, 3, 2, 1))
