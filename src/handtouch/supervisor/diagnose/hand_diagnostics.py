"""Diagnosis of a hand: from blocks of samples to diagnoses, by five detectors.

Public: `HandDiagnostics`. `channel_faults` checks single samples, `loose_electrodes` and `offset_steps` steps
between samples, `static_load` what persists, `contact_faults` what begins and ends. `static_load` leaves out
channels in which `channel_faults` found a fault, `contact_faults` their pads and those with a loose
electrode.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from handtouch.arrays import BoolArray, FloatArray
from handtouch.supervisor.diagnose.channel_faults import ChannelFaultDetector
from handtouch.supervisor.diagnose.contact_faults import ContactFaultDetector
from handtouch.supervisor.diagnose.descriptions import (
    describe_channel_faults,
    describe_contact_fault,
    describe_loose_electrode,
    describe_static_load,
    named_electrodes,
)
from handtouch.supervisor.diagnose.features import (
    GROUP_SAMPLES,
    BlockFeatures,
    approximate_position,
    electrode_weights,
    extract_features,
)
from handtouch.supervisor.diagnose.hypotheses import MIN_CHANNELS, ContactCurrents, HypothesisTables
from handtouch.supervisor.diagnose.loose_electrodes import LooseElectrodeDetector
from handtouch.supervisor.diagnose.model import DiagnosisModel, HandSamples, PadDiagnosis
from handtouch.supervisor.diagnose.offset_steps import OffsetStepDetector
from handtouch.supervisor.diagnose.static_load import StaticLoad, StaticLoadDetector
from handtouch.wire.faults import FaultKind

# Constants without an origin beside them were chosen; docs/benchmarks/diagnose.md and soak_alarms.md measure
# what they yield.
_MIN_CONFIDENCE_CHANGE = 0.3  # that is reported,
_MIN_PROBABILITY_CHANGE = 0.1  # of a load that is probably gum
_MIN_CONTACT_COUNTS, _MAX_RELEASED_COUNTS = 250.0, 60.0
"""Sums that begin and end a contact: noise of a count is 0.4 % of the former."""
_MIN_MOVE_FRACTION, _MAX_SMEAR_FRACTION = 0.08, 0.03  # fractions of a side, roughly


class HandDiagnostics:
    """Detectors and active diagnoses of all pads of a hand; `process_block` takes block after block.

    offset_counts: (n, c), stored readings of the untouched channels; those of the model if left out.
    tables: of hypotheses, by design, shared by diagnostics of one model.
    """

    def __init__(
        self,
        model: DiagnosisModel,
        offset_counts: ArrayLike | None = None,
        tables: dict[Hashable, HypothesisTables] | None = None,
    ) -> None:
        self._model = model
        offsets = model.offset_counts if offset_counts is None else offset_counts
        self._offsets = np.asarray(offsets, np.float64)
        n = len(model.links)
        noise = model.reading_noise_counts
        self._channels = ChannelFaultDetector(model)
        self._offset_steps = OffsetStepDetector(model)
        self._loose = LooseElectrodeDetector(model)
        self._weights = [electrode_weights(network) for network in model.networks]
        self._static_loads = StaticLoadDetector(noise, self._weights)
        self._mean_noise_counts = noise / np.sqrt(GROUP_SAMPLES)
        self._tables = {} if tables is None else tables
        self._contact_detectors: dict[int, ContactFaultDetector] = {}
        self._released = np.ones(n, dtype=np.bool_)
        self._last_position = np.full((n, 2), np.nan)
        self._diagnoses: dict[tuple[int, FaultKind], PadDiagnosis] = {}

    def diagnoses(self) -> list[PadDiagnosis]:
        """Return all active diagnoses."""
        return list(self._diagnoses.values())

    def diagnoses_by_pad(self) -> list[tuple[int, PadDiagnosis]]:
        """Return all active diagnoses, each with the row of its pad."""
        return [(pad, diagnosis) for (pad, _), diagnosis in self._diagnoses.items()]

    def dead_electrodes(self) -> dict[int, int]:
        """Return the dead electrodes of pads that locate contacts with the others, by the row of the pad."""
        return {
            pad: self._model.electrodes[pad].index(diagnosis.electrodes[0])
            for (pad, kind), diagnosis in self._diagnoses.items()
            if kind == FaultKind.DEAD_ELECTRODE and diagnosis.published.position_valid
        }

    def set_offsets(self, pad: int, offset_counts: ArrayLike) -> None:
        """Replace the stored offsets (c,) of a pad, with as many channels as it has."""
        self._offsets = self._offsets.copy()
        self._offsets[pad, : self._model.channel_counts[pad]] = offset_counts
        self._offset_steps.reset(pad)
        self._static_loads.reset_zero(np.arange(len(self._model.links)) == pad)

    def reset_contacts(self, pad: int) -> None:
        """Discard the contacts of a pad, whose calibration or node was replaced."""
        self._loose.reset(pad)
        if pad in self._contact_detectors:
            self._contact_detectors[pad].reset(self._gain_covariance(pad))

    def process_block(self, block: HandSamples) -> list[PadDiagnosis]:
        """Process a block; return the diagnoses that began, changed or ended.

        Raises ValueError for a block of the wrong shape.
        """
        features = extract_features(block, self._model, self._offsets)
        sample_ns = int(features.last_sample_ns.max())
        if sample_ns <= 0:  # no pad has been sampled yet
            return []
        self._channels.process_block(features)
        faulty = self._channels.faulty_channels
        healthy: BoolArray = np.asarray(np.logical_not(faulty.any(axis=1)))
        usable = self._channels.usable_channels
        counts = self._subtract_offsets(block, features.mean_counts, usable)
        self._static_loads.process_block(sample_ns, counts, usable.astype(np.float64))
        self._offset_steps_of_loads()
        zero = self._offsets + self._static_loads.zero_counts + self._offset_steps.counts
        self._loose.process_block(block, zero, healthy)
        healthy[list(self._loose.loose)] = False
        self._process_contacts(features, counts, healthy)
        return self._update_diagnoses(self._collect_diagnoses(), sample_ns)

    def _subtract_offsets(self, block: HandSamples, counts: FloatArray, usable: BoolArray) -> FloatArray:
        """Update the steps of offsets; return the short means (g, n, c) without them."""
        static, steps = self._static_loads, self._offset_steps
        for pad in np.flatnonzero(steps.end_steps(counts - static.zero_counts)).tolist():
            static.forget(pad)
        floor = static.floor_counts + static.zero_counts + steps.counts
        steps.find_jumps(block, floor, usable)
        for pad, channel, since_ns, size in steps.confirm(int(block.sample_ns.max()), floor):
            steps.add_step(pad, channel, since_ns, size, None)
            static.subtract(pad, channel, since_ns, size)
        return counts - steps.counts

    def _offset_steps_of_loads(self) -> None:
        """Subtract the offsets among static loads, so that what comes later is seen as without them."""
        for pad, load in list(self._static_loads.loads.items()):
            if load.kind == FaultKind.OFFSET:
                size = float(load.level_counts[load.channel])
                self._offset_steps.add_step(pad, load.channel, load.since_ns, size, load)
                self._static_loads.subtract(pad, load.channel, load.since_ns, size)

    def _process_contacts(self, features: BlockFeatures, counts: FloatArray, healthy: BoolArray) -> None:
        """Pass new contacts to their detectors: the highest short mean of each, less the static load."""
        excess = counts - self._static_loads.floor_counts
        totals = excess.sum(axis=2)
        least = np.maximum(_MIN_CONTACT_COUNTS, 2 * np.abs(self._static_loads.floor_counts).sum(axis=1))
        self._released |= totals.min(axis=0) < _MAX_RELEASED_COUNTS
        strongest = totals.argmax(axis=0)
        observable = np.array(self._model.channel_counts) >= MIN_CHANNELS
        for pad in np.flatnonzero((totals.max(axis=0) > least) & healthy & observable).tolist():
            own, weights = slice(self._model.channel_counts[pad]), self._weights[pad]
            reading = excess[strongest[pad], pad, own]
            position = approximate_position(reading, weights)
            if _is_sliding(excess[:, pad, own], int(strongest[pad]), position, weights):
                continue
            if (
                not self._released[pad]
                and np.abs(position - self._last_position[pad]).max() < _MIN_MOVE_FRACTION
            ):
                continue
            self._released[pad] = totals[-1, pad] < _MAX_RELEASED_COUNTS
            self._last_position[pad] = position
            noise = np.hypot(
                self._mean_noise_counts[pad], 0.05 * np.abs(self._static_loads.floor_counts[pad, own])
            )
            scale = self._model.ampere_per_count[pad, own]
            contact = ContactCurrents(
                int(features.last_sample_ns[pad]), reading * scale, noise * scale, position
            )
            self._contact_detector(pad).add_contact(contact, np.zeros(len(reading), dtype=np.bool_))

    def _contact_detector(self, pad: int) -> ContactFaultDetector:
        """Return the detector of a pad, made on first use: tables take a quarter of a second per design."""
        if pad not in self._contact_detectors:
            design = self._model.designs[pad]
            if design not in self._tables:
                self._tables[design] = HypothesisTables(
                    self._model.networks[pad],
                    self._model.surfaces[pad],
                    self._model.parts[pad](),
                    self._model.electrodes[pad],
                )
            self._contact_detectors[pad] = ContactFaultDetector(
                self._tables[design], self._gain_covariance(pad)
            )
        return self._contact_detectors[pad]

    def _gain_covariance(self, pad: int) -> FloatArray:
        own = slice(self._model.channel_counts[pad])
        return self._model.gain_covariance[pad, own, own]

    def _collect_diagnoses(self) -> dict[tuple[int, FaultKind], PadDiagnosis]:
        active: dict[tuple[int, FaultKind], PadDiagnosis] = {}
        faulty = {pad for pad, _ in self._channels.faults}
        for pad in faulty:
            faults = {channel: f for (row, channel), f in self._channels.faults.items() if row == pad}
            for diagnosis in describe_channel_faults(self._model, pad, faults):
                active[pad, diagnosis.kind] = diagnosis
        loads = [(pad, step.load) for (pad, _), step in self._offset_steps.steps.items()]
        for pad, load in (*loads, *self._static_loads.loads.items()):
            if load.kind is not None:
                before = self._diagnoses.get((pad, load.kind))
                names = named_electrodes(self._model, pad, load)
                if before is None or before.electrodes != names or _is_changed(load, before):
                    before = describe_static_load(self._model, pad, load, is_located=pad not in faulty)
                active[pad, load.kind] = before
        for pad, detector in self._contact_detectors.items():
            fault = detector.fault
            if pad not in faulty and fault is not None:
                active[pad, fault.kind] = describe_contact_fault(self._model, pad, fault)
        for pad, loose in self._loose.loose.items():
            if pad not in faulty:
                diagnosis = describe_loose_electrode(self._model, pad, loose)
                active[pad, diagnosis.kind] = diagnosis
        return active

    def _update_diagnoses(
        self, active: dict[tuple[int, FaultKind], PadDiagnosis], sample_ns: int
    ) -> list[PadDiagnosis]:
        changes = []
        for key, diagnosis in active.items():
            before = self._diagnoses.get(key)
            if before is None or _differs(before, diagnosis):
                changes.append(diagnosis)
            else:
                active[key] = before
        changes += [replace(f, until_ns=sample_ns) for key, f in self._diagnoses.items() if key not in active]
        self._diagnoses = active
        return changes


def _is_sliding(excess: FloatArray, at: int, position: FloatArray, weights: FloatArray) -> bool:
    """Return whether the contact slides so fast that the short mean (g, c) at `at` smears it."""
    near = [excess[k] for k in (at - 1, at + 1) if 0 <= k < len(excess)]
    there = [e for e in near if e.sum() > 0.3 * excess[at].sum()]
    return any(np.abs(approximate_position(e, weights) - position).max() > _MAX_SMEAR_FRACTION for e in there)


def _is_changed(load: StaticLoad, before: PadDiagnosis) -> bool:
    """Return whether a load is described again; locating it is expensive."""
    change = abs(load.probability - before.published.confidence)
    return load.kind == FaultKind.STATIC_LOAD and change > _MIN_PROBABILITY_CHANGE


def _differs(before: PadDiagnosis, now: PadDiagnosis) -> bool:
    if now.kind == FaultKind.STATIC_LOAD:
        return before is not now
    if now.kind == FaultKind.DEAD_ELECTRODE and before.published.cause != now.published.cause:
        return True  # dead now, or part of the time only
    change = abs(now.published.confidence - before.published.confidence)
    return before.electrodes != now.electrodes or change > _MIN_CONFIDENCE_CHANGE
