"""Numerical stability: worst errors of theory and core over extreme inputs, and a fuzz of the core.

*Theory* and *core*: for each function and region, the worst error in units of rounding (2.2e-16) times the
condition of the problem, which is how far rounding of the arguments alone moves the answer; its limit, and
the input that causes it. References have 50 digits and use other formulas: sums of images (ideal pad), an
Abelian integral on the half plane (gaps), Bessel functions (contact). The core's are the exact theory; it
reads tables of 109 x 109 nodes and stops within a small part of the noise, so its errors are stated in mm
or relative, too, and over the standard deviation that it states, to which its limit applies. Contacts of the
core: exact currents of 1 mA, quantised channels of 10 mA, tracked from 0.1 mm away, no tolerances.

*Fuzz*: random pads (shapes from 2 mm to 1 m, three to six electrodes, gaps up to nearly the whole side,
resistors up to 1 Mohm; the keys of node and sheet over three to eight orders of magnitude), random counts up
to both ends of the range, changing from one sample to the next or held, clocks that stop, jump by hours and
run backwards, SYNC periods of 0.5 ms to 1 s, missing samples, and events: tares, calibrations with gains of
0.1 to 10, replacements, scenes, gravity, forces of other sensors. Each tick of each pad must keep the laws of
the table. `make test` runs 100,000 of these ticks.
"""

from __future__ import annotations

import json
import math
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mpmath as mp
import numpy as np
import numpy.typing as npt

from benchmarks.page import Report, options, progress
from handtouch.config import Deployment, parse
from handtouch.core.stages import solve
from handtouch.core.stages.rows import VALUE_COUNT, VALUE_SLICES
from handtouch.core.stages.solve import ContactSolver
from handtouch.daemon.table_cache import build_pad_model
from handtouch.field import (
    ConeSurface,
    ContactLaw,
    ElectrodeNetwork,
    ForceEstimateStatus,
    Rectangle,
    SphereSurface,
    contact_stack_resistance,
)
from handtouch.field.model import ChannelModel
from tests.core.pipeline_fuzz import SHAPES, Fuzz
from tests.deployments import deployment_text, pad_text
from tests.exact_pads import ExactPads

FloatArray = npt.NDArray[np.float64]
ROOT = Path(__file__).parent.parent
EPS = float(np.finfo(float).eps)
LEAST = 1e-290
DIGITS, MANY_DIGITS = 50, 420
"""Of references; fifty of the many are left after what cancels in currents of 1e-290."""
mp.mp.dps = DIGITS


class Worst:
    """The worst of many errors of one function in one region, in eps x condition; of the core in `unit`, too,
    and in stated standard deviations, to which its limit applies."""

    def __init__(self, function: str, region: str, limit: float, *, unit: str = "") -> None:
        self.function, self.region, self.limit, self.unit = function, region, limit, unit
        self.cases, self.worst, self.where, self.greatest, self.deviations = 0, 0.0, "", 0.0, 0.0

    def add(self, error: Any, condition: Any, where: object, std: float = math.inf) -> None:
        """Compare one error; one that isn't finite is the worst."""
        finite = math.isfinite(float(error))
        size = abs(float(error)) if finite else math.inf
        ratio = float(abs(error) / (EPS * condition)) if finite else math.inf
        self.cases += 1
        self.greatest, self.deviations = max(self.greatest, size), max(self.deviations, size / std)
        if ratio >= self.worst:
            self.worst, self.where = ratio, str(where) if ratio else ""

    @property
    def is_met(self) -> bool:
        return (self.deviations if self.unit else self.worst) <= self.limit

    def row(self) -> dict[str, Any]:
        row = {"function": self.function, "region": self.region, "cases": self.cases}
        row["worst, eps x condition"] = f"{self.worst:.2g}" if self.worst > 1e4 else self.worst
        if self.unit:
            row |= {"greatest": f"{self.greatest:.1e} {self.unit}", "of its deviation": self.deviations}
        return row | {"limit": self.limit, "met": self.is_met, "worst input": self.where}


# The ideal pad


def long_fractions(a: Any, b: Any, x: Any, y: Any) -> list[Any]:
    """Fractions of x0, xa, y0, yb of a pad at least as long as wide, by images along it."""
    unit = mp.pi / b
    sine, cosine = mp.sin(unit * y), mp.cos(unit * y)
    count = int(440 / (2.7 * float(a / b))) + 3
    ends = [mp.mpf(0), mp.mpf(0)]
    for j in range(count):
        for end, distance in enumerate((x, a - x)):
            near, far = distance + 2 * j * a, 2 * (j + 1) * a - distance
            ends[end] += mp.atan2(sine, mp.sinh(unit * near)) - mp.atan2(sine, mp.sinh(unit * far))
    below = above = mp.mpf(0)
    for j in range(2 * count):
        for distance in (x + j * a, (j + 1) * a - x):
            growth = mp.exp(unit * distance)
            below += (-1) ** j * mp.atan2(sine, growth - cosine)
            above += (-1) ** j * mp.atan2(sine, growth + cosine)
    sides = [1 - y / b - 2 / mp.pi * below, y / b - 2 / mp.pi * above]
    return [2 / mp.pi * ends[0], 2 / mp.pi * ends[1], *sides]


def exact_fractions(a: float, b: float, x: Any, y: Any) -> list[Any]:
    a_, b_, x_, y_ = mp.mpf(a), mp.mpf(b), mp.mpf(x), mp.mpf(y)
    if a >= b:
        return long_fractions(a_, b_, x_, y_)
    y0, yb, x0, xa = long_fractions(b_, a_, y_, x_)
    return [x0, xa, y0, yb]


def exact_jacobian(a: float, b: float, x: float, y: float) -> list[list[Any]]:
    """Central differences with 420 digits; the step leaves 100 of them right."""
    rows = []
    for d in range(2):
        h = mp.mpf(10) ** -60 * min(x, a - x, y, b - y)
        ahead = exact_fractions(a, b, mp.mpf(x) + h * (1 - d), mp.mpf(y) + h * d)
        behind = exact_fractions(a, b, mp.mpf(x) - h * (1 - d), mp.mpf(y) - h * d)
        rows.append([(p - m) / (2 * h) for p, m in zip(ahead, behind, strict=True)])
    return rows


REGIONS: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
    # exponents of ten: of the aspect, and of the distance from the nearest edge in sides
    "1:4 to 4:1, inside": ((-0.6, 0.6), (-1.5, -0.3)),
    "1:4 to 4:1, to 1e-12 of a side": ((-0.6, 0.6), (-12, -0.3)),
    "1:1000 to 1000:1, inside": ((-3, 3), (-1.5, -0.3)),
    "1:1000 to 1000:1, to 1e-12 of a side": ((-3, 3), (-12, -0.3)),
    "300:1 to 1000:1, near the middle": ((2.48, 3), (-0.36, -0.302)),
}


def cases(region: str, count: int) -> Iterator[tuple[float, float, float, float]]:
    generator = np.random.default_rng(len(region))
    aspects, places = REGIONS[region]
    for _ in range(count):
        aspect = 10.0 ** generator.uniform(*aspects)
        unit = 10.0 ** generator.uniform(-3, 3)
        sides = (unit * math.sqrt(aspect), unit / math.sqrt(aspect))
        near = 10.0 ** generator.uniform(*places, size=2)
        flip = generator.random(2) < 0.5
        x, y = (s - s * n if f else s * n for s, n, f in zip(sides, near, flip, strict=True))
        yield *sides, float(x), float(y)


def accuracy(share: float) -> Iterator[Worst]:
    """Rectangle against the sums of images."""
    for region in REGIONS:
        with mp.workdps(MANY_DIGITS):
            found = _accuracy(region, math.ceil(share * 40))
        yield from found


def _accuracy(region: str, count: int) -> tuple[Worst, ...]:
    forward = Worst("Rectangle.side_fractions", region, 20)
    absolute = Worst("Rectangle.side_fractions, absolute", region, 4)
    slopes = Worst("Rectangle.fractions_with_jacobian", region, 60)
    radius = Worst("Rectangle.conformal_radius", region, 20)
    place = Worst("Rectangle.locate", region, 20)
    lost = Worst("Rectangle.locate, lost coordinates not NaN", region, 0.5)
    for where in cases(region, count):
        a, b, x, y = where
        pad, exact, gradient = Rectangle(a, b), exact_fractions(*where), exact_jacobian(*where)
        jacobian = pad.fractions_with_jacobian(x, y)[1]
        for i, value in enumerate(pad.side_fractions(x, y)):
            absolute.add(mp.mpf(float(value)) - exact[i], 1, where)
            if exact[i] < LEAST:
                continue
            condition = 1 + abs(mp.log(exact[i]))
            forward.add(mp.mpf(float(value)) / exact[i] - 1, condition, where)
            size = mp.hypot(gradient[0][i], gradient[1][i])
            for d in range(2):
                error = mp.mpf(float(jacobian[i, d])) - gradient[d][i]
                slopes.add(error / size, condition, where)
        i = max(range(4), key=lambda k: -abs(exact[k] - 0.5))
        size = mp.hypot(gradient[0][i], gradient[1][i])
        expected = 2 * mp.sin(mp.pi * exact[i]) / (mp.pi * size)
        radius.add(mp.mpf(float(pad.conformal_radius(x, y))) / expected - 1, 1, where)
        _locate(pad, exact, gradient, where, place, lost)
    return (forward, absolute, slopes, radius, place, lost)


def _locate(
    pad: Rectangle,
    exact: list[Any],
    gradient: list[list[Any]],
    where: tuple[float, float, float, float],
    place: Worst,
    lost: Worst,
) -> None:
    """Locate the rounded exact currents; a coordinate with both currents below LEAST is let off."""
    found = pad.locate([float(f) for f in exact])
    for d, (coordinate, true) in enumerate(((found.x, where[2]), (found.y, where[3]))):
        pair = exact[2 * d : 2 * d + 2]
        if max(pair) < mp.mpf(float(np.finfo(float).tiny)):
            lost.add(0 if math.isnan(coordinate) else EPS, 1, where)
        elif max(pair) >= LEAST:
            sensitivity = _sensitivity(exact, 2 * d, gradient[d])
            place.add(mp.mpf(float(coordinate)) - true, true + sensitivity, where)


def _sensitivity(f: list[Any], first: int, slope: list[Any]) -> Any:
    """Sum over currents of |I dx / dI|, for x found from ln(T0 / T1) of the pair that begins at `first`."""
    sides = (first, first + 1)
    lead = [mp.pi / mp.sin(mp.pi * f[i]) for i in sides]
    by_place = lead[0] * slope[sides[0]] - lead[1] * slope[sides[1]]
    total = mp.mpf(0)
    for j in range(4):
        moved = [lead[n] * f[i] * ((i == j) - f[j]) for n, i in enumerate(sides)]
        total += abs((moved[0] - moved[1]) / by_place)
    return total


def stack(share: float) -> Iterator[Worst]:
    """Eq. 11 against Bessel functions of 30 digits."""
    rng = np.random.default_rng(1)
    for region, reach, scale in (
        ("x^2 of 1e-12 to 1e12", 12, 3),
        ("x^2 of 1e-40 to 1e40", 40, 3),
        ("units of 1e-100 to 1e100", 6, 100),
    ):
        worst = Worst("contact_stack_resistance", region, 20)
        for _ in range(round(share * 300)):
            x2, unit = 10.0 ** rng.uniform(-reach, reach), 10.0 ** rng.uniform(-scale, scale)
            sheet, ratio = 10.0 ** rng.uniform(0, 5), 1 + 10.0 ** rng.uniform(-15, 6)
            radius, outer = unit, unit * ratio
            layer = sheet / x2 * unit * unit
            if not 1e-300 < layer < 1e300:
                continue
            s, c, r, o = (mp.mpf(float(v)) for v in (sheet, layer, radius, outer))
            x = r * mp.sqrt(s / c)
            factor = mp.besseli(0, x) / (x * mp.besseli(1, x)) if x < 1e5 else 1 / x + 1 / (2 * x**2)
            exact = s / (2 * mp.pi) * (factor + mp.log(o / r))
            found = float(contact_stack_resistance(sheet, layer, radius, outer))
            condition = 3 + 2 * float(s / (2 * mp.pi) / exact)
            worst.add(float(mp.mpf(found) / exact - 1), condition, (sheet, layer, radius, outer))
        yield worst


def law(share: float) -> Iterator[Worst]:
    """Force from the current of a force: the inverse's own promise is 1e-8 of the force."""
    rng = np.random.default_rng(2)
    for hertz in (None, 1.0):
        worst = Worst("ContactLaw.force", f"round trip, {'Hertz' if hertz else 'fixed'} radius", 1e8)
        for _ in range(round(share * 3000)):
            alpha, layer = float(rng.uniform(0.3, 3)), 10.0 ** rng.uniform(-6, 2)
            force, outer = 10.0 ** rng.uniform(-5, 3), 10.0 ** rng.uniform(-2.4, -1)
            curve = ContactLaw(layer, alpha, 2e-3, hertz_n=hertz)
            current = float(curve.current(force, 5.0, 2400.0, outer))
            found = curve.force(current, 5.0, 2400.0, outer)
            if found.status != ForceEstimateStatus.VALID:
                worst.add(max(float(found.force_n) / force - 1, 0.0), 1e9, (layer, alpha, force, outer))
                continue
            step = float(curve.current(force * 1.0001, 5.0, 2400.0, outer)) / current - 1
            worst.add(float(found.force_n) / force - 1, 1 + 1e-4 / step, (layer, alpha, force, outer))
        yield worst


def surfaces(share: float) -> Iterator[Worst]:
    """Conformal coordinates of cones and spheres, and the way back."""
    rng = np.random.default_rng(3)
    cone, back = Worst("Cone.to_rectangle", "slopes of 1e-14 to 1", 40), Worst("Cone", "there and back", 60)
    for _ in range(round(share * 2000)):
        unit, near = 10.0 ** rng.uniform(-100, 100), 1.0
        slope = 10.0 ** rng.uniform(-14, 0) * rng.choice([-1, 1])
        slant = float(rng.uniform(0.1, 0.9 / max(abs(slope), 0.1)))
        pad = ConeSurface(near * unit, (near + slope * slant) * unit, slant * unit, 2.0)
        u = float(rng.uniform(0, 1)) * slant * unit
        n, f, s = (mp.mpf(float(v)) for v in (pad.near_radius_m, pad.far_radius_m, pad.slant_m))
        tilt = (f - n) / s
        mid = (n + f) / 2
        exact = mid * (mp.log1p(tilt * mp.mpf(u) / n) / tilt if tilt else mp.mpf(u) / n)
        x = float(pad.to_rectangle(u, 0.0)[0])
        cone.add(float(mp.mpf(x) / exact - 1) if u else 0.0, 4 + abs(slope) * slant, (slope, slant, u))
        back.add(float(pad.from_rectangle(x, 0.0)[0]) / u - 1, 4 + abs(slope) * slant, (slope, slant, u))
    yield cone
    yield back
    ball = Worst("Sphere.to_rectangle", "to 1e-6 of the poles", 40)
    back = Worst("Sphere", "there and back", 60)
    for _ in range(round(share * 2000)):
        low = -math.pi / 2 + 10.0 ** rng.uniform(-6, 0)
        high = low + (math.pi / 2 - 1e-6 - low) * 10.0 ** rng.uniform(-6, 0)
        pad_ = SphereSurface(1.0, low, high, 2.0)
        u = float(rng.uniform(0.01, 1)) * pad_.extent_m[0]
        lat0, lat = mp.mpf(low), mp.mpf(low) + mp.mpf(u)
        mid = mp.cos(lat0 + (mp.mpf(high) - lat0) / 2)
        exact = mid * (mp.asinh(mp.tan(lat)) - mp.asinh(mp.tan(lat0)))
        steep = 1 / float(min(mp.cos(lat), mp.cos(lat0)))
        condition = 4 + steep * (abs(low) + u) * float(mid) / float(exact) * min(1.0, 1.0)
        x = float(pad_.to_rectangle(u, 0.0)[0])
        ball.add(float(mp.mpf(x) / exact - 1), condition + abs(low) / u, (low, high, u))
        back.add(float(pad_.from_rectangle(x, 0.0)[0]) / u - 1, 4 + condition * steep, (low, high, u))
    yield ball
    yield back


class HalfPlane:
    """A pad on the half plane, w = sn: potentials are parts of integrals of i P(w) / sqrt(prod (w - e))."""

    def __init__(self, a: float, b: float, gap: float) -> None:
        self.a, self.b, gap_ = mp.mpf(a), mp.mpf(b), mp.mpf(gap)
        self.k = mp.kfrom(q=mp.exp(-2 * mp.pi * self.b / self.a))
        self.K = mp.ellipk(self.k**2)
        self.Kp = mp.ellipk(1 - self.k**2)
        self.low = [self.w(gap_, 0), self.w(self.a - gap_, 0)]
        right = [self.w(self.a, gap_), self.w(self.a, self.b - gap_)]
        top = self.w(self.a - gap_, self.b)
        ends = [*self.low, *right, top]
        self.ends = [mp.re(e) for e in ends] + [-mp.re(right[0]), -mp.re(right[1]), -mp.re(top)]
        b2, r1, r2, t2 = (mp.re(e) for e in (self.low[1], *right, top))
        gaps = ((b2, r1), (r2, t2), (-t2, -r2), (-r1, -b2))
        # steps of the potential over the gaps, bottom to right to top to left to bottom, for P = 1, w, w^2
        steps = mp.matrix(3, 3)
        for row, (start, stop) in enumerate(gaps[:3]):
            for power in range(3):
                steps[row, power] = self.step(start, stop, power)
        targets = {"y0": (-1, 0, 0), "xa": (1, -1, 0), "yb": (0, 1, -1), "x0": (0, 0, 1)}
        self.coefficients = {side: mp.lu_solve(steps, mp.matrix(v)) for side, v in targets.items()}

    def w(self, x: Any, y: Any) -> Any:
        u = (2 * mp.mpf(x) / self.a - 1) * self.K + 1j * mp.mpf(y) / self.b * self.Kp
        return mp.ellipfun("sn", u, k=self.k)

    def step(self, start: Any, stop: Any, power: int) -> Any:
        """Over a gap: with w = middle + half cos(angle) the roots at its ends cancel against dw."""

        def integrand(angle: Any) -> Any:
            w = (start + stop) / 2 + (stop - start) / 2 * mp.cos(angle)
            root = mp.mpf(1)
            for end in self.ends:
                if end not in (start, stop):
                    root *= mp.sqrt(w - end)
            return mp.re(w**power / root)

        return mp.quad(integrand, [0, mp.pi])

    def integral(self, path: list[Any], power: int) -> Any:
        def integrand(w: Any) -> Any:
            root = mp.mpf(1)
            for end in self.ends:
                root *= mp.sqrt(w - end)
            return 1j * w**power / root

        return mp.quad(integrand, path)

    def fractions(self, x: float, y: float) -> list[Any]:
        """X0, xa, y0, yb."""
        target = self.w(x, y)
        path = [mp.mpf(0), mp.mpc(0, 1), *(target + mp.mpc(0, 1) / 8**n for n in range(9)), target]
        parts = [mp.re(self.integral(path, power)) for power in range(3)]
        start = {"x0": 0, "xa": 0, "y0": 1, "yb": 0}
        return [start[s] + sum(self.coefficients[s][p] * parts[p] for p in range(3)) for s in start]


def networks(share: float) -> Iterator[Worst]:
    """Fractions of gapped pads against Abelian integrals."""
    regions = (
        ("square, gaps 0.2 to 20 %, 3 % inside", 1.0, (0.002, 0.01, 0.056, 0.2), 0.03),
        ("1 : 1.8", 1 / 1.8, (0.01, 0.1), 0.03),
        ("3 : 1", 3.0, (0.01, 0.1), 0.03),
        ("square, 1e-3 from corners and edges", 1.0, (0.002, 0.05), 1e-3),
    )
    for region, aspect, gaps, margin in regions[: math.ceil(share * len(regions))]:
        worst = Worst("ElectrodeNetwork.fractions", region, 20)
        for gap in gaps[: math.ceil(share * len(gaps))]:
            pad = ElectrodeNetwork(aspect, 1.0, gap * min(aspect, 1.0), 1.0)
            exact = HalfPlane(aspect, 1.0, gap * min(aspect, 1.0))
            for s, t in (
                (margin, margin),
                (0.5, margin),
                (1 - margin, 0.37),
                (0.3, 1 - margin),
                (0.41, 0.58),
            ):
                x, y = s * aspect, t
                found, slopes = pad.fractions_with_jacobian(x, y)
                off = max(
                    abs(mp.mpf(float(f)) - e) for f, e in zip(found, exact.fractions(x, y), strict=True)
                )
                condition = 1 + float(np.abs(slopes[:, 0]).max() * x + np.abs(slopes[:, 1]).max() * y)
                worst.add(float(off), condition, (aspect, gap, x, y))
        yield worst


def conductance(share: float) -> Iterator[Worst]:
    """Against the reference, which has ten decimals; symmetric, and rows that sum to zero, for any gaps."""
    given = Worst("ElectrodeNetwork.conductance", "reference, to its ten decimals", 1e-10 / EPS)
    for case in json.loads((ROOT / "tests" / "field" / "data" / "electrodes.json").read_text()):
        pad = ElectrodeNetwork(case["a"], case["b"], case["gap"], case["sheet_ohm_per_square"])
        off = np.abs(pad.conductance - case["conductance"]).max()
        given.add(off, 1.0, (case["a"], case["b"], case["gap"]))
    yield given
    rng = np.random.default_rng(6)
    region = "50:1 to 1:50, gaps 1e-6 to 0.49 of the short side"
    mirrored = Worst("ElectrodeNetwork.conductance, asymmetry", region, 40)
    sums = Worst("ElectrodeNetwork.conductance, sums of rows", region, 40)
    for _ in range(round(share * 400)):
        a, gap = 50.0 ** rng.uniform(-1, 1), 10.0 ** rng.uniform(-6, math.log10(0.49))
        found = ElectrodeNetwork(a, 1.0, gap * min(a, 1.0), 1.0).conductance
        largest = float(np.abs(found).max())
        mirrored.add(np.abs(found - found.T).max(), largest, (a, gap))
        sums.add(np.abs(found.sum(axis=1)).max(), largest, (a, gap))
    yield mirrored
    yield sums


def ideal_limit(share: float) -> Iterator[Worst]:
    """Without gaps: against `Rectangle`, which is proven to 50 digits, over aspects, edges and corners."""
    rng = np.random.default_rng(4)
    fractions = Worst("ElectrodeNetwork.fractions", "gap 0, 50:1 to 1:50, 1e-12 from corners", 40)
    radius = Worst("ElectrodeNetwork.spreading_radius", "the same, from 1e-3 off the edges", 2000)
    for _ in range(round(share * 400)):
        a = 50.0 ** rng.uniform(-1, 1)
        pad, ideal = ElectrodeNetwork(a, 1.0, 0.0, 1.0), Rectangle(a, 1.0)
        near = 10.0 ** rng.uniform(-12, -0.31, (2, 40))
        s, t = np.where(rng.random((2, 40)) < 0.5, near, 1 - near)
        x, y = s * a, t
        found, slopes = pad.fractions_with_jacobian(x, y)
        off = np.abs(found - ideal.side_fractions(x, y)).max(axis=0)
        condition = 1 + np.abs(slopes[:, 0]).max(axis=0) * x + np.abs(slopes[:, 1]).max(axis=0) * y
        index = int(np.argmax(off / condition))
        fractions.add(off[index], condition[index], (a, x[index], y[index]))
        inner = near.min(axis=0) > 1e-3
        if inner.any():
            ratio = pad.spreading_radius(x[inner], y[inner]) / ideal.conformal_radius(x[inner], y[inner]) - 1
            index = int(np.argmax(np.abs(ratio)))
            radius.add(ratio[index], 1, (a, x[inner][index], y[inner][index]))
    yield fractions
    yield radius


def round_trip(share: float) -> Iterator[Worst]:
    """Location there and back, 3 % and farther from the edges, in shorter sides."""
    rng = np.random.default_rng(5)
    for region, longest, limit in (("to 2:1", 2.0, 1e3), ("to 5:1", 5.0, 1e5)):
        worst = Worst("ElectrodeNetwork.locate", f"{region}, gaps 0.01 to 30 %, resistors to 5 sheets", limit)
        for _ in range(round(share * 150)):
            a = longest ** rng.uniform(-1, 1)
            short = min(a, 1.0)
            series = tuple(map(float, 2400 * 5 * rng.random(4) * rng.integers(0, 2, 4)))
            pad = ElectrodeNetwork(a, 1.0, 10.0 ** rng.uniform(-4, -0.53) * short, 2400.0, series)
            s, t = rng.uniform(0.03, 0.97, (2, 50))
            found = pad.locate(pad.currents(s * a, t))
            off = np.hypot(found.x - s * a, found.y - t) / short
            index = int(np.argmax(np.where(np.isnan(off), np.inf, off)))
            condition = _condition(pad, s[index] * a, t[index]) / short
            worst.add(off[index], condition, (a, series, s[index] * a, t[index]))
        yield worst


def _condition(pad: ChannelModel, x: float, y: float) -> float:
    """Condition of a location: its size, and sum |I dx / dI|, its motion by rounding of the currents."""
    fractions, slopes = pad.fractions_with_jacobian(x, y)
    columns = np.concatenate([slopes, fractions[:, None]], axis=1)
    moves = np.abs(np.linalg.pinv(columns)[:2]) @ np.abs(fractions)
    return float(np.hypot(x, y) + np.hypot(*moves))


# The core

DEPTHS = {
    "5 % and farther from edges": (0.05, 0.05, 0.1),
    "1 % from one edge": (0.01, 0.05, 1.0),
    "0.1 % from one edge": (0.001, 0.05, 7.0),
    "1 % from both edges of a corner": (0.01, 0.01, 7.0),
}
"""Distance from one edge, and least one from the others, in sides; largest error over its stated deviation.
The distance from a corner isn't known: a position there is moved out to where the currents tell it."""
EXACT = tuple(name for name in SHAPES if "arcs" not in name and "Mohm" not in name)
TOTAL_A, BEFORE_M = 1e-3, 1e-4
COVARIANCE = VALUE_SLICES["covariance_m2"]
MAX_DEVIATIONS = 0.1
MIN_SIGNAL = 20.0
"""Least current of a force, over its noise: below, the mean of a force isn't its most likely value"""


def core(share: float) -> Iterator[Worst]:
    """Positions and forces of the compiled stages against the exact theory, without tolerances."""
    texts = [
        pad_text(f"p{k}", k + 1, SHAPES[name][0], SHAPES[name][2], gap_mm=SHAPES[name][1])
        for k, name in enumerate(EXACT)
    ]
    deployment = parse(
        deployment_text(*texts, exact_parts=True, noise_counts=1e-3, contact_radius_std_mm=0.0)
    )
    model = build_pad_model(deployment)
    exact, pads = ExactPads(deployment, model), np.arange(model.size)
    currents, values = np.zeros((model.size, 4)), np.full((model.size, VALUE_COUNT), np.nan)
    solver = ContactSolver(model, currents, np.zeros(model.size), np.ones(model.size, np.bool_), values)
    rng = np.random.default_rng(7)
    middle = exact.sides.T / 2
    placed = exact.to_link_frame(pads, middle[0], middle[1], np.zeros((model.size, 2, 2)))
    metres = np.asarray(placed.scale_m_per_unit)
    for region, (margin, aside, limit) in DEPTHS.items():
        worst = [Worst(f"position: {name}", region, limit, unit="mm") for name in EXACT]
        for _ in range(round(share * 400)):
            place = rng.uniform(aside, 1 - aside, (model.size, 2))
            if aside < 0.05:
                place[:] = np.where(rng.random(place.shape) < 0.5, aside, 1 - aside)
            axis = rng.integers(2, size=model.size)
            place[pads, axis] = np.where(rng.random(model.size) < 0.5, margin, 1 - margin)
            xy = place * exact.sides
            values[:] = np.nan
            for shift in (BEFORE_M / metres, 0.0 * metres):
                inside = np.clip(xy + shift[:, None] * np.sign(0.5 - place), 0.0, exact.sides)
                currents[:] = TOTAL_A * exact.fractions(pads, *inside.T).T
                solver.solve_contacts(pads.data)
            off = np.linalg.norm(values[:, VALUE_SLICES["xy"]] - xy, axis=1)
            for pad, row in enumerate(worst):
                condition = _condition(model.networks[pad], *xy[pad])
                error_mm = 1e3 * metres[pad] * off[pad]
                std_mm = 1e3 * float(np.sqrt(np.trace(values[pad, COVARIANCE].reshape(3, 3))))
                row.add(error_mm, 1e3 * metres[pad] * condition, tuple(place[pad].tolist()), std_mm)
        yield from worst
    yield from _core_forces(share, deployment, solver, currents, values)


def _core_forces(
    share: float, deployment: Deployment, solver: ContactSolver, currents: FloatArray, values: FloatArray
) -> Iterator[Worst]:
    """Forces at the centres of pads, where the current's density inside the contact is even."""
    model = build_pad_model(deployment)
    exact, pads, rng = ExactPads(deployment, model), np.arange(model.size), np.random.default_rng(8)
    middle = exact.sides / 2
    fractions, alone = exact.fractions(pads, *middle.T).T, 1e-4
    region = f"current from {MIN_SIGNAL:g} deviations to 90 % of the greatest"
    worst = [Worst(f"force: {name}", region, MAX_DEVIATIONS, unit="of it") for name in EXACT]
    large = model.networks[EXACT.index("3 x 2 mm")]  # its contact is larger than the pad
    at, least_a = VALUE_SLICES["force_n"].start, 2 * MIN_SIGNAL * model.noise_a.max(axis=1)
    for _ in range(round(share * 400)):
        force = 10.0 ** rng.uniform(-3, 2, model.size)
        for pad, row in enumerate(worst):
            total = model.centre_current(pad, force[pad])
            slope = model.centre_current(pad, force[pad] * (1 + alone)) / total - 1
            if model.networks[pad] is large or not least_a[pad] < total < 0.9 * model.centre_current(
                pad, 1e9
            ):
                continue
            currents[pad], values[pad] = total * fractions[pad], np.nan
            solver.solve_contacts(pads[pad : pad + 1].data)
            found, std = values[pad, at], values[pad, VALUE_SLICES["force_std_n"].start]
            row.add(found / force[pad] - 1, 1 + alone / slope, float(force[pad]), std / force[pad])
    yield from (row for row in worst if row.cases)


# Fuzz


def fuzz(ticks: int, seeds: int) -> list[dict[str, Any]]:
    """Return a row for each law of the core's ticks; each seed draws other pads."""
    rows: dict[str, dict[str, Any]] = {}
    for seed in range(seeds):
        for law in Fuzz(seed).run(ticks // seeds):
            row = rows.setdefault(law.name, {"law": law.name, "checked": 0, "broken": 0, "first input": ""})
            row["checked"] += law.checked
            row["broken"] += law.broken
            row["first input"] = row["first input"] or law.first
        progress(f"fuzz: pads of seed {seed}")
    return list(rows.values())


def main() -> int:
    """Run all parts; return 1 if something is beyond its limit."""
    parser = options(__doc__)
    parser.add_argument("--ticks", type=int, default=5_000_000, help="of pads in the fuzz")
    asked = parser.parse_args()
    share, ticks, seeds = (0.02, 50_000, 1) if asked.quick else (1.0, asked.ticks, 8)
    report = Report(
        asked.quick, mpmath=mp.__version__, compiled=solve.__file__.endswith(".so"), ticks_of_the_fuzz=ticks
    )
    tables: dict[str, list[Worst]] = {"Theory": [], "Core": []}
    with warnings.catch_warnings(), np.errstate(all="raise"):
        warnings.simplefilter("error")
        for part in (accuracy, stack, law, surfaces, conductance, ideal_limit, round_trip, networks):
            tables["Theory"] += part(share)
            progress(part.__name__)
    tables["Core"] += core(share)
    for title, worst in tables.items():
        rows = [row.row() for row in worst]
        report.table(title, rows)
        report.limit(f"{title.lower()}: functions beyond their limit", sum(not row["met"] for row in rows), 0)
    laws = fuzz(ticks, seeds)
    report.table("Fuzz", laws)
    report.limit("fuzz: values that break a law", sum(row["broken"] for row in laws), 0)
    return int(not report.keep())


if __name__ == "__main__":
    sys.exit(main())
