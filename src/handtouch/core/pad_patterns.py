"""Selection of pads by patterns such as "thumb_*", in a time that is linear in the pattern's length.

Public names: `PadNames`, `PadName`, `PATTERNS_PER_PAD`.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Sequence
from functools import reduce
from itertools import accumulate
from operator import or_

import numpy as np
from numpy.typing import NDArray

from handtouch.config.problems import suggest_name

PadName = tuple[str, str]
"""hand, link"""
PATTERNS_PER_PAD = 2
"""Most patterns of one request, for each pad of the deployment"""


class PadNames:
    """Names of n pads (hand, link), matched with a pattern all at once.

    The names are one text, each with an end; a set of places in it is an integer with a bit for each. From
    the places where names begin, each character of a pattern leads to the places behind it. Nothing is
    compiled, and each character takes the same few operations, so a request can't make patterns costly.
    """

    def __init__(self, names: Sequence[PadName]) -> None:
        self.names = list(names)
        self._full = [f"{hand}/{link}" for hand, link in names]
        ends = list(accumulate(len(name) + 1 for name in self._full))
        starts = [0, *ends[:-1]]
        self._ends = [1 << (end - 1) for end in ends]
        self._full_starts = _places(starts)
        self._link_starts = _places(
            start + len(hand) + 1 for start, (hand, _) in zip(starts, names, strict=True)
        )
        self._all_ends = reduce(or_, self._ends, 0)
        self._inside = (1 << sum(len(name) + 1 for name in self._full)) - 1 ^ self._all_ends
        text = "".join(f"{name}\0" for name in self._full)
        self._alphabet = sorted(set("".join(self._full)))
        self._holding = {
            character: _places(place for place, held in enumerate(text) if held == character)
            for character in self._alphabet
        }
        self._below = list(accumulate(self._holding.values(), or_, initial=0))
        """of the first k characters of the alphabet"""

    def select(self, patterns: Sequence[str]) -> NDArray[np.bool_]:
        """Return the pads (n,) named by patterns of links, or of "hand/link" with a slash.

        `*` matches any text, `?` any character, `[a-f]` one of a set, `[!a-f]` none of it, as fnmatch does.
        Raises ValueError for a pattern that matches none, among the first of so many that further ones can't
        add a pad.
        """
        chosen = 0
        for number, pattern in enumerate(patterns):
            if number >= PATTERNS_PER_PAD * len(self.names) and chosen == self._all_ends:
                break
            matched = self._match(pattern)
            if not matched:
                known = self._full if "/" in pattern else [link for _, link in self.names]
                hint = suggest_name(pattern, known)
                raise ValueError(f'no pad is named "{pattern}"; {hint}there are {", ".join(self._full)}')
            chosen |= matched
        return np.array([bool(chosen & end) for end in self._ends], dtype=np.bool_)

    def _match(self, pattern: str) -> int:
        """Return the ends of the names that match."""
        inside, holding = self._inside, self._holding
        places, at = self._full_starts if "/" in pattern else self._link_starts, 0
        while places and at < len(pattern):
            character, at = pattern[at], at + 1
            if character == "*":  # adding the places carries a bit from the first of a name to its end
                places |= inside ^ (inside + (places & inside))
                continue
            step = holding.get(character, 0)
            if character == "?":
                step = inside
            elif character == "[" and (end := _end_of_set(pattern, at)) > 0:
                step, at = self._places_of_set(pattern[at:end]), end + 1
            places = (places & step) << 1
        return places & ~inside

    def _places_of_set(self, text: str) -> int:
        """Return the places that hold a character of a set, the text between its brackets."""
        negated = text.startswith("!")
        rest, places = text[negated:], 0
        while rest:
            first, last = rest[0], rest[2] if len(rest) > 2 and rest[1] == "-" else rest[0]
            rest = rest[3 if len(rest) > 2 and rest[1] == "-" else 1 :]
            if first <= last:
                low, high = bisect_left(self._alphabet, first), bisect_right(self._alphabet, last)
                places |= self._below[high] & ~self._below[low]
        return self._inside & ~places if negated else places


def _end_of_set(pattern: str, begin: int) -> int:
    """Return the index of a set's closing bracket, -1 without one; its first character may be a bracket."""
    return pattern.find("]", begin + 1 + pattern.startswith("!", begin))


def _places(at: Iterable[int]) -> int:
    return sum(1 << place for place in at)
