"""Which of the shapes do contacts lie on? Fits of all classes compared by their evidence.

Public names: `classify`, `classifying` (the same in pieces), `judge`, `Verdict`.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from handtouch.percept.primitives import CLASSES, Fit, Prior, finished, fitting

FloatArray = NDArray[np.float64]

_MISFIT = 4.0  # standard deviations of chi^2, beyond which a model is none
_LEAST_CONTACTS, _LEAST_MOVING = 3, 6


@dataclass(frozen=True)
class Verdict:
    """`label` where one class is sure; probabilities and fits by class. state and reason as of a percept.
    moves: whether it only fits if the object moved a little between touches."""

    state: str
    label: str
    reason: str
    contacts: int
    probabilities: dict[str, float] = field(default_factory=dict)
    fits: dict[str, Fit] = field(default_factory=dict)
    moves: bool = False


def classify(
    points_m: FloatArray,
    normals: FloatArray,
    covariances_m2: FloatArray,
    prior: Prior | None = None,
    classes: Iterable[str] = CLASSES,
) -> Verdict:
    """Which class contacts (n, 3) with normals (n, 3), outward from the pads, and covariances (n, 3, 3) tell.

    All in one frame in which the object rests. Every row should be a touch of its own: a contact that rests
    tells the same thing each time. Raises ValueError for shapes that don't fit, or what isn't finite.
    """
    return finished(classifying(points_m, normals, covariances_m2, prior, classes))


def classifying(
    points_m: FloatArray,
    normals: FloatArray,
    covariances_m2: FloatArray,
    prior: Prior | None = None,
    classes: Iterable[str] = CLASSES,
    moved: bool = False,
) -> Generator[None, None, Verdict]:
    """`classify` in small pieces, for who has little time at once.

    Where no class fits an object at rest, one that moves a little between touches is tried: sizes are then
    less sure, and the verdict says so. moved: that it does is known, nothing else is tried. Few touches fit
    anything that moves, so it isn't tried with them.
    """
    prior = Prior() if prior is None else prior
    _check(points_m, normals, covariances_m2)
    enough, verdict = len(points_m) >= _LEAST_MOVING, None
    for moves in (True,) if moved and enough else (False, True) if enough else (False,):
        one, fits = prior.freely() if moves else prior, dict[str, Fit]()
        for name in classes:
            fits[name] = yield from fitting(name, points_m, normals, covariances_m2, one)
        found = replace(judge(fits, len(points_m), one), moves=moves)
        if verdict is None or found.state != "invalid":
            verdict = found
        if verdict.state != "invalid":
            break
    assert verdict is not None
    return verdict


def judge(fits: dict[str, Fit], contacts: int, prior: Prior) -> Verdict:
    """Compare fits of the same contacts."""
    scores = np.array(
        [fits[n].log_evidence + math.log(max(prior.classes[CLASSES.index(n)], 1e-300)) for n in fits]
    )
    weights = np.exp(scores - scores.max())
    probabilities = dict(zip(fits, (weights / weights.sum()).tolist(), strict=True))
    best = max(probabilities, key=probabilities.__getitem__)
    state, label, reason = "estimated", best, ""
    if contacts < _LEAST_CONTACTS:
        state, label, reason = "unestimated", "", f"{contacts} of {_LEAST_CONTACTS} contacts"
    elif fits[best].misfit > _MISFIT:
        off = fits[best].misfit
        state, label, reason = "invalid", "", f"none of the shapes: even {best} is {off:.0f} sigma off"
    elif probabilities[best] < prior.sure:
        second = sorted(probabilities, key=probabilities.__getitem__)[-2]
        state, label, reason = "unestimated", "", f"not enough yet to tell {best} from {second}"
    return Verdict(state, label, reason, contacts, probabilities, fits)


def _check(points_m: FloatArray, normals: FloatArray, covariances_m2: FloatArray) -> None:
    """Raise ValueError unless these are contacts."""
    n = len(points_m)
    if points_m.shape != (n, 3) or normals.shape != (n, 3) or covariances_m2.shape != (n, 3, 3) or not n:
        shapes = points_m.shape, normals.shape, covariances_m2.shape
        raise ValueError(
            f"points, normals, covariances have shapes {shapes}: must be (n, 3), (n, 3), (n, 3, 3)"
        )
    if not (np.isfinite(points_m).all() and np.isfinite(normals).all() and np.isfinite(covariances_m2).all()):
        raise ValueError("points, normals and covariances must be finite")
