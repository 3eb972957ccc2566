"""Percepts of a real daemon: no cost without subscribers; estimates and action requests with one."""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from handtouch import connect, wire
from handtouch.simulate.gripper_client import GripperClient

PERIOD_MS, LONGEST_S = 20.0, 60.0
HELD_N, SLOWLY_M_S = 0.5, 0.0004
STIFFNESS_N_M = 6000.0
"""of each side of the block"""


@pytest.fixture(scope="module")
def setup(network: list[str]) -> Iterator[Any]:
    """A gripper of two fingers and its daemon, as in the examples."""
    examples = str(Path(__file__).parents[2] / "examples")
    sys.path.insert(0, examples)
    with (
        tempfile.TemporaryDirectory(prefix="ht.") as folder,
        __import__("run_all").rig(Path(folder), network, PERIOD_MS) as options,
    ):
        yield options
    sys.path.remove(examples)


class Controller:
    """Moves the gripper, which sends its joint states, and receives the daemon's percepts."""

    def __init__(self, gripper: GripperClient, percepts: Any) -> None:
        self.gripper, self._percepts = gripper, percepts
        self.estimates: list[wire.Percept] = []
        self.requests: list[wire.Percept] = []

    def step(self, speed_m_s: float = 0.0) -> None:
        """Command both fingers once and receive pending percepts."""
        self.gripper.move(thumb=speed_m_s, index=speed_m_s)
        end_s = time.monotonic() + 0.01
        while (left_s := end_s - time.monotonic()) > 0:
            percept = self._percepts.recv(left_s)
            if percept is not None:
                (self.requests if percept.kind == "action_request" else self.estimates).append(percept)

    def press(self, force_n: float, speed_m_s: float) -> None:
        """Close, or open at a negative speed, until the block is pressed at this force."""
        end_s, sign = time.monotonic() + LONGEST_S, 1 if speed_m_s > 0 else -1
        while sign * (self.gripper.read_state().truth["index_force_n"] - force_n) < 0:
            assert time.monotonic() < end_s
            self.step(speed_m_s)

    @property
    def known(self) -> dict[str, wire.Percept]:
        """Stiffness by link."""
        return {p.link: p for p in self.estimates if p.kind == "stiffness" and p.state == "estimated"}

    def answer(self, question: str) -> int:
        """Execute requests of a question until both stiffnesses are known; return their number."""
        end_s, seen, answers = time.monotonic() + LONGEST_S, 0, 0
        while len(self.known) < 2:
            assert time.monotonic() < end_s, {(p.kind, p.link, p.question, p.reason) for p in self.estimates}
            self.step()
            fresh, seen = [p for p in self.requests[seen:] if p.question == question], len(self.requests)
            if fresh and fresh[-1].expires_ns > time.monotonic_ns():
                assert fresh[-1].label == "squeeze"
                assert fresh[-1].values["expected_information_bits"] > 0.5
                self.press(HELD_N + fresh[-1].values["force_n"], SLOWLY_M_S)
                self.press(1.2 * HELD_N, -SLOWLY_M_S)
                answers += 1
        return answers


def percept_time_s(live: str) -> float:
    """Return the time that the daemon has spent on percepts so far."""
    with connect("service", endpoint=live) as messages:
        while not isinstance(message := messages.recv(), wire.Service) or message.retained:
            pass
    return float(message.loop["stages"]["percepts"]["sum_s"])


def test_question_is_answered_by_a_squeeze_and_not_posed_again(setup: Any) -> None:
    """Percepts take no time before a client subscribes."""
    with GripperClient(setup.robot, timeout_s=LONGEST_S) as gripper:
        gripper.reset("block", equilibrium_stiffness_n_m=STIFFNESS_N_M, relaxing_stiffness_n_m=0.0)
        assert percept_time_s(setup.live) == 0.0
        with connect("percept/*/*", endpoint=setup.live, queue=100_000) as percepts:
            hand = Controller(gripper, percepts)
            hand.press(HELD_N, 0.003)
            assert hand.answer("stiffness_class") >= 1
            settled = hand.known
            for stiffness in settled.values():
                assert stiffness.values["indentation_source"] == "joints"
                values, truth = stiffness.values, STIFFNESS_N_M / 2  # two sides in series
                assert values["low_n_per_m"] / 1.1 < truth < values["high_n_per_m"] * 1.1
                assert values["stiffness_n_per_m"] == pytest.approx(
                    truth, rel=0.4
                )  # steps depend on the machine
                assert stiffness.label == "medium"
            end_ns = max(p.t_ns for p in settled.values()) + 3 * 10**9  # an request expires after 2 s
            while not hand.estimates or hand.estimates[-1].t_ns < end_ns:
                hand.step()
            for request in hand.requests:
                known = settled.get(request.link)
                if known is not None and (request.question, request.contact_id) == (
                    "stiffness_class",
                    known.contact_id,
                ):
                    assert request.t_ns <= known.t_ns
            assert {"motion", "stiffness"} <= {percept.kind for percept in hand.estimates}
        assert percept_time_s(setup.live) > 0.0
