"""The scene: what is used of the hand, by whom; joined with subscriptions, and nothing else is computed.

A scene says what a task uses. The deployment file has one; control may put another in its place, and clients
add theirs for as long as they renew them. Of what the scenes hold, only what reaches somebody is computed.

Public names: `Scenes`, `Needs`, `Demand`, `select`, `FILE`, `CONTROL`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from handtouch.config.tables import Wants
from handtouch.percept.stream import KINDS

FILE, CONTROL = "the deployment file", "control"
MOST_CLIENTS = 32
BoolArray = NDArray[np.bool_]
Name = tuple[str, str]
"""hand, link"""


class Needs(NamedTuple):
    """What the scenes together use of each of n pads; tolerance [m] and rate [Hz] are the strictest asked."""

    pads: BoolArray
    location: BoolArray
    strength: BoolArray
    raw: BoolArray
    palm: BoolArray
    base: BoolArray
    tolerance_m: NDArray[np.float64]
    rate_hz: NDArray[np.float64]
    """inf: at every SYNC"""
    percepts: BoolArray
    """(kinds, n), rows as KINDS"""


def select(patterns: Sequence[str], names: Sequence[Name]) -> BoolArray:
    """Which of the pads (hand, link) a scene's patterns name: "thumb_*", "left/index_distal".

    Raises ValueError for a pattern that names none.
    """
    chosen = np.zeros(len(names), dtype=np.bool_)
    for pattern in patterns:
        full = pattern if "/" in pattern else f"*/{pattern}"
        hits = [fnmatchcase(f"{hand}/{link}", full) for hand, link in names]
        if not any(hits):
            known = ", ".join(f"{hand}/{link}" for hand, link in names)
            raise ValueError(f'no pad is named "{pattern}"; there are {known}')
        chosen |= np.array(hits)
    return chosen


def join(scenes: Sequence[Wants], names: Sequence[Name]) -> Needs:
    """The union of scenes over the pads. Raises ValueError for a pattern that names none."""
    n = len(names)
    pads, location, strength, raw, palm, base, *percepts = np.zeros((6 + len(KINDS), n), dtype=np.bool_)
    needs = Needs(
        pads, location, strength, raw, palm, base, np.full(n, np.inf), np.zeros(n), np.array(percepts)
    )
    for scene in scenes:
        chosen = select(scene.links, names)
        needs.pads[chosen] = True
        for output in ("location", "strength", "raw", "palm", "base"):
            getattr(needs, output)[chosen] |= output in scene.outputs
        needs.percepts[np.outer([kind in scene.outputs for kind in KINDS], chosen)] = True
        needs.location[chosen] |= bool(
            {"palm", "base"} & set(scene.outputs)
        )  # they are of a place on the link
        np.minimum(needs.tolerance_m, scene.tolerance_mm * 1e-3, out=needs.tolerance_m, where=chosen)
        np.maximum(needs.rate_hz, scene.rate_hz or np.inf, out=needs.rate_hz, where=chosen)
    needs.tolerance_m[~needs.pads] = 0.0
    return needs


class Scenes:
    """The scenes in force: a base, and those of clients by name, each until its lease ends. Times in ns.

    `needs` is their union; `version` counts its changes.
    """

    def __init__(self, file: Wants, names: Sequence[Name]) -> None:
        self.names = list(names)
        self.version = 0
        self._file = file
        self._base: Wants | None = None  # in place of the file's
        self._clients: dict[str, tuple[Wants, int]] = {}
        self.needs = join([file], self.names)

    @property
    def base(self) -> Wants:
        """The file's scene, or what control put in its place."""
        return self._base or self._file

    def set_file(self, file: Wants) -> None:
        """The deployment file was read again."""
        self._file = file
        self._rejoin()

    def set_base(self, base: Wants | None) -> None:
        """Put a scene in place of the file's, None: back to that. Raises ValueError, changing nothing."""
        if base is not None:
            select(base.links, self.names)
        self._base = base
        self._rejoin()

    def hold(self, client: str, scene: Wants, lease_ns: int, now_ns: int) -> None:
        """Add a client's scene, or renew it. Raises ValueError, changing nothing."""
        select(scene.links, self.names)
        if client not in self._clients and len(self._clients) >= MOST_CLIENTS:
            raise ValueError(f"{MOST_CLIENTS} clients hold scenes already; wait for a lease to end")
        known = self._clients.get(client)
        self._clients[client] = scene, now_ns + lease_ns
        if known is None or known[0] != scene:
            self._rejoin()

    def held_by(self, client: str) -> Wants | None:
        """The scene of a client, if it holds one."""
        held = self._clients.get(client)
        return held[0] if held else None

    def leave(self, client: str) -> None:
        """A client needs its scene no more."""
        if self._clients.pop(client, None):
            self._rejoin()

    def poll(self, now_ns: int) -> None:
        """End what was not renewed."""
        if self._clients:
            for client in [name for name, (_, end_ns) in self._clients.items() if now_ns >= end_ns]:
                self.leave(client)

    def all(self) -> dict[str, Wants]:
        """Every scene in force, by whose it is."""
        base = {FILE if self._base is None else CONTROL: self.base}
        return base | {f"client {name}": scene for name, (scene, _) in self._clients.items()}

    def tell(self, now_ns: int) -> list[dict[str, Any]]:
        """The scenes in force as plain values; `lease_s` is what is left of a client's."""
        ends = {f"client {name}": end_ns for name, (_, end_ns) in self._clients.items()}
        return [
            {
                "of": of,
                "links": list(scene.links),
                "outputs": list(scene.outputs),
                "tolerance_mm": scene.tolerance_mm,
                "rate_hz": scene.rate_hz,
                "lease_s": (ends[of] - now_ns) * 1e-9 if of in ends else None,
            }
            for of, scene in self.all().items()
        ]

    def _rejoin(self) -> None:
        self.needs = join(list(self.all().values()), self.names)
        self.version += 1


class Listeners(Protocol):
    """Who listens: `Publisher`."""

    @property
    def subscriptions(self) -> frozenset[bytes]: ...

    def wants(self, topic: str) -> bool: ...


class Wanted(NamedTuple):
    """What is computed for each of n pads: somebody hears of it, and a scene holds it."""

    located: BoolArray
    weighed: BoolArray
    tolerance_m: NDArray[np.float64]
    every: NDArray[np.int64]
    """ticks from one update to the next"""
    palm: BoolArray
    base: BoolArray
    percepts: BoolArray | None = None
    """(kinds, n), rows as KINDS; None: nothing is perceived"""
    asks: BoolArray | None = None
    """pads that questions may be asked of"""


class Demand:
    """Joins scenes with subscriptions; `step` it after every tick: it calls `apply` with what has changed.

    `disabled` (n,) are pads that somebody switched off, `disabled_by` their names.
    """

    def __init__(
        self,
        scenes: Scenes,
        listeners: Listeners,
        tick_hz: float,
        apply: Callable[[Wanted, Needs, BoolArray, int], None],
    ) -> None:
        n = len(scenes.names)
        self.scenes = scenes
        self.disabled_by: dict[int, str] = {}
        self.placeable = np.ones(n, dtype=np.bool_)
        """pads whose place in palm and base can be known"""
        self._listeners, self._tick_hz, self._apply = listeners, tick_hz, apply
        self._seen: object = None
        self._disabled_version = 0
        self.frames_every = 1
        """ticks from one frame of a hand to the next: as its busiest pad needs"""
        none = np.zeros(n, dtype=np.bool_)
        self.wanted = Wanted(none, none, np.zeros(n), np.ones(n, dtype=np.int64), none, none)

    def step(self, now_ns: int) -> None:
        """Notice what changed, if anything did."""
        self.scenes.poll(now_ns)
        seen = self.scenes.version, self._disabled_version, self._listeners.subscriptions
        if seen != self._seen:
            self._seen = seen
            self._join(now_ns)

    def disable(self, pads: Sequence[int], by: str) -> None:
        """Switch pads off, in the name of somebody."""
        self.disabled_by.update(dict.fromkeys(pads, by))
        self._disabled_version += 1

    def enable(self, pads: Sequence[int]) -> None:
        """Switch pads on again."""
        for pad in pads:
            self.disabled_by.pop(pad, None)
        self._disabled_version += 1

    def tell(self) -> list[dict[str, Any]]:
        """Of each pad: what is computed, what is skipped and why, and for whom, as plain values."""
        scenes = {of: (select(s.links, self.scenes.names), s) for of, s in self.scenes.all().items()}
        told = []
        for pad, (hand, link) in enumerate(self.scenes.names):
            topics = (f"contact/{hand}/{link}".encode(), f"hand/{hand}".encode())
            held = {of: scene for of, (chosen, scene) in scenes.items() if chosen[pad]}
            prefixes = [p for p in self._listeners.subscriptions if any(t.startswith(p) for t in topics)]
            heard = sorted(prefix.decode("utf-8", "replace") for prefix in prefixes)
            computed, skipped = self._outputs(pad, bool(heard))
            told.append(
                {
                    "hand": hand,
                    "link": link,
                    "computed": computed,
                    "skipped": skipped,
                    "scenes": list(held),
                    "subscriptions": heard,
                    "tolerance_mm": float(self.wanted.tolerance_m[pad]) * 1e3,
                    "rate_hz": self._tick_hz / int(self.wanted.every[pad]),
                }
            )
        return told

    def _outputs(self, pad: int, heard: bool) -> tuple[list[str], dict[str, str]]:
        needs = self.scenes.needs
        raw = self._listeners.wants(f"raw/{self.scenes.names[pad][0]}")
        wanted = self.wanted
        on = {
            "location": wanted.located,
            "strength": wanted.weighed,
            "palm": wanted.palm,
            "base": wanted.base,
        }
        felt = (
            [kind for kind, pads in zip(KINDS, wanted.percepts, strict=True) if pads[pad]]
            if (wanted.percepts is not None)
            else []
        )
        computed = ["touched", *(output for output, pads in on.items() if pads[pad]), *["raw"] * raw, *felt]
        skipped = {}
        for output in ("touched", *on):
            if pad in self.disabled_by:
                skipped[output] = f"disabled by {self.disabled_by[pad]}"
            elif not needs.pads[pad]:
                skipped[output] = "outside every scene"
            elif output == "touched" or on[output][pad]:
                if output in ("palm", "base") and not self.placeable[pad]:
                    skipped[output] = "the hand has no URDF, or handtouch[urdf] isn't installed"
            elif not heard:
                skipped[output] = "nobody subscribed"
            else:
                skipped[output] = "in no scene's outputs"
        if not raw:
            skipped["raw"] = "nobody subscribed"
        return [output for output in computed if output not in skipped], skipped

    def _join(self, now_ns: int) -> None:
        names, needs, wants = self.scenes.names, self.scenes.needs, self._listeners.wants
        heard = np.array([wants(f"contact/{hand}/{link}") or wants(f"hand/{hand}") for hand, link in names])
        enabled = np.ones(len(names), dtype=np.bool_)
        enabled[list(self.disabled_by)] = False
        heard &= enabled
        held = enabled & needs.pads
        asks = held & [wants(f"percept/{hand}/ask") for hand, _ in names]
        percepts = np.array([[wants(f"percept/{hand}/{kind}") for hand, _ in names] for kind in KINDS])
        percepts = held & (percepts | needs.percepts | asks)
        felt = percepts.any(axis=0)
        with np.errstate(divide="ignore"):
            every = np.where(needs.pads & ~needs.raw, np.floor(self._tick_hz / needs.rate_hz + 1e-9), 1)
        self.wanted = Wanted(
            located=heard & (needs.location | needs.strength) | felt,  # strength depends on the place
            weighed=heard & needs.strength | felt,
            tolerance_m=np.where((needs.location | needs.strength) & ~felt, needs.tolerance_m, 0.0),
            every=np.where(felt, 1, np.maximum(every, 1)).astype(np.int64),  # a slip may come at any tick
            palm=heard & needs.palm | felt & self.placeable,
            base=heard & needs.base,
            percepts=percepts if felt.any() else None,
            asks=asks,
        )
        self.frames_every = int(self.wanted.every[needs.pads].min()) if needs.pads.any() else 1
        self._apply(self.wanted, needs, enabled, now_ns)
