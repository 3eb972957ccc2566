"""Extract the features that the detectors use from blocks of samples: short means, repeats, saturation.

Public: `BlockFeatures`, `extract_features`, `approximate_position`. One vectorised pass over all pads of a
hand.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.supervisor.diagnose.model import DiagnosisModel, FloatArray, HandSamples

GROUP_SAMPLES = 5
"""Samples of a short mean: 25 ms at 200 Hz, during which a contact hardly moves."""


class BlockFeatures(NamedTuple):
    """Features of a block of m samples of n pads, in g short means.

    last_sample_ns (n,). fresh_samples (n,): number of new samples. means (g, n, 4): currents [A] without the
    stored offsets. noise_a (n, 4): of a short mean. trailing_repeats (n, 4): equal samples in a row at the
    end of the block; varied (n, 4): whether any differed. last_counts (n, 4). railed_fraction (n, 4): of
    samples at an end of the range.
    """

    last_sample_ns: NDArray[np.int64]
    fresh_samples: NDArray[np.int64]
    means: FloatArray
    noise_a: FloatArray
    trailing_repeats: NDArray[np.int64]
    varied: NDArray[np.bool_]
    last_counts: NDArray[np.int64]
    railed_fraction: FloatArray


def extract_features(block: HandSamples, model: DiagnosisModel, offset_counts: FloatArray) -> BlockFeatures:
    """Return the features of a block; offset_counts (n, 4). Raises ValueError for a block of other shape."""
    counts = np.asarray(block.counts)
    m, n = counts.shape[:2]
    if m == 0 or counts.shape != (m, len(model.links), 4):
        raise ValueError(f"counts have shape {counts.shape}: must be (m, {len(model.links)}, 4), m > 0")
    groups = max(m // GROUP_SAMPLES, 1)
    edges = np.arange(groups) * (m // groups)
    lengths = np.diff(np.append(edges, m))
    means = np.add.reduceat(counts, edges, axis=0) / lengths[:, None, None]
    means = (means - offset_counts) * model.ampere_per_count
    differs = (counts[1:] != counts[:-1]) & block.fresh[1:, :, None]
    varied = differs.any(axis=0) if m > 1 else np.zeros((n, 4), dtype=np.bool_)
    # fresh samples after the last that differed
    after = np.flip(np.logical_or.accumulate(np.flip(differs, 0), axis=0), 0) if m > 1 else differs
    repeated = (~after & block.fresh[1:, :, None]).sum(axis=0)
    near = 1 + 8 * model.noise_counts[:, None]  # noise moves a reading away from the end of its range
    at_end = (counts <= model.limits[:, :, 0] + near) | (counts >= model.limits[:, :, 1] - near)
    noise = np.hypot(model.noise_counts, 12**-0.5)[:, None] * model.ampere_per_count
    return BlockFeatures(
        block.sample_ns.max(axis=0),
        block.fresh.sum(axis=0),
        means,
        noise / np.sqrt(GROUP_SAMPLES),
        repeated,
        varied,
        counts[-1].astype(np.int64),
        at_end.mean(axis=0),
    )


def approximate_position(reading: FloatArray) -> FloatArray:
    """Return the position as fractions of the sides, by ratios: enough to distinguish positions."""
    x0, xa, y0, yb = np.maximum(reading, 1.0)
    return np.asarray(np.clip([xa / (x0 + xa), yb / (y0 + yb)], 0.0, 0.999))
