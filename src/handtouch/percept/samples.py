"""Buffer of the latest samples of every contact, and estimates from them.

Public names: `ContactBuffer`, `ContactSamples`, `FIELD_SLICES`, `PerceptEstimate`. Estimators: `estimator`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray, IntArray

if TYPE_CHECKING:
    from handtouch import wire


SAMPLES_PER_CONTACT = 512
"""Samples kept of a contact."""

SAMPLE_FIELDS: dict[str, tuple[int, ...]] = {
    "pad_m": (2,),  # arc lengths on the pad
    "pad_noise_m2": (2, 2),  # part of pad_m's covariance that is independent in each sample
    "position_m": (3,),  # in the link's frame
    "normal": (3,),
    "covariance_m2": (3, 3),  # covariance of position_m, systematic errors included
    "force_n": (),  # sheet behaviour compensated, where it is modelled
    "force_std_n": (),
    "total_current_a": (),
    "residual": (),
    "residual_std": (),
    "palm_position_m": (3,),  # NaN without joint states; also the following
    "palm_normal": (3,),
    "palm_covariance_m2": (3, 3),
    "palm_rotation": (3, 3),  # rotation of the link frame in the palm frame
    "palm_joints_m2": (),  # contribution of joints to palm_covariance_m2, mean per axis
    "joints_age_s": (),
    "slip_log_odds": (),  # ln of the odds of slip; infinite while it slips
    "slip_velocity_m_per_s": (2,),  # on the pad, where slip is likely
    "tremor_std_m": (2,),  # as learnt
    "force_vector_n": (3,),  # in the link's frame, above a shear pad
    "force_vector_covariance_n2": (3, 3),
    "contact_radius_m": (),  # by both sheets of a pad
    "contact_radius_std_m": (),
}
"""Fields of a sample and their shapes; SI units, NaN where unknown."""


def _slices() -> tuple[dict[str, slice], int]:
    at, slices = 0, {}
    for name, shape in SAMPLE_FIELDS.items():
        slices[name] = slice(at, at + int(np.prod(shape, dtype=int)))
        at = slices[name].stop
    return slices, at


FIELD_SLICES, _WIDTH = _slices()
"""Columns of a sample's fields."""


class ContactSamples:
    """Samples (k,) of as many pads at one tick: `pads`, `sample_ns`, `contact_id`, and SAMPLE_FIELDS by name.

    Fields can be assigned, and read as views: `sample["force_n"]` is (k,), `sample["pad_m"]` (k, 2).
    """

    def __init__(self, pads: IntArray, sample_ns: NDArray[np.int64], contact_id: NDArray[np.uint32]) -> None:
        self.pads, self.sample_ns, self.contact_id = pads, sample_ns, contact_id
        self.values = np.full((len(pads), _WIDTH), np.nan)

    def __getitem__(self, name: str) -> FloatArray:
        return self.values[:, FIELD_SLICES[name]].reshape(len(self.pads), *SAMPLE_FIELDS[name])

    def __setitem__(self, name: str, values: FloatArray) -> None:
        self.values[:, FIELD_SLICES[name]] = np.reshape(values, (len(self.pads), -1))


class ContactBuffer:
    """Ring buffers of the contacts of n pads. Each sample is stored twice, so that every window is
    contiguous.

    `contact_id` (n,): 0 where nothing touches; `sample_count` (n,): samples of that contact since it began.
    `values` (n, 2 length, columns of FIELD_SLICES), `sample_ns` (n, 2 length): sample k of a contact is at k
    modulo length, and `length` after that.
    """

    def __init__(
        self, pads: int, hand_index: Sequence[int] | None = None, length: int = SAMPLES_PER_CONTACT
    ) -> None:
        """hand_index: number of each pad's hand; default: all pads are of one."""
        self.size, self.length = pads, length
        self.hand_index = (
            np.zeros(pads, dtype=np.intp) if hand_index is None else np.asarray(hand_index, np.intp)
        )
        self.contact_id = np.zeros(pads, dtype=np.uint32)
        self.sample_count = np.zeros(pads, dtype=np.int64)
        self.sample_ns = np.zeros((pads, 2 * length), dtype=np.int64)
        self.values = np.full((pads, 2 * length, _WIDTH), np.nan)

    def add_samples(self, sample: ContactSamples) -> None:
        """Add the samples of a tick."""
        pads = sample.pads
        self.sample_count[pads[self.contact_id[pads] != sample.contact_id]] = 0
        self.contact_id[pads] = sample.contact_id
        at = self.sample_count[pads] % self.length
        for where in (at, at + self.length):
            self.sample_ns[pads, where] = sample.sample_ns
            self.values[pads, where] = sample.values
        self.sample_count[pads] += 1

    def end_contacts(self, pads: IntArray) -> None:
        """Mark the contacts on these pads as ended."""
        self.contact_id[pads] = 0
        self.sample_count[pads] = 0

    def window(self, pad: int, name: str, max_samples: int = SAMPLES_PER_CONTACT) -> FloatArray:
        """Return a field of the last samples (k, ...) of the contact on a pad, oldest first; a view."""
        k = int(min(max_samples, self.sample_count[pad], self.length))
        stop = int((self.sample_count[pad] - 1) % self.length) + self.length + 1
        values = self.values[pad, stop - k : stop, FIELD_SLICES[name]]
        return np.asarray(values.reshape(k, *SAMPLE_FIELDS[name]))

    def latest_field(self, pads: IntArray, name: str) -> FloatArray:
        """Return a field of the last sample of each pad (k, ...); NaN if missing."""
        at = (self.sample_count[pads] - 1) % self.length
        values = self.values[pads, at, FIELD_SLICES[name]]
        values[self.sample_count[pads] == 0] = np.nan
        return np.asarray(values.reshape(len(pads), *SAMPLE_FIELDS[name]))


@dataclass(frozen=True, slots=True)
class PerceptEstimate:
    """Estimate of one kind for a contact, or for a whole hand (`pad` -1).

    `label` is the most probable class, "" without classes; `state` is undetermined (`reason` says what is
    missing), estimated or invalid.
    """

    kind: str
    hand: int
    pad: int
    contact: int
    estimate_ns: int
    state: str
    label: str = ""
    probabilities: Mapping[str, float] = field(default_factory=dict)
    values: Mapping[str, float | str | Sequence[float] | None] = field(default_factory=dict)
    """by name with unit; standard deviations as NAME_std, covariances row by row"""
    evidence: Mapping[str, float | int] = field(default_factory=dict)
    """counts of the data used: samples, contacts, seconds"""
    reason: str = ""
    poses: tuple[wire.ObjectPose, ...] = ()
    """of an object, the likeliest first"""
