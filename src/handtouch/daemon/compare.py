"""How contacts that were made again compare with those that were recorded, as numbers and in words.

Public names: `Comparison`, `OfLink`, `tell_same`, `tell_anew`.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from handtouch import wire

if TYPE_CHECKING:
    from handtouch.daemon.rerun import Rerun
    from handtouch.record.read import Recording


@dataclass
class OfLink:
    """What differs on one link; shifts [mm] and ratios new/recorded are of samples that both tell."""

    recorded: int
    """contacts"""
    replayed: int
    only_recorded: int
    """contacts that overlap in time with none of the others"""
    only_replayed: int
    samples: int
    shift_mm: dict[str, float] = field(default_factory=dict)
    """median, p95 and max of the distance"""
    force_ratio: dict[str, float] = field(default_factory=dict)
    """p5, median and p95"""
    begin_ms: float | None = None
    """median of how much later contacts begin"""


class _Side:
    """Contacts of one link, recorded or made again."""

    def __init__(self) -> None:
        self.spans: dict[tuple[int, int], list[int]] = {}  # run, id -> first and last time
        self.places: dict[int, tuple[float, float, float]] = {}
        self.forces: dict[int, float] = {}

    def add(self, contact: Mapping[str, Any]) -> None:
        t_ns = contact["t_ns"]
        span = self.spans.setdefault((contact["run"], contact["id"]), [contact["begin_ns"], t_ns])
        span[1] = max(span[1], t_ns)
        if contact["event"] == "end":
            return
        if contact["position_m"] is not None:
            self.places[t_ns] = tuple(contact["position_m"])
        if contact["strength"] == "valid":
            self.forces[t_ns] = contact["force_n"]


class Comparison:
    """Takes contact messages of both sides; `links` compares them."""

    def __init__(self) -> None:
        self._sides: dict[str, tuple[_Side, _Side]] = {}

    def add_recorded(self, payload: Mapping[str, Any]) -> None:
        """A payload of `contact`."""
        self._of(payload)[0].add(payload)

    def add_replayed(self, contact: wire.Contact) -> None:
        """A contact message that was made again."""
        payload = {name: getattr(contact, name) for name in _NAMES}
        self._of(payload)[1].add(payload)

    def links(self) -> dict[str, OfLink]:
        """hand/link -> what differs there; links without a contact are left out."""
        return {name: _compared(*sides) for name, sides in sorted(self._sides.items())}

    def _of(self, payload: Mapping[str, Any]) -> tuple[_Side, _Side]:
        name = f"{payload['hand']}/{payload['link']}"
        return self._sides.setdefault(name, (_Side(), _Side()))


_NAMES = (
    *("run", "id", "hand", "link", "event", "t_ns", "begin_ns"),
    *("position_m", "force_n", "strength"),
)


def _compared(before: _Side, after: _Side) -> OfLink:
    told = OfLink(
        recorded=len(before.spans),
        replayed=len(after.spans),
        only_recorded=_alone(before, after),
        only_replayed=_alone(after, before),
        samples=len(before.places.keys() & after.places.keys()),
    )
    if both := sorted(before.places.keys() & after.places.keys()):
        shift = np.array([after.places[t] for t in both]) - np.array([before.places[t] for t in both])
        distance_mm = np.sqrt((shift**2).sum(axis=1)) * 1e3
        told.shift_mm = _percentiles(distance_mm, median=50, p95=95, max=100)
    both = sorted(t for t in before.forces.keys() & after.forces.keys() if before.forces[t] > 0)
    if both:
        ratio = np.array([after.forces[t] for t in both]) / np.array([before.forces[t] for t in both])
        told.force_ratio = _percentiles(ratio, p5=5, median=50, p95=95)
    begins = [
        after_span[0] - span[0]
        for span in before.spans.values()
        for after_span in after.spans.values()
        if _overlap(span, after_span)
    ]
    if begins:
        told.begin_ms = float(np.median(begins)) * 1e-6
    return told


def _alone(side: _Side, other: _Side) -> int:
    return sum(not any(_overlap(span, o) for o in other.spans.values()) for span in side.spans.values())


def _overlap(a: list[int], b: list[int]) -> bool:
    return a[0] <= b[1] and b[0] <= a[1]


def _percentiles(values: NDArray[np.float64], **parts: float) -> dict[str, float]:
    return {name: float(np.percentile(values, part)) for name, part in parts.items()}


def tell_same(recording: Recording, found: Rerun, seconds: float, report: Path | None) -> int:
    """Whether all came out as recorded, on stderr and as JSON; exit status 0 if so, else 1."""
    well = found.ticks > 0 and found.same == found.compared
    _say(recording, found, seconds)
    if found.ticks and well:
        print(f"all {found.compared} contact messages are the same, bit for bit", file=sys.stderr)
    elif found.ticks:
        print(
            f"{found.compared - found.same} of {found.compared} contact messages differ; "
            f"first: {found.first}",
            file=sys.stderr,
        )
    _write(report, recording, found, {"same": found.same, "first_difference": _plain(found)})
    return 0 if well else 1


def tell_anew(
    recording: Recording, found: Rerun, comparison: Comparison, seconds: float, report: Path | None
) -> int:
    """What differs on each link, on stderr and as JSON; exit status 0 if there were ticks, else 1."""
    _say(recording, found, seconds)
    links = comparison.links()
    if found.ticks:
        print(table(links), file=sys.stderr)
    _write(report, recording, found, {"links": {name: asdict(link) for name, link in links.items()}})
    return 0 if found.ticks else 1


def table(links: Mapping[str, OfLink]) -> str:
    """What differs, as lines."""
    rows = [("link", "contacts", "only then", "only now", "samples", "shift mm", "95 %", "force", "begin ms")]
    for name, link in links.items():
        rows.append(
            (
                name,
                f"{link.recorded} -> {link.replayed}",
                str(link.only_recorded),
                str(link.only_replayed),
                str(link.samples),
                f"{link.shift_mm['median']:.3f}" if link.shift_mm else "-",
                f"{link.shift_mm['p95']:.3f}" if link.shift_mm else "-",
                f"x {link.force_ratio['median']:.3f}" if link.force_ratio else "-",
                f"{link.begin_ms:+.1f}" if link.begin_ms is not None else "-",
            )
        )
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = ("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows)
    return "\n".join(line.rstrip() for line in lines)


def _say(recording: Recording, found: Rerun, seconds: float) -> None:
    times = found.log_s / seconds if seconds else 0.0
    print(
        f"{found.ticks} ticks of {found.log_s:.1f} s made again in {seconds:.1f} s "
        f"({times:.1f} times as fast), {found.contacts} contacts",
        file=sys.stderr,
    )
    if found.other_build:
        print("another build or processor than recorded, which may differ in the last bits:", file=sys.stderr)
        print("\n".join(f"  {line}" for line in found.other_build), file=sys.stderr)
    if found.skipped:
        print(f"{found.skipped} ticks could not be made again: no state to go on from", file=sys.stderr)
    if not found.ticks:
        print(f"{recording.path}: holds no tick that can be made again", file=sys.stderr)
    if recording.cut:
        print(f"{recording.path}: {recording.cut}; all before it is used", file=sys.stderr)


def _write(report: Path | None, recording: Recording, found: Rerun, more: dict[str, Any]) -> None:
    if report is None:
        return
    told = {
        "recording": str(recording.path),
        "cut": recording.cut,
        "seconds": found.log_s,
        "ticks": found.ticks,
        "skipped_ticks": found.skipped,
        "contacts": found.contacts,
        "compared": found.compared,
        "other_build": found.other_build,
        **more,
    }
    report.write_text(json.dumps(told, indent=1) + "\n")


def _plain(found: Rerun) -> dict[str, Any] | None:
    return None if found.first is None else asdict(found.first)
