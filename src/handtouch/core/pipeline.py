"""Pipeline from SYNC to messages, driven by a live bus or by a recording."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from handtouch.core.cycle import Cycle
from handtouch.core.external_inputs import ExternalInputs
from handtouch.core.journal import TickJournal
from handtouch.core.pad_model import PadModel
from handtouch.core.scene import RequestedOutputs
from handtouch.core.slab import Slab
from handtouch.core.tick import TickProcessor, TickResult
from handtouch.core.tick_messages import MessageSink, TickMessages
from handtouch.core.transforms import ContactTransforms
from handtouch.hand.robot_models import RobotModels
from handtouch.wire import PadState

_NO_LIMIT_NS = np.iinfo(np.int64).max


class Pipeline:
    """Slab, cycle, tick and messages of all hands of a deployment; the owner of the bus drives it.

    Call `begin_cycle` at each SYNC, write samples into `slab`, and call `tick_if_due` as time passes.
    `node_state` (n,) uint8 is set by the owner: PadState.CLEAR where a node is up, else the state of its pad.
    `session` goes into the messages; `robots`: kinematics of the hands.
    """

    def __init__(
        self,
        model: PadModel,
        period_ns: int,
        window: float,
        sink: MessageSink,
        session: int = 0,
        robots: RobotModels | None = None,
    ) -> None:
        self.model = model
        self.slab = Slab(model.size)
        self.cycle = Cycle(period_ns, window)
        self.tick = TickProcessor(model, period_ns)
        self.transforms = ContactTransforms(model.hands, robots)
        self.messages = TickMessages(model, self.tick, session, self.transforms)
        self.node_state: NDArray[np.uint8] = np.full(model.size, PadState.STARTING, dtype=np.uint8)
        self.ticks = 0
        self.ticks_per_hand_frame = 1
        """ticks per hand frame"""
        self.on_tick_computed: Callable[[], None] = lambda: None
        """called between a tick and its messages, to measure time"""
        self.on_messages_queued: Callable[[], None] = lambda: None
        """called after the messages of a tick, to send them before what can wait is computed"""
        self.external_inputs = ExternalInputs()
        """reference forces and gravity, applied when the next cycle begins"""
        self._sink = sink
        self.journal = TickJournal(
            self,
            session,
            sink,
            {
                "joints": self.transforms.recorded_joints,
                "external_inputs": self.external_inputs.recorded_inputs,
            },
        )
        self._expected_pads = self.tick.expected_pads()
        self._expected_count = 0

    def apply_demand(self, requested: RequestedOutputs) -> None:
        """Compute the requested outputs only."""
        self.tick.set_requested(requested.position, requested.force, requested.interval_ticks)
        self.tick.slip.set_requested(requested.motion)
        self.transforms.set_requested(requested.palm, requested.base)

    def begin_cycle(self, sync_ns: int, now_ns: int) -> TickResult | None:
        """Begin a cycle at a SYNC, sent or received: samples that arrived since `sync_ns` belong to it.

        If the tick of the previous cycle is still due, it runs first; its result is returned.
        """
        late = None if self.cycle.ticked else self._run_tick(now_ns, sync_ns)
        self.prepare_next_tick()
        self.journal.publish_changed_state(now_ns)
        self.external_inputs.apply(self.tick)  # after the state: it doesn't contain them yet
        self.slab.begin_cycle(sync_ns)
        self.cycle.begin_cycle(sync_ns)
        self._expected_pads = self.tick.expected_pads()
        self._expected_count = int(np.count_nonzero(self._expected_pads))
        return late

    def tick_if_due(self, now_ns: int) -> TickResult | None:
        """Run the tick and send its messages if all expected samples have arrived or their window is over."""
        if not self.cycle.is_tick_due(now_ns, self._samples_complete()):
            return None
        return self._run_tick(now_ns, _NO_LIMIT_NS)

    def tick_without_sync(self, now_ns: int) -> TickResult:
        """Run a cycle without SYNC, for samples of event-driven pads."""
        self.begin_cycle(now_ns, now_ns)
        return self._run_tick(now_ns, _NO_LIMIT_NS)

    def replay_tick(self, now_ns: int, until_ns: int | None) -> TickResult:
        """Run a recorded tick on its inputs in slab, cycle and `node_state`."""
        self.prepare_next_tick()
        self.external_inputs.apply(self.tick)
        return self._run_tick(now_ns, _NO_LIMIT_NS if until_ns is None else until_ns)

    def replace_model(self, model: PadModel, changed: NDArray[np.intp]) -> None:
        """Continue with another model of the same pads, `changed` of which differ; between two ticks."""
        self.model = model
        self.tick.replace_model(model, changed)
        self.messages.replace_model(model)

    def prepare_next_tick(self) -> None:
        """Do the part of the next tick that can be done in advance; at the latest in `begin_cycle`."""
        self.tick.prepare_next_tick()

    def end_session(self, now_ns: int) -> None:
        """Send the end of every contact and a last frame of every hand, because the daemon stops."""
        self.prepare_next_tick()
        self.messages.end_all_contacts(now_ns, self._sink)
        self.messages.send_hand_frames(self.slab, self.ticks, self.cycle.sync_ns, self._sink)
        self.journal.publish_tick_inputs(now_ns, _NO_LIMIT_NS, stopped=True)

    def _run_tick(self, now_ns: int, until_ns: int) -> TickResult:
        self.cycle.ticked = True
        self.ticks += 1
        result = self.tick.run_tick(self.slab, self.node_state, self.cycle, now_ns, until_ns)
        self.transforms.transform_updated(result, self.tick.columns, self.tick.contacts.id)
        self.on_tick_computed()
        self.messages.send_contacts(result, now_ns, self._sink)
        if self.ticks % self.ticks_per_hand_frame == 0:
            self.messages.send_hand_frames(self.slab, self.ticks, self.cycle.sync_ns, self._sink)
        self.journal.publish_tick_inputs(now_ns, until_ns)
        self.on_messages_queued()
        self.tick.detect_slips(result)
        return result

    def _samples_complete(self) -> bool:
        fresh = self.slab.fresh_count
        if fresh < self._expected_count or self._expected_count == 0:
            return False
        return fresh == self.slab.size or bool(np.all(self.slab.fresh[self._expected_pads]))
