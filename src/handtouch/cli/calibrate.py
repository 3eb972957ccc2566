"""The command `calibrate`: a guided measurement, or a request to the daemon."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from handtouch.calibration.store import StoreError
from handtouch.cli import requests
from handtouch.cli.errors import CommandError, failing
from handtouch.cli.options import add_number, find_endpoint, integer
from handtouch.cli.requests import add_request
from handtouch.host.json_output import print_json
from handtouch.procedures import calibrate


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `calibrate`."""
    add_request(parser, run, config=False)
    parser.add_argument("pad", metavar="PAD", help='pad, such as "left/index_distal"')
    _add_guided(parser.add_argument_group("guided measurement with known weights"))
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
    add_number(
        direct,
        "--hertz-force-n",
        "N",
        "with --law: hertz_force_n, as in [sheet.NAME] (default: the same radius at every force)",
    )


def run(
    pad: str,
    *,
    endpoint: str | None,
    key: str | None,
    as_json: bool,
    live: str | None,
    weights: str,
    from_file: Path | None,
    config: Path | None,
    name: str | None,
    gains: Sequence[float] | None,
    offsets: Sequence[float] | None,
    law: Sequence[float] | None,
    hertz_force_n: float | None,
    new_sheet: bool,
    **options: Any,
) -> int:
    """Measure a contact law, set a calibration or print the active one; `options` of `CalibrateOptions`.

    Exit status 0, 1 (no law found, no daemon, refused), 2 (wrong usage or invalid file).
    """
    guided = bool(weights) or from_file is not None
    values: dict[str, Any] = {"gains": gains, "offset_counts": offsets, "law": law}
    values = {option: value for option, value in values.items() if value is not None}
    if hertz_force_n is not None and law is None:
        raise CommandError("handtouch calibrate: --hertz-force-n is of the law that --law sets", 2)
    if conflict := _find_conflict(guided, values, name, config, bool(weights) and from_file is not None):
        raise CommandError(f"handtouch calibrate: {conflict}", 2)
    with failing(2, ValueError, OSError):
        endpoint = find_endpoint("control", endpoint, config)
        stream = find_endpoint("live", live, config)
    if new_sheet:
        if guided or values or name is not None or config is None:
            raise CommandError("handtouch calibrate: --new-sheet takes --config CONFIG and nothing else", 2)
        asked = calibrate.CalibrateOptions(pad=pad, config=config, as_json=as_json, **options)
        return _run_new_sheet(asked, calibrate.DaemonEndpoints(stream, endpoint, key))
    if from_file is not None and not from_file.is_file():
        raise CommandError(f"{from_file}: no such file; --from reads readings that --log recorded", 2)
    if guided and config is not None:
        guided_options = calibrate.CalibrateOptions(
            pad=pad, config=config, weights=weights, from_file=from_file, as_json=as_json, **options
        )
        return _run_guided(guided_options, calibrate.DaemonEndpoints(stream, endpoint, key))
    if law is not None:
        values["law"] = dict(zip(("contact_ohm_mm2", "alpha", "ohm_per_square"), law, strict=True))
        values["law"]["hertz_force_n"] = hertz_force_n
    if name is not None:
        values["name"] = name
    return requests.run_request(
        "calibrate",
        requests.calibration_lines,
        endpoint=endpoint,
        key=key,
        as_json=as_json,
        pad=pad,
        **values,
    )


def _find_conflict(
    guided: bool, values: dict[str, Any], name: str | None, config: Path | None, two_sources: bool
) -> str:
    """Return the conflict between options with its remedy; empty if there is none."""
    if guided and (values or name is not None):
        return "--weights and --from measure a law, --name, --gains, --offsets and --law set one; use either"
    if guided and config is None:
        return "--config CONFIG is missing: the deployment file that the daemon runs with"
    if two_sources:
        return "--weights measures, --from reads recorded readings; use either"
    if values and name is None:
        return "--name NAME is missing: the id of the new calibration"
    return ""


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
    # RuntimeError: the daemon refuses
    with failing(2, ValueError), failing(1, calibrate.CalibrationError, StoreError, OSError, RuntimeError):
        if options.from_file is not None:
            result = calibrate.refit_recording(options, options.from_file, datetime.now(UTC))
            failed = bool(result.report.fit.problems)
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
