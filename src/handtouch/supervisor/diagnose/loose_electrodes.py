"""Detect electrodes that open and close while the pad is touched: a loose contact, crimp or cable.

Public: `LooseElectrodeDetector`, `LooseElectrode`. When electrode k opens under contacts, its current falls
to zero from one sample to the next, and the others take it over in shares w that are the same wherever the
contacts are, few or many: those of a contact on the floating electrode itself. The contacts' total changes
little. So the currents i before and i' after an opening obey

    i'_k = 0,   i'_j = s (i_j + w_j i_k),   s near 1,

and those of a closing the same with before and after exchanged. A contact that ends lowers all channels, one
that moves takes longer. Several such steps of one electrode, in both directions, are a loose electrode.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray
from handtouch.supervisor.diagnose.model import DiagnosisModel, HandSamples

# Constants without an origin beside them were chosen; docs/benchmarks/diagnose.md measures what they yield.
MIN_STEPS = 3
"""Openings and closings of an electrode, at least one of each, within `MAX_AGE_NS`."""
MIN_OPEN_CONTACTS = 6
"""Contacts without a current of an electrode that opened, after which it is dead."""
MAX_AGE_NS = 60_000_000_000  # steps of a minute: a loose wire moves with the hand
END_TOUCHED_NS = 30_000_000_000
"""Time of contact without an opening or closing, after which the electrode isn't loose any more."""
_LAGS = (1, 2)
"""Samples from before to after a step; a sample between them may show a part of it."""
_MIN_STEP_COUNTS, _MIN_STEP_FRACTION = 100.0, 0.06
"""Step of the channel that opens or closes; the fraction is of the total before an opening."""
_MAX_OPEN_FRACTION, _MAX_OPEN_SIGMA = 0.04, 5.0
"""Reading of the open channel, of the step and of its noise."""
_MIN_SCALE, _MAX_SCALE = 0.5, 1.15  # total after a step, and step of the others, over those expected
_MAX_MISFIT_FRACTION = 0.25
"""Misfit of the shares that the others take, of the step."""
_MIN_MISFIT_RATIO = 2.5
"""Misfit without a redistribution, over that with it."""
_DEAD_TIME_NS = 50_000_000
"""From one step of an electrode to the next."""
_TOUCHED_COUNTS = 250.0  # sum of a contact, as in hand_diagnostics
_STEPS_OF_DEAD = 2
"""Steps that count as much as the contacts after the opening of a dead electrode."""
_MIN_RETURNED_COUNTS, _MIN_RETURNED_FRACTION = 100.0, 0.05
"""Reading of a channel that isn't open any more; the fraction is of the total."""
_WRONG_PER_STEP = 0.2
"""Probability that one step isn't an opening or closing, for the stated confidence."""


@dataclass
class LooseElectrode:
    """A loose electrode of one pad, begun at since_ns; the last steps (time [ns], whether it opened)."""

    channel: int
    since_ns: int = 0
    steps: deque[tuple[int, bool]] = field(default_factory=lambda: deque(maxlen=40))
    touched_ns: int = 0
    """time of contact since the last step"""
    is_reported: bool = False
    contacts: int = 0
    """contacts that began since the last step"""
    was_touched: bool = True
    is_open: bool = False
    """since the last step"""

    @property
    def is_dead(self) -> bool:
        """Return whether it stays open."""
        return self.is_open and self.contacts >= MIN_OPEN_CONTACTS

    @property
    def confidence(self) -> float:
        """Probability that the electrode is loose, by the number of its steps."""
        return 1.0 - _WRONG_PER_STEP ** (len(self.steps) + (_STEPS_OF_DEAD if self.is_dead else 0))

    @property
    def evidence(self) -> dict[str, float]:
        """Numbers of openings and closings."""
        openings = sum(opened for _, opened in self.steps)
        return {"openings": float(openings), "closings": float(len(self.steps) - openings)}


class LooseElectrodeDetector:
    """Detector of loose electrodes of the n pads of a hand."""

    def __init__(self, model: DiagnosisModel) -> None:
        self._model = model
        self._noise = model.reading_noise_counts
        self._taken_over: dict[Hashable, FloatArray] = {}
        self._candidates: dict[tuple[int, int], LooseElectrode] = {}
        self._last: tuple[NDArray[np.int64], FloatArray, NDArray[np.bool_]] | None = None

    @property
    def loose(self) -> dict[int, LooseElectrode]:
        """Loose electrodes by the row of the pad: the one with most steps."""
        found: dict[int, LooseElectrode] = {}
        for (pad, _), one in self._candidates.items():
            if (one.is_reported or one.is_dead) and (
                pad not in found or len(one.steps) > len(found[pad].steps)
            ):
                found[pad] = one
        return found

    def process_block(self, block: HandSamples, zero_counts: FloatArray, healthy: NDArray[np.bool_]) -> None:
        """Find the steps of a block; zero_counts (n, c) of untouched channels, healthy (n,) pads."""
        stamps, fresh = block.sample_ns, block.fresh
        counts = block.counts - zero_counts
        if self._last is not None:  # a step may lie between two blocks
            stamps, counts, fresh = (
                np.concatenate(pair) for pair in zip(self._last, (stamps, counts, fresh), strict=True)
            )
        keep = slice(-_LAGS[-1], None)
        self._last = stamps[keep], counts[keep], fresh[keep]
        self._age(block.sample_ns, block.counts - zero_counts)
        for lag in _LAGS:
            if len(counts) > lag:
                usable = fresh[:-lag] & fresh[lag:] & healthy
                self._find_steps(stamps[lag:], counts[:-lag], counts[lag:], usable, opened=True)
                self._find_steps(stamps[lag:], counts[lag:], counts[:-lag], usable, opened=False)

    def reset(self, pad: int) -> None:
        """Discard the steps of a pad, whose node was replaced."""
        for key in [key for key in self._candidates if key[0] == pad]:
            del self._candidates[key]

    def _find_steps(
        self,
        stamps: NDArray[np.int64],
        closed: FloatArray,
        opened_counts: FloatArray,
        usable: NDArray[np.bool_],
        *,
        opened: bool,
    ) -> None:
        """Record the pairs of samples (k, n, c) that differ by one open electrode."""
        total, left = closed.sum(axis=2), opened_counts.sum(axis=2)
        usable = usable & (left > _MIN_SCALE * total) & (left < _MAX_SCALE * total)
        least = np.maximum(_MIN_STEP_COUNTS, _MIN_STEP_FRACTION * total)[:, :, None]
        most = _MAX_OPEN_FRACTION * closed + _MAX_OPEN_SIGMA * self._noise[:, None]
        steps = usable[:, :, None] & (closed > least) & (np.abs(opened_counts) < most)
        for row, pad, channel in np.argwhere(steps).tolist():
            own = slice(self._model.channel_counts[pad])
            pair = closed[row, pad, own], opened_counts[row, pad, own]
            if self._is_redistributed(pad, channel, *pair):
                self._add_step(pad, channel, int(stamps[row, pad]), opened)

    def _is_redistributed(self, pad: int, channel: int, closed: FloatArray, opened: FloatArray) -> bool:
        """Return whether the other channels have taken over the channel's current in the right shares."""
        others = np.arange(len(closed)) != channel
        before, after, step = closed[others], opened[others], closed[channel]
        shared = before + step * self._shares(pad)[channel][others]
        scale = float(shared @ after / (shared @ shared))
        noise = 3 * self._noise[pad]
        with_shares = float(np.abs(after - scale * shared).max())
        without = float(np.abs(after - min(float(before @ after / (before @ before)), 1.0) * before).max())
        return (
            _MIN_SCALE < scale < _MAX_SCALE
            and with_shares < _MAX_MISFIT_FRACTION * step + noise
            and without > _MIN_MISFIT_RATIO * with_shares
        )

    def _shares(self, pad: int) -> FloatArray:
        """Return the shares (c, c) in which the others take over each electrode's current."""
        design = self._model.designs[pad]
        if design not in self._taken_over:
            network = self._model.networks[pad]
            self._taken_over[design] = np.array(
                [
                    network.with_open_electrode(k).fractions(*centre)
                    for k, centre in enumerate(network.centres)
                ]
            )
        return self._taken_over[design]

    def _add_step(self, pad: int, channel: int, at_ns: int, opened: bool) -> None:
        one = self._candidates.setdefault((pad, channel), LooseElectrode(channel, at_ns))
        if one.steps and abs(at_ns - one.steps[-1][0]) < _DEAD_TIME_NS:
            return
        one.steps.append((at_ns, opened))
        one.touched_ns = one.contacts = 0
        one.was_touched, one.is_open = True, opened
        recent = [was_opened for since, was_opened in one.steps if since > at_ns - MAX_AGE_NS]
        if not one.is_reported:
            one.since_ns = next(since for since, _ in one.steps if since > at_ns - MAX_AGE_NS)
            one.is_reported = len(recent) >= MIN_STEPS and any(recent) and not all(recent)

    def _age(self, stamps: NDArray[np.int64], counts: FloatArray) -> None:
        """Count contacts; end the loose electrodes of pads that were touched for long without a step."""
        for pad, channel in list(self._candidates):
            totals, reading = counts[:, pad].sum(axis=1), counts[:, pad, channel]
            touched = totals > _TOUCHED_COUNTS
            one = self._candidates[pad, channel]
            one.contacts += int((touched & ~np.append(one.was_touched, touched[:-1])).sum())
            one.was_touched = bool(touched[-1])
            one.touched_ns += int(touched.mean() * (stamps[-1, pad] - stamps[0, pad]))
            returned = reading > np.maximum(_MIN_RETURNED_COUNTS, _MIN_RETURNED_FRACTION * totals)
            one.is_open &= not returned.any()  # it may close while nothing touches the pad
            if one.touched_ns > END_TOUCHED_NS and not one.is_dead:
                del self._candidates[pad, channel]
