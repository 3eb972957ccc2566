"""Extract the features that the detectors use from blocks of samples: short means, repeats, saturation.

Public: `BlockFeatures`, `extract_features`, `approximate_position`, `electrode_weights`. One vectorised pass
over all pads of a hand.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.arrays import FloatArray
from handtouch.field.model import ChannelModel
from handtouch.supervisor.diagnose.model import DiagnosisModel, HandSamples

GROUP_SAMPLES = 5
"""Samples of a short mean: 25 ms at 200 Hz, during which a contact hardly moves."""


class BlockFeatures(NamedTuple):
    """Features of a block of m samples of n pads, in g short means.

    last_sample_ns (n,). mean_counts (g, n, c) without the stored offsets. trailing_repeats (n, c): equal
    samples in a row at the end of the block; varied (n, c): whether any differed. last_counts (n, c).
    railed_fraction (n, c): of samples at an end of the range.
    """

    last_sample_ns: NDArray[np.int64]
    mean_counts: FloatArray
    trailing_repeats: NDArray[np.int64]
    varied: NDArray[np.bool_]
    last_counts: NDArray[np.int64]
    railed_fraction: FloatArray


def extract_features(block: HandSamples, model: DiagnosisModel, offset_counts: FloatArray) -> BlockFeatures:
    """Return the features of a block; offset_counts (n, c). Raises ValueError for a block of other shape."""
    counts = np.asarray(block.counts)
    m, expected = len(counts), model.ampere_per_count.shape
    if m == 0 or counts.shape != (m, *expected):
        raise ValueError(
            f"counts have shape {counts.shape}: must be (m, {expected[0]}, {expected[1]}), m > 0"
        )
    groups = max(m // GROUP_SAMPLES, 1)
    edges = np.arange(groups) * (m // groups)
    lengths = np.diff(np.append(edges, m))
    means = np.add.reduceat(counts, edges, axis=0) / lengths[:, None, None]
    differs = (counts[1:] != counts[:-1]) & block.fresh[1:, :, None]
    varied = differs.any(axis=0) if m > 1 else np.zeros(expected, dtype=np.bool_)
    # fresh samples after the last that differed
    after = np.flip(np.logical_or.accumulate(np.flip(differs, 0), axis=0), 0) if m > 1 else differs
    repeated = (~after & block.fresh[1:, :, None]).sum(axis=0)
    near = 8 * model.noise_counts[:, None]  # noise moves a reading away from the end of its range
    at_end = (counts <= model.limits[:, :, 0] + near) | (counts >= model.limits[:, :, 1] - 1 - near)
    return BlockFeatures(
        block.sample_ns.max(axis=0),
        means - offset_counts,
        repeated,
        varied,
        counts[-1].astype(np.int64),
        at_end.mean(axis=0),
    )


def electrode_weights(network: ChannelModel) -> FloatArray:
    """Return the weights (2, 2, c) with which `approximate_position` takes a pad's channels.

    Along each side, an electrode counts by its distance from the middle: opposite sides by their ratio.
    """
    centres = network.centres.T / [[network.a], [network.b]]
    aside = np.abs(centres - 0.5)
    return np.stack([centres * aside, aside])


def approximate_position(reading: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the position of c channels' reading as fractions of the sides: enough to distinguish positions.

    `weights`: see `electrode_weights`.
    """
    collected = np.maximum(reading, 1.0)
    return np.asarray(np.clip(weights[0] @ collected / (weights[1] @ collected), 0.0, 0.999))
