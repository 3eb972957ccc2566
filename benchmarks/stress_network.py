"""Stress of networks, surfaces and strength: beside 50-digit references, in more regions than tests.

For each function and region, the worst error in units of eps times the condition of the problem (how far
rounding of the arguments alone moves the answer) and where it was. References are mpmath's and use other
formulas: the network's is an Abelian integral on the half plane, 3 coefficients from its periods. Exit status
1 if any is worse than its limit.
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
from benchmarks.stress_field import EPS, Worst, report_worst
from handtouch.field import (
    ConeSurface,
    ContactLaw,
    ElectrodeNetwork,
    ForceEstimateStatus,
    Rectangle,
    SphereSurface,
    contact_stack_resistance,
)

FloatArray = npt.NDArray[np.float64]
ROOT = Path(__file__).parent.parent
mp.mp.dps = 50


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
    for region, aspect, gaps, margin in (
        ("square, gaps 0.2 to 20 %, 3 % inside", 1.0, (0.002, 0.01, 0.056, 0.2), 0.03),
        ("1 : 1.8", 1 / 1.8, (0.01, 0.1), 0.03),
        ("3 : 1", 3.0, (0.01, 0.1), 0.03),
        ("square, 1e-3 from corners and edges", 1.0, (0.002, 0.05), 1e-3),
    ):
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


def _condition(pad: ElectrodeNetwork, x: float, y: float) -> float:
    """Condition of a location: its size, and sum |I dx / dI|, its motion by rounding of the currents."""
    fractions, slopes = pad.fractions_with_jacobian(x, y)
    columns = np.concatenate([slopes, fractions[:, None]], axis=1)
    moves = np.abs(np.linalg.pinv(columns)[:2]) @ np.abs(fractions)
    return float(np.hypot(x, y) + np.hypot(*moves))


def main() -> int:
    """Run all parts; 1 if one is beyond its limit."""
    quick = options(__doc__).parse_args().quick
    rows: list[Worst] = []
    warnings.simplefilter("error")
    with np.errstate(all="raise"):
        for part in (stack, law, surfaces, conductance, ideal_limit, round_trip, networks):
            rows += part(0.02 if quick else 1.0)
            progress(part.__name__)
    return report_worst(Report(quick, mpmath=mp.__version__), rows)


if __name__ == "__main__":
    sys.exit(main())
