"""Other vendors' nodes: the master boots them by their EDS, and their counts arrive in the slab."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.config import load, shipped
from handtouch.config.channels import order_by_electrode, resolve_channels
from handtouch.config.eds import EdsError
from handtouch.config.tables import SIDE_ELECTRODES

PAD = load(shipped.path("utah_mit.toml")).pads[0].pad
Make = Callable[..., Any]
FOLDER = Path(__file__).parent.parent / "data" / "eds"
KINDS = {  # objects of the channels, counts that need their full width, identifiers of node 1
    "feldmann-ai4w.eds": ("0x6401:{}", (-32768, 32767, -1, 2), (0x281,)),
    "norsens-quad404.eds": ("0x9130:{}", (-(2**31), 2**31 - 1, -70_000, 1), (0x181, 0x281)),
    "tactor-q16.eds": ("0x21{}0:0", (0, 65_535, 32_768, 1), (0x181, 0x381)),
    "hapt24.dcf": ("0x8130:{}", (-(2**23), 2**23 - 1, -70_000, 1), (0x181, 0x281)),
    "noname-4ch.eds": ("0x6401:{}", (-32768, 32767, -1, 2), (0x181,)),
    "ambit-f401.eds": ("0x6403:{}:f32/1000", (-8_000_000, 8_388_607, -1, 2), (0x181, 0x281)),
    "ambit-f404.eds": ("0x6130:{}:f32/0.25", (-8_000_000, 8_388_607, -1, 2), (0x181, 0x281)),
}


def objects(kind: str) -> list[str]:
    return [KINDS[kind][0].format(number) for number in (1, 2, 3, 4)]


def make_kind(make_rig: Make, kind: str, size: int = 2, **more: Any) -> Any:
    """A hand of nodes of a kind, its spec as a deployment gives it."""
    path = str(FOLDER / kind)
    channels = resolve_channels(objects(kind), path)
    device = {
        "eds": path,
        "channels": tuple((c.index, c.sub) for c in channels),
        "counts_per_unit": tuple(c.counts_per_unit for c in channels),
    } | more.pop("device", {})
    pad = PAD.model_copy(update={"electrodes": more.pop("electrodes", SIDE_ELECTRODES)})
    rig = make_rig(size, device=device, **{"eds": path, "channels": order_by_electrode(channels, pad)} | more)
    rig.counts[:] = KINDS[kind][1]
    return rig


@pytest.mark.parametrize("strict", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_node_of_another_vendor_is_operational_and_its_counts_are_in_the_slab(
    make_rig: Make, kind: str, strict: bool
) -> None:
    rig = make_kind(make_rig, kind, device={"strict_pdo": strict})
    rig.boot()
    rig.run(10)
    assert rig.slab.unpack_counts().tolist() == [list(KINDS[kind][1])] * 2
    assert rig.status(1).cob_ids == KINDS[kind][2]
    before = rig.slab.arrival_ns.copy()
    rig.run(5)
    assert (rig.slab.arrival_ns > before).all()
    assert rig.port.counters.wrong_length == rig.port.counters.unknown_frames == 0


@pytest.mark.parametrize("kind", KINDS)
def test_node_of_another_vendor_comes_back_after_a_reboot(make_rig: Make, kind: str) -> None:
    rig = make_kind(make_rig, kind)
    rig.boot()
    rig.node(1).reboot()
    rig.run(400)
    assert rig.state(1) is NodeState.OPERATIONAL
    assert rig.status(1).reboots == 1
    assert rig.slab.unpack_counts().tolist() == [list(KINDS[kind][1])] * 2


@pytest.mark.parametrize("wired", [*itertools.permutations(SIDE_ELECTRODES)][::5])
def test_channels_are_reordered_by_electrode(make_rig: Make, wired: tuple[str, ...]) -> None:
    rig = make_kind(make_rig, "hapt24.dcf", 1, electrodes=wired)
    rig.counts[:] = (1, 2, 3, 4)
    rig.boot()
    rig.run(10)
    assert rig.slab.unpack_counts().tolist() == [[wired.index(name) + 1 for name in SIDE_ELECTRODES]]


def test_lost_part_of_a_sample_discards_only_that_sample(make_rig: Make) -> None:
    """And never mixes two: the counts change with every SYNC."""
    rig = make_kind(make_rig, "norsens-quad404.eds", 1)
    rig.boot()
    seen = set()
    for number in range(200):
        rig.counts[:] = number
        rig.wire.lose = {0x181} if number % 20 == 7 else {0x281} if number % 20 == 13 else set()
        rig.run(5)
        (counts,) = rig.slab.unpack_counts().tolist()
        assert len(set(counts)) == 1
        seen.add(counts[0])
    assert len(seen) >= 200 - 4 * 10
    assert rig.state(1) is NodeState.OPERATIONAL


def unmapped(rig: Any, *numbers: int) -> None:
    """TPDOs that carry nothing, as after power-on."""
    for number in numbers:
        cob_id = rig.node(1).read_object(0x17FF + number, 1)
        rig.node(1).write_object(0x17FF + number, 1, cob_id | 1 << 31, keep=True)
        rig.node(1).write_object(0x19FF + number, 0, 0, keep=True)


@pytest.mark.parametrize("kind", ["feldmann-ai4w.eds", "norsens-quad404.eds"])
def test_channels_in_no_tpdo_are_mapped_over_sdo(make_rig: Make, kind: str) -> None:
    rig = make_kind(make_rig, kind, 1, device={"strict_pdo": True})
    unmapped(rig, *((2,) if kind.startswith("feldmann") else (1, 2)))
    rig.boot()
    rig.run(10)
    assert rig.slab.unpack_counts().tolist() == [list(KINDS[kind][1])]
    rig.node(1).reboot()  # which forgets the mapping
    rig.run(400)
    assert rig.state(1) is NodeState.OPERATIONAL
    assert rig.node(1).state == "OPERATIONAL"


def test_mapping_is_unchanged_if_remapping_is_not_allowed(make_rig: Make) -> None:
    rig = make_kind(make_rig, "feldmann-ai4w.eds", 1, allow_pdo_remapping=False)
    unmapped(rig, 2)
    rig.plug_all()
    rig.start()
    rig.run(200)
    assert rig.state(1) is NodeState.FAULTED
    assert "no TPDO carries 0x6401:01 (16 bit)" in rig.status(1).reason
    assert "TPDO2 has nothing; TPDO1 has 0x6000:01 (8 bit); map them" in rig.status(1).reason
    assert rig.node(1).read_object(0x1A01, 0) == 0


def test_read_only_mapping_is_used_as_it_is_and_never_changed(make_rig: Make) -> None:
    """The other two channels are in a TPDO that the node hasn't got, and it takes no mapping."""
    rig = make_kind(make_rig, "tactor-q16.eds", 1)
    rig.node(1).write_object(0x1A02, 4, 0x20010008, keep=True)
    rig.plug_all()
    rig.start()
    rig.run(300)
    assert rig.state(1) is NodeState.FAULTED
    assert "0x2140:00 (unsigned 16 bit)" in rig.status(1).reason
    assert rig.node(1).read_object(0x1A00, 0) == 4
    writes = [data for can_id, data in rig.wire.sent if can_id == 0x601 and data[0] & 0xE0 == 0x20]
    assert [w for w in writes if w[2] == 0x1A] == []


def test_refused_remapping_is_reported_with_its_object(make_rig: Make) -> None:
    rig = make_kind(make_rig, "feldmann-ai4w.eds", 1)
    unmapped(rig, 2)
    rig.node(1).sdo.fail_write[0x1A01, 1] = 0x06010002
    rig.plug_all()
    rig.start()
    rig.run(200)
    assert rig.state(1) is NodeState.FAULTED
    assert "writing mapping of TPDO2, 0x1A01:01: refused by the node" in rig.status(1).reason


def test_object_that_cannot_be_mapped_is_reported(make_rig: Make) -> None:
    channels = resolve_channels(["0x6401:1", "0x6401:2", "0x6401:3", "0x1017:0:u16"], None)
    rig = make_kind(make_rig, "feldmann-ai4w.eds", 1, channels=channels)
    unmapped(rig, 2)
    rig.plug_all()
    rig.start()
    rig.run(200)
    assert rig.state(1) is NodeState.FAULTED
    assert "writing mapping of TPDO2, 0x1A01:04: refused by the node (Code 0x06040041" in rig.status(1).reason


def test_channel_of_another_width_than_configured_is_a_fault(make_rig: Make) -> None:
    rig = make_kind(make_rig, "hapt24.dcf", 1)
    expected = resolve_channels([f"{text}:i32" for text in objects("hapt24.dcf")], None)
    rig.specs = [rig.spec(1, channels=expected)]
    rig.restart()
    rig.plug_all()
    rig.start()
    rig.run(200)
    assert rig.state(1) is NodeState.FAULTED
    assert (
        "TPDO2 carries 0x8130:03 (32 bit) with 24 bits; write its type, 0x8130:3:i24" in rig.status(1).reason
    )


@pytest.mark.parametrize("strict", [False, True])
def test_a_mapping_may_carry_the_low_bits_of_a_wider_object(
    make_rig: Make, tmp_path: Path, strict: bool
) -> None:
    text = (FOLDER / "hapt24.dcf").read_text()
    wide = tmp_path / "wide.dcf"
    wide.write_text(text.replace("DataType=0x0010", "DataType=0x0004"))
    assert wide.read_text() != text
    channels = resolve_channels([f"0x8130:{number}:i24" for number in (1, 2, 3, 4)], wide)
    assert {channel.bits for channel in channels} == {24}
    device = {"eds": str(wide), "channels": tuple((c.index, c.sub) for c in channels), "strict_pdo": strict}
    rig = make_rig(2, device=device, eds=str(wide), channels=channels)
    rig.counts[:] = KINDS["hapt24.dcf"][1]
    rig.boot()
    rig.run(10)
    assert rig.slab.unpack_counts().tolist() == [list(KINDS["hapt24.dcf"][1])] * 2
    with pytest.raises(EdsError, match="has i32"):
        resolve_channels(["0x8130:1:u24", "0x8130:2", "0x8130:3", "0x8130:4"], wide)


def test_listener_takes_the_mapping_from_the_eds_or_reports_why_not(make_rig: Make) -> None:
    rig = make_kind(make_rig, "hapt24.dcf", 1, role="listener")
    assert rig.master.status()[0].cob_ids == (0x181, 0x281)
    with pytest.raises(EdsError, match="no TPDO carries"):
        make_rig(1, role="listener", eds=str(FOLDER / "hapt24.dcf"))
    with pytest.raises(EdsError, match="more than 64 bits need several PDOs"):
        make_rig(1, role="listener", channels=resolve_channels([f"0x9130:{n}" for n in (1, 2, 3, 4)], None))


@pytest.mark.parametrize(
    ("identifier", "error", "expected"),
    [
        ("0x1C5", ValueError, 'nodes "pad1" and "pad2" both send 0x1C5 by their EDS'),
        ("0x701", EdsError, "TPDO1 has COB-ID 0x701, which CANopen reserves for another service"),
    ],
)
def test_listener_refuses_invalid_identifiers(
    make_rig: Make, tmp_path: Path, identifier: str, error: type[Exception], expected: str
) -> None:
    text = (FOLDER / "noname-4ch.eds").read_text(encoding="latin-1")
    assert "180h+$NODEID" in text
    path = tmp_path / "fixed.eds"
    path.write_text(text.replace("180h+$NODEID", identifier), encoding="latin-1")
    with pytest.raises(error, match=expected):
        make_rig(2, role="listener", eds=str(path))


def test_listener_refuses_a_29_bit_cob_id(make_rig: Make, tmp_path: Path) -> None:
    """Its node would never be operational: handtouch receives 11-bit identifiers."""
    text = (FOLDER / "noname-4ch.eds").read_text(encoding="latin-1")
    path = tmp_path / "extended.eds"
    path.write_text(text.replace("180h+$NODEID", "0x20000181"), encoding="latin-1")
    with pytest.raises(EdsError, match=r"TPDO1 has no 11-bit COB-ID \(0x1800:01 is 0x20000181\)"):
        make_rig(2, role="listener", eds=str(path))


def test_no_rtr_bit_is_kept(make_rig: Make) -> None:
    """Many nodes refuse to change bit 30 of an identifier."""
    rig = make_kind(make_rig, "feldmann-ai4w.eds", 1, device={"strict_pdo": True})
    rig.node(1).write_object(0x1801, 1, 0xC0000281, keep=True)
    rig.boot()
    assert rig.node(1).read_object(0x1801, 1) == 0x40000281


@pytest.mark.parametrize("cob_id", [0x80, 0x81, 0x581, 0x601, 0x701, 0x7E5])
def test_identifier_of_another_service_is_a_fault(make_rig: Make, cob_id: int) -> None:
    """A heartbeat must never be taken for a sample."""
    rig = make_kind(make_rig, "feldmann-ai4w.eds", 1)
    rig.node(1).write_object(0x1801, 1, 1 << 31 | cob_id, keep=True)
    rig.plug_all()
    rig.start()
    rig.run(200)
    assert rig.state(1) is NodeState.FAULTED
    assert (
        f"TPDO2 has COB-ID 0x{cob_id:X}, which CANopen reserves for another service" in rig.status(1).reason
    )


@pytest.mark.parametrize("strict", [False, True])
def test_node_that_cannot_follow_sync_sends_at_the_same_rate_by_event_timer(
    make_rig: Make, tmp_path: Path, strict: bool
) -> None:
    """Its EDS allows no transmission type but 254 and 255; no SYNC is needed."""
    text = shipped.path("handtouch-node.eds").read_text(encoding="utf-8")
    head, tail = text.split("[1801sub2]\n")
    assert "DefaultValue=1\n" in tail
    eds = tmp_path / "events.eds"
    eds.write_text(
        f"{head}[1801sub2]\nLowLimit=254\n" + tail.replace("DefaultValue=1\n", "DefaultValue=255\n", 1)
    )
    rig = make_rig(2, device={"eds": str(eds), "strict_pdo": strict}, event_timer_ms=5)
    rig.syncs = False
    rig.plug_all()
    rig.start()
    events = rig.run(1000)
    assert [rig.state(n) for n in (1, 2)] == [NodeState.OPERATIONAL] * 2
    expected = [e.reason for e in events if "by its event timer" in e.reason]
    assert len(expected) == 2
    assert re.match(r"sends every 5 ms by its event timer, not with SYNC: .*0x1801:02: refused", expected[0])
    before = rig.port.counters.samples
    assert rig.run(1000) == []
    assert rig.port.counters.samples - before == pytest.approx(400, abs=4)
    rig.node(1).reboot()
    rig.run(500)
    assert rig.state(1) is NodeState.OPERATIONAL
