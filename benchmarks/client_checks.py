"""Independent check of what clients show, for soaks: nothing may contradict the truth of a simulated hand.

Public names: `Truth`, `HandCheck`, `RosCheck`, `watch_hand`, `watch_ros`, `longest_age_s`.
The truth is the scenario, played from the
first SYNC on, and the times at which the daemon died; nothing of it comes from the daemon. Rules: a pad whose
touch isn't known is shown as unknown and never as zero; a frame is no older than its limit by its own time; a
dead daemon is known within 50 ms. `python -m benchmarks.client_checks CONFIG SCENARIO FILE` simulates the
hand, and writes the time of the first SYNC into FILE.
"""

from __future__ import annotations

import argparse
import asyncio
import math
import struct
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from itertools import cycle
from pathlib import Path
from typing import Any, cast

import numpy as np

from handtouch.bridge.ros2 import messages as ros
from handtouch.bridge.ros2.conflation import Conflation
from handtouch.bridge.ros2.conversion import Stamper
from handtouch.bridge.ros2.network import RosNetwork
from handtouch.bridge.ros2.relay import TOPICS, RosRelay, relay_received
from handtouch.client import Subscriber
from handtouch.client.hand import Hand
from handtouch.client.hand_arrays import HandArrays
from handtouch.config import Deployment, load
from handtouch.host.signals import stop_on_signals
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.simulated_hand import SimulatedHand
from handtouch.simulate.worlds import WORLDS, Family

SETTLED_NS = 300_000_000
"""Time after a change of a touch until it must be shown: filters of nodes, and the detection"""
MIN_FORCE_N = 0.35
"""Force that must be noticed: twice the begin threshold of the shipped hand"""
KNOWN_DEAD_NS = 50_000_000
STARVED_NS = 10_000_000
"""Between two looks of a reader, which then had no processor: nobody else's delay counts"""
NEAR_NS = 2_000_000_000
"""Between the death of a daemon and the end of a loop because of it"""
SECOND_NS = 1_000_000_000
DELAYED_NS = 50_000_000
"""Between two looks of a reader: nodes without a processor may have sent old samples in this second"""
LATE_NS = 150_000_000
"""Between a sample and its message, beyond which nodes without processor time may have sampled later, too"""
MAX_KEPT = 50
POLL_S = 0.002
STEP_NS = 10_000_000
FORCES = struct.Struct("<6d")


def longest_age_s(deployment: Deployment) -> float:
    """Return the stated limit of a frame's age: three of the longest periods, or 50 ms."""
    period_ms = max(deployment.daemon.sync_period_ms, deployment.scene.idle_sync_period_ms)
    return max(0.05, 3e-3 * period_ms)


class Truth:
    """Touches of a scenario from the first SYNC on, and deaths of the daemon [ns, of the monotonic clock].

    `start_ns` returns the time of the first SYNC, None before it.
    """

    def __init__(self, scenario: Scenario, start_ns: Callable[[], int | None]) -> None:
        if not scenario.repeat:
            raise ValueError("the scenario must repeat")
        self._start_ns, self._duration_s = start_ns, scenario.duration_s
        self.links = sorted(set(scenario.touch_links))
        self.deaths_ns: list[int] = []
        self._shown = {link: _shown(scenario, link) for link in self.links}

    @classmethod
    def of_process(cls, scenario: Path, started: Path) -> Truth:
        """Return the truth of a hand that this module's program simulates."""
        found: list[int] = []

        def start_ns() -> int | None:
            if not found and started.exists() and (text := started.read_text()).endswith("\n"):
                found.append(int(text))
            return found[0] if found else None

        return cls(Scenario.load(scenario), start_ns)

    def is_touched(self, link: str, t_ns: int) -> bool | None:
        """Return whether a pad is touched; None around a change, for a weak touch, and before the start."""
        start_ns = self._start_ns()
        if start_ns is None or t_ns - SETTLED_NS < start_ns:
            return None
        shown, t_s = self._shown[link], 1e-9 * (t_ns - start_ns) % self._duration_s
        return shown[min(int(1e9 * t_s / STEP_NS), len(shown) - 1)]


def _shown(scenario: Scenario, link: str) -> list[bool | None]:
    """Return what must be shown of a pad in each step of a pass, which is played again and again."""
    force_n = np.zeros(round(1e9 * scenario.duration_s / STEP_NS))
    for touch in scenario.touches:
        if touch.link == link:
            steps = range(round(1e9 * touch.from_s / STEP_NS), round(1e9 * touch.until_s / STEP_NS))
            force_n[steps.start : steps.stop] += [touch.force_at(1e-9 * STEP_NS * step) for step in steps]
    # also of the next step: a frame belongs to the middle of one
    near = np.array([np.roll(force_n, shift) for shift in range(-1, SETTLED_NS // STEP_NS)])
    touched, clear = near.min(axis=0) >= MIN_FORCE_N, near.max(axis=0) == 0
    return [True if t else False if c else None for t, c in zip(touched, clear, strict=True)]


COLUMNS = (
    "reads", "frames", "wrenches", "touches compared", "no processor", "unknown", "loops ended",
)  # fmt: skip


class Found:
    """Violations by rule, the first of them as text, and how much was checked."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.checked: Counter[str] = Counter()
        self.violations: Counter[str] = Counter()
        self.texts: list[str] = []

    def add(self, rule: str, text: str) -> None:
        """Count a violation."""
        self.violations[rule] += 1
        if len(self.texts) < MAX_KEPT:
            self.texts.append(f"{self.name}, {rule}: {text}")

    def figures(self) -> dict[str, Any]:
        """Return the figures for a page."""
        checked = {name: self.checked[name] for name in COLUMNS}
        return {"client": self.name, **checked, "violations": self.violations.total()}


class HandCheck:
    """Compares what a `Hand` shows with the truth; `max_age_s`: limit of a frame's age."""

    def __init__(self, hand: Hand, truth: Truth, max_age_s: float, name: str = "Hand") -> None:
        self.hand, self.truth, self.found = hand, truth, Found(name)
        self.worst_age_s = 0.0
        self._max_age_ns = round(1e9 * max_age_s)
        self._looked_ns = time.monotonic_ns()
        self._starved_ns = self._delayed_ns = 0
        self._ends_ns: list[tuple[int, bool]] = []  # of loops; whether this process was starved then
        self._next_link = cycle(truth.links)
        self._checked: HandArrays | None = None
        self._violating: HandArrays | None = None

    def look(self) -> bool:
        """Read the newest frame and check it; return True if there is one."""
        before_ns = time.monotonic_ns()
        if before_ns - self._looked_ns > STARVED_NS:
            self._starved_ns = before_ns
        if before_ns - self._looked_ns > DELAYED_NS:
            self._delayed_ns = before_ns
        arrays = self.hand.latest()
        if arrays is not None:
            self.check(arrays, before_ns)
        self._looked_ns = before_ns
        return arrays is not None

    def _is_starved(self, now_ns: int) -> bool:
        return now_ns - self._starved_ns < KNOWN_DEAD_NS

    def check(self, arrays: HandArrays, before_ns: int) -> None:
        """Check a frame that was shown after `before_ns`."""
        self.found.checked["reads"] += 1
        self._check_time(arrays, before_ns)
        if arrays is self._checked:
            return
        self._checked = arrays
        self.found.checked["frames"] += 1
        touched, sample_ns = self.hand.touched, arrays.sample_ns
        for link in self.truth.links:
            if link in arrays.links:
                self._check_touch(link, touched.get(link), sample_ns[link])
        if (link := next(self._next_link)) in arrays.links:
            self._check_force(link)

    def _check_time(self, arrays: HandArrays, before_ns: int) -> None:
        age_ns = before_ns - arrays.t_ns
        self.worst_age_s = max(self.worst_age_s, 1e-9 * age_ns)
        died_ns = max(self.truth.deaths_ns, default=0)
        if arrays is self._violating:
            return
        violations = self.found.violations.total()
        if age_ns > self._max_age_ns:
            self.found.add("age", f"a frame of {1e-6 * age_ns:.1f} ms is shown")
        if arrays.t_ns > time.monotonic_ns() or min(self.hand.age_s.array) < 0:
            self.found.add("age", "a frame or a sample of the future is shown")
        if arrays.t_ns < died_ns < before_ns - KNOWN_DEAD_NS and not self._is_starved(before_ns):
            late_ms = 1e-6 * (before_ns - died_ns)
            self.found.add("dead", f"a frame is shown {late_ms:.0f} ms after its daemon died")
        if self.found.violations.total() > violations:
            self._violating = arrays  # it counts once

    def _check_touch(self, link: str, shown: bool | None, sample_ns: int) -> None:
        if shown is None:
            self.found.checked["unknown"] += 1
            return
        if self._looked_ns - self._delayed_ns < SECOND_NS:
            self.found.checked["no processor"] += 1
            return
        true = self.truth.is_touched(link, sample_ns)
        self.found.checked["touches compared"] += true is not None
        if true is not None and shown != true:
            words = {True: "touched", False: "clear"}
            self.found.add("touch", f"{link} is {words[true]} at {sample_ns}, shown as {words[shown]}")

    def _check_force(self, link: str) -> None:
        """Check the sums of one pad, which would hide that it is unknown."""
        shown, (force_n, _) = self.hand.touched.get(link), self.hand.total_force_n(link)
        wrench = self.hand.wrench(link, "link")
        if shown is None:
            if not math.isnan(force_n):
                self.found.add("unknown", f"{link} isn't sampled, its sum of forces is {force_n} N")
            if link not in wrench.missing:
                self.found.add("unknown", f"{link} isn't sampled, its wrench is {wrench.force_n}")
        if shown and force_n == 0:
            self.found.add("unknown", f"{link} is touched, its sum of forces is 0 N")

    async def read_loops(self) -> None:
        """Read with `latest` within `async for`, with another loop after the end of one, until cancelled."""
        while True:
            try:
                async for _ in self.hand:
                    while self.look():
                        await asyncio.sleep(POLL_S)
            except ConnectionError:
                end_ns = time.monotonic_ns()
                self._ends_ns.append((end_ns, self._is_starved(end_ns)))

    def finish(self) -> Found:
        """Check the ends of the loops, and return all that was found."""
        for died_ns in self.truth.deaths_ns:
            near = [(abs(end_ns - died_ns), end_ns - died_ns, starved) for end_ns, starved in self._ends_ns]
            distance_ns, late_ns, starved = min(near, default=(NEAR_NS, 0, True))
            if distance_ns >= NEAR_NS:
                continue  # no frame was shown at that time
            self.found.checked["loops ended"] += 1
            if late_ns > KNOWN_DEAD_NS and not starved:
                self.found.add("dead", f"a loop ended {1e-6 * late_ns:.0f} ms after the daemon died")
        return self.found


@contextmanager
def watch_hand(endpoint: str, control: str, truth: Truth, max_age_s: float) -> Iterator[HandCheck]:
    """Check what a `Hand` shows, in a thread, meanwhile."""
    stop = threading.Event()
    with Hand("right", endpoint=endpoint, control=control) as hand, ThreadPoolExecutor(1) as threads:
        check = HandCheck(hand, truth, max_age_s)
        done = threads.submit(asyncio.run, _until(stop, check.read_loops()))
        try:
            yield check
        finally:
            stop.set()
            done.result()


async def _until(stop: threading.Event, reading: Coroutine[Any, Any, None]) -> None:
    task = asyncio.ensure_future(reading)
    while not (stop.is_set() or task.done()):
        await asyncio.sleep(0.1)
    task.cancel()
    with suppress(asyncio.CancelledError):
        await task


class RosCheck:
    """Compares the wrenches that the relay to ROS 2 publishes with the truth; takes the place of DDS."""

    is_read = True

    def __init__(self, truth: Truth) -> None:
        self.truth, self.found = truth, Found("ROS 2 relay")
        self.stamper = Stamper()
        self._unknown_ns: dict[str, int] = {}
        self._looked_ns, self._delayed_ns = time.monotonic_ns(), 0

    def look(self) -> None:
        """Note the time: the relay's thread has a processor."""
        now_ns = time.monotonic_ns()
        if now_ns - self._looked_ns > DELAYED_NS:
            self._delayed_ns = now_ns
        self._looked_ns = now_ns

    def writer(self, name: str, *_: object) -> _Writer:
        """Return a topic's writer."""
        return _Writer(self if name.endswith("/wrench") else None)

    def check(self, link: str, t_ns: int, wrench: tuple[float, ...], now_ns: int) -> None:
        """Check a wrench on a link, stamped with a time of the monotonic clock."""
        self.found.checked["wrenches"] += 1
        if math.isnan(wrench[0]):
            self.found.checked["unknown"] += 1
            if self._unknown_ns.get(link, 0) >= t_ns:
                self.found.add("unknown", f"{link}: a second wrench of NaN without another sample")
            self._unknown_ns[link] = t_ns
            return
        self._unknown_ns.pop(link, None)
        delayed = now_ns - self._delayed_ns < SECOND_NS or now_ns - t_ns > LATE_NS
        self.found.checked["no processor"] += delayed
        true = None if delayed else self.truth.is_touched(link, t_ns)
        self.found.checked["touches compared"] += true is not None
        if true and not any(wrench):
            self.found.add("touch", f"{link} is touched at {t_ns}, its wrench is 0 N")
        if true is False and any(wrench):
            self.found.add("touch", f"{link} is clear at {t_ns}, its wrench is {wrench[:3]} N")
        if t_ns < max(self.truth.deaths_ns, default=0) < now_ns - KNOWN_DEAD_NS:
            self.found.add("dead", f"{link}: a wrench is published after its daemon died")


class _Writer:
    is_read = True

    def __init__(self, check: RosCheck | None) -> None:
        self._check = check

    def write(self, message: object) -> None:
        """Decode a wrench: header with stamp and frame, force, torque."""
        if self._check is None or not isinstance(message, bytes):
            return
        seconds, nanoseconds, length = struct.unpack_from("<iII", message, 4)
        link = message[16 : 16 + length - 1].decode()
        t_ns = self._check.stamper.monotonic_ns(ros.Time(seconds, nanoseconds)) or 0
        wrench = FORCES.unpack_from(message, len(message) - FORCES.size)
        self._check.check(link, t_ns, wrench, time.monotonic_ns())


@contextmanager
def watch_ros(endpoint: str, truth: Truth) -> Iterator[RosCheck]:
    """Check what the relay to ROS 2 publishes, in a thread, meanwhile."""
    stop, check = threading.Event(), RosCheck(truth)

    def run() -> None:
        relay, waiting = RosRelay(cast(RosNetwork, check), check.stamper, {}), Conflation()
        with Subscriber[Any].open(TOPICS, endpoint, 10_000, None) as source:
            while not stop.is_set():
                check.look()
                if not relay_received(source, waiting, relay, 0.02):
                    if source.has_received and not source.alive:
                        relay.end_session()
                    else:
                        relay.expire()

    thread = threading.Thread(target=run, name="checked ROS 2 relay")
    thread.start()
    try:
        yield check
    finally:
        stop.set()
        thread.join(5.0)


def main() -> int:
    """Simulate the hand of a deployment and write when its scenario began."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ("config", "scenario", "started"):
        parser.add_argument(name, type=Path)
    asked = parser.parse_args()
    deployment, scenario = load(asked.config), Scenario.load(asked.scenario)
    hand = SimulatedHand.open(
        deployment, scenario, WORLDS["ideal"].draw(Family.REPORTING.seed(0)), record=False
    )
    stop = stop_on_signals()
    hand.start()
    hand.publish_joints(deployment, scenario, deployment.daemon.inputs)
    while not stop.wait(0.05) and hand.start_ns is None:
        pass
    asked.started.write_text(f"{hand.start_ns}\n")
    stop.wait()
    hand.stop()
    return 0


if __name__ == "__main__":
    sys.exit(main())
