"""Drift stays within its rate; sheet behaviour acts on a held force as in its model."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from handtouch import config
from handtouch.sheet import (
    S1,
    S2,
    Fluctuation,
    SheetModel,
)
from handtouch.simulate import noise
from handtouch.simulate.electronics_drift import ElectronicsDrift
from handtouch.simulate.faults import Gum
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.sheet_physics import SheetLaw
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.virtual_pad import VirtualPad
from handtouch.simulate.worlds import (
    SHEET_KINDS,
    WORLDS,
    DrawnWorld,
    ElectronicsSpread,
    Fixed,
    Normal,
    PartSpread,
    SheetKind,
    Uniform,
    World,
)
from tests.deployments import SIX_ARCS, arcs_text
from tests.sheets import apparent_load


def kind_of(law: SheetLaw) -> SheetKind:
    return dataclasses.replace(SHEET_KINDS["S1"], name="test", law=law)


def calm(name: str) -> SheetLaw:
    """Return the law of a kind without fluctuation."""
    return dataclasses.replace(SHEET_KINDS[name].law, press_std=0.0, noise_std=0.0)


def drawn(law: SheetLaw) -> DrawnWorld:
    """Return a world that differs from the file only in its sheets, and has no noise."""
    silent = World("silent", electronics=ElectronicsSpread(noise_ratio=Fixed(0.0)))
    return silent.with_sheets(kind_of(law)).draw(3)


def presses(*touches: tuple[float, float, float], **other: object) -> Scenario:
    """Return a scenario of touches (begin, duration, force) on the flat pad."""
    return Scenario.model_validate(
        {
            "touch": [
                {"link": "flat", "from_s": a, "duration_s": b, "path": ((0.5, 0.5),), "force_n": (f,)}
                for a, b, f in touches
            ]
        }
        | other
    )


def built(deployment: config.Deployment, scenario: Scenario, of: DrawnWorld) -> VirtualPad:
    return VirtualPad.build(deployment, "right", deployment.hands[0].pads[0], scenario, of, ())


@pytest.mark.parametrize(("kind", "model"), [("S1", S1), ("S2", S2)])
def test_held_force_reads_as_in_sheet_model(
    deployment: config.Deployment, kind: str, model: SheetModel
) -> None:
    scenario = presses((1.0, 3.0, 2.0), (6.0, 30.0, 1.0), (37.0, 5.0, 3.0))
    pad = built(deployment, scenario, drawn(calm(kind)))

    def force_n(t_s: float) -> float:
        return sum(touch.force_at(t_s) for touch in scenario.touches)

    calm_model = dataclasses.replace(model, fluctuation=Fluctuation())
    track = apparent_load(calm_model, force_n, step_s=1e-3)
    times = np.concatenate([np.arange(1.2, 4, 0.3), np.arange(6.3, 35.5, 1.3), np.arange(37.2, 41.8, 0.4)])
    expected = [track(t) / force_n(t) for t in times]
    np.testing.assert_allclose(pad.force_ratio(times), expected, atol=0.015)


def test_sheet_adapts_under_load_and_recovers_without_excitation(deployment: config.Deployment) -> None:
    scenario = presses(*((20.0 * k, 15.0, 2.0) for k in range(400)))
    hand = VirtualHand(deployment, scenario, drawn(calm("S1")))
    fresh = hand.counts(0, [10.0])[0].sum()
    tired = hand.counts(0, [3010.0])[0].sum()
    under_potential = hand.counts(0, [7990.0])[0].sum()
    hand.switch_excitation(0, 3020.0, False)
    hand.switch_excitation(0, 7900.0, True)
    rested = hand.counts(0, [7990.0])[0].sum()
    assert hand.counts(0, [3010.0])[0].sum() == tired
    assert 0 <= under_potential < tired < 0.7 * fresh
    assert rested > 1.2 * tired


def test_results_do_not_depend_on_order_of_requests(deployment: config.Deployment) -> None:
    scenario = presses((1.0, 3.0, 2.0), (6.0, 3.0, 1.0), repeat=True)
    of = WORLDS["harsh"].draw(5)
    times = np.random.default_rng(1).uniform(0, 60, 300)
    whole = VirtualHand(deployment, scenario, of).counts(0, times)
    alone = VirtualHand(deployment, scenario, of)
    np.testing.assert_array_equal(whole, [alone.sample(t)[0] for t in times])


def test_presses_vary_as_in_sheet_model(deployment: config.Deployment) -> None:
    scenario = presses(*((2.0 * k, 1.5, 1.0) for k in range(600)))
    lasting = dataclasses.replace(SHEET_KINDS["S1"].law.adaptation, times_s=(1e9,))
    slow = dataclasses.replace(calm("S1"), press_std=0.072, adaptation=lasting)
    pad = built(deployment, scenario, drawn(slow))
    factors = pad.force_ratio(np.arange(1.2, 1200.0, 2.0))
    assert np.log(factors).std() == pytest.approx(0.072, rel=0.1)
    assert np.ptp(pad.force_ratio(np.linspace(0.9, 1.3, 20))) < 0.05


def test_gum_adapts_the_sheet_like_a_touch(deployment: config.Deployment) -> None:
    gum = Gum(link="flat", from_s=5.0, place=(0.3, 0.6), force_n=1.0, press_n=0, relax=0.0)
    hand = VirtualHand(deployment, presses((0.0, 1.0, 1.0)), drawn(calm("S1")), faults=(gum,))
    first, later = hand.counts(0, [10.0, 4000.0]).sum(1)
    assert later < 0.7 * first


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000), st.floats(0, 1e6), st.floats(1e-3, 1e3))
def test_random_walk_never_exceeds_its_rate(seed: int, t_s: float, dt_s: float) -> None:
    keys = np.array([noise.stream_key(seed, "a"), noise.stream_key(seed, "b")])
    before, after = noise.random_walk(keys, [t_s, t_s + dt_s]).T
    assert (np.abs(after - before) <= dt_s * (1 + 1e-6) + 1e-9).all()


def test_zeros_drift_independently_and_temperature_is_common() -> None:
    of = World("zeros", electronics=ElectronicsSpread(zero_drift_counts_per_s=Fixed(0.1))).draw(3)
    times = np.arange(0, 86_400, 60.0)
    zeros = (
        ElectronicsDrift(of, [("right", "flat"), ("right", "tip")]).zero_counts(times).reshape(len(times), 8)
    )
    assert (zeros[0] == 0).all()
    assert zeros.std(0).min() > 3
    assert np.abs(np.diff(zeros, axis=0)).max() <= 6.0
    assert np.abs(np.corrcoef(zeros.T) - np.eye(8)).max() < 0.9
    climate = ElectronicsSpread(temperature_drift_k_per_s=Fixed(0.01), offset_counts_per_k=Normal(0.0, 2.0))
    warm = World("warm", electronics=climate).draw(3)
    zeros = (
        ElectronicsDrift(warm, [("right", "flat"), ("right", "tip")])
        .zero_counts(times)
        .reshape(len(times), 8)
    )
    assert np.linalg.matrix_rank(zeros, tol=1e-6 * np.abs(zeros).max()) == 1
    one, other = (ElectronicsDrift(warm, [("right", link)]) for link in ("flat", "tip"))
    np.testing.assert_array_equal(one.temperature_rise_k(times), other.temperature_rise_k(times))


def test_zeros_begin_where_they_are_drawn_and_move_while_the_hand_warms_up() -> None:
    cold = ElectronicsSpread(
        zero_counts=Fixed(40.0), warm_up_k=Fixed(10.0), offset_counts_per_k=Normal(0.0, 5.0)
    )
    of = World("cold", electronics=cold).draw(3)
    drift = ElectronicsDrift(of, [("right", "flat")])
    slope = of.offset_counts_per_k("right/flat")
    zeros = drift.zero_counts(np.array([0.0, 60.0, 120.0, 500.0]))[:, 0]
    np.testing.assert_allclose(zeros, 40.0 + np.outer([0.0, 5.0, 10.0, 10.0], slope), rtol=1e-12)


def test_noise_is_normal_and_white() -> None:
    keys = np.array([noise.stream_key(1, "right", "flat", name) for name in ("x0", "xa", "y0", "yb")])
    drawn = noise.standard_normal(keys, 5_000_000 * np.arange(50_000)[:, None])
    np.testing.assert_allclose(drawn.mean(0), 0, atol=0.02)
    np.testing.assert_allclose(np.cov(drawn.T), np.eye(4), atol=0.03)
    np.testing.assert_allclose([(drawn[1:] * drawn[:-1]).mean(0)], 0, atol=0.02)
    np.testing.assert_allclose((drawn**4).mean(0), 3, atol=0.15)


def test_replaced_node_has_gains_by_serial_number(deployment: config.Deployment) -> None:
    swap = {"link": "flat", "at_s": 50.0, "serial": 77}
    scenario = presses((0.0, 1000.0, 2.0), swap=(swap,))
    silent = ElectronicsSpread(noise_ratio=Fixed(0.0))
    gains = PartSpread(gain_ratio=Uniform(0.98, 1.02))
    of = World("gains", gains, electronics=silent).draw(4)
    hand = VirtualHand(deployment, scenario, of)
    before, after = hand.counts(0, [20.0, 60.0])
    hidden = of.pad("right", deployment.hands[0].pads[0])
    expected = np.array(of.replacement_gain(77)) / np.array(hidden.gain_ratio)
    np.testing.assert_allclose(after / before, expected, atol=3 / before.min())
    assert of.replacement_gain(77) != of.replacement_gain(78)
    given_gains = presses((0.0, 1000.0, 2.0), swap=(swap | {"gain": (1.0, 1.1, 0.9, 1.0)},))
    ideal = World("silent", electronics=silent).draw(4)
    before, after = VirtualHand(deployment, given_gains, ideal).counts(0, [20.0, 60.0])
    np.testing.assert_allclose(after / before, [1.0, 1.1, 0.9, 1.0], atol=3 / before.min())


def test_sheets_of_a_hand_differ_and_remain_stable(deployment: config.Deployment) -> None:
    world = WORLDS["default"].with_sheets(SHEET_KINDS["S1"]).draw(2)
    laws = [world.pad("right", pad).sheet_law for pad in deployment.hands[0].pads]
    assert len({law.adaptation.times_s for law in laws if law}) == len(laws) == 4
    assert all(law is not None and law.adaptation.shares == (1.0,) for law in laws)
    ideal = WORLDS["default"].with_sheets().draw(2)
    assert ideal.pad("right", deployment.hands[0].pads[0]).sheet_law is None


def test_ends_of_arcs_are_off_in_both_directions_without_touching() -> None:
    (pad,) = (entry.pad for entry in config.parse(arcs_text(SIX_ARCS)).pads if entry.pad.arcs_mm)
    gaps = np.array([WORLDS["harsh"].draw(seed).pad("h", pad).gap_before_mm for seed in range(40)])
    assert gaps.min() < -0.1 < 0.1 < gaps.max()
    assert gaps.min() >= -0.4 * 1.0
