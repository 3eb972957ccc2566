"""Fit of contact law and sheet resistance to readings of known weights, as in the paper's 4.3.

Public names: `fit_law`, `fit_laws` of `SheetReadings`, `LawFit`, `ConfidenceInterval`, `PARAMETERS`,
`MIN_EVIDENCE`.

A contact of radius A under a force F passes I = V / (stack(sheet, sigma, A, R) + series), eq. 11, with
sigma = k / (F / pi A^2)^alpha, eq. 12. The paper guesses the plane's resistance from the largest force and
refines it until log(V / I - plane) against log F is straight; here all are estimated together, by maximum
likelihood: ln k, alpha and ln of the sheet resistance, with the ln A of each indenter as a nuisance that is
known within its standard deviation. Errors are of two kinds: of the measurement (noise, position), and the
sheet's own scatter from press to press, of one relative size in load, which is unknown and estimated (Mandel
and Paule: so that the sum of squared residuals equals the degrees of freedom). Intervals are Student's, for
that reason.

Both radius laws are fitted: the same radius at every force, as under a flat foot, and one that grows as
force^(1/3), as under a round one (Hertz). They have as many parameters. The deployment's is kept unless the
readings are much likelier under the other one, by `MIN_EVIDENCE`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr, stdtrit

from handtouch.arrays import FloatArray
from handtouch.calibration.calibration import LAW_AGE_S, LawParameters, matrix
from handtouch.field import ContactLaw
from handtouch.procedures.calibrate.readings import ContactCircuit, WeightReading

PARAMETERS = ("contact_ohm_mm2", "alpha", "ohm_per_square")

SHEET_LOG_STD = 0.2
"""Standard deviation of ln of the file's sheet resistance, used if the readings don't determine it."""
_MAX_OBSERVED_LOG_STD = 0.1
"""Standard deviation of ln sheet resistance, from the readings alone, that counts as observed."""
MIN_EVIDENCE = 6.0
"""Twice the log likelihood ratio from which on the other radius law replaces the deployment's: "strong" in
the scale of Kass and Raftery, J. Am. Stat. Assoc. 90, 1995; a ratio of 20."""
_MIN_WEIGHTS, _MIN_DEGREES_OF_FREEDOM = 3, 3
_MAX_HALF_INTERVALS = {
    "contact_ohm_mm2": math.log(2),
    "alpha": 0.4,
}  # half widths above which an interval is useless
_MIN_CURRENT_SLOPE = 0.2  # d ln current / d ln force; 1 to 2 if the contact limits the current
_MIN_LAW_PROBABILITY = 1e-3  # probability below which the readings contradict any such law
_MODEL_LOG_STD = 0.002
"""Of the law itself, against contacts that are solved (the simulator's world `ideal`): readings without any
scatter don't contradict it"""
_NO_FIT_DEVIANCE = 1e6
_MAX_ITERATIONS, _MAX_STEP, _CONVERGED_STEP = 60, 1.0, 1e-9
_DIFFERENCE_STEP = 1e-5


@dataclass(frozen=True)
class ConfidenceInterval:
    """Interval of 95 % confidence."""

    low: float
    high: float


@dataclass(frozen=True)
class LawFit:
    """Fitted law. law: most likely, with covariance. intervals: by name of `PARAMETERS`.

    scatter: relative standard deviation from press to press, as load. residuals (n,): of ln current;
    misfit: their root mean square in standard deviations. freedom: degrees of freedom. observed: whether the
    readings determine the sheet's resistance; else it is the file's, within SHEET_LOG_STD. radii_m: of the
    indenters, as fitted; where the law's `hertz_force_n` is known, at that force. evidence: twice the log
    likelihood ratio of the radius law that grows over the constant one. problems: reasons not to use the law,
    with remedies; remarks: limitations. basis: data for `band`.
    """

    law: LawParameters
    intervals: dict[str, ConfidenceInterval]
    scatter: float
    misfit: float
    degrees_of_freedom: int
    sheet_observed: bool
    radii_m: FloatArray
    residuals: FloatArray
    evidence: float
    problems: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    basis: _BandBasis | None = field(default=None, repr=False, compare=False)

    def radius_m(self, force_n: FloatArray, radius_m: float) -> FloatArray:
        """Return the fitted radius (n,) under the indenter of a stated radius [m], at forces (n,)."""
        assert self.basis is not None
        fitted = self.radii_m[np.argmin(np.abs(self.basis.data.radii_m - radius_m))]
        return np.asarray(fitted * np.exp(self.basis.data.log_growth(np.log(force_n))))

    def band(self, force_n: FloatArray, circuit: ContactCircuit, radius_m: float) -> FloatArray:
        """Return ln current and half its 95 % interval, (2, n), at forces under an indenter in a circuit."""
        assert self.basis is not None
        return self.basis.band(force_n, circuit, radius_m)


@dataclass(frozen=True)
class SheetReadings:
    """Readings of one sheet, each with its circuit; start: the deployment file's law."""

    readings: Sequence[WeightReading]
    circuits: Sequence[ContactCircuit]
    start: LawParameters
    reference_pa: float


def fit_law(
    readings: Sequence[WeightReading],
    circuits: Sequence[ContactCircuit],
    start: LawParameters,
    reference_pa: float,
    radius_std: float,
) -> LawFit:
    """Fit the law to readings, each with its circuit.

    start: the deployment file's, where the search begins. radius_std: standard deviation of an indenter's ln
    radius. Raises ValueError for too few readings.
    """
    (fit,) = fit_laws([SheetReadings(readings, circuits, start, reference_pa)], radius_std)
    return fit


def fit_laws(sheets: Sequence[SheetReadings], radius_std: float) -> list[LawFit]:
    """Fit the laws of sheets under the same weights: the contact's radius follows one law. Raises as
    `fit_law`."""
    columns, evidence, before_n = [], 0.0, sheets[0].start.hertz_force_n
    for sheet in sheets:
        if lack := _insufficient_data(sheet.readings):
            raise ValueError(lack)
        constant = _ReadingColumns.from_readings(
            sheet.readings, sheet.circuits, sheet.reference_pa, radius_std
        )
        growing = replace(constant, hertz_force_n=before_n or float(np.exp(np.log(constant.force_n).mean())))
        evidence += _deviance(constant, sheet.start) - _deviance(growing, sheet.start)
        columns.append((constant, growing))
    is_growing = evidence > (MIN_EVIDENCE if before_n is None else -MIN_EVIDENCE)
    return [
        _fit_columns(data[is_growing], sheet, evidence) for data, sheet in zip(columns, sheets, strict=True)
    ]


def _fit_columns(data: _ReadingColumns, sheet: SheetReadings, evidence: float) -> LawFit:
    free = _solve(data, sheet.start, sheet_std=math.inf)
    observed = free is not None and free.sheet_std < _MAX_OBSERVED_LOG_STD
    solved = free if observed and free is not None else _solve(data, sheet.start, sheet_std=SHEET_LOG_STD)
    if solved is None:
        raise ValueError(f"no law fits these readings: {_failure_causes(sheet.readings)}")
    return _build_fit(solved, observed, sheet.readings, evidence)


def _deviance(data: _ReadingColumns, start: LawParameters) -> float:
    """Return -2 ln of the greatest likelihood of the readings, with the file's sheet resistance for prior."""
    solved = _solve(data, start, sheet_std=SHEET_LOG_STD)
    if solved is None:
        return _NO_FIT_DEVIANCE
    return solved.deviance


@dataclass(frozen=True)
class _ReadingColumns:
    """Columns (n,) of the readings; indenter (n,) numbers into the distinct `radii_m`."""

    force_n: FloatArray
    log_current: FloatArray
    variance: FloatArray
    """of log_current, from noise"""
    log_force_std: FloatArray
    """of ln force, as stated"""
    spreading_m: FloatArray
    spreading_log_std: FloatArray
    drive_v: FloatArray
    series_ohm: FloatArray
    radii_m: FloatArray
    indenter: NDArray[np.intp]
    reference_pa: float
    radius_std: float
    hertz_force_n: float | None = None
    """at which the indenters have their radii; None: at every force"""

    @classmethod
    def from_readings(
        cls,
        readings: Sequence[WeightReading],
        circuits: Sequence[ContactCircuit],
        reference_pa: float,
        radius_std: float,
    ) -> _ReadingColumns:
        radii, indenter = np.unique([reading.weight.radius_m for reading in readings], return_inverse=True)
        current = np.array([reading.current_a for reading in readings])
        noise = np.array([reading.current_std_a for reading in readings]) / current
        return cls(
            force_n=np.array([reading.apparent_n for reading in readings]),
            log_current=np.log(current),
            variance=noise**2,
            log_force_std=np.array([reading.weight.std_n / reading.weight.force_n for reading in readings]),
            spreading_m=np.array([circuit.spreading_m for circuit in circuits]),
            spreading_log_std=np.array([circuit.spreading_log_std for circuit in circuits]),
            drive_v=np.array([circuit.drive_v for circuit in circuits]),
            series_ohm=np.array([circuit.series_ohm for circuit in circuits]),
            radii_m=radii,
            indenter=indenter,
            reference_pa=reference_pa,
            radius_std=radius_std,
        )

    def log_current_model(
        self, theta: FloatArray, log_force: FloatArray | None = None, log_spread: float = 0.0
    ) -> FloatArray:
        """Return ln current (..., n) of parameters (..., 3 + indenters): ln k, alpha, ln sheet, ln radii.

        k is in ohm m^2 at the reference.
        """
        log_k, alpha, log_sheet = (theta[..., i, None] for i in range(3))
        force = self.force_n if log_force is None else np.exp(log_force)
        log_radius = theta[..., 3:][..., self.indenter] + self.log_growth(np.log(force))
        law = ContactLaw(np.exp(log_k), alpha, np.exp(log_radius), reference_pa=self.reference_pa)
        spreading = self.spreading_m * math.exp(log_spread)
        return np.log(law.current(force, self.drive_v, np.exp(log_sheet), spreading, self.series_ohm))

    def log_growth(self, log_force: FloatArray) -> FloatArray:
        """Return ln of the radius at forces over that stated."""
        if self.hertz_force_n is None:
            return np.zeros_like(log_force)
        return np.asarray((log_force - math.log(self.hertz_force_n)) / 3)

    def slopes(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return slopes of ln current (n,) by ln force, and its standard deviation by the position."""
        by_force = self.log_current_model(
            theta, np.log(self.force_n) + _DIFFERENCE_STEP
        ) - self.log_current_model(theta)
        by_spreading = self.log_current_model(theta, log_spread=_DIFFERENCE_STEP) - self.log_current_model(
            theta
        )
        return by_force / _DIFFERENCE_STEP, by_spreading / _DIFFERENCE_STEP * self.spreading_log_std


@dataclass(frozen=True)
class _LawSolution:
    data: _ReadingColumns
    theta: FloatArray
    normal: FloatArray
    scatter: float
    variance: FloatArray
    degrees_of_freedom: int
    deviance: float
    """-2 ln of the likelihood"""

    @cached_property
    def covariance(self) -> FloatArray:
        return np.asarray(np.linalg.inv(self.normal))

    def std(self, parameter: int) -> float:
        return math.sqrt(self.covariance[parameter, parameter])

    @property
    def sheet_std(self) -> float:
        """Return the std of ln sheet resistance for known radii, from the readings alone."""
        return math.sqrt(np.linalg.inv(self.normal[:3, :3])[2, 2])


def _solve(data: _ReadingColumns, start: LawParameters, sheet_std: float) -> _LawSolution | None:
    """Iterate Gauss-Newton steps and the scatter; None without convergence.

    sheet_std: of the file's ln sheet resistance; infinite to use the readings alone.
    """
    priors = np.concatenate([[math.inf, math.inf, sheet_std], np.full(len(data.radii_m), data.radius_std)])
    alpha = start.alpha
    if (data.hertz_force_n is None) != (start.hertz_force_n is None):  # the current's slope by force is kept
        alpha = 3 * alpha - 2 if start.hertz_force_n is None else (alpha + 2) / 3
    start_theta = np.concatenate(
        [
            [math.log(start.contact_ohm_mm2 * 1e-6), max(alpha, 0.5), math.log(start.ohm_per_square)],
            np.log(data.radii_m),
        ]
    )
    freedom = len(data.force_n) - (3 if math.isinf(sheet_std) else 2)
    theta, scatter = start_theta.copy(), 0.05
    precision = np.diag(1 / np.maximum(priors, 1e-9) ** 2)
    for _ in range(_MAX_ITERATIONS):
        steps = np.eye(len(theta)) * _DIFFERENCE_STEP
        values = data.log_current_model(np.vstack([theta, theta + steps]))
        jacobian = (values[1:] - values[0]).T / _DIFFERENCE_STEP
        residual = data.log_current - values[0]
        by_load, by_place = data.slopes(theta)
        known = data.variance + by_place**2 + (by_load * data.log_force_std) ** 2
        scatter = _scatter(residual, known, by_load**2, freedom)
        variance = known + (scatter * by_load) ** 2
        normal = (jacobian.T / variance) @ jacobian + precision
        gradient = jacobian.T @ (residual / variance) + precision @ (start_theta - theta)
        if not np.isfinite(normal).all():
            return None
        step = np.linalg.lstsq(normal, gradient, rcond=1e-14)[0]
        step = np.clip(step, -_MAX_STEP, _MAX_STEP)
        step[1] = np.clip(step[1], -theta[1] / 2, None)
        theta = theta + step
        if np.abs(step).max() < _CONVERGED_STEP:
            break
    else:
        return None
    if np.linalg.cond(normal) > 1e14:
        return None
    away = (theta - start_theta) / priors
    deviance = float((residual**2 / variance + np.log(variance)).sum() + (away**2).sum())
    return _LawSolution(data, theta, normal, scatter, variance, freedom, deviance)


def _scatter(residual: FloatArray, known: FloatArray, by_load: FloatArray, freedom: int) -> float:
    """Return the relative standard deviation s of load: sum r^2 / (known + s^2 slope^2) = freedom, or 0."""

    def excess(log_s: float) -> float:
        return float((residual**2 / (known + math.exp(2 * log_s) * by_load)).sum()) - freedom

    low, high = math.log(1e-5), math.log(10.0)
    if excess(low) <= 0:
        return 0.0
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return math.exp(low)


def _mean_age_s(readings: Sequence[WeightReading]) -> float:
    """Return the age at which creep by a power law is the mean of these readings'."""
    ages = np.array([reading.measured_s - reading.loaded_s for reading in readings])
    return float(np.exp(np.log(ages).mean())) if (ages > 0).all() else LAW_AGE_S


def _build_fit(
    solved: _LawSolution, observed: bool, readings: Sequence[WeightReading], evidence: float
) -> LawFit:
    theta, data = solved.theta, solved.data
    law = LawParameters(
        math.exp(theta[0]) * 1e6,
        float(theta[1]),
        math.exp(theta[2]),
        matrix(_symmetric(solved.covariance[:3, :3])),
        data.hertz_force_n,
        _mean_age_s(readings),
    )
    quantile = float(stdtrit(solved.degrees_of_freedom, 0.975))
    half = [quantile * solved.std(i) for i in range(3)]
    intervals = {
        "contact_ohm_mm2": _log_interval(law.contact_ohm_mm2, half[0]),
        "alpha": ConfidenceInterval(law.alpha - half[1], law.alpha + half[1]),
        "ohm_per_square": _log_interval(law.ohm_per_square, half[2]),
    }
    residual = data.log_current - data.log_current_model(theta)
    misfit = math.sqrt(float((residual**2 / solved.variance).mean()))
    by_load, _ = data.slopes(theta)
    share = by_load / law.alpha  # share of the contact in the total resistance
    problems = _problems(solved, half, share, readings, residual)
    remarks = _remarks(observed, share, half[2], quantile * solved.sheet_std, solved.scatter)
    radii = np.exp(theta[3:])
    return LawFit(
        law=law,
        intervals=intervals,
        scatter=solved.scatter,
        misfit=misfit,
        degrees_of_freedom=solved.degrees_of_freedom,
        sheet_observed=observed,
        radii_m=radii,
        residuals=residual,
        evidence=evidence,
        problems=tuple(problems),
        remarks=tuple(remarks),
        basis=_BandBasis(data, theta, solved.covariance, quantile),
    )


@dataclass(frozen=True)
class _BandBasis:
    data: _ReadingColumns
    theta: FloatArray
    covariance: FloatArray
    t_quantile: float

    def band(self, force_n: FloatArray, circuit: ContactCircuit, radius_m: float) -> FloatArray:
        indenter = int(np.argmin(np.abs(self.data.radii_m - radius_m)))
        like = np.ones_like(force_n)
        at = replace(
            self.data,
            force_n=force_n,
            log_current=like,
            variance=like,
            log_force_std=0 * like,
            spreading_m=circuit.spreading_m * like,
            spreading_log_std=0 * like,
            drive_v=circuit.drive_v * like,
            series_ohm=circuit.series_ohm * like,
            indenter=np.full(len(force_n), indenter, dtype=np.intp),
        )
        values = at.log_current_model(
            np.vstack([self.theta, self.theta + np.eye(len(self.theta)) * _DIFFERENCE_STEP])
        )
        jacobian = (values[1:] - values[0]).T / _DIFFERENCE_STEP
        spread = np.sqrt(np.einsum("ni,ij,nj->n", jacobian, self.covariance, jacobian))
        return np.stack([values[0], self.t_quantile * spread])


def _insufficient_data(readings: Sequence[WeightReading]) -> str:
    """Return why nothing can be fitted; empty if something can."""
    weights = {reading.weight.force_n for reading in readings}
    if len(weights) < _MIN_WEIGHTS:
        return (
            f"{len(weights)} different weights were read, {_MIN_WEIGHTS} are needed at least, better 5: "
            "a law has a level, a slope and a bend"
        )
    if len(readings) < 3 + _MIN_DEGREES_OF_FREEDOM:
        return (
            f"{len(readings)} readings, {3 + _MIN_DEGREES_OF_FREEDOM} are needed at least: repeat each weight"
        )
    if min(reading.current_a for reading in readings) <= 0:
        return "a reading has no current: the weight is below this sheet's threshold, leave it out"
    return ""


def _failure_causes(readings: Sequence[WeightReading]) -> str:
    """Return likely causes why no law fits."""
    causes = _decreasing_currents(readings)
    force, current = np.log([(reading.apparent_n, reading.current_a) for reading in readings]).T
    if not causes and abs(np.polyfit(force, current, 1)[0]) < _MIN_CURRENT_SLOPE:
        causes = ["the current hardly changes with the weight, the sheet limits it: add lighter weights"]
    return "; ".join(causes) or "were weights mixed up, or was another pad under them?"


def _problems(
    solved: _LawSolution,
    half: Sequence[float],
    share: FloatArray,
    readings: Sequence[WeightReading],
    residual: FloatArray,
) -> list[str]:
    found = list(_decreasing_currents(readings))
    forces = solved.data.force_n
    span = float(forces.max() / forces.min())
    wide = [
        name
        for name, size in zip(PARAMETERS, half, strict=False)
        if size > _MAX_HALF_INTERVALS.get(name, math.inf)
    ]
    if wide:
        text = f"{' and '.join(wide)} can't be determined from these readings (alpha to +- {half[1]:.2g})"
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
                "place, let the sheet recover, repeat each more often"
            )
        found.append(f"{text}; {'; '.join(causes) or 'repeat each weight more often'}")
    if not wide and (chance := _lack_of_fit_probability(solved, readings, residual)) < _MIN_LAW_PROBABILITY:
        found.append(
            f"the readings don't lie on such a law (chance {chance:.1g}): does the contact's size change "
            "with the weight, otherwise than under a round object? Stand all weights on one foot, flat or "
            "round"
        )
    return found


def _lack_of_fit_probability(
    solved: _LawSolution, readings: Sequence[WeightReading], residual: FloatArray
) -> float:
    """Return the probability of means so far from the law, by the scatter of repetitions; 1 without any."""
    scaled = residual / np.sqrt(solved.variance)
    weights = [(reading.weight.force_n, reading.weight.radius_m) for reading in readings]
    _, group = np.unique(weights, axis=0, return_inverse=True)
    group = group.reshape(-1)
    count = np.bincount(group)
    mean = np.bincount(group, scaled) / count
    lack_freedom = len(count) - (len(scaled) - solved.degrees_of_freedom)
    pure_freedom = len(scaled) - len(count)
    if lack_freedom < 1 or pure_freedom < 1:
        return 1.0
    pure = float(((scaled - mean[group]) ** 2).sum()) / pure_freedom
    lack = float((count * mean**2).sum()) / lack_freedom
    pure += float(np.mean(_MODEL_LOG_STD**2 / solved.variance)) * len(scaled) / len(count)
    if pure <= 0:
        return 1.0
    from scipy.special import fdtrc

    return float(fdtrc(lack_freedom, pure_freedom, lack / pure))


def _decreasing_currents(readings: Sequence[WeightReading]) -> list[str]:
    """Return weights that gave significantly less current than lighter ones."""
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
            standard_error = pooled * math.sqrt(1 / len(logs[light]) + 1 / len(logs[heavy]))
            freedom = sum(len(values) - 1 for values in logs.values()) or 1
            if fall > 0 and stdtr(freedom, -fall / max(standard_error, 1e-6)) < 0.01:
                found.append(
                    f"{names[heavy]} gave less current than {names[light]} ({-100 * math.expm1(-fall):.0f} % "
                    "less): were they mixed up, or does the sheet adapt? Let it recover, and repeat these"
                )
    return found


def _remarks(
    observed: bool, share: FloatArray, sheet_half: float, by_readings: float, scatter: float
) -> list[str]:
    remarks = []
    if not observed:
        remarks.append(
            f"the sheet's resistance is not observable: the contact makes {share.min():.0%} of the whole "
            f"or more at every weight. The file's value is kept, within {SHEET_LOG_STD:.0%}; add heavier "
            "weights"
        )
    elif by_readings > 0.2:
        remarks.append(
            f"the sheet's resistance is known to {by_readings:.0%} only: heavier weights would improve it"
        )
    elif sheet_half > 2 * by_readings:
        remarks.append(
            "k and the sheet's resistance are known only as well as the radius under the weights, the latter "
            f"to {sheet_half:.0%}: set --radius-mm, or use weights on two radii; forces aren't affected"
        )
    if scatter > 0.1:
        remarks.append(f"presses scatter by {scatter:.0%} of the load: forces from this pad will, too")
    return remarks


def _log_interval(value: float, half: float) -> ConfidenceInterval:
    return ConfidenceInterval(value * math.exp(-half), value * math.exp(half))


def _symmetric(values: FloatArray) -> FloatArray:
    return np.asarray((values + values.T) / 2)
