"""The skin's weight on a hand that turns over, end to end: real daemon, nodes and joint states.

Twice, as a robot reports it: by its arm's `gravity` with the joint states, and by the joints of its URDF.
"""

from __future__ import annotations

import contextlib
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from handtouch import columns, config, wire
from handtouch.config import shipped
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS
from tests.starter import Starter

from .conftest import own_rig

TOUCHED, UNTOUCHED = "palm_heel", "thumb_proximal"
LINKS = (TOUCHED, UNTOUCHED, "palm_thumb", "index_distal")
LEARNT_S, FAST_S = 12.0, 5.0
SKIN = "[skin]\ng_per_cm2 = 1.0\n"
TOUCH = f"""
[[touch]]
link = "{TOUCHED}"
from_s = {LEARNT_S + 3}
duration_s = 40.0
path = [[0.5, 0.5]]
force_n = [0.1]
"""
BY_GRAVITY = f"""
[[turn]]
from_s = 1.0
duration_s = {LEARNT_S - 1}
axis = [1.0, 0.3, 0.0]
rev_s = 0.3

[[turn]]
from_s = {LEARNT_S}
duration_s = 120.0
axis = [1.0, 0.3, 0.0]
rev_s = 1.0
"""
BY_JOINTS = f"""
[[joint]]
joints = ["wrist"]
from_s = 1.0
duration_s = {LEARNT_S - 1}
position_deg = [0.0, 720.0]

[[joint]]
joints = ["wrist"]
from_s = {LEARNT_S}
duration_s = {4 * FAST_S}
position_deg = [720.0, {720 + 4 * 360 * FAST_S}]
"""


def prepare(rig: Any, motion: str) -> None:
    """Write the scenario, low thresholds, and a URDF whose wrist turns."""
    rig.scenario.write_text(SKIN + TOUCH + motion)
    urdf = shipped.path("utah_mit.urdf").read_text()
    urdf, changed = re.subn(
        r'<joint name="wrist" type="fixed">(.*?)</joint>',
        r'<joint name="wrist" type="continuous">\1<axis xyz="0 1 0.3"/></joint>',
        urdf,
    )
    assert changed == 1
    (rig.folder / "turning.urdf").write_text(urdf)
    head, *pads = re.split(r"(?=^\[\[hand\.pad\]\])", rig.config.read_text(), flags=re.MULTILINE)
    text = head + "".join(pad for pad in pads if any(f'link = "{link}"' in pad for link in LINKS))
    text = re.sub(r'urdf = "[^"]*"', 'urdf = "turning.urdf"', text)
    text = text.replace("begin_threshold_n = 0.06", "begin_threshold_n = 0.03")
    rig.config.write_text(text.replace("end_threshold_n = 0.03", "end_threshold_n = 0.015"))


def weight_std_counts(rig: Any) -> float:
    """Return the standard deviation of what the skin's weight does to `UNTOUCHED` in a turn, uncorrected."""
    deployment = config.load(rig.config)
    scenario = Scenario.load(rig.scenario)
    hand = VirtualHand(deployment, scenario, WORLDS["ideal"].draw(1))
    (pad,) = (one for one in hand.virtual_pads if one.pad.link == UNTOUCHED)
    times_s = LEARNT_S + 2 + np.arange(200) / 50
    return float(np.std((pad.load_currents(times_s) * pad.counts_per_ampere).sum(axis=1)))


def judge(rig: Any) -> tuple[list[str], float]:
    """Return links with contacts but the touched one, and what is left of the skin's weight on `UNTOUCHED`,
    of what it does uncorrected."""
    rig.wait_operational(len(LINKS))
    others, begin_ns, t_ns, currents = [], 0, 0, []
    with rig.subscribe("contact/*/*", "hand/*") as messages:
        while not begin_ns or t_ns - begin_ns < FAST_S * 1e9:
            message = messages.recv(90)
            assert message is not None, rig.all_printed()
            if isinstance(message, wire.HandFrame):
                t_ns = message.t_ns
                row = message.links.index(UNTOUCHED)
                if begin_ns:
                    currents.append(float(columns(message)["total_current_a"][row]))
            elif message.link != TOUCHED:
                others.append(message.link)
            elif message.event == "end":  # without samples, on a machine that is too busy for a while
                assert message.end_reason == "stale"
                begin_ns = 0
            else:
                begin_ns = begin_ns or message.t_ns
    ampere_per_count = 10e-3 / 32767
    # of turns, the one in which joint states were least late: a busy machine delays them
    left_a = min(np.std(turn) for turn in np.array_split(currents, round(FAST_S)))
    return others, float(left_a / ampere_per_count) / weight_std_counts(rig)


def test_a_hand_that_turns_over_once_a_second_has_no_contact_but_the_touch(
    tmp_path: Path, network: list[str], starter: Starter
) -> None:
    """Both hands at a time: each waits for its turns."""
    with contextlib.ExitStack() as stack:
        rigs = []
        for name, motion in (("gravity", BY_GRAVITY), ("joints", BY_JOINTS)):
            (tmp_path / name).mkdir()
            rigs.append(stack.enter_context(own_rig(tmp_path / name, network, starter)))
            prepare(rigs[-1], motion)
            rigs[-1].simulate("--world", "ideal")
            rigs[-1].start("run")
        with ThreadPoolExecutor(len(rigs)) as threads:
            judged = list(threads.map(judge, rigs))
    assert [others for others, _ in judged] == [[], []]
    assert max(left for _, left in judged) < 0.75
