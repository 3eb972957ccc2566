"""The checker of soaks finds what contradicts the truth, and nothing else."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq

from benchmarks import client_checks
from benchmarks.client_checks import KNOWN_DEAD_NS, SETTLED_NS, Found, HandCheck, RosCheck, Truth
from handtouch import wire
from handtouch.bridge.ros2.conversion import encode_plain_wrench
from handtouch.client.hand import Hand
from handtouch.simulate.scenario import Scenario
from tests.client.hand_messages import LINKS, make_frame

SECOND_NS = 1_000_000_000
CLEAR, TOUCHED, STALE = wire.PadState.CLEAR, wire.PadState.TOUCHED, wire.PadState.STALE
VALID = wire.ForceStatus.VALID
HELD, FREE, WEAK = LINKS
SCENARIO = f"""
repeat = true
pause_s = 0.001
[[touch]]
link = "{HELD}"
from_s = 0.0
duration_s = 200.0
path = [[0.5, 0.5]]
force_n = [1.0]
[[touch]]
link = "{FREE}"
from_s = 199.0
duration_s = 1.0
path = [[0.5, 0.5]]
force_n = [1.0]
[[touch]]
link = "{WEAK}"
from_s = 0.0
duration_s = 200.0
path = [[0.5, 0.5]]
force_n = [0.1]
"""
"""The first pad is held, the second is free, and nobody can say whether the third must be noticed"""
LONGEST_S, BELIEVED_S = 30.0, 60.0


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return Scenario.parse(SCENARIO)


@pytest.fixture
def truth(scenario: Scenario) -> Truth:
    start_ns = time.monotonic_ns() - 10 * SECOND_NS
    return Truth(scenario, lambda: start_ns)


class Bench:
    """A publisher, and a checked client that believes any frame of the last minute."""

    def __init__(self, truth: Truth, folder: str, max_age_s: float) -> None:
        self._context = zmq.Context[Any]()
        self._publisher = self._context.socket(zmq.XPUB)
        self._publisher.bind(f"ipc://{folder}/live")
        self._hand = Hand("right", endpoint=f"ipc://{folder}/live", max_age_s=BELIEVED_S)
        for _ in range(3):
            self._publisher.recv()
        self.check = HandCheck(self._hand, truth, max_age_s)
        self._seq = 0

    def show(self, t_ns: int | None = None, force_n: float = 1.0, **values: Any) -> Found:
        """Publish a frame, let the client show it, and return what the checker found."""
        t_ns, self._seq = time.monotonic_ns() if t_ns is None else t_ns, self._seq + 1
        values = {"state": (TOUCHED, CLEAR, CLEAR), "sample_ns": (t_ns,) * 3, **values}
        values |= {"force_n": (force_n,) * 3, "force_status": (VALID,) * 3}
        self._publisher.send_multipart(wire.encode(make_frame(self._seq, t_ns=t_ns, **values)))
        end_s = time.monotonic() + LONGEST_S
        while self.check.found.checked["frames"] < self._seq:
            assert time.monotonic() < end_s
            self.check.look()
        return self.check.finish()

    def close(self) -> None:
        self._hand.close()
        self._context.destroy(0)


@pytest.fixture(autouse=True)
def with_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    """The checker excuses nothing by other load of the machine."""
    for name in ("DELAYED_NS", "STARVED_NS", "LATE_NS"):
        monkeypatch.setattr(client_checks, name, 2**62)


@pytest.fixture
def bench(truth: Truth) -> Iterator[Bench]:
    with tempfile.TemporaryDirectory(prefix="ht.") as folder:
        made = Bench(truth, folder, LONGEST_S)
        yield made
        made.close()


def test_the_truth_contradicts_no_message_of_it(bench: Bench) -> None:
    for _ in range(len(LINKS)):
        found = bench.show()
    found = bench.show(state=(STALE, STALE, STALE))
    assert found.texts == []
    assert found.checked["frames"] == len(LINKS) + 1
    assert found.checked["touches compared"] == 2 * len(LINKS)
    assert found.checked["unknown"] == 3


@pytest.mark.parametrize(
    ("state", "words"), [((CLEAR, CLEAR, CLEAR), f"{HELD} is touched"), ((TOUCHED, TOUCHED, CLEAR), FREE)]
)
def test_a_touch_shown_as_clear_and_the_reverse_are_found(bench: Bench, state: Any, words: str) -> None:
    (text,) = bench.show(state=state).texts
    assert words in text


def test_a_touch_of_zero_newtons_is_found(bench: Bench) -> None:
    for _ in range(len(LINKS)):
        found = bench.show(force_n=0.0)
    (text,) = found.texts
    assert "its sum of forces is 0 N" in text


def test_a_pad_that_is_not_sampled_and_has_a_sum_is_found(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A client that shows the last force of a pad that fell silent."""
    monkeypatch.setattr(Hand, "total_force_n", lambda *_: (1.0, 0.1))
    (text,) = bench.show(state=(STALE, STALE, STALE)).texts
    assert "isn't sampled, its sum of forces is 1.0 N" in text


def test_an_old_frame_and_one_of_the_future_are_found(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = time.monotonic_ns()
    monkeypatch.setattr(Hand, "max_age_s", LONGEST_S)
    assert not bench.show(now_ns - round(0.5 * LONGEST_S * 1e9)).texts
    monkeypatch.setattr(Hand, "alive", True)  # it believes any frame, also the one before
    assert bench.show(now_ns - round(1.1 * LONGEST_S * 1e9)).violations["age"]
    assert bench.show(now_ns + 3600 * SECOND_NS).texts[-1].endswith("of the future is shown")


def test_a_frame_of_a_dead_daemon_is_found(bench: Bench, truth: Truth) -> None:
    truth.deaths_ns.append(time.monotonic_ns() + 3600 * SECOND_NS)
    assert not bench.show().texts
    end_s = time.monotonic() + LONGEST_S
    truth.deaths_ns[-1] = time.monotonic_ns()
    while not bench.check.found.violations["dead"] and time.monotonic() < end_s:
        bench.check.look()  # the publisher lives, so that the client can't know
    found = bench.check.finish()
    assert found.violations["dead"]
    assert found.violations.keys() == {"dead"}


def test_a_frame_of_the_next_daemon_is_none_of_the_dead_one(bench: Bench, truth: Truth) -> None:
    truth.deaths_ns.append(time.monotonic_ns() - 2 * KNOWN_DEAD_NS)
    assert not bench.show().texts


def test_nothing_is_known_around_a_change_and_before_the_start(scenario: Scenario) -> None:
    truth = Truth(scenario, lambda: 0)
    assert truth.is_touched(FREE, SETTLED_NS - 1) is None
    assert truth.is_touched(FREE, SETTLED_NS + 1) is False
    assert truth.is_touched(FREE, 199 * SECOND_NS + SETTLED_NS // 2) is None
    assert truth.is_touched(FREE, 199 * SECOND_NS + 2 * SETTLED_NS) is True
    assert truth.is_touched(WEAK, 100 * SECOND_NS) is None
    assert Truth(scenario, lambda: None).is_touched(HELD, SECOND_NS) is None


def test_touches_of_a_starved_second_are_not_compared(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_checks, "DELAYED_NS", -1)  # any look came late
    found = bench.show(state=(CLEAR, TOUCHED, STALE))
    assert found.violations == {}
    assert found.checked["no processor"] == 2


@pytest.mark.parametrize(
    ("link", "newtons", "words"),
    [
        ((HELD,), (0.0,), "its wrench is 0 N"),
        ((FREE,), (1.0,), "is clear"),
        ((HELD,), (math.nan, math.nan), "a second wrench of NaN"),
        ((HELD, FREE), (1.0, 0.0), ""),
        ((HELD,), (1.0, math.nan), ""),
    ],
)
def test_wrenches_that_contradict_the_truth_are_found(
    truth: Truth, link: tuple[str, ...], newtons: tuple[float, ...], words: str
) -> None:
    check = RosCheck(truth)
    check.stamper.wall_offset_ns = 1_700_000_000_000_000_123
    writer = check.writer(f"right/{link[0]}/wrench")
    now_ns = time.monotonic_ns()
    for number, force_n in enumerate(newtons):
        name = link[number % len(link)]
        writer.write(encode_plain_wrench(now_ns, name, force_n, check.stamper))
    assert [words in text for text in check.found.texts] == [True] * bool(words)
    assert check.found.checked["wrenches"] == len(newtons)


def test_a_wrench_after_the_death_of_the_daemon_is_found(truth: Truth) -> None:
    check = RosCheck(truth)
    now_ns = time.monotonic_ns()
    truth.deaths_ns.append(now_ns - 2 * KNOWN_DEAD_NS)
    check.check(HELD, now_ns - 3 * KNOWN_DEAD_NS, (1.0,) * 6, now_ns)
    check.check(FREE, now_ns - KNOWN_DEAD_NS, (0.0,) * 6, now_ns)
    check.check(FREE, now_ns - 3 * KNOWN_DEAD_NS, (math.nan,) * 6, now_ns)
    assert check.found.violations == {"dead": 1}


def test_the_truth_of_a_process_is_known_once_it_has_begun(tmp_path: Path) -> None:
    path, started = tmp_path / "scenario.toml", tmp_path / "started"
    path.write_text(SCENARIO)
    truth = Truth.of_process(path, started)
    assert truth.is_touched(HELD, 5 * SECOND_NS) is None
    started.write_text(f"{SECOND_NS}\n")
    assert truth.is_touched(HELD, 5 * SECOND_NS) is True
