"""Print a digest of force vectors of any samples of shear pads: `python shear_many.py COUNT`."""

from __future__ import annotations

import hashlib
import sys

import numpy as np

from handtouch.core.stages import shear
from tests.core.shear_bench import PATTERNS, ShearBench


def main(count: int) -> None:
    """Estimate displacements and forces from noisy, saturated, missing and impossible currents."""
    rng = np.random.default_rng(6)
    bench, digest, vectors = ShearBench(tuple(PATTERNS)), hashlib.sha256(), 0
    for number in range(count // 4):
        touched = number % 100 > 70
        for pad in range(len(PATTERNS)):
            motion = rng.normal(0.0, 0.25e-3, 2) * touched
            counts = bench.counts(pad, motion, 3.0 * touched) * np.exp(rng.normal(0.0, 0.01, 4))
            if rng.random() < 0.05:
                counts[rng.integers(4)] = rng.choice([-5.0, 0.0, 32767.0, 100.0])
            bench.touch(pad, 3.0 if touched else None, rng.normal(0.0, 2e-3, 2), counts)
            bench.state.update_interval_ticks[pad] = 1 + number % 3
        bench.tick()
        digest.update(bench.state.save())
        vectors += int(np.isfinite(bench.state.force_vector[:, 0]).sum())
    assert vectors > count // 20
    print("compiled" if shear.__file__.endswith(".so") else "interpreted", digest.hexdigest())


if __name__ == "__main__":
    main(int(sys.argv[1]))
