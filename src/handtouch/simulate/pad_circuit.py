"""Circuit of one pad: its four currents at many times, from contacts, faults and wiring.

Public names: `PadCircuit` (sheet, contacts and wiring), `contact_layer_ohm`, `layer_ratio`.

The contacts k of a pad share its sheet: V = J_k R_k + sum_l (G_kl + phi_k . Z phi_l) J_l + phi_k . v0, where
R_k is the resistance of a contact with the sheet around it (paper eqs. 9-11), G Green's function between
contacts, Z and v0 `impedance_ohm` and `idle_v` of `SheetCircuit`. All times with the same set of contacts are
solved together.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import i0e, i1e

from handtouch import config
from handtouch.simulate.contact_patch import effective_patch, look_up_patches
from handtouch.simulate.current_crowding import shifted_positions
from handtouch.simulate.faults import Fault, FaultContacts
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
from handtouch.simulate.stimulus import PadStimulus
from handtouch.simulate.torn_sheet import cut_sheet_maps, is_beyond_cut
from handtouch.simulate.unevenness import Unevenness

FloatArray = NDArray[np.float64]
_MIN_FORCE_N = 1e-6  # avoids a division by 0
_MAX_BATCHED_TIMES = 20
_UNIFORM_DISC_RESISTANCE = 0.25
"""Resistance of a disc with uniform current density, besides ln(R / a), in rho / 2 pi."""


def contact_layer_ohm(
    force_n: FloatArray,
    radius_m: FloatArray,
    sheet_ohm: FloatArray | float,
    contact_ohm_m2: FloatArray | float,
    reference_pa: FloatArray | float,
    alpha: FloatArray | float,
) -> FloatArray:
    """Return a disc's resistance [ohm], of layer and sheet under it: eq. 11's first term times rho / 2 pi."""
    x = layer_ratio(force_n, radius_m, sheet_ohm, contact_ohm_m2, reference_pa, alpha)
    return np.asarray(sheet_ohm / (2 * math.pi) * i0e(x) / (x * i1e(x)))  # the scaling cancels


def layer_ratio(
    force_n: FloatArray,
    radius_m: FloatArray,
    sheet_ohm: FloatArray | float,
    contact_ohm_m2: FloatArray | float,
    reference_pa: FloatArray | float,
    alpha: FloatArray | float,
) -> FloatArray:
    """Return x of eq. 11: a disc's radius times the root of the sheet's resistance over the layer's."""
    pressure = np.maximum(force_n, _MIN_FORCE_N) / (math.pi * radius_m**2)
    return np.asarray(radius_m * np.sqrt(sheet_ohm / contact_ohm_m2 * (pressure / reference_pa) ** alpha))


@dataclass(frozen=True)
class _ContactSeries:
    """One contact over times (n,)."""

    position: FloatArray
    """(2, n), fractions of the pad."""
    radius_m: FloatArray
    """(n,), of the equivalent disc."""
    focus: FloatArray
    """(2, n), of its patch, in fractions of the pad; 0: a disc."""
    contact_ohm: FloatArray
    """(n,), of the contact itself, without the sheet around it; infinite without contact."""
    is_static: bool
    """True if its position never changes."""
    layer: FloatArray | None = None
    """(n,), `layer_ratio` of a pressed contact, whose current is the sheet's and the layer's together."""


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
        touching = np.array([np.isfinite(contact.contact_ohm) for contact in contacts])
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
        shares, own = [], []
        for contact in contacts:
            at = rows[:1] if contact.is_static else rows
            sheet = np.zeros(len(at), np.intp)
            values, slopes = look_up_patches(bank, sheet, contact.position[:, at], contact.focus[:, at])
            if contact.layer is not None:
                values[:-1] = self._crowded_shares(bank, contact, at, slopes[-1])
            shares.append(np.broadcast_to(values[:-1].T, (len(rows), len(values) - 1)))
            spreading = np.maximum(values[-1] - np.log(contact.radius_m[rows]), 0.0)
            local_ohm = self._local_ohm(contact.position[:, rows])
            own.append(contact.contact_ohm[rows] + local_ohm / (2 * math.pi) * spreading)
        phi = np.stack(shares, axis=1)  # (n, k, m)
        ohm = phi @ circuit.impedance_ohm @ phi.transpose(0, 2, 1)
        number = np.arange(len(contacts))
        ohm[:, number, number] += np.stack(own, axis=1)
        if len(contacts) > 1:
            ohm += self.sheet.ohm_per_square * self._mutual_ohm(contacts, rows)
        volt = self.drive_v - phi @ circuit.idle_v
        current = volt / ohm[:, 0] if len(contacts) == 1 else np.linalg.solve(ohm, volt[:, :, None])[:, :, 0]
        return np.asarray(np.einsum("nk,nki->ni", current, phi) @ circuit.share_to_channel.T)

    def _crowded_shares(
        self, bank: SheetMapBank, contact: _ContactSeries, at: NDArray[np.intp], slope: FloatArray
    ) -> FloatArray:
        """Return the electrodes' shares of a contact's current at its centre; `slope` (2, k) of ln R."""
        assert contact.layer is not None
        centre = shifted_positions(
            self.shape, contact.position[:, at], slope, contact.radius_m[at], contact.layer[at]
        )
        values, _ = look_up_patches(bank, np.zeros(len(at), np.intp), centre, contact.focus[:, at])
        return values[:-1]

    def _new_wiring(self) -> Wiring:
        return Wiring(self.series_ohm.copy(), self.drive_v, self.limit_a)

    def _mutual_ohm(self, contacts: Sequence[_ContactSeries], rows: NDArray[np.intp]) -> FloatArray:
        """Return mutual resistances (n, k, k) of contacts on 1 ohm per square; 0 on the diagonal."""
        if isinstance(self.shape, SimulatedOutline):
            green = outline_mutual_resistance(self.shape, self.gaps)
        else:
            assert isinstance(self.gaps, ElectrodeGaps)
            green = mutual_resistance(self.shape, self.gaps)
        mutual = np.zeros((len(rows), len(contacts), len(contacts)))
        moving: list[tuple[int, int, float]] = []
        for i, one in enumerate(contacts):
            for j, other in enumerate(contacts[:i]):
                nearest_m = max(one.radius_m[rows[0]], other.radius_m[rows[0]])
                if one.is_static and other.is_static:
                    positions = (*one.position[:, 0].tolist(), *other.position[:, 0].tolist())
                    mutual[:, [i, j], [j, i]] = green.static_resistance_ohm(*positions, float(nearest_m))
                elif len(rows) > _MAX_BATCHED_TIMES:
                    ohm = green.resistance_ohm(
                        one.position[:, rows], other.position[:, rows], np.full(len(rows), nearest_m)
                    )
                    mutual[:, [i, j], [j, i]] = ohm[:, None]
                else:
                    moving.append((i, j, nearest_m))
        if moving:  # few times: all pairs together
            first, second = [i for i, _, _ in moving], [j for _, j, _ in moving]
            one_at = np.concatenate([contacts[i].position[:, rows] for i in first], axis=1)
            other_at = np.concatenate([contacts[j].position[:, rows] for j in second], axis=1)
            limits_m = np.repeat([nearest_m for _, _, nearest_m in moving], len(rows))
            ohm = green.resistance_ohm(one_at, other_at, limits_m).reshape(len(moving), -1).T
            mutual[:, first, second] = mutual[:, second, first] = ohm
        return mutual

    def _collect_contacts(
        self, times_s: FloatArray, touches: PadStimulus, faults: Sequence[Fault], force_ratio: FloatArray
    ) -> list[_ContactSeries]:
        position, force, patches = touches.contacts(times_s)
        contacts = [
            self._pressed_contact(position[lane], patches[lane], force[lane] * force_ratio, False)
            for lane in range(len(force))
            if force[lane].any()
        ]
        for fault in faults:
            added = fault.contacts(times_s, self.size_m)
            if added is not None:
                contacts += self._fault_contacts(added, len(times_s), force_ratio)
        return contacts

    def _fault_contacts(self, discs: FaultContacts, n: int, force_ratio: FloatArray) -> list[_ContactSeries]:
        contacts = []
        disc_ohm = self.sheet.ohm_per_square * _UNIFORM_DISC_RESISTANCE / (2 * math.pi)
        for position, radius_m in zip(discs.position, discs.radius_m, strict=True):
            positions, focus = np.repeat(position[:, None], n, axis=1), np.zeros((2, n))
            radii = np.full(n, radius_m)
            if discs.force_n is not None and discs.force_n.any():
                contacts.append(
                    self._pressed_contact(
                        positions, np.stack([radii, *focus]), discs.force_n * force_ratio, True
                    )
                )
            elif discs.conductance_s is not None and discs.conductance_s.any():
                with np.errstate(divide="ignore", over="ignore"):
                    leak_ohm = len(discs.position) / discs.conductance_s
                contacts.append(_ContactSeries(positions, radii, focus, leak_ohm + disc_ohm, True))
        return contacts

    def _pressed_contact(
        self, position: FloatArray, patch: FloatArray, force_n: FloatArray, is_static: bool
    ) -> _ContactSeries:
        radius_m, (equivalent_m, focus) = patch[0], self.patch_on_sheet(position, patch)
        sheet, own = self.sheet, np.full(len(force_n), np.inf)
        law = 1e-6 * sheet.contact_ohm_mm2, 1e3 * sheet.reference_kpa, sheet.alpha
        on = force_n > 0
        own[on] = contact_layer_ohm(force_n[on], radius_m[on], self._local_ohm(position[:, on]), *law)
        layer = layer_ratio(force_n, radius_m, self._local_ohm(position), *law) if sheet.crowding else None
        is_static = is_static and (layer is None or np.ptp(layer) == 0.0)
        return _ContactSeries(position, equivalent_m, focus, own, is_static, layer)

    def _local_ohm(self, position: FloatArray) -> FloatArray | float:
        """Return the sheet resistance at positions (2, n): (n,), or () on an even sheet."""
        nominal = self.sheet.ohm_per_square
        return nominal if self.unevenness.is_even else nominal * self.unevenness.ohm_ratio(position)

    def patch_on_sheet(self, position: FloatArray, patch: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return equivalent radii (n,) [m], and foci (2, n) as fractions, of patches (3, n) [m]."""
        radius_m, focus_m = effective_patch(patch[0], patch[1:], self.shape.stretch)
        if not focus_m.any():
            return radius_m, focus_m
        return radius_m, self.shape.fractions_of(position, focus_m)

    @property
    def size_m(self) -> tuple[float, float]:
        """Sides along x and y, at the middle of the pad."""
        return self.shape.length_m, self.shape.arc * float(self.shape.radius(self.shape.length_m / 2))


def _changes_circuit(fault: Fault) -> bool:
    """Return whether a fault changes the wires or the sheet."""
    return fault.cut_corner is not None or type(fault).modify_wiring is not Fault.modify_wiring


def _remove_where(contact: _ContactSeries, mask: NDArray[np.bool_]) -> _ContactSeries:
    contact_ohm = np.where(mask, np.inf, contact.contact_ohm)
    return dataclasses.replace(contact, contact_ohm=contact_ohm)
