"""The plug-in for LeRobot: touch in the observations of any robot. Runs where LeRobot is installed."""

from __future__ import annotations

import contextlib
import itertools
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from handtouch import wire
from handtouch.learn import TouchFeatures
from tests.client.hand_messages import LINKS, make_frame

pytest.importorskip("lerobot", reason="LeRobot isn't installed")
PACKAGE = Path(__file__).parents[2] / "clients/lerobot"


@pytest.fixture
def plug_in(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Any]:
    monkeypatch.setenv("HF_LEROBOT_CALIBRATION", str(tmp_path))
    sys.path.insert(0, str(PACKAGE))
    yield pytest.importorskip("lerobot_robot_handtouch")
    sys.path.remove(str(PACKAGE))


@contextlib.contextmanager
def publishing(publisher: Any) -> Iterator[None]:
    """Publish frames as a daemon does, until the end of the block."""
    stop = threading.Event()

    def publish() -> None:
        for seq in itertools.count(1):
            if stop.wait(0.005):
                return
            frame = make_frame(seq, t_ns=time.monotonic_ns(), state=(1, 0, 2), force_n=(2.0, np.nan, np.nan))
            publisher.send_multipart(wire.encode(frame))

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def test_touch_is_part_of_the_observations_of_another_robot(
    plug_in: Any, publisher: Any, endpoints: dict[str, str]
) -> None:
    import tests.learn.arm  # noqa: F401 - registers itself

    config = plug_in.HandtouchConfig(
        id="test",
        robot={"type": "handtouch_test_arm"},
        hand="right",
        links=list(LINKS[:2]),
        endpoint=endpoints["live"],
    )
    robot = plug_in.Handtouch(config)
    names = [f"touch.{name}" for name in TouchFeatures(LINKS[:2]).names]
    assert list(robot.observation_features) == ["joint.pos", *names]
    assert robot.action_features == {"joint.pos": float}
    with publishing(publisher):
        robot.connect()
        observation = robot.get_observation()
    assert observation["joint.pos"] == 0.5
    assert set(observation) == set(robot.observation_features)
    assert [observation[f"touch.{link}.touched"] for link in LINKS[:2]] == [1, 0]
    assert robot.send_action({"joint.pos": 0.7}) == {"joint.pos": 0.7}
    robot.disconnect()
    assert not robot.is_connected
