"""The daemon: owns buses, sockets and the clock, and drives the pipeline in one hot loop.

Public names: `Daemon`, `run`.
"""

from __future__ import annotations

import gc
import logging
import os
import select
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import zmq
from numpy.typing import NDArray

from handtouch.canbus.bus.port import BusError, Port
from handtouch.canbus.bus.router import SYNC_ID
from handtouch.canbus.bus.sync import Sync
from handtouch.canbus.nodes.master import Master
from handtouch.canbus.nodes.spec import NodeSpec, checked, node_specs
from handtouch.canbus.objects.eds import EdsError
from handtouch.config import ConfigError, Deployment, load, with_bus
from handtouch.daemon import histogram, logs, realtime
from handtouch.daemon.commands import Commands
from handtouch.daemon.control import Control
from handtouch.daemon.cycle import BusyPoll
from handtouch.daemon.gravity import Gravity
from handtouch.daemon.inputs import Inputs
from handtouch.daemon.joints import JointTeller
from handtouch.daemon.metrics import PATH, Exporter
from handtouch.daemon.model import PadModel
from handtouch.daemon.notify import Notifier, Pulse
from handtouch.daemon.pacer import Pacer
from handtouch.daemon.perceive import Perceiving
from handtouch.daemon.pipeline import Pipeline
from handtouch.daemon.publisher import Publisher
from handtouch.daemon.rehearsal import Rehearsal
from handtouch.daemon.report import Report
from handtouch.daemon.scene import Demand, Needs, Scenes, Wanted
from handtouch.daemon.security import Gate
from handtouch.daemon.supervisor import Supervisor
from handtouch.hand.joints import JointStates
from handtouch.hand.robot import Robots, served
from handtouch.keys import KeysError
from handtouch.signals import stop_on_signals
from handtouch.supervise.store import store_path

_log = logging.getLogger("handtouch.daemon")

_COLD_NS = 1_000_000
"""After a rest of that length others have had the caches: a tick would take several times as long."""
_BEFORE_SYNC_NS, _BEFORE_TICK_NS = 400_000, 250_000
"""When all is rehearsed, and the tick once more: the nearer, the more of it is still in the caches."""
_NEVER_NS = 1 << 62
_HOUSE_NS = 4_000_000
"""Least time between two looks at nodes, buses, health and requests: a tick every millisecond needn't."""
_CARRIERS = 3
"""Threads that a message goes through, each waking the next: ZeroMQ's here and there, and the subscriber."""
_GIL_SWITCH_S = 0.0005  # a thread that boots a node or builds a model lets the hot one in after so long


class Daemon:
    """A deployment at work: `open` it, `run` it in one thread until told to stop, `close` it.

    `read` reads the deployment anew when control asks for it. Raises BusError or OSError, each naming what is
    missing and a remedy, when a bus or an endpoint can't be opened; KeysError for keys that can't be used.
    `beside`: folder of the deployment's file, where its calibration store may be.
    """

    def __init__(
        self,
        deployment: Deployment,
        model: PadModel | None = None,
        read: Callable[[], Deployment] | None = None,
        beside: Path | None = None,
    ) -> None:
        self.deployment = deployment
        self._rehearse_ns = _NEVER_NS
        self._rehearsed = False  # since the last tick
        self._house_ns = 0  # when to look after the rest again
        settings = deployment.daemon
        period_ns = round(settings.sync_period_ms * 1e6)
        self._busy_poll = BusyPoll(round(settings.busy_poll_us * 1e3))
        robots = Robots(deployment)
        with ExitStack() as opened:
            self._open_endpoints(opened, robots)
            self._connect(model or PadModel(deployment), period_ns, robots)
            self.ports: dict[str, Port] = {}
            for bus in deployment.buses:
                self.ports[bus.name] = port = Port.open(bus, self.pipeline.slab)
                opened.callback(port.close)
            self._opened = opened.pop_all()
        self.master = Master(self.ports, self._specs(), period_ns)
        self.sync = Sync(list(self.ports.values()), period_ns)
        self._watch_over(beside)
        self._serve(read, period_ns, robots)

    def _open_endpoints(self, opened: ExitStack, robots: Robots) -> None:
        settings = self.deployment.daemon
        context = opened.enter_context(zmq.Context())
        self.gate = Gate(context, Path(settings.keys) if settings.keys else None)
        opened.callback(self.gate.close)
        self.publisher = Publisher(context, settings.live, settings.complete, self.gate)
        opened.callback(self.publisher.close)
        self.control = Control(context, settings.control, self.gate)
        opened.callback(self.control.close)
        self.inputs = self._open_inputs(context, robots)
        opened.callback(self.inputs.close)

    def _connect(self, model: PadModel, period_ns: int, robots: Robots) -> None:
        """From samples and what robots tell to messages."""
        publisher, inputs, window = self.publisher, self.inputs, self.deployment.daemon.window
        self.pipeline = pipeline = Pipeline(model, period_ns, window, publisher, publisher.run, robots)
        pipeline.frames.joints_at = inputs.joints_at
        inputs.refer = pipeline.told.refer
        self.joints = JointTeller(robots, inputs.joints_at, publisher)
        self.gravity = Gravity(robots, model.size, inputs.joints_at, inputs.down_at)
        self.rehearsal = Rehearsal(pipeline, publisher)
        self.perceiving = Perceiving(pipeline, publisher, publisher.run)
        self.perceiving.commands_at = inputs.commands_at
        publisher.present.update(pipeline.messages.present())
        publisher.present.update(pipeline.journal.present())
        pipeline.journal.serve(self.deployment, time.monotonic_ns())

    def _watch_over(self, beside: Path | None) -> None:
        """Nodes, buses and pads."""
        settings = self.deployment.daemon
        self.report = Report(
            self.deployment,
            self.pipeline,
            self.master,
            self.ports,
            self.sync,
            self.publisher,
            self.gate,
            self.control,
        )
        self.report.inputs = self.inputs.figures
        self.publisher.present.update(self.report.present())
        self.supervisor: Supervisor | None = None
        if settings.supervise:
            store = str(store_path(settings.store, beside))
            self.supervisor = Supervisor(self.deployment, self.pipeline, self.master, store)
            self.supervisor.rested = self._rest
            self._opened.callback(self.supervisor.close)
        self.report.supervisor = self.supervisor

    def _serve(self, read: Callable[[], Deployment] | None, period_ns: int, robots: Robots) -> None:
        """What scenes want, and control."""
        scenes = Scenes(self.deployment.scene, pad_names(self.deployment))
        self.pacer = Pacer(self.deployment, scenes.needs.pads, self.pipeline, self.master, self.sync)
        self.demand = Demand(scenes, self.publisher, 1e9 / period_ns, self._apply)
        self.demand.placeable[:] = False
        for rows in robots.rows:
            self.demand.placeable[rows] = True
        self.demand.step(time.monotonic_ns())
        commands = Commands(self.deployment, read, self.pipeline, self.report, self.demand, self.pacer)
        self.control.commands.update(commands.by_name)

    def __enter__(self) -> Daemon:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Give buses and endpoints back."""
        self._opened.close()

    def _specs(self) -> list[NodeSpec]:
        """Of all nodes; where a replacement is welcome, any serial number is that no other pad's node has."""
        specs, settings = node_specs(self.deployment), self.deployment.daemon
        if not settings.supervise or settings.another_unit == "refuse":
            return specs
        known = {spec.serial for spec in specs if spec.serial}
        return [replace(spec, serial=None, foreign=frozenset(known - {spec.serial})) for spec in specs]

    def _open_inputs(self, context: zmq.Context[zmq.Socket[bytes]], robots: Robots) -> Inputs:
        parts = zip(robots.hands, robots.joint_names, robots.kinematics, strict=True)
        states = {hand: JointStates(names, kinematics.continuous) for hand, names, kinematics in parts}
        return Inputs(context, self.deployment.daemon.inputs, self.gate, states, pad_names(self.deployment))

    def run(self, stop: threading.Event, alive: Callable[[int], None] = lambda _: None) -> None:
        """Serve until `stop` is set; `alive` is called after every tick, with the time in ns.

        At the end contacts end and nodes are stopped.
        """
        if self.supervisor is not None:
            self.supervisor.start(time.monotonic_ns())
        self.master.start(time.monotonic_ns())
        gc.collect()
        gc.freeze()
        try:
            self._loop(stop, alive)
        finally:
            now_ns = time.monotonic_ns()
            self.sync.stop()
            self.pipeline.end(now_ns)
            self.master.stop(now_ns)
            if self.supervisor is not None:
                self.supervisor.close()
            gc.unfreeze()

    def _loop(self, stop: threading.Event, alive: Callable[[int], None]) -> None:
        pipeline, cycle, ports = self.pipeline, self.pipeline.cycle, list(self.ports.values())
        by_descriptor = {port.fileno(): port for port in ports}
        descriptors = list(by_descriptor)
        queues = all(port.is_queue for port in ports)  # to look into all costs less than to wake once more
        busy_poll = self._busy_poll
        sync, pacer, master, stages = self.sync, self.pacer, self.master, self.report.stages
        pipeline.stepped = self._stepped
        sync.start(time.monotonic_ns())
        stages.start(time.monotonic_ns())
        while not stop.is_set():
            now_ns = time.monotonic_ns()
            if (sync_ns := sync.poll(now_ns)) is not None:
                self._begin(sync_ns, now_ns)
            wake_ns = min(sync.wake_ns, master.wake_ns)  # nodes may not be able to wait for a slow SYNC
            if not cycle.ticked:
                sleep_ns = busy_poll.sleep_ns(cycle.t_ns, now_ns)
                wake_ns = min(wake_ns, cycle.t_ns + cycle.window_ns, now_ns + sleep_ns)
            wait_s = max(0, min(wake_ns, self._rehearse_ns) - now_ns) * 1e-9
            readable = select.select(descriptors, (), (), wait_s)[0]
            woke_ns = time.monotonic_ns()
            stages.slept(wake_ns, woke_ns)
            # one that is gone shows nothing, and is opened again from `drain`
            every = queues or not readable or woke_ns >= self._house_ns
            self._receive(ports if every else [by_descriptor[ready] for ready in readable])
            now_ns = time.monotonic_ns()
            stages.lap(histogram.RECEIVE, now_ns)
            ticked = pipeline.advance(now_ns)
            if ticked is None and pacer.slow and pipeline.slab.fresh_count:
                ticked = pipeline.tick_now(now_ns)
            if ticked is not None:
                sent = self.publisher.release()
                sent_ns = time.monotonic_ns()
                stages.lap(histogram.SEND, sent_ns)
                self.report.ticked(now_ns, sent_ns)
                if sent:
                    self._make_way()
                busy_poll.ticked(cycle.t_ns, int(pipeline.slab.t_ns.max()))
                if self.perceiving.wanted:
                    self.perceiving.step(ticked)
                    stages.lap(histogram.PERCEIVE, time.monotonic_ns())
                self._after_tick(alive)
            elif now_ns >= master.wake_ns:
                master.poll(now_ns)
            elif now_ns >= self._rehearse_ns:
                self._rehearse()

    def _stepped(self) -> None:
        self.report.stages.lap(histogram.TICK, time.monotonic_ns())
        self.publisher.hold()

    def _make_way(self) -> None:
        """Let those run that carry and take the messages, where they wait for this very processor."""
        for _ in range(_CARRIERS):
            os.sched_yield()
        self.report.stages.lap(histogram.WAIT, time.monotonic_ns())

    def _begin(self, sync_ns: int, now_ns: int) -> None:
        """A SYNC was sent or seen: a new period."""
        self.report.stages.begin(self.sync.overruns, not self.pipeline.cycle.ticked)
        self.inputs.poll(now_ns)  # before the journal tells what the next tick starts from
        if (gravity := self.gravity.step(now_ns)) is not None:
            self.pipeline.told.turn(gravity)
        self.pipeline.begin(sync_ns, now_ns)
        self.publisher.release()
        tick_ns = self._busy_poll.expected_ns(sync_ns)
        if self._rehearsed and tick_ns - sync_ns > _COLD_NS:
            self._rehearse_ns = tick_ns - _BEFORE_TICK_NS
        self.report.stages.lap(histogram.SYNC, time.monotonic_ns())

    def _rehearse(self) -> None:
        """A SYNC is about to come, or the last samples are."""
        self._rehearse_ns = _NEVER_NS
        if self.pipeline.cycle.ticked:
            self.rehearsal.all()
            self._rehearsed = True
        else:
            self.rehearsal.tick()
        self.report.stages.lap(histogram.REHEARSE, time.monotonic_ns())

    def _receive(self, ports: list[Port]) -> None:
        for port in ports:
            for can_id, data, t_ns in port.drain():
                if can_id == SYNC_ID:
                    now_ns = time.monotonic_ns()
                    if (sync_ns := self.sync.seen(port.name, t_ns, now_ns)) is not None:
                        self._begin(sync_ns, now_ns)
                else:
                    self.master.handle(port.name, can_id, data, t_ns)

    def _apply(self, wanted: Wanted, needs: Needs, enabled: NDArray[np.bool_], now_ns: int) -> None:
        """Do what is wanted now, and no more."""
        self.pipeline.want(wanted)
        self.perceiving.want(wanted)
        self.pipeline.frames_every = self.demand.frames_every
        self._raw = needs.raw
        if self.supervisor is None:
            self.pacer.set_needs(needs.pads & enabled, needs.raw, now_ns)
        else:
            self.supervisor.needed = needs.pads & enabled
            self._rest(now_ns)
        self.report.set_disabled(self.demand.disabled_by)

    def _rest(self, now_ns: int) -> None:
        """What the scenes hold, but for the pads that rest."""
        assert self.supervisor is not None
        self.pacer.set_needs(self.supervisor.needed & ~self.supervisor.turns.resting, self._raw, now_ns)

    def _after_tick(self, alive: Callable[[int], None]) -> None:
        """What may wait until the contacts are out."""
        self._rehearsed = False
        before_sync_ns = self.pipeline.cycle.t_ns + self.sync.period_ns - _BEFORE_SYNC_NS
        lap = self.report.stages.lap
        self.pipeline.settle()
        now_ns = time.monotonic_ns()
        lap(histogram.SETTLE, now_ns)
        self.pacer.step(now_ns)
        if self.supervisor is not None:
            self.supervisor.step(now_ns)
            lap(histogram.SUPERVISE, time.monotonic_ns())
        if now_ns >= self._house_ns:
            self._house_ns = now_ns + _HOUSE_NS
            self._keep_house(now_ns)
        alive(now_ns)
        now_ns = time.monotonic_ns()
        lap(histogram.REQUESTS, now_ns)
        waited_for = self.publisher.subscriptions and before_sync_ns - now_ns > _COLD_NS
        self._rehearse_ns = before_sync_ns if waited_for else _NEVER_NS

    def _keep_house(self, now_ns: int) -> None:
        lap = self.report.stages.lap
        self.master.poll(now_ns)
        for port in self.ports.values():
            port.look(now_ns)
        lap(histogram.NODES, time.monotonic_ns())
        self.report.poll(now_ns)
        lap(histogram.REPORT, time.monotonic_ns())
        self.joints.step(now_ns)
        self.gate.poll(now_ns)
        self.publisher.take_subscriptions(now_ns)
        self.demand.step(now_ns)
        self.control.poll(now_ns)


def pad_names(deployment: Deployment) -> list[tuple[str, str]]:
    """Hand and link of every pad, in the order of the deployment."""
    return [(hand.name, pad.link) for hand in deployment.hands for pad in hand.pads]


def run(config_path: Path, buses: tuple[str, ...] = ()) -> int:
    """`handtouch run`: serve a deployment until SIGINT or SIGTERM; exit status 0, 1 (no bus), 2 (config)."""
    try:
        deployment = _read(config_path, buses)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return 2
    stop = stop_on_signals()
    said = logs.start(deployment.daemon.log_level)
    logging.getLogger("canopen").setLevel(logging.CRITICAL)  # the master tells it in words of its own
    try:
        return _serve(deployment, stop, partial(_read, config_path, buses), config_path.parent)
    finally:
        said.close()


def _read(config_path: Path, buses: tuple[str, ...]) -> Deployment:
    """The deployment in a file, with other buses; hands that don't fit their URDFs go without. Raises
    ConfigError."""
    deployment = load(config_path)
    for bus in buses:
        deployment = with_bus(deployment, bus)
    deployment = checked(deployment, str(config_path))  # a mistake must show before a bus is touched
    deployment, problems = served(deployment, str(config_path))
    for problem in problems:
        _log.error("%s: %s; until then that hand has no palm and base frame", config_path, problem)
    return deployment


def _serve(
    deployment: Deployment, stop: threading.Event, read: Callable[[], Deployment], beside: Path
) -> int:
    settings = deployment.daemon
    sys.setswitchinterval(_GIL_SWITCH_S)
    notifier = Notifier()
    with ExitStack() as opened:
        opened.callback(notifier.close)
        try:
            daemon = opened.enter_context(Daemon(deployment, read=read, beside=beside))
            if settings.metrics is not None:
                exporter = opened.enter_context(closing(Exporter(settings.metrics)))
                daemon.report.listener = exporter.take
                _log.info("metrics http://%s%s", exporter.address, PATH)
        except (KeysError, EdsError) as error:  # no restart mends it
            print(error, file=sys.stderr)
            return 2
        except (BusError, OSError) as error:
            print(error, file=sys.stderr)
            return 1
        _announce(daemon)
        for refused in realtime.apply(settings):
            _log.warning("%s", refused)
        watchdog_ns = int(os.environ.get("WATCHDOG_USEC", "0")) * 1000
        daemon.run(stop, Pulse(notifier, watchdog_ns, daemon.report.summary).ticked)
        notifier.send("STOPPING=1")
    return 0


def _announce(daemon: Daemon) -> None:
    where = ", ".join(f"{name} {endpoint}" for name, endpoint in daemon.publisher.endpoints.items())
    hands = ", ".join(f"{hand.name} ({len(hand.pads)} pads)" for hand in daemon.deployment.hands)
    buses = ", ".join(f"{bus.name} ({bus.interface} {bus.channel})" for bus in daemon.deployment.buses)
    _log.info("hand %s on bus %s", hands, buses)
    _log.info("%s, control %s", where, daemon.control.endpoint)
