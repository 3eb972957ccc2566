"""Scenes: outputs used by tasks, joined with subscriptions; nothing else is computed.

A scene states what a task uses. The deployment file has one; a control request may replace it, and clients
add their own for as long as they renew them. Of the union, only outputs with a subscriber are computed.

Public names: `ActiveScenes`, `SceneRequirements`, `Demand`, `FILE_OWNER`, `CONTROL_OWNER`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import BoolArray
from handtouch.config.tables import SceneRequest
from handtouch.core.pad_patterns import PadName, PadNames
from handtouch.wire import PERCEPT_KINDS

FILE_OWNER, CONTROL_OWNER = "the deployment file", "control"
MAX_CLIENTS = 32
MAX_CLIENT_CHARACTERS = 32_768
"""Length of the patterns of all clients' scenes, and of their names once for each pad: answers have them"""
_USUAL_PADS = 15  # of the paper's hand
_MAX_SUBSCRIPTIONS = 8
"""Subscriptions that are named for each pad"""
_OUTPUTS = ("position", "force", "raw", "palm", "base", *PERCEPT_KINDS)


def scaled_limit(limit: int, pads: int) -> int:
    """Return a limit that holds for the paper's hand for this number of pads: for more of them in proportion
    higher."""
    return limit * max(pads, _USUAL_PADS) // _USUAL_PADS


class SceneRequirements(NamedTuple):
    """Union of scenes over n pads; the rate [Hz] is the highest requested."""

    pads: BoolArray
    position: BoolArray
    force: BoolArray
    raw: BoolArray
    palm: BoolArray
    base: BoolArray
    rate_hz: NDArray[np.float64]
    """inf: at every SYNC"""
    percepts: BoolArray
    """(kinds, n), rows as PERCEPT_KINDS"""


class _ResolvedScene(NamedTuple):
    """A scene with the pads (n,) that its patterns name, and which of `_OUTPUTS` it has."""

    scene: SceneRequest
    pads: BoolArray
    outputs: BoolArray


def _merge_scenes(scenes: Sequence[_ResolvedScene]) -> SceneRequirements:
    """Return the union of scenes over the pads."""
    pads = np.array([held.pads for held in scenes])
    outputs = np.array([held.outputs for held in scenes])
    rate_hz = np.array([[held.scene.rate_hz or np.inf] for held in scenes])
    requested = outputs.T @ pads  # of truth values: any scene with this output and this pad
    position, force, raw, palm, base, *percepts = requested
    return SceneRequirements(
        pads=np.asarray(pads.any(axis=0)),
        position=position | palm | base,  # palm and base need the position on the link
        force=force,
        raw=raw,
        palm=palm,
        base=base,
        rate_hz=np.where(pads, rate_hz, 0.0).max(axis=0),
        percepts=np.array(percepts),
    )


class ActiveScenes:
    """The active scenes: a base, and those of clients by name, each until its lease ends. Times in ns.

    `requirements` is their union; `version` counts its changes.
    """

    def __init__(self, file: SceneRequest, names: Sequence[PadName]) -> None:
        self.pads = PadNames(names)
        self.version = 0
        self._file = self._resolve(file)
        self._base: _ResolvedScene | None = None  # replaces the file's
        self._clients: dict[str, tuple[_ResolvedScene, int]] = {}
        self.requirements = _merge_scenes([self._file])

    @property
    def names(self) -> list[PadName]:
        """Names of the pads."""
        return self.pads.names

    @property
    def base(self) -> SceneRequest:
        """The base scene: the file's, or its replacement by a control request."""
        return (self._base or self._file).scene

    def _resolve(self, scene: SceneRequest) -> _ResolvedScene:
        outputs = np.array([output in scene.outputs for output in _OUTPUTS])
        return _ResolvedScene(scene, self.pads.select(scene.links), outputs)

    def set_file(self, file: SceneRequest) -> None:
        """Set the deployment file's scene after a reload."""
        self._file = self._resolve(file)
        self._merge()

    def set_base(self, base: SceneRequest | None) -> None:
        """Replace the file's scene, None: restore it. Raises ValueError, changing nothing."""
        self._base = None if base is None else self._resolve(base)
        self._merge()

    def set_client_scene(self, client: str, scene: SceneRequest, lease_ns: int, now_ns: int) -> None:
        """Add a client's scene, or renew it. Raises ValueError, changing nothing."""
        known = self._clients.get(client)
        is_same = known is not None and known[0].scene == scene
        resolved = known[0] if known is not None and is_same else self._resolve(scene)
        if client not in self._clients and len(self._clients) >= MAX_CLIENTS:
            raise ValueError(f"{MAX_CLIENTS} clients have scenes already; wait until a lease ends")
        self._clients[client] = resolved, now_ns + lease_ns
        if not is_same:
            self._merge()

    def check_size(self, client: str, links: Sequence[str]) -> None:
        """Raise ValueError if a client's scene would make an answer longer than it may be."""
        patterns = {name: held.scene.links for name, (held, _) in self._clients.items()} | {client: links}
        pads = len(self.names)
        size = sum(len("".join(links)) + pads * len(name) for name, links in patterns.items())
        limit = scaled_limit(MAX_CLIENT_CHARACTERS, pads)
        if size > limit:
            raise ValueError(
                f"the patterns of all clients' scenes, and their names for each pad, have {size} characters, "
                f"and may have {limit}; use wildcards and shorter names, or wait until a lease ends"
            )

    def client_scene(self, client: str) -> SceneRequest | None:
        """Return a client's scene, None without one."""
        held = self._clients.get(client)
        return held[0].scene if held else None

    def remove_client(self, client: str) -> None:
        """Remove a client's scene."""
        if self._clients.pop(client, None):
            self._merge()

    def expire_leases(self, now_ns: int) -> None:
        """Remove scenes whose lease has ended."""
        if self._clients:
            for client in [name for name, (_, end_ns) in self._clients.items() if now_ns >= end_ns]:
                self.remove_client(client)

    def by_owner(self) -> dict[str, _ResolvedScene]:
        """Return every active scene and its pads by its owner."""
        base = {FILE_OWNER if self._base is None else CONTROL_OWNER: self._base or self._file}
        return base | {f"client {name}": scene for name, (scene, _) in self._clients.items()}

    def describe(self, now_ns: int) -> list[dict[str, Any]]:
        """Return the active scenes as plain values; `lease_s` is the rest of a client's lease."""
        ends = {f"client {name}": end_ns for name, (_, end_ns) in self._clients.items()}
        return [
            {
                "owner": owner,
                "links": list(scene.links),
                "outputs": list(scene.outputs),
                "rate_hz": scene.rate_hz,
                "lease_s": (ends[owner] - now_ns) * 1e-9 if owner in ends else None,
            }
            for owner, (scene, *_) in self.by_owner().items()
        ]

    def _merge(self) -> None:
        self.requirements = _merge_scenes(list(self.by_owner().values()))
        self.version += 1


class SubscriptionSource(Protocol):
    """Source of subscriptions: the daemon's publisher."""

    @property
    def subscriptions(self) -> frozenset[bytes]: ...

    def has_subscriber(self, topic: str) -> bool: ...


class RequestedOutputs(NamedTuple):
    """Outputs computed for each of n pads: they are in a scene and have a subscriber."""

    position: BoolArray
    force: BoolArray
    interval_ticks: NDArray[np.int64]
    """ticks from one update to the next"""
    palm: BoolArray
    base: BoolArray
    percepts: BoolArray | None = None
    """(kinds, n), rows as PERCEPT_KINDS; None: no percepts"""
    action_requests: BoolArray | None = None
    """pads that may get action requests"""

    @property
    def motion(self) -> BoolArray:
        """Pads (n,) whose slip and lift-off are detected."""
        if self.percepts is None:
            return np.zeros(len(self.position), dtype=np.bool_)
        return np.asarray(self.percepts[PERCEPT_KINDS.index("motion")])


class Demand:
    """Scenes joined with subscriptions; call `update` after every tick: it calls `apply` after changes.

    `disabled_by`: pad -> name of the client that disabled it.
    """

    def __init__(
        self,
        scenes: ActiveScenes,
        subscribers: SubscriptionSource,
        tick_hz: float,
        apply: Callable[[RequestedOutputs, SceneRequirements, BoolArray, int], None],
    ) -> None:
        n = len(scenes.names)
        self.scenes = scenes
        self.disabled_by: dict[int, str] = {}
        self.transformable = np.ones(n, dtype=np.bool_)
        """pads whose contacts can be transformed to palm and base"""
        self._subscribers, self._tick_hz, self._apply = subscribers, tick_hz, apply
        self._merged_versions: object = None
        self._disabled_version = 0
        self._described: list[dict[str, Any]] | None = None  # until something changes
        self.ticks_per_hand_frame = 1
        """ticks per hand frame, as the most frequently updated pad requires"""
        none = np.zeros(n, dtype=np.bool_)
        self.requested = RequestedOutputs(none, none, np.ones(n, dtype=np.int64), none, none)

    def update(self, now_ns: int) -> None:
        """Merge scenes and subscriptions again if any of them changed."""
        self.scenes.expire_leases(now_ns)
        versions = self.scenes.version, self._disabled_version, self._subscribers.subscriptions
        if versions != self._merged_versions:
            self._merged_versions = versions
            self._merge(now_ns)

    def disable(self, pads: Sequence[int], by: str) -> None:
        """Disable pads, on behalf of a named client."""
        self.disabled_by.update(dict.fromkeys(pads, by))
        self._disabled_version += 1

    def enable(self, pads: Sequence[int]) -> None:
        """Enable pads again."""
        for pad in pads:
            self.disabled_by.pop(pad, None)
        self._disabled_version += 1

    def describe_pads(self) -> list[dict[str, Any]]:
        """Return as plain values, for each pad: computed outputs, skipped ones with the reason, scenes and
        subscriptions; made once for each change of any."""
        if self._described is None:
            self._described = self._describe_pads()
        return self._described

    def _describe_pads(self) -> list[dict[str, Any]]:
        scenes = {owner: held.pads.tolist() for owner, held in self.scenes.by_owner().items()}
        subscriptions = sorted((p, p.decode("utf-8", "replace")) for p in self._subscribers.subscriptions)
        described = []
        for pad, (hand, link) in enumerate(self.scenes.names):
            topics = (f"contact/{hand}/{link}".encode(), f"hand/{hand}".encode())
            subscribed = [text for prefix, text in subscriptions if any(t.startswith(prefix) for t in topics)]
            if len(subscribed) > _MAX_SUBSCRIPTIONS:
                further = len(subscribed) - _MAX_SUBSCRIPTIONS + 1
                subscribed[_MAX_SUBSCRIPTIONS - 1 :] = [f"{further} more"]
            computed, skipped = self._computed_and_skipped(pad, bool(subscribed))
            described.append(
                {
                    "hand": hand,
                    "link": link,
                    "computed": computed,
                    "not_computed": skipped,
                    "scenes": [owner for owner, chosen in scenes.items() if chosen[pad]],
                    "subscriptions": subscribed,
                    "rate_hz": self._tick_hz / int(self.requested.interval_ticks[pad]),
                }
            )
        return described

    def _computed_and_skipped(self, pad: int, subscribed: bool) -> tuple[list[str], dict[str, str]]:
        needed = self.scenes.requirements
        raw = self._subscribers.has_subscriber(f"raw/{self.scenes.names[pad][0]}")
        requested = self.requested
        outputs = {
            "position": requested.position,
            "force": requested.force,
            "palm": requested.palm,
            "base": requested.base,
        }
        percepts: list[str] = []
        if requested.percepts is not None:
            percepts = [
                kind for kind, pads in zip(PERCEPT_KINDS, requested.percepts, strict=True) if pads[pad]
            ]
        contacts = (output for output, pads in outputs.items() if pads[pad])
        computed = ["contact", *contacts, *["raw"] * raw, *percepts]
        skipped = {}
        for output in ("contact", *outputs):
            if pad in self.disabled_by:
                skipped[output] = f"disabled by {self.disabled_by[pad]}"
            elif not needed.pads[pad]:
                skipped[output] = "in no scene"
            elif output == "contact" or outputs[output][pad]:
                if output in ("palm", "base") and not self.transformable[pad]:
                    skipped[output] = "the hand has no URDF"
            elif not subscribed:
                skipped[output] = "no subscriber"
            else:
                skipped[output] = "in no scene's outputs"
        if not raw:
            skipped["raw"] = "no subscriber"
        return [output for output in computed if output not in skipped], skipped

    def _merge(self, now_ns: int) -> None:
        names, needed, has = self.scenes.names, self.scenes.requirements, self._subscribers.has_subscriber
        subscribed = np.array([has(f"contact/{hand}/{link}") or has(f"hand/{hand}") for hand, link in names])
        enabled = np.ones(len(names), dtype=np.bool_)
        enabled[list(self.disabled_by)] = False
        subscribed &= enabled
        in_scene = enabled & needed.pads
        action_requests = in_scene & [has(f"percept/{hand}/action_request") for hand, _ in names]
        percepts = np.array([[has(f"percept/{hand}/{kind}") for hand, _ in names] for kind in PERCEPT_KINDS])
        percepts = in_scene & (percepts | needed.percepts | action_requests)
        motion, known_object = (PERCEPT_KINDS.index(kind) for kind in ("motion", "object"))
        percepts[motion] |= percepts[known_object]  # by which contacts stick
        perceived = percepts.any(axis=0)
        located = needed.position | needed.force  # force depends on the position
        with np.errstate(divide="ignore"):
            every = np.where(needed.pads & ~needed.raw, np.floor(self._tick_hz / needed.rate_hz + 1e-9), 1)
        every = np.where(perceived, 1, np.maximum(every, 1))  # slip is detected in any tick
        self.requested = RequestedOutputs(
            position=subscribed & located | perceived,
            force=subscribed & needed.force | perceived,
            interval_ticks=every.astype(np.int64),
            palm=subscribed & needed.palm | perceived & self.transformable,
            base=subscribed & needed.base,
            percepts=percepts if perceived.any() else None,
            action_requests=action_requests,
        )
        intervals = self.requested.interval_ticks[needed.pads]
        self.ticks_per_hand_frame = int(intervals.min()) if len(intervals) else 1
        self._described = None
        self._apply(self.requested, needed, enabled, now_ns)
