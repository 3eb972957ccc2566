"""Nodes on the buses of a deployment that sense the contacts of a MuJoCo simulation, for the real daemon.

Public name: `TactileNodes`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.canbus.bus.port import open_bus
from handtouch.simulate.simulated_hand import NodesOnBus
from handtouch.simulate.tactile.mujoco_contacts import NO_POINTS, ContactReader
from handtouch.simulate.tactile.simulated_pads import SimulatedPads
from handtouch.simulate.worlds import World, world_named


class TactileNodes:
    """The nodes of a deployment, whose pads are on the links of a MuJoCo model; use it in a `with` block.

    `world`, `seed` and `bodies` are those of `TactileSensor`. Call `update` after each step; a node answers
    SYNC with the contacts of the last call. All pads must be on one bus, which `handtouch run` opens, too.

    Raises ValueError for an unknown world, a link without a body or pads on several buses, BusError for a bus
    that can't be opened.
    """

    def __init__(
        self,
        deployment: config.Deployment,
        model: Any,
        world: str | World = "default",
        seed: int = 1,
        *,
        bodies: Mapping[str, str] | None = None,
    ) -> None:
        names = {entry.pad.bus for entry in deployment.pads}
        if len(names) > 1:
            raise ValueError(f"pads are on the buses {', '.join(sorted(names))}: must be on one")
        self._period_s = 1e-3 * deployment.daemon.sync_period_ms
        self._reader = ContactReader([entry.pad for entry in deployment.pads], model, bodies or {})
        self._pads = SimulatedPads(deployment, world_named(world).draw(seed), 1, self._period_s)
        self._contacts, self._samples = NO_POINTS, 0
        with contextlib.ExitStack() as stack:
            port = open_bus(next(bus for bus in deployment.buses if bus.name in names))
            stack.callback(port.shutdown)
            self._nodes = NodesOnBus(deployment, deployment.pads, port, self._sample)
            self._stack = stack.pop_all()

    def update(self, data: Any | None) -> None:
        """Sense the contacts of an MjData, after `mj_step`; None: nothing touches."""
        self._contacts = NO_POINTS if data is None else self._reader.read([data])

    def __enter__(self) -> Self:
        self._nodes.bus.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._nodes.bus.stop()
        self._stack.close()

    def _sample(self, sync_ns: int) -> NDArray[np.int64]:  # noqa: ARG002
        self._samples += 1
        counts: NDArray[np.int64] = self._pads.sample(self._samples * self._period_s, self._contacts)[0]
        return counts
