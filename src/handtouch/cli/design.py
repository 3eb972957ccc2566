"""The command `design`: a pad's expected errors, or layouts before and after, drawings and tables."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from handtouch import config
from handtouch.cli.errors import failing, needing
from handtouch.cli.options import add_config, add_json, add_number, add_output, integer
from handtouch.cli.progress import ProgressLine
from handtouch.cli.tables import make_table, output_console
from handtouch.host.json_output import print_json

if TYPE_CHECKING:
    from handtouch.design.goals import Statistic
    from handtouch.design.layout import ElectrodeLayout
    from handtouch.design.optimise import DesignResult
    from handtouch.design.pad_task import PadTask
    from handtouch.design.sheets import SheetCase

_COLUMNS = ("electrode", "from, mm", "to, mm", "then bare", "series, ohm")
_PREFIX = "handtouch design: "
_CHECK_SEED = 0  # any seed: it draws the deployment's tolerances, on which the result doesn't depend


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `design`."""
    parser.set_defaults(command=run)
    add_config(parser)
    parser.add_argument("--link", metavar="LINK", help="pad to design (default: the first)")
    add_output(
        parser, "out", "folder to write to (default: design)", default=Path("design"), metavar="FOLDER"
    )
    add_json(parser)
    parser.add_argument(
        "--goal",
        choices=("position", "force", "two-contacts", "linearity"),
        help="optimise: standard deviation of position or of force, least separation of two contacts, error "
        "of plain log-ratios; default: draw the pad as it is",
    )
    parser.add_argument(
        "--statistic",
        choices=("worst", "mean"),
        default="worst",
        help="of the goal over the inner 80 %% of the pad (default: worst; mean: root mean square)",
    )
    parser.add_argument(
        "--world",
        choices=("ideal", "default", "harsh"),
        default="default",
        help="tolerances of the parts (default: default; ideal: none, the nominal optimum)",
    )
    add_number(parser, "--force", "N", "force of the contacts to design for", default=1.0, dest="force_n")
    parser.add_argument(
        "--electrodes",
        type=integer(4, 12, "4 to 12 electrodes"),
        metavar="COUNT",
        help="electrodes anywhere on the boundary, for a node of as many channels; default: one on each "
        "side, which a deployment can describe",
    )
    for name, default, text in (
        ("min-gap-mm", 0.3, "least bare length at an end of an electrode"),
        ("min-electrode-mm", 3.0, "least length of an electrode"),
    ):
        add_number(parser, f"--{name}", "MM", f"{text} (default: {default})", default=default)
    parser.add_argument(
        "--max-series-ohm",
        type=float,
        default=1000.0,
        metavar="OHM",
        help="largest series resistor; 0: none are used (default: 1000)",
    )
    parser.add_argument(
        "--no-check", dest="check", action="store_false", help="skip the check by the simulator"
    )


def run(
    config_path: Path,
    link: str | None,
    out: Path,
    goal: str | None,
    statistic: Statistic,
    world: str,
    force_n: float,
    electrodes: int | None,
    min_gap_mm: float,
    min_electrode_mm: float,
    max_series_ohm: float,
    check: bool,
    as_json: bool = False,
) -> int:
    """Draw a pad as it is, or optimise it for a goal; return the exit status.

    2 for an invalid file, link or combination of options, or without matplotlib; 1 if the folder cannot be
    written.
    """
    if goal is None:
        return _draw_pad(config_path, link, out, as_json)
    from handtouch.design.goals import GOALS
    from handtouch.design.layout import FabricationLimits
    from handtouch.design.optimise import optimise_layout
    from handtouch.design.pad_task import PadTask
    from handtouch.design.sheets import compare_sheets
    from handtouch.simulate.worlds import WORLDS

    described = WORLDS[world].draw(_CHECK_SEED).describe(config.load(config_path))
    with _failing(), ProgressLine() as progress:
        task = PadTask.from_deployment(described, link, force_n, nominal=world == "ideal")
        limits = FabricationLimits(min_gap_mm, min_electrode_mm, max_series_ohm)
        result = optimise_layout(task, GOALS[goal], statistic, limits, electrodes, progress.update)
        simulated = _simulated(task, result, world, progress) if check else None
        files, no_tables = _write(config_path, task, result, world, out, progress)
        forces_n = _sheet_forces(task)
        sheets = compare_sheets(task, forces_n) if goal == "force" else []
        films_mm = _by_films(task, result) if goal == "position" and electrodes is None else None
    if as_json:
        made = _as_json(task, result, simulated, files) | {"no_tables": no_tables}
        if films_mm is not None:
            made |= {"two_layers": dict(zip(("known_leads", "unknown_leads"), films_mm, strict=True))}
        if sheets:
            made |= {"sheets": [asdict(case) for case in sheets], "sheet_forces_n": forces_n}
        print_json(made)
    else:
        _print(task, result, world, simulated, files, no_tables)
        if films_mm is not None:
            _print_films(*films_mm)
        if sheets:
            _print_sheets(forces_n, sheets)
    return 0


@contextmanager
def _failing() -> Iterator[None]:
    with (
        needing("figures", _PREFIX),
        failing(2, ValueError, prefix=_PREFIX),
        failing(1, OSError, prefix=_PREFIX),
    ):
        yield


def _draw_pad(config_path: Path, link: str | None, out: Path, as_json: bool) -> int:
    """Draw one pad of a deployment, print the paths and its expected errors; return the exit status.

    2 for an invalid file or link, or without matplotlib; 1 if the folder cannot be written.
    """
    from handtouch.design.pad_drawings import draw_design
    from handtouch.hand.expected_error import FIRM_TOUCH_N, error_summary, pad_design

    deployment = config.load(config_path)
    with _failing(), ProgressLine() as progress:
        pad = pad_design(deployment, link)
        paths = draw_design(pad, out, progress.update)
    errors = [(force_n, *error_summary(pad, force_n)) for force_n in (pad.light_touch_n, FIRM_TOUCH_N)]
    if as_json:
        rows = [{"force_n": force, "median_m": median, "worst_m": worst} for force, median, worst in errors]
        print_json({"pad": pad.name, "files": paths, "expected_error": rows})
        return 0
    print(*paths, sep="\n")
    for force_n, *errors_m in errors:
        median_mm, worst_mm = (1e3 * error_m for error_m in errors_m)
        print(f"{force_n:g} N: expected location error {median_mm:.3g} mm median, {worst_mm:.3g} mm at worst")
    return 0


def _simulated(
    task: PadTask, result: DesignResult, world: str, progress: ProgressLine
) -> tuple[float, float] | None:
    """Return the goal before and after as simulated; None where it can't be."""
    from handtouch.design.goals import goal_value
    from handtouch.design.simulated_check import CHECKED_GOALS, simulated_goal_map
    from handtouch.simulate.worlds import WORLDS

    if result.goal.name not in CHECKED_GOALS or not result.after.is_on_sides(task.boundary):
        return None
    task = task.with_points(len(result.map_after))
    draws = 4 if world == "ideal" else 12
    before, after = (
        goal_value(
            simulated_goal_map(
                task, layout, result.goal, WORLDS[world].only("parts"), draws, on_progress=progress.update
            ),
            result.statistic,
        )
        for layout in (result.before, result.after)
    )
    return before, after


def _write(
    config_path: Path, task: PadTask, result: DesignResult, world: str, out: Path, progress: ProgressLine
) -> tuple[list[Path], str]:
    """Write pictures, drawings and, where possible, the deployment.

    Return their paths, and why there is no deployment.
    """
    from handtouch.design.deployed import deployment_text
    from handtouch.design.drawing import write_dxf, write_svg
    from handtouch.design.fabrication import fabrication_drawing
    from handtouch.design.pictures import draw_before_and_after

    out.mkdir(parents=True, exist_ok=True)
    stem = f"{task.pad.link}_{result.goal.name.replace('-', '_')}"
    progress.update("drawing")
    title = f"{task.pad.link}: {result.goal.description}, {task.force_n:g} N, world {world}"
    files = draw_before_and_after(task, result, title, out / f"{stem}_map")
    drawing = fabrication_drawing(task, result.after)
    texts = {f"{stem}.svg": write_svg(drawing), f"{stem}.dxf": write_dxf(drawing)}
    no_tables = ""
    try:
        texts[f"{stem}.toml"] = deployment_text(config_path, task, result.after, out)
    except ValueError as error:
        no_tables = str(error)
    for name, text in texts.items():
        (out / name).write_text(text, encoding="utf-8")
        files.append(out / name)
    return files, no_tables


def _by_films(task: PadTask, result: DesignResult) -> tuple[float, float]:
    """Return the goal `position` [mm] of two films on the pad's wires, with known leads and unknown ones."""
    from handtouch.design.films import LEAD_STD_OHM, film_position_std
    from handtouch.design.goals import goal_value

    fine = task.with_points(len(result.map_after))
    known, unknown = (
        goal_value(result.goal.factor * film_position_std(fine, lead_ohm), result.statistic)
        for lead_ohm in (0.0, LEAD_STD_OHM)
    )
    return known, unknown


def _print_films(known_mm: float, unknown_mm: float) -> None:
    from handtouch.design.films import FILM_OHM, LEAD_STD_OHM

    print(
        f"two films of {FILM_OHM:g} ohm per square on the same four wires: {known_mm:.4g} mm, "
        f"{unknown_mm:.4g} mm where leads are unknown by {LEAD_STD_OHM:g} ohm (docs/responses.md#two-layers)"
    )


def _sheet_forces(task: PadTask) -> list[float]:
    """Return the forces [N] at which sheets are compared: a light, the asked and a firm one."""
    most_n = task.sheet.max_force_n or math.inf
    return sorted(force_n for force_n in {0.1, task.force_n, 5 * task.force_n} if force_n <= most_n)


def _print_sheets(forces_n: Sequence[float], sheets: Sequence[SheetCase]) -> None:
    """Print what other layers would make of the force."""
    at = " / ".join(f"{force_n:g}" for force_n in forces_n)
    print(f"expected deviation of force and of contact radius, and the sheet's load, % at {at} N:")
    table = make_table("alpha", "second sheet", "force", "radius", "current of most")
    for case in sheets:
        columns = (case.force_std, case.radius_std, case.current_fraction)
        second = "none" if case.second_alpha is None else f"alpha {case.second_alpha:g}"
        table.add_row(
            f"{case.alpha:g}" + (" (configured)" if case.is_configured else ""),
            second,
            *(" / ".join(f"{100 * value:.2g}" for value in values) for values in columns),
        )
    output_console().print(table)


def _rows(task: PadTask, layout: ElectrodeLayout) -> list[dict[str, Any]]:
    """Return what each electrode measures, in mm and ohm."""
    from handtouch.design.fabrication import electrode_names

    return [
        {
            "electrode": name,
            "start_mm": round(1e3 * start, 4),
            "stop_mm": round(1e3 * stop, 4),
            "bare_after_mm": round(1e3 * gap, 4),
            "series_ohm": ohm,
        }
        for name, (start, stop), gap, ohm in zip(
            electrode_names(task, layout),
            layout.stretches_m.tolist(),
            layout.gaps_m(task.boundary).tolist(),
            layout.series_ohm.tolist(),
            strict=True,
        )
    ]


def _as_json(
    task: PadTask, result: DesignResult, simulated: tuple[float, float] | None, files: list[Path]
) -> dict[str, Any]:
    return {
        "pad": task.pad.link,
        "goal": result.goal.name,
        "unit": result.goal.unit,
        "statistic": result.statistic,
        "before": result.value_before,
        "after": result.value_after,
        "simulated": {"before": simulated[0], "after": simulated[1]} if simulated else None,
        "electrodes": _rows(task, result.after),
        "files": files,
    }


def _print(
    task: PadTask,
    result: DesignResult,
    world: str,
    simulated: tuple[float, float] | None,
    files: list[Path],
    no_tables: str,
) -> None:
    goal, unit = result.goal, result.goal.unit
    ratio = result.value_before / result.value_after
    print(f"{task.pad.link}: {goal.description}, {result.statistic}, {task.force_n:g} N, world {world}")
    print(f"  before     {result.value_before:8.4g} {unit}")
    print(f"  after      {result.value_after:8.4g} {unit}   {ratio:.2f} times better")
    if simulated:
        before, after = simulated
        print(f"  simulated  {before:8.4g} {unit} before, {after:.4g} {unit} after")
    table = make_table(*_COLUMNS, right=_COLUMNS[1:])
    for row in _rows(task, result.after):
        lengths = (f"{row[key]:.2f}" for key in ("start_mm", "stop_mm", "bare_after_mm"))
        table.add_row(row["electrode"], *lengths, f"{row['series_ohm']:g}")
    output_console().print(table)
    if no_tables:
        print(f"  no tables: {no_tables}")
    if not result.after.is_on_sides(task.boundary):
        print("  not simulated: electrodes aren't one on each side")
    if ratio == 1:
        print("  nothing better was found within these limits")
    print(*files, sep="\n")
