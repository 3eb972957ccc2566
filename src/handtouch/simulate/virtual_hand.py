"""Virtual hand: computes the counts of every pad's channels from a stimulus, and the ground truth.

Public name: `VirtualHand`. It has neither clock nor state: the same time gives the same sample.

A contact obeys V = J [R_contact + sum_i phi_i R_i m_i], where J is its current, R_contact the resistance of
its layer and the sheet to grounded electrodes, phi the mean shares of its current, R_i the resistors and
m = (1 + G R / rho)^-1 phi the shares that the electrodes collect through them. R_contact and phi are those of
`solve_patches`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.config.roles import channel_count
from handtouch.config.tables import SIDE_ELECTRODES
from handtouch.simulate import noise
from handtouch.simulate.contact_patch import ContactPatch
from handtouch.simulate.faults import Fault
from handtouch.simulate.pad_circuit import PadCircuit, layer_of
from handtouch.simulate.pad_geometry import SimulatedSurface
from handtouch.simulate.response_circuit import ResponseCircuit
from handtouch.simulate.sheet_solver import SheetMapBank
from handtouch.simulate.solved_contact import (
    ContactLayer,
    PatchNodes,
    look_up_nodes,
    node_slopes,
    solve_patches,
)
from handtouch.simulate.stimulus import AppliedContact, Stimulus
from handtouch.simulate.truth import GroundTruth, Vector
from handtouch.simulate.unevenness import wave_ratio
from handtouch.simulate.virtual_pad import VirtualPad, channel_errors_of, drift_of
from handtouch.simulate.worlds import DrawnWorld

_Number = TypeVar("_Number", bound=np.generic)
_QUANTISATION_VARIANCE = 1 / 12  # counts^2, by rounding
_KEY_STEP = np.uint64(0xBF58476D1CE4E5B9)  # between the noise streams of equal hands


class VirtualHand:
    """Pads of a deployment, or of one of its buses, with a stimulus in a world.

    Rows are the pads in the order of the file, columns their channels, of the pad that has most: those that
    others lack read 0. `pads` are (hand's name, pad), `virtual_pads` their models.
    `faults` are added to those of
    the stimulus. Models of second sheets follow those of the pads.
    """

    def __init__(
        self,
        deployment: config.Deployment,
        stimulus: Stimulus,
        world: DrawnWorld,
        bus: str | None = None,
        faults: Sequence[Fault] = (),
    ) -> None:
        self.pads = [(hand, pad) for hand, pad in deployment.pads if bus in (None, pad.bus)]
        self._stimulus = stimulus
        all_faults = (*stimulus.faults, *faults)
        self.virtual_pads = [
            VirtualPad.build(deployment, hand, pad, stimulus, world, all_faults) for hand, pad in self.pads
        ]
        self._shear_rows = [(k, pad.shear) for k, pad in enumerate(self.virtual_pads) if pad.shear]
        # second sheets follow the pads, as rows of their own under the same contacts
        firsts = [row for row, (_, pad) in enumerate(self.pads) if pad.second_sheet]
        self._second_rows = {row: len(self.pads) + number for number, row in enumerate(firsts)}
        self.virtual_pads += [self.virtual_pads[row].build_second(deployment, all_faults) for row in firsts]
        are_sheets = np.array([isinstance(row.circuit, PadCircuit) for row in self.virtual_pads])
        sheets = [row for row, is_sheet in zip(self.virtual_pads, are_sheets, strict=True) if is_sheet]
        self._sheet_number = np.cumsum(are_sheets) - 1
        """(rows,), numbers of those that are sheets with electrodes"""
        self._circuits = _HealthyCircuits(sheets) if sheets else None
        self._bank = SheetMapBank(self._circuits.maps) if self._circuits else None
        self._noise = np.array([row.noise_counts for row in self.virtual_pads])
        self._keys = _padded([row.noise_keys for row in self.virtual_pads])
        self._mixed_keys = noise.mix_keys(self._keys[:0])  # (hands, pads, c), of the hands asked for last
        self._gains = _padded([row.counts_per_ampere for row in self.virtual_pads])
        self._low = _padded([row.limits[:, 0] for row in self.virtual_pads])
        self._high = _padded([row.limits[:, 1] for row in self.virtual_pads])
        self._sample_count = 0
        self._drift = drift_of(self.virtual_pads, world)
        self._errors = channel_errors_of(self.virtual_pads, world)
        self._special_rows = [
            number
            for number, row in enumerate(self.virtual_pads)
            if row.faults or row.replacement_gains or row.new_sheets or row.circuit.states or row.pad.response
        ]
        self._loaded_rows = [
            number
            for number, row in enumerate(self.virtual_pads)
            if row.load and number not in self._special_rows
        ]
        self._touch_pads = [
            [
                (
                    row,
                    stimulus.touch_patch(index, world.contact(self.virtual_pads[number].sheet, index).patch),
                )
                for number, (_, pad) in enumerate(self.pads)
                if pad.link == link
                for row in (number, self._second_rows.get(number))
                if row is not None
            ]
            for index, link in enumerate(stimulus.touch_links)
        ]

    def sample(self, t_s: float) -> NDArray[np.int64]:
        """Return counts (pads, c) of the channels, `t_s` after the start of the scenario.

        Those of a pad's shear pad and its second sheet follow its own.
        """
        self._sample_count += 1
        if history := self.virtual_pads[self._sample_count % len(self.virtual_pads)].history:
            history.extend_ahead(t_s)  # one pad per sample, to keep samples fast
        counts, gains = self.untouched_counts(t_s)[0], self.counts_per_ampere(t_s)
        all_contacts = self._contacts_at(t_s)
        contact_counts = Counter(contact.row for contact in all_contacts)
        special = {*self._special_rows, *(row for row, number in contact_counts.items() if number > 1)}
        if contacts := [contact for contact in all_contacts if contact.row not in special]:
            solved = self._solve(contacts, t_s)
            own = slice(solved.shares.shape[1])
            counts[solved.rows, own] += solved.currents_a * gains[solved.rows, own]
        for row in self._loaded_rows:
            currents = self.virtual_pads[row].load_currents(np.array([t_s]))[0]
            counts[row, : len(currents)] += currents * gains[row, : len(currents)]
        readings = self.quantise(counts)
        for row in special:
            own = self.counts(row, [t_s])[0]
            readings[row, : len(own)] = own
        return self._with_others(readings, t_s) if self._shear_rows or self._second_rows else readings

    def _with_others(self, readings: NDArray[np.int64], t_s: float) -> NDArray[np.int64]:
        """Return readings with those of each pad's shear pad and second sheet after its own channels."""
        more = max(channel_count(pad) - len(pad.electrode_names) for _, pad in self.pads)
        widened = np.zeros((len(self.pads), readings.shape[1] + more), np.int64)
        widened[:, : readings.shape[1]] = readings[: len(self.pads)]
        ends = [len(row.limits) for row in self.virtual_pads]
        for row, shear in self._shear_rows:
            first, ends[row] = ends[row], ends[row] + len(SIDE_ELECTRODES)
            widened[row, first : ends[row]] = shear.counts(np.array([t_s]))[0]
        for row, second in self._second_rows.items():
            widened[row, ends[row]] = readings[second, 0]
        return widened

    def all_counts(self, pad_row: int, times_s: ArrayLike) -> NDArray[np.int64]:
        """Return counts (n, m) of all channels of one pad at times (n,): electrodes, shear pad, second
        sheet."""
        made, shear = [self.counts(pad_row, times_s)], self.virtual_pads[pad_row].shear
        if shear:
            made.append(shear.counts(np.asarray(times_s, np.float64)))
        if pad_row in self._second_rows:
            made.append(self.counts(self._second_rows[pad_row], times_s))
        return np.hstack(made)

    def untouched_counts(self, t_s: float, hands: int = 1) -> FloatArray:
        """Return zeros and noise (hands, pads, c) [counts] at `t_s`, of hands that differ in noise only; the
        first one is that of `sample`."""
        if len(self._mixed_keys) != hands:
            of_hands = (np.arange(hands, dtype=np.uint64) * _KEY_STEP)[:, None, None]
            self._mixed_keys = noise.mix_keys(self._keys + of_hands)
        counts = noise.normal_of_mixed(self._mixed_keys, round(t_s * 1e9))
        counts *= self._noise[:, None]
        if not self._drift.is_constant:
            counts += self._drift.zero_counts(np.array([t_s]))
        if self._errors.disturbs:
            counts += self._errors.disturbance(np.array([t_s]))
        return np.asarray(counts)

    def counts_per_ampere(self, t_s: float) -> FloatArray:
        """Return the gains (pads, c) of the channels at `t_s`, for currents at the nominal supply voltage."""
        if self._drift.is_constant:
            return self._gains
        times_s = np.array([t_s])
        return np.asarray(
            self._gains * self._drift.gain_ratio(times_s)[0] * self._drift.supply_ratio(times_s)
        )

    def temperature_rise_k(self, t_s: float) -> float:
        """Return the temperature at `t_s` relative to that at the start."""
        return float(self._drift.temperature_rise_k(np.array([t_s]))[0])

    def quantise(self, counts: FloatArray) -> NDArray[np.int64]:
        """Return readings (..., pads, c) of the converters."""
        if self._errors.distorts:
            counts = self._errors.distorted(counts)
        counts = np.rint(counts)
        return np.asarray(np.clip(counts, self._low, self._high, out=counts), dtype=np.int64)

    def counts(self, pad_row: int, times_s: ArrayLike) -> NDArray[np.int64]:
        """Return counts (n, m) of the m channels of one pad at times (n,), the same as those of `sample`."""
        return self.virtual_pads[pad_row].counts(times_s)

    def prepare(self) -> None:
        """Solve all sheets in advance, so that a live hand doesn't pause for it."""
        for row in self.virtual_pads:
            row.prepare()

    def switch_excitation(self, pad_row: int, t_s: float, on: bool) -> None:
        """Switch a pad's excitation at `t_s`, later than any switch before; without it the sheet recovers.

        It is on from the start.
        """
        row, second = self.virtual_pads[pad_row], self._second_rows.get(pad_row)
        seconds = () if second is None else (self.virtual_pads[second],)
        for pad in (row, *row.new_sheets, *seconds):
            if history := pad.history:
                history.switch_excitation(t_s, on)

    def truth(self, t_s: float, sync_ns: int = 0) -> list[GroundTruth]:
        """Return the true contacts of the sample at `t_s`; `sync_ns` is its SYNC on the host's clock."""
        contacts = [contact for contact in self._contacts_at(t_s) if contact.row < len(self.pads)]
        signals = self._signals(contacts, t_s)
        return [self._truth(*one, sync_ns, t_s) for one in zip(contacts, *signals, strict=True)]

    def _signals(
        self, contacts: Sequence[_PadContact], t_s: float
    ) -> tuple[list[FloatArray], list[FloatArray]]:
        """Return the signals of each contact alone, and their derivatives by x, y and strength."""
        circuits = [self.virtual_pads[one.row].circuit for one in contacts]
        on_sheets = [k for k, circuit in enumerate(circuits) if isinstance(circuit, PadCircuit)]
        signals: list[FloatArray] = [np.zeros(0)] * len(contacts)
        jacobians = list(signals)
        if on_sheets:
            solved = self._solve([contacts[k] for k in on_sheets], t_s)
            for k, own, jacobian in zip(on_sheets, solved.currents_a, self._jacobian(solved), strict=True):
                signals[k], jacobians[k] = own, jacobian
        for k, (circuit, contact) in enumerate(zip(circuits, contacts, strict=True)):
            if isinstance(circuit, ResponseCircuit):
                applied = contact.contact
                at = applied.x, applied.y, applied.force_n
                signals[k], jacobians[k] = circuit.signals_with_jacobian(*at, contact.column)
        return signals, jacobians

    def _contacts_at(self, t_s: float) -> list[_PadContact]:
        return [
            _PadContact(row, contact, ContactPatch(contact.radius_m) if contact.radius_m else patch)
            for contact in self._stimulus.contacts_at(t_s)
            for row, patch in self._touch_pads[contact.touch_number]
        ]

    def _solve(self, contacts: Sequence[_PadContact], t_s: float) -> _SolvedContacts:
        rows = np.array([contact.row for contact in contacts])
        position = np.array([(contact.contact.x, contact.contact.y) for contact in contacts]).T
        patch = np.stack([contact.column for contact in contacts], axis=1)
        force = np.array([contact.contact.force_n for contact in contacts])
        times_s = np.array([t_s])
        pads = [self.virtual_pads[contact.row] for contact in contacts]
        on_pad = np.bincount(rows, force)[rows]
        force = force * [
            1.0 if pad.is_ideal else pad.force_ratio(times_s, None if pad.faults else on_pad[[k]])[0]
            for k, pad in enumerate(pads)
        ]
        return self._solve_patches(rows, position, patch, force)

    def solve_contacts(
        self, rows: NDArray[np.intp], position: FloatArray, patch: FloatArray, force: FloatArray
    ) -> FloatArray:
        """Return currents (k, c) [A] of contacts (k,), each alone on its pad, at the nominal supply voltage.

        rows: (k,) of the pads. position: (2, k), fractions of the pad. patch: (PATCH_ROWS, k), see
        `ContactPatch.column`. force: (k,), apparent [N].
        """
        if not len(rows):
            return np.zeros((0, self._gains.shape[1]))
        return self._solve_patches(rows, position, patch, force).currents_a

    def _solve_patches(
        self, rows: NDArray[np.intp], position: FloatArray, patch: FloatArray, force: FloatArray
    ) -> _SolvedContacts:
        groups = [np.flatnonzero(rows == row) for row in np.unique(rows)]
        parts = [
            PatchNodes.of_patches(self.virtual_pads[rows[at[0]]].shape, position[:, at], patch[:, at])
            for at in groups
        ]
        nodes = parts[0]
        if len(parts) > 1:
            nodes = PatchNodes.joined(parts).taken(np.argsort(np.concatenate(groups)))
        assert self._bank is not None
        assert self._circuits is not None
        own = self._sheet_number[rows]
        log_radius, shares = look_up_nodes(self._bank, own, nodes)
        sheet_ohm, layer = self._circuits.sheets(own, position)
        number = np.arange(len(rows))
        ohm, mean, by_node = solve_patches(nodes, log_radius, shares, number, force, sheet_ohm, layer)
        return _SolvedContacts(rows, nodes, by_node, *self._circuits.solve_contacts(own, mean, ohm))

    def _jacobian(self, solved: _SolvedContacts) -> FloatArray:
        """Return the currents' derivatives (k, c, 3) by x, y [fractions] and total current."""
        assert self._bank is not None
        assert self._circuits is not None
        own = self._sheet_number[solved.rows]
        slopes = node_slopes(self._bank, own, solved.nodes)
        by_position = self._circuits.share_to_channel[own] @ np.einsum("makn,kn->kma", slopes, solved.by_node)
        return np.concatenate(
            [solved.total_a[:, None, None] * by_position, solved.shares[:, :, None]], axis=2
        )

    def _truth(
        self, contact: _PadContact, currents: FloatArray, jacobian: FloatArray, sync_ns: int, t_s: float
    ) -> GroundTruth:
        row, applied = self.virtual_pads[contact.row], contact.contact
        shape = row.shape
        at = np.array([[applied.x], [applied.y]])
        nodes = PatchNodes.of_patches(shape, at, contact.column[:, None])
        x, y = nodes.centres(shape, at)[:, 0].tolist()
        s_m, phi = x * shape.length_m, y * shape.arc
        point, normal = shape.point(s_m, phi), shape.normal(s_m, phi)
        in_counts = jacobian * self._gains[contact.row][: len(jacobian), None]
        in_counts[:, :2] @= np.linalg.inv(shape.metres_per_fraction(x, y))
        variance = row.noise_counts**2 + _QUANTISATION_VARIANCE
        covariance = variance * np.linalg.inv(in_counts.T @ in_counts)
        return GroundTruth(
            sync_ns,
            row.hand,
            row.pad.link,
            applied.touch_number,
            *shape.arc_lengths(s_m, phi),
            _vector(row.rotation @ point + row.translation),
            _vector(row.rotation @ normal),
            applied.force_n,
            contact.patch.radius_under(applied.force_n),
            tuple(currents[: len(row.limits)].tolist()),
            min(math.sqrt(covariance[0, 0] + covariance[1, 1]), _guess_error_m(shape)),
            self._true_force_vector(row, normal, applied.force_n, t_s),
            stated_position_m=_vector(row.stated_mount[0] @ point + row.stated_mount[1]),
        )

    @staticmethod
    def _true_force_vector(pad: VirtualPad, normal: FloatArray, force_n: float, t_s: float) -> Vector | None:
        """Return the force on a pad in its link's frame, where a shear pad senses it."""
        if pad.shear is None:
            return None
        across = np.cross(normal, [1.0, 0.0, 0.0])
        across /= np.linalg.norm(across)
        x_n, y_n = pad.shear.tangential_n(np.array([t_s]))[:, 0]
        return _vector(pad.rotation @ (x_n * np.cross(across, normal) + y_n * across - force_n * normal))


def _guess_error_m(shape: SimulatedSurface) -> float:
    """Return the rms error of a guess at the middle of a pad, for contacts anywhere on it."""
    _, width_m = shape.arc_lengths(shape.length_m / 2, shape.arc)
    return math.hypot(shape.length_m, width_m) / math.sqrt(12)


@dataclass(frozen=True)
class _PadContact:
    row: int
    contact: AppliedContact
    patch: ContactPatch

    @property
    def column(self) -> FloatArray:
        """The patch (PATCH_ROWS,) under its force."""
        return self.patch.column(np.array([self.contact.force_n]))[:, 0]


class _SolvedContacts(NamedTuple):
    """Contacts (k,), each alone on its pad, with their currents at the nominal supply voltage."""

    rows: NDArray[np.intp]
    """(k,), of the pads."""
    nodes: PatchNodes
    by_node: FloatArray
    """(k, NODES), shares of the nodes in each contact's current."""
    shares: FloatArray
    """(k, c), of the channels in it."""
    total_a: FloatArray
    """(k,)."""

    @property
    def currents_a(self) -> FloatArray:
        """(k, c), of the channels."""
        return np.asarray(self.total_a[:, None] * self.shares)


class _HealthyCircuits:
    """Circuits of all sheets with electrodes without faults: supply, contact, sheet, resistors."""

    def __init__(self, rows: Sequence[VirtualPad]) -> None:
        pads = [row.circuit for row in rows if isinstance(row.circuit, PadCircuit)]
        self.maps = [pad.maps for pad in pads]
        self._drive_v = np.array([pad.drive_v for pad in pads])
        self._sheet_ohm = np.array([pad.sheet.ohm_per_square for pad in pads])
        self._layers = np.array([layer_of(pad.sheet) for pad in pads]).T
        circuits = [pad.healthy for pad in pads]
        self._impedance_ohm = _padded([circuit.impedance_ohm for circuit in circuits])
        self.share_to_channel = _padded([circuit.share_to_channel for circuit in circuits])
        """(rows, c, c): from the shares of grounded electrodes to those of the channels."""
        for number, row in enumerate(rows):
            if row.is_total:
                self.share_to_channel[number, 0] = self.share_to_channel[number].sum(axis=0)
                self.share_to_channel[number, 1:] = 0.0
        uneven = [pad.unevenness for pad in pads]
        self._modes = max((one.modes for one in uneven), key=len)
        self._amplitudes = _padded([np.array(one.amplitudes) for one in uneven]).T
        """(modes, rows)"""
        self._films = [one.film for one in uneven]
        self._is_even = all(one.is_even for one in uneven)

    def solve_contacts(
        self, rows: NDArray[np.intp], shares: FloatArray, ohm: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the shares (k, c) of the channels in each contact's current, and these currents (k,) [A].

        shares: (k, c), of grounded electrodes. ohm: (k,), resistance to these.
        """
        column = shares[:, :, None]
        collected = (self.share_to_channel[rows] @ column)[:, :, 0]
        ohm = ohm + (column.transpose(0, 2, 1) @ self._impedance_ohm[rows] @ column)[:, 0, 0]
        return collected, self._drive_v[rows] / ohm

    def sheets(self, rows: NDArray[np.intp], position: FloatArray) -> tuple[FloatArray, ContactLayer]:
        """Return the sheet resistances (k,) at contacts, and their layers."""
        return self._sheet_ohm[rows] * self._ohm_ratio(rows, position), ContactLayer(*self._layers[:, rows])

    def _ohm_ratio(self, rows: NDArray[np.intp], position: FloatArray) -> FloatArray:
        """Return the local over the nominal sheet resistance (k,) at positions (2, k)."""
        if self._is_even:
            return np.ones(len(rows))
        ratio = wave_ratio(self._modes, self._amplitudes[:, rows], position)
        for k, row in enumerate(rows.tolist()):
            if film := self._films[row]:
                ratio[k] *= np.exp(film.log_at(position[:, k]))
        return ratio


def _vector(values: FloatArray) -> Vector:
    x, y, z = values.tolist()
    return x, y, z


def _padded(arrays: Sequence[NDArray[_Number]]) -> NDArray[_Number]:
    """Return arrays of different shapes as one, (rows, ...), with zeros beyond their own."""
    shape = np.max([array.shape for array in arrays], axis=0)
    padded = np.zeros((len(arrays), *shape), arrays[0].dtype)
    for row, array in zip(padded, arrays, strict=True):
        row[tuple(map(slice, array.shape))] = array
    return padded
