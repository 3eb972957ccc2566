"""Episodes for bench_diagnose: a small hand in use, and a fault of one of its pads."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from handtouch import config
from handtouch.config import shipped
from handtouch.config.surfaces import PadSurface
from handtouch.hand import pad_surface
from handtouch.simulate.faults import FAULTS, INFLUENCES, Fault
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, Family, World, world_with
from handtouch.supervisor.diagnose import DiagnosisModel, HandDiagnostics, HandSamples
from handtouch.wire.faults import FaultKind

PADS = ("index_distal", "index_proximal", "palm_thumb")
RATE_HZ = 100
BLOCK = 50  # samples
BLOCKS_AT_ONCE = 20
"""Blocks of samples that are computed together: an episode may end early."""
LENGTH_S = 110.0
ELECTRODES = ("x0", "xa", "y0", "yb")
FAULTY = {
    "gum": FaultKind.GUM,
    "moisture": FaultKind.MOISTURE,
    "dead electrode": FaultKind.DEAD_ELECTRODE,
    "shorted electrode": FaultKind.SHORTED_ELECTRODE,
    "swapped cables": FaultKind.SWAPPED_CABLES,
    "saturated channel": FaultKind.SATURATED_CHANNEL,
    "stuck channel": FaultKind.STUCK_CHANNEL,
    "torn corner": FaultKind.TORN_CORNER,
    "offset": FaultKind.OFFSET,
    "gain step": FaultKind.GAIN_STEP,
    "hysteresis tail": FaultKind.HYSTERESIS_TAIL,
}
"""Fault played, and its right diagnosis."""
EPISODES_OF_HAND = 5
"""Seeds that share a drawn hand, as its sheets are costly."""
FAULT_FREE = ("plain use", "long grasp", "wet object", "sweeping wipes", "hot cup", "two objects")


@dataclass(frozen=True)
class Episode:
    """One episode: a fault of pad `link` from begin_s on, and its size."""

    name: str
    seed: int
    link: str
    begin_s: float
    details: dict[str, Any]
    deployment: config.Deployment
    """As the builder of the drawn hand describes it."""
    hand: VirtualHand

    def blocks(self, length_s: float = LENGTH_S) -> Iterator[HandSamples]:
        """Yield its samples in blocks."""
        return sample_blocks(self.hand, length_s)


def sample_blocks(hand: VirtualHand, length_s: float) -> Iterator[HandSamples]:
    """Yield the samples of a hand in blocks."""
    ticks = int(length_s * RATE_HZ) // BLOCK * BLOCK
    fresh = np.ones((BLOCK, len(PADS)), dtype=np.bool_)
    some = BLOCKS_AT_ONCE * BLOCK
    for start in range(0, ticks, some):
        times = np.arange(start, min(start + some, ticks)) / RATE_HZ
        counts = np.stack([hand.counts(row, times) for row in range(len(PADS))], axis=1)
        stamps = np.repeat(np.rint(times * 1e9).astype(np.int64)[:, None], len(PADS), axis=1)
        for first in range(0, len(times), BLOCK):
            part = slice(first, first + BLOCK)
            yield HandSamples(stamps[part], counts[part], fresh)


@lru_cache(maxsize=1)
def deployment() -> config.Deployment:
    """Three pads of the shipped hand: a fingertip, a phalanx, one of the palm."""
    whole = config.load(shipped.path("utah_mit.toml"))
    (hand,) = whole.hands
    pads = tuple(pad for link in PADS for pad in hand.pads if pad.link == link)
    return whole.model_copy(update={"hands": (hand.model_copy(update={"pads": pads}),)})


def hand_of(seed: int) -> int:
    """Return the number of the hand of a seed."""
    return seed // EPISODES_OF_HAND


def episode(name: str, seed: int, world: World) -> Episode:
    """Return the episode of that name and seed, on a hand drawn in a world for the reporting family."""
    rng = np.random.default_rng((seed, sum(name.encode())))
    link = PADS[int(rng.integers(len(PADS)))]
    begin_s = float(rng.uniform(15, 30))
    play = Play(rng)
    faults: list[Fault] = []
    details: dict[str, Any] = {}
    if name in FAULTY and name != "hysteresis tail":
        details = draw_fault(name, rng, _size_mm(link))
        kind = details.pop("kind")
        faults.append(FAULTS[kind].model_validate({"kind": kind, "link": link, "from_s": begin_s, **details}))
        for pad in PADS:
            play.use(pad, 0.5, LENGTH_S)
    elif name == "hysteresis tail":
        details = play.tail(link, begin_s)
    elif name == "long grasp":
        details = play.grasp(begin_s, 70.0)
    elif name == "wet object":
        details = play.wet(link, begin_s)
    elif name == "hot cup":
        details = play.grasp(begin_s, 70.0)
        for pad in PADS:
            heat = {"kind": "heat", "link": pad, "from_s": begin_s, "until_s": begin_s + 70.0}
            warmer = float(rng.uniform(10, 30))
            faults.append(INFLUENCES["heat"].model_validate({**heat, "warmer_by_k": warmer}))
    elif name == "sweeping wipes":
        play.wipes(link, begin_s)
    elif name == "two objects":
        play.two(link, begin_s)
    else:
        for pad in PADS:
            play.use(pad, 0.5, LENGTH_S)
    touches = tuple(play.touches)
    drawn = world.draw(Family.REPORTING.seed(hand_of(seed)))
    described = drawn.describe(deployment())
    hand = VirtualHand(described, Scenario(touch=touches), drawn, faults=tuple(faults))
    return Episode(name, seed, link, begin_s, details, described, hand)


class Play:
    """Touches of an episode, as they come to be."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self.touches: list[ScenarioTouch] = []

    def use(self, link: str, from_s: float, until_s: float) -> None:
        """Taps, presses and slides one after another, with rests."""
        rng, at = self._rng, from_s + float(self._rng.uniform(0, 3))
        while at < until_s - 1:
            length = float(rng.uniform(0.4, 2.5))
            path = [self._place()]
            if rng.uniform() < 0.3:
                path.append(self._place())
            force = np.exp(rng.uniform(np.log(0.4), np.log(5.0), int(rng.integers(1, 4))))
            self._add(link, at, length, path, force.tolist())
            at += length + float(rng.uniform(0.3, 4.0))

    def held(self, link: str, from_s: float, length_s: float) -> dict[str, Any]:
        """Hold an object with a tremor of 0.03 to 0.5 mm and 0.5 to 10 % of its force, at about 3 Hz."""
        rng = self._rng
        steps = int(3 * length_s)
        middle, size = np.array(self._place(0.15)), _size_mm(link)
        wander_mm = float(np.exp(rng.uniform(np.log(0.03), np.log(0.5))))
        relative = float(np.exp(rng.uniform(np.log(0.005), np.log(0.1))))
        force = float(np.exp(rng.uniform(np.log(0.4), np.log(5.0))))
        path = np.clip(middle + rng.normal(size=(steps, 2)) * wander_mm / np.array(size), 0.02, 0.98)
        forces = force * np.exp(relative * rng.normal(size=steps))
        self._add(link, from_s, length_s, [(float(x), float(y)) for x, y in path], forces.tolist())
        return {"wander_mm": wander_mm, "tremor": relative, "force_n": force}

    def grasp(self, from_s: float, length_s: float) -> dict[str, Any]:
        """Two or more pads hold an object for long."""
        rng, details = self._rng, {}
        links = rng.permutation(PADS)[: int(rng.integers(2, len(PADS) + 1))].tolist()
        for link in links:
            delay = float(rng.uniform(0, 0.5))
            details[link] = self.held(link, from_s + delay, length_s - delay)
        for link in PADS:
            self.use(link, 0.5, from_s - 1)
            self.use(link, from_s + length_s + 2 if link in links else from_s, LENGTH_S)
        return details

    def wet(self, link: str, from_s: float) -> dict[str, Any]:
        """A wet object is handled: it slips slowly while it is held, again and again."""
        rng, at = self._rng, from_s
        for pad in PADS:
            self.use(pad, 0.5, from_s - 1 if pad == link else LENGTH_S)
        while at < LENGTH_S - 25:
            length = float(rng.uniform(8, 25))
            way = [np.array(self._place(0.15))]
            for _ in range(int(4 * length)):
                way.append(np.clip(way[-1] + rng.normal(size=2) * 0.02, 0.06, 0.94))
            force = np.exp(rng.normal(size=int(3 * length)) * 0.15) * rng.uniform(0.5, 3)
            self._add(link, at, length, [(float(x), float(y)) for x, y in way], force.tolist())
            at += length + float(rng.uniform(0.5, 3))
        return {}

    def wipes(self, link: str, from_s: float) -> None:
        """Fast strokes across the pad, to and fro."""
        rng, at = self._rng, from_s
        for pad in PADS:
            self.use(pad, 0.5, from_s - 1 if pad == link else LENGTH_S)
        while at < LENGTH_S - 4:
            length = float(rng.uniform(1, 4))
            path = [self._place() for _ in range(int(rng.integers(3, 10)))]
            self._add(link, at, length, path, rng.uniform(0.4, 4, 4).tolist())
            at += length + float(rng.uniform(0.2, 1.5))

    def two(self, link: str, from_s: float) -> None:
        """Two objects press on one pad together, again and again."""
        rng, at = self._rng, from_s
        for pad in PADS:
            self.use(pad, 0.5, from_s - 1 if pad == link else LENGTH_S)
        while at < LENGTH_S - 8:
            length = float(rng.uniform(1, 6))
            for _ in range(2):
                self._add(link, at, length, [self._place()], rng.uniform(0.5, 4, 2).tolist())
            at += length + float(rng.uniform(0.5, 2))

    def tail(self, link: str, begin_s: float) -> dict[str, Any]:
        """A long, hard press whose rest fades over tens of seconds."""
        rng, place = self._rng, self._place(0.12)
        for pad in PADS:
            self.use(pad, 0.5, begin_s - 6 if pad == link else LENGTH_S)
        press = float(rng.uniform(2, 6))
        rest, fade_s = press * float(rng.uniform(0.08, 0.2)), float(rng.uniform(15, 60))
        self._add(link, begin_s - 5, 5.0, [place], [press])
        left = LENGTH_S - begin_s
        forces = rest * np.exp(-np.arange(0, left, 0.5) / fade_s)
        self._add(link, begin_s - 0.1, left, [place], np.maximum(forces, 1e-3).tolist(), 0.05)
        return {"press_n": press, "rest_n": rest, "fade_s": fade_s}

    def _add(
        self, link: str, from_s: float, length_s: float, path: list[tuple[float, float]], force: list[float],
        ramp_s: float = 0.15,
    ) -> None:  # fmt: skip
        self.touches.append(
            ScenarioTouch(
                link=link,
                from_s=from_s,
                duration_s=length_s,
                path=tuple(path),
                force_n=tuple(force),
                ramp_s=ramp_s,
            )
        )

    def _place(self, margin: float = 0.06) -> tuple[float, float]:
        x, y = self._rng.uniform(margin, 1 - margin, 2).tolist()
        return x, y


@lru_cache(maxsize=8)
def _size_mm(link: str) -> tuple[float, float]:
    (pad,) = (pad for pad in deployment().hands[0].pads if pad.link == link)
    return size_mm(pad)


def size_mm(pad: config.Pad) -> tuple[float, float]:
    """Return the extents of a pad's surface [mm]."""
    u, v = pad_surface(pad).extent_m
    return 1e3 * u, 1e3 * v


def draw_fault(name: str, rng: np.random.Generator, size_mm: tuple[float, float]) -> dict[str, Any]:
    """Return a fault of that name, of a size that needs attention."""
    electrode = ELECTRODES[int(rng.integers(4))]
    place = tuple(rng.uniform(0.12, 0.88, 2).tolist())
    if name == "gum":
        force, radius = float(np.exp(rng.uniform(np.log(0.15), np.log(1.0)))), float(rng.uniform(1.5, 4))
        return {"kind": "gum", "place": place, "radius_mm": radius, "force_n": force,
                "press_n": float(rng.uniform(1, 3)), "relax": float(rng.uniform(0, 0.2))}  # fmt: skip
    if name == "moisture":
        return {"kind": "moisture", "place": place, "radius_mm": float(rng.uniform(3, 9)),
                "leak_ohm": float(np.exp(rng.uniform(np.log(2e3), np.log(5e4)))),
                "grow_s": float(rng.uniform(15, 60))}  # fmt: skip
    if name == "dead electrode":
        return {"kind": "dead_electrode", "electrode": electrode}
    if name == "shorted electrode":
        return {"kind": "shorted_electrode", "electrode": electrode, "short_ohm": float(rng.uniform(1, 50))}
    if name == "swapped cables":
        order = list(ELECTRODES)
        i, j = int(rng.integers(0, 2)), int(rng.integers(2, 4))  # neighbours; opposite ones leave no trace
        order[i], order[j] = order[j], order[i]
        return {"kind": "swapped_cables", "order": tuple(order)}
    if name == "saturated channel":
        return {"kind": "saturated_channel", "electrode": electrode, "high": bool(rng.uniform() < 0.7)}
    if name == "stuck channel":
        count = None if rng.uniform() < 0.5 else int(rng.integers(-200, 8000))
        return {"kind": "stuck_channel", "electrode": electrode, "count": count}
    if name == "torn corner":
        corner = ("x0y0", "x0yb", "xay0", "xayb")[int(rng.integers(4))]
        along = rng.uniform(0.35, 0.55, 2) * np.array(size_mm)
        return {"kind": "torn_corner", "corner": corner, "along_x_mm": float(along[0]),
                "along_y_mm": float(along[1])}  # fmt: skip
    if name == "offset":
        counts = float(np.exp(rng.uniform(np.log(30), np.log(3000)))) * (1 if rng.uniform() < 0.5 else -1)
        return {"kind": "offset", "electrode": electrode, "counts": counts}
    factor = float(np.exp(rng.uniform(np.log(1.2), np.log(3)))) ** (1 if rng.uniform() < 0.5 else -1)
    return {"kind": "gain_step", "electrode": electrode, "factor": factor}


MENDED_S = 100.0
"""Time from the begin of a fault that is mended to its end."""
DRYING_S = 40.0
"""Time constant with which moisture dries after its end."""
SETTLED_S = 15.0
"""Time from when all faults are named, and the mended ones have ended, to the end of an episode."""
SERIES_OHM = (100.0, 1000.0)
HAND_EPISODES = 4
"""Episodes that share a drawn hand."""
_TABLES: dict[Any, Any] = {}
PLAYED = tuple(name for name in FAULTY if name != "hysteresis tail")
"""Faults that are drawn; a tail is a use of a healthy pad."""


@dataclass(frozen=True)
class Case:
    """Episodes of one kind; `count` for each name in `names`."""

    name: str
    world: World
    names: Sequence[str]
    count: int
    pads: Callable[[np.random.Generator], config.Deployment] = lambda _: deployment()
    length_s: float = 110.0
    is_mended: bool = False

    @property
    def episodes(self) -> list[tuple[str, int]]:
        """Name and number of each episode."""
        return [(name, number) for number in range(self.count) for name in self.names]


def _with_pads(change: Callable[[config.Pad], dict[str, Any]]) -> config.Deployment:
    """Return the hand of the episodes with its pads changed."""
    whole = deployment()
    (hand,) = whole.hands
    pads = tuple(pad.model_copy(update=change(pad)) for pad in hand.pads)
    return whole.model_copy(update={"hands": (hand.model_copy(update={"pads": pads}),)})


def with_resistors(rng: np.random.Generator) -> config.Deployment:
    """Return the hand with equal resistors at all electrodes of a pad."""
    return _with_pads(lambda _: {"series_ohm": (float(np.exp(rng.uniform(*np.log(SERIES_OHM)))),) * 4})


def _planes(x_mm: float, y_mm: float) -> Callable[[np.random.Generator], config.Deployment]:
    keys = {"kind": "plane", "length_mm": x_mm, "width_mm": y_mm}
    plane: Any = TypeAdapter(PadSurface).validate_python(keys)
    return lambda _: _with_pads(lambda __: {"surface": plane})


_DEFAULT = WORLDS["default"]
_DRIFTING = replace(_DEFAULT, electronics=WORLDS["harsh"].electronics)
CASES = (
    Case("gum, sheets S1", world_with(_DEFAULT, sheet="S1"), ("gum",), 48),
    Case("gum, sheets S2", world_with(_DEFAULT, sheet="S2"), ("gum",), 48),
    Case("moisture", _DEFAULT, ("moisture",), 24),
    Case("loose electrode", _DEFAULT, ("loose electrode",), 24),
    Case("two faults on two pads", _DEFAULT, ("two pads",), 24),
    Case("two faults on one pad", _DEFAULT, ("one pad",), 96),
    Case("drift of `harsh`", _DRIFTING, PLAYED, 4),
    Case("drift of `harsh`, no fault", _DRIFTING, ("plain use",), 24),
    Case("series resistors", _DEFAULT, (*PLAYED, "shorted pair"), 4, with_resistors),
    Case("series resistors, no fault, centre lines", _DEFAULT, ("centre lines",), 64, with_resistors),
    Case("small pads, 10 x 10 mm", _DEFAULT, PLAYED, 4, _planes(10.0, 10.0)),
    Case("long pads, 60 x 20 mm", _DEFAULT, PLAYED, 4, _planes(60.0, 20.0)),
    Case("mended", _DEFAULT, PLAYED, 4, length_s=480.0, is_mended=True),
)


def _draw_faults(
    case: Case, name: str, rng: np.random.Generator, sizes: dict[str, tuple[float, float]]
) -> list[tuple[str, dict[str, Any]]]:
    """Return the faults of an episode, each with its name."""
    links = rng.permutation(PADS).tolist()
    begin_s = float(rng.uniform(15, 30))
    if name in ("plain use", "centre lines"):
        return []
    if name == "loose electrode":
        electrode, at, parts = ELECTRODES[int(rng.integers(4))], begin_s, []
        while at < case.length_s:
            off_s = float(np.exp(rng.uniform(np.log(0.1), np.log(3.0))))
            there = {"link": links[0], "from_s": at, "until_s": at + off_s}
            parts.append((name, {"kind": "dead_electrode", "electrode": electrode, **there}))
            at += off_s + float(np.exp(rng.uniform(np.log(0.1), np.log(3.0))))
        return parts
    names = [name]
    if name in ("two pads", "one pad"):
        names = rng.permutation(PLAYED)[:2].tolist()
        links = links if name == "two pads" else [links[0]] * 2
    drawn = []
    for number, one in enumerate(names):
        if one == "shorted pair":
            first, second = ("x0", "xa") if rng.uniform() < 0.5 else ("x0", "y0")
            keys: dict[str, Any] = {"kind": "shorted_electrode", "electrode": first, "to": second}
            keys["short_ohm"] = float(rng.uniform(0.5, 20))
        else:
            keys = draw_fault(one, rng, sizes[links[number]])
        keys |= {"link": links[number], "from_s": begin_s + 10.0 * number}
        if case.is_mended:
            keys["until_s"] = begin_s + MENDED_S
            keys |= {"dry_s": DRYING_S} if one == "moisture" else {}
        drawn.append((one, keys))
    return drawn


def hides(events: list[dict[str, Any]]) -> bool:
    """Return whether one of two faults of a pad leaves too few currents to observe the other.

    Four currents and three unknowns of a contact: faults that show in contacts need all channels. Of a pad
    that is shorted to the layer, all channels carry the current of the short.
    """
    first, second = (event["name"] for event in events)
    pairs = ((first, second), (second, first))
    lost = ("stuck channel", "saturated channel", "shorted electrode", "dead electrode")
    shown = ("swapped cables", "torn corner", "gain step", "dead electrode")
    static = ("gum", "moisture", "offset")
    return any(
        (one in lost and other in shown) or (one == "shorted electrode" and other in static)
        for one, other in pairs
    )


def _right_kind(name: str) -> FaultKind:
    if name == "loose electrode":
        return FaultKind.DEAD_ELECTRODE
    return FaultKind.SHORTED_ELECTRODE if name == "shorted pair" else FAULTY[name]


def _touch_centre_lines(rng: np.random.Generator, length_s: float) -> list[ScenarioTouch]:
    """Return presses and slow strokes along one line midway between opposite electrodes of each pad."""
    touches = []
    for link in PADS:
        at, along_y = 0.5 + float(rng.uniform(0, 2)), rng.uniform() < 0.7
        while at < length_s - 7:
            line = rng.uniform(0.06, 0.94, 2).tolist()
            stroke = rng.uniform() < 0.5
            path = tuple((0.5, s) if along_y else (s, 0.5) for s in (line if stroke else line[:1]))
            long_s = float(rng.uniform(2, 6) if stroke else rng.uniform(0.4, 1.5))
            force = float(np.exp(rng.uniform(np.log(0.4), np.log(5.0))))
            touches.append(
                ScenarioTouch(
                    link=link, from_s=at, duration_s=long_s, path=path, force_n=(force,), ramp_s=0.15
                )
            )
            at += long_s + float(rng.uniform(0.3, 2.0))
    return touches


@lru_cache(maxsize=4)
def _hand(case: int, number: int) -> tuple[Any, config.Deployment, DiagnosisModel]:
    """Return the drawn world, its deployment as described, and what diagnosis knows of it."""
    drawn = CASES[case].world.draw(Family.REPORTING.seed(3000 + number))
    described = drawn.describe(CASES[case].pads(np.random.default_rng((case, number))))
    return drawn, described, DiagnosisModel.from_deployment(described, "right")


def play_case(task: tuple[int, str, int]) -> dict[str, Any]:
    """Play one episode of a case; return its events and all diagnoses, as lists that JSON has."""
    index, name, number = task
    case = CASES[index]
    drawn, described, model = _hand(index, number // HAND_EPISODES)
    rng = np.random.default_rng((index, number, *name.encode()))
    (hand,) = described.hands
    sizes = {pad.link: size_mm(pad) for pad in hand.pads}
    keys = _draw_faults(case, name, rng, sizes)
    if name == "centre lines":
        touches = _touch_centre_lines(rng, case.length_s)
    else:
        play = Play(rng)
        for link in PADS:
            play.use(link, 0.5, case.length_s)
        touches = play.touches
    faults: list[Fault] = [FAULTS[one["kind"]].model_validate(one) for _, one in keys]
    virtual = VirtualHand(described, Scenario(touch=tuple(touches)), drawn, faults=tuple(faults))
    events = [
        {"name": one, "kind": _right_kind(one).value, "link": fault["link"], "begin_s": fault["from_s"]}
        for one, fault in (keys[:1] if name == "loose electrode" else keys)
    ]
    diagnosis = HandDiagnostics(model, tables=_TABLES)
    found: list[dict[str, Any]] = []
    t_s, quiet_since_s = 0.0, None
    for block in sample_blocks(virtual, case.length_s):
        t_s = float(block.sample_ns.max()) * 1e-9
        for it in diagnosis.process_block(block):
            if not it.is_fault:
                continue
            if it.until_ns is not None:
                for one in found:
                    if (one["link"], one["kind"]) == (it.link, it.kind.value) and one["until_s"] is None:
                        one["until_s"] = t_s
                continue
            off_mm = None
            if it.kind == FaultKind.GUM and it.published.pad_m is not None and name == "gum":
                size = np.array(sizes[it.link])
                true_mm = np.array(keys[0][1]["place"]) * size
                off_mm = float(np.linalg.norm(1e3 * np.array(it.published.pad_m) - true_mm))
            found.append(
                {
                    "link": it.link, "kind": it.kind.value, "at_s": t_s, "until_s": None,
                    "confidence": it.published.confidence, "off_mm": off_mm,
                }
            )  # fmt: skip
        if not events or case.name == "loose electrode":
            continue
        named = all(any(matches(event, one) for one in found) for event in events)
        wrong = [one for one in found if not any(matches(event, one) for event in events)]
        wrong = [one for one in wrong if one["kind"] != FaultKind.UNEXPLAINED]
        lasting = [one for one in found if one["until_s"] is None]
        mended_s = events[0]["begin_s"] + MENDED_S
        is_done = (t_s > mended_s and not lasting) if case.is_mended else (named and not wrong)
        quiet_since_s = (quiet_since_s or t_s) if is_done else None
        if quiet_since_s is not None and t_s > quiet_since_s + SETTLED_S:
            break
    return {
        "case": case.name, "name": name, "number": number, "events": events, "found": found,
        "hours": t_s * len(PADS) / 3600, "length_s": t_s,
    }  # fmt: skip


def matches(event: dict[str, Any], one: dict[str, Any]) -> bool:
    """Return whether a diagnosis names an event on its pad, after it began."""
    return bool(
        one["kind"] == event["kind"] and one["link"] == event["link"] and one["at_s"] >= event["begin_s"]
    )
