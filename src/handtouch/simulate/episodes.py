"""Random episodes of one pad: ordinary use with one fault, or a hard case without a fault.

Public names: `Episode`, `draw_episode`, `HARD_CASES` (by name; "none" is ordinary use), `pad_size_mm`. An
episode with a fault has the fault's kind as its name.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from handtouch import config
from handtouch.simulate.faults import FAULTS, Fault, Gum, Heat, Moisture, draw_position
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.surfaces import simulated_surface
from handtouch.simulate.touch import ScenarioTouch

Size = tuple[float, float]


@dataclass(frozen=True)
class Episode:
    """Input of one pad for a time: pass `scenario` and `active_faults` to a `VirtualHand`."""

    name: str
    duration_s: float
    scenario: Scenario
    active_faults: tuple[Fault, ...] = ()
    fault: Fault | None = None
    """The one of `active_faults` that a supervisor must diagnose; None: it must diagnose nothing."""


def pad_size_mm(pad: config.Pad) -> Size:
    """Return the sides of a pad along x and y, at its middle."""
    shape = simulated_surface(pad.surface)
    return 1e3 * shape.length_m, 1e3 * shape.arc * float(shape.radius(shape.length_m / 2))


def draw_episode(name: str, seed: int, pad: config.Pad, duration_s: float = 60.0) -> Episode:
    """Draw an episode; a fault begins within its first half, and lasts.

    Raises KeyError for a name that is neither a hard case nor a kind of fault.
    """
    rng = np.random.default_rng((seed, *name.encode()))
    if name in HARD_CASES:
        return HARD_CASES[name](rng, pad.link, pad_size_mm(pad), duration_s)
    from_s = duration_s * rng.uniform(0.15, 0.5)
    fault = FAULTS[name].draw(rng, pad.link, from_s, pad_size_mm(pad))
    use = _draw_ordinary_touches(rng, pad.link, duration_s)
    if isinstance(fault, Gum):  # includes a touch of its own
        end = from_s + fault.press_s
        use = [touch for touch in use if touch.until_s <= from_s or touch.from_s >= end]
    return Episode(name, duration_s, _make_scenario(use), (fault,), fault)


def _draw_ordinary_touches(
    rng: np.random.Generator, link: str, duration_s: float, until_s: float = math.inf
) -> list[ScenarioTouch]:
    """Draw ordinary use: presses and slides of 0.3 to 4 s, pauses of 0.5 to 6 s."""
    touches = []
    begin_s = rng.uniform(0.5, 2.0)
    while begin_s < min(duration_s, until_s) - 1.0:
        touch_s = float(np.exp(rng.uniform(math.log(0.3), math.log(4.0))))
        touch_s = min(touch_s, min(duration_s, until_s) - begin_s)
        points = int(rng.choice([1, 1, 2, 3]))
        touches.append(
            _draw_touch(
                rng,
                link,
                begin_s,
                touch_s,
                [draw_position(rng) for _ in range(points)],
                int(rng.choice([1, 1, 2, 3])),
            )
        )
        begin_s += touch_s + float(np.exp(rng.uniform(math.log(0.5), math.log(6.0))))
    return touches


def _draw_touch(
    rng: np.random.Generator,
    link: str,
    from_s: float,
    duration_s: float,
    path: list[tuple[float, float]],
    levels: int = 1,
    steadiness: float = 0.5,
) -> ScenarioTouch:
    force = math.exp(rng.uniform(math.log(0.3), math.log(5.0)))
    forces = force * np.exp(rng.uniform(-steadiness, steadiness, levels))
    return ScenarioTouch.model_validate(
        {
            "link": link,
            "from_s": from_s,
            "duration_s": duration_s,
            "path": tuple(path),
            "force_n": tuple(forces.tolist()),
            "ramp_s": float(rng.uniform(0.05, 0.4)),
        }
    )


def _make_scenario(touches: list[ScenarioTouch]) -> Scenario:
    return Scenario.model_validate({"touch": tuple(touches)})


# --- hard cases, without a fault ---


def _ordinary_use(rng: np.random.Generator, link: str, size: Size, duration_s: float) -> Episode:  # noqa: ARG001
    return Episode("none", duration_s, _make_scenario(_draw_ordinary_touches(rng, link, duration_s)))


def _draw_grasp(
    rng: np.random.Generator, link: str, duration_s: float, wander: float = 0.02
) -> list[ScenarioTouch]:
    """Draw ordinary use, then an object held almost to the end: its position and force vary a little."""
    begins = duration_s * float(rng.uniform(0.1, 0.3))
    holds = duration_s * float(rng.uniform(0.5, 0.65))
    middle = np.array(draw_position(rng, 0.2))
    steps = max(int(holds / 20), 2)
    path = [tuple((middle + rng.uniform(-wander, wander, 2)).tolist()) for _ in range(steps)]
    held = _draw_touch(rng, link, begins, holds, path, steps + 1, 0.06)
    after = [
        touch for touch in _draw_ordinary_touches(rng, link, duration_s) if touch.from_s > held.until_s + 0.5
    ]
    return [*_draw_ordinary_touches(rng, link, duration_s, begins - 0.5), held, *after]


def _long_grasp(rng: np.random.Generator, link: str, size: Size, duration_s: float) -> Episode:  # noqa: ARG001
    return Episode("long_grasp", duration_s, _make_scenario(_draw_grasp(rng, link, duration_s)))


def _wet_object(rng: np.random.Generator, link: str, size: Size, duration_s: float) -> Episode:
    """Hold a wet object: it cools the pad, and its water leaks between the layers and dries soon after."""
    touches = _draw_grasp(rng, link, duration_s)
    held = max(touches, key=lambda touch: touch.duration_s)
    wet = Moisture(
        link=link,
        from_s=held.from_s,
        until_s=held.until_s,
        place=held.path[0],
        radius_mm=float(rng.uniform(0.15, 0.3)) * min(size),
        leak_ohm=float(np.exp(rng.uniform(math.log(2e4), math.log(2e5)))),
        grow_s=float(rng.uniform(2, 10)),
        dry_s=float(rng.uniform(2, 8)),
    )
    cold = Heat(
        link=link,
        from_s=held.from_s,
        until_s=held.until_s,
        warmer_by_k=float(rng.uniform(-15, -5)),
        time_s=float(rng.uniform(10, 40)),
    )
    return Episode("wet_object", duration_s, _make_scenario(touches), (wet, cold))


def _sweeping_wipe(rng: np.random.Generator, link: str, size: Size, duration_s: float) -> Episode:  # noqa: ARG001
    """Wipe to and fro over the pad without lifting, several times."""
    touches, begin_s = [], float(rng.uniform(0.5, 2))
    while begin_s < duration_s - 3:
        touch_s = min(float(rng.uniform(3, 15)), duration_s - begin_s)
        across, low, high = float(rng.uniform(0.2, 0.8)), 0.06, 0.94
        strokes = max(int(touch_s / rng.uniform(0.5, 2)), 2)
        ends = [(low if stroke % 2 else high, across) for stroke in range(strokes)]
        if rng.random() < 0.5:
            ends = [(y, x) for x, y in ends]
        touches.append(_draw_touch(rng, link, begin_s, touch_s, ends, strokes, 0.4))
        begin_s += touch_s + float(rng.uniform(0.5, 3))
    return Episode("sweeping_wipe", duration_s, _make_scenario(touches))


def _hot_cup(rng: np.random.Generator, link: str, size: Size, duration_s: float) -> Episode:  # noqa: ARG001
    touches = _draw_grasp(rng, link, duration_s)
    held = max(touches, key=lambda touch: touch.duration_s)
    hot = Heat(
        link=link,
        from_s=held.from_s,
        until_s=held.until_s,
        warmer_by_k=float(rng.uniform(10, 35)),
        time_s=float(rng.uniform(15, 60)),
    )
    return Episode("hot_cup", duration_s, _make_scenario(touches), (hot,))


def _two_objects(rng: np.random.Generator, link: str, size: Size, duration_s: float) -> Episode:  # noqa: ARG001
    """Press on the pad with two objects, at times simultaneously."""
    first, second = (
        _draw_ordinary_touches(rng, link, duration_s),
        _draw_ordinary_touches(rng, link, duration_s),
    )
    apart = [touch for touch in second if rng.random() < 0.7]
    return Episode("two_objects", duration_s, _make_scenario([*first, *apart]))


HARD_CASES: Mapping[str, Callable[[np.random.Generator, str, Size, float], Episode]] = MappingProxyType(
    {
        "none": _ordinary_use,
        "long_grasp": _long_grasp,
        "wet_object": _wet_object,
        "sweeping_wipe": _sweeping_wipe,
        "hot_cup": _hot_cup,
        "two_objects": _two_objects,
    }
)
