"""Replay of an MCAP recording: exactly, or with another deployment.

Public names: `replay_recording`, `first_config`, `RecordingReplay`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import msgpack

from handtouch import wire
from handtouch.config import Deployment
from handtouch.record.comparison import ContactComparison
from handtouch.record.exact_replay import DeploymentReplay, ExactReplay, Recomputation, ReplayResult
from handtouch.record.recording import RecordedMessage, Recording
from handtouch.record.replay_sink import ContactCallback, ReplayPublisher

_STATUS_PREFIXES = ("health", "joints", "service", "percept")
"""Topics published as recorded."""


class RecordingReplay(NamedTuple):
    """Outcome of a replay; `comparison` with the recorded contacts, for another deployment only."""

    result: ReplayResult
    comparison: ContactComparison | None


def replay_recording(
    recording: Recording,
    on_contact: ContactCallback,
    deployment: Deployment | None = None,
    *,
    pace: Callable[[int], None] = lambda _: None,
    publisher: ReplayPublisher | None = None,
    recompute: bool = False,
) -> RecordingReplay:
    """Recompute the contacts of a recording: exactly, or with another `deployment` of the same pads.

    `recompute`: with the recorded deployment from an empty state, without comparison.
    `pace` is called with the time of each tick before it is computed; it may sleep. Raises ValueError,
    OSError.
    """
    comparison = None
    replay: ExactReplay
    if deployment is None:
        replay = (Recomputation if recompute else ExactReplay)(on_contact, publisher)
    else:
        comparison = compared = ContactComparison()

        def compare(contact: wire.Contact) -> None:
            on_contact(contact)
            compared.add_replayed(contact)

        replay = DeploymentReplay(deployment, compare, publisher, on_recorded=compared.add_recorded)
    prefixes = ("config", "state", "contact", "tick", *(_STATUS_PREFIXES if publisher is not None else ()))
    for entry in recording.read(*prefixes):
        if entry.topic == "tick":
            pace(entry.payload["now_ns"])
        if publisher is not None:
            _publish_status(entry, publisher)
        if not entry.topic.startswith(_STATUS_PREFIXES):
            replay.process_message(entry)
    return RecordingReplay(replay.result, comparison)


def first_config(recording: Recording) -> dict[str, Any]:
    """Return the first `config` payload of a recording. Raises ValueError if there is none."""
    for entry in recording.read("config"):
        return entry.payload
    cut = f"; {recording.truncation}" if recording.truncation else ""
    raise ValueError(f"{recording.path}: holds no deployment, so no tick can be replayed{cut}")


def _publish_status(entry: RecordedMessage, publisher: ReplayPublisher) -> None:
    """Publish a status message as recorded, and retain it for late subscribers."""
    if not entry.topic.startswith((*_STATUS_PREFIXES, "config")):
        return
    message = wire.decode([entry.topic.encode(), msgpack.packb(entry.payload)])
    if isinstance(message, wire.Service):
        message = replace(message, replay=True)
    publisher.send(message)
    retained = replace(message, retained=True)
    publisher.retained_messages[entry.topic] = lambda _: retained
