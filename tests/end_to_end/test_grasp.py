"""A hand grasps a ball in MuJoCo: the daemon tells what MuJoCo did, on the links and in the palm."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from handtouch import wire
from handtouch.simulate.grasp import THINGS
from handtouch.simulate.score import score
from handtouch.simulate.truth import read

LEAST = 150
"""Samples of contacts that are enough; some five pads touch at a time, 50 times a second."""


@pytest.fixture
def grasping(rig: Any) -> Any:
    """The daemon, and nodes whose pads a ball presses again and again."""
    pytest.importorskip("mujoco", reason="the extra isn't here: pip install 'handtouch[mujoco]'")
    text = rig.config.read_text()
    scene = '[scene]\noutputs = ["location", "strength", "palm"]\n\n[touch]'
    rig.config.write_text(text.replace("[touch]", scene, 1))
    rig.start("simulate", "--grasp", "ball", "--truth", str(rig.folder / "truth"))
    rig.start("run")
    return rig


def test_a_grasp_is_told_as_mujoco_has_it_on_the_links_and_on_one_ball_in_the_palm(grasping: Any) -> None:
    told: list[wire.Contact] = []
    with grasping.subscribe("contact/*/*") as messages:
        while sum(contact.palm == "valid" for contact in told) < LEAST:
            message = messages.recv(120)
            assert message is not None, grasping.all_printed()
            told.append(message)
    assert grasping.end("simulate") == 0, grasping.all_printed()
    found = score(told, read(grasping.folder / "truth"))
    assert len({contact.link for contact in told}) >= 4
    assert found.total.samples > LEAST / 2, found
    assert found.total.invented == 0, found
    assert found.total.median_error_m < 50e-6, found
    _on_one_ball(told)


def _on_one_ball(told: list[wire.Contact]) -> None:
    """All contacts of one moment have the same centre, a radius in from the pads."""
    radius_m = THINGS["ball"].drawn(1).size_m[0]
    centres: dict[int, list[Any]] = {}
    for contact in told:
        if contact.event == "update" and contact.palm_position_m is not None:
            inward = np.array(contact.palm_normal)  # of the ball: out of the pad
            centres.setdefault(contact.t_ns, []).append(contact.palm_position_m + radius_m * inward)
    together = [np.array(of) for of in centres.values() if len(of) > 2]
    assert len(together) > 20
    spread = [np.linalg.norm(of - of.mean(axis=0), axis=1).max() for of in together]
    assert np.median(spread) < 1e-3  # skins give way by half a millimetre
