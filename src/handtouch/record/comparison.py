"""Comparison of replayed contacts with recorded ones.

Public names: `ContactComparison`, `LinkComparison`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch import wire


@dataclass
class LinkComparison:
    """Differences on one link; shifts [mm] and ratios replayed/recorded are of samples that both have."""

    recorded: int
    """contacts"""
    replayed: int
    only_recorded: int
    """contacts that overlap in time with no replayed one"""
    only_replayed: int
    samples: int
    shift_mm: dict[str, float] = field(default_factory=dict)
    """median, p95 and max of the distance"""
    force_ratio: dict[str, float] = field(default_factory=dict)
    """p5, median and p95"""
    begin_delay_ms: float | None = None
    """median delay of contact begins"""


class _LinkContacts:
    """Contacts of one link, recorded or replayed."""

    def __init__(self) -> None:
        self.spans_ns: dict[tuple[int, int], list[int]] = {}  # session, id -> first and last time
        self.positions_m: dict[int, tuple[float, float, float]] = {}
        self.forces_n: dict[int, float] = {}

    def add(self, contact: Mapping[str, Any]) -> None:
        t_ns = contact["t_ns"]
        span = self.spans_ns.setdefault((contact["session"], contact["id"]), [contact["begin_ns"], t_ns])
        span[1] = max(span[1], t_ns)
        if contact["event"] == "end":
            return
        if contact["position_m"] is not None:
            self.positions_m[t_ns] = tuple(contact["position_m"])
        if contact["force_status"] == "valid":
            self.forces_n[t_ns] = contact["force_n"]


class ContactComparison:
    """Collects recorded and replayed contact messages; `links` compares them."""

    def __init__(self) -> None:
        self._sides: dict[str, tuple[_LinkContacts, _LinkContacts]] = {}

    def add_recorded(self, payload: Mapping[str, Any]) -> None:
        """Add a recorded payload of `contact`."""
        self._sides_of(payload)[0].add(payload)

    def add_replayed(self, contact: wire.Contact) -> None:
        """Add a replayed contact message."""
        payload = {name: getattr(contact, name) for name in _COMPARED_KEYS}
        self._sides_of(payload)[1].add(payload)

    def links(self) -> dict[str, LinkComparison]:
        """Return hand/link -> comparison, for links with a contact."""
        return {name: _compare_link(*sides) for name, sides in sorted(self._sides.items())}

    def _sides_of(self, payload: Mapping[str, Any]) -> tuple[_LinkContacts, _LinkContacts]:
        name = f"{payload['hand']}/{payload['link']}"
        return self._sides.setdefault(name, (_LinkContacts(), _LinkContacts()))


_COMPARED_KEYS = (
    "session",
    "id",
    "hand",
    "link",
    "event",
    "t_ns",
    "begin_ns",
    "position_m",
    "force_n",
    "force_status",
)


def _compare_link(before: _LinkContacts, after: _LinkContacts) -> LinkComparison:
    link = LinkComparison(
        recorded=len(before.spans_ns),
        replayed=len(after.spans_ns),
        only_recorded=_count_unmatched(before, after),
        only_replayed=_count_unmatched(after, before),
        samples=len(before.positions_m.keys() & after.positions_m.keys()),
    )
    if both := sorted(before.positions_m.keys() & after.positions_m.keys()):
        shift = np.array([after.positions_m[t] for t in both]) - np.array(
            [before.positions_m[t] for t in both]
        )
        distance_mm = np.sqrt((shift**2).sum(axis=1)) * 1e3
        link.shift_mm = _percentiles(distance_mm, median=50, p95=95, max=100)
    both = sorted(t for t in before.forces_n.keys() & after.forces_n.keys() if before.forces_n[t] > 0)
    if both:
        ratio = np.array([after.forces_n[t] for t in both]) / np.array([before.forces_n[t] for t in both])
        link.force_ratio = _percentiles(ratio, p5=5, median=50, p95=95)
    begins = [
        after_span[0] - span[0]
        for span in before.spans_ns.values()
        for after_span in after.spans_ns.values()
        if _overlap(span, after_span)
    ]
    if begins:
        link.begin_delay_ms = float(np.median(begins)) * 1e-6
    return link


def _count_unmatched(side: _LinkContacts, other: _LinkContacts) -> int:
    return sum(not any(_overlap(span, o) for o in other.spans_ns.values()) for span in side.spans_ns.values())


def _overlap(a: list[int], b: list[int]) -> bool:
    return a[0] <= b[1] and b[0] <= a[1]


def _percentiles(values: NDArray[np.float64], **parts: float) -> dict[str, float]:
    return {name: float(np.percentile(values, part)) for name, part in parts.items()}
