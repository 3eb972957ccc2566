"""Evidence of slip from the hand: motion of a contact, its link and the other links, and changes of current.

A centroid moves on a pad when its contact slips, but also when the link rolls on the object, or when the load
shifts to another part of the pad. Joint states distinguish these: a link that rolls turns, and its surface
moves with the object. `SLIP_FEATURES` are what is known of each contact over windows of 10 to 100 ms, and
`SlipTrees`, boosted decision trees with the same test for all nodes of a level (A. Gulin et al. 2011,
"Winning the transfer learning track of Yahoo!'s Learning to Rank challenge with YetiRank"), sum the evidence.
A rigid object slips under several contacts at once, so the odds of slip of a contact are its own sum plus a
part of the mean of the hand's other contacts.
benchmarks/train_slip.py trains them with simulated grasps of the tuning family. That part (OTHERS_WEIGHT) and
the odds of a hand's only contact (ALONE_LOG_ODDS) were chosen by its cross-validation over seeds.

Public names: `SlipEvidence`, `SlipTrees`, `FEATURE_WINDOW_S`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib import resources

import numpy as np

from handtouch.arrays import FloatArray, IntArray
from handtouch.core.memory import view_memory, view_rows
from handtouch.core.stages.evidence import (
    EVIDENCE_FIELDS,
    EVIDENCE_WINDOWS_S,
    SLIP_FEATURES,
    EvidenceStage,
)
from handtouch.core.stages.rows import SLIP_ROW
from handtouch.core.stages.slip import SlipDetector
from handtouch.percept.relative_motion import RelativeMotion
from handtouch.percept.samples import FIELD_SLICES, ContactBuffer

FEATURE_WINDOW_S = max(EVIDENCE_WINDOWS_S)
"""Longest time that features look back."""


class SlipEvidence:
    """Odds of slip of the contacts of n pads, by the samples in a buffer and the state of the slip stage.

    The buffer's fields are those of EVIDENCE_FIELDS, NaN where joint states are unknown; samples come every
    `period_s`. `trees`: those shipped by default. `log_odds` (n,): ln of the odds, NaN where unknown.
    """

    def __init__(
        self, buffer: ContactBuffer, slip: SlipDetector, period_s: float, trees: SlipTrees | None = None
    ) -> None:
        trees = SlipTrees.shipped() if trees is None else trees
        n = buffer.size
        self.log_odds = np.full(n, np.nan)
        self._evidence_ns = np.zeros(n, np.int64)
        self._features = np.full((n, len(SLIP_FEATURES)), np.nan)
        self._compared = view_memory(np.zeros(5))
        steps = [max(round(window_s / period_s), 1) for window_s in EVIDENCE_WINDOWS_S]
        arrays = {
            "values": buffer.values,
            "sample_ns": buffer.sample_ns,
            "sample_count": buffer.sample_count,
            "tested": trees.features,
            "thresholds": trees.thresholds,
            "leaves": trees.values,
            "features": self._features,
            "log_odds": self.log_odds,
            "evidence_ns": self._evidence_ns,
        }
        self._stage = EvidenceStage(
            arrays={name: view_memory(array) for name, array in arrays.items()},
            offsets={name: FIELD_SLICES[name].start for name in EVIDENCE_FIELDS},
            steps=steps,
            width=buffer.values.shape[2],
            levels=trees.features.shape[1],
            hands=view_memory(buffer.hand_index),
            slip=view_rows(slip.state, SLIP_ROW),
        )

    def restart_contacts(self, pads: IntArray) -> None:
        """Forget the evidence about earlier contacts on these pads (k,)."""
        self.log_odds[pads] = np.nan
        self._evidence_ns[pads] = 0

    def update_odds(self, pads: IntArray, now_ns: int) -> None:
        """Update the odds of contacts on pads (k,) whose newest sample is of `now_ns`, every 5 ms at most.

        They become NaN where the pose of a contact's link is unknown.
        """
        self._stage.update_odds(np.sort(pads).data, now_ns)

    def compute_velocities(self, now_ns: int) -> None:
        """Compute the velocities of links over the last 50 ms, for `relative_motion`."""
        self._stage.compute_velocities(now_ns)

    def relative_motion(self, pad: int) -> RelativeMotion | None:
        """Return the velocity of a contact's link relative to the object; None if its pose isn't known."""
        if not self._stage.compare_to_object(pad, self._compared):
            return None
        x, y, z, std, contacts = self._compared
        return RelativeMotion.of_velocity((x, y, z), std, int(contacts))

    def features(self, pads: IntArray) -> FloatArray:
        """Return features (k, len(SLIP_FEATURES)) of the contacts on pads (k,), by these contacts alone."""
        self._stage.compute_features(np.sort(pads).data)
        return self._features[pads]


@dataclass(frozen=True, slots=True)
class SlipTrees:
    """Boosted trees of t trees and d levels; `features` and `thresholds` (t, d), `values` (t, 2^d)."""

    features: IntArray
    thresholds: FloatArray
    values: FloatArray

    @classmethod
    def shipped(cls) -> SlipTrees:
        """Return the trees of this package."""
        return _shipped()

    def log_odds(self, features: FloatArray) -> FloatArray:
        """Return the sum of leaves (k,) of contacts with features (k, len(SLIP_FEATURES))."""
        above = features[:, self.features] > self.thresholds  # NaN is not
        leaf = above @ (1 << np.arange(self.features.shape[1]))
        return np.asarray(self.values[np.arange(len(self.values)), leaf].sum(axis=1))

    def to_text(self) -> str:
        """Return the trees as JSON, with features by name."""
        names = [[SLIP_FEATURES[k] for k in row] for row in self.features.tolist()]
        parts = (names, self.thresholds.tolist(), self.values.tolist())
        lines = [json.dumps(tree) for tree in zip(*parts, strict=True)]
        return "[\n" + ",\n".join(lines) + "\n]\n"

    @classmethod
    def from_text(cls, text: str) -> SlipTrees:
        """Return the trees of `to_text`; raises ValueError for an unknown feature."""
        names, thresholds, values = zip(*json.loads(text), strict=True)
        if unknown := {name for row in names for name in row} - set(SLIP_FEATURES):
            raise ValueError(f"unknown features of slip: {', '.join(sorted(unknown))}")
        return cls(
            np.array([[SLIP_FEATURES.index(name) for name in row] for row in names], np.intp),
            np.array(thresholds, np.float64),
            np.array(values, np.float64),
        )


@cache
def _shipped() -> SlipTrees:
    return SlipTrees.from_text((resources.files("handtouch.percept") / "slip_trees.json").read_text())
