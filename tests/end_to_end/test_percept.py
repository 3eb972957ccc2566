"""Perception in a real daemon: it costs nothing until somebody subscribes; then it tells, and asks."""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from handtouch import connect, wire
from handtouch.simulate.gripper_client import Gripper

PERIOD_MS, LONGEST_S = 20.0, 60.0
HELD_N, SLOWLY_M_S = 0.5, 0.0004
STIFFNESS_N_M = 6000.0
"""of each side of the block"""


@pytest.fixture(scope="module")
def asked(network: list[str]) -> Iterator[Any]:
    """A gripper of two fingers and its daemon, as the examples have them."""
    examples = str(Path(__file__).parents[2] / "examples")
    sys.path.insert(0, examples)
    with (
        tempfile.TemporaryDirectory(prefix="ht.") as folder,
        __import__("run_all").rig(Path(folder), network, PERIOD_MS) as options,
    ):
        yield options
    sys.path.remove(examples)


class Controller:
    """Moves the gripper, which tells where its joints are, and hears what the daemon perceives."""

    def __init__(self, gripper: Gripper, percepts: Any) -> None:
        self.gripper, self._percepts = gripper, percepts
        self.told: list[wire.Percept] = []
        self.asks: list[wire.Percept] = []

    def step(self, speed_m_s: float = 0.0) -> None:
        """One command to both fingers, and what has come meanwhile."""
        self.gripper.move(thumb=speed_m_s, index=speed_m_s)
        end_s = time.monotonic() + 0.01
        while (left_s := end_s - time.monotonic()) > 0:
            percept = self._percepts.recv(left_s)
            if percept is not None:
                (self.asks if percept.kind == "ask" else self.told).append(percept)

    def press(self, force_n: float, speed_m_s: float) -> None:
        """Close, or open at a speed below 0, until the block is pressed so."""
        end_s, sign = time.monotonic() + LONGEST_S, 1 if speed_m_s > 0 else -1
        while sign * (self.gripper.look().truth["index_force_n"] - force_n) < 0:
            assert time.monotonic() < end_s
            self.step(speed_m_s)

    @property
    def known(self) -> dict[str, wire.Percept]:
        """Stiffness by link."""
        return {p.link: p for p in self.told if p.kind == "hardness" and p.state == "estimated"}

    def answer(self, question: str) -> int:
        """Do what is asked to settle a question, whenever it is asked, until both pads know; how often."""
        end_s, seen, answers = time.monotonic() + LONGEST_S, 0, 0
        while len(self.known) < 2:
            assert time.monotonic() < end_s, {(p.kind, p.link, p.question, p.reason) for p in self.told}
            self.step()
            fresh, seen = [p for p in self.asks[seen:] if p.question == question], len(self.asks)
            if fresh and fresh[-1].expires_ns > time.monotonic_ns():
                assert fresh[-1].label == "squeeze"
                assert fresh[-1].values["bits"] > 0.5
                self.press(HELD_N + fresh[-1].values["force_n"], SLOWLY_M_S)
                self.press(1.2 * HELD_N, -SLOWLY_M_S)
                answers += 1
        return answers


def perceived_s(live: str) -> float:
    """Time that the daemon has spent on perception so far."""
    with connect("service", endpoint=live) as messages:
        while not isinstance(message := messages.recv(), wire.Service) or message.repeat:
            pass
    return float(message.loop["stages"]["perceive"]["sum_s"])


def test_a_question_is_asked_answered_by_a_squeeze_and_not_asked_again(asked: Any) -> None:
    """And perception costs nothing before somebody subscribes."""
    pytest.importorskip("pinocchio")  # links in the palm
    with Gripper(asked.robot, timeout_s=LONGEST_S) as gripper:
        gripper.reset("block", lasting_n_m=STIFFNESS_N_M, relaxing_n_m=0.0)
        assert perceived_s(asked.live) == 0.0
        with connect("percept/*/*", endpoint=asked.live, queue=100_000) as percepts:
            hand = Controller(gripper, percepts)
            hand.press(HELD_N, 0.003)
            assert hand.answer("how hard") >= 1
            settled = hand.known
            for hardness in settled.values():
                assert hardness.values["depth_by"] == "joints"
                told, truth = hardness.values, STIFFNESS_N_M / 2  # two sides, one after the other
                assert told["low_n_per_m"] / 1.1 < truth < told["high_n_per_m"] * 1.1
                assert told["stiffness_n_per_m"] == pytest.approx(truth, rel=0.4)  # steps are this machine's
                assert hardness.label == "medium"
            end_ns = max(p.t_ns for p in settled.values()) + 3 * 10**9  # an ask expires after 2 s
            while not hand.told or hand.told[-1].t_ns < end_ns:
                hand.step()
            for ask in hand.asks:
                known = settled.get(ask.link)
                if known is not None and (ask.question, ask.contact) == ("how hard", known.contact):
                    assert ask.t_ns <= known.t_ns
            assert {"motion", "hardness"} <= {percept.kind for percept in hand.told}
        assert perceived_s(asked.live) > 0.0
