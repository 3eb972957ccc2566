"""Report of a calibration: force errors before and after, the law with its intervals, as text and JSON.

Public names: `CalibrationReport`, `build_report`, `format_text`, `to_json`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from handtouch import config
from handtouch.calibration.calibration import LawParameters
from handtouch.core.pad_model import contact_law, law_of
from handtouch.procedures.calibrate.fit import MIN_EVIDENCE, PARAMETERS, LawFit
from handtouch.procedures.calibrate.readings import ContactCircuit, WeightReading

_UNITS = {"contact_ohm_mm2": "ohm mm2", "alpha": "", "ohm_per_square": "ohm per square"}


@dataclass(frozen=True)
class WeightErrors:
    """Readings of one weight: number, mean current, its scatter, rms relative force errors; NaN if
    unknown."""

    weight: str
    force_n: float
    readings: int
    current_a: float
    scatter: float
    force_error_before: float
    force_error_after: float


@dataclass(frozen=True)
class CalibrationReport:
    """Fit with the force errors of the daemon before, and expected after it; second: of the pad's second
    sheet."""

    pad: str
    fit: LawFit
    weight_errors: tuple[WeightErrors, ...]
    force_error_before: float
    force_error_after: float
    default_law: LawParameters
    second: CalibrationReport | None = None

    @property
    def laws(self) -> list[LawParameters]:
        """Laws of the pad's sheets."""
        return [self.fit.law, *([] if self.second is None else [self.second.fit.law])]

    @property
    def problems(self) -> list[str]:
        """Reasons not to use the laws, with remedies."""
        named = [] if self.second is None else [f"second sheet: {one}" for one in self.second.problems]
        return [*self.fit.problems, *named]


def build_report(
    pad: str,
    fit: LawFit,
    sheet: config.Sheet,
    readings: Sequence[WeightReading],
    circuits: Sequence[ContactCircuit],
) -> CalibrationReport:
    """Return the report of a fit of one sheet.

    before: errors of the forces that the daemon published; after: expected for the same readings under the
    new law by this sheet alone, with the contact radius of the deployment file.
    """
    after = [
        reported_force(fit.law, sheet, reading, circuit) / reading.apparent_n - 1
        for reading, circuit in zip(readings, circuits, strict=True)
    ]
    before = [reading.reported_force_n / reading.weight.force_n - 1 for reading in readings]
    rows = []
    for weight in sorted({reading.weight for reading in readings}, key=lambda w: (w.radius_m, w.force_n)):
        chosen = [k for k, reading in enumerate(readings) if reading.weight == weight]
        current = np.array([readings[k].current_a for k in chosen])
        scatter = float(current.std(ddof=1) / current.mean()) if len(chosen) > 1 else math.nan
        errors = _rms([before[k] for k in chosen]), _rms([after[k] for k in chosen])
        rows.append(
            WeightErrors(weight.name, weight.force_n, len(chosen), float(current.mean()), scatter, *errors)
        )
    return CalibrationReport(pad, fit, tuple(rows), _rms(before), _rms(after), law_of(sheet))


def reported_force(
    law: LawParameters, sheet: config.Sheet, reading: WeightReading, circuit: ContactCircuit
) -> float:
    """Return the force [N] that the daemon estimates for a reading of a sheet under a law; NaN above the
    sheet's limit."""
    estimate = contact_law(sheet, law).force(
        reading.current_a, circuit.drive_v, law.ohm_per_square, circuit.spreading_m, circuit.series_ohm
    )
    return float(estimate.force_n)


def format_text(report: CalibrationReport) -> str:
    """Return the report as text."""
    lines = [
        f"{'weight':>16} {'n':>3} {'mA':>9} {'scatter':>8} {'before':>8} {'after':>8}   force error, rms"
    ]
    rows = [
        (row.weight, row.readings, row.current_a, row.scatter, row.force_error_before, row.force_error_after)
        for row in report.weight_errors
    ]
    for name, count, current, *parts in rows:
        lines += [
            f"{name:>16} {count:>3} {1e3 * current:>9.4g} " + " ".join(f"{_percent(p):>8}" for p in parts)
        ]
    lines.append(
        f"{'all':>39} {_percent(report.force_error_before):>8} {_percent(report.force_error_after):>8}"
    )
    lines += ["", *_law_lines(report)]
    if report.second is not None:
        lines += ["", "second sheet", *_law_lines(report.second)]
    return "\n".join([*lines, *(f"Not enough: {problem}." for problem in report.problems)])


def _law_lines(report: CalibrationReport) -> list[str]:
    """Return the law of a sheet with its intervals, and remarks."""
    fit, law, lines = report.fit, report.fit.law, list[str]()
    for name in PARAMETERS:
        value, interval, file = getattr(law, name), fit.intervals[name], getattr(report.default_law, name)
        kept = "  (not observed)" if name == "ohm_per_square" and not fit.sheet_observed else ""
        lines.append(
            f"{name:<16} {value:>9.5g}  95 %: {interval.low:.5g} to {interval.high:.5g} {_UNITS[name]}; "
            f"file: {file:.5g}{kept}"
        )
    lines += _radius_lines(report)
    lines.append(f"{'scatter':<16} {fit.scatter:>9.1%}  from press to press, of the load")
    return [*lines, *(f"Note: {remark}." for remark in fit.remarks)]


def _radius_lines(report: CalibrationReport) -> list[str]:
    """Return the radius law that was chosen, and the evidence for it."""
    fit = report.fit
    names = "the same at every force", "grows as force^(1/3)"
    chosen_n, is_files = fit.law.hertz_force_n, "the file's"
    at = "" if chosen_n is None else f", {1e3 * fit.radii_m[0]:.3g} mm at {chosen_n:.3g} N"
    if (chosen_n is None) != (report.default_law.hertz_force_n is None):
        is_files = "unlike the file's"
    verdict = f"strong beyond +-{MIN_EVIDENCE:.0f}"
    if abs(fit.evidence) < MIN_EVIDENCE:
        verdict = f"undecided within +-{MIN_EVIDENCE:.0f}: add lighter and heavier weights, to 1:100"
    return [
        f"{'contact radius':<16} {names[chosen_n is not None]}{at}; {is_files}",
        f"{'':<16} 2 ln(likelihood ratio) of growing over constant: {fit.evidence:+.1f}; {verdict}",
    ]


def to_json(report: CalibrationReport, **more: Any) -> dict[str, Any]:
    """Return the report as plain values; unknown ones are NaN."""
    fit = report.fit
    return {
        "pad": report.pad,
        "law": asdict(fit.law),
        "radius_evidence": fit.evidence,
        "intervals_95": {name: [interval.low, interval.high] for name, interval in fit.intervals.items()},
        "sheet_observed": fit.sheet_observed,
        "scatter": fit.scatter,
        "misfit": fit.misfit,
        "freedom": fit.degrees_of_freedom,
        "radii_m": fit.radii_m.tolist(),
        "force_error_before": report.force_error_before,
        "force_error_after": report.force_error_after,
        "weights": [asdict(row) for row in report.weight_errors],
        "problems": list(fit.problems),
        "remarks": list(fit.remarks),
        **({} if report.second is None else {"second_sheet": to_json(report.second)}),
        **more,
    }


def _rms(values: Sequence[float]) -> float:
    known = np.array([value for value in values if math.isfinite(value)])
    return float(np.sqrt(np.mean(known**2))) if len(known) else math.nan


def _percent(value: float) -> str:
    return f"{value:.1%}" if math.isfinite(value) else "-"
