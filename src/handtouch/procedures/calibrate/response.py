"""Response of a sheet with behaviour to weights: what creep, adaptation and hysteresis leave of each.

The core compensates them in every force, so a law is fitted to the loads that it takes for uncompensated.

Public name: `with_responses`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from handtouch import config
from handtouch.core.sheet_force import sheet_behaviour_of
from handtouch.procedures.calibrate.readings import WeightReading
from handtouch.sheet import Fluctuation

_MIN_RESPONSE = 0.1  # of a sheet that passed current, whatever its model


def with_responses(sheet: config.Sheet, readings: Sequence[WeightReading]) -> list[WeightReading]:
    """Return consecutive readings of a sheet with its responses by the behaviour that its table states.

    The sheet is fresh at first; each weight stays until the pad is unloaded before the next one. Without
    behaviour, or times, the readings are returned as they are.
    """
    known = all(math.isfinite(reading.unloaded_s) for reading in readings)
    if sheet.behaviour is None or not known:
        return list(readings)
    steady = replace(sheet_behaviour_of(sheet.behaviour).model, fluctuation=Fluctuation())
    state, made = steady.initial_state(1), list[WeightReading]()
    for reading in readings:
        if made:
            weight_n, measured_s = made[-1].weight.force_n, made[-1].measured_s
            steady.discretise(max(reading.unloaded_s - measured_s, 0.0)).forward(state, weight_n)
        steady.discretise(max(reading.loaded_s - reading.unloaded_s, 0.0)).forward(state, 0.0)
        step = steady.discretise(reading.measured_s - reading.loaded_s)
        (apparent_n,) = step.forward(state, reading.weight.force_n)
        made.append(replace(reading, response=max(apparent_n / reading.weight.force_n, _MIN_RESPONSE)))
    return made
