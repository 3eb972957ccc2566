"""Print a digest of simulated contacts and sheet histories: `python simulator_many.py COUNT`."""

from __future__ import annotations

import hashlib
import sys

import numpy as np

from handtouch.simulate.contact_patch import PROFILES
from handtouch.simulate.pad_geometry import SimulatedSurface
from handtouch.simulate.sheet_physics import SheetStates
from handtouch.simulate.sheet_solver import ElectrodeGaps, SheetMapBank, solve_sheet
from handtouch.simulate.solved_contact import (
    ContactLayer,
    PatchNodes,
    look_up_nodes,
    node_slopes,
    solve_patches,
)
from handtouch.simulate.stages import histories, patches
from handtouch.simulate.worlds import SHEET_KINDS


def main(count: int) -> None:
    """Solve `count` random patches on a pad, and as many intervals of each kind of sheet."""
    rng, digest = np.random.default_rng(5), hashlib.sha256()
    shape = SimulatedSurface(0.024, 0.020, 1.0, flat=True)
    bank = SheetMapBank([solve_sheet(shape, ElectrodeGaps(*(4 * ((0.001, 0.002),))))])
    position = rng.uniform(0.01, 0.99, (2, count))
    radius_m, elongation = rng.uniform(5e-4, 4e-3, count), rng.uniform(1, 2, count)
    patch = np.stack(
        [radius_m, elongation, rng.uniform(0, 3, count), rng.integers(len(PROFILES), size=count)]
    )
    nodes, sheet = PatchNodes.of_patches(shape, position, patch), np.zeros(count, np.intp)
    log_radius, shares = look_up_nodes(bank, sheet, nodes)
    force_n, layer = rng.uniform(0, 5, count), ContactLayer(0.02, 1e5, 1.5)
    solved = solve_patches(nodes, log_radius, shares, np.arange(count), force_n, 2400.0, layer)
    assert (solved[0] > 0).all()
    for values in (log_radius, shares, node_slopes(bank, sheet, nodes), *solved):
        digest.update(values.tobytes())
    for kind in SHEET_KINDS.values():
        load_n = rng.uniform(0, 5, count) * (rng.uniform(size=count) < 0.8)
        steps_s, warmer_k = np.exp(rng.uniform(-6, 4, count)), rng.uniform(-5, 5, count)
        excited = rng.uniform(size=count) < 0.9
        sheets = rng.integers(3, size=count)
        apparent_n = SheetStates(kind.law, 3).advance(sheets, steps_s, load_n, excited, warmer_k)
        assert (apparent_n > 0).sum() > count // 3
        digest.update(apparent_n.tobytes())
    are_compiled = all(str(module.__file__).endswith(".so") for module in (patches, histories))
    print("compiled" if are_compiled else "interpreted", digest.hexdigest())


if __name__ == "__main__":
    main(int(sys.argv[1]))
