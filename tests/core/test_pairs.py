"""Two contacts at once on a pad of six electrodes: reported where the currents support them, else not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch import config, wire
from handtouch.config import load, shipped
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.core.slab import ChannelField
from handtouch.core.stages.rows import PART_COUNT, PART_SLICES, PARTS_COUNT, VALUE_COUNT
from handtouch.core.stages.solve import ContactSolver
from handtouch.daemon.table_cache import build_pad_model
from handtouch.hand import pad_surface
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, Family

FloatArray = NDArray[np.float64]
PAD, PERIOD_NS = 1, 10_000_000


class Collector:
    """Subscriber to contacts that keeps them by time."""

    def __init__(self) -> None:
        self.payloads: list[bytes] = []
        self.contacts: list[wire.Contact] = []

    def has_subscriber(self, topic: str) -> bool:
        return topic == "contact/finger/middle"

    def send(self, message: Any) -> None:
        parts = wire.encode(message)
        self.payloads.append(parts[1])
        contact = wire.decode(parts)
        assert isinstance(contact, wire.Contact)
        self.contacts.append(contact)


def deployment(**sheet: float) -> config.Deployment:
    """Return the shipped finger without tolerances, with other keys of its sheet."""
    drawn = WORLDS["ideal"].draw(Family.TUNING.seed(0)).describe(load(shipped.path("electrodes.toml")))
    stated = drawn.sheets["soft"].model_copy(update={"contact_radius_std_mm": 0.0, **sheet})
    return drawn.model_copy(update={"sheets": {"soft": stated}})


@pytest.fixture(scope="module")
def model() -> PadModel:
    return build_pad_model(deployment())


def solved(model: PadModel, currents: FloatArray) -> FloatArray:
    """Return the two contacts (k, 2, PART_COUNT) of each of k samples of the pad's six currents (k, 6)."""
    every, values = np.zeros((model.size, 6)), np.full((model.size, VALUE_COUNT), np.nan)
    parts = np.full((model.size, PARTS_COUNT), np.nan)
    solver = ContactSolver(model, every, np.zeros(model.size), np.ones(model.size, np.bool_), values, parts)
    found = []
    for row in currents:
        every[PAD], values[:] = row, np.nan
        solver.solve_contacts(np.array([PAD]).data)
        found.append(parts[PAD].reshape(2, PART_COUNT).copy())
    return np.array(found)


def currents_of(model: PadModel, x: FloatArray, y: FloatArray, totals: FloatArray) -> FloatArray:
    """Return noisy currents (k, 6) of k samples of contacts (k, contacts) on sides of 0 to 1."""
    network, rng = model.networks[PAD], np.random.default_rng(5)
    fractions = network.fractions(x * network.a, y * network.b)
    exact = (fractions * totals).sum(axis=2).T
    return np.asarray(exact + model.noise_a[PAD] * rng.normal(size=exact.shape))


def squared_deviations(part: FloatArray, position_m: FloatArray) -> float:
    """Return the squared error along the surface, in units of the stated covariance."""
    variance, axes = np.linalg.eigh(part[6:15].reshape(3, 3))
    return float(np.sum((axes.T @ (part[:3] - position_m))[1:] ** 2 / variance[1:]))


def test_two_currents_far_from_each_other_are_located_within_their_covariance(model: PadModel) -> None:
    rng = np.random.default_rng(3)
    x = np.stack([rng.uniform(0.1, 0.3, 200), rng.uniform(0.65, 0.85, 200)], axis=1)
    y, totals = rng.uniform(0.2, 0.8, (200, 2)), 10 ** rng.uniform(-3.3, -2.7, (200, 2))
    found, network = solved(model, currents_of(model, x, y, totals)), model.networks[PAD]
    accepted = np.isfinite(found[:, 0, 0])
    assert accepted.mean() > 0.9
    surface = pad_surface(deployment().pads[PAD].pad)
    true_m = np.moveaxis(surface.point(x * network.a, y * network.b), 0, -1)
    deviations = []
    for parts, truth in zip(found[accepted], true_m[accepted], strict=True):
        both = [[squared_deviations(part, at) for part, at in zip(parts, truth[order], strict=True)]
                for order in ([0, 1], [1, 0])]  # fmt: skip
        deviations += min(both, key=sum)
    assert np.mean(np.array(deviations) < 5.99) > 0.9  # 95 %


@pytest.mark.parametrize("length_mm", [0.0, 4.0, 10.0])
def test_one_contact_is_reported_as_two_no_more_often_than_stated(model: PadModel, length_mm: float) -> None:
    """Lines of any direction, up to the length that the sheet states."""
    rng, count, network = np.random.default_rng(4), 3000, model.networks[PAD]
    surface = pad_surface(deployment().pads[PAD].pad)
    at = rng.uniform(0.02, 0.98, (2, count)) * [[network.a], [network.b]]
    length = 1e-3 * length_mm / np.asarray(surface.scale(*at))
    direction = rng.uniform(0, np.pi, count)
    along = np.linspace(-0.5, 0.5, 9)[None, :] * length[:, None]
    x, y = (
        at[0][:, None] + along * np.cos(direction)[:, None],
        at[1][:, None] + along * np.sin(direction)[:, None],
    )
    inside = (x.min(1) > 0) & (x.max(1) < network.a) & (y.min(1) > 0) & (y.max(1) < network.b)
    totals = np.repeat(10 ** rng.uniform(-4, -2.5, (count, 1)) / 9, 9, axis=1)
    currents = currents_of(model, x[inside] / network.a, y[inside] / network.b, totals[inside])
    accepted = int(np.isfinite(solved(model, currents)[:, 0, 0]).sum())
    assert inside.sum() > 1000
    assert accepted <= 1e-3 * inside.sum() + 3 * np.sqrt(1e-3 * inside.sum())


def test_no_pair_is_reported_at_a_false_alarm_rate_of_zero() -> None:
    never = build_pad_model(deployment(pair_false_alarm=0.0))
    x, y = np.array([[0.2, 0.8]]), np.array([[0.5, 0.5]])
    assert np.isnan(solved(never, currents_of(never, x, y, np.full((1, 2), 2e-3)))).all()


def play(pipeline: Pipeline, counts: NDArray[np.int64], first: int) -> None:
    """Run a tick for each row of counts (ticks, pads, 6)."""
    for tick, rows in enumerate(counts.astype("<i2"), first):
        t_ns = PERIOD_NS * (1 + tick)
        pipeline.begin_cycle(t_ns, t_ns)
        for pad, row in enumerate(rows):
            for number in range(2 if pad == PAD else 1):
                data = row[4 * number : 4 * number + 4].tobytes().ljust(8, b"\0")
                pipeline.slab.write_pdo(pad, data, t_ns + 1, number)
        pipeline.tick_if_due(t_ns + PERIOD_NS)
        pipeline.prepare_next_tick()


def pipeline_of(model: PadModel, sink: Collector) -> Pipeline:
    """Return a pipeline of the finger, all nodes operational."""
    pipeline = Pipeline(model, PERIOD_NS, 0.6, sink)
    pipeline.node_state[:] = wire.PadState.CLEAR
    for pad, electrodes in enumerate(model.electrodes):
        layout = tuple(ChannelField(k // 4, 16 * (k % 4), 16, True) for k in range(len(electrodes)))
        pipeline.slab.set_layout(pad, layout)
    return pipeline


@pytest.fixture(scope="module")
def presses() -> tuple[VirtualHand, NDArray[np.int64]]:
    """Two presses on the simulated finger, which overlap in time, and their counts (ticks, pads, 6)."""
    touches = tuple(
        ScenarioTouch(link="middle", from_s=begin_s, duration_s=0.6, path=(at,), force_n=(force_n,))
        for begin_s, at, force_n in ((1.0, (0.2, 0.5), 1.0), (1.1, (0.8, 0.4), 1.5))
    )
    hand = VirtualHand(deployment(), Scenario(touch=touches), WORLDS["ideal"].draw(Family.TUNING.seed(0)))
    times = 1e-9 * PERIOD_NS * np.arange(200)
    counts = np.zeros((len(times), 2, 6), np.int64)
    for pad, channels in enumerate((3, 6)):
        counts[:, pad, :channels] = hand.counts(pad, times)
    return hand, counts


def test_two_simulated_presses_are_published_with_positions_forces_and_covariances(
    model: PadModel, presses: tuple[VirtualHand, NDArray[np.int64]]
) -> None:
    hand, counts = presses
    sink = Collector()
    play(pipeline_of(model, sink), counts, 0)
    together = next(contact for contact in sink.contacts if contact.t_ns == PERIOD_NS * 151)
    truths = hand.truth(1.5)
    assert len(together.parts) == len(truths) == 2
    assert together.position_status == "unreliable"
    for part, truth in zip(
        sorted(together.parts, key=lambda part: part["position_m"][0]), truths, strict=True
    ):
        row = np.concatenate([part["position_m"], part["normal"], part["covariance_m2"]])
        assert squared_deviations(row, np.array(truth.position_m)) < 13.8  # 99.9 %
        assert part["force_n"] == pytest.approx(truth.force_n, rel=0.03)
        assert 0 < (part["force_std_n"] or 0.0) < 0.05
    alone = next(contact for contact in sink.contacts if contact.t_ns == PERIOD_NS * 109)
    assert alone.parts == ()
    assert sink.contacts[-1].event == "end"


def test_two_contacts_keep_their_order_and_ids_through_samples_with_one(model: PadModel) -> None:
    """Alternating starts of the search find them in either order; one of them is far stronger at times."""
    network, rng = model.networks[PAD], np.random.default_rng(3)
    every, values = np.zeros((model.size, 6)), np.full((model.size, VALUE_COUNT), np.nan)
    parts = np.full((model.size, PARTS_COUNT), np.nan)
    solver = ContactSolver(model, every, np.zeros(model.size), np.ones(model.size, np.bool_), values, parts)
    x, y = np.array([0.25, 0.75]) * network.a, np.array([0.3, 0.7]) * network.b
    found, fractions = [], network.fractions(x, y).T
    for step in range(300):
        alone = step % 50 > 40
        totals = np.array([1.5e-3, 0.0 if alone else 1.5e-3 * rng.uniform(0.4, 1.6)])[:: (-1) ** (step // 50)]
        every[PAD] = totals @ fractions + rng.normal(0, 1, 6) / model.weight[PAD]
        solver.solve_contacts(np.array([PAD]).data)
        both = parts[PAD].reshape(2, PART_COUNT)
        if np.isfinite(both[0, 0]):
            found.append(np.concatenate([both[:, PART_SLICES["id"].start], both[:, 0]]))
    history = np.array(found)
    assert len(history) > 200
    assert (history[:, :2] == history[0, :2]).all()
    assert set(history[0, :2]) == {1.0, 2.0}
    order = history[:, 2] < history[:, 3]
    assert order.all() or not order.any()


def test_a_contact_at_another_place_has_another_id(model: PadModel) -> None:
    network = model.networks[PAD]
    every, values = np.zeros((model.size, 6)), np.full((model.size, VALUE_COUNT), np.nan)
    parts = np.full((model.size, PARTS_COUNT), np.nan)
    solver = ContactSolver(model, every, np.zeros(model.size), np.ones(model.size, np.bool_), values, parts)
    seen = []
    for place in ((0.8, 0.8), None, (0.8, 0.2)):
        for _ in range(5):
            x, y = [0.2, *([place[0]] if place else [])], [0.5, *([place[1]] if place else [])]
            fractions = network.fractions(np.array(x) * network.a, np.array(y) * network.b)
            every[PAD] = 1.5e-3 * fractions.sum(axis=1)
            solver.solve_contacts(np.array([PAD]).data)
        seen.append(parts[PAD].reshape(2, PART_COUNT)[:, PART_SLICES["id"].start].tolist())
    stays = set(seen[0]) & set(seen[2])
    assert len(stays) == 1
    assert max(seen[2]) == 3.0


def test_two_contacts_are_the_same_after_their_state_was_saved_and_loaded(
    model: PadModel, presses: tuple[VirtualHand, NDArray[np.int64]]
) -> None:
    counts, sinks = presses[1][:155], (Collector(), Collector())
    whole = pipeline_of(model, sinks[0])
    play(whole, counts[:140], 0)
    saved = whole.save_state()
    sinks[0].payloads.clear()
    play(whole, counts[140:], 140)
    again = pipeline_of(model, sinks[1])
    again.load_state(saved, whole.state.layout())
    play(again, counts[139:], 139)  # a pipeline skips its first cycle, which has been processed
    assert len(sinks[0].contacts[-1].parts) == 2
    assert sinks[1].payloads
    assert sinks[0].payloads == sinks[1].payloads
    assert whole.state.parts.tobytes() == again.state.parts.tobytes()


def test_the_two_contacts_have_palm_and_base_positions_where_their_contact_has(
    model: PadModel, presses: tuple[VirtualHand, NDArray[np.int64]]
) -> None:
    pipeline = pipeline_of(model, Collector())
    play(pipeline, presses[1][:152], 0)
    held = pipeline.state
    held.palm_requested[PAD] = held.base_requested[PAD] = True
    held.palm_status[PAD], held.base_status[PAD] = wire.FrameStatus.VALID, wire.FrameStatus.STALE
    held.palm_values[PAD], held.part_frames[PAD] = np.arange(31.0), np.arange(100.0, 160.0)
    contact = published_contact(pipeline)
    for number, part in enumerate(contact.parts):
        first = 100.0 + 30.0 * number
        assert part["palm_position_m"] == [first, first + 1, first + 2]
        assert part["palm_normal"] == [first + 3, first + 4, first + 5]
        assert part["palm_covariance_m2"] == [first + 6 + k for k in range(9)]
        assert not [key for key in part if key.startswith("base")]
    held.base_status[PAD] = wire.FrameStatus.VALID
    contact = published_contact(pipeline)
    assert contact.parts[1]["base_normal"] == [148.0, 149.0, 150.0]
    assert set(contact.parts[0]) == set(wire.ContactPart.__annotations__)


def published_contact(pipeline: Pipeline) -> wire.Contact:
    """Return the contact that a late subscriber gets."""
    message = pipeline.messages.retained_messages()["contact/finger/middle"](10**10)
    assert message is not None
    contact = wire.decode(wire.encode(message))
    assert isinstance(contact, wire.Contact)
    return contact
