"""No floating-point warning leaves networks, surfaces or contact laws, underflow included."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from handtouch.field import (
    AnisotropicSurface,
    ConeSurface,
    CylinderSurface,
    PlaneSurface,
    PrismSurface,
    RevolutionSurface,
    SphereSurface,
)
from handtouch.field.contact_law import ContactLaw, contact_stack_resistance
from handtouch.field.network import ElectrodeNetwork

ODD = [0.0, -0.0, 5e-324, 1e-300, 1e-160, 0.3, 0.7, 1.0, -0.1, 1e160, 1e300, math.inf, -math.inf, math.nan]
X, Y = (v.ravel() for v in np.meshgrid(ODD, ODD))
BOTH = np.stack([X, Y])
FOUR = np.stack(np.broadcast_arrays(X, Y, 0.2, 0.3))

FIXED, SIZED = ContactLaw(2e-2, 1.5, 2e-3, 3e-4), ContactLaw(2e-2, 1.5, 2e-3, 3e-4, hertz_n=1.0)

SURFACES: list[Callable[[], Any]] = [
    lambda: PlaneSurface(1.3, 1.0),
    lambda: CylinderSurface(0.5, 1.3, 2.0),
    lambda: ConeSurface(0.6, 0.4, 1.3, 2.0),
    lambda: SphereSurface(1.0, -0.3, 1.0, 2.0),
    lambda: RevolutionSurface((0.0, 0.5, 1.3), (0.5, 0.6, 0.4), 2.0),
    lambda: PrismSurface(1.3, (0.0, 0.5, 1.0), (0.0, 0.2, 0.0)),
    lambda: PrismSurface(1.0, (0.0, 1e-310, 1.0), (0.0, 0.0, 1e-320)),
    lambda: AnisotropicSurface(PlaneSurface(1.3, 1.0), 3.0),
    lambda: AnisotropicSurface(PlaneSurface(1e300, 1.0), 1e300),
]
NETWORKS: list[Callable[[], ElectrodeNetwork]] = [
    lambda: ElectrodeNetwork(1.3, 1.0, 0.05, 2400.0, (0.0, 336.0, 0.0, 1e-310)),
    lambda: ElectrodeNetwork(50.0, 1.0, 0.01, 1.0),
    lambda: ElectrodeNetwork(1e-300, 2e-300, 1e-302, 1e300, (0.0, 1e-300, 1e300, 1.0)),
    lambda: ElectrodeNetwork(1.0, 1.0, 0.0, 1.0),
]
WEIGHINGS: dict[str, Callable[[], object]] = {
    "stack": lambda: contact_stack_resistance(X, Y, 1.0, 2.0),
    "radius": lambda: (FIXED.radius(X), SIZED.radius(X)),
    "resistivity": lambda: (FIXED.resistivity(X), SIZED.resistivity(X)),
    "current": lambda: (FIXED.current(X, 5.0, 2400.0, Y), SIZED.current(X, 5.0, 2400.0, Y)),
    "force": lambda: [law.force(X, 5.0, 2400.0, Y, current_std_a=1e-4) for law in (FIXED, SIZED)],
    "terms": lambda: ContactLaw(1e-300, 3.0, 1e-200, 1e-300, 1e300).force(1e-3, 5.0, 2400.0, 0.017),
}


@pytest.fixture(autouse=True)
def warnings_are_errors() -> Any:
    with np.errstate(all="raise"):
        yield


@pytest.mark.parametrize("make", SURFACES)
def test_surfaces_raise_no_floating_point_warnings(make: Callable[[], Any]) -> None:
    for name in ("point", "tangents", "normal", "scales", "from_rectangle", "to_rectangle"):
        getattr(make(), name)(X, Y)


@pytest.mark.parametrize("make", NETWORKS)
def test_networks_raise_no_floating_point_warnings(make: Callable[[], ElectrodeNetwork]) -> None:
    pad = make()
    for name in ("currents", "fractions_with_jacobian", "spreading_radius", "series_resistance"):
        getattr(pad, name)(X, Y)
        getattr(pad, name)(0.3 * pad.a, 0.4 * pad.b)
    pad.locate(FOUR)


@pytest.mark.parametrize("name", WEIGHINGS)
def test_forces_raise_no_floating_point_warnings(name: str) -> None:
    WEIGHINGS[name]()


def test_fixed_radius_does_not_depend_on_the_force() -> None:
    assert list(FIXED.radius([0.0, 1.0, math.inf])) == [2e-3] * 3
    assert np.isnan(FIXED.radius(math.nan))
