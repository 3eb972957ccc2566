"""Pipeline with the daemon's own settings, for benchmarks that measure what the daemon computes.

Public names: `pipeline_of`; `decoded`, a message as a subscriber has it.
"""

from __future__ import annotations

from handtouch import wire
from handtouch.config import Deployment
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.core.tick_messages import MessageSink
from handtouch.hand.robot_models import RobotModels
from handtouch.wire import PadState


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


def decoded(message: wire.OutgoingMessage) -> wire.Message:
    """Return what a subscriber decodes of a message."""
    return wire.decode(wire.encode(message))
