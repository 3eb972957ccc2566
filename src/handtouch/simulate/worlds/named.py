"""The named worlds. docs/worlds.md states the source of each number.

Public names: `WORLDS`, `world_named`, `world_with`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

from handtouch.simulate.contact_patch import PROFILES
from handtouch.simulate.preisach import PlayLoops
from handtouch.simulate.worlds.distributions import Fixed, LogNormal, LogUniform, Normal, OneOf, Uniform
from handtouch.simulate.worlds.response_spread import ResponseSpread
from handtouch.simulate.worlds.shear_spread import ShearSpread
from handtouch.simulate.worlds.sheet_kinds import ELASTOMER, SHEET_KINDS, SheetKind
from handtouch.simulate.worlds.spreads import (
    ONE,
    ContactSpread,
    ElectronicsSpread,
    MountSpread,
    PartSpread,
    SheetSpread,
)
from handtouch.simulate.worlds.world import World


def _kinds(*names: str) -> tuple[SheetKind, ...]:
    return tuple(SHEET_KINDS[name] for name in names)


_IDEAL = World("ideal")

_DEFAULT = World(
    "default",
    PartSpread(
        gain_ratio=Uniform(0.98, 1.02),
        gap_offset_mm=Uniform(-0.2, 0.2),
        resistor_ratio=Uniform(0.95, 1.05),
        lead_ohm=Uniform(0.0, 2.0),
        sheet_ohm_ratio=LogNormal(1.0, 0.1),
        anisotropy_ratio=LogNormal(1.0, 0.02),
        length_offset_mm=Uniform(-0.1, 0.1),
        width_offset_mm=Uniform(-0.1, 0.1),
    ),
    MountSpread(
        position_mm=Normal(0.0, 0.2),
        orientation_deg=Normal(0.0, 0.5),
        joint_offset_deg=Normal(0.0, 0.2),
        joint_noise_deg=Fixed(0.05),
        joint_delay_s=Fixed(0.003),
    ),
    ContactSpread(radius_sigma=Normal(0.0, 1.0), elongation=LogUniform(1.0, 2.0), profile=OneOf(PROFILES)),
    SheetSpread(
        contact_ohm_ratio=LogNormal(1.0, 0.06),
        alpha_offset=Normal(0.0, 0.05),
        tuning_kinds=_kinds("S1", "S2"),
        reporting_kinds=_kinds("fsr", "flexiforce", "conductive_film"),
        parameter_ratio=LogNormal(1.0, 0.15),
    ),
    ElectronicsSpread(
        noise_ratio=LogNormal(1.0, 0.1),
        common_noise_counts=Fixed(0.2),
        hum_counts=Uniform(0.0, 0.5),
        crosstalk=Uniform(0.0, 2e-4),
        nonlinearity_counts=Normal(0.0, 0.5),
        zero_drift_counts_per_s=Fixed(0.05),
        temperature_drift_k_per_s=Fixed(0.01),
        offset_counts_per_k=Normal(0.0, 2.0),
        gain_per_k=Normal(0.0, 1e-4),
        supply_drift_per_s=Fixed(1e-5),
    ),
    ShearSpread(
        stiffness_ratio=LogNormal(1.0, 0.1),
        axis_ratio=LogNormal(1.0, 0.02),
        plate_offset_mm=Uniform(-0.1, 0.1),
        plate_turn_deg=Normal(0.0, 0.5),
        edge_offset_mm=Uniform(-0.03, 0.03),
        film_ratio=LogNormal(1.0, 0.05),
        film_ohm_ratio=LogNormal(1.0, 0.1),
        contact_share=Uniform(0.0, 0.05),
        alpha_offset=Normal(0.0, 0.03),
        hysteresis=Uniform(0.02, 0.06),
        creep=Uniform(0.02, 0.05),
        stiffening=Uniform(0.0, 0.05),
    ),
    ResponseSpread(
        position_offset_mm=Normal(0.0, 0.2),
        width_ratio=LogNormal(1.0, 0.05),
        signal_ratio=LogNormal(1.0, 0.08),
        crosstalk=Uniform(0.0, 0.02),
        tail=Uniform(0.0, 0.1),
        film_unevenness=Normal(0.0, 0.01),
        field_n=LogNormal(0.3, 0.3),
        field_tilt=Normal(0.0, 0.1),
        kind=ELASTOMER,
    ),
)

_HARSH = World(
    "harsh",
    PartSpread(
        gain_ratio=Uniform(0.95, 1.05),
        gap_offset_mm=Uniform(-0.5, 0.5),
        resistor_ratio=Uniform(0.88, 1.12),
        lead_ohm=Uniform(0.0, 5.0),
        sheet_ohm_ratio=LogNormal(1.0, 0.25),
        anisotropy_ratio=LogNormal(1.0, 0.05),
        unevenness=Normal(0.0, 0.05),
        length_offset_mm=Uniform(-0.25, 0.25),
        width_offset_mm=Uniform(-0.25, 0.25),
    ),
    MountSpread(
        position_mm=Normal(0.0, 0.5),
        orientation_deg=Normal(0.0, 1.25),
        joint_offset_deg=Normal(0.0, 0.5),
        joint_noise_deg=Fixed(0.12),
        joint_delay_s=Fixed(0.008),
    ),
    ContactSpread(radius_sigma=Normal(0.0, 2.0), elongation=LogUniform(1.0, 3.0), profile=OneOf(PROFILES)),
    SheetSpread(
        contact_ohm_ratio=LogNormal(1.0, 0.15),
        alpha_offset=Normal(0.0, 0.12),
        tuning_kinds=_kinds("power_creep", "two_speeds"),
        reporting_kinds=_kinds(
            "steep_creep",
            "fast_and_slow",
            "preisach_without_adaptation",
            "preisach_and_power_creep",
        ),
        parameter_ratio=LogNormal(1.0, 0.35),
    ),
    ElectronicsSpread(
        noise_ratio=LogNormal(1.0, 0.25),
        common_noise_counts=Fixed(0.5),
        hum_counts=Uniform(0.0, 1.25),
        crosstalk=Uniform(0.0, 5e-4),
        nonlinearity_counts=Normal(0.0, 1.25),
        zero_drift_counts_per_s=Fixed(0.12),
        temperature_drift_k_per_s=Fixed(0.025),
        offset_counts_per_k=Normal(0.0, 5.0),
        gain_per_k=Normal(0.0, 2.5e-4),
        supply_drift_per_s=Fixed(2.5e-5),
    ),
    ShearSpread(
        stiffness_ratio=LogNormal(1.0, 0.2),
        axis_ratio=LogNormal(1.0, 0.05),
        plate_offset_mm=Uniform(-0.2, 0.2),
        plate_turn_deg=Normal(0.0, 1.25),
        edge_offset_mm=Uniform(-0.08, 0.08),
        film_ratio=LogNormal(1.0, 0.12),
        film_ohm_ratio=LogNormal(1.0, 0.25),
        contact_share=Uniform(0.0, 0.12),
        alpha_offset=Normal(0.0, 0.08),
        hysteresis=Uniform(0.05, 0.15),
        creep=Uniform(0.05, 0.13),
        stiffening=Uniform(0.0, 0.12),
    ),
    ResponseSpread(
        position_offset_mm=Normal(0.0, 0.5),
        width_ratio=LogNormal(1.0, 0.12),
        signal_ratio=LogNormal(1.0, 0.2),
        crosstalk=Uniform(0.0, 0.05),
        tail=Uniform(0.0, 0.25),
        film_unevenness=Normal(0.0, 0.03),
        field_n=LogNormal(0.3, 0.6),
        field_tilt=Normal(0.0, 0.25),
        kind=replace(ELASTOMER, law=replace(ELASTOMER.law, hysteresis=PlayLoops(0.15, 5.0))),
    ),
)

WORLDS: Mapping[str, World] = MappingProxyType({world.name: world for world in (_IDEAL, _DEFAULT, _HARSH)})
"""`ideal` (exactly as in the file, with noise and quantisation), `default` (that of a careful builder),
`harsh` (two to three times wider, with sheets and patches that estimators have no model of)."""


def world_with(world: World, *, sheet: str | None = None, drift: bool = False) -> World:
    """Return a world with sheets of one kind, and with drift if it has none.

    In a world of ideal sheets or electronics they vary and drift as in `default`. `sheet` is one of
    `SHEET_KINDS`.
    """
    if sheet:
        world = world.with_sheets(SHEET_KINDS[sheet])
        if world.sheets.parameter_ratio == ONE:
            varied = replace(world.sheets, parameter_ratio=_DEFAULT.sheets.parameter_ratio)
            world = replace(world, sheets=varied)
    if drift and world.electronics == ElectronicsSpread():
        world = replace(world, electronics=replace(_DEFAULT.electronics, noise_ratio=ONE))
    return world


def world_named(world: str | World) -> World:
    """Return a world by its name. Raises ValueError for an unknown one."""
    if isinstance(world, World):
        return world
    if world not in WORLDS:
        raise ValueError(f'there is no world "{world}"; known: {", ".join(WORLDS)}')
    return WORLDS[world]
