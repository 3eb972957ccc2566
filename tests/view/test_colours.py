"""Status colours of the page are distinguishable with each kind of colour blindness."""

from __future__ import annotations

import itertools
import re
from importlib.resources import files

import numpy as np
import pytest
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
MIN_DISTANCE = 15.0
"""In CIE Lab; about 2 is just noticeable side by side."""
SIMULATED = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}
"""Linear RGB as seen with each kind, complete (Machado, Oliveira, Fernandes 2009)."""
XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
WHITE = np.array([0.95047, 1.0, 1.08883])


def status_colours() -> dict[str, str]:
    source = (files("handtouch.view.page") / "static/colours.js").read_text()
    (table,) = re.findall(r"STATUS_COLOURS = \{(.*?)\}", source, re.DOTALL)
    return dict(re.findall(r'(\w+): "#([0-9a-f]{6})"', table))


def lab(colour: str, matrix: FloatArray) -> FloatArray:
    rgb = np.array([int(colour[at : at + 2], 16) for at in (0, 2, 4)]) / 255
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    x, y, z = np.cbrt(np.maximum(XYZ @ np.clip(matrix @ linear, 0, 1) / WHITE, 0.008856))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("kind", SIMULATED)
def test_statuses_differ_in_colour(kind: str) -> None:
    colours = status_colours()
    assert {"clear", "unreliable", "stale", "lost", "starting", "off"} <= set(colours)
    assert colours.pop("faulted") == colours["lost"]
    for one, other in itertools.combinations(colours, 2):
        distance = np.linalg.norm(lab(colours[one], SIMULATED[kind]) - lab(colours[other], SIMULATED[kind]))
        assert distance > MIN_DISTANCE, f"{one} and {other}: {distance:.1f}"
