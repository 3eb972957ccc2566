"""Selection of nodes by id, bus and pad, with what the deployment states about them."""

from __future__ import annotations

import pytest

from handtouch import config
from handtouch.config import ConfigError, shipped
from handtouch.procedures.conformance import select_targets

BUS = ["can0=virtual:x"]


@pytest.fixture(scope="module")
def hand() -> config.Deployment:
    return config.load(shipped.path("two_finger.toml"))


def keys(deployment: config.Deployment | None, buses: list[str], names: list[str]) -> list[tuple[str, int]]:
    return [(node.bus, node.node_id) for node in select_targets(deployment, buses, names, None).nodes]


def test_ids_are_decimal_or_hexadecimal_with_or_without_a_bus() -> None:
    assert keys(None, BUS, ["5", "0x11", "can0:6"]) == [("can0", 5), ("can0", 17), ("can0", 6)]


def test_all_without_a_deployment_are_those_that_respond() -> None:
    targets = select_targets(None, BUS, [], "x.eds")
    assert targets.find_all
    assert targets.nodes == ()
    assert targets.describe_found("can0", 5).eds == "x.eds"


def test_all_of_a_deployment_are_its_pads_with_what_it_states(hand: config.Deployment) -> None:
    targets = select_targets(hand, [], [], None)
    assert not targets.find_all
    assert [node.name for node in targets.nodes] == hand.pad_names
    pad, node = hand.pads[0].pad, targets.nodes[0]
    assert (node.node_id, node.serial) == (pad.node_id, pad.serial)
    assert node.noise_counts == hand.nodes[pad.node].noise_counts


def test_pads_are_selected_by_pattern(hand: config.Deployment) -> None:
    assert keys(hand, [], ["thumb_*"]) == [("can0", 1)]
    assert keys(hand, [], ["gripper/*"]) == [("can0", 1), ("can0", 2)]


def test_an_id_of_the_deployment_is_described_by_it(hand: config.Deployment) -> None:
    (node,) = select_targets(hand, [], ["2"], None).nodes
    assert node.name == "gripper/index_tip"


@pytest.mark.parametrize("role", ["guest", "listener"])
def test_a_bus_on_which_handtouch_sends_no_nmt_is_refused(hand: config.Deployment, role: str) -> None:
    bus = hand.buses[0].model_copy(update={"role": role})
    with pytest.raises(ConfigError, match=f"role = {role}"):
        select_targets(hand.model_copy(update={"buses": (bus,)}), [], ["1"], None)


@pytest.mark.parametrize(
    ("buses", "names", "text"),
    [
        ([], ["5"], "--bus can0=socketcan:can0"),
        (BUS, ["128"], "1 to 127"),
        (BUS, ["0"], "1 to 127"),
        (BUS, ["can1:5"], "no such bus"),
        (BUS, ["thumb"], "only with --config"),
        ([*BUS, "can1=virtual:y"], ["5"], "give the bus, too: can0:5"),
    ],
)
def test_a_mistake_names_the_remedy(buses: list[str], names: list[str], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        select_targets(None, buses, names, None)
