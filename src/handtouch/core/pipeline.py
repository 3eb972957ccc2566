"""Path of a sample: from the slab to the messages of a tick, driven by a live bus or by a recording.

Public names: `Pipeline`; `run_tick`, `solve_contacts`, stages of its ticks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.arrays import FloatArray, IntArray
from handtouch.core.active_calibration import ActiveCalibration
from handtouch.core.columns import TickResult
from handtouch.core.events import CalibrationEvent, DemandEvent, Event, ForceEvent, GravityEvent, ModelEvent
from handtouch.core.hand_poses import HandPoses
from handtouch.core.journal import TickJournal
from handtouch.core.pad_model import PadModel
from handtouch.core.scene import RequestedOutputs
from handtouch.core.sheet_force import ForceReference
from handtouch.core.slab import Cycle, Slab
from handtouch.core.stages.frames import ContactTransforms
from handtouch.core.state import TickState
from handtouch.core.tick import TickProcessor
from handtouch.core.tick_messages import MessageSink, TickMessages
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
        sizes = model.size, len(model.rows_of_hand), model.channels, len(model.second_pads)
        self.state = TickState.empty(*sizes)
        self.slab = Slab(model.size, model.slab_channels, model.slab_columns)
        self.cycle = Cycle(period_ns, window)
        self.tick = TickProcessor(model, period_ns, self.state)
        self.transforms = ContactTransforms(model.hands, robots, self.state)
        self._hand_poses = HandPoses(robots) if robots else None
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
        self._recorded = False  # the last tick
        self._prepared = False  # the next tick
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

    def set_felt_gravity(self, felt: NDArray[np.float64]) -> None:
        """Set gravity less acceleration in each link's frame (n, 3), in units of gravity, NaN where
        unknown."""
        self.add_event(GravityEvent(tuple(map(tuple, felt.tolist()))))

    def link_poses(self, hand: str, t_ns: int) -> tuple[FloatArray, FloatArray] | None:
        """Return the poses of a hand at a time, see `HandPoses.compute`; None without joints."""
        joints = self.transforms.joints_at(hand, t_ns)
        return None if joints is None or self._hand_poses is None else self._hand_poses.compute(hand, joints)

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
        self.prepare_next_tick()
        return self._run_tick(now_ns, _NO_LIMIT_NS if until_ns is None else until_ns)

    def prepare_next_tick(self) -> None:
        """Do the part of the next tick that can be done in advance; at the latest when that begins."""
        if not self._prepared:
            self._prepared = True
            self.tick.prepare_next_tick()

    def end_session(self, now_ns: int) -> None:
        """Send the end of every contact and a last frame of every hand, because the daemon stops."""
        self.prepare_next_tick()
        self.messages.end_all_contacts(now_ns, self._sink)
        self.messages.send_hand_frames(self.slab, self.ticks, self.cycle.sync_ns, self._sink)
        if self._sink.has_subscriber("tick"):
            self.journal.publish_tick_inputs((), now_ns, _NO_LIMIT_NS, stopped=True)

    def _run_tick(self, now_ns: int, until_ns: int) -> TickResult:
        recorded = self._sink.has_subscriber("tick")
        if recorded and not self._recorded:
            self.journal.publish_first_state(now_ns)
        self._recorded = recorded
        events, self._events = self._events, []
        for event in events:
            event.apply(self)
        self.cycle.ticked, self._prepared = True, False
        tick, messages = self.tick, self.messages
        result = run_tick(tick, self.slab, self.node_state, self.cycle, until_ns)
        if self.transforms.any_requested:
            self.transforms.transform_updated(result)
        self.on_tick_computed()
        messages.send_contacts(result, now_ns, self._sink)
        if self.ticks % int(self.state.ticks_per_hand_frame[0]) == 0:
            messages.send_hand_frames(self.slab, self.ticks, self.cycle.sync_ns, self._sink)
        if recorded:
            self.journal.publish_tick_inputs(events, now_ns, until_ns)
        self.on_messages_queued()
        if tick.slip.any_requested:
            tick.detect_slips(result)
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
        self._solve_all()
        messages = {topic: make(now_ns) for topic, make in self.messages.retained_messages().items()}
        self.load_state(saved, self.state.layout())
        return {topic: message for topic, message in messages.items() if message is not None}

    def _solve_all(self) -> None:
        """Compute position and force of every touched pad, requested or not."""
        tick = self.tick
        everything = np.ones(self.model.size, dtype=np.bool_)
        tick.set_requested(everything, everything, self.state.update_interval_ticks)
        touching = np.flatnonzero(tick.state.touching)
        if len(touching):
            solve_contacts(tick, touching)
            tick.sheet_force.store_forces()
            if tick.second.any_configured:
                tick.second.store_both()
            tick.output.publish()
            if tick.shear.any_configured:
                self.state.shear_sample_ns[touching] = 0
                tick.shear.update_forces(self.slab)

    def load_state(
        self, saved: bytes, layout: str, calibrations: Sequence[ActiveCalibration] | None = None
    ) -> None:
        """Load a state of a pipeline of the same deployment, and the calibrations of its pads.

        Raises StateLayoutError, changing nothing.
        """
        self.state.load(saved, layout)
        self.tick.sync_ns = 0  # nothing is left to prepare: `save_state` did
        for pad, calibration in enumerate(calibrations or ()):
            self.model.set_calibration(pad, calibration)
        self.calibrations = list(self.model.calibrations) if calibrations else self.calibrations
        self.tick.refresh()
        self.transforms.refresh()


# Stages of a tick -----------------------------------------------------------------------------------------


def run_tick(
    tick: TickProcessor,
    slab: Slab,
    node_state: NDArray[np.uint8],
    cycle: Cycle,
    until_ns: int = _NO_LIMIT_NS,
) -> TickResult:
    """Process the samples of a cycle, and those of the previous one that arrived after its tick.

    Samples that arrived at `until_ns` or later belong to the next cycle. `node_state` (n,):
    PadState.CLEAR where the node is up, else the state to give its pad.
    """
    tick.channel_counts, tick.sync_ns = slab.unpack_counts(), cycle.sync_ns
    tick.counts = tick.channel_counts[:, : tick.model.channels]
    changes = tick.contacts.detect_contacts(slab, node_state, cycle, until_ns)
    if len(changes.began):
        tick.sheet_force.begin_contacts(changes.began)
        tick.second.begin_contacts(changes.began)
    if tick.second.any_configured:
        tick.second.read_totals(slab, cycle.sync_ns)
    if len(changes.solved):
        solve_contacts(tick, changes.solved)
    if tick.sheet_force.any_modelled:
        tick.sheet_force.compensate_forces(cycle.sync_ns)
    if tick.second.any_configured:
        tick.second.store_forces(cycle.sync_ns)
    tick.output.publish()
    if tick.shear.any_configured:
        tick.shear.update_forces(slab)
    began, ended, updated, silent, _, framed = changes
    return TickResult(
        sync_ns=cycle.sync_ns, began=began, updated=updated, ended=ended, silent=silent, framed=framed
    )


def solve_contacts(tick: TickProcessor, pads: IntArray) -> None:
    """Locate the contacts on these pads (k,), place them in their links' frames and estimate their forces."""
    tick.solver.solve_contacts(pads.data)
    tick.output.store_solved(pads.data)
