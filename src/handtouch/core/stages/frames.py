"""Contacts in the palm and base frames, from the joint states at their sample times; where requested.

Public name: `ContactTransforms`. Free of I/O and clocks; joint states come from `joints_at`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from handtouch.core.memory import RowArray, row_count, slices_of, view_memory, view_rows
from handtouch.core.stages import kinematics
from handtouch.core.stages.groups import ContactGroups
from handtouch.core.stages.rows import CONTACT_FRAMES, FRAME_ROW, PART_FRAMES, PART_ROW, VALUE_ROW
from handtouch.hand.joints import JointSnapshot
from handtouch.wire.status import FrameStatus

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from handtouch.arrays import BoolArray, FloatArray, IntArray
    from handtouch.core.columns import TickResult
    from handtouch.core.state import TickState
    from handtouch.hand.robot_models import RobotModels


_PLACES = slices_of(CONTACT_FRAMES)
_BASE, _AGE = _PLACES["base_position_m"].start, _PLACES["joints_age_s"].start
_ROW, _PARTS = row_count(CONTACT_FRAMES), 2 * row_count(PART_FRAMES)
_VECTOR, _VECTORS = 12, 6  # force vector with its covariance; in palm and base
_NOT_COMPUTED, _VALID, _STALE, _INVALID = map(int, FrameStatus)
_NAN, _INFINITY = float("nan"), float("inf")
_NEVER_NS = 1 << 62


class HandFrames:
    """Kinematics of one hand: pads `first` to `stop` are on its links, in their order.

    masks: (2 n m,), 1 for a joint on which the pose of a link in the palm depends; the same for the base.
    stds: (m,) of the joints, those of the last call. mounts: (3 n,) origins of the pads on their links [m].
    mount_variance, mount_rotation_variance: of these in m^2 and rad^2, about each axis.
    stale_s: age of joints beyond which a pose is stale.
    """

    def __init__(self, robots: RobotModels, number: int) -> None:
        hand, rows, mounts = robots.kinematics[number], robots.pad_rows[number], robots.mounts[number]
        self.name, self.errors = robots.hands[number], robots.joint_errors[number]
        self.tree = kinematics.LinkPoses(hand)
        self.first, self.stop = int(rows[0]), int(rows[0]) + len(rows)
        self.masks = view_memory(np.concatenate([hand.palm_joint_mask, hand.base_joint_mask]))
        self.stds = view_memory(np.zeros(self.tree.joints))
        self.mounts = view_memory(mounts.origin_m)
        self.mount_variance = mounts.position_variance_m2
        self.mount_rotation_variance = mounts.rotation_variance_rad2
        self.stale_s = robots.joints_stale_s[number]


class ContactTransforms:
    """Contacts on n pads in palm and base; a row keeps its values until its contact ends.

    `joints_at`: function of a hand and a time that returns the hand's joints then, None if unknown; set by
    the daemon. `used_joints`: hand, time, positions, ages and standard deviations of the joints used by the
    last tick, for recorders. `any_requested`: any pad is requested in palm or base.
    """

    def __init__(self, hands: list[str], robots: RobotModels | None, state: TickState) -> None:
        n, memory = len(hands), state.memory
        self.pads, self.held = n, state
        used_joints: list[Any] = []
        self.joints_at, self.used_joints, self.any_requested = _NO_JOINTS, used_joints, False
        self.requested = np.zeros(n, dtype=np.bool_)
        self.hands = [HandFrames(robots, number) for number in range(len(robots.hands))] if robots else []
        self.published_values = np.full((n, _ROW), np.nan, np.float32)
        self.published, self.pending = view_memory(self.published_values), view_memory(np.zeros(n, np.uint8))
        self.pose = view_rows(np.zeros(1, kinematics.POSE_ROW), kinematics.POSE_ROW)
        self.on_link = view_rows(np.zeros(1, FRAME_ROW), FRAME_ROW)
        self.covariance = view_memory(np.zeros(9))
        self.contacts, self.parts = view_rows(state.values, VALUE_ROW), view_rows(state.parts, PART_ROW)
        frames: Any = view_rows(state.palm_values, CONTACT_FRAMES)
        parts: Any = view_rows(state.part_frames, PART_FRAMES)
        self.palm, self.base = frames["palm"], frames["base"]
        self.parts_palm, self.parts_base = parts["palm"], parts["base"]
        within_m, number_of_hand = np.zeros(n), {hand: k for k, hand in enumerate(dict.fromkeys(hands))}
        for rows, group_m in zip(robots.pad_rows, robots.group_distance_m, strict=True) if robots else ():
            within_m[rows] = group_m
        self.groups = ContactGroups(
            within_m, np.array([number_of_hand[hand] for hand in hands]), state, frames["palm"]
        )
        self.values, self.part_values = memory["palm_values"], memory["part_frames"]
        self.rotation = memory["palm_rotation"]
        self.vector, self.frame_vector = memory["force_vector"], memory["frame_force_vector"]
        self.sample_ns, self.joint_variance_m2 = memory["sample_ns"], memory["joint_variance_m2"]
        self.palm_requested, self.base_requested = memory["palm_requested"], memory["base_requested"]
        self.palm_status, self.base_status = memory["palm_status"], memory["base_status"]

    @property
    def group(self) -> NDArray[np.uint32]:
        """Ids of contact groups (n,), 0 without contact or where not requested."""
        return self.held.group_id

    def set_requested(self, palm: BoolArray, base: BoolArray) -> None:
        """Restrict palm and base outputs to these pads (n,); copied."""
        held = self.held
        changed = np.flatnonzero((palm != held.palm_requested) | (base != held.base_requested))
        held.palm_requested[:], held.base_requested[:] = palm, base
        self.discard(changed)
        self.refresh()

    def refresh(self) -> None:
        """Compute what follows from the state, after that was loaded."""
        np.logical_or(self.held.palm_requested, self.held.base_requested, out=self.requested)
        self.any_requested = bool(self.requested.any())
        if not self.any_requested:
            self.used_joints.clear()
        for pad in range(self.pads):
            _publish_pad(self, pad)

    def transform_updated(self, result: TickResult) -> None:
        """Transform the contacts that a tick updated."""
        self.used_joints.clear()
        for pad in range(self.pads):
            self.pending[pad] = 0
        for pads in (result.began, result.updated, result.framed):
            self.begin_contacts(pads)
        for hand in self.hands:
            while sample_ns := self.next_sample_ns(hand):  # one, unless pads are event-driven
                joints = self.joints_at(hand.name, sample_ns) or JointSnapshot.unknown(
                    sample_ns, hand.tree.joints
                )
                positions, ages_s, stated = joints.position_rad, joints.age_s, joints.std_rad
                self.used_joints.append((hand.name, sample_ns, positions, ages_s, stated))
                self.transform_contacts(hand, sample_ns, positions, ages_s, hand.errors.of(stated))
        self.groups.update_groups()

    def begin_contacts(self, pads: IntArray) -> None:
        """Discard the values of these pads, where requested; `transform_contacts` computes new ones."""
        for k in range(len(pads)):
            _begin_contact(self, pads[k])

    def discard(self, pads: IntArray) -> None:
        """Discard the values of pads whose contact ended or is no longer requested."""
        for k in range(len(pads)):
            _discard(self, pads[k])

    def next_sample_ns(self, hand: HandFrames) -> int:
        """Return the earliest sample of a hand's contacts that are to be transformed, 0 if there is none."""
        earliest = _NEVER_NS
        for pad in range(hand.first, hand.stop):
            if self.pending[pad] and self.sample_ns[pad] < earliest:
                earliest = self.sample_ns[pad]
        return earliest if earliest < _NEVER_NS else 0

    def transform_contacts(
        self, hand: HandFrames, sample_ns: int, positions: FloatArray, ages_s: FloatArray, stds: FloatArray
    ) -> None:
        """Transform a hand's contacts sampled at a time, by positions, ages and deviations (m,) of joints."""
        hand.tree.set_joint_positions(positions)
        for joint in range(hand.tree.joints):
            hand.stds[joint] = stds[joint]
        for pad in range(hand.first, hand.stop):
            if self.pending[pad] and self.sample_ns[pad] <= sample_ns:
                self.pending[pad] = 0
                _transform_contact(self, hand, pad, ages_s)

    def in_palm(self, rows: IntArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return position, normal and covariance (k, 15) of contacts in the palm, rotations (k, 3, 3) of
        their links in it, and ages (k,) of joints; NaN where not valid. Also the variance (k,) [m^2] of the
        position from the joints' standard deviations, mean over the axes; 0 where there are none."""
        held = self.held
        values = held.palm_values[rows]
        return values[:, :_BASE], held.palm_rotation[rows], values[:, _AGE], held.joint_variance_m2[rows]

    def hand_columns(self, rows: slice) -> dict[str, bytes]:
        """Return columns of a hand frame; empty where not requested."""
        if not np.count_nonzero(self.requested[rows]):
            return {}
        held, published = self.held, self.published_values[rows]
        columns = {"group": held.group_id[rows].tobytes(), "joints_age_s": published[:, _AGE].tobytes()}
        for frame, status, requested in (
            ("palm", held.palm_status, held.palm_requested),
            ("base", held.base_status, held.base_requested),
        ):
            if np.count_nonzero(requested[rows]):
                columns[f"{frame}_status"] = status[rows].tobytes()
                for name, at in _PLACES.items():
                    if name.startswith(frame):
                        columns[name] = published[:, at].tobytes()
        return columns

    def recorded_joints(self) -> tuple[dict[str, Any], ...]:
        """Return `used_joints` as msgpack values, see `wire.recording.UsedJoints`."""
        return tuple(
            {
                "hand": hand,
                "t_ns": t_ns,
                "position_rad": position_rad.tobytes(),
                "age_s": age_s.tobytes(),
                "std_rad": std_rad.tobytes(),
            }
            for hand, t_ns, position_rad, age_s, std_rad in self.used_joints
        )

    def replay_joints(self, recorded: Sequence[Mapping[str, Any]]) -> None:
        """Use the joints of a record of `recorded_joints` in the next tick."""
        known = {
            (joints["hand"], joints["t_ns"]): JointSnapshot(
                joints["t_ns"],
                *(np.frombuffer(joints[name], np.float64) for name in ("position_rad", "age_s", "std_rad")),
            )
            for joints in recorded
        }
        self.joints_at = lambda hand, t_ns: known.get((hand, t_ns))


def _no_joints(hand: str, t_ns: int) -> JointSnapshot | None:  # noqa: ARG001
    return None


_NO_JOINTS: Any = _no_joints


def _begin_contact(frames: ContactTransforms, pad: int) -> None:
    if frames.palm_requested[pad] or frames.base_requested[pad]:
        frames.pending[pad] = 1
        _discard(frames, pad)
        frames.palm_status[pad] = _INVALID if frames.palm_requested[pad] else _NOT_COMPUTED
        frames.base_status[pad] = _INVALID if frames.base_requested[pad] else _NOT_COMPUTED


def _discard(frames: ContactTransforms, pad: int) -> None:
    frames.palm_status[pad] = frames.base_status[pad] = _NOT_COMPUTED
    for i in range(_ROW):
        frames.values[pad * _ROW + i] = _NAN
    for i in range(_VECTORS):
        frames.frame_vector[pad * _VECTORS + i] = _NAN
    in_palm, in_base = frames.parts_palm[2 * pad].position_m[0], frames.parts_base[2 * pad].position_m[0]
    if in_palm == in_palm or in_base == in_base:
        for i in range(_PARTS):
            frames.part_values[pad * _PARTS + i] = _NAN
    _publish_pad(frames, pad)


def _publish_pad(frames: ContactTransforms, pad: int) -> None:
    """Write the published values of a pad: NaN where there is no valid value."""
    in_palm, in_base = frames.palm_status[pad] == _VALID, frames.base_status[pad] == _VALID
    row = pad * _ROW
    for i in range(row, row + _BASE):
        frames.published[i] = frames.values[i] if in_palm else _NAN
    for i in range(row + _BASE, row + _AGE):
        frames.published[i] = frames.values[i] if in_base else _NAN
    frames.published[row + _AGE] = frames.values[row + _AGE]


def _transform_contact(frames: ContactTransforms, hand: HandFrames, pad: int, ages_s: FloatArray) -> None:
    """Transform a contact to the palm and, if requested, to the base."""
    oldest_s = _transform(frames, hand, pad, False, ages_s)
    if frames.base_requested[pad]:
        oldest_s = max(oldest_s, _transform(frames, hand, pad, True, ages_s))
    if not frames.palm_requested[pad]:
        frames.palm_status[pad] = _NOT_COMPUTED
    frames.values[pad * _ROW + _AGE] = oldest_s if oldest_s < _INFINITY else _NAN
    _publish_pad(frames, pad)


def _transform(
    frames: ContactTransforms, hand: HandFrames, pad: int, in_base: bool, ages_s: FloatArray
) -> float:
    """Transform a contact to one frame; return the age of the oldest joint that its pose depends on."""
    link = pad - hand.first
    mask = (hand.stop - hand.first + link if in_base else link) * hand.tree.joints
    oldest_s = 0.0
    for joint in range(hand.tree.joints):
        if hand.masks[mask + joint]:
            oldest_s = max(oldest_s, ages_s[joint])
    hand.tree.write_pose(link, in_base, frames.pose)
    for i in range(3):
        frames.on_link[0].position_m[i] = frames.contacts[pad].position_m[i]
        frames.on_link[0].normal[i] = frames.contacts[pad].normal[i]
    for i in range(9):
        frames.on_link[0].covariance_m2[i] = frames.contacts[pad].covariance_m2[i]
    _set_joint_covariance(frames, hand, link, in_base)
    if not in_base:
        for i in range(9):
            frames.rotation[9 * pad + i] = frames.pose[0].rotation[i]
        variance = frames.covariance[0] + frames.covariance[4] + frames.covariance[8]
        frames.joint_variance_m2[pad] = variance / 3.0
    status = _VALID if oldest_s <= hand.stale_s else _STALE
    x = frames.on_link[0].position_m[0]
    if not (oldest_s < _INFINITY and x - x == 0.0):
        status = _INVALID
    if in_base:
        frames.base_status[pad] = status
    else:
        frames.palm_status[pad] = status
    if status != _VALID:
        return oldest_s
    _write_in_frame(frames, hand, link, frames.base if in_base else frames.palm, pad)
    vector, turned_vector = pad * _VECTOR, pad * _VECTORS + (3 if in_base else 0)
    for i in range(3):
        a, b, c = _turning(frames, i, 0), _turning(frames, i, 1), _turning(frames, i, 2)
        turned = a * frames.vector[vector] + b * frames.vector[vector + 1] + c * frames.vector[vector + 2]
        frames.frame_vector[turned_vector + i] = turned
    if frames.parts[2 * pad].position_m[0] == frames.parts[2 * pad].position_m[0]:
        for part in range(2 * pad, 2 * pad + 2):
            _transform_part(frames, hand, link, part, in_base)
    return oldest_s


def _transform_part(frames: ContactTransforms, hand: HandFrames, link: int, part: int, in_base: bool) -> None:
    """Transform one of two contacts on a pad to the frame of `pose`."""
    for i in range(3):
        frames.on_link[0].position_m[i] = frames.parts[part].position_m[i]
        frames.on_link[0].normal[i] = frames.parts[part].normal[i]
    for i in range(9):
        frames.on_link[0].covariance_m2[i] = frames.parts[part].covariance_m2[i]
    _set_joint_covariance(frames, hand, link, in_base)
    _write_in_frame(frames, hand, link, frames.parts_base if in_base else frames.parts_palm, part)


def _turning(frames: ContactTransforms, i: int, j: int) -> float:
    """Return element (i, j) of the rotation of `pose`."""
    element: float = frames.pose[0].rotation[3 * i + j]
    return element


def _set_joint_covariance(frames: ContactTransforms, hand: HandFrames, link: int, in_base: bool) -> None:
    """Set `covariance` to that of the contact `on_link` by the joints."""
    x, y, z = (
        frames.on_link[0].position_m[0],
        frames.on_link[0].position_m[1],
        frames.on_link[0].position_m[2],
    )
    for i in range(9):
        frames.covariance[i] = 0.0
    hand.tree.add_joint_covariance(link, in_base, x, y, z, hand.stds, frames.covariance)


def _write_in_frame(
    frames: ContactTransforms, hand: HandFrames, link: int, written: RowArray, row: int
) -> None:
    """Write the contact `on_link` in the frame of `pose` to a row; `covariance` is that by joints."""
    _add_link_covariance(frames, hand, link)
    for i in range(3):
        a, b, c = _turning(frames, i, 0), _turning(frames, i, 1), _turning(frames, i, 2)
        turned = (
            a * frames.on_link[0].position_m[0]
            + b * frames.on_link[0].position_m[1]
            + c * frames.on_link[0].position_m[2]
        )
        written[row].position_m[i] = turned + frames.pose[0].translation[i]
        written[row].normal[i] = (
            a * frames.on_link[0].normal[0]
            + b * frames.on_link[0].normal[1]
            + c * frames.on_link[0].normal[2]
        )
    for i in range(9):
        written[row].covariance_m2[i] = frames.covariance[i]


def _add_link_covariance(frames: ContactTransforms, hand: HandFrames, link: int) -> None:
    """Add the covariance of the contact on its link, and of the pad's mount, turned to the frame of `pose`.

    A rotation error of s about each axis through the pad's origin moves a point at r by s^2 (r.r 1 - r r').
    """
    x = frames.on_link[0].position_m[0] - hand.mounts[3 * link]
    y = frames.on_link[0].position_m[1] - hand.mounts[3 * link + 1]
    z = frames.on_link[0].position_m[2] - hand.mounts[3 * link + 2]
    turning = hand.mount_rotation_variance
    even = hand.mount_variance + turning * (x * x + y * y + z * z)
    for i in range(3):
        a, b, c = _turning(frames, i, 0), _turning(frames, i, 1), _turning(frames, i, 2)
        arm = turning * (a * x + b * y + c * z)
        by_x = _turned_column(frames, 0, a, b, c) + even * a - arm * x
        by_y = _turned_column(frames, 1, a, b, c) + even * b - arm * y
        by_z = _turned_column(frames, 2, a, b, c) + even * c - arm * z
        for j in range(3):
            frames.covariance[3 * i + j] += (
                by_x * _turning(frames, j, 0) + by_y * _turning(frames, j, 1) + by_z * _turning(frames, j, 2)
            )


def _turned_column(frames: ContactTransforms, j: int, a: float, b: float, c: float) -> float:
    """Return the product of (a, b, c) with column j of the covariance of the contact `on_link`."""
    turned: float = (
        a * frames.on_link[0].covariance_m2[j]
        + b * frames.on_link[0].covariance_m2[3 + j]
        + c * frames.on_link[0].covariance_m2[6 + j]
    )
    return turned
