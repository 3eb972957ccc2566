"""Circuit of one pad: its four currents at many times, from contacts, faults and wiring.

Public names: `PadCircuit` (sheet, contacts and wiring), `layer_of`.

The contacts k of a pad share its sheet: V = J_k R_k + sum_l (G_kl + phi_k . Z phi_l) J_l + phi_k . v0, where
R_k is the resistance of a contact with the sheet around it, of grounded electrodes, and phi_k the mean shares
of its current (`solve_patches`); G is Green's function between contacts, Z and v0 `impedance_ohm` and
`idle_v` of `SheetCircuit`. All times with the same set of contacts are solved together.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.simulate.coarse_sheet import cut_sheet_maps, is_beyond_cut
from handtouch.simulate.contact_patch import discs
from handtouch.simulate.faults import Fault, FaultContacts
from handtouch.simulate.mesh_geometry import SimulatedMesh
from handtouch.simulate.mesh_solver import mesh_mutual_resistance
from handtouch.simulate.outline_geometry import SimulatedOutline
from handtouch.simulate.outline_solver import outline_mutual_resistance
from handtouch.simulate.pad_geometry import SimulatedSurface
from handtouch.simulate.sheet_circuit import SheetCircuit, Wiring
from handtouch.simulate.sheet_solver import (
    ArcEnds,
    ElectrodeGaps,
    SheetMapBank,
    SheetMaps,
    mutual_resistance,
)
from handtouch.simulate.solved_contact import ContactLayer, PatchNodes, look_up_nodes, solve_patches
from handtouch.simulate.stimulus import PadStimulus
from handtouch.simulate.unevenness import Unevenness

_MAX_BATCHED_TIMES = 20
_UNIFORM_DISC_RESISTANCE = 0.25
"""Resistance of a disc with uniform current density, besides ln(R / a), in rho / 2 pi."""


def layer_of(sheet: config.Sheet) -> ContactLayer:
    """Return the layer of a sheet's contacts."""
    return ContactLayer(1e-6 * sheet.contact_ohm_mm2, 1e3 * sheet.reference_kpa, sheet.alpha)


@dataclass(frozen=True)
class _ContactSeries:
    """One contact over times (n,)."""

    position: FloatArray
    """(2, n), fractions of the pad."""
    patch: FloatArray
    """(PATCH_ROWS, n), see `ContactPatch`."""
    is_static: bool
    """True if position and patch never change."""
    force_n: FloatArray
    """(n,), that which the layer conducts as; 0 without contact."""
    leak_ohm: FloatArray | None = None
    """(n,), of a leak through the layer instead, infinite without."""

    @property
    def is_touching(self) -> NDArray[np.bool_]:
        return self.force_n > 0 if self.leak_ohm is None else np.isfinite(self.leak_ohm)


@dataclass(frozen=True)
class PadCircuit:
    """Circuit of a pad with its true parts; `gaps` in the coordinates of the surface."""

    shape: SimulatedSurface
    gaps: ElectrodeGaps | ArcEnds
    maps: SheetMaps
    unevenness: Unevenness
    sheet: config.Sheet
    series_ohm: FloatArray
    drive_v: float
    limit_a: FloatArray
    states: tuple[tuple[int, ...], ...] = ()
    """Electrodes that are connected in each state of a schedule; empty: all of them, always."""
    _solved_by_faults: dict[tuple[Fault, ...], tuple[SheetCircuit, SheetMapBank]] = field(
        default_factory=dict
    )
    """By the active faults of wires and sheet."""

    @cached_property
    def healthy(self) -> SheetCircuit:
        """Circuit without faults; of a schedule, its currents in the mean of the states."""
        if self.states:
            circuits = [one.healthy for one in self._state_circuits]
            return SheetCircuit(
                np.mean([one.share_to_channel for one in circuits], axis=0),
                np.mean([one.impedance_ohm for one in circuits], axis=0),
                np.mean([one.idle_a for one in circuits], axis=0),
                np.mean([one.idle_v for one in circuits], axis=0),
            )
        return SheetCircuit.from_wiring(self.maps.conductance, self.sheet.ohm_per_square, self._new_wiring())

    def currents(
        self,
        times_s: FloatArray,
        touches: PadStimulus,
        faults: Sequence[Fault],
        force_ratio: FloatArray,
        supply_ratio: FloatArray | float = 1.0,
    ) -> FloatArray:
        """Return the currents (n, m) [A] that the wires of the electrodes carry to the amplifiers.

        force_ratio: (n,), apparent over true force. supply_ratio: (n,) or (), actual over nominal voltage.
        With a schedule the current of each electrode is that of the state in which it is connected.
        """
        if self.states:
            by_state = [
                one.currents(times_s, touches, faults, force_ratio, supply_ratio)
                for one in self._state_circuits
            ]
            return np.asarray(sum(by_state))  # each electrode is 0 in all states but one
        changes = [fault for fault in faults if _changes_circuit(fault)]
        currents = np.zeros((len(times_s), len(self.series_ohm)))
        active = np.array([fault.is_active(times_s) for fault in changes]).reshape(len(changes), len(times_s))
        for pattern in np.unique(active, axis=1).T if changes else [np.zeros(0, np.bool_)]:
            rows = np.flatnonzero((active == pattern[:, None]).all(0))
            present = [fault for fault, is_active in zip(changes, pattern, strict=True) if is_active]
            currents[rows] = self._currents_with_faults(
                present, times_s[rows], touches, faults, force_ratio[rows]
            )
        return np.asarray(currents * np.reshape(supply_ratio, (-1, 1)))

    @cached_property
    def _state_circuits(self) -> list[PadCircuit]:
        """Circuits of the states of a schedule, each solved by itself."""
        number = np.arange(len(self.series_ohm))
        return [
            dataclasses.replace(
                self,
                series_ohm=np.where(np.isin(number, state), self.series_ohm, np.inf),
                states=(),
                _solved_by_faults={},
            )
            for state in self.states
        ]

    def _currents_with_faults(
        self,
        changes: Sequence[Fault],
        times_s: FloatArray,
        touches: PadStimulus,
        faults: Sequence[Fault],
        force_ratio: FloatArray,
    ) -> FloatArray:
        """Return `currents` at times with the same faults of wires and sheet."""
        key = tuple(changes)
        if key not in self._solved_by_faults:
            self._solved_by_faults[key] = self._build_circuit(changes)
        circuit, bank = self._solved_by_faults[key]
        cuts = [fault.cut_corner for fault in changes if fault.cut_corner]
        contacts = self._collect_contacts(times_s, touches, faults, force_ratio)
        for cut in cuts:
            contacts = [_remove_where(it, is_beyond_cut(self.shape, cut, it.position)) for it in contacts]
        currents = np.repeat(circuit.idle_a[None], len(times_s), axis=0)
        if not contacts:
            return currents
        touching = np.array([contact.is_touching for contact in contacts])
        patterns, pattern_of = np.unique(touching, axis=1, return_inverse=True)
        for number, pattern in enumerate(patterns.T):
            if pattern.any():
                rows = np.flatnonzero(pattern_of.ravel() == number)
                present = [it for it, is_touching in zip(contacts, pattern, strict=True) if is_touching]
                currents[rows] += self._solve_contacts(circuit, bank, present, rows)
        return currents

    def _build_circuit(self, changes: Sequence[Fault]) -> tuple[SheetCircuit, SheetMapBank]:
        wiring, maps = self._new_wiring(), self.maps
        for fault in changes:
            fault.modify_wiring(wiring)
            if fault.cut_corner:
                assert isinstance(self.gaps, ElectrodeGaps)
                maps = cut_sheet_maps(self.shape, self.gaps, maps, fault.cut_corner)
        circuit = SheetCircuit.from_wiring(maps.conductance, self.sheet.ohm_per_square, wiring)
        return circuit, SheetMapBank([maps])

    def _solve_contacts(
        self,
        circuit: SheetCircuit,
        bank: SheetMapBank,
        contacts: Sequence[_ContactSeries],
        rows: NDArray[np.intp],
    ) -> FloatArray:
        """Return the currents (n, m) that contacts cause in the amplifiers at the times `rows`."""
        solved = [self._solve_alone(bank, contact, rows) for contact in contacts]
        shares, own = zip(*solved, strict=True)
        phi = np.stack(shares, axis=1)  # (n, k, m)
        ohm = phi @ circuit.impedance_ohm @ phi.transpose(0, 2, 1)
        number = np.arange(len(contacts))
        ohm[:, number, number] += np.stack(own, axis=1)
        if len(contacts) > 1:
            ohm += self.sheet.ohm_per_square * self._mutual_ohm(contacts, rows)
        volt = self.drive_v - phi @ circuit.idle_v
        current = volt / ohm[:, 0] if len(contacts) == 1 else np.linalg.solve(ohm, volt[:, :, None])[:, :, 0]
        return np.asarray(np.einsum("nk,nki->ni", current, phi) @ circuit.share_to_channel.T)

    def _solve_alone(
        self, bank: SheetMapBank, contact: _ContactSeries, rows: NDArray[np.intp]
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean shares (n, m), and resistances (n,) [ohm] to grounded electrodes, at times `rows`."""
        at = rows[:1] if contact.is_static else rows
        columns = np.concatenate([contact.position[:, at], contact.patch[:, at]])
        columns, number = np.unique(columns, axis=1, return_inverse=True)
        number = np.broadcast_to(number.ravel(), len(rows))
        position, sheet = columns[:2], np.zeros(columns.shape[1], np.intp)
        if contact.leak_ohm is not None:
            values, _ = bank.look_up(sheet, *position)
            spreading = np.maximum(values[-1] - np.log(columns[2]), 0.0) + _UNIFORM_DISC_RESISTANCE
            spreading_ohm = self._local_ohm(position) / (2 * math.pi) * spreading
            return values[:-1].T[number], contact.leak_ohm[rows] + spreading_ohm[number]
        nodes = PatchNodes.of_patches(self.shape, position, columns[2:])
        log_radius, shares = look_up_nodes(bank, sheet, nodes)
        local_ohm = np.broadcast_to(self._local_ohm(position), len(sheet))[number]
        ohm, mean, _ = solve_patches(
            nodes, log_radius, shares, number, contact.force_n[rows], local_ohm, layer_of(self.sheet)
        )
        return mean, ohm

    def _new_wiring(self) -> Wiring:
        return Wiring(self.series_ohm.copy(), self.drive_v, self.limit_a)

    def _mutual_ohm(self, contacts: Sequence[_ContactSeries], rows: NDArray[np.intp]) -> FloatArray:
        """Return mutual resistances (n, k, k) of contacts on 1 ohm per square; 0 on the diagonal."""
        if isinstance(self.shape, SimulatedOutline):
            green = outline_mutual_resistance(self.shape, self.gaps)
        elif isinstance(self.shape, SimulatedMesh):
            green = mesh_mutual_resistance(self.shape, self.gaps)
        else:
            assert isinstance(self.gaps, ElectrodeGaps)
            green = mutual_resistance(self.shape, self.gaps)
        mutual = np.zeros((len(rows), len(contacts), len(contacts)))
        moving: list[tuple[int, int, FloatArray]] = []
        for i, one in enumerate(contacts):
            for j, other in enumerate(contacts[:i]):
                nearest_m = np.maximum(one.patch[0, rows], other.patch[0, rows])
                if one.is_static and other.is_static:
                    positions = (*one.position[:, 0].tolist(), *other.position[:, 0].tolist())
                    mutual[:, [i, j], [j, i]] = green.static_resistance_ohm(*positions, float(nearest_m[0]))
                elif len(rows) > _MAX_BATCHED_TIMES:
                    ohm = green.resistance_ohm(one.position[:, rows], other.position[:, rows], nearest_m)
                    mutual[:, [i, j], [j, i]] = ohm[:, None]
                else:
                    moving.append((i, j, nearest_m))
        if moving:  # few times: all pairs together
            first, second = [i for i, _, _ in moving], [j for _, j, _ in moving]
            one_at = np.concatenate([contacts[i].position[:, rows] for i in first], axis=1)
            other_at = np.concatenate([contacts[j].position[:, rows] for j in second], axis=1)
            limits_m = np.concatenate([nearest_m for _, _, nearest_m in moving])
            ohm = green.resistance_ohm(one_at, other_at, limits_m).reshape(len(moving), -1).T
            mutual[:, first, second] = mutual[:, second, first] = ohm
        return mutual

    def _collect_contacts(
        self, times_s: FloatArray, touches: PadStimulus, faults: Sequence[Fault], force_ratio: FloatArray
    ) -> list[_ContactSeries]:
        position, force, patches = touches.contacts(times_s)
        contacts = [
            _ContactSeries(position[lane], patches[lane], False, force[lane] * force_ratio)
            for lane in range(len(force))
            if force[lane].any()
        ]
        for fault in faults:
            added = fault.contacts(times_s, self.size_m)
            if added is not None:
                contacts += self._fault_contacts(added, len(times_s), force_ratio)
        return contacts

    @staticmethod
    def _fault_contacts(added: FaultContacts, n: int, force_ratio: FloatArray) -> list[_ContactSeries]:
        contacts = []
        for position, radius_m in zip(added.position, added.radius_m, strict=True):
            where = np.repeat(position[:, None], n, axis=1), discs(np.full(n, radius_m)), True
            if added.force_n is not None and added.force_n.any():
                contacts.append(_ContactSeries(*where, added.force_n * force_ratio))
            elif added.conductance_s is not None and added.conductance_s.any():
                with np.errstate(divide="ignore", over="ignore"):
                    leak_ohm = len(added.position) / added.conductance_s
                contacts.append(_ContactSeries(*where, np.zeros(n), leak_ohm))
        return contacts

    def _local_ohm(self, position: FloatArray) -> FloatArray | float:
        """Return the sheet resistance at positions (2, n): (n,), or () on an even sheet."""
        nominal = self.sheet.ohm_per_square
        return nominal if self.unevenness.is_even else nominal * self.unevenness.ohm_ratio(position)

    @property
    def size_m(self) -> tuple[float, float]:
        """Sides along x and y, at the middle of the pad."""
        return self.shape.length_m, self.shape.arc * float(self.shape.radius(self.shape.length_m / 2))


def _changes_circuit(fault: Fault) -> bool:
    """Return whether a fault changes the wires or the sheet."""
    return fault.cut_corner is not None or type(fault).modify_wiring is not Fault.modify_wiring


def _remove_where(contact: _ContactSeries, mask: NDArray[np.bool_]) -> _ContactSeries:
    leak_ohm = None if contact.leak_ohm is None else np.where(mask, np.inf, contact.leak_ohm)
    return dataclasses.replace(contact, force_n=np.where(mask, 0.0, contact.force_n), leak_ohm=leak_ohm)
