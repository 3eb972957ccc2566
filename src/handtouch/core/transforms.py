"""Contacts in the palm and base frames, from the joint states at their sample times; where requested.

Public name: `ContactTransforms`. Free of I/O and clocks; joint states come from `joints_at`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from handtouch.core.groups import ContactGroups
from handtouch.core.memory import view_memory
from handtouch.core.stages.frames import FRAME_SLICES, FRAME_VALUES, FrameStage, HandFrames
from handtouch.core.stages.kinematics import LinkPoses
from handtouch.core.state import TickState
from handtouch.hand.joints import JointSnapshot

if TYPE_CHECKING:
    from handtouch.core.contacts import BoolArray, IntArray
    from handtouch.core.tick import TickResult
    from handtouch.hand.robot_models import RobotModels

FloatArray = NDArray[np.float64]
_PALM, _AGE = slice(0, FRAME_VALUES), 2 * FRAME_VALUES


def _no_joints(hand: str, t_ns: int) -> JointSnapshot | None:  # noqa: ARG001
    return None


class ContactTransforms:
    """Contacts on n pads in palm and base; a row keeps its values until its contact ends.

    `joints_at`: a hand's joints at a time, None if unknown; set by the daemon. `used_joints`: hand, time,
    positions, ages and standard deviations of the joints used by the last tick, for recorders.
    """

    def __init__(
        self, hands: list[str], robots: RobotModels | None = None, state: TickState | None = None
    ) -> None:
        n = len(hands)
        self._held = held = TickState.empty(n) if state is None else state
        self.joints_at: Callable[[str, int], JointSnapshot | None] = _no_joints
        self.used_joints: list[tuple[str, int, FloatArray, FloatArray, FloatArray]] = []
        self.any_requested = False
        """any pad is requested in palm or base"""
        self._requested = np.zeros(n, dtype=np.bool_)
        self._robots = robots
        self._poses = [LinkPoses(kinematics) for kinematics in robots.kinematics] if robots else []
        self._stage_of_hand = [
            (robots.hands[number], robots.joint_errors[number], _hand_frames(robots, number, poses))
            for number, poses in enumerate(self._poses)
            if robots
        ]
        within_m = np.zeros(n)
        for rows, group_m in zip(robots.pad_rows, robots.group_distance_m, strict=True) if robots else ():
            within_m[rows] = group_m
        number_of_hand = {hand: k for k, hand in enumerate(dict.fromkeys(hands))}
        self._groups = ContactGroups(within_m, np.array([number_of_hand[hand] for hand in hands]), held)
        published = np.full((2 * FRAME_VALUES + 1) * n, np.nan, np.float32)
        self._published_age_s = published[_AGE * n :]
        self._published = {
            (frame, name): published[(first + at.start) * n : (first + at.stop) * n].reshape(n, -1)
            for frame, first in (("palm", 0), ("base", FRAME_VALUES))
            for name, at in FRAME_SLICES.items()
        }
        self._stage = FrameStage(
            *(held.memory, view_memory(published), view_memory(np.zeros(n, np.uint8))),
            *(view_memory(np.zeros(12)), view_memory(np.zeros(9))),
        )

    @property
    def group(self) -> NDArray[np.uint32]:
        """Ids of contact groups (n,), 0 without contact or where not requested."""
        return self._groups.group_id

    def set_requested(self, palm: BoolArray, base: BoolArray) -> None:
        """Restrict palm and base outputs to these pads (n,); copied."""
        held = self._held
        changed = np.flatnonzero((palm != held.palm_requested) | (base != held.base_requested))
        held.palm_requested[:], held.base_requested[:] = palm, base
        self.discard(changed)
        self.refresh()

    def refresh(self) -> None:
        """Compute what follows from the state, after that was loaded."""
        np.logical_or(self._held.palm_requested, self._held.base_requested, out=self._requested)
        self.any_requested = bool(self._requested.any())
        if not self.any_requested:
            self.used_joints.clear()
        self._stage.publish()

    def transform_updated(self, result: TickResult) -> None:
        """Transform the contacts that a tick updated."""
        self.used_joints.clear()
        stage = self._stage
        updated = np.concatenate([result.updated, result.framed]) if len(result.framed) else result.updated
        stage.begin_contacts(result.began.data, updated.data)
        for hand, errors, frames in self._stage_of_hand:
            while sample_ns := stage.next_sample_ns(frames):  # one, unless pads are event-driven
                joints = self.joints_at(hand, sample_ns) or JointSnapshot.unknown(
                    sample_ns, len(errors.unstated)
                )
                positions, ages_s, stated = joints.position_rad, joints.age_s, joints.std_rad
                self.used_joints.append((hand, sample_ns, positions, ages_s, stated))
                used = map(view_memory, (positions, ages_s, errors.of(stated)))
                stage.transform_contacts(frames, sample_ns, *used)
        self._groups.update_groups()

    def discard(self, rows: IntArray) -> None:
        """Discard the values of pads whose contact ended or is no longer requested."""
        self._stage.discard(rows.data)

    def in_palm(self, rows: IntArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return position, normal and covariance (k, 15) of contacts in the palm, rotations (k, 3, 3) of
        their links in it, and ages (k,) of joints; NaN where not valid. Also the variance (k,) [m^2] of the
        position from the joints' standard deviations, mean over the axes; 0 where there are none."""
        held = self._held
        values = held.palm_values[rows]
        return values[:, _PALM], held.palm_rotation[rows], values[:, _AGE], held.joint_variance_m2[rows]

    def hand_columns(self, rows: slice) -> dict[str, bytes]:
        """Return columns of a hand frame; empty where not requested."""
        if not np.count_nonzero(self._requested[rows]):
            return {}
        held = self._held
        columns = {
            "group": held.group_id[rows].tobytes(),
            "joints_age_s": self._published_age_s[rows].tobytes(),
        }
        for frame, status, requested in (
            ("palm", held.palm_status, held.palm_requested),
            ("base", held.base_status, held.base_requested),
        ):
            if np.count_nonzero(requested[rows]):
                columns[f"{frame}_status"] = status[rows].tobytes()
                for name in FRAME_SLICES:
                    columns[f"{frame}_{name}"] = self._published[frame, name][rows].tobytes()
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


def _hand_frames(robots: RobotModels, number: int, poses: LinkPoses) -> HandFrames:
    kinematics, rows, mounts = robots.kinematics[number], robots.pad_rows[number], robots.mounts[number]
    masks = np.stack([kinematics.palm_joint_mask, kinematics.base_joint_mask])
    return HandFrames(
        *(poses, int(rows[0]), int(rows[-1]) + 1, view_memory(masks)),
        *(view_memory(np.zeros(poses.joints)), view_memory(mounts.origin_m)),
        *(mounts.position_variance_m2, mounts.rotation_variance_rad2, robots.joints_stale_s[number]),
    )
