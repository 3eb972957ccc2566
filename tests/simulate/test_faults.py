"""Faults obey the laws of the sheet and its wires; counts at many times equal single samples."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from handtouch import config
from handtouch.config import shipped
from handtouch.hand import electrode_network
from handtouch.simulate.faults import (
    FAULTS,
    INFLUENCES,
    DeadElectrode,
    Fault,
    GainStep,
    Gum,
    Heat,
    Moisture,
    Offset,
    SaturatedChannel,
    ShortedElectrode,
    StuckChannel,
    SwappedCables,
    TornCorner,
)
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, DrawnWorld, ElectronicsSpread, Fixed, World

CALM = World("calm", electronics=ElectronicsSpread(noise_ratio=Fixed(0.0))).draw(3)
FULL_MA = 0.02  # fine enough that rounding doesn't matter
HELD = np.array([10.0])
AT: dict[str, object] = {"link": "flat", "from_s": 5.0}
Kind = TypeVar("Kind", bound=Fault)


def on_flat(kind: type[Kind], **own: object) -> Kind:
    """Return a fault of the flat pad from 5 s on."""
    return kind.model_validate(AT | own)


def press(*places: tuple[float, float], link: str = "flat", force_n: float = 1.0) -> Scenario:
    """Return long, constant, simultaneous touches."""
    return Scenario.model_validate(
        {
            "touch": [
                {"link": link, "from_s": 0.0, "duration_s": 1e4, "path": (place,), "force_n": (force_n,)}
                for place in places
            ]
        }
    )


FAR = Scenario.model_validate(
    {"touch": [{"link": "tip", "from_s": 0.0, "duration_s": 1.0, "path": ((0.5, 0.5),), "force_n": (1.0,)}]}
)
"""A scenario without touches of the flat pad."""


def currents(
    deployment: config.Deployment,
    scenario: Scenario,
    *faults: Fault,
    t_s: float = 10.0,
    full_ma: float = FULL_MA,
) -> NDArray[np.float64]:
    """Return counts of the flat pad, with a converter too fine for rounding to matter."""
    node = deployment.nodes["n"]
    fine = deployment.model_copy(update={"nodes": {"n": node.model_copy(update={"full_scale_ma": full_ma})}})
    counts = VirtualHand(fine, scenario, CALM, faults=faults).counts(0, [t_s])[0]
    return np.asarray(counts, np.float64)


@pytest.mark.parametrize("electrode", range(4))
def test_dead_electrode_leaves_all_current_to_the_other_three(
    deployment: config.Deployment, electrode: int
) -> None:
    name = ("x0", "xa", "y0", "yb")[electrode]
    whole = currents(deployment, press((0.4, 0.6), force_n=0.05))
    left = currents(deployment, press((0.4, 0.6), force_n=0.05), on_flat(DeadElectrode, electrode=name))
    others = np.delete(np.arange(4), electrode)
    assert abs(left[electrode]) <= 1
    assert (left[others] > whole[others]).all()
    assert 0.85 * whole.sum() < left.sum() <= whole.sum()  # a little less, through more sheet
    conductance = electrode_network(deployment.hands[0].pads[0], deployment.sheets["s"]).conductance
    taken = conductance[electrode, others] / -conductance[electrode, electrode]
    shares = (whole[others] + taken * whole[electrode]) / whole.sum()  # Kirchhoff at the floating electrode
    assert shares.sum() == pytest.approx(1, abs=1e-3)
    np.testing.assert_allclose(left[others] / left.sum(), shares, atol=1e-3)


def test_swapped_cables_permute_channels(deployment: config.Deployment) -> None:
    whole = currents(deployment, press((0.3, 0.6), force_n=0.05))
    swapped = currents(
        deployment, press((0.3, 0.6), force_n=0.05), on_flat(SwappedCables, order=("y0", "xa", "yb", "x0"))
    )
    np.testing.assert_array_equal(swapped, whole[[2, 1, 3, 0]])


def test_shorted_electrodes_share_current_evenly(deployment: config.Deployment) -> None:
    whole = currents(deployment, press((0.2, 0.6), force_n=0.05))
    fault = on_flat(ShortedElectrode, electrode="x0", to="yb", short_ohm=1e-3)
    shorted = currents(deployment, press((0.2, 0.6), force_n=0.05), fault)
    assert shorted[0] == pytest.approx(shorted[3], abs=1.5)
    assert shorted[[0, 3]].sum() == pytest.approx(whole[[0, 3]].sum(), rel=0.05)
    np.testing.assert_allclose(shorted[[1, 2]], whole[[1, 2]], atol=0.05 * whole.sum())


def test_electrode_shorted_to_layer_saturates_and_drives_neighbours_without_contact(
    deployment: config.Deployment,
) -> None:
    hand = VirtualHand(deployment, FAR, CALM, faults=(on_flat(ShortedElectrode, electrode="x0"),))
    counts = hand.counts(0, HELD)[0]
    assert counts[0] == 32767
    conductance = electrode_network(deployment.hands[0].pads[0], deployment.sheets["s"]).conductance
    drive = counts[1:] * 10e-3 / 32767 * 2400.0 / -conductance[0, 1:]
    assert np.ptp(drive) < 1e-2 * drive.mean()  # one potential drives all three
    assert 4.5 < drive.mean() < 5.0  # all of the supply but what the short takes


@pytest.mark.parametrize("corner", ["x0y0", "x0yb", "xay0", "xayb"])
def test_tear_of_zero_length_changes_nothing(deployment: config.Deployment, corner: str) -> None:
    whole = currents(deployment, press((0.4, 0.6), force_n=0.05))
    torn = currents(
        deployment,
        press((0.4, 0.6), force_n=0.05),
        on_flat(TornCorner, corner=corner, along_x_mm=0, along_y_mm=0),
    )
    np.testing.assert_array_equal(torn, whole)


def test_tear_reduces_current_of_freed_electrodes_only(
    deployment: config.Deployment,
) -> None:
    scenario = press((0.4, 0.5), force_n=0.05)
    whole = currents(deployment, scenario)
    lost = []
    for share in (0.1, 0.3, 0.5):
        tear = on_flat(TornCorner, corner="x0y0", along_x_mm=share * 40, along_y_mm=share * 25)
        torn = currents(deployment, scenario, tear)
        lost.append(whole[[0, 2]].sum() - torn[[0, 2]].sum())
        assert (torn[[1, 3]] >= whole[[1, 3]]).all()
        assert torn.sum() == pytest.approx(whole.sum(), rel=1e-3)
    assert lost == sorted(lost)
    assert lost[-1] > 0.05 * whole.sum()


def test_torn_off_area_senses_nothing(deployment: config.Deployment) -> None:
    tear = on_flat(TornCorner, corner="xayb", along_x_mm=16, along_y_mm=10)
    np.testing.assert_array_equal(currents(deployment, press((0.9, 0.9)), tear), 0)


def residual(deployment: config.Deployment, counts: NDArray[np.float64]) -> float:
    """Return the residual of a point contact fitted to the four currents, relative to their sum."""
    network = electrode_network(deployment.hands[0].pads[0], deployment.sheets["s"])
    found = network.estimate(counts, 1.0)
    expected = network.fractions(found.x, found.y)
    return float(np.abs(counts / counts.sum() - expected / expected.sum()).max())


def test_leak_has_a_residual_and_point_contact_has_none(deployment: config.Deployment) -> None:
    point = currents(deployment, press((0.5, 0.5), force_n=0.05))
    wet = on_flat(Moisture, place=(0.5, 0.5), radius_mm=10, leak_ohm=4e5, grow_s=0.1)
    leak = currents(deployment, FAR, wet)
    assert residual(deployment, point) < 1e-4
    assert residual(deployment, leak) > 20 * residual(deployment, point)


def test_small_leak_has_its_conductance_and_dries(deployment: config.Deployment) -> None:
    wet = Moisture(
        link="flat",
        from_s=0.0,
        until_s=100.0,
        place=(0.5, 0.5),
        radius_mm=6,
        leak_ohm=1e6,
        grow_s=20.0,
        dry_s=50.0,
    )
    sums = [currents(deployment, FAR, wet, t_s=t).sum() for t in (20.0, 99.0, 150.0)]
    full = 5.0 / 1e6 / (1e-3 * FULL_MA) * 32767
    np.testing.assert_allclose(
        sums, full * np.array([1 - np.exp(-1), 1 - np.exp(-4.95), np.exp(-1)]), rtol=0.01
    )


def test_gum_is_a_lasting_contact_at_its_position(deployment: config.Deployment) -> None:
    gum = on_flat(Gum, place=(0.3, 0.6), radius_mm=2.0, force_n=0.05, press_n=0, relax=0.0)
    before = currents(deployment, FAR, gum, t_s=4.9)
    np.testing.assert_array_equal(before, 0)
    later = currents(deployment, FAR, gum, t_s=5000.0)
    touch = press((0.3, 0.6)).model_dump(by_alias=True)
    touch["touch"] = [touch["touch"][0] | {"radius_mm": 2.0, "path": ((0.3, 0.6),), "force_n": (0.05,)}]
    np.testing.assert_allclose(later, currents(deployment, Scenario.model_validate(touch)), atol=1)


def test_contacts_reduce_each_others_current_less_when_far_apart(deployment: config.Deployment) -> None:
    def lost(apart: float) -> float:
        one, other = (0.5 - apart / 2, 0.5), (0.5 + apart / 2, 0.5)
        first, second, both = (
            currents(deployment, press(*places, force_n=0.5), full_ma=10.0).sum()
            for places in ((one,), (other,), (one, other))
        )
        return float(1 - both / (first + second))

    losses = [lost(apart) for apart in (0.25, 0.5, 0.8)]
    assert losses == sorted(losses, reverse=True)
    assert losses[-1] > 0
    assert losses[0] > 5 * losses[-1]


def test_greens_function_is_symmetric(deployment: config.Deployment) -> None:
    hand = VirtualHand(deployment, press((0.3, 0.4), (0.7, 0.8)), CALM)
    turned = VirtualHand(deployment, press((0.7, 0.8), (0.3, 0.4)), CALM)
    np.testing.assert_array_equal(hand.counts(0, HELD), turned.counts(0, HELD))


def test_offset_gain_stuck_and_saturated_channels_follow_the_scenario(deployment: config.Deployment) -> None:
    scenario = press((0.4, 0.6), force_n=0.05)
    whole = currents(deployment, scenario)
    np.testing.assert_array_equal(
        currents(deployment, scenario, on_flat(Offset, electrode="xa", counts=50.0)) - whole, [0, 50, 0, 0]
    )
    stepped = currents(deployment, scenario, on_flat(GainStep, electrode="yb", factor=1.5))
    np.testing.assert_allclose(stepped / whole, [1, 1, 1, 1.5], rtol=2e-4)
    assert currents(deployment, scenario, on_flat(SaturatedChannel, electrode="y0"))[2] == 32767
    stuck = VirtualHand(
        deployment,
        scenario,
        WORLDS["default"].only("parts", "contacts").draw(3),
        faults=(on_flat(StuckChannel, electrode="x0"),),
    )
    counts = stuck.counts(0, np.arange(4.0, 8.0, 0.01))
    assert np.ptp(counts[:90, 0]) > 0
    assert np.ptp(counts[110:, 0]) == 0
    assert np.ptp(counts[110:, 1]) > 0


def test_heat_raises_conductance_and_fades(deployment: config.Deployment) -> None:
    scenario = press((0.4, 0.6), force_n=0.05)
    heat = Heat(link="flat", from_s=5.0, until_s=500.0, warmer_by_k=20.0, time_s=10.0)
    whole = currents(deployment, scenario).sum()
    warm, after = (currents(deployment, scenario, heat, t_s=t).sum() for t in (400.0, 900.0))
    assert 1.1 * whole < warm < 1.4 * whole
    assert after == pytest.approx(whole, rel=1e-3)


KEYS: dict[str, dict[str, object]] = {
    "gum": {"place": (0.4, 0.6), "radius_mm": 2.0},
    "moisture": {"place": (0.5, 0.4), "leak_ohm": 8e3, "until_s": 14.0, "dry_s": 5.0},
    "dead_electrode": {"electrode": "x0"},
    "shorted_electrode": {"electrode": "yb", "to": "xa"},
    "swapped_cables": {"order": ("x0", "y0", "xa", "yb")},
    "saturated_channel": {"electrode": "y0"},
    "stuck_channel": {"electrode": "xa"},
    "torn_corner": {"corner": "x0y0", "along_x_mm": 12.0, "along_y_mm": 8.0},
    "offset": {"electrode": "yb", "counts": -400.0},
    "gain_step": {"electrode": "x0", "factor": 1.4},
    "heat": {"warmer_by_k": 20.0, "time_s": 10.0, "until_s": 15.0},
}
"""Keys of a fault of each kind, by which it shows under `USE`."""
USE = Scenario.model_validate(
    {
        "touch": [
            {
                "link": "flat",
                "from_s": begin,
                "duration_s": 2.0,
                "path": ((0.2, 0.3), (0.8, 0.7)),
                "force_n": (0.5, 2.0),
            }
            for begin in (0.5, 4.0, 9.0, 16.0)
        ]
    }
)


def fault_of(kind: str) -> Fault:
    """Return a fault of the flat pad from 5 s on."""
    return {**FAULTS, **INFLUENCES}[kind].model_validate(AT | KEYS[kind])


@pytest.mark.parametrize("kind", [*FAULTS, *INFLUENCES])
def test_counts_at_many_times_equal_single_samples(deployment: config.Deployment, kind: str) -> None:
    hand = VirtualHand(deployment, USE, WORLDS["default"].draw(2), "near", (fault_of(kind),))
    times = np.linspace(0.0, 20.0, 41)
    np.testing.assert_array_equal(hand.counts(0, times), [hand.sample(t)[0] for t in times])


@pytest.mark.parametrize("kind", [*FAULTS, *INFLUENCES])
def test_fault_acts_only_after_its_begin(deployment: config.Deployment, kind: str) -> None:
    times = np.linspace(0.0, 20.0, 200)
    sick, well = (
        VirtualHand(deployment, USE, CALM, "near", faults).counts(0, times)
        for faults in ((fault_of(kind),), ())
    )
    before = times < 5.0
    np.testing.assert_array_equal(sick[before], well[before])
    assert (sick[~before] != well[~before]).any()


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: on_flat(SwappedCables, order=("x0", "xa", "y0", "yb")),
        lambda: on_flat(SwappedCables, order=("x0", "x0", "y0", "yb")),
        lambda: on_flat(ShortedElectrode, electrode="x0", to="x0"),
        lambda: Offset(link="flat", from_s=5.0, until_s=4.0, electrode="x0", counts=3.0),
    ],
)
def test_inconsistent_fault_is_rejected(wrong: object) -> None:
    with pytest.raises(ValidationError):
        wrong()  # type: ignore[operator]


def test_a_new_sheet_changes_currents_from_then_on_and_no_node(deployment: config.Deployment) -> None:
    """Twice the contact resistance halves what it conducts, but for the sheet's own resistance in series."""
    touch = {"link": "flat", "from_s": 0.0, "duration_s": 20.0, "path": ((0.5, 0.5),), "force_n": (1.0,)}
    swap = {"link": "flat", "at_s": 10.0, "sheet": 3, "contact_ohm_ratio": 2.0}
    hands = [
        VirtualHand(deployment, Scenario.model_validate(tables, strict=False), DrawnWorld(WORLDS["ideal"], 0))
        for tables in ({"touch": (touch,)}, {"touch": (touch,), "swap": (swap,)})
    ]
    old, new = (hand.counts(0, [5.0, 9.99, 10.01, 15.0]).sum(axis=1) for hand in hands)
    np.testing.assert_array_equal(new[:2], old[:2])
    assert np.all(new[2:] < 0.75 * old[2:])
    assert np.all(new[2:] > 0.5 * old[2:])
    with pytest.raises(ValidationError, match="must have serial"):
        Scenario.model_validate({"swap": ({"link": "flat", "at_s": 1.0},)}, strict=False)


def test_sheets_of_other_numbers_have_other_parts_on_the_same_node(deployment: config.Deployment) -> None:
    world, (hand, pad) = DrawnWorld(WORLDS["harsh"], 4), deployment.pads[0]
    first, second, third = (replace(world, sheet_number=number).pad(hand, pad) for number in (0, 1, 2))
    for one, other in ((first, second), (second, third)):
        assert (one.gain_ratio, one.series_ohm, one.noise_ratio) == (
            (other.gain_ratio, other.series_ohm, other.noise_ratio)
        )
        assert one.contact_ohm_ratio != other.contact_ohm_ratio
        assert one.unevenness != other.unevenness
        assert one.gap_before_mm != other.gap_before_mm


def test_shipped_fault_scenario_fits_shipped_hand() -> None:
    hand = config.load(shipped.path("utah_mit.toml"))
    played = Scenario.load(shipped.path("utah_mit_faults.toml"))
    played.check_links(pad.link for pad in hand.hands[0].pads)
    assert {type(fault) for fault in played.faults} == {Gum, Moisture, DeadElectrode, TornCorner}
    assert played.node_replacements[0].serial == 4711
