"""EDS files: TPDOs, types, and vendors' deviations."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable
from pathlib import Path

import canopen
import pytest
from canopen.objectdictionary import ODVariable
from canopen.objectdictionary.eds import import_eds
from canopen.sdo import SdoAbortedError
from hypothesis import given
from hypothesis import strategies as st

from handtouch.config import shipped
from handtouch.config.eds import (
    REAL32,
    EdsError,
    TpdoDefault,
    ValueType,
    default_tpdos,
    load_eds,
    value_type,
)
from handtouch.config.eds_file import parse_eds

FILES = sorted((Path(__file__).parent.parent / "data" / "eds").iterdir())
NODE_ID = 5

CURRENTS = tuple((0x6401, sub, 16) for sub in (1, 2, 3, 4))
STATUS, DUMMY_8, DUMMY_16 = (0x2000, 0, 8), (0x0005, 0, 8), (0x0006, 0, 16)
CARRIED = {
    "feldmann-ai4w.eds": (
        TpdoDefault(1, 0x185, True, 255, ((0x6000, 1, 8),)),
        TpdoDefault(2, 0x285, True, 255, CURRENTS),
    ),
    "norsens-quad404.eds": (
        TpdoDefault(1, 0x185, True, 1, ((0x9130, 1, 32), (0x9130, 2, 32))),
        TpdoDefault(2, 0x285, True, 1, ((0x9130, 3, 32), (0x9130, 4, 32))),
    ),
    "tactor-q16.eds": (
        TpdoDefault(1, 0x185, True, 1, (STATUS, (0x2110, 0, 16), DUMMY_8, (0x2120, 0, 16))),
        TpdoDefault(3, 0x385, True, 1, ((0x2130, 0, 16), (0x2001, 0, 8), DUMMY_16, (0x2140, 0, 16))),
    ),
    "hapt24.dcf": (
        TpdoDefault(1, 0x185, True, 1, ((0x8130, 1, 24), (0x8130, 2, 24), (0x6150, 1, 8))),
        TpdoDefault(2, 0x285, True, 1, ((0x8130, 3, 24), (0x8130, 4, 24))),
        TpdoDefault(3, 0x385, False, 254, ((0x6130, 1, 32), (0x6130, 2, 32))),
    ),
    "noname-4ch.eds": (TpdoDefault(1, 0x185, True, 255, CURRENTS),),
    "ambit-f401.eds": (
        TpdoDefault(1, 0x185, True, 255, ((0x6403, 1, 32), (0x6403, 2, 32))),
        TpdoDefault(2, 0x285, True, 255, ((0x6403, 3, 32), (0x6403, 4, 32))),
    ),
    "ambit-f404.eds": (
        TpdoDefault(1, 0x185, True, 255, ((0x6130, 1, 32), (0x6130, 2, 32))),
        TpdoDefault(2, 0x285, True, 255, ((0x6130, 3, 32), (0x6130, 4, 32))),
    ),
}
CHANNELS = {
    "feldmann-ai4w.eds": ([(0x6401, sub) for sub in (1, 2, 3, 4)], ValueType(16)),
    "norsens-quad404.eds": ([(0x9130, sub) for sub in (1, 2, 3, 4)], ValueType(32)),
    "tactor-q16.eds": ([(index, 0) for index in (0x2110, 0x2120, 0x2130, 0x2140)], ValueType(16, False)),
    "hapt24.dcf": ([(0x8130, sub) for sub in (1, 2, 3, 4)], ValueType(24)),
    "noname-4ch.eds": ([(0x6401, sub) for sub in (1, 2, 3, 4)], ValueType(16)),
    "ambit-f401.eds": ([(0x6403, sub) for sub in (1, 2, 3, 4)], REAL32),
    "ambit-f404.eds": ([(0x6130, sub) for sub in (1, 2, 3, 4)], REAL32),
}

OBJECT = "[{}]\nParameterName=x\nDataType={}\nAccessType=rw\nDefaultValue={}\n"


def read(text: str) -> canopen.ObjectDictionary:
    return parse_eds("odd.eds", text.encode(), NODE_ID)


def variables(dictionary: canopen.ObjectDictionary) -> dict[tuple[int, int], ODVariable]:
    found: dict[tuple[int, int], ODVariable] = {}
    for index, item in dictionary.indices.items():
        members = {0: item} if isinstance(item, ODVariable) else item.subindices
        found.update({(index, sub): variable for sub, variable in members.items()})
    return found


def contents(dictionary: canopen.ObjectDictionary) -> dict[tuple[int, int], tuple[object, ...]]:
    return {
        place: (v.name, v.data_type, v.access_type, v.pdo_mappable, v.default, v.value, v.min, v.max)
        for place, v in variables(dictionary).items()
    }


def serve_all(dictionary: canopen.ObjectDictionary) -> int:
    """Return the number of objects of this dictionary that an SDO server returns data for."""
    node = canopen.LocalNode(NODE_ID, dictionary)
    answered = 0
    for index, sub in variables(dictionary):
        with contextlib.suppress(SdoAbortedError):
            node.get_data(index, sub, check_readable=True)
            answered += 1
    return answered


def tpdo(communication: str = "", mapping: str = "", number: int = 1) -> TpdoDefault:
    """A TPDO from lines "sub value" of its two objects."""
    text = OBJECT.format("1000", 7, 0)
    for start, lines in ((0x17FF, communication), (0x19FF, mapping)):
        text += f"[{start + number:04X}]\nObjectType=9\n"
        for line in filter(None, lines.split("\n")):
            sub, _, value = line.strip().partition(" ")
            text += f"[{start + number:04X}sub{sub}]\nDefaultValue={value}\nAccessType=rw\n"
    return default_tpdos(read(text))[0]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_tpdos_are_those_of_the_file(path: Path) -> None:
    assert default_tpdos(load_eds(path, NODE_ID)) == CARRIED[path.name]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_channels_have_the_types_of_the_file(path: Path) -> None:
    dictionary = load_eds(path, NODE_ID)
    places, kind = CHANNELS[path.name]
    assert [value_type(dictionary, *place) for place in places] == [kind] * 4


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_a_node_serves_every_default(path: Path) -> None:
    dictionary = load_eds(path, NODE_ID)
    given_values = [v for v in variables(dictionary).values() if v.value is not None or v.default is not None]
    readable = [v for v in given_values if v.readable]
    assert serve_all(dictionary) == len(readable) >= 19


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_encoding_and_line_ends_change_nothing(path: Path, encoding: str, end: str) -> None:
    raw = path.read_bytes()
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("latin-1")
    if encoding == "utf-16-le":  # without a mark only ASCII survives
        text = text.encode("ascii", "replace").decode()
    lines = text.replace("\r\n", "\n").split("\n")
    same = parse_eds("odd.eds", end.join(lines).encode(encoding), NODE_ID)
    assert contents(same) == contents(parse_eds("odd.eds", "\n".join(lines).encode(), NODE_ID))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
@pytest.mark.parametrize("change", [str.upper, str.lower, str.swapcase])
def test_case_changes_nothing_but_names(path: Path, change: Callable[[str], str]) -> None:
    text = path.read_bytes().decode("latin-1")
    changed = load_eds(path, NODE_ID), read("".join(change(c) if c.isascii() else c for c in text))
    assert contents(changed[0]).keys() == contents(changed[1]).keys()
    assert default_tpdos(changed[0]) == default_tpdos(changed[1])


def test_well_formed_files_read_as_canopen_reads_them() -> None:
    for path in (shipped.path("handtouch-node.eds"), FILES[0].parent / "norsens-quad404.eds"):
        with path.open(encoding="utf-8-sig") as file:
            theirs = import_eds(file, NODE_ID)
        ours = load_eds(path, NODE_ID)
        for place, variable in variables(theirs).items():
            own = variables(ours)[place]
            assert (own.data_type, own.access_type) == (variable.data_type, variable.access_type)
            assert own.default == (None if variable.default == "" else variable.default)
            assert own.name == variable.name
        assert variables(ours).keys() == variables(theirs).keys()


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0x1F", 31),
        ("0X1f", 31),
        ("1Fh", 31),
        ("31", 31),
        ("037", 31),
        ("0000", 0),
        ("0089", 89),  # 8 and 9 are no octal digits
        ("31.0", 31),
        (" 0x1F ; thirty-one", 31),
        ("0x1F;", 31),
        ("31 # x", 31),
        ("0x1F // x", 31),
        ('"0x1F"', 31),
        ("-1", 0xFFFFFFFF),
        ("$NODEID+0x180", 0x185),
        ("$NodeId + 180h", 0x185),
        ("0x180+$NODEID", 0x185),
        ("384 + $nodeid", 0x185),
        ("$NODEID", 5),
        ("0x80000000 + $NODEID + 0x180", 0x80000185),
        ("+5", 5),
        ("NODEID+0x180", 0x185),
        ("$NODE_ID+0x180", 0x185),
        ("", None),
        (" ; none", None),
    ],
)
def test_numbers_are_read_in_all_spellings(text: str, value: int | None) -> None:
    assert read(OBJECT.format("1005", "0x0007", text))[0x1005].default == value


@pytest.mark.parametrize(("text", "value"), [("0xFFFF", -1), ("-32768", -32768), ("0x7FFF", 32767)])
def test_signed_values_may_be_given_as_their_bits(text: str, value: int) -> None:
    assert read(OBJECT.format("6401", 3, text))[0x6401].default == value


def test_values_that_are_no_integers_are_read_in_their_type() -> None:
    values = [
        (8, "0.5", 0.5),
        (9, '"a b"  ; c', "a b"),
        (0xA, "01 fe", b"\1\xfe"),
        (0xB, "Ω", "Ω"),
        (0xC, "1", None),
    ]
    for kind, text, value in values:
        assert read(OBJECT.format("2000", kind, text))[0x2000].default == value
    assert read("[2000]\nObjectType=2\nDefaultValue=01\n")[0x2000].default == b"\1"


@pytest.mark.parametrize(
    ("broken", "line", "what"),
    [
        ("[1018sub1]\nDataType=7\nDefaultValue=abc", 3, 'DefaultValue "abc"'),
        ("[1018sub1]\n\n;\nDataType=7\nDefaultValue=0x100000000", 5, "outside UNSIGNED32"),
        ("[1000]\nParameterName\n", 2, "ParameterName is followed by no"),
        ("[1000]\nDataType 7\n", 2, "DataType is followed by no"),
        ("[1000]\nObjectType=zz\n", 2, 'ObjectType "zz"'),
        ("[1000]\nObjectType=0x77\n", 2, "ObjectType 119"),
        ("[1000]\nDataType=0x999\n", 2, "unknown DataType 0x0999"),
        ("[1000]\n[1000sub100]\n", 2, "sub-index above"),
        ("[1000]\n[1018sub\n", 2, "no closing bracket"),
        ("[1000]\n1018sub0]\n", 2, "no opening bracket"),
        ("[1800sub1]\nDefaultValue=$NODEID*2\n", 2, "neither a number nor"),
        ("[1800sub1]\nDefaultValue=$NODEID+\n", 2, "neither a number nor"),
        ("[1800sub1]\nDefaultValue=$NODEID+$NODEID\n", 2, "neither a number nor"),
        ("[1A00]\nCompactSubObj=many\n", 2, "CompactSubObj"),
        ("[1A00sub1]\nDefaultValue=0x64010110\n[6401sub1]\nParameterName=x\n", 3, "no DataType"),
        ("[1A00sub1]\nDefaultValue=0x64010110\n[6401sub1]\nDataType=?\n", 4, 'DataType "\\?"'),
    ],
)
def test_mistakes_in_needed_objects_name_the_line(broken: str, line: int, what: str) -> None:
    for end in ("\n", "\r\n", "\r"):
        with pytest.raises(EdsError, match=rf"^odd\.eds:{line}: .*{what}.*"):
            read(broken.replace("\n", end))


def test_mistakes_elsewhere_cost_only_the_value() -> None:
    text = OBJECT.format("1000", 7, 1) + OBJECT.format("2001", "?", "?") + OBJECT.format("2002", 5, 256)
    text += OBJECT.format("2003", 8, "1e99") + OBJECT.format("2004", 0xF, "no hex")
    text += "[2005]\nAccessType=secret\nLowLimit=a\nDataType=0x0003\nHighLimit=0x8000\n[2006]\nSubNumber=x\n"
    text += "[2007]\nDefaultValue\n[2008subFFF]\nDataType=5\n" + OBJECT.format("2009", 9, "Gerät")
    dictionary = read(text)
    found = variables(dictionary)
    assert [found[0x2000 + n, 0].default for n in range(1, 8)] == [None] * 7
    assert found[0x2005, 0].access_type == "rw"
    assert (found[0x2005, 0].min, found[0x2005, 0].max) == (None, -32768)
    assert 0x2008 not in dictionary
    assert serve_all(dictionary) == 2  # strings go out as ASCII


def test_how_objects_may_be_accessed_is_asked_of_the_node_not_of_the_file() -> None:
    text = Path(shipped.path("handtouch-node.eds")).read_text()
    odd = read(re.sub("AccessType=.*", "AccessType=UNKNOWN", text))
    assert [t.entries for t in default_tpdos(odd)] == [t.entries for t in default_tpdos(read(text))]
    assert {variable.access_type for variable in variables(odd).values()} == {"rw"}


def test_defaults_of_channels_need_not_fit_their_type() -> None:
    dictionary = read("[1A00sub1]\nDefaultValue=0x64010110\n[6401sub1]\nDataType=3\nDefaultValue=99999\n")
    assert dictionary[0x6401][1].default is None
    assert value_type(dictionary, 0x6401, 1) == ValueType(16)


def test_of_keys_and_sections_that_come_twice_the_first_counts() -> None:
    text = "[1000]\nDataType=7\nDefaultValue=1\nDefaultValue=2\n[1018SUB01]\nDataType=7\nDefaultValue=3\n"
    dictionary = read(text + "[1018sub1]\nDataType=5\nDefaultValue=4\nParameterName=later\n")
    assert dictionary[0x1000].default == 1
    assert (dictionary[0x1018][1].default, dictionary[0x1018][1].data_type) == (3, 7)
    assert dictionary[0x1018][1].name != "later"


def test_sub_objects_without_their_object_make_one() -> None:
    dictionary = read("[1018sub1]\nDataType=7\nDefaultValue=9\n[2022sub2]\nDataType=5\nDefaultValue=8\n")
    assert dictionary[0x1018][1].default == 9
    assert dictionary[0x2022][2].default == 8
    assert serve_all(dictionary) == 2


def test_types_left_out_of_communication_objects_are_those_of_cia_301() -> None:
    names = ["1000", "1001", "1008", "1017", "1018sub0", "1018sub1", "1800sub1", "1800sub2", "1800sub3"]
    dictionary = read("".join(f"[{name}]\n" for name in [*names, "1A00sub0", "1A00sub1", "2000sub0"]))
    kinds = [variable.data_type for variable in variables(dictionary).values()]
    assert sorted(kinds) == sorted([7, 5, 9, 6, 5, 7, 7, 5, 6, 5, 7, 5])


def test_types_of_canfestival_are_found_in_their_own_object() -> None:
    text = "[A0]\nObjectType=7\n[A0sub1]\nDataType=5\nDefaultValue=0x03\n[A0sub2]\nDataType=3\n"
    assert value_type(read(text + OBJECT.format("2000", "0x00A0", 0)), 0x2000, 0) == ValueType(16)


def test_compact_objects_have_all_their_members() -> None:
    text = "[1A00]\nObjectType=9\nDataType=7\nAccessType=rw\nCompactSubObj=3\nParameterName=map\n"
    text += "[1A00Value]\nNrOfEntries=2\n1=0x64010110\n2=0x00050008\n[1A00Name]\n2=gap\n"
    text += "[1800]\n[6401sub1]\nDataType=3\n"
    dictionary = read(text)
    assert [dictionary[0x1A00][sub].name for sub in (1, 2, 3)] == ["map 1", "gap", "map 3"]
    assert default_tpdos(dictionary)[0].entries == ((0x6401, 1, 16), (5, 0, 8))
    assert 5 in dictionary  # a PDO with gaps can't be served without
    big = read("[1000]\n[2000]\nObjectType=8\nDataType=5\nCompactSubObj=255\n[2000sub3]\nDataType=6\n")
    assert len(big[0x2000]) == 255
    assert value_type(big, 0x2000, 3) == ValueType(16, False)


def test_values_of_a_dcf_count_before_defaults() -> None:
    assert default_tpdos(read("[1800sub2]\nDefaultValue=255\nParameterValue=1\n"))[0].transmission_type == 1
    assert default_tpdos(read("[1800sub2]\nDefaultValue=255\nParameterValue=\n"))[0].transmission_type == 255


def test_cob_ids() -> None:
    assert tpdo("1 0x80000185").enabled is False
    assert tpdo("1 0x80000185").cob_id == 0x185
    assert tpdo("1 0x40000185").enabled is True  # no remote requests
    assert tpdo("1 0x20000185").enabled is False  # 29 bits
    assert (tpdo("1 0xE0012345").extended_cob_id, tpdo("1 0x185").extended_cob_id) == (0x20012345, 0)
    assert tpdo("1 0").enabled is False
    assert tpdo("1 0x180").cob_id == 0x185  # the firmware adds the node id
    assert tpdo("1 ", number=2).cob_id == tpdo("", number=2).cob_id == 0x285  # predefined connection set
    assert tpdo("", number=2).enabled is True
    assert (tpdo("", number=5).cob_id, tpdo("", number=5).enabled) == (0, False)
    assert tpdo("1 $NODEID+0x6A0", number=512) == TpdoDefault(512, 0x6A5, True, 255, ())


@pytest.mark.parametrize(
    ("mapping", "carried"),
    [
        ("", ()),
        ("0 0\n1 0x60000108", ()),
        ("0 1\n1 0x60000108\n2 0x60000208", ((0x6000, 1, 8),)),
        ("0 \n1 0x60000108\n2 0x60000208", ((0x6000, 1, 8), (0x6000, 2, 8))),
        ("0 3\n1 0x60000108\n2 \n3 0x60000308", ((0x6000, 1, 8),)),  # the position of the third is unknown
        ("0 254\n1 0x60000108", ()),  # multiplexed
        ("1 0xFFFFFFFF", ((0xFFFF, 255, 255),)),
    ],
)
def test_mapping_entries(mapping: str, carried: tuple[tuple[int, int, int], ...]) -> None:
    assert tpdo(mapping=mapping).entries == carried


def test_number_types_are_all_known_and_others_named() -> None:
    kinds = {0x02: 8, 0x03: 16, 0x10: 24, 0x04: 32, 0x12: 40, 0x13: 48, 0x14: 56, 0x15: 64}
    plain = {0x05: 8, 0x06: 16, 0x16: 24, 0x07: 32, 0x18: 40, 0x19: 48, 0x1A: 56, 0x1B: 64}
    for signed, table in ((True, kinds), (False, plain)):
        for kind, bits in table.items():
            assert value_type(read(OBJECT.format("2000", kind, 0)), 0x2000, 0) == ValueType(bits, signed)
    assert value_type(read(OBJECT.format("2000", 8, 0.5)), 0x2000, 0) == REAL32
    for kind, name in ((0x11, "REAL64"), (1, "BOOLEAN"), (9, "VISIBLE_STRING")):
        with pytest.raises(EdsError, match=rf':\d+: object 0x2000 sub 0 "x" is {name}'):
            value_type(read(OBJECT.format("2000", kind, "")), 0x2000, 0)
    array = read("[2000]\nObjectType=8\n[2000sub1]\nDataType=3\n[3000]\nDataType=3\n")
    absent = [(0x2000, 2), (0x3000, 1), (0x4000, 0)]
    assert [value_type(array, *place) for place in absent] == [None, None, None]


def test_a_tpdo_without_mapping_can_be_served() -> None:
    assert (
        serve_all(read("[1800sub1]\nDefaultValue=0x181\n[1400sub1]\nDataType=7\nDefaultValue=0x201\n")) == 2
    )


@pytest.mark.parametrize(
    "raw", [b"", b"no section\n", b"\x00\xff\xfe", b"[FileInfo]\nFileName=x\n", b"PK\3\4"]
)
def test_files_without_objects_are_named(tmp_path: Path, raw: bytes) -> None:
    path = tmp_path / "odd.eds"
    path.write_bytes(raw)
    with pytest.raises(EdsError, match=r"odd\.eds: has no objects"):
        load_eds(path, NODE_ID)


def test_files_that_cannot_be_opened_are_named(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "absent.eds", tmp_path / "a\0.eds"):
        with pytest.raises(EdsError, match=tmp_path.name):
            load_eds(path, NODE_ID)


@st.composite
def mangled(draw: st.DrawFn) -> bytes:
    """A test file with lines dropped, doubled, moved, cut, in other case, and bytes changed or put in."""
    raw = draw(st.sampled_from([path.read_bytes() for path in FILES]))
    for _ in range(draw(st.integers(1, 12))):
        lines = raw.split(b"\n")
        start = draw(st.integers(0, len(lines) - 1))
        line = lines[start]
        place = draw(st.integers(0, len(line)))
        stuff = draw(
            st.binary(max_size=6) | st.sampled_from([b"=", b"[", b"]", b";", b"$NODEID", b"0x", b"\r"])
        )
        end = start + draw(st.integers(1, 40))
        change: list[bytes] = draw(
            st.sampled_from(
                [
                    [],
                    [line, line],
                    [line.swapcase()],
                    [line[:place]],
                    [line[place:]],
                    [line[:place] + stuff + line[place:]],
                    [line[:place] + stuff + line[place + len(stuff) :]],
                    lines[end : end + 5],
                ]
            )
        )
        lines[start : start + 1] = change
        if draw(st.integers(0, 9)) == 0:
            del lines[start:end]
        raw = b"\n".join(lines)
    return raw


@given(mangled())
def test_a_mangled_file_loads_or_is_named(raw: bytes) -> None:
    try:
        dictionary = parse_eds("odd.eds", raw, NODE_ID)
    except EdsError as error:
        assert str(error).startswith("odd.eds:")  # noqa: PT017 - most files load
        return
    serve_all(dictionary)
    for found in default_tpdos(dictionary):
        assert 0 <= found.cob_id < 0x800
        for index, sub, _ in found.entries:
            with contextlib.suppress(EdsError):
                value_type(dictionary, index, sub)


@pytest.mark.parametrize("start", ["<?xml version='1.0'?>\n<ISO15745Profile>", "\ufeff\n <ISO15745Profile>"])
def test_an_xdd_file_is_named_as_such(start: str) -> None:
    with pytest.raises(EdsError, match=r"^pad\.xdd: .*XDD isn't read; export an EDS$"):
        parse_eds("pad.xdd", start.encode(), NODE_ID)


def test_a_key_without_equals_sign_is_one_message_with_one_line() -> None:
    with pytest.raises(EdsError, match=r'^[^:]*:2: DataType is followed by no "="; add it$'):
        read("[1000]\nDataType 7\n")
