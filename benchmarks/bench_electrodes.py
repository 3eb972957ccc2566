"""Intervals of pads with other numbers of electrodes, and two contacts at once.

The pads of [electrodes.toml](../../config/electrodes.toml), with three and six electrodes, with hidden
quantities drawn for seeds of the reporting family. Touches of 0.2 to 12 N (log-uniform) anywhere on a pad's
rectangle from 2 % of a side inside its edges, and pairs of touches on the pad with six, go through the
daemon's own pipeline; one sample of each is compared, else as in [worlds](worlds.md). Touches of one pad
share its parts: intervals are of touches on these pads, but those "of fingers" and of pairs, which follow
from how they differ.

*Two contacts at once*: 0.3 to 3 N each, at uniform positions from 5 % of a side inside the edges; sheets
without creep and hysteresis, for which forces of two contacts aren't compensated; reported at a false-alarm
rate of 0.1 %. *Unequal*: those whose forces differ by a factor of 3 and more.

*Many electrodes*, a part of its own (`ARGS="--part many"`): plane pads of 24 x 18 mm with 5, 8, 12 and 16
equal electrodes along their whole edge, gaps of 0.4 mm; world `default`, as configured and with the gains
learned from 48 more touches.
"""

from __future__ import annotations

import os
from argparse import Namespace
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from benchmarks.bench_worlds import (
    DRAWN_MORE,
    DRAWN_PER_LEARNT,
    UNITS,
    WARM_UP,
    drawn_world,
    learn,
    with_stated_touches,
)
from benchmarks.hand_touches import (
    REST_S,
    SAMPLE_S,
    STEP_S,
    TOUCH_S,
    Key,
    TouchReadings,
    draw_touches,
    estimates,
    force_error,
    position_error,
    serve,
    tangent_basis,
)
from benchmarks.page import Report, options, progress
from benchmarks.scores import ClusterShare, Estimates, EstimateScore, Share, bin_labels, concatenate, slices
from handtouch import wire
from handtouch.config import Deployment, load, parse, shipped
from handtouch.core.pad_model import PadModel
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.truth import GroundTruth
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, DrawnWorld, Family, MountSpread

ERRORS = {"position": position_error, "force": force_error}
REPORTED = ("default", "harsh")
PAIRED = "middle"
PAIR_FORCES_N = (0.3, 3.0)
DISTANCES_MM = (8.0, 12.0, 16.0)
UNEQUAL = 3.0
MANY, LEARNT, RECTANGLE_MM = (5, 8, 12, 16), 48, (24.0, 18.0)
_RECTANGLE_HEAD = """
[daemon]
sync_period_ms = 10.0
[[bus]]
name = "can0"
interface = "udp_multicast"
channel = "239.74.163.2"
[sheet.soft]
ohm_per_square = 2400.0
contact_ohm_mm2 = 12_000.0
alpha = 1.5
contact_radius_mm = 1.5
contact_radius_std_mm = 0.15
[[hand]]
name = "finger"
"""


@dataclass(frozen=True)
class Played:
    """Estimates of a finger's touches by quantity; which touches of the paired pad were reported as two."""

    estimates: dict[str, Estimates]
    false_pairs: list[bool]


@dataclass(frozen=True)
class PlayedPair:
    """Two touches at once: distance, whether two were reported, larger over smaller true force.

    And of each, squared deviations of position and force from the truth, errors [m, N], NaN without a force,
    and standard deviation of the position [m].
    """

    finger: int
    distance_mm: float
    reported: bool
    force_ratio: float
    position: tuple[float, ...] = ()
    force: tuple[float, ...] = ()
    error_m: tuple[float, ...] = ()
    error_n: tuple[float, ...] = ()
    std_m: tuple[float, ...] = ()


def rectangle_deployment(counts: Sequence[int]) -> Deployment:
    """Return plane pads of so many equal electrodes along their whole edge."""
    length, width = RECTANGLE_MM
    text = [_RECTANGLE_HEAD]
    for number, count in enumerate(counts, 1):
        ends = np.linspace(0.0, 2 * (length + width), count + 1)
        arcs = ", ".join(f"e{k} = [{ends[k]:.4f}, {ends[k + 1]:.4f}]" for k in range(count))
        channels = ", ".join(f'"0x6401:{k + 1}"' for k in range(count))
        text.append(
            f"[node.n{count}]\nchannels = [{channels}]\ndrive_v = 5.0\nfull_scale_ma = 10.0\n"
            f'noise_counts = 1.0\n[[hand.pad]]\nlink = "pad{count}"\nbus = "can0"\n'
            f'node_id = {number}\nserial = {number}\nnode = "n{count}"\nsheet = "soft"\n'
            f"gap_mm = 0.4\nelectrode_arcs_mm = {{ {arcs} }}\nseries_ohm = {[20.0] * count}\n"
            f'[hand.pad.surface]\nkind = "outline"\noutline_x_mm = [0.0, {length}, {length}, 0.0]\n'
            f"outline_y_mm = [0.0, 0.0, {width}, {width}]\nedge_turn_deg = [0.0, 0.0, 0.0, 0.0]\n"
            f"corners_mm = [0.0, {length}, {length + width}, {2 * length + width}]\n"
        )
    return parse("".join(text))


def estimates_without_oracle(
    found: Sequence[tuple[wire.Contact | None, GroundTruth]], columns: Mapping[str, NDArray[Any]]
) -> dict[str, Estimates]:
    """Return estimates of position, with its bound, and force of touches (n,) by quantity."""
    bound_m, made = np.array([truth.bound_m for _, truth in found]), {}
    for quantity, error in ERRORS.items():
        errors = [error(*pair) for pair in found]
        unknown = np.full((len(found), len(errors[0][0]), len(errors[0][0])), np.nan)
        bound = bound_m if quantity == "position" else np.full(len(found), np.nan)
        made[quantity] = estimates(errors, bound, unknown, columns)
    return made


def play_many(number: int, touches: int, counts: Sequence[int]) -> Estimates:
    """Return estimates of the position on rectangles with many electrodes, in each state."""
    drawn = replace(WORLDS["default"], mounts=MountSpread()).draw(Family.REPORTING.seed(number))
    deployment = drawn.describe(rectangle_deployment(counts))
    model, numbers = PadModel(deployment), range(WARM_UP, WARM_UP + touches)
    others = range(numbers.stop, numbers.stop + round(DRAWN_PER_LEARNT * LEARNT) + DRAWN_MORE)
    stimulus = Scenario(touch=draw_touches(model.links, others.stop, drawn.seed))
    hand = VirtualHand(deployment, stimulus, drawn)
    readings, parts = TouchReadings.of_hand(hand, deployment, numbers), list[Estimates]()
    for state in ("as configured", f"after {LEARNT} contacts"):
        if parts:
            for row in range(model.size):
                if calibration := learn(hand, deployment, model, row, others, (LEARNT,))[0].calibration:
                    model.set_calibration(row, calibration)
        contacts = readings.contacts(model, deployment)
        for row, link in enumerate(model.links):
            found = [(contacts.get(key), truth) for key, truth in readings.truths.items() if key[1] == link]
            case = f"{model.electrode_counts[row]:2d} electrodes, {state}"
            columns = {"case": np.full(len(found), case), "finger": np.full(len(found), number)}
            unknown = np.full((len(found), 2, 2), np.nan)
            errors = [position_error(*pair) for pair in found]
            parts.append(estimates(errors, np.array([t.bound_m for _, t in found]), unknown, columns))
    return concatenate(parts)


def play(world: str, number: int, touches: int) -> Played:
    """Return estimates of position and force of a drawn finger."""
    drawn = drawn_world(world, number)
    deployment = drawn.describe(load(shipped.path("electrodes.toml")))
    stated = with_stated_touches(deployment, drawn)
    model, numbers = PadModel(stated), range(WARM_UP, WARM_UP + touches)
    stimulus = Scenario(touch=draw_touches(model.links, numbers.stop, drawn.seed))
    readings = TouchReadings.of_hand(VirtualHand(deployment, stimulus, drawn), deployment, numbers)
    contacts = readings.contacts(model, stated)
    pairs = [bool(contact.parts) for (_, link), contact in contacts.items() if link == PAIRED]
    return Played(estimates_of_finger(model, contacts, readings.truths, number, "electrodes"), pairs)


def estimates_of_finger(
    model: PadModel,
    contacts: Mapping[Key, wire.Contact],
    truths: Mapping[Key, GroundTruth],
    number: int,
    channels: str,
) -> dict[str, Estimates]:
    """Return estimates of position and force of a finger's touches, by pad with its number of `channels`."""
    parts: dict[str, list[Estimates]] = {quantity: [] for quantity in ERRORS}
    for row, link in enumerate(model.links):
        found = [(contacts.get(key), truth) for key, truth in truths.items() if key[1] == link]
        true_n = np.array([truth.force_n for _, truth in found])
        columns = {
            "pad": np.full(len(found), f"{link}, {model.electrode_counts[row]} {channels}"),
            "force": bin_labels(true_n, (0.5, 2.0, 5.0), "N"),
            "finger": np.full(len(found), number),
        }
        for quantity, own in estimates_without_oracle(found, columns).items():
            parts[quantity].append(own)
    return {quantity: concatenate(some) for quantity, some in parts.items()}


def play_pairs(world: str, finger: int, count: int) -> list[PlayedPair]:
    """Return pairs of touches at once on the pad with six electrodes of a drawn finger, ideal sheets."""
    drawn = drawn_world(world, finger)
    drawn = DrawnWorld(drawn.world.with_sheets(), drawn.seed)
    deployment = drawn.describe(load(shipped.path("electrodes.toml")))
    stated = with_stated_touches(deployment, drawn)
    model, rng = PadModel(stated), np.random.default_rng((drawn.seed, 6))
    low, high = np.log(PAIR_FORCES_N)
    touches = tuple(
        ScenarioTouch(
            link=PAIRED,
            from_s=REST_S + number * STEP_S,
            duration_s=TOUCH_S,
            path=((float(x), float(y)),),
            force_n=(float(np.exp(force)),),
        )
        for number in range(count)
        for (x, y), force in zip(rng.uniform(0.05, 0.95, (2, 2)), rng.uniform(low, high, 2), strict=True)
    )
    hand = VirtualHand(deployment, Scenario(touch=touches), drawn)
    found = _serve_pairs(model, stated, hand, count)
    return [compare_pair(finger, contact, truths) for contact, truths in found]


def play_finger(world: str, number: int, touches: int, pairs: int) -> tuple[Played, list[PlayedPair]]:
    """Return estimates of single touches and of so many pairs of one drawn finger, whose sheets are solved
    once for both."""
    return play(world, number, touches), play_pairs(world, number, pairs) if pairs else []


def _serve_pairs(
    model: PadModel, deployment: Deployment, hand: VirtualHand, count: int
) -> list[tuple[wire.Contact | None, list[GroundTruth]]]:
    """Return the contact of each pair's sample, and its true touches."""
    period_s = deployment.daemon.sync_period_ms * 1e-3
    times_s = period_s * np.arange(round((REST_S + count * STEP_S) / period_s))
    counts = np.zeros((len(times_s), model.size, model.channels), np.int64)
    for row, electrodes in enumerate(model.electrodes):
        counts[:, row, : len(electrodes)] = hand.counts(row, times_s)
    ticks = {round((REST_S + k * STEP_S + SAMPLE_S) / period_s): k for k in range(count)}
    contacts = serve(model, deployment, counts, ticks)
    return [(contacts.get((k, PAIRED)), list(hand.truth(float(times_s[tick])))) for tick, k in ticks.items()]


def compare_pair(finger: int, contact: wire.Contact | None, truths: list[GroundTruth]) -> PlayedPair:
    """Compare two reported contacts with the true ones that they are nearer to."""
    true_m = np.array([truth.position_m for truth in truths])
    distance_mm = 1e3 * float(np.linalg.norm(true_m[1] - true_m[0]))
    small, large = sorted(truth.force_n for truth in truths)
    if contact is None or not contact.parts:
        return PlayedPair(finger, distance_mm, False, large / small)
    at = np.array([part["position_m"] for part in contact.parts])
    kept, crossed = (np.linalg.norm(at - true_m[order], axis=1).sum() for order in ([0, 1], [1, 0]))
    rows = []
    for part, truth in zip(contact.parts, truths if kept <= crossed else truths[::-1], strict=True):
        across = tangent_basis(np.array(part["normal"]))
        error = across @ np.subtract(part["position_m"], truth.position_m)
        on_pad = np.subtract(part["covariance_m2"], contact.mount_covariance_m2 or 0.0)
        covariance = across @ on_pad.reshape(3, 3) @ across.T
        force = (np.nan if part["force_n"] is None else part["force_n"]) - truth.force_n
        std_n = np.nan if part["force_std_n"] is None else part["force_std_n"]
        squares = float(error @ np.linalg.solve(covariance, error)), float((force / std_n) ** 2)
        rows.append(
            (*squares, float(np.linalg.norm(error)), float(force), float(np.sqrt(covariance.trace())))
        )
    return PlayedPair(finger, distance_mm, True, large / small, *zip(*rows, strict=True))


def pair_rows(pairs: list[PlayedPair], distances_mm: Sequence[float] = DISTANCES_MM) -> list[dict[str, Any]]:
    """Return shares of pairs reported, and of these in their regions, by distance."""
    labels = bin_labels(np.array([pair.distance_mm for pair in pairs]), distances_mm, "mm")
    rows = []
    for label in sorted(set(labels.tolist())):
        own = [pair for pair, of in zip(pairs, labels.tolist(), strict=True) if of == label]
        fingers = np.array([pair.finger for pair in own])
        some = [pair for pair in own if pair.reported]
        twice = np.repeat([pair.finger for pair in some], 2)
        position, force, error_m, error_n, std_m = (
            np.array([value for pair in some for value in getattr(pair, name)])
            for name in ("position", "force", "error_m", "error_n", "std_m")
        )
        known = np.isfinite(force)
        rows.append(
            {
                "distance": label,
                "pairs": len(own),
                "reported as two, %": share_of(np.array([p.reported for p in own]), fingers),
                "positions in 95 %": share_of(position < 5.991, twice),
                "median error, mm": f"{1e3 * np.median(error_m):.3g}" if len(error_m) else "-",
                "median std, mm": f"{1e3 * np.median(std_m):.3g}" if len(std_m) else "-",
                "greatest, mm": f"{1e3 * error_m.max():.3g}" if len(error_m) else "-",
                "forces in 95 %": share_of(force[known] < 3.841, twice[known]),
                "median error, N": f"{np.median(np.abs(error_n[known])):.3g}" if known.any() else "-",
            }
        )
    return rows


def rows_of(every: Estimates, quantity: str) -> list[dict[str, Any]]:
    """Return the scores of each pad, and of each pad by force."""
    rows = []
    for pad, own in slices(every, "pad"):
        cut = {pad: own, **{f"{pad}, {force}": part for force, part in slices(own, "force")}}
        for name, part in cut.items():
            row = EstimateScore.of_estimates(part).row(UNITS[quantity][1], bounds=False)
            hits = part.where(part.valid)
            row["in 95 %, of fingers"] = share_of(hits.stated_levels() <= 0.95, hits.columns["finger"])
            rows.append({"case": name, **row})
    return rows


def share_of(hits: NDArray[np.bool_], finger: NDArray[Any]) -> ClusterShare | None:
    """Return a share with the interval that the scatter between fingers gives."""
    return ClusterShare.of_mask(hits, finger) if len(np.unique(finger)) > 1 else None


def measure_many(asked: Namespace) -> None:
    """Measure pads with many electrodes."""
    fingers, touches, counts = (1, 4, MANY[:2]) if asked.quick else (asked.many, asked.touches, MANY)
    report = Report(asked.quick, "many", fingers=fingers, touches_of_a_pad=touches)
    made = []
    for number in range(fingers):
        made.append(play_many(number, touches, counts))
        progress(f"many electrodes: finger {number + 1} of {fingers}")
    rows = []
    for case, own in slices(concatenate(made), "case"):
        valid = own.where(own.valid)
        row = EstimateScore.of_estimates(own).row(UNITS["position"][1], bounds=False)
        row["in 95 %, of fingers"] = share_of(valid.stated_levels() <= 0.95, valid.columns["finger"])
        rows.append({"case": case.strip(), **row})
    report.table("Position by number of electrodes in `default`", rows)
    report.keep()


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--part", choices=["", "many"], help="by default both")
    parser.add_argument("--many", type=int, default=6, help="fingers with many electrodes")
    parser.add_argument("--hands", type=int, default=40)
    parser.add_argument("--touches", type=int, default=16, help="of each pad")
    parser.add_argument("--paired", type=int, default=40, help="fingers with pairs of touches")
    parser.add_argument("--pairs", type=int, default=8, help="of each paired finger")
    asked = parser.parse_args()
    if asked.part != "":
        measure_many(asked)
    if asked.part != "many":
        measure_fingers(asked)


def measure_fingers(asked: Namespace) -> None:
    """Measure the pads with three and six electrodes."""
    if asked.quick:
        asked.hands, asked.touches, asked.paired, asked.pairs = 2, 3, 2, 6
    report = Report(
        asked.quick, hands=asked.hands, touches_of_a_pad=asked.touches, pairs_of_fingers=asked.paired
    )
    for world in REPORTED:
        made, pairs = [], []
        with ProcessPoolExecutor(min(asked.hands, os.cpu_count() or 1)) as pool:
            tasks = [
                pool.submit(play_finger, world, number, asked.touches, asked.pairs * (number < asked.paired))
                for number in range(asked.hands)
            ]
            for number, task in enumerate(tasks):
                played, played_pairs = task.result()
                made.append(played)
                pairs += played_pairs
                print(f"{world}: finger {number + 1} of {asked.hands}", flush=True)
        found = {
            quantity: concatenate([finger.estimates[quantity] for finger in made]) for quantity in ERRORS
        }
        for quantity, every in found.items():
            report.table(f"{quantity.capitalize()} in `{world}`", rows_of(every, quantity))
        false = np.array([one for finger in made for one in finger.false_pairs])
        report.table(f"Two contacts at once in `{world}`", pair_rows(pairs))
        unequal = [pair for pair in pairs if pair.force_ratio >= UNEQUAL]
        report.table(f"Unequal ones in `{world}`", pair_rows(unequal))
        report.table(f"Single contacts reported as two in `{world}`", [{"share, %": Share.of_mask(false)}])
    report.keep()


if __name__ == "__main__":
    main()
