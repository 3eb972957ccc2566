"""How far a hand closes on what it presses: by joint states, or as it was told to.

Public names: `closing_m`, `sways_m`, `opposite`, `held`, `Commanded`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from handtouch.percept.stream import IntArray, Stream, Window

FloatArray = NDArray[np.float64]
_FEW = 24  # samples that are enough to tell how far something goes
_OPPOSED = -0.7  # cosine between normals of two pads that hold something between them


def closing_m(window: Window, others: Sequence[Window] = ()) -> tuple[FloatArray, str]:
    """How far the hand has closed on a contact, (k,) [m], along the contact's normal; and by what: joints,
    command, or "" where neither is known.

    Of the point of the link where the contact is, so that noise of the place on the pad doesn't count.
    others: of the same hand; one that presses from the other side closes, too. Without any, the object is
    taken to be at rest in the palm's frame.
    """
    for by, along in (("joints", _by_joints), ("command", _by_command)):
        moved, normal = along(window)
        if not np.isfinite(moved).any():
            continue
        for other in others:
            there, facing = along(other)
            known = np.isfinite(there)
            if known.any() and float(facing @ normal) < _OPPOSED:
                t, when = (np.asarray(w.t_ns - window.t_ns[0], np.float64) for w in (window, other))
                moved = moved + np.interp(t, when[known], there[known])
                break
        return moved, by
    return np.full(len(window), np.nan), ""


def sways_m(window: Window, opposed: Sequence[Window], others: Sequence[Window]) -> float:
    """How far an object that goes along with the other contacts of the hand may have gone [m], 1 sigma, of
    which `closing_m` knows nothing.

    0 where nothing else touches; infinite where something does and nothing presses from the other side. Else
    it is taken to move as far as the farthest of `others` at most. Of that, two pads that face each other see
    what normals that aren't quite opposite leave, and of its turns what places that aren't do.
    """
    normal = _by_joints(window)[1]
    if not others or not np.isfinite(normal).all():
        return 0.0
    if not opposed:
        return math.inf
    apart = _points(window)[-1] - _points(opposed[0])[-1]
    turns = float(np.linalg.norm(np.cross(apart, normal))) / max(float(np.linalg.norm(apart)), 1e-6)
    left = float(np.linalg.norm(normal + _by_joints(opposed[0])[1])) + turns
    left = left if math.isfinite(left) else 1.0
    ways = []
    for other in others:
        few = max(len(other) // _FEW, 1)
        point = _points(other, few)[other.t_ns[::few] >= window.t_ns[0]]
        point = np.sort(point[~np.isnan(point[:, 0])], axis=0)
        if len(point):
            tail = len(point) // 20  # noise alone has a range, too
            ways.append(float(np.linalg.norm(point[-1 - tail] - point[tail])))
    return min(left, 1.0) / 2 * max(ways, default=0.0)


def held(stream: Stream, pad: int) -> list[Window]:
    """The other contacts of the same hand."""
    near = (stream.hand_of == stream.hand_of[pad]) & (stream.contact > 0) & (stream.count > 1)
    near[pad] = False
    return [stream.window(other) for other in np.flatnonzero(near).tolist()]


def opposite(stream: Stream, pad: int) -> list[Window]:
    """The contact of the same hand that presses most from the other side, if any does."""
    near = np.flatnonzero((stream.hand_of == stream.hand_of[pad]) & (stream.contact > 0) & (stream.count > 1))
    for name in ("palm_normal", "commanded_normal"):
        normals = stream.latest(near, name)
        cosine = normals @ stream.latest(np.array([pad]), name)[0]
        if np.isfinite(cosine).any() and np.nanmin(cosine) < _OPPOSED:
            return [stream.window(int(near[np.nanargmin(cosine)]))]
    return []


def _by_joints(window: Window) -> tuple[FloatArray, FloatArray]:
    """Way of a link's point along the mean normal (k,), and that normal."""
    point = _points(window)
    known = np.flatnonzero(np.isfinite(point).all(axis=1))
    if not len(known):
        return np.full(len(window), np.nan), np.full(3, np.nan)
    normal = window["palm_normal"][known].mean(axis=0)
    normal = normal / np.linalg.norm(normal)
    return np.asarray((point - point[known[-1]]) @ normal), normal


def _points(window: Window, each: int = 1) -> FloatArray:
    """Where in the palm (k, 3) the point of the link was that is touched in the mean, at each so many
    samples; NaN where unknown."""
    names = "palm_rotation", "palm_position_m", "position_m"
    rotation, place, on_link = (window[name][::each] for name in names)
    known = np.isfinite(place).all(axis=1) & np.isfinite(on_link).all(axis=1)
    if not known.any():
        return np.full(place.shape, np.nan)
    offset = on_link - on_link[known].mean(axis=0)
    return np.asarray(place - (rotation @ offset[:, :, None])[:, :, 0])


def _by_command(window: Window) -> tuple[FloatArray, FloatArray]:
    moved = window["commanded_m"]
    known = np.flatnonzero(np.isfinite(moved))
    if not len(known):
        return moved, np.full(3, np.nan)
    return moved - moved[known[-1]], window["commanded_normal"][known].mean(axis=0)


class Commanded:
    """How far the links of n pads were told to close, added up from tick to tick along their normals."""

    def __init__(self, pads: int) -> None:
        self._contact = np.zeros(pads, dtype=np.uint32)
        self._pose = np.full((pads, 3, 4), np.nan)
        self._way = np.zeros(pads)

    def step(
        self,
        pads: IntArray,
        contact: NDArray[np.uint32],
        pose: FloatArray,
        on_link: FloatArray,
        normal: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Ways (k,) since contacts (k,) began, and normals (k, 3) in the palm.

        pose (k, 3, 4): rotation and translation of the links in the palm, joints being as told; on_link and
        normal (k, 3): of the contacts, in the links' frames. NaN where a pose isn't known.
        """
        point = np.concatenate([on_link, np.ones((len(pads), 1))], axis=1)[:, :, None]
        facing = (pose[:, :, :3] @ normal[:, :, None])[:, :, 0]
        moved = ((pose - self._pose[pads]) @ point)[:, :, 0]
        step = (moved * facing).sum(axis=1)
        goes_on = (self._contact[pads] == contact) & np.isfinite(step)
        self._way[pads] = np.where(goes_on, self._way[pads] + np.where(goes_on, step, 0.0), 0.0)
        self._contact[pads], self._pose[pads] = contact, pose
        known = np.isfinite(facing).all(axis=1)
        return np.where(known, self._way[pads], np.nan), facing
