"""Design of electrodes: three goals for the shipped fingertip, before and after, nominal and robust.

`handtouch design` for `index_distal` of config/utah_mit.toml: worst value over the inner 80 %, within the
default limits (gaps from 0.3 mm, electrodes from 3 mm, resistors to 1 kohm), in mm: standard deviation of
position, least separation of two contacts, error of plain log-ratios. *Theory* is what is minimised;
*simulated* are root mean squares over drawn pads of the reporting family, solved by the simulator's finite
elements, the greatest of the grid's positions: of few pads it lies above that of many. *ideal* and *default*
are [worlds](../worlds.md). Gaps follow y0, xa, yb and x0. *Number of electrodes*: anywhere on the boundary,
0.3 N, noise only, theory.
"""

from __future__ import annotations

from benchmarks.page import ROOT, Report, Row, options, progress
from handtouch import config
from handtouch.design.goals import GOALS, Goal, goal_map, goal_value
from handtouch.design.layout import ElectrodeLayout
from handtouch.design.optimise import optimise_layout
from handtouch.design.pad_task import PadTask
from handtouch.design.simulated_check import simulated_goal_map
from handtouch.simulate.worlds import WORLDS, Family

LINK = "index_distal"
POINTS = 9  # of a side
DRAWS = 12
CASES = (("position", 0.3), ("two-contacts", 1.0), ("linearity", 1.0))
ELECTRODES = (4, 6, 8)


def simulated(task: PadTask, layout: ElectrodeLayout, goal: Goal, world: str, draws: int) -> float:
    """Return the worst value of simulated pads of the reporting family."""
    count = min(4, draws) if world == "ideal" else draws
    parts = WORLDS[world].only("parts")
    found = simulated_goal_map(task, layout, goal, parts, count, Family.REPORTING)
    return goal_value(found, "worst")


def goal_rows(deployment: config.Deployment, draws: int, starts: int) -> list[Row]:
    """Optimise for each goal without tolerances and with those of `default`; simulate both in both."""
    rows = []
    for name, force in CASES:
        goal = GOALS[name]
        nominal = PadTask.from_deployment(deployment, LINK, force, nominal=True)
        robust = PadTask.from_deployment(deployment, LINK, force)
        layouts = {
            "as shipped": nominal.configured,
            "nominal optimum": optimise_layout(nominal, goal, starts=starts).after,
            "robust optimum": optimise_layout(robust, goal, starts=starts).after,
        }
        for kind, layout in layouts.items():
            row: Row = {"goal": name, "force, N": force, "electrodes": kind}
            for world, task in (("ideal", nominal), ("default", robust)):
                theory = goal_value(goal_map(goal, task.with_points(POINTS), layout), "worst")
                row[f"{world}, theory"] = theory
                row[f"{world}, simulated"] = simulated(task, layout, goal, world, draws)
            gaps = 1e3 * layout.gaps_m(nominal.boundary)
            row["bare at the corners, mm"] = " ".join(f"{gap:.2f}" for gap in gaps)
            row["resistors xa, x0, ohm"] = " ".join(f"{ohm:g}" for ohm in layout.series_ohm[1::2])
            rows.append(row)
            progress(row)
    return rows


def count_rows(deployment: config.Deployment, starts: int) -> list[Row]:
    """Optimise the position with electrodes anywhere on the boundary, by their number."""
    task = PadTask.from_deployment(deployment, LINK, 0.3, nominal=True).with_points(7)
    rows: list[Row] = []
    for count in ELECTRODES:
        result = optimise_layout(task, GOALS["position"], electrodes=count, starts=starts)
        rows.append(
            {
                "electrodes": count,
                "worst, mm": result.value_after,
                "times better than shipped": result.value_before / result.value_after,
            }
        )
        progress(rows[-1])
    return rows


def main() -> None:
    parser = options(__doc__)
    quick = parser.parse_args().quick
    deployment = config.load(ROOT / "config" / "utah_mit.toml")
    draws, starts = (2 if quick else DRAWS), 1
    report = Report(quick, simulated_pads=draws, positions=POINTS**2)
    report.table("Goals", goal_rows(deployment, draws, starts))
    report.table("Number of electrodes", count_rows(deployment, starts))
    report.keep()


if __name__ == "__main__":
    main()
