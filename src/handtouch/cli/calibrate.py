"""The command `calibrate`: a guided measurement, or a request to the daemon."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from handtouch import client, wire
from handtouch.calibration.store import StoreError
from handtouch.cli import requests
from handtouch.cli.errors import CommandError, failing
from handtouch.cli.options import add_number, find_endpoint, integer
from handtouch.cli.requests import add_request
from handtouch.config import Deployment, NamedPad, load
from handtouch.host.json_output import print_json
from handtouch.procedures import calibrate
from handtouch.procedures.calibrate import press_map
from handtouch.record.recording import Recording


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `calibrate`."""
    add_request(parser, run, config=False)
    parser.add_argument("pad", metavar="PAD", help='pad, such as "left/index_distal"')
    _add_guided(parser.add_argument_group("guided measurement with known weights"))
    _add_map(parser.add_argument_group("map of positions from presses at known places"))
    _add_direct(parser.add_argument_group("direct setting; omitted values are left unchanged"))


def _add_guided(guided: argparse._ArgumentGroup) -> None:
    guided.add_argument(
        "--weights",
        default="",
        metavar="LIST",
        help="weights to place, such as 20,50,100,200,500 (unit: --unit); 200@4: on a base of radius 4 mm",
    )
    guided.add_argument(
        "--config", type=Path, metavar="CONFIG", help="deployment file that the daemon runs with (required)"
    )
    guided.add_argument(
        "--unit",
        dest="weight_unit",
        choices=("gf", "n"),
        default="gf",
        help="unit of the weights: gram-force or newton (default: gf)",
    )
    guided.add_argument(
        "--repeats",
        type=integer(1, 100, "an integer, 1 to 100"),
        default=3,
        metavar="N",
        help="measurements per weight (default: 3)",
    )
    add_number(
        guided,
        "--radius-mm",
        "MM",
        "radius of the contact under the weights (default: the sheet's contact_radius_mm); of a round "
        "base at hertz_force_n, else at the geometric mean of the weights",
    )
    add_number(
        guided,
        "--radius-std-mm",
        "MM",
        "error of that radius, 1 sigma (default: contact_radius_std_mm, or 5 %% of --radius-mm)",
    )
    guided.add_argument("--log", type=Path, metavar="FILE", help="record the readings to this file")
    guided.add_argument(
        "--from",
        dest="from_file",
        type=Path,
        metavar="FILE",
        help="fit readings recorded with --log instead of measuring",
    )
    guided.add_argument(
        "--grasps",
        type=Path,
        metavar="FILE",
        help="fit forces in static grasps, from joint torques or the weight of what is held: JSON lines with "
        "joints, torque_nm, contacts (docs/calibrations.md)",
    )
    guided.add_argument("--plot", type=Path, metavar="PNG", help="plot current against force")
    guided.add_argument("--yes", action="store_true", help="apply the law without confirmation")
    guided.add_argument(
        "--no-store",
        dest="store",
        action="store_false",
        help="don't store the calibration: it lasts until the daemon exits",
    )
    add_number(
        guided,
        "--seconds",
        "S",
        "time limit for placing a weight or pressing a key",
        default=60.0,
        dest="timeout_s",
    )
    guided.add_argument(
        "--new-sheet",
        action="store_true",
        help="the pad has another sheet on the same node: set aside law, state and parts of the old one, "
        "keep the gains; needs --config, nothing is measured",
    )
    guided.add_argument(
        "--live", metavar="ENDPOINT", help="the daemon's live stream (default: as the deployment file says)"
    )


def _add_map(presses: argparse._ArgumentGroup) -> None:
    presses.add_argument(
        "--map",
        type=Path,
        metavar="NPZ",
        help="write a press_map of the pad; needs --config and --positions, and presses it now, or takes the "
        "presses of a recording that --from names",
    )
    presses.add_argument(
        "--positions",
        type=Path,
        metavar="CSV",
        help="places of the presses in their order: columns x_mm, y_mm from the corner of x0 and y0, or with "
        "z_mm in the pad frame; force_n if known",
    )
    add_number(
        presses, "--position-std-mm", "MM", "error of these places along each axis, 1 sigma", default=0.1
    )


def _add_direct(direct: argparse._ArgumentGroup) -> None:
    direct.add_argument("--name", help="id of the new calibration, published in contact messages (required)")
    direct.add_argument(
        "--gains",
        type=float,
        nargs="+",
        metavar="G",
        help="relative gains of the electrodes' channels: x0, xa, y0, yb, or those of electrode_arcs_mm",
    )
    direct.add_argument(
        "--offsets", type=float, nargs="+", metavar="COUNTS", help="counts of the untouched channels"
    )
    direct.add_argument(
        "--law",
        type=float,
        nargs=3,
        metavar=("K", "ALPHA", "OHM"),
        help="contact_ohm_mm2, alpha and ohm_per_square, as in [sheet.NAME]",
    )
    direct.add_argument(
        "--second-law",
        type=float,
        nargs=3,
        metavar=("K", "ALPHA", "OHM"),
        help="the same of the pad's second sheet",
    )
    add_number(
        direct,
        "--hertz-force-n",
        "N",
        "with --law: hertz_force_n, as in [sheet.NAME] (default: the same radius at every force)",
    )


class _Setting(NamedTuple):
    """Options of the direct setting."""

    name: str | None
    gains: Sequence[float] | None
    offsets: Sequence[float] | None
    law: Sequence[float] | None
    second_law: Sequence[float] | None
    hertz_force_n: float | None

    @property
    def has_values(self) -> bool:
        return any(one is not None for one in (self.gains, self.offsets, self.law, self.second_law))

    @property
    def is_given(self) -> bool:
        return self.has_values or self.name is not None

    def arguments(self) -> dict[str, Any]:
        """Return the arguments of the request."""
        keys = "contact_ohm_mm2", "alpha", "ohm_per_square"
        laws = {
            name: {**dict(zip(keys, law, strict=True)), "hertz_force_n": self.hertz_force_n}
            for name, law in (("law", self.law), ("second_law", self.second_law))
            if law is not None
        }
        values = {"gains": self.gains, "offset_counts": self.offsets, "name": self.name}
        return laws | {option: value for option, value in values.items() if value is not None}


def run(
    pad: str,
    *,
    endpoint: str | None,
    key: str | None,
    as_json: bool,
    live: str | None,
    weights: str,
    from_file: Path | None,
    grasps: Path | None,
    config: Path | None,
    name: str | None,
    gains: Sequence[float] | None,
    offsets: Sequence[float] | None,
    law: Sequence[float] | None,
    second_law: Sequence[float] | None,
    hertz_force_n: float | None,
    new_sheet: bool,
    map: Path | None,
    positions: Path | None,
    position_std_mm: float,
    **options: Any,
) -> int:
    """Measure a contact law or a map, set a calibration or print the active one; `options` of
    `CalibrateOptions`.

    Exit status 0, 1 (no law found, no daemon, refused), 2 (wrong usage or invalid file).
    """
    setting = _Setting(name, gains, offsets, law, second_law, hertz_force_n)
    sources = [bool(weights), from_file is not None, grasps is not None]
    if map is None and positions is None:
        conflict = _find_conflict(sources, setting, config, new_sheet)
    elif map is None or positions is None or config is None:
        conflict = "--map needs --positions CSV and --config CONFIG"
    else:
        no_map = bool(weights) or grasps is not None or setting.is_given or new_sheet
        conflict = "--map measures no law and sets no calibration" if no_map else ""
    if conflict:
        raise CommandError(f"handtouch calibrate: {conflict}", 2)
    with failing(2, ValueError, OSError):
        control, stream = find_endpoint("control", endpoint, config), find_endpoint("live", live, config)
    endpoints = calibrate.DaemonEndpoints(stream, control, key)
    if map is not None and positions is not None and config is not None:
        files = _MapFiles(config, positions, from_file, map)
        return _run_map(files, pad, position_std_mm, endpoints, as_json)
    if config is not None and (new_sheet or any(sources)):
        asked = calibrate.CalibrateOptions(
            pad=pad,
            config=config,
            weights=weights,
            from_file=from_file,
            grasps=grasps,
            as_json=as_json,
            **options,
        )
        return (_run_new_sheet if new_sheet else _run_guided)(asked, endpoints)
    return requests.run_request(
        "calibrate",
        requests.calibration_lines,
        endpoint=control,
        key=key,
        as_json=as_json,
        pad=pad,
        **setting.arguments(),
    )


def _find_conflict(sources: Sequence[bool], setting: _Setting, config: Path | None, new_sheet: bool) -> str:
    """Return the conflict between options with its remedy; empty if there is none. sources: which of
    `--weights`, `--from` and `--grasps` are given."""
    guided = any(sources)
    if setting.hertz_force_n is not None and setting.law is None:
        return "--hertz-force-n is of the law that --law sets"
    if new_sheet and (guided or setting.is_given or config is None):
        return "--new-sheet takes --config CONFIG and nothing else"
    if guided and setting.is_given:
        return (
            "--weights, --from and --grasps measure laws, --name, --gains, --offsets and --law set them; "
            "use either"
        )
    if guided and config is None:
        return "--config CONFIG is missing: the deployment file that the daemon runs with"
    if sum(sources) > 1:
        return "--weights measures, --from and --grasps read what was recorded; use either"
    if setting.has_values and setting.name is None:
        return "--name NAME is missing: the id of the new calibration"
    return ""


class _MapFiles(NamedTuple):
    """Files of the options of `--map`."""

    config: Path
    positions: Path
    recording: Path | None
    out: Path


def _run_map(
    files: _MapFiles,
    pad: str,
    position_std_mm: float,
    endpoints: calibrate.DaemonEndpoints,
    as_json: bool,
) -> int:
    """Measure a map and write it. Exit status 0; 1: the presses don't fit the places."""
    with failing(2, ValueError, OSError):
        deployment = load(files.config)
        entry = calibrate.find_pad(deployment, pad)
        places = press_map.read_places(files.positions)
        job = press_map.MapJob(deployment, entry)
        collector = press_map.PressCollector()
        if files.recording is not None:
            _read_presses(files.recording, deployment, entry, collector)
        else:
            _await_presses(endpoints, entry, places, collector)
    if len(collector.presses) != len(places):
        raise CommandError(
            f"{len(collector.presses)} presses were held long enough, {files.positions} has {len(places)} "
            "places: hold each for a second, a second apart, and leave out of the table what wasn't pressed",
            1,
        )
    with failing(1, ValueError, OSError):
        presses = job.presses(collector.presses, places, collector.samples, position_std_mm)
        report = job.report(presses)
        files.out.write_bytes(presses.data)
    if as_json:
        print_json({"file": str(files.out), **asdict(report)})
    else:
        print("\n".join(report.lines()))
        print(f'Wrote {files.out}: press_map = "{files.out.name}" in the [[hand.pad]] of {entry.name}')
    return 0


def _read_presses(
    file: Path, deployment: Deployment, entry: NamedPad, collector: press_map.PressCollector
) -> None:
    """Collect the presses of a recording."""
    row, pads = deployment.pads.index(entry), len(deployment.pads)
    column = wire.COLUMNS[wire.TickInputs]["counts"]
    recording = Recording(file)
    with recording.checked():
        for message in recording.read("tick", "contact"):
            if message.topic == f"contact/{entry.name}" and not message.payload["retained"]:
                collector.add_event(message.payload["event"])
            elif message.topic == "tick" and not message.payload["stopped"]:
                counts = column.to_array(message.payload["counts"], pads)[row]
                collector.add_counts(message.payload["t_ns"], counts.astype(np.float64))


def _await_presses(
    endpoints: calibrate.DaemonEndpoints,
    entry: NamedPad,
    places: Sequence[press_map.Place],
    collector: press_map.PressCollector,
) -> None:
    """Ask for the presses one by one on standard error, and collect them."""
    column, asked = wire.COLUMNS[wire.Raw]["counts"], -1
    topics = f"raw/{entry.hand}", f"contact/{entry.name}"
    with client.connect(*topics, endpoint=endpoints.live, key=endpoints.key) as messages:
        while (done := len(collector.presses)) < len(places):
            if asked != done:
                at = ", ".join(f"{1e3 * part:.1f}" for part in places[done].at_m)
                print(f"[{done + 1}/{len(places)}] press at ({at}) mm for a second", file=sys.stderr)
                asked = done
            message = messages.recv(1.0)
            if isinstance(message, wire.Contact) and not message.retained:
                collector.add_event(message.event)
                asked = -1 if message.event == "end" else asked  # again, if it was too short
            elif isinstance(message, wire.Raw):
                counts = column.to_array(message.counts, len(message.links))
                row = message.links.index(entry.pad.link)
                collector.add_counts(message.t_ns, counts[row].astype(np.float64))


def _run_new_sheet(options: calibrate.CalibrateOptions, endpoints: calibrate.DaemonEndpoints) -> int:
    with failing(2, ValueError), failing(1, calibrate.CalibrationError, StoreError, OSError, RuntimeError):
        stored = calibrate.set_new_sheet(options, endpoints, datetime.now(UTC))
    if options.as_json:
        print_json({"calibration_id": stored})
    else:
        print(
            f"{options.pad}: stored as {stored}, with the gains of its node only; a daemon that uses this "
            "store applies it within seconds: law and sheet of the deployment file, learned anew"
        )
    return 0


def _run_guided(options: calibrate.CalibrateOptions, endpoints: calibrate.DaemonEndpoints) -> int:
    if options.from_file is not None and not options.from_file.is_file():
        raise CommandError(f"{options.from_file}: no such file; --from reads readings that --log recorded", 2)
    # RuntimeError: the daemon refuses
    with failing(2, ValueError), failing(1, calibrate.CalibrationError, StoreError, OSError, RuntimeError):
        if (file := options.from_file or options.grasps) is not None:
            now = datetime.now(UTC)
            if options.grasps is not None:
                result = calibrate.fit_grasps(options, file, endpoints, now)
            else:
                result = calibrate.refit_recording(options, file, now)
            failed = bool(result.report.problems)
            if not options.as_json:
                print("\n".join(result.lines))
        else:
            # with --json, standard output is for the result alone
            with contextlib.redirect_stdout(sys.stderr) if options.as_json else contextlib.nullcontext():
                result = calibrate.run_guided(options, endpoints, lambda: datetime.now(UTC))
            failed = not result.calibration_id
    if options.as_json:
        print_json(calibrate.report.to_json(result.report, calibration_id=result.calibration_id or None))
    return 1 if failed else 0
