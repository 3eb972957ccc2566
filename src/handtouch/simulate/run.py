"""A simulated hand on the buses of a deployment, in real time; `handtouch simulate`.

Public names: `SimulatedHand`, `run`.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Self, TextIO

import can
import numpy as np
from numpy.typing import NDArray

from handtouch import config, shipped
from handtouch.canbus.bus.port import BusError, open_bus
from handtouch.canbus.device import Device, DeviceBus
from handtouch.canbus.nodes.spec import checked
from handtouch.canbus.objects.channels import ELECTRODES, channels_of, parse
from handtouch.config.problems import ConfigError
from handtouch.signals import stop_on_signals
from handtouch.simulate import truth as truth_file
from handtouch.simulate.grasp import played as grasped
from handtouch.simulate.gripper import GripperPlay
from handtouch.simulate.gripper_service import GripperService
from handtouch.simulate.hand import VirtualHand
from handtouch.simulate.joints import JointFeed
from handtouch.simulate.play import Play
from handtouch.simulate.scenario import Scenario, Swap
from handtouch.simulate.truth import Truth
from handtouch.simulate.world import World

_SESSION = "utah_mit_session.toml"
_STATUS_EVERY_S = 5.0
_LOOK_EVERY_S = 0.5


class SimulatedHand:
    """The nodes of a deployment, playing a scenario from the first SYNC; a thread serves each bus.

    `devices` are the nodes by "hand/link", with their fault switches.
    """

    def __init__(self, stages: Sequence[_Stage], opened: contextlib.ExitStack) -> None:
        self._stages, self._opened = stages, opened
        self.devices: dict[str, Device] = {
            name: device for stage in stages for name, device in stage.devices.items()
        }

    @classmethod
    def open(
        cls, deployment: config.Deployment, scenario: Play, world: World, *, record: bool = True
    ) -> Self:
        """Build the hand and open the buses that carry its pads; `record` keeps the truth of every SYNC.

        Raises ConfigError for a touch on no pad, BusError for a bus that can't be opened, ValueError for an
        EDS that can't be simulated.
        """
        scenario.check_links(pad.link for hand in deployment.hands for pad in hand.pads)
        start = _Start()
        stages: list[_Stage] = []
        used = {pad.bus for hand in deployment.hands for pad in hand.pads}
        buses = [bus for bus in deployment.buses if bus.name in used]
        # Before any bus is open: the sheets take a second, and its frames would wait to be answered too late.
        virtuals = [VirtualHand(deployment, scenario, world, bus.name) for bus in buses]
        for virtual in virtuals:
            virtual.prepare()
        with contextlib.ExitStack() as opened:
            for bus, virtual in zip(buses, virtuals, strict=True):
                wire = open_bus(bus)
                opened.callback(wire.shutdown)
                stages.append(_Stage(deployment, bus.name, wire, virtual, start, record, scenario.swaps))
            return cls(stages, opened.pop_all())

    def start(self) -> None:
        """Plug in every node."""
        for stage in self._stages:
            stage.nodes.start()

    def tell_joints(self, deployment: config.Deployment, scenario: Play, endpoint: str) -> None:
        """Tell a daemon where the joints are, from now on, if a URDF has some and the scenario moves them."""
        if any(hand.urdf for hand in deployment.hands):
            start, round_s = self._stages[0].start, scenario.duration_s

            def since_s() -> float:
                t_s = start.peek_s(time.monotonic_ns())
                return t_s % round_s if scenario.repeat else t_s

            feed = JointFeed(deployment, scenario.moved, since_s, endpoint)
            self._opened.callback(feed.close)

    def obey(self, play: GripperPlay, endpoint: str) -> None:
        """Take commands for the gripper that is being played, from now on; ValueError as `GripperService`."""
        service = GripperService(play.world, self._stages[0].start.peek_s, endpoint)
        self._opened.callback(service.close)

    def stop(self) -> None:
        """Silence all nodes and shut the buses down, for good."""
        for stage in self._stages:
            stage.nodes.stop()
        self._opened.close()

    @property
    def truth(self) -> list[Truth]:
        """What happened at every SYNC so far; none without `record`, or taken by `take_truth`."""
        return [record for stage in self._stages for record in stage.truth(list(stage.times_ns))]

    def take_truth(self) -> list[Truth]:
        """`truth` since the last call."""
        return [record for stage in self._stages for record in stage.truth(stage.take_times())]

    @property
    def syncs(self) -> int:
        """SYNCs answered, all buses together."""
        return sum(stage.nodes.syncs for stage in self._stages)

    @property
    def without_sync(self) -> list[str]:
        """Names of the buses on which no SYNC has come yet."""
        return [stage.name for stage in self._stages if not stage.nodes.syncs]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


class _Start:
    """When the scenario began: at the first SYNC on any bus."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._t_ns: int | None = None

    def since_s(self, t_ns: int) -> float:
        with self._lock:
            if self._t_ns is None:
                self._t_ns = t_ns
            return (t_ns - self._t_ns) * 1e-9

    def peek_s(self, t_ns: int) -> float:
        """As `since_s`, 0 as long as it hasn't begun."""
        with self._lock:
            return 0.0 if self._t_ns is None else (t_ns - self._t_ns) * 1e-9


class _Stage:
    """One bus with its nodes."""

    def __init__(
        self,
        deployment: config.Deployment,
        name: str,
        bus: can.BusABC,
        virtual: VirtualHand,
        start: _Start,
        record: bool,
        swaps: Sequence[Swap],
    ) -> None:
        self.name = name
        self.times_ns: deque[int] = deque()
        self.devices: dict[str, Device] = {}
        self._virtual, self.start, self._record = virtual, start, record
        self.nodes = DeviceBus(bus, self._sample)
        for hand, pad in virtual.pads:
            node = deployment.nodes[pad.node]
            device = self.nodes.add(
                pad.node_id,
                eds=node.eds,
                vendor_id=node.vendor_id,
                product_code=node.product_code,
                serial=pad.serial,
                channels=tuple((c.index, c.sub) for c in channels_of(node.channels, node.eds)),
                excitation=parse(node.excitation)[:2] if node.excitation else None,
            )
            device.wired = tuple(map(ELECTRODES.index, pad.electrodes))
            self.devices[f"{hand}/{pad.link}"] = device
        self._excited = [True] * len(virtual.pads)
        self._swaps = [
            (swap.at_s, swap.serial, self.devices[f"{hand}/{pad.link}"])
            for swap in sorted(swaps, key=lambda swap: swap.at_s)
            for hand, pad in virtual.pads
            if pad.link == swap.link
        ]

    def truth(self, times_ns: Sequence[int]) -> list[Truth]:
        return [record for t_ns in times_ns for record in self._virtual.truth(self.start.since_s(t_ns), t_ns)]

    def take_times(self) -> list[int]:
        return [self.times_ns.popleft() for _ in range(len(self.times_ns))]

    def _sample(self, t_ns: int) -> NDArray[np.int64]:
        if self._record:
            self.times_ns.append(t_ns)
        since_s = self.start.since_s(t_ns)
        self._handle(since_s)
        return self._virtual.sample(since_s)

    def _handle(self, since_s: float) -> None:
        """Swap the nodes whose time has come, and tell the sheets of potentials that went on or off."""
        while self._swaps and since_s >= self._swaps[0][0]:
            _, serial, device = self._swaps.pop(0)
            device.swap(serial)
        for row, device in enumerate(self.devices.values()):
            if device.excited != self._excited[row]:
                self._excited[row] = device.excited
                self._virtual.switch(row, since_s, device.excited)


def run(
    config_path: Path,
    *,
    buses: tuple[str, ...] = (),
    scenario: Path | None = None,
    gripper: str | None = None,
    grasp: str | None = None,
    truth: Path | None = None,
    world: World | None = None,
    seconds: float | None = None,
    stop: threading.Event | None = None,
) -> int:
    """Simulate the nodes of a deployment until `seconds` have passed, `stop` is set, or a signal comes.

    Without `stop`, SIGINT and SIGTERM end it. Without a scenario the shipped session is played if the
    deployment has its links, else a tour over the pads; with `gripper`, an endpoint, what commands from there
    do; with `grasp`, a thing, what grasping it does, again and again. `buses` put the deployment on other
    wires, as `config.with_bus` has it. Exit status 0, 1 for a bus or file that can't be opened, 2 for a
    mistake in the deployment or scenario.
    """
    try:
        deployment = config.load(config_path)
        for other in buses:
            deployment = config.with_bus(deployment, other)
        checked(deployment, str(config_path))
        if gripper and (truth or (world and world.sheet)):
            raise ValueError(
                "--gripper can't go with --truth and --sheet: both need to know what will happen"
            )
        world = world or World.ideal_parts()
        played = (
            grasped(deployment, grasp, world, repeat=True)
            if grasp
            else _played(deployment, scenario, gripper, str(config_path))
        )
        hand = SimulatedHand.open(deployment, played, world, record=truth is not None)
    except BusError as error:
        print(error, file=sys.stderr)
        return 1
    except ValueError as error:  # ConfigError, or an EDS that can't be simulated
        print(error, file=sys.stderr)
        return 2
    with hand, contextlib.ExitStack() as stack:
        try:
            if isinstance(played, GripperPlay) and gripper:
                hand.obey(played, gripper)
        except ValueError as error:
            print(error, file=sys.stderr)
            return 1
        try:
            file = stack.enter_context(truth.open("w", encoding="utf-8")) if truth else None
        except OSError as error:
            print(f"{truth}: {error.strerror}", file=sys.stderr)
            return 1
        hand.tell_joints(deployment, played, deployment.daemon.inputs.replace("//*:", "//127.0.0.1:"))
        _play(hand, deployment, file, seconds, stop or stop_on_signals())
    return 0


def _play(
    hand: SimulatedHand,
    deployment: config.Deployment,
    file: TextIO | None,
    seconds: float | None,
    stop: threading.Event,
) -> None:
    places = ", ".join(f"{bus.name} ({bus.interface} {bus.channel})" for bus in deployment.buses)
    print(f"{len(hand.devices)} nodes on {places}; the scenario starts with the first SYNC", flush=True)
    if file:
        truth_file.write_header(file)
    hand.start()
    begin_s = time.monotonic()
    told_s, told_syncs = begin_s, 0
    while not stop.wait(_LOOK_EVERY_S if seconds is None else min(_LOOK_EVERY_S, seconds / 4)):
        now_s = time.monotonic()
        if seconds is not None and now_s - begin_s >= seconds:
            break
        if now_s - told_s >= _STATUS_EVERY_S:
            rate_hz = (hand.syncs - told_syncs) / (now_s - told_s)
            print(_status(hand, deployment, now_s - begin_s, rate_hz), flush=True)
            told_s, told_syncs = now_s, hand.syncs
    hand.stop()
    if file:  # not before: working it out would hold up the nodes
        truth_file.write(file, hand.take_truth())
    print(f"{hand.syncs} SYNCs answered", flush=True)


def _status(hand: SimulatedHand, deployment: config.Deployment, since_s: float, rate_hz: float) -> str:
    states = [device.state for device in hand.devices.values()]
    parts = [
        f"{since_s:6.0f} s",
        f"{rate_hz:5.0f} SYNC/s",
        f"{states.count('OPERATIONAL')} of {len(states)} operational",
    ]
    silent = hand.without_sync
    for sync, sender in (
        ("producer", "`handtouch run` sends it"),
        ("consumer", "somebody else must send it"),
    ):
        if names := [bus.name for bus in deployment.buses if bus.name in silent and bus.sync == sync]:
            parts.append(f'no SYNC yet: on {", ".join(names)} {sender} (sync = "{sync}")')
    return "  ".join(parts)


def _played(deployment: config.Deployment, scenario: Path | None, gripper: str | None, file: str) -> Play:
    if gripper:
        return GripperPlay.of(deployment, file)
    return Scenario.load(scenario) if scenario else _usual(deployment)


def _usual(deployment: config.Deployment) -> Scenario:
    """The shipped session where it fits, else a tour."""
    session = Scenario.load(shipped.path(_SESSION))
    with contextlib.suppress(ConfigError):
        session.check_links(pad.link for hand in deployment.hands for pad in hand.pads)
        return session.model_copy(update={"repeat": True})
    return Scenario.tour(deployment)
