"""Print a digest of the evidence of slip of contacts on moving links: `python evidence_many.py COUNT`."""

from __future__ import annotations

import hashlib
import sys

import numpy as np

from handtouch.core.stages import evidence
from handtouch.percept.slip_evidence import SlipEvidence
from tests.percept.test_slip_evidence import PERIOD_S, RandomHands


def main(count: int) -> None:
    """Process about `count` samples of random contacts on two hands."""
    hands, digest, known = RandomHands(), hashlib.sha256(), 0
    found = SlipEvidence(hands.buffer, hands.slip, PERIOD_S)
    for k in range(count // RandomHands.PADS):
        pads = hands.tick(k)
        found.update_odds(pads, 10**9 + 5_000_000 * k)
        found.compute_velocities(10**9 + 5_000_000 * k)
        motion = [found.relative_motion(pad) for pad in pads.tolist()]
        of_motion = np.array([(*one.velocity, one.std) for one in motion if one], np.float64)
        for values in (found.log_odds, found.features(pads), of_motion):
            digest.update(np.nan_to_num(values, nan=-7.0).tobytes())
        known += int(np.isfinite(found.log_odds).sum())
    assert known > count // 3
    print("compiled" if evidence.__file__.endswith(".so") else "interpreted", digest.hexdigest())


if __name__ == "__main__":
    main(int(sys.argv[1]))
