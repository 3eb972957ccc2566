"""Days of a hand in use, faster than real time: the daemon's parts in one process, time as an argument.

Public names: `Days`, `run_days`. The samples come from another process. From the samples on everything is the
daemon's: pipeline, percepts, supervision with its store on a small disk, recorder. Not here: sockets, the
CANopen master, whose events of replaced nodes are injected, and child processes (`cycled_processes`).
"""

from __future__ import annotations

import gc
import logging
import multiprocessing
import os
import queue
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from benchmarks.daemon_settings import InlineProcess
from benchmarks.diagnose_episodes import draw_fault, size_mm
from benchmarks.page import progress
from benchmarks.served_hand import descriptors, resident_mb
from benchmarks.soak_alarms import BLOCK_S, BUSY_HZ, Hour
from handtouch import wire
from handtouch.calibration.store_client import StoreClient
from handtouch.canbus.nodes.lifecycle_types import NodeState
from handtouch.canbus.nodes.spec import SerialChanged
from handtouch.config import Deployment
from handtouch.config.files import deployment_files
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.core.scene import RequestedOutputs
from handtouch.daemon.child_process import ChildProcess
from handtouch.daemon.percepts import PerceptPublisher
from handtouch.daemon.supervisor_client import SupervisorClient
from handtouch.host.build import build_info
from handtouch.record.mcap_file import RecordingFile
from handtouch.record.recorder import MessageRecorder, RotationLimits
from handtouch.simulate.faults import FAULTS
from handtouch.simulate.stimulus import NodeReplacement
from handtouch.simulate.worlds import WORLDS, MountSpread, World
from handtouch.supervisor.deployment_diagnostics import DeploymentDiagnostics
from handtouch.supervisor.ipc import pack_message, unpack_daemon_message
from handtouch.supervisor.worker import SupervisorWorker
from handtouch.wire import PERCEPT_KINDS, PadState
from handtouch.wire.status import PositionStatus
from tests.client.hand_messages import make_service

FloatArray = NDArray[np.float64]
SEED = 41
PERIOD_NS = 5 * 10**6
"""Of SYNC, as the deployment has it, by which a replay computes too; not every period has samples."""
HOUR_NS = 3600 * 10**9
EPOCH = datetime(2026, 1, 1, tzinfo=UTC)
FIRST_SERIAL = 1001
FAULT_PERIOD_S, FAULT_S = 5400.0, (180.0, 900.0)
SWAP_PERIOD_S = 4 * 3600.0
RESTART_PERIOD_S = 3 * 3600.0
"""Of daemon restarts and, half a period later, of crashes of the supervisor."""
FULL_DISK_S = 7200.0
BOOT_S = 2.0
KEPT_RECORDINGS = 3
AFTERWARDS_S = 600.0
"""A fault explains diagnoses up to this time after its end."""
TRUTH_BLOCKS = 8
"""Every so many blocks in use, one sample is compared with the ground truth."""
DAY_S, WORK_S = 24 * 3600.0, 12 * 3600.0
"""A day, and its first part, in which the hand is used."""
NIGHT_HZ = 5
WAITING_BATCHES = 400
"""Batches made ahead: use takes the processors of both processes by turns, rest hardly any."""
Batch = tuple[NDArray[np.int64], NDArray[np.int64], list[tuple[int, FloatArray, float]]]
"""Times (k,), counts (k, pads, 4), and of its last sample row, position [m] and force [N] of contacts."""


class Act(NamedTuple):
    """Something done to the hand or the computer: kind, begin and end [s], pad (-1: none), details."""

    kind: str
    from_s: float
    until_s: float
    pad: int = -1
    detail: Any = None


class WorkingDays(Hour):
    """Days of use with nights at rest."""

    def __init__(self, world: World, seed: int, length_s: float) -> None:
        super().__init__(world, seed, length_s)
        self.busy = [span for span in self.busy if is_work(*span)]
        self.touches = [touch for touch in self.touches if is_work(touch.from_s)]
        self.faults = [fault for fault in self.faults if is_work(fault.from_s)]

    def _stretches(self) -> Iterator[tuple[float, float, int]]:
        for from_s, until_s, rate in super()._stretches():
            nights = [t for t in np.arange(WORK_S, self.length_s, DAY_S / 2).tolist() if from_s < t < until_s]
            for begin_s, end_s in pairwise((from_s, *nights, until_s)):
                yield begin_s, end_s, rate if is_work(begin_s) else NIGHT_HZ


def is_work(*times_s: float) -> bool:
    """Return True if none of the times is at night."""
    return all(t % DAY_S < WORK_S for t in times_s)


class Days:
    """Use and acts of some hours of a hand of the world `default`, whose pads are mounted as stated."""

    def __init__(self, hours: float) -> None:
        self.hours, length_s = hours, 3600 * hours
        rng = np.random.default_rng(SEED)
        world = replace(WORLDS["default"], mounts=MountSpread())
        self.use = WorkingDays(world, SEED, length_s)
        self.acts: list[Act] = []
        for number, at in enumerate(np.arange(600.0, length_s - 1200, FAULT_PERIOD_S).tolist()):
            self._add_fault([*FAULTS][number % len(FAULTS)], at, rng)
        pads = rng.permutation(len(self.use.links)).tolist()
        for number, at in enumerate(np.arange(3000.0, length_s - 3600, SWAP_PERIOD_S).tolist()):
            pad, serial = pads[number % len(pads)], FIRST_SERIAL + 100 + number
            self.use.swaps.append(NodeReplacement(link=self.use.links[pad], at_s=at, serial=serial))
            self.acts.append(Act("swap", at, at + BOOT_S, pad, serial))
        for at in np.arange(RESTART_PERIOD_S, length_s - 600, RESTART_PERIOD_S).tolist():
            self.acts.append(Act("restart", at, at))
            self.acts.append(Act("crash", at - RESTART_PERIOD_S / 2, at - RESTART_PERIOD_S / 2))
        for at in (length_s / 3, 2 * length_s / 3):
            self.acts.append(Act("disk full", at, at + min(FULL_DISK_S, length_s / 6)))
        self.acts.sort(key=lambda act: act.from_s)

    def _add_fault(self, kind: str, at: float, rng: np.random.Generator) -> None:
        pad = int(rng.integers(len(self.use.links)))
        settings = self.use.deployment.pads[pad][1]
        keys = draw_fault(kind.replace("_", " "), rng, size_mm(settings))
        fault = FAULTS[kind].model_validate({"link": settings.link, "from_s": at, **keys})
        until_s = at + float(rng.uniform(*FAULT_S))
        self.use.faults.append(fault.model_copy(update={"until_s": until_s}))
        self.acts.append(Act(kind, at, until_s, pad))

    def serials_at(self, t_s: float) -> list[int]:
        """Return the serial numbers of the nodes at a time."""
        serials = [FIRST_SERIAL + pad for pad in range(len(self.use.links))]  # as the deployment has them
        for act in self.acts:
            if act.kind == "swap" and act.from_s <= t_s:
                serials[act.pad] = act.detail
        return serials

    def batches(self) -> Iterator[Batch]:
        """Yield half seconds of samples, every some of them with ground truth."""
        hand = self.use.hand()
        rows = {link: row for row, link in enumerate(self.use.links)}
        busy = 0
        for block in self.use.blocks(hand):
            times, truth = block.sample_ns[:, 0], []
            busy += len(times) == round(BLOCK_S * BUSY_HZ)
            if busy % TRUTH_BLOCKS == 1 and len(times) == round(BLOCK_S * BUSY_HZ):
                found = [
                    (rows[t.link], np.array(t.position_m), t.force_n) for t in hand.truth(times[-1] * 1e-9)
                ]
                alone = [row for row, *_ in found]
                truth = [entry for entry in found if alone.count(entry[0]) == 1]
            yield times, block.counts, truth


def start_message(deployment: Deployment, store: Path) -> bytes:
    """Return the deployment that the supervisor process gets, with the path of its store."""
    daemon = deployment.daemon.model_copy(update={"store": str(store)})
    return deployment.model_copy(update={"daemon": daemon}).model_dump_json(by_alias=True).encode()


class InlineSupervisor(ChildProcess):
    """The supervisor's worker in this process, which exchanges the same messages; `crash` ends it at once."""

    def __init__(self, start: bytes) -> None:
        super().__init__("", "supervisor", lambda: start)
        self._start, self.waiting = start, list[bytes]()
        self.worker: SupervisorWorker | None = None
        self.now_ns = 0

    @property
    def pid(self) -> int | None:
        """Any number while it runs."""
        return None if self.worker is None else 1

    def start(self, now_ns: int) -> None:
        """Enable it; `poll` starts it."""
        self.enabled, self.now_ns = True, now_ns

    def crash(self) -> None:
        """Lose the worker with what it hasn't stored; `poll` starts another one."""
        assert self.worker is not None
        self.worker = None
        self.waiting.clear()
        self.restarts += 1

    def close(self) -> None:
        """Let the worker store the rest, and end it."""
        if self.worker is not None:
            self.worker.finish(wall(self.now_ns))
        self.worker, self.enabled = None, False

    def poll(self, now_ns: int) -> bool:
        """Start the worker, unless it runs; return True if it was started."""
        self.now_ns = now_ns
        if self.worker is not None or not self.enabled:
            return False
        deployment = Deployment.model_validate_json(self._start)
        store = StoreClient(Path(deployment.daemon.store or ""))
        self.worker = SupervisorWorker(deployment, store, DeploymentDiagnostics(deployment))
        return True

    def send(self, message: bytes) -> bool:
        """Process a message at once."""
        if self.worker is None:
            return False
        done = self.worker.process_message(unpack_daemon_message(message), wall(self.now_ns))
        self.waiting += map(pack_message, done)
        return True

    def receive(self, now_ns: int, max_messages: int = 8) -> list[bytes]:
        """Return what the worker has sent."""
        self.now_ns = now_ns
        received, self.waiting = self.waiting[:max_messages], self.waiting[max_messages:]
        return received


class Recording:
    """The sink of all messages: encoded as on the wire and recorded; the newest files of use are kept."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.paths, self.messages = folder, list[Path](), 0
        limits = RotationLimits(max_duration_ns=HOUR_NS)
        self.recorder = MessageRecorder(self._open_file, limits)
        self.now_ns = 0

    def has_subscriber(self, topic: str) -> bool:
        """Return True for what `handtouch record` and a subscriber to percepts request."""
        return not topic.startswith(("raw/", "hand/"))

    def send(self, message: wire.OutgoingMessage) -> None:
        """Record a message."""
        self.messages += 1
        self.recorder.add_message(wire.encode(message), self.now_ns)

    def _open_file(self, t_ns: int) -> RecordingFile:
        if not is_work(1e-9 * t_ns - EPOCH.timestamp()):
            night = self.folder / "night.mcap"
            night.unlink(missing_ok=True)
            return RecordingFile(night, {"began": str(t_ns)})
        path = self.folder / f"{len(self.paths):05}.mcap"
        self.paths.append(path)
        for old in self.paths[:-KEPT_RECORDINGS]:
            old.unlink(missing_ok=True)
        return RecordingFile(path, {"began": str(t_ns)})


class LogLines(logging.Handler):
    """Collects warnings and errors with the time of the samples."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.now_s = 0.0
        self.lines: list[tuple[float, str]] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append((self.now_s, record.getMessage()))


@dataclass
class Compared:
    """Ticks and contacts, and positions compared with their truth: whether they lie in their 95 % region."""

    ticks: int = 0
    contacts: int = 0
    inside: list[bool] = field(default_factory=list)


class Session:
    """One session of the daemon's parts, from its start to its end."""

    def __init__(self, days: Days, store: Path, recording: Recording, number: int, now_ns: int) -> None:
        deployment = days.use.deployment
        self.recording, self.number, self._service_seq = recording, number, 0
        self._links = deployment.links_by_hand
        model = PadModel(deployment)
        self.pipeline = Pipeline(model, PERIOD_NS, 0.8, recording, number)
        self.pipeline.node_state[:] = PadState.CLEAR
        self.process = InlineSupervisor(start_message(deployment, store))
        self.serials: list[int | None] = [None] * model.size
        nodes: Any = SimpleNamespace(status=self._node_status)
        self.supervisor = SupervisorClient(deployment, self.pipeline, nodes, "", self.process)
        self.percepts = PerceptPublisher(
            deployment, self.pipeline, recording, number, process=InlineProcess(deployment)
        )
        every = np.ones(model.size, np.bool_)
        kinds = np.ones((len(PERCEPT_KINDS), model.size), np.bool_)
        requested = RequestedOutputs(
            every, every, np.ones(model.size, np.int64), ~every, ~every, kinds, every
        )
        self.pipeline.apply_demand(requested)
        self.percepts.set_requested(requested, now_ns)
        self.supervisor.start(now_ns)
        self.send_service(now_ns)
        files = deployment_files(deployment)
        self.pipeline.journal.publish_config(deployment, files, build_info(), now_ns)

    def _node_status(self) -> list[SimpleNamespace]:
        return [SimpleNamespace(serial=serial, state=NodeState.OPERATIONAL) for serial in self.serials]

    def assign_nodes(self, serials: list[int], now_ns: int) -> None:
        """Report the nodes as the master does."""
        for pad, serial in enumerate(serials):
            if self.serials[pad] != serial:
                before, self.serials[pad] = self.serials[pad], serial
                self.supervisor.handle_node_events([SerialChanged(pad, now_ns, before, serial)], now_ns)

    def tick(self, sync_ns: int, samples: list[bytes]) -> None:
        """Run a cycle."""
        pipeline, recorder = self.pipeline, self.recording.recorder
        self.recording.now_ns = sync_ns
        pipeline.begin_cycle(sync_ns, sync_ns)
        for pad, data in enumerate(samples):
            pipeline.slab.write_pdo(pad, data, sync_ns + 1000 + 100 * pad)
        now_ns = sync_ns + PERIOD_NS - 1  # beyond the sample window: at first, no pad is expected
        result = pipeline.tick_if_due(now_ns)
        assert result is not None
        self.percepts.process_tick(result, now_ns)
        pipeline.prepare_next_tick()
        self.supervisor.process_tick(now_ns)
        if recorder.state_requested:
            recorder.state_requested = False
            message = pipeline.journal.retained_messages()["state"](sync_ns)
            assert message is not None
            self.recording.send(message)

    def send_service(self, now_ns: int) -> None:
        """Send the message that has the wall clock's offset."""
        self._service_seq += 1
        offset_ns = round(EPOCH.timestamp() * 1e9)
        pipeline = self.pipeline
        self.recording.send(
            make_service(
                self._service_seq,
                self.number,
                t_ns=now_ns,
                wall_offset_ns=offset_ns,
                uptime_s=now_ns * 1e-9,
                period_s=PERIOD_NS * 1e-9,
                hands=self._links,
                ticks=pipeline.ticks,
                rate_hz=float(BUSY_HZ),
                contacts=pipeline.tick.contacts.begun_count,
                supervisor=self.supervisor.statistics(),
            )
        )

    def end(self, now_ns: int) -> None:
        """End the session as the daemon does."""
        self.pipeline.end_session(now_ns)
        self.supervisor.close()
        self.percepts.close()


def run_days(days: Days, store: Path, fill: Callable[[bool], None], folder: Path) -> dict[str, Any]:
    """Run all hours; `fill` fills the store's disk (True) or frees it. Return figures, also by hour."""
    log, whole = LogLines(), Compared()
    logger = logging.getLogger("handtouch")
    logger.addHandler(log)
    recording = Recording(folder)
    session = Session(days, store, recording, 1, 0)
    memory: list[tuple[float, float, int, int, int, float]] = []
    steps: list[tuple[float, Act, bool]] = sorted(
        [(act.from_s, act, True) for act in days.acts] + [(a.until_s, a, False) for a in days.acts],
        key=lambda step: step[0],
    )
    diagnosed: dict[tuple[int, str], list[float]] = {}
    begun = polled_s = 0.0
    for times, counts, truth in from_process(days.batches):
        now_s = float(times[0]) * 1e-9
        log.now_s = now_s
        while steps and steps[0][0] <= now_s:
            _, act, begins = steps.pop(0)
            if act.kind == "disk full":
                fill(begins)
            elif act.kind == "swap":
                session.pipeline.node_state[act.pad] = PadState.STARTING if begins else PadState.CLEAR
            elif begins and act.kind == "crash":
                session.process.crash()
            elif begins and act.kind == "restart":
                session.end(int(times[0]))
                session = Session(days, store, recording, session.number + 1, int(times[0]))
                begun = 0
        session.assign_nodes(days.serials_at(now_s - BOOT_S), int(times[0]))
        for sync_ns, sample in zip((times + 10**9).tolist(), counts.astype("<i2"), strict=True):
            session.tick(sync_ns, [pad.tobytes() for pad in sample])
        if truth:
            compare(session.pipeline, truth, faulty_pads(days, now_s), whole)
        whole.ticks += len(times)
        now_begun = session.pipeline.tick.contacts.begun_count
        whole.contacts += int(now_begun - begun)
        begun = now_begun
        for pad, assessment in enumerate(session.supervisor.assessments):
            for diagnosis in assessment.diagnoses if assessment else ():
                diagnosed.setdefault((pad, diagnosis.kind.value), []).append(now_s)
        if now_s - polled_s >= 1:
            polled_s = now_s
            recording.recorder.poll(int(times[-1]) + 10**9)
            session.send_service(int(times[-1]) + 10**9)
        if not memory or now_s >= 3600 * len(memory) / 6:
            gc.collect()
            used = resident_mb(os.getpid()), descriptors(os.getpid()), len(gc.get_objects())
            size = sum(path.stat().st_size for path in store.parent.glob(f"{store.name}*"))
            memory.append((now_s / 3600, *used, size, kept_mb(diagnosed.values())))
            if len(memory) % 6 == 1:
                progress(
                    f"{now_s / 3600:.1f} of {days.hours:g} h, {used[0]:.0f} MB, {len(log.lines)} warnings"
                )
    end_ns = int(times[-1]) + 2 * 10**9
    gains = gain_errors(days, session)
    states = [a.calibration_state if a else "" for a in session.supervisor.assessments]
    error = session.supervisor.statistics()["store_error"]
    session.end(end_ns)
    recording.recorder.finish()
    logger.removeHandler(log)
    return {
        "hours": days.hours,
        "whole": whole,
        "memory": memory,
        "gain_errors": gains,
        "states": states,
        "store_error": error,
        "late": session.supervisor.late,
        "malformed": session.supervisor.malformed,
        "acts": [act._asdict() for act in days.acts],
        "diagnosed": [{"pad": pad, "kind": kind, "at_s": spans(at)} for (pad, kind), at in diagnosed.items()],
        "log": log.lines,
        "messages": recording.messages,
        "lost": dict(recording.recorder.lost),
        "malformed_messages": recording.recorder.malformed,
        "last_recordings": [str(path) for path in recording.paths[-KEPT_RECORDINGS:]],
    }


def kept_mb(diagnosed: Iterable[list[float]]) -> float:
    """Return the memory [MB] of what the test keeps itself: a number and its place a report."""
    return 32e-6 * sum(map(len, diagnosed))


def wall(now_ns: int) -> datetime:
    """Return the wall-clock time of a time of the samples."""
    return EPOCH + timedelta(microseconds=now_ns / 1000)


def from_process(make: Callable[[], Iterator[Batch]]) -> Iterator[Batch]:
    """Yield what another process makes, so that its memory and time aren't measured here."""
    context = multiprocessing.get_context("fork")
    reader, writer = context.Pipe(duplex=False)

    def produce(output: Connection) -> None:
        waiting: queue.Queue[Batch | None] = queue.Queue(WAITING_BATCHES)

        def send() -> None:
            while (batch := waiting.get()) is not None:
                output.send(batch)
            output.send(None)

        sender = threading.Thread(target=send)
        sender.start()
        for batch in make():
            waiting.put(batch)
        waiting.put(None)
        sender.join()

    process = context.Process(target=produce, args=(writer,), daemon=True)
    process.start()
    writer.close()
    while (batch := reader.recv()) is not None:
        yield batch
    process.join()
    reader.close()


def faulty_pads(days: Days, t_s: float) -> set[int]:
    """Return pads that have a fault or a node without calibration."""
    return {
        act.pad
        for act in days.acts
        if act.pad >= 0 and act.from_s <= t_s <= act.until_s + (3600 if act.kind == "swap" else AFTERWARDS_S)
    }


def compare(
    pipeline: Pipeline, truth: list[tuple[int, FloatArray, float]], faulty: set[int], whole: Compared
) -> None:
    """Compare published positions with the truth of this tick."""
    columns, touching = pipeline.tick.columns, pipeline.tick.state.touching
    for row, position_m, _ in truth:
        if not touching[row] or row in faulty:
            continue
        if columns.position_status[row] == PositionStatus.VALID:
            error = columns.position_m[row] - position_m
            covariance = columns.covariance_m2[row].reshape(3, 3)
            distance = float(error @ np.linalg.pinv(covariance, rcond=1e-6, hermitian=True) @ error)
            whole.inside.append(distance < chi2.ppf(0.95, 2))


def gain_errors(days: Days, session: Session) -> list[float]:
    """Return the rms error of the active relative gains of each pad's channels."""
    world, found = days.use.world, []
    serials = days.serials_at(3600 * days.hours)
    for pad, (hand, settings) in enumerate(days.use.deployment.pads):
        own = FIRST_SERIAL + pad == serials[pad]
        true = world.pad(hand, settings).gain_ratio if own else world.replacement_gain(serials[pad])
        error = np.log(session.pipeline.model.gains[pad]) + np.log(np.array(true))
        found.append(float(np.std(error)))
    return found


def spans(times: list[float], gap_s: float = 5.0) -> list[tuple[float, float]]:
    """Return begin and end of runs of times."""
    at = np.array(times)
    cut = np.flatnonzero(np.diff(at) > gap_s)
    first, last = np.r_[at[:1], at[cut + 1]], np.r_[at[cut], at[-1:]]
    return list(zip(first.tolist(), last.tolist(), strict=True))
