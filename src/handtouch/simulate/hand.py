"""A virtual hand: touches of a scenario -> counts of every pad's channels, and the truth behind them.

Public name: `VirtualHand`. No clock and no state: the same time gives the same sample.

A contact feeds V = J [R_contact + R_sheet + sum_i phi_i R_i m_i] into its sheet, J being its current, phi the
shares of `SheetMaps`, R_i the resistors and m = (1 + G R / rho)^-1 phi what the electrodes then collect of
it. The contact is a disc of radius A with the resistance of eq. 9-11 of the paper, its outer radius the
conformal one; the disc's location counts as its centre, exact by the mean-value property as long as it lies
on the sheet.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch import config
from handtouch.simulate import noise
from handtouch.simulate.built import BuiltPad
from handtouch.simulate.faults import Fault
from handtouch.simulate.pad import layer_ohm
from handtouch.simulate.play import Play, Pressing
from handtouch.simulate.sheet import SheetBank
from handtouch.simulate.truth import Truth, Vector
from handtouch.simulate.world import Climate, World

FloatArray = NDArray[np.float64]
_QUANTISATION_VARIANCE = 1 / 12  # of a rounded count


class VirtualHand:
    """The pads of a deployment, or those on one bus of it, under a scenario in a world.

    Rows are the pads in the order of the file: `pads` are (hand's name, pad). Besides the scenario's own,
    `faults` befall it.
    """

    def __init__(
        self,
        deployment: config.Deployment,
        scenario: Play,
        world: World,
        bus: str | None = None,
        faults: Sequence[Fault] = (),
    ) -> None:
        self.pads = [
            (hand.name, pad) for hand in deployment.hands for pad in hand.pads if bus in (None, pad.bus)
        ]
        self._scenario = scenario
        acting = (*scenario.faults, *faults)
        self._rows = [BuiltPad.of(deployment, hand, pad, scenario, world, acting) for hand, pad in self.pads]
        self._bank = SheetBank([row.circuit.maps for row in self._rows])
        self._electric = _Electric(self._rows)
        self._noise = np.array([row.noise_counts for row in self._rows])
        self._keys = np.array([row.keys for row in self._rows]).reshape(-1, 4)
        self._gains = np.array([row.counts_per_ampere for row in self._rows])
        limits = np.array([row.limits for row in self._rows])
        self._low, self._high = limits[:, :, 0], limits[:, :, 1]
        self._calls = 0
        self._climate = Climate(world, [(row.hand, row.pad.link) for row in self._rows])
        self._special = [number for number, row in enumerate(self._rows) if row.faults or row.swapped]
        self._contacts = [
            [
                (number, radius_m or 1e-3 * world.radius_mm(row.sheet, index))
                for number, row in enumerate(self._rows)
                if row.pad.link == link
            ]
            for index, (link, radius_m) in enumerate(scenario.links)
        ]

    def sample(self, t_s: float) -> NDArray[np.int64]:
        """Counts (pads, 4) of the electrodes x0, xa, y0, yb, `t_s` after the start of the scenario."""
        self._calls += 1
        if history := self._rows[self._calls % len(self._rows)].history:
            history.prepare(t_s)  # in turn, so that no sample has to wait for all of them
        counts = self._noise[:, None] * noise.normal(self._keys, round(t_s * 1e9))
        gains, at = self._gains, np.array([t_s])
        if not self._climate.steady:
            counts += self._climate.zero(at)[0]
            gains = gains * self._climate.gain(at) * self._climate.drive(at)
        found = self._at(t_s)
        pressed = Counter(contact.row for contact in found)
        special = {*self._special, *(row for row, number in pressed.items() if number > 1)}
        if contacts := [contact for contact in found if contact.row not in special]:
            currents, _ = self._currents(contacts, t_s)
            rows = [contact.row for contact in contacts]
            counts[rows] += currents * gains[rows]
        read = np.asarray(np.clip(np.rint(counts), self._low, self._high), dtype=np.int64)
        for number in special:
            read[number] = self.counts(number, [t_s])[0]
        return read

    def counts(self, pad_row: int, times_s: ArrayLike) -> NDArray[np.int64]:
        """Counts (n, 4) of one pad at times (n,): those that `sample` gives, many at once."""
        return self._rows[pad_row].counts(times_s)

    def prepare(self) -> None:
        """Solve ahead what a live hand must not pause for."""
        for row in self._rows:
            row.prepare()

    def switch(self, pad_row: int, t_s: float, on: bool) -> None:
        """A pad's potential goes on or off at `t_s`, later than any switch before: without it, its sheet
        recovers. On from the start."""
        if history := self._rows[pad_row].history:
            history.switch(t_s, on)

    def truth(self, t_s: float, t_ns: int = 0) -> list[Truth]:
        """The contacts of the sample at `t_s`; `t_ns` is the host's time of it."""
        contacts = self._at(t_s)
        if not contacts:
            return []
        return [
            self._truth(contact, currents, jacobian, t_ns)
            for contact, currents, jacobian in zip(contacts, *self._currents(contacts, t_s), strict=True)
        ]

    def _at(self, t_s: float) -> list[_Contact]:
        return [
            _Contact(row, pressing, pressing.radius_m or radius_m)
            for pressing in self._scenario.pressing(t_s)
            for row, radius_m in self._contacts[pressing.touch]
        ]

    def _currents(self, contacts: Sequence[_Contact], t_s: float) -> tuple[FloatArray, FloatArray]:
        """Currents (k, 4) [A] and their derivatives (k, 4, 3) by x and y [fractions of the pad] and total."""
        rows = np.array([contact.row for contact in contacts])
        x, y, force, radius = np.array(
            [(c.pressing.x, c.pressing.y, c.pressing.force_n, c.radius_m) for c in contacts]
        ).T
        at = np.array([t_s])
        force = force * [1.0 if self._rows[row].ideal else self._rows[row].yields(at)[0] for row in rows]
        values, slopes = self._bank.look_up(rows, x, y)
        shares, log_radius = values[:4].T, values[4]
        collected, total = self._electric.solve(rows, shares, log_radius, force, radius)
        by_place = self._electric.spread[rows] @ slopes[:4].transpose(2, 0, 1)
        jacobian = np.concatenate([total[:, None, None] * by_place, collected[:, :, None]], axis=2)
        return total[:, None] * collected, jacobian

    def _truth(self, contact: _Contact, currents: FloatArray, jacobian: FloatArray, t_ns: int) -> Truth:
        row, pressing = self._rows[contact.row], contact.pressing
        shape = row.shape
        s_m, phi = pressing.x * shape.length_m, pressing.y * shape.arc
        parallel_m = float(shape.radius(s_m))
        in_counts = jacobian * self._gains[contact.row][:, None]
        in_counts[:, :2] /= (shape.length_m, shape.arc * parallel_m)
        variance = row.noise_counts**2 + _QUANTISATION_VARIANCE
        covariance = variance * np.linalg.inv(in_counts.T @ in_counts)
        return Truth(
            t_ns,
            row.hand,
            row.pad.link,
            pressing.touch,
            s_m,
            phi * parallel_m,
            _vector(row.rotation @ shape.point(s_m, phi) + row.translation),
            _vector(row.rotation @ shape.normal(s_m, phi)),
            pressing.force_n,
            contact.radius_m,
            tuple(currents.tolist()),
            math.sqrt(covariance[0, 0] + covariance[1, 1]),
        )


@dataclass(frozen=True)
class _Contact:
    row: int
    pressing: Pressing
    radius_m: float


class _Electric:
    """The healthy circuits of all pads: supply, contact, sheet, resistors."""

    def __init__(self, rows: Sequence[BuiltPad]) -> None:
        self._drive_v = np.array([row.circuit.drive_v for row in rows])
        self._sheet_ohm = np.array([row.sheet.ohm_per_square for row in rows])
        self._alpha = np.array([row.sheet.alpha for row in rows])
        self._reference_pa = np.array([row.sheet.reference_kpa * 1e3 for row in rows])
        self._contact_ohm_m2 = np.array([row.sheet.contact_ohm_mm2 * 1e-6 for row in rows])
        circuits = [row.circuit.healthy for row in rows]
        self._lift = np.array([circuit.lift for circuit in circuits])
        self.spread = np.array([circuit.channels for circuit in circuits])
        """(rows, 4, 4): what the channels collect of the shares that grounded electrodes would."""

    def solve(
        self,
        rows: NDArray[np.intp],
        shares: FloatArray,
        log_radius: FloatArray,
        force_n: FloatArray,
        radius_m: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """What each channel collects of a contact's current, (k, 4), and that current (k,) [A]."""
        column = shares[:, :, None]
        collected = (self.spread[rows] @ column)[:, :, 0]
        sheet_ohm = self._sheet_ohm[rows]
        ohm = layer_ohm(
            force_n,
            radius_m,
            sheet_ohm,
            self._contact_ohm_m2[rows],
            self._reference_pa[rows],
            self._alpha[rows],
        )
        ohm += sheet_ohm / (2 * math.pi) * np.maximum(log_radius - np.log(radius_m), 0.0)
        ohm += (column.transpose(0, 2, 1) @ self._lift[rows] @ column)[:, 0, 0]
        return collected, self._drive_v[rows] / ohm


def _vector(values: FloatArray) -> Vector:
    x, y, z = values.tolist()
    return x, y, z
