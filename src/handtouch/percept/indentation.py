"""Indentation depth of a contact while a hand closes, from joint states or joint commands.

An object that only one contact touches is taken to be at rest in the palm. One that several contacts hold
moves with them by far more than it is indented: its motion is estimated from all of them
(`handtouch.percept.grasp_compliance`).

Public names: `estimate_indentation`, `Indentation`, `other_contacts_of_hand`, `CommandedMotion`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.percept.grasp_compliance import estimate_compliance, rigid_motion_jacobian
from handtouch.percept.samples import ContactBuffer, IntArray, SampleWindow
from handtouch.percept.vectors import perpendicular_directions

FloatArray = NDArray[np.float64]

_MIN_SAMPLES, _MAX_GRASP_SAMPLES = 16, 96  # of a contact; of one in a grasp, which takes longer
_CREEP_STD_M, _NORMAL_MISFIT_STD_M = (
    0.15e-3,
    0.03e-3,
)  # of a sticking contact: along the pad; along the normal, beyond its spring
_MAX_TRACK_GAP_NS = 30_000_000
_UNKNOWN_STD_M = 0.1
_MAX_GRASP_MOTION_M = 0.8e-3  # an object that moves farther isn't held firmly yet and slides


class Indentation(NamedTuple):
    """Depths [m] of the samples `rows` of a window, up to a constant.

    object_motion_fraction: part of the depth's rise (1 sigma) that may be motion of the object instead.
    contact_sides: number of contacts indented in series. source: joints, command, or "" where neither is
    known.
    """

    depth_m: FloatArray
    rows: slice = slice(None)
    object_motion_fraction: float = 0.0
    contact_sides: int = 1
    source: str = ""


def estimate_indentation(window: SampleWindow, others: Sequence[SampleWindow] = ()) -> Indentation:
    """Estimate how far the hand has closed on a contact since its force began to rise.

    others: windows of the other contacts of the same hand. If there are any, the depth is twice the mean
    indentation of a contact: as far as two fingers that pinch the object would close. object_motion_fraction
    is infinite if they don't determine the object's motion.
    """
    each = max(len(window) // _MAX_GRASP_SAMPLES, 1) if others else 1
    for by, follow in (("joints", _track_from_joint_states), ("command", _track_from_commands)):
        one = follow(window, each)
        if one is None:
            continue
        own = np.where(
            one.valid, (one.displacement_m - one.displacement_m[one.valid][-1]) @ one.normal, np.nan
        )
        if not others:
            return Indentation(own, source=by)
        first, top = _force_rise(window["force_n"])
        rows = slice(first, None, each)
        when, rise = window.sample_ns[rows], slice(0, (top - first) // rows.step + 1)
        ends = int(when[0]), int(window.sample_ns[top])
        tracks = [one, *(track for other in others if (track := follow(other, each)) is not None)]
        tracks = [track for track in tracks if track.covers(*ends)]
        known = top - first >= _MIN_SAMPLES and bool(np.isfinite(one.force_n).all())
        if len(tracks) < 2 or tracks[0] is not one or not known:
            return Indentation(own, slice(None, None, each), np.inf, 2, by)
        return _indentation_in_grasp(tracks, when, rise)._replace(rows=rows, source=by)
    return Indentation(np.full(len(window), np.nan))


def other_contacts_of_hand(buffer: ContactBuffer, pad: int) -> list[SampleWindow]:
    """Return the windows of the other contacts of the same hand."""
    near = (buffer.hand_index == buffer.hand_index[pad]) & (buffer.contact_id > 0) & (buffer.sample_count > 1)
    near[pad] = False
    return [buffer.window(other) for other in np.flatnonzero(near).tolist()]


class _LinkTrack(NamedTuple):
    """Motion in the palm frame of the link under one contact.

    displacement_m: (k, 3) of the link's mean contact point, where `valid`; normal, position_m: mean outward
    normal and position; rotation: (k, 3, 3) of the link, None if the displacement is known along the normal
    only.
    """

    sample_ns: NDArray[np.int64]
    valid: NDArray[np.bool_]
    displacement_m: FloatArray
    normal: FloatArray
    position_m: FloatArray
    rotation: FloatArray | None
    force_n: FloatArray

    def covers(self, from_ns: int, until_ns: int) -> bool:
        """Return whether the track has valid samples over the whole interval."""
        known = self.sample_ns[self.valid]
        if len(known) < _MIN_SAMPLES:
            return False
        return bool(known[0] <= from_ns + _MAX_TRACK_GAP_NS and known[-1] >= until_ns - _MAX_TRACK_GAP_NS)

    def displacement_at(self, when: NDArray[np.int64]) -> FloatArray:
        """Return the displacements (k, 3) interpolated at these times."""
        since, then = (np.asarray(t - when[0], np.float64) for t in (self.sample_ns[self.valid], when))
        return np.stack(
            [np.interp(then, since, along) for along in self.displacement_m[self.valid].T], axis=1
        )

    def force_at(self, when: NDArray[np.int64]) -> FloatArray:
        """Return the forces (k,) interpolated at these times; NaN unless all of them are known."""
        if not np.isfinite(self.force_n).all():
            return np.full(len(when), np.nan)
        since, then = (np.asarray(t - when[0], np.float64) for t in (self.sample_ns, when))
        return np.interp(then, since, self.force_n)

    def rotation_between(self, from_ns: int, until_ns: int) -> FloatArray:
        """Return the link's rotation vector (3,) [rad] between two times; small angles, NaN if unknown."""
        if self.rotation is None:
            return np.full(3, np.nan)
        begin, end = np.searchsorted(self.sample_ns, [from_ns, until_ns]).tolist()
        before = self.rotation[begin : begin + 6].mean(axis=0)
        turn = self.rotation[max(end - 5, 0) : end + 1].mean(axis=0) @ before.T
        return np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2


def _indentation_in_grasp(tracks: Sequence[_LinkTrack], when: NDArray[np.int64], rise: slice) -> Indentation:
    """Return the indentation of the first track's contact while the other contacts hold the object."""
    force = np.stack([track.force_at(when) for track in tracks])
    frames = _contact_frames(np.stack([track.normal for track in tracks]))
    ways = np.stack(
        [track.displacement_at(when) @ frame.T for track, frame in zip(tracks, frames, strict=True)], axis=1
    )
    rose = float(np.ptp(force[0, rise]))
    force_response = force[0, rise] - force[0, rise].mean()
    # product with a signal: its change that is correlated with the force
    force_response = force_response * rose / max(float(force_response @ force_response), 1e-12)
    std = np.tile([_NORMAL_MISFIT_STD_M, _CREEP_STD_M, _CREEP_STD_M], (len(tracks), 1))
    std[[track.rotation is None for track in tracks], 1:] = _UNKNOWN_STD_M
    weights, give, deviation, far_m = estimate_compliance(
        np.tensordot(force_response, ways[rise], 1),
        force[:, rise] @ force_response,
        rigid_motion_jacobian(
            frames, np.stack([track.position_m for track in tracks]) - tracks[0].position_m
        ),
        np.stack([track.rotation_between(int(when[0]), int(when[rise.stop - 1])) for track in tracks]),
        std,
    )
    fraction = deviation / give if give > 0 and far_m < _MAX_GRASP_MOTION_M else np.inf
    return Indentation(
        2 * rose * np.tensordot(ways, weights, 2), object_motion_fraction=fraction, contact_sides=2
    )


def _contact_frames(normals: FloatArray) -> FloatArray:
    """Return normals (m, 3) and two perpendicular directions each, as rows (m, 3, 3)."""
    return np.stack([normals, *perpendicular_directions(normals)], axis=1)


def _force_rise(force: FloatArray) -> tuple[int, int]:
    """Return the first and last index of the force's rise to its maximum."""
    width = max(len(force) // 64, 1)
    smooth = np.convolve(np.nan_to_num(force), np.full(width, 1 / width), mode="valid")
    top = int(np.argmax(smooth))
    return int(np.argmin(smooth[: top + 1])), top


def _track_from_joint_states(window: SampleWindow, each: int) -> _LinkTrack | None:
    """Track the mean contact point of the link, so that noise of the contact position cancels."""
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
    return _LinkTrack(
        window.sample_ns[::each], np.asarray(known), way, normal, middle, rotation, _known_force(window, each)
    )


def _track_from_commands(window: SampleWindow, each: int) -> _LinkTrack | None:
    moved = window["commanded_m"][::each]
    known = np.isfinite(moved)
    if not known.any():
        return None
    normal = window["commanded_normal"][::each][known].mean(axis=0)
    normal = normal / np.linalg.norm(normal)
    return _LinkTrack(
        window.sample_ns[::each],
        known,
        moved[:, None] * normal,
        normal,
        np.zeros(3),
        None,
        _known_force(window, each),
    )


def _known_force(window: SampleWindow, each: int) -> FloatArray:
    """Return the forces of every `each`-th sample, NaN where a force is a lower bound only."""
    return np.where(np.isfinite(window["force_std_n"]), window["force_n"], np.nan)[::each]


class CommandedMotion:
    """Accumulates the commanded displacement of the links of n pads along their contact normals."""

    def __init__(self, pads: int) -> None:
        self._contact_id = np.zeros(pads, dtype=np.uint32)
        self._pose = np.full((pads, 3, 4), np.nan)
        self._displacement_m = np.zeros(pads)

    def accumulate(
        self,
        pads: IntArray,
        contact: NDArray[np.uint32],
        pose: FloatArray,
        on_link: FloatArray,
        normal: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Return displacements (k,) since contacts (k,) began, and normals (k, 3) in the palm frame.

        pose: (k, 3, 4) rotation and translation of the links in the palm frame at the commanded joint
        positions; on_link, normal: (k, 3) of the contacts, in the links' frames. NaN where a pose isn't
        known.
        """
        point = np.concatenate([on_link, np.ones((len(pads), 1))], axis=1)[:, :, None]
        facing = (pose[:, :, :3] @ normal[:, :, None])[:, :, 0]
        moved = ((pose - self._pose[pads]) @ point)[:, :, 0]
        step = (moved * facing).sum(axis=1)
        continues = (self._contact_id[pads] == contact) & np.isfinite(step)
        self._displacement_m[pads] = np.where(
            continues, self._displacement_m[pads] + np.where(continues, step, 0.0), 0.0
        )
        self._contact_id[pads], self._pose[pads] = contact, pose
        known = np.isfinite(facing).all(axis=1)
        return np.where(known, self._displacement_m[pads], np.nan), facing
