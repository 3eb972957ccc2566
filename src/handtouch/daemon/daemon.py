"""The daemon: opens buses and endpoints, reads the clock, and runs the pipeline in one loop.

Public name: `HandtouchDaemon`. `handtouch.daemon.serve` runs it as a service.
"""

from __future__ import annotations

import gc
import logging
import os
import secrets
import select
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import zmq
from numpy.typing import NDArray

from handtouch import wire
from handtouch.calibration.store_path import store_path
from handtouch.canbus import cia301
from handtouch.canbus.bus.loop_pause import LoopPause
from handtouch.canbus.bus.port import Port
from handtouch.canbus.bus.sync import Sync
from handtouch.canbus.nodes.master import Master
from handtouch.canbus.nodes.spec import NodeSpec, node_specs, sync_overflows
from handtouch.config import Deployment
from handtouch.config.files import deployment_files
from handtouch.core.columns import TickResult
from handtouch.core.compiled import Compilation
from handtouch.core.gravity import GravityTracker
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.core.scene import (
    ActiveScenes,
    Demand,
    RequestedOutputs,
    SceneRequirements,
)
from handtouch.daemon import stage_timer
from handtouch.daemon.authentication import Authenticator
from handtouch.daemon.busy_poll import BusyPoll
from handtouch.daemon.commands import ControlCommands
from handtouch.daemon.control import ControlServer, open_control_socket
from handtouch.daemon.endpoints import remove_socket_file
from handtouch.daemon.inputs import InputReceiver
from handtouch.daemon.joint_messages import JointPublisher
from handtouch.daemon.percepts import PerceptPublisher
from handtouch.daemon.publisher import Publisher, RetainedMessages
from handtouch.daemon.sampling import SamplingController
from handtouch.daemon.status_reporter import Buses, Statistics, StatusReporter, Workers
from handtouch.daemon.supervisor_client import SupervisorClient
from handtouch.daemon.table_cache import build_pad_model
from handtouch.hand.joints import JointStateBuffer
from handtouch.hand.robot_models import RobotModels
from handtouch.host.build import build_info
from handtouch.host.closing import Closing
from handtouch.host.installation import compile_command
from handtouch.host.machine import process_statistics

_log = logging.getLogger("handtouch.daemon")

_BACKGROUND_PERIOD_NS = 9_000_000
"""Least period of polling nodes, buses, health and requests; two ticks at 200 Hz, more at higher rates"""
_UNHURRIED_BACKGROUND_PERIOD_NS = 19_000_000
"""The same, and of polling inputs, while nobody waits for ticks: a subscriber is served four ticks later"""
_UNHURRIED_PREFIXES = (wire.HEALTH.prefix.encode(), wire.SERVICE.prefix.encode())
"""Topics whose subscribers wait for no tick"""
_LOGGED_PAUSE_NS = 100_000_000
_MESSAGE_PATH_THREADS = 3
"""Threads that a message passes, each waking the next: ZeroMQ's on both sides, and the subscriber's"""
_SESSION_BITS = 53  # exact where numbers are doubles


@dataclass(frozen=True)
class _Resources:
    """Endpoints, buses and pipeline of a daemon, and the stack that closes them."""

    stack: ExitStack
    authenticator: Authenticator
    publisher: Publisher
    retained_messages: RetainedMessages
    control_socket: tuple[zmq.Socket[bytes], str]
    inputs: InputReceiver
    pipeline: Pipeline
    ports: dict[str, Port]


class HandtouchDaemon(Closing):
    """The running service of a deployment: `open` it, `run` it in one thread, `close` it.

    `read` reads the deployment file again for the command `reload`. `folder` is the deployment file's, where
    the calibration store is by default. `on_message` gets every health and service message.
    """

    def __init__(
        self,
        deployment: Deployment,
        resources: _Resources,
        robots: RobotModels,
        now_ns: int,
        read: Callable[[], Deployment] | None = None,
        folder: Path | None = None,
        on_message: Callable[[wire.Health | wire.Service], None] | None = None,
    ) -> None:
        self.deployment = deployment
        self.authenticator, self.publisher = resources.authenticator, resources.publisher
        self.inputs, self.ports, self.pipeline = resources.inputs, resources.ports, resources.pipeline
        self._stack = resources.stack
        self._next_background_ns = 0
        self._subscribed = False
        self._hurried = True
        """somebody waits for ticks or for nodes that boot; else the samples of a tick are read all at once"""
        self._sent_ns = 0  # when the last tick's messages were sent
        settings, pipeline, inputs, publisher = deployment.daemon, self.pipeline, self.inputs, self.publisher
        period_ns, session = pipeline.cycle.period_ns, publisher.session
        self._busy_poll = BusyPoll(round(settings.busy_poll_us * 1e3))
        pipeline.transforms.joints_at = inputs.joints_at
        self.joint_publisher = JointPublisher(robots, inputs.sent_joints_at, publisher, session)
        self.gravity = GravityTracker(robots, pipeline.model.size, inputs.joints_at, inputs.base_pose)
        self.percepts = PerceptPublisher(deployment, pipeline, publisher, session)
        self._stack.callback(self.percepts.close)
        self.master = Master(self.ports, self._node_specs(), period_ns)
        self.sync = Sync(list(self.ports.values()), period_ns, sync_overflows(deployment))
        self.supervisor = self._build_supervisor(folder)
        self.reporter = StatusReporter(
            deployment,
            pipeline,
            Buses(self.master, self.ports, self.sync),
            publisher,
            started_ns=now_ns,
            statistics=Statistics(
                wall_offset_ns=lambda: time.time_ns() - time.monotonic_ns(),
                process=process_statistics,
                refusals=self._refusals,
                inputs=inputs.statistics,
            ),
            workers=Workers(self.supervisor, self.percepts.client),
            on_message=on_message,
        )
        scenes = ActiveScenes(deployment.scene, pad_names(deployment))
        self.sampling = SamplingController(
            deployment, scenes.requirements.pads, pipeline, self.master, self.sync
        )
        self.demand = Demand(scenes, publisher, 1e9 / period_ns, self._apply_demand)
        self.demand.transformable[:] = False
        for rows in robots.pad_rows:
            self.demand.transformable[rows] = True
        commands = ControlCommands(deployment, read, pipeline, self.reporter, self.demand, self.sampling)
        self.control = ControlServer(
            *resources.control_socket, self.authenticator, commands.by_name, commands.jobs
        )
        self._stack.callback(self.control.close)
        for source in (pipeline.messages, pipeline.journal, self.reporter):
            resources.retained_messages.update(source.retained_messages())
        files = deployment_files(deployment)
        pipeline.journal.publish_config(deployment, files, build_info(), now_ns)
        self.demand.update(now_ns)
        for endpoint in (*publisher.endpoints.values(), self.control.endpoint, inputs.endpoint):
            self._stack.callback(remove_socket_file, endpoint)

    @classmethod
    def open(
        cls,
        deployment: Deployment,
        model: PadModel | None = None,
        read: Callable[[], Deployment] | None = None,
        folder: Path | None = None,
        on_message: Callable[[wire.Health | wire.Service], None] | None = None,
    ) -> HandtouchDaemon:
        """Open endpoints and buses.

        Raises BusError or OSError naming what can't be opened and a remedy, KeyFileError for unusable keys.
        """
        robots = RobotModels(deployment)
        with ExitStack() as stack:
            resources = _open_resources(stack, deployment, model or build_pad_model(deployment), robots)
            daemon = cls(deployment, resources, robots, time.monotonic_ns(), read, folder, on_message)
            stack.pop_all()
        return daemon

    def close(self) -> None:
        """Close buses and endpoints."""
        self._stack.close()

    def _node_specs(self) -> list[NodeSpec]:
        """Return the specs of all nodes; if replacing nodes is allowed, without serial numbers."""
        specs, settings = node_specs(self.deployment), self.deployment.daemon
        if not settings.supervise or settings.on_node_replaced == "refuse":
            return specs
        return [replace(spec, serial=None) for spec in specs]

    def _build_supervisor(self, folder: Path | None) -> SupervisorClient | None:
        settings = self.deployment.daemon
        if not settings.supervise:
            return None
        supervisor = SupervisorClient(
            self.deployment,
            self.pipeline,
            self.master,
            str(store_path(self.deployment, folder).absolute()),
            on_excitation_changed=self._apply_excitation,
        )
        self._stack.callback(supervisor.close)
        return supervisor

    def _refusals(self) -> dict[str, int]:
        return {
            **self.authenticator.refused,
            **self.publisher.refused,
            "request": self.control.refused,
        }

    def run(self, stop: threading.Event, on_tick: Callable[[int], None] = lambda _: None) -> None:
        """Serve until `stop` is set, then end all contacts and stop the nodes.

        `on_tick` is called after every tick with the time [ns].
        """
        if self.supervisor is not None:
            self.supervisor.start(time.monotonic_ns())
        self.master.start(time.monotonic_ns())
        compilation = Compilation.current()
        if not compilation.compiled:
            remedy = compilation.remedy or compile_command()
            text = "core: uncompiled, some fifty times slower per contact: %s; %s"
            _log.warning(text, compilation.reason, remedy)
        gc.collect()
        gc.freeze()
        try:
            self._loop(stop, on_tick)
        finally:
            now_ns = time.monotonic_ns()
            self.publisher.release()
            self.reporter.publish_stopping(now_ns)
            self.sync.stop()
            self.pipeline.end_session(now_ns)
            self.master.stop(now_ns)
            if self.supervisor is not None:
                self.supervisor.close()
            self.percepts.close()
            gc.unfreeze()

    def _loop(self, stop: threading.Event, on_tick: Callable[[int], None]) -> None:
        pipeline, cycle, ports = self.pipeline, self.pipeline.cycle, list(self.ports.values())
        by_descriptor = {port.fileno(): port for port in ports}
        descriptors = list(by_descriptor)
        # with local queues, draining all ports costs less than another wake-up
        queues = all(port.has_local_queue for port in ports)
        busy_poll = self._busy_poll
        sync, sampling, master, stages = self.sync, self.sampling, self.master, self.reporter.stage_timer
        pipeline.on_tick_computed = self._on_tick_computed
        pipeline.on_messages_queued = self._on_messages_queued
        pause = LoopPause(sync.period_ns)
        sync.start(time.monotonic_ns())
        stages.start(time.monotonic_ns())
        while not stop.is_set():
            now_ns = time.monotonic_ns()
            wake_ns = min(sync.wake_ns, master.wake_ns)  # node time-outs may come before a slow SYNC
            watched = descriptors
            if not cycle.ticked:
                if self._hurried:
                    sleep_ns = busy_poll.max_sleep_ns(cycle.sync_ns, now_ns)
                    wake_ns = min(wake_ns, cycle.sync_ns + cycle.window_ns, now_ns + sleep_ns)
                else:  # one wake-up reads all samples: with the loop's own SYNC that sends the next one
                    watched = []
                    if not sync.is_timed:
                        wake_ns = min(wake_ns, cycle.sync_ns + cycle.window_ns)
            wait_s = max(0, wake_ns - now_ns) * 1e-9
            pause.begin_wait(now_ns)
            readable = select.select(watched, (), (), wait_s)[0]
            woke_ns = time.monotonic_ns()
            stages.record_wait(wake_ns, woke_ns)
            if paused_ns := pause.end_wait(wake_ns, woke_ns):
                self._excuse_pause(paused_ns, woke_ns)
            # when a timeout is due, all frames are read first; a disconnected port is never readable, and
            # `drain` reopens it
            drain_all = queues or not readable or woke_ns >= min(wake_ns, self._next_background_ns)
            self._receive_frames(ports if drain_all else [by_descriptor[ready] for ready in readable])
            now_ns = time.monotonic_ns()
            stages.lap(stage_timer.RECEIVE, now_ns)
            if paused_ns := pause.end_receive(now_ns):
                self._excuse_pause(paused_ns, now_ns)
            for sync_ns in sync.poll(now_ns, self._received_until_ns):
                self._begin_cycle(sync_ns, now_ns, on_tick)
            ticked = pipeline.tick_if_due(now_ns)
            if ticked is None and sampling.slow_sync and pipeline.slab.fresh_count:
                ticked = pipeline.tick_without_sync(now_ns)
            if ticked is not None:
                self.reporter.record_tick(now_ns, self._sent_ns)
                busy_poll.update_usual_latency(cycle.sync_ns, int(pipeline.slab.arrival_ns.max()))
                self._complete_tick(ticked, on_tick)
            elif now_ns >= master.wake_ns:
                master.poll(self._received_until_ns)

    def _on_tick_computed(self) -> None:
        self.reporter.stage_timer.lap(stage_timer.TICK, time.monotonic_ns())
        self.publisher.hold()

    def _on_messages_queued(self) -> None:
        sent = self.publisher.release()
        self._sent_ns = time.monotonic_ns()
        self.reporter.stage_timer.lap(stage_timer.SEND, self._sent_ns)
        if sent:
            self._yield_processor()

    def _process_percepts(self, ticked: TickResult) -> None:
        if self.percepts.enabled:
            now_ns = time.monotonic_ns()
            self.percepts.process_tick(ticked, now_ns)
            self.reporter.stage_timer.lap(stage_timer.PERCEIVE, time.monotonic_ns())

    def _yield_processor(self) -> None:
        """Let the threads run that transport messages, if they wait for this CPU."""
        for _ in range(_MESSAGE_PATH_THREADS):
            os.sched_yield()
        self.reporter.stage_timer.lap(stage_timer.WAIT, time.monotonic_ns())

    def _begin_cycle(self, sync_ns: int, now_ns: int, on_tick: Callable[[int], None]) -> None:
        """Begin a cycle at a SYNC that was sent or received.

        The previous tick comes first if it is still due, as every tick is where the machine is too slow, or
        where nobody waits for it.
        """
        hurried = self._hurried
        unticked = hurried and not self.pipeline.cycle.ticked
        self.reporter.stage_timer.begin_period(self.sync.overruns, unticked)
        if hurried or now_ns >= self._next_background_ns:
            self.inputs.poll(now_ns)
        if (felt := self.gravity.update_felt(now_ns)) is not None:
            self.pipeline.set_felt_gravity(felt)
        if (late := self.pipeline.finish_cycle(sync_ns, now_ns)) is not None:
            if not hurried:
                self.reporter.record_tick(now_ns, self._sent_ns, due_periods=2)
            self._complete_tick(late, on_tick)
        self.pipeline.begin_cycle(sync_ns, now_ns)
        self.reporter.stage_timer.lap(stage_timer.SYNC, time.monotonic_ns())

    def _receive_frames(self, ports: list[Port]) -> None:
        for port in ports:
            for can_id, data, arrival_ns in port.drain():
                if can_id == cia301.SYNC:
                    self.sync.handle_sync(port.name, arrival_ns)
                else:
                    self.master.handle_frame(port.name, can_id, data, arrival_ns)

    @property
    def _received_until_ns(self) -> int:
        """Time before which all frames that arrived have been handled."""
        return min(port.received_until_ns for port in self.ports.values())

    def _excuse_pause(self, paused_ns: int, now_ns: int) -> None:
        """Extend timeouts by a pause of this loop, in which it may have sent no SYNC and read no frame."""
        self.sync.excuse_pause(paused_ns)
        self.master.excuse_pause(paused_ns, now_ns)
        if paused_ns > _LOGGED_PAUSE_NS:
            late_ms = (paused_ns + self.sync.period_ns) * 1e-6
            _log.warning("the loop was late by %.0f ms; timeouts of nodes and pads are extended", late_ms)

    def _apply_demand(
        self, requested: RequestedOutputs, needs: SceneRequirements, enabled: NDArray[np.bool_], now_ns: int
    ) -> None:
        """Apply the outputs that scenes and subscriptions request."""
        self._subscribed = not all(
            prefix.startswith(_UNHURRIED_PREFIXES) for prefix in self.publisher.subscriptions
        )
        self.pipeline.apply_demand(requested, self.demand.ticks_per_hand_frame)
        self.percepts.set_requested(requested, now_ns)
        self._raw_pads = needs.raw
        if self.supervisor is None:
            self.sampling.set_needed_pads(needs.pads & enabled, needs.raw, now_ns)
        else:
            self.supervisor.set_needed_pads(needs.pads & enabled)
            self._apply_excitation(now_ns)
        self.reporter.set_disabled(self.demand.disabled_by)

    def _apply_excitation(self, now_ns: int) -> None:
        """Sample the pads that scenes need and whose excitation is on."""
        assert self.supervisor is not None
        self.sampling.set_needed_pads(self.supervisor.active_pads, self._raw_pads, now_ns)

    def _complete_tick(self, ticked: TickResult, on_tick: Callable[[int], None]) -> None:
        """Do what can wait until the contacts are sent."""
        self._process_percepts(ticked)
        lap = self.reporter.stage_timer.lap
        self.pipeline.prepare_next_tick()
        now_ns = time.monotonic_ns()
        lap(stage_timer.SETTLE, now_ns)
        self.sampling.update_sampling(now_ns)
        if self.supervisor is not None:
            self.supervisor.process_tick(now_ns)
            lap(stage_timer.SUPERVISE, time.monotonic_ns())
        if now_ns >= self._next_background_ns:
            self._run_background_tasks(now_ns)
            period_ns = _BACKGROUND_PERIOD_NS if self._hurried else _UNHURRIED_BACKGROUND_PERIOD_NS
            self._next_background_ns = now_ns + period_ns
        on_tick(now_ns)
        lap(stage_timer.REQUESTS, time.monotonic_ns())

    def _run_background_tasks(self, now_ns: int) -> None:
        lap = self.reporter.stage_timer.lap
        for port in self.ports.values():  # first: the master names a bus's problem as the cause of a node's
            port.update_state(now_ns)
        self.master.poll(self._received_until_ns)
        lap(stage_timer.NODES, time.monotonic_ns())
        self.reporter.poll(now_ns)
        lap(stage_timer.REPORT, time.monotonic_ns())
        self.joint_publisher.publish_joints(now_ns)
        self.authenticator.poll(now_ns)
        self.publisher.poll_subscriptions(now_ns)
        self.demand.update(now_ns)
        self.control.poll(now_ns)
        self._hurried = self._subscribed or self.sampling.slow_sync or self.master.is_booting


def pad_names(deployment: Deployment) -> list[tuple[str, str]]:
    """Return hand and link of every pad, in the order of the deployment."""
    return [(entry.hand, entry.pad.link) for entry in deployment.pads]


def _open_resources(
    stack: ExitStack, deployment: Deployment, model: PadModel, robots: RobotModels
) -> _Resources:
    """Open endpoints, then buses; the returned stack closes them, `stack` only if opening fails."""
    settings = deployment.daemon
    period_ns = round(settings.sync_period_ms * 1e6)
    opened = stack.enter_context(ExitStack())
    context = opened.enter_context(zmq.Context())
    authenticator = Authenticator.open(context, Path(settings.keys) if settings.keys else None)
    opened.callback(authenticator.close)
    session = secrets.randbits(_SESSION_BITS)
    retained: RetainedMessages = {}
    publisher = Publisher.open(
        context,
        settings.live,
        settings.complete,
        wire.topics_of(deployment.links_by_hand),
        authenticator,
        session,
        retained_messages=retained,
    )
    opened.callback(publisher.close)
    control_socket = open_control_socket(context, settings.control, authenticator)
    opened.callback(control_socket[0].close)
    pipeline = Pipeline(model, period_ns, settings.sample_window_fraction, publisher, session, robots)
    parts = zip(robots.hands, robots.joint_names, robots.kinematics, robots.followers, strict=True)
    timeouts_ns = {hand.name: round(hand.joint_state_timeout_ms * 1e6) for hand in deployment.hands}
    joints = {
        hand: JointStateBuffer(names, of.continuous, of.limits, of.tolerances, timeouts_ns[hand], followers)
        for hand, names, of, followers in parts
    }
    inputs = InputReceiver.open(
        context,
        settings.inputs,
        authenticator,
        joints,
        pad_names(deployment),
        pipeline.add_force_reference,
    )
    opened.callback(inputs.close)
    ports: dict[str, Port] = {}
    for bus in deployment.buses:
        ports[bus.name] = port = Port.open(bus, pipeline.slab)
        opened.callback(port.close)
    return _Resources(opened, authenticator, publisher, retained, control_socket, inputs, pipeline, ports)
