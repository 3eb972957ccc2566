"""Inputs of a tick besides samples: reference forces measured elsewhere, and the direction of gravity.

Public name: `ExternalInputs`. They are applied when a cycle begins and recorded with the inputs of its tick,
so that a replay applies them at the same point and is exact bit for bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from handtouch.core.sheet_force import ForceReference

FloatArray = NDArray[np.float64]


class _Tick(Protocol):
    """The part of `TickProcessor` that receives external inputs."""

    def update_force_gains(self, reference: ForceReference) -> int: ...
    def set_gravity(self, gravity: FloatArray) -> None: ...


class ExternalInputs:
    """Inputs received since the last cycle began: every reference force, and the latest gravity (n, 3)."""

    def __init__(self) -> None:
        self._forces: list[ForceReference] = []
        self._gravity: FloatArray | None = None
        self._applied: dict[str, Any] = {}

    def add_force_reference(self, reference: ForceReference) -> None:
        """Add forces on pads, measured by another sensor."""
        self._forces.append(reference)

    def set_gravity(self, gravity: FloatArray) -> None:
        """Set the unit direction of gravity in each link's frame (n, 3), NaN where unknown."""
        self._gravity = gravity

    def apply(self, tick: _Tick) -> None:
        """Apply the inputs to the tick's state, between two ticks."""
        if self._applied:
            self._applied = {}
        if self._forces:
            self._applied["forces"] = [_encoded_reference(reference) for reference in self._forces]
            for reference in self._forces:
                tick.update_force_gains(reference)
            self._forces = []
        if self._gravity is not None:
            self._applied["gravity"] = self._gravity.astype("<f8", copy=False).tobytes()
            tick.set_gravity(self._gravity)
            self._gravity = None

    def recorded_inputs(self) -> dict[str, Any]:
        """Return the inputs applied last, as msgpack values; empty if none were."""
        return self._applied

    def replay_inputs(self, recorded: Mapping[str, Any]) -> None:
        """Set the inputs from a record of `recorded_inputs`."""
        self._forces = [
            ForceReference(
                np.frombuffer(pads, "<i8"),
                np.frombuffer(force, "<f8"),
                np.frombuffer(std, "<f8"),
                measured_ns,
            )
            for pads, force, std, measured_ns in recorded.get("forces", ())
        ]
        gravity = recorded.get("gravity")
        self._gravity = None if gravity is None else np.frombuffer(gravity, "<f8").reshape(-1, 3)


def _encoded_reference(reference: ForceReference) -> list[Any]:
    pads, force_n, std_n, measured_ns = reference
    columns = np.asarray(pads, "<i8"), np.asarray(force_n, "<f8"), np.asarray(std_n, "<f8")
    return [*(column.tobytes() for column in columns), measured_ns]
