"""Contact laws learned without weights: from joint torques in static grasps, and from a held object's weight.

The fingers of the shipped hand in a [world](../worlds.md), seeds of the reporting family, touch with four
fingertips in random postures, with 0.3 to 5 N each and tangential forces within a friction of 0.5, for 4 s
every 15 s, read after 2 s. The contact resistance of their sheets is 1.5 times that of the file. Torques
follow from MuJoCo's Jacobians at the true contacts, with errors of 5 mN m; joints are off by 2 mrad, contacts
by 0.2 mm and by their mounts. *With the weight*: the sum of all forces is that of a held object, of a mass
known to 1 g. The laws of the four pads are fitted as by `handtouch calibrate PAD --grasps`. *Error*: of the
forces of 24 other contacts, rms relative to what the sheet's stated behaviour leaves of each, which contains
the sheet's scatter and the contacts' unknown radii; median of the pads. *Exact forces*: the same readings by
the true forces. *Interval*: half the 95 % interval of alpha; *holds*: the hidden alpha is in it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from benchmarks.page import Report, options, progress
from benchmarks.scores import Share
from handtouch import config
from handtouch.calibration.calibration import LawParameters
from handtouch.config import shipped
from handtouch.core.pad_model import law_of
from handtouch.hand.urdf import read_urdf
from handtouch.host.units import GRAVITY_M_S2
from handtouch.procedures.calibrate.fit import LawFit, fit_law
from handtouch.procedures.calibrate.grasps import StaticGrasp, grasp_readings
from handtouch.procedures.calibrate.readings import PadCircuitModel, Weight, WeightReading, with_responses
from handtouch.procedures.calibrate.report import reported_force
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, Family

FloatArray = NDArray[np.float64]
LINKS = ("thumb_distal", "index_distal", "middle_distal", "ring_distal")
SEEDS, COUNTS, TESTS = (1, 2, 3), (8, 16, 32, 64), 24
PERIOD_S, HELD_S, READ_S = 15.0, 4.0, 2.0
TORQUE_STD_NM, JOINT_STD_RAD, PLACE_STD_M, FRICTION, HELD_STD_KG = 0.005, 0.002, 2e-4, 0.5, 1e-3
RADIUS_STD = 0.2
POSITION_STD_M, OHM_RATIO = 5e-4, 1.5
Row = dict[str, Any]


class GraspedHand(NamedTuple):
    """A hand as stated, with its grasps: by torques, and by torques and weight; readings by true forces and
    hidden alphas, by link."""

    deployment: config.Deployment
    by_torques: list[StaticGrasp]
    with_weight: list[StaticGrasp]
    exact: dict[str, list[WeightReading]]
    alphas: dict[str, float]


def grasped(name: str, seed: int, count: int) -> GraspedHand:
    """Return a hand of a world with `count` grasps."""
    world = WORLDS[name].draw(Family.REPORTING.seed(seed))
    deployment = world.describe(config.load(shipped.path("utah_mit.toml")))
    urdf = deployment.hands[0].urdf
    assert urdf is not None
    model = mujoco.MjModel.from_xml_path(urdf)
    rng = np.random.default_rng((seed, 4))
    touches = tuple(
        ScenarioTouch(
            link=link,
            from_s=PERIOD_S * number,
            duration_s=HELD_S,
            ramp_s=0.1,
            path=((float(x), float(y)),),
            force_n=(float(force),),
        )
        for number in range(count)
        for link, (x, y), force in zip(
            LINKS,
            rng.uniform(0.25, 0.75, (4, 2)),
            np.exp(rng.uniform(np.log(0.3), np.log(5.0), 4)),
            strict=True,
        )
    )
    hand = VirtualHand(deployment, Scenario(touch=touches), world)
    sheets = {
        name: sheet.model_copy(update={"contact_ohm_mm2": sheet.contact_ohm_mm2 / OHM_RATIO})
        for name, sheet in deployment.sheets.items()
    }
    made = GraspedHand(
        deployment.model_copy(update={"sheets": sheets}), [], [], {link: [] for link in LINKS},
        {row.pad.link: row.sheet.alpha for row in hand.virtual_pads if row.pad.link in LINKS},
    )  # fmt: skip
    for number in range(count):
        _add_grasp(made, model, hand, number * PERIOD_S, rng)
    return made


def _add_grasp(
    made: GraspedHand, model: mujoco.MjModel, hand: VirtualHand, began_s: float, rng: np.random.Generator
) -> None:
    """Append a grasp with its torques, and the readings by true forces."""
    data = mujoco.MjData(model)
    names = [model.joint(k).name for k in range(model.njnt)]
    low, high = model.jnt_range.T
    data.qpos[:] = rng.uniform(low + 0.1 * (high - low), high - 0.1 * (high - low))
    mujoco.mj_forward(model, data)
    torque, total, contacts = np.zeros(model.nv), np.zeros(3), []
    for truth in hand.truth(began_s + READ_S):
        body = model.body(truth.link).id
        rotation = data.xmat[body].reshape(3, 3)
        at, normal = data.xpos[body] + rotation @ truth.position_m, rotation @ truth.normal
        aside = np.cross(normal, rng.normal(size=3))
        aside *= FRICTION * math.sqrt(rng.uniform()) * truth.force_n / np.linalg.norm(aside)
        force = aside - truth.force_n * normal
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jacobian, None, at, body)
        torque -= jacobian.T @ force
        total += force
        current_a = float(np.sum(truth.currents_a))
        place = np.array(truth.stated_position_m) + rng.normal(0, PLACE_STD_M, 3)
        pad_m = truth.u_m + rng.normal(0, PLACE_STD_M), truth.v_m + rng.normal(0, PLACE_STD_M)
        contacts.append({
            "link": truth.link, "position_m": tuple(place.tolist()), "normal": tuple(truth.normal),
            "pad_m": pad_m, "total_current_a": current_a,
            "force_n": truth.force_n * math.exp(0.3 * rng.normal()),
        })  # fmt: skip
        weight = Weight(truth.force_n, stated_radius_m(made.deployment, truth.link), "")
        made.exact[truth.link].append(
            WeightReading(
                weight, current_a, 1e-3 * current_a, 1, pad_m,
                unloaded_s=began_s - PERIOD_S + HELD_S, loaded_s=began_s, measured_s=began_s + READ_S,
            )
        )  # fmt: skip
    joints = data.qpos + rng.normal(0, JOINT_STD_RAD, model.nq)
    torque += rng.normal(0, TORQUE_STD_NM, model.nv)
    grasp = StaticGrasp.model_validate({
        "joints": dict(zip(names, joints.tolist(), strict=True)), "contacts": tuple(contacts),
        "torque_nm": dict(zip(names, torque.tolist(), strict=True)), "torque_std_nm": TORQUE_STD_NM,
        "began_s": began_s, "t_s": began_s + READ_S, "ended_s": began_s + HELD_S,
    })  # fmt: skip
    held_kg = float(np.linalg.norm(total)) / GRAVITY_M_S2 + HELD_STD_KG * rng.normal()
    down = tuple((total / np.linalg.norm(total)).tolist())
    made.by_torques.append(grasp)
    made.with_weight.append(
        grasp.model_copy(update={"held_kg": max(held_kg, 0.0), "held_std_kg": HELD_STD_KG, "gravity": down})
    )


def stated_radius_m(deployment: config.Deployment, link: str) -> float:
    """Return the stated contact radius of a link's pad."""
    return deployment.sheet_of(_pad(deployment, link)).contact_radius_mm * 1e-3


def _pad(deployment: config.Deployment, link: str) -> config.Pad:
    return next(pad for _, pad in deployment.pads if pad.link == link)


def fitted(model: PadCircuitModel, readings: Sequence[WeightReading]) -> LawFit | None:
    """Return the law of readings; None where they determine none."""
    readings = with_responses(model.sheet, readings)
    circuits = [model.circuit_at(reading.position_m, POSITION_STD_M) for reading in readings]
    try:
        fit = fit_law(readings, circuits, law_of(model.sheet), model.sheet.reference_kpa * 1e3, RADIUS_STD)
    except ValueError:
        return None
    return None if fit.problems else fit


def force_error(model: PadCircuitModel, law: LawParameters, readings: Sequence[WeightReading]) -> float:
    """Return the rms relative error of forces under a law."""
    errors = [
        reported_force(law, model.sheet, reading, model.circuit_at(reading.position_m)) / reading.apparent_n
        - 1
        for reading in readings
    ]
    return float(np.sqrt(np.mean(np.square(errors))))


def rows_of(hands: Sequence[GraspedHand], counts: Sequence[int], tests: int) -> list[Row]:
    """Return the rows of a world."""
    cases = [("file's law", 0), *((kind, n) for kind in ("torques", "torques and weight") for n in counts)]
    cases.append(("exact forces", counts[-1]))
    found = []
    for kind, count in cases:
        errors, halves, holds, used, pads = [], [], [], 0, 0
        for hand in hands:
            robot = read_urdf(Path(hand.deployment.hands[0].urdf or ""))
            for link in LINKS:
                model = PadCircuitModel(hand.deployment, _pad(hand.deployment, link))
                test = with_responses(model.sheet, hand.exact[link])[-tests:]
                pads += 1
                if not count:
                    errors.append(force_error(model, law_of(model.sheet), test))
                    continue
                readings = hand.exact[link][:count]
                if kind != "exact forces":
                    grasps = hand.by_torques if kind == "torques" else hand.with_weight
                    radius_m = stated_radius_m(hand.deployment, link)
                    readings = grasp_readings(robot, grasps[:count], link, radius_m)
                used += len(readings)
                if (fit := fitted(model, readings)) is not None:
                    errors.append(force_error(model, fit.law, test))
                    interval = fit.intervals["alpha"]
                    halves.append((interval.high - interval.low) / 2)
                    holds.append(interval.low < hand.alphas[link] < interval.high)
        found.append({
            "forces by": kind, "grasps": count, "readings a pad": used / pads,
            "law found, %": Share(len(errors), pads),
            "force error, rms %": 100 * float(np.median(errors)) if errors else None,
            "alpha, +-": float(np.median(halves)) if halves else None,
            "holds, %": Share(sum(holds), len(holds)) if holds else None,
        })  # fmt: skip
    return found


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--world", choices=[*WORLDS], action="append", help="default: all")
    args = parser.parse_args()
    seeds, counts, tests = (SEEDS[:1], COUNTS[:2], 4) if args.quick else (SEEDS, COUNTS, TESTS)
    for name in args.world or WORLDS:
        hands = []
        for seed in seeds:
            hands.append(grasped(name, seed, counts[-1] + tests))
            progress(f"{name}: hand {seed}")
        report = Report(args.quick, part=name, pads=4 * len(hands))
        report.table("Laws", rows_of(hands, counts, tests))
        report.keep()


if __name__ == "__main__":
    main()
