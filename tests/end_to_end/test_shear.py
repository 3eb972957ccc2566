"""Fingertips with shear pads: a subscriber sees force vectors of touches, with their covariances."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from handtouch import wire
from handtouch.client.hand import Hand
from handtouch.config import shipped
from handtouch.simulate.truth import read_records

MIN_SAMPLES = 25
"""Valid force vectors of each fingertip to wait for."""
FINGERTIPS = {"thumb_distal", "index_distal", "middle_distal", "ring_distal"}
PULLED = """
repeat = true
pause_s = 0.3

[[touch]]
link = "thumb_tip"
from_s = 1.6
duration_s = 0.7
path = [[0.45, 0.6]]
force_n = [3.0]
tangential_n = [[0.9, -0.5]]

[[touch]]
link = "index_tip"
from_s = 1.5
duration_s = 0.8
path = [[0.5, 0.4]]
force_n = [2.0, 3.0]
tangential_n = [[-0.2, 0.7], [0.6, 0.3]]
"""


@pytest.fixture
def pulled(rig: Any) -> Any:
    """A daemon, and the nodes of two fingertips that are pulled again and again."""
    settings = "\n".join(f'{stream} = "{endpoint}"' for stream, endpoint in rig.endpoints.items())
    text = shipped.path("shear.toml").read_text()
    text = text.replace("[daemon]\n", f"[daemon]\n{settings}\nsupervise = false\n", 1)
    text = text.replace("sync_period_ms = 10.0", "sync_period_ms = 20.0", 1)
    rig.config.write_text(text.replace("noise_counts", "heartbeat_timeout_ms = 1000\nnoise_counts", 1))
    rig.scenario.write_text(PULLED)
    rig.simulate("--world", "ideal", "--truth", str(rig.folder / "truth"))
    rig.start("run")
    return rig


@pytest.fixture
def grasping(rig: Any) -> Any:
    """A daemon, and the nodes of the shipped hand with such fingertips, which grasps a ball in MuJoCo."""
    pytest.importorskip("mujoco", reason="the extra isn't installed: pip install 'handtouch[mujoco]'")
    settings = "\n".join(f'{stream} = "{endpoint}"' for stream, endpoint in rig.endpoints.items())
    text = shipped.path("utah_mit_shear.toml").read_text()
    text = text.replace("[daemon]\n", f"[daemon]\n{settings}\nsupervise = false\n", 1)
    text = text.replace("sync_period_ms = 5.0", "sync_period_ms = 50.0", 1)
    text = text.replace("heartbeat_timeout_ms = 350", "heartbeat_timeout_ms = 1500")
    text = text.replace('"utah_mit.urdf"', f'"{shipped.path("utah_mit.urdf")}"', 1)
    rig.config.write_text(text)
    rig.start("simulate", "--grasp", "ball", "--world", "ideal", "--truth", str(rig.folder / "truth"))
    rig.start("run")
    return rig


def test_fingertips_of_a_grasping_hand_report_mujocos_tangential_forces(grasping: Any) -> None:
    contacts: list[wire.Contact] = []
    with grasping.subscribe("contact/*/*", "percept/right/friction") as messages:
        ratios = 0
        while len(contacts) < 3 * MIN_SAMPLES or not ratios:
            message = messages.recv(120)
            assert message is not None, grasping.all_printed()
            if isinstance(message, wire.Percept):
                ratios += message.state == "estimated" and "ratio" in message.values
            elif message.event == "update" and message.fresh and message.force_vector_n is not None:
                contacts.append(message)
    assert grasping.end("simulate") == 0, grasping.all_printed()
    truth = {(record.link, record.t_ns): record for record in read_records(grasping.folder / "truth")}
    times = np.array(sorted({t_ns for _, t_ns in truth}))
    errors_n, pulls_n = [], []
    for contact in contacts:
        nearest = int(times[np.abs(times - contact.t_ns).argmin()])
        if (true := truth.get((contact.link, nearest))) is None or abs(nearest - contact.t_ns) > 10_000_000:
            continue
        assert contact.force_vector_n is not None
        assert true.force_vector_n is not None
        across = np.eye(3) - np.outer(true.normal, true.normal)
        errors_n.append(across @ np.subtract(contact.force_vector_n, true.force_vector_n))
        pulls_n.append(across @ true.force_vector_n)
    assert len(errors_n) > MIN_SAMPLES
    assert {contact.link for contact in contacts} <= FINGERTIPS
    errors, pulls = np.linalg.norm(errors_n, axis=1), np.linalg.norm(pulls_n, axis=1)
    assert np.median(pulls) > 0.1
    assert np.median(errors) < 0.25 * np.median(pulls)


def test_a_subscriber_sees_the_force_vectors_of_touches(pulled: Any) -> None:
    found: dict[str, list[wire.Contact]] = {"thumb_tip": [], "index_tip": []}
    endpoints = pulled.endpoints
    with (
        pulled.subscribe("contact/*/*") as messages,
        Hand("gripper", endpoint=endpoints["live"], control=endpoints["control"]) as hand,
    ):
        frames = []
        while min(map(len, found.values())) < MIN_SAMPLES:
            contact = messages.recv(90)
            assert contact is not None, pulled.all_printed()
            if contact.force_vector_status == "valid" and contact.event == "update" and contact.fresh:
                found[contact.link].append(contact)
                frames.append(hand.latest())
    assert pulled.end("simulate") == 0, pulled.all_printed()
    truth = list(read_records(pulled.folder / "truth"))
    for link, contacts in found.items():
        errors_n, sigmas = [], []
        for contact in contacts:
            # a node of a busy machine may have answered one SYNC late
            near = [one for one in truth if one.link == link and abs(one.t_ns - contact.t_ns) < 25_000_000]
            if not near:
                continue
            assert contact.force_vector_covariance_n2 is not None
            covariance = np.array(contact.force_vector_covariance_n2).reshape(3, 3)
            assert contact.force_vector_n is not None
            errors = [np.subtract(contact.force_vector_n, one.force_vector_n or np.nan) for one in near]
            errors_n.append(min(errors, key=np.linalg.norm))
            sigmas.append(np.sqrt(errors_n[-1] @ np.linalg.solve(covariance, errors_n[-1])))
        assert len(errors_n) > MIN_SAMPLES / 2
        assert np.abs(errors_n)[:, :2].max() < 0.1  # of 0.9 N: a pad without errors, but for noise
        assert np.median(sigmas) < 1.0
    vectors = [arrays.force_vector_n for arrays in frames if arrays is not None]
    assert any(np.isfinite(column["thumb_tip"]).all() for column in vectors)
