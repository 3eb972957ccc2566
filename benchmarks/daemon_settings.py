"""The daemon's pipeline with its own settings, and its percept process in this one.

Public names: `pipeline_of`, `lay_out_channels`, `write_counts`, `request_percepts`; `decoded`, a message as a
subscriber has it; `InlineProcess`, the percept process' worker in this process, so that a run is repeatable
and as fast as it can be.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.config import Deployment
from handtouch.config.roles import channel_count
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.core.scene import RequestedOutputs
from handtouch.core.slab import ChannelField
from handtouch.core.tick_messages import MessageSink
from handtouch.daemon.child_process import ChildProcess
from handtouch.daemon.percepts import PerceptPublisher
from handtouch.hand.robot_models import RobotModels
from handtouch.percept.messages import pack_message, unpack_input
from handtouch.percept.worker import PerceptWorker
from handtouch.wire import PERCEPT_KINDS, PadState

_CHANNELS_OF_PDO = 4


def pipeline_of(
    deployment: Deployment,
    sink: MessageSink,
    *,
    model: PadModel | None = None,
    robots: RobotModels | None = None,
    period_ns: int | None = None,
) -> Pipeline:
    """Return a deployment's pipeline, all nodes operational.

    `model`: the deployment's, with another calibration; `period_ns`: another than the deployment's.
    """
    settings = deployment.daemon
    period_ns = period_ns or round(settings.sync_period_ms * 1e6)
    pipeline = Pipeline(
        model or PadModel(deployment), period_ns, settings.sample_window_fraction, sink, robots=robots
    )
    pipeline.node_state[:] = PadState.CLEAR
    return pipeline


def lay_out_channels(pipeline: Pipeline, deployment: Deployment) -> None:
    """Let each pad's node send its channels by 16 bits each, as many PDOs as they take."""
    for pad, entry in enumerate(deployment.pads):
        layout = (
            ChannelField(k // _CHANNELS_OF_PDO, 16 * (k % _CHANNELS_OF_PDO), 16, True)
            for k in range(channel_count(entry.pad))
        )
        pipeline.slab.set_layout(pad, tuple(layout))


def write_counts(pipeline: Pipeline, pad: int, counts: NDArray[np.integer], arrival_ns: int) -> None:
    """Let the sample (c,) of a pad arrive."""
    for number, first in enumerate(range(0, len(counts), _CHANNELS_OF_PDO)):
        data = counts[first : first + _CHANNELS_OF_PDO].astype("<i2").tobytes()
        pipeline.slab.write_pdo(pad, data.ljust(8, b"\0"), arrival_ns, number)


def request_percepts(
    pipeline: Pipeline,
    perceiving: PerceptPublisher,
    kinds: Sequence[str],
    now_ns: int = 0,
    *,
    palm: bool = False,
) -> None:
    """Request positions, forces and percepts of these kinds of all pads; palm: positions in the palm, too."""
    every = np.ones(pipeline.model.size, np.bool_)
    percepts = np.repeat(np.isin(PERCEPT_KINDS, kinds)[:, None], len(every), axis=1) if kinds else None
    requested = RequestedOutputs(
        every, every, np.ones(len(every), np.int64), every if palm else ~every, ~every, percepts
    )
    pipeline.apply_demand(requested)
    perceiving.set_requested(requested, now_ns)


def decoded(message: wire.OutgoingMessage) -> wire.Message:
    """Return what a subscriber decodes of a message."""
    return wire.decode(wire.encode(message))


class InlineProcess(ChildProcess):
    """Exchanges the same messages as the process, which it never starts."""

    def __init__(self, deployment: Deployment) -> None:
        super().__init__("", "percept", lambda: b"")
        self.worker = PerceptWorker(deployment)
        self.waiting: list[bytes] = []
        self.busy_s = 0.0
        """processor time of the worker"""

    @property
    def pid(self) -> int | None:
        """Any number while it is enabled."""
        return 1 if self.enabled else None

    def start(self, now_ns: int) -> None:  # noqa: ARG002
        """Enable it."""
        self.enabled = True

    def poll(self, now_ns: int) -> bool:  # noqa: ARG002
        """Return False: there is nothing to start."""
        return False

    def send(self, message: bytes) -> bool:
        """Process a message at once."""
        begun_s = time.process_time()
        self.waiting += map(pack_message, self.worker.process_input(unpack_input(message)))
        self.busy_s += time.process_time() - begun_s
        return True

    def receive(self, now_ns: int, max_messages: int = 8) -> list[bytes]:  # noqa: ARG002
        """Return what the worker has sent."""
        received, self.waiting = self.waiting[:max_messages], self.waiting[max_messages:]
        return received
