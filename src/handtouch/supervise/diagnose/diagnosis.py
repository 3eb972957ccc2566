"""The diagnosis of a hand: blocks of samples to findings, by three witnesses.

Public: `Diagnosis`. `channels` looks at single samples, `standing` at what stays, `contacts` at what comes
and goes; what one has found wrong, the next leaves out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch.supervise.diagnose.channels import ChannelWitness
from handtouch.supervise.diagnose.contacts import Contact, ContactWitness, Tables
from handtouch.supervise.diagnose.features import GROUP, Reduced, reduce
from handtouch.supervise.diagnose.findings import Block, DiagnosisModel, Finding, FloatArray, Kind
from handtouch.supervise.diagnose.standing import StandingWitness
from handtouch.supervise.diagnose.words import electrodes_of, of_channels, of_contacts, of_standing

BoolArray = NDArray[np.bool_]
_OBSERVED_COUNTS, _RELEASED_COUNTS = 250.0, 60.0
_MOVED, _STILL = 0.08, 0.03  # as parts of a side, roughly


class Diagnosis:
    """State of all pads of a hand; `step` takes block after block.

    offset_counts: (n, 4), what the channels read untouched, as stored; those of the model if left out.
    tables: of alternatives, shared by diagnoses of one model.
    """

    def __init__(
        self,
        model: DiagnosisModel,
        offset_counts: ArrayLike | None = None,
        tables: dict[int, Tables] | None = None,
    ) -> None:
        self._model = model
        offsets = model.offset_counts if offset_counts is None else offset_counts
        self._offsets = np.asarray(offsets, np.float64)
        n = len(model.links)
        noise = np.hypot(model.noise_counts, 12**-0.5)
        self._channels = ChannelWitness(model)
        self._standing = StandingWitness(noise)
        self._noise = noise / np.sqrt(GROUP)
        self._tables = {} if tables is None else tables
        self._contacts: dict[int, ContactWitness] = {}
        self._released = np.ones(n, dtype=np.bool_)
        self._place = np.full((n, 2), np.nan)
        self._found: dict[tuple[int, Kind], Finding] = {}

    def findings(self) -> list[Finding]:
        """What is the matter now, all of it that lasts."""
        return list(self._found.values())

    def by_pad(self) -> list[tuple[int, Finding]]:
        """The same, with the row of each pad."""
        return [(pad, finding) for (pad, _), finding in self._found.items()]

    def tare(self, pad: int, offset_counts: ArrayLike) -> None:
        """Other stored offsets (4,) of a pad."""
        self._offsets = self._offsets.copy()
        self._offsets[pad] = offset_counts
        self._standing.tare(np.arange(len(self._model.links)) == pad)

    def renew(self, pad: int) -> None:
        """The pad has another calibration or unit: what its contacts told is void."""
        if pad in self._contacts:
            self._contacts[pad].forget()

    def step(self, block: Block) -> list[Finding]:
        """Take in a block; return the findings that began, changed or are over.

        Raises ValueError for a block of the wrong shape.
        """
        reduced = reduce(block, self._model, self._offsets)
        t_ns = int(reduced.t_ns.max())
        self._channels.take(reduced)
        bad = self._channels.bad
        counts = reduced.means / self._model.ampere_per_count
        well: BoolArray = np.asarray(np.logical_not(bad.any(axis=1)))
        self._standing.take(t_ns, counts, np.repeat(well[:, None], 4, axis=1).astype(np.float64))
        self._observe(reduced, counts, well)
        return self._compare(self._gather(), t_ns)

    def _observe(self, reduced: Reduced, counts: FloatArray, well: BoolArray) -> None:
        """Give new contacts to their witnesses: the strongest short mean of each, what stands taken off."""
        excess = counts - self._standing.floor
        totals = excess.sum(axis=2)
        least = np.maximum(_OBSERVED_COUNTS, 2 * np.abs(self._standing.floor).sum(axis=1))
        self._released |= totals.min(axis=0) < _RELEASED_COUNTS
        strongest = totals.argmax(axis=0)
        for pad in np.flatnonzero((totals.max(axis=0) > least) & well).tolist():
            reading = excess[strongest[pad], pad]
            place = _rough_place(reading)
            if _moves(excess[:, pad], int(strongest[pad]), place):
                continue
            if not self._released[pad] and np.abs(place - self._place[pad]).max() < _MOVED:
                continue
            self._released[pad] = totals[-1, pad] < _RELEASED_COUNTS
            self._place[pad] = place
            noise = np.hypot(self._noise[pad], 0.05 * np.abs(self._standing.floor[pad]))
            scale = self._model.ampere_per_count[pad]
            contact = Contact(int(reduced.t_ns[pad]), reading * scale, noise * scale, place)
            self._witness(pad).take(contact, np.zeros(4, dtype=np.bool_))

    def _witness(self, pad: int) -> ContactWitness:
        """Made when first needed: tables take a quarter of a second a make of pad."""
        if pad not in self._contacts:
            network = self._model.networks[pad]
            if id(network) not in self._tables:
                self._tables[id(network)] = Tables(network, self._model.surfaces[pad])
            self._contacts[pad] = ContactWitness(self._tables[id(network)])
        return self._contacts[pad]

    def _gather(self) -> dict[tuple[int, Kind], Finding]:
        found: dict[tuple[int, Kind], Finding] = {}
        bad = {pad for pad, _ in self._channels.now}
        for pad in bad:
            faults = {channel: f for (row, channel), f in self._channels.now.items() if row == pad}
            for finding in of_channels(self._model.links[pad], faults):
                found[pad, finding.kind] = finding
        for pad, standing in self._standing.now.items():
            if pad not in bad and standing.kind is not None:
                before = self._found.get((pad, standing.kind))
                if before is None or before.electrodes != electrodes_of(standing):  # to find a place is dear
                    before = of_standing(self._model, pad, standing)
                found[pad, standing.kind] = before
        for pad, witness in self._contacts.items():
            verdict = witness.verdict
            if pad not in bad and verdict is not None:
                found[pad, verdict.kind] = of_contacts(self._model, pad, verdict)
        return found

    def _compare(self, found: dict[tuple[int, Kind], Finding], t_ns: int) -> list[Finding]:
        changes = []
        for key, finding in found.items():
            before = self._found.get(key)
            if before is None or _differs(before, finding):
                changes.append(finding)
            else:
                found[key] = before
        changes += [replace(f, until_ns=t_ns) for key, f in self._found.items() if key not in found]
        self._found = found
        return changes


def _rough_place(reading: FloatArray) -> FloatArray:
    """Where, as parts of the sides, by ratios: good enough to tell one place from another."""
    x0, xa, y0, yb = np.maximum(reading, 1.0)
    return np.asarray(np.clip([xa / (x0 + xa), yb / (y0 + yb)], 0.0, 0.999))


def _moves(excess: FloatArray, at: int, place: FloatArray) -> bool:
    """Whether the contact slides so fast that a short mean (g, 4) at `at` smears it."""
    near = [excess[k] for k in (at - 1, at + 1) if 0 <= k < len(excess)]
    there = [e for e in near if e.sum() > 0.3 * excess[at].sum()]
    return any(np.abs(_rough_place(e) - place).max() > _STILL for e in there)


def _differs(before: Finding, now: Finding) -> bool:
    return before.electrodes != now.electrodes
