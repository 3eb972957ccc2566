"""Groups of distributions of the properties of a simulated hand that its deployment file doesn't know.

Public names: `PartSpread`, `MountSpread`, `ContactSpread`, `SheetSpread`, `ElectronicsSpread`. Their defaults
are those of a hand exactly as in its file. docs/worlds.md has the values of the named worlds, with sources.
"""

from __future__ import annotations

from dataclasses import dataclass

from handtouch.simulate.contact_patch import PROFILES, Profile
from handtouch.simulate.worlds.distributions import Distribution, Fixed, OneOf
from handtouch.simulate.worlds.families import Family
from handtouch.simulate.worlds.sheet_kinds import SheetKind

ZERO, ONE = Fixed(0.0), Fixed(1.0)
UNIFORM: OneOf[Profile] = OneOf(PROFILES[:1])


@dataclass(frozen=True)
class PartSpread:
    """Parts of each pad: electrodes, resistors, sheet, size. Ratios and offsets are to configured values."""

    gain_ratio: Distribution = ONE
    """Gain of a channel."""
    gap_offset_mm: Distribution = ZERO
    """Bare length at each end of each electrode, less the configured one; a length below 0 counts as 0."""
    resistor_ratio: Distribution = ONE
    """Series resistor of an electrode."""
    lead_ohm: Distribution = ZERO
    """Resistance of an electrode's lead and of the electrode itself, besides series resistors."""
    sheet_ohm_ratio: Distribution = ONE
    """Sheet resistance."""
    anisotropy_ratio: Distribution = ONE
    """Resistivity along x over that along y."""
    unevenness: Distribution = ZERO
    """Amplitude of each of the five smoothest waves of the logarithm of the sheet resistance."""
    length_offset_mm: Distribution = ZERO
    """Length of the pad along x."""
    width_offset_mm: Distribution = ZERO
    """Width of the pad along y, in its middle."""


@dataclass(frozen=True)
class MountSpread:
    """Pose of each pad on its link, and reported positions of the joints."""

    position_mm: Distribution = ZERO
    """Each component of a pad's displacement."""
    orientation_deg: Distribution = ZERO
    """Each component of its rotation."""
    joint_offset_deg: Distribution = ZERO
    """Error of a joint's zero."""
    joint_noise_deg: Distribution = ZERO
    """Standard deviation of a joint's reading, one value per hand."""
    joint_delay_s: Distribution = ZERO
    """Age of a joint's reading at its time stamp, one value per hand."""


@dataclass(frozen=True)
class ContactSpread:
    """Patch of each touch."""

    radius_sigma: Distribution = ZERO
    """Radius less the assumed one, in units of the sheet's contact_radius_std_mm; at least 0.3 of it."""
    elongation: Distribution = ONE
    """Length over width of the elliptical patch; its direction is uniform, its area that of the radius."""
    profile: OneOf[Profile] = UNIFORM
    """How its pressure is distributed, one of `PROFILES`."""


@dataclass(frozen=True)
class SheetSpread:
    """Contact law and behaviour of each pad's sheet. Sheets of one name in the file are of one kind."""

    contact_ohm_ratio: Distribution = ONE
    """Contact resistance at the reference pressure."""
    alpha_offset: Distribution = ZERO
    """Exponent of the contact law, less the configured one."""
    tuning_kinds: tuple[SheetKind, ...] = ()
    """Kinds of behaviour for seeds of `Family.TUNING`; none: ideal sheets."""
    reporting_kinds: tuple[SheetKind, ...] = ()
    """The same for seeds of `Family.REPORTING`."""
    parameter_ratio: Distribution = ONE
    """Each of six parameters of a pad's behaviour over that of its kind (`SheetKind.varied`)."""

    def kinds(self, family: Family) -> tuple[SheetKind, ...]:
        """Return the kinds that seeds of a family draw."""
        return self.tuning_kinds if family is Family.TUNING else self.reporting_kinds


@dataclass(frozen=True)
class ElectronicsSpread:
    """Noise and drift of the electronics. Drifts are smooth random walks of bounded rate."""

    noise_ratio: Distribution = ONE
    """Standard deviation of a pad's readings."""
    common_noise_counts: Distribution = ZERO
    """Standard deviation of noise that all channels of a pad share."""
    hum_counts: Distribution = ZERO
    """Amplitude of hum of the mains, the same in all channels of a pad."""
    crosstalk: Distribution = ZERO
    """Share of the channel converted before that a channel reads, one value per pad."""
    nonlinearity_counts: Distribution = ZERO
    """Amplitude of a channel's error by its converter's non-linearity."""
    zero_counts: Distribution = ZERO
    """Reading of a channel without current at the start."""
    warm_up_k: Distribution = ZERO
    """Temperature by which the hand warms, evenly, in the two minutes after its start."""
    zero_drift_counts_per_s: Distribution = ZERO
    """Maximum drift rate of a channel's zero, one value per hand; channels drift independently."""
    temperature_drift_k_per_s: Distribution = ZERO
    """Maximum drift rate of the hand's temperature."""
    offset_counts_per_k: Distribution = ZERO
    """Temperature coefficient of a channel's zero."""
    gain_per_k: Distribution = ZERO
    """Relative temperature coefficient of a channel's gain."""
    supply_drift_per_s: Distribution = ZERO
    """Maximum relative drift rate of the supply voltage."""
