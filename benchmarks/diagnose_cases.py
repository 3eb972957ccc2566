"""Cases for bench_diagnose_cases: pads, sheets and faults beyond the episodes of bench_diagnose.

Public names: `Case`, `CASES`, `HAND_EPISODES`, `play_case`, `matches`, `hides`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from benchmarks.diagnose_episodes import (
    ELECTRODES,
    FAULTY,
    PADS,
    Play,
    deployment,
    draw_fault,
    sample_blocks,
    size_mm,
)
from handtouch import config
from handtouch.config.surfaces import PadSurface
from handtouch.simulate.faults import FAULTS, Fault
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, Family, World, world_with
from handtouch.supervisor.diagnose import DiagnosisModel, HandDiagnostics
from handtouch.wire.faults import FaultKind

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
