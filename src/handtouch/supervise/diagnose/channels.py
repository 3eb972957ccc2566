"""Faults of single channels that show in every sample: stuck, at an end of the range, shorted to the layer.

Public: `ChannelWitness`, `ChannelFault`. A reading of a healthy channel repeats by chance with a probability
that follows from its noise; a run of repeats that chance makes less than once in e^ALARM is no chance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from handtouch.supervise.diagnose.features import Reduced
from handtouch.supervise.diagnose.findings import DiagnosisModel, FloatArray, Kind

ALARM = 40.0
"""Nats; 15 pads of 200 Hz make 7e9 readings a week: 7e9 e^-40 is one false alarm in 600 million weeks."""

_LEAST_RUN = 200
_RAILED_NS = 1_000_000_000
_RAILED_TOUCHED_NS = 20_000_000_000
_UNTOUCHED = 0.03  # of the railed channel: less than a contact at any place brings the other three
_IDLE = 0.7, 1.3  # of the currents that the layer's potential on an electrode drives into the other three
_OVER_NS = 2_000_000_000


@dataclass(frozen=True)
class ChannelFault:
    """What is the matter with a channel of a pad."""

    kind: Kind
    since_ns: int
    evidence: dict[str, float]


class ChannelWitness:
    """The four channels of n pads."""

    def __init__(self, model: DiagnosisModel) -> None:
        self._model = model
        n = len(model.links)
        chance = _repeats(0.5 * np.hypot(model.noise_counts, 0.0))  # half the noise: it may be quieter
        self._longest = np.maximum(np.ceil(ALARM / -np.log(chance)), _LEAST_RUN)
        self._run = np.zeros((n, 4), dtype=np.int64)
        self._begin = np.zeros((n, 4), dtype=np.int64)
        self._rail_ns = np.full((n, 4), -1, dtype=np.int64)  # since when railed; -1: it isn't
        self._well_ns = np.zeros((n, 4), dtype=np.int64)  # when it last was not faulty
        self._least = np.full((n, 4, 4), np.inf)  # what each channel read at least while another was railed
        self._idle = np.array([_idle_counts(model, row) for row in range(n)])  # (n, 4 shorted, 4 channels)
        self.now: dict[tuple[int, int], ChannelFault] = {}

    @property
    def bad(self) -> NDArray[np.bool_]:
        """Channels (n, 4) with a fault."""
        bad = np.zeros(self._run.shape, dtype=np.bool_)
        for pad, channel in self.now:
            bad[pad, channel] = True
        return bad

    def take(self, reduced: Reduced) -> None:
        """One more block."""
        t_ns = reduced.t_ns[:, None]
        begins = reduced.varied | (self._run == 0)
        self._begin = np.where(begins, t_ns, self._begin)
        self._run = np.where(reduced.varied, 0, self._run) + reduced.repeated
        railed = reduced.railed >= 1.0
        self._rail_ns = np.where(railed, np.where(self._rail_ns < 0, t_ns, self._rail_ns), -1)
        least = (reduced.means / self._model.ampere_per_count).min(axis=0)[:, None, :]
        self._least = np.where(railed[:, :, None], np.minimum(self._least, least), np.inf)
        for pad, channel in np.argwhere(railed | (self._run >= self._longest[:, None])).tolist():
            fault = self._judge(pad, channel, reduced)
            if fault is not None:
                self._well_ns[pad, channel] = -1
                before = self.now.get((pad, channel))
                if before is None or before.kind != fault.kind:
                    self.now[pad, channel] = fault
        for pad, channel in list(self.now):
            if railed[pad, channel] or not reduced.varied[pad, channel]:
                self._well_ns[pad, channel] = -1
            elif self._well_ns[pad, channel] < 0:
                self._well_ns[pad, channel] = int(reduced.t_ns[pad])
            elif reduced.t_ns[pad] - self._well_ns[pad, channel] > _OVER_NS:
                del self.now[pad, channel]

    def _judge(self, pad: int, channel: int, reduced: Reduced) -> ChannelFault | None:
        count = int(reduced.last[pad, channel])
        if self._rail_ns[pad, channel] < 0:
            evidence = {"count": float(count), "repeats": float(self._run[pad, channel])}
            return ChannelFault(Kind.STUCK_CHANNEL, int(self._begin[pad, channel]), evidence)
        since = int(self._rail_ns[pad, channel])
        lasted = int(reduced.t_ns[pad]) - since
        if lasted < _RAILED_NS:
            return None
        others = np.delete(reduced.means[:, pad] / self._model.ampere_per_count[pad], channel, axis=1)
        least = np.delete(self._least[pad, channel], channel)
        expected = np.delete(self._idle[pad, channel], channel)
        evidence = {"count": float(count), "others_counts": float(others.sum(axis=1).min())}
        if count > 0 and (least > _IDLE[0] * expected).all() and (least < _IDLE[1] * expected).all():
            return ChannelFault(Kind.SHORTED_ELECTRODE, since, evidence)
        untouched = np.abs(least).sum() < _UNTOUCHED * abs(count)
        if untouched or count < 0 or lasted > _RAILED_TOUCHED_NS:
            return ChannelFault(Kind.SATURATED_CHANNEL, since, evidence)
        return None


def _repeats(std: FloatArray) -> FloatArray:
    """Probability (n,) that two rounded normal readings of standard deviation std (n,) counts are equal."""
    steps = np.arange(-40, 41)
    width = np.maximum(std, 0.05)[:, None]
    chance = ndtr((steps + 0.5) / width) - ndtr((steps - 0.5) / width)
    return np.asarray(np.clip((chance**2).sum(axis=1), 0.5, 1 - 1e-3))


def _idle_counts(model: DiagnosisModel, row: int) -> FloatArray:
    """Counts [shorted, channel] of an electrode at the layer's potential; infinite where none are known."""
    network = model.networks[row]
    try:
        conductance = network.conductance / network.sheet_ohm_per_square
    except ValueError:
        return np.full((4, 4), np.inf)
    volts = model.drive_v[row]
    return np.asarray(-volts * conductance / model.ampere_per_count[row])
