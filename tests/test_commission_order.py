"""The order of the electrodes from a few rough presses: right or refused, never wrong."""

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
from handtouch.commission.order import ASKED, ELECTRODES, Near, Reading, Shares, Verdict, judge
from handtouch.field.network import ElectrodeNetwork
from handtouch.field.surface import Surface
from handtouch.hand import network_of, surface_of

SHEET = config.Sheet(
    ohm_per_square=2400.0, contact_ohm_mm2=2e4, alpha=1.5, contact_radius_mm=2.5, contact_radius_std_mm=0.5
)
SEQUENCE: tuple[Near, ...] = ("xa", "yb", "x0", "y0", "xa", "yb")
ALL = np.ones(4, bool)


@dataclass(frozen=True)
class Built:
    """A pad as it is."""

    surface: Surface
    network: ElectrodeNetwork
    shares: Shares = field(repr=False)

    @classmethod
    def of(cls, shape: config.Surface, gap_mm: float, series_ohm: float = 0.0) -> Built:
        four = (series_ohm, series_ohm, series_ohm, series_ohm)
        pad = config.Pad(
            link="a", bus="b", node_id=1, node="n", sheet="s", surface=shape, gap_mm=gap_mm, series_ohm=four
        )
        surface, network = surface_of(pad), network_of(pad, SHEET)
        return cls(surface, network, Shares(network, surface))

    def press(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """Shares (4,) of the electrodes."""
        x, _ = self.surface.to_rectangle(place[0] * self.surface.extent_m[0], 0.0)
        return np.asarray(self.network.fractions(float(x), place[1] * self.surface.b))


def random_pad(rng: np.random.Generator) -> Built:
    """Sides of 12 to 60 mm, no longer than 2.5 times as wide, of any kind."""
    length = rng.uniform(12, 60)
    width = length * math.exp(rng.uniform(-1, 1) * math.log(2.5))
    gap = rng.uniform(0, 0.8)
    arc = rng.uniform(40, 200)
    radius = width / math.radians(arc)
    kind = rng.integers(4)
    shape: config.Surface
    if kind == 0:
        shape = config.Plane(kind="plane", length_mm=length, width_mm=width)
    elif kind == 1:
        shape = config.Cylinder(kind="cylinder", radius_mm=radius, length_mm=length, arc_deg=arc)
    elif kind == 2:
        near, far = radius * rng.uniform(0.75, 1.25, 2)
        slant = max(length, 2 * abs(near - far))
        shape = config.Cone(kind="cone", near_radius_mm=near, far_radius_mm=far, slant_mm=slant, arc_deg=arc)
    else:
        low = rng.uniform(-50, 0)
        high = low + rng.uniform(50, 100)
        shape = config.Sphere(
            kind="sphere", radius_mm=10.0, from_deg=low, to_deg=min(high, 60.0), arc_deg=rng.uniform(80, 160)
        )
    return Built.of(shape, gap, rng.choice([0.0, 100.0]))


def trial(
    built: Built, rng: np.random.Generator, off: float, *, gain: float = 0.05, dead: int | None = None
) -> tuple[Verdict, tuple[str, ...], int]:
    """What is found, what is so, and after how many presses; a channel may be `dead`."""
    wired = rng.permutation(4)
    gains = 1 + gain * rng.standard_normal(4)
    live = ALL if dead is None else np.arange(4) != dead
    readings: list[Reading] = []
    for near in SEQUENCE:
        place = np.clip(np.array(ASKED[near]) + rng.uniform(-off, off, 2), 0.03, 0.97)
        total = rng.uniform(1000, 20_000)
        counts = np.where(live, total * built.press(place)[wired] * gains, 0.0) + rng.standard_normal(4)
        readings.append(Reading(near, np.abs(counts), 1.0, live))
        if len(readings) >= 2 and (verdict := judge(built.shares, readings)).clear:
            break
    return verdict, tuple(ELECTRODES[i] for i in wired), len(readings)


def campaign(seed: int, pads: int, each: int, off: float) -> Counter[str]:
    """Outcomes of many trials: right, wrong, refused, and how many took more than two presses."""
    rng = np.random.default_rng(seed)
    outcomes: Counter[str] = Counter()
    for _ in range(pads):
        built = random_pad(rng)
        for _ in range(each):
            verdict, so, presses = trial(built, rng, off)
            outcomes["more presses"] += presses > 2
            kind = "refused" if not verdict.clear else "right" if verdict.electrodes == so else "wrong"
            outcomes[kind] += 1
    return outcomes


@given(st.integers(0, 2**32 - 1))
def test_presses_off_by_a_fifth_of_a_side_with_gains_5_percent_off_are_never_judged_wrongly(
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    verdict, so, _ = trial(random_pad(rng), rng, off=0.2)
    assert not verdict.clear or verdict.electrodes == so


def test_nearly_every_pad_is_found_out_and_most_by_two_presses() -> None:
    outcomes = campaign(seed=1, pads=30, each=10, off=0.2)
    assert outcomes["wrong"] == 0
    assert outcomes["right"] >= 297
    assert outcomes["more presses"] < 150


def test_a_press_in_the_middle_tells_no_order() -> None:
    built = Built.of(config.Plane(kind="plane", length_mm=30.0, width_mm=20.0), 1.0)
    middle = built.press(np.array([0.5, 0.5]))
    readings = [Reading(near, 5000 * middle, 1.0, ALL) for near in ("xa", "yb")]
    assert not judge(built.shares, readings).clear


def test_a_mirrored_pad_is_found_as_such() -> None:
    built = Built.of(config.Plane(kind="plane", length_mm=30.0, width_mm=20.0), 1.0)
    readings = []
    for near in ("xa", "yb"):
        x0, xa, y0, yb = 5000 * built.press(np.array(ASKED[near]))
        readings.append(Reading(near, np.array([xa, x0, y0, yb]), 1.0, ALL))
    verdict = judge(built.shares, readings)
    assert verdict.clear
    assert verdict.electrodes == ("xa", "x0", "y0", "yb")


def test_currents_of_no_place_fit_no_order() -> None:
    built = Built.of(config.Plane(kind="plane", length_mm=30.0, width_mm=30.0), 1.0)
    readings = [Reading(near, np.array([3000.0, 3000.0, 3000.0, 0.0]), 1.0, ALL) for near in ("xa", "yb")]
    verdict = judge(built.shares, readings)
    assert not verdict.fits
    assert not verdict.clear


@pytest.mark.parametrize("dead", range(4))
def test_a_dead_channel_does_not_lead_astray(dead: int) -> None:
    rng = np.random.default_rng(dead)
    right = 0
    for _ in range(25):
        verdict, so, _ = trial(random_pad(rng), rng, off=0.15, dead=dead)
        assert not verdict.clear or verdict.electrodes == so
        right += verdict.clear
    assert right >= 20


def test_without_a_press_there_is_no_verdict() -> None:
    built = Built.of(config.Plane(kind="plane", length_mm=30.0, width_mm=20.0), 1.0)
    with pytest.raises(ValueError, match="no press"):
        judge(built.shares, [])


if __name__ == "__main__":  # the figures of docs/commission.md
    for off in (0.1, 0.2, 0.25, 0.3, 0.4):
        print(off, dict(campaign(seed=2, pads=200, each=25, off=off)))
