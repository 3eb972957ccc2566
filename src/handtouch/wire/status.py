"""Status codes: numbers in columns, lower-case names in other messages (`status.text`).

Public names: `MAX_SILENT_PERIODS`, `StatusCode`, `PadState`, `PositionStatus`, `ForceStatus`,
`ContactRadiusStatus`, `FrameStatus`, and the type of the names of each, `PadStateName` and so on. A later
version may add codes."""

from __future__ import annotations

from enum import IntEnum
from typing import Any, Literal

PadStateName = Literal["clear", "touched", "stale", "lost", "faulted", "starting", "off"]
PositionStatusName = Literal["not_computed", "valid", "unreliable", "invalid"]
ForceStatusName = Literal["not_computed", "valid", "lower_bound", "unreliable", "invalid"]
ContactRadiusStatusName = Literal["not_computed", "valid", "assumed", "contradictory"]
FrameStatusName = Literal["not_computed", "valid", "stale", "invalid"]


MAX_SILENT_PERIODS = 3
"""Periods without a sample or a message after which a pad, a node or a publisher counts as silent.

Chosen: two samples lost in a row are no fault yet; with four, a client learns of a fault a period later.
"""


class StatusCode(IntEnum):
    """A code that prints as its name in messages without columns, and equals it: `code == "valid"`."""

    @property
    def text(self) -> Any:
        """Name of the code in messages without columns, of the type `...Name`."""
        return self.name.lower()

    def __str__(self) -> str:
        return str(self.text)

    def __eq__(self, other: object) -> bool:
        return bool(self.text == other) if isinstance(other, str) else int.__eq__(self, other)

    def __ne__(self, other: object) -> bool:
        return bool(self.text != other) if isinstance(other, str) else int.__ne__(self, other)

    __hash__ = int.__hash__


class PadState(StatusCode):
    """State of a pad: "no contact" is CLEAR only, not STALE, LOST or FAULTED."""

    CLEAR = 0
    """sampled, without contact"""
    TOUCHED = 1
    """sampled, with a contact"""
    STALE = 2
    """no sample for three periods"""
    LOST = 3
    """heartbeat of its node timed out"""
    FAULTED = 4
    """samples are invalid; the pad's health has the reason"""
    STARTING = 5
    """its node isn't operational yet; or its first samples may begin a contact"""
    OFF = 6
    """switched off: in no scene, or disabled"""


class PositionStatus(StatusCode):
    """Status of a contact's position."""

    NOT_COMPUTED = 0
    """no scene requests it, or no contact"""
    VALID = 1
    UNRELIABLE = 2
    """published, but degraded by what `diagnoses` name, or as the contact is no point: several objects, or
    a long one; the covariance includes an extent that explains its currents"""
    INVALID = 3
    """no position agrees with the currents"""


class ForceStatus(StatusCode):
    """Status of a contact's force."""

    NOT_COMPUTED = 0
    """no scene requests it, or no contact"""
    VALID = 1
    LOWER_BOUND = 2
    """the pad is saturated: the force is at least `force_n`"""
    UNRELIABLE = 3
    """the pad's baseline, or the state of its sheet, is not known well enough yet"""
    INVALID = 4


class ContactRadiusStatus(StatusCode):
    """Status of a contact's radius."""

    NOT_COMPUTED = 0
    """no scene requests forces, or no contact"""
    VALID = 1
    """estimated from the currents of two sheets"""
    ASSUMED = 2
    """of the sheet's table: its range of radii, which the currents don't narrow"""
    CONTRADICTORY = 3
    """the two sheets contradict each other at any such radius: it is assumed, and `force_n` is by the
    first"""


class FrameStatus(StatusCode):
    """Status of a contact's position in the frame of the palm or the base."""

    NOT_COMPUTED = 0
    """no scene requests it, or no contact"""
    VALID = 1
    STALE = 2
    """the joint states that it depends on are too old"""
    INVALID = 3
    """no position on the link, or joints without any joint state"""
