"""Episodes of one pad, drawn by seed: ordinary use with one fault in it, or a hard case without any.

Public names: `Episode`, `episode`, `CASES` (the hard cases by name), `size_mm`. Names of faults are those of
`FAULTS`; "none" is ordinary use.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from handtouch import config
from handtouch.canbus.objects.channels import ELECTRODES
from handtouch.simulate.faults import (
    DeadElectrode,
    Fault,
    GainStep,
    Gum,
    Heat,
    Moisture,
    Offset,
    SaturatedChannel,
    ShortedElectrode,
    StuckChannel,
    SwappedCables,
    TornCorner,
)
from handtouch.simulate.scenario import Scenario, Touch
from handtouch.simulate.shape import shape_of

Size = tuple[float, float]
_CORNERS = ("x0y0", "x0yb", "xay0", "xayb")


@dataclass(frozen=True)
class Episode:
    """What a pad goes through: give scenario and `acting` to a `VirtualHand`."""

    name: str
    duration_s: float
    scenario: Scenario
    acting: tuple[Fault, ...] = ()
    fault: Fault | None = None
    """The one of `acting` that a supervisor must name; None where there is nothing to tell."""


def size_mm(pad: config.Pad) -> Size:
    """Sides of a pad along x and y, at its middle."""
    shape = shape_of(pad.surface)
    return 1e3 * shape.length_m, 1e3 * shape.arc * float(shape.radius(shape.length_m / 2))


def episode(name: str, seed: int, pad: config.Pad, duration_s: float = 60.0) -> Episode:
    """Draw an episode; a fault begins within the first half of it, and stays. Raises KeyError for a name."""
    draw = np.random.default_rng((seed, *name.encode()))
    if name in CASES:
        return CASES[name](draw, pad.link, size_mm(pad), duration_s)
    from_s = duration_s * draw.uniform(0.15, 0.5)
    fault = _DRAWN[name](draw, {"link": pad.link, "from_s": from_s}, size_mm(pad))
    use = _use(draw, pad.link, duration_s)
    if isinstance(fault, Gum):  # it comes with a touch of its own
        end = from_s + fault.press_s
        use = [touch for touch in use if touch.until_s <= from_s or touch.from_s >= end]
    return Episode(name, duration_s, _scenario(use), (fault,), fault)


def _use(draw: np.random.Generator, link: str, duration_s: float, until_s: float = math.inf) -> list[Touch]:
    """Ordinary use: presses and slides of 0.3 to 4 s, pauses of 0.5 to 6 s."""
    touches = []
    at = draw.uniform(0.5, 2.0)
    while at < min(duration_s, until_s) - 1.0:
        lasts = float(np.exp(draw.uniform(math.log(0.3), math.log(4.0))))
        lasts = min(lasts, min(duration_s, until_s) - at)
        points = int(draw.choice([1, 1, 2, 3]))
        touches.append(
            _touch(
                draw, link, at, lasts, [_place(draw) for _ in range(points)], int(draw.choice([1, 1, 2, 3]))
            )
        )
        at += lasts + float(np.exp(draw.uniform(math.log(0.5), math.log(6.0))))
    return touches


def _touch(
    draw: np.random.Generator,
    link: str,
    from_s: float,
    duration_s: float,
    path: list[tuple[float, float]],
    levels: int = 1,
    steadiness: float = 0.5,
) -> Touch:
    force = math.exp(draw.uniform(math.log(0.3), math.log(5.0)))
    forces = force * np.exp(draw.uniform(-steadiness, steadiness, levels))
    return Touch.model_validate(
        {
            "link": link,
            "from_s": from_s,
            "duration_s": duration_s,
            "path": tuple(path),
            "force_n": tuple(forces.tolist()),
            "ramp_s": float(draw.uniform(0.05, 0.4)),
        }
    )


def _place(draw: np.random.Generator, margin: float = 0.12) -> tuple[float, float]:
    x, y = draw.uniform(margin, 1 - margin, 2).tolist()
    return x, y


def _scenario(touches: list[Touch]) -> Scenario:
    return Scenario.model_validate({"touch": tuple(touches)})


# --- hard cases: nothing is wrong ---


def _ordinary(draw: np.random.Generator, link: str, size: Size, duration_s: float) -> Episode:  # noqa: ARG001
    return Episode("none", duration_s, _scenario(_use(draw, link, duration_s)))


def _grasp(draw: np.random.Generator, link: str, duration_s: float, wander: float = 0.02) -> list[Touch]:
    """Use, and then something held to near the end: it shifts a little, and its weight with it."""
    begins = duration_s * float(draw.uniform(0.1, 0.3))
    holds = duration_s * float(draw.uniform(0.5, 0.65))
    middle = np.array(_place(draw, 0.2))
    steps = max(int(holds / 20), 2)
    path = [tuple((middle + draw.uniform(-wander, wander, 2)).tolist()) for _ in range(steps)]
    held = _touch(draw, link, begins, holds, path, steps + 1, 0.06)
    after = [touch for touch in _use(draw, link, duration_s) if touch.from_s > held.until_s + 0.5]
    return [*_use(draw, link, duration_s, begins - 0.5), held, *after]


def _long_grasp(draw: np.random.Generator, link: str, size: Size, duration_s: float) -> Episode:  # noqa: ARG001
    return Episode("long_grasp", duration_s, _scenario(_grasp(draw, link, duration_s)))


def _wet_object(draw: np.random.Generator, link: str, size: Size, duration_s: float) -> Episode:
    """Held, it cools the pad, and its water bridges the layers as long as it is there; then it dries soon."""
    touches = _grasp(draw, link, duration_s)
    held = max(touches, key=lambda touch: touch.duration_s)
    wet = Moisture(
        link=link,
        from_s=held.from_s,
        until_s=held.until_s,
        place=held.path[0],
        radius_mm=float(draw.uniform(0.15, 0.3)) * min(size),
        leak_ohm=float(np.exp(draw.uniform(math.log(2e4), math.log(2e5)))),
        grow_s=float(draw.uniform(2, 10)),
        dry_s=float(draw.uniform(2, 8)),
    )
    cold = Heat(
        link=link,
        from_s=held.from_s,
        until_s=held.until_s,
        warmer_by_k=float(draw.uniform(-15, -5)),
        time_s=float(draw.uniform(10, 40)),
    )
    return Episode("wet_object", duration_s, _scenario(touches), (wet, cold))


def _sweeping_wipe(draw: np.random.Generator, link: str, size: Size, duration_s: float) -> Episode:  # noqa: ARG001
    """To and fro over the pad without letting go, again and again."""
    touches, at = [], float(draw.uniform(0.5, 2))
    while at < duration_s - 3:
        lasts = min(float(draw.uniform(3, 15)), duration_s - at)
        across, low, high = float(draw.uniform(0.2, 0.8)), 0.06, 0.94
        turns = max(int(lasts / draw.uniform(0.5, 2)), 2)
        ends = [(low if turn % 2 else high, across) for turn in range(turns)]
        if draw.random() < 0.5:
            ends = [(y, x) for x, y in ends]
        touches.append(_touch(draw, link, at, lasts, ends, turns, 0.4))
        at += lasts + float(draw.uniform(0.5, 3))
    return Episode("sweeping_wipe", duration_s, _scenario(touches))


def _hot_cup(draw: np.random.Generator, link: str, size: Size, duration_s: float) -> Episode:  # noqa: ARG001
    touches = _grasp(draw, link, duration_s)
    held = max(touches, key=lambda touch: touch.duration_s)
    hot = Heat(
        link=link,
        from_s=held.from_s,
        until_s=held.until_s,
        warmer_by_k=float(draw.uniform(10, 35)),
        time_s=float(draw.uniform(15, 60)),
    )
    return Episode("hot_cup", duration_s, _scenario(touches), (hot,))


def _two_objects(draw: np.random.Generator, link: str, size: Size, duration_s: float) -> Episode:  # noqa: ARG001
    """Two things press on the pad at the same time, now and then."""
    first, second = _use(draw, link, duration_s), _use(draw, link, duration_s)
    apart = [touch for touch in second if draw.random() < 0.7]
    return Episode("two_objects", duration_s, _scenario([*first, *apart]))


CASES: Mapping[str, Callable[[np.random.Generator, str, Size, float], Episode]] = MappingProxyType(
    {
        "none": _ordinary,
        "long_grasp": _long_grasp,
        "wet_object": _wet_object,
        "sweeping_wipe": _sweeping_wipe,
        "hot_cup": _hot_cup,
        "two_objects": _two_objects,
    }
)


# --- faults, of a severity that matters ---


def _log(draw: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(draw.uniform(math.log(low), math.log(high))))


def _electrode(draw: np.random.Generator) -> str:
    return str(draw.choice(ELECTRODES))


def _gum(draw: np.random.Generator, at: dict[str, object], size: Size) -> Fault:
    force = _log(draw, 0.15, 1.5)
    return Gum.model_validate(
        at
        | {
            "place": _place(draw),
            "radius_mm": float(draw.uniform(0.06, 0.16)) * min(size),
            "force_n": force,
            "press_n": force * float(draw.uniform(1.5, 5)),
            "press_s": float(draw.uniform(0.4, 2)),
            "relax": float(draw.uniform(0, 0.25)),
            "relax_s": float(draw.uniform(20, 200)),
        }
    )


def _moisture(draw: np.random.Generator, at: dict[str, object], size: Size) -> Fault:
    return Moisture.model_validate(
        at
        | {
            "place": _place(draw, 0.2),
            "radius_mm": float(draw.uniform(0.2, 0.5)) * min(size),
            "leak_ohm": _log(draw, 2e3, 3e4),
            "grow_s": _log(draw, 10, 60),
        }
    )


def _dead(draw: np.random.Generator, at: dict[str, object], size: Size) -> Fault:  # noqa: ARG001
    return DeadElectrode.model_validate(at | {"electrode": _electrode(draw)})


def _shorted(draw: np.random.Generator, at: dict[str, object], size: Size) -> Fault:  # noqa: ARG001
    one, other = draw.permutation(ELECTRODES)[:2].tolist()
    to = "layer" if draw.random() < 0.5 else other
    return ShortedElectrode.model_validate(
        at | {"electrode": one, "to": to, "short_ohm": _log(draw, 0.5, 20)}
    )


def _swapped(draw: np.random.Generator, at: dict[str, object], size: Size) -> Fault:  # noqa: ARG001
    order = list(ELECTRODES)
    i, j = draw.permutation(4)[:2].tolist()
    order[i], order[j] = order[j], order[i]
    return SwappedCables.model_validate(at | {"order": tuple(order)})


def _saturated(draw: np.random.Generator, at: dict[str, object], size: Size) -> Fault:  # noqa: ARG001
    return SaturatedChannel.model_validate(
        at | {"electrode": _electrode(draw), "high": bool(draw.random() < 0.8)}
    )


def _torn(draw: np.random.Generator, at: dict[str, object], size: Size) -> Fault:
    x_mm, y_mm = (float(draw.uniform(0.2, 0.5)) * side for side in size)
    return TornCorner.model_validate(
        at | {"corner": str(draw.choice(_CORNERS)), "along_x_mm": x_mm, "along_y_mm": y_mm}
    )


def _offset(draw: np.random.Generator, at: dict[str, object], size: Size) -> Fault:  # noqa: ARG001
    counts = _log(draw, 60, 3000) * float(draw.choice([-1, 1]))
    return Offset.model_validate(at | {"electrode": _electrode(draw), "counts": counts})


def _stuck(draw: np.random.Generator, at: dict[str, object], size: Size) -> Fault:  # noqa: ARG001
    count = int(draw.integers(-2000, 20_000)) if draw.random() < 0.3 else None
    return StuckChannel.model_validate(at | {"electrode": _electrode(draw), "count": count})


def _gain(draw: np.random.Generator, at: dict[str, object], size: Size) -> Fault:  # noqa: ARG001
    factor = _log(draw, 1.15, 2.0) ** float(draw.choice([-1, 1]))
    return GainStep.model_validate(at | {"electrode": _electrode(draw), "factor": factor})


_DRAWN: Mapping[str, Callable[[np.random.Generator, dict[str, object], Size], Fault]] = MappingProxyType(
    {
        "gum": _gum,
        "moisture": _moisture,
        "dead_electrode": _dead,
        "shorted_electrode": _shorted,
        "swapped_cables": _swapped,
        "saturated_channel": _saturated,
        "torn_corner": _torn,
        "offset": _offset,
        "stuck_channel": _stuck,
        "gain_step": _gain,
    }
)
