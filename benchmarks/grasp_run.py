"""Process one MuJoCo grasp with the daemon's pipeline, and compare the output with MuJoCo's ground truth.

Public names: `drawn_world`, `served` -> `Served`; `against` and `at_best` score its contacts. Samples enter
at 200 Hz, joint states at 100 Hz through the decoder of the inputs endpoint, in the order of their arrival,
not in real time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import zmq
from numpy.typing import NDArray

from benchmarks.daemon_settings import (
    InlineProcess,
    decoded,
    lay_out_channels,
    pipeline_of,
    request_percepts,
    write_counts,
)
from benchmarks.event_score import (
    EventScore,
    Span,
    compare_contacts,
    ideal_contact_spans,
    merge_spans,
    touch_spans,
)
from handtouch import wire
from handtouch.config import Deployment, Touch
from handtouch.core.pad_model import PadModel
from handtouch.core.stages.kinematics import LinkPoses
from handtouch.daemon.authentication import Authenticator
from handtouch.daemon.inputs import InputReceiver
from handtouch.daemon.percepts import PerceptPublisher
from handtouch.hand.joints import JointStateBuffer
from handtouch.hand.pads import mount_transform
from handtouch.hand.robot_models import RobotModels
from handtouch.simulate.grasp.grasp_objects import GraspObject
from handtouch.simulate.grasp.grasp_stimulus import EncoderErrors, GraspStimulus
from handtouch.simulate.grasp.mujoco_scene import TIME_STEP_S
from handtouch.simulate.grasp.patches import ContactPatches, contact_patches
from handtouch.simulate.grasp.simulation import DURATION_S, GraspRecord, simulate_grasp
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, DrawnWorld, Family
from handtouch.wire import PERCEPT_KINDS
from handtouch.wire.inputs import JointState, encode

FloatArray = NDArray[np.float64]
PARTS = ("pad", "mount", "kinematics", "time")
_PERIOD_NS, _JOINTS_NS, _ARRIVES_NS = 5_000_000, 10_000_000, 2_000_000
_START_NS = 1_000_000_000
_PER_TICK = 5  # steps of MuJoCo
"""Of a pad with a shear pad or a second sheet: its channels are in two TPDOs."""


def drawn_world(name: str, seed: int) -> DrawnWorld:
    """Return a named world of the reporting family, with misaligned pads and late joint states."""
    return WORLDS[name].draw(Family.REPORTING.seed(seed))


@dataclass(frozen=True, eq=False)
class Served:
    """The daemon's output for a grasp: k contact samples with a position in the palm; lengths in metres."""

    grasp: GraspRecord
    patches: ContactPatches
    step: NDArray[np.intp]
    """(k,), step of MuJoCo."""
    pad: NDArray[np.intp]
    palm_m: FloatArray
    """(k, 3), reported position."""
    covariance_m2: FloatArray
    """(k, 3, 3), reported covariance."""
    true_m: FloatArray
    """(k, 3), centre of force."""
    error_m: dict[str, FloatArray]
    """(k, 3) by PARTS; their sum is palm_m - true_m."""
    force_n: FloatArray
    force_std_n: FloatArray
    """(k,), reported; NaN where the force is a lower bound."""
    true_n: FloatArray
    moving_rad_s: FloatArray
    """(k,), speed of the fastest joint."""
    railed: int
    """Samples with a channel at the end of its range."""
    spans: list[list[Span]]
    """Reported contacts by pad."""
    percepts: list[wire.Percept]
    """Published percepts, if requested."""
    contacts: list[wire.Contact]
    """Published contact messages, also those without a position in the palm."""
    seed: int = 0
    """Of the hand's parts and mounts."""
    percepts_s: float = 0.0
    """Processor time of the percept process."""


def served(
    deployment: Deployment,
    name: str | GraspObject,
    seed: int,
    world: DrawnWorld,
    *,
    perceive: Literal[True] | Sequence[str] = (),
    duration_s: float = DURATION_S,
    done: GraspRecord | None = None,
    used_before: bool = False,
) -> Served:
    """Let the first hand grasp and process the samples; its file describes sheets as their builder would.

    `perceive` requests percepts, all or some kinds; `done` is the grasp if it has been simulated already;
    `used_before`: the sheets are known to be rested, and all zeros known, by a stored state.
    """
    deployment = world.describe(deployment)
    if used_before:
        deployment = with_rested_sheets(deployment)
    hand = deployment.hands[0]
    grasp = done or simulate_grasp(hand, name, seed, world, duration_s=duration_s)
    patches = contact_patches(grasp)
    stimulus = GraspStimulus.from_grasp(grasp, patches, EncoderErrors.of_world(world, grasp))
    virtual = VirtualHand(deployment, stimulus, world)
    steps = np.arange(0, len(grasp.times_s), _PER_TICK)
    times_s = np.asarray(steps * TIME_STEP_S, np.float64)
    counts = [virtual.all_counts(row, times_s) for row in range(len(hand.pads))]
    with zmq.Context() as context:
        run = _Run(deployment, context, grasp, world, perceive)
        for pad in range(len(hand.pads) if used_before else 0):
            run.pipeline.tick.sheet_force.set_back_force(pad, 0.0, 0.0)
            run.pipeline.tick.second.set_offset(pad, 0.0)
            run.pipeline.tick.set_baseline(pad, 0.0)
        for tick, step in enumerate(steps.tolist()):
            run.tick(step, [of[tick] for of in counts])
        run.inputs.close()
        run.authenticator.close()
    railed = sum(int((np.abs(of) >= 32767).any(axis=1).sum()) for of in counts)
    compared = _compared(deployment, grasp, patches, run, railed)
    return replace(compared, seed=seed, percepts_s=run.process.busy_s)


def with_rested_sheets(deployment: Deployment) -> Deployment:
    """Return a deployment that states its sheets as not loaded before."""
    sheets = {
        name: sheet.model_copy(
            update={"behaviour": sheet.behaviour.model_copy(update={"back_force_std_n": 0.0})}
        )
        if sheet.behaviour
        else sheet
        for name, sheet in deployment.sheets.items()
    }
    return deployment.model_copy(update={"sheets": sheets})


class _Run:
    """The core's pipeline, fed tick by tick."""

    def __init__(
        self,
        deployment: Deployment,
        context: zmq.Context[Any],
        grasp: GraspRecord,
        world: DrawnWorld,
        perceive: Literal[True] | Sequence[str] = (),
    ) -> None:
        model, robots = PadModel(deployment), RobotModels(deployment)
        self.poses = LinkPoses(robots.kinematics[0])
        hand, names = deployment.hands[0].name, robots.kinematics[0].joints
        self._order = np.array([grasp.joints.index(name) for name in names])
        self._names, self._hand = robots.joint_names[0], hand
        encoders = EncoderErrors.of_world(world, grasp)
        self._reported, self._std = encoders.readings(grasp.joint_rad), encoders.std_rad
        self._clean = encoders.delayed_only(grasp.joint_rad)
        states, self._timely = JointStateBuffer(self._names), JointStateBuffer(self._names)
        pads = list(zip(model.hands, model.links, strict=True))
        self.authenticator = Authenticator(context)
        self.inputs = InputReceiver.open(
            context, "tcp://127.0.0.1:*", self.authenticator, {hand: states}, pads
        )
        self.pipeline = pipeline_of(deployment, self, model=model, robots=robots, period_ns=_PERIOD_NS)
        self.pipeline.transforms.joints_at = self.inputs.joints_at
        lay_out_channels(self.pipeline, deployment)
        self.process = InlineProcess(deployment)
        self._perceiving = PerceptPublisher(deployment, self.pipeline, self, process=self.process)
        kinds = PERCEPT_KINDS if perceive is True else perceive
        request_percepts(self.pipeline, self._perceiving, kinds, _START_NS, palm=True)
        self.contacts: list[wire.Contact] = []
        self.percepts: list[wire.Percept] = []
        self.used: dict[int, tuple[FloatArray, FloatArray]] = {}
        """By step: joint positions used by the daemon, and those of exact encoders."""
        self._next_ns = 3_000_000  # joint states aren't synchronous with samples

    def has_subscriber(self, topic: str) -> bool:
        return topic.startswith(("contact/", "percept/"))

    def send(self, message: wire.OutgoingMessage) -> None:
        received = decoded(message)
        if isinstance(received, wire.Contact):
            self.contacts.append(received)
        elif isinstance(received, wire.Percept):
            self.percepts.append(received)

    def tick(self, step: int, counts: Sequence[NDArray[np.int64]]) -> None:
        since_ns = round(step * TIME_STEP_S * 1e9)
        while self._next_ns + _ARRIVES_NS <= since_ns:
            self._send_joints(self._next_ns)
            self._next_ns += _JOINTS_NS
        t_ns = _START_NS + since_ns
        self.pipeline.begin_cycle(t_ns, t_ns)
        for pad, now in enumerate(counts):
            write_counts(self.pipeline, pad, now, t_ns + 1)
        ticked = self.pipeline.tick_if_due(t_ns + 7 * _PERIOD_NS // 10)
        assert ticked is not None
        self._perceiving.process_tick(ticked, t_ns)
        self.pipeline.prepare_next_tick()
        if self.pipeline.transforms.used_joints:
            self.used[step] = (
                self.pipeline.transforms.used_joints[-1][2].copy(),
                self._timely.interpolate(t_ns).position_rad,
            )

    def _send_joints(self, since_ns: int) -> None:
        t_ns, number = _START_NS + since_ns, round(since_ns * 1e-9 / TIME_STEP_S)
        reported, clean = self._reported[number, self._order], self._clean[number, self._order]
        std = np.full(len(reported), self._std) if self._std else None
        topic, data = encode(JointState(self._hand, t_ns, self._names, reported, None, None, std))
        self.inputs.process_message([topic, data], t_ns + _ARRIVES_NS)
        self._timely.add_state(t_ns, self._names, clean, None, std)


def against(run: Served, touch: Touch, min_gap_s: float) -> EventScore:
    """Score contacts against MuJoCo's touches at 1 kHz, ignoring gaps of either shorter than `min_gap_s`."""
    events = EventScore()
    for pad, contacts in enumerate(run.spans):
        total = run.patches.total_n[:, pad]
        true = touch_spans(total, TIME_STEP_S, touch.begin_threshold_n, touch.end_threshold_n, min_gap_s)
        compare_contacts(
            events, true, touch_spans(total, TIME_STEP_S, 0.0, 1e-9, 0.0), merge_spans(contacts, min_gap_s)
        )
    return events


def at_best(run: Served, touch: Touch) -> EventScore:
    """Score contacts against those of pads with exact samples of MuJoCo's forces."""
    events, period_s = EventScore(), _PER_TICK * TIME_STEP_S
    for pad, contacts in enumerate(run.spans):
        total = run.patches.total_n[::_PER_TICK, pad]
        samples = 1 + math.ceil(1e-3 * touch.begin_ms / period_s - 0.5)
        true = ideal_contact_spans(total, period_s, touch.begin_threshold_n, touch.end_threshold_n, samples)
        compare_contacts(
            events, true, touch_spans(total, period_s, 0.0, 1e-9, 0.0), contacts, min_touch_s=0.0
        )
    return events


def _compared(
    deployment: Deployment, grasp: GraspRecord, patches: ContactPatches, run: _Run, railed: int
) -> Served:
    pads = deployment.hands[0].pads
    row = {pad.link: number for number, pad in enumerate(pads)}
    spans: list[list[Span]] = [[] for _ in pads]
    begun: dict[int, float] = {}
    kept: list[tuple[wire.Contact, int, int]] = []
    for contact in run.contacts:
        pad, t_s = row[contact.link], (contact.t_ns - _START_NS) * 1e-9
        step = round(t_s / TIME_STEP_S)
        if contact.event == "begin":
            begun[pad] = t_s
        elif contact.event == "end":
            spans[pad].append((begun.pop(pad), t_s))
        if contact.event != "end" and contact.palm_position_m is not None and patches.total_n[step, pad] > 0:
            kept.append((contact, step, pad))
    for pad, t_s in begun.items():
        spans[pad].append((t_s, len(grasp.times_s) * TIME_STEP_S))
    positions = [_split(run, grasp, patches, deployment, *it) for it in kept]
    steps = np.array([step for _, step, _ in kept], np.intp)
    rows = np.array([pad for *_, pad in kept], np.intp)
    speed = np.abs(np.gradient(grasp.joint_rad, TIME_STEP_S, axis=0)).max(axis=1)
    return Served(
        grasp,
        patches,
        steps,
        rows,
        np.array([contact.palm_position_m for contact, *_ in kept]).reshape(-1, 3),
        np.array([contact.palm_covariance_m2 for contact, *_ in kept]).reshape(-1, 3, 3),
        np.array([true_m for true_m, _ in positions]).reshape(-1, 3),
        {part: np.array([error[part] for _, error in positions]).reshape(-1, 3) for part in PARTS},
        np.array([np.nan if c.force_n is None else c.force_n for c, *_ in kept]),
        np.array([np.nan if c.force_std_n is None else c.force_std_n for c, *_ in kept]),
        patches.total_n[steps, rows],
        speed[steps],
        railed,
        spans,
        run.percepts,
        run.contacts,
    )


def _split(
    run: _Run,
    grasp: GraspRecord,
    patches: ContactPatches,
    deployment: Deployment,
    contact: wire.Contact,
    step: int,
    pad: int,
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Return the true position in the palm, and the error's components by cause, which sum to the error."""
    poses, built = run.poses, grasp.pads[pad]
    rotation, offset_m = mount_transform(deployment.hands[0].pads[pad])
    x, y = patches.force_centre[step, pad].tolist()
    in_pad = built.shape.point(x * built.shape.length_m, y * built.shape.arc)
    true_on_link = built.rotation @ in_pad + built.translation_m
    nominal = rotation @ in_pad + offset_m
    reported = np.array(contact.position_m)
    true_rotation, origin = grasp.link_rotation[step, pad], grasp.link_m[step, pad]
    used, timely = run.used[step]

    def by(position_rad: FloatArray) -> FloatArray:
        poses.set_joint_positions(position_rad)
        pose = poses.pose_in_palm(pad)
        return np.asarray(pose.rotation @ reported + pose.translation_m)

    return true_rotation @ true_on_link + origin, {
        "pad": true_rotation @ (reported - nominal),
        "mount": true_rotation @ (nominal - true_on_link),
        "kinematics": by(used) - by(timely),
        "time": by(timely) - (true_rotation @ reported + origin),
    }
