"""Where to press on a pad, by directions in the frame of its link, and bars of what its channels read.

Public names: `describe_position`, `describe_press`, `describe_arc_press`, `render_channel_bars`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from rich.text import Text

from handtouch import config
from handtouch.field.model import ChannelModel
from handtouch.hand import mount_transform, pad_surface
from handtouch.procedures.commission.electrode_order import PRESS_TARGETS, target_fractions
from handtouch.procedures.commission.press import PRESS_THRESHOLD_SIGMA, PressDetector

_MIN_NAMED_COMPONENT_FRACTION = 0.6  # component over the greatest one, to be named too
_OPPOSITE_ELECTRODE: dict[str, str] = {"x0": "xa", "xa": "x0", "y0": "yb", "yb": "y0"}
_MAX_SIMILAR_DISTANCE_RATIO = 0.97  # ratio of the distances of two ends from the link's origin


def describe_position(pad: config.Pad, electrode: str) -> str:
    """Describe a position near an electrode: "the end towards +x of the link, away from its origin"."""
    origin, other, position = (
        _position_in_link(pad, fractions) for fractions in _target_fractions(electrode)
    )
    side = pad_surface(pad).describe_side(electrode)
    text = f"{side} towards {_describe_direction(position - origin)} of the link"
    here, there = float(np.linalg.norm(position)), float(np.linalg.norm(other))
    if (
        electrode in ("x0", "xa")
        and not _MAX_SIMILAR_DISTANCE_RATIO < here / there < 1 / _MAX_SIMILAR_DISTANCE_RATIO
    ):
        text += ", away from its origin" if here > there else ", near its origin"
    return text


def describe_press(pad: config.Pad, electrode: str) -> str:
    """Describe a position to press, with its coordinates in millimetres in the link's frame."""
    *_, position = (_position_in_link(pad, fractions) for fractions in _target_fractions(electrode))
    across = "across" if electrode in ("x0", "xa") else "lengthwise"
    return f"{describe_position(pad, electrode)}; in the middle {across} ({_coordinates(position)})"


def describe_arc_press(pad: config.Pad, network: ChannelModel, electrode: str) -> str:
    """Describe a position near an electrode on an arc: "the rim towards +y of the link (about x ...)"."""
    fractions = target_fractions(network)[pad.electrode_names.index(electrode)]
    surface, (rotation, translation) = pad_surface(pad), mount_transform(pad)
    middle, position = (
        rotation @ surface.point(*(at * (network.a, network.b))) + translation
        for at in (np.array([0.5, 0.5]), fractions)
    )
    direction = _describe_direction(position - middle)
    return f"the rim towards {direction} of the link ({_coordinates(position)})"


def _coordinates(position: NDArray[np.float64]) -> str:
    x, y, z = (round(1e3 * value) for value in position.tolist())
    return f"about x {x}, y {y}, z {z} mm"


def _target_fractions(
    electrode: str,
) -> tuple[tuple[float, float], tuple[float, float], tuple[float, float]]:
    return (0.5, 0.5), PRESS_TARGETS[_OPPOSITE_ELECTRODE[electrode]], PRESS_TARGETS[electrode]


def _position_in_link(pad: config.Pad, fractions: tuple[float, float]) -> NDArray[np.float64]:
    """Return a point of the pad [m] in its link's frame."""
    surface = pad_surface(pad)
    rotation, translation = mount_transform(pad)
    x, _ = surface.to_rectangle(fractions[0] * surface.extent_m[0], 0.0)
    return np.asarray(rotation @ surface.point(x, fractions[1] * surface.b) + translation)


def _describe_direction(vector: NDArray[np.float64]) -> str:
    """ "+x", or "+x and -z" where a second axis contributes."""
    size = np.abs(vector)
    named = [axis for axis in np.argsort(-size) if size[axis] >= _MIN_NAMED_COMPONENT_FRACTION * size.max()]
    return " and ".join(f"{'-' if vector[axis] < 0 else '+'}{'xyz'[axis]}" for axis in named[:2])


_BAR_COLUMNS = 40


def render_channel_bars(slot: int, name: str, detector: PressDetector, channels: int) -> Text:
    """Return bars of a slot's first `channels`, scaled to the strongest, at least to half the press
    threshold.
    """
    deltas = detector.deltas[slot, :channels]
    scale = max(float(np.abs(deltas).max()), PRESS_THRESHOLD_SIGMA * float(detector.noise_counts[slot]) / 2)
    pressed = detector.level_sigma[slot] > PRESS_THRESHOLD_SIGMA
    text = Text()
    for channel, delta in enumerate(deltas.tolist(), 1):
        filled = round(_BAR_COLUMNS * abs(delta) / scale)
        text.append(f"  {channel} ", "dim")
        text.append("█" * filled, "cyan" if pressed else "dim")
        text.append("·" * (_BAR_COLUMNS - filled), "dim")
        text.append(f" {delta:+7.0f}\n")
    text.append(f"  {name}   a: again, s: skip, q: quit", "dim")
    return text
