"""Small hand with pads of several surfaces, with gaps, resistors, and two buses."""

from __future__ import annotations

import itertools

import pytest

from handtouch import config
from tests import deployments

FLAT = '{ kind = "plane", length_mm = 40.0, width_mm = 25.0 }'
ROUND = '{ kind = "cylinder", radius_mm = 11.0, length_mm = 30.0, arc_deg = 160.0 }'
TAPERED = '{ kind = "cone", near_radius_mm = 12.0, far_radius_mm = 7.0, slant_mm = 26.0, arc_deg = 140.0 }'
TIP = '{ kind = "sphere", radius_mm = 10.0, from_deg = -20.0, to_deg = 60.0, arc_deg = 140.0 }'
ROUND_KEYS = """series_ohm = [336.0, 200.0, 0.0, 100.0]
mount = { position_mm = [20.0, 1.0, 11.0], rpy_deg = [10.0, 20.0, -30.0] }"""
TIP_KEYS = "mount = { position_mm = [5.0, 0.0, 9.0], rpy_deg = [0.0, 15.0, 0.0] }"

_channels = itertools.count()


@pytest.fixture
def deployment_text() -> str:
    """Deployment file of the small hand, on virtual buses of its own."""
    channel = f"simulate-{next(_channels)}"
    return deployments.deployment_text(
        deployments.pad_text("flat", 3, FLAT, "serial = 30", bus="near", gap_mm=1.0),
        deployments.pad_text("round", 4, ROUND, ROUND_KEYS, bus="near", gap_mm=0.8),
        deployments.pad_text("tapered", 3, TAPERED, bus="far", gap_mm=0.8),
        deployments.pad_text("tip", 5, TIP, TIP_KEYS, bus="far", gap_mm=0.5),
        daemon="",
        noise_counts=2.0,
        contact_radius_mm=2.0,
        contact_radius_std_mm=0.4,
        touch="",
        buses={"near": f"{channel}-near", "far": f"{channel}-far"},
        hand="right",
    )


@pytest.fixture
def deployment(deployment_text: str) -> config.Deployment:
    """Deployment of the small hand."""
    return config.parse(deployment_text)
