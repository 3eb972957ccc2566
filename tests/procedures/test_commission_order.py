"""The order of the electrodes from a few rough presses: correct or refused, never wrong."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from handtouch import config
from handtouch.config.tables import SIDE_ELECTRODES
from handtouch.field.network import ElectrodeNetwork
from handtouch.field.surface_base import Surface
from handtouch.hand import electrode_network, pad_network, pad_surface
from handtouch.procedures.commission.electrode_order import (
    PRESS_TARGETS,
    ElectrodeOrder,
    PressReading,
    ShareGrid,
    find_electrode_order,
)
from tests.deployments import SIX_ARCS, THREE_ARCS, arcs_text

SHEET = config.Sheet(
    ohm_per_square=2400.0, contact_ohm_mm2=2e4, alpha=1.5, contact_radius_mm=2.5, contact_radius_std_mm=0.5
)
SEQUENCE: tuple[str, ...] = ("xa", "yb", "x0", "y0", "xa", "yb")
ALL = np.ones(4, bool)


@dataclass(frozen=True)
class Built:
    """A pad as it is."""

    surface: Surface
    network: ElectrodeNetwork
    shares: ShareGrid = field(repr=False)

    @classmethod
    def of(cls, shape: config.SurfaceTable, gap_mm: float, series_ohm: float = 0.0) -> Built:
        four = (series_ohm, series_ohm, series_ohm, series_ohm)
        pad = config.Pad(
            link="a", bus="b", node_id=1, node="n", sheet="s", surface=shape, gap_mm=gap_mm, series_ohm=four
        )
        surface, network = pad_surface(pad), electrode_network(pad, SHEET)
        return cls(surface, network, ShareGrid(network, surface))

    def press(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Shares (4,) of the electrodes."""
        x, _ = self.surface.to_rectangle(position[0] * self.surface.extent_m[0], 0.0)
        return np.asarray(self.network.fractions(float(x), position[1] * self.surface.b))


def random_pad(rng: np.random.Generator) -> Built:
    """Sides of 12 to 60 mm, no longer than 2.5 times as wide, of any kind."""
    length = rng.uniform(12, 60)
    width = length * math.exp(rng.uniform(-1, 1) * math.log(2.5))
    gap = rng.uniform(0, 0.8)
    arc = rng.uniform(40, 200)
    radius = width / math.radians(arc)
    kind = rng.integers(4)
    shape: config.SurfaceTable
    if kind == 0:
        shape = config.surface_table(kind="plane", length_mm=length, width_mm=width)
    elif kind == 1:
        shape = config.surface_table(kind="cylinder", radius_mm=radius, length_mm=length, arc_deg=arc)
    elif kind == 2:
        near, far = radius * rng.uniform(0.75, 1.25, 2)
        slant = max(length, 2 * abs(near - far))
        shape = config.surface_table(
            kind="cone", near_radius_mm=near, far_radius_mm=far, slant_mm=slant, arc_deg=arc
        )
    else:
        low = rng.uniform(-50, 0)
        high = low + rng.uniform(50, 100)
        shape = config.surface_table(
            kind="sphere", radius_mm=10.0, from_deg=low, to_deg=min(high, 60.0), arc_deg=rng.uniform(80, 160)
        )
    return Built.of(shape, gap, rng.choice([0.0, 100.0]))


def trial(
    built: Built, rng: np.random.Generator, off: float, *, gain: float = 0.05, dead: int | None = None
) -> tuple[ElectrodeOrder, tuple[str, ...], int]:
    """Return the estimated order, the true one and the number of presses; a channel may be `dead`."""
    wired = rng.permutation(4)
    gains = 1 + gain * rng.standard_normal(4)
    working = ALL if dead is None else np.arange(4) != dead
    readings: list[PressReading] = []
    for electrode in SEQUENCE:
        position = np.clip(np.array(PRESS_TARGETS[electrode]) + rng.uniform(-off, off, 2), 0.03, 0.97)
        total = rng.uniform(1000, 20_000)
        counts = np.where(working, total * built.press(position)[wired] * gains, 0.0) + rng.standard_normal(4)
        readings.append(PressReading(electrode, np.abs(counts), 1.0, working))
        if len(readings) >= 2 and (order := find_electrode_order(built.shares, readings)).is_clear:
            break
    return order, tuple(SIDE_ELECTRODES[i] for i in wired), len(readings)


def campaign(seed: int, pads: int, each: int, off: float) -> Counter[str]:
    """Count the results of many trials: correct, wrong, ambiguous, and with more than two presses."""
    rng = np.random.default_rng(seed)
    outcomes: Counter[str] = Counter()
    for _ in range(pads):
        built = random_pad(rng)
        for _ in range(each):
            order, truth, presses = trial(built, rng, off)
            outcomes["more presses"] += presses > 2
            kind = "ambiguous" if not order.is_clear else "correct" if order.electrodes == truth else "wrong"
            outcomes[kind] += 1
    return outcomes


@given(st.integers(0, 2**32 - 1))
def test_order_is_never_wrong_with_inaccurate_presses_and_gains(
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    order, truth, _ = trial(random_pad(rng), rng, off=0.2)
    assert not order.is_clear or order.electrodes == truth


def test_order_of_nearly_every_pad_is_found_mostly_with_two_presses() -> None:
    outcomes = campaign(seed=1, pads=30, each=10, off=0.2)
    assert outcomes["wrong"] == 0
    assert outcomes["correct"] >= 297
    assert outcomes["more presses"] < 150


def test_press_in_the_middle_is_ambiguous() -> None:
    built = Built.of(config.surface_table(kind="plane", length_mm=30.0, width_mm=20.0), 1.0)
    middle = built.press(np.array([0.5, 0.5]))
    readings = [PressReading(electrode, 5000 * middle, 1.0, ALL) for electrode in ("xa", "yb")]
    assert not find_electrode_order(built.shares, readings).is_clear


def test_mirrored_pad_is_found() -> None:
    built = Built.of(config.surface_table(kind="plane", length_mm=30.0, width_mm=20.0), 1.0)
    readings = []
    for electrode in ("xa", "yb"):
        x0, xa, y0, yb = 5000 * built.press(np.array(PRESS_TARGETS[electrode]))
        readings.append(PressReading(electrode, np.array([xa, x0, y0, yb]), 1.0, ALL))
    order = find_electrode_order(built.shares, readings)
    assert order.is_clear
    assert order.electrodes == ("xa", "x0", "y0", "yb")


def test_impossible_currents_are_inconsistent() -> None:
    built = Built.of(config.surface_table(kind="plane", length_mm=30.0, width_mm=30.0), 1.0)
    readings = [
        PressReading(electrode, np.array([3000.0, 3000.0, 3000.0, 0.0]), 1.0, ALL)
        for electrode in ("xa", "yb")
    ]
    order = find_electrode_order(built.shares, readings)
    assert not order.consistent
    assert not order.is_clear


@pytest.mark.parametrize("dead", range(4))
def test_dead_channel_causes_no_wrong_order(dead: int) -> None:
    rng = np.random.default_rng(dead)
    correct = 0
    for _ in range(25):
        order, truth, _ = trial(random_pad(rng), rng, off=0.15, dead=dead)
        assert not order.is_clear or order.electrodes == truth
        correct += order.is_clear
    assert correct >= 20


def test_missing_press_raises_value_error() -> None:
    built = Built.of(config.surface_table(kind="plane", length_mm=30.0, width_mm=20.0), 1.0)
    with pytest.raises(ValueError, match="no press"):
        find_electrode_order(built.shares, [])


if __name__ == "__main__":  # the figures of docs/commission.md
    for off in (0.1, 0.2, 0.25, 0.3, 0.4):
        print(off, dict(campaign(seed=2, pads=200, each=25, off=off)))


@pytest.mark.parametrize("arcs", [THREE_ARCS, SIX_ARCS], ids=["three", "six"])
def test_order_of_electrodes_on_arcs_is_found_with_few_presses(arcs: dict[str, tuple[float, float]]) -> None:
    pad = config.parse(arcs_text(arcs)).pads[1].pad
    network, names, rng = pad_network(pad, SHEET), pad.electrode_names, np.random.default_rng(1)
    grid, count, presses = ShareGrid(network, pad_surface(pad), names), len(names), []
    for _ in range(20):
        wired, gains = rng.permutation(count), 1 + 0.05 * rng.standard_normal(count)
        readings: list[PressReading] = []
        for electrode in (names[0], names[-(-count // 3)], *names, *names):
            off = rng.uniform(-0.15, 0.15, 2)
            x, y = np.clip(grid.targets[names.index(electrode)] + off, 0.03, 0.97) * (network.a, network.b)
            currents = rng.uniform(1000, 20_000) * network.fractions(x, y)[wired] * gains
            currents += rng.standard_normal(count)
            readings.append(PressReading(electrode, np.abs(currents), 1.0, np.ones(count, bool)))
            if len(readings) >= 2 and (order := find_electrode_order(grid, readings)).is_clear:
                break
        assert order.is_clear
        assert order.electrodes == tuple(names[i] for i in wired)
        presses.append(len(readings))
    assert np.median(presses) <= 3
