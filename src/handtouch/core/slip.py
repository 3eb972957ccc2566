"""Slip and lift-off of the contacts of n pads: the stage with its state.

Public names: `SlipDetector`, `GripModel`, `FALSE_ALARM_S`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from handtouch.core.memory import view_memory
from handtouch.core.stages.slip import SLIP_PARAMETERS, SLIP_SLICES, SLIP_WORK, SlipStage
from handtouch.core.state import TickState

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]

FALSE_ALARM_S = 600.0
"""Lower bound on the mean time between two false alarms of one contact, under the grip model."""
_ONSET_PERIOD_S = 0.005


@dataclass(frozen=True, slots=True)
class GripModel:
    """Motion of a contact that doesn't slide."""

    creep_std_m_per_s: float = 0.7e-3
    """standard deviation of the speed at which soft contacts creep and roll; initial value, then learnt"""
    level_drift_std_m: float = 20e-6
    """standard deviation of the level's drift in one second"""
    tremor_std_m: float = 30e-6
    """standard deviation of the tremor; initial value, then learnt from the innovations"""
    tremor_std_range_m: tuple[float, float] = (2e-6, 300e-6)
    tremor_corner_hz: float = 5.0
    """corner frequency of the tremor"""
    tremor_time_constant_s: float = 1.0
    """time constant of learning the tremor"""
    creep_time_constant_s: float = 2.0
    """time constant of learning the creep; shorter at the start"""
    coupling_std_m: float = 1e-3
    """standard deviation of the centroid's displacement per relative current of a firm contact"""
    coupling_drift_per_s: float = 0.05
    """relative change of that coupling in one second"""
    chatter_m: float = 0.35e-3
    """displacement that bursts of chatter don't reach, as it returns: those of 9 Hz and 0.1 mm amplitude that
    bench_slip plays move a contact by 0.2 mm, noise and tremor of a light contact by some more. Chosen: on a
    hand of the tuning family, world `default`, double misses 3 mm/s (found after 0.23 s at 0.5 N) and finds
    10 mm/s 5 ms later, half finds it 15 to 20 ms sooner; bursts raise no alarm in 25 min (half: in 3 min)"""
    chatter_speed_m_per_s: float = 8e-3
    """speed that they don't reach: 2 pi 9 Hz 0.1 mm is 5.7 mm/s, and noise adds to it"""
    chatter_time_s: float = 0.12
    """time in which they return: one period of 9 Hz"""
    sway_m: float = 80e-6
    """displacement that counts at higher speeds"""

    def parameters(self, period_s: float, samples_per_false_alarm: float) -> FloatArray:
        """Return the parameters of the stage, in the order of SLIP_PARAMETERS."""
        least, most = self.tremor_std_range_m
        named = {
            "period_s": period_s,
            "log_threshold": math.log(samples_per_false_alarm),
            "onset_stride": max(1, round(_ONSET_PERIOD_S / period_s)),
            "log_creep_variance": 2 * math.log(self.creep_std_m_per_s),
            "level_drift_variance": self.level_drift_std_m**2,
            "log_tremor_variance": 2 * math.log(self.tremor_std_m),
            "min_log_tremor_variance": 2 * math.log(least),
            "max_log_tremor_variance": 2 * math.log(most),
            "tremor_rate": 2 * math.pi * self.tremor_corner_hz,
            "tremor_time_constant_s": self.tremor_time_constant_s,
            "creep_time_constant_s": self.creep_time_constant_s,
            "coupling_variance": self.coupling_std_m**2,
            "coupling_drift_variance": (self.coupling_std_m * self.coupling_drift_per_s) ** 2,
            "chatter_m": self.chatter_m,
            "chatter_speed": self.chatter_speed_m_per_s,
            "chatter_time_s": self.chatter_time_s,
            "sway_m": self.sway_m,
        }
        return np.array([named[name] for name in SLIP_PARAMETERS])


class SlipDetector:
    """Detects slip and lift-off of contacts on n pads, in the results of a tick.

    values (n, VALUE_COUNT), total_a, times and ids (n,) are those of the tick, of the contacts' newest
    samples; they are read in place.

    `state` (n, SLIP_COUNT), `contact_id` (n,) and `sample_ns` (n,) are all that survives a tick.
    `requested` (n,): pads it runs for. `samples_per_false_alarm` is the lower bound on the mean number of
    samples of a contact from one false alarm to the next.
    """

    def __init__(
        self,
        period_s: float,
        values: FloatArray,
        total_a: FloatArray,
        times: NDArray[np.int64],
        ids: NDArray[np.uint32],
        false_alarm_s: float = FALSE_ALARM_S,
        grip: GripModel | None = None,
        held: TickState | None = None,
    ) -> None:
        held = TickState.empty(len(ids)) if held is None else held
        self.state, self.contact_id = held.slip, held.slip_contact_id
        self.sample_ns, self.requested = held.slip_sample_ns, held.slip_requested
        self.any_requested = False
        self.samples_per_false_alarm = max(false_alarm_s / period_s, 2.0)
        self._stage = SlipStage(
            view_memory((grip or GripModel()).parameters(period_s, self.samples_per_false_alarm)),
            view_memory(np.zeros(SLIP_WORK)),
            view_memory(self.state),
            self.contact_id.data,
            self.sample_ns.data,
            view_memory(values),
            view_memory(total_a),
            times.data,
            ids.data,
        )

    def set_requested(self, pads: BoolArray) -> None:
        """Set the pads (n,) it runs for; contacts on changed ones start afresh."""
        self.restart_contacts(np.flatnonzero(pads != self.requested))
        self.requested[:] = pads
        self.refresh()

    def refresh(self) -> None:
        """Compute what follows from the state, after that was loaded."""
        self.any_requested = bool(self.requested.any())

    def restart_contacts(self, pads: IntArray) -> None:
        """Start the contacts on these pads (k,) afresh with their next sample."""
        self.contact_id[pads] = 0

    def detect_slips(self, pads: IntArray) -> None:
        """Process the newest sample of the contact on each of these pads (k,), if requested."""
        self._stage.detect_slips(pads[self.requested[pads]].data)

    def column(self, name: str) -> FloatArray:
        """Return a part of the state by its name in SLIP_SLICES, (n,) or (n, k), as a view."""
        part = self.state[:, SLIP_SLICES[name]]
        return part[:, 0] if part.shape[1] == 1 else part
