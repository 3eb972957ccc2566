"""Contacts in the palm and base frames at the joint states of their samples; where requested."""

from __future__ import annotations

from typing import Any

from handtouch.core.stages import kinematics
from handtouch.core.stages.solve import PART_COUNT, PART_SLICES, PARTS_COUNT, VALUE_COUNT, VALUE_SLICES
from handtouch.wire.status import FrameStatus

FRAME_VALUES = 15
FRAME_SLICES = {"position_m": slice(0, 3), "normal": slice(3, 6), "covariance_m2": slice(6, 15)}
"""Layout of a contact in one frame; a row of values holds it in palm, in base, and the age of joints."""
PART_FRAMES = 4 * FRAME_VALUES
"""Values of a row of `part_frames`: of each of two contacts on a pad, in palm and in base."""
_COUNT, _ROW, _AGE = FRAME_VALUES, 2 * FRAME_VALUES + 1, 2 * FRAME_VALUES
_VALUES, _POSITION = VALUE_COUNT, VALUE_SLICES["position_m"].start
_NORMAL, _COVARIANCE = VALUE_SLICES["normal"].start, VALUE_SLICES["covariance_m2"].start
_PART_COUNT, _PARTS_COUNT, _PART_FRAMES = PART_COUNT, PARTS_COUNT, PART_FRAMES
_PART_POSITION, _PART_NORMAL = PART_SLICES["position_m"].start, PART_SLICES["normal"].start
_PART_COVARIANCE = PART_SLICES["covariance_m2"].start
_VECTOR, _FRAME_VECTORS = 12, 6  # force vector with its covariance; in palm and base
_NOT_COMPUTED, _VALID, _STALE, _INVALID = map(int, FrameStatus)
_NAN, _INFINITY = float("nan"), float("inf")
_NEVER_NS = 1 << 62


class HandFrames:
    """Kinematics of one hand for `FrameStage`: pads `first` to `stop` are on its links, in their order.

    masks: (2 n m,) 1 for a joint on which the pose of a link in the palm depends; the same for the base.
    stds: (m,) of the joints, those of the last call. mounts: (n 3,) origins of the pads on their links [m].
    mount_variance, mount_rotation_variance: of these in m^2 and rad^2, about each axis.
    stale_s: age of joints beyond which a pose is stale.
    """

    def __init__(
        self,
        tree: kinematics.LinkPoses,
        first: int,
        stop: int,
        masks: memoryview[int],
        stds: memoryview[float],
        mounts: memoryview[float],
        mount_variance: float,
        mount_rotation_variance: float,
        stale_s: float,
    ) -> None:
        self.tree, self.first, self.stop = tree, first, stop
        self.masks, self.stds, self.mounts = masks, stds, mounts
        self.mount_variance, self.mount_rotation_variance = mount_variance, mount_rotation_variance
        self.stale_s = stale_s


class FrameStage:
    """Palm and base frames of n pads. arrays: flat memory of the arrays of `TickState` by their names.

    published: (2 n 15 + n,) columns of position, normal and covariance in palm, in base, then the age of
    joints; NaN where there is no valid value. pending: (n,), pose: (12,), covariance: (9,), working memory.
    """

    def __init__(
        self,
        arrays: dict[str, memoryview[Any]],
        published: memoryview[float],
        pending: memoryview[int],
        pose: memoryview[float],
        covariance: memoryview[float],
    ) -> None:
        self.pads = len(pending)
        self.values, self.sample_ns = arrays["values"], arrays["sample_ns"]
        self.palm_requested, self.base_requested = arrays["palm_requested"], arrays["base_requested"]
        self.palm_status, self.base_status = arrays["palm_status"], arrays["base_status"]
        self.frame_values, self.rotation = arrays["palm_values"], arrays["palm_rotation"]
        self.joint_variance_m2 = arrays["joint_variance_m2"]
        self.vector, self.frame_vector = arrays["force_vector"], arrays["frame_force_vector"]
        self.parts, self.part_frames = arrays["parts"], arrays["part_frames"]
        self.published, self.pending = published, pending
        self.pose, self.covariance = pose, covariance

    def begin_contacts(self, began: memoryview[int], updated: memoryview[int]) -> None:
        """Discard the values of these pads, where requested; `transform_contacts` computes new ones."""
        for pad in range(self.pads):
            self.pending[pad] = 0
        for k in range(len(began)):
            _begin_contact(self, began[k])
        for k in range(len(updated)):
            _begin_contact(self, updated[k])

    def discard(self, pads: memoryview[int]) -> None:
        """Discard the values of pads whose contact ended or is no longer requested."""
        for k in range(len(pads)):
            _discard(self, pads[k])

    def publish(self) -> None:
        """Write the published columns of all pads."""
        for pad in range(self.pads):
            _publish_pad(self, pad)

    def next_sample_ns(self, hand: HandFrames) -> int:
        """Return the earliest sample of a hand's contacts that are to be transformed, 0 if there is none."""
        earliest = _NEVER_NS
        for pad in range(hand.first, hand.stop):
            if self.pending[pad] and self.sample_ns[pad] < earliest:
                earliest = self.sample_ns[pad]
        return earliest if earliest < _NEVER_NS else 0

    def transform_contacts(
        self,
        hand: HandFrames,
        sample_ns: int,
        positions: memoryview[float],
        ages_s: memoryview[float],
        stds: memoryview[float],
    ) -> None:
        """Transform a hand's contacts sampled at a time, by positions, ages and deviations (m,) of joints."""
        hand.tree.set_joint_positions(positions)
        for joint in range(hand.tree.joints):
            hand.stds[joint] = stds[joint]
        for pad in range(hand.first, hand.stop):
            if self.pending[pad] and self.sample_ns[pad] <= sample_ns:
                self.pending[pad] = 0
                _transform_contact(self, hand, pad, ages_s)


def _begin_contact(stage: FrameStage, pad: int) -> None:
    if stage.palm_requested[pad] or stage.base_requested[pad]:
        stage.pending[pad] = 1
        _discard(stage, pad)
        stage.palm_status[pad] = _INVALID if stage.palm_requested[pad] else _NOT_COMPUTED
        stage.base_status[pad] = _INVALID if stage.base_requested[pad] else _NOT_COMPUTED


def _discard(stage: FrameStage, pad: int) -> None:
    stage.palm_status[pad] = stage.base_status[pad] = _NOT_COMPUTED
    for i in range(_ROW):
        stage.frame_values[pad * _ROW + i] = _NAN
    for i in range(_FRAME_VECTORS):
        stage.frame_vector[pad * _FRAME_VECTORS + i] = _NAN
    first = pad * _PART_FRAMES
    in_palm, in_base = stage.part_frames[first], stage.part_frames[first + _COUNT]
    if in_palm == in_palm or in_base == in_base:
        for i in range(_PART_FRAMES):
            stage.part_frames[first + i] = _NAN
    _publish_pad(stage, pad)


def _publish_pad(stage: FrameStage, pad: int) -> None:
    row = pad * _ROW
    for i in range(2 * _COUNT):
        status = stage.palm_status[pad] if i < _COUNT else stage.base_status[pad]
        first, j, width = 0 if i < _COUNT else _COUNT, i % _COUNT, 3
        if j >= 6:
            first, j, width = first + 6, j - 6, 9
        elif j >= 3:
            first, j = first + 3, j - 3
        value = stage.frame_values[row + i] if status == _VALID else _NAN
        stage.published[first * stage.pads + pad * width + j] = value
    stage.published[_AGE * stage.pads + pad] = stage.frame_values[row + _AGE]


def _transform_contact(stage: FrameStage, hand: HandFrames, pad: int, ages_s: memoryview[float]) -> None:
    """Transform a contact to the palm and, if requested, to the base."""
    oldest_s = _transform(stage, hand, pad, False, ages_s)
    if stage.base_requested[pad]:
        oldest_s = max(oldest_s, _transform(stage, hand, pad, True, ages_s))
    if not stage.palm_requested[pad]:
        stage.palm_status[pad] = _NOT_COMPUTED
    stage.frame_values[pad * _ROW + _AGE] = oldest_s if oldest_s < _INFINITY else _NAN
    _publish_pad(stage, pad)


def _transform(
    stage: FrameStage, hand: HandFrames, pad: int, in_base: bool, ages_s: memoryview[float]
) -> float:
    """Transform a contact to one frame; return the age of the oldest joint that its pose depends on."""
    link, joints, pose, values = pad - hand.first, hand.tree.joints, stage.pose, stage.values
    mask = (hand.stop - hand.first + link if in_base else link) * joints
    oldest_s = 0.0
    for joint in range(joints):
        if hand.masks[mask + joint]:
            oldest_s = max(oldest_s, ages_s[joint])
    hand.tree.write_pose(link, in_base, pose)
    on_pad, row = pad * _VALUES, pad * _ROW + (_COUNT if in_base else 0)
    for i in range(9):
        stage.covariance[i] = 0.0
    hand.tree.add_joint_covariance(link, in_base, values, on_pad + _POSITION, hand.stds, stage.covariance)
    if not in_base:
        for i in range(9):
            stage.rotation[9 * pad + i] = pose[i]
        variance = stage.covariance[0] + stage.covariance[4] + stage.covariance[8]
        stage.joint_variance_m2[pad] = variance / 3.0
    status = _VALID if oldest_s <= hand.stale_s else _STALE
    x = values[on_pad + _POSITION]
    if not (oldest_s < _INFINITY and x - x == 0.0):
        status = _INVALID
    if in_base:
        stage.base_status[pad] = status
    else:
        stage.palm_status[pad] = status
    if status != _VALID:
        return oldest_s
    _write_in_frame(
        stage,
        hand,
        link,
        values,
        on_pad + _POSITION,
        on_pad + _NORMAL,
        on_pad + _COVARIANCE,
        stage.frame_values,
        row,
    )
    for i in range(3):
        a, b, c = pose[3 * i], pose[3 * i + 1], pose[3 * i + 2]
        at = _VECTOR * pad
        turned = a * stage.vector[at] + b * stage.vector[at + 1] + c * stage.vector[at + 2]
        stage.frame_vector[_FRAME_VECTORS * pad + (3 if in_base else 0) + i] = turned
    if stage.parts[pad * _PARTS_COUNT] == stage.parts[pad * _PARTS_COUNT]:
        _transform_parts(stage, hand, pad, in_base)
    return oldest_s


def _transform_parts(stage: FrameStage, hand: HandFrames, pad: int, in_base: bool) -> None:
    """Transform two contacts on a pad to the frame of `pose`."""
    link = pad - hand.first
    for k in range(2):
        at = pad * _PARTS_COUNT + k * _PART_COUNT
        for i in range(9):
            stage.covariance[i] = 0.0
        hand.tree.add_joint_covariance(
            link, in_base, stage.parts, at + _PART_POSITION, hand.stds, stage.covariance
        )
        _write_in_frame(
            stage,
            hand,
            link,
            stage.parts,
            at + _PART_POSITION,
            at + _PART_NORMAL,
            at + _PART_COVARIANCE,
            stage.part_frames,
            pad * _PART_FRAMES + (2 * k + (1 if in_base else 0)) * _COUNT,
        )


def _write_in_frame(
    stage: FrameStage,
    hand: HandFrames,
    link: int,
    values: memoryview[float],
    position: int,
    normal: int,
    covariance: int,
    written: memoryview[float],
    row: int,
) -> None:
    """Write position, normal and covariance in the frame of `pose` to `written`, from index `row` on.

    They are at these indices of `values`, in the link's frame; `covariance` of the stage is that by joints.
    """
    pose = stage.pose
    _add_link_covariance(stage, hand, link, values, position, covariance)
    for i in range(3):
        a, b, c = pose[3 * i], pose[3 * i + 1], pose[3 * i + 2]
        turned = a * values[position] + b * values[position + 1] + c * values[position + 2]
        written[row + i] = turned + pose[9 + i]
        written[row + 3 + i] = a * values[normal] + b * values[normal + 1] + c * values[normal + 2]
    for i in range(9):
        written[row + 6 + i] = stage.covariance[i]


def _add_link_covariance(
    stage: FrameStage, hand: HandFrames, link: int, values: memoryview[float], position: int, first: int
) -> None:
    """Add the covariance of the contact on its link, and of the pad's mount, turned to the frame of `pose`.

    A rotation error of s about each axis through the pad's origin moves a point at r by s^2 (r.r 1 - r r').
    """
    pose, mount = stage.pose, 3 * link
    x, y, z = (
        values[position] - hand.mounts[mount],
        values[position + 1] - hand.mounts[mount + 1],
        values[position + 2] - hand.mounts[mount + 2],
    )
    turning = hand.mount_rotation_variance
    even = hand.mount_variance + turning * (x * x + y * y + z * z)
    for i in range(3):
        a, b, c = pose[3 * i], pose[3 * i + 1], pose[3 * i + 2]
        arm = turning * (a * x + b * y + c * z)
        by_x = a * values[first] + b * values[first + 3] + c * values[first + 6] + even * a - arm * x
        by_y = a * values[first + 1] + b * values[first + 4] + c * values[first + 7] + even * b - arm * y
        by_z = a * values[first + 2] + b * values[first + 5] + c * values[first + 8] + even * c - arm * z
        for j in range(3):
            at = 3 * j
            stage.covariance[3 * i + j] += by_x * pose[at] + by_y * pose[at + 1] + by_z * pose[at + 2]
