"""Check of a design by the simulator: its own sheet solver, its own draws of a pad's parts.

Public name: `simulated_goal_map`.

The simulator solves each drawn pad by finite elements, which share nothing with `handtouch.field`. Positions
are then estimated from its currents, with noise, as the daemon does: by the weights V of the nominal pad.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from handtouch.arrays import FloatArray
from handtouch.design.deployed import pad_with_layout
from handtouch.design.goals import PAIR_SCORE, Goal, line_errors, misfit_weights
from handtouch.design.layout import ElectrodeLayout
from handtouch.design.pad_task import PadTask
from handtouch.design.response import ContactResponse, contact_response
from handtouch.simulate.coarse_sheet import uneven_sheet_maps
from handtouch.simulate.sheet_circuit import SheetCircuit, Wiring
from handtouch.simulate.sheet_solver import SheetMapBank
from handtouch.simulate.surfaces import simulated_surface
from handtouch.simulate.unevenness import Unevenness
from handtouch.simulate.virtual_pad import true_gaps
from handtouch.simulate.worlds import UNEVEN_MODES, DrawnWorld, Family, World

Shares = Callable[[FloatArray, FloatArray], FloatArray]

CHECKED_GOALS = ("position", "linearity", "two-contacts")
_RING = [2, 1, 3, 0]  # channels y0, xa, yb, x0 of the simulator's x0, xa, y0, yb
_ITERATIONS = 3
_NOISE_SAMPLES = 25  # samples of each drawn pad
_DIRECTIONS_RAD = np.arange(4) * np.pi / 4


def simulated_goal_map(
    task: PadTask,
    layout: ElectrodeLayout,
    goal: Goal,
    world: World,
    draws: int = 24,
    family: Family = Family.TUNING,
    on_progress: Callable[[str], None] = lambda _: None,
) -> FloatArray:
    """Return root mean squares of a goal (points, points) in its unit over drawn pads of a world.

    Raises ValueError for a goal not in `CHECKED_GOALS`, or a layout without one electrode on each side.
    """
    if goal.name not in CHECKED_GOALS:
        raise ValueError(f"goal {goal.name} isn't simulated; known: {', '.join(CHECKED_GOALS)}")
    response = contact_response(task, layout, with_bends=goal.name == "two-contacts")
    x, y = task.grid
    squares = np.zeros(len(x))
    for number in range(draws):
        on_progress(f"simulating pad {number + 1} of {draws}")
        drawn = world.draw(family.seed(number))
        shares = _channel_shares(task, layout, drawn)
        if goal.name == "two-contacts":
            squares += _pair_squares(task, layout, goal, response, shares)
            continue
        rng, currents = np.random.default_rng(number), shares(x, y).T
        for _ in range(_NOISE_SAMPLES):
            noise = rng.standard_normal((len(x), 4)) * (task.noise_a / response.total_a)[:, None]
            if goal.name == "linearity":
                found = line_errors(task, response.fractions, currents + noise)
            else:
                found = _position_squares(task, layout, response, currents + noise)
            squares += found / _NOISE_SAMPLES
    return goal.factor * np.sqrt(squares / draws).reshape(task.points, task.points)


def _channel_shares(task: PadTask, layout: ElectrodeLayout, drawn: DrawnWorld) -> Shares:
    """Return the function from positions (k,) on the rectangle to the channels' currents (4, k) per unit of
    current of a drawn pad."""
    pad = pad_with_layout(task, layout)
    hidden, shape = drawn.pad(task.hand, pad), drawn.surface(task.hand, pad)
    gaps = true_gaps(shape, hidden)
    maps = uneven_sheet_maps(shape, gaps, Unevenness(UNEVEN_MODES, hidden.unevenness))
    sheet = drawn.sheet(task.hand, pad, task.sheet)
    wiring = Wiring(np.array(hidden.series_ohm), task.node.drive_v, np.full(4, np.inf))
    circuit = SheetCircuit.from_wiring(maps.conductance, sheet.ohm_per_square, wiring)
    bank, nominal = SheetMapBank([maps]), simulated_surface(pad.surface)
    gains = np.array(hidden.gain_ratio)[:, None]

    def shares(x: FloatArray, y: FloatArray) -> FloatArray:
        along = nominal.project(task.surface.point(x, y).T).fraction.T
        values, _ = bank.look_up(np.zeros(len(x), np.intp), along[0], along[1])
        return np.asarray((gains * (circuit.share_to_channel @ values[:4]))[_RING])

    return shares


def _position_squares(
    task: PadTask, layout: ElectrodeLayout, response: ContactResponse, currents: FloatArray
) -> FloatArray:
    """Return squared errors [m^2] (k,) of positions estimated from currents (k, 4), by weighted least
    squares."""
    x, y = task.grid
    network = layout.network(task.boundary, task.sheet.ohm_per_square)
    scales = task.surface.scales(x, y)
    at, weights = np.stack([x, y]), np.linalg.inv(response.covariance)
    inset = 1e-3 * np.array([[task.surface.a], [task.surface.b]])
    for _ in range(_ITERATIONS):
        fractions, jacobian = network.fractions_with_jacobian(*at)
        columns = np.moveaxis(np.concatenate([jacobian, fractions[:, None]], axis=1), 2, 0)
        weighted = np.swapaxes(columns, 1, 2) @ weights
        right = np.einsum("kji,ki->kj", weighted, currents - fractions.T)
        step = np.linalg.solve(weighted @ columns, right[:, :, None])[:, :2, 0].T
        at = np.clip(at + step, inset, np.array([[task.surface.a], [task.surface.b]]) - inset)
    return np.asarray((((at - [x, y]) * scales) ** 2).sum(axis=0))


def _pair_squares(
    task: PadTask, layout: ElectrodeLayout, goal: Goal, response: ContactResponse, shares: Shares
) -> FloatArray:
    """Return squared separations [m^2] (k,) at which simulated pairs of contacts have the score sought."""
    x, y = task.grid
    separation = goal.compute(task, layout)
    scale = np.sqrt(np.prod(task.surface.scales(x, y), axis=0))
    near = np.minimum(np.minimum(x, task.surface.a - x), np.minimum(y, task.surface.b - y))
    tried = np.minimum(separation / scale, near)  # the pair's distance on the rectangle
    alone, weights, scores = shares(x, y).T, misfit_weights(response), np.zeros(len(x))
    for angle in _DIRECTIONS_RAD:
        half_x, half_y = tried / 2 * np.cos(angle), tried / 2 * np.sin(angle)
        pair = (shares(x + half_x, y + half_y) + shares(x - half_x, y - half_y)).T / 2
        scores += np.einsum("ki,kij,kj->k", pair - alone, weights, pair - alone) / len(_DIRECTIONS_RAD)
    # the score grows with the square of the separation
    return np.asarray((tried * scale) ** 2 * PAIR_SCORE / np.sqrt(scores))
