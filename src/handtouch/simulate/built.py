"""A pad as it was built, in a world and under a scenario: its counts at any times.

Public name: `BuiltPad`. No clock and no state: the same time gives the same counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch import config
from handtouch.canbus.objects.channels import ELECTRODES, channels_of, in_order
from handtouch.sheet import SheetModel
from handtouch.simulate import noise
from handtouch.simulate.faults import Fault, Gum, StuckChannel
from handtouch.simulate.history import History
from handtouch.simulate.pad import PadCircuit
from handtouch.simulate.play import OnPad, Play
from handtouch.simulate.shape import Shape, shape_of
from handtouch.simulate.sheet import Gaps, solve
from handtouch.simulate.world import Climate, Parts, World

FloatArray = NDArray[np.float64]
CountArray = NDArray[np.int64]
_GAIN_PER_K = 0.01  # of an ideal sheet: that of the paper's


@dataclass(frozen=True, eq=False)
class BuiltPad:
    """One pad: what presses on it, what is wrong with it, its sheet and its channels."""

    hand: str
    pad: config.Pad
    sheet: config.Sheet
    circuit: PadCircuit
    touches: OnPad
    faults: tuple[Fault, ...]
    rotation: FloatArray
    translation: FloatArray
    noise_counts: float
    keys: NDArray[np.uint64]
    """(4,) of the noise of its channels."""
    limits: CountArray
    """(4, 2)."""
    counts_per_ampere: FloatArray
    """(4,) of the channels x0, xa, y0, yb."""
    swapped: tuple[tuple[float, FloatArray], ...]
    """When another unit was put in [s], and its gains (4,) relative to those of the first one."""
    climate: Climate
    """Of this pad alone."""
    model: SheetModel | None
    round_s: float
    """After this the scenario begins again; infinite: never."""

    @classmethod
    def of(
        cls,
        deployment: config.Deployment,
        hand: str,
        pad: config.Pad,
        scenario: Play,
        world: World,
        faults: Sequence[Fault],
    ) -> BuiltPad:
        """Build it; of touches and faults it takes those on its link."""
        node, sheet, parts = deployment.nodes[pad.node], deployment.sheets[pad.sheet], world.parts(hand, pad)
        channels = in_order(channels_of(node.channels, node.eds), pad.electrodes)
        limits = np.array([channel.limits for channel in channels])
        scale = np.array([node.channel_scale[pad.electrodes.index(name)] for name in ELECTRODES])
        full = np.array([node.full_scale_counts or high for high in limits[:, 1]])
        per_ampere = full / (node.full_scale_ma * 1e-3 * scale) * np.array(parts.gain)
        shape = shape_of(pad.surface)
        gaps = _gaps(shape, parts)
        circuit = PadCircuit(
            shape,
            gaps,
            solve(shape, gaps),
            sheet,
            np.array(parts.series_ohm),
            node.drive_v,
            limits[:, 1] / per_ampere,
        )
        keys = [noise.key(world.seed, "noise", hand, pad.link, name) for name in ELECTRODES]
        return cls(
            hand,
            pad,
            sheet,
            circuit,
            scenario.on(pad.link, lambda number: 1e-3 * world.radius_mm(sheet, number)),
            tuple(fault for fault in faults if fault.link == pad.link),
            *world.mount(hand, pad),
            node.noise_counts if world.noise_counts is None else world.noise_counts,
            np.array(keys),
            limits,
            per_ampere,
            tuple(
                (swap.at_s, np.array(swap.gain or world.gain_of(swap.serial)) / np.array(parts.gain))
                for swap in sorted(scenario.swaps, key=lambda swap: swap.at_s)
                if swap.link == pad.link
            ),
            Climate(world, [(hand, pad.link)]),
            world.model(hand, pad.link),
            scenario.duration_s if scenario.repeat else np.inf,
        )

    @property
    def shape(self) -> Shape:
        """Its surface."""
        return self.circuit.shape

    @property
    def plain(self) -> bool:
        """Whether it has never more than one contact, and nothing wrong with it."""
        return not (self.faults or self.swapped) and self.touches.depth <= 1

    def counts(self, times_s: ArrayLike) -> CountArray:
        """Counts (n, 4) of the electrodes x0, xa, y0, yb at times (n,) from the start of the scenario."""
        t = np.atleast_1d(np.asarray(times_s, np.float64))
        read = self._read(t, self._lasting)
        for fault in self._stuck:
            self._hold(fault, t, read)
        return read

    @property
    def ideal(self) -> bool:
        """Whether its sheet makes of a force what the file says."""
        return self.model is None and self.climate.steady and not self.faults

    def yields(self, times_s: FloatArray) -> FloatArray:
        """Apparent over true force (n,): what the sheet makes of what presses on it."""
        if self.ideal:
            return np.ones(len(times_s))
        if self.history is None:
            return np.asarray(1 + _GAIN_PER_K * self._warmer_k(times_s))
        return self.history.yields(times_s)

    @cached_property
    def history(self) -> History | None:
        """What its sheet goes through; None for an ideal sheet."""
        if self.model is None:
            return None
        changes, settles, begins = self.touches.changes
        gum = [fault.from_s for fault in self.faults if isinstance(fault, Gum)]
        ends = [fault.until_s for fault in self.faults if isinstance(fault, Gum) and fault.until_s]
        after = [from_s + step for from_s in gum for step in np.arange(0, 4, 0.05)]
        return History(
            self.model,
            self.keys[0] + np.uint64(7),
            self._load,
            self._warmer_k,
            np.concatenate([changes, after, ends]),
            np.concatenate([settles, gum, ends]),
            np.concatenate([begins, gum]),
            self.round_s,
        )

    def prepare(self) -> None:
        """Solve what the faults will need, before a live hand must not pause for it."""
        if not self.plain:
            begins = [fault.from_s for fault in self.faults]
            changes = [*self.touches.changes[1], *begins]
            times = [t + step for t in changes for step in (0.01, 0.1) if t + step < self.round_s]
            self.counts(np.array(times, np.float64))

    def _load(self, since_s: FloatArray) -> FloatArray:
        """Total force (n,) [N] at times of a round."""
        total = self.touches.contacts(since_s)[1].sum(0)
        for fault in self.faults:
            found = fault.contacts(since_s, self.circuit.size_m)
            if found is not None and found.force_n is not None:
                total += found.force_n
        return np.asarray(total)

    def _warmer_k(self, times_s: FloatArray) -> FloatArray:
        since = self._since(times_s)
        return np.asarray(
            self.climate.warmer_k(times_s) + sum(fault.warmer_k(since) for fault in self.faults)
        )

    def _read(self, times_s: FloatArray, faults: Sequence[Fault]) -> CountArray:
        since = self._since(times_s)
        yields, drive = self.yields(times_s), self.climate.drive(times_s)
        amperes = self.circuit.currents(since, self.touches, faults, yields, drive)
        for fault in faults:
            if order := fault.permutation:
                amperes = np.where(fault.active(since)[:, None], amperes[:, order], amperes)
        counts = amperes * self.counts_per_ampere * self.climate.gain(times_s)[:, None]
        for from_s, gains in self.swapped:
            later = [at_s for at_s, _ in self.swapped if at_s > from_s]
            counts[(times_s >= from_s) & (times_s < min(later, default=np.inf))] *= gains
        counts += self.climate.zero(times_s)[:, 0]
        for fault in faults:
            at = np.flatnonzero(fault.active(since))
            counts[at] = fault.signal(counts[at])
        moments = np.rint(times_s * 1e9).astype(np.int64)
        counts += self.noise_counts * noise.normal(self.keys, moments[:, None])
        read = np.clip(np.rint(counts), *self.limits.T).astype(np.int64)
        for fault in faults:
            at = np.flatnonzero(fault.active(since))
            held = read[at]
            fault.freeze(held, self.limits)
            read[at] = held
        return read

    def _hold(self, fault: StuckChannel, times_s: FloatArray, read: CountArray) -> None:
        at = np.flatnonzero(fault.active(self._since(times_s)))
        if len(at):
            channel = ELECTRODES.index(fault.electrode)
            read[at, channel] = self._read(np.array([fault.from_s]), self._lasting)[0, channel]

    def _since(self, times_s: FloatArray) -> FloatArray:
        """Times in the round of the scenario."""
        return times_s % self.round_s if np.isfinite(self.round_s) else times_s

    @cached_property
    def _stuck(self) -> list[StuckChannel]:
        """Faults that hold what a channel showed when they began."""
        return [fault for fault in self.faults if isinstance(fault, StuckChannel) and fault.count is None]

    @cached_property
    def _lasting(self) -> list[Fault]:
        return [fault for fault in self.faults if fault not in self._stuck]


def _gaps(shape: Shape, parts: Parts) -> Gaps:
    """Gaps in the coordinates of the shape."""
    ends = shape.radius([0.0, shape.length_m])
    units = (*ends.tolist(), 1.0, 1.0)  # metres per unit of the coordinate along the side
    x0, xa, y0, yb = (
        (1e-3 * before / unit, 1e-3 * after / unit)
        for before, after, unit in zip(parts.gap_before_mm, parts.gap_after_mm, units, strict=True)
    )
    return Gaps(x0, xa, y0, yb)
