"""What lies between a sheet and its four channels: resistors, broken wires, short circuits.

Public names: `Wiring`, `Circuit`.

Electrode i of a sheet with conductances C / rho sits at potential v_i and gives off the current
I = J phi - C v / rho, J phi being what a contact of current J would send to grounded electrodes. Outside, the
nodal equations Y v = I + s hold, s being what other sources feed in. Healthy electrodes have Y = diag(1 / R).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_INPUT_OHM = 1e-3
"""What is left of resistance between an electrode and an amplifier that holds it at ground."""


@dataclass
class Wiring:
    """How a pad is wired; faults change it. Electrodes by number: x0, xa, y0, yb."""

    series_ohm: FloatArray
    drive_v: float
    limit_a: FloatArray
    """(4,) what an amplifier can take; beyond, it no longer holds its electrode at ground."""
    between: list[tuple[int, int, float]] = field(default_factory=list)
    """Short circuits of two electrodes, and their ohms."""
    to_layer: list[tuple[int, float]] = field(default_factory=list)
    """Short circuits of an electrode to the conducting layer, and their ohms."""


@dataclass(frozen=True)
class Circuit:
    """A sheet in its wiring, solved.

    A contact of current J at a place of shares phi sends J `channels` phi into the channels, besides the
    `idle_a` that flow without any contact; it lifts the sheet under a contact of shares phi' by
    J phi' . `lift` phi, besides the `idle_v` . phi' that is there anyway.
    """

    channels: FloatArray
    lift: FloatArray
    idle_a: FloatArray
    idle_v: FloatArray

    @classmethod
    def of(cls, conductance: FloatArray, sheet_ohm: float, wiring: Wiring) -> Circuit:
        """conductance: (4, 4) of a sheet of 1 ohm per square."""
        into = 1 / (wiring.series_ohm + _INPUT_OHM)
        sunk = np.zeros(4)
        circuit = cls._with(conductance / sheet_ohm, into, sunk, wiring)
        beyond = circuit.idle_a > wiring.limit_a
        if beyond.any():  # overdriven amplifiers take what they can, and their electrodes float up
            into, sunk = np.where(beyond, 0.0, into), np.where(beyond, wiring.limit_a, 0.0)
            circuit = cls._with(conductance / sheet_ohm, into, sunk, wiring)
        return circuit

    @classmethod
    def _with(cls, sheet: FloatArray, into: FloatArray, sunk: FloatArray, wiring: Wiring) -> Circuit:
        outside, source = np.diag(into), np.negative(sunk)
        for i, j, ohm in wiring.between:
            outside[[i, j], [i, j]] += 1 / ohm
            outside[[i, j], [j, i]] -= 1 / ohm
        for i, ohm in wiring.to_layer:
            outside[i, i] += 1 / ohm
            source[i] += wiring.drive_v / ohm
        lift = np.asarray(np.linalg.inv(outside + sheet), np.float64)
        idle_v = lift @ source
        return cls(into[:, None] * lift, lift, into * idle_v + sunk, idle_v)
