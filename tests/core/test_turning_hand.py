"""A hand that turns over: the skin's weight is learnt, subtracted, and no contact; light touches remain."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handtouch import config
from handtouch.config import shipped
from handtouch.config.channels import node_channels
from handtouch.core.gravity import GravityTracker
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import run_tick
from handtouch.core.slab import CountSlab, Cycle
from handtouch.core.tick import TickProcessor
from handtouch.hand import urdf
from handtouch.hand.joints import JointStateBuffer
from handtouch.hand.robot_models import RobotModels
from handtouch.simulate.base_motion import gravity_in_base
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS

LINKS = ("thumb_proximal", "index_distal", "palm_thumb")
PERIOD_S, THRESHOLDS_N = 0.01, (0.03, 0.015)
LEARNT_S, TOUCHED_S, END_S = 40.0, 43.0, 53.0
SLOW, FAST = 0.1, 1.0
TOUCH = {"link": "index_distal", "from_s": TOUCHED_S, "duration_s": 6.0, "path": [(0.5, 0.5)]}
COMMON = {"touch": [TOUCH | {"force_n": [0.1]}], "skin": {"g_per_cm2": 1.5}}
BY_BASE = {
    "turn": [
        {"from_s": 2.0, "duration_s": LEARNT_S - 2.0, "axis": [1.0, 0.3, 0.0], "rev_s": SLOW},
        {"from_s": LEARNT_S, "duration_s": END_S, "axis": [1.0, 0.3, 0.0], "rev_s": FAST},
    ]
}
_SLOW_DEG, _FAST_DEG = 360 * SLOW * (LEARNT_S - 2.0), 360 * FAST * (END_S - LEARNT_S)
BY_WRIST = {
    "joint": [
        {"joints": ["wrist"], "from_s": 2.0, "duration_s": LEARNT_S - 2.0, "position_deg": [0.0, _SLOW_DEG]},
        {
            "joints": ["wrist"],
            "from_s": LEARNT_S,
            "duration_s": END_S - LEARNT_S,
            "position_deg": [_SLOW_DEG, _SLOW_DEG + _FAST_DEG],
        },
    ]
}
JOINT_STD_RAD = 1e-3


def deployment(folder: Path, *, wrist: bool) -> config.Deployment:
    """Three pads of the shipped hand, with low thresholds; with `wrist`, a URDF whose wrist turns."""
    whole = config.load(shipped.path("utah_mit.toml"))
    begin_n, end_n = THRESHOLDS_N
    touch = whole.touch.model_copy(update={"begin_threshold_n": begin_n, "end_threshold_n": end_n})
    (hand,) = whole.hands
    pads = tuple(pad for pad in hand.pads if pad.link in LINKS)
    hand = hand.model_copy(update={"pads": pads})
    if wrist:
        turning = '<joint name="wrist" type="continuous">\\1<axis xyz="0 1 0.3"/></joint>'
        robot = shipped.path("utah_mit.urdf").read_text()
        robot, _ = re.subn('<joint name="wrist" type="fixed">(.*?)</joint>', turning, robot)
        (folder / "turning.urdf").write_text(robot)
        hand = hand.model_copy(update={"urdf": str(folder / "turning.urdf")})
    return whole.model_copy(update={"hands": (hand,), "touch": touch})


class Turned:
    """Times and links of contacts that began, and that ended, on a hand that turns by its base or wrist."""

    def __init__(self, folder: Path, *, wrist: bool, known: bool = True) -> None:
        self.settings = deployment(folder, wrist=wrist)
        self.scenario = Scenario.model_validate(COMMON | (BY_WRIST if wrist else BY_BASE))
        self.robots = RobotModels(self.settings)
        self.names = self.robots.joint_names[0]
        self.joints = JointStateBuffer(self.names, np.array([name == "wrist" for name in self.names]))
        self.down: dict[tuple[str, ...], Any] = {}
        self.began: list[tuple[float, str]] = []
        self.ended: list[tuple[float, str]] = []
        self._known, self._noise = known, np.random.default_rng(1)
        (hand,) = self.settings.hands
        self._trajectory = self.scenario.joint_trajectory(urdf.read_urdf(Path(hand.urdf or "")))
        self._run()

    def _send_state(self, t_s: float, sync_ns: int) -> None:
        """Send joints with an encoder's noise, and gravity where the base turns."""
        at = self._trajectory.positions_at(t_s) if self._trajectory else {}
        noise = JOINT_STD_RAD * self._noise.standard_normal(len(self.names))
        self.joints.add_state(
            sync_ns, self.names, np.array([at.get(name, 0.0) for name in self.names]) + noise
        )
        if self.scenario.turns:
            self.down["right", "gravity"] = np.array(
                gravity_in_base(self.scenario.turns, (0.0, 0.0, -1.0), t_s)
            )

    def _run(self) -> None:
        settings, period_ns = self.settings, round(1e9 * PERIOD_S)
        hand, model = VirtualHand(settings, self.scenario, WORLDS["default"].draw(3)), PadModel(settings)
        tracker = GravityTracker(
            self.robots,
            model.size,
            lambda _, t_ns: self.joints.interpolate(t_ns),
            lambda *key: self.down.get(key),
        )
        limits = np.array(
            [[c.limits for c in node_channels(settings.nodes[pad.node])] for _, pad in settings.pads]
        )
        tick, slab, cycle = TickProcessor(model, period_ns), CountSlab(limits), Cycle(period_ns, 0.6)
        times_s = np.arange(round(END_S / PERIOD_S)) * PERIOD_S
        counts = np.stack([hand.counts(row, times_s) for row in range(model.size)], axis=1)
        up = np.zeros(model.size, np.uint8)
        for t_s, sample in zip(times_s.tolist(), counts, strict=True):
            sync_ns = 10**9 + round(1e9 * t_s)
            if self._known:
                self._send_state(t_s, sync_ns)
                if (felt := tracker.update_felt(sync_ns)) is not None:
                    tick.baseline.set_felt_gravity(felt)
            tick.prepare_next_tick()
            slab.begin_cycle(sync_ns)
            cycle.begin_cycle(sync_ns)
            slab.store_counts(sample, sync_ns + 1000)
            result = run_tick(tick, slab, up, cycle)
            self.began += [(t_s, model.links[pad]) for pad in result.began.tolist()]
            self.ended += [(t_s, model.links[pad]) for pad in result.ended.tolist()]


@pytest.mark.parametrize("wrist", [False, True], ids=["gravity", "joints"])
def test_a_hand_that_turns_once_a_second_has_no_contact_but_the_touch(tmp_path: Path, wrist: bool) -> None:
    turned = Turned(tmp_path, wrist=wrist)
    (begin,) = turned.began
    assert begin[1] == "index_distal"
    assert begin[0] == pytest.approx(TOUCHED_S, abs=0.2)
    (end,) = turned.ended
    assert end[0] == pytest.approx(TOUCHED_S + 6.0, abs=0.2)
    assert end[1] == "index_distal"


def test_without_gravity_the_weight_of_the_skin_begins_contacts(tmp_path: Path) -> None:
    began = Turned(tmp_path, wrist=False, known=False).began
    assert len([link for _, link in began if link != "index_distal"]) > 5
