"""Circuit between a sheet and its channels: resistors, broken wires, short circuits.

Public names: `Wiring`, `SheetCircuit`.

The electrodes of a sheet with conductances C / rho are at potentials v and deliver the currents
I = J phi - C v / rho, where J phi is what a contact of current J delivers to grounded electrodes. Outside,
the nodal equations Y v = I + s hold, where s are the currents of other sources. Healthy electrodes have
Y = diag(1 / R).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from handtouch.arrays import FloatArray

_AMPLIFIER_INPUT_OHM = 1e-3
"""Input resistance of an amplifier that holds its electrode at ground."""


@dataclass
class Wiring:
    """Wiring of a pad of m electrodes, which faults modify."""

    series_ohm: FloatArray
    drive_v: float
    limit_a: FloatArray
    """(m,), maximum currents of the amplifiers; beyond, an electrode is no longer held at ground."""
    electrode_shorts: list[tuple[int, int, float]] = field(default_factory=list)
    """Short circuits between two electrodes, with their resistance."""
    layer_shorts: list[tuple[int, float]] = field(default_factory=list)
    """Short circuits of an electrode to the conducting layer, with their resistance."""


@dataclass(frozen=True)
class SheetCircuit:
    """Solved circuit of a sheet in its wiring.

    A contact of current J at a position of shares phi adds J `share_to_channel` phi to the channels'
    currents, which are `idle_a` without contact. At another position, of shares phi', it adds
    J phi' . `impedance_ohm` phi to the sheet's potential, which is `idle_v` . phi' without contact.
    """

    share_to_channel: FloatArray
    impedance_ohm: FloatArray
    idle_a: FloatArray
    idle_v: FloatArray

    @classmethod
    def from_wiring(cls, conductance: FloatArray, sheet_ohm: float, wiring: Wiring) -> SheetCircuit:
        """Solve the circuit; conductance: (m, m), of the sheet with 1 ohm per square."""
        into = 1 / (wiring.series_ohm + _AMPLIFIER_INPUT_OHM)
        sunk = np.zeros(len(into))
        circuit = cls._solve_nodal(conductance / sheet_ohm, into, sunk, wiring)
        beyond = circuit.idle_a > wiring.limit_a
        if beyond.any():  # overdriven amplifiers sink their maximum, and their electrodes float
            into, sunk = np.where(beyond, 0.0, into), np.where(beyond, wiring.limit_a, 0.0)
            circuit = cls._solve_nodal(conductance / sheet_ohm, into, sunk, wiring)
        return circuit

    @classmethod
    def _solve_nodal(
        cls, sheet: FloatArray, into: FloatArray, sunk: FloatArray, wiring: Wiring
    ) -> SheetCircuit:
        outside, source = np.diag(into), np.negative(sunk)
        for i, j, ohm in wiring.electrode_shorts:
            outside[[i, j], [i, j]] += 1 / ohm
            outside[[i, j], [j, i]] -= 1 / ohm
        for i, ohm in wiring.layer_shorts:
            outside[i, i] += 1 / ohm
            source[i] += wiring.drive_v / ohm
        impedance_ohm = np.asarray(np.linalg.inv(outside + sheet), np.float64)
        idle_v = impedance_ohm @ source
        return cls(into[:, None] * impedance_ohm, impedance_ohm, into * idle_v + sunk, idle_v)
