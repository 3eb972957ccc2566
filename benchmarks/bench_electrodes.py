"""Measure intervals of pads with any number of electrodes: position and force in the world `default`.

The pads of config/electrodes.toml, with three and six electrodes, with hidden quantities drawn for seeds of
the reporting family. Touches anywhere on them go through the daemon's own pipeline; one sample of each is
compared. Prints its tables and writes docs/benchmarks/electrodes.md and electrodes.json.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from bench_worlds import UNITS, WARM_UP, drawn_world, with_stated_touches
from hand_touches import FORCES_N, TouchReadings, draw_touches, estimates, force_error, position_error
from page import made_by, options, output_folder, table
from scores import Estimates, EstimateScore, bin_labels, concatenate, slices

from handtouch.config import load, shipped
from handtouch.core.pad_model import PadModel
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.virtual_hand import VirtualHand

ERRORS = {"position": position_error, "force": force_error}


def play(number: int, touches: int) -> dict[str, Estimates]:
    """Return estimates of position and force of a drawn finger."""
    drawn = drawn_world("default", number)
    deployment = drawn.describe(load(shipped.path("electrodes.toml")))
    stated = with_stated_touches(deployment, drawn)
    model, numbers = PadModel(stated), range(WARM_UP, WARM_UP + touches)
    stimulus = Scenario(touch=draw_touches(model.links, numbers.stop, drawn.seed))
    readings = TouchReadings.of_hand(VirtualHand(deployment, stimulus, drawn), deployment, numbers)
    contacts = readings.contacts(model, stated)
    parts: dict[str, list[Estimates]] = {quantity: [] for quantity in ERRORS}
    for row, link in enumerate(model.links):
        found = [(contacts.get(key), truth) for key, truth in readings.truths.items() if key[1] == link]
        true_n = np.array([truth.force_n for _, truth in found])
        columns = {
            "pad": np.full(len(found), f"{link}, {model.electrode_counts[row]} electrodes"),
            "force": bin_labels(true_n, (0.5, 2.0, 5.0), "N"),
        }
        bound_m = np.array([truth.bound_m for _, truth in found])
        for quantity, error in ERRORS.items():
            errors = [error(*pair) for pair in found]
            unknown = np.full((len(found), len(errors[0][0]), len(errors[0][0])), np.nan)
            bound = bound_m if quantity == "position" else np.full(len(found), np.nan)
            parts[quantity].append(estimates(errors, bound, unknown, columns))
    return {quantity: concatenate(some) for quantity, some in parts.items()}


def rows_of(every: Estimates, quantity: str) -> list[dict[str, Any]]:
    """Return the scores of each pad, and of each pad by force."""
    rows = []
    for pad, own in slices(every, "pad"):
        cut = {pad: own, **{f"{pad}, {force}": part for force, part in slices(own, "force")}}
        for name, part in cut.items():
            row = EstimateScore.of_estimates(part).row(UNITS[quantity][1], bounds=False)
            rows.append({"": name, **row})
    return rows


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--hands", type=int, default=8)
    parser.add_argument("--touches", type=int, default=60, help="of each pad")
    asked = parser.parse_args()
    if asked.quick:
        asked.hands, asked.touches = 1, 3
    made = []
    for number in range(asked.hands):
        made.append(play(number, asked.touches))
        print(f"finger {number + 1} of {asked.hands}", flush=True)
    found = {quantity: concatenate([part[quantity] for part in made]) for quantity in ERRORS}
    page = ["# Intervals of pads with other numbers of electrodes", "", f"{made_by()}.", ""]
    page += [HEAD.format(hands=asked.hands, touches=asked.touches, low=FORCES_N[0], high=FORCES_N[1]), ""]
    for quantity, every in found.items():
        text = f"As configured. Errors and deviations in {UNITS[quantity][0]}."
        page += table(quantity.capitalize(), text, rows_of(every, quantity))
    out = output_folder(asked.quick)
    (out / "electrodes.md").write_text("\n".join(page))
    record = {
        f"{pad}, {quantity}": asdict(EstimateScore.of_estimates(part))
        for quantity, every in found.items()
        for pad, part in slices(every, "pad")
    }
    (out / "electrodes.json").write_text(json.dumps(record, indent=1).replace("NaN", "null") + "\n")


HEAD = """\
{hands} fingers of [electrodes.toml](../../config/electrodes.toml) drawn in the [world](../worlds.md)
`default`, seeds of the reporting family; {touches} touches of each pad, {low:g} to {high:g} N (log-uniform),
at uniform positions of the drawing's rectangle from 2 % of a side inside its edges; else as in
[worlds](worlds.md). Touches of one pad share its parts: the shares' intervals are of touches on these pads,
and pads differ more than they say."""


if __name__ == "__main__":
    main()
