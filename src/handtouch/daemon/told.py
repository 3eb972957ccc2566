"""What robots told since the last tick, and the next is made from too: forces measured elsewhere, the way of
gravity.

Public name: `Told`. It is given to the tick when a cycle begins, recorded with what the tick is made from,
and recalled by a replay: so no bit differs then, and no state has to be recorded for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from handtouch.supervise.strength import ForceReference

if TYPE_CHECKING:
    from handtouch.daemon.tick import Tick

FloatArray = NDArray[np.float64]


class Told:
    """Waits until `apply`; the latest way of gravity (n, 3) counts, and every force."""

    def __init__(self) -> None:
        self._forces: list[ForceReference] = []
        self._gravity: FloatArray | None = None
        self._used: dict[str, Any] = {}

    def refer(self, reference: ForceReference) -> None:
        """Forces on pads, as something else measured them."""
        self._forces.append(reference)

    def turn(self, gravity: FloatArray) -> None:
        """Direction of gravity in each link's frame (n, 3), of unit length; NaN where nobody knows."""
        self._gravity = gravity

    def apply(self, tick: Tick) -> None:
        """Give it to the tick, between two of its steps."""
        if self._used:
            self._used = {}
        if self._forces:
            self._used["forces"] = [_columns(reference) for reference in self._forces]
            for reference in self._forces:
                tick.refer(reference)
            self._forces = []
        if self._gravity is not None:
            self._used["gravity"] = self._gravity.astype("<f8", copy=False).tobytes()
            tick.turn(self._gravity)
            self._gravity = None

    def journal(self) -> dict[str, Any]:
        """What the next step was given, as msgpack takes it; empty for nothing."""
        return self._used

    def recall(self, told: Mapping[str, Any]) -> None:
        """Take what a `journal` tells."""
        self._forces = [
            ForceReference(
                np.frombuffer(pads, "<i8"), np.frombuffer(force, "<f8"), np.frombuffer(std, "<f8"), t_ns
            )
            for pads, force, std, t_ns in told.get("forces", ())
        ]
        gravity = told.get("gravity")
        self._gravity = None if gravity is None else np.frombuffer(gravity, "<f8").reshape(-1, 3)


def _columns(reference: ForceReference) -> list[Any]:
    pads, force_n, std_n, t_ns = reference
    told = np.asarray(pads, "<i8"), np.asarray(force_n, "<f8"), np.asarray(std_n, "<f8")
    return [*(column.tobytes() for column in told), t_ns]
