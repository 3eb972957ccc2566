"""Parameters of all pads as columns over the hands, computed once from the deployment."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.calibration.calibration import LawParameters, LearnedParts, matrix
from handtouch.config import Deployment
from handtouch.config.channels import (
    node_channels,
    order_by_electrode,
)
from handtouch.config.roles import CHANNEL_ROLES, SECOND_SHEET, SHEAR, channel_numbers
from handtouch.core.active_calibration import ActiveCalibration
from handtouch.core.channel_currents import ChannelCurrents
from handtouch.core.memory import RowArray, made_once, number_row, rows_at, rows_by_name, view_memory
from handtouch.core.pad_tables import ForwardTable, pair_limit
from handtouch.core.shear_pads import shear_parameters
from handtouch.core.sheet_force import SheetBehaviour, sheet_behaviour_of
from handtouch.core.stages.force import LAW_ROW, PadLaw
from handtouch.core.stages.locate import ModelTable
from handtouch.core.stages.rows import TOUCH_ROW
from handtouch.core.stages.tables import PadSurface
from handtouch.core.stages.tolerances import PadTolerances, part_count, shape_error
from handtouch.field.channel_map import ChannelMap
from handtouch.field.contact_law import ContactLaw
from handtouch.field.contact_stack import stack_factor
from handtouch.field.model import ChannelModel
from handtouch.hand import (
    MountUncertainty,
    channel_gain_std,
    mount_transform,
    network_parameters,
    pad_channels,
    pad_surface,
)
from handtouch.hand.pads import sheet_law

FloatArray = NDArray[np.float64]
_NODE_TOLERANCES = {"gain_std", "series_std", "series_std_ohm"}
_SHEET_TOLERANCES = {
    *("ohm_per_square_std", "contact_ohm_std", "alpha_std", "anisotropy_std", "gap_std_mm", "size_std_mm"),
    *("unevenness_std", "contact_elongation_std", "max_force_n", "pair_false_alarm", "max_contact_length_mm"),
    *("contact_tilt_std", "crowding"),
}


_NODE_KEYS, _SHEET_KEYS = number_row(config.Node), number_row(config.Sheet)
_UNEVEN_FACTOR = 1 / 3
"""Relative standard deviation of a layer's resistance over `contact_tilt_std`: even, Hertz's, tilted, annular
and two-spot pressures, weighted alike, have 0.1 where the layer dominates and twice that where the sheet
does."""
_UNLIMITED_FORCE_N = 1e3  # force of a sheet without max_force_n: its current is the sheet's maximum
_MIN_RADIUS_RATIO = 0.3  # least radius of a contact, relative to the stated one
_DEAD_WEIGHT = 1e-6  # weight of a dead electrode, whose readings are left out
_LOCAL_UNEVENNESS = 1.5  # standard deviation of ln of the local sheet resistance, per wave's: a sum of five


class PadModel:
    """Columns of the n pads of a deployment, in its order, which is also the slab's.

    `hands`, `links` and `frame_links` (URDF links) (n,) are names; `rows_of_hand`: hand -> slice of rows;
    `calibrations` (n,): the active ones. `electrodes`: names of each pad's, `electrode_counts`
    (n,) their numbers; `c`, `channels`, is the largest of them. Columns beyond a pad's own are 0.
    `slab_channels` and `slab_columns` (n,): those of the slab, electrodes before those of shear pads, which
    `shear_pads` describe.
    `ampere_per_count` (n, c) of the electrodes includes `gains` (n, c); `noise_counts` (n,) and `noise_a` (n,
    c) are standard deviations of a channel. The counts of untouched pads are state of the tick: see
    `Baseline`.

    `state_counts` (n,): numbers of states of a schedule, 1 where electrodes aren't switched.
    `gain_covariance` (n, c, c) is that of log gains; `part_axes` (n, (c + p)^2), `part_axis_ends` (n, c + p),
    `part_offsets` (n, p) and `touch_errors` (n,): see `PartKnowledge`; `quarantined` (n,): no force is
    published; `position_unreliable` (n,).

    `begin_threshold_a`, `end_threshold_a` [A] are the total currents at the centre of the pad at which a
    contact begins and ends. `sample_delay_ns` (n,): from a sample to its SYNC. `behaviours` (n,): sheet
    behaviour, None where it isn't modelled.

    `magnetic` (n,): pads whose zeros shift as they turn. `crowding` (n,): pads on which currents crowd
    towards electrodes.
    `mounts` (n, MOUNT_COUNT): origins of the pads on their links, and their variances, see `ContactSolver`.
    `peak_currents_a` (n,): largest current of an electrode by a contact of the sheet's `max_force_n`.

    `forward_tables` (those without an electrode where it is dead), `surfaces` and `law_parameters` are
    what the stages read; `weight` (n, c) is 1 / `noise_a`. `networks` are the exact theory that the tables
    approximate.
    """

    def __init__(
        self,
        deployment: Deployment,
        forward_table: Callable[[ChannelModel], ForwardTable] = ForwardTable.from_network,
    ) -> None:
        """Compute the parameters; `forward_table` returns that of a pad's network, once per distinct one."""
        entries = deployment.pads
        pads = [pad for _, pad in entries]
        nodes = [deployment.nodes[pad.node] for pad in pads]
        sheets = [deployment.sheet_of(pad) for pad in pads]
        self._parts = list(zip(pads, nodes, sheets, strict=True))
        self.node_keys, self.sheet_keys = rows_by_name(_NODE_KEYS, nodes), rows_by_name(_SHEET_KEYS, sheets)
        """(n,) numbers of each pad's node and sheet, by the names of the deployment's keys"""
        self.size = len(pads)
        self.hands = [hand for hand, _ in entries]
        self.links = [pad.link for pad in pads]
        self.frame_links = [pad.mount.link or pad.link for pad in pads]
        self.rows_of_hand = _rows_of_hands(self.hands)
        self.mounts = np.concatenate([_mounts_of(hand) for hand in deployment.hands])
        self.surfaces = made_once(_surface_of, zip(pads, strict=True))
        self._set_channels(deployment)
        self.networks = networks = networks_of(deployment)
        self.forward_tables = made_once(forward_table, zip(networks, strict=True))
        self._whole_tables = list(self.forward_tables)
        self.default_calibration_ids = [default_calibration_id_of(pad, deployment) for pad in pads]
        self.calibrations = [self.default_calibration(pad) for pad in range(self.size)]
        self.quarantined = np.zeros(self.size, dtype=np.bool_)
        self.position_unreliable = np.zeros(self.size, dtype=np.bool_)
        self._set_stated_parts()
        kinds_of_sheet = {name: _behaviour_of_sheet(sheet, name) for name, sheet in deployment.sheets.items()}
        self.behaviours = [kinds_of_sheet.get(pad.sheet) if not pad.response else None for pad in pads]
        self.magnetic = np.array([pad.is_magnetic for pad in pads])
        self.crowding = self.sheet_keys.crowding > 0
        self._set_stated_laws()
        self._set_second_sheets(deployment)
        self.touch = rows_by_name(TOUCH_ROW, [deployment.touch_of(pad) for pad in pads])
        """(n,) thresholds by the names of `[touch]`"""
        self.begin_threshold_a, self.end_threshold_a = (
            np.array([self.centre_current(pad, force[pad]) for pad in range(self.size)])
            for force in (self.touch.begin_threshold_n, self.touch.end_threshold_n)
        )

    def _set_channels(self, deployment: Deployment) -> None:
        """Set the columns of channels: electrodes, their gains and noise, and what else is in the slab."""
        pads, nodes = [pad for pad, _, _ in self._parts], [node for _, node, _ in self._parts]
        self.electrodes = [pad.electrode_names for pad in pads]
        self.electrode_counts = np.array([len(names) for names in self.electrodes])
        self.channels = int(self.electrode_counts.max())
        self._used = np.arange(self.channels) < self.electrode_counts[:, None]
        self.ampere_per_count = np.zeros((self.size, self.channels))
        self.ampere_per_count[self._used] = np.concatenate(
            [ampere_per_count_of(pad, deployment) for pad in pads]
        )
        self._nominal_a = self.ampere_per_count.copy()
        self.gains = self._used.astype(np.float64)
        self.mean_ampere_per_count = self.ampere_per_count.sum(axis=1) / self.electrode_counts
        self.noise_counts = np.array([noise_counts_of(node) for node in nodes])
        self.noise_a = self.noise_counts[:, None] * self.ampere_per_count
        self.weight = np.zeros(self.noise_a.shape)
        self.weight[self._used] = 1 / self.noise_a[self._used]
        kinds = {name: node_channels(node) for name, node in deployment.nodes.items()}
        self.max_counts = np.array([min(c.limits[1] for c in kinds[pad.node]) for pad in pads])
        self.sample_delay_ns = np.rint(self.node_keys.sample_delay_ms * 1e6).astype(np.int64)
        self.state_counts = np.array([pad.state_count for pad in pads])
        columns = _role_columns(pads)
        self.slab_channels = max(of_role[-1] + 1 for own in columns for of_role in own.values() if of_role)
        self.slab_columns = [tuple(c for of_role in own.values() for c in of_role) for own in columns]
        first_of_shear = next((own[SHEAR][0] for own in columns if own[SHEAR]), 0)
        self.shear_pads = shear_parameters(deployment, first_of_shear, self.noise_counts)
        self.second_pads = np.array([row for row, pad in enumerate(pads) if pad.second_sheet], np.int64)
        """(m,) rows of the pads with two sheets"""
        self.second_columns = np.array([columns[row][SECOND_SHEET][0] for row in self.second_pads], np.int64)
        """(m,) columns of their second sheets in the slab"""

    def _set_stated_parts(self) -> None:
        """Set what the deployment states of gains and other parts."""
        self._stated_gain_covariance = np.stack(
            [
                channel_gain_std(pad, node) ** 2 * _shared_channels(pad, self.channels)
                for pad, node, _ in self._parts
            ]
        )
        self.gain_covariance = self._stated_gain_covariance.copy()
        self._stated_touch_errors = np.array(
            [one.touch_error if isinstance(one, ChannelMap) else 0.0 for one in self.networks]
        )
        self.touch_errors = np.zeros(self.size)
        parts = part_count(self.channels)
        self.part_offsets = np.zeros((self.size, parts))
        self.part_axes = np.zeros((self.size, (self.channels + parts) ** 2))
        self.part_axis_ends: NDArray[np.intp] = np.zeros((self.size, self.channels + parts), dtype=np.intp)
        for pad in range(self.size):
            self._set_parts(pad, None)

    def _set_stated_laws(self) -> None:
        """Set the contact laws of the deployment, and contacts at the centres of the pads."""
        sheets = [sheet for _, _, sheet in self._parts]
        self._sheet_ohm = self.sheet_keys.ohm_per_square.copy()
        self._has_series = np.array([any(pad.series_ohm) for pad, _, _ in self._parts])
        self._series_form = np.zeros((self.size, self.channels, self.channels))
        for form, network in zip(self._series_form, self.networks, strict=True):
            count = len(network.series_ohm)
            form[:count, :count] = network.series_quadratic_form
        self._file_laws = [law_of(sheet) for sheet in sheets]
        self._laws = [contact_law(sheet, law) for sheet, law in zip(sheets, self._file_laws, strict=True)]
        self.law_parameters: RowArray = np.zeros(self.size, LAW_ROW).view(np.recarray)
        """(n,) LAW_ROWs"""
        for pad in range(self.size):
            self._update_law_parameters(pad)
        self.peak_currents_a = self._peak_currents()
        self._centre_contacts = self._contacts_at_centre()

    def _set_second_sheets(self, deployment: Deployment) -> None:
        """Compute the parameters of the second sheets (m,), as those of the pads."""
        pads = [self._parts[row][0] for row in self.second_pads]
        nodes = [self._parts[row][1] for row in self.second_pads]
        sheets = [deployment.sheets[pad.second_sheet or ""] for pad in pads]
        numbers = [channel_numbers(pad, SECOND_SHEET)[0] for pad in pads]
        self.second_ampere_per_count = np.array(
            [channel_ampere_per_count(node, number) for node, number in zip(nodes, numbers, strict=True)]
        )
        self.second_behaviours = [
            _behaviour_of_sheet(sheet, pad.second_sheet or "")
            for sheet, pad in zip(sheets, pads, strict=True)
        ]
        self._second_parts = list(zip(sheets, [law_of(sheet) for sheet in sheets], strict=True))
        self.second_law_parameters: RowArray = np.zeros(len(pads), LAW_ROW).view(np.recarray)
        """(m,) LAW_ROWs"""
        for row in self.second_pads.tolist():
            self._update_second_law(row)

    def default_second_law(self, pad: int) -> LawParameters | None:
        """Return the deployment's contact law of a pad's second sheet, None without one."""
        if pad not in self.second_pads:
            return None
        return self._second_parts[self.second_pads.searchsorted(pad)][1]

    def _update_second_law(self, pad: int) -> None:
        """Write the law of a pad's second sheet as the stages take it.

        While it isn't measured, the error of the channel's gain is one of the sheet's resistance: both
        multiply the current.
        """
        number, measured = self.second_pads.searchsorted(pad), self.calibrations[pad].second_law
        sheet, law = self._second_parts[number]
        if measured is not None:
            law = measured
        else:
            covariance = np.array(law.covariance)
            covariance[np.ix_([0, 2], [0, 2])] += self._parts[pad][1].gain_std ** 2
            law = replace(law, covariance=matrix(covariance))
        _write_law(self.second_law_parameters[number], law, sheet, float(self.node_keys.drive_v[pad]))

    def second_threshold_counts(self) -> tuple[FloatArray, FloatArray]:
        """Return the counts (m,) of the second sheets at which contacts begin and end."""
        counts = []
        for forces in (self.touch.begin_threshold_n, self.touch.end_threshold_n):
            currents = [
                float(
                    contact_law(sheet, law).current(
                        forces[row],
                        self.node_keys.drive_v[row],
                        law.ohm_per_square,
                        self._centre_contacts[0][row],
                        0.0,
                    )
                )
                for row, (sheet, law) in zip(self.second_pads, self._second_parts, strict=True)
            ]
            counts.append(np.array(currents) / self.second_ampere_per_count)
        return counts[0], counts[1]

    def default_calibration(self, pad: int) -> ActiveCalibration:
        """Return the calibration of a pad without one: the deployment's."""
        return ActiveCalibration(self.default_calibration_ids[pad], (1.0,) * int(self.electrode_counts[pad]))

    def set_calibration(self, pad: int, calibration: ActiveCalibration) -> None:
        """Apply a calibration as a whole. Where series resistors matter, contacts are located with the
        deployment's sheet resistance."""
        before, self.calibrations[pad] = self.calibrations[pad], calibration
        if calibration.law != before.law:
            self._set_law(pad, calibration.law)
        if calibration.second_law != before.second_law and pad in self.second_pads:
            self._update_second_law(pad)
        count = self.electrode_counts[pad]
        self.gains[pad, :count] = calibration.gains
        self.ampere_per_count[pad] = self._nominal_a[pad] * self.gains[pad]
        self.noise_a[pad] = self.noise_counts[pad] * self.ampere_per_count[pad]
        self.weight[pad, :count] = 1 / self.noise_a[pad, :count]
        if calibration.dead_electrode != before.dead_electrode:
            self._set_dead_electrode(pad, calibration.dead_electrode)
        if calibration.dead_electrode is not None:
            self.weight[pad, calibration.dead_electrode] *= _DEAD_WEIGHT
        self.mean_ampere_per_count[pad] = self.ampere_per_count[pad].sum() / count
        self.gain_covariance[pad] = self._stated_gain_covariance[pad]
        if calibration.gain_covariance is not None:
            self.gain_covariance[pad, :count, :count] = np.reshape(
                calibration.gain_covariance, (count, count)
            )
        self._set_parts(pad, calibration.parts)
        self.quarantined[pad] = calibration.quarantined
        self.position_unreliable[pad] = calibration.position_unreliable

    def _set_dead_electrode(self, pad: int, electrode: int | None) -> None:
        """Take the forward model without an electrode, None: with all.

        Without one, the resistors' part is in the spreading radius.
        """
        network, table = self.networks[pad], self._whole_tables[pad]
        self._series_form[pad] = 0.0
        if electrode is None:
            count = self.electrode_counts[pad]
            self._series_form[pad, :count, :count] = network.series_quadratic_form
            self.forward_tables[pad] = table
        else:
            self.forward_tables[pad] = table.with_dead_electrode(network, electrode)

    def _set_parts(self, pad: int, parts: LearnedParts | None) -> None:
        """Apply what is known of the parts of a pad, None: as the deployment states, and of its gains."""
        count = int(self.electrode_counts[pad])
        size = count + part_count(count)
        self.part_offsets[pad], self.touch_errors[pad] = 0.0, self._stated_touch_errors[pad]
        if parts is not None:
            axes = _triangle(np.array(parts.covariance))
            self.part_offsets[pad, : size - count] = parts.offsets
            # scores of contacts that aren't round, which the sheet states already, are among those measured
            stated = shape_error(*self._parts[pad][::2], self.networks[pad], self._whole_tables[pad])
            learned = math.sqrt(max(parts.touch_error**2 - stated**2, 0.0))
            self.touch_errors[pad] = max(learned, self._stated_touch_errors[pad])
        else:
            axes = np.eye(size)
            axes[:count, :count] = _triangle(self.gain_covariance[pad, :count, :count])
        self.part_axes[pad, : size * size] = axes.ravel()
        self.part_axis_ends[pad, :size] = ((axes != 0) * np.arange(1, size + 1)).max(axis=1)

    @property
    def begin_threshold_counts(self) -> FloatArray:
        """Sum of the channels at which a contact begins (n,)."""
        return np.asarray(self.begin_threshold_a / self.mean_ampere_per_count)

    @property
    def end_threshold_counts(self) -> FloatArray:
        """Sum of the channels at which a contact ends (n,)."""
        return np.asarray(self.end_threshold_a / self.mean_ampere_per_count)

    def law(self, pad: int) -> LawParameters:
        """Return the contact law of a pad: its calibration's, or the deployment's."""
        return self.calibrations[pad].law or self._file_laws[pad]

    def default_law(self, pad: int) -> LawParameters:
        """Return the contact law of the deployment."""
        return self._file_laws[pad]

    @property
    def law_ages_s(self) -> FloatArray:
        """Ages (n,) [s] of contacts at which the laws hold."""
        return np.array([self.law(pad).age_s for pad in range(self.size)])

    @property
    def second_law_ages_s(self) -> FloatArray:
        """Ages (m,) [s] of contacts at which the laws of the second sheets hold."""
        laws = zip(self.second_pads.tolist(), [law for _, law in self._second_parts], strict=True)
        return np.array([(self.calibrations[pad].second_law or law).age_s for pad, law in laws])

    def copy_calibrations(self, other: PadModel) -> None:
        """Take over all calibrations of the model that this one replaces."""
        for pad, calibration in enumerate(self.continued_calibrations(other, other.calibrations)):
            self.set_calibration(pad, calibration)

    def continued_calibrations(
        self, other: PadModel, calibrations: Sequence[ActiveCalibration]
    ) -> list[ActiveCalibration]:
        """Return calibrations (n,) of the model that this one replaces as this one has them: default ones
        change their name."""
        defaults = zip(other.default_calibration_ids, self.default_calibration_ids, strict=True)
        return [
            replace(calibration, calibration_id=after)
            if calibration.calibration_id == before and all(gain == 1 for gain in calibration.gains)
            else calibration
            for calibration, (before, after) in zip(calibrations, defaults, strict=True)
        ]

    def _series_resistance(self, index: NDArray[np.intp], currents: FloatArray) -> FloatArray:
        """Return the equivalent series resistance from contact to ground [ohm] (n,), sum of phi_i V_i / I."""
        if not self._has_series[index].any():
            return np.zeros(len(index))
        with np.errstate(divide="ignore", invalid="ignore"):
            fractions = currents / currents.sum(axis=0)
        return np.asarray(np.einsum("in,nij,jn->n", fractions, self._series_form[index], fractions))

    def _set_law(self, pad: int, law: LawParameters | None) -> None:
        """Apply a contact law, and the thresholds [A] that follow from it."""
        applied = law or self._file_laws[pad]
        self._sheet_ohm[pad] = applied.ohm_per_square
        self._laws[pad] = contact_law(self._parts[pad][2], applied)
        self._update_law_parameters(pad)
        self.begin_threshold_a[pad] = self.centre_current(pad, self.touch.begin_threshold_n[pad])
        self.end_threshold_a[pad] = self.centre_current(pad, self.touch.end_threshold_n[pad])

    def _update_law_parameters(self, pad: int) -> None:
        """Write the law of a pad as the stages take it."""
        drive_v, sheet = float(self.node_keys.drive_v[pad]), self._parts[pad][2]
        _write_law(self.law_parameters[pad], self.law(pad), sheet, drive_v)

    def stage_tolerances(self) -> list[PadTolerances]:
        """Return the tolerances of the pads' parts as the stages take them."""
        columns = zip(*zip(*self._parts, strict=True), self.networks, self.forward_tables, strict=True)
        return made_once(PadTolerances, columns)

    def stage_tables(self) -> list[ModelTable]:
        """Return the forward models as the stages take them."""
        potential = [network.is_potential for network in self.networks]
        return made_once(
            ModelTable, zip(self.forward_tables, self.state_counts.tolist(), potential, strict=True)
        )

    def pair_settings(self) -> FloatArray:
        """Return the limit (n,) of one contact's squared misfit beyond which two are tried, and the deviation
        (n,) [m^2] of half the difference of the variances of an elongated contact's current, (2, n).

        That of a line of length L is L^2 / 24 along it, which is taken as the deviation along any axes.
        """
        sheets = [sheet for _, _, sheet in self._parts]
        limits = [
            pair_limit(table, sheet.pair_false_alarm, states)
            for table, sheet, states in zip(
                self.forward_tables, sheets, self.state_counts.tolist(), strict=True
            )
        ]
        return np.array([limits, [(1e-3 * sheet.max_contact_length_mm) ** 2 / 24 for sheet in sheets]])

    def stage_laws(self) -> list[PadLaw]:
        """Return the contact laws as the stages take them; they follow later changes."""
        return [
            PadLaw(
                rows_at(self.law_parameters, pad),
                view_memory(np.ascontiguousarray(form[:count, :count])),
                bool(has_series),
            )
            for pad, (form, count, has_series) in enumerate(
                zip(self._series_form, self.electrode_counts, self._has_series, strict=True)
            )
        ]

    def _peak_currents(self) -> FloatArray:
        """Return the largest current of an electrode by the firmest contact of the deployment (n,) [A]."""
        known: dict[tuple[object, ...], float] = {}
        currents = []
        for (pad, node, sheet), network in zip(self._parts, self.networks, strict=True):
            key = pad.surface, id(network), pad.sheet, pad.node
            if key not in known:
                places = ChannelCurrents(
                    network,
                    pad_surface(pad),
                    contact_law(sheet, law_of(sheet)),
                    node.drive_v,
                    sheet.ohm_per_square,
                )
                known[key] = places.peak(sheet.max_force_n or _UNLIMITED_FORCE_N).current_a
            currents.append(known[key])
        return np.array(currents)

    def _contacts_at_centre(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return spreading radius [m], series resistance [ohm] and sum of the fractions at the centre of each
        pad."""
        networks = self.networks
        x, y = np.array([(net.a / 2, net.b / 2) for net in networks]).T
        pads = np.arange(self.size)
        surfaces = [pad_surface(pad) for pad, _, _ in self._parts]
        scale = np.array([float(surface.scale(*at)) for surface, *at in zip(surfaces, x, y, strict=True)])
        radius = np.array([net.spreading_radius(*at) for net, *at in zip(networks, x, y, strict=True)])
        fractions = np.zeros((self.channels, self.size))
        fractions.T[self._used] = np.concatenate(
            [net.fractions(*at) for net, *at in zip(networks, x, y, strict=True)]
        )
        is_sheet = [network.is_potential for network in networks]
        sums = np.where(is_sheet, 1.0, fractions.sum(axis=0))
        return radius * scale, self._series_resistance(pads, fractions), sums

    def centre_current(self, pad: int, force_n: float) -> float:
        """Return the sum of the currents of a contact of that force at the centre of a pad."""
        spreading_m, series_ohm, share = (values[pad] for values in self._centre_contacts)
        drive_v, sheet_ohm = self.node_keys.drive_v[pad], self._sheet_ohm[pad]
        return float(share * self._laws[pad].current(force_n, drive_v, sheet_ohm, spreading_m, series_ohm))

    def centre_force(self, pad: int, counts: float) -> float:
        """Return the force of a contact at the centre of a pad by the sum of its channels."""
        spreading_m, series_ohm, share = (values[pad] for values in self._centre_contacts)
        current_a = counts * self.mean_ampere_per_count[pad] / share
        drive_v, sheet_ohm = self.node_keys.drive_v[pad], self._sheet_ohm[pad]
        estimate = self._laws[pad].force(current_a, drive_v, sheet_ohm, spreading_m, series_ohm)
        return float(estimate.force_n)


def _write_law(row: np.record, law: LawParameters, sheet: config.Sheet, drive_v: float) -> None:
    """Write a sheet's law to a LAW_ROW."""
    alpha, greatest_n = law.alpha, sheet.max_force_n
    log_radius, radius_variance = _log_radius(
        sheet.contact_radius_mm * 1e-3, sheet.contact_radius_std_mm * 1e-3
    )
    power, growth = 1 / alpha, 0.0
    if law.hertz_force_n is not None:
        power, growth = 3 / (2 + alpha), 1 / (2 + alpha)
        log_radius -= math.log(law.hertz_force_n) / 3
    log_sheet = math.log(law.ohm_per_square)
    log_reference_n = math.log(math.pi * sheet.reference_kpa * 1e3) + 2 * log_radius
    # x^2 = A^2 rho / sigma, here at 1 N
    log_x2 = log_sheet + 2 * log_radius - math.log(law.contact_ohm_mm2 * 1e-6) - alpha * log_reference_n
    log_max_x2 = log_x2 + math.log(greatest_n) / power if greatest_n else math.inf
    row.log_x2, row.power, row.by_radius = log_x2, power, 2 - 2 * alpha
    row.log_radius, row.radius_variance = log_radius, radius_variance
    row.log_sheet, row.drive_v = log_sheet, drive_v
    row.log_reference = log_x2 * (power - 2 * growth) + log_reference_n
    row.covariance[:] = np.array(law.covariance)[np.triu_indices(3)]
    row.max_log_x2 = log_max_x2
    row.min_factor = float(stack_factor(np.exp(0.5 * log_max_x2))) if greatest_n else 0.0
    row.growth, row.uneven = growth, _UNEVEN_FACTOR * sheet.contact_tilt_std


def _log_radius(radius: float, std: float) -> tuple[float, float]:
    """Return mean and variance of the logarithm of a contact radius."""
    sigma = np.linspace(-5.0, 5.0, 401)
    log_ratio = np.log(np.maximum(1 + sigma * std / radius, _MIN_RADIUS_RATIO))
    weight = np.exp(-0.5 * sigma**2)
    mean = float(np.average(log_ratio, weights=weight))
    return math.log(radius) + mean, float(np.average(np.square(log_ratio - mean), weights=weight))


def _mounts_of(hand: config.HandTable) -> FloatArray:
    """Return origins and variances (n, MOUNT_COUNT) of the mounts of a hand's pads, as `ContactSolver` takes
    them."""
    mounts = MountUncertainty(hand)
    variances = mounts.position_variance_m2, mounts.rotation_variance_rad2
    return np.hstack([mounts.origin_m, np.tile(variances, (len(mounts.origin_m), 1))])


def _triangle(covariance: FloatArray) -> FloatArray:
    """Return the upper triangle R with R' R = covariance, which may be singular."""
    variances, directions = np.linalg.eigh(covariance)
    root = np.sqrt(np.maximum(variances, 0.0))[:, None] * directions.T
    return np.asarray(np.linalg.qr(root, mode="r"))


def _behaviour_of_sheet(sheet: config.Sheet, name: str) -> SheetBehaviour | None:
    if not sheet.behaviour:
        return None
    behaviour = sheet_behaviour_of(sheet.behaviour, name)
    return replace(behaviour, max_force_n=sheet.max_force_n or math.inf)


def noise_counts_of(node: config.Node) -> float:
    """Return the standard deviation of a channel's counts, quantisation included."""
    return math.hypot(node.noise_counts, 1 / math.sqrt(12))


def ampere_per_count_of(pad: config.Pad, deployment: Deployment) -> list[float]:
    """Return the current per count of the electrodes, without any calibration.

    The sum of all is the mean of those of the states.
    """
    node = deployment.nodes[pad.node]
    channels = node_channels(node)
    scale = [node.channel_scale[pad.electrodes.index(name)] for name in pad.electrode_names]
    return [
        node.full_scale_ma * 1e-3 / (node.full_scale_counts or channel.limits[1]) * factor / pad.state_count
        for channel, factor in zip(order_by_electrode(channels, pad), scale, strict=True)
    ]


def channel_ampere_per_count(node: config.Node, number: int) -> float:
    """Return the current per count of a channel of a node, without any calibration."""
    most = node.full_scale_counts or node_channels(node)[number].limits[1]
    return node.full_scale_ma * 1e-3 / most * node.channel_scale[number]


def _role_columns(pads: Sequence[config.Pad]) -> list[dict[str, range]]:
    """Return the columns of each pad's channels by role: those of one role are the same ones in all pads."""
    first, columns = 0, [dict[str, range]() for _ in pads]
    for role in CHANNEL_ROLES:
        counts = [len(channel_numbers(pad, role)) for pad in pads]
        for own, count in zip(columns, counts, strict=True):
            own[role] = range(first, first + count)
        first += max(counts)
    return columns


def _shared_channels(pad: config.Pad, channels: int) -> FloatArray:
    """Return a matrix (channels, channels), 1 for each two electrodes that share an amplifier, else 0."""
    shared = np.diag((np.arange(channels) < len(pad.electrode_names)).astype(np.float64))
    for electrodes in zip(*pad.state_numbers, strict=True):
        shared[np.ix_(electrodes, electrodes)] = 1.0
    return shared


def _rows_of_hands(hands: list[str]) -> dict[str, slice]:
    """Return the rows of each hand; the pads of a hand are consecutive."""
    first = {hand: hands.index(hand) for hand in hands}
    return {hand: slice(start, start + hands.count(hand)) for hand, start in first.items()}


def _surface_of(pad: config.Pad) -> PadSurface:
    return PadSurface(pad_surface(pad), *mount_transform(pad))


def networks_of(deployment: Deployment) -> list[ChannelModel]:
    """Return the electrode network, or channel map, of every pad; identical ones share it and its table."""
    shared: dict[tuple[object, ...], ChannelModel] = {}
    networks = []
    for _, pad in deployment.pads:
        sheet = deployment.sheet_of(pad)
        parameters = network_parameters(pad), sheet.ohm_per_square
        if parameters not in shared:
            shared[parameters] = pad_channels(pad, sheet, deployment.nodes[pad.node])
        networks.append(shared[parameters])
    return networks


def law_of(sheet: config.Sheet) -> LawParameters:
    """Return the contact law of a deployment's sheet, with its tolerances."""
    local_std = math.hypot(sheet.ohm_per_square_std, _LOCAL_UNEVENNESS * sheet.unevenness_std)
    covariance = np.diag(np.square([sheet.contact_ohm_std, sheet.alpha_std, local_std]))
    return LawParameters(
        sheet.contact_ohm_mm2, sheet.alpha, sheet.ohm_per_square, matrix(covariance), sheet.hertz_force_n
    )


def contact_law(sheet: config.Sheet, law: LawParameters) -> ContactLaw:
    """Return a law in SI units, with the contact radius of the deployment's sheet."""
    return sheet_law(sheet, law.contact_ohm_mm2, law.alpha, law.hertz_force_n)


def default_calibration_id_of(pad: config.Pad, deployment: Deployment) -> str:
    """Return the id of the default calibration, which changes with the pad's tables in the deployment.

    Not with `serial`: calibrations are bound to it anyway, and a replacement node keeps its own when the
    deployment file gets its serial number. Nor with tolerances: they are no part of what is calibrated.
    """
    node, sheet = deployment.nodes[pad.node], deployment.sheet_of(pad)
    absent = {"shear", "shear_electrodes"} | (set() if pad.second_sheet else {"second_sheet"})
    absent |= set() if pad.arcs_mm else {"electrode_arcs_mm"}
    absent |= set() if pad.switch_states else {"switch_states"}
    absent |= set() if pad.resistance_map else {"resistance_map"}
    absent |= set() if pad.press_map else {"press_map"}
    absent |= set() if pad.response else {"response"}
    text = pad.model_copy(update={"serial": None}).model_dump_json(exclude=absent)
    text += node.model_dump_json(exclude=_NODE_TOLERANCES)
    for one in (sheet, deployment.sheets.get(pad.second_sheet or "")):
        if one is not None:
            unstated = _SHEET_TOLERANCES | ({"hertz_force_n"} if one.hertz_force_n is None else set())
            text += one.model_dump_json(exclude=unstated)
    return "nominal-" + hashlib.sha256(text.encode()).hexdigest()[:12]
