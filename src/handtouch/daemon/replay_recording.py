"""A recording made again: the same contacts to the last bit, or what would have been different.

Public names: `replay`, `Other`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace as changed_copy
from pathlib import Path
from typing import Any, NamedTuple

import msgpack

from handtouch import wire
from handtouch.config import Deployment
from handtouch.daemon import locators, rerun
from handtouch.daemon.compare import Comparison, tell_anew, tell_same
from handtouch.daemon.publisher import Publisher
from handtouch.record.read import Entry, Recording

_BESIDES = ("health", "joints", "service", "percept")
"""What is published as it was recorded."""


class Other(NamedTuple):
    """What is to be otherwise than it was recorded."""

    nominal: bool
    locator: str | None
    tolerance_mm: float | None

    @property
    def any(self) -> bool:
        return self.nominal or self.locator is not None or self.tolerance_mm is not None

    def of(self, deployment: Deployment) -> Deployment:
        """With the tolerance that is asked for."""
        if self.tolerance_mm is None:
            return deployment
        scene = deployment.scene.model_copy(update={"tolerance_mm": self.tolerance_mm})
        return deployment.model_copy(update={"scene": scene})


def replay(
    path: Path,
    deployment: Deployment | None,
    other: Other,
    serve: Callable[[Deployment | None], tuple[Publisher | None, Callable[[int], None]]],
    take: Callable[[wire.Contact], None],
    report: Path | None,
    stack: ExitStack,
) -> int:
    """Make a recording again and tell how it compares; exit status 0 or 1. Raises ValueError, OSError.

    `serve` gives a publisher where there is to be one, and what keeps the pace; files of the recorded
    deployment are there until `stack` is left.
    """
    recording = Recording(path)
    comparison = Comparison()

    def both(contact: wire.Contact) -> None:
        take(contact)
        comparison.add_replayed(contact)

    began_s = time.monotonic()
    again = deployment is None and not other.any
    recorded = stack.enter_context(rerun.recorded_deployment(_first_config(recording)))
    publisher, pace = serve(deployment or recorded)
    if again:
        feeder = rerun.Again(take, publisher)
    else:
        changed = other.of(deployment or recorded)
        locate = locators.locator(changed, other.locator) if other.locator else None
        nominal, keep = other.nominal, comparison.add_recorded
        feeder = locators.Otherwise(changed, both, publisher, nominal=nominal, recorded=keep, locate=locate)
    told = _Told(publisher) if publisher else None
    for entry in recording.read("config", "state", "contact", "tick", *(_BESIDES if told else ())):
        if entry.topic == "tick":
            pace(entry.payload["now_ns"])
        if told is not None:
            told.take(entry)
        if not entry.topic.startswith(_BESIDES):
            feeder.feed(entry)
    seconds = time.monotonic() - began_s
    if again:
        return tell_same(recording, feeder.found, seconds, report)
    return tell_anew(recording, feeder.found, comparison, seconds, report)


class _Told:
    """What a recording has beside contacts, published as it was: who looks on finds a hand and its health."""

    def __init__(self, publisher: Publisher) -> None:
        self._publisher = publisher

    def take(self, entry: Entry) -> None:
        """Send it, and keep it for those who come late."""
        if not entry.topic.startswith((*_BESIDES, "config")):
            return
        message = wire.decode([entry.topic.encode(), msgpack.packb(entry.payload)])
        self._publisher.send(message)
        late = changed_copy(message, repeat=True)
        self._publisher.present[entry.topic] = lambda _: late


def _first_config(recording: Recording) -> dict[str, Any]:
    """What a recording begins with. Raises ValueError where there is none."""
    for entry in recording.read("config"):
        return entry.payload
    cut = f"; {recording.cut}" if recording.cut else ""
    raise ValueError(f"{recording.path}: holds no tick that can be made again, for want of a deployment{cut}")
