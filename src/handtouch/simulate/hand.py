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
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import i0e, i1e

from handtouch import config
from handtouch.canbus.channels import ELECTRODES, Channels, channels_of, in_order
from handtouch.hand import mount_of
from handtouch.simulate.scenario import Pressing, Scenario
from handtouch.simulate.shape import Shape, shape_of
from handtouch.simulate.sheet import Gaps, SheetBank, SheetMaps, solve
from handtouch.simulate.truth import Truth, Vector
from handtouch.simulate.world import Parts, World

FloatArray = NDArray[np.float64]
_QUANTISATION_VARIANCE = 1 / 12  # of a rounded count


class VirtualHand:
    """The pads of a deployment, or those on one bus of it, under a scenario in a world.

    Rows are the pads in the order of the file: `pads` are (hand's name, pad).
    """

    def __init__(
        self, deployment: config.Deployment, scenario: Scenario, world: World, bus: str | None = None
    ) -> None:
        self.pads = [
            (hand.name, pad) for hand in deployment.hands for pad in hand.pads if bus in (None, pad.bus)
        ]
        self._scenario = scenario
        self._seed = world.seed, zlib.crc32((bus or "").encode())
        self._rows = [_Row.of(deployment, hand, pad, world) for hand, pad in self.pads]
        self._bank = SheetBank([row.maps for row in self._rows])
        self._electric = _Electric(self._rows)
        self._noise = np.array([row.noise_counts for row in self._rows])
        limits = np.array([[channel.limits for channel in row.channels] for row in self._rows])
        self._low, self._high = limits[:, :, 0], limits[:, :, 1]
        self._contacts = [
            [
                (number, 1e-3 * (touch.radius_mm or world.radius_mm(row.sheet, index)))
                for number, row in enumerate(self._rows)
                if row.pad.link == touch.link
            ]
            for index, touch in enumerate(scenario.touches)
        ]

    def sample(self, t_s: float) -> NDArray[np.int64]:
        """Counts (pads, 4) of the electrodes x0, xa, y0, yb, `t_s` after the start of the scenario."""
        moment = max(round(t_s * 1e9), 0)
        counts = np.random.default_rng((*self._seed, moment)).standard_normal((len(self._rows), 4))
        counts *= self._noise[:, None]
        if contacts := self._at(t_s):
            currents, _ = self._currents(contacts)
            rows = [contact.row for contact in contacts]
            counts[rows] += currents * self._electric.counts_per_ampere[rows]
        return np.asarray(np.clip(np.rint(counts), self._low, self._high), dtype=np.int64)

    def truth(self, t_s: float, t_ns: int = 0) -> list[Truth]:
        """The contacts of the sample at `t_s`; `t_ns` is the host's time of it."""
        contacts = self._at(t_s)
        if not contacts:
            return []
        return [
            self._truth(contact, currents, jacobian, t_ns)
            for contact, currents, jacobian in zip(contacts, *self._currents(contacts), strict=True)
        ]

    def _at(self, t_s: float) -> list[_Contact]:
        return [
            _Contact(row, pressing, radius_m)
            for pressing in self._scenario.pressing(t_s)
            for row, radius_m in self._contacts[pressing.touch]
        ]

    def _currents(self, contacts: Sequence[_Contact]) -> tuple[FloatArray, FloatArray]:
        """Currents (k, 4) [A] and their derivatives (k, 4, 3) by x and y [fractions of the pad] and total."""
        rows = np.array([contact.row for contact in contacts])
        x, y, force, radius = np.array(
            [(c.pressing.x, c.pressing.y, c.pressing.force_n, c.radius_m) for c in contacts]
        ).T
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
        in_counts = jacobian * self._electric.counts_per_ampere[contact.row][:, None]
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


@dataclass(frozen=True)
class _Row:
    """A pad as it was built."""

    hand: str
    pad: config.Pad
    node: config.Node
    channels: Channels
    sheet: config.Sheet
    parts: Parts
    shape: Shape
    maps: SheetMaps
    rotation: FloatArray
    translation: FloatArray
    noise_counts: float

    @classmethod
    def of(cls, deployment: config.Deployment, hand: str, pad: config.Pad, world: World) -> _Row:
        node, shape, parts = deployment.nodes[pad.node], shape_of(pad.surface), world.parts(hand, pad)
        maps, sheet = solve(shape, _gaps(shape, parts)), deployment.sheets[pad.sheet]
        noise = node.noise_counts if world.noise_counts is None else world.noise_counts
        channels = in_order(channels_of(node.channels, node.eds), pad.electrodes)
        return cls(hand, pad, node, channels, sheet, parts, shape, maps, *mount_of(pad), noise)

    @property
    def counts_per_ampere(self) -> FloatArray:
        """(4,) of the electrodes x0, xa, y0, yb."""
        full = [self.node.full_scale_counts or channel.limits[1] for channel in self.channels]
        scale = [self.node.channel_scale[self.pad.electrodes.index(name)] for name in ELECTRODES]
        of_channel = np.array(full) / (self.node.full_scale_ma * 1e-3 * np.array(scale))
        return np.asarray(of_channel * np.array(self.parts.gain))


class _Electric:
    """The circuits of all pads: supply, contact, sheet, resistors, channels."""

    def __init__(self, rows: Sequence[_Row]) -> None:
        self._drive_v = np.array([row.node.drive_v for row in rows])
        self._sheet_ohm = np.array([row.sheet.ohm_per_square for row in rows])
        self._alpha = np.array([row.sheet.alpha for row in rows])
        self._reference_pa = np.array([row.sheet.reference_kpa * 1e3 for row in rows])
        self._contact_ohm_m2 = np.array([row.sheet.contact_ohm_mm2 * 1e-6 for row in rows])
        self._series_ohm = np.array([row.parts.series_ohm for row in rows])
        self.counts_per_ampere = np.array([row.counts_per_ampere for row in rows])
        conductance = np.stack([row.maps.conductance for row in rows])
        mixing = conductance * self._series_ohm[:, None, :] / self._sheet_ohm[:, None, None]
        self.spread = np.linalg.inv(np.eye(4) + mixing)
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
        collected = (self.spread[rows] @ shares[:, :, None])[:, :, 0]
        pressure = force_n / (math.pi * radius_m**2)
        contact_ohm_m2 = (
            self._contact_ohm_m2[rows] * (self._reference_pa[rows] / pressure) ** self._alpha[rows]
        )
        x = radius_m * np.sqrt(self._sheet_ohm[rows] / contact_ohm_m2)
        disc = i0e(x) / (x * i1e(x))  # paper eqs. 9-11; the scaling cancels
        beyond = np.maximum(log_radius - np.log(radius_m), 0.0)
        ohm = self._sheet_ohm[rows] / (2 * math.pi) * (disc + beyond)
        ohm += (shares * self._series_ohm[rows] * collected).sum(1)
        return collected, self._drive_v[rows] / ohm


def _gaps(shape: Shape, parts: Parts) -> Gaps:
    """Gaps in the coordinates of the shape."""
    ends = shape.radius([0.0, shape.length_m])
    units = (*ends.tolist(), 1.0, 1.0)  # metres per unit of the coordinate along the side
    x0, xa, y0, yb = (
        (1e-3 * before / unit, 1e-3 * after / unit)
        for before, after, unit in zip(parts.gap_before_mm, parts.gap_after_mm, units, strict=True)
    )
    return Gaps(x0, xa, y0, yb)


def _vector(values: FloatArray) -> Vector:
    x, y, z = values.tolist()
    return x, y, z
