"""Print a digest of two contacts at once on a pad of six electrodes: `python pairs_many.py COUNT`."""

from __future__ import annotations

import hashlib
import sys

import numpy as np

from handtouch.config import load, shipped
from handtouch.core.stages import solve
from handtouch.core.stages.rows import PARTS_COUNT, VALUE_COUNT
from handtouch.core.stages.solve import ContactSolver
from handtouch.daemon.table_cache import build_pad_model

_PAD = 1


def main(count: int) -> None:
    """Solve pairs anywhere on the pad, a twentieth of `count` of them: each is fitted from many starts."""
    rng, model = np.random.default_rng(11), build_pad_model(load(shipped.path("electrodes.toml")))
    network, pads = model.networks[_PAD], model.size
    currents, values = np.zeros((pads, 6)), np.full((pads, VALUE_COUNT), np.nan)
    parts = np.full((pads, PARTS_COUNT), np.nan)
    solver = ContactSolver(model, currents, np.zeros(pads), np.ones(pads, np.bool_), values, parts)
    digest, found = hashlib.sha256(), 0
    for _ in range(-(-count // 20)):
        x, y = rng.uniform(0.05, 0.95, (2, 2)) * [[network.a], [network.b]]
        totals = 10 ** rng.uniform(-4, -2.5, 2)
        currents[_PAD] = network.fractions(x, y) @ totals + model.noise_a[_PAD] * rng.normal(size=6)
        solver.solve_contacts(np.array([_PAD]).data)
        found += int(np.isfinite(parts[_PAD, 0]))
        digest.update(np.nan_to_num(parts, nan=-7.0).tobytes())
    assert found
    print("compiled" if solve.__file__.endswith(".so") else "interpreted", digest.hexdigest())


if __name__ == "__main__":
    main(int(sys.argv[1]))
