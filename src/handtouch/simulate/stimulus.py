"""Input of a simulated hand, as an interface: contacts, faults, replaced nodes, joint motion over time.

Implemented by `Scenario` (a file), `GraspStimulus` (a grasp in MuJoCo) and `GripperStimulus` (live commands).
Public names: `Stimulus` (a whole hand), `PadStimulus` (one pad), `AppliedContact`, `JointTrajectory`,
`NodeReplacement`, `EventlessStimulus` (a base).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, Protocol, Self

from pydantic import Field, model_validator

from handtouch.arrays import FloatArray
from handtouch.config.base import Name, Positive, PositivePerChannel, Table
from handtouch.config.tables import Unsigned32
from handtouch.hand.urdf import RobotDescription
from handtouch.simulate.base_motion import BaseTurn, Skin
from handtouch.simulate.contact_patch import ContactPatch
from handtouch.simulate.faults import Fault
from handtouch.simulate.node_faults import NodeFault


class AppliedContact(NamedTuple):
    """A contact at one moment: number of its touch, position as fractions of the pad, force."""

    touch_number: int
    x: float
    y: float
    force_n: float
    radius_m: float | None = None
    """Radius of a disc; None: the touch's radius, or the world's patch."""


class NodeReplacement(Table):
    """`[[swap]]`: a pad's node is replaced by one with another serial number, or its sheet by another one."""

    link: Name = Field(description="link whose pad gets another node or sheet")
    at_s: float = Field(ge=0, description="time since the start; happens once, even in a repeating scenario")
    serial: Unsigned32 | None = Field(
        None, description="serial number of the new node; left out: the node stays"
    )
    sheet: int | None = Field(
        None,
        ge=1,
        le=1_000_000,
        description="number of the new sheet, by which resistances, law, gaps and behaviour are drawn; its "
        "state is fresh; left out: the sheet stays",
    )
    contact_ohm_ratio: Positive | None = Field(
        None, description="contact resistance of the new sheet over the old one's; left out: drawn by sheet"
    )
    gain: PositivePerChannel | None = Field(
        None,
        description="gains of its channels, relative to the configured ones; left out: drawn by serial",
    )

    @model_validator(mode="after")
    def _check_parts(self) -> Self:
        if self.serial is None and self.sheet is None:
            raise ValueError("must have serial, of a new node, or sheet, the number of a new one")
        if self.gain is not None and self.serial is None:
            raise ValueError("gain: is of a new node, which needs serial")
        if self.contact_ohm_ratio is not None and self.sheet is None:
            raise ValueError("contact_ohm_ratio: is of a new sheet, which needs sheet")
        return self


class JointTrajectory(Protocol):
    """Joint positions of a hand over time."""

    def positions_at(self, t_s: float) -> dict[str, float]:
        """Return the reported position of each joint at `t_s` [rad or m]."""


class PadStimulus(Protocol):
    """Contacts on one pad over time."""

    @property
    def max_contacts(self) -> int:
        """Largest number of simultaneous contacts."""

    @property
    def event_times_s(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Times [s]: to sample the force at; after which the sheet settles; at which touches begin."""

    def contacts(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return positions (k, 2, n), forces (k, n) [N], 0 without contact, and patches.

        k is `max_contacts`, n the number of times. patches: (k, PATCH_ROWS, n), see `ContactPatch.column`.
        """

    def tangential_n(self, times_s: FloatArray) -> FloatArray:
        """Return the sum (2, n) of the contacts' tangential forces along x and y of the pad [N]."""


class Stimulus(Protocol):
    """Input of a simulated hand. Times are seconds since the start; a repeating one starts again at 0."""

    @property
    def faults(self) -> Sequence[Fault]: ...
    @property
    def node_faults(self) -> Sequence[NodeFault]: ...
    @property
    def node_replacements(self) -> Sequence[NodeReplacement]: ...
    @property
    def repeat(self) -> bool: ...
    @property
    def duration_s(self) -> float:
        """Duration of one pass."""

    @property
    def skin(self) -> Skin | None:
        """Skin that presses on the sheets by its weight; None: not simulated."""

    @property
    def turns(self) -> Sequence[BaseTurn]:
        """Turns of the base."""

    @property
    def touch_links(self) -> Sequence[str]:
        """Link of each touch."""

    def touch_patch(self, number: int, drawn: ContactPatch) -> ContactPatch:
        """Return the patch of a touch; `drawn`: the world's, where the touch doesn't define its own."""

    def contacts_at(self, t_s: float) -> list[AppliedContact]:
        """Return the contacts of all pads at `t_s`."""

    def pad_stimulus(self, link: str, patch: Callable[[int], ContactPatch]) -> PadStimulus:
        """Return the contacts of one pad; `patch(number)`: the world's, as in `touch_patch`."""

    def joint_trajectory(self, robot: RobotDescription) -> JointTrajectory | None:
        """Return the joint motion of a hand; None if its joints don't move."""

    def check_links(self, links: Iterable[str], file: str = ...) -> None:
        """Raise ConfigError if a touch, fault or replacement names a link that carries no pad."""


class EventlessStimulus:
    """Base of a `Stimulus` without end and events other than contacts, whose patches are the world's."""

    faults: Sequence[Fault] = ()
    node_faults: Sequence[NodeFault] = ()
    node_replacements: Sequence[NodeReplacement] = ()
    skin: Skin | None = None
    turns: Sequence[BaseTurn] = ()
    repeat = False
    duration_s = math.inf

    def touch_patch(self, number: int, drawn: ContactPatch) -> ContactPatch:  # noqa: ARG002
        """Return the world's patch."""
        return drawn
