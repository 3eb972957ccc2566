"""Grasp as the stimulus of a simulated hand: contact discs, forces on the pads, reported joint positions.

Public names: `GraspStimulus`, `EncoderErrors`, `PadForces`, `pad_forces`. Between two steps of MuJoCo the
earlier state holds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from handtouch.arrays import FloatArray, IntArray
from handtouch.config import ConfigError, Problem
from handtouch.hand.urdf import RobotDescription
from handtouch.simulate.base_motion import BaseTurn, Skin
from handtouch.simulate.contact_patch import ContactPatch, discs
from handtouch.simulate.faults import Fault
from handtouch.simulate.grasp.mujoco_scene import TIME_STEP_S
from handtouch.simulate.grasp.patches import ContactPatches
from handtouch.simulate.grasp.simulation import GraspRecord
from handtouch.simulate.node_faults import NodeFault
from handtouch.simulate.stimulus import AppliedContact, JointTrajectory, NodeReplacement
from handtouch.simulate.worlds import DrawnWorld, HiddenJoints


@dataclass(frozen=True)
class PadForces:
    """Forces on one pad over time: tangential (2, n) along its x and y, and normal (n,) [N]."""

    tangential_n: FloatArray
    normal_n: FloatArray


def pad_forces(grasp: GraspRecord, row: int) -> PadForces:
    """Return MuJoCo's forces on a pad at each of the n steps, sums of those of its contacts."""
    pad, count = grasp.pads[row], len(grasp.times_s)
    mine = grasp.pad_row == row
    step = grasp.step_index[mine]
    rotation = grasp.link_rotation[step, row]
    on_link = np.einsum("kji,kj->ki", rotation, grasp.point_m[mine] - grasp.link_m[step, row])
    force = np.einsum("kji,kj->ki", rotation, grasp.force_n[mine]) @ pad.rotation
    foot = pad.shape.project((on_link - pad.translation_m) @ pad.rotation)
    inward = np.einsum("ki,ki->k", force, foot.normal)
    along = force - inward[:, None] * foot.normal
    across = np.cross(foot.normal, [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across, axis=1)[:, None]
    forward = np.cross(across, foot.normal)
    total = np.zeros((3, count))
    for k, values in enumerate(
        (np.einsum("ki,ki->k", along, forward), np.einsum("ki,ki->k", along, across), -inward)
    ):
        np.add.at(total[k], step, values)
    return PadForces(total[:2], total[2])


_FORCE_SAMPLING_STEPS = 8  # between samples of the force for the sheet's history
_MIN_GAP_STEPS = 20  # shorter interruptions don't end a press
_ROUNDING_STEPS = 1e-6  # tolerance for rounded times of steps


@dataclass(frozen=True)
class EncoderErrors:
    """Errors of the joint positions that a robot reports in a world; the seed is of the noise."""

    joints: HiddenJoints
    seed: int = 1

    @classmethod
    def of_world(cls, world: DrawnWorld, grasp: GraspRecord) -> EncoderErrors:
        """Return the errors of the hand that grasps."""
        return cls(world.joints(grasp.hand, len(grasp.joints)), world.seed)

    def readings(self, position_rad: FloatArray) -> FloatArray:
        """Return readings (n, m) of true positions at 1 kHz."""
        noise = self.joints.noise_deg * np.random.default_rng((self.seed, 31)).normal(size=position_rad.shape)
        return self.delayed_only(position_rad) + np.radians(np.array(self.joints.offset_deg) + noise)

    def delayed_only(self, position_rad: FloatArray) -> FloatArray:
        """Return `readings` without offset and noise."""
        delay_steps = round(self.joints.delay_s / TIME_STEP_S)
        return np.asarray(position_rad[np.maximum(np.arange(len(position_rad)) - delay_steps, 0)])

    @property
    def std_rad(self) -> float:
        """Standard deviation of a reading, as in a data sheet."""
        return float(np.radians(self.joints.std_deg))


@dataclass(frozen=True, eq=False)
class GraspStimulus:
    """Contacts of a grasp on the pads of a hand; a `handtouch.simulate.stimulus.Stimulus`.

    Touches are numbered pad by pad, one number for each simultaneous disc of a pad.
    """

    patches: ContactPatches
    pads: tuple[str, ...]
    """Links, in the order of `patches`."""
    joints: tuple[str, ...]
    reported_rad: FloatArray
    """(n, m), joint positions reported by the robot."""
    tangential_n: FloatArray
    """(p, 2, n), tangential force on each pad along its x and y."""
    repeat: bool = False
    faults: Sequence[Fault] = ()
    node_faults: Sequence[NodeFault] = ()
    node_replacements: Sequence[NodeReplacement] = ()
    skin: Skin | None = None
    turns: Sequence[BaseTurn] = ()

    @classmethod
    def from_grasp(
        cls,
        grasp: GraspRecord,
        patches: ContactPatches,
        encoders: EncoderErrors | None = None,
        repeat: bool = False,
    ) -> GraspStimulus:
        """Return the stimulus of a grasp; without `encoders` the joint positions are exact."""
        reported_rad = encoders.readings(grasp.joint_rad) if encoders else grasp.joint_rad
        links = tuple(pad.link for pad in grasp.pads)
        tangential = np.stack([pad_forces(grasp, row).tangential_n for row in range(len(links))])
        return cls(patches, links, grasp.joints, reported_rad, tangential, repeat)

    @property
    def max_contacts(self) -> int:
        """Largest number of simultaneous discs of a pad."""
        return int(self.patches.force_n.shape[2])

    @property
    def duration_s(self) -> float:
        """Duration of one grasp."""
        return len(self.patches.total_n) * TIME_STEP_S

    @property
    def touch_links(self) -> list[str]:
        """Link of each touch; radii come with the contacts."""
        return [link for link in self.pads for _ in range(self.max_contacts)]

    def touch_patch(self, number: int, drawn: ContactPatch) -> ContactPatch:  # noqa: ARG002
        """Return the world's patch."""
        return drawn

    def contacts_at(self, t_s: float) -> list[AppliedContact]:
        """Return the discs at `t_s`."""
        step = self.step_indices(np.array([t_s]))[0]
        if step < 0:
            return []
        force, position, radius = (
            self.patches.force_n[step],
            self.patches.position[step],
            self.patches.radius_m[step],
        )
        return [
            AppliedContact(
                pad * self.max_contacts + lane, x, y, float(force[pad, lane]), float(radius[pad, lane])
            )
            for pad, lane in np.argwhere(force > 0).tolist()
            for x, y in [position[pad, lane].tolist()]
        ]

    def pad_stimulus(self, link: str, patch: Callable[[int], ContactPatch]) -> _GraspPadStimulus:  # noqa: ARG002
        """Return the discs of one pad."""
        row = self.pads.index(link)
        return _GraspPadStimulus(self, row, int((self.patches.force_n[:, row] > 0).any(axis=0).sum()))

    def joint_trajectory(self, robot: RobotDescription) -> JointTrajectory | None:
        """Return the joint motion if the robot has the grasp's joints, else None."""
        return _ReportedJoints(self) if set(self.joints) <= set(robot.joints) else None

    def check_links(self, links: Iterable[str], file: str = "grasp") -> None:
        """Raise ConfigError if the grasp presses on a pad that the deployment doesn't have."""
        if missing := sorted(set(self.pads) - set(links)):
            raise ConfigError(
                file, (Problem("the grasp", "", f"presses on {', '.join(missing)}: no such pad"),)
            )

    def step_indices(self, times_s: FloatArray) -> IntArray:
        """Return the indices (n,) of the steps at times (n,); -1 after the end."""
        number = np.floor(times_s / TIME_STEP_S + _ROUNDING_STEPS).astype(np.intp)
        n = len(self.patches.total_n)
        return number % n if self.repeat else np.where(number < n, number, -1)


class _ReportedJoints:
    """Reported joint positions of a grasp."""

    def __init__(self, stimulus: GraspStimulus) -> None:
        self._stimulus = stimulus

    def positions_at(self, t_s: float) -> dict[str, float]:
        """Return the reported positions at `t_s` [rad or m]."""
        stimulus = self._stimulus
        step = max(int(stimulus.step_indices(np.array([t_s]))[0]), -1)
        return dict(zip(stimulus.joints, stimulus.reported_rad[step].tolist(), strict=True))


@dataclass(frozen=True)
class _GraspPadStimulus:
    """Discs of one pad."""

    stimulus: GraspStimulus
    row: int
    max_contacts: int
    """Largest number of simultaneous discs."""

    @property
    def event_times_s(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Times [s]: to sample the force at; after which the sheet settles; at which presses begin."""
        on = np.flatnonzero(self.stimulus.patches.total_n[:, self.row] > 0)
        gaps = np.flatnonzero(np.diff(on, prepend=-_MIN_GAP_STEPS - 1) > _MIN_GAP_STEPS)
        begins = on[gaps]
        ends = on[np.append(gaps[1:] - 1, len(on) - 1)] + 1 if len(on) else on
        sampled = np.unique(np.concatenate([on[::_FORCE_SAMPLING_STEPS], begins, ends]))
        settling = np.append(begins, ends)
        return _times_s(sampled), _times_s(settling), _times_s(begins)

    def contacts(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return positions (k, 2, n), forces (k, n) [N], 0 without contact, and discs (k, PATCH_ROWS, n)."""
        patches, lanes = self.stimulus.patches, np.arange(self.max_contacts)
        steps = self.stimulus.step_indices(times_s)
        force = patches.force_n[steps, self.row][:, lanes].T * (steps >= 0)
        position = patches.position[steps, self.row][:, lanes].transpose(1, 2, 0)
        radius = np.asarray(patches.radius_m[steps, self.row][:, lanes].T)
        return np.asarray(position), np.asarray(force), discs(radius)

    def tangential_n(self, times_s: FloatArray) -> FloatArray:
        """Return the tangential force (2, n) along x and y of the pad [N]."""
        steps = self.stimulus.step_indices(times_s)
        return np.asarray(self.stimulus.tangential_n[self.row][:, steps] * (steps >= 0))


def _times_s(steps: IntArray) -> FloatArray:
    return np.asarray(steps * TIME_STEP_S, np.float64)
