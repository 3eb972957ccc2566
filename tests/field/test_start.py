"""Replacements for scipy's slow imports at start-up agree with scipy."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import i0e, i1e

from handtouch.field.contact_stack import bessel_ratio
from handtouch.hand.pads import rotation_from_rpy


def test_bessel_ratio_equals_that_of_scipy() -> None:
    x = np.concatenate([np.geomspace(1e-12, 1e6, 400), np.linspace(30, 34, 100)])
    np.testing.assert_allclose(bessel_ratio(x), i0e(x) / i1e(x), rtol=2e-15)
    assert bessel_ratio(0.0) == np.inf
    assert np.isnan(bessel_ratio(np.nan))
    assert bessel_ratio(np.inf) == 1


def test_rotations_equal_those_of_scipy() -> None:
    for rpy in np.random.default_rng(1).uniform(-7, 7, (20, 3)):
        np.testing.assert_allclose(
            rotation_from_rpy(rpy), Rotation.from_euler("xyz", rpy).as_matrix(), atol=1e-14
        )


def test_daemon_and_pad_model_load_no_package_that_they_can_do_without() -> None:
    code = (
        "import sys, handtouch.daemon.serve; from handtouch import config; "
        "from handtouch.config import shipped; from handtouch.core.pad_model import PadModel; "
        "PadModel(config.load(shipped.path('utah_mit.toml'))); print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    loaded = set(done.stdout.split())
    assert "pydantic" in loaded
    assert not {"scipy", "matplotlib", "rich", "mcap", "tomlkit", "pyarrow"} & loaded
    own = {"calibration.gains", "calibration.stationary_contacts", "calibration.store", "client.key_maker"}
    own |= {"client.subscriber", "daemon.metrics_page", "percept.action_request", "percept.estimator"}
    own |= {"percept.worker", "supervisor.level_scatter", "supervisor.worker"}
    own |= {f"field.{name}" for name in ("film", "measured", "mesh_surface", "outline", "outline_surface")}
    own |= {f"field.{name}" for name in ("taxels", "triangulation", "two_layers")}
    assert not {f"handtouch.{name}" for name in own} & loaded
