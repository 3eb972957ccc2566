"""Hands with two sheets for benchmarks: the shipped one with a second sheet on every pad.

Public names: `with_second_sheets`, `with_radii`, `weigh`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.calibration.calibration import LawParameters
from handtouch.config import Deployment, shipped
from handtouch.core.pad_model import ampere_per_count_of, law_of
from handtouch.procedures.calibrate.fit import SheetReadings, fit_laws
from handtouch.procedures.calibrate.readings import (
    PadCircuitModel,
    Weight,
    WeightReading,
    measurement_order,
    parse_weights,
    with_responses,
)
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import DrawnWorld

_SECOND = """
[sheet.even]
ohm_per_square = 600.0
contact_ohm_mm2 = 40_000.0
alpha = 1.0
contact_radius_mm = 3.0
contact_radius_std_mm = 1.0
max_force_n = 20.0

[touch]"""
"""Second sheet of `config/two_sheets.toml`."""
WEIGHTS = "20@2,50@2,100@2,200@2,500@2,20@4,50@4,100@4,200@4,500@4"
_FIRST_S, _STEP_S, _PRESS_S, _SETTLING_S = 2.0, 3.0, 2.5, 1.0
_SAMPLES, _RADIUS_STD, _POSITION_STD_M = 40, 0.05, 0.5e-3


def with_second_sheets() -> Deployment:
    """Return the shipped hand with a second sheet of alpha 1 on every pad."""
    text = shipped.path("utah_mit.toml").read_text()
    channels = ", ".join(f'"0x6401:{number}"' for number in range(1, 6))
    text = text.replace("[node.four_channel]", f"[node.four_channel]\nchannels = [{channels}]")
    text = text.replace('node = "four_channel"\n', 'node = "four_channel"\nsecond_sheet = "even"\n')
    return config.parse(text.replace("\n[touch]", _SECOND, 1), "utah_mit.toml with second sheets")


def with_radii(deployment: Deployment, radius_mm: float, std_mm: float) -> Deployment:
    """Return a deployment whose contacts have radii of this mean and standard deviation, as all its sheets
    state."""
    radii = {"contact_radius_mm": radius_mm, "contact_radius_std_mm": std_mm}
    sheets = {name: sheet.model_copy(update=radii) for name, sheet in deployment.sheets.items()}
    return deployment.model_copy(update={"sheets": sheets})


def weigh(deployment: Deployment, drawn: DrawnWorld) -> list[list[LawParameters]]:
    """Return the laws of the sheets of each pad by known weights, as `handtouch calibrate` fits them.

    Each weight is placed twice on each pad, on either foot, near its middle; the radii of the feet are known
    within 3 %, and stated within 5 %.
    """
    rng, pads = np.random.default_rng((drawn.seed, 9)), [entry.pad for entry in deployment.pads]
    weights = measurement_order(parse_weights(WEIGHTS, "gf", 3.0), 2)
    feet = {radius: radius * float(np.exp(0.03 * rng.normal())) for radius in {w.radius_m for w in weights}}
    places = 0.5 + 0.02 * rng.normal(size=(len(pads), len(weights), 2))
    touches = tuple(
        ScenarioTouch(
            link=pad.link,
            from_s=_FIRST_S + _STEP_S * number,
            duration_s=_PRESS_S,
            path=((float(place[0]), float(place[1])),),
            force_n=(weight.force_n,),
            radius_mm=1e3 * feet[weight.radius_m],
        )
        for pad, own in zip(pads, places, strict=True)
        for number, (weight, place) in enumerate(zip(weights, own, strict=True))
    )
    hand = VirtualHand(deployment, Scenario(touch=touches), drawn)
    truths = [hand.truth(_FIRST_S + _STEP_S * number + _SETTLING_S) for number in range(len(weights))]
    centres = [{truth.link: (truth.u_m, truth.v_m) for truth in at_once} for at_once in truths]
    return [
        _laws_of(deployment, hand, row, weights, np.array([own[pad.link] for own in centres]), rng)
        for row, pad in enumerate(pads)
    ]


def _laws_of(
    deployment: Deployment,
    hand: VirtualHand,
    row: int,
    weights: Sequence[Weight],
    centres_m: NDArray[np.float64],
    rng: np.random.Generator,
) -> list[LawParameters]:
    pad = deployment.pads[row].pad
    model = PadCircuitModel(deployment, pad)
    starts = [0.0, *(_FIRST_S + _STEP_S * k + _SETTLING_S for k in range(len(weights)))]
    times = np.concatenate([start + np.linspace(0.0, 1.0, _SAMPLES, endpoint=False) for start in starts])
    counts = hand.all_counts(row, times).reshape(len(starts), _SAMPLES, -1).mean(axis=1)
    rise = counts[1:] - counts[0]
    scales = [ampere_per_count_of(pad, deployment)]
    sheets = [model.sheet]
    if model.second_sheet is not None:
        scales.append([model.second_ampere_per_count or 0.0])
        sheets.append(model.second_sheet)
    columns = np.split(rise, [len(scales[0])], axis=1)
    noise_a = model.node.noise_counts * max(scales[0]) * 2 / _SAMPLES**0.5
    made = []
    for sheet, scale, own in zip(sheets, scales, columns, strict=False):
        readings = []
        for number, (weight, centre, values) in enumerate(zip(weights, centres_m, own, strict=True)):
            at, loaded_s = centre + _POSITION_STD_M * rng.normal(size=2), _FIRST_S + _STEP_S * number
            readings.append(
                WeightReading(
                    *(weight, float(values @ scale), noise_a, _SAMPLES, (at[0], at[1])),
                    unloaded_s=loaded_s - _STEP_S + _PRESS_S,
                    loaded_s=loaded_s,
                    measured_s=loaded_s + _SETTLING_S + 0.5,
                )
            )
        circuits = [model.circuit_at(reading.position_m, _POSITION_STD_M) for reading in readings]
        if sheet is model.second_sheet:
            circuits = [replace(circuit, series_ohm=0.0) for circuit in circuits]
        made.append(
            SheetReadings(with_responses(sheet, readings), circuits, law_of(sheet), sheet.reference_kpa * 1e3)
        )
    return [fit.law for fit in fit_laws(made, _RADIUS_STD)]
