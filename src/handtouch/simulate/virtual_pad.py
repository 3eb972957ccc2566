"""One pad of a virtual hand, with its true parts, contacts and faults: counts of its channels at any time.

Public names: `VirtualPad`, `drift_of`, `channel_errors_of`, `true_gaps`, `true_arcs`. It has no clock and no
state: the same time gives the same counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.config.channels import Channels, node_channels, order_by_electrode
from handtouch.config.responses import TwoLayersTable
from handtouch.config.roles import ELECTRODE, SECOND_SHEET, channel_numbers
from handtouch.hand.pads import mount_transform
from handtouch.simulate import noise
from handtouch.simulate.coarse_sheet import uneven_sheet_maps
from handtouch.simulate.electronics_drift import ChannelErrors, ElectronicsDrift
from handtouch.simulate.faults import (
    Fault,
    Gum,
    Moisture,
    ShortedElectrode,
    StuckChannel,
    SwappedCables,
    TornCorner,
    electrode_index,
)
from handtouch.simulate.film import FilmRatio
from handtouch.simulate.pad_circuit import PadCircuit
from handtouch.simulate.pad_geometry import SimulatedSurface
from handtouch.simulate.response_circuit import ResponseCircuit, response_circuit
from handtouch.simulate.shear_pad import VirtualShear
from handtouch.simulate.sheet_history import SimulatedSheetHistory
from handtouch.simulate.sheet_physics import SheetLaw
from handtouch.simulate.sheet_solver import ArcEnds, ElectrodeGaps
from handtouch.simulate.skin import FieldLoad, SkinLoad, link_motion
from handtouch.simulate.stimulus import NodeReplacement, PadStimulus, Stimulus
from handtouch.simulate.surfaces import simulated_surface
from handtouch.simulate.two_layers import two_layer_circuit
from handtouch.simulate.unevenness import Unevenness
from handtouch.simulate.worlds import UNEVEN_MODES, DrawnWorld, HiddenPad

CountArray = NDArray[np.int64]
_FAULTS_OF_SHEETS = Moisture, ShortedElectrode, SwappedCables, TornCorner
_IDEAL_SHEET_GAIN_PER_K = 0.01  # as the paper's sheets


@dataclass(frozen=True, eq=False)
class VirtualPad:
    """One pad: its contacts, faults, sheet and channels."""

    hand: str
    pad: config.Pad
    sheet: config.Sheet
    circuit: PadCircuit | ResponseCircuit
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
    world: DrawnWorld
    sheet_law: SheetLaw | None
    repeat_period_s: float
    """Period after which the scenario repeats; infinite: it doesn't."""
    shear: VirtualShear | None
    """Shear pad beneath it."""
    load: SkinLoad | FieldLoad | None
    """Skin on it that presses by its weight, or the Earth's field on a magnetic pad."""
    duration_s: float
    """Duration of one pass of the scenario."""
    sheet_from_s: float = 0.0
    """Time at which its sheet was fresh."""
    new_sheets: tuple[VirtualPad, ...] = ()
    """The same pad with the sheets that replace this one, in the order of time."""
    is_total: bool = False
    """The electrodes are joined and read by one channel: it is the second sheet of a pad."""

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
        sheet = world.sheet(hand, pad, _stated_sheet(pad, deployment))
        if new_sheet is not None and new_sheet.contact_ohm_ratio is not None:
            first = replace(world, sheet_number=0).sheet(hand, pad, deployment.sheet_of(pad))
            ohm = first.contact_ohm_mm2 * new_sheet.contact_ohm_ratio
            sheet = sheet.model_copy(update={"contact_ohm_mm2": ohm})
        limits = np.array([channel.limits for channel in order_by_electrode(node_channels(node), pad)])
        per_ampere, limit_a = _channels(node, pad, hidden)
        _check_faults(pad, faults, stimulus)
        circuit = _true_circuit(pad, node, (deployment.sheet_of(pad), sheet), world, hand, limit_a)
        touches = stimulus.pad_stimulus(pad.link, lambda number: world.contact(sheet, number).patch)
        repeat_s = stimulus.duration_s if stimulus.repeat else np.inf
        shear = VirtualShear(deployment, hand, pad, touches, world, repeat_s) if pad.shear else None
        rotation, translation = world.mount(hand, pad)
        load: SkinLoad | FieldLoad | None = None
        if isinstance(circuit, PadCircuit):
            load = SkinLoad.of_pad(deployment, hand, pad, circuit, stimulus, (rotation, translation))
        elif circuit.field_axes is not None:
            (table,) = (one for one in deployment.hands if one.name == hand)
            motion = link_motion(table, pad, stimulus)
            load = FieldLoad(circuit.field_axes @ rotation.T, world.magnetic_field(hand), motion)
        changes = sorted(stimulus.node_replacements, key=lambda change: change.at_s)
        own_changes = [change for change in changes if change.link == pad.link]
        return cls(
            hand=hand,
            pad=pad,
            sheet=sheet,
            circuit=circuit,
            touches=touches,
            faults=tuple(fault for fault in faults if fault.link == pad.link),
            rotation=rotation,
            translation=translation,
            noise_counts=node.noise_counts * hidden.noise_ratio,
            noise_keys=_noise_keys(world, hand, pad),
            limits=limits,
            counts_per_ampere=per_ampere,
            replacement_gains=tuple(
                (change.at_s, _replaced_gains(change, pad, hidden, world))
                for change in own_changes
                if change.serial is not None
            ),
            world=world,
            sheet_law=hidden.sheet_law,
            repeat_period_s=repeat_s,
            shear=shear,
            load=load,
            duration_s=stimulus.duration_s,
            sheet_from_s=0.0 if new_sheet is None else new_sheet.at_s,
            new_sheets=tuple(
                cls.build(deployment, hand, pad, stimulus, world, faults, change)
                for change in own_changes
                if new_sheet is None and change.sheet is not None
            ),
        )

    def build_second(self, deployment: config.Deployment, faults: Sequence[Fault]) -> VirtualPad:
        """Build the second sheet of this pad, under the same contacts: a pad with parts, layer and behaviour
        of its own, whose electrodes are joined without resistors."""
        number = channel_numbers(self.pad, SECOND_SHEET)[0]
        joined: dict[str, Any] = {
            "link": f"{self.pad.link}/second",
            "sheet": self.pad.second_sheet,
            "second_sheet": None,
            "shear": None,
            "series_ohm": (0.0,) * len(self.pad.electrode_names),
        }
        pad, node = self.pad.model_copy(update=joined), deployment.nodes[self.pad.node]
        hidden = self.world.pad(self.hand, pad)
        sheet = self.world.sheet(self.hand, pad, deployment.sheet_of(pad))
        _, limit_a = _channels(node, pad, hidden)
        channels = node_channels(node)
        return replace(
            self,
            pad=pad,
            sheet=sheet,
            circuit=_true_circuit(
                pad, node, (deployment.sheet_of(pad), sheet), self.world, self.hand, limit_a
            ),
            faults=tuple(fault for fault in faults if isinstance(fault, Gum) and fault.link == self.pad.link),
            noise_counts=node.noise_counts * hidden.noise_ratio,
            noise_keys=_noise_keys(self.world, self.hand, pad)[:1],
            limits=np.array([channels[number].limits]),
            counts_per_ampere=np.array(
                [_stated_counts_per_ampere(node, channels, number) * hidden.gain_ratio[0]]
            ),
            replacement_gains=(),
            sheet_law=hidden.sheet_law,
            shear=None,
            load=None,
            new_sheets=(),
            is_total=True,
        )

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels: the electrodes, or their total."""
        return ("total",) if self.is_total else self.pad.electrode_names

    @cached_property
    def drift(self) -> ElectronicsDrift:
        """Drift of this pad."""
        return drift_of([self], self.world)

    @cached_property
    def errors(self) -> ChannelErrors:
        """Errors of its channels."""
        return channel_errors_of([self], self.world)

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
            (
                np.concatenate([force_times, after, ends]),
                np.concatenate([settling, gum, ends]),
                np.concatenate([begins, gum]),
            ),
            self.repeat_period_s,
            self.sheet_from_s,
        )

    def prepare(self) -> None:
        """Solve the sheet for all contacts and faults in advance, so that a live hand doesn't pause."""
        if self.load:
            self.load.prepare(self.duration_s)
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
        if self.is_total:
            amperes = amperes.sum(axis=1, keepdims=True)
        if self.load:
            amperes += self.load_currents(times_s) * self.drift.supply_ratio(times_s)[:, None]
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

    def load_currents(self, times_s: FloatArray) -> FloatArray:
        """Return the currents (n, m) [A] of the skin's weight, or signals of the field, at times (n,), at
        nominal supply."""
        if self.load is None:
            return np.zeros((len(times_s), len(self.limits)))
        return self.load.currents(self._scenario_time_s(times_s))

    def _apply_stuck_channel(self, fault: StuckChannel, times_s: FloatArray, counts: CountArray) -> None:
        active = np.flatnonzero(fault.is_active(self._scenario_time_s(times_s)))
        if len(active):
            channel = electrode_index(fault.electrode)
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


def drift_of(pads: Sequence[VirtualPad], world: DrawnWorld) -> ElectronicsDrift:
    """Return the drift of the electronics of pads."""
    return ElectronicsDrift(
        world, [(pad.hand, pad.pad.link) for pad in pads], [pad.channel_names for pad in pads]
    )


def channel_errors_of(pads: Sequence[VirtualPad], world: DrawnWorld) -> ChannelErrors:
    """Return the errors of the channels of pads."""
    return ChannelErrors(
        world,
        [(pad.hand, pad.pad.link) for pad in pads],
        [len(pad.limits) for pad in pads],
        [float(pad.limits[:, 1].min()) for pad in pads],
    )


def _channels(node: config.Node, pad: config.Pad, hidden: HiddenPad) -> tuple[FloatArray, FloatArray]:
    """Return the true counts per ampere (m,) of a pad's electrodes, and their greatest currents (m,) [A]."""
    channels, numbers = node_channels(node), channel_numbers(pad, ELECTRODE)
    stated = np.array([_stated_counts_per_ampere(node, channels, number) for number in numbers])
    per_ampere = stated * _gain_ratios(pad, hidden)
    highest = np.array([channels[number].limits[1] for number in numbers])
    return per_ampere, highest / per_ampere


def _stated_counts_per_ampere(node: config.Node, channels: Channels, number: int) -> float:
    """Return the counts per ampere of one of a node's channels as its table states them."""
    full = node.full_scale_counts or channels[number].limits[1]
    return full / (node.full_scale_ma * 1e-3 * node.channel_scale[number])


def _replaced_gains(
    change: NodeReplacement, pad: config.Pad, hidden: HiddenPad, world: DrawnWorld
) -> FloatArray:
    """Return the gains (m,) of a new node relative to those of the first one."""
    gains = change.gain or world.replacement_gain(change.serial or 0, len(pad.electrode_names))
    return np.asarray(np.array(gains) / np.array(hidden.gain_ratio))


def _noise_keys(world: DrawnWorld, hand: str, pad: config.Pad) -> NDArray[np.uint64]:
    """Return the random streams (m,) of the noise of a pad's electrodes."""
    return np.array(
        [noise.stream_key(world.seed, "noise", hand, pad.link, name) for name in pad.electrode_names]
    )


def _true_circuit(
    pad: config.Pad,
    node: config.Node,
    sheets: tuple[config.Sheet, config.Sheet],
    world: DrawnWorld,
    hand: str,
    limit_a: FloatArray,
) -> PadCircuit | ResponseCircuit:
    """Return the circuit of a pad with its true parts; sheets: as stated, and the true one; limit_a: (m,),
    greatest current of each channel."""
    shape, hidden = world.surface(hand, pad), world.pad(hand, pad)
    if isinstance(pad.response, TwoLayersTable):
        return two_layer_circuit(pad, sheets[1], node.drive_v, shape, hidden)
    if pad.response:
        count = len(pad.electrode_names)
        return response_circuit(pad, shape, world.response(f"{hand}/{pad.link}", count))
    gaps = true_arcs(pad, hidden) if pad.arcs_mm else true_gaps(shape, hidden)
    film = FilmRatio.of_pad(pad, sheets[0], simulated_surface(pad.surface))
    unevenness = Unevenness(UNEVEN_MODES, hidden.unevenness, film)
    return PadCircuit(
        shape=shape,
        gaps=gaps,
        maps=uneven_sheet_maps(shape, gaps, unevenness),
        unevenness=unevenness,
        sheet=sheets[1],
        series_ohm=np.array(hidden.series_ohm),
        drive_v=node.drive_v,
        limit_a=limit_a,
        states=pad.state_numbers,
    )


def _gain_ratios(pad: config.Pad, hidden: HiddenPad) -> FloatArray:
    """Return the true over the stated gain of each electrode's channel; switched ones share channels."""
    ratios = np.array(hidden.gain_ratio)
    for first, *others in zip(*pad.state_numbers, strict=True):
        ratios[others] = ratios[first]
    return ratios


def _stated_sheet(pad: config.Pad, deployment: config.Deployment) -> config.Sheet:
    """Return the sheet of a pad, of a response with the spread of its contacts."""
    sheet = deployment.sheet_of(pad)
    std_mm = getattr(pad.response, "contact_radius_std_mm", sheet.contact_radius_std_mm)
    return sheet.model_copy(update={"contact_radius_std_mm": std_mm})


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
    own = [fault for fault in faults if fault.link == pad.link]
    if pad.response and any(isinstance(fault, _FAULTS_OF_SHEETS) for fault in own):
        kinds = ", ".join(
            sorted({fault.fault_kind() for fault in own if isinstance(fault, _FAULTS_OF_SHEETS)})
        )
        raise ValueError(f"{pad.link}: {kinds} isn't simulated on a pad with a response")
    for fault in own:
        name = getattr(fault, "electrode", None)
        if name is not None and name not in pad.electrode_names:
            raise ValueError(f"{pad.link}: has no {name}, but {', '.join(pad.electrode_names)}")
