"""Scenario files (TOML): touches on links, faults, replaced nodes and joint motion over time, checked.

Public name: `Scenario`. Mistakes are reported like those in a deployment file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, ValidationError

from handtouch.config import Deployment
from handtouch.config.base import Table
from handtouch.config.problems import ConfigError, Problem, problems_of
from handtouch.config.toml_text import parse_toml, read_text
from handtouch.hand.urdf import RobotDescription
from handtouch.simulate.base_motion import BaseTurn, Skin
from handtouch.simulate.contact_patch import ContactPatch
from handtouch.simulate.faults import FAULTS, INFLUENCES, AnyFault, Fault
from handtouch.simulate.joints import JointMotion, ScenarioJoints
from handtouch.simulate.node_faults import NODE_FAULTS, AnyNodeFault, NodeFault
from handtouch.simulate.stimulus import AppliedContact, NodeReplacement
from handtouch.simulate.touch import ScenarioTouch, ScheduledTouches

_TOUR_TOUCH_S, _TOUR_STEP_S = 1.6, 1.0
_KINDS: dict[str, dict[str, type[Table]]] = {"fault": {**FAULTS, **INFLUENCES}, "node_fault": {**NODE_FAULTS}}


class Scenario(Table):
    """Touches, faults and events of a hand; after the last touch it ends, or starts again after `pause_s`."""

    touches: Annotated[tuple[ScenarioTouch, ...], Field(strict=False, min_length=1)] = Field(alias="touch")
    faults: Annotated[tuple[AnyFault, ...], Field(strict=False)] = Field(
        (), alias="fault", description="faults of pads, and when they are active"
    )
    node_replacements: Annotated[tuple[NodeReplacement, ...], Field(strict=False)] = Field(
        (), alias="swap", description="nodes that are replaced, and when"
    )
    node_faults: Annotated[tuple[AnyNodeFault, ...], Field(strict=False)] = Field(
        (), alias="node_fault", description="faults of nodes, and when they are active"
    )
    motions: Annotated[tuple[JointMotion, ...], Field(strict=False)] = Field(
        (), alias="joint", description="joint motion; without any the joints don't move"
    )
    skin: Skin | None = Field(None, description="weight of the skin; without it, it weighs nothing")
    turns: Annotated[tuple[BaseTurn, ...], Field(strict=False)] = Field(
        (), alias="turn", description="turns of the hand's base"
    )
    repeat: bool = Field(False, description="start again after the end")
    pause_s: float = Field(1.0, ge=0, description="time from the last touch to the end, or to the repetition")

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read and check a scenario file. Raises ConfigError naming every mistake."""
        return cls.parse(read_text(Path(path), "a scenario file"), str(path))

    @classmethod
    def parse(cls, text: str, file: str = "scenario.toml") -> Self:
        """Check the text of a scenario file. Raises ConfigError naming every mistake."""
        raw = parse_toml(text, file)
        try:
            scenario = cls.model_validate(raw)
        except ValidationError as error:
            tables: dict[str, type[Table]] = {
                "": cls,
                "touch": ScenarioTouch,
                "swap": NodeReplacement,
                "joint": JointMotion,
                "skin": Skin,
                "turn": BaseTurn,
            }
            raise ConfigError(file, problems_of(raw, error, tables, _KINDS)) from error
        return scenario

    @classmethod
    def tour(cls, deployment: Deployment) -> Self:
        """Return a scenario with one sliding touch per pad, each begun before the previous one ends.

        Those on pads above shear pads have tangential forces.
        """
        links = {entry.pad.link: entry.pad.shear for entry in deployment.pads}
        touches = [
            ScenarioTouch(
                link=link,
                from_s=1.0 + number * _TOUR_STEP_S,
                duration_s=_TOUR_TOUCH_S,
                path=((0.3, 0.35), (0.7, 0.5), (0.4, 0.65)),
                force_n=(0.5, 2.0, 1.0),
                tangential_n=((0.1, 0.0), (0.8, -0.4), (0.2, 0.3)) if shear else (),
            )
            for number, (link, shear) in enumerate(links.items())
        ]
        return cls.model_validate({"touch": touches, "repeat": True})

    @property
    def duration_s(self) -> float:
        """Duration of one pass."""
        return max(touch.until_s for touch in self.touches) + self.pause_s

    @property
    def touch_links(self) -> list[str]:
        """Link of each touch."""
        return [touch.link for touch in self.touches]

    def touch_patch(self, number: int, drawn: ContactPatch) -> ContactPatch:
        """Return the patch of a touch; `drawn`: the world's, where the touch doesn't define its own."""
        return self.touches[number].patch(drawn)

    def pad_stimulus(self, link: str, patch: Callable[[int], ContactPatch]) -> ScheduledTouches:
        """Return the touches of one pad; `patch(number)`: the world's, as in `touch_patch`."""
        return ScheduledTouches(
            [
                (touch, touch.patch(patch(number)))
                for number, touch in enumerate(self.touches)
                if touch.link == link
            ]
        )

    def joint_trajectory(self, robot: RobotDescription) -> ScenarioJoints | None:
        """Return the joint motion of a hand; None if neither its joints nor its base move."""
        moves = self.motions or self.turns
        return ScenarioJoints(robot.joints.values(), self.motions) if moves else None

    def contacts_at(self, t_s: float) -> list[AppliedContact]:
        """Return the contacts of all pads at `t_s`."""
        if self.repeat:
            t_s %= self.duration_s
        return [
            AppliedContact(number, *touch.position_at(t_s), force)
            for number, touch in enumerate(self.touches)
            if touch.from_s < t_s < touch.until_s and (force := touch.force_at(t_s)) > 0
        ]

    def check_links(self, links: Iterable[str], file: str = "scenario") -> None:
        """Raise ConfigError if a touch, fault or replacement names a link that carries no pad."""
        known = sorted(set(links))
        tables: tuple[tuple[str, Sequence[ScenarioTouch | Fault | NodeFault | NodeReplacement]], ...] = (
            ("touch", self.touches),
            ("fault", self.faults),
            ("node_fault", self.node_faults),
            ("swap", self.node_replacements),
        )
        problems = [
            Problem(
                f"[[{table}]] {number}: link",
                f' = "{entry.link}"',
                f"carries no pad; pads: {', '.join(known)}",
            )
            for table, entries in tables
            for number, entry in enumerate(entries, 1)
            if entry.link not in known
        ]
        if problems:
            raise ConfigError(file, tuple(problems))
