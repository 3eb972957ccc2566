"""Simulated two-finger gripper under velocity control, with an object between the fingers.

Public names: `GripperWorld` (joints and object), `GripperStimulus` (contacts of its pads). There is no clock:
times are seconds since the first SYNC, and never decrease.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.config.problems import ConfigError, Problem
from handtouch.hand.urdf import RobotDescription
from handtouch.simulate.contact_patch import ContactPatch, discs
from handtouch.simulate.gripper_objects import (
    GRIPPER_OBJECTS,
    CurvedEdge,
    FingertipContact,
    FingertipPositions,
    SoftBlock,
)
from handtouch.simulate.stimulus import AppliedContact, EventlessStimulus

FINGER_LINKS = {"thumb": "thumb_tip", "index": "index_tip"}
"""Link with the pad of each finger."""
JOINT_LIMITS_M = {"reach": (0.0, 0.1), "lift": (-0.03, 0.03), "thumb": (0.0, 0.03), "index": (0.0, 0.03)}
"""Range of each joint, as in two_finger.urdf."""
MAX_SPEED_M_S = 0.1
COMMAND_TIMEOUT_S = 0.05
"""A commanded velocity expires after this time, then the joints stop."""
_MAX_SAMPLE_GAP_S = 0.05
"""If samples are further apart, on an overloaded machine, simulated time pauses."""
_JOINT_LAG_S = 0.01
_TIME_STEP_S = 0.001
_HOME_OFFSET_M = 0.03  # distance of each fingertip from the centre, with its joint at 0
_PAD_FRACTION_RANGE = (0.02, 0.98)


class GripperWorld:
    """Joints that follow commanded velocities with a lag of 10 ms, and the object between the fingers."""

    def __init__(self, tip_radius_m: float) -> None:
        self._contacts: list[FingertipContact] = []
        self._tip_radius_m = tip_radius_m
        self._lock = threading.Lock()
        self._time_s = 0.0
        self._sampled_s = 0.0
        self._paused_s = 0.0
        self._commanded_m_s = dict.fromkeys(JOINT_LIMITS_M, 0.0)
        self._command_end_s = 0.0
        self.reset("block")

    def reset(self, object_name: str, **parameters: float) -> None:
        """Move the joints home and replace the object: "block" or "edge", with parameters.

        Raises ValueError for an unknown object or parameter.
        """
        new_object = _create_object(object_name, parameters)
        with self._lock:
            self._object = new_object
            self._commanded_m_s = dict.fromkeys(JOINT_LIMITS_M, 0.0)
            self._speed_m_s = dict.fromkeys(JOINT_LIMITS_M, 0.0)
            self._position_m = dict.fromkeys(JOINT_LIMITS_M, 0.0)
            self._pull = (0.0, 0.0, 0.0, 0.0)
            self._contacts = []

    def command_velocity(self, t_s: float, velocity_m_s: Mapping[str, float]) -> None:
        """Set joint velocities from `t_s` on, 0 for joints not named; ValueError for an unknown joint."""
        _check_parameters(velocity_m_s, JOINT_LIMITS_M, "joint")
        self.advance(t_s)
        with self._lock:
            self._commanded_m_s = {
                name: min(max(velocity_m_s.get(name, 0.0), -MAX_SPEED_M_S), MAX_SPEED_M_S)
                for name in JOINT_LIMITS_M
            }
            self._command_end_s = self._time_s + COMMAND_TIMEOUT_S

    def pull_object(self, t_s: float, force_n: float, ramp_s: float) -> None:
        """Apply an external force to the object along +x, which rises linearly within `ramp_s`."""
        if not (math.isfinite(force_n) and ramp_s >= 0):
            raise ValueError(f"force_n = {force_n}, ramp_s = {ramp_s}: must be finite, and ramp_s 0 or more")
        self.advance(t_s)
        with self._lock:
            self._pull = (self._time_s, self._pull_n(self._time_s), force_n, ramp_s)

    def sample_contacts(self, t_s: float) -> list[FingertipContact]:
        """Return the contacts at `t_s`, or the present ones if `t_s` is past."""
        with self._lock:
            self._paused_s += max(t_s - self._sampled_s - _MAX_SAMPLE_GAP_S, 0.0)
            self._sampled_s = max(t_s, self._sampled_s)
        self.advance(t_s)
        with self._lock:
            return self._contacts

    def advance(self, t_s: float) -> None:
        """Advance to `t_s`, at most 50 ms beyond the last sample."""
        with self._lock:
            until_s = min(t_s, self._sampled_s + _MAX_SAMPLE_GAP_S) - self._paused_s
            while self._time_s + _TIME_STEP_S <= until_s:
                self._time_s += _TIME_STEP_S
                self._advance_step()

    @property
    def position_m(self) -> dict[str, float]:
        """Present joint positions."""
        with self._lock:
            return dict(self._position_m)

    def truth(self) -> dict[str, float]:
        """Return the ground truth about the object."""
        with self._lock:
            return self._object.truth()

    def _advance_step(self) -> None:
        gain = 1 - math.exp(-_TIME_STEP_S / _JOINT_LAG_S)
        for name, (low, high) in JOINT_LIMITS_M.items():
            target = self._commanded_m_s[name] if self._time_s < self._command_end_s else 0.0
            self._speed_m_s[name] += gain * (target - self._speed_m_s[name])
            self._position_m[name] = min(
                max(self._position_m[name] + _TIME_STEP_S * self._speed_m_s[name], low), high
            )
        position = self._position_m
        self._object.set_pull(self._pull_n(self._time_s))
        tips = FingertipPositions(
            x_m=position["reach"],
            z_m=position["lift"],
            thumb_y_m=position["thumb"] - _HOME_OFFSET_M,
            index_y_m=_HOME_OFFSET_M - position["index"],
            index_radius_m=self._tip_radius_m,
        )
        self._contacts = self._object.advance(_TIME_STEP_S, tips)

    def _pull_n(self, t_s: float) -> float:
        begin_s, before, after, ramp_s = self._pull
        fraction = min(max((t_s - begin_s) / ramp_s, 0.0), 1.0) if ramp_s else 1.0
        return before + fraction * (after - before)


class GripperStimulus(EventlessStimulus):
    """Contacts of a gripper world on the pads of a deployment; only present contacts are known."""

    def __init__(self, world: GripperWorld, thumb: config.SurfaceTable, index: config.SurfaceTable) -> None:
        self.world = world
        self._thumb, self._index = thumb, index

    @classmethod
    def from_deployment(cls, deployment: config.Deployment, file: str = "the deployment") -> GripperStimulus:
        """Build a world on the pads of the fingers' links.

        Raises ConfigError if they are missing or have other surfaces than a plane and a sphere.
        """
        pads = {pad.link: pad.surface for _, pad in deployment.pads}
        thumb, index = (pads.get(link) for link in FINGER_LINKS.values())
        if not (thumb and index and (thumb.kind, index.kind) == ("plane", "sphere")):
            reason = "a gripper needs a plane on thumb_tip and a sphere on index_tip, as in two_finger.toml"
            raise ConfigError(file, (Problem("[[hand.pad]]", "", reason),))
        return cls(GripperWorld(1e-3 * index.radius_mm), thumb, index)

    @property
    def touch_links(self) -> Sequence[str]:
        """One touch per finger."""
        return list(FINGER_LINKS.values())

    def contacts_at(self, t_s: float) -> list[AppliedContact]:
        """Return the contacts at `t_s`, or the present ones if `t_s` is past."""
        contacts = []
        low, high = _PAD_FRACTION_RANGE
        for contact in self.world.sample_contacts(t_s):
            is_thumb = contact.finger == "thumb"
            x, y = self._thumb_position(contact) if is_thumb else self._index_position(contact)
            if min(x, y) >= low and max(x, y) <= high:  # contacts beside the pad aren't sensed
                number = list(FINGER_LINKS).index(contact.finger)
                contacts.append(AppliedContact(number, x, y, contact.force_n))
        return contacts

    def pad_stimulus(self, link: str, patch: Callable[[int], ContactPatch]) -> LivePadStimulus:  # noqa: ARG002
        """Return a stimulus without any contact known in advance."""
        return LivePadStimulus()

    def joint_trajectory(self, robot: RobotDescription) -> CommandedJoints:  # noqa: ARG002
        """Return the commanded joints."""
        return CommandedJoints(self.world)

    def check_links(self, links: Iterable[str], file: str = "gripper") -> None:
        """Raise ConfigError if a finger's link carries no pad."""
        if missing := sorted(set(FINGER_LINKS.values()) - set(links)):
            raise ConfigError(file, (Problem("[[hand.pad]]", "", f"no pad on {', '.join(missing)}"),))

    def _thumb_position(self, contact: FingertipContact) -> tuple[float, float]:
        """Return fractions of the thumb's pad: its x is along x, its y along -z."""
        x, z = contact.offset
        return 0.5 + 1e3 * x / self._thumb.length_mm, 0.5 - 1e3 * z / self._thumb.width_mm

    def _index_position(self, contact: FingertipContact) -> tuple[float, float]:
        """Return fractions of the index finger's pad: latitude along x, longitude along z."""
        x, z = contact.offset
        latitude = math.degrees(math.asin(x))
        longitude = math.degrees(math.atan2(z, math.sqrt(max(1 - x * x - z * z, 0.0))))
        low, high = self._index.from_deg, self._index.to_deg
        return (latitude - low) / (high - low), 0.5 + longitude / self._index.arc_deg


@dataclass(frozen=True)
class CommandedJoints:
    """Joints of a gripper world, as a `JointTrajectory`."""

    world: GripperWorld

    def positions_at(self, t_s: float) -> dict[str, float]:
        """Return the joint positions at `t_s`, or the present ones if `t_s` is past [m]."""
        self.world.advance(t_s)
        return self.world.position_m


class LivePadStimulus:
    """Pad without contacts known in advance; it can't be combined with sheet behaviour."""

    max_contacts = 1

    @property
    def event_times_s(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """No times."""
        return np.zeros(0), np.zeros(0), np.zeros(0)

    def contacts(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return one contact without force."""
        n = len(times_s)
        return np.full((1, 2, n), 0.5), np.zeros((1, n)), discs(np.ones((1, n)))

    def tangential_n(self, times_s: FloatArray) -> FloatArray:
        """Return no force."""
        return np.zeros((2, len(times_s)))


def _create_object(object_name: str, parameters: Mapping[str, float]) -> SoftBlock | CurvedEdge:
    if object_name not in GRIPPER_OBJECTS:
        raise ValueError(f"unknown object {object_name!r}; known: {', '.join(GRIPPER_OBJECTS)}")
    kind = GRIPPER_OBJECTS[object_name]
    known = [name for name in kind.__dataclass_fields__ if not name.startswith("_")]
    _check_parameters(parameters, known, f"parameter of {object_name}")
    return CurvedEdge(**parameters) if kind is CurvedEdge else SoftBlock(**parameters)


def _check_parameters(given: Mapping[str, float], known: Iterable[str], what: str) -> None:
    for name, value in given.items():
        if name not in known:
            raise ValueError(f"unknown {what} {name!r}; known: {', '.join(known)}")
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise ValueError(f"{name} = {value!r}: must be a finite number")
