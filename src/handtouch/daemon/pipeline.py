"""From SYNC to messages: the one pipeline behind a live bus and a recorded one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtouch.canbus.slab import Slab
from handtouch.daemon.cycle import Cycle
from handtouch.daemon.messages import Messages, Outlet
from handtouch.daemon.model import PadModel
from handtouch.daemon.tick import Tick, Ticked


class Pipeline:
    """Slab, cycle, tick and messages of all hands of a deployment; whoever owns the bus drives it.

    Call `begin` at each SYNC, write samples into `slab`, and `advance` as time passes.
    """

    def __init__(self, model: PadModel, period_ns: int, window: float, outlet: Outlet) -> None:
        self.model = model
        self.slab = Slab(model.size)
        self.cycle = Cycle(period_ns, window)
        self.tick = Tick(model, period_ns)
        self.messages = Messages(model, self.tick)
        self.ticks = 0
        self._outlet = outlet
        self._expected = self.tick.expected()
        self._expected_count = 0

    def begin(self, t_ns: int) -> None:
        """A SYNC was sent or seen at `t_ns`: samples from here on belong to it."""
        self.slab.begin_cycle()
        self.cycle.begin(t_ns)
        self._expected = self.tick.expected()
        self._expected_count = int(np.count_nonzero(self._expected))

    def advance(self, now_ns: int, node_state: NDArray[np.uint8]) -> Ticked | None:
        """Tick and send the messages if all expected samples are there or their window has passed."""
        if not self.cycle.tick_due(now_ns, self._complete()):
            return None
        self.cycle.ticked = True
        self.ticks += 1
        ticked = self.tick.step(self.slab, node_state, self.cycle.t_ns, self.cycle.previous_ns, now_ns)
        self.messages.send_contacts(ticked, now_ns, self._outlet)
        self.messages.send_frames(self.slab, self.ticks, self.cycle.t_ns, self._outlet)
        return ticked

    def _complete(self) -> bool:
        fresh = self.slab.fresh_count
        if fresh < self._expected_count or self._expected_count == 0:
            return False
        return fresh == self.slab.size or bool(np.all(self.slab.fresh[self._expected]))
