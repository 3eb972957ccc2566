"""Position and force by world: coverage, sharpness and validity.

Hands of each of the [worlds](../worlds.md) `ideal`, `default` and `harsh`, half as many of each world with
few hidden quantities; 15 pads each, of four surfaces; seeds of the reporting family. Touches of each pad, 0.2
to 12 N (log-uniform), anywhere from 2 % of a side inside the edges, go through the daemon's own pipeline; one
sample of each, 0.32 s after it began, is compared. 12 touches come first, as evidence for the compensation of
sheets. Deployment files describe sheets as their builder would, and state the standard deviations of the
parts and contacts of their world, also those of uneven sheets and elongated contacts. Pads are mounted as
stated; for mounts and joints see [grasp](grasp.md). Sheets are fresh, and stated to be (`back_force_std_n`
0): the default of 0.1 N for loads before the daemon's start widens forces below 1 N. *After 32 (256)
contacts*: with the gains and parts that automatic calibration learned from so many other touches of each pad,
where it reached that state; it doesn't use touches within 5 % of a side from an edge, weak ones and saturated
ones.

Errors and deviations in mm and N; tables by a quantity are as configured. Touches of one pad share its parts:
intervals are of touches on these pads. The oracle knows the history of the sheet, and neither drift nor
uneven sheets nor elongated patches; contacts don't measure a pad's size, so positions keep its tolerance.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from benchmarks.hand_touches import (
    REST_S,
    SAMPLE_S,
    STEP_S,
    Key,
    TouchReadings,
    compare,
    draw_touches,
)
from benchmarks.oracle import PadOracle
from benchmarks.page import Report, options
from benchmarks.scores import Estimates, EstimateScore, concatenate, slices
from handtouch.calibration.auto_calibration import AutoCalibrator
from handtouch.calibration.gains import PartModels
from handtouch.calibration.stationary_contacts import StationaryContact
from handtouch.config import Deployment, load, shipped
from handtouch.core.active_calibration import ActiveCalibration
from handtouch.core.pad_model import PadModel
from handtouch.hand import pad_network, part_stds
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.truth import GroundTruth
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import (
    WORLDS,
    ContactSpread,
    DrawnWorld,
    Family,
    MountSpread,
    Normal,
    World,
)

FloatArray = NDArray[np.float64]
NAMED = ("ideal", "default", "harsh")
SINGLE = {
    "radius": World("radius", contacts=ContactSpread(radius_sigma=Normal(0.0, 1.0))),
}
"""Worlds in which only some quantities are hidden; contact patches as stated."""
WARM_UP = 12
"""Touches before those that are compared: as many as compensation of sheets needs for evidence."""
HELD_SAMPLES, REST_SAMPLES, REST_PAUSES = 12, 6, 4
"""Of a contact that is learned from; of each pause before a contact, and pauses, for its zeros."""
DRAWN_PER_LEARNT, DRAWN_MORE = 1.3, 32
"""Touches drawn for each contact that the calibration uses (none at edges, no weak or saturated ones), and
how many more, as it takes contacts in groups."""
CONFIGURED = "as configured"
LEARNT = (32, 256)
"""Contacts after which estimates are compared again, in the world `default`; elsewhere after the first."""
SLICES = ("edge distance", "force", "sheet", "sheet kind", "surface", "aspect")


def drawn_world(name: str, number: int) -> DrawnWorld:
    """Return a world of the reporting family. Pads are mounted as stated: mounts are the grasp's subject."""
    world = WORLDS[name] if name in WORLDS else SINGLE[name]
    return replace(world, mounts=MountSpread()).draw(Family.REPORTING.seed(number))


def with_stated_touches(deployment: Deployment, drawn: DrawnWorld) -> Deployment:
    """Return the deployment with the spread of contact radii in this world as its builder states it, and with
    sheets that weren't loaded before, as they are here."""
    spread = drawn.world.contacts.radius_sigma.std
    sheets = {}
    for name, sheet in deployment.sheets.items():
        stated: dict[str, Any] = {"contact_radius_std_mm": spread * sheet.contact_radius_std_mm}
        if sheet.behaviour:
            stated["behaviour"] = sheet.behaviour.model_copy(update={"back_force_std_n": 0.0})
        sheets[name] = sheet.model_copy(update=stated)
    return deployment.model_copy(update={"sheets": sheets})


def state_after(contacts: int) -> str:
    """Return the name of the state after this many contacts."""
    return f"after {contacts} contacts" if contacts else CONFIGURED


STATES = tuple(state_after(contacts) for contacts in (0, *LEARNT))


@dataclass(frozen=True)
class Learning:
    """What a pad's calibration knows after some contacts; `touches`: those that it was given."""

    calibration: ActiveCalibration | None
    touches: list[int]


def learn(
    hand: VirtualHand,
    deployment: Deployment,
    model: PadModel,
    row: int,
    numbers: range,
    counts: Sequence[int],
) -> list[Learning]:
    """Calibrate a pad by touches of these numbers, as the supervisor does, until it has used each of
    `counts`."""
    period_s, (_, pad) = deployment.daemon.sync_period_ms * 1e-3, deployment.pads[row]
    begin_s = REST_S + np.array(numbers)[:, None] * STEP_S
    held_s = begin_s + SAMPLE_S - period_s * np.arange(HELD_SAMPLES)
    rest_s = begin_s - period_s * np.arange(1, REST_SAMPLES + 1)
    held, rest = (
        hand.counts(row, times.ravel()).reshape(*times.shape, -1).mean(axis=1) for times in (held_s, rest_s)
    )
    padded = np.concatenate([rest[:1].repeat(REST_PAUSES - 1, axis=0), rest])
    rest = np.lib.stride_tricks.sliding_window_view(padded, REST_PAUSES, axis=0).mean(axis=-1)
    node, sheet = deployment.nodes[pad.node], deployment.sheets[pad.sheet]
    network = pad_network(pad, sheet)
    parts = PartModels.of_pad(network, pad, node, sheet)
    calibrator = AutoCalibrator(network, parts, part_stds(pad, node, sheet), node.gain_std)
    calibrator.assign_node(row + 1, None, None, "", 0)
    noise_a, count = contact_noise_a(model, row), model.electrode_counts[row]
    found: list[Learning] = []
    applied, given = None, []
    for number, reading, zeros in zip(numbers, held, rest, strict=True):
        if reading.max() >= model.max_counts[row]:
            continue
        sync_ns = round((REST_S + number * STEP_S + SAMPLE_S) * 1e9)
        currents_a = (reading - zeros) * model.ampere_per_count[row, :count]
        given.append(number)
        contact = StationaryContact(currents_a, noise_a, HELD_SAMPLES, sync_ns, number)
        if calibrator.add_contact(contact).apply:
            gains = calibrator.gains
            covariance = tuple(np.ravel(gains.covariance).tolist())
            applied = ActiveCalibration(
                f"{row + 1}-1", gains.factors, gain_covariance=covariance, parts=gains.parts
            )
        if calibrator.estimate.contacts >= counts[len(found)]:
            calibrated = calibrator.calibration_state == "calibrated"
            found.append(Learning(applied if calibrated else None, list(given)))
            if len(found) == len(counts):
                break
    return found + [Learning(None, given)] * (len(counts) - len(found))


def contact_noise_a(model: PadModel, row: int) -> FloatArray:
    """Return the noise (channels,) [A] of a contact's mean less its zeros."""
    noise_a = model.noise_a[row, : model.electrode_counts[row]]
    return np.asarray(noise_a * np.sqrt(1 / HELD_SAMPLES + 1 / (REST_SAMPLES * REST_PAUSES)))


def play(task: tuple[str, int, int, tuple[int, ...]]) -> dict[str, Estimates]:
    """Return estimates of position and force of a hand: name of the world, number, touches, and the numbers
    of contacts after which they are compared again."""
    name, number, touches, counts = task
    drawn = drawn_world(name, number)
    deployment = drawn.describe(load(shipped.path("utah_mit.toml")))
    stated = with_stated_touches(deployment, drawn)
    model = PadModel(stated)
    numbers = range(WARM_UP, WARM_UP + touches)
    drawn_touches = round(DRAWN_PER_LEARNT * max(counts)) + DRAWN_MORE if counts else 0
    others = range(numbers.stop, numbers.stop + drawn_touches)
    stimulus = Scenario(touch=draw_touches(model.links, others.stop, drawn.seed))
    hand = VirtualHand(deployment, stimulus, drawn)
    readings = TouchReadings.of_hand(hand, deployment, numbers)
    learnt = [learn(hand, deployment, model, row, others, counts) for row in range(model.size) if counts]
    touched_at = {
        (k, truth.link): truth
        for k in others
        for truth in hand.truth(REST_S + k * STEP_S + SAMPLE_S)
    }  # fmt: skip
    oracles = [
        PadOracle.build(drawn, deployment, hand_name, pad, model.noise_a[row])
        for row, (hand_name, pad) in enumerate(deployment.pads)
    ]
    parts: dict[str, list[Estimates]] = {"position": [], "force": []}
    for step, contacts_before in enumerate((0, *counts)):
        if contacts_before:
            for row in range(model.size):
                calibration = learnt[row][step - 1].calibration
                if calibration:
                    model.set_calibration(row, calibration)
        contacts = readings.contacts(model, stated)
        for row, (_, pad) in enumerate(deployment.pads):
            oracle = oracles[row]
            if contacts_before:
                oracle = oracle.with_contacts(
                    true_contacts(touched_at, pad.link, learnt[row][step - 1].touches),
                    contact_noise_a(model, row),
                )
            found = [
                (contacts.get(key), truth) for key, truth in readings.truths.items() if key[1] == pad.link
            ]
            position, force = compare(
                found,
                oracle,
                {
                    "world": name,
                    "state": state_after(contacts_before),
                    "pad": f"{number}/{pad.link}",
                    "sheet": pad.sheet,
                    "sheet kind": kind.name if (kind := drawn.sheet_kind(pad.sheet)) else "ideal",
                },
            )
            parts["position"].append(position)
            parts["force"].append(force)
    return {quantity: concatenate(some) for quantity, some in parts.items()}


def true_contacts(truths: Mapping[Key, GroundTruth], link: str, touches: Sequence[int]) -> FloatArray:
    """Return arc lengths [m] and forces [N] of these touches of a pad, (3, k)."""
    every = [truths[number, link] for number in touches]
    return np.array([(truth.u_m, truth.v_m, truth.force_n) for truth in every]).T


UNITS = {"position": ("mm", 1e3), "force": ("N", 1.0)}


def rows_of(parts: Mapping[str, Estimates], quantity: str) -> list[dict[str, Any]]:
    return [
        {"case": name, **EstimateScore.of_estimates(part).row(UNITS[quantity][1])}
        for name, part in parts.items()
    ]


def add_tables(report: Report, found: Mapping[str, Mapping[str, Estimates]]) -> None:
    """Add all tables to the report."""
    report.table("Sharpness by contacts", sharpness(found))
    for quantity in UNITS:
        every = {name: found[name][quantity] for name in found}
        parts = {
            f"{name}, {state}": by_state[state]
            for name, by_state in ((name, dict(slices(both, "state"))) for name, both in every.items())
            for state in STATES
            if state in by_state
        }
        report.table(quantity.capitalize(), rows_of(parts, quantity))
        for by in SLICES:
            cut = {
                f"{name}, {value}": part
                for name in NAMED
                for value, part in slices(dict(slices(every[name], "state"))[CONFIGURED], by)
            }
            report.table(f"{quantity.capitalize()} by {by}", rows_of(cut, quantity))
    radius = dict(slices(found["radius"]["force"], "state"))[CONFIGURED]
    cut = {
        f"{sheet}, {value}": part
        for sheet, own in slices(radius, "sheet")
        for value, part in slices(own, "force")
    }
    report.table("Force with hidden radius alone", rows_of(cut, "force"))


def sharpness(found: Mapping[str, Mapping[str, Estimates]]) -> list[dict[str, Any]]:
    """Return rows: median stated standard deviation over the oracle's, in the world `default`."""
    rows = []
    for contacts in (0, *LEARNT):
        row: dict[str, Any] = {"contacts before": contacts}
        for quantity, (unit, factor) in UNITS.items():
            every = found["default"][quantity]
            score = EstimateScore.of_estimates(every.where(every.columns["state"] == state_after(contacts)))
            row |= {
                f"{quantity}, median std, {unit}": factor * score.median_std,
                f"oracle, {unit}": factor * score.oracle_std,
                f"{quantity}, ratio": score.median_std / score.oracle_std,
            }
        rows.append(row)
    return rows


def main() -> None:
    parser = options(__doc__)
    parser.add_argument(
        "--hands", type=int, default=8, help="of each named world; half as many of the others"
    )
    parser.add_argument("--touches", type=int, default=20, help="of each pad")
    asked = parser.parse_args()
    if asked.quick:
        asked.hands, asked.touches = 1, 2
    learnt = {name: LEARNT if name == "default" else LEARNT[:1] for name in NAMED}
    names, few = (*NAMED, *SINGLE), (asked.hands + 1) // 2
    tasks = [
        (name, number, asked.touches, learnt.get(name, ()))
        for name in names
        for number in range(asked.hands if name in NAMED else few)
    ]
    made: dict[str, list[dict[str, Estimates]]] = {name: [] for name in names}
    with ProcessPoolExecutor(os.cpu_count() or 1) as pool:
        for task, result in zip(tasks, pool.map(play, tasks), strict=True):
            made[task[0]].append(result)
            print(f"{task[0]}: hand {task[1] + 1}", flush=True)
    found = {
        name: {quantity: concatenate([part[quantity] for part in parts]) for quantity in UNITS}
        for name, parts in made.items()
    }
    report = Report(asked.quick, hands=asked.hands, touches_of_a_pad=asked.touches)
    add_tables(report, found)
    report.keep()


if __name__ == "__main__":
    main()
