"""Reads an EDS or DCF file (CiA 306) as vendors ship them into `canopen`'s object dictionary.

Public names: `parse`, `EdsError`; `entries`, `raw_value` and `variable_at` look into a dictionary;
`PDOS`, `MAPPINGS`, `INTEGERS`, `TYPE_NAMES`.

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

_GENERAL, PDOS, MAPPINGS = range(0x1000, 0x1019), range(0x1800, 0x1A00), range(0x1A00, 0x1C00)
_RECEIVE_PDOS, _TO_MAPPING = range(0x1400, 0x1600), 0x200
_DOMAIN, _VARIABLE, _ARRAY, _OBJECT_TYPES, _GROUPS = 2, 7, 8, (2, 5, 6, 7, 8, 9), (6, 8, 9)
_ACCESS = ("ro", "wo", "rw", "rwr", "rww", "const")
_DUMMIES = range(1, 8)
INTEGERS = {
    kind: (8 * ODVariable.STRUCT_TYPES[kind].size, kind in datatypes.SIGNED_TYPES)
    for kind in datatypes.INTEGER_TYPES
}
TYPE_NAMES = {kind: name for name, kind in vars(datatypes).items() if isinstance(kind, int) and kind < 0x20}

# CiA 301's types, for files that leave them out
_U8, _U16, _U32 = datatypes.UNSIGNED8, datatypes.UNSIGNED16, datatypes.UNSIGNED32
_USUAL_TYPES = dict.fromkeys(_GENERAL, _U32) | {
    **dict.fromkeys((0x1001, 0x100D), _U8),
    **dict.fromkeys((0x100C, 0x1015, 0x1017), _U16),
    **dict.fromkeys((0x1008, 0x1009, 0x100A), datatypes.VISIBLE_STRING),
}
_PDO_TYPES = {0: _U8, 1: _U32, 2: _U8, 3: _U16, 4: _U8, 5: _U16, 6: _U8}

_ADDRESS = re.compile(r"(?:0x)?([0-9a-f]{1,4})(?:sub([0-9a-f]{1,3})|(name|value))?", re.ASCII)
_NODE_ID = re.compile(r"\$?node_?id", re.ASCII)
_LITERAL = re.compile(
    r"(-?)(?:0x([0-9a-f]{1,16})|([0-9][0-9a-f]{0,15})h|0([0-7]{1,21})|([0-9]{1,20})(?:\.0*)?)", re.ASCII
)
_KEYS = ("parametername", "objecttype", "datatype", "accesstype", "defaultvalue", "parametervalue")

_log = logging.getLogger(__name__)


class EdsError(ValueError):
    """An EDS that can't be used; `str` is "file:line: what is wrong; remedy", the line where there is one."""


def parse(path: str, raw: bytes, node_id: int) -> ObjectDictionary:
    """Object dictionary of a file's bytes; `path` is for messages. Raises EdsError."""
    return _Reader(path, node_id, _decode(raw)).dictionary()


def entries(dictionary: ObjectDictionary, mapping: int) -> Iterator[tuple[int, int, int]]:
    """(index, sub-index, bits) of a mapping object, up to the first that the file leaves empty."""
    count = raw_value(dictionary, mapping, 0)
    for sub in range(1, 65 if count is None else count + 1 if count <= 64 else 1):  # 254, 255: no plain PDO
        entry = raw_value(dictionary, mapping, sub)
        if not entry:
            return
        yield entry >> 16, entry >> 8 & 0xFF, entry & 0xFF


def variable_at(dictionary: ObjectDictionary, index: int, sub: int) -> Any:
    """The ODVariable that the file describes, or None; ODArray alone would invent it."""
    found: Any = dictionary.indices.get(index)
    if isinstance(found, ODVariable):
        return None if sub else found
    return None if found is None else found.subindices.get(sub)


def raw_value(dictionary: ObjectDictionary, index: int, sub: int) -> int | None:
    """Integer that an object has after power-on; None where the file gives none."""
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
    return text.replace("\0", "")  # UTF-16 without a mark: what counts is ASCII


@dataclass(slots=True)
class _Section:
    """Keys in small letters, without spaces, to line and text; the text is None where the line has no "="."""

    line: int
    values: dict[str, tuple[int, str | None]] = field(default_factory=dict)

    def get(self, key: str) -> tuple[int, str | None]:
        return self.values.get(key.lower(), (self.line, ""))


class _Reader:
    """One file on its way to an ObjectDictionary."""

    def __init__(self, path: str, node_id: int, text: str) -> None:
        self._path = path
        self._node_id = node_id
        self._sections: dict[str, _Section] = {}
        self._objects: dict[int, dict[int, _Section]] = {}  # by index and sub-index; -1 is the object itself
        self._mapped: set[int] = set()
        section = _Section(0)
        for line, content in enumerate(re.split(r"\r\n|\r|\n", text), 1):
            section = self._read(line, content.strip(), section)
        if not self._objects:
            raise EdsError(f"{path}: has no objects, sections such as [1000]; is it an EDS?")

    def _read(self, line: int, content: str, section: _Section) -> _Section:
        """Take in one line; gives the section that the next one belongs to."""
        if not content or content[0] in ";#":
            return section
        if content[0] == "[":
            if "]" not in content:
                raise self._error(line, f'section "{content}" has no closing bracket; add it')
            return self._open(line, content[1 : content.index("]")])
        key, equals, value = content.partition("=")
        word = re.match(r"\w*", content)[0].lower()  # type: ignore[index]  # matches anything
        if equals:
            self._keep(section.values, _plain(key), (line, value), line)
        elif _ADDRESS.fullmatch(_plain(content).rstrip("]")) and content[-1] == "]":
            raise self._error(line, f'section "{content}" has no opening bracket; add it')
        elif word in _KEYS:
            self._keep(section.values, word, (line, None), line)
        return section

    def _open(self, line: int, title: str) -> _Section:
        name, section = _plain(title), _Section(line)
        address = _ADDRESS.fullmatch(name)
        if address is None:
            self._keep(self._sections, name, section, line)
            return section
        index, sub, list_of = int(address[1], 16), int(address[2] or "0", 16), address[3]
        if list_of:
            self._keep(self._sections, f"{index:04x}{list_of}", section, line)
        elif sub > 0xFF:
            self._complain(line, f"[{title}] has a sub-index above 0xFF; correct it", self._needed(index))
        else:
            self._keep(self._objects.setdefault(index, {}), sub if address[2] else -1, section, line)
        return section

    def _keep(self, table: dict[Any, Any], key: Any, value: Any, line: int) -> None:
        if table.setdefault(key, value) is not value:
            self._complain(line, f"{key} comes twice, the first counts", strict=False)

    def dictionary(self) -> ObjectDictionary:
        result = ObjectDictionary()
        result.node_id = self._node_id
        for index in self._objects:  # mappings first: they say which objects matter
            if index in MAPPINGS:
                result.add_object(self._object(index))
                self._mapped |= {entry[0] for entry in entries(result, index)}
        for index in self._objects:
            if index not in MAPPINGS:
                result.add_object(self._object(index))
        for index in (*_RECEIVE_PDOS, *PDOS):  # canopen looks for a mapping wherever there is a PDO
            if index in result and index + _TO_MAPPING not in result:
                result.add_object(ODRecord(f"0x{index + _TO_MAPPING:04X}", index + _TO_MAPPING))
        usage = self._sections.get("dummyusage", _Section(0))
        for kind in _DUMMIES:
            if kind in self._mapped or self._number(usage, f"dummy{kind:04d}", strict=False):
                dummy = ODVariable(f"Dummy{kind:04d}", kind)
                dummy.data_type, dummy.access_type = kind, "const"
                result.add_object(dummy)
        return result

    def _object(self, index: int) -> ODVariable | ODRecord | ODArray:
        subs = dict(self._objects[index])
        head = subs.pop(-1, None) or _Section(next(iter(self._objects[index].values())).line)
        strict = self._needed(index)
        name = self._text(head, "ParameterName", strict) or f"0x{index:04X}"
        kind = self._number(head, "ObjectType", strict) or (9 if subs else _VARIABLE)
        if kind not in _OBJECT_TYPES:
            line = head.get("ObjectType")[0]
            self._complain(line, f"ObjectType {kind} is none of CiA 306; correct it", strict)
        count = self._number(head, "CompactSubObj", strict) or 0
        if not (subs or count or kind in _GROUPS or index in PDOS or index in MAPPINGS):
            return self._variable(index, 0, head, name)
        group = ODArray(name, index) if kind == _ARRAY else ODRecord(name, index)
        for variable in self._compact(index, count, head, name):
            group.add_member(variable)
        for sub, section in sorted(subs.items()):
            own = self._text(section, "ParameterName", strict) or f"{name} {sub}"
            group.add_member(self._variable(index, sub, section, own, grouped=True))
        return group

    def _compact(self, index: int, count: int, head: _Section, name: str) -> Iterator[ODVariable]:
        """Members of an object that describes them all at once, with their own names and values."""
        if not count:
            return
        size = ODVariable("Number of entries", index, 0)
        size.data_type, size.access_type, size.default = _U8, "ro", min(count, 254)
        yield size
        names, values = (self._sections.get(f"{index:04x}{what}", _Section(0)) for what in ("name", "value"))
        for sub in range(1, min(count, 254) + 1):
            own = self._text(names, str(sub), strict=False) or f"{name} {sub}"
            variable = self._variable(index, sub, head, own, grouped=True)
            if str(sub) in values.values:
                variable.value = self._value(values, str(sub), variable.data_type, self._needed(index))
            yield variable

    def _variable(
        self, index: int, sub: int, section: _Section, name: str, *, grouped: bool = False
    ) -> ODVariable:
        strict = self._needed(index)
        values_matter = strict and index not in self._mapped
        result = ODVariable(name, index, sub)
        result.data_type = self._type(index, sub, section, grouped=grouped)
        result.access_type = self._access(section, strict)
        result.pdo_mappable = bool(self._number(section, "PDOMapping", strict=False))
        result.default = self._value(section, "DefaultValue", result.data_type, values_matter)
        result.value = self._value(section, "ParameterValue", result.data_type, values_matter)
        if result.data_type in INTEGERS:
            result.min = self._value(section, "LowLimit", result.data_type, strict=False)
            result.max = self._value(section, "HighLimit", result.data_type, strict=False)
        return result

    def _type(self, index: int, sub: int, section: _Section, *, grouped: bool) -> int:
        strict = self._needed(index)
        kind: int | None = self._number(section, "DataType", strict)
        if kind is None:
            if grouped and sub == 0:
                kind = _U8
            elif index in PDOS:
                kind = _PDO_TYPES.get(sub)
            elif self._number(section, "ObjectType", strict=False) == _DOMAIN:
                kind = datatypes.DOMAIN
            else:
                kind = _U32 if index in MAPPINGS else _USUAL_TYPES.get(index)
        elif kind not in TYPE_NAMES and kind in self._objects:  # CANFestival: its type is told in [A0sub1]
            own = self._objects[kind].get(1)
            kind = (own and self._number(own, "DefaultValue", strict)) or kind
        if kind in TYPE_NAMES:
            return int(kind)
        line = section.get("DataType")[0]
        what = "no DataType" if kind is None else f"unknown DataType 0x{kind:04X}"
        self._complain(line, f"object 0x{index:04X} sub {sub} has {what}; correct it", strict)
        return int(datatypes.DOMAIN)  # so that its data pass as bytes

    def _access(self, section: _Section, strict: bool) -> str:
        text = re.sub("[^a-z]", "", _uncommented(self._text(section, "AccessType", strict)).lower())
        if text and text not in _ACCESS:
            line = section.get("AccessType")[0]
            self._complain(line, f"AccessType {text} is none of {', '.join(_ACCESS)}; correct it", strict)
        return text if text in _ACCESS else "rw"

    def _value(self, section: _Section, key: str, kind: int, strict: bool) -> Any:
        """Value of a key in an object's type; None where there is none or, if not `strict`, no valid one."""
        text = self._text(section, key, strict)
        try:
            if kind in INTEGERS or kind == datatypes.BOOLEAN:
                number = _number(text, self._node_id)
                return None if number is None else _fit(number, kind)
            return _other(text, kind) if text else None
        except (ValueError, OverflowError) as error:
            self._complain(section.get(key)[0], f"{key} {error}; correct it or leave it empty", strict)
            return None

    def _number(self, section: _Section, key: str, strict: bool) -> int | None:
        try:
            return _number(self._text(section, key, strict), self._node_id)
        except ValueError as error:
            self._complain(section.get(key)[0], f"{key} {error}; correct it or leave it empty", strict)
            return None

    def _text(self, section: _Section, key: str, strict: bool) -> str:
        """Value without comment and quotation marks; "" where there is none."""
        line, text = section.get(key)
        if text is None:
            self._complain(line, f'{key} is followed by no "="; add it', strict)
            return ""
        plain = re.split(r"(?:^|\s);", text)[0].strip()
        return plain[1:-1] if len(plain) > 1 and plain[0] == plain[-1] == '"' else plain

    def _needed(self, index: int) -> bool:
        return any(index in these for these in (_GENERAL, PDOS, MAPPINGS, self._mapped))

    def _complain(self, line: int, what: str, strict: bool) -> None:
        if strict:
            raise self._error(line, what)
        _log.debug("%s:%d: %s; left out", self._path, line, what)

    def _error(self, line: int, what: str) -> EdsError:
        return EdsError(f"{self._path}:{line}: {what}")


def _uncommented(text: str) -> str:
    return re.split(r"[;#]|//", text)[0]


def _plain(text: str) -> str:
    return "".join(text.split()).lower()


def _number(text: str, node_id: int) -> int | None:
    """Value of an integer as in C, of one in hex with an h after it, of a sum with $NODEID; None if empty."""
    plain = _plain(_uncommented(text))
    if not plain:
        return None
    terms = plain.removeprefix("+").split("+")
    numbers = [_literal(term) for term in terms if not _NODE_ID.fullmatch(term)]
    node_ids = len(terms) - len(numbers)
    if None in numbers or node_ids > 1:
        raise ValueError(f'"{text}" is neither a number nor $NODEID+number')
    return sum(number for number in numbers if number is not None) + node_ids * node_id


def _literal(text: str) -> int | None:
    found = _LITERAL.fullmatch(text)
    if not found:
        return None
    sign, *groups = found.groups()
    digits, base = next((g, b) for g, b in zip(groups, (16, 16, 8, 10), strict=True) if g)
    return int(sign + digits, base)


def _fit(number: int, kind: int) -> int:
    """A number in a type; a signed one may be given as its bits, 0xFFFF for -1, an unsigned one as -1."""
    bits, signed = INTEGERS.get(kind, (1, False))
    if not -(1 << (bits - 1)) <= number < 1 << bits:
        raise ValueError(f"{number} is outside {TYPE_NAMES[kind]}")
    number &= (1 << bits) - 1
    return number - (1 << bits) if signed and number >> (bits - 1) else number


def _other(text: str, kind: int) -> float | str | bytes | None:
    """A value that is no integer, such that canopen can send it; None for types that it can't send."""
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
