"""Contacts on a pad whose electrodes are switched: one or two, still or moving, from a whole schedule."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.config import load, shipped
from handtouch.core.pad_model import PadModel
from handtouch.core.slab import ChannelField, Slab
from handtouch.core.stages.rows import PART_COUNT, PART_SLICES, PARTS_COUNT, VALUE_COUNT, VALUE_SLICES
from handtouch.core.stages.solve import ContactSolver
from handtouch.daemon.table_cache import build_pad_model
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, Family

FloatArray = NDArray[np.float64]
TOTAL_A = 2e-3


@pytest.fixture(scope="module")
def model() -> PadModel:
    return build_pad_model(load(shipped.path("switched.toml")))


def solve(model: PadModel, *samples: FloatArray, settled: int = 1) -> tuple[FloatArray, FloatArray]:
    """Return values and parts of the tip for currents (8,) [A], one sample after the other."""
    currents = np.zeros((2, model.channels))
    values, parts = np.full((2, VALUE_COUNT), np.nan), np.full((2, PARTS_COUNT), np.nan)
    solver = ContactSolver(model, currents, np.zeros(2), np.ones(2, np.bool_), values, parts)
    for sample in samples:
        currents[0] = sample
        for _ in range(settled):
            solver.solve_contacts(np.arange(1).data)
    return values[0], parts[0].reshape(2, PART_COUNT)


def fractions(model: PadModel, s: float, t: float) -> FloatArray:
    network = model.networks[0]
    return np.asarray(network.fractions(s * network.a, t * network.b))


def states(model: PadModel) -> list[list[int]]:
    return [[0, 2, 4, 6], [1, 3, 5, 7]] if model.state_counts[0] == 2 else []


def test_the_currents_of_a_schedule_locate_a_contact_whatever_the_totals_of_its_states(
    model: PadModel,
) -> None:
    currents = TOTAL_A * fractions(model, 0.3, 0.6)
    differing = currents.copy()
    differing[states(model)[1]] *= 1.15  # the force has grown
    network = model.networks[0]
    for sample in (currents, differing):
        values, _ = solve(model, sample)
        np.testing.assert_allclose(values[VALUE_SLICES["xy"]] / [network.a, network.b], [0.3, 0.6], atol=1e-3)
        assert values[VALUE_SLICES["squared_misfit"]] < 4


def test_electrodes_of_one_channel_share_its_gain(model: PadModel) -> None:
    covariance = model.gain_covariance[0]
    node = load(shipped.path("switched.toml")).nodes["switched"]
    first, second = states(model)
    expected = np.eye(8)
    expected[first, second] = expected[second, first] = 1.0
    np.testing.assert_allclose(covariance, node.gain_std**2 * expected)


def test_two_contacts_are_resolved_with_four_channels(model: PadModel) -> None:
    """Each contact with another current in each state, as it sees other electrodes."""
    one, other = fractions(model, 0.2, 0.3), fractions(model, 0.75, 0.7)
    currents = TOTAL_A * (one + 0.8 * other)
    currents[states(model)[1]] += TOTAL_A * (0.03 * one - 0.02 * other)[states(model)[1]]
    values, parts = solve(model, currents)
    assert values[VALUE_SLICES["squared_misfit"]] > 9
    at = parts[:, PART_SLICES["position_m"]][:, :2] * 1e3 / [24, 18] + 0.5
    at = at[np.argsort(at[:, 0])]
    np.testing.assert_allclose(at, [[0.2, 0.3], [0.75, 0.7]], atol=0.05)


def test_a_contact_that_moves_has_a_wider_region(model: PadModel) -> None:
    still, _ = solve(model, TOTAL_A * fractions(model, 0.4, 0.5), settled=3)
    moved, _ = solve(model, TOTAL_A * fractions(model, 0.36, 0.5), TOTAL_A * fractions(model, 0.4, 0.5))
    at = VALUE_SLICES["covariance_m2"]
    along = [values[at].reshape(3, 3)[0, 0] for values in (still, moved)]
    across = [values[at].reshape(3, 3)[1, 1] for values in (still, moved)]
    assert along[1] - along[0] == pytest.approx((0.8 * 0.04 * 24e-3) ** 2, rel=0.01)
    assert across[1] - across[0] == pytest.approx((0.3 * 0.04 * 24e-3) ** 2, rel=0.05)


def test_the_simulators_own_solution_of_each_state_is_located(model: PadModel) -> None:
    deployment = load(shipped.path("switched.toml"))
    drawn = WORLDS["ideal"].draw(Family.TUNING.seed(0))
    places = [(0.2, 0.25), (0.5, 0.5), (0.8, 0.3), (0.35, 0.8)]
    touches = tuple(
        ScenarioTouch(
            link="tip", from_s=1.0 + k, duration_s=0.9, path=(place,), force_n=(1.5,), radius_mm=0.3
        )
        for k, place in enumerate(places)
    )
    hand = VirtualHand(deployment, Scenario(touch=touches), drawn)
    counts = hand.counts(0, [1.5 + k for k in range(len(places))])
    for row, place in zip(counts, places, strict=True):
        values, _ = solve(model, row * model.ampere_per_count[0])
        off_mm = (values[VALUE_SLICES["pad_m"]] * 1e3 - np.multiply(place, [24, 18])).tolist()
        assert np.hypot(*off_mm) < 0.15
        assert values[VALUE_SLICES["squared_misfit"]] < 9


def scheduled_slab() -> Slab:
    slab = Slab(1, 8)
    layout = tuple(ChannelField(k // 4, 16 * (k % 4), 16, True) for k in range(8))
    slab.set_layout(0, layout, scheduled=True)
    return slab


def play(slab: Slab, cycles: list[list[tuple[int, int]]]) -> list[list[int] | None]:
    """Return the sample of each cycle, in which these PDOs with these counts arrive; None without one."""
    samples: list[list[int] | None] = []
    for number, pdos in enumerate(cycles, 1):
        slab.begin_cycle(10 * number)
        for pdo, count in pdos:
            slab.write_pdo(0, np.full(4, count, "<i2").tobytes(), 10 * number + 1, pdo)
        fresh = bool(slab.fresh[0])
        samples.append(slab.unpack_counts()[0, ::4].tolist() if fresh else None)
    return samples


def test_a_sample_is_that_of_the_last_two_states() -> None:
    found = play(scheduled_slab(), [[(0, 1)], [(1, 2)], [(0, 3)], [(1, 4)]])
    assert found == [None, [1, 2], [3, 2], [3, 4]]


@pytest.mark.parametrize(
    ("cycles", "expected"),
    [
        # a lost PDO or SYNC: none until both states are of consecutive cycles again
        ([[(0, 1)], [(1, 2)], [], [(1, 4)], [(0, 5)]], [None, [1, 2], None, None, [5, 4]]),
        # a PDO that arrives in the next cycle, with that of the next state
        ([[(0, 1)], [(1, 2)], [], [(0, 3), (1, 4)], [(0, 5)], [(1, 6)]],
         [None, [1, 2], None, None, [5, 4], [5, 6]]),
        # a pause in which the host read nothing: the newest of each state, of unknown cycles
        ([[(0, 1)], [(1, 2), (0, 3), (1, 4), (0, 5)], [(1, 6)]], [None, [1, 2], [5, 6]]),
        # the same state again, as of a node that doesn't count SYNCs
        ([[(0, 1)], [(0, 2)], [(0, 3)]], [None, None, None]),
    ],
)  # fmt: skip
def test_states_of_other_cycles_are_never_combined(
    cycles: list[list[tuple[int, int]]], expected: list[list[int] | None]
) -> None:
    assert play(scheduled_slab(), cycles)[-1] == expected[-1]
    assert [sample is None for sample in play(scheduled_slab(), cycles)] == [one is None for one in expected]


def test_a_state_received_before_the_notice_of_its_sync_completes_the_sample() -> None:
    slab = scheduled_slab()
    play(slab, [[(0, 1)]])
    slab.write_pdo(0, np.full(4, 2, "<i2").tobytes(), 22, 1)
    assert not slab.fresh[0]
    slab.begin_cycle(20)
    assert slab.fresh[0]
    assert slab.unpack_counts()[0, ::4].tolist() == [1, 2]


def test_the_calibration_id_changes_with_the_schedule_alone(model: PadModel) -> None:
    deployment = load(shipped.path("switched.toml"))
    (hand,) = deployment.hands
    swapped = hand.pads[0].model_copy(update={"switch_states": (hand.pads[0].switch_states or ())[::-1]})
    other = deployment.model_copy(
        update={"hands": (hand.model_copy(update={"pads": (swapped, hand.pads[1])}),)}
    )
    ids = build_pad_model(other).default_calibration_ids
    assert ids[0] != model.default_calibration_ids[0]
    assert ids[1] == model.default_calibration_ids[1]
