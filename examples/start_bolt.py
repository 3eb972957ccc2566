"""Find a bolt on a table, pick it up, and start its free end in a hole, by touch alone.

A state machine. It knows the bolt's shape, that it lies within 40 x 40 mm of the table, where the hole is,
and the hand's URDF; it gets reported joint positions and the columns of touch that a `Hand` and a
`TactileReading` share. There is no camera. SEARCH lowers flat fingers from several sides: each contact is a
point of the bolt's surface, with the normal of the pad there, and where the fingers are, it isn't; it asks
for the touch of the most expected information. GRASP closes thumb, index and middle finger around the shank
with stated forces. LIFT notices when it failed, or when the bolt slips, and puts it down. FEEL fits the
bolt's pose to the contacts of the fingers, weighted by their covariances. ORIENT points the free end to the
hole. INSERT pushes, follows a spiral over the rim while the fingers yield, and pushes on when the tip falls
in.

Needs the extra `gym`. Public names: `BoltStarter`, `Step`.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import signal
import sys
from collections.abc import Callable
from enum import Enum

import numpy as np
import pinocchio as pin
from bolt_pose import UP, Contact, KnownBolt, OnTable, compose, inverse, relative
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, Slerp

from handtouch.percept.action_request import CandidateAction, Question, expected_information_bits
from handtouch.simulate.tactile.bolt_scene import BOLTS, HOLE_M, BoltStart
from handtouch.simulate.tactile.bolt_workcell import BoltWorkcell, Pose

FloatArray = NDArray[np.float64]

# The grip, in the palm: origin, and axes from the thumb to the fingers, along the bolt, and of the approach.
GRIP_M = np.array([0.130, -0.023, 0.086])
_ACROSS, _APPROACH = np.array([0.463, 0.875, 0.144]), np.array([-0.300, 0.002, 0.954])
TIP_M = {"thumb": 0.017, "index": 0.015, "middle": 0.016, "ring": 0.015}
"""Centre of the round tip, along the last link"""
RADIUS_M = {"thumb": 11.5e-3, "index": 10e-3, "middle": 10e-3}
ALONG_M = {"thumb": 9e-3, "index": 0.0, "middle": 20.5e-3}
ABOVE_M = {"thumb": 5e-3, "index": 4e-3, "middle": 4e-3}
"""Where the fingertips' centres are in the grip, along the bolt and against the approach"""
HEAD_ALONG_M = 18.3e-3
"""Where the bolt's head begins: the thumb beside it, the tip beyond the index finger"""
POSTURE_RAD = {
    "thumb": [-0.479, 1.15, 0.02, 0.02],
    "index": [0.34, 0.828, 0.568, 0.528],
    "middle": [0.008, 0.68, 1.396, 0.01],
    "ring": [-0.2, -0.1, 0.3, 0.2],
}
FLAT_RAD = {"thumb": [0.78, -0.2, 0.05, 0.12], "index": [0.0, -0.1, 0.0, 0.0]}
"""Straight fingers, and the thumb away from the table"""
PAD_RADIUS_M = 10e-3
STIFFNESS_NM_RAD = 3.0
"""Of the joints' position controllers"""

# Feeling with flat fingers
FLAT_M = np.array([0.175, 0.0, 0.004])
"""A point of their surface, in the palm"""
PITCH_RAD = np.radians(20.0)
"""Of the palm: the fingertips are lowest, and fingers slope more than the bolt does to its tip."""
_PARTS = ("proximal", "middle", "distal")
FLAT_LINKS = tuple(f"{finger}_{part}" for finger in ("index", "middle", "ring") for part in _PARTS)
FLAT_SPHERES = {
    "proximal": [(0.01, 0.011), (0.022, 0.011), (0.034, 0.011), (0.046, 0.0105)],
    "middle": [(0.008, 0.0105), (0.018, 0.01), (0.028, 0.0095)],
    "distal": [(0.0, 0.0095), (0.008, 0.0095), (0.0155, 0.01)],
}
"""Spheres in the links of a finger: distance along x and radius [m]"""
_ON_TABLE_M = 6e-3
_BEGIN_M, _END_M = 0.028, 0.005
"""Heights between which flat fingers are lowered until they touch"""
_ALONG_M, _TURNS_RAD = (-0.012, 0.0, 0.012), np.radians([0, 50, 90, 130, 180, -130, -90, -50])
"""Touches to choose from, by places along a possible bolt and directions of the fingers to it"""
_TOUCH_STD_M = 2e-3
"""Of the height of a touch as it is predicted: by fingers, pads and what their model leaves out"""
MIN_WEIGHT, MAX_STD_RAD, MAX_PRESSES = 0.95, np.radians(3.0), 10

FORCE_N, MIN_FORCE_N = {"thumb": 4.0, "index": 2.4, "middle": 1.6}, 0.4
_PUSHED_M, _JAMMED_M = 0.5e-3, 1.5e-3
"""Mean displacement of the fingertips by the rim, while the tip searches and at most: 0.5 N and 1.5 N"""
_FREE_M = -0.03
"""Place of the tip before the hole from which on nothing can push the fingertips but the bolt in the grip"""
_SPIRAL_PITCH_M, _SPIRAL_M = 0.5e-3, 4e-3
INSERT_M, ENOUGH_M = 13e-3, 9e-3
"""Depth to reach unless the fingers meet the plate, and from which on they may: by the estimate of the bolt
along the hand, which may be wrong by some millimetres"""


class Step(Enum):
    SEARCH = "search"
    GRASP = "grasp"
    LIFT = "lift"
    FEEL = "feel"
    ORIENT = "orient"
    INSERT = "insert"
    DONE = "done"
    FAILED = "failed"


class Arm:
    """Kinematics of the hand: where its links are, and joint positions that put fingertips somewhere."""

    def __init__(self, urdf: str, joints: tuple[str, ...]) -> None:
        self._model = pin.buildModelFromUrdf(urdf)
        self._data = self._model.createData()
        names = list(self._model.names)[1:]
        self._order = [names.index(name) for name in joints]  # pinocchio's own order is alphabetical
        self._own = {finger: [k for k, n in enumerate(names) if n.startswith(finger)] for finger in TIP_M}
        pin.framesForwardKinematics(self._model, self._data, pin.neutral(self._model))
        self.palm = self.link("base", "palm")
        grip = np.column_stack(_orthonormal(_ACROSS, _APPROACH))
        self.grip = compose(self.palm, (GRIP_M, grip))

    def link(self, of: str, name: str) -> Pose:
        """Return the pose of a link in that of another, at the joint positions set last."""
        frames = [self._data.oMf[self._model.getFrameId(each)] for each in (of, name)]
        relative = frames[0].inverse() * frames[1]
        return relative.translation.copy(), relative.rotation.copy()

    def set(self, joint_rad: FloatArray) -> None:
        """Set joint positions, in the order of the robot."""
        q = np.empty(len(joint_rad))
        q[self._order] = joint_rad
        pin.framesForwardKinematics(self._model, self._data, q)

    def tip(self, finger: str) -> FloatArray:
        """Return the centre of a fingertip in the frame of the flange."""
        position, rotation = self.link("base", f"{finger}_distal")
        return position + TIP_M[finger] * rotation[:, 0]

    def posture(self, fingers: dict[str, list[float]]) -> FloatArray:
        """Return joint positions; fingers that aren't named are as the index finger."""
        q = np.empty(len(self._order))
        for finger, own in self._own.items():
            q[own] = fingers.get(finger, fingers["index"])
        return q[self._order]

    def reach(self, finger: str, target_m: FloatArray, joint_rad: FloatArray) -> FloatArray:
        """Return joint positions with a fingertip's centre at a target in the frame of the flange."""
        q, own = np.empty(len(joint_rad)), self._own[finger]
        q[self._order] = joint_rad
        low, high = self._model.lowerPositionLimit[own], self._model.upperPositionLimit[own]
        posture = np.clip(POSTURE_RAD[finger], low + 1e-3, high - 1e-3)

        def residual(angles: FloatArray) -> FloatArray:
            q[own] = angles
            pin.framesForwardKinematics(self._model, self._data, q)
            return np.concatenate([1e3 * (self.tip(finger) - target_m), 0.05 * (angles - posture)])

        q[own] = least_squares(residual, posture, bounds=(low, high)).x
        return q[self._order]

    def press(self, finger: str, force_n: FloatArray, joint_rad: FloatArray) -> FloatArray:
        """Return changes of commands (m,) with which a fingertip exerts a force, in the flange's frame."""
        own, q, shift = self._own[finger], np.empty(len(joint_rad)), np.zeros(len(joint_rad))
        q[self._order] = joint_rad
        frame = self._model.getFrameId(f"{finger}_distal")
        whole = pin.computeFrameJacobian(self._model, self._data, q, frame, pin.LOCAL_WORLD_ALIGNED)
        pin.framesForwardKinematics(self._model, self._data, q)
        arm = self.tip(finger) - self.link("base", f"{finger}_distal")[0]
        jacobian = (whole[:3] - pin.skew(arm) @ whole[3:])[:, own]
        shift[own] = jacobian.T @ force_n / STIFFNESS_NM_RAD
        return shift[self._order]


class BoltStarter:
    """The program: `run` it on a robot. `truth` gives the bolt's pose in the world, to show the ceiling."""

    def __init__(
        self,
        robot: BoltWorkcell,
        truth: Callable[[], Pose] | None = None,
        log: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._robot, self._truth, self._log = robot, truth, log
        self._arm = Arm(robot.urdf, robot.joints)
        self.bolt = KnownBolt(robot.scene.bolt)
        self._attempts = 0
        self._table: Pose = np.zeros(3), np.eye(3)  # the bolt on the table
        self._held: Pose = np.zeros(3), np.eye(3)  # the bolt in the grip
        self._grasped_at: Pose = np.zeros(3), np.eye(3)  # the grip
        self.steps: list[Step] = []
        self._command = self._arm.posture(FLAT_RAD)
        self._flange = self._flat_on(np.zeros(2), 0.15, 0.0)
        robot.start_at(self._flange, self._command)
        self._sensed = robot.move(self._flange, self._command)

    def run(self) -> bool:
        """Return whether the program holds the bolt to be in the hole."""
        step = Step.SEARCH
        while step not in (Step.DONE, Step.FAILED):
            self.steps.append(step)
            step = getattr(self, f"_{step.value}")()
        self.steps.append(step)
        return step is Step.DONE

    # States ---------------------------------------------------------------------------------------------

    def _search(self) -> Step:
        self._attempts += 1
        if self._attempts > 3:
            self._log("no attempt left")
            return Step.FAILED
        self._go(self._above(self._flange), self._arm.posture(FLAT_RAD), 0.6)
        if self._truth:
            self._table = self._truth()
            return Step.GRASP
        found: list[Contact] = []
        free: list[FloatArray] = []
        place, yaw, sure, std_rad = np.zeros(2), 0.0, 0.0, np.inf
        for number in range(MAX_PRESSES):
            contacts, spheres = self._press(place, yaw)
            found += contacts
            free.append(spheres)
            yaw = np.radians(120.0 * (number + 1))
            if len(found) > 2:
                poses = self.bolt.poses_on_table(found, np.concatenate(free))
                self._table = self.bolt.lying(poses[0].parameters)
                sure, std_rad = poses[0].weight, poses[0].direction_std_rad
                if sure > MIN_WEIGHT and std_rad < MAX_STD_RAD:
                    break
                place, yaw = self._most_telling(poses)
            elif found:
                place = found[-1].point_m[:2]
        if sure < MIN_WEIGHT:
            self._log(f"{len(found)} contacts leave it open where the bolt is: search again")
            return Step.SEARCH
        x, y, _ = 1e3 * self._table[0]
        toward, std_deg = np.degrees([np.arctan2(*self._table[1][1::-1, 2]), std_rad])
        told = f"bolt at {x:.1f}, {y:.1f} mm, toward {toward:.0f} degrees with std {std_deg:.1f}"
        self._log(f"{told}; weight of this pose {sure:.2f}")
        return Step.GRASP

    def _grasp(self) -> Step:
        position, rotation = self._table
        along = -np.array([*rotation[:2, 2], 0.0])
        along /= np.linalg.norm(along)
        axes = np.column_stack([np.cross(along, -UP), along, -UP])
        place = position + (self.bolt.half_m - self.bolt.head_m - HEAD_ALONG_M) * along
        place[2] = 2.5e-3 + self.bolt.shank_m
        opened = self._fingers(0.02, 0.008)
        self._go(self._gripping((place + 0.1 * UP, axes)), opened, 1.5)
        self._go(self._gripping((place, axes)), opened, 1.5)
        self._grasped_at = place, axes
        closed = self._fingers(0.0, 0.0)
        self._go(self._flange, closed, 0.8)
        self._go(self._flange, self._squeeze(closed), 0.5)
        return Step.LIFT

    def _lift(self) -> Step:
        if not self._carry(self._above(self._flange), 1.0):
            return self._put_down("it slips", self._grasped_at)
        forces = {finger: each.force_n for finger, each in self._fingertips().items()}
        self._log("lifted with " + ", ".join(f"{finger} {force:.1f} N" for finger, force in forces.items()))
        if not self._truth and not self._is_held():
            self._log("it isn't held: search again")
            return Step.SEARCH
        return Step.FEEL

    def _feel(self) -> Step:
        grip = self._grip_pose()
        if self._truth:
            self._held = relative(grip, self._truth())
            return Step.ORIENT
        contacts = [each.seen_from(grip) for each in self._fingertips().values()]
        found = self.bolt.pose_in_grip(relative(self._grasped_at, self._table), contacts)
        self._held = found.pose
        tilt = np.degrees(np.arcsin(np.clip(self._held[1][[0, 2], 2], -1, 1)))
        told = f"in the grip at {1e3 * self._held[0].round(4)} mm, tilted by {tilt.round(1)} degrees"
        self._log(f"{told}; weight of this end {found.weight:.2f}")
        return Step.ORIENT

    def _orient(self) -> Step:
        axes = np.column_stack([np.cross([0.0, -1.0, 0.0], -UP), [0.0, -1.0, 0.0], -UP])
        before_hole = self._gripping((HOLE_M - [0.0, 0.1, 0.0], axes))
        if not (self._carry(before_hole, 2.0) and self._carry(self._aimed(-0.012), 1.0)):
            return self._put_down("it slips")
        if not self._truth and not self._is_held():
            self._log("it was lost on the way: search again")
            return Step.SEARCH
        self._feel()
        self._go(self._aimed(-0.008), self._command, 0.5)
        return Step.INSERT

    def _insert(self) -> Step:
        rest = self._tips()
        aim = self._aimed(0.0)
        forward_m, angle, speed = -0.008, 0.0, self._robot.period_s * 8e-3
        radius = 0.0
        while forward_m < INSERT_M:
            pushed_m = float(np.mean(rest - self._tips(), axis=0)[1])
            if forward_m > ENOUGH_M and pushed_m > _PUSHED_M:
                break
            if pushed_m > _JAMMED_M:
                forward_m -= speed
                if forward_m < _FREE_M:
                    return self._put_down("the fingertips stay pushed, far from the hole")
            elif pushed_m > _PUSHED_M:
                radius = _SPIRAL_PITCH_M * angle / (2 * np.pi)
                angle += self._robot.period_s * 6e-3 / max(radius, 0.5e-3)
            else:
                forward_m += speed
            if radius > _SPIRAL_M:
                return self._put_down("the spiral found no hole")
            aside = radius * np.array([np.cos(angle), 0.0, np.sin(angle)])
            self._move((aim[0] + [0.0, forward_m, 0.0] + aside, aim[1]), self._command)
        if not self._truth and not self._is_held():
            return self._put_down("nothing is held")
        self._log(f"inserted, {1e3 * radius:.1f} mm aside of the estimate")
        return Step.DONE

    def _put_down(self, reason: str, grip: Pose | None = None) -> Step:
        """Put the bolt back on the table, where the grip was or in the middle, to begin again."""
        self._log(f"{reason}: put it down")
        if grip is None:
            position, rotation = self._flange
            self._go((position - [0.0, 0.04, 0.0], rotation), self._command, 0.8)
            _, axes = self._grip_pose()
            upright = Rotation.align_vectors([-UP], [axes[:, 2]])[0].as_matrix() @ axes
            grip = np.array([0.0, 0.0, 0.009]), upright
            self._go(self._gripping((np.array([0.0, 0.0, 0.1]), upright)), self._command, 1.5)
        self._go(self._gripping(grip), self._command, 1.0)
        self._go(self._flange, self._fingers(0.02, 0.008), 0.5)
        return Step.SEARCH

    # Motions ----------------------------------------------------------------------------------------------

    def _move(self, flange: Pose, joint_rad: FloatArray) -> None:
        self._sensed = self._robot.move(flange, joint_rad)
        self._flange, self._command = flange, joint_rad

    def _carry(self, flange: Pose, duration_s: float) -> bool:
        """Move with the bolt in the grip; stop and return False where it slips."""
        return not self._go(flange, self._command, duration_s, until=self._slips)

    def _go(
        self,
        flange: Pose,
        joint_rad: FloatArray,
        duration_s: float,
        until: Callable[[], bool] | None = None,
        *,
        evenly: bool = False,
    ) -> bool:
        """Move, smoothly or with an even speed; return whether `until` stopped it."""
        (begin_m, begin), before = self._flange, self._command
        turn = Slerp([0.0, 1.0], Rotation.from_matrix([begin, flange[1]]))
        steps = round(duration_s / self._robot.period_s)
        for s in np.arange(1, steps + 1) / steps:
            part = s if evenly else s * s * (3 - 2 * s)
            pose = begin_m + part * (flange[0] - begin_m), turn(part).as_matrix()
            self._move(pose, before + part * (joint_rad - before))
            if until and until():
                return True
        return False

    def _above(self, flange: Pose) -> Pose:
        return np.array([*flange[0][:2], max(flange[0][2], 0.22)]), flange[1]

    def _gripping(self, grip: Pose) -> Pose:
        """Return the flange's pose that puts the grip somewhere."""
        return compose(grip, inverse(self._arm.grip))

    def _grip_pose(self) -> Pose:
        return compose(self._flange, self._arm.grip)

    def _fingers(self, thumb_m: float, fingers_m: float) -> FloatArray:
        """Return joint positions with the fingertips so far from the bolt's shank."""
        q = self._arm.posture(POSTURE_RAD)
        for finger, along_m in ALONG_M.items():
            side, apart_m = (-1, thumb_m) if finger == "thumb" else (1, fingers_m)
            away = side * (self.bolt.shank_m + RADIUS_M[finger] + apart_m)
            target = self._arm.grip[0] + self._arm.grip[1] @ [away, along_m, -ABOVE_M[finger]]
            q = self._arm.reach(finger, target, q)
        return q

    def _squeeze(self, joint_rad: FloatArray) -> FloatArray:
        """Return joint positions to command so that the fingers press with `FORCE_N`."""
        across, pressed = self._arm.grip[1][:, 0], joint_rad.copy()
        for finger, force_n in FORCE_N.items():
            side = 1.0 if finger == "thumb" else -1.0
            pressed += self._arm.press(finger, side * force_n * across, joint_rad)
        return pressed

    def _flat_on(self, middle: FloatArray, height_m: float, yaw: float) -> Pose:
        """Return the flange's pose with flat fingers over a place, pointing along `yaw` and down."""
        turn = Rotation.from_euler("z", yaw).as_matrix() @ np.diag([1.0, -1.0, -1.0])
        turn = turn @ Rotation.from_euler("y", -PITCH_RAD).as_matrix()
        place = np.array([*middle, height_m])
        return compose((place - turn @ FLAT_M, turn), inverse(self._arm.palm))

    def _press(self, middle: FloatArray, yaw: float) -> tuple[list[Contact], FloatArray]:
        """Lower flat fingers until they touch the bolt; return contacts, and spheres where it isn't."""
        flat = self._arm.posture(FLAT_RAD)
        self._go(self._flat_on(middle, 0.05, yaw), flat, 0.8)
        self._go(self._flat_on(middle, _BEGIN_M, yaw), flat, 0.2)
        last: dict[str, list[Contact]] = {}
        lowest = self._flat_on(middle, _END_M, yaw)
        if self._go(lowest, flat, 1.5, until=lambda: bool(self._on_bolt()), evenly=True):
            for _ in range(5):
                self._move(self._flange, flat)
                for link, each in self._on_bolt().items():
                    last.setdefault(link, []).append(each)
        spheres = self._spheres()
        self._go(self._flat_on(middle, 0.05, yaw), flat, 0.3)
        means = [(each[-1], np.mean([one.point_m for one in each], axis=0)) for each in last.values()]
        for _, mean_m in means:
            self._log(f"touched at {1e3 * mean_m.round(4)} mm")
        return [each._replace(point_m=mean_m) for each, mean_m in means], spheres

    def _most_telling(self, poses: list[OnTable]) -> tuple[FloatArray, float]:
        """Return place and yaw of the touch that is expected to tell possible poses of the bolt apart best.

        The question is one as the daemon's estimators pose: which pose of the spread of all is true? Its
        actions are touches about each pose, measured by the height at which the fingers meet the bolt.
        """
        drawn = [each for pose in poses for each in pose.spread()]
        total = sum(weight for _, weight in drawn)
        self._arm.set(self._arm.posture(FLAT_RAD))
        flat = self._flat_spheres(self._flat_on(np.zeros(2), 0.0, 0.0))
        touches: list[tuple[FloatArray, float, CandidateAction]] = []
        for pose, along_m, turn in itertools.product(poses, _ALONG_M, _TURNS_RAD):
            x, y, toward = pose.parameters
            place = np.array([x + along_m * np.cos(toward), y + along_m * np.sin(toward)])
            spheres = flat.copy()
            spheres[:, :3] = flat[:, :3] @ Rotation.from_euler("z", toward + turn).as_matrix().T
            spheres[:, :2] += place
            heights_m = [self.bolt.lowered_m(each, spheres, _END_M) for each, _ in drawn]
            outcomes = {f"pose {k}": (height_m, _TOUCH_STD_M) for k, height_m in enumerate(heights_m)}
            touches.append((place, toward + turn, CandidateAction("touch", {}, outcomes)))
        weights = {f"pose {k}": weight / total for k, (_, weight) in enumerate(drawn)}
        question = Question("bolt_on_table", 0, 0, 0, weights, [action for *_, action in touches])
        bits = [expected_information_bits(question, action) for action in question.actions]
        place, yaw, _ = touches[int(np.argmax(bits))]
        self._log(f"asks which pose it is: a touch that is expected to tell {max(bits):.1f} bits")
        return place, yaw

    def _spheres(self) -> FloatArray:
        """Return spheres in flat fingers (n, 4), centre in the world and radius."""
        self._arm.set(self._sensed.joint_rad)
        return self._flat_spheres(self._flange)

    def _flat_spheres(self, flange: Pose) -> FloatArray:
        found = []
        for link in FLAT_LINKS:
            position, rotation = compose(flange, self._arm.link("base", link))
            for along_m, radius_m in FLAT_SPHERES[link.partition("_")[2]]:
                found.append([*(position + along_m * rotation[:, 0]), radius_m])
        return np.array(found)

    def _on_bolt(self) -> dict[str, Contact]:
        contacts = self._contacts(FLAT_LINKS)
        return {link: each for link, each in contacts.items() if each.point_m[2] > _ON_TABLE_M}

    # Touch ------------------------------------------------------------------------------------------------

    def _contacts(self, links: tuple[str, ...]) -> dict[str, Contact]:
        """Return present contacts of some links, in the world."""
        touch, found = self._sensed.touch, {}
        touched = [link for link in links if touch.touched[self._robot.links.index(link)]]
        if touched:
            self._arm.set(self._sensed.joint_rad)
        for link in touched:
            row = self._robot.links.index(link)
            position, rotation = compose(self._flange, self._arm.link("base", link))
            normal = touch.normal[row].astype(np.float64)
            variance = max(float(normal @ touch.covariance_m2[row] @ normal), 0.0)
            aside = (float(np.trace(touch.covariance_m2[row])) - variance) / 2
            point = position + rotation @ touch.position_m[row]
            if np.isfinite(point).all():
                std_m, std_rad = np.sqrt(variance), np.sqrt(max(aside, 0.0)) / PAD_RADIUS_M
                force_n = float(touch.force_n[row])
                found[link] = Contact(point, rotation @ normal, std_m, std_rad, force_n)
        return found

    def _fingertips(self) -> dict[str, Contact]:
        links = tuple(f"{finger}_distal" for finger in FORCE_N)
        return {link.partition("_")[0]: each for link, each in self._contacts(links).items()}

    def _is_held(self) -> bool:
        """Thumb and a finger press on something, as far as forces are known."""
        firm = [finger for finger, each in self._fingertips().items() if not each.force_n < MIN_FORCE_N]
        return "thumb" in firm and len(firm) > 1

    def _slips(self) -> bool:
        """Two of the holding fingers slide: one may roll, or change the place where it bears."""
        rows = [self._robot.links.index(f"{finger}_distal") for finger in FORCE_N]
        return int(np.count_nonzero(self._sensed.sliding[rows])) > 1

    def _tips(self) -> FloatArray:
        """Return the centres of the holding fingertips (3, 3) from the flange, along the world's axes."""
        self._arm.set(self._sensed.joint_rad)
        return np.array([self._flange[1] @ self._arm.tip(finger) for finger in FORCE_N])

    def _aimed(self, beyond_m: float) -> Pose:
        """Return the flange's pose with the bolt on the hole's axis, its tip so far into the hole."""
        _, rotation = self._held
        _, now = self._grip_pose()
        axis = now @ rotation[:, 2]
        turn, _ = Rotation.align_vectors([[0.0, 1.0, 0.0]], [axis])
        turned = turn.as_matrix() @ now
        _, tip = self.bolt.ends(self._held)
        return self._gripping((HOLE_M + np.array([0.0, beyond_m, 0.0]) - turned @ tip, turned))


def _orthonormal(across: FloatArray, approach: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    across = across / np.linalg.norm(across)
    approach = approach - (approach @ across) * across
    approach /= np.linalg.norm(approach)
    return across, np.cross(approach, across), approach


def main() -> None:
    """Start bolts."""
    parser = argparse.ArgumentParser(description="Start a bolt in a hole by touch alone.")
    parser.add_argument("--seed", type=int, default=1, help="of the bolt's place, and of the world")
    parser.add_argument("--world", default="default")
    parser.add_argument("--clearance-mm", type=float, default=1.0)
    parser.add_argument("--bolt", choices=BOLTS, default="M10x40")
    parser.add_argument("--truth", action="store_true", help="give the program the true pose")
    parser.add_argument("--daemon", type=int, default=0, help="touch by a daemon, N times slower")
    given = parser.parse_args()
    clearance_m, start = 1e-3 * given.clearance_mm, BoltStart.drawn(given.seed)
    bolt = BOLTS[given.bolt]
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that a daemon ends with this program
    cell = BoltWorkcell(given.seed, start, given.world, clearance_m, bolt=bolt, slower=given.daemon)
    with contextlib.closing(cell):
        truth = (lambda: cell.scene.bolt_pose) if given.truth else None
        program = BoltStarter(cell, truth, lambda text: print(f"{cell.scene.data.time:6.2f} s  {text}"))
        program.run()
        print(" ".join(step.value for step in program.steps))
        print(
            f"in truth: inserted by {1e3 * cell.scene.inserted_m:.1f} mm after {cell.scene.data.time:.0f} s"
        )


if __name__ == "__main__":
    main()
