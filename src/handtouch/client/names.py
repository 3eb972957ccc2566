"""Names of hands and links that a client asks for, against those that a daemon has.

Public names: `UnknownNameError`, `unknown_name`, `link_hint`, `topics_of_pattern`.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatchcase

from handtouch import wire


class UnknownNameError(LookupError):
    """The daemon has no such hand or link; the text names those that it has."""


def unknown_name(pattern: str, hands: Mapping[str, Sequence[str]]) -> str:
    """Return why a pattern matches no topic of a daemon with these hands and their links; "" if it does."""
    reasons = [
        _unknown_key(dict(zip(topic.keys, parts, strict=True)), hands)
        for topic, parts in topics_of_pattern(pattern)
    ]
    return "" if "" in reasons or not hands else reasons[0]


def _unknown_key(keys: Mapping[str, str], hands: Mapping[str, Sequence[str]]) -> str:
    hand, link = keys.get("hand", "*"), keys.get("link", "*")
    named = [name for name in hands if fnmatchcase(name, hand)]
    if not named:
        return f"the daemon has no hand {hand!r}; it has {', '.join(hands)}"
    links = [name for hand in named for name in hands[hand]]
    if any(fnmatchcase(name, link) for name in links):
        return ""
    return f"no link {link!r} on {', '.join(named)}; {link_hint(link, links)}"


def link_hint(link: str, links: Iterable[str]) -> str:
    """Return a question that suggests the closest link, or all links if none is close."""
    known = list(links)
    close = difflib.get_close_matches(link, known, 1)
    return f"did you mean {close[0]!r}?" if close else f"the links are {', '.join(known)}"


def topics_of_pattern(pattern: str) -> list[tuple[wire.Topic, list[str]]]:
    """Return the topics that a pattern matches, and the parts for the keys of each."""
    prefix, *parts = pattern.split("/")
    return [
        (topic, parts)
        for topic in wire.TOPICS
        if len(parts) == len(topic.keys) and fnmatchcase(topic.prefix, prefix)
    ]
