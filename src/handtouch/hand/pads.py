"""Surface, electrodes and mount of a pad in SI units, from its table in the deployment.

Public names: `pad_surface`, `mount_transform`, `network_parameters`, `pad_channels`, `pad_network`,
`press_map`, `channel_gain_std`, `electrode_network`, `models_with_other_parts`, `part_stds`, `part_limits`,
`series_ohm_stds`, `shape_stds`, `elongation_stds`, `metres_per_unit`, `relative_size_stds`,
`log_aspect_std`, `rotation_from_rpy`, `MountUncertainty`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch import config, field
from handtouch.config.responses import ForceLaw, ResponseTable
from handtouch.field.channel_map import VARIATIONS, ChangedMap, ChannelMap
from handtouch.field.contact_law import ContactLaw
from handtouch.field.model import ChannelModel, FractionModel
from handtouch.field.network import SIDES, Electrode, ElectrodeNetwork
from handtouch.field.surface_base import Surface
from handtouch.field.uneven_sheet import UNEVEN_WAVES, UnevenSheet

_M_PER_MM = 1e-3
_MAP_GAIN_STD = 1e-3  # drift of gains since a map was measured, of which they are part
LEAD_STD_OHM = 20.0
"""Standard deviation of leads of silver ink, or of worn plugs, as contacts may find it: up to 35 ohm."""


def pad_surface(pad: config.Pad) -> Surface:
    """Return the surface that a pad covers, in metres and radians."""
    return pad.surface.build()


def mount_transform(pad: config.Pad) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rotation (3, 3) and translation (3,) [m] from the pad frame to its link frame."""
    turn, at = rotation_from_rpy(np.radians(pad.mount.rpy_deg)), np.array(pad.mount.position_mm) * _M_PER_MM
    axes, origin = pad_surface(pad).frame
    return turn @ axes, at + turn @ origin


class MountUncertainty:
    """Uncertainty of the mounts of a hand's pads on their links."""

    def __init__(self, hand: config.HandTable) -> None:
        self.origin_m = np.array([mount_transform(pad)[1] for pad in hand.pads])
        """(n, 3) of the pads on their links"""
        self.position_variance_m2 = (hand.mount_std_mm * _M_PER_MM) ** 2
        """along each axis"""
        self.rotation_variance_rad2 = math.radians(hand.mount_std_deg) ** 2
        """about each axis"""


def rotation_from_rpy(rpy_rad: ArrayLike) -> NDArray[np.float64]:
    """Return the matrix (3, 3) of roll, pitch and yaw [rad] about the fixed axes x, y and z, as in URDF."""
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy_rad), np.cos(rpy_rad)
    roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    yaw = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return np.asarray(yaw @ pitch @ roll)


def network_parameters(pad: config.Pad) -> tuple[object, ...]:
    """Return what `pad_channels` depends on, but for the sheet: pads with the same share a network."""
    parts = pad.surface, pad.response, pad.resistance_map, pad.press_map
    return *parts, pad.arcs_mm, pad.gaps_mm, pad.series_ohm, pad.state_numbers


def pad_channels(pad: config.Pad, sheet: config.Sheet, node: config.Node) -> ChannelModel:
    """Return the pad's electrodes, or the map of its response, as its presses show them if there are any."""
    if pad.press_map is not None:
        return press_map(pad, sheet, node, config.presses_of(pad.press_map))
    if isinstance(pad.response, ResponseTable):
        return pad.response.build(pad_surface(pad))
    return pad_network(pad, sheet)


def press_map(
    pad: config.Pad, sheet: config.Sheet, node: config.Node, presses: field.PressTable
) -> field.MeasuredMap:
    """Return the map of a pad that presses at known places show, from what is stated of its parts on.

    Raises ValueError for presses of other channels.
    """
    stated = pad.model_copy(update={"press_map": None})
    theory = pad_channels(stated, sheet, node)
    prior = field.MapPrior(
        theory,
        models_with_other_parts(theory, stated, node, sheet),
        node.gain_std,
        relative_size_stds(stated, sheet),
    )
    response = pad.response if isinstance(pad.response, ForceLaw) else None
    radius_mm, std_mm, elongation = (
        (response.contact_radius_mm, response.contact_radius_std_mm, response.contact_elongation_std)
        if response
        else (
            math.hypot(sheet.contact_radius_mm, sheet.contact_radius_std_mm),
            0.0,
            sheet.contact_elongation_std,
        )
    )
    sizes = _M_PER_MM * radius_mm, _M_PER_MM * std_mm, elongation
    return field.MeasuredMap(pad_surface(pad), presses, prior, *sizes)


def channel_gain_std(pad: config.Pad, node: config.Node) -> float:
    """Return the standard deviation of the logarithm of a channel's gain, of what isn't in its map."""
    if pad.press_map is None:
        return node.gain_std
    serial = config.presses_of(pad.press_map).serial
    if None not in (serial, pad.serial) and serial != pad.serial:  # another node than was pressed
        return node.gain_std
    return min(_MAP_GAIN_STD, node.gain_std)


def pad_network(pad: config.Pad, sheet: config.Sheet) -> ElectrodeNetwork:
    """Return the pad's electrodes on its rectangle, whether on its sides or on arcs of its outline, and with
    their schedule if they are switched. Raises ValueError for a pad without electrodes."""
    if pad.response:
        raise ValueError(f"{pad.link}: has a response, and no electrodes")
    if not pad.arcs_mm:
        return electrode_network(pad, sheet)
    surface = pad_surface(pad)
    if surface.perimeter_m is None:
        raise ValueError("electrode_arcs_mm: only pads with an outline or on a mesh have arcs")
    ends_m = _M_PER_MM * (np.array(pad.arcs_mm) + np.array(pad.gaps_mm) * (1.0, -1.0))
    spans = surface.perimeter_positions(ends_m)
    network = ElectrodeNetwork.from_arcs(surface.a, surface.b, spans, sheet.ohm_per_square, pad.series_ohm)
    return _on_film(network.switched(pad.state_numbers) if pad.switch_states else network, pad, sheet)


def _on_film(network: ElectrodeNetwork, pad: config.Pad, sheet: config.Sheet) -> ElectrodeNetwork:
    """Return a pad's network on its film, if its resistance was measured."""
    if pad.resistance_map is None:
        return network
    surface = pad_surface(pad)
    scale = float(surface.scale(surface.a / 2, surface.b / 2))
    radius = _M_PER_MM * sheet.contact_radius_mm / scale
    return field.UnevenNetwork.on_film(network, config.film_of(pad.resistance_map), surface, radius)


def sheet_law(
    sheet: config.Sheet, contact_ohm_mm2: float, alpha: float, hertz_force_n: float | None
) -> ContactLaw:
    """Return a contact law in SI units, with the contact radius of the deployment's sheet."""
    return ContactLaw(
        contact_ohm_m2=contact_ohm_mm2 * 1e-6,
        alpha=alpha,
        radius_m=sheet.contact_radius_mm * 1e-3,
        radius_std_m=sheet.contact_radius_std_mm * 1e-3,
        reference_pa=sheet.reference_kpa * 1e3,
        hertz_n=hertz_force_n,
    )


def electrode_network(pad: config.Pad, sheet: config.Sheet) -> ElectrodeNetwork:
    """Return the four electrodes of a pad on its rectangle, with the bare corners as measured on the surface.

    A gap below 0 counts as 0. Raises ValueError for a pad with electrodes on arcs of its outline, which has a
    `pad_network` only.
    """
    if pad.arcs_mm:
        raise ValueError(f"{pad.link}: not supported for electrodes on arcs (electrode_arcs_mm)")
    surface = pad_surface(pad)
    gaps_m = np.maximum(np.array(pad.gaps_mm) * _M_PER_MM, 0.0).tolist()
    electrodes = [
        Electrode(side, *surface.electrode_span(side, *ends))
        for side, ends in zip(SIDES, gaps_m, strict=True)
    ]
    network = ElectrodeNetwork.from_sides(
        surface.a, surface.b, electrodes, sheet.ohm_per_square, pad.series_ohm
    )
    return _on_film(network, pad, sheet)


def models_with_other_parts(
    nominal: ChannelModel, pad: config.Pad, node: config.Node, sheet: config.Sheet
) -> tuple[FractionModel, ...]:
    """Return models in each of which one part of the pad differs by one standard deviation; gains aside.

    In the order of `part_stds`; `nominal` itself, the pad's network, for parts without a tolerance.
    """
    stds, ohm = part_stds(pad, node, sheet), np.array(pad.series_ohm)
    if isinstance(nominal, ChannelMap):
        own = 2 * nominal.channels
        changed = [ChangedMap(nominal, slot) for slot in range(own + VARIATIONS)]
        others = [nominal] * (nominal.channels + 1)
        return (*changed[:own], nominal, *changed[own:], *others)
    assert isinstance(nominal, ElectrodeNetwork)
    models: list[FractionModel] = []
    gap_std_m = sheet.gap_std_mm * _M_PER_MM
    steps = gap_std_m / metres_per_unit(pad, nominal)
    models += [nominal.with_moved_end(end, step) for end, step in enumerate(steps.tolist())]
    models.append(nominal.stretched(math.exp(log_aspect_std(pad, sheet))))
    models += [UnevenSheet(nominal, wave, sheet.unevenness_std) for wave in range(len(UNEVEN_WAVES))]
    models += [nominal.with_series_ohm((ohm + more).tolist()) for more in np.diag(series_ohm_stds(pad, node))]
    models.append(nominal.with_series_ohm((ohm * math.exp(-sheet.ohm_per_square_std)).tolist()))
    return tuple(model if std else nominal for model, std in zip(models, stds, strict=True))


def part_stds(pad: config.Pad, node: config.Node, sheet: config.Sheet) -> tuple[float, ...]:
    """Return the standard deviations of a pad's parts; 0 for those that don't matter.

    Gaps [mm] at both ends of each electrode; logarithms of the ratio of the sides, of the waves of the sheet
    resistance (`UNEVEN_WAVES`); each series resistor with its lead [ohm]; logarithm of the sheet resistance
    beside these. Of a response, those are multiples of what its parts are off by.
    """
    if pad.press_map is not None or isinstance(pad.response, ResponseTable):
        count = len(pad.electrode_names)
        return (*(1.0,) * (2 * count), 0.0, *(1.0,) * VARIATIONS, *(0.0,) * (count + 1))
    count = len(pad.electrode_names)
    sheet_std = sheet.ohm_per_square_std if any(pad.series_ohm) else 0.0
    resistors = (*series_ohm_stds(pad, node).tolist(), sheet_std)
    waves = (sheet.unevenness_std,) * len(UNEVEN_WAVES)
    return (*(sheet.gap_std_mm,) * (2 * count), log_aspect_std(pad, sheet), *waves, *resistors)


def part_limits(pad: config.Pad, node: config.Node) -> tuple[float, ...]:
    """Return how many times its stated deviation a pad's part may have, (p,) in the order of `part_stds`.

    Only leads aren't known by those who state them: nobody sees what silver ink or a plug adds.
    """
    stds = series_ohm_stds(pad, node)
    leads = np.maximum(LEAD_STD_OHM / np.where(stds > 0, stds, LEAD_STD_OHM), 1.0)
    before = (1.0,) * (2 * len(stds) + 1 + len(UNEVEN_WAVES))
    return (*before, *leads.tolist(), 1.0)


def series_ohm_stds(pad: config.Pad, node: config.Node) -> NDArray[np.float64]:
    """Return the standard deviations of the resistances from a pad's electrodes to ground, (c,) [ohm].

    0 where electrodes touch, and where there are none.
    """
    if pad.response or pad.press_map or not np.min(pad.gaps_mm) > 0:
        return np.zeros(len(pad.electrode_names))
    return np.hypot(node.series_std * np.array(pad.series_ohm), node.series_std_ohm)


def shape_stds(
    pad: config.Pad, sheet: config.Sheet, network: ChannelModel
) -> tuple[NDArray[np.float64], float]:
    """Return the standard deviations of the ends of a pad's electrodes (2 c,), in units of its rectangle, and
    of its waves; of a map, whose changes are those by one standard deviation, ones."""
    if isinstance(network, ChannelMap):
        return np.ones(2 * network.channels), 1.0
    assert isinstance(network, ElectrodeNetwork)
    return sheet.gap_std_mm * _M_PER_MM / metres_per_unit(pad, network), sheet.unevenness_std


def elongation_stds(
    sheet: config.Sheet, surface: Surface, network: ChannelModel, x: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return half the standard deviation of the difference of variances of a contact's current, at x (k,).

    Along the rectangle's axes, in squares of its unit, of elliptical patches of pressure in all directions.
    """
    if isinstance(network, ChannelMap):
        return np.ascontiguousarray(network.patch_std(x, np.full(len(x), surface.b / 2)))
    area_m2 = (sheet.contact_radius_mm**2 + sheet.contact_radius_std_mm**2) * _M_PER_MM**2
    difference_m2 = area_m2 / 4 * 2 * math.sinh(sheet.contact_elongation_std)
    inside = np.clip(x, 1e-6 * surface.a, (1 - 1e-6) * surface.a)
    along_x, along_y = surface.scales(inside, np.full(len(x), surface.b / 2))
    return np.ascontiguousarray(difference_m2 / (2 * math.sqrt(2)) / (along_x * along_y))


def metres_per_unit(pad: config.Pad, network: ElectrodeNetwork) -> NDArray[np.float64]:
    """Return the length on the surface of a unit of the rectangle, along each electrode at each end, (2 c,).

    `network`: the pad's.
    """
    surface = pad_surface(pad)
    return np.array([float(surface.scales(end.x, end.y)[end.axis]) for end in network.ends])


def relative_size_stds(pad: config.Pad, sheet: config.Sheet) -> tuple[float, float]:
    """Return the relative standard deviations of a pad's length, and of its width in the middle; 0 where
    presses show them."""
    if pad.press_map is not None:
        return 0.0, 0.0
    surface = pad_surface(pad)
    width_m = float(surface.b * surface.scale(surface.a / 2, surface.b / 2))
    std_m = sheet.size_std_mm * _M_PER_MM
    return std_m / surface.extent_m[0], std_m / width_m


def log_aspect_std(pad: config.Pad, sheet: config.Sheet) -> float:
    """Return the standard deviation of the logarithm of the ratio of the rectangle's sides; 0 where presses
    show it."""
    if pad.press_map is not None:
        return 0.0
    size_x, size_y = relative_size_stds(pad, sheet)
    return math.sqrt(size_x**2 + size_y**2 + (sheet.anisotropy_std / 2) ** 2)
