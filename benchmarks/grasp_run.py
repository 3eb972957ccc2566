"""One grasp of MuJoCo's through the daemon's own pipeline, and what became of it beside MuJoCo's truth.

Public names: `Setting`, `served` -> `Served`; `against` and `at_best` compare its contacts. Samples go in at
200 Hz, joint states through the decoder of the inputs endpoint at 100 Hz, in the order of their arrival; no
clock is waited for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import zmq
from numpy.typing import NDArray

from handtouch import wire
from handtouch.config import Deployment, Touch
from handtouch.daemon.inputs import Inputs
from handtouch.daemon.model import PadModel
from handtouch.daemon.perceive import Perceiving
from handtouch.daemon.pipeline import Pipeline
from handtouch.daemon.scene import Wanted
from handtouch.daemon.security import Gate
from handtouch.hand.joints import JointStates
from handtouch.hand.pads import mount_of
from handtouch.hand.robot import Robots
from handtouch.inputs import JointState, encode
from handtouch.percept.stream import KINDS
from handtouch.simulate.grasp.episode import DURATION_S, Grasp, grasp
from handtouch.simulate.grasp.events import Events, Span, compare, joined, sampled, touches
from handtouch.simulate.grasp.patches import Patches, patches
from handtouch.simulate.grasp.scene import STEP_S
from handtouch.simulate.grasp.timeline import Encoders, Timeline
from handtouch.simulate.hand import VirtualHand
from handtouch.simulate.world import World
from handtouch.wire import PadState

FloatArray = NDArray[np.float64]
PARTS = ("pad", "mount", "kinematics", "time")
_PERIOD_NS, _JOINTS_NS, _ARRIVES_NS = 5_000_000, 10_000_000, 2_000_000
_START_NS = 1_000_000_000
_PER_TICK = 5  # steps of MuJoCo


@dataclass(frozen=True)
class Setting:
    """What is hidden from the daemon."""

    world: World
    encoders: Encoders

    @classmethod
    def usual(cls, seed: int) -> Setting:
        """Parts with tolerances, pads and encoders a little off, joint states that are late."""
        world = replace(World(seed=seed), mount_mm=0.2, mount_deg=0.5)
        return cls(world, Encoders(seed, offset_deg=0.2, noise_deg=0.05, delay_s=0.003))

    @classmethod
    def ideal(cls, seed: int) -> Setting:
        """Noise of the channels, and nothing else."""
        return cls(World.ideal_parts(seed), Encoders(seed))


@dataclass(frozen=True, eq=False)
class Served:
    """What the daemon told of a grasp: k samples of contacts with a place in the palm; lengths in metres."""

    grasp: Grasp
    patches: Patches
    step: NDArray[np.intp]
    """(k,) MuJoCo's"""
    pad: NDArray[np.intp]
    palm_m: FloatArray
    """(k, 3) as told"""
    covariance_m2: FloatArray
    """(k, 3, 3) as told"""
    true_m: FloatArray
    """(k, 3) centre of force"""
    error_m: dict[str, FloatArray]
    """(k, 3) by PARTS; they add up to palm_m - true_m"""
    force_n: FloatArray
    force_std_n: FloatArray
    """(k,) as told; NaN where the force is a lower bound"""
    true_n: FloatArray
    moving_rad_s: FloatArray
    """(k,) the fastest joint"""
    railed: int
    """samples of a pad at the end of a channel's range"""
    spans: list[list[Span]]
    """of each pad, when contacts were told"""
    percepts: list[wire.Percept]
    """what was perceived, if that was asked for"""


def served(
    deployment: Deployment,
    name: str,
    seed: int,
    setting: Setting,
    *,
    assumed_radius: bool = False,
    perceive: bool = False,
    duration_s: float = DURATION_S,
    done: Grasp | None = None,
) -> Served:
    """Let the first hand grasp, and serve it; `assumed_radius`: as if every pad were pressed by one disc of
    the radius that forces assume; `perceive`: all that there is to perceive. `done` is the grasp, if it has
    been made."""
    hand = deployment.hands[0]
    went = done or grasp(hand, name, seed, setting.world, duration_s=duration_s)
    pressed = patches(went)
    timeline = Timeline.play(went, pressed, setting.encoders)
    if assumed_radius:
        radii = [deployment.sheets[pad.sheet].contact_radius_mm * 1e-3 for pad in hand.pads]
        timeline = timeline.evenly(np.array(radii))
    virtual = VirtualHand(deployment, timeline, setting.world)
    steps = np.arange(0, len(went.times_s), _PER_TICK)
    counts = np.stack([virtual.counts(row, steps * STEP_S) for row in range(len(hand.pads))], axis=1)
    with zmq.Context() as context:
        run = _Run(deployment, context, went, setting, perceive)
        for step, now in zip(steps.tolist(), counts, strict=True):
            run.tick(step, now)
        run.inputs.close()
    railed = int((np.abs(counts) >= 32767).any(axis=2).sum())
    return _compared(deployment, went, pressed, run, railed)


class _Run:
    """The pipeline, fed tick by tick."""

    def __init__(
        self,
        deployment: Deployment,
        context: zmq.Context[Any],
        went: Grasp,
        setting: Setting,
        perceive: bool = False,
    ) -> None:
        model, robots = PadModel(deployment), Robots(deployment)
        self.kinematics = robots.kinematics[0]
        hand, names = deployment.hands[0].name, self.kinematics.joints
        self._order = np.array([went.joints.index(name) for name in names])
        self._names, self._hand, self._went = robots.joint_names[0], hand, went
        self._told, self._std = setting.encoders.read(went.position_rad), setting.encoders.std_rad
        self._clean = setting.encoders.delayed(went.position_rad)
        states, self._timely = JointStates(self._names), JointStates(self._names)
        pads = list(zip(model.hands, model.links, strict=True))
        self.inputs = Inputs(context, "tcp://127.0.0.1:*", Gate(context), {hand: states}, pads)
        self.pipeline = Pipeline(model, _PERIOD_NS, deployment.daemon.window, self, robots=robots)
        self.pipeline.node_state[:] = PadState.CLEAR
        self.pipeline.frames.joints_at = self.inputs.joints_at
        every = np.ones(model.size, np.bool_)
        wanted = Wanted(every, every, np.zeros(model.size), np.ones(model.size, np.int64), every, ~every)
        self.pipeline.want(wanted)
        self._perceiving = Perceiving(self.pipeline, self)
        if perceive:
            self._perceiving.want(wanted._replace(percepts=np.ones((len(KINDS), model.size), np.bool_)))
        self.contacts: list[wire.Contact] = []
        self.percepts: list[wire.Percept] = []
        self.used: dict[int, tuple[FloatArray, FloatArray]] = {}
        """by step: the joints that the daemon took, and what it would have taken from faultless encoders"""
        self._next_ns = 3_000_000  # the robot's clock and ours don't go together

    def wants(self, topic: str) -> bool:
        return topic.startswith(("contact/", "percept/"))

    def send(self, message: wire.Outgoing) -> None:
        if isinstance(message, wire.Contact):
            self.contacts.append(message)
        elif isinstance(message, wire.Percept):
            self.percepts.append(message)

    def tick(self, step: int, counts: NDArray[np.int64]) -> None:
        since_ns = round(step * STEP_S * 1e9)
        while self._next_ns + _ARRIVES_NS <= since_ns:
            self._tell(self._next_ns)
            self._next_ns += _JOINTS_NS
        t_ns = _START_NS + since_ns
        self.pipeline.begin(t_ns, t_ns)
        for pad, now in enumerate(counts):
            self.pipeline.slab.write(pad, now.astype("<i2").tobytes(), t_ns + 1)
        ticked = self.pipeline.advance(t_ns + 7 * _PERIOD_NS // 10)
        assert ticked is not None
        self._perceiving.step(ticked)
        self.pipeline.settle()
        if self.pipeline.frames.used:
            self.used[step] = (
                self.pipeline.frames.used[-1][2].copy(),
                self._timely.at(t_ns).position_rad,
            )

    def _tell(self, since_ns: int) -> None:
        t_ns, number = _START_NS + since_ns, round(since_ns * 1e-9 / STEP_S)
        told, clean = self._told[number, self._order], self._clean[number, self._order]
        std = np.full(len(told), self._std) if self._std else None
        topic, data = encode(JointState(self._hand, t_ns, self._names, told, None, None, std))
        self.inputs.take([topic, data], t_ns + _ARRIVES_NS)
        self._timely.take(t_ns, self._names, clean, None, std)


def against(run: Served, touch: Touch, apart_s: float) -> Events:
    """Contacts beside MuJoCo's touches at 1 kHz; breaks of either shorter than `apart_s` are none."""
    events = Events()
    for pad, told in enumerate(run.spans):
        total = run.patches.total_n[:, pad]
        true = touches(total, STEP_S, touch.on_n, touch.off_n, apart_s)
        compare(events, true, touches(total, STEP_S, 0.0, 1e-9, 0.0), joined(told, apart_s))
    return events


def at_best(run: Served, touch: Touch) -> Events:
    """Contacts beside those of pads that feel MuJoCo's forces exactly, whenever they are sampled."""
    events, period_s = Events(), _PER_TICK * STEP_S
    for pad, told in enumerate(run.spans):
        total = run.patches.total_n[::_PER_TICK, pad]
        true = sampled(total, period_s, touch.on_n, touch.off_n, touch.begin_samples)
        compare(events, true, touches(total, period_s, 0.0, 1e-9, 0.0), told, least_s=0.0)
    return events


def _compared(deployment: Deployment, went: Grasp, pressed: Patches, run: _Run, railed: int) -> Served:
    pads = deployment.hands[0].pads
    row = {pad.link: number for number, pad in enumerate(pads)}
    spans: list[list[Span]] = [[] for _ in pads]
    begun: dict[int, float] = {}
    kept: list[tuple[wire.Contact, int, int]] = []
    for contact in run.contacts:
        pad, t_s = row[contact.link], (contact.t_ns - _START_NS) * 1e-9
        step = round(t_s / STEP_S)
        if contact.event == "begin":
            begun[pad] = t_s
        elif contact.event == "end":
            spans[pad].append((begun.pop(pad), t_s))
        if contact.event != "end" and contact.palm_position_m is not None and pressed.total_n[step, pad] > 0:
            kept.append((contact, step, pad))
    for pad, t_s in begun.items():
        spans[pad].append((t_s, len(went.times_s) * STEP_S))
    places = [_split(run, went, pressed, deployment, *of) for of in kept]
    steps = np.array([step for _, step, _ in kept], np.intp)
    rows = np.array([pad for *_, pad in kept], np.intp)
    speed = np.abs(np.gradient(went.position_rad, STEP_S, axis=0)).max(axis=1)
    return Served(
        went,
        pressed,
        steps,
        rows,
        np.array([contact.palm_position_m for contact, *_ in kept]).reshape(-1, 3),
        np.array([contact.palm_covariance_m2 for contact, *_ in kept]).reshape(-1, 3, 3),
        np.array([true_m for true_m, _ in places]).reshape(-1, 3),
        {part: np.array([of[part] for _, of in places]).reshape(-1, 3) for part in PARTS},
        np.array([np.nan if c.force_n is None else c.force_n for c, *_ in kept]),
        np.array([np.nan if c.force_std_n is None else c.force_std_n for c, *_ in kept]),
        pressed.total_n[steps, rows],
        speed[steps],
        railed,
        spans,
        run.percepts,
    )


def _split(
    run: _Run,
    went: Grasp,
    pressed: Patches,
    deployment: Deployment,
    contact: wire.Contact,
    step: int,
    pad: int,
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """True place in the palm, and the error by its causes; telescoping, so that they add up to all of it."""
    kinematics, built = run.kinematics, went.pads[pad]
    rotation, offset_m = mount_of(deployment.hands[0].pads[pad])
    x, y = pressed.centre[step, pad].tolist()
    in_pad = built.shape.point(x * built.shape.length_m, y * built.shape.arc)
    true_on_link = built.rotation @ in_pad + built.translation_m
    nominal = rotation @ in_pad + offset_m
    told = np.array(contact.position_m)
    turn, origin = went.link_rotation[step, pad], went.link_m[step, pad]  # MuJoCo's
    used, timely = run.used[step]

    def by(position_rad: FloatArray) -> FloatArray:
        kinematics.move(position_rad)
        pose = kinematics.in_palm(pad)
        return np.asarray(pose.rotation @ told + pose.translation_m)

    return turn @ true_on_link + origin, {
        "pad": turn @ (told - nominal),
        "mount": turn @ (nominal - true_on_link),
        "kinematics": by(used) - by(timely),
        "time": by(timely) - (turn @ told + origin),
    }
