"""A hand that turns over: the skin's weight is learnt, subtracted, and no contact; light touches remain."""

from __future__ import annotations

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
from handtouch.hand.joints import JointStateBuffer
from handtouch.hand.robot_models import RobotModels
from handtouch.simulate.base_motion import gravity_in_base
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS

LINKS = ("thumb_proximal", "index_distal", "palm_thumb")
PERIOD_S, THRESHOLDS_N = 0.01, (0.03, 0.015)
LEARNT_S, TOUCHED_S, END_S = 60.0, 66.0, 80.0
SLOW, FAST = 0.1, 1.0
TOUCH = {"link": "index_distal", "from_s": TOUCHED_S, "duration_s": 10.0, "path": [(0.5, 0.5)]}
SCENARIO = Scenario.model_validate(
    {
        "touch": [TOUCH | {"force_n": [0.1]}],
        "skin": {"g_per_cm2": 1.5},
        "turn": [
            {"from_s": 2.0, "duration_s": LEARNT_S - 2.0, "axis": [1.0, 0.3, 0.0], "rev_s": SLOW},
            {"from_s": LEARNT_S, "duration_s": END_S, "axis": [1.0, 0.3, 0.0], "rev_s": FAST},
        ],
    }
)


def deployment() -> config.Deployment:
    """Three pads of the shipped hand, with low thresholds."""
    whole = config.load(shipped.path("utah_mit.toml"))
    begin_n, end_n = THRESHOLDS_N
    touch = whole.touch.model_copy(update={"begin_threshold_n": begin_n, "end_threshold_n": end_n})
    (hand,) = whole.hands
    pads = tuple(pad for pad in hand.pads if pad.link in LINKS)
    hand = hand.model_copy(update={"pads": pads})
    return whole.model_copy(update={"hands": (hand,), "touch": touch})


def begun_contacts(*, gravity_known: bool) -> tuple[list[tuple[float, str]], list[tuple[float, str]]]:
    """Return times and links of contacts that began, and that ended, while the hand turns."""
    settings = deployment()
    hand, model = VirtualHand(settings, SCENARIO, WORLDS["default"].draw(3)), PadModel(settings)
    robots, period_ns = RobotModels(settings), round(1e9 * PERIOD_S)
    names = robots.joint_names[0]
    joints, down = JointStateBuffer(names), dict[str, Any]()
    tracker = GravityTracker(robots, model.size, lambda _, t_ns: joints.interpolate(t_ns), down.get)
    limits = np.array(
        [[c.limits for c in node_channels(settings.nodes[pad.node])] for _, pad in settings.pads]
    )
    tick, slab, cycle = TickProcessor(model, period_ns), CountSlab(limits), Cycle(period_ns, 0.6)
    times_s = np.arange(round(END_S / PERIOD_S)) * PERIOD_S
    counts = np.stack([hand.counts(row, times_s) for row in range(model.size)], axis=1)
    up = np.zeros(model.size, np.uint8)
    began, ended = [], []
    for t_s, sample in zip(times_s.tolist(), counts, strict=True):
        sync_ns = 10**9 + round(1e9 * t_s)
        if gravity_known:
            joints.add_state(sync_ns, names, np.zeros(len(names)))
            down["right"] = np.array(gravity_in_base(SCENARIO.turns, (0.0, 0.0, -1.0), t_s))
            if (directions := tracker.update_directions(sync_ns)) is not None:
                tick.baseline.set_gravity(directions)
        tick.prepare_next_tick()
        slab.begin_cycle(sync_ns)
        cycle.begin_cycle(sync_ns)
        slab.store_counts(sample, sync_ns + 1000)
        result = run_tick(tick, slab, up, cycle)
        began += [(t_s, model.links[pad]) for pad in result.began.tolist()]
        ended += [(t_s, model.links[pad]) for pad in result.ended.tolist()]
    return began, ended


def test_with_known_gravity_a_hand_that_turns_once_a_second_has_no_contact_but_the_touch() -> None:
    began, ended = begun_contacts(gravity_known=True)
    (begin,) = began
    assert begin[1] == "index_distal"
    assert begin[0] == pytest.approx(TOUCHED_S, abs=0.2)
    (end,) = ended
    assert end[0] == pytest.approx(TOUCHED_S + 10.0, abs=0.2)
    assert end[1] == "index_distal"


def test_without_gravity_the_weight_of_the_skin_begins_contacts() -> None:
    began, _ = begun_contacts(gravity_known=False)
    assert len([link for _, link in began if link != "index_distal"]) > 5
