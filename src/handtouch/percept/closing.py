"""How far a hand closes on what it presses: by joint states, or as it was told to.

What nothing else touches is taken to rest in the palm. What several contacts hold moves with them, by far
more than it gives: how it does is solved for, from all of them (`grasped`).

Public names: `closing`, `Closing`, `held`, `Commanded`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.percept.directions import across
from handtouch.percept.grasped import gives, rigid
from handtouch.percept.stream import IntArray, Stream, Window

FloatArray = NDArray[np.float64]

_LEAST_SAMPLES, _MANY = 16, 96  # of a contact; of a squeeze that many hold, which costs more time
_CREEPS_M, _GIVES_M = 0.15e-3, 0.03e-3  # of a contact that sticks: along the pad, and beyond its spring
_LATE_NS = 30_000_000
_UNKNOWN_M = 0.1
_FAR_M = 0.8e-3  # farther in a squeeze goes what isn't held firmly yet, and slides


class Closing(NamedTuple):
    """Depths [m] of the samples `rows` of a window; `share` of their rise (1 sigma) that may be the
    thing's own way. sides: how many contacts give in it. by: joints, command, or "" where nothing tells."""

    depth_m: FloatArray
    rows: slice = slice(None)
    share: float = 0.0
    sides: int = 1
    by: str = ""


def closing(window: Window, others: Sequence[Window] = ()) -> Closing:
    """How far the hand has closed on a contact since its force began to rise.

    others: contacts of the same hand. With any, it is twice what a contact gives in the mean: as far as two
    fingers that pinch the thing would close. Infinite `share`: they don't tell how the thing went.
    """
    each = max(len(window) // _MANY, 1) if others else 1
    for by, follow in (("joints", _by_joints), ("command", _by_command)):
        one = follow(window, each)
        if one is None:
            continue
        own = np.where(one.known, (one.way - one.way[one.known][-1]) @ one.normal, np.nan)
        if not others:
            return Closing(own, by=by)
        first, top = _rising(window["force_n"])
        rows = slice(first, None, each)
        when, rise = window.t_ns[rows], slice(0, (top - first) // rows.step + 1)
        ends = int(when[0]), int(window.t_ns[top])
        tracks = [one, *(track for other in others if (track := follow(other, each)) is not None)]
        tracks = [track for track in tracks if track.covers(*ends)]
        known = top - first >= _LEAST_SAMPLES and bool(np.isfinite(one.force).all())
        if len(tracks) < 2 or tracks[0] is not one or not known:
            return Closing(own, slice(None, None, each), np.inf, 2, by)
        return _together(tracks, when, rise)._replace(rows=rows, by=by)
    return Closing(np.full(len(window), np.nan))


def held(stream: Stream, pad: int) -> list[Window]:
    """The other contacts of the same hand."""
    near = (stream.hand_of == stream.hand_of[pad]) & (stream.contact > 0) & (stream.count > 1)
    near[pad] = False
    return [stream.window(other) for other in np.flatnonzero(near).tolist()]


class _Track(NamedTuple):
    """A contact in the palm: ways (k, 3) of the point of the link that is touched in the mean, where `known`;
    its mean outward normal and place; rotations (k, 3, 3) of the link. Without these the way is known along
    the normal alone."""

    t_ns: NDArray[np.int64]
    known: NDArray[np.bool_]
    way: FloatArray
    normal: FloatArray
    place: FloatArray
    rotation: FloatArray | None
    force: FloatArray

    def covers(self, from_ns: int, until_ns: int) -> bool:
        """Whether it was there all the time."""
        known = self.t_ns[self.known]
        if len(known) < _LEAST_SAMPLES:
            return False
        return bool(known[0] <= from_ns + _LATE_NS and known[-1] >= until_ns - _LATE_NS)

    def at(self, when: NDArray[np.int64]) -> FloatArray:
        """Ways (k, 3) at these times."""
        since, then = (np.asarray(t - when[0], np.float64) for t in (self.t_ns[self.known], when))
        return np.stack([np.interp(then, since, along) for along in self.way[self.known].T], axis=1)

    def force_at(self, when: NDArray[np.int64]) -> FloatArray:
        """Forces (k,) then, NaN where they aren't known all the time."""
        if not np.isfinite(self.force).all():
            return np.full(len(when), np.nan)
        since, then = (np.asarray(t - when[0], np.float64) for t in (self.t_ns, when))
        return np.interp(then, since, self.force)

    def turned(self, from_ns: int, until_ns: int) -> FloatArray:
        """How the link turned between, (3,) [rad]; small angles, NaN where unknown."""
        if self.rotation is None:
            return np.full(3, np.nan)
        begin, end = np.searchsorted(self.t_ns, [from_ns, until_ns]).tolist()
        before = self.rotation[begin : begin + 6].mean(axis=0)
        turn = self.rotation[max(end - 5, 0) : end + 1].mean(axis=0) @ before.T
        return np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2


def _together(tracks: Sequence[_Track], when: NDArray[np.int64], rise: slice) -> Closing:
    """Closing on the first of the tracks, where the others hold the thing, too."""
    force = np.stack([track.force_at(when) for track in tracks])
    frames = _frames(np.stack([track.normal for track in tracks]))
    ways = np.stack([track.at(when) @ frame.T for track, frame in zip(tracks, frames, strict=True)], axis=1)
    rose = float(np.ptp(force[0, rise]))
    of = force[0, rise] - force[0, rise].mean()
    of = of * rose / max(float(of @ of), 1e-12)  # times it: by how much anything went with the force
    std = np.tile([_GIVES_M, _CREEPS_M, _CREEPS_M], (len(tracks), 1))
    std[[track.rotation is None for track in tracks], 1:] = _UNKNOWN_M
    weights, give, deviation, far_m = gives(
        np.tensordot(of, ways[rise], 1),
        force[:, rise] @ of,
        rigid(frames, np.stack([track.place for track in tracks]) - tracks[0].place),
        np.stack([track.turned(int(when[0]), int(when[rise.stop - 1])) for track in tracks]),
        std,
    )
    share = deviation / give if give > 0 and far_m < _FAR_M else np.inf
    return Closing(2 * rose * np.tensordot(ways, weights, 2), share=share, sides=2)


def _frames(normals: FloatArray) -> FloatArray:
    """Normals (m, 3) and two ways across each, as rows (m, 3, 3)."""
    return np.stack([normals, *across(normals)], axis=1)


def _rising(force: FloatArray) -> tuple[int, int]:
    """From where to where the force rises to its greatest."""
    width = max(len(force) // 64, 1)
    smooth = np.convolve(np.nan_to_num(force), np.full(width, 1 / width), mode="valid")
    top = int(np.argmax(smooth))
    return int(np.argmin(smooth[: top + 1])), top


def _by_joints(window: Window, each: int) -> _Track | None:
    """Of the point of the link that is touched in the mean, so that noise of the place doesn't count."""
    rotation, place, on_link = (
        window[name][::each] for name in ("palm_rotation", "palm_position_m", "position_m")
    )
    known = np.isfinite(place).all(axis=1) & np.isfinite(on_link).all(axis=1)
    if not known.any():
        return None
    offset = on_link - on_link[known].mean(axis=0)
    way = place - (rotation @ offset[:, :, None])[:, :, 0]
    normal = window["palm_normal"][::each][known].mean(axis=0)
    middle = place[known].mean(axis=0)
    normal = normal / np.linalg.norm(normal)
    return _Track(window.t_ns[::each], np.asarray(known), way, normal, middle, rotation, _force(window, each))


def _by_command(window: Window, each: int) -> _Track | None:
    moved = window["commanded_m"][::each]
    known = np.isfinite(moved)
    if not known.any():
        return None
    normal = window["commanded_normal"][::each][known].mean(axis=0)
    normal = normal / np.linalg.norm(normal)
    return _Track(
        window.t_ns[::each], known, moved[:, None] * normal, normal, np.zeros(3), None, _force(window, each)
    )


def _force(window: Window, each: int) -> FloatArray:
    """NaN where no bound is known above."""
    return np.where(np.isfinite(window["force_std_n"]), window["force_n"], np.nan)[::each]


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
