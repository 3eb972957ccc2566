"""Input of one pad: currents and counts of its ADC's channels, and its failures as EMCY messages.

Public name: `PadInput`.
"""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray
from handtouch.canbus import cia301
from handtouch.device import Device, UnconfiguredDevice
from handtouch.node.adc_fault import AdcError, AdcFaultKind, emergency_of
from handtouch.node.settings import NodePad, Trim

_MIN_END = 1 / 50  # of a negative end, over the positive one: nearer to zero, it is the offset of a converter
_SATURATED_SAMPLES = 3  # in succession, before a channel is reported
_SATURATED_HOLD_NS = 1_000_000_000  # since the last one, before it is reported as recovered

_log = logging.getLogger("handtouch.node")


class PadInput:
    """Converts raw values of a pad to counts, and reports its failures.

    `columns` : of its c channels in its ADC's readings; `node` : its CANopen node, None without one;
    `has_sample` : False while its ADC has failed or hasn't converted. Without a sample the node sends no
    TPDO, so that no old value passes for a new one; its NMT state stays.
    """

    def __init__(
        self, pad: NodePad, trim: Trim, columns: list[int], node: UnconfiguredDevice | None = None
    ) -> None:
        self.pad, self.columns, self._node = pad, columns, node
        self._ma_per_unit = np.array([pad.ma_per_unit_of(channel) for channel in pad.channels])
        count = len(pad.channels)
        self._gain, self._offset_ma = np.array(trim.gain or (1.0,) * count), np.zeros(count)
        if trim.offset_ma is not None:
            self._offset_ma = np.array(trim.offset_ma)
        self.has_sample = False
        self._faults: dict[AdcFaultKind, bytes] = {}
        self._saturated_samples = np.zeros(count, np.int64)
        self._saturated_ns = 0

    @property
    def faults(self) -> tuple[AdcFaultKind, ...]:
        """Present failures."""
        return tuple(self._faults)

    @property
    def max_count(self) -> int:
        """Greatest count of a channel."""
        return (1 << self.pad.bits - 1) - 1

    @property
    def counts_per_ma(self) -> float:
        """Counts per milliampere, or per unit of values that aren't currents."""
        return self.max_count / self.pad.full_scale_signal

    @property
    def step_ma(self) -> FloatArray:
        """Current (c,) [mA] of one unit of the raw values of a source."""
        return np.asarray(np.abs(self._ma_per_unit * self._gain))

    @property
    def device(self) -> Device | None:
        """The node on the bus, None without an id."""
        return None if self._node is None else self._node.device

    def currents_ma(self, raw: FloatArray, scale: FloatArray, offset: FloatArray) -> FloatArray:
        """Return the currents (..., c) [mA] of raw values (..., c).

        `scale`, `offset` : of the channels (c,), to mV as in IIO, to mA for channels currentN, or 1 and 0
        """
        measured = (raw + offset) * scale * self._ma_per_unit
        return np.asarray((measured - self._offset_ma) * self._gain)

    def counts(self, currents_ma: FloatArray, ends_ma: FloatArray) -> NDArray[np.int64]:
        """Return the counts (c,) of currents, limited to the channels' bits.

        A channel at one of the ends (2, c) of its range gets that end of the counts': the daemon knows by it
        that it is saturated. An end near no current is none: a converter without negative values is there
        while nothing touches.
        """
        most = self.max_count
        counts = np.clip(np.rint(currents_ma * self.counts_per_ma), -most - 1, most)
        low_ma, high_ma = np.sort(ends_ma, axis=0)
        counts[currents_ma >= high_ma] = most
        has_bottom = low_ma * self.counts_per_ma < -_MIN_END * most
        counts[has_bottom & (currents_ma <= low_ma)] = -most - 1
        return counts.astype(np.int64)

    def record_sample(self, at_limit: NDArray[np.bool_], now_ns: int) -> None:
        """Record a successful sample; `at_limit` (c,): the channels at an end of their counts."""
        self.has_sample = True
        for kind in self.faults:
            if _is_of_adc(kind):
                self._clear(kind)
        if at_limit.any() or AdcFaultKind.SATURATED in self._faults:
            self._record_saturation(at_limit, now_ns)
        else:
            self._saturated_samples[:] = 0
        self._allow_data()

    def record_no_sample(self) -> None:
        """Record that there is no sample at this time, which may be no failure yet."""
        self.has_sample = False
        self._allow_data()

    def record_failure(self, error: AdcError, channels: int | None = None) -> None:
        """Record a failed sample, or a failed switch; `channels`: mask of those concerned, default: all."""
        mask = (1 << len(self.pad.channels)) - 1 if channels is None else channels
        data = (
            bytes((error.kind, mask & 0xFF)) + error.number.to_bytes(2, "little") + bytes((mask >> 8 & 0xFF,))
        )
        if _is_of_adc(error.kind):
            self.record_no_sample()
        if self._faults.get(error.kind) == data:
            return
        if _is_of_adc(error.kind):  # an ADC fails in one way at a time
            self._faults = {kind: sent for kind, sent in self._faults.items() if not _is_of_adc(kind)}
        self._faults[error.kind] = data
        _log.error("pad %s: %s", self.pad.name, error, extra=self._fields)
        self._send(error.kind)

    def record_excitation(self) -> None:
        """Record that the excitation could be switched."""
        if AdcFaultKind.EXCITATION_FAILED in self._faults:
            self._clear(AdcFaultKind.EXCITATION_FAILED)

    def update_device(self) -> None:
        """Stop or allow TPDOs, and report present failures again after a reset of the node."""
        device = self.device
        if device is None:
            return
        self._allow_data()
        if self._faults and not device.read_object(cia301.ERROR_REGISTER, 0):
            for kind in self.faults:
                self._send(kind)

    def _record_saturation(self, at_limit: NDArray[np.bool_], now_ns: int) -> None:
        self._saturated_samples = np.where(at_limit, self._saturated_samples + 1, 0)
        if at_limit.any():
            self._saturated_ns = now_ns
        lasting = self._saturated_samples >= _SATURATED_SAMPLES
        if lasting.any() and AdcFaultKind.SATURATED not in self._faults:
            mask = sum(1 << channel for channel in np.flatnonzero(lasting).tolist())
            names = ", ".join(self.pad.channels[channel] for channel in np.flatnonzero(lasting))
            self.record_failure(AdcError(AdcFaultKind.SATURATED, names), mask)
        elif AdcFaultKind.SATURATED in self._faults and now_ns - self._saturated_ns > _SATURATED_HOLD_NS:
            self._clear(AdcFaultKind.SATURATED)

    def _clear(self, kind: AdcFaultKind) -> None:
        del self._faults[kind]
        _log.warning("pad %s: recovered from %s", self.pad.name, kind.text, extra=self._fields)
        if self.device is not None:
            self.device.send_emergency(0, self._register, bytes((kind,)))

    def _send(self, kind: AdcFaultKind) -> None:
        if self.device is not None:
            self.device.send_emergency(emergency_of(kind)[0], self._register, self._faults[kind])

    def _allow_data(self) -> None:
        """Stop TPDOs without a sample, and allow them with one."""
        device = self.device
        if device is not None and device.send_data is not self.has_sample:
            device.send_data = self.has_sample

    @property
    def _register(self) -> int:
        """Error register, 0x1001."""
        register = 0
        for kind in self._faults:
            register |= emergency_of(kind)[1]
        return register

    @property
    def _fields(self) -> dict[str, dict[str, str]]:
        return {"fields": {"pad": self.pad.name}}


def _is_of_adc(kind: AdcFaultKind) -> bool:
    """Return True for a failure that leaves no sample."""
    return kind not in (AdcFaultKind.SATURATED, AdcFaultKind.EXCITATION_FAILED)
