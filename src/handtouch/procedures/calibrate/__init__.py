"""Calibration of a pad's contact law by known weights: guided procedure, or fit of recorded readings.

Public: `CalibrateOptions`, `DaemonEndpoints`, `CalibrationError`; `run_guided` and `refit_recording`, which
return a `CalibrationResult`; `fit_grasps`; `set_new_sheet`, `find_pad`. `procedure` is the dialogue,
`daemon_pad` the pad of a running daemon, `readings` what is read of a weight, `fit` the law, `report` and
`plot` its description, `recording` the file of readings, `grasps` the forces of static grasps, `store_law`
what is stored; `press_map` the map of positions.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from handtouch import config
from handtouch.calibration.store_path import store_path
from handtouch.core.pad_model import default_calibration_id_of, law_of
from handtouch.hand.urdf import read_urdf
from handtouch.host.installation import extra_command
from handtouch.procedures.calibrate import plot, report
from handtouch.procedures.calibrate.daemon_pad import DaemonEndpoints, ServedPad
from handtouch.procedures.calibrate.fit import SheetReadings, fit_laws
from handtouch.procedures.calibrate.grasps import grasp_readings, read_grasps
from handtouch.procedures.calibrate.procedure import WeightProcedure
from handtouch.procedures.calibrate.readings import (
    ContactCircuit,
    PadCircuitModel,
    Weight,
    WeightReading,
    measurement_order,
    parse_weights,
    with_responses,
)
from handtouch.procedures.calibrate.recording import ReadingRecorder, RecordingHeader, read_recording
from handtouch.procedures.calibrate.store_law import store_law, store_new_sheet
from handtouch.procedures.dialogue import Dialogue, open_dialogue

__all__ = [
    "CalibrateOptions",
    "CalibrationError",
    "CalibrationResult",
    "DaemonEndpoints",
    "find_pad",
    "fit_grasps",
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
    grasps: Path | None = None
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
    return _fit_and_store(job, header, readings, now)


def fit_grasps(
    options: CalibrateOptions, file: Path, endpoints: DaemonEndpoints, now: datetime
) -> CalibrationResult:
    """Fit the law to the forces that joint torques, or a held weight, show in static grasps; as
    `refit_recording`. Where the deployment file has no serial number, a daemon is asked for it to store."""
    job = _CalibrationJob(options)
    hand = next(hand for hand in job.deployment.hands if hand.name == job.hand)
    if hand.urdf is None:
        raise ValueError(f"{options.config}: hand {hand.name} has no urdf, by which torques become forces")
    radius_m = (options.radius_mm or job.circuit_model.sheet.contact_radius_mm) * 1e-3
    grasps = read_grasps(file)
    readings = grasp_readings(read_urdf(Path(hand.urdf)), grasps, job.pad.link, radius_m)
    if not readings:
        raise CalibrationError(
            f"{job.name}: none of {len(grasps)} grasps determines its force: hold the hand still with this "
            "pad pressed firmly, and give the torques of the joints that move it"
        )
    serial = job.pad.serial
    if serial is None and options.yes and options.store:
        serial, _ = _node_of(job, endpoints)
    header = RecordingHeader(job.name, job.default_calibration_id, serial, job.radius_std)
    if options.log is not None:
        with ReadingRecorder(options.log) as recorder:
            recorder.write_header(header)
            for reading in readings:
                recorder.write_reading(reading)
    return _fit_and_store(job, header, readings, now)


def _fit_and_store(
    job: _CalibrationJob, header: RecordingHeader, readings: Sequence[WeightReading], now: datetime
) -> CalibrationResult:
    """Fit the law; store it, if that is requested."""
    options = job.options
    result = job.fit_readings(readings, header.radius_std)
    if not options.yes or not options.store or result.report.problems:
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
        served = stack.enter_context(
            ServedPad(endpoints, job.hand, job.pad.link, job.circuit_model.second_ampere_per_count)
        )
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
    serial, store = _node_of(job, endpoints)
    return store_new_sheet(store, job.entry, serial, job.default_calibration_id, now)


def _node_of(job: _CalibrationJob, endpoints: DaemonEndpoints) -> tuple[int, Path]:
    """Return the serial number of a pad's node and its store; a daemon is asked where the file has none."""
    serial, store = job.pad.serial, store_path(job.deployment, job.options.config.parent)
    if serial is None:
        with ServedPad(endpoints, job.hand, job.pad.link) as served:
            until_s = time.monotonic() + job.options.timeout_s
            for _ in served.samples():
                if served.serial is not None or time.monotonic() > until_s:
                    break
            serial, store = served.serial, served.store or store
    if serial is None:
        raise CalibrationError(f"{job.name}: its node has no serial number, so nothing of it is stored")
    return serial, store


class _CalibrationJob:
    """A pad to calibrate, from the deployment file. Raises ConfigError."""

    def __init__(self, options: CalibrateOptions) -> None:
        self.options = options
        self.deployment = config.load(options.config)
        self.entry = find_pad(self.deployment, options.pad)
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
        if given.radius_mm is not None or all("@" in weight for weight in given.weights.split(",")):
            return _GIVEN_LOG_RADIUS_STD
        return max(sheet.contact_radius_std_mm / sheet.contact_radius_mm, _GIVEN_LOG_RADIUS_STD)

    def fit_readings(self, readings: Sequence[WeightReading], radius_std: float) -> CalibrationResult:
        """Fit and describe the law; write the plot, if requested. Raises CalibrationError."""
        model = self.circuit_model
        circuits = [model.circuit_at(reading.position_m, _POSITION_STD_M) for reading in readings]
        sheets, readings_of = [model.sheet], [with_responses(model.sheet, readings)]
        circuits_of: list[Sequence[ContactCircuit]] = [circuits]
        has_second = all(math.isfinite(reading.second_current_a) for reading in readings)
        if model.second_sheet is not None and has_second:
            sheets.append(model.second_sheet)
            readings_of.append(
                with_responses(model.second_sheet, [reading.of_second for reading in readings])
            )
            circuits_of.append([replace(circuit, series_ohm=0.0) for circuit in circuits])
        columns = list(zip(sheets, readings_of, circuits_of, strict=True))
        try:
            fits = fit_laws(
                [
                    SheetReadings(own, around, law_of(sheet), sheet.reference_kpa * 1e3)
                    for sheet, own, around in columns
                ],
                radius_std,
            )
        except ValueError as error:
            raise CalibrationError(f"{self.name}: {error}") from error
        made, *second = [
            report.build_report(self.name, fit, sheet, own, around)
            for fit, (sheet, own, around) in zip(fits, columns, strict=True)
        ]
        made, fit = replace(made, second=second[0] if second else None), fits[0]
        sketch = plot.sketch(fit, readings_of[0], circuits).splitlines()
        lines = ["", *sketch, "", *report.format_text(made).splitlines()]
        if (path := self.options.plot) is not None:
            try:
                plot.draw(path, self.name, fit, readings_of[0], circuits)
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
    if result.report.problems or not (job.options.yes or procedure.confirm(question)):
        return result
    stored = ""
    if not job.options.store or served.serial is None:
        reason = "its node has no serial number to bind it to" if job.options.store else "--no-store"
        dialogue.print_line(f"Not stored ({reason}): applied until the daemon ends.", "bad")
    else:
        store = served.store or store_path(job.deployment, job.options.config.parent)
        stored = store_law(store, job.entry, header(), result.report, clock())
        dialogue.print_line(f"Stored as {stored}.", "good")
    applied = served.apply_laws(stored or "guided", result.report.laws)
    dialogue.print_line(f"{job.name}: calibration {applied} is active.", "good")
    return CalibrationResult(result.report, result.lines, applied)


def find_pad(deployment: config.Deployment, name: str) -> config.NamedPad:
    """Return the pad "right/thumb_distal", or "thumb_distal" if only one hand has it. Raises ValueError."""
    found = [entry for entry in deployment.pads if name in (entry.pad.link, entry.name)]
    if len(found) != 1:
        names = ", ".join(deployment.pad_names)
        raise ValueError(f"PAD {name}: names {len(found)} pads, one is calibrated at a time; pads: {names}")
    return found[0]
