"""The latest samples of the contact on each pad, as arrays, and what parts make of them.

Public names: `Stream`, `Window`, `Sample`, `Turns`, `Percept`, `Part`, `KINDS`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from handtouch.percept.ask import Question

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

KINDS = ("motion", "hardness", "shape", "texture")
"""What there is to perceive; names of topics and of a scene's outputs."""
LENGTH = 512
"""Samples that are kept of a contact."""

FIELDS: dict[str, tuple[int, ...]] = {
    "pad_m": (2,),  # arc lengths on the pad
    "pad_noise_m2": (2, 2),  # what of pad_m's covariance is new with each sample
    "position_m": (3,),  # in the link's frame
    "normal": (3,),
    "covariance_m2": (3, 3),  # of position_m, with what stays the same from sample to sample
    "force_n": (),  # what the sheet does undone, where that is modelled
    "force_std_n": (),
    "raw_force_n": (),  # as the contact law has it; NaN where the sheet isn't modelled
    "current_a": (),  # total
    "residual": (),
    "residual_std": (),
    "palm_position_m": (3,),  # NaN where palm and joints aren't known; also the following
    "palm_normal": (3,),
    "palm_covariance_m2": (3, 3),
    "palm_rotation": (3, 3),  # of the link's frame in the palm's
    "palm_joints_m2": (),  # what joints put into palm_covariance_m2, one way in the mean
    "joints_age_s": (),
    "commanded_m": (),  # how far the link was told to close since the contact began, along the normal
    "commanded_normal": (3,),  # in the palm, where joints are as they were told to be
}
"""What is known of a sample -> its shape; SI units, NaN where it isn't known."""


def _slices() -> tuple[dict[str, slice], int]:
    at, slices = 0, {}
    for name, shape in FIELDS.items():
        slices[name] = slice(at, at + int(np.prod(shape, dtype=int)))
        at = slices[name].stop
    return slices, at


_SLICES, _WIDTH = _slices()


class Sample:
    """Samples (k,) of as many pads at one tick: `pads`, `t_ns`, `contact` (ids), and FIELDS by name.

    Fields can be set, and read as views: `sample["force_n"]` is (k,), `sample["pad_m"]` (k, 2).
    """

    def __init__(self, pads: IntArray, t_ns: NDArray[np.int64], contact: NDArray[np.uint32]) -> None:
        self.pads, self.t_ns, self.contact = pads, t_ns, contact
        self.values = np.full((len(pads), _WIDTH), np.nan)

    def __getitem__(self, name: str) -> FloatArray:
        return self.values[:, _SLICES[name]].reshape(len(self.pads), *FIELDS[name])

    def __setitem__(self, name: str, values: FloatArray) -> None:
        self.values[:, _SLICES[name]] = np.reshape(values, (len(self.pads), -1))


class Window:
    """The last samples (k,) of one contact, oldest first: `t_ns`, `t_s` (0 at the last), FIELDS by name.

    Views of a ring: read them now, copy what is to be kept.
    """

    def __init__(self, t_ns: NDArray[np.int64], values: FloatArray) -> None:
        self.t_ns, self._values = t_ns, values

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def t_s(self) -> FloatArray:
        """Time before the last sample, negative."""
        return np.asarray((self.t_ns - self.t_ns[-1]) * 1e-9) if len(self.t_ns) else np.zeros(0)

    def __getitem__(self, name: str) -> FloatArray:
        return np.asarray(self._values[:, _SLICES[name]].reshape(len(self.t_ns), *FIELDS[name]))


class Stream:
    """Rings of the contacts of n pads. A sample is written twice, so that any window of it lies in one piece.

    `contact` (n,) ids, 0 where nothing touches; `count` (n,) samples of that contact, ever.
    """

    def __init__(self, pads: int, hand_of: Sequence[int] | None = None, length: int = LENGTH) -> None:
        """hand_of: number of each pad's hand; left out: all are of one."""
        self.size, self.length = pads, length
        self.hand_of = np.zeros(pads, dtype=np.intp) if hand_of is None else np.asarray(hand_of, np.intp)
        self.contact = np.zeros(pads, dtype=np.uint32)
        self.count = np.zeros(pads, dtype=np.int64)
        self._t_ns = np.zeros((pads, 2 * length), dtype=np.int64)
        self._values = np.full((pads, 2 * length, _WIDTH), np.nan)

    def add(self, sample: Sample) -> IntArray:
        """Take in a tick's samples; the pads whose contact is another than before."""
        pads = sample.pads
        new = self.contact[pads] != sample.contact
        began = pads[new]
        self.count[began] = 0
        self.contact[pads] = sample.contact
        at = self.count[pads] % self.length
        for where in (at, at + self.length):
            self._t_ns[pads, where] = sample.t_ns
            self._values[pads, where] = sample.values
        self.count[pads] += 1
        return np.asarray(began)

    def end(self, pads: IntArray) -> None:
        """Contacts on these pads are over."""
        self.contact[pads] = 0
        self.count[pads] = 0

    def window(self, pad: int, most: int = LENGTH) -> Window:
        """The last samples of the contact on a pad, `most` of them at most."""
        k = int(min(most, self.count[pad], self.length))
        stop = int((self.count[pad] - 1) % self.length) + self.length + 1
        return Window(self._t_ns[pad, stop - k : stop], self._values[pad, stop - k : stop])

    def latest(self, pads: IntArray, name: str, back: IntArray | int = 0) -> FloatArray:
        """A field of the last sample of each pad (k, ...), or of that `back` samples before; NaN without."""
        at = (self.count[pads] - 1 - back) % self.length
        values = self._values[pads, at, _SLICES[name]]
        values[self.count[pads] <= back] = np.nan
        return np.asarray(values.reshape(len(pads), *FIELDS[name]))

    def latest_ns(self, pads: IntArray, back: IntArray | int = 0) -> NDArray[np.int64]:
        """Times (k,) of these samples."""
        return np.asarray(self._t_ns[pads, (self.count[pads] - 1 - back) % self.length])


class Turns:
    """Whose turn it is to be fitted: of n pads the one that waited longest, none again within `again_ns`."""

    def __init__(self, pads: int, again_ns: int) -> None:
        self._again_ns = again_ns
        self._last_ns = np.full(pads, -(10**18), dtype=np.int64)

    def due(self, ready: NDArray[np.bool_], t_ns: int) -> int | None:
        """The next of the pads that are `ready` (n,), None if each had its turn a moment ago."""
        pads = np.flatnonzero(ready & (t_ns - self._last_ns >= self._again_ns))
        return int(pads[np.argmin(self._last_ns[pads])]) if len(pads) else None

    def took(self, pad: int, t_ns: int) -> None:
        """It had its turn."""
        self._last_ns[pad] = t_ns


@dataclass(frozen=True, slots=True)
class Percept:
    """What a part makes of a contact, or of a hand; `pad` -1: of the whole hand.

    `label` is the most probable class, "" where there are none; `state` unestimated (not enough yet: `reason`
    says what is missing), estimated or invalid.
    """

    kind: str
    hand: int
    pad: int
    contact: int
    t_ns: int
    state: str
    label: str = ""
    probabilities: Mapping[str, float] = field(default_factory=dict)
    values: Mapping[str, float | str | Sequence[float] | None] = field(default_factory=dict)
    """by name with its unit at the end; standard deviations as NAME_std, covariances row by row"""
    evidence: Mapping[str, float | int] = field(default_factory=dict)
    """what it rests on, counted: samples, contacts, seconds"""
    reason: str = ""
    at_once: bool = False
    """news that can't wait for the next turn to tell"""


class Part(Protocol):
    """One kind of perception, over all pads. `wanted` (n,) are the pads that it is for.

    `step` is called at every tick and has to be quick; what takes long belongs into `fit`, which is called
    for one pad at a time, now and then, and has to stay below a few milliseconds.
    """

    kind: str
    wanted: NDArray[np.bool_]

    def step(self, stream: Stream, sample: Sample, began: IntArray) -> Sequence[Percept]:
        """Take in a tick's samples of wanted pads, already in the stream; what is new."""

    def due(self, stream: Stream, t_ns: int) -> int | None:
        """The pad that a fit is most worth while for, None if there is none."""

    def fit(self, stream: Stream, pad: int, t_ns: int) -> Sequence[Percept]:
        """Fit one pad's contact, or what its hand holds."""

    def end(self, stream: Stream, pads: IntArray, t_ns: int) -> Sequence[Percept]:
        """Contacts on these pads end; their windows are still there. Last words, if any."""

    def questions(self, t_ns: int) -> Sequence[Question]:
        """What it would like to know, with what it thinks so far."""
