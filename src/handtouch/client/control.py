"""Requests to a daemon as methods with typed results.

    control = handtouch.DaemonControl()
    for pad in control.tare("right/thumb_*"):
        print(pad["link"], pad["tared"], pad["reason"])

Public names: `DaemonControl`, and the types of its results.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NotRequired, TypedDict, TypeVar, cast

from handtouch import wire
from handtouch.client.subscriber import request
from handtouch.host.endpoints import CONTROL_ENDPOINT
from handtouch.wire.contact import Output

SHORT_TIMEOUT_S, LONG_TIMEOUT_S = 3.0, 60.0
SLOW_COMMANDS = ("tare", "reload")
M = TypeVar("M")


class TareResult(TypedDict):
    """Result of one pad; counts are of x0, xa, y0, yb."""

    hand: str
    link: str
    tared: bool
    reason: str
    """why it wasn't tared, with a remedy"""
    samples: int
    offset_counts: list[float]
    """active now"""
    second_offset_counts: NotRequired[float | None]
    """of a second sheet's channel; None without one"""
    mean_counts: NotRequired[list[float]]
    std_counts: NotRequired[list[float]]
    begin_threshold_n: NotRequired[float]
    """in the deployment"""
    least_begin_threshold_n: NotRequired[float | None]
    """lower bound of it for one false contact in 100 hours, by the noise of this second and drift so far"""


class ActiveScene(TypedDict):
    """One scene: what the deployment file, an operator or a client requires."""

    owner: str
    links: list[str]
    outputs: list[Output]
    rate_hz: float | None
    """None: every SYNC"""
    lease_s: float | None
    """remaining; None: unlimited"""


class PadDemand(TypedDict):
    """Computed and other outputs of one pad."""

    hand: str
    link: str
    computed: list[str]
    not_computed: dict[str, str]
    """output -> reason"""
    scenes: list[str]
    """owners"""
    subscriptions: list[str]
    """prefixes that match its contacts"""
    rate_hz: float


class Scenes(TypedDict):
    """All scenes, and what follows for each pad."""

    scenes: list[ActiveScene]
    pads: list[PadDemand]


class LawValues(TypedDict):
    """Contact law of a pad's sheet."""

    contact_ohm_mm2: float
    """resistance times area of the layer at the reference pressure [ohm mm^2]"""
    alpha: float
    """its exponent of pressure"""
    ohm_per_square: float
    """of the sheet"""
    hertz_force_n: NotRequired[float | None]
    """force at which a contact has `contact_radius_mm`, which grows as force^(1/3); None: it doesn't"""
    age_s: NotRequired[float]
    """age of the contacts that it was measured by; where a sheet creeps, the law holds at that age [s]"""


class PadCalibration(TypedDict):
    """Active calibration of one pad; four values are of x0, xa, y0, yb."""

    hand: str
    link: str
    calibration_id: str
    previous_calibration_id: str
    default_calibration_id: str
    gains: list[float]
    offset_counts: list[float]
    law: LawValues
    second_law: NotRequired[LawValues | None]
    """of its second sheet; None without one"""
    store: str | None
    """path of the calibration store that the daemon reads; None without supervisor"""


class HandObject(TypedDict):
    """The object in a hand."""

    hand: str
    name: str | None
    """None: none is stated"""
    table: dict[str, Any] | None
    """as [object.NAME] of a deployment"""


class ReloadResult(TypedDict):
    """Changes of the deployment file."""

    applied: bool
    tables: list[str]
    pads: dict[str, list[str]]
    """hand/link -> changed keys"""


@dataclass(frozen=True)
class DaemonStatus:
    """The daemon, its pads and its scenes."""

    service: wire.Service
    pads: tuple[wire.Health, ...]
    scene: Scenes


@dataclass(frozen=True)
class Snapshot:
    """Everything about the present contacts, computed whether a scene requests it or not."""

    hands: Mapping[str, wire.HandFrame]
    contacts: tuple[wire.Contact, ...]


class DaemonControl:
    """The commands of a daemon's control endpoint.

    Pads are selected by patterns over `hand/link` or `link`. Every method raises TimeoutError when no daemon
    answers, RuntimeError with the daemon's cause and remedy when it refuses, PermissionError when it rejects
    this client, ValueError for an invalid endpoint or an unusable key file. `key` as for `connect`.
    """

    def __init__(self, endpoint: str = CONTROL_ENDPOINT, key: Path | str | None = None) -> None:
        self.endpoint = endpoint
        self._key = key

    def status(self) -> DaemonStatus:
        """Return the daemon's state, that of every pad, and the scenes."""
        answer = self._request("status")
        pads = tuple(wire.from_map(wire.Health, pad) for pad in answer["pads"])
        return DaemonStatus(wire.from_map(wire.Service, answer["service"]), pads, answer["scene"])

    def snapshot(self) -> Snapshot:
        """Return all hands and contacts now."""
        answer = self._request("snapshot")
        hands = {hand: wire.from_map(wire.HandFrame, frame) for hand, frame in answer["hands"].items()}
        return Snapshot(hands, tuple(wire.from_map(wire.Contact, contact) for contact in answer["contacts"]))

    def tare(self, *pads: str) -> list[TareResult]:
        """Zero pads, by default all; takes a second. A loaded pad isn't tared, see `reason`."""
        answer = self._request("tare", pads=list(pads) or ["*"])
        return list(answer["pads"])

    def scene(
        self,
        *,
        links: Sequence[str] | None = None,
        outputs: Sequence[Output] | None = None,
        rate_hz: float | None = None,
        name: str | None = None,
        lease_s: float | None = None,
        reset: bool = False,
    ) -> Scenes:
        """Change the base scene, or with `name` a client's own for `lease_s`; return all scenes.

        Arguments left out stay as they are; without any, nothing changes. `links`: patterns of the pads in
        use, the others are switched off. `rate_hz` 0: every SYNC.
        """
        given = {"links": _list(links), "outputs": _list(outputs), "rate_hz": rate_hz, "name": name}
        given |= {"lease_s": lease_s, "reset": reset or None}
        changes = {key: value for key, value in given.items() if value is not None}
        answer = self._request("scene", **changes)
        return Scenes(scenes=answer["scenes"], pads=answer["pads"])

    def disable(self, *pads: str, name: str | None = None) -> dict[str, str]:
        """Switch pads off, under the name of who does; return all disabled ones, `hand/link` -> name."""
        return self._switch("disable", pads, name)

    def enable(self, *pads: str, name: str | None = None) -> dict[str, str]:
        """Switch pads on; return those that stay disabled, `hand/link` -> name."""
        return self._switch("enable", pads, name)

    def calibrate(
        self,
        pad: str,
        name: str | None = None,
        *,
        gains: Sequence[float] | None = None,
        offset_counts: Sequence[float] | None = None,
        law: LawValues | None = None,
        second_law: LawValues | None = None,
    ) -> PadCalibration:
        """Set gains (c,), offsets (c,) or laws of one pad under a calibration's name; return all of it.

        With the pad alone, nothing changes.
        """
        given = {
            "name": name,
            "gains": _list(gains),
            "offset_counts": _list(offset_counts),
            "law": law,
            "second_law": second_law,
        }
        changes = {key: value for key, value in given.items() if value is not None}
        answer = self._request("calibrate", pad=pad, **changes)
        return cast(PadCalibration, {key: answer.get(key) for key in PadCalibration.__annotations__})

    def reload(self, *, dry_run: bool = False) -> ReloadResult:
        """Read the deployment file again and apply it; `dry_run`: only return what would change."""
        answer = self._request("reload", dry_run=dry_run)
        return ReloadResult(applied=answer["applied"], tables=answer["tables"], pads=answer["pads"])

    def object(
        self,
        hand: str,
        name: str | None = None,
        shape: Mapping[str, Any] | None = None,
        *,
        none: bool = False,
    ) -> HandObject:
        """Set the object in a hand, whose pose the percept `object` estimates; return it.

        `name`: of the deployment, or with `shape`, as in its [object.NAME], of another; a mesh must be stated
        there. `none`: the hand has no known object. With the hand alone, nothing changes.
        """
        given = {
            "name": name,
            "table": None if shape is None else {"shape": dict(shape)},
            "none": none or None,
        }
        changes = {key: value for key, value in given.items() if value is not None}
        answer = self._request("object", hand=hand, **changes)
        return HandObject(hand=answer["hand"], name=answer["name"], table=answer["table"])

    def log(self, level: Literal["debug", "info", "warning", "error"]) -> str:
        """Set the daemon's log level; return the previous one."""
        return str(self._request("log", level=level)["previous_level"])

    def _switch(self, command: str, pads: Sequence[str], name: str | None) -> dict[str, str]:
        if not pads:
            raise ValueError(f'{command}: name the pads; "*" is all of them')
        by = {} if name is None else {"name": name}
        return dict(self._request(command, pads=list(pads), **by)["disabled"])

    def _request(self, command: str, **arguments: Any) -> dict[str, Any]:
        timeout_s = LONG_TIMEOUT_S if command in SLOW_COMMANDS else SHORT_TIMEOUT_S
        return request(command, endpoint=self.endpoint, key=self._key, timeout_s=timeout_s, **arguments)


def _list(values: Sequence[Any] | None) -> list[Any] | None:
    if isinstance(values, str):
        raise ValueError(f"{values!r} is one string; give a list, [{values!r}]")
    return None if values is None else list(values)
