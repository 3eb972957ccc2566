"""Reading of TOML files, with errors that name line, key and remedy.

Public names: `read_text`, `parse_toml`.
"""

from __future__ import annotations

import codecs
import re
import tomllib
from pathlib import Path
from typing import Any

from handtouch.config.problems import ConfigError, Problem

_UTF16_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_KEY = re.compile(r"""\s*((?:[\w\-]+|"[^"]*"|'[^']*')(?:\s*\.\s*(?:[\w\-]+|"[^"]*"|'[^']*'))*)\s*=""")
_MAX_SHOWN_CHARACTERS = 60


def read_text(path: Path, kind: str) -> str:
    """Return the text of a UTF-8 file. Raises ConfigError, in which `kind` names it ("a deployment file")."""
    try:
        data = path.read_bytes()
    except OSError as error:
        problem = Problem("the file", "", f"{error.strerror}; give the path of {kind}")
        raise ConfigError(str(path), (problem,)) from error
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError(str(path), (_encoding_problem(data, error.start, kind),)) from error


def parse_toml(text: str, file: str) -> dict[str, Any]:
    """Return the tables of a TOML text. Raises ConfigError with line, key and remedy."""
    if text.startswith("\ufeff"):
        remedy = "is a byte order mark (BOM), which TOML doesn't allow; save the file as UTF-8 without BOM"
        raise ConfigError(file, (Problem("line 1", "", f"its first character {remedy}"),))
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(file, (_syntax_problem(text, str(error)),)) from error


def _encoding_problem(data: bytes, position: int, kind: str) -> Problem:
    """Describe bytes that aren't UTF-8: UTF-16 by its mark, Latin-1 if they are text in it, else no text."""
    if data.startswith(_UTF16_MARKS) and len(data) > 2:
        return Problem("the file", "", "is UTF-16; save it as UTF-8, the encoding of TOML")
    number = data.count(b"\n", 0, position) + 1
    line = data.splitlines()[number - 1].decode("latin-1")
    is_text = all(character.isprintable() or character == "\t" for character in line)
    if not is_text or not re.search("[A-Za-z]", line):
        return Problem("the file", "", f"not UTF-8 text; give the path of {kind}")
    return Problem(
        f"line {number}",
        f" `{_shorten(line)}`",
        f"byte 0x{data[position]:02X} isn't UTF-8; it is {chr(data[position])!r} in Latin-1 (Windows): save "
        "the file as UTF-8, e.g. `iconv -f LATIN1 -t UTF-8`",
    )


def _syntax_problem(text: str, reason: str) -> Problem:
    """Describe an error of the parser by its line, and duplicate keys and tables by name."""
    lines = text.splitlines() or [""]
    at = re.search(r" \(at (?:line (\d+), column (\d+)|end of document)\)$", reason)
    number = (
        int(at[1]) if at and at[1] else max((n for n, line in enumerate(lines, 1) if line.strip()), default=1)
    )
    number = min(number, len(lines))
    line = lines[number - 1]
    if reason.startswith(("Cannot overwrite", "Duplicate inline", "Cannot declare", "Cannot mutate")):
        named = re.search(r"inline table key '(.*)'", reason)
        return _duplicate_problem(lines, number, named[1] if named else "")
    column = f", column {at[2]}" if at and at[2] else ""
    reason = reason[: at.start()] if at else reason
    remedy = _foreign_file(text) or _slip(line.split("#")[0].strip()) or f"{reason}; correct the syntax there"
    return Problem(f"TOML, line {number}{column}", f" `{_shorten(line)}`", remedy)


def _foreign_file(text: str) -> str:
    """Return what to do with a file of another format, which a deployment names; empty for TOML."""
    begin = text.lstrip()
    if begin.startswith("<"):
        return "this is XML; a robot description (URDF) belongs under urdf of a [[hand]] in a deployment file"
    if re.search(r"(?im)^\[(fileinfo|deviceinfo)\]", text):
        return "this is a device description; an EDS belongs under eds of a [node.NAME] in a deployment file"
    if begin.startswith("{"):
        return "this is JSON; a deployment file is TOML, such as config/utah_mit.toml"
    lines = [line.split("#")[0].rstrip() for line in text.splitlines()]
    given = [line for line in lines if line]
    if given and sum(bool(re.match(r"\s*(- )?[\w.\-]+:(\s|$)", line)) for line in given) > len(given) / 2:
        return "this is YAML; a deployment file is TOML, such as config/utah_mit.toml"
    return ""


def _slip(line: str) -> str:
    """Return the remedy of a usual slip on a line without its comment; empty for another one."""
    if re.search("[\u201c\u201d\u201e\u2018\u2019]", line):
        return 'has typographic quotes; write straight ones, "..."'
    key, _, value = (part.strip() for part in line.partition("="))
    if re.fullmatch(r"[+-]?\d+,\d+", value):
        return f"has a decimal comma; write {key} = {value.replace(',', '.')}"
    if value.lower() in ("none", "null", "nil"):
        return "TOML has no such value; leave the key out"
    if value.lower() in ("true", "false"):
        return f"write {key} = {value.lower()}"
    if re.fullmatch(r"[A-Za-z_][\w.:/\-]*", value):
        return f'a text needs quotes; write {key} = "{value}"'
    if value.count("{") > value.count("}"):
        return f"an inline table {{...}} stands on one line; write it so, or as a table [{key}] of its own"
    if not value and (found := re.fullmatch(r"([\w.\-]+)\s*:\s*(.+)", line)):
        return f"a key and its value are separated by =; write {found[1]} = {found[2]}"
    return ""


def _duplicate_problem(lines: list[str], number: int, inline_key: str) -> Problem:
    """Describe a key or table that is given twice, the second time on a line or above it."""
    if inline_key:
        remedy = f'the key "{inline_key}" is given twice in {{...}}; delete one of them'
        return Problem(f"line {number}", f" `{_shorten(lines[number - 1])}`", remedy)
    header = lines[number - 1].split("#")[0].strip()
    if header.startswith("["):
        others = [n for n, line in enumerate(lines[: number - 1], 1) if line.split("#")[0].strip() == header]
        first = f", first on line {others[0]}" if others else ""
        return Problem(
            f"line {number}",
            f" {header}",
            f"this table is given twice{first}; keep one with the keys of both, or write [[...]] for a list",
        )
    while number > 1 and not _KEY.match(lines[number - 1]):
        number -= 1  # the value continues on further lines
    found = _KEY.match(lines[number - 1])
    key = found[1] if found else ""
    begin = next((n for n in range(number - 1, 0, -1) if lines[n - 1].lstrip().startswith("[")), 0)
    same = [n for n in range(begin + 1, number) if (other := _KEY.match(lines[n - 1])) and other[1] == key]
    table = lines[begin - 1].split("#")[0].strip() if begin else "the top level"
    first = f", first on line {same[0]} `{_shorten(lines[same[0] - 1])}`" if same else ""
    return Problem(
        f"line {number}",
        f" `{_shorten(lines[number - 1])}`",
        f'the key "{key}" is given twice in {table}{first}; delete one of them',
    )


def _shorten(line: str) -> str:
    line = line.strip()
    return line if len(line) <= _MAX_SHOWN_CHARACTERS else line[: _MAX_SHOWN_CHARACTERS - 3] + "..."
