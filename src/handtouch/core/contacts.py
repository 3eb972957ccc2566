"""Contact detection: two thresholds and a debounce turn samples into begin, update and end.

Public names: `ContactDetector`, `DetectionSettings`, `ContactChanges`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray, IntArray
from handtouch.core.memory import RowArray, view_memory
from handtouch.core.pad_model import PadModel
from handtouch.core.stages.detect import ContactDetection
from handtouch.core.state import TickState


class DetectionSettings(NamedTuple):
    """Settings of n pads, read in place in every tick."""

    ampere_per_count: FloatArray
    """(n, channels)"""
    mean_ampere_per_count: FloatArray
    """(n,)"""
    noise_counts: FloatArray
    """(n,) of a channel"""
    begin_threshold_a: FloatArray
    """(n,) a contact begins above it"""
    end_threshold_a: FloatArray
    """(n,) a contact ends below it"""
    touch: RowArray
    """(n,) TOUCH_ROWs"""
    sample_delay_ns: NDArray[np.int64]
    """(n,) from a sample to its SYNC, or to its arrival where it is event-driven"""

    @classmethod
    def of_model(cls, model: PadModel) -> DetectionSettings:
        """Return those of a model, which has them by the same names."""
        return cls(*(getattr(model, name) for name in cls._fields))


class ContactChanges(NamedTuple):
    """Pads whose contact began or ended in one tick, continues with a new sample (`updated`) or without the
    expected one (`silent`), those whose contact is to be solved, and those whose new sample only a hand frame
    needs (`framed`)."""

    began: IntArray
    ended: IntArray
    updated: IntArray
    silent: IntArray
    solved: IntArray
    framed: IntArray


class ContactDetector:
    """Contacts of n pads, at most one each, in a tick's state.

    `touching` (n,) bool; `id` (n,) uint32, 0 without contact; `begin_ns` (n,) time of the first sample above
    the begin threshold; `peak_force_n` (n,) greatest valid force of the contact [N]; `currents` (n, channels)
    [A], `saturated` (n, channels) those at the top of their range, and of contacts that are to be solved
    `offset_std_a` (n,) of the currents' sum, from the baseline.

    expected_counts: (n, channels) of untouched pads, read in place.
    """

    def __init__(self, settings: DetectionSettings, expected_counts: FloatArray, state: TickState) -> None:
        self.touching, self.id, self.begin_ns = state.touching, state.contact_id, state.begin_ns
        self.peak_force_n, self._next_id = state.peak_force_n, state.next_contact_id
        self.currents, self.offset_std_a = np.zeros_like(expected_counts), np.zeros(state.pads)
        self.saturated = np.zeros(expected_counts.shape, dtype=np.bool_)
        self._state, self._expected_counts = state, expected_counts
        self.lists = [np.zeros(state.pads, np.intp) for _ in ContactChanges._fields]
        """pads of a tick's changes, as long as the numbers in `stage` say"""
        self.set_settings(settings)

    def set_settings(self, settings: DetectionSettings) -> None:
        """Change the settings; they apply to present contacts too."""
        arrays: dict[str, Any] = {"touch": settings.touch}
        arrays |= {name: view_memory(a) for name, a in settings._asdict().items() if name != "touch"}
        arrays["expected_counts"] = view_memory(self._expected_counts)
        arrays["currents"] = view_memory(self.currents)
        arrays["saturated"] = view_memory(self.saturated)
        arrays["excess"] = view_memory(np.zeros(self._state.channels))
        arrays["offset_std_a"] = view_memory(self.offset_std_a)
        self.stage = ContactDetection(
            self._state.pads, self._state.memory | arrays, [view_memory(pads) for pads in self.lists]
        )

    @property
    def begun_count(self) -> int:
        """Number of contacts begun so far."""
        return int(self._next_id[0]) - 1
