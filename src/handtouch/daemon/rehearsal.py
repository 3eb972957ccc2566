"""Rehearses the next tick with what is there, to have all that it goes through in the caches.

After milliseconds of sleep a tick takes two to four times as long as right after another one.

Public names: `Rehearsal`.
"""

from __future__ import annotations

from handtouch.daemon.contacts import IntArray
from handtouch.daemon.messages import Outlet
from handtouch.daemon.pipeline import Pipeline
from handtouch.daemon.tick import FloatArray, Tick


class Rehearsal:
    """Of a pipeline: changes nothing of it, and sends nothing."""

    def __init__(self, pipeline: Pipeline, outlet: Outlet) -> None:
        self._pipeline, self._outlet = pipeline, outlet
        self._tick = _Double(pipeline.tick)

    def all(self) -> None:
        """Samples are about to come."""
        self._pipeline.frames.rehearse()
        self.tick()

    def tick(self) -> None:
        """From samples to contacts, and their messages."""
        pipeline = self._pipeline
        pipeline.messages.rehearse(self._outlet)
        if self._tick.model is not pipeline.tick.model:
            self._tick = _Double(pipeline.tick)
        self._tick.follow(pipeline.tick)
        self._tick.step(pipeline.slab, pipeline.node_state, pipeline.cycle, pipeline.cycle.t_ns)


class _Double(Tick):
    """Goes the way of another tick's next step; what is rare it leaves out."""

    def __init__(self, tick: Tick) -> None:
        super().__init__(tick.model, int(tick.period_ns.max()))
        self.strength.any = False

    def follow(self, tick: Tick) -> None:
        """Begin where the other one is, as if every sample were new."""
        self.contacts.imitate(tick.contacts)
        self.follower.imitate(tick.follower)
        self.baseline.expected[:] = tick.baseline.expected
        self.columns.state[:] = tick.columns.state
        self.wanted, self._every, self._sparse = tick.wanted, tick._every, tick._sparse
        self._taken_ns[:] = -1

    def _solve_anew(self, pads: IntArray, currents: FloatArray, values: FloatArray, off: FloatArray) -> None:
        pass
