"""What a start does without scipy's slow imports is what scipy would have done."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation
from scipy.special import i0e, i1e

from handtouch.field._spline import spline_operator
from handtouch.field._stack import bessel_ratio
from handtouch.hand.pads import rotation_of


@pytest.mark.parametrize("cells", [8, 64])
@pytest.mark.parametrize("degree", [3, 5])
def test_splines_are_those_of_scipy(cells: int, degree: int) -> None:
    spline = make_interp_spline(np.arange(cells + 1.0), np.eye(cells + 1), k=degree)
    left = np.arange(float(cells))
    expected = np.stack([spline(left, nu=k) / math.factorial(k) for k in range(degree + 1)], axis=1)
    np.testing.assert_allclose(spline_operator(cells, degree), expected, rtol=0, atol=1e-9)


def test_the_ratio_of_bessel_functions_is_that_of_scipy_to_rounding() -> None:
    x = np.concatenate([np.geomspace(1e-12, 1e6, 400), np.linspace(30, 34, 100)])
    np.testing.assert_allclose(bessel_ratio(x), i0e(x) / i1e(x), rtol=2e-15)
    assert bessel_ratio(0.0) == np.inf
    assert np.isnan(bessel_ratio(np.nan))
    assert bessel_ratio(np.inf) == 1


def test_rotations_are_those_of_scipy() -> None:
    for rpy in np.random.default_rng(1).uniform(-7, 7, (20, 3)):
        np.testing.assert_allclose(rotation_of(rpy), Rotation.from_euler("xyz", rpy).as_matrix(), atol=1e-14)


def test_the_model_of_a_hand_is_built_without_scipy() -> None:
    code = (
        "import sys; from handtouch import config, shipped; from handtouch.daemon.model import PadModel; "
        "PadModel(config.load(shipped.path('utah_mit.toml'))); "
        "sys.exit(sorted(name for name in sys.modules if name.startswith('scipy'))[:3] != [])"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
