"""Contacts in the frames of palm and base, with the joints as they were at each sample; where a scene asks.

Public names: `Frames`. Pure but for what it keeps; joint states come through `joints_at`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from handtouch.hand.groups import Groups
from handtouch.hand.joints import Joints
from handtouch.hand.kinematics import Kinematics
from handtouch.wire import Placing

if TYPE_CHECKING:
    from handtouch.daemon.contacts import BoolArray, IntArray
    from handtouch.daemon.tick import Columns, Ticked
    from handtouch.hand.kinematics import Pose
    from handtouch.hand.robot import Robots

FloatArray = NDArray[np.float64]
_PALM, _BASE, _AGE, _VALUES = slice(0, 15), slice(15, 30), 30, 31
_TOLD = {"position_m": slice(0, 3), "normal": slice(3, 6), "covariance_m2": slice(6, 15)}
_SKIPPED, _VALID, _STALE, _INVALID = map(int, Placing)
_NAMES = tuple(placing.name.lower() for placing in Placing)


def _nobody(hand: str, t_ns: int) -> Joints | None:  # noqa: ARG001
    return None


class Frames:
    """What is known of contacts on n pads in palm and base; a row keeps its values until its contact ended.

    `joints_at`: a hand's joints at a time, None where nothing was told; the daemon sets it. `used`: hand,
    time, positions, ages and deviations of the joints that the last step used, for recorders.
    """

    def __init__(self, hands: list[str], robots: Robots | None = None) -> None:
        n = len(hands)
        self.joints_at: Callable[[str, int], Joints | None] = _nobody
        self.used: list[tuple[str, int, FloatArray, FloatArray, FloatArray]] = []
        self.wanted = False
        """whether any pad is"""
        self.palm = np.zeros(n, dtype=np.uint8)
        """Placing"""
        self.base = np.zeros(n, dtype=np.uint8)
        self._rotation = np.full((n, 3, 3), np.nan)  # of the link in the palm
        self._joints_m2 = np.zeros(n)  # what joints add to the covariance in the palm, one way in the mean
        self._values = np.full((n, _VALUES), np.nan)  # position, normal, covariance in palm; in base; age
        self._wants_palm, self._wants_base, self._wants = (np.zeros(n, dtype=np.bool_) for _ in range(3))
        self._robots = robots
        within_m = np.zeros(n)
        for rows, group_m in zip(robots.rows, robots.group_m, strict=True) if robots else ():
            within_m[rows] = group_m
        number = {hand: k for k, hand in enumerate(dict.fromkeys(hands))}
        self._groups = Groups(within_m, np.array([number[hand] for hand in hands]))

    @property
    def group(self) -> NDArray[np.uint32]:
        """(n,) ids of groups, 0 without contact or where no scene asks."""
        return self._groups.id

    def want(self, palm: BoolArray, base: BoolArray) -> None:
        """Tell only of these pads (n,) in palm and in base; copied."""
        changed = np.flatnonzero((palm != self._wants_palm) | (base != self._wants_base))
        self._wants_palm[:], self._wants_base[:] = palm, base
        np.logical_or(palm, base, out=self._wants)
        self.wanted = bool(self._wants.any())
        self.forget(changed)
        if not self.wanted:
            self.used.clear()

    def step(self, ticked: Ticked, columns: Columns, contact: NDArray[np.uint32]) -> None:
        """Place the contacts that a tick touched; `contact` (n,) ids."""
        if not self.wanted:
            return
        self.used.clear()
        rows = np.concatenate([ticked.began, ticked.updated])
        self._place_all(rows[self._wants.take(rows)], columns)
        self._groups.step(np.where(self._wants, contact, 0), self._values[:, :3], self._values[:, 3:6])

    def place(self, rows: IntArray, columns: Columns, contact: NDArray[np.uint32]) -> None:
        """Place the contacts on these pads as they are now."""
        self._place_all(rows, columns)
        self._groups.step(np.where(self._wants, contact, 0), self._values[:, :3], self._values[:, 3:6])

    def forget(self, rows: IntArray) -> None:
        """Contacts on these pads ended, or nobody asks for them any more."""
        if len(rows):
            self.palm[rows] = self.base[rows] = _SKIPPED
            self._values[rows] = np.nan

    def rehearse(self) -> None:
        """Go the way of the next step, to have it in the caches; changes nothing."""
        if self.used and self._robots:
            hand, t_ns, position, *_ = self.used[-1]
            self.joints_at(hand, t_ns)
            kinematics = self._robots.kinematics[self._robots.hands.index(hand)]
            kinematics.move(position)
            kinematics.in_palm(0)

    def in_palm(self, rows: IntArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Place, normal and covariance (k, 15) of contacts in the palm, rotations (k, 3, 3) of their links
        in it, ages (k,) of joints; NaN where they aren't valid. And the variance (k,) [m^2], one way in the
        mean, that the joints' deviations put into the place; 0 where none are told or stated."""
        values = self._values[rows]
        return values[:, _PALM], self._rotation[rows], values[:, _AGE], self._joints_m2[rows]

    def told_poses(
        self, rows: IntArray, t_ns: int, joints_at: Callable[[str, int], Joints | None]
    ) -> FloatArray:
        """Rotations and translations (k, 3, 4) of links in the palm, joints being as somebody else tells; NaN
        where that isn't enough."""
        poses = np.full((len(rows), 3, 4), np.nan)
        robots = self._robots
        for number, of in enumerate(robots.rows if robots else ()):
            mine = np.flatnonzero((rows >= of[0]) & (rows <= of[-1]))
            joints = joints_at(robots.hands[number], t_ns) if robots and len(mine) else None
            if robots is None or joints is None:
                continue
            kinematics, links = robots.kinematics[number], rows[mine] - of[0]
            kinematics.move(joints.position_rad)
            for row, link in zip(mine.tolist(), links.tolist(), strict=True):
                if np.isfinite(joints.position_rad[kinematics.palm_needs[link]]).all():
                    pose = kinematics.in_palm(link)
                    poses[row, :, :3], poses[row, :, 3] = pose.rotation, pose.translation_m
        return poses

    def tell(self, pad: int) -> dict[str, Any]:
        """Fields of a contact message, none where no scene asks."""
        if not self._wants[pad]:
            return {}
        values, age_s = self._values[pad].tolist(), float(self._values[pad, _AGE])
        told: dict[str, Any] = {
            "group": int(self.group[pad]),
            "palm": _NAMES[self.palm[pad]],
            "base": _NAMES[self.base[pad]],
            "joints_age_s": age_s if age_s == age_s else None,
        }
        for frame, state, at in (("palm", self.palm, 0), ("base", self.base, 15)):
            if state[pad] == _VALID:
                part = values[at : at + 15]
                told |= {f"{frame}_{name}": tuple(part[where]) for name, where in _TOLD.items()}
                if not math.isfinite(sum(part)):  # at a corner nothing may bound the covariance
                    told[f"{frame}_covariance_m2"] = None
        return told

    def columns(self, rows: slice) -> dict[str, bytes]:
        """Columns of a hand frame, none where no scene asks."""
        if not self.wanted or not self._wants[rows].any():
            return {}
        values = self._values[rows].astype("<f4")
        told = {
            "group": self.group[rows].astype("<u4").tobytes(),
            "joints_age_s": values[:, _AGE].tobytes(),
        }
        asked = (("palm", self.palm, _PALM, self._wants_palm), ("base", self.base, _BASE, self._wants_base))
        for frame, state, at, wants in asked:
            if not wants[rows].any():
                continue
            told[frame] = state[rows].tobytes()
            part = np.where((state[rows] == _VALID)[:, None], values[:, at], np.float32(np.nan))
            told |= {f"{frame}_{name}": part[:, where].tobytes() for name, where in _TOLD.items()}
        return told

    def journal(self) -> list[list[Any]]:
        """`used`, as msgpack takes it: hand, time, and float64 columns of positions, ages, deviations."""
        return [[hand, t_ns, *(column.tobytes() for column in told)] for hand, t_ns, *told in self.used]

    def recall(self, told: Sequence[Sequence[Any]]) -> None:
        """Take the joints of the next step from a `journal`, instead of from who told them."""
        known = {
            (hand, t_ns): Joints(t_ns, *(np.frombuffer(column, np.float64) for column in columns))
            for hand, t_ns, *columns in told
        }
        self.joints_at = lambda hand, t_ns: known.get((hand, t_ns))

    # Details ----------------------------------------------------------------------------------------------

    def _place_all(self, rows: IntArray, columns: Columns) -> None:
        if not len(rows):
            return
        self.palm[rows] = self.base[rows] = _INVALID
        self._values[rows] = np.nan
        robots = self._robots
        if robots is not None:
            for number, of in enumerate(robots.rows):
                mine = rows if len(of) == len(self.palm) else rows[(rows >= of[0]) & (rows <= of[-1])]
                times = columns.sample_ns.take(mine).tolist()
                for t_ns in sorted(set(times)):  # one, but for pads that sample when something moves
                    now = mine if times.count(t_ns) == len(times) else mine[np.equal(times, t_ns)]
                    self._place(number, now, t_ns, columns)
        for state, wants in ((self.palm, self._wants_palm), (self.base, self._wants_base)):
            wanted = wants.take(rows)
            if np.count_nonzero(wanted) < len(rows):
                state[rows[~wanted]] = _SKIPPED

    def _place(self, number: int, rows: IntArray, t_ns: int, columns: Columns) -> None:
        """Contacts of one hand, sampled at one time."""
        assert self._robots is not None
        kinematics, hand = self._robots.kinematics[number], self._robots.hands[number]
        links = rows - self._robots.rows[number][0]
        joints = self.joints_at(hand, t_ns)
        if joints is None:
            joints = Joints.unknown(t_ns, len(kinematics.joints))
        self.used.append((hand, t_ns, joints.position_rad, joints.age_s, joints.std_rad))
        kinematics.move(joints.position_rad)
        covariance_m2, mounts = columns.covariance_m2[rows], self._robots.mounts[number]
        if mounts is not None:
            covariance_m2 = covariance_m2 + mounts.covariance(links, columns.position_m[rows])
        on_link = columns.position_m[rows], columns.normal[rows], covariance_m2
        joint_std = np.where(joints.std_rad > 0, joints.std_rad, self._robots.joint_std[number])
        ages = []
        wants_base = np.count_nonzero(self._wants_base[rows]) > 0
        for at, state, needs, pose in (
            (_PALM, self.palm, kinematics.palm_needs, kinematics.in_palm),
            (_BASE, self.base, kinematics.base_needs, kinematics.in_base),
        )[: 1 + wants_base]:
            age_s = np.where(needs[links], joints.age_s, 0.0).max(axis=1, initial=0.0)
            rotation, placed = _carry([pose(link) for link in links.tolist()], *on_link)
            if at == _PALM:
                self._rotation[rows], self._joints_m2[rows] = rotation, 0.0
            if np.count_nonzero(joint_std):
                of_joints = _of_joints(kinematics, links, joint_std, on_link[0], at == _BASE)
                placed[:, _TOLD["covariance_m2"]] += of_joints
                if at == _PALM:
                    self._joints_m2[rows] = of_joints[:, ::4].mean(axis=1)
            stale = age_s > self._robots.stale_s[number]
            lost = ~np.isfinite(placed[:, 0]) | ~np.isfinite(age_s)
            state[rows] = np.where(lost, _INVALID, np.where(stale, _STALE, _VALID))
            placed[lost | stale] = np.nan
            self._values[rows, at] = placed
            ages.append(age_s)
        told = np.stack(ages).max(axis=0)
        self._values[rows, _AGE] = np.where(np.isfinite(told), told, np.nan)


def _carry(
    poses: list[Pose], position_m: FloatArray, normal: FloatArray, covariance_m2: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Rotations (k, 3, 3) of links in another frame, and (k, 15) places, normals and covariances there."""
    rotation = np.array([pose.rotation for pose in poses])
    turned = rotation.transpose(0, 2, 1)
    vectors = np.stack([position_m, normal], axis=1) @ turned  # rows times the transposed rotation
    vectors[:, 0] += np.array([pose.translation_m for pose in poses])
    covariance = rotation @ covariance_m2 @ turned
    return rotation, np.concatenate([vectors.reshape(-1, 6), covariance.reshape(-1, 9)], axis=1)


def _of_joints(
    kinematics: Kinematics, links: IntArray, std_rad: FloatArray, position_m: FloatArray, in_base: bool
) -> FloatArray:
    """What uncertain joints add to covariances, (k, 9)."""
    slopes = np.array(
        [
            kinematics.slope(link, place, in_base)
            for link, place in zip(links.tolist(), position_m, strict=True)
        ]
    )
    slopes = slopes * std_rad
    return np.asarray((slopes @ slopes.transpose(0, 2, 1)).reshape(-1, 9))
