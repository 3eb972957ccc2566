"""The hand on its buses, as commissioning sees it: every node brought up, samples by the SYNC.

Public names: `Bench`, `Sample`, `as_wired`.
"""

from __future__ import annotations

import contextlib
import select
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.canbus.bus.port import Port
from handtouch.canbus.bus.router import SYNC_ID
from handtouch.canbus.bus.slab import Slab
from handtouch.canbus.bus.sync import Sync
from handtouch.canbus.nodes.life import NodeState
from handtouch.canbus.nodes.master import STALE_PERIODS, Master
from handtouch.canbus.nodes.spec import NodeStatus, node_specs
from handtouch.canbus.objects.channels import ELECTRODES

from .edit import Edit, applied

_HELD_NS = 100_000_000  # a sample that is late or lost doesn't end a press


def as_wired(deployment: config.Deployment) -> config.Deployment:
    """The deployment with each node's channels in the node's own order, and any serial number allowed."""
    edits = {
        (hand.name, pad.link): replace(Edit.of(pad), serial=None, electrodes=ELECTRODES)
        for hand in deployment.hands
        for pad in hand.pads
    }
    return applied(deployment, edits)


@dataclass(frozen=True)
class Sample:
    """The latest counts (n, 4) at a SYNC, in the order of each node's channels; `alive` (n,): not too old."""

    t_ns: int
    counts: NDArray[np.int64]
    alive: NDArray[np.bool_]


class Bench:
    """Opens the buses of a deployment and serves its nodes as long as `samples` is iterated.

    Slots are the pads in the order of the file. Raises BusError, and EdsError for an EDS that can't be used.
    """

    def __init__(self, deployment: config.Deployment) -> None:
        deployment = as_wired(deployment)
        specs = node_specs(deployment)
        period_ns = round(deployment.daemon.sync_period_ms * 1e6)
        self._slab = Slab(len(specs))
        with contextlib.ExitStack() as opened:
            self._ports: dict[str, Port] = {}
            for bus in deployment.buses:
                self._ports[bus.name] = port = Port.open(bus, self._slab)
                opened.callback(port.close)
            self._master = Master(self._ports, specs, period_ns)
            self._opened = opened.pop_all()
        self._held_ns = max(_HELD_NS, STALE_PERIODS * period_ns)
        self._sync = Sync(list(self._ports.values()), period_ns)

    def __enter__(self) -> Bench:
        now_ns = time.monotonic_ns()
        self._master.start(now_ns)
        self._sync.start(now_ns)
        return self

    def __exit__(self, *_: object) -> None:
        """Nodes are stopped, buses given back."""
        self._sync.stop()
        self._master.stop(time.monotonic_ns())
        self._opened.close()

    @property
    def nodes(self) -> list[NodeStatus]:
        """What is known of each node."""
        return self._master.status()

    @property
    def problems(self) -> list[str]:
        """What is wrong with the buses."""
        return [f"bus {name}: {port.problem}" for name, port in self._ports.items() if port.problem]

    def samples(self) -> Iterator[Sample]:
        """A sample every SYNC period, whether or not a node answers, without end."""
        while True:
            now_ns = time.monotonic_ns()
            if (sync_ns := self._sync.poll(now_ns)) is not None:
                yield self._cycle(sync_ns)
            wait_s = max(0, self._sync.wake_ns - time.monotonic_ns()) * 1e-9
            select.select(list(self._ports.values()), (), (), wait_s)
            for port in self._ports.values():
                for can_id, data, t_ns in port.drain():
                    if can_id != SYNC_ID:
                        self._master.handle(port.name, can_id, data, t_ns)
                    elif (seen_ns := self._sync.seen(port.name, t_ns, time.monotonic_ns())) is not None:
                        yield self._cycle(seen_ns)
            now_ns = time.monotonic_ns()
            self._master.poll(now_ns)
            for port in self._ports.values():
                port.look(now_ns)

    def _cycle(self, t_ns: int) -> Sample:
        """What the period that ends now has brought."""
        started = np.isin(self._master.states, (NodeState.OPERATIONAL, NodeState.STALE))
        alive = started & (t_ns - self._slab.t_ns < self._held_ns)
        sample = Sample(t_ns, self._slab.read().copy(), alive)
        self._slab.begin_cycle(t_ns)
        return sample
