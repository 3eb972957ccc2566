"""From SYNC to messages: the one pipeline behind a live bus and a recorded one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from handtouch.canbus.bus.slab import Slab
from handtouch.daemon.cycle import Cycle
from handtouch.daemon.frames import Frames
from handtouch.daemon.journal import Journal
from handtouch.daemon.messages import Messages, Outlet
from handtouch.daemon.model import PadModel
from handtouch.daemon.scene import Wanted
from handtouch.daemon.tick import Tick, Ticked
from handtouch.daemon.told import Told
from handtouch.hand.robot import Robots
from handtouch.wire import PadState

_FOREVER_NS = np.iinfo(np.int64).max


class Pipeline:
    """Slab, cycle, tick and messages of all hands of a deployment; whoever owns the bus drives it.

    Call `begin` at each SYNC, write samples into `slab`, and `advance` as time passes. `node_state` (n,)
    uint8 is for the owner to keep: PadState.CLEAR where a node is up, else what its pad is instead.
    `run` is the daemon's, for its messages; `robots` tell where links are in palm and base.
    """

    def __init__(
        self,
        model: PadModel,
        period_ns: int,
        window: float,
        outlet: Outlet,
        run: int = 0,
        robots: Robots | None = None,
    ) -> None:
        self.model = model
        self.slab = Slab(model.size)
        self.cycle = Cycle(period_ns, window)
        self.tick = Tick(model, period_ns)
        self.frames = Frames(model.hands, robots)
        self.messages = Messages(model, self.tick, run, self.frames)
        self.node_state: NDArray[np.uint8] = np.full(model.size, PadState.STARTING, dtype=np.uint8)
        self.ticks = 0
        self.frames_every = 1
        """ticks from one frame of a hand to the next"""
        self.stepped: Callable[[], None] = lambda: None
        """called between the step of a tick and its messages, for who watches the time"""
        self.told = Told()
        """what robots tell of forces and gravity; the next cycle takes it in"""
        self._outlet = outlet
        self.journal = Journal(self, run, outlet)
        self.journal.others.update(joints=self.frames.journal, told=self.told.journal)
        self._expected = self.tick.expected()
        self._expected_count = 0

    def want(self, wanted: Wanted) -> None:
        """Compute what somebody wants, and no more."""
        self.tick.want(wanted.located, wanted.weighed, wanted.tolerance_m, wanted.every)
        self.frames.want(wanted.palm, wanted.base)

    def begin(self, t_ns: int, now_ns: int) -> None:
        """A SYNC was sent or seen at `t_ns`: samples that arrived since then belong to it.

        If nobody got round to the tick of the cycle before, that comes first.
        """
        if not self.cycle.ticked:
            self._tick(now_ns, t_ns)
        self.settle()
        self.journal.between(now_ns)
        self.told.apply(self.tick)  # what the state holds already would be given twice
        self.slab.begin_cycle(t_ns)
        self.cycle.begin(t_ns)
        self._expected = self.tick.expected()
        self._expected_count = int(np.count_nonzero(self._expected))

    def advance(self, now_ns: int) -> Ticked | None:
        """Tick and send the messages if all expected samples are there or their window has passed."""
        if not self.cycle.tick_due(now_ns, self._complete()):
            return None
        return self._tick(now_ns, _FOREVER_NS)

    def tick_now(self, now_ns: int) -> Ticked:
        """A cycle without SYNC, for samples that came because something moved."""
        self.begin(now_ns, now_ns)
        return self._tick(now_ns, _FOREVER_NS)

    def tick_again(self, now_ns: int, until_ns: int | None) -> Ticked:
        """A recorded tick; slab, cycle and `node_state` hold what it was made from."""
        self.settle()
        self.told.apply(self.tick)
        return self._tick(now_ns, _FOREVER_NS if until_ns is None else until_ns)

    def adopt(self, model: PadModel, changed: NDArray[np.intp]) -> None:
        """Go on with another model of the same pads, some of them changed; between two ticks."""
        self.model = model
        self.tick.adopt(model, changed)
        self.messages.adopt(model)

    def settle(self) -> None:
        """Do what makes the next tick quick and can wait until messages are out; `begin` does it at last."""
        self.tick.settle()

    def end(self, now_ns: int) -> None:
        """Send the end of every contact, and of every hand a last frame that says so: the daemon stops."""
        self.settle()
        self.messages.end_all(now_ns, self._outlet)
        self.messages.send_frames(self.slab, self.ticks, self.cycle.t_ns, self._outlet)
        self.journal.ticked(now_ns, _FOREVER_NS, stopped=True)

    def _tick(self, now_ns: int, until_ns: int) -> Ticked:
        self.cycle.ticked = True
        self.ticks += 1
        ticked = self.tick.step(self.slab, self.node_state, self.cycle, now_ns, until_ns)
        self.frames.step(ticked, self.tick.columns, self.tick.contacts.id)
        self.stepped()
        self.messages.send_contacts(ticked, now_ns, self._outlet)
        if self.ticks % self.frames_every == 0:
            self.messages.send_frames(self.slab, self.ticks, self.cycle.t_ns, self._outlet)
        self.journal.ticked(now_ns, until_ns)
        return ticked

    def _complete(self) -> bool:
        fresh = self.slab.fresh_count
        if fresh < self._expected_count or self._expected_count == 0:
            return False
        return fresh == self.slab.size or bool(np.all(self.slab.fresh[self._expected]))
