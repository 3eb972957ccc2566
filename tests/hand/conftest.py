"""Path of a third-party hand's URDF."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def allegro() -> Path:
    """The Allegro hand's URDF, from the package example-robot-data."""
    spec = importlib.util.find_spec("cmeel")
    assert spec is not None
    assert spec.origin is not None
    shared = Path(spec.origin).parents[1] / "cmeel.prefix/share/example-robot-data"
    return shared / "robots/allegro_hand_description/urdf/allegro_right_hand.urdf"
