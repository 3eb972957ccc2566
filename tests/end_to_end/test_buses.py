"""Several buses and hands, and SYNC of another producer; in one process, on virtual buses."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import can
import pytest

from handtouch.cli.demo import in_process_deployment
from handtouch.client import connect
from handtouch.config import Deployment, load, shipped
from handtouch.daemon.daemon import HandtouchDaemon
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.simulated_hand import SimulatedHand
from handtouch.simulate.worlds import WORLDS

PERIOD_S = 0.02
LONGEST_S = 60.0
SCENARIO = """
repeat = true
pause_s = 0.1
[[touch]]
link = "index_distal"
from_s = 0.1
duration_s = 0.6
path = [[0.3, 0.3], [0.7, 0.6]]
force_n = [1.0]
"""


def _deployment(hands: int, sync: str = "producer") -> Deployment:
    """Hands of two pads, each on a bus of its own."""
    shipped_one = load(shipped.path("utah_mit.toml"))
    links = ("index_middle", "index_distal")
    pads = [pad for pad in shipped_one.hands[0].pads if pad.link in links]
    names = ["left", "right"][:hands]
    made = shipped_one.model_copy(
        update={
            "buses": tuple(shipped_one.buses[0].model_copy(update={"name": f"can_{name}"}) for name in names),
            "hands": tuple(
                shipped_one.hands[0].model_copy(
                    update={
                        "name": name,
                        "pads": tuple(pad.model_copy(update={"bus": f"can_{name}"}) for pad in pads),
                    }
                )
                for name in names
            ),
            "daemon": shipped_one.daemon.model_copy(update={"sync_period_ms": PERIOD_S * 1e3}),
        }
    )
    made = in_process_deployment(made)
    buses = tuple(bus.model_copy(update={"sync": sync}) for bus in made.buses)
    return made.model_copy(update={"buses": buses})


@contextmanager
def _running(deployment: Deployment) -> Iterator[HandtouchDaemon]:
    stop = threading.Event()
    nodes = SimulatedHand.open(deployment, Scenario.parse(SCENARIO), WORLDS["ideal"].draw(1), record=False)
    with nodes, HandtouchDaemon.open(deployment) as daemon:
        nodes.start()
        thread = threading.Thread(target=daemon.run, args=(stop,))
        thread.start()
        try:
            yield daemon
        finally:
            stop.set()
            thread.join()


def _events(daemon: HandtouchDaemon, ends: int) -> Counter[tuple[str, str]]:
    """Count (hand, event) of contacts until `ends` have ended on every hand."""
    got: Counter[tuple[str, str]] = Counter()
    end_s = time.monotonic() + LONGEST_S
    hands = {hand.name for hand in daemon.deployment.hands}
    with connect("contact/*/*", endpoint=daemon.publisher.endpoints["live"]) as messages:
        while not all(got[hand, "released"] >= ends for hand in hands):
            assert time.monotonic() < end_s, got
            message = messages.recv(0.2)
            if message is not None:
                got[message.hand, message.end_reason or message.event] += 1
    return got


def test_one_daemon_serves_two_hands_on_two_buses() -> None:
    with _running(_deployment(hands=2)) as daemon:
        got = _events(daemon, ends=2)
        status = daemon.reporter.status(time.monotonic_ns())
    for hand in ("left", "right"):
        assert got[hand, "begin"] >= 1
        assert got[hand, "update"] > 10
    for bus in status["service"]["buses"].values():
        assert bus["samples"] > 0
        assert bus["unknown_frames"] == 0
    assert status["service"]["hands"] == {
        "left": ["index_middle", "index_distal"],
        "right": ["index_middle", "index_distal"],
    }


@pytest.mark.parametrize("hands", [1, 2])
def test_sync_of_another_producer_is_followed(hands: int) -> None:
    deployment = _deployment(hands, sync="consumer")
    stopped = threading.Event()

    def produce() -> None:
        buses: list[Any] = [can.Bus(interface="virtual", channel=bus.channel) for bus in deployment.buses]
        while not stopped.wait(PERIOD_S):
            for bus in buses:
                bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        for bus in buses:
            bus.shutdown()

    other = threading.Thread(target=produce)
    other.start()
    try:
        with _running(deployment) as daemon:
            _events(daemon, ends=2)
            before = daemon.reporter.status(time.monotonic_ns())
            _events(daemon, ends=1)
            after = daemon.reporter.status(time.monotonic_ns())
    finally:
        stopped.set()
        other.join()
    ticks = after["service"]["ticks"] - before["service"]["ticks"]
    syncs = (after["service"]["t_ns"] - before["service"]["t_ns"]) * 1e-9 / PERIOD_S
    assert 0.6 * syncs < ticks < 1.3 * syncs  # one tick per period, for any number of buses with SYNC
    for earlier, later in zip(before["pads"], after["pads"], strict=True):
        assert later["missed_samples"] - earlier["missed_samples"] < 0.2 * ticks
