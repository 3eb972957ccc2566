"""What came of a session: the force errors before and after, the law with its intervals, as text and JSON.

Public names: `Outcome`, `outcome_of`, `text`, `as_json`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from handtouch.calibrate.fit import PARAMETERS, Fit
from handtouch.calibrate.readings import Circuit, Place, Reading
from handtouch.field import ContactLaw
from handtouch.supervise.calibration import Law

_UNITS = {"contact_ohm_mm2": "ohm mm2", "alpha": "", "ohm_per_square": "ohm per square"}


@dataclass(frozen=True)
class Errors:
    """Of one weight: readings, mean current, scatter of it, and rms relative force errors, NaN unknown."""

    weight: str
    force_n: float
    readings: int
    current_a: float
    scatter: float
    before: float
    after: float


@dataclass(frozen=True)
class Outcome:
    """A fit with what it does to the forces that the daemon tells."""

    pad: str
    fit: Fit
    errors: tuple[Errors, ...]
    before: float
    after: float
    file: Law


def outcome_of(
    pad: str, fit: Fit, place: Place, readings: Sequence[Reading], circuits: Sequence[Circuit], file: Law
) -> Outcome:
    """before: errors of the forces that the daemon told; after: of those it would tell of the same readings
    under the new law, with the contact radius that the deployment file assumes."""
    after = [
        force_of(fit.law, place, reading, circuit) / reading.weight.force_n - 1
        for reading, circuit in zip(readings, circuits, strict=True)
    ]
    before = [reading.told_n / reading.weight.force_n - 1 for reading in readings]
    rows = []
    for weight in sorted({reading.weight for reading in readings}, key=lambda w: (w.radius_m, w.force_n)):
        chosen = [k for k, reading in enumerate(readings) if reading.weight == weight]
        current = np.array([readings[k].current_a for k in chosen])
        scatter = float(current.std(ddof=1) / current.mean()) if len(chosen) > 1 else math.nan
        errors = _rms([before[k] for k in chosen]), _rms([after[k] for k in chosen])
        rows.append(Errors(weight.name, weight.force_n, len(chosen), float(current.mean()), scatter, *errors))
    return Outcome(pad, fit, tuple(rows), _rms(before), _rms(after), file)


def force_of(law: Law, place: Place, reading: Reading, circuit: Circuit) -> float:
    """Force [N] that the daemon tells of a reading under a law; NaN beyond what the sheet carries."""
    contact = ContactLaw(
        law.contact_ohm_mm2 * 1e-6,
        law.alpha,
        place.sheet.contact_radius_mm * 1e-3,
        reference_pa=place.sheet.reference_kpa * 1e3,
    )
    told = contact.force(
        reading.current_a, circuit.drive_v, law.ohm_per_square, circuit.spreading_m, circuit.series_ohm
    )
    return float(told.force_n)


def text(outcome: Outcome) -> str:
    """For a person."""
    fit, law = outcome.fit, outcome.fit.law
    lines = [
        f"{'weight':>16} {'n':>3} {'mA':>9} {'scatter':>8} {'before':>8} {'after':>8}   force error, rms"
    ]
    rows = [
        (row.weight, row.readings, row.current_a, row.scatter, row.before, row.after)
        for row in outcome.errors
    ]
    for name, count, current, *parts in rows:
        lines += [
            f"{name:>16} {count:>3} {1e3 * current:>9.4g} " + " ".join(f"{_percent(p):>8}" for p in parts)
        ]
    lines.append(f"{'all':>39} {_percent(outcome.before):>8} {_percent(outcome.after):>8}")
    lines.append("")
    for name in PARAMETERS:
        value, interval, file = getattr(law, name), fit.intervals[name], getattr(outcome.file, name)
        kept = "  (not observed)" if name == "ohm_per_square" and not fit.observed else ""
        lines.append(
            f"{name:<16} {value:>9.5g}  95 %: {interval.low:.5g} to {interval.high:.5g} {_UNITS[name]}; "
            f"file: {file:.5g}{kept}"
        )
    lines.append(f"{'scatter':<16} {fit.scatter:>9.1%}  from press to press, of the load")
    lines += [f"Note: {remark}." for remark in fit.remarks]
    lines += [f"Not enough: {problem}." for problem in fit.problems]
    return "\n".join(lines)


def as_json(outcome: Outcome, **more: Any) -> dict[str, Any]:
    """For a program; what isn't known is None."""
    fit = outcome.fit
    record = {
        "pad": outcome.pad,
        "law": {**{name: getattr(fit.law, name) for name in PARAMETERS}, "covariance": fit.law.covariance},
        "intervals_95": {name: [interval.low, interval.high] for name, interval in fit.intervals.items()},
        "sheet_observed": fit.observed,
        "scatter": fit.scatter,
        "misfit": fit.misfit,
        "freedom": fit.freedom,
        "radii_m": fit.radii_m.tolist(),
        "force_error_before": outcome.before,
        "force_error_after": outcome.after,
        "weights": [asdict(row) for row in outcome.errors],
        "problems": list(fit.problems),
        "remarks": list(fit.remarks),
        **more,
    }
    return {key: _known(value) for key, value in record.items()}


def _known(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _known(item) for key, item in value.items()}
    return [_known(item) for item in value] if isinstance(value, list | tuple) else value


def _rms(values: Sequence[float]) -> float:
    known = np.array([value for value in values if math.isfinite(value)])
    return float(np.sqrt(np.mean(known**2))) if len(known) else math.nan


def _percent(value: float) -> str:
    return f"{value:.1%}" if math.isfinite(value) else "-"
