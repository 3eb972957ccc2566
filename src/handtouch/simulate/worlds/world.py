"""World: distributions of all hidden quantities of a simulated hand, and draws from them.

Public names: `World`; `DrawnWorld` (the world of one seed) with its records `HiddenPad`, `HiddenChannels`,
`HiddenContact`, `HiddenJoints`.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field, replace

import numpy as np

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.hand.pads import mount_transform, rotation_from_rpy
from handtouch.simulate.contact_patch import ContactPatch, Profile
from handtouch.simulate.pad_geometry import SimulatedSurface
from handtouch.simulate.sheet_physics import SheetLaw
from handtouch.simulate.surfaces import simulated_surface
from handtouch.simulate.worlds.distributions import Distribution
from handtouch.simulate.worlds.families import Family
from handtouch.simulate.worlds.response_spread import HiddenResponse, ResponseSpread
from handtouch.simulate.worlds.shear_spread import HiddenShear, ShearSpread
from handtouch.simulate.worlds.sheet_kinds import SheetKind
from handtouch.simulate.worlds.spreads import (
    ContactSpread,
    ElectronicsSpread,
    MountSpread,
    PartSpread,
    SheetSpread,
)

PerElectrode = tuple[float, ...]
_MIN_RADIUS_RATIO = 0.3
_UNEVENNESS_STD, _ELONGATION_STD, _TILT_STD = 0.01, 0.4, 0.3
"""Of films and contacts, as builders state them who know of all profiles and haven't measured the film."""
_MAX_ARC_GROWTH = 0.4  # growth at each end over the shortest bare stretch between electrodes on arcs
UNEVEN_MODES = ((1, 0), (0, 1), (1, 1), (2, 0), (0, 2))
"""Waves (m, n), cos(m pi x) cos(n pi y), of the logarithm of an uneven sheet's resistance."""


@dataclass(frozen=True)
class World:
    """Distributions of all hidden quantities; `WORLDS` has the named ones."""

    name: str
    parts: PartSpread = field(default_factory=PartSpread)
    mounts: MountSpread = field(default_factory=MountSpread)
    contacts: ContactSpread = field(default_factory=ContactSpread)
    sheets: SheetSpread = field(default_factory=SheetSpread)
    electronics: ElectronicsSpread = field(default_factory=ElectronicsSpread)
    shear: ShearSpread = field(default_factory=ShearSpread)
    responses: ResponseSpread = field(default_factory=ResponseSpread)

    def draw(self, seed: int) -> DrawnWorld:
        """Return the world of one seed; raises ValueError for a seed of no `Family`."""
        return DrawnWorld(self, seed)

    def only(self, *groups: str) -> World:
        """Return a world with these groups of this one, such as "parts"; the others are ideal."""
        return World(self.name, **{group: getattr(self, group) for group in groups})

    def with_sheets(self, *kinds: SheetKind) -> World:
        """Return this world with the behaviour of these kinds, for both families; none: ideal sheets.

        Their parameters vary between pads as in this world.
        """
        return replace(self, sheets=replace(self.sheets, tuning_kinds=kinds, reporting_kinds=kinds))


@dataclass(frozen=True)
class HiddenPad:
    """True properties of a pad, electrodes in their order. Ratios are to values of the file."""

    gain_ratio: PerElectrode
    series_ohm: PerElectrode
    gap_before_mm: PerElectrode
    """Bare length of each electrode's side, along the surface, at its low end (y = 0 or x = 0), or of its arc
    at its begin."""
    gap_after_mm: PerElectrode
    """Bare length at its high end."""
    sheet_ohm_ratio: float
    anisotropy_ratio: float
    unevenness: tuple[float, ...]
    """Amplitudes of the waves `UNEVEN_MODES` of the logarithm of the sheet resistance."""
    length_offset_mm: float
    width_offset_mm: float
    mount_offset_mm: tuple[float, float, float]
    mount_rotation_deg: tuple[float, float, float]
    contact_ohm_ratio: float
    alpha_offset: float
    sheet_law: SheetLaw | None
    """Behaviour of the sheet; None: ideal."""
    noise_ratio: float
    offset_counts_per_k: PerElectrode
    gain_per_k: PerElectrode


@dataclass(frozen=True)
class HiddenChannels:
    """Errors of the channels of a pad, see `ElectronicsSpread`."""

    crosstalk: float
    nonlinearity_counts: PerElectrode
    hum_counts: float
    common_noise_counts: float


@dataclass(frozen=True)
class HiddenContact:
    """True patch of a touch: an ellipse with half axes radius sqrt(elongation), radius / sqrt(elongation)."""

    radius_mm: float
    elongation: float
    direction_rad: float
    """Angle between the long axis and x on the pad."""
    hertz_force_n: float | None = None
    """Force at which it has this size; None: at every force."""

    profile: Profile = "uniform"

    @property
    def patch(self) -> ContactPatch:
        """The patch, in metres."""
        return ContactPatch(
            1e-3 * self.radius_mm, self.elongation, self.direction_rad, self.profile, self.hertz_force_n
        )


@dataclass(frozen=True)
class HiddenJoints:
    """Errors of the joint positions that a robot reports."""

    offset_deg: tuple[float, ...]
    """Error of each joint's zero."""
    noise_deg: float
    """Standard deviation of a reading."""
    delay_s: float
    """Age of a reading at its time stamp."""
    std_deg: float
    """Standard deviation of zero and noise, as the data sheet of the encoders has it."""


@dataclass(frozen=True)
class DrawnWorld:
    """World of one seed. All methods are functions of their arguments; the same seed gives the same world.

    Raises ValueError for a seed of no `Family`.
    """

    world: World
    seed: int
    sheet_number: int = 0
    """Number of the sheets that replace the first ones."""
    family: Family = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "family", Family.of_seed(self.seed))

    def pad(self, hand: str, pad: config.Pad) -> HiddenPad:
        """Return the properties of a pad; they depend only on the seed, the names and the pad's own table."""
        name = f"{hand}/{pad.link}"
        drawn = self._draw_pad(name, pad)
        if not self.sheet_number:
            return drawn
        other = self._draw_pad(f"{name}/sheet {self.sheet_number}", pad)
        return replace(drawn, **{part: getattr(other, part) for part in _PARTS_OF_SHEET})

    def _draw_pad(self, link: str, pad: config.Pad) -> HiddenPad:
        parts, mounts, sheets = self.world.parts, self.world.mounts, self.world.sheets
        electronics = self.world.electronics
        unevenness = self.world.responses.film_unevenness if pad.response else parts.unevenness
        rng = self._stream(link)
        count = len(pad.electrode_names)
        gain = parts.gain_ratio.sample(rng, count)
        resistors = parts.resistor_ratio.sample(rng, count)
        nominal = np.array(pad.gaps_mm).T.ravel()
        gaps = np.maximum(nominal + parts.gap_offset_mm.sample(rng, 2 * count), _least_gap_mm(pad))
        mount = self._stream("mount", link)
        return HiddenPad(
            gain_ratio=_floats(gain),
            series_ohm=_floats(np.array(pad.series_ohm) * resistors + self.lead_ohm(link, count)),
            gap_before_mm=_floats(gaps[:count]),
            gap_after_mm=_floats(gaps[count:]),
            sheet_ohm_ratio=self._number(parts.sheet_ohm_ratio, "sheet_ohm", link),
            anisotropy_ratio=self._number(parts.anisotropy_ratio, "anisotropy", link),
            unevenness=tuple(self._numbers(unevenness, len(UNEVEN_MODES), "unevenness", link).tolist()),
            length_offset_mm=self._number(parts.length_offset_mm, "length", link),
            width_offset_mm=self._number(parts.width_offset_mm, "width", link),
            mount_offset_mm=_three(mounts.position_mm.sample(mount, 3)),
            mount_rotation_deg=_three(mounts.orientation_deg.sample(mount, 3)),
            contact_ohm_ratio=self._number(sheets.contact_ohm_ratio, "contact_ohm", link),
            alpha_offset=self._number(sheets.alpha_offset, "alpha", link),
            sheet_law=self._sheet_law(link, self._kind_of(pad)),
            noise_ratio=self._number(electronics.noise_ratio, "noise_ratio", link),
            offset_counts_per_k=_floats(self.offset_counts_per_k(link, count)),
            gain_per_k=_floats(self.gain_per_k(link, count)),
        )

    def mount(self, hand: str, pad: config.Pad) -> tuple[FloatArray, FloatArray]:
        """Return the true rotation (3, 3) and translation (3,) [m] of the pad's frame in its link's frame."""
        hidden = self.pad(hand, pad)
        rotation, translation = mount_transform(pad)
        turned = rotation @ rotation_from_rpy(np.radians(hidden.mount_rotation_deg))
        return turned, translation + rotation @ (1e-3 * np.array(hidden.mount_offset_mm))

    def surface(self, hand: str, pad: config.Pad) -> SimulatedSurface:
        """Return the true shape of a pad, with its anisotropy."""
        hidden = self.pad(hand, pad)
        shape = simulated_surface(pad.surface)
        sized = shape.resized(1e-3 * hidden.length_offset_mm, 1e-3 * hidden.width_offset_mm)
        return replace(sized, resistivity_ratio=shape.resistivity_ratio * hidden.anisotropy_ratio)

    def sheet(self, hand: str, pad: config.Pad, sheet: config.Sheet) -> config.Sheet:
        """Return the true sheet resistance and contact law of a pad whose table names `sheet`."""
        hidden = self.pad(hand, pad)
        return sheet.model_copy(
            update={
                "ohm_per_square": sheet.ohm_per_square * hidden.sheet_ohm_ratio,
                "contact_ohm_mm2": sheet.contact_ohm_mm2 * hidden.contact_ohm_ratio,
                "alpha": sheet.alpha + hidden.alpha_offset,
            }
        )

    def contact(self, sheet: config.Sheet, touch: int) -> HiddenContact:
        """Return the patch of a touch; `touch` is its number in the scenario."""
        contacts = self.world.contacts
        sigma = contacts.radius_sigma.sample(np.random.default_rng((self.seed, touch)), 1)[0]
        radius_mm = sheet.contact_radius_mm + float(sigma) * sheet.contact_radius_std_mm
        patch = self._stream("patch", str(touch))
        elongation = float(contacts.elongation.sample(patch, 1)[0])
        return HiddenContact(
            max(radius_mm, _MIN_RADIUS_RATIO * sheet.contact_radius_mm),
            elongation,
            float(patch.uniform(0, np.pi)),
            sheet.hertz_force_n,
            contacts.profile.names[int(contacts.profile.sample(patch, 1)[0])],
        )

    def response(self, pad_name: str, count: int) -> HiddenResponse:
        """Return the properties of the n channels of a pad, "hand/link", that isn't a sheet."""
        return HiddenResponse.draw(
            self.world.responses,
            count,
            lambda spread, size, name: self._numbers(spread, size, "response", name, pad_name),
        )

    def magnetic_field(self, hand: str) -> FloatArray:
        """Return the direction (3,) of the Earth's field in a hand's base at the start."""
        field = self._stream("magnetic_field", hand).normal(size=3)
        return np.asarray(field / np.linalg.norm(field))

    def shear(self, pad_name: str) -> HiddenShear:
        """Return the properties of the shear pattern and layer of a pad, "hand/link"."""
        return HiddenShear.draw(
            self.world.shear,
            lambda spread, count, name: self._numbers(spread, count, "shear", name, pad_name),
        )

    def shear_gain(self, pad_name: str) -> FloatArray:
        """Return the gains (4,) of the channels of a shear pad, "hand/link", relative to configured ones."""
        return self._numbers(self.world.parts.gain_ratio, 4, "shear_gain", pad_name)

    def joints(self, hand: str, count: int) -> HiddenJoints:
        """Return the errors of a hand's joint positions."""
        mounts, rng = self.world.mounts, self._stream("joints", hand)
        noise_deg, delay_s = mounts.joint_noise_deg.sample(rng, 1)[0], mounts.joint_delay_s.sample(rng, 1)[0]
        offsets = mounts.joint_offset_deg.sample(rng, count)
        std_deg = float(np.hypot(mounts.joint_offset_deg.std, noise_deg))
        return HiddenJoints(tuple(offsets.tolist()), float(noise_deg), float(delay_s), std_deg)

    def replacement_gain(self, serial: int, count: int = 4) -> PerElectrode:
        """Return the channel gains of a replacement node."""
        rng = np.random.default_rng((self.seed, serial, 1))
        return _floats(self.world.parts.gain_ratio.sample(rng, count))

    def sheet_kind(self, sheet: str) -> SheetKind | None:
        """Return the kind of the file's sheets of a name; None: ideal."""
        kinds = self.world.sheets.kinds(self.family)
        return kinds[int(self._stream("kind", sheet).integers(len(kinds)))] if kinds else None

    def describe(self, deployment: config.Deployment) -> config.Deployment:
        """Return the deployment as its builder writes it: with the nominal behaviour of the drawn kinds, and
        with the tolerances of his parts and mounts."""
        parts, law = self.world.parts, self.world.sheets
        contacts, careful = self.world.contacts, len(self.world.contacts.profile.names) > 1
        of_node = {
            "gain_std": parts.gain_ratio.std,
            "series_std": parts.resistor_ratio.std,
            "series_std_ohm": float(np.hypot(parts.lead_ohm.mean, parts.lead_ohm.std)),
        }
        of_sheet = {
            "ohm_per_square_std": parts.sheet_ohm_ratio.std,
            "contact_ohm_std": law.contact_ohm_ratio.std,
            "alpha_std": law.alpha_offset.std,
            "anisotropy_std": parts.anisotropy_ratio.std,
            "unevenness_std": max(parts.unevenness.std, _UNEVENNESS_STD * careful),
            "contact_elongation_std": max(float(np.log(contacts.elongation.mean)), _ELONGATION_STD * careful),
            "contact_tilt_std": _TILT_STD * careful,
            "gap_std_mm": parts.gap_offset_mm.std,
            "size_std_mm": max(parts.length_offset_mm.std, parts.width_offset_mm.std),
        }
        sheets = {}
        for name, sheet in deployment.sheets.items():
            kind = self.sheet_kind(name)
            behaviour = {"behaviour": kind.behaviour} if kind else {}
            sheets[name] = sheet.model_copy(update=of_sheet | behaviour)
        nodes = {name: node.model_copy(update=of_node) for name, node in deployment.nodes.items()}
        shears = {name: self.world.shear.describe(shear) for name, shear in deployment.shears.items()}
        mounts = self.world.mounts
        of_hand = {"mount_std_mm": mounts.position_mm.std, "mount_std_deg": mounts.orientation_deg.std}
        hands = tuple(hand.model_copy(update=of_hand) for hand in deployment.hands)
        update = {"sheets": sheets, "nodes": nodes, "shears": shears, "hands": hands}
        of_films = of_sheet | {"lead_std_ohm": of_node["series_std_ohm"]}
        return self.world.responses.describe(deployment.model_copy(update=update), of_films)

    def lead_ohm(self, pad_name: str, count: int = 4) -> FloatArray:
        """Return the resistances (count,) of the leads of a pad's electrodes, "hand/link" [ohm]."""
        return self._numbers(self.world.parts.lead_ohm, count, "lead_ohm", pad_name)

    def channel_errors(self, pad_name: str, count: int = 4) -> HiddenChannels:
        """Return the errors of the channels of a pad, "hand/link"."""
        spread = self.world.electronics
        return HiddenChannels(
            self._number(spread.crosstalk, "crosstalk", pad_name),
            _floats(self._numbers(spread.nonlinearity_counts, count, "nonlinearity_counts", pad_name)),
            self._number(spread.hum_counts, "hum_counts", pad_name),
            self._number(spread.common_noise_counts, "common_noise_counts", pad_name),
        )

    def offset_counts_per_k(self, pad_name: str, count: int = 4) -> FloatArray:
        """Return the temperature coefficients (count,) of the zeros of a pad, "hand/link"."""
        return self._numbers(
            self.world.electronics.offset_counts_per_k, count, "offset_counts_per_k", pad_name
        )

    def zero_counts(self, pad_name: str, count: int = 4) -> FloatArray:
        """Return the zeros (count,) of the channels of a pad, "hand/link", at the start."""
        return self._numbers(self.world.electronics.zero_counts, count, "zero_counts", pad_name)

    def gain_per_k(self, pad_name: str, count: int = 4) -> FloatArray:
        """Return the relative temperature coefficients (count,) of the gains of a pad, "hand/link"."""
        return self._numbers(self.world.electronics.gain_per_k, count, "gain_per_k", pad_name)

    def hand_rate(self, rate: Distribution, name: str) -> float:
        """Return a quantity with one value per hand, such as a drift rate."""
        return self._number(rate, name)

    def sheet_factors(self, pad_name: str) -> list[float]:
        """Return the factors of `SheetKind.varied` for the sheet of a pad, "hand/link"."""
        factors = self._numbers(self.world.sheets.parameter_ratio, 6, "sheet", pad_name)
        return [float(factor) for factor in factors]

    def _kind_of(self, pad: config.Pad) -> SheetKind | None:
        return self.world.responses.kind if pad.response else self.sheet_kind(pad.sheet)

    def _sheet_law(self, pad_name: str, kind: SheetKind | None) -> SheetLaw | None:
        return kind.varied(*self.sheet_factors(pad_name)) if kind else None

    def _number(self, distribution: Distribution, *names: str) -> float:
        return float(self._numbers(distribution, 1, *names)[0])

    def _numbers(self, distribution: Distribution, count: int, *names: str) -> FloatArray:
        return distribution.sample(self._stream(*names), count)

    def _stream(self, *names: str) -> np.random.Generator:
        """Return the random stream of some quantities of an object, independent of all others."""
        return np.random.default_rng((self.seed, zlib.crc32("/".join(names).encode())))


_PARTS_OF_SHEET = (
    "gap_before_mm",
    "gap_after_mm",
    "sheet_ohm_ratio",
    "anisotropy_ratio",
    "unevenness",
    "contact_ohm_ratio",
    "alpha_offset",
    "sheet_law",
)
"""Properties of a pad that a new sheet on the same node changes."""


def _least_gap_mm(pad: config.Pad) -> float:
    """Return the least gap of a pad's electrodes: arcs may be longer than stated, without touching."""
    ends = np.array(pad.arcs_mm).reshape(-1, 2)
    bare = np.roll(ends[:, 0], -1) - ends[:, 1]
    between = bare[bare > 0]  # not that with the first vertex, from where lengths begin again
    return -_MAX_ARC_GROWTH * float(between.min()) if between.size else 0.0


def _floats(values: FloatArray) -> PerElectrode:
    return tuple(map(float, values))


def _three(values: FloatArray) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
