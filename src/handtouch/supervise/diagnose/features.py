"""From blocks of samples to what the witnesses look at: short means, repeats, ends of the range.

Public: `Reduced`, `reduce`. One vectorised pass over all pads of a hand.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from handtouch.supervise.diagnose.findings import Block, DiagnosisModel, FloatArray

GROUP = 5
"""Samples of a short mean: 25 ms at 200 Hz, in which a contact hardly moves."""


class Reduced(NamedTuple):
    """A block of m samples of n pads, in g short means.

    t_ns (n,) time of the newest sample. fresh (n,) how many samples are new. means (g, n, 4) currents [A],
    stored offsets off. noise_a (n, 4) of a short mean. repeated (n, 4): how many samples up to now are equal
    in a row at the end of the block; varied (n, 4): whether any differed. last (n, 4) counts. railed (n, 4)
    part of the samples at an end of the range.
    """

    t_ns: NDArray[np.int64]
    fresh: NDArray[np.int64]
    means: FloatArray
    noise_a: FloatArray
    repeated: NDArray[np.int64]
    varied: NDArray[np.bool_]
    last: NDArray[np.int64]
    railed: FloatArray


def reduce(block: Block, model: DiagnosisModel, offset_counts: FloatArray) -> Reduced:
    """offset_counts (n, 4). Raises ValueError for a block of other shape, or without samples."""
    counts = np.asarray(block.counts)
    m, n = counts.shape[:2]
    if m == 0 or counts.shape != (m, len(model.links), 4):
        raise ValueError(f"counts have shape {counts.shape}: must be (m, {len(model.links)}, 4), m > 0")
    groups = max(m // GROUP, 1)
    edges = np.arange(groups) * (m // groups)
    lengths = np.diff(np.append(edges, m))
    means = np.add.reduceat(counts, edges, axis=0) / lengths[:, None, None]
    means = (means - offset_counts) * model.ampere_per_count
    differs = (counts[1:] != counts[:-1]) & block.fresh[1:, :, None]
    varied = differs.any(axis=0) if m > 1 else np.zeros((n, 4), dtype=np.bool_)
    # fresh samples after the last that differed
    after = np.flip(np.logical_or.accumulate(np.flip(differs, 0), axis=0), 0) if m > 1 else differs
    repeated = (~after & block.fresh[1:, :, None]).sum(axis=0)
    near = 1 + 8 * model.noise_counts[:, None]  # noise takes a reading off the end of its range
    at_end = (counts <= model.limits[:, :, 0] + near) | (counts >= model.limits[:, :, 1] - near)
    noise = np.hypot(model.noise_counts, 12**-0.5)[:, None] * model.ampere_per_count
    return Reduced(
        block.sample_ns.max(axis=0),
        block.fresh.sum(axis=0),
        means,
        noise / np.sqrt(GROUP),
        repeated,
        varied,
        counts[-1].astype(np.int64),
        at_end.mean(axis=0),
    )
