"""Contacts in the palm and base frames, from the joint states at their sample times; where requested.

Public name: `ContactTransforms`. Free of I/O and clocks; joint states come from `joints_at`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from handtouch.core.state import TickState
from handtouch.hand.groups import ContactGroups
from handtouch.hand.joints import JointSnapshot
from handtouch.hand.kinematics import HandKinematics
from handtouch.wire import FrameStatus

if TYPE_CHECKING:
    from handtouch.core.contacts import BoolArray, IntArray
    from handtouch.core.tick import PadColumns, TickResult
    from handtouch.hand.kinematics import LinkPose
    from handtouch.hand.robot_models import RobotModels

FloatArray = NDArray[np.float64]
_PALM, _BASE, _AGE = slice(0, 15), slice(15, 30), 30
_PUBLISHED_SLICES = {"position_m": slice(0, 3), "normal": slice(3, 6), "covariance_m2": slice(6, 15)}
_NOT_COMPUTED, _VALID, _STALE, _INVALID = map(int, FrameStatus)


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
        held = TickState.empty(n) if state is None else state
        self.joints_at: Callable[[str, int], JointSnapshot | None] = _no_joints
        self.used_joints: list[tuple[str, int, FloatArray, FloatArray, FloatArray]] = []
        self.any_requested = False
        """any pad is requested in palm or base"""
        self.palm_status, self.base_status = held.palm_status, held.base_status
        """FrameStatus"""
        self._rotation = held.palm_rotation  # of the link in the palm
        self._joint_variance_m2 = held.joint_variance_m2  # of the palm position, mean over the axes
        self._values = held.palm_values  # position, normal, covariance in palm; in base; age
        self._palm_requested, self._base_requested = held.palm_requested, held.base_requested
        self._requested = np.zeros(n, dtype=np.bool_)
        self._robots = robots
        within_m = np.zeros(n)
        for rows, group_m in zip(robots.pad_rows, robots.group_distance_m, strict=True) if robots else ():
            within_m[rows] = group_m
        number = {hand: k for k, hand in enumerate(dict.fromkeys(hands))}
        self._groups = ContactGroups(
            within_m,
            np.array([number[hand] for hand in hands]),
            held.group_id,
            held.grouped_contact_id,
            held.grouped,
        )

    @property
    def group(self) -> NDArray[np.uint32]:
        """Ids of contact groups (n,), 0 without contact or where not requested."""
        return self._groups.group_id

    def set_requested(self, palm: BoolArray, base: BoolArray) -> None:
        """Restrict palm and base outputs to these pads (n,); copied."""
        changed = np.flatnonzero((palm != self._palm_requested) | (base != self._base_requested))
        self._palm_requested[:], self._base_requested[:] = palm, base
        self.discard(changed)
        self.refresh()

    def refresh(self) -> None:
        """Compute what follows from the state, after that was loaded."""
        np.logical_or(self._palm_requested, self._base_requested, out=self._requested)
        self.any_requested = bool(self._requested.any())
        if not self.any_requested:
            self.used_joints.clear()

    def transform_updated(
        self, result: TickResult, columns: PadColumns, contact_id: NDArray[np.uint32]
    ) -> None:
        """Transform the contacts that a tick updated; `contact_id` (n,)."""
        self.used_joints.clear()
        rows = np.concatenate([result.began, result.updated])
        self._transform_pads(rows[self._requested.take(rows)], columns)
        self._groups.update_groups(
            np.where(self._requested, contact_id, 0), self._values[:, :3], self._values[:, 3:6]
        )

    def discard(self, rows: IntArray) -> None:
        """Discard the values of pads whose contact ended or is no longer requested."""
        if len(rows):
            self.palm_status[rows] = self.base_status[rows] = _NOT_COMPUTED
            self._values[rows] = np.nan

    def in_palm(self, rows: IntArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return position, normal and covariance (k, 15) of contacts in the palm, rotations (k, 3, 3) of
        their links in it, and ages (k,) of joints; NaN where not valid. Also the variance (k,) [m^2] of the
        position from the joints' standard deviations, mean over the axes; 0 where there are none."""
        values = self._values[rows]
        return values[:, _PALM], self._rotation[rows], values[:, _AGE], self._joint_variance_m2[rows]

    def poses_from_joints(
        self, rows: IntArray, t_ns: int, joints_at: Callable[[str, int], JointSnapshot | None]
    ) -> FloatArray:
        """Return rotations and translations (k, 3, 4) of links in the palm with joints from another source;
        NaN where those don't suffice."""
        poses = np.full((len(rows), 3, 4), np.nan)
        robots = self._robots
        for number, hand_rows in enumerate(robots.pad_rows if robots else ()):
            mine = np.flatnonzero((rows >= hand_rows[0]) & (rows <= hand_rows[-1]))
            joints = joints_at(robots.hands[number], t_ns) if robots and len(mine) else None
            if robots is None or joints is None:
                continue
            kinematics, links = robots.kinematics[number], rows[mine] - hand_rows[0]
            kinematics.set_joint_positions(joints.position_rad)
            for row, link in zip(mine.tolist(), links.tolist(), strict=True):
                if np.isfinite(joints.position_rad[kinematics.palm_joint_mask[link]]).all():
                    pose = kinematics.pose_in_palm(link)
                    poses[row, :, :3], poses[row, :, 3] = pose.rotation, pose.translation_m
        return poses

    def hand_columns(self, rows: slice) -> dict[str, bytes]:
        """Return columns of a hand frame; empty where not requested."""
        if not self._requested[rows].any():
            return {}
        values = self._values[rows].astype("<f4")
        columns = {
            "group": self.group[rows].astype("<u4").tobytes(),
            "joints_age_s": values[:, _AGE].tobytes(),
        }
        for frame, status, at, requested in (
            ("palm", self.palm_status, _PALM, self._palm_requested),
            ("base", self.base_status, _BASE, self._base_requested),
        ):
            if not requested[rows].any():
                continue
            columns[f"{frame}_status"] = status[rows].tobytes()
            part = np.where((status[rows] == _VALID)[:, None], values[:, at], np.float32(np.nan))
            columns |= {
                f"{frame}_{name}": part[:, span].tobytes() for name, span in _PUBLISHED_SLICES.items()
            }
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

    # Details ----------------------------------------------------------------------------------------------

    def _transform_pads(self, rows: IntArray, columns: PadColumns) -> None:
        if not len(rows):
            return
        self.palm_status[rows] = self.base_status[rows] = _INVALID
        self._values[rows] = np.nan
        robots = self._robots
        if robots is not None:
            for number, of_hand in enumerate(robots.pad_rows):
                single = len(of_hand) == len(self.palm_status)
                mine = rows if single else rows[(rows >= of_hand[0]) & (rows <= of_hand[-1])]
                times = columns.sample_ns.take(mine).tolist()
                for sample_ns in sorted(set(times)):  # one, unless pads are event-driven
                    now = mine if times.count(sample_ns) == len(times) else mine[np.equal(times, sample_ns)]
                    self._transform_hand(number, now, sample_ns, columns)
        for status, requested in (
            (self.palm_status, self._palm_requested),
            (self.base_status, self._base_requested),
        ):
            kept = requested.take(rows)
            if np.count_nonzero(kept) < len(rows):
                status[rows[~kept]] = _NOT_COMPUTED

    def _transform_hand(self, number: int, rows: IntArray, sample_ns: int, columns: PadColumns) -> None:
        """Transform contacts of one hand, sampled at one time."""
        assert self._robots is not None
        kinematics, hand = self._robots.kinematics[number], self._robots.hands[number]
        links = rows - self._robots.pad_rows[number][0]
        joints = self.joints_at(hand, sample_ns)
        if joints is None:
            joints = JointSnapshot.unknown(sample_ns, len(kinematics.joints))
        self.used_joints.append((hand, sample_ns, joints.position_rad, joints.age_s, joints.std_rad))
        kinematics.set_joint_positions(joints.position_rad)
        covariance_m2, mounts = columns.covariance_m2[rows], self._robots.mounts[number]
        if mounts is not None:
            covariance_m2 = covariance_m2 + mounts.position_covariance_m2(links, columns.position_m[rows])
        on_link = columns.position_m[rows], columns.normal[rows], covariance_m2
        joint_std = np.where(joints.std_rad > 0, joints.std_rad, self._robots.joint_std[number])
        ages = []
        base_requested = np.count_nonzero(self._base_requested[rows]) > 0
        for at, status, mask, pose in (
            (_PALM, self.palm_status, kinematics.palm_joint_mask, kinematics.pose_in_palm),
            (_BASE, self.base_status, kinematics.base_joint_mask, kinematics.pose_in_base),
        )[: 1 + base_requested]:
            age_s = np.where(mask[links], joints.age_s, 0.0).max(axis=1, initial=0.0)
            rotation, placed = _transform_contacts([pose(link) for link in links.tolist()], *on_link)
            if at == _PALM:
                self._rotation[rows], self._joint_variance_m2[rows] = rotation, 0.0
            if np.count_nonzero(joint_std):
                of_joints = _joint_covariance(kinematics, links, joint_std, on_link[0], at == _BASE)
                placed[:, _PUBLISHED_SLICES["covariance_m2"]] += of_joints
                if at == _PALM:
                    self._joint_variance_m2[rows] = of_joints[:, ::4].mean(axis=1)
            stale = age_s > self._robots.joints_stale_s[number]
            unknown = ~np.isfinite(placed[:, 0]) | ~np.isfinite(age_s)
            status[rows] = np.where(unknown, _INVALID, np.where(stale, _STALE, _VALID))
            placed[unknown | stale] = np.nan
            self._values[rows, at] = placed
            ages.append(age_s)
        oldest_s = np.stack(ages).max(axis=0)
        self._values[rows, _AGE] = np.where(np.isfinite(oldest_s), oldest_s, np.nan)


def _transform_contacts(
    poses: list[LinkPose], position_m: FloatArray, normal: FloatArray, covariance_m2: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return rotations (k, 3, 3) of links in another frame, and (k, 15) positions, normals, covariances
    there."""
    rotation = np.array([pose.rotation for pose in poses])
    turned = rotation.transpose(0, 2, 1)
    vectors = np.stack([position_m, normal], axis=1) @ turned  # rows times the transposed rotation
    vectors[:, 0] += np.array([pose.translation_m for pose in poses])
    covariance = rotation @ covariance_m2 @ turned
    return rotation, np.concatenate([vectors.reshape(-1, 6), covariance.reshape(-1, 9)], axis=1)


def _joint_covariance(
    kinematics: HandKinematics, links: IntArray, std_rad: FloatArray, position_m: FloatArray, in_base: bool
) -> FloatArray:
    """Return the covariance (k, 9) of contact positions from the joints' standard deviations."""
    jacobians = np.array(
        [
            kinematics.point_jacobian(link, position, in_base)
            for link, position in zip(links.tolist(), position_m, strict=True)
        ]
    )
    scaled = jacobians * std_rad
    return np.asarray((scaled @ scaled.transpose(0, 2, 1)).reshape(-1, 9))
