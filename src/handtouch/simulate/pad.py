"""One pad over many times at once: what its contacts, its faults and its wiring make of its four currents.

Public names: `PadCircuit` (sheet, contacts and wiring), `layer_ohm`.

The contacts k of a pad share its sheet: V = J_k R_k + sum_l (G_kl + phi_k . lift phi_l) J_l + phi_k . v0, R_k
being the resistance of a contact with the sheet around it (paper eqs. 9-11), G Green's function between
contacts, lift and v0 those of `Circuit`. All times with the same set of contacts are solved together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import i0e, i1e

from handtouch import config
from handtouch.simulate.circuit import Circuit, Wiring
from handtouch.simulate.faults import Contacts, Fault
from handtouch.simulate.play import OnPad
from handtouch.simulate.shape import Shape
from handtouch.simulate.sheet import Gaps, SheetBank, SheetMaps, mutual
from handtouch.simulate.tear import beyond, torn

FloatArray = NDArray[np.float64]
_SILENT_N = 1e-6  # less is nothing, and would divide by nothing
_FEW = 20
_EVEN_DISC = 0.25  # resistance of a disc that feeds its current evenly, beside ln(R / a), in rho / 2 pi


def layer_ohm(
    force_n: FloatArray,
    radius_m: FloatArray,
    sheet_ohm: FloatArray | float,
    contact_ohm_m2: FloatArray | float,
    reference_pa: FloatArray | float,
    alpha: FloatArray | float,
) -> FloatArray:
    """rho / 2 pi times the first term of eq. 11: a disc's own resistance [ohm], layer and sheet under it."""
    pressure = np.maximum(force_n, _SILENT_N) / (math.pi * radius_m**2)
    x = radius_m * np.sqrt(sheet_ohm / contact_ohm_m2 * (pressure / reference_pa) ** alpha)
    return np.asarray(sheet_ohm / (2 * math.pi) * i0e(x) / (x * i1e(x)))  # the scaling cancels


@dataclass(frozen=True)
class _Spot:
    """One contact over times (n,)."""

    place: FloatArray
    """(2, n), fractions of the pad."""
    radius_m: FloatArray
    own_ohm: FloatArray
    """(n,) of the contact itself, without the sheet around it; infinite where it isn't there."""
    rests: bool
    """Whether its place never changes."""


@dataclass(frozen=True)
class PadCircuit:
    """A pad as it was built; `shape` and `gaps` in the coordinates of the shape."""

    shape: Shape
    gaps: Gaps
    maps: SheetMaps
    sheet: config.Sheet
    series_ohm: FloatArray
    drive_v: float
    limit_a: FloatArray
    _made: dict[tuple[Fault, ...], tuple[Circuit, SheetBank]] = field(default_factory=dict)
    """By what is wrong with wires and sheet."""

    @cached_property
    def healthy(self) -> Circuit:
        """Its circuit as long as nothing is wrong with it."""
        return Circuit.of(self.maps.conductance, self.sheet.ohm_per_square, self._wiring())

    def currents(
        self,
        times_s: FloatArray,
        touches: OnPad,
        faults: Sequence[Fault],
        yields: FloatArray,
        drive: FloatArray | float = 1.0,
    ) -> FloatArray:
        """Currents (n, 4) [A] that the wires of x0, xa, y0, yb bring to the amplifiers.

        yields: (n,) apparent over true force. drive: (n,) or () the potential, relative to what it should be.
        """
        changes = [fault for fault in faults if _changes(fault)]
        found = np.zeros((len(times_s), 4))
        active = np.array([fault.active(times_s) for fault in changes]).reshape(len(changes), len(times_s))
        for pattern in np.unique(active, axis=1).T if changes else [np.zeros(0, np.bool_)]:
            at = np.flatnonzero((active == pattern[:, None]).all(0))
            now = [fault for fault, there in zip(changes, pattern, strict=True) if there]
            found[at] = self._under(now, times_s[at], touches, faults, yields[at])
        return np.asarray(found * np.reshape(drive, (-1, 1)))

    def _under(
        self,
        changes: Sequence[Fault],
        times_s: FloatArray,
        touches: OnPad,
        faults: Sequence[Fault],
        yields: FloatArray,
    ) -> FloatArray:
        """`currents` as long as nothing about wires and sheet changes."""
        key = tuple(changes)
        if key not in self._made:
            self._made[key] = self._make(changes)
        circuit, bank = self._made[key]
        cuts = [fault.cut for fault in changes if fault.cut]
        spots = self._spots(times_s, touches, faults, yields)
        for cut in cuts:
            spots = [_without(spot, beyond(self.shape, cut, spot.place)) for spot in spots]
        found = np.repeat(circuit.idle_a[None], len(times_s), axis=0)
        if not spots:
            return found
        there = np.array([np.isfinite(spot.own_ohm) for spot in spots])
        kinds, which = np.unique(there, axis=1, return_inverse=True)
        for number, kind in enumerate(kinds.T):
            if kind.any():
                at = np.flatnonzero(which.ravel() == number)
                together = [spot for spot, is_there in zip(spots, kind, strict=True) if is_there]
                found[at] += self._solve(circuit, bank, together, at)
        return found

    def _make(self, changes: Sequence[Fault]) -> tuple[Circuit, SheetBank]:
        wiring, maps = self._wiring(), self.maps
        for fault in changes:
            fault.rewire(wiring)
            if fault.cut:
                maps = torn(self.shape, self.gaps, maps, fault.cut)
        return Circuit.of(maps.conductance, self.sheet.ohm_per_square, wiring), SheetBank([maps])

    def _solve(
        self, circuit: Circuit, bank: SheetBank, spots: Sequence[_Spot], at: NDArray[np.intp]
    ) -> FloatArray:
        """Currents (n, 4) that contacts bring to the amplifiers at the times `at`."""
        sheet_ohm = self.sheet.ohm_per_square
        shares, own = [], []
        for spot in spots:
            place = spot.place[:, :1] if spot.rests else spot.place[:, at]
            values, _ = bank.look_up(np.zeros(place.shape[1], np.intp), *place)
            shares.append(np.broadcast_to(values[:4].T, (len(at), 4)))
            around = np.maximum(values[4] - np.log(spot.radius_m[at]), 0.0)
            own.append(spot.own_ohm[at] + sheet_ohm / (2 * math.pi) * around)
        phi = np.stack(shares, axis=1)  # (n, k, 4)
        ohm = phi @ circuit.lift @ phi.transpose(0, 2, 1)
        number = np.arange(len(spots))
        ohm[:, number, number] += np.stack(own, axis=1)
        if len(spots) > 1:
            ohm += sheet_ohm * self._between(spots, at)
        volt = self.drive_v - phi @ circuit.idle_v
        current = volt / ohm[:, 0] if len(spots) == 1 else np.linalg.solve(ohm, volt[:, :, None])[:, :, 0]
        return np.asarray(np.einsum("nk,nki->ni", current, phi) @ circuit.channels.T)

    def _wiring(self) -> Wiring:
        return Wiring(self.series_ohm.copy(), self.drive_v, self.limit_a)

    def _between(self, spots: Sequence[_Spot], at: NDArray[np.intp]) -> FloatArray:
        """Mutual resistances (n, k, k) of contacts on 1 ohm per square; 0 on the diagonal."""
        green = mutual(self.shape, self.gaps)
        found = np.zeros((len(at), len(spots), len(spots)))
        moving = []
        for i, one in enumerate(spots):
            for j, other in enumerate(spots[:i]):
                nearest = max(one.radius_m[at[0]], other.radius_m[at[0]])
                if one.rests and other.rests:
                    places = (*one.place[:, 0].tolist(), *other.place[:, 0].tolist())
                    found[:, [i, j], [j, i]] = green.resting(*places, float(nearest))
                elif len(at) > _FEW:
                    ohm = green.ohm(one.place[:, at], other.place[:, at], np.full(len(at), nearest))
                    found[:, [i, j], [j, i]] = ohm[:, None]
                else:
                    moving.append((i, j, nearest))
        if moving:  # few times: all pairs together
            first, second, nearest_m = zip(*moving, strict=True)
            one_at = np.concatenate([spots[i].place[:, at] for i in first], axis=1)
            other_at = np.concatenate([spots[j].place[:, at] for j in second], axis=1)
            ohm = green.ohm(one_at, other_at, np.repeat(nearest_m, len(at))).reshape(len(moving), -1).T
            found[:, first, second] = found[:, second, first] = ohm
        return found

    def _spots(
        self, times_s: FloatArray, touches: OnPad, faults: Sequence[Fault], yields: FloatArray
    ) -> list[_Spot]:
        place, force, radius = touches.contacts(times_s)
        spots = [
            self._pressed(place[lane], radius[lane], force[lane] * yields, False)
            for lane in range(len(force))
            if force[lane].any()
        ]
        for fault in faults:
            found = fault.contacts(times_s, self.size_m)
            if found is not None:
                spots += self._of(found, len(times_s), yields)
        return spots

    def _of(self, contacts: Contacts, n: int, yields: FloatArray) -> list[_Spot]:
        spots = []
        for place, radius_m in zip(contacts.place, contacts.radius_m, strict=True):
            places, radii = np.repeat(place[:, None], n, axis=1), np.full(n, radius_m)
            if contacts.force_n is not None and contacts.force_n.any():
                spots.append(self._pressed(places, radii, contacts.force_n * yields, True))
            elif contacts.siemens is not None and contacts.siemens.any():
                with np.errstate(divide="ignore"):
                    ohm = len(contacts.place) / contacts.siemens
                spots.append(
                    _Spot(places, radii, ohm + self.sheet.ohm_per_square * _EVEN_DISC / (2 * math.pi), True)
                )
        return spots

    def _pressed(self, place: FloatArray, radius_m: FloatArray, force_n: FloatArray, rests: bool) -> _Spot:
        sheet, own = self.sheet, np.full(len(force_n), np.inf)
        on = force_n > 0
        own[on] = layer_ohm(
            force_n[on],
            radius_m[on],
            sheet.ohm_per_square,
            1e-6 * sheet.contact_ohm_mm2,
            1e3 * sheet.reference_kpa,
            sheet.alpha,
        )
        return _Spot(place, radius_m, own, rests)

    @property
    def size_m(self) -> tuple[float, float]:
        """Sides along x and y, at the middle of the pad."""
        return self.shape.length_m, self.shape.arc * float(self.shape.radius(self.shape.length_m / 2))


def _changes(fault: Fault) -> bool:
    """Whether it changes the wires or the sheet."""
    return fault.cut is not None or type(fault).rewire is not Fault.rewire


def _without(spot: _Spot, where: NDArray[np.bool_]) -> _Spot:
    return _Spot(spot.place, spot.radius_m, np.where(where, np.inf, spot.own_ohm), spot.rests)
