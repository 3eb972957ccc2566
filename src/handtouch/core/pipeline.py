"""Pipeline from SYNC to messages, driven by a live bus or by a recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.core.active_calibration import ActiveCalibration
from handtouch.core.cycle import Cycle
from handtouch.core.events import CalibrationEvent, DemandEvent, Event, ForceEvent, GravityEvent, ModelEvent
from handtouch.core.journal import TickJournal
from handtouch.core.pad_model import PadModel
from handtouch.core.scene import RequestedOutputs
from handtouch.core.sheet_force import ForceReference
from handtouch.core.slab import Slab
from handtouch.core.state import TickState
from handtouch.core.tick import TickProcessor, TickResult
from handtouch.core.tick_messages import MessageSink, TickMessages
from handtouch.core.transforms import ContactTransforms
from handtouch.hand.robot_models import RobotModels
from handtouch.wire import PadState

_NO_LIMIT_NS = np.iinfo(np.int64).max


class Pipeline:
    """Slab, cycle, tick and messages of all hands of a deployment; the owner of the bus drives it.

    Call `begin_cycle` at each SYNC, write samples into `slab`, and call `tick_if_due` as time passes.
    `node_state` (n,) uint8 is an input of each tick: PadState.CLEAR where a node is up, else the state of its
    pad. Whatever else changes between two ticks is an event (`add_event`), applied when the next one begins.
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
        self.state = TickState.empty(model.size, len(model.rows_of_hand))
        self.slab = Slab(model.size)
        self.cycle = Cycle(period_ns, window)
        self.tick = TickProcessor(model, period_ns, self.state)
        self.transforms = ContactTransforms(model.hands, robots, self.state)
        self.messages = TickMessages(model, self.tick, session, self.transforms)
        self.node_state: NDArray[np.uint8] = np.full(model.size, PadState.STARTING, dtype=np.uint8)
        self.on_tick_computed: Callable[[], None] = lambda: None
        """called between a tick and its messages, to measure time"""
        self.on_messages_queued: Callable[[], None] = lambda: None
        """called after the messages of a tick, to send them before what can wait is computed"""
        self.calibrations = list(model.calibrations)
        """calibrations of the pads (n,), those included that the next tick applies"""
        self._events: list[Event] = []
        self.next_model = model
        """the model that a `ModelEvent` applies"""
        self._sink = sink
        self.journal = TickJournal(self, session, sink)
        self._expected_pads = self.tick.expected_pads()
        self._expected_count = 0

    @property
    def ticks(self) -> int:
        """Number of ticks."""
        return int(self.state.ticks[0])

    # Events -----------------------------------------------------------------------------------------------

    def add_event(self, event: Event) -> None:
        """Change the state at the start of the next tick."""
        self._events.append(event)

    def set_calibration(self, pad: int, calibration: ActiveCalibration) -> None:
        """Change a pad's calibration, unless it is the present one."""
        if calibration != self.calibrations[pad]:
            self.calibrations[pad] = calibration
            self.add_event(CalibrationEvent(pad, calibration))

    def replace_model(self, model: PadModel, changed: Sequence[int]) -> None:
        """Continue with another model of the same pads, `changed` of which differ. It takes over the
        calibrations."""
        self.calibrations = model.continued_calibrations(self.next_model, self.calibrations)
        self.next_model = model
        self.add_event(ModelEvent(tuple(changed)))

    def apply_demand(self, requested: RequestedOutputs, ticks_per_hand_frame: int = 1) -> None:
        """Compute the requested outputs only."""
        self.add_event(DemandEvent.of(requested, ticks_per_hand_frame))

    def set_gravity(self, directions: NDArray[np.float64]) -> None:
        """Set the unit direction of gravity in each link's frame (n, 3), NaN where unknown."""
        self.add_event(GravityEvent(tuple(map(tuple, directions.tolist()))))

    def add_force_reference(self, reference: ForceReference) -> None:
        """Add forces on pads, measured by another sensor."""
        pads, force_n, std_n = (tuple(np.asarray(column).tolist()) for column in reference[:3])
        self.add_event(ForceEvent(pads, force_n, std_n, reference.measured_ns))

    def apply_next_model(self, changed: NDArray[np.intp]) -> None:
        """Continue with `next_model`."""
        self.next_model.copy_calibrations(self.model)
        self.model = self.next_model
        self.tick.replace_model(self.model, changed)
        self.messages.replace_model(self.model)

    # Ticks ------------------------------------------------------------------------------------------------

    def finish_cycle(self, sync_ns: int, now_ns: int) -> TickResult | None:
        """Run the tick of the present cycle, if it is still due at the next SYNC; return its result."""
        return None if self.cycle.ticked else self._run_tick(now_ns, sync_ns)

    def begin_cycle(self, sync_ns: int, now_ns: int) -> TickResult | None:
        """Begin a cycle at a SYNC, sent or received: samples that arrived since `sync_ns` belong to it.

        If the tick of the previous cycle is still due, it runs first; its result is returned.
        """
        late = self.finish_cycle(sync_ns, now_ns)
        self.prepare_next_tick()
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
        """Run a recorded tick on its inputs in slab, cycle and `node_state`, and the events added."""
        return self._run_tick(now_ns, _NO_LIMIT_NS if until_ns is None else until_ns)

    def prepare_next_tick(self) -> None:
        """Do the part of the next tick that can be done in advance; at the latest when that begins."""
        self.tick.prepare_next_tick()

    def end_session(self, now_ns: int) -> None:
        """Send the end of every contact and a last frame of every hand, because the daemon stops."""
        self.prepare_next_tick()
        self.messages.end_all_contacts(now_ns, self._sink)
        self.messages.send_hand_frames(self.slab, self.ticks, self.cycle.sync_ns, self._sink)
        self.journal.publish_tick_inputs((), now_ns, _NO_LIMIT_NS, stopped=True)

    def _run_tick(self, now_ns: int, until_ns: int) -> TickResult:
        self.prepare_next_tick()
        self.journal.publish_first_state(now_ns)
        events, self._events = self._events, []
        for event in events:
            event.apply(self)
        self.cycle.ticked = True
        result = self.tick.run_tick(self.slab, self.node_state, self.cycle, until_ns)
        self.transforms.transform_updated(result, self.tick.columns, self.tick.contacts.id)
        self.on_tick_computed()
        self.messages.send_contacts(result, now_ns, self._sink)
        if self.ticks % int(self.state.ticks_per_hand_frame[0]) == 0:
            self.messages.send_hand_frames(self.slab, self.ticks, self.cycle.sync_ns, self._sink)
        self.journal.publish_tick_inputs(events, now_ns, until_ns)
        self.on_messages_queued()
        self.tick.detect_slips(result)
        return result

    def _samples_complete(self) -> bool:
        fresh = self.slab.fresh_count
        if fresh < self._expected_count or self._expected_count == 0:
            return False
        return fresh == self.slab.size or bool(np.all(self.slab.fresh[self._expected_pads]))

    # State between two ticks --------------------------------------------------------------------------------

    def save_state(self) -> bytes:
        """Return the state between two ticks."""
        self.prepare_next_tick()
        return self.state.save()

    def solved_messages(self, now_ns: int) -> dict[str, wire.OutgoingMessage]:
        """Return contacts and hand frames by topic with everything computed, requested or not; the state is
        left as it was."""
        saved = self.save_state()
        self.tick.solve_all()
        messages = {topic: make(now_ns) for topic, make in self.messages.retained_messages().items()}
        self.load_state(saved, TickState.layout())
        return {topic: message for topic, message in messages.items() if message is not None}

    def load_state(
        self, saved: bytes, layout: str, calibrations: Sequence[ActiveCalibration] | None = None
    ) -> None:
        """Load a state of a pipeline of the same deployment, and the calibrations of its pads.

        Raises StateLayoutError, changing nothing.
        """
        self.state.load(saved, layout)
        for pad, calibration in enumerate(calibrations or ()):
            self.model.set_calibration(pad, calibration)
        self.calibrations = list(self.model.calibrations) if calibrations else self.calibrations
        self.tick.refresh()
        self.transforms.refresh()
