"""Cache warming: a dry run of the next tick shortly before samples arrive.

After milliseconds of sleep a tick takes two to four times as long as right after another one.

Public name: `CacheWarmer`.
"""

from __future__ import annotations

from handtouch.core.contacts import IntArray
from handtouch.core.pipeline import Pipeline
from handtouch.core.tick import FloatArray, TickProcessor
from handtouch.core.tick_messages import MessageSink


class CacheWarmer:
    """Dry runs of a pipeline's tick; they change nothing in it and send nothing."""

    def __init__(self, pipeline: Pipeline, sink: MessageSink) -> None:
        self._pipeline, self._sink = pipeline, sink
        self._dry_run = _DryRunTick(pipeline.tick)

    def warm_all(self) -> None:
        """Warm tick, transforms and messages, just before samples arrive."""
        self._pipeline.transforms.warm_caches()
        self.warm_tick()

    def warm_tick(self) -> None:
        """Warm the tick and its messages."""
        pipeline = self._pipeline
        pipeline.messages.warm_caches(self._sink)
        if self._dry_run.model is not pipeline.tick.model:
            self._dry_run = _DryRunTick(pipeline.tick)
        self._dry_run.copy_state(pipeline.tick)
        self._dry_run.run_tick(pipeline.slab, pipeline.node_state, pipeline.cycle, pipeline.cycle.sync_ns)


class _DryRunTick(TickProcessor):
    """A tick on the present state of another one, without its rare branches."""

    def __init__(self, tick: TickProcessor) -> None:
        super().__init__(tick.model, int(tick.max_sample_period_ns.max()))
        self.sheet_force.any_modelled = False

    def copy_state(self, tick: TickProcessor) -> None:
        """Copy another tick's state, with every sample marked new."""
        self.contacts.copy_state(tick.contacts)
        self.linearisations.copy_state(tick.linearisations)
        self.baseline.expected_counts[:] = tick.baseline.expected_counts
        self.columns.state[:] = tick.columns.state
        self.position_requested, self._update_interval_ticks, self._some_skipped = (
            tick.position_requested,
            tick._update_interval_ticks,
            tick._some_skipped,
        )
        self._used_arrival_ns[:] = -1

    def _solve_outside_range(
        self, pads: IntArray, currents: FloatArray, values: FloatArray, off: FloatArray
    ) -> None:
        pass
