"""Force vectors of contacts above shear pads are those of the theory; their status states what they lack."""

from __future__ import annotations

import numpy as np
import pytest

from handtouch.core.stages.shear import REST_SAMPLES
from handtouch.hand import mount_transform
from handtouch.hand.pads import rotation_from_rpy
from handtouch.wire import ForceStatus, PositionStatus
from tests.core.shear_bench import CENTRE_STD_M, FORCE_STD_N, NOISE_COUNTS, PATTERNS, ShearBench

COUNTS_PER_A = 32767 / 25e-3


@pytest.fixture
def bench() -> ShearBench:
    """All pads untouched, for long enough that their rest positions are known."""
    made = ShearBench(tuple(PATTERNS))
    counts = [made.counts(pad, (0.05e-3, -0.03e-3), 0.0) for pad in range(made.pads)]
    for _ in range(REST_SAMPLES):
        for pad in range(made.pads):
            made.touch(pad, None, (0.0, 0.0), counts[pad])
        made.tick()
    return made


@pytest.mark.parametrize("pad", range(len(PATTERNS)), ids=PATTERNS)
def test_the_force_vector_is_that_of_the_theory(bench: ShearBench, pad: int) -> None:
    rng, theory, peak_n = np.random.default_rng(pad), bench.theory(pad, part_std=1e3), 0.0
    layer = bench.shear(pad).build_layer()
    rotation, _ = mount_transform(bench.deployment.pads[pad].pad)
    rest = theory.estimate(np.rint(bench.counts(pad, (0.05e-3, -0.03e-3), 0.0)), 1.0).motion[:2]
    for _ in range(20):
        normal_n, centre_m = float(rng.uniform(0.5, 6.0)), rng.normal(0.0, 2e-3, 2)
        counts = np.rint(bench.counts(pad, rng.uniform(-0.25e-3, 0.25e-3, 2), normal_n))
        bench.touch(pad, normal_n, centre_m, counts)
        bench.tick()
        found = theory.estimate(
            counts,
            NOISE_COUNTS,
            normal_force_n=normal_n,
            centre_m=centre_m,
            centre_std_m=CENTRE_STD_M,
            normal_force_std_n=FORCE_STD_N,
        )
        alone = layer.force(found.motion[:2] - rest)
        peak_n = max(peak_n, float(np.hypot(*alone.vector_n)))
        tangential = layer.force(found.motion[:2] - rest, found.covariance[:2, :2], peak_n)
        covariance = np.zeros((3, 3))
        covariance[:2, :2], covariance[2, 2] = tangential.covariance_n2, FORCE_STD_N**2
        values = bench.state.force_vector[pad]
        assert bench.state.force_vector_status[pad] == ForceStatus.VALID
        np.testing.assert_allclose(values[:3], rotation @ [*tangential.vector_n, -normal_n], atol=1e-6)
        np.testing.assert_allclose(
            values[3:].reshape(3, 3), rotation @ covariance @ rotation.T, rtol=1e-4, atol=1e-9
        )


def test_on_a_curved_pad_the_tangential_force_lies_in_the_tangent_plane_of_the_contact(
    bench: ShearBench,
) -> None:
    rotation, _ = mount_transform(bench.deployment.pads[0].pad)
    forces = []
    for tilt_rad in (0.0, 0.6):
        counts = bench.counts(0, (0.15e-3, 0.1e-3), 3.0)
        bench.touch(0, 3.0, (0.0, 0.0), counts, tilt_rad)
        bench.tick()
        forces.append(rotation.T @ bench.state.force_vector[0, :3])
    cosine, sine = np.cos(0.6), np.sin(0.6)
    turn = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    np.testing.assert_allclose(forces[1], turn @ forces[0], atol=1e-9)
    covariance = rotation.T @ bench.state.force_vector[0, 3:].reshape(3, 3) @ rotation
    normal = turn[:, 2]
    assert normal @ covariance @ normal == pytest.approx(FORCE_STD_N**2)


def test_the_covariance_includes_the_angle_of_the_mount(bench: ShearBench) -> None:
    std_rad, rng = np.radians(2.0), np.random.default_rng(5)
    counts, covariances = bench.counts(0, (0.15e-3, 0.1e-3), 3.0), []
    for variance in (0.0, std_rad**2):
        bench.mounts[0, 4] = variance
        bench.touch(0, 3.0, (0.0, 0.0), counts)
        bench.tick()
        covariances.append(bench.state.force_vector[0, 3:].reshape(3, 3).copy())
    turns = [rotation_from_rpy(rng.normal(0.0, std_rad, 3)) for _ in range(20_000)]
    turned = np.cov(np.array(turns) @ bench.state.force_vector[0, :3], rowvar=False)
    np.testing.assert_allclose(covariances[1] - covariances[0], turned, atol=0.05 * turned.max())


def test_where_the_normal_is_along_the_pads_x_there_is_no_vector(bench: ShearBench) -> None:
    counts = bench.counts(0, (0.15e-3, 0.1e-3), 3.0)
    found = []
    for tilt_rad in (0.5 * np.pi, 0.4 * np.pi):
        bench.touch(0, 3.0, (0.0, 0.0), counts, tilt_rad)
        bench.tick()
        found.append((bench.state.force_vector_status[0], np.isfinite(bench.state.force_vector[0]).any()))
    assert found == [(ForceStatus.INVALID, False), (ForceStatus.VALID, True)]


def test_the_hysteresis_bound_is_that_of_the_greatest_force_since_the_tare(bench: ShearBench) -> None:
    stds = []
    for moved in (0.05e-3, 0.4e-3, 0.05e-3):
        bench.touch(0, 3.0, (0.0, 0.0), bench.counts(0, (moved, 0.0), 3.0))
        bench.tick()
        stds.append(float(np.sqrt(np.trace(bench.state.force_vector[0, 3:].reshape(3, 3)))))
    assert stds[0] < stds[2] < stds[1]
    bench.forces.set_rest(0, bench.counts(0, (0.05e-3, 0.0), 0.0))
    bench.tick()
    assert np.sqrt(np.trace(bench.state.force_vector[0, 3:].reshape(3, 3))) < stds[0]


def test_a_tare_replaces_the_rest_position_and_a_replaced_pad_has_none(bench: ShearBench) -> None:
    bench.forces.set_rest(0, bench.counts(0, (0.2e-3, 0.1e-3), 0.0))
    bench.touch(0, 1.0, (0.0, 0.0), bench.counts(0, (0.2e-3, 0.1e-3), 1.0))
    bench.tick()
    rotation, _ = mount_transform(bench.deployment.pads[0].pad)
    np.testing.assert_allclose(rotation.T @ bench.state.force_vector[0, :3], [0.0, 0.0, -1.0], atol=2e-3)
    bench.forces.forget_rest([0])
    bench.tick()
    assert bench.state.force_vector_status[0] == ForceStatus.INVALID
    assert np.isnan(bench.state.force_vector[0]).all()


@pytest.mark.parametrize(
    ("position", "force", "expected"),
    [
        (PositionStatus.VALID, ForceStatus.VALID, ForceStatus.VALID),
        (PositionStatus.VALID, ForceStatus.LOWER_BOUND, ForceStatus.LOWER_BOUND),
        (PositionStatus.VALID, ForceStatus.UNRELIABLE, ForceStatus.UNRELIABLE),
        (PositionStatus.UNRELIABLE, ForceStatus.VALID, ForceStatus.UNRELIABLE),
        (PositionStatus.VALID, ForceStatus.INVALID, ForceStatus.INVALID),
        (PositionStatus.INVALID, ForceStatus.VALID, ForceStatus.INVALID),
    ],
)
def test_the_vector_is_as_reliable_as_position_and_force(
    bench: ShearBench, position: PositionStatus, force: ForceStatus, expected: ForceStatus
) -> None:
    bench.position_status[0], bench.force_status[0] = position, force
    bench.touch(0, 2.0, (0.0, 0.0), bench.counts(0, (0.1e-3, 0.0), 2.0))
    bench.tick()
    assert bench.state.force_vector_status[0] == expected


@pytest.mark.parametrize(
    ("count", "expected"),
    [(32767, ForceStatus.INVALID), (0, ForceStatus.INVALID), (150, ForceStatus.UNRELIABLE)],
)
def test_a_failed_channel_is_no_displacement(bench: ShearBench, count: int, expected: ForceStatus) -> None:
    counts = bench.counts(1, (0.1e-3, 0.0), 2.0)
    counts[2] = counts[3] = count  # one alone may be explained by a displacement beyond the travel
    bench.touch(1, 2.0, (0.0, 0.0), counts)
    bench.tick()
    assert bench.state.force_vector_status[1] == expected


def test_a_pad_without_new_sample_keeps_its_vector_until_its_contact_ends(bench: ShearBench) -> None:
    bench.touch(0, 2.0, (0.0, 0.0), bench.counts(0, (0.1e-3, 0.0), 2.0))
    bench.tick()
    before = bench.state.force_vector[0].copy()
    bench.forces.update_forces(bench.slab)
    np.testing.assert_array_equal(bench.state.force_vector[0], before)
    bench.touch(0, None, (0.0, 0.0), bench.counts(0, (0.0, 0.0), 0.0))
    bench.tick()
    assert bench.state.force_vector_status[0] == ForceStatus.NOT_COMPUTED
    assert np.isnan(bench.state.force_vector[0]).all()


def test_what_no_scene_requests_is_not_computed(bench: ShearBench) -> None:
    bench.state.force_requested[0] = False
    bench.touch(0, 2.0, (0.0, 0.0), bench.counts(0, (0.1e-3, 0.0), 2.0))
    bench.tick()
    assert bench.state.force_vector_status[0] == ForceStatus.NOT_COMPUTED
    assert bench.state.shear_peak_n[0] > 0.4  # the layer's loop has its memory of forces nevertheless
