"""Classification of an object's shape: fits of all classes, compared by their evidence.

Public names: `classify_shape`, `classify_touches` (the same as a generator), `compare_fits`,
`ShapeClassification`.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from handtouch.arrays import FloatArray
from handtouch.percept.primitives import (
    SHAPE_CLASSES,
    PrimitiveFit,
    ShapePrior,
    Touches,
    fit_primitive,
    run_to_completion,
)

_MAX_MISFIT_SIGMA = 4.0  # misfit beyond which a class is rejected
_MIN_CONTACTS, _MIN_CONTACTS_MOVING_OBJECT = 3, 6


@dataclass(frozen=True)
class ShapeClassification:
    """Result of a classification; `label` is empty unless one class is probable enough.

    state, reason: as of a percept. probabilities, fits: by class. object_moves: True if the classes fit only
    with an object that moves slightly between touches.
    """

    state: str
    label: str
    reason: str
    contacts: int
    probabilities: dict[str, float] = field(default_factory=dict)
    fits: dict[str, PrimitiveFit] = field(default_factory=dict)
    object_moves: bool = False


def classify_shape(
    points_m: FloatArray,
    normals: FloatArray,
    covariances_m2: FloatArray,
    prior: ShapePrior | None = None,
    classes: Iterable[str] = SHAPE_CLASSES,
    *,
    pads: ArrayLike | None = None,
    moves: bool = False,
) -> ShapeClassification:
    """Classify contact points (n, 3) with normals (n, 3), outward from the pads, and covariances (n, 3, 3).

    All in one frame in which the object is at rest, or moves slightly between touches (`moves`). Every row
    should be a separate touch: a contact that doesn't move adds the same information only once. pads: (n,),
    numbers of the pads that touched, whose errors are common to their touches; default: all differ. Raises
    ValueError for shapes that don't match, or for values that aren't finite.
    """
    n = len(points_m)
    _check_contacts(points_m, normals, covariances_m2)
    of_pads = np.arange(n) if pads is None else np.asarray(pads, np.intp)
    touches = Touches(points_m, normals, covariances_m2, of_pads, np.zeros(n))
    return run_to_completion(classify_touches(touches, prior or ShapePrior(), classes, moves=moves))


def classify_touches(
    touches: Touches, prior: ShapePrior, classes: Iterable[str] = SHAPE_CLASSES, *, moves: bool = False
) -> Generator[None, None, ShapeClassification]:
    """Classify as `classify_shape`, yielding between small steps so that a caller can bound its time.

    moves: the object was seen to move. If no class fits one at rest, one that moves slightly between touches
    is fitted; sizes are then less certain, and the result says so. With few touches that fits anything, so it
    isn't tried.
    """
    contacts = len(touches.points_m)
    rests = yield from _classify(touches, prior, classes)
    if rests.state != "invalid" or not moves or contacts < _MIN_CONTACTS_MOVING_OBJECT:
        return rests
    moving = yield from _classify(touches, prior.for_moving_object(), classes)
    return rests if moving.state == "invalid" else replace(moving, object_moves=True)


def _classify(
    touches: Touches, prior: ShapePrior, classes: Iterable[str]
) -> Generator[None, None, ShapeClassification]:
    fits: dict[str, PrimitiveFit] = {}
    for name in classes:
        fits[name] = yield from fit_primitive(name, touches, prior)
    return compare_fits(fits, len(touches.points_m), prior)


def compare_fits(fits: dict[str, PrimitiveFit], contacts: int, prior: ShapePrior) -> ShapeClassification:
    """Compare fits of several classes to the same contacts."""
    scores = np.array(
        [fits[n].log_evidence + math.log(max(prior.classes[SHAPE_CLASSES.index(n)], 1e-300)) for n in fits]
    )
    weights = np.exp(scores - scores.max())
    probabilities = dict(zip(fits, (weights / weights.sum()).tolist(), strict=True))
    best = max(probabilities, key=probabilities.__getitem__)
    state, label, reason = "estimated", best, ""
    if contacts < _MIN_CONTACTS:
        state, label, reason = "undetermined", "", f"{contacts} of {_MIN_CONTACTS} contacts"
    elif fits[best].misfit_sigma > _MAX_MISFIT_SIGMA:
        off = fits[best].misfit_sigma
        state, label, reason = "invalid", "", f"no class fits: the best, {best}, misfits by {off:.0f} sigma"
    elif probabilities[best] < prior.min_probability:
        second = sorted(probabilities, key=probabilities.__getitem__)[-2]
        state, label, reason = "undetermined", "", f"can't distinguish {best} from {second} yet"
    return ShapeClassification(state, label, reason, contacts, probabilities, fits)


def _check_contacts(points_m: FloatArray, normals: FloatArray, covariances_m2: FloatArray) -> None:
    """Raise ValueError unless the arrays are finite and of matching shapes."""
    n = len(points_m)
    if points_m.shape != (n, 3) or normals.shape != (n, 3) or covariances_m2.shape != (n, 3, 3) or not n:
        shapes = points_m.shape, normals.shape, covariances_m2.shape
        raise ValueError(
            f"points, normals, covariances have shapes {shapes}: must be (n, 3), (n, 3), (n, 3, 3)"
        )
    if not (np.isfinite(points_m).all() and np.isfinite(normals).all() and np.isfinite(covariances_m2).all()):
        raise ValueError("points, normals and covariances must be finite")
