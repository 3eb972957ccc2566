"""Parser of EDS and DCF files (CiA 306), tolerant of vendors' deviations, into `canopen`'s object dictionary.

Public names: `parse_eds`, `EdsError`, `EdsVariable`; `mapping_entries`, `raw_value` and `variable_at` look
into a dictionary; `TPDO_INDICES`, `TPDO_MAPPING_INDICES`, `INTEGER_TYPES`, `TYPE_NAMES`.

Read strictly are the objects that the master uses: 0x1000 to 0x1018, TPDOs and what these carry. A mistake
there is an error that names the line; elsewhere what can't be understood is left out and logged. The parser
of `canopen` stops at the first of either and knows no lines.
"""

from __future__ import annotations

import codecs
import logging
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from canopen import ObjectDictionary
from canopen.objectdictionary import ODArray, ODRecord, ODVariable, datatypes

_COMMUNICATION_INDICES, TPDO_INDICES, TPDO_MAPPING_INDICES = (
    range(0x1000, 0x1019),
    range(0x1800, 0x1A00),
    range(0x1A00, 0x1C00),
)
_RPDO_INDICES, _MAPPING_OFFSET = range(0x1400, 0x1600), 0x200
_DOMAIN, _VARIABLE, _ARRAY, _OBJECT_TYPES, _GROUPS = 2, 7, 8, (2, 5, 6, 7, 8, 9), (6, 8, 9)
_ACCESS_TYPES = ("ro", "wo", "rw", "rwr", "rww", "const")
_DUMMY_TYPES = range(1, 8)
INTEGER_TYPES = {
    kind: (8 * ODVariable.STRUCT_TYPES[kind].size, kind in datatypes.SIGNED_TYPES)
    for kind in datatypes.INTEGER_TYPES
}
TYPE_NAMES = {kind: name for name, kind in vars(datatypes).items() if isinstance(kind, int) and kind < 0x20}

# CiA 301's types, for files that leave them out
_U8, _U16, _U32 = datatypes.UNSIGNED8, datatypes.UNSIGNED16, datatypes.UNSIGNED32
_DEFAULT_TYPES = dict.fromkeys(_COMMUNICATION_INDICES, _U32) | {
    **dict.fromkeys((0x1001, 0x100D), _U8),
    **dict.fromkeys((0x100C, 0x1015, 0x1017), _U16),
    **dict.fromkeys((0x1008, 0x1009, 0x100A), datatypes.VISIBLE_STRING),
}
_PDO_TYPES = {0: _U8, 1: _U32, 2: _U8, 3: _U16, 4: _U8, 5: _U16, 6: _U8}

_ADDRESS_PATTERN = re.compile(r"(?:0x)?([0-9a-f]{1,4})(?:sub([0-9a-f]{1,3})|(name|value))?", re.ASCII)
_NODE_ID_PATTERN = re.compile(r"\$?node_?id", re.ASCII)
_LITERAL_PATTERN = re.compile(
    r"(-?)(?:0x([0-9a-f]{1,16})|([0-9][0-9a-f]{0,15})h|0([0-7]{1,21})|([0-9]{1,20})(?:\.0*)?)", re.ASCII
)
_KEYS = ("parametername", "objecttype", "datatype", "accesstype", "defaultvalue", "parametervalue")

_log = logging.getLogger(__name__)


class EdsError(ValueError):
    """An EDS can't be used; `str` is "file:line: problem; remedy", the line where known."""

    exit_status = 2


class EdsVariable(ODVariable):  # type: ignore[misc]  # canopen is untyped
    """Variable of a file; `location` is "file:line" of its type."""

    def __init__(self, name: str, index: int, sub: int, location: str) -> None:
        super().__init__(name, index, sub)
        self.location = location


def parse_eds(path: str, raw: bytes, node_id: int) -> ObjectDictionary:
    """Parse a file's bytes into an object dictionary; `path` is for messages. Raises EdsError."""
    text = _decode(raw)
    if text.lstrip().startswith("<"):
        raise EdsError(f"{path}: is XML, as XDD and XDC files (CiA 311) are; XDD isn't read; export an EDS")
    return _EdsReader(path, node_id, text).build_dictionary()


def mapping_entries(dictionary: ObjectDictionary, mapping: int) -> Iterator[tuple[int, int, int]]:
    """Yield (index, sub-index, bits) of a mapping object, up to the first empty entry."""
    count = raw_value(dictionary, mapping, 0)
    for sub in range(1, 65 if count is None else count + 1 if count <= 64 else 1):  # 254, 255: no plain PDO
        entry = raw_value(dictionary, mapping, sub)
        if not entry:
            return
        yield entry >> 16, entry >> 8 & 0xFF, entry & 0xFF


def variable_at(dictionary: ObjectDictionary, index: int, sub: int) -> Any:
    """Return the ODVariable described in the file, or None; ODArray itself would make one up."""
    found: Any = dictionary.indices.get(index)
    if isinstance(found, ODVariable):
        return None if sub else found
    return None if found is None else found.subindices.get(sub)


def raw_value(dictionary: ObjectDictionary, index: int, sub: int) -> int | None:
    """Return the integer value of an object after power-on; None if the file has none."""
    variable = variable_at(dictionary, index, sub)
    if variable is None:
        return None
    value = variable.default if variable.value is None else variable.value
    return value if isinstance(value, int) else None


def _decode(raw: bytes) -> str:
    if raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return raw.decode("utf-16", "replace")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("latin-1")
    return text.replace("\0", "")  # UTF-16 without a byte order mark: all relevant text is ASCII


@dataclass(slots=True)
class _EdsSection:
    """Lower-case keys without spaces -> line and text; the text is None if the line has no "="."""

    line: int
    values: dict[str, tuple[int, str | None]] = field(default_factory=dict)

    def get(self, key: str) -> tuple[int, str | None]:
        return self.values.get(key.lower(), (self.line, ""))


class _EdsReader:
    """Reader of one file into an ObjectDictionary."""

    def __init__(self, path: str, node_id: int, text: str) -> None:
        self._path = path
        self._node_id = node_id
        self._sections: dict[str, _EdsSection] = {}
        self._objects: dict[
            int, dict[int, _EdsSection]
        ] = {}  # by index and sub-index; -1 is the object itself
        self._mapped: set[int] = set()
        section = _EdsSection(0)
        for line, content in enumerate(re.split(r"\r\n|\r|\n", text), 1):
            section = self._parse_line(line, content.strip(), section)
        if not self._objects:
            raise EdsError(f"{path}: has no objects, sections such as [1000]; is it an EDS?")

    def _parse_line(self, line: int, content: str, section: _EdsSection) -> _EdsSection:
        """Parse one line; return the section of the next one."""
        if not content or content[0] in ";#":
            return section
        if content[0] == "[":
            if "]" not in content:
                raise self._error(line, f'section "{content}" has no closing bracket; add it')
            return self._open_section(line, content[1 : content.index("]")])
        key, equals, value = content.partition("=")
        word = re.match(r"\w*", content)[0].lower()  # type: ignore[index]  # matches anything
        if equals:
            self._store_first(section.values, _normalise(key), (line, value), line)
        elif _ADDRESS_PATTERN.fullmatch(_normalise(content).rstrip("]")) and content[-1] == "]":
            raise self._error(line, f'section "{content}" has no opening bracket; add it')
        elif word in _KEYS:
            self._store_first(section.values, word, (line, None), line)
        return section

    def _open_section(self, line: int, title: str) -> _EdsSection:
        name, section = _normalise(title), _EdsSection(line)
        address = _ADDRESS_PATTERN.fullmatch(name)
        if address is None:
            self._store_first(self._sections, name, section, line)
            return section
        index, sub, list_of = int(address[1], 16), int(address[2] or "0", 16), address[3]
        if list_of:
            self._store_first(self._sections, f"{index:04x}{list_of}", section, line)
        elif sub > 0xFF:
            self._report_problem(
                line, f"[{title}] has a sub-index above 0xFF; correct it", self._is_required(index)
            )
        else:
            self._store_first(self._objects.setdefault(index, {}), sub if address[2] else -1, section, line)
        return section

    def _store_first(self, table: dict[Any, Any], key: Any, value: Any, line: int) -> None:
        if table.setdefault(key, value) is not value:
            self._report_problem(line, f"{key} comes twice; the first one is used", strict=False)

    def build_dictionary(self) -> ObjectDictionary:
        result = ObjectDictionary()
        result.node_id = self._node_id
        for index in self._objects:  # mappings first: the objects they refer to are read strictly
            if index in TPDO_MAPPING_INDICES:
                result.add_object(self._build_object(index))
                self._mapped |= {entry[0] for entry in mapping_entries(result, index)}
        for index in self._objects:
            if index not in TPDO_MAPPING_INDICES:
                result.add_object(self._build_object(index))
        for index in (*_RPDO_INDICES, *TPDO_INDICES):  # canopen looks for a mapping wherever there is a PDO
            if index in result and index + _MAPPING_OFFSET not in result:
                result.add_object(ODRecord(f"0x{index + _MAPPING_OFFSET:04X}", index + _MAPPING_OFFSET))
        usage = self._sections.get("dummyusage", _EdsSection(0))
        for kind in _DUMMY_TYPES:
            if kind in self._mapped or self._parse_number(usage, f"dummy{kind:04d}", strict=False):
                dummy = EdsVariable(f"Dummy{kind:04d}", kind, 0, self._path)
                dummy.data_type, dummy.access_type = kind, "const"
                result.add_object(dummy)
        return result

    def _build_object(self, index: int) -> ODVariable | ODRecord | ODArray:
        subs = dict(self._objects[index])
        head = subs.pop(-1, None) or _EdsSection(next(iter(self._objects[index].values())).line)
        strict = self._is_required(index)
        name = self._get_text(head, "ParameterName", strict) or f"0x{index:04X}"
        kind = self._parse_number(head, "ObjectType", strict) or (9 if subs else _VARIABLE)
        if kind not in _OBJECT_TYPES:
            line = head.get("ObjectType")[0]
            self._report_problem(line, f"ObjectType {kind} is none of CiA 306; correct it", strict)
        count = self._parse_number(head, "CompactSubObj", strict) or 0
        if not (subs or count or kind in _GROUPS or index in TPDO_INDICES or index in TPDO_MAPPING_INDICES):
            return self._build_variable(index, 0, head, name)
        group = ODArray(name, index) if kind == _ARRAY else ODRecord(name, index)
        for variable in self._build_compact_members(index, count, head, name):
            group.add_member(variable)
        for sub, section in sorted(subs.items()):
            own = self._get_text(section, "ParameterName", strict) or f"{name} {sub}"
            group.add_member(self._build_variable(index, sub, section, own, grouped=True))
        return group

    def _build_compact_members(
        self, index: int, count: int, head: _EdsSection, name: str
    ) -> Iterator[ODVariable]:
        """Yield the members of an object with CompactSubObj, with their own names and values."""
        if not count:
            return
        size = ODVariable("Number of entries", index, 0)
        size.data_type, size.access_type, size.default = _U8, "ro", min(count, 254)
        yield size
        names, values = (
            self._sections.get(f"{index:04x}{what}", _EdsSection(0)) for what in ("name", "value")
        )
        for sub in range(1, min(count, 254) + 1):
            own = self._get_text(names, str(sub), strict=False) or f"{name} {sub}"
            variable = self._build_variable(index, sub, head, own, grouped=True)
            if str(sub) in values.values:
                variable.value = self._parse_value(
                    values, str(sub), variable.data_type, self._is_required(index)
                )
            yield variable

    def _build_variable(
        self, index: int, sub: int, section: _EdsSection, name: str, *, grouped: bool = False
    ) -> ODVariable:
        strict = self._is_required(index)
        values_matter = strict and index not in self._mapped
        result = EdsVariable(name, index, sub, f"{self._path}:{section.get('DataType')[0]}")
        result.data_type = self._parse_type(index, sub, section, grouped=grouped)
        result.access_type = self._parse_access(section)
        result.pdo_mappable = bool(self._parse_number(section, "PDOMapping", strict=False))
        result.default = self._parse_value(section, "DefaultValue", result.data_type, values_matter)
        result.value = self._parse_value(section, "ParameterValue", result.data_type, values_matter)
        if result.data_type in INTEGER_TYPES:
            result.min = self._parse_value(section, "LowLimit", result.data_type, strict=False)
            result.max = self._parse_value(section, "HighLimit", result.data_type, strict=False)
        return result

    def _parse_type(self, index: int, sub: int, section: _EdsSection, *, grouped: bool) -> int:
        strict = self._is_required(index)
        kind: int | None = self._parse_number(section, "DataType", strict)
        if kind is None:
            if grouped and sub == 0:
                kind = _U8
            elif index in TPDO_INDICES:
                kind = _PDO_TYPES.get(sub)
            elif self._parse_number(section, "ObjectType", strict=False) == _DOMAIN:
                kind = datatypes.DOMAIN
            else:
                kind = _U32 if index in TPDO_MAPPING_INDICES else _DEFAULT_TYPES.get(index)
        elif kind not in TYPE_NAMES and kind in self._objects:  # CANFestival: its type is in [A0sub1]
            own = self._objects[kind].get(1)
            kind = (own and self._parse_number(own, "DefaultValue", strict)) or kind
        if kind in TYPE_NAMES:
            return int(kind)
        line = section.get("DataType")[0]
        what = "no DataType" if kind is None else f"unknown DataType 0x{kind:04X}"
        self._report_problem(line, f"object 0x{index:04X} sub {sub} has {what}; correct it", strict)
        return int(datatypes.DOMAIN)  # its data are bytes

    def _parse_access(self, section: _EdsSection) -> str:
        """Return how an object may be accessed; "rw" if that isn't understood: the node decides."""
        text = re.sub("[^a-z]", "", _strip_comment(self._get_text(section, "AccessType", False)).lower())
        if text and text not in _ACCESS_TYPES:
            line = section.get("AccessType")[0]
            self._report_problem(
                line, f"AccessType {text} is none of {', '.join(_ACCESS_TYPES)}", strict=False
            )
        return text if text in _ACCESS_TYPES else "rw"

    def _parse_value(self, section: _EdsSection, key: str, kind: int, strict: bool) -> Any:
        """Return a key's value in an object's type; None if it is missing or, unless `strict`, invalid."""
        text = self._get_text(section, key, strict)
        try:
            if kind in INTEGER_TYPES or kind == datatypes.BOOLEAN:
                number = _parse_integer(text, self._node_id)
                return None if number is None else _wrap_integer(number, kind)
            return _parse_non_integer(text, kind) if text else None
        except (ValueError, OverflowError) as error:
            self._report_problem(section.get(key)[0], f"{key} {error}; correct it or leave it empty", strict)
            return None

    def _parse_number(self, section: _EdsSection, key: str, strict: bool) -> int | None:
        text = self._get_text(section, key, strict)
        try:
            return _parse_integer(text, self._node_id)
        except ValueError as error:
            self._report_problem(section.get(key)[0], f"{key} {error}; correct it or leave it empty", strict)
            return None

    def _get_text(self, section: _EdsSection, key: str, strict: bool) -> str:
        """Return a value without comment and quotation marks; "" if there is none."""
        line, text = section.get(key)
        if text is None:
            self._report_problem(line, f'{key} is followed by no "="; add it', strict)
            return ""
        plain = re.split(r"(?:^|\s);", text)[0].strip()
        return plain[1:-1] if len(plain) > 1 and plain[0] == plain[-1] == '"' else plain

    def _is_required(self, index: int) -> bool:
        return any(
            index in these
            for these in (_COMMUNICATION_INDICES, TPDO_INDICES, TPDO_MAPPING_INDICES, self._mapped)
        )

    def _report_problem(self, line: int, what: str, strict: bool) -> None:
        if strict:
            raise self._error(line, what)
        _log.debug("%s:%d: %s; left out", self._path, line, what)

    def _error(self, line: int, what: str) -> EdsError:
        return EdsError(f"{self._path}:{line}: {what}")


def _strip_comment(text: str) -> str:
    return re.split(r"[;#]|//", text)[0]


def _normalise(text: str) -> str:
    return "".join(text.split()).lower()


def _parse_integer(text: str, node_id: int) -> int | None:
    """Parse an integer as in C, in hex with a final h, or as a sum with $NODEID; None if empty."""
    plain = _normalise(_strip_comment(text))
    if not plain:
        return None
    terms = plain.removeprefix("+").split("+")
    numbers = [_parse_literal(term) for term in terms if not _NODE_ID_PATTERN.fullmatch(term)]
    node_ids = len(terms) - len(numbers)
    if None in numbers or node_ids > 1:
        raise ValueError(f'"{text}" is neither a number nor $NODEID+number')
    return sum(number for number in numbers if number is not None) + node_ids * node_id


def _parse_literal(text: str) -> int | None:
    found = _LITERAL_PATTERN.fullmatch(text)
    if not found:
        return None
    sign, *groups = found.groups()
    digits, base = next((g, b) for g, b in zip(groups, (16, 16, 8, 10), strict=True) if g)
    return int(sign + digits, base)


def _wrap_integer(number: int, kind: int) -> int:
    """Wrap a number into a type; a signed one may be given as bits (0xFFFF for -1), an unsigned one as -1."""
    bits, signed = INTEGER_TYPES.get(kind, (1, False))
    if not -(1 << (bits - 1)) <= number < 1 << bits:
        raise ValueError(f"{number} is outside {TYPE_NAMES[kind]}")
    number &= (1 << bits) - 1
    return number - (1 << bits) if signed and number >> (bits - 1) else number


def _parse_non_integer(text: str, kind: int) -> float | str | bytes | None:
    """Parse a value that isn't an integer; None for types that canopen can't send."""
    if kind in datatypes.FLOAT_TYPES:
        number = float(text)
        struct.pack("<f" if kind == datatypes.REAL32 else "<d", number)
        return number
    if kind == datatypes.VISIBLE_STRING:
        return text.encode("ascii", "replace").decode()
    if kind == datatypes.UNICODE_STRING:
        return text
    if kind in (datatypes.OCTET_STRING, datatypes.DOMAIN):
        return bytes.fromhex(text)
    return None
