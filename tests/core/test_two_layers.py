"""Pads of two films: the map against films solved by finite volumes, and contacts by the stages."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.config import Deployment, parse, shipped
from handtouch.core.memory import view_memory
from handtouch.core.pad_model import PadModel
from handtouch.core.stages.rows import VALUE_COUNT, VALUE_SLICES
from handtouch.core.stages.solve import ContactSolver
from handtouch.field.channel_map import ChannelMap
from handtouch.field.surface import PlaneSurface
from handtouch.field.two_layers import TwoLayers
from handtouch.simulate.contact_patch import discs
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.two_layers import TwoLayerCircuit
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, DrawnWorld, Family

FloatArray = NDArray[np.float64]
TOUCH = (ScenarioTouch(link="tip", from_s=0.0, duration_s=1.0, path=((0.5, 0.5),), force_n=(1.0,)),)


@pytest.fixture(scope="module")
def deployment() -> Deployment:
    """Return films whose leads are known."""
    text = shipped.path("two_layers.toml").read_text(encoding="utf-8")
    return parse(text.replace("alpha = 1.2\n", "alpha = 1.2\nlead_std_ohm = 0.0\n"))


@pytest.fixture(scope="module")
def model(deployment: Deployment) -> PadModel:
    return PadModel(deployment)


def circuit(deployment: Deployment, row: int, world: DrawnWorld | None = None) -> TwoLayerCircuit:
    drawn = world or WORLDS["ideal"].draw(Family.TUNING.seed(1))
    found = VirtualHand(deployment, Scenario(touch=TOUCH), drawn).virtual_pads[row].circuit
    assert isinstance(found, TwoLayerCircuit)
    return found


@pytest.mark.parametrize("row", [0, 1])
def test_films_solved_by_finite_volumes_have_the_map_and_the_radii(
    deployment: Deployment, model: PadModel, row: int
) -> None:
    solved, network = circuit(deployment, row), model.networks[row]
    s, t = np.array([[0.5, 0.5], [0.2, 0.7], [0.9, 0.1]]).T
    x, y = s * network.a, t * network.b
    shares = np.stack([table.ev(s, t) for table in solved.tables])
    assert shares == pytest.approx(network.fractions(x, y), abs=1e-6)
    assert isinstance(network, TwoLayers)
    scale = network.surface.scale(x, y)
    assert np.exp(solved.log_radius.ev(s, t)) == pytest.approx(
        network.spreading_radius(x, y) * scale, rel=5e-3
    )


@pytest.mark.parametrize("row", [0, 1])
def test_contacts_are_found_where_they_are_solved(deployment: Deployment, model: PadModel, row: int) -> None:
    solved, network = circuit(deployment, row), model.networks[row]
    for s, t, force_n in ((0.5, 0.5, 1.0), (0.25, 0.7, 0.3), (0.8, 0.35, 4.0)):
        signals = solved.signals(np.array([[s], [t]]), discs(np.array([2.5e-3])), np.array([force_n]))[0]
        assert signals[:2].sum() == pytest.approx(signals[2:].sum())
        currents, values = np.zeros((model.size, 4)), np.full((model.size, VALUE_COUNT), np.nan)
        currents[row] = signals
        solver = ContactSolver(model, currents, np.zeros(model.size), np.ones(model.size, np.bool_), values)
        solver.solve_contacts(view_memory(np.array([row])))
        x, y = values[row, VALUE_SLICES["xy"]]
        assert (x / network.a, y / network.b) == pytest.approx((s, t), abs=4e-3)
        assert values[row, VALUE_SLICES["force_n"]][0] == pytest.approx(force_n, rel=0.06)


def test_two_contacts_have_the_centroid_of_their_currents(model: PadModel) -> None:
    network = model.networks[1]
    one, other = ((0.2, 0.3), 1.0), ((0.8, 0.9), 2.0)
    currents = np.zeros((model.size, 4))
    for (s, t), current in (one, other):
        currents[1] += 5e-5 * current * network.fractions(s * network.a, t * network.b)
    values = np.full((model.size, VALUE_COUNT), np.nan)
    solver = ContactSolver(model, currents, np.zeros(model.size), np.zeros(model.size, np.bool_), values)
    solver.solve_contacts(view_memory(np.array([1])))
    x, y = values[1, VALUE_SLICES["xy"]]
    assert (x / network.a, y / network.b) == pytest.approx((0.6, 0.7), abs=2e-3)


def test_leads_move_contacts_towards_the_middle_as_in_the_solved_films(deployment: Deployment) -> None:
    pad = deployment.pads[1].pad
    leads = pad.response.model_copy(update={"lead_ohm": (30.0, 10.0, 0.0, 20.0)})  # type: ignore[union-attr]
    (hand,) = deployment.hands
    pads = (hand.pads[0], pad.model_copy(update={"response": leads}))
    changed = deployment.model_copy(update={"hands": (hand.model_copy(update={"pads": pads}),)})
    network = leads.build(pad.surface.build())
    assert isinstance(network, TwoLayers)
    tables = circuit(changed, 1).tables
    for s, t in ((0.1, 0.9), (0.5, 0.5)):
        solved = np.array([table.ev(np.array(s), np.array(t)) for table in tables])
        assert network.fractions(s * network.a, t * network.b) == pytest.approx(solved, abs=1e-6)
    assert network.fractions(0.0, 0.0)[1] > 0.02


@pytest.mark.parametrize("world", ["default", "harsh"])
def test_gaps_and_uneven_films_are_in_the_tolerances(deployment: Deployment, world: str) -> None:
    scores = []
    for seed in range(16):
        drawn = WORLDS[world].draw(Family.TUNING.seed(seed))
        stated = drawn.describe(deployment)
        network = PadModel(stated).networks[0]
        assert isinstance(network, ChannelMap)
        s, t = (at.ravel() for at in np.meshgrid(np.linspace(0.15, 0.85, 5), np.linspace(0.2, 0.8, 5)))
        shares = np.stack([table.ev(s, t) for table in circuit(stated, 0, drawn).tables])
        x, y = s * network.a, t * network.b
        slopes = network.variation_slopes(x, y)[:, [1, 3]]
        errors = (shares - network.fractions(x, y))[[1, 3]]
        covariance = np.einsum("vik,vjk->kij", slopes, slopes)
        squares = np.einsum("ik,ik->k", errors, np.linalg.solve(covariance, errors.T[:, :, None])[:, :, 0].T)
        scores.append(squares.mean() / len(errors))
    assert 0.6 < np.mean(scores) < 1.7  # 1 by Gaussian parts as large as stated, +- 0.3


def test_unknown_leads_are_no_less_than_nothing() -> None:
    surface, stated = PlaneSurface(0.06, 0.02), (0.0, 3.0, 20.0, 0.0)
    network = TwoLayers(surface, 400.0, 2.5e-3, stated, lead_std_ohm=3.0)
    x, y = np.array([[0.0, 0.02, 0.06], [0.01, 0.0, 0.02]])
    draws = np.random.default_rng(3).normal(stated, 3.0, (60_000, 4))
    leads = draws[(draws >= 0).all(axis=1)]
    shares = []
    for share, ohm, of_film in ((x / 0.06, 1200.0, leads[:, :2]), (y / 0.02, 400 / 3, leads[:, 2:])):
        shares.append((of_film[:, :1] + ohm * share) / (ohm + of_film.sum(axis=1, keepdims=True)))
    found = network.fractions(x, y)[[1, 3]]
    assert found == pytest.approx(np.mean(shares, axis=1), abs=5e-4)
    slopes = network.variation_slopes(x, y)[:, [1, 3]]
    assert np.sqrt(np.square(slopes).sum(axis=0)) == pytest.approx(np.std(shares, axis=1), rel=0.06)
