"""Print a digest of what the stages compute for many contacts: `python solve_many.py COUNT`."""

from __future__ import annotations

import hashlib
import sys

import numpy as np

from handtouch.calibration.calibration import LawParameters
from handtouch.config import parse
from handtouch.core.active_calibration import ActiveCalibration
from handtouch.core.stages import solve
from handtouch.core.stages.rows import VALUE_COUNT
from handtouch.core.stages.slip import SlipDetector
from handtouch.core.stages.solve import ContactSolver
from handtouch.core.state import TickState
from handtouch.daemon.table_cache import build_pad_model
from tests.core.conftest import TOLERANT_DEPLOYMENT


def main(count: int) -> None:
    """Solve contacts of any force that move, jump, and are no points, on pads calibrated and not."""
    rng, model = np.random.default_rng(7), build_pad_model(parse(TOLERANT_DEPLOYMENT))
    n = model.size
    covariance = ((0.01, 0.0, 0.0), (0.0, 0.02, 0.0), (0.0, 0.0, 0.01))
    law = LawParameters(20000.0, 1.4, 2400.0, covariance, 2.0)
    by_gain = tuple((1e-4 * np.eye(4)).ravel().tolist())
    model.set_calibration(1, ActiveCalibration("1-1", (1.01, 0.99, 1.0, 1.02), law, by_gain))
    currents, values = np.zeros((n, 4)), np.full((n, VALUE_COUNT), np.nan)
    offset_std = np.full(n, 1e-7)
    solver = ContactSolver(model, currents, offset_std, np.ones(n, np.bool_), values)
    summed_a, times = np.zeros(n), np.zeros(n, dtype=np.int64)
    slip = SlipDetector(5e-3, values, summed_a, times, np.ones(n, dtype=np.uint32), TickState.empty(n))
    slip.set_requested(np.ones(n, dtype=np.bool_))
    at, digest = rng.uniform(0, 1, (n, 2)), hashlib.sha256()
    for number in range(-(-count // n)):
        if number % 7 == 0:
            at = rng.uniform(0, 1, (n, 2))
        at = np.clip(at + 0.01 * rng.normal(size=(n, 2)), 0.001, 0.999)
        for pad, network in enumerate(model.networks):
            fractions = network.fractions(at[pad, 0] * network.a, at[pad, 1] * network.b)
            total_a = 10 ** rng.uniform(-6, -1.9)
            bend = 1 + 0.05 * (number % 11 == 0) * rng.normal(size=4)
            currents[pad] = total_a * fractions * bend + model.noise_a[pad] * rng.normal(size=4)
        solver.solve_contacts(np.arange(n).data)
        summed_a[:], times[:] = currents.sum(axis=1), 5_000_000 * (number + 1)
        slip.detect_slips(np.arange(n))
        for result in (values, slip.state):
            digest.update(np.nan_to_num(result, nan=-7.0).tobytes())
    print("compiled" if solve.__file__.endswith(".so") else "interpreted", digest.hexdigest())


if __name__ == "__main__":
    main(int(sys.argv[1]))
