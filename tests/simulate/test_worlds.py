"""Worlds: every drawn quantity has its documented distribution; families of seeds and sheets are disjoint."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from handtouch import config
from handtouch.simulate.worlds import (
    SHEET_KINDS,
    WORLDS,
    Distribution,
    DrawnWorld,
    Family,
    Fixed,
    HiddenShear,
    LogNormal,
    LogUniform,
    Normal,
    OneOf,
    ShearSpread,
    Uniform,
    World,
)
from handtouch.simulate.worlds.response_spread import HiddenResponse
from tests.deployments import SHEET_TOLERANCES

SEEDS = 400
FloatArray = NDArray[np.float64]
Draw = Callable[[DrawnWorld, config.Deployment], Any]


@cache
def drawn_pad(world: str, seed: int, pad: config.Pad) -> Any:
    return WORLDS[world].draw(seed).pad("right", pad)


def second_pad(drawn: DrawnWorld, deployment: config.Deployment) -> Any:
    return drawn_pad(drawn.world.name, drawn.seed, deployment.hands[0].pads[1])


def pad_value(name: str) -> Draw:
    """Return the draw of a property of the second pad, less what its table contributes."""
    return lambda drawn, deployment: getattr(second_pad(drawn, deployment), name)


def resistor_ratio(drawn: DrawnWorld, deployment: config.Deployment) -> Any:
    pad = deployment.hands[0].pads[1]
    used = np.array(pad.series_ohm) > 0
    resistors = np.array(second_pad(drawn, deployment).series_ohm) - drawn.lead_ohm("right/round")
    return (resistors[used] / np.array(pad.series_ohm)[used]).tolist()


def gap_offset(drawn: DrawnWorld, deployment: config.Deployment) -> Any:
    pad = deployment.hands[0].pads[1]
    hidden = second_pad(drawn, deployment)
    return (np.array(hidden.gap_before_mm + hidden.gap_after_mm) - pad.gap_mm).tolist()


def radius_sigma(drawn: DrawnWorld, deployment: config.Deployment) -> Any:
    sheet = deployment.sheets["s"]  # 0.4 of 2 mm: the lower limit is 3.5 standard deviations away
    return (drawn.contact(sheet, 5).radius_mm - sheet.contact_radius_mm) / sheet.contact_radius_std_mm


def hand_rate(name: str) -> Draw:
    return lambda drawn, _: drawn.hand_rate(getattr(drawn.world.electronics, name), name)


@cache
def shear_parts(world: str, seed: int) -> HiddenShear:
    return WORLDS[world].draw(seed).shear("right/round")


def shear_value(name: str) -> Draw:
    return lambda drawn, _: getattr(shear_parts(drawn.world.name, drawn.seed), name)


def response_value(name: str) -> Draw:
    return lambda drawn, _: getattr(drawn.response("left/pad", 4), name)


def film_unevenness(drawn: DrawnWorld, _: config.Deployment) -> Any:
    films = two_layers()
    return drawn.pad(films.name, films.pads[0]).unevenness


@cache
def two_layers() -> config.HandTable:
    return config.load(config.shipped.path("two_layers.toml")).hands[0]


CHANNEL_ERRORS = ("common_noise_counts", "hum_counts", "crosstalk", "nonlinearity_counts")


@cache
def channel_errors(world: str, seed: int) -> Any:
    return WORLDS[world].draw(seed).channel_errors("right/round")


def channel_value(name: str) -> Draw:
    return lambda drawn, _: getattr(channel_errors(drawn.world.name, drawn.seed), name)


DRAWS: dict[str, Draw] = {
    "parts.gain_ratio": pad_value("gain_ratio"),
    "parts.gap_offset_mm": gap_offset,
    "parts.resistor_ratio": resistor_ratio,
    "parts.lead_ohm": lambda drawn, _: drawn.lead_ohm("right/round"),
    "parts.sheet_ohm_ratio": pad_value("sheet_ohm_ratio"),
    "parts.anisotropy_ratio": pad_value("anisotropy_ratio"),
    "parts.unevenness": pad_value("unevenness"),
    "parts.length_offset_mm": pad_value("length_offset_mm"),
    "parts.width_offset_mm": pad_value("width_offset_mm"),
    "mounts.position_mm": pad_value("mount_offset_mm"),
    "mounts.orientation_deg": pad_value("mount_rotation_deg"),
    "mounts.joint_offset_deg": lambda drawn, _: drawn.joints("right", 3).offset_deg,
    "mounts.joint_noise_deg": lambda drawn, _: drawn.joints("right", 3).noise_deg,
    "mounts.joint_delay_s": lambda drawn, _: drawn.joints("right", 3).delay_s,
    "contacts.radius_sigma": radius_sigma,
    "contacts.elongation": lambda drawn, deployment: drawn.contact(deployment.sheets["s"], 5).elongation,
    "contacts.profile": lambda drawn, deployment: drawn.world.contacts.profile.names.index(
        drawn.contact(deployment.sheets["s"], 5).profile
    ),
    "sheets.contact_ohm_ratio": pad_value("contact_ohm_ratio"),
    "sheets.alpha_offset": pad_value("alpha_offset"),
    "sheets.parameter_ratio": lambda drawn, _: drawn.sheet_factors("right/round"),
    "electronics.noise_ratio": pad_value("noise_ratio"),
    **{f"electronics.{name}": channel_value(name) for name in CHANNEL_ERRORS},
    "electronics.zero_counts": lambda drawn, _: drawn.zero_counts("right/round"),
    "electronics.warm_up_k": hand_rate("warm_up_k"),
    "electronics.zero_drift_counts_per_s": hand_rate("zero_drift_counts_per_s"),
    "electronics.temperature_drift_k_per_s": hand_rate("temperature_drift_k_per_s"),
    "electronics.offset_counts_per_k": pad_value("offset_counts_per_k"),
    "electronics.gain_per_k": pad_value("gain_per_k"),
    "electronics.supply_drift_per_s": hand_rate("supply_drift_per_s"),
    **{f"shear.{entry.name}": shear_value(entry.name) for entry in dataclasses.fields(ShearSpread)},
    "responses.film_unevenness": film_unevenness,
    **{f"responses.{entry.name}": response_value(entry.name) for entry in dataclasses.fields(HiddenResponse)},
}


def distributions(world: World) -> dict[str, Distribution]:
    """Return the distributions of a world by group and name."""
    found = {}
    for group in dataclasses.fields(world):
        if group.name != "name":
            spread = getattr(world, group.name)
            for entry in dataclasses.fields(spread):
                if not entry.name.endswith(("_kinds", "kind")):
                    found[f"{group.name}.{entry.name}"] = getattr(spread, entry.name)
    return found


def assert_moments(values: FloatArray, expected: Distribution, sigmas: float = 4.5) -> None:
    """Check mean and standard deviation against their sampling errors."""
    n = values.size
    if expected.std == 0:
        np.testing.assert_allclose(values, expected.mean, rtol=1e-12, atol=1e-12)
        return
    assert abs(values.mean() - expected.mean) < sigmas * expected.std / math.sqrt(n)
    fourth = ((values - values.mean()) ** 4).mean() / expected.std**4
    error = expected.std / 2 * math.sqrt(max(fourth - 1, 0.1) / n)
    assert abs(values.std() - expected.std) < sigmas * error


@pytest.mark.parametrize(
    "distribution",
    [
        Fixed(2.0),
        Uniform(-1.0, 3.0),
        Normal(1.0, 2.0),
        LogNormal(2.0, 0.3),
        LogUniform(1.0, 3.0),
        OneOf(("a", "b", "c")),
    ],
    ids=str,
)
def test_samples_have_the_moments_of_their_distribution(distribution: Distribution) -> None:
    assert_moments(distribution.sample(np.random.default_rng(1), 40_000), distribution)


@pytest.mark.parametrize("name", sorted(DRAWS))
@pytest.mark.parametrize("world", WORLDS.values(), ids=list(WORLDS))
def test_drawn_quantities_have_their_documented_distribution(
    world: World, name: str, deployment: config.Deployment
) -> None:
    expected = distributions(world)[name]
    seeds = [Family.REPORTING.seed(number) for number in range(SEEDS)]
    values = np.array([np.ravel(DRAWS[name](world.draw(seed), deployment)) for seed in seeds]).ravel()
    assert_moments(values, expected)


def test_every_quantity_of_a_world_is_checked() -> None:
    assert distributions(WORLDS["ideal"]).keys() == DRAWS.keys()


@given(st.sampled_from(list(WORLDS)), st.integers(0, 1_999_999))
def test_the_same_seed_gives_the_same_world(name: str, seed: int) -> None:
    pad = config.Pad(
        link="a",
        bus="b",
        node_id=1,
        node="n",
        sheet="s",
        surface={"kind": "plane", "length_mm": 40.0, "width_mm": 20.0},  # type: ignore[arg-type]
        gap_mm=1.0,
    )
    drawn = WORLDS[name].draw(seed)
    assert drawn.pad("right", pad) == WORLDS[name].draw(seed).pad("right", pad)
    if name != "ideal":
        assert drawn.pad("left", pad) != drawn.pad("right", pad)
        assert drawn.pad("right", pad) != WORLDS[name].draw((seed + 1) % 2_000_000).pad("right", pad)


def test_quantities_of_a_pad_are_independent(deployment: config.Deployment) -> None:
    world, pad = WORLDS["harsh"], deployment.hands[0].pads[1]
    hidden = [world.draw(seed).pad("right", pad) for seed in range(SEEDS)]
    columns = [
        (*pad.gain_ratio, *pad.gap_before_mm, pad.sheet_ohm_ratio, *pad.unevenness, *pad.mount_offset_mm)
        for pad in hidden
    ]
    correlation = np.corrcoef(np.array(columns).T)
    assert np.abs(correlation - np.eye(len(correlation))).max() < 4.5 / math.sqrt(SEEDS)


def test_families_have_disjoint_seeds_and_sheets() -> None:
    tuning, reporting = Family.TUNING, Family.REPORTING
    assert not set(tuning.seeds) & set(reporting.seeds)
    assert {Family.of_seed(tuning.seed(7)), Family.of_seed(reporting.seed(7))} == {tuning, reporting}
    drawable = {
        family: {kind.name for world in WORLDS.values() for kind in world.sheets.kinds(family)}
        for family in Family
    }
    assert not drawable[tuning] & drawable[reporting]
    assert drawable[tuning] | drawable[reporting] == SHEET_KINDS.keys()


@pytest.mark.parametrize("family", Family)
@pytest.mark.parametrize("world", ["default", "harsh"])
def test_every_kind_of_its_family_is_drawn_equally_often(world: str, family: Family) -> None:
    kinds = WORLDS[world].sheets.kinds(family)
    drawn = [WORLDS[world].draw(family.seed(number)).sheet_kind("s") for number in range(SEEDS)]
    for kind in kinds:
        share = 1 / len(kinds)
        assert abs(drawn.count(kind) / SEEDS - share) < 4.5 * math.sqrt(share * (1 - share) / SEEDS)
    assert all(kind in kinds for kind in drawn)


def test_seeds_of_no_family_are_rejected() -> None:
    for seed in (-1, 2_000_000):
        with pytest.raises(ValueError, match=f"seed = {seed}: must lie between 0 and 1999999"):
            WORLDS["ideal"].draw(seed)
    with pytest.raises(ValueError, match="number = 1000000: must lie between 0 and 999999"):
        Family.TUNING.seed(1_000_000)


def test_harsh_is_two_to_three_times_as_wide_as_default() -> None:
    default, harsh = distributions(WORLDS["default"]), distributions(WORLDS["harsh"])
    for name, distribution in default.items():
        wide = harsh[name]
        if isinstance(distribution, OneOf):
            assert isinstance(wide, OneOf)
            assert set(wide.names) >= set(distribution.names)
            continue
        if isinstance(distribution, Fixed):  # noise, delay and rates
            ratio = wide.mean / distribution.mean if distribution.value not in (0, 1) else 2.5
        else:
            ratio = wide.std / distribution.std
        assert 1.9 < ratio < 3.1, name


def test_default_is_as_wide_as_the_tolerances_of_parts_it_replaces() -> None:
    parts = WORLDS["default"].parts
    assert parts.gain_ratio.std >= Uniform(0.98, 1.02).std
    assert parts.gap_offset_mm.std >= Uniform(-0.2, 0.2).std
    assert parts.resistor_ratio.std >= Uniform(0.95, 1.05).std


def test_a_builder_describes_the_nominal_kind_of_his_sheets(deployment: config.Deployment) -> None:
    drawn = WORLDS["default"].draw(Family.REPORTING.seed(3))
    kind = drawn.sheet_kind("s")
    assert kind is not None
    assert drawn.describe(deployment).sheets["s"].behaviour == kind.behaviour
    ideal = WORLDS["ideal"].draw(3).describe(deployment)
    assert ideal.sheets["s"].behaviour is None
    assert (ideal.nodes["n"].gain_std, ideal.sheets["s"].gap_std_mm) == (0.0, 0.0)


def test_default_tolerances_of_a_deployment_are_those_of_the_default_world(
    deployment: config.Deployment,
) -> None:
    described = WORLDS["default"].draw(Family.REPORTING.seed(3)).describe(deployment)
    for name in ("gain_std", "series_std"):
        default = config.Node.model_fields[name].default
        assert getattr(described.nodes["n"], name) == pytest.approx(default, rel=0.05)
    for name in SHEET_TOLERANCES:
        default = config.Sheet.model_fields[name].default
        assert getattr(described.sheets["s"], name) == pytest.approx(default, rel=0.05)


PAGE = (Path(__file__).parents[2] / "docs" / "worlds.md").read_text()


def test_docs_state_every_distribution() -> None:
    stated = {
        name: cells
        for name, *cells in re.findall(
            r"^\| `(\w+\.\w+)` \| [^|]+ \| [^|]+ \| ([^|]+) \| ([^|]+) \| ([^|]+) \| [^|]+ \|$", PAGE, re.M
        )
    }
    columns = [distributions(world) for world in WORLDS.values()]
    assert stated == {name: [str(column[name]) for column in columns] for name in columns[0]}


def test_docs_state_the_world_and_family_of_every_kind_of_sheet() -> None:
    stated = set(re.findall(r"^\| `(\w+)` \| (\w+), (\w+) \|", PAGE, re.M))
    assert stated == {
        (kind.name, world.name, family.name.lower())
        for world in WORLDS.values()
        for family in Family
        for kind in world.sheets.kinds(family)
    }
