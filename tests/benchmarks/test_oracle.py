"""The oracle of benchmarks: against the simulator's own bound, and growing with what is hidden."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.bench_worlds import contact_noise_a, learn
from benchmarks.hand_touches import REST_S, SAMPLE_S, STEP_S, draw_touches
from benchmarks.oracle import OracleCovariances, PadOracle
from handtouch import config
from handtouch.config import load, shipped
from handtouch.core.stages.rows import VALUE_COUNT, VALUE_SLICES
from handtouch.core.stages.solve import ContactSolver
from handtouch.daemon.table_cache import build_pad_model
from handtouch.hand import pad_surface
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.truth import GroundTruth
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import (
    WORLDS,
    ContactSpread,
    DrawnWorld,
    Family,
    Fixed,
    MountSpread,
    Normal,
    PartSpread,
    Uniform,
    World,
)

PLACES = ((0.5, 0.5), (0.2, 0.7), (0.65, 0.35))
FORCE_N = 2.0
LIGHT_N = 0.3  # whose current is even, as the oracle has it


EVEN = {
    "crowding": False,
    **dict.fromkeys(("contact_elongation_std", "contact_tilt_std", "unevenness_std"), 0.0),
}


@pytest.fixture(scope="module")
def deployment() -> config.Deployment:
    """One curved pad of the shipped hand, with even sheets and contacts, as the oracle has them."""
    whole = load(shipped.path("utah_mit.toml"))
    (hand,) = whole.hands
    pads = tuple(pad for pad in hand.pads if pad.link == "index_distal")
    sheets = {name: sheet.model_copy(update=EVEN) for name, sheet in whole.sheets.items()}
    nodes = {name: node.model_copy(update={"series_std_ohm": 0.0}) for name, node in whole.nodes.items()}
    hands = (hand.model_copy(update={"pads": pads}),)
    return whole.model_copy(update={"hands": hands, "sheets": sheets, "nodes": nodes})


def world(parts: PartSpread, contacts: ContactSpread | None = None) -> DrawnWorld:
    made = World("of a test", parts, contacts=contacts or ContactSpread())
    return made.draw(Family.TUNING.seed(3))


def truths(deployment: config.Deployment, drawn: DrawnWorld, force_n: float = FORCE_N) -> list[GroundTruth]:
    touches = tuple(
        ScenarioTouch(link="index_distal", from_s=k * 1.0, duration_s=0.9, path=(place,), force_n=(force_n,))
        for k, place in enumerate(PLACES)
    )
    hand = VirtualHand(deployment, Scenario(touch=touches), drawn)
    return [truth for k in range(len(PLACES)) for truth in hand.truth(k + 0.45)]


def covariances(
    deployment: config.Deployment, drawn: DrawnWorld, found: list[GroundTruth], contacts_before: int = 0
) -> OracleCovariances:
    ((hand, pad),) = deployment.pads
    noise_a = build_pad_model(deployment).noise_a[0]
    oracle = PadOracle.build(drawn, deployment, hand, pad, noise_a)
    if contacts_before:
        place = np.random.default_rng(1).uniform(0.1, 0.9, (2, contacts_before))
        size = np.array([[oracle.surface.a], [oracle.surface.b]])
        at_m = oracle.surface.from_rectangle(*(size * place))
        oracle = oracle.with_contacts(np.stack([*at_m, np.full(contacts_before, FORCE_N)]), noise_a)
    u, v = np.array([(truth.u_m, truth.v_m) for truth in found]).T
    return oracle.covariances(u, v, np.array([truth.force_n for truth in found]))


def test_without_hidden_quantities_it_is_the_simulators_own_bound(deployment: config.Deployment) -> None:
    """Electrodes and sheet as configured; the bound is of finite elements, the oracle of the theory."""
    drawn = world(PartSpread())
    found = truths(deployment, drawn, LIGHT_N)
    stated = covariances(deployment, drawn, found)
    rms_m = np.sqrt(np.trace(stated.position_m2, axis1=1, axis2=2))
    assert rms_m == pytest.approx([truth.bound_m for truth in found], rel=0.02)
    assert np.sqrt(stated.force_n2[:, 0, 0]) == pytest.approx(stated.force_bound_n)


def test_it_evaluates_at_the_true_parts(deployment: config.Deployment) -> None:
    """Wider gaps on one side than the file says change the bound as in the simulator."""
    drawn = world(PartSpread(gap_offset_mm=Uniform(0.0, 1.5)))
    found = truths(deployment, drawn, LIGHT_N)
    ((hand, pad),) = deployment.pads
    known = replace(drawn, world=World("known"))
    oracle = PadOracle(
        pad, deployment.sheets[pad.sheet], drawn.pad(hand, pad), deployment.nodes[pad.node].drive_v,
        build_pad_model(deployment).noise_a[0], {},
    )  # fmt: skip
    u, v = np.array([(truth.u_m, truth.v_m) for truth in found]).T
    stated = oracle.covariances(u, v, np.full(len(found), LIGHT_N))
    rms_m = np.sqrt(np.trace(stated.position_m2, axis1=1, axis2=2))
    assert rms_m == pytest.approx([truth.bound_m for truth in found], rel=0.02)
    nominal = covariances(deployment, known, found)
    assert np.abs(np.trace(nominal.position_m2, axis1=1, axis2=2) / rms_m**2 - 1).max() > 0.02


def test_hidden_gains_widen_positions_until_contacts_determine_them(deployment: config.Deployment) -> None:
    drawn = world(PartSpread(gain_ratio=Uniform(0.98, 1.02)))
    found = truths(deployment, world(PartSpread()))
    none, few, many = (
        np.trace(covariances(deployment, drawn, found, contacts).position_m2, axis1=1, axis2=2)
        for contacts in (0, 32, 2048)
    )
    known = np.trace(covariances(deployment, world(PartSpread()), found).position_m2, axis1=1, axis2=2)
    assert (none > 10 * few).all()
    assert (few > many).all()
    assert many == pytest.approx(known, rel=0.05)


def test_no_number_of_contacts_measures_a_pads_size(deployment: config.Deployment) -> None:
    """Fractions go with the ratio of the sides: one of the two remains as uncertain as it was."""
    drawn = world(PartSpread(length_offset_mm=Uniform(-0.1, 0.1)))
    found = truths(deployment, world(PartSpread()))[1:2]
    ((_, pad),) = deployment.pads
    surface = pad_surface(pad)
    wider = world(PartSpread(length_offset_mm=Uniform(-0.1, 0.1), width_offset_mm=Uniform(-0.1, 0.1)))
    alone, both = (covariances(deployment, one, found, 2048).position_m2[0] for one in (drawn, wider))
    share = (found[0].u_m - surface.extent_m[0] / 2) / surface.extent_m[0]
    assert both[0, 0] > (0.5 * share * 0.1e-3 / np.sqrt(3)) ** 2
    assert both[0, 0] > 4 * alone[0, 0]


def test_a_hidden_radius_widens_forces_up_to_what_the_contact_layer_alone_would(
    deployment: config.Deployment,
) -> None:
    """Force goes with the radius to the power 2 - 2 / alpha where the layer dominates, else with less."""
    ((_, pad),) = deployment.pads
    sheet = deployment.sheets[pad.sheet]
    found = truths(deployment, world(PartSpread()))
    narrow, wide = (
        covariances(
            deployment, world(PartSpread(), ContactSpread(radius_sigma=Normal(0.0, std))), found
        ).force_n2[:, 0, 0]
        ** 0.5
        for std in (0.1, 0.2)
    )
    layer_alone = (2 - 2 / sheet.alpha) * 0.1 * sheet.contact_radius_std_mm / sheet.contact_radius_mm
    assert (narrow < 1.01 * layer_alone * FORCE_N).all()
    assert (narrow > 0.1 * layer_alone * FORCE_N).all()
    assert wide == pytest.approx(2 * narrow, rel=0.01)


def test_positions_are_nearly_as_certain_as_can_be_after_32_contacts(deployment: config.Deployment) -> None:
    """Median of the stated standard deviations, by the oracle's that got the same contacts."""
    default = WORLDS["default"]
    even = replace(
        default,
        mounts=MountSpread(),
        parts=replace(default.parts, lead_ohm=Fixed(0.0)),
        contacts=ContactSpread(radius_sigma=Normal(0.0, 1.0)),
    )
    drawn = even.draw(Family.TUNING.seed(4))
    described = drawn.describe(deployment)
    ((hand_name, pad),) = described.pads
    model, touches = build_pad_model(described), draw_touches(["index_distal"], 80, drawn.seed)
    hand = VirtualHand(described, Scenario(touch=touches), drawn)
    (learnt,) = learn(hand, described, model, 0, range(80), (32,))
    assert learnt.calibration is not None
    at = [truth for k in learnt.touches for truth in hand.truth(REST_S + k * STEP_S + SAMPLE_S)]
    u, v, force_n = np.array([(truth.u_m, truth.v_m, truth.force_n) for truth in at]).T
    oracle = PadOracle.build(drawn, described, hand_name, pad, model.noise_a[0])
    best = oracle.with_contacts(np.stack([u, v, force_n]), contact_noise_a(model, 0))
    model.set_calibration(0, learnt.calibration)
    currents_a, values = np.zeros((1, 4)), np.full((1, VALUE_COUNT), np.nan)
    solver = ContactSolver(model, currents_a, np.zeros(1), np.ones(1, np.bool_), values)
    stated = []
    for truth in at:
        values[:] = np.nan
        currents_a[0] = model.gains[0] * truth.currents_a
        solver.solve_contacts(np.arange(1).data)
        stated.append(np.trace(values[0, VALUE_SLICES["covariance_m2"]].reshape(3, 3)))
    least = np.trace(best.covariances(u, v, force_n).position_m2, axis1=1, axis2=2)
    assert 1.0 < np.median(np.sqrt(stated)) / np.median(np.sqrt(least)) < 1.24
