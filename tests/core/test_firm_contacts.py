"""Firm contacts beside electrodes, whose current exceeds what a channel measures."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.config import Behaviour, load, shipped
from handtouch.core.channel_currents import ChannelCurrents
from handtouch.core.columns import TickResult
from handtouch.core.pad_model import contact_law, law_of
from handtouch.core.pipeline import run_tick
from handtouch.core.slab import Cycle, Slab
from handtouch.core.tick import TickProcessor
from handtouch.daemon.table_cache import build_pad_model
from handtouch.hand import pad_surface
from handtouch.wire import ForceStatus, PadState, PositionStatus

PERIOD_NS = 5_000_000
TOP, NOISE_COUNTS = 32767, 1.0
MAX_FORCE_N = 20.0
RAMP = (0.05, 0.2, 0.5, 0.8, 1.0, 1.0, 1.0, 0.6, 0.3, 0.1)  # of the force; then it is released
ANGLES = 2 * np.pi * np.arange(12) / 12
DISC = np.array(
    [[r * np.cos(ANGLES), r * np.sin(ANGLES)] for r in (0.35, 0.61, 0.79, 0.93)]
)  # of equal areas


class Hand:
    """The hand of config/utah_mit.toml, pressed by discs of uniform current at places (n, 2) of its pads."""

    def __init__(self, seed: int, **of_sheets: object) -> None:
        deployment = load(shipped.path("utah_mit.toml"))
        described = {name: sheet.model_copy(update=of_sheets) for name, sheet in deployment.sheets.items()}
        self.deployment = deployment.model_copy(update={"sheets": described})
        self.model = build_pad_model(self.deployment)
        self.pads = [pad for _, pad in self.deployment.pads]
        self.surfaces = [pad_surface(pad) for pad in self.pads]
        self.size, self.rng = self.model.size, np.random.default_rng(seed)
        self.slab, self.cycle = Slab(self.size), Cycle(PERIOD_NS, 0.6)
        self.tick, self.t_ns = TickProcessor(self.model, PERIOD_NS), 10**9
        for _ in range(40):
            self.step(np.zeros((self.size, 4)))

    def step(self, counts: NDArray[np.float64]) -> TickResult:
        self.t_ns += PERIOD_NS
        self.slab.begin_cycle(self.t_ns)
        self.cycle.begin_cycle(self.t_ns)
        read = np.rint(counts + self.rng.normal(0, NOISE_COUNTS, counts.shape))
        for pad, row in enumerate(np.clip(read, -TOP - 1, TOP).astype("<i2")):
            self.slab.write_pdo(pad, row.tobytes(), self.t_ns + 1000)
        result = run_tick(self.tick, self.slab, np.zeros(self.size, np.uint8), self.cycle)
        self.tick.prepare_next_tick()
        return result

    def counts(self, at: NDArray[np.float64], force_n: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the counts (n, 4) of a contact on each pad; `centres` (n, 2) are those of its current."""
        self.centres = np.zeros((self.size, 2))
        counts = np.zeros((self.size, 4))
        for row, (network, pad) in enumerate(zip(self.model.networks, self.pads, strict=True)):
            sheet, node = self.deployment.sheets[pad.sheet], self.deployment.nodes[pad.node]
            x, y = at[row] * (network.a, network.b)
            scale_x, scale_y = (float(scale) for scale in self.surfaces[row].scales(x, y))
            radius_m = 1e-3 * sheet.contact_radius_mm
            low, high = 1e-6, 1 - 1e-6
            along = np.clip(x + radius_m / scale_x * DISC[:, 0], low * network.a, high * network.a)
            across = np.clip(y + radius_m / scale_y * DISC[:, 1], low * network.b, high * network.b)
            fractions = network.fractions(along, across).mean(axis=(1, 2))
            self.centres[row] = along.mean(), across.mean()
            spreading_m = float(network.spreading_radius(x, y)) * np.sqrt(scale_x * scale_y)
            total_a = contact_law(sheet, law_of(sheet)).current(
                force_n[row], node.drive_v, sheet.ohm_per_square, spreading_m
            )
            counts[row] = fractions * total_a / self.model.ampere_per_count[row]
        return counts


def test_no_contact_ends_or_loses_its_values_because_it_is_firm() -> None:
    """675 presses up to `max_force_n` anywhere on the pads, through the limit and back."""
    hand, bounds, saturated = Hand(1), [], 0
    for _ in range(45):
        at = hand.rng.uniform(0.002, 0.998, (hand.size, 2))
        force_n = hand.rng.uniform(1.0, MAX_FORCE_N, hand.size)
        begun = np.zeros(hand.size, dtype=np.int64)
        for share in RAMP:
            result = hand.step(hand.counts(at, share * force_n))
            begun[result.began] += 1
            assert not len(result.ended)
            columns = hand.tick.columns
            if share == 1.0:
                assert (columns.state == PadState.TOUCHED).all()
                assert np.isfinite(columns.position_m).all()
                assert np.isfinite(columns.force_n).all()
                bound = columns.force_status == ForceStatus.LOWER_BOUND
                saturated += int(np.count_nonzero(bound))
                bounds += (columns.force_n <= force_n)[bound].tolist()
        for _ in range(12):
            hand.step(np.zeros((hand.size, 4)))
        assert (begun == 1).all()
        assert (hand.tick.columns.state == PadState.CLEAR).all()
    assert saturated > 100
    assert np.mean(bounds) > 0.95


@pytest.mark.parametrize(
    "of_sheets",
    [{"behaviour": Behaviour(preset="S1")}, {"max_force_n": None}],
    ids=["behaviour", "unknown greatest force"],
)
def test_forces_of_firm_contacts_stay_true_bounds(of_sheets: dict[str, object]) -> None:
    """While they are held, too, as uncertainties are updated ten times a second."""
    hand, bounds = Hand(1, **of_sheets), []
    for _ in range(6):
        at = hand.rng.uniform(0.002, 0.998, (hand.size, 2))
        force_n = hand.rng.uniform(5.0, MAX_FORCE_N, hand.size)
        for share in (*RAMP[:4], *[1.0] * 50):
            hand.step(hand.counts(at, share * force_n))
        columns = hand.tick.columns
        assert np.isfinite(columns.force_n).all()
        bounds += (columns.force_n <= force_n)[columns.force_status == ForceStatus.LOWER_BOUND].tolist()
        for _ in range(12):
            hand.step(np.zeros((hand.size, 4)))
    assert len(bounds) > 10
    assert np.mean(bounds) > 0.95


def test_positions_of_contacts_beyond_the_range_are_within_their_region() -> None:
    """The centre of the current of discs whose centre is on the pad; parts as stated."""
    hand, inside = Hand(2), []
    for _ in range(60):
        at = hand.rng.uniform(0.0, 1.0, (hand.size, 2))
        sides = np.array([(network.a, network.b) for network in hand.model.networks])
        scale = np.array(
            [surface.scales(*place) for surface, place in zip(hand.surfaces, at * sides, strict=True)]
        )
        edge_m = np.minimum(at, 1 - at) * sides * scale
        counts = hand.counts(at, hand.rng.uniform(5.0, MAX_FORCE_N, hand.size))
        for _ in range(3):
            hand.step(counts)
        columns = hand.tick.columns
        error_m = (columns.xy - hand.centres) * scale
        variance = np.trace(columns.covariance_m2, axis1=1, axis2=2)
        judged = (counts.max(axis=1) > TOP) & (edge_m.min(axis=1) > 1e-3)
        judged &= columns.position_status == PositionStatus.VALID
        # the error is across the near edge: one dimension, 1.96 standard deviations
        inside += (np.square(error_m).sum(axis=1) < 1.96**2 * variance)[judged].tolist()
        for _ in range(12):
            hand.step(np.zeros((hand.size, 4)))
    assert len(inside) > 40
    assert np.mean(inside) > 0.9


@pytest.mark.parametrize("others", [0, 3000])
def test_a_channel_at_its_top_while_untouched_stays_a_fault_when_the_pad_is_touched(others: int) -> None:
    hand = Hand(3)
    counts = np.zeros((hand.size, 4))
    counts[0] = [TOP + 100, 0, 0, 0]
    hand.step(counts)
    assert hand.tick.columns.state[0] == PadState.FAULTED
    counts[0, 1:] = others
    for _ in range(4):
        assert not len(hand.step(counts).began)
    assert hand.tick.columns.state[0] == PadState.FAULTED


def test_a_contact_whose_channel_breaks_ends_with_the_release() -> None:
    hand = Hand(4)
    middle = np.full((hand.size, 2), 0.5)
    touch = hand.counts(middle, np.full(hand.size, 2.0))
    for _ in range(3):
        hand.step(touch)
    released = np.zeros((hand.size, 4))
    released[0, 2] = TOP + 100
    assert 0 in hand.step(released).ended
    assert hand.tick.columns.state[0] == PadState.FAULTED


def test_the_largest_current_of_a_channel_bounds_those_of_contacts_on_the_pad() -> None:
    hand = Hand(5)
    for row in (2, 12):  # a fingertip and a pad of the palm
        pad, network = hand.pads[row], hand.model.networks[row]
        sheet, node = hand.deployment.sheets[pad.sheet], hand.deployment.nodes[pad.node]
        law = contact_law(sheet, law_of(sheet))
        peak = ChannelCurrents(network, hand.surfaces[row], law, node.drive_v, sheet.ohm_per_square).peak(
            MAX_FORCE_N
        )
        assert peak.edge_m < 1e-3 * sheet.contact_radius_mm
        x, y = hand.rng.uniform(1e-3, 1 - 1e-3, (2, 500)) * [[network.a], [network.b]]
        scale_x, scale_y = hand.surfaces[row].scales(x, y)
        spreading_m = network.spreading_radius(x, y) * np.sqrt(scale_x * scale_y)
        total_a = law.current(MAX_FORCE_N, node.drive_v, sheet.ohm_per_square, spreading_m)
        largest_a = (network.fractions(x, y) * total_a).max()
        # contacts inside have at most the current of those over an edge
        assert 0.5 * peak.current_a < largest_a < 1.01 * peak.current_a
