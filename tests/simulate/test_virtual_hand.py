"""Virtual hand: Ohm's and Kirchhoff's laws, noise, tolerances, and consistent ground truth."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from handtouch import config
from handtouch.config import shipped
from handtouch.field.contact_law import contact_stack_resistance
from handtouch.hand import electrode_network, mount_transform, pad_network, pad_surface
from handtouch.simulate.pad_circuit import PadCircuit
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS
from tests.sandwich import Sandwich
from tests.simulate.surfaces import OUTLINE_TABLES, SURFACE_TABLES

LINKS = ("flat", "round", "tapered", "tip")
IDEAL = WORLDS["ideal"].draw(3)


def press(
    link: str, place: tuple[float, float] = (0.4, 0.7), force_n: float = 1.0, radius_mm: float | None = None
) -> Scenario:
    """Return a long, constant touch."""
    touch = {"link": link, "from_s": 0.0, "duration_s": 1000.0, "path": (place,), "force_n": (force_n,)}
    touch |= {"radius_mm": radius_mm} if radius_mm else {}
    return Scenario.model_validate({"touch": [touch]})


@pytest.mark.parametrize("link", LINKS)
def test_currents_agree_with_exact_theory(deployment: config.Deployment, link: str) -> None:
    check_currents(deployment, link)


@pytest.mark.parametrize("table", SURFACE_TABLES.values(), ids=list(SURFACE_TABLES))
def test_currents_agree_with_exact_theory_on_every_surface(
    deployment: config.Deployment, table: config.SurfaceTable
) -> None:
    pad, *others = deployment.hands[0].pads
    pads = (pad.model_copy(update={"surface": table}), *others)
    hand = deployment.hands[0].model_copy(update={"pads": pads})
    check_currents(deployment.model_copy(update={"hands": (hand,)}), pad.link)


def test_currents_agree_with_exact_theory_on_an_outline(deployment: config.Deployment) -> None:
    pad, *others = deployment.hands[0].pads
    table = OUTLINE_TABLES["outline_on_sphere"]
    pads = (pad.model_copy(update={"surface": table}), *others)
    hand = deployment.hands[0].model_copy(update={"pads": pads})
    check_currents(deployment.model_copy(update={"hands": (hand,)}), pad.link, 3e-3)


def test_currents_agree_with_exact_theory_on_an_l_shaped_palm_with_eight_electrodes() -> None:
    check_currents(config.load(shipped.path("l_palm.toml")), "palm", 3e-3)


def test_currents_agree_with_exact_theory_for_unequal_gaps(deployment: config.Deployment) -> None:
    pad, *others = deployment.hands[0].pads
    pad = pad.model_copy(update={"gap_offsets_mm": ((2.0, 0.0), (0.5, 1.5), (0.0, 3.0), (1.0, 0.0))})
    hand = deployment.hands[0].model_copy(update={"pads": (pad, *others)})
    check_currents(deployment.model_copy(update={"hands": (hand,)}), pad.link)


def check_currents(deployment: config.Deployment, link: str, tolerance: float = 2e-4) -> None:
    """Compare currents, position and normal of a small touch with `handtouch.field`."""
    growing = any(sheet.hertz_force_n for sheet in deployment.sheets.values())
    scenario = press(link, force_n=0.05) if growing else press(link, force_n=0.01, radius_mm=0.3)
    hand = VirtualHand(deployment, scenario, IDEAL)
    (true,) = hand.truth(10.0)
    pad = next(pad for pad in deployment.hands[0].pads if pad.link == link)
    sheet, surface = deployment.sheets[pad.sheet], pad_surface(pad)
    network = pad_network(pad, sheet)
    x, y = surface.to_rectangle(true.u_m, true.v_m)
    radius_m = true.radius_m
    if sheet.hertz_force_n is not None:
        assert radius_m == pytest.approx(
            1e-3 * sheet.contact_radius_mm * (0.05 / sheet.hertz_force_n) ** (1 / 3)
        )
    pressure_kpa = true.force_n / (math.pi * radius_m**2) * 1e-3
    contact_ohm_m2 = 1e-6 * sheet.contact_ohm_mm2 * (sheet.reference_kpa / pressure_kpa) ** sheet.alpha
    outer_m = network.spreading_radius(x, y) * surface.scale(x, y)
    ohm = contact_stack_resistance(sheet.ohm_per_square, contact_ohm_m2, radius_m, outer_m)
    ohm += network.series_resistance(x, y)
    expected = deployment.nodes[pad.node].drive_v / ohm * network.fractions(x, y)
    np.testing.assert_allclose(true.currents_a, expected, rtol=tolerance, atol=1e-9)
    rotation, translation = mount_transform(pad)
    np.testing.assert_allclose(true.position_m, rotation @ surface.point(x, y) + translation, atol=1e-12)
    np.testing.assert_allclose(true.normal, rotation @ surface.normal(x, y), atol=1e-12)


def test_currents_agree_with_exact_theory_of_a_patch_that_grows_with_the_force(
    deployment: config.Deployment,
) -> None:
    sheets = {
        name: sheet.model_copy(update={"hertz_force_n": 0.7}) for name, sheet in deployment.sheets.items()
    }
    growing = deployment.model_copy(update={"sheets": sheets})
    check_currents(growing, "round")
    hand, row = VirtualHand(growing, press("round"), IDEAL), LINKS.index("round")
    (one,), (true,) = hand.counts(row, [10.0]), hand.truth(10.0)
    assert one == pytest.approx(true.currents_a * hand.counts_per_ampere(10.0)[row], abs=10.0)


def test_counts_are_true_currents_with_configured_noise(
    deployment: config.Deployment,
) -> None:
    hand = VirtualHand(deployment, press("round"), IDEAL)
    (true,) = hand.truth(10.0)
    counts = np.array([hand.sample(10 + k * 0.005) for k in range(4000)])
    assert counts.dtype == np.int64
    assert counts.shape[1:] == (4, 4)
    expected = np.zeros((4, 4))
    expected[1] = np.array(true.currents_a) / 10e-3 * 32767
    deviation = math.hypot(2.0, math.sqrt(1 / 12))
    np.testing.assert_allclose(counts.mean(0), expected, rtol=0, atol=5 * deviation / math.sqrt(4000))
    np.testing.assert_allclose(counts.std(0), deviation, rtol=0.06)


def test_bound_is_reached_by_an_efficient_estimator(deployment: config.Deployment) -> None:
    for row, link in enumerate(LINKS):
        hand = VirtualHand(deployment, press(link, (0.3, 0.6), force_n=0.1), IDEAL)
        (true,) = hand.truth(10.0)
        pad = deployment.hands[0].pads[row]
        unit_a = 10e-3 / 32767
        counts = np.array([hand.sample(10 + k * 0.005)[row] for k in range(2000)])
        found = electrode_network(pad, deployment.sheets[pad.sheet]).estimate(counts.T * unit_a, 2.0 * unit_a)
        at = pad_surface(pad).point(found.x, found.y)
        rotation, translation = mount_transform(pad)
        error = rotation @ at + translation[:, None] - np.array(true.position_m)[:, None]
        assert np.sqrt(np.mean(np.sum(error**2, axis=0))) == pytest.approx(true.bound_m, rel=0.08)
        assert np.linalg.norm(error.mean(1)) < 0.15 * true.bound_m


def test_current_rises_with_force_up_to_full_scale(deployment: config.Deployment) -> None:
    totals = [
        sum(VirtualHand(deployment, press("flat", force_n=f), IDEAL).truth(10.0)[0].currents_a)
        for f in (0.1, 1, 10)
    ]
    assert totals == sorted(totals)
    strong = deployment.model_copy(
        update={"nodes": {"n": deployment.nodes["n"].model_copy(update={"drive_v": 500.0})}}
    )
    assert VirtualHand(strong, press("flat", (0.05, 0.5), 10.0), IDEAL).sample(10.0)[0, 0] == 32767


def test_samples_are_reproducible_by_time_and_seed(
    deployment: config.Deployment,
) -> None:
    one = VirtualHand(deployment, press("tip"), IDEAL)
    again = VirtualHand(deployment, press("tip"), IDEAL)
    np.testing.assert_array_equal(one.sample(3.0), again.sample(3.0))
    np.testing.assert_array_equal(one.sample(3.0), one.sample(3.0))
    assert (one.sample(3.0) != one.sample(3.005)).any()
    other = VirtualHand(deployment, press("tip"), WORLDS["ideal"].draw(4))
    assert (one.sample(3.0) != other.sample(3.0)).any()


def test_bus_has_its_own_pads_and_their_touches(deployment: config.Deployment) -> None:
    scenario = Scenario.tour(deployment)
    near, far = (VirtualHand(deployment, scenario, IDEAL, bus) for bus in ("near", "far"))
    whole = VirtualHand(deployment, scenario, IDEAL)
    assert [pad.link for _, pad in near.pads] == ["flat", "round"]
    assert [pad.link for _, pad in far.pads] == ["tapered", "tip"]
    for t_s in (1.5, 2.3, 3.4, 4.3):
        split, together = near.truth(t_s) + far.truth(t_s), whole.truth(t_s)
        assert [record.link for record in split] == [record.link for record in together]
        for one, other in zip(split, together, strict=True):
            assert one.position_m == other.position_m
            assert one.currents_a == pytest.approx(other.currents_a, rel=1e-9)


def test_hand_without_contact_reads_noise_only(deployment: config.Deployment) -> None:
    hand = VirtualHand(deployment, press("flat"), IDEAL)
    assert hand.truth(2000.0) == []
    assert np.abs(hand.sample(2000.0)).max() < 12


def test_parts_differ_within_tolerances(deployment: config.Deployment) -> None:
    world = WORLDS["default"].draw(5)
    pads = deployment.hands[0].pads
    parts = [world.pad("right", pad) for pad in pads]
    for pad, part in zip(pads, parts, strict=True):
        assert np.abs(np.array(part.gain_ratio) - 1).max() <= 0.02
        gaps = np.array(part.gap_before_mm + part.gap_after_mm)
        assert np.abs(gaps - pad.gap_mm).max() <= 0.2
        series = np.array(part.series_ohm)
        more = series - pad.series_ohm
        assert (
            (more >= -0.05 * np.array(pad.series_ohm)) & (more <= 0.05 * np.array(pad.series_ohm) + 2.0)
        ).all()
        assert len(set(part.gain_ratio)) == 4
    assert len(set(parts)) == len(parts)
    assert WORLDS["default"].draw(6).pad("right", pads[0]) != world.pad("right", pads[0])


def test_ideal_parts_are_as_configured(deployment: config.Deployment) -> None:
    pad = deployment.hands[0].pads[1]
    part = IDEAL.pad("right", pad)
    assert part.gain_ratio == (1, 1, 1, 1)
    assert part.series_ohm == pad.series_ohm
    assert part.gap_before_mm == part.gap_after_mm == (pad.gap_mm,) * 4
    assert IDEAL.contact(deployment.sheets["s"], 7).radius_mm == 2.0


def test_contact_radii_have_configured_spread(deployment: config.Deployment) -> None:
    radii = np.array(
        [
            WORLDS["default"]
            .only("parts", "contacts")
            .draw(1)
            .contact(deployment.sheets["s"], touch)
            .radius_mm
            for touch in range(2000)
        ]
    )
    assert radii.mean() == pytest.approx(2.0, abs=0.03)
    assert radii.std() == pytest.approx(0.4, rel=0.06)
    assert radii.min() > 0.5


def test_tolerances_shift_position_far_beyond_noise(deployment: config.Deployment) -> None:
    ideal = VirtualHand(deployment, press("flat"), IDEAL).truth(10.0)[0]
    real_hand = VirtualHand(deployment, press("flat"), WORLDS["default"].only("parts", "contacts").draw(4))
    pad = deployment.hands[0].pads[0]
    counts = np.mean([real_hand.sample(10 + k * 0.005)[0] for k in range(400)], axis=0)
    found = electrode_network(pad, deployment.sheets["s"]).estimate(counts * 10e-3 / 32767, 1e-6)
    off = np.linalg.norm(pad_surface(pad).point(found.x, found.y) - ideal.position_m)
    assert 2 * ideal.bound_m < off < 1e-3


def test_both_sheets_of_a_pad_are_pressed_by_one_contact_and_obey_their_own_laws() -> None:
    """Far from edges the total currents of both are those of the theory, for one force and radius."""
    deployment = config.load(shipped.path("two_sheets.toml"))
    hand = VirtualHand(deployment, press("thumb_tip", (0.5, 0.5), 1.0, 2.0), IDEAL)
    pad, node = deployment.pads[0].pad, deployment.nodes["five_channel"]
    counts = hand.all_counts(0, np.arange(1.0, 2.0, 0.01)).mean(axis=0)
    assert len(counts) == 5
    assert np.array_equal(hand.sample(1.0)[0], hand.all_counts(0, [1.0])[0])
    totals_a = np.array([counts[:4].sum(), counts[4]]) * node.full_scale_ma * 1e-3 / 32767
    network = pad_network(pad, deployment.sheets[pad.sheet])
    spreading_m = float(network.spreading_radius(network.a / 2, network.b / 2)) * 30e-3 / network.a
    sheets = [deployment.sheets[name] for name in ("steep", "even")]
    sandwich = Sandwich(
        (1e-6 * sheets[0].contact_ohm_mm2, 1e-6 * sheets[1].contact_ohm_mm2),
        (sheets[0].alpha, sheets[1].alpha),
        (sheets[0].ohm_per_square, sheets[1].ohm_per_square),
    )
    assert totals_a == pytest.approx(sandwich.currents(1.0, 2e-3, node.drive_v, spreading_m), rel=0.02)


def test_the_sheets_of_a_pad_differ_in_parts_and_behaviour() -> None:
    deployment = WORLDS["default"].draw(3).describe(config.load(shipped.path("two_sheets.toml")))
    hand = VirtualHand(deployment, press("thumb_tip"), WORLDS["default"].draw(3))
    first, second = hand.virtual_pads[0], hand.virtual_pads[2]
    assert second.is_total
    assert not first.is_total
    assert isinstance(first.circuit, PadCircuit)
    assert isinstance(second.circuit, PadCircuit)
    assert second.circuit.gaps != first.circuit.gaps
    assert second.sheet.ohm_per_square / 600.0 != first.sheet.ohm_per_square / 2400.0
    assert second.history is not first.history
    assert len(second.limits) == 1


def test_samples_of_both_sheets_equal_their_counts_with_errors_of_channels() -> None:
    deployment = config.load(shipped.path("two_sheets.toml"))
    world = dataclasses.replace(WORLDS["ideal"], electronics=WORLDS["harsh"].electronics).draw(5)
    hand = VirtualHand(deployment, press("thumb_tip", (0.4, 0.5), 3.0), world)
    for t_s in np.arange(1.0, 4.0, 0.3):
        assert np.array_equal(hand.sample(t_s)[0], hand.all_counts(0, [t_s])[0])
