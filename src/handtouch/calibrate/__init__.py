"""`handtouch calibrate PAD --weights ...`: known weights on one pad, and the contact law that follows.

Public names: `run`, `Options`. `session` is the dialogue, `served` the pad of a running daemon, `fit` the
law, `report` and `plot` what is told, `record` a session on file, `keep` what becomes of the law.
"""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from handtouch import config
from handtouch.calibrate import plot, record, report
from handtouch.calibrate.fit import fit_law
from handtouch.calibrate.keep import store_law
from handtouch.calibrate.readings import Place, Reading, Weight, order, parse_weights
from handtouch.calibrate.served import Asked, ServedPad
from handtouch.calibrate.session import Session
from handtouch.daemon.model import law_of, nominal_of
from handtouch.dialogue import Dialogue, open_dialogue
from handtouch.supervise.store import StoreError

__all__ = ["Asked", "Options", "run"]

_PLACE_STD_M = 0.5e-3  # of where the middle of what stands there is, on the daemon's word
_KNOWN = 0.05  # standard deviation of ln of a radius that was given expressly


@dataclass(frozen=True)
class Options:
    """What was asked for; `config` is the file that the daemon runs with."""

    pad: str
    config: Path
    weights: str = ""
    unit: str = "gf"
    repeats: int = 3
    radius_mm: float | None = None
    radius_std_mm: float | None = None
    log: Path | None = None
    from_file: Path | None = None
    plot: Path | None = None
    yes: bool = False
    store: bool = True
    as_json: bool = False
    patience_s: float = 60.0


class _FailedError(Exception):
    """Exit status 1, with words."""


def run(options: Options, asked: Asked) -> int:
    """Calibrate a pad, or fit a recorded session anew.

    Exit status: 0 a law was found (and put in force, after a session), 1 it wasn't, 2 usage.
    """
    try:
        job = _Job(options)
        return _again(job, options.from_file) if options.from_file else _guided(job, asked)
    except (_FailedError, StoreError, OSError, RuntimeError) as error:  # RuntimeError: the daemon refuses
        print(error, file=sys.stderr)
        return 1
    except (config.ConfigError, ValueError) as error:
        print(error, file=sys.stderr)
        return 2


class _Job:
    """A pad to be calibrated, by the deployment file. Raises ConfigError."""

    def __init__(self, options: Options) -> None:
        self.options = options
        self.deployment = config.load(options.config)
        self.hand, self.pad = _find(self.deployment, options.pad)
        self.name = f"{self.hand}/{self.pad.link}"
        self.place = Place(self.deployment, self.pad)
        self.nominal = nominal_of(self.pad, self.deployment)

    @property
    def weights(self) -> list[Weight]:
        """In the order in which they are to be put down. Raises ValueError."""
        given = self.options
        radius_mm = given.radius_mm or self.place.sheet.contact_radius_mm
        return order(parse_weights(given.weights, given.unit, radius_mm), given.repeats)

    @property
    def radius_std(self) -> float:
        """Standard deviation of ln radius of what the weights stand on."""
        given, sheet = self.options, self.place.sheet
        if given.radius_std_mm is not None:
            return given.radius_std_mm / (given.radius_mm or sheet.contact_radius_mm)
        if given.radius_mm is not None:
            return _KNOWN
        return max(sheet.contact_radius_std_mm / sheet.contact_radius_mm, _KNOWN)

    def conclude(self, readings: Sequence[Reading], radius_std: float) -> tuple[report.Outcome, list[str]]:
        """The law, and words and sketch of it; draws it too. Raises _FailedError for too few readings."""
        circuits = [self.place.circuit(reading.place_m, _PLACE_STD_M) for reading in readings]
        file, sheet = law_of(self.place.sheet), self.place.sheet
        try:
            fit = fit_law(readings, circuits, file, sheet.reference_kpa * 1e3, radius_std)
        except ValueError as error:
            raise _FailedError(f"{self.name}: {error}") from error
        outcome = report.outcome_of(self.name, fit, self.place, readings, circuits, file)
        words = [
            "",
            *plot.sketch(fit, readings, circuits).splitlines(),
            "",
            *report.text(outcome).splitlines(),
        ]
        if (path := self.options.plot) is not None:
            try:
                plot.draw(path, self.name, fit, readings, circuits)
                words.append(f"wrote {path}")
            except ImportError:
                words.append("no plot: it needs matplotlib, pip install 'handtouch[figures]'")
        return outcome, words


def _again(job: _Job, file: Path) -> int:
    head, readings = record.read(file)
    if head.pad != job.name:
        raise ValueError(f"{file}: is a session of {head.pad}, not of {job.name}")
    outcome, words = job.conclude(readings, head.radius_std)
    stored = ""
    if job.options.yes and job.options.store and not outcome.fit.problems:
        stored = store_law(job.options.config, job.deployment, (job.hand, job.pad), head, outcome)
        words.append(f"stored as {stored}; a daemon that uses this store takes it within seconds")
    if job.options.as_json:
        print(json.dumps(report.as_json(outcome, calibration=stored or None), indent=2))
    else:
        print("\n".join(words))
    return 1 if outcome.fit.problems else 0


def _guided(job: _Job, asked: Asked) -> int:
    options, weights = job.options, job.weights
    with contextlib.ExitStack() as stack:
        if options.as_json:  # standard output is the program's, who reads it
            stack.enter_context(contextlib.redirect_stdout(sys.stderr))
        served = stack.enter_context(ServedPad(asked, job.hand, job.pad.link))
        if (theirs := served.present["nominal"]) != job.nominal:
            raise _FailedError(
                f"{options.config}: the daemon has other tables of {job.name} ({theirs}, not {job.nominal}): "
                "give the file that it runs with, or have it read again by `handtouch reload`"
            )
        recorder = stack.enter_context(record.Recorder(options.log)) if options.log else None
        dialogue = stack.enter_context(open_dialogue())
        session = Session(job.name, weights, job.place, served, dialogue, patience_s=options.patience_s)
        try:
            outcome, name = _session(job, session, served, dialogue, recorder)
        except KeyboardInterrupt:
            raise _FailedError("Interrupted; nothing was changed but zero.") from None
    if options.as_json:
        print(json.dumps(report.as_json(outcome, calibration=name or None), indent=2))
    return 0 if name else 1


def _session(
    job: _Job, session: Session, served: ServedPad, dialogue: Dialogue, recorder: record.Recorder | None
) -> tuple[report.Outcome, str]:
    """The law, and the name of the calibration that is in force with it, empty if it isn't."""

    def head() -> record.Head:
        return record.Head(job.name, job.nominal, served.serial, job.radius_std, served.zero or ())

    for reading in session.run():
        if recorder is not None:
            if len(session.readings) == 1:
                recorder.head(head())
            recorder.reading(reading)
    if not session.readings:
        raise _FailedError(f"{job.name}: nothing was read")
    outcome, words = job.conclude(session.readings, job.radius_std)
    for line in words:
        dialogue.say(line)
    question = "Enter: put this law in force, q: leave all as it was"
    if outcome.fit.problems or not (job.options.yes or session.confirm(question)):
        return outcome, ""
    name = ""
    if not job.options.store or served.serial is None:
        why = "its node has no serial number to bind it to" if job.options.store else "--no-store"
        dialogue.say(f"Not stored ({why}): it holds until the daemon ends.", "bad")
    else:
        name = store_law(job.options.config, job.deployment, (job.hand, job.pad), head(), outcome)
        dialogue.say(f"Stored as {name}.", "good")
    name = served.apply(name or "guided", outcome.fit.law)
    dialogue.say(f"{job.name}: calibration {name} is in force.", "good")
    return outcome, name


def _find(deployment: config.Deployment, asked: str) -> tuple[str, config.Pad]:
    """The pad "right/thumb_distal", or "thumb_distal" where only one hand has it. Raises ValueError."""
    pads = [(hand.name, pad) for hand in deployment.hands for pad in hand.pads]
    found = [(hand, pad) for hand, pad in pads if asked in (pad.link, f"{hand}/{pad.link}")]
    if len(found) != 1:
        names = ", ".join(f"{hand}/{pad.link}" for hand, pad in pads)
        raise ValueError(f"PAD {asked}: names {len(found)} pads, one is calibrated at a time; pads: {names}")
    return found[0]
