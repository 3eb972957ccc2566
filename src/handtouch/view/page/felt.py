"""What is felt above contacts, in words for the page: of each pad, and of the hand as a whole.

Public names: `Felt`. No clock: times are those of messages.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from handtouch import wire
from handtouch.view.lines import percept_words

_KINDS = ("motion", "hardness", "shape", "texture")
_PLAIN = ("sticking", "point")
"""Classes that are the rule: told in the list, not beside the pad."""
_LASTS_NS = 3_000_000_000
"""A percept is told anew twice a second; one of the whole hand that isn't any more is over."""


class _Told(NamedTuple):
    contact: int
    until_ns: int
    label: str
    words: str
    missing: str


class Felt:
    """Takes percepts; `told` gives what holds, as plain values for the board."""

    def __init__(self) -> None:
        self._pads: dict[str, dict[str, _Told]] = {}

    def take(self, percept: wire.Percept) -> None:
        """Take in a message of any kind."""
        pad = self._pads.setdefault(f"{percept.hand}/{percept.link}", {})
        is_ask = percept.kind == "ask"
        known = percept.state == "estimated" and percept.label not in _PLAIN
        pad[f"{percept.kind} {percept.question}" if is_ask else percept.kind] = _Told(
            percept.contact,
            percept.expires_ns if is_ask else percept.t_ns + _LASTS_NS,
            percept.label if is_ask or known else "",
            percept_words(percept),
            f"{percept.kind}: {percept.reason}" if percept.state == "unestimated" else "",
        )

    def told(self, contacts: dict[str, int], t_ns: int) -> dict[str, dict[str, Any] | None]:
        """hand/link (hand/: the whole hand) -> what is felt there, None: nothing any more.

        `contacts`: of each pad whose frame came, 0 for none; what is of another contact is over.
        """
        return {key: self._of(key, contacts.get(key), t_ns) for key in list(self._pads)}

    def clear(self) -> None:
        """Nothing is known."""
        self._pads.clear()

    def _of(self, key: str, contact: int | None, t_ns: int) -> dict[str, Any] | None:
        of_pad = not key.endswith("/")
        held = {
            kind: told
            for kind, told in self._pads[key].items()
            if t_ns < told.until_ns and (contact is None or not of_pad or told.contact == contact)
        }
        if not held:
            del self._pads[key]
            return None
        self._pads[key] = held
        asks = [told.words for kind, told in held.items() if kind not in _KINDS]
        felt = [held[kind] for kind in _KINDS if kind in held]
        return {
            "short": [told.label for told in felt if told.label],
            "lines": [told.words for told in felt if told.words],
            "asks": asks,
            "missing": [told.missing for told in felt if told.missing],
        }
