"""One pad of a virtual hand, with its true parts, contacts and faults: counts of its channels at any time.

Public names: `VirtualPad`, `true_gaps`, `true_arcs`. It has no clock and no state:
the same time gives the same counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch import config
from handtouch.config.channels import node_channels, order_by_electrode
from handtouch.config.tables import SIDE_ELECTRODES
from handtouch.hand.pads import mount_transform
from handtouch.simulate import noise
from handtouch.simulate.channel_errors import ChannelErrors
from handtouch.simulate.electronics_drift import ElectronicsDrift
from handtouch.simulate.faults import Fault, Gum, StuckChannel
from handtouch.simulate.film import FilmRatio
from handtouch.simulate.pad_circuit import PadCircuit
from handtouch.simulate.pad_geometry import SimulatedSurface
from handtouch.simulate.sheet_history import SimulatedSheetHistory
from handtouch.simulate.sheet_physics import SheetLaw
from handtouch.simulate.sheet_solver import ArcEnds, ElectrodeGaps
from handtouch.simulate.skin import SkinLoad
from handtouch.simulate.stimulus import NodeReplacement, PadStimulus, Stimulus
from handtouch.simulate.surfaces import simulated_surface
from handtouch.simulate.uneven_sheet import uneven_sheet_maps
from handtouch.simulate.unevenness import Unevenness
from handtouch.simulate.virtual_shear import VirtualShear
from handtouch.simulate.worlds import UNEVEN_MODES, DrawnWorld, HiddenPad

FloatArray = NDArray[np.float64]
CountArray = NDArray[np.int64]
_IDEAL_SHEET_GAIN_PER_K = 0.01  # as the paper's sheets


@dataclass(frozen=True, eq=False)
class VirtualPad:
    """One pad: its contacts, faults, sheet and channels."""

    hand: str
    pad: config.Pad
    sheet: config.Sheet
    circuit: PadCircuit
    touches: PadStimulus
    faults: tuple[Fault, ...]
    rotation: FloatArray
    translation: FloatArray
    noise_counts: float
    noise_keys: NDArray[np.uint64]
    """(m,), random streams of the channels' noise."""
    limits: CountArray
    """(m, 2), lowest and highest count of each channel."""
    counts_per_ampere: FloatArray
    """(m,), of the channels."""
    replacement_gains: tuple[tuple[float, FloatArray], ...]
    """Times of node replacements [s], with the gains (m,) of the new node relative to the first one's."""
    drift: ElectronicsDrift
    """Drift of this pad."""
    errors: ChannelErrors
    """Errors of its channels."""
    sheet_law: SheetLaw | None
    repeat_period_s: float
    """Period after which the scenario repeats; infinite: it doesn't."""
    shear: VirtualShear | None
    """Shear pad beneath it."""
    skin: SkinLoad | None
    """Skin on it that presses by its weight."""
    duration_s: float
    """Duration of one pass of the scenario."""
    sheet_from_s: float = 0.0
    """Time at which its sheet was fresh."""
    new_sheets: tuple[VirtualPad, ...] = ()
    """The same pad with the sheets that replace this one, in the order of time."""

    @classmethod
    def build(
        cls,
        deployment: config.Deployment,
        hand: str,
        pad: config.Pad,
        stimulus: Stimulus,
        world: DrawnWorld,
        faults: Sequence[Fault],
        new_sheet: NodeReplacement | None = None,
    ) -> VirtualPad:
        """Build a pad with the touches, faults and replacements of its link; `new_sheet`: that which it has
        from then on."""
        if new_sheet is not None:
            assert new_sheet.sheet is not None
            world = replace(world, sheet_number=new_sheet.sheet)
        node, hidden = deployment.nodes[pad.node], world.pad(hand, pad)
        sheet = world.sheet(hand, pad, deployment.sheets[pad.sheet])
        if new_sheet is not None and new_sheet.contact_ohm_ratio is not None:
            first = replace(world, sheet_number=0).sheet(hand, pad, deployment.sheets[pad.sheet])
            ohm = first.contact_ohm_mm2 * new_sheet.contact_ohm_ratio
            sheet = sheet.model_copy(update={"contact_ohm_mm2": ohm})
        channels = order_by_electrode(node_channels(node), pad)
        limits = np.array([channel.limits for channel in channels])
        scale = np.array([node.channel_scale[pad.electrodes.index(name)] for name in pad.electrode_names])
        full = np.array([node.full_scale_counts or high for high in limits[:, 1]])
        per_ampere = full / (node.full_scale_ma * 1e-3 * scale) * _gain_ratios(pad, hidden)
        shape = world.surface(hand, pad)
        gaps = true_arcs(pad, hidden) if pad.arcs_mm else true_gaps(shape, hidden)
        _check_faults(pad, faults, stimulus)
        nominal = simulated_surface(pad.surface)
        film = FilmRatio.of_pad(pad, deployment.sheets[pad.sheet], nominal)
        unevenness = Unevenness(UNEVEN_MODES, hidden.unevenness, film)
        circuit = PadCircuit(
            shape,
            gaps,
            uneven_sheet_maps(shape, gaps, unevenness),
            unevenness,
            sheet,
            np.array(hidden.series_ohm),
            node.drive_v,
            limits[:, 1] / per_ampere,
            pad.state_numbers,
        )
        touches = stimulus.pad_stimulus(pad.link, lambda number: world.contact(sheet, number).patch)
        repeat_s = stimulus.duration_s if stimulus.repeat else np.inf
        shear = VirtualShear(deployment, hand, pad, touches, world, repeat_s) if pad.shear else None
        keys = [noise.stream_key(world.seed, "noise", hand, pad.link, name) for name in pad.electrode_names]
        return cls(
            hand,
            pad,
            sheet,
            circuit,
            touches,
            tuple(fault for fault in faults if fault.link == pad.link),
            *world.mount(hand, pad),
            node.noise_counts * hidden.noise_ratio,
            np.array(keys),
            limits,
            per_ampere,
            tuple(
                (
                    node.at_s,
                    np.array(node.gain or world.replacement_gain(node.serial or 0))
                    / np.array(hidden.gain_ratio),
                )
                for node in sorted(stimulus.node_replacements, key=lambda node: node.at_s)
                if node.link == pad.link and node.serial is not None
            ),
            ElectronicsDrift(world, [(hand, pad.link)], [pad.electrode_names]),
            ChannelErrors(world, [(hand, pad.link)], [len(pad.electrode_names)], [float(limits[:, 1].min())]),
            hidden.sheet_law,
            repeat_s,
            shear,
            SkinLoad.of_pad(deployment, hand, pad, circuit, stimulus, world.mount(hand, pad)),
            stimulus.duration_s,
            new_sheet.at_s if new_sheet is not None else 0.0,
            tuple(
                cls.build(deployment, hand, pad, stimulus, world, faults, swap)
                for swap in sorted(stimulus.node_replacements, key=lambda swap: swap.at_s)
                if new_sheet is None and swap.link == pad.link and swap.sheet is not None
            ),
        )

    @cached_property
    def stated_mount(self) -> tuple[FloatArray, FloatArray]:
        """Rotation (3, 3) and translation (3,) [m] from the pad's frame to its link's, as stated."""
        return mount_transform(self.pad)

    @property
    def shape(self) -> SimulatedSurface:
        """Surface of the pad."""
        return self.circuit.shape

    @property
    def has_single_contacts_only(self) -> bool:
        """True without faults, replaced nodes and simultaneous contacts."""
        return (
            not (self.faults or self.replacement_gains or self.new_sheets) and self.touches.max_contacts <= 1
        )

    def counts(self, times_s: ArrayLike) -> CountArray:
        """Return counts (n, m) of the channels at times (n,) since the start."""
        t = np.atleast_1d(np.asarray(times_s, np.float64))
        counts = self._compute_counts(t, self._other_faults)
        for fault in self._stuck_faults:
            self._apply_stuck_channel(fault, t, counts)
        for pad in self.new_sheets:
            later = np.flatnonzero(t >= pad.sheet_from_s)
            if len(later):
                counts[later] = pad.counts(t[later])
        return counts

    @property
    def is_ideal(self) -> bool:
        """True if apparent and true force are always the same."""
        return self.sheet_law is None and self.drift.is_constant and not self.faults

    def force_ratio(self, times_s: FloatArray, total_force_n: FloatArray | None = None) -> FloatArray:
        """Return apparent over true force (n,); total_force_n: as in `SimulatedSheetHistory.force_ratio`."""
        if self.is_ideal:
            return np.ones(len(times_s))
        if self.history is None:
            return np.asarray(1 + _IDEAL_SHEET_GAIN_PER_K * self._temperature_rise_k(times_s))
        return self.history.force_ratio(times_s, total_force_n)

    @cached_property
    def history(self) -> SimulatedSheetHistory | None:
        """History of the sheet; None for an ideal sheet."""
        if self.sheet_law is None:
            return None
        force_times, settling, begins = self.touches.event_times_s
        gum = [fault.from_s for fault in self.faults if isinstance(fault, Gum)]
        ends = [fault.until_s for fault in self.faults if isinstance(fault, Gum) and fault.until_s]
        after = [from_s + step for from_s in gum for step in np.arange(0, 4, 0.05)]
        return SimulatedSheetHistory(
            self.sheet_law,
            self.noise_keys[0] + np.uint64(7),
            self._total_force_n,
            self._temperature_rise_k,
            np.concatenate([force_times, after, ends]),
            np.concatenate([settling, gum, ends]),
            np.concatenate([begins, gum]),
            self.repeat_period_s,
            self.sheet_from_s,
        )

    def prepare(self) -> None:
        """Solve the sheet for all contacts and faults in advance, so that a live hand doesn't pause."""
        if self.skin:
            self.skin.prepare(self.duration_s)
        if not self.has_single_contacts_only:
            begins = [fault.from_s for fault in self.faults]
            changes = [*self.touches.event_times_s[1], *begins]
            times = [t + step for t in changes for step in (0.01, 0.1) if t + step < self.repeat_period_s]
            self.counts(np.array(times, np.float64))

    def _total_force_n(self, scenario_s: FloatArray) -> FloatArray:
        """Return the total force (n,) at times of the scenario."""
        total = self.touches.contacts(scenario_s)[1].sum(0)
        for fault in self.faults:
            contacts = fault.contacts(scenario_s, self.circuit.size_m)
            if contacts is not None and contacts.force_n is not None:
                total += contacts.force_n
        return np.asarray(total)

    def _temperature_rise_k(self, times_s: FloatArray) -> FloatArray:
        scenario_s = self._scenario_time_s(times_s)
        return np.asarray(
            self.drift.temperature_rise_k(times_s)
            + sum(fault.temperature_rise_k(scenario_s) for fault in self.faults)
        )

    def _compute_counts(self, times_s: FloatArray, faults: Sequence[Fault]) -> CountArray:
        scenario_s = self._scenario_time_s(times_s)
        force_ratio, supply_ratio = self.force_ratio(times_s), self.drift.supply_ratio(times_s)
        amperes = self.circuit.currents(scenario_s, self.touches, faults, force_ratio, supply_ratio)
        if self.skin:
            amperes += self.skin_currents(times_s) * self.drift.supply_ratio(times_s)[:, None]
        for fault in faults:
            if order := fault.channel_permutation:
                amperes = np.where(fault.is_active(scenario_s)[:, None], amperes[:, order], amperes)
        counts = amperes * self.counts_per_ampere * self.drift.gain_ratio(times_s)[:, 0]
        for from_s, gains in self.replacement_gains:
            later = [at_s for at_s, _ in self.replacement_gains if at_s > from_s]
            counts[(times_s >= from_s) & (times_s < min(later, default=np.inf))] *= gains
        counts += self.drift.zero_counts(times_s)[:, 0]
        for fault in faults:
            active = np.flatnonzero(fault.is_active(scenario_s))
            counts[active] = fault.distort_counts(counts[active])
        sample_ns = np.rint(times_s * 1e9).astype(np.int64)
        counts += self.noise_counts * noise.standard_normal(self.noise_keys, sample_ns[:, None])
        if self.errors.disturbs:
            counts += self.errors.disturbance(times_s)[:, 0]
        if self.errors.distorts:
            counts = self.errors.distorted(counts[:, None])[:, 0]
        readings = np.clip(np.rint(counts), *self.limits.T).astype(np.int64)
        for fault in faults:
            active = np.flatnonzero(fault.is_active(scenario_s))
            affected = readings[active]
            fault.override_counts(affected, self.limits)
            readings[active] = affected
        return readings

    def skin_currents(self, times_s: FloatArray) -> FloatArray:
        """Return the currents (n, m) [A] of the skin's weight at times (n,), at nominal supply."""
        if self.skin is None:
            return np.zeros((len(times_s), len(self.limits)))
        return self.skin.currents(self._scenario_time_s(times_s))

    def _apply_stuck_channel(self, fault: StuckChannel, times_s: FloatArray, counts: CountArray) -> None:
        active = np.flatnonzero(fault.is_active(self._scenario_time_s(times_s)))
        if len(active):
            channel = SIDE_ELECTRODES.index(fault.electrode)
            stuck = self._compute_counts(np.array([fault.from_s]), self._other_faults)[0, channel]
            counts[active, channel] = stuck

    def _scenario_time_s(self, times_s: FloatArray) -> FloatArray:
        """Convert times since the start to times of a possibly repeating scenario."""
        return times_s % self.repeat_period_s if np.isfinite(self.repeat_period_s) else times_s

    @cached_property
    def _stuck_faults(self) -> list[StuckChannel]:
        """Faults that hold the reading of a channel at their begin."""
        return [fault for fault in self.faults if isinstance(fault, StuckChannel) and fault.count is None]

    @cached_property
    def _other_faults(self) -> list[Fault]:
        return [fault for fault in self.faults if fault not in self._stuck_faults]


def _gain_ratios(pad: config.Pad, hidden: HiddenPad) -> FloatArray:
    """Return the true over the stated gain of each electrode's channel; switched ones share channels."""
    ratios = np.array(hidden.gain_ratio)
    for first, *others in zip(*pad.state_numbers, strict=True):
        ratios[others] = ratios[first]
    return ratios


def true_gaps(shape: SimulatedSurface, hidden: HiddenPad) -> ElectrodeGaps:
    """Return the gaps in the coordinates of the surface."""
    x0, xa, y0, yb = (
        (1e-3 * before / unit, 1e-3 * after / unit)
        for before, after, unit in zip(
            hidden.gap_before_mm, hidden.gap_after_mm, shape.side_units(), strict=True
        )
    )
    return ElectrodeGaps(x0, xa, y0, yb)


def true_arcs(pad: config.Pad, hidden: HiddenPad) -> ArcEnds:
    """Return the ends of electrodes on arcs of a pad's outline."""
    return tuple(
        (1e-3 * (begin + before), 1e-3 * (end - after))
        for (begin, end), before, after in zip(
            pad.arcs_mm, hidden.gap_before_mm, hidden.gap_after_mm, strict=True
        )
    )


def _check_faults(pad: config.Pad, faults: Sequence[Fault], stimulus: Stimulus) -> None:
    """Raise ValueError for faults and replacements of a pad that the simulator has for four sides only."""
    changes = [*(f.link for f in faults), *(node.link for node in stimulus.node_replacements)]
    if pad.arcs_mm and pad.link in changes:
        raise ValueError(f"{pad.link}: faults and replaced nodes aren't simulated with electrodes on arcs")
