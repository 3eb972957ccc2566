"""Calibration of a pad's contact law by known weights: guided procedure, or fit of recorded readings.

Public: `CalibrateOptions`, `DaemonEndpoints`, `CalibrationError`; `run_guided` and `refit_recording`, which
return a `CalibrationResult`; `set_new_sheet`. `procedure` is the dialogue, `daemon_pad` the pad of a running
daemon, `fit` the law, `report` and `plot` its description, `recording` the file of readings, `store_law` and
`new_sheet` what is stored.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from handtouch import config
from handtouch.calibration.store import store_path
from handtouch.core.pad_model import default_calibration_id_of, law_of
from handtouch.host.installation import extra_command
from handtouch.procedures.calibrate import plot, report
from handtouch.procedures.calibrate.daemon_pad import DaemonEndpoints, ServedPad
from handtouch.procedures.calibrate.fit import fit_law
from handtouch.procedures.calibrate.new_sheet import store_new_sheet
from handtouch.procedures.calibrate.procedure import WeightProcedure
from handtouch.procedures.calibrate.readings import (
    PadCircuitModel,
    Weight,
    WeightReading,
    measurement_order,
    parse_weights,
)
from handtouch.procedures.calibrate.recording import ReadingRecorder, RecordingHeader, read_recording
from handtouch.procedures.calibrate.store_law import store_law
from handtouch.procedures.dialogue import Dialogue, open_dialogue

__all__ = [
    "CalibrateOptions",
    "CalibrationError",
    "CalibrationResult",
    "DaemonEndpoints",
    "refit_recording",
    "report",
    "run_guided",
    "set_new_sheet",
]

_POSITION_STD_M = 0.5e-3
"""Standard deviation of the position of a weight's centre, as the daemon estimates it."""
_GIVEN_LOG_RADIUS_STD = 0.05
"""Standard deviation of ln radius, if the radius is given on the command line; least one of the file's."""


@dataclass(frozen=True)
class CalibrateOptions:
    """Options of the command line; `config` is the deployment file that the daemon runs with."""

    pad: str
    config: Path
    weights: str = ""
    weight_unit: str = "gf"
    repeats: int = 3
    radius_mm: float | None = None
    radius_std_mm: float | None = None
    log: Path | None = None
    from_file: Path | None = None
    plot: Path | None = None
    yes: bool = False
    store: bool = True
    as_json: bool = False
    timeout_s: float = 60.0


@dataclass(frozen=True)
class CalibrationResult:
    """Report of a fit as data and text lines; calibration_id: that was stored or applied, else empty."""

    report: report.CalibrationReport
    lines: tuple[str, ...]
    calibration_id: str


class CalibrationError(Exception):
    """No law was found, or it can't be applied."""


def refit_recording(options: CalibrateOptions, file: Path, now: datetime) -> CalibrationResult:
    """Fit recorded readings again; store the law with `yes`.

    Raises CalibrationError, StoreError, OSError; ConfigError or ValueError for wrong options or files.
    """
    job = _CalibrationJob(options)
    header, readings = read_recording(file)
    if header.pad != job.name:
        raise ValueError(f"{file}: is a recording of {header.pad}, not of {job.name}")
    result = job.fit_readings(readings, header.radius_std)
    if not options.yes or not options.store or result.report.fit.problems:
        return result
    store = store_path(job.deployment, options.config.parent)
    stored = store_law(store, job.entry, header, result.report, now)
    line = f"stored as {stored}; a daemon that uses this store applies it within seconds"
    return CalibrationResult(result.report, (*result.lines, line), stored)


def run_guided(
    options: CalibrateOptions, endpoints: DaemonEndpoints, clock: Callable[[], datetime]
) -> CalibrationResult:
    """Run the guided procedure with a daemon; all but the result goes to the dialogue.

    Raises as `refit_recording` does, and what `client.request` does.
    """
    job = _CalibrationJob(options)
    weights = job.weights
    with contextlib.ExitStack() as stack:
        served = stack.enter_context(ServedPad(endpoints, job.hand, job.pad.link))
        active_id = served.active_calibration["default_calibration_id"]
        if active_id != job.default_calibration_id:
            raise CalibrationError(
                f"{options.config}: the daemon has other tables of {job.name} ({active_id}, not "
                f"{job.default_calibration_id}); pass the file that it runs with, or `handtouch reload` it"
            )
        recorder = stack.enter_context(ReadingRecorder(options.log)) if options.log else None
        dialogue = stack.enter_context(open_dialogue())
        procedure = WeightProcedure(
            job.name, weights, job.circuit_model, served, dialogue, timeout_s=options.timeout_s
        )
        try:
            return _run_procedure(job, procedure, served, dialogue, recorder, clock)
        except KeyboardInterrupt:
            dialogue.print_line("Interrupted; nothing was changed but the zero.")
            raise


def set_new_sheet(options: CalibrateOptions, endpoints: DaemonEndpoints, now: datetime) -> str:
    """Set aside what was learned of a pad's sheet, since its node has another one; return the calibration_id.

    A daemon that uses the store applies it within seconds; one that runs is asked for the node's serial
    number where the deployment file has none. Raises as `run_guided` does.
    """
    job = _CalibrationJob(options)
    serial, store = job.pad.serial, store_path(job.deployment, options.config.parent)
    if serial is None:
        with ServedPad(endpoints, job.hand, job.pad.link) as served:
            until_s = time.monotonic() + options.timeout_s
            for _ in served.samples():
                if served.serial is not None or time.monotonic() > until_s:
                    break
            serial, store = served.serial, served.store or store
    if serial is None:
        raise CalibrationError(f"{job.name}: its node has no serial number, so nothing of it is stored")
    return store_new_sheet(store, job.entry, serial, job.default_calibration_id, now)


class _CalibrationJob:
    """A pad to calibrate, from the deployment file. Raises ConfigError."""

    def __init__(self, options: CalibrateOptions) -> None:
        self.options = options
        self.deployment = config.load(options.config)
        self.entry = _find_pad(self.deployment, options.pad)
        self.hand, self.pad, self.name = *self.entry, self.entry.name
        self.circuit_model = PadCircuitModel(self.deployment, self.pad)
        self.default_calibration_id = default_calibration_id_of(self.pad, self.deployment)

    @property
    def weights(self) -> list[Weight]:
        """Return the weights in the order of measurement. Raises ValueError."""
        given = self.options
        radius_mm = given.radius_mm or self.circuit_model.sheet.contact_radius_mm
        return measurement_order(parse_weights(given.weights, given.weight_unit, radius_mm), given.repeats)

    @property
    def radius_std(self) -> float:
        """Return the standard deviation of ln radius of the weights' foot."""
        given, sheet = self.options, self.circuit_model.sheet
        if given.radius_std_mm is not None:
            return given.radius_std_mm / (given.radius_mm or sheet.contact_radius_mm)
        if given.radius_mm is not None:
            return _GIVEN_LOG_RADIUS_STD
        return max(sheet.contact_radius_std_mm / sheet.contact_radius_mm, _GIVEN_LOG_RADIUS_STD)

    def fit_readings(self, readings: Sequence[WeightReading], radius_std: float) -> CalibrationResult:
        """Fit and describe the law; write the plot, if requested. Raises CalibrationError."""
        circuits = [
            self.circuit_model.circuit_at(reading.position_m, _POSITION_STD_M) for reading in readings
        ]
        default, sheet = law_of(self.circuit_model.sheet), self.circuit_model.sheet
        try:
            fit = fit_law(readings, circuits, default, sheet.reference_kpa * 1e3, radius_std)
        except ValueError as error:
            raise CalibrationError(f"{self.name}: {error}") from error
        made = report.build_report(self.name, fit, self.circuit_model, readings, circuits, default)
        sketch = plot.sketch(fit, readings, circuits).splitlines()
        lines = ["", *sketch, "", *report.format_text(made).splitlines()]
        if (path := self.options.plot) is not None:
            try:
                plot.draw(path, self.name, fit, readings, circuits)
                lines.append(f"wrote {path}")
            except ImportError:
                lines.append(f"no plot: it needs matplotlib, {extra_command('figures')}")
        return CalibrationResult(made, tuple(lines), "")


def _run_procedure(
    job: _CalibrationJob,
    procedure: WeightProcedure,
    served: ServedPad,
    dialogue: Dialogue,
    recorder: ReadingRecorder | None,
    clock: Callable[[], datetime],
) -> CalibrationResult:
    def header() -> RecordingHeader:
        return RecordingHeader(
            job.name, job.default_calibration_id, served.serial, job.radius_std, served.tare_offsets or ()
        )

    for reading in procedure.run():
        if recorder is not None:
            if len(procedure.readings) == 1:
                recorder.write_header(header())
            recorder.write_reading(reading)
    if not procedure.readings:
        raise CalibrationError(f"{job.name}: no readings")
    result = job.fit_readings(procedure.readings, job.radius_std)
    for line in result.lines:
        dialogue.print_line(line)
    question = "Enter: apply this law, q: change nothing"
    if result.report.fit.problems or not (job.options.yes or procedure.confirm(question)):
        return result
    stored = ""
    if not job.options.store or served.serial is None:
        reason = "its node has no serial number to bind it to" if job.options.store else "--no-store"
        dialogue.print_line(f"Not stored ({reason}): applied until the daemon ends.", "bad")
    else:
        store = served.store or store_path(job.deployment, job.options.config.parent)
        stored = store_law(store, job.entry, header(), result.report, clock())
        dialogue.print_line(f"Stored as {stored}.", "good")
    applied = served.apply_law(stored or "guided", result.report.fit.law)
    dialogue.print_line(f"{job.name}: calibration {applied} is active.", "good")
    return CalibrationResult(result.report, result.lines, applied)


def _find_pad(deployment: config.Deployment, name: str) -> config.NamedPad:
    """Return the pad "right/thumb_distal", or "thumb_distal" if only one hand has it. Raises ValueError."""
    found = [entry for entry in deployment.pads if name in (entry.pad.link, entry.name)]
    if len(found) != 1:
        names = ", ".join(deployment.pad_names)
        raise ValueError(f"PAD {name}: names {len(found)} pads, one is calibrated at a time; pads: {names}")
    return found[0]
