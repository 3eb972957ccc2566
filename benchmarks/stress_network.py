"""Stress networks, surfaces and strength: against 50-digit references and with arguments of every kind.

Prints and writes to docs/benchmarks/stress_network.md, for each function and region, the worst error in units
of eps times the condition of the problem (how far rounding of the arguments alone moves the answer) and where
it was. Exit status 1 if any is worse than its limit. References are mpmath's and use other formulas: the
network's is an Abelian integral on the half plane, 3 coefficients from its periods.
"""

from __future__ import annotations

import json
import math
import platform
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import mpmath as mp
import numpy as np
import numpy.typing as npt
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.page import made_by, options, output_folder
from handtouch.field import (
    AnisotropicSurface,
    ConeSurface,
    ContactLaw,
    CylinderSurface,
    Electrode,
    ElectrodeNetwork,
    ForceEstimateStatus,
    PlaneSurface,
    PrismSurface,
    Rectangle,
    RevolutionSurface,
    Sandwich,
    SphereSurface,
    Surface,
    contact_stack_resistance,
)
from handtouch.field.network import SIDES

FloatArray = npt.NDArray[np.float64]
EPS = float(np.finfo(float).eps)
ROOT = Path(__file__).parent.parent
mp.mp.dps = 50


class Row(NamedTuple):
    function: str
    region: str
    cases: int
    worst: float  # in eps x condition
    limit: float
    where: str


class Worst:
    """Keeps the worst of many errors."""

    def __init__(self, function: str, region: str, limit: float) -> None:
        self.row = Row(function, region, 0, 0.0, limit, "")

    def add(self, error: float, condition: float, where: object) -> None:
        ratio = abs(float(error)) / (EPS * float(condition))
        ratio = math.inf if math.isnan(ratio) else ratio
        worse = ratio >= self.row.worst
        self.row = self.row._replace(
            cases=self.row.cases + 1,
            worst=max(ratio, self.row.worst),
            where=str(where) if worse else self.row.where,
        )


def stack(share: float) -> Iterator[Row]:
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
        yield worst.row


def law(share: float) -> Iterator[Row]:
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
        yield worst.row


def surfaces(share: float) -> Iterator[Row]:
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
    yield cone.row
    yield back.row
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
    yield ball.row
    yield back.row


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


def networks(share: float) -> Iterator[Row]:
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
        yield worst.row


def conductance(share: float) -> Iterator[Row]:
    """Against the reference, which has ten decimals; symmetric, and rows that sum to zero, for any gaps."""
    given = Worst("ElectrodeNetwork.conductance", "reference, to its ten decimals", 1e-10 / EPS)
    for case in json.loads((ROOT / "tests" / "field" / "data" / "electrodes.json").read_text()):
        pad = ElectrodeNetwork(case["a"], case["b"], case["gap"], case["sheet_ohm_per_square"])
        off = np.abs(pad.conductance - case["conductance"]).max()
        given.add(off, 1.0, (case["a"], case["b"], case["gap"]))
    yield given.row
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
    yield mirrored.row
    yield sums.row


def ideal_limit(share: float) -> Iterator[Row]:
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
    yield fractions.row
    yield radius.row


def round_trip(share: float) -> Iterator[Row]:
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
        yield worst.row


def _condition(pad: ElectrodeNetwork, x: float, y: float) -> float:
    """Condition of a location: its size, and sum |I dx / dI|, its motion by rounding of the currents."""
    fractions, slopes = pad.fractions_with_jacobian(x, y)
    columns = np.concatenate([slopes, fractions[:, None]], axis=1)
    moves = np.abs(np.linalg.pinv(columns)[:2]) @ np.abs(fractions)
    return float(np.hypot(x, y) + np.hypot(*moves))


def arguments(_share: float) -> Iterator[Row]:
    """Every public function on arrays of every kind: each element as if alone, no warning."""
    pad = ElectrodeNetwork(1.3, 1.0, 0.05, 2400.0, (0.0, 336.0, 0.0, 100.0))
    curve, sized = ContactLaw(2e-2, 1.5, 2e-3, 3e-4), ContactLaw(2e-2, 1.5, 2e-3, hertz_n=1.0)
    shapes: list[Surface] = [
        PlaneSurface(1.3, 1.0),
        CylinderSurface(0.5, 1.3, 2.0),
        ConeSurface(0.6, 0.4, 1.3, 2.0),
        SphereSurface(1.0, -0.3, 1.0, 2.0),
        RevolutionSurface((0.0, 0.5, 1.3), (0.5, 0.6, 0.4), 2.0),
        PrismSurface(1.3, (0.0, 0.5, 1.0), (0.0, 0.2, 0.0)),
        AnisotropicSurface(PlaneSurface(1.3, 1.0), 3.0),
    ]
    pair = Sandwich((2e-2, 3e-2), (1.5, 0.7), (2400.0, 3000.0))
    pieces = [Electrode(side, start, stop) for side in SIDES for start, stop in ((0.02, 0.48), (0.52, 0.98))]
    parted = ElectrodeNetwork.from_sides(1.0, 1.0, pieces, 2400.0)

    def four(x: Any, y: Any) -> FloatArray:
        return np.stack(np.broadcast_arrays(x, y, 0.2, 0.3))

    functions: dict[str, Callable[[Any, Any], npt.ArrayLike]] = {
        "network.estimate": lambda x, y: pad.estimate(four(x, y), 0.01).x,
        "from_sides.currents": parted.currents,
        "with_series.currents": pad.with_series_ohm((0.0, 0.0, 500.0, 1e-3)).currents,
        "Sandwich.currents": lambda x, y: pair.currents(x, y, 12.0, 0.02),
        "Sandwich.force": lambda x, y: pair.force(np.stack(np.broadcast_arrays(x, y)), 12.0, 0.02).force_n,
        "network.currents": pad.currents,
        "network.jacobian": lambda x, y: pad.fractions_with_jacobian(x, y)[1],
        "network.spreading_radius": pad.spreading_radius,
        "network.series_resistance": pad.series_resistance,
        "network.locate": lambda x, y: pad.locate(np.stack(np.broadcast_arrays(x, y, 0.2, 0.3))).x,
        "contact_stack_resistance": lambda x, y: contact_stack_resistance(2400.0, x, y, 1.0),
        "ContactLaw.current": lambda x, y: curve.current(x, 5.0, 2400.0, y),
        "ContactLaw.force": lambda x, y: curve.force(x, 5.0, 2400.0, y, current_std_a=1e-4).force_n,
        "ContactLaw.force, Hertz": lambda x, y: sized.force(x, 5.0, 2400.0, y).std_n,
    }
    for shape in shapes:
        name = type(shape).__name__
        functions |= {
            f"{name}.point": shape.point,
            f"{name}.tangents": shape.tangents,
            f"{name}.normal": shape.normal,
            f"{name}.scales": shape.scales,
            f"{name}.from_rectangle": _stacked(shape.from_rectangle),
            f"{name}.to_rectangle": _stacked(shape.to_rectangle),
        }
    odd = [
        0.0,
        -0.0,
        5e-324,
        1e-300,
        1e-160,
        0.3,
        0.7,
        1.0,
        -0.1,
        1e160,
        1e300,
        math.inf,
        -math.inf,
        math.nan,
    ]
    x, y = (v.ravel() for v in np.meshgrid(odd, odd))
    xs = np.linspace(0.1, 0.9, 12).astype(np.float32)[::3]
    xs.setflags(write=False)
    for name, function in functions.items():
        worst = Worst(name, "zeros, denormals, 1e-300 to 1e300, inf, NaN, kinds of arrays", 0)
        together = np.asarray(function(x, y), float)
        for i in range(x.size):
            alone = np.asarray(function(x[[i]], y[[i]]), float)[..., 0]
            with np.errstate(under="ignore"):  # of the comparison itself
                same = np.isclose(together[..., i], alone, rtol=1e-12, atol=1e-14, equal_nan=True)
            worst.add(0.0 if same.all() else math.inf, 1, (name, x[i], y[i]))
        plain = np.asarray(function(xs.astype(float), 0.5), float)
        same32 = np.array_equal(np.asarray(function(xs, 0.5)), plain, equal_nan=True)
        worst.add(0.0 if same32 else math.inf, 1, (name, "float32, strided, read-only"))
        worst.add(float(np.asarray(function(np.empty((0, 2)), np.empty((0, 2)))).size), 1, (name, "empty"))
        whole = np.asarray(function(1, np.array([[0], [1]])), float)
        same_int = np.array_equal(whole, function(1.0, np.array([[0.0], [1.0]])), equal_nan=True)
        worst.add(0.0 if same_int else math.inf, 1, (name, "integers"))
        yield worst.row._replace(where=worst.row.where if worst.row.worst else "")


def _stacked(
    function: Callable[[Any, Any], tuple[FloatArray, FloatArray]],
) -> Callable[[Any, Any], FloatArray]:
    return lambda x, y: np.stack(function(x, y))


anything = st.floats(width=64) | st.sampled_from([0.0, -0.0, math.inf, -math.inf, math.nan, 5e-324, 1e308])
part = st.floats(0.03, 0.97)


def searches(share: float) -> Iterator[Row]:
    """Failures found by hypothesis; any floating-point warning counts as one."""
    search = settings(max_examples=round(share * 400), deadline=None, derandomize=True, database=None)
    for part in (_search_networks, _search_points, _search_surfaces, _search_law, _search_sandwich):
        yield part(search)


def _search_networks(search: settings) -> Row:
    worst = Worst(
        "ElectrodeNetwork, fractions, locate, estimate", "any gaps to 45 %, 1:3 to 3:1 (hypothesis)", 1e5
    )

    @search
    @given(st.floats(1 / 3, 3), st.lists(st.floats(1e-3, 0.45), min_size=4, max_size=4), part, part)
    def attempt(aspect: float, gaps: list[float], u: float, v: float) -> None:
        short = min(aspect, 1.0)
        pad = ElectrodeNetwork(aspect, 1.0, [gap * short for gap in gaps], 1.0)
        x, y = u * pad.a, v * pad.b
        shares = pad.fractions(x, y)
        worst.add(float(shares.sum()) - 1, 1, (aspect, gaps, u, v))
        found, likely = pad.locate(shares), pad.estimate(shares, 1e-6)
        condition = _condition(pad, x, y)
        if not np.isnan(found.x + found.y):
            worst.add(math.hypot(found.x - x, found.y - y), condition, (aspect, gaps, u, v))
        worst.add(
            min(math.hypot(likely.x - x, likely.y - y), 1e-6), max(condition, 1e5), (aspect, gaps, u, v)
        )

    attempt()
    return worst.row


def _search_points(search: settings) -> Row:
    worst = Worst(
        "ElectrodeNetwork, spoilt neighbours", "any numbers for places and currents (hypothesis)", 0.5
    )
    pad = ElectrodeNetwork(1.5, 1.0, 0.05, 2400.0, (10.0, 0.0, 336.0, 0.0))
    good = pad.fractions(0.4, 0.6)

    @search
    @given(anything, anything, st.lists(anything, min_size=4, max_size=4))
    def attempt(x: float, y: float, readings: list[float]) -> None:
        shares = pad.fractions(np.array([x, 0.4]), np.array([y, 0.6]))
        worst.add(EPS * float(not np.allclose(shares[:, 1], good, rtol=1e-12)), 1, (x, y))
        found = pad.locate(np.stack([readings, good], axis=1))
        worst.add(EPS * float(not np.isclose(found.x[1], 0.4, rtol=1e-9)), 1, readings)

    attempt()
    return worst.row


def _search_surfaces(search: settings) -> Row:
    worst = Worst("Cylinder, Cone, Sphere, Anisotropic", "there and back, any shape (hypothesis)", 1e4)

    @search
    @given(st.floats(0.1, 10), st.floats(0.1, 10), st.floats(0.05, 6.2), part, part)
    def attempt(near: float, far: float, arc: float, u: float, v: float) -> None:
        made: list[Surface] = [
            CylinderSurface(near, far, arc),
            ConeSurface(near, far, abs(far - near) + near, arc),
            SphereSurface(near, -0.1 * min(far, 10) * 0.9, 0.1 * near, arc),
        ]
        for surface in [*made, *(AnisotropicSurface(other, far) for other in made)]:
            x, y = u * surface.a, v * surface.b
            again = surface.to_rectangle(*surface.from_rectangle(x, y))
            worst.add(float(again[0] - x) / surface.a, 1, (type(surface).__name__, near, far, arc, u, v))
            worst.add(float(again[1] - y) / surface.b, 1, (type(surface).__name__, near, far, arc, u, v))
            along, around = surface.tangents(x, y)
            worst.add(float(along @ around), 1, (type(surface).__name__, near, far, arc, u, v))
            worst.add(float(np.linalg.norm(surface.normal(x, y))) - 1, 1, (near, far, arc, u, v))

    attempt()
    return worst.row


def _search_law(search: settings) -> Row:
    worst = Worst("ContactLaw, force of current", "any force, layer, exponent, where valid (hypothesis)", 1e8)
    powers = st.floats(-6, 3)

    @search
    @given(powers, powers, st.floats(0.3, 3), st.floats(1.5, 4), st.booleans())
    def attempt(force: float, layer: float, alpha: float, spread: float, hertz: bool) -> None:
        law = ContactLaw(10**layer, alpha, 1e-3, hertz_n=1.0 if hertz else None)
        radius = float(law.radius(10**force)) * 10**spread
        current = law.current(10**force, 5.0, 2400.0, radius)
        found = law.force(current, 5.0, 2400.0, radius)
        if found.status == ForceEstimateStatus.VALID:
            worst.add(float(found.force_n) / 10**force - 1, 1, (force, layer, alpha, spread, hertz))

    attempt()
    return worst.row


def _search_sandwich(search: settings) -> Row:
    worst = Worst(
        "Sandwich, force of its own currents", "any force and radius, where valid (hypothesis)", 1e11
    )
    pair = Sandwich((2e-2, 3e-2), (1.5, 0.7), (2400.0, 3000.0))

    @search
    @given(st.floats(-2, 1), st.floats(-3.5, -2.5))
    def attempt(force: float, radius: float) -> None:
        found = pair.force(pair.currents(10**force, 10**radius, 12.0, 0.02), 12.0, 0.02)
        if found.status == ForceEstimateStatus.VALID:
            worst.add(float(found.force_n) / 10**force - 1, 1, (force, radius))

    attempt()
    return worst.row


def main() -> int:
    """Run all parts; 1 if one is beyond its limit."""
    quick = options(__doc__).parse_args().quick
    warnings.simplefilter("error")
    np.seterr(all="raise")
    heads = ("function", "region", "cases", "worst, eps x condition", "limit", "where")
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    print("\n".join(lines))
    failed = 0
    for part in (stack, law, surfaces, conductance, ideal_limit, round_trip, networks, arguments, searches):
        for row in part(0.02 if quick else 1.0):
            failed += row.worst > row.limit
            mark = " **!**" if row.worst > row.limit else ""
            cells = (
                row.function,
                row.region,
                row.cases,
                f"{row.worst:.2g}{mark}",
                f"{row.limit:.2g}",
                row.where,
            )
            lines.append("| " + " | ".join(map(str, cells)) + " |")
            print(lines[-1], flush=True)
    machine = f"{platform.machine()}, Python {platform.python_version()}, numpy {np.__version__}"
    made = f"{made_by()}; {machine}, mpmath {mp.__version__}."
    print(made)
    head = ["# Stress of networks, surfaces and strength", "", made, ""]
    out = output_folder(quick) / "stress_network.md"
    out.write_text("\n".join(head + lines) + "\n")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
