"""Small hand with pads of several surfaces, with gaps, resistors, and two buses."""

from __future__ import annotations

import itertools

import pytest

from handtouch import config

FILE = """
[[bus]]
name = "near"
interface = "virtual"
channel = "{channel}-near"

[[bus]]
name = "far"
interface = "virtual"
channel = "{channel}-far"

[node.plain]
drive_v = 5.0
full_scale_ma = 10.0
noise_counts = 2.0

[sheet.firm]
ohm_per_square = 2400.0
contact_ohm_mm2 = 20_000.0
alpha = 1.5
contact_radius_mm = 2.0
contact_radius_std_mm = 0.4

[[hand]]
name = "right"

[[hand.pad]]
link = "flat"
bus = "near"
node_id = 3
serial = 30
node = "plain"
sheet = "firm"
surface = {{ kind = "plane", length_mm = 40.0, width_mm = 25.0 }}
gap_mm = 1.0

[[hand.pad]]
link = "round"
bus = "near"
node_id = 4
node = "plain"
sheet = "firm"
surface = {{ kind = "cylinder", radius_mm = 11.0, length_mm = 30.0, arc_deg = 160.0 }}
gap_mm = 0.8
series_ohm = [336.0, 200.0, 0.0, 100.0]
mount = {{ position_mm = [20.0, 1.0, 11.0], rpy_deg = [10.0, 20.0, -30.0] }}

[[hand.pad]]
link = "tapered"
bus = "far"
node_id = 3
node = "plain"
sheet = "firm"
surface = {{ kind = "cone", near_radius_mm = 12.0, far_radius_mm = 7.0, slant_mm = 26.0, arc_deg = 140.0 }}
gap_mm = 0.8

[[hand.pad]]
link = "tip"
bus = "far"
node_id = 5
node = "plain"
sheet = "firm"
surface = {{ kind = "sphere", radius_mm = 10.0, from_deg = -20.0, to_deg = 60.0, arc_deg = 140.0 }}
gap_mm = 0.5
mount = {{ position_mm = [5.0, 0.0, 9.0], rpy_deg = [0.0, 15.0, 0.0] }}
"""

_channels = itertools.count()


@pytest.fixture
def deployment_text() -> str:
    """Deployment file of the small hand, on virtual buses of its own."""
    return FILE.format(channel=f"simulate-{next(_channels)}")


@pytest.fixture
def deployment(deployment_text: str) -> config.Deployment:
    """Deployment of the small hand."""
    return config.parse(deployment_text)
