"""The contact law and the sheet's resistance from readings of known weights, as the paper's 4.3 has it.

Public names: `fit_law`, `Fit`, `Interval`, `PARAMETERS`.

A contact of radius A under a force F passes I = V / (stack(sheet, sigma, A, R) + series), eq. 11, with
sigma = k / (F / pi A^2)^alpha, eq. 12. The paper guesses the plane's resistance from the largest force and
refines it until log(V / I - plane) against log F is straight; here all are found at once, by maximum
likelihood: ln k, alpha and ln of the sheet resistance, with the ln A of each indenter as a nuisance that is
known within its standard deviation. Errors are of two kinds: what is measured (noise, place), and the sheet's
own scatter from press to press, of one relative size in load, which is unknown and estimated (Mandel and
Paule: so that squared residuals are as many as degrees of freedom). Intervals are Student's, for that reason.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr, stdtrit

from handtouch.calibrate.readings import Circuit, Reading
from handtouch.field import ContactLaw
from handtouch.supervise.calibration import Law, matrix

FloatArray = NDArray[np.float64]
PARAMETERS = ("contact_ohm_mm2", "alpha", "ohm_per_square")

SHEET_STD = 0.2
"""Where readings don't tell the sheet's resistance, the file's is taken to be within this of ln of it."""
_SEEN = 0.1  # standard deviation of ln sheet resistance, from the readings alone, that counts as observed
_LEAST_WEIGHTS, _LEAST_FREEDOM = 3, 3
_WIDE = {"contact_ohm_mm2": math.log(2), "alpha": 0.4}  # half an interval that is too wide to be of use
_FLAT = 0.2  # slope of ln current by ln force, of 1 to 2 where the contact limits the current
_CROOKED = 1e-3  # probability below which readings don't lie on any law of this kind
_STEPS, _LONGEST, _SAME = 60, 1.0, 1e-9
_DELTA = 1e-5


@dataclass(frozen=True)
class Interval:
    """95 %."""

    low: float
    high: float


@dataclass(frozen=True)
class Fit:
    """What the readings say. law: most likely, with covariance. intervals: by name of `PARAMETERS`.

    scatter: relative standard deviation from press to press, as load. residuals (n,): of ln current;
    misfit: their root mean square in standard deviations. freedom: degrees of freedom. observed: whether the
    readings tell the sheet's resistance; else it is the file's, within SHEET_STD. radii_m: of the indenters,
    as fitted. problems: why the law is not to be used, with what to add; remarks: what to know of it.
    basis: what `band` needs.
    """

    law: Law
    intervals: dict[str, Interval]
    scatter: float
    misfit: float
    freedom: int
    observed: bool
    radii_m: FloatArray
    residuals: FloatArray
    problems: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    basis: _Basis | None = field(default=None, repr=False, compare=False)

    def band(self, force_n: FloatArray, circuit: Circuit, radius_m: float) -> FloatArray:
        """ln current and half its 95 % interval, (2, n), at forces under an indenter in a circuit."""
        assert self.basis is not None
        return self.basis.band(force_n, circuit, radius_m)


def fit_law(
    readings: Sequence[Reading],
    circuits: Sequence[Circuit],
    start: Law,
    reference_pa: float,
    radius_std: float,
) -> Fit:
    """Fit the law to readings, each with its circuit.

    start: the deployment file's, where the search begins. radius_std: standard deviation of an indenter's ln
    radius. Raises ValueError with words when there are too few readings to fit anything.
    """
    if lack := _lack(readings):
        raise ValueError(lack)
    data = _Data.of(readings, circuits, reference_pa, radius_std)
    free = _solve(data, start, sheet_std=math.inf)
    observed = free is not None and free.sheet_std < _SEEN
    solved = free if observed and free is not None else _solve(data, start, sheet_std=SHEET_STD)
    if solved is None:
        raise ValueError(f"no law fits these readings: {_unfit(readings)}")
    return _told(solved, observed, readings)


@dataclass(frozen=True)
class _Data:
    """Columns (n,) of the readings; indenter (n,) numbers into the distinct `radii_m`."""

    force_n: FloatArray
    log_current: FloatArray
    variance: FloatArray
    """of log_current, from noise"""
    spreading_m: FloatArray
    place_std: FloatArray
    drive_v: FloatArray
    series_ohm: FloatArray
    radii_m: FloatArray
    indenter: NDArray[np.intp]
    reference_pa: float
    radius_std: float

    @classmethod
    def of(
        cls, readings: Sequence[Reading], circuits: Sequence[Circuit], reference_pa: float, radius_std: float
    ) -> _Data:
        radii, indenter = np.unique([reading.weight.radius_m for reading in readings], return_inverse=True)
        current = np.array([reading.current_a for reading in readings])
        noise = np.array([reading.current_std_a for reading in readings]) / current
        return cls(
            np.array([reading.weight.force_n for reading in readings]),
            np.log(current),
            noise**2,
            np.array([circuit.spreading_m for circuit in circuits]),
            np.array([circuit.spreading_std for circuit in circuits]),
            np.array([circuit.drive_v for circuit in circuits]),
            np.array([circuit.series_ohm for circuit in circuits]),
            radii,
            indenter,
            reference_pa,
            radius_std,
        )

    def model(
        self, theta: FloatArray, log_force: FloatArray | None = None, log_spread: float = 0.0
    ) -> FloatArray:
        """ln current (..., n) of parameters (..., 3 + indenters): ln k, alpha, ln sheet, ln radii.

        k is in ohm m^2 at the reference.
        """
        log_k, alpha, log_sheet = (theta[..., i, None] for i in range(3))
        law = ContactLaw(
            np.exp(log_k), alpha, np.exp(theta[..., 3:][..., self.indenter]), reference_pa=self.reference_pa
        )
        force = self.force_n if log_force is None else np.exp(log_force)
        spreading = self.spreading_m * math.exp(log_spread)
        return np.log(law.current(force, self.drive_v, np.exp(log_sheet), spreading, self.series_ohm))

    def slopes(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Of ln current (n,) by ln force, and the standard deviation that the place adds."""
        ahead = self.model(theta, np.log(self.force_n) + _DELTA) - self.model(theta)
        aside = self.model(theta, log_spread=_DELTA) - self.model(theta)
        return ahead / _DELTA, aside / _DELTA * self.place_std


@dataclass(frozen=True)
class _Solved:
    data: _Data
    theta: FloatArray
    normal: FloatArray
    scatter: float
    variance: FloatArray
    freedom: int

    @cached_property
    def covariance(self) -> FloatArray:
        return np.asarray(np.linalg.inv(self.normal))

    def std(self, parameter: int) -> float:
        return math.sqrt(self.covariance[parameter, parameter])

    @property
    def sheet_std(self) -> float:
        """Of ln sheet resistance, were the radii known: what the readings themselves leave open."""
        return math.sqrt(np.linalg.inv(self.normal[:3, :3])[2, 2])


def _solve(data: _Data, start: Law, sheet_std: float) -> _Solved | None:
    """Gauss-Newton alternating with the scatter; None where it doesn't come to rest.

    sheet_std: of the file's ln sheet resistance; infinite where the readings alone are to tell it.
    """
    priors = np.concatenate([[math.inf, math.inf, sheet_std], np.full(len(data.radii_m), data.radius_std)])
    begin = np.concatenate(
        [
            [math.log(start.contact_ohm_mm2 * 1e-6), start.alpha, math.log(start.ohm_per_square)],
            np.log(data.radii_m),
        ]
    )
    freedom = len(data.force_n) - (3 if math.isinf(sheet_std) else 2)
    theta, scatter = begin.copy(), 0.05
    precision = np.diag(1 / np.maximum(priors, 1e-9) ** 2)
    for _ in range(_STEPS):
        steps = np.eye(len(theta)) * _DELTA
        values = data.model(np.vstack([theta, theta + steps]))
        jacobian = (values[1:] - values[0]).T / _DELTA
        residual = data.log_current - values[0]
        by_load, by_place = data.slopes(theta)
        known = data.variance + by_place**2
        scatter = _scatter(residual, known, by_load**2, freedom)
        variance = known + (scatter * by_load) ** 2
        normal = (jacobian.T / variance) @ jacobian + precision
        gradient = jacobian.T @ (residual / variance) + precision @ (begin - theta)
        if not np.isfinite(normal).all():
            return None
        step = np.linalg.lstsq(normal, gradient, rcond=1e-14)[0]
        step = np.clip(step, -_LONGEST, _LONGEST)
        step[1] = np.clip(step[1], -theta[1] / 2, None)
        theta = theta + step
        if np.abs(step).max() < _SAME:
            break
    else:
        return None
    if np.linalg.cond(normal) > 1e14:
        return None
    return _Solved(data, theta, normal, scatter, variance, freedom)


def _scatter(residual: FloatArray, known: FloatArray, by_load: FloatArray, freedom: int) -> float:
    """Relative standard deviation s of load: sum r^2 / (known + s^2 slope^2) = freedom, or 0."""

    def excess(log_s: float) -> float:
        return float((residual**2 / (known + math.exp(2 * log_s) * by_load)).sum()) - freedom

    low, high = math.log(1e-5), math.log(10.0)
    if excess(low) <= 0:
        return 0.0
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return math.exp(low)


def _told(solved: _Solved, observed: bool, readings: Sequence[Reading]) -> Fit:
    theta, data = solved.theta, solved.data
    law = Law(
        math.exp(theta[0]) * 1e6,
        float(theta[1]),
        math.exp(theta[2]),
        matrix(_symmetric(solved.covariance[:3, :3])),
    )
    sure = float(stdtrit(solved.freedom, 0.975))
    half = [sure * solved.std(i) for i in range(3)]
    intervals = {
        "contact_ohm_mm2": _around(law.contact_ohm_mm2, half[0]),
        "alpha": Interval(law.alpha - half[1], law.alpha + half[1]),
        "ohm_per_square": _around(law.ohm_per_square, half[2]),
    }
    residual = data.log_current - data.model(theta)
    misfit = math.sqrt(float((residual**2 / solved.variance).mean()))
    by_load, _ = data.slopes(theta)
    share = by_load / law.alpha  # of the contact in the whole resistance
    problems = _problems(solved, half, share, readings, residual)
    remarks = _remarks(observed, share, half[2], sure * solved.sheet_std, solved.scatter)
    radii = np.exp(theta[3:])
    return Fit(
        law, intervals, solved.scatter, misfit, solved.freedom, observed, radii, residual,
        tuple(problems), tuple(remarks), _Basis(data, theta, solved.covariance, sure),
    )  # fmt: skip


@dataclass(frozen=True)
class _Basis:
    data: _Data
    theta: FloatArray
    covariance: FloatArray
    sure: float

    def band(self, force_n: FloatArray, circuit: Circuit, radius_m: float) -> FloatArray:
        indenter = int(np.argmin(np.abs(self.data.radii_m - radius_m)))
        like = np.ones_like(force_n)
        at = _Data(
            force_n, like, like, circuit.spreading_m * like, 0 * like, circuit.drive_v * like,
            circuit.series_ohm * like, self.data.radii_m, np.full(len(force_n), indenter, dtype=np.intp),
            self.data.reference_pa, self.data.radius_std,
        )  # fmt: skip
        values = at.model(np.vstack([self.theta, self.theta + np.eye(len(self.theta)) * _DELTA]))
        jacobian = (values[1:] - values[0]).T / _DELTA
        spread = np.sqrt(np.einsum("ni,ij,nj->n", jacobian, self.covariance, jacobian))
        return np.stack([values[0], self.sure * spread])


def _lack(readings: Sequence[Reading]) -> str:
    """Why nothing can be fitted; empty if something can."""
    weights = {reading.weight.force_n for reading in readings}
    if len(weights) < _LEAST_WEIGHTS:
        return (
            f"{len(weights)} different weights were read, {_LEAST_WEIGHTS} are needed at least, better 5: "
            "a law has a level, a slope and a bend"
        )
    if len(readings) < 3 + _LEAST_FREEDOM:
        return f"{len(readings)} readings, {3 + _LEAST_FREEDOM} are needed at least: repeat each weight"
    if min(reading.current_a for reading in readings) <= 0:
        return "a reading has no current: the weight is below what this sheet feels, leave it out"
    return ""


def _unfit(readings: Sequence[Reading]) -> str:
    """Likely causes where no law fits."""
    causes = _falling(readings)
    force, current = np.log([(reading.weight.force_n, reading.current_a) for reading in readings]).T
    if not causes and abs(np.polyfit(force, current, 1)[0]) < _FLAT:
        causes = ["the current hardly changes with the weight, the sheet limits it: add lighter weights"]
    return "; ".join(causes) or "were weights mixed up, or was another pad under them?"


def _problems(
    solved: _Solved,
    half: Sequence[float],
    share: FloatArray,
    readings: Sequence[Reading],
    residual: FloatArray,
) -> list[str]:
    found = list(_falling(readings))
    forces = solved.data.force_n
    span = float(forces.max() / forces.min())
    wide = [name for name, size in zip(PARAMETERS, half, strict=False) if size > _WIDE.get(name, math.inf)]
    if wide:
        text = f"{' and '.join(wide)} can't be told from these readings (alpha to +- {half[1]:.2g})"
        causes = []
        if share.max() < 0.3:
            causes.append(
                f"the sheet, not the contact, limits the current (contact at most {share.max():.0%} of the "
                "resistance): add lighter weights"
            )
        if span < 8:
            causes.append(f"the weights span only 1:{span:.3g}: add lighter or heavier ones, to 1:10")
        if solved.scatter > 0.1:
            causes.append(
                f"presses scatter by {solved.scatter:.0%} of the load: set weights down flat and in the same "
                "place, let the sheet rest, repeat each more often"
            )
        found.append(f"{text}; {'; '.join(causes) or 'repeat each weight more often'}")
    if not wide and (chance := _straightness(solved, residual)) < _CROOKED:
        found.append(
            f"the readings don't lie on such a law (chance {chance:.1g}): does the contact's size change "
            "with the weight, as under a round object? Stand all weights on one flat foot"
        )
    return found


def _straightness(solved: _Solved, residual: FloatArray) -> float:
    """Probability of means so far from the law, given how repetitions scatter; 1 where nothing repeats."""
    data = solved.data
    scaled = residual / np.sqrt(solved.variance)
    _, group = np.unique(np.stack([data.force_n, data.radii_m[data.indenter]]), axis=1, return_inverse=True)
    group = group.reshape(-1)
    count = np.bincount(group)
    mean = np.bincount(group, scaled) / count
    lack_freedom = len(count) - (len(scaled) - solved.freedom)
    pure_freedom = len(scaled) - len(count)
    if lack_freedom < 1 or pure_freedom < 1:
        return 1.0
    pure = float(((scaled - mean[group]) ** 2).sum()) / pure_freedom
    lack = float((count * mean**2).sum()) / lack_freedom
    if pure <= 0:
        return 1.0
    from scipy.special import fdtrc

    return float(fdtrc(lack_freedom, pure_freedom, lack / pure))


def _falling(readings: Sequence[Reading]) -> list[str]:
    """Where a heavier weight gave surely less current."""
    found = []
    for radius in sorted({reading.weight.radius_m for reading in readings}):
        logs: dict[float, list[float]] = {}
        names = {}
        for reading in readings:
            if reading.weight.radius_m == radius:
                logs.setdefault(reading.weight.force_n, []).append(math.log(reading.current_a))
                names[reading.weight.force_n] = reading.weight.name
        forces = sorted(logs)
        spread = [float(np.var(values, ddof=1)) for values in logs.values() if len(values) > 1]
        pooled = math.sqrt(np.mean(spread)) if spread else 0.02
        for light, heavy in itertools.pairwise(forces):
            fall = float(np.mean(logs[light]) - np.mean(logs[heavy]))
            doubt = pooled * math.sqrt(1 / len(logs[light]) + 1 / len(logs[heavy]))
            freedom = sum(len(values) - 1 for values in logs.values()) or 1
            if fall > 0 and stdtr(freedom, -fall / max(doubt, 1e-6)) < 0.01:
                found.append(
                    f"{names[heavy]} gave less current than {names[light]} ({-100 * math.expm1(-fall):.0f} % "
                    "less): were they mixed up, or is the sheet fading? Let it rest, and do these again"
                )
    return found


def _remarks(
    observed: bool, share: FloatArray, sheet_half: float, by_readings: float, scatter: float
) -> list[str]:
    told = []
    if not observed:
        told.append(
            f"the sheet's resistance is not observable: the contact makes {share.min():.0%} of the whole "
            f"or more at every weight. The file's is kept, within {SHEET_STD:.0%}; add heavier weights"
        )
    elif by_readings > 0.2:
        told.append(
            f"the sheet's resistance is told to {by_readings:.0%} only: heavier weights would tell it better"
        )
    elif sheet_half > 2 * by_readings:
        told.append(
            "k and the sheet's resistance are told as well as the radius under the weights is, the latter "
            f"to {sheet_half:.0%}: give it by --radius-mm, or weights on two radii; forces don't suffer"
        )
    if scatter > 0.1:
        told.append(f"presses scatter by {scatter:.0%} of the load: forces from this pad will, too")
    return told


def _around(value: float, half: float) -> Interval:
    return Interval(value * math.exp(-half), value * math.exp(half))


def _symmetric(values: FloatArray) -> FloatArray:
    return np.asarray((values + values.T) / 2)
