"""Objects of the four channels, and error texts for unsuitable ones."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import pytest

from handtouch.config import parse, shipped
from handtouch.config.channels import (
    STANDARD_CHANNELS,
    Channel,
    node_channels,
    order_by_electrode,
    parse_object,
    parse_writable_object,
    resolve_channels,
)
from handtouch.config.eds import REAL32, EdsError, ValueType
from handtouch.config.tables import SIDE_ELECTRODES
from tests.deployments import deployment_text, pad_text

FOLDER = Path(__file__).parent.parent / "data" / "eds"
FLOATS = ("0x6403:1", "0x6403:2", "0x6403:3", "0x6403:4")
TACTOR = ("0x2110:0", "0x2120:0", "0x2130:0", "0x2140:0")


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("0x6401:1", (0x6401, 1, None, None)),
        ("0x2001:0:u24", (0x2001, 0, ValueType(24, False), None)),
        ("0x2001:0xFE:i32", (0x2001, 254, ValueType(32), None)),
        ("0xABCD:17:u8", (0xABCD, 17, ValueType(8, False), None)),
        ("0x6401:5:i12", (0x6401, 5, ValueType(12), None)),
        ("0x6403:1:f32/1000", (0x6403, 1, REAL32, 1000.0)),
        ("0x6403:1:f32/2.5e-3", (0x6403, 1, REAL32, 0.0025)),
    ],
)
def test_objects_are_written_as_index_sub_and_type(text: str, found: object) -> None:
    assert parse_object(text) == found


@pytest.mark.parametrize(
    "text",
    [
        "",
        "6401:1",
        "0x6401",
        "0x6401:255",
        "0x6401:1:u7",
        "0x6401:1:u33",
        "0x6401:1:f32",
        "0x0000:1",
        "0x64010:1",
        "0x6401:-1",
    ],
)
def test_other_forms_are_refused_with_an_example(text: str) -> None:
    with pytest.raises(EdsError, match=r'is no object; write INDEX:SUB such as "0x6401:1"'):
        parse_object(text)


@pytest.mark.parametrize(
    ("objects", "eds", "bits", "signed"),
    [
        (("0x6401:1", "0x6401:2", "0x6401:3", "0x6401:4"), None, 16, True),
        (("0x9130:1", "0x9130:2", "0x9130:3", "0x9130:4"), None, 32, True),
        (("0x8130:1", "0x8130:2", "0x8130:3", "0x8130:4"), "hapt24.dcf", 24, True),
        (TACTOR, "tactor-q16.eds", 16, False),
        (tuple(f"{text}:u16" for text in TACTOR), None, 16, False),
    ],
)
def test_types_come_from_the_text_the_eds_or_the_profile(
    objects: tuple[str, ...], eds: str | None, bits: int, signed: bool
) -> None:
    found = resolve_channels(objects, FOLDER / eds if eds else None)
    assert {(channel.bits, channel.signed) for channel in found} == {(bits, signed)}


@pytest.mark.parametrize(
    ("objects", "eds", "expected"),
    [
        (TACTOR, None, r'"0x2110:0": its type is unknown; give the EDS, or the type: "0x2110:0:i16"'),
        (("0x2110:0:i16", *TACTOR[1:]), "tactor-q16.eds", "has u16; leave the type out"),
        (("0x2999:0", *TACTOR[1:]), "tactor-q16.eds", "has no such object"),
        (("0x2110:0", "0x2110:0", *TACTOR[2:]), "tactor-q16.eds", '"0x2110:0" is given twice'),
        (FLOATS, None, '"0x6403:1" is REAL32; add its counts per unit: "0x6403:1:f32/1000"'),
        (FLOATS, "ambit-f401.eds", '"0x6403:1" is REAL32; add its counts per unit'),
        (tuple(f"{text}:i32" for text in FLOATS), "ambit-f401.eds", "has f32; leave the type out"),
        (("0x6403:1:f32/0", *FLOATS[1:]), None, "the counts per unit must be above 0"),
    ],
)
def test_channels_that_cannot_be_are_named_with_a_remedy(
    objects: tuple[str, ...], eds: str | None, expected: str
) -> None:
    with pytest.raises(EdsError, match=expected):
        resolve_channels(objects, FOLDER / eds if eds else None)


def test_real32_channels_have_their_counts_per_unit() -> None:
    found = resolve_channels([f"{text}:f32/1000" for text in FLOATS], FOLDER / "ambit-f401.eds")
    assert found[3] == Channel(0x6403, 4, 32, True, 1000.0)


def test_order_of_electrodes_is_that_of_the_pad_whatever_the_wiring() -> None:
    pad = parse(deployment_text(pad_text("plane", 1))).pads[0].pad
    for wired in itertools.permutations(SIDE_ELECTRODES):
        ordered = order_by_electrode(STANDARD_CHANNELS, pad.model_copy(update={"electrodes": wired}))
        assert [wired[channel.sub - 1] for channel in ordered] == list(SIDE_ELECTRODES)


def test_written_objects_need_their_type() -> None:
    assert parse_writable_object("0x2100:0:u8").size_bytes == 1
    with pytest.raises(EdsError, match=r'its type is missing; add it: "0x2100:0:u8"'):
        parse_writable_object("0x2100:0")
    with pytest.raises(EdsError, match="is REAL32; only integers are written"):
        parse_writable_object("0x6429:1:f32/1000")
    with pytest.raises(EdsError, match="has 12 bits; objects of 8, 16, 24 and 32 bits are written"):
        parse_writable_object("0x2100:0:u12")


def test_shipped_node_is_the_standard_one() -> None:
    found = resolve_channels(
        ("0x6401:1", "0x6401:2", "0x6401:3", "0x6401:4"), shipped.path("handtouch-node.eds")
    )
    assert found == STANDARD_CHANNELS


def test_channel_text_has_address_and_type() -> None:
    assert str(Channel(0x2110, 0, 24, False)) == "0x2110:00 (unsigned 24 bit)"
    assert str(Channel(0x6401, 4)) == "0x6401:04 (16 bit)"
    assert str(Channel(0x6403, 4, 32, counts_per_unit=10.0)) == "0x6403:04 (REAL32)"


@pytest.mark.parametrize(
    ("kind", "keys", "limits", "saturation"),
    [
        ("i16", {}, (-32768, 32767), (-32767, 32767)),
        ("u16", {}, (0, 65535), (-math.inf, 65535)),
        ("u8", {}, (0, 255), (-math.inf, 255)),
        ("i16", {"full_scale_counts": 4095}, (-4096, 4095), (-4095, 4095)),
        ("u16", {"full_scale_counts": 4096}, (0, 4095), (-math.inf, 4095)),
        ("i16", {"full_scale_counts": 4000}, (-32768, 32767), (-32767, 32767)),
        ("i16", {"full_scale_counts": 4000, "max_count": 4095}, (-4096, 4095), (-4095, 4095)),
        ("i16", {"full_scale_counts": 4095, "max_count": 32767}, (-32768, 32767), (-32767, 32767)),
        ("f32/10", {"full_scale_counts": 4095}, (-(2**31), 2**31 - 1), (-(2**31) + 1, 2**31 - 1)),
        ("f32/10", {"full_scale_counts": 4095, "max_count": 4095}, (-4096, 4095), (-4095, 4095)),
    ],
)
def test_channel_ends_where_its_converter_does(
    kind: str, keys: dict[str, int], limits: tuple[int, int], saturation: tuple[float, float]
) -> None:
    channels = ", ".join(f'"0x2000:{sub}:{kind}"' for sub in range(1, 5))
    lines = "".join(f"{key} = {value}\n" for key, value in keys.items())
    text = deployment_text(pad_text("plane", 1)).replace(
        "[node.n]\n", f"[node.n]\nchannels = [{channels}]\n{lines}"
    )
    for channel in node_channels(parse(text).nodes["n"]):
        assert (channel.limits, channel.saturation) == (limits, saturation)
