"""Simulated shear pads beneath touched pads: counts over time, and coverage of force vectors from them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from handtouch.config import parse
from handtouch.core.stages.shear import REST_SAMPLES
from handtouch.hand import mount_transform
from handtouch.simulate.contact_patch import ContactPatch
from handtouch.simulate.shear_pad import VirtualShear
from handtouch.simulate.touch import ScenarioTouch, ScheduledTouches
from handtouch.simulate.worlds import WORLDS, DrawnWorld
from tests.core.shear_bench import ShearBench, shear_deployment

FloatArray = npt.NDArray[np.float64]
KINDS = ("crossed", "discs")
DEPLOYMENT = parse(shear_deployment(KINDS))
PULL = ScenarioTouch.model_validate(
    {
        "link": "tip0",
        "from_s": 1.0,
        "duration_s": 2.0,
        "path": [[0.5, 0.5]],
        "force_n": [2.0, 4.0],
        "tangential_n": [[0.5, -0.3], [1.2, 0.4]],
    }
)


def virtual_shear(pad: int, world: DrawnWorld, repeat_period_s: float = np.inf) -> VirtualShear:
    touches = ScheduledTouches([(PULL, ContactPatch(2.5e-3))])
    return VirtualShear(DEPLOYMENT, "h", DEPLOYMENT.pads[pad].pad, touches, world, repeat_period_s)


def test_the_same_time_gives_the_same_counts_in_any_order() -> None:
    times = np.linspace(0.0, 4.0, 41)
    at_once = virtual_shear(0, WORLDS["default"].draw(1)).counts(times)
    one = virtual_shear(0, WORLDS["default"].draw(1))
    np.testing.assert_array_equal(np.vstack([one.counts(times[[k]]) for k in range(41)][::-1])[::-1], at_once)


def test_a_pull_moves_currents_and_leaves_less_than_its_hysteresis() -> None:
    pad = virtual_shear(0, WORLDS["ideal"].draw(1))
    before, pulled, after = pad.counts(np.array([0.5, 2.5, 3.5])).astype(float)
    ratio = np.log(pulled[1] / pulled[0]) - np.log(before[1] / before[0])
    left = np.log(after[1] / after[0]) - np.log(before[1] / before[0])
    assert ratio > 0.2  # pulled along x
    assert abs(left) < 0.1 * ratio


def test_force_vectors_cover_simulated_forces_in_the_world_default() -> None:
    """Two components of many drawn pads: sigma is neither too small, nor three times too large."""
    sigmas, bench = [], ShearBench(KINDS)
    times = np.asarray(0.01 * np.arange(1, REST_SAMPLES + 1), np.float64)
    for seed in range(1, 9):
        world = WORLDS["default"].draw(seed)
        bench.forces.forget_rest(range(len(KINDS)))
        pads = [virtual_shear(pad, world) for pad in range(len(KINDS))]
        for counts in np.stack([pad.counts(times) for pad in pads], axis=1):
            for pad, row in enumerate(counts):
                bench.touch(pad, None, (0.0, 0.0), row)
            bench.tick()
        for t_s in (1.5, 2.0, 2.7):
            at = np.array([t_s])
            for pad, shear in enumerate(pads):
                bench.touch(pad, PULL.force_at(t_s), (0.0, 0.0), shear.counts(at)[0])
            bench.tick()
            for pad, shear in enumerate(pads):
                rotation, _ = mount_transform(DEPLOYMENT.pads[pad].pad)
                found = rotation.T @ bench.state.force_vector[pad, :3]
                covariance = rotation.T @ bench.state.force_vector[pad, 3:].reshape(3, 3) @ rotation
                error = found[:2] - shear.tangential_n(at)[:, 0]
                sigmas.append(np.sqrt(error @ np.linalg.solve(covariance[:2, :2], error)))
    assert np.mean(np.array(sigmas) < 2.45) > 0.9  # 95 % of two dimensions
    assert np.median(sigmas) > 0.4  # 1.18 of two dimensions
