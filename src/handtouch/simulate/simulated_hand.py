"""Simulated hand on the buses of a deployment, in real time: CANopen nodes that answer SYNC with samples.

Public names: `SimulatedHand`, `ScenarioClock`.
"""

from __future__ import annotations

import contextlib
import copy
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Self

import can
import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.canbus.bus.port import open_bus
from handtouch.config.base import MAX_CHANNELS
from handtouch.config.channels import node_channels, parse_object
from handtouch.config.roles import column_channels
from handtouch.device import Device, DeviceBus, Sampler
from handtouch.hand.urdf import RobotDescription
from handtouch.simulate.base_motion import base_pose
from handtouch.simulate.gripper import GripperStimulus
from handtouch.simulate.gripper_service import GripperService
from handtouch.simulate.joints import JointFeed, ReportedJoints
from handtouch.simulate.stimulus import JointTrajectory, Stimulus
from handtouch.simulate.truth import GroundTruth, TouchCounter
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import DrawnWorld


class ScenarioClock:
    """Time in a scenario, which starts at the first SYNC on any bus."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._start_ns: int | None = None

    def start_or_elapsed_s(self, sync_ns: int) -> float:
        """Return the time since the start; the first call starts the scenario."""
        with self._lock:
            if self._start_ns is None:
                self._start_ns = sync_ns
            return (sync_ns - self._start_ns) * 1e-9

    @property
    def start_ns(self) -> int | None:
        """Time of the start; None before it."""
        with self._lock:
            return self._start_ns

    def elapsed_s(self, now_ns: int) -> float:
        """Return the time since the start, 0 before it."""
        with self._lock:
            return 0.0 if self._start_ns is None else (now_ns - self._start_ns) * 1e-9


class SimulatedHand:
    """Nodes of a deployment that play a stimulus from the first SYNC on; one thread serves each bus.

    `devices` are the nodes by "hand/link", with their fault switches.
    """

    def __init__(
        self,
        buses: Sequence[_SimulatedBus],
        world: DrawnWorld,
        clock: ScenarioClock,
        resources: contextlib.ExitStack,
    ) -> None:
        self._buses, self._world, self._clock, self._resources = buses, world, clock, resources
        self.devices: dict[str, Device] = {
            name: device for bus in buses for name, device in bus.devices.items()
        }

    @classmethod
    def open(
        cls, deployment: config.Deployment, stimulus: Stimulus, world: DrawnWorld, *, record: bool = True
    ) -> Self:
        """Build the hand and open the buses of its pads; `record` keeps the ground truth of every SYNC.

        Raises ConfigError for a touch on a link without a pad, BusError for a bus that can't be opened,
        ValueError for an EDS that can't be simulated.
        """
        stimulus.check_links(entry.pad.link for entry in deployment.pads)
        clock = ScenarioClock()
        simulated: list[_SimulatedBus] = []
        used = {entry.pad.bus for entry in deployment.pads}
        buses = [bus for bus in deployment.buses if bus.name in used]
        # Solved before any bus is open: it takes a second, in which frames would queue up.
        virtual_hands = [VirtualHand(deployment, stimulus, world, bus.name) for bus in buses]
        for virtual_hand in virtual_hands:
            virtual_hand.prepare()
        with contextlib.ExitStack() as resources:
            for bus, virtual_hand in zip(buses, virtual_hands, strict=True):
                port = open_bus(bus)
                resources.callback(port.shutdown)
                simulated.append(
                    _SimulatedBus(deployment, bus.name, port, virtual_hand, clock, record, stimulus)
                )
            return cls(simulated, world, clock, resources.pop_all())

    def start(self) -> None:
        """Switch on every node."""
        for bus in self._buses:
            bus.nodes.start()

    def publish_joints(self, deployment: config.Deployment, stimulus: Stimulus, endpoint: str) -> None:
        """Start sending joint states to a daemon, if a hand has a URDF and the stimulus moves its joints."""
        if not any(hand.urdf for hand in deployment.hands):
            return

        def scenario_time_s() -> float:
            t_s = self._clock.elapsed_s(time.monotonic_ns())
            return t_s % stimulus.duration_s if stimulus.repeat else t_s

        def reported(hand: str, robot: RobotDescription) -> JointTrajectory | None:
            true = stimulus.joint_trajectory(robot)
            return ReportedJoints(true, robot, self._world, hand) if true else None

        def pose(hand: config.HandTable, t_s: float) -> dict[str, tuple[float, ...]]:
            return base_pose(stimulus.turns, hand.gravity, t_s)

        feed = JointFeed(deployment, reported, scenario_time_s, endpoint, base_pose=pose)
        feed.start()
        self._resources.callback(feed.close)

    def serve_gripper(self, stimulus: GripperStimulus, endpoint: str) -> None:
        """Start executing commands for the simulated gripper; raises ValueError as `GripperService.open`."""
        service = GripperService(stimulus.world, self._clock.elapsed_s, endpoint)
        service.open()
        self._resources.callback(service.close)

    def stop(self) -> None:
        """Switch off all nodes and close the buses; the hand can't be started again."""
        for bus in self._buses:
            bus.nodes.stop()
        self._resources.close()

    @property
    def start_ns(self) -> int | None:
        """Time of the first SYNC, at which the stimulus began; None before it."""
        return self._clock.start_ns

    @property
    def truth(self) -> list[GroundTruth]:
        """Ground truth of every SYNC since the last `pop_truth`; empty without `record`."""
        return [record for bus in self._buses for record in bus.truth()]

    def pop_truth(self) -> list[GroundTruth]:
        """Return `truth` and forget it."""
        return [record for bus in self._buses for record in bus.pop_truth()]

    @property
    def sync_times_ns(self) -> list[int]:
        """Times of the SYNCs that `truth` is about, one bus after the other."""
        return [sync_ns for bus in self._buses for sync_ns in bus.sync_times_ns]

    @property
    def sync_count(self) -> int:
        """Number of SYNCs answered, all buses together."""
        return sum(bus.nodes.sync_count for bus in self._buses)

    @property
    def skipped_syncs(self) -> int:
        """Number of SYNCs left unanswered since newer ones were waiting, all buses together."""
        return sum(bus.nodes.skipped_syncs for bus in self._buses)

    @property
    def buses_without_sync(self) -> list[str]:
        """Names of the buses that have received no SYNC yet."""
        return [bus.name for bus in self._buses if not bus.nodes.sync_count]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


class NodesOnBus:
    """The nodes of pads (hand's name, pad) on an open bus, as the deployment states them.

    `bus` hosts them, `devices` are they by "hand/link"; rows of `sample` are the pads in their order, columns
    the electrodes in that of their names.
    """

    def __init__(
        self,
        deployment: config.Deployment,
        pads: Sequence[tuple[str, config.Pad]],
        port: can.BusABC,
        sample: Sampler,
    ) -> None:
        self.bus = DeviceBus(port, sample)
        self.devices: dict[str, Device] = {}
        for hand, pad in pads:
            node = deployment.nodes[pad.node]
            channels = node_channels(node)
            device = self.bus.add(
                pad.node_id,
                eds=node.eds,
                kind=(node.vendor_id, node.product_code),
                serial=pad.serial,
                channels=tuple((c.index, c.sub) for c in channels),
                counts_per_unit=tuple(c.counts_per_unit for c in channels),
                excitation=parse_object(node.excitation_object)[:2] if node.excitation_object else None,
            )
            wired = np.argsort(column_channels(pad)).tolist()  # columns by channels
            device.wiring = (*wired, *range(len(wired), MAX_CHANNELS))
            self.devices[f"{hand}/{pad.link}"] = device


class _SimulatedBus:
    """One bus with its nodes."""

    def __init__(
        self,
        deployment: config.Deployment,
        name: str,
        port: can.BusABC,
        virtual_hand: VirtualHand,
        clock: ScenarioClock,
        record: bool,
        stimulus: Stimulus,
    ) -> None:
        self.name = name
        self.sync_times_ns: deque[int] = deque()
        self._virtual_hand, self._clock, self._record = virtual_hand, clock, record
        nodes = NodesOnBus(deployment, virtual_hand.pads, port, self._sample_at)
        self.nodes, self.devices = nodes.bus, nodes.devices
        self._touch_counter = TouchCounter()
        self._excited = [True] * len(virtual_hand.pads)
        self._events = sorted(self._node_events(stimulus), key=lambda event: event[0])

    def _node_events(self, stimulus: Stimulus) -> Iterator[tuple[float, Callable[[], None]]]:
        """Yield the times of replacements and faults of nodes, and what causes them."""
        for hand, pad in self._virtual_hand.pads:
            device = self.devices[f"{hand}/{pad.link}"]
            for replacement in stimulus.node_replacements:
                if replacement.link == pad.link and replacement.serial is not None:
                    yield replacement.at_s, partial(device.replace_device, replacement.serial)
            for fault in stimulus.node_faults:
                if fault.link == pad.link:
                    yield fault.from_s, partial(fault.begin, device)
                    if fault.until_s is not None:
                        yield fault.until_s, partial(fault.end, device)

    def truth(self) -> list[GroundTruth]:
        return self._truth_at(list(self.sync_times_ns), copy.deepcopy(self._touch_counter))

    def pop_truth(self) -> list[GroundTruth]:
        times_ns = [self.sync_times_ns.popleft() for _ in range(len(self.sync_times_ns))]
        return self._truth_at(times_ns, self._touch_counter)

    def _truth_at(self, times_ns: Sequence[int], counter: TouchCounter) -> list[GroundTruth]:
        return [
            record
            for sync_ns in times_ns
            for record in counter.number(
                self._virtual_hand.truth(self._clock.start_or_elapsed_s(sync_ns), sync_ns)
            )
        ]

    def _sample_at(self, sync_ns: int) -> NDArray[np.int64]:
        if self._record:
            self.sync_times_ns.append(sync_ns)
        elapsed_s = self._clock.start_or_elapsed_s(sync_ns)
        self._apply_node_events(elapsed_s)
        return self._virtual_hand.sample(elapsed_s)

    def _apply_node_events(self, elapsed_s: float) -> None:
        """Cause the events of nodes whose time has come, and pass switched excitation on to the sheets."""
        while self._events and elapsed_s >= self._events[0][0]:
            _, cause = self._events.pop(0)
            cause()
        for row, device in enumerate(self.devices.values()):
            if device.is_excited != self._excited[row]:
                self._excited[row] = device.is_excited
                self._virtual_hand.switch_excitation(row, elapsed_s, device.is_excited)
