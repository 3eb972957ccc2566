"""A hand grasps a ball in MuJoCo: reported contacts agree with MuJoCo, on the links and in the palm."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from handtouch import wire
from handtouch.simulate.grasp import GRASP_OBJECTS
from handtouch.simulate.score import score_contacts
from handtouch.simulate.truth import read_records

MIN_SAMPLES = 150
"""Number of contact samples to wait for; about five pads touch at a time, at 50 Hz."""


@pytest.fixture
def grasping(rig: Any) -> Any:
    """A daemon, and nodes whose pads grasp a ball repeatedly."""
    pytest.importorskip("mujoco", reason="the extra isn't installed: pip install 'handtouch[mujoco]'")
    text = rig.config.read_text()
    scene = '[scene]\noutputs = ["position", "force", "palm"]\n\n[touch]'
    rig.config.write_text(text.replace("[touch]", scene, 1))
    rig.start("simulate", "--grasp", "ball", "--truth", str(rig.folder / "truth"))
    rig.start("run")
    return rig


def test_reported_grasp_agrees_with_mujoco_on_links_and_in_palm(grasping: Any) -> None:
    contacts: list[wire.Contact] = []
    with grasping.subscribe("contact/*/*") as messages:
        while sum(contact.palm_status == "valid" for contact in contacts) < MIN_SAMPLES:
            message = messages.recv(120)
            assert message is not None, grasping.all_printed()
            contacts.append(message)
    assert grasping.end("simulate") == 0, grasping.all_printed()
    found = score_contacts(contacts, read_records(grasping.folder / "truth"))
    assert len({contact.link for contact in contacts}) >= 4
    assert found.total.samples > MIN_SAMPLES / 2, found
    assert found.total.false_positives == 0, found
    assert found.total.median_error_m < 50e-6, found
    _check_common_centre(contacts)


def _check_common_centre(contacts: list[wire.Contact]) -> None:
    """Check that all contacts of one sample have the same centre, a radius inward from the pads."""
    radius_m = GRASP_OBJECTS["ball"].randomised(1).size_m[0]
    centres: dict[int, list[Any]] = {}
    for contact in contacts:
        if contact.event == "update" and contact.palm_position_m is not None:
            inward = np.array(contact.palm_normal)  # for the ball: out of the pad
            centres.setdefault(contact.t_ns, []).append(contact.palm_position_m + radius_m * inward)
    groups = [np.array(group) for group in centres.values() if len(group) > 2]
    assert len(groups) > 20
    spread = [np.linalg.norm(group - group.mean(axis=0), axis=1).max() for group in groups]
    assert np.median(spread) < 1e-3  # skins deform by half a millimetre
