"""Removal of secrets from texts that leave this machine.

Public name: `redact`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

REPLACEMENT = "<removed>"
_NAMES = r"secret|token|passw(?:or)?d|passphrase|api[_-]?key|private[_-]?key|credentials?|authori[sz]ation"
_RULES = (
    # a block of PEM
    (r"-----BEGIN [A-Z ]*PRIVATE KEY-----.*?(?:-----END [A-Z ]*PRIVATE KEY-----|\Z)", REPLACEMENT),
    # name = value, "name": "value", --name value; without quotes, all to the end of the line
    (
        rf"""(?i)((?:[\w.-]*(?:{_NAMES})[\w.-]*["']?[ \t]*[=:]|--[\w-]*(?:{_NAMES})[\w-]*)[ \t]*)"""
        r"""(?:\"{3}.*?\"{3}|'{3}.*?'{3}|"(?:\\.|[^"\\\n])+"|'[^'\n]+'|[^\n]+)""",
        rf'\1"{REPLACEMENT}"',
    ),
    (r"(?i)\b(bearer|basic)[ \t]+[A-Za-z0-9+/=._~-]{8,}", rf"\1 {REPLACEMENT}"),
    # scheme://user:password@host
    (r"(\w+://)[^\s/@:]*:[^\s/@]+@", rf"\1{REPLACEMENT}@"),
    # a quoted CURVE key, public or secret (32 bytes as Z85)
    (r"""(["'])[0-9A-Za-z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}\1""", f'"{REPLACEMENT}"'),
)
_PATTERNS = tuple((re.compile(pattern, re.DOTALL), by) for pattern, by in _RULES)


def redact(text: str, secrets: Iterable[str] = ()) -> tuple[str, int]:
    """Return the text without `secrets` and all that looks like one, and the number of replacements.

    Looks like one: a value named secret, token, password or similar; credentials in a URL or an HTTP header;
    a private key in PEM; a quoted CURVE key. Rather too much is removed than too little.
    """
    total = 0
    for secret in filter(None, secrets):
        total += text.count(secret)
        text = text.replace(secret, REPLACEMENT)
    for pattern, by in _PATTERNS:
        text, count = pattern.subn(by, text)
        total += count
    return text, total
