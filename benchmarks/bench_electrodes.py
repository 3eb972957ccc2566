"""Measure intervals of pads with any number of electrodes, and two contacts at once, in worlds.

The pads of config/electrodes.toml, with three and six electrodes, with hidden quantities drawn for seeds of
the reporting family. Touches anywhere on them, and pairs of touches on the pad with six, go through the
daemon's own pipeline; one sample of each is compared. Prints its tables and writes
docs/benchmarks/electrodes.md and electrodes.json.
"""

from __future__ import annotations

import json
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from benchmarks.bench_worlds import UNITS, WARM_UP, drawn_world, with_stated_touches
from benchmarks.hand_touches import (
    FORCES_N,
    REST_S,
    SAMPLE_S,
    STEP_S,
    TOUCH_S,
    TouchReadings,
    draw_touches,
    estimates,
    force_error,
    position_error,
    serve,
    tangent_basis,
)
from benchmarks.linear_pads import LinearPads, squared_deviation
from benchmarks.page import made_by, options, output_folder, table
from benchmarks.scores import ClusterShare, Estimates, EstimateScore, bin_labels, concatenate, slices
from handtouch import wire
from handtouch.config import Deployment, load, shipped
from handtouch.core.pad_model import PadModel
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.truth import GroundTruth
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import DrawnWorld

ERRORS = {"position": position_error, "force": force_error}
WORLDS = ("default", "harsh")
PAIRED = "middle"
PAIR_FORCES_N = (0.3, 3.0)
DISTANCES_MM = (8.0, 12.0, 16.0)
LINEAR_TOTALS_A = (0.6e-3, 2.5e-3)
LINEAR = (10, 5)
"""Single contacts and pairs of each pad whose currents are of first order."""
LINEAR_PER_TASK = 25


@dataclass(frozen=True)
class Played:
    """Estimates of a finger's touches by quantity; which touches of the paired pad were reported as two."""

    estimates: dict[str, Estimates]
    false_pairs: list[bool]


@dataclass(frozen=True)
class PlayedPair:
    """Two touches at once: distance, whether two were reported, and of each, squared deviations of position
    and force from the truth, errors [m, N], NaN without a force, and standard deviation of the position [m].
    """

    finger: int
    distance_mm: float
    reported: bool
    position: tuple[float, ...] = ()
    force: tuple[float, ...] = ()
    error_m: tuple[float, ...] = ()
    error_n: tuple[float, ...] = ()
    std_m: tuple[float, ...] = ()


def play(world: str, number: int, touches: int) -> Played:
    """Return estimates of position and force of a drawn finger."""
    drawn = drawn_world(world, number)
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
            "finger": np.full(len(found), number),
        }
        bound_m = np.array([truth.bound_m for _, truth in found])
        for quantity, error in ERRORS.items():
            errors = [error(*pair) for pair in found]
            unknown = np.full((len(found), len(errors[0][0]), len(errors[0][0])), np.nan)
            bound = bound_m if quantity == "position" else np.full(len(found), np.nan)
            parts[quantity].append(estimates(errors, bound, unknown, columns))
    pairs = [bool(contact.parts) for (_, link), contact in contacts.items() if link == PAIRED]
    return Played({quantity: concatenate(some) for quantity, some in parts.items()}, pairs)


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
    return [_compare_pair(finger, contact, truths) for contact, truths in found]


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


def _compare_pair(finger: int, contact: wire.Contact | None, truths: list[GroundTruth]) -> PlayedPair:
    """Compare two reported contacts with the true ones that they are nearer to."""
    true_m = np.array([truth.position_m for truth in truths])
    distance_mm = 1e3 * float(np.linalg.norm(true_m[1] - true_m[0]))
    if contact is None or not contact.parts:
        return PlayedPair(finger, distance_mm, False)
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
    return PlayedPair(finger, distance_mm, True, *zip(*rows, strict=True))


def play_linear(numbers: range, touches: int, pairs: int) -> tuple[list[tuple[int, float]], list[PlayedPair]]:
    """Return finger and squared deviation of single contacts, and pairs, on pads drawn in `default` whose
    currents follow from their parts to first order."""
    first = drawn_world("default", numbers.start)
    first = DrawnWorld(first.world.with_sheets(), first.seed)
    stated = with_stated_touches(first.describe(load(shipped.path("electrodes.toml"))), first)
    row = [pad.link for _, pad in stated.pads].index(PAIRED)
    pads, singles, found = LinearPads(stated, row), [], []
    low, high = np.log(LINEAR_TOTALS_A)
    for number in numbers:
        drawn = drawn_world("default", number)
        rng = np.random.default_rng((drawn.seed, 7))
        s, t = rng.uniform(0.05, 0.95, (2, touches + pairs, 2))
        totals = np.exp(rng.uniform(low, high, (touches + pairs, 2)))
        totals[:touches, 1] = 0.0
        currents = pads.draw_currents(drawn, s, t, totals, rng)
        true_m = pads.position_m(s, t)
        for k, sample in enumerate(currents.T):
            position_m, covariance_m2, parts = pads.solve(sample)
            if k < touches:
                singles.append((number, squared_deviation(position_m - true_m[k, 0], covariance_m2)))
                continue
            distance_mm = 1e3 * float(np.linalg.norm(true_m[k, 1] - true_m[k, 0]))
            if np.isnan(parts[0, 0]):
                found.append(PlayedPair(number, distance_mm, False))
                continue
            at, truth, unknown = parts[:, :3], true_m[k], (np.nan, np.nan)
            if np.linalg.norm(at - truth, axis=1).sum() > np.linalg.norm(at - truth[::-1], axis=1).sum():
                truth = truth[::-1]
            errors = at - truth
            squares = [
                squared_deviation(error, part[6:15].reshape(3, 3))
                for error, part in zip(errors, parts, strict=True)
            ]
            lengths = np.linalg.norm(errors, axis=1).tolist()
            std_m = np.sqrt(parts[:, [6, 10, 14]].sum(axis=1)).tolist()
            found.append(
                PlayedPair(
                    number, distance_mm, True, tuple(squares), unknown, tuple(lengths), unknown, tuple(std_m)
                )
            )
    return singles, found


def linear_rows(singles: list[tuple[int, float]]) -> list[dict[str, Any]]:
    """Return the shares of single contacts in their regions."""
    finger, square = (np.array(column) for column in zip(*singles, strict=True))
    row: dict[str, Any] = {"contacts": len(singles)}
    for level in (0.5, 0.9, 0.95, 0.99):
        row[f"in {100 * level:g} %"] = share_of(square < -2 * np.log(1 - level), finger)
    in_region = np.array([np.mean(square[finger == one] < 5.991) for one in np.unique(finger)])
    row["fingers below 85 % in 95 %, %"] = f"{100 * np.mean(in_region < 0.85):.1f}"
    return [row]


def pair_rows(pairs: list[PlayedPair]) -> list[dict[str, Any]]:
    """Return shares of pairs reported, and of these in their regions, by distance."""
    labels = bin_labels(np.array([pair.distance_mm for pair in pairs]), DISTANCES_MM, "mm")
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
            rows.append({"": name, **row})
    return rows


def share_of(hits: NDArray[np.bool_], finger: NDArray[Any]) -> str:
    """Return a share with the interval that the scatter between fingers gives."""
    return str(ClusterShare.of_mask(hits, finger)) if len(np.unique(finger)) > 1 else "-"


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--hands", type=int, default=40)
    parser.add_argument("--touches", type=int, default=16, help="of each pad")
    parser.add_argument("--paired", type=int, default=40, help="fingers with pairs of touches")
    parser.add_argument("--pairs", type=int, default=8, help="of each paired finger")
    parser.add_argument("--linear", type=int, default=200, help="pads whose currents are of first order")
    asked = parser.parse_args()
    if asked.quick:
        asked.hands, asked.touches, asked.paired, asked.pairs, asked.linear = 2, 3, 2, 6, 8
    page = ["# Intervals of pads with other numbers of electrodes", "", f"{made_by()}.", ""]
    page += [HEAD.format(hands=asked.hands, touches=asked.touches, low=FORCES_N[0], high=FORCES_N[1]), ""]
    record: dict[str, Any] = {}
    for world in WORLDS:
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
            text = f"As configured. Errors and deviations in {UNITS[quantity][0]}."
            page += table(f"{quantity.capitalize()} in `{world}`", text, rows_of(every, quantity))
            for pad, part in slices(every, "pad"):
                record[f"{world}, {pad}, {quantity}"] = asdict(EstimateScore.of_estimates(part))
        false = np.array([one for finger in made for one in finger.false_pairs])
        text = PAIRS.format(
            low=PAIR_FORCES_N[0],
            high=PAIR_FORCES_N[1],
            false=int(false.sum()),
            touches=len(false),
            fingers=asked.paired,
        )
        rows = pair_rows(pairs)
        page += table(f"Two contacts at once in `{world}`", text, rows)
        record[f"{world}, pairs"] = rows
        record[f"{world}, touches reported as two"] = [int(false.sum()), len(false)]
    starts = range(0, asked.linear, LINEAR_PER_TASK)
    singles, pairs = [], []
    with ProcessPoolExecutor(min(len(starts), os.cpu_count() or 1)) as pool:
        ranges = [range(start, min(start + LINEAR_PER_TASK, asked.linear)) for start in starts]
        for some, more in pool.map(play_linear, ranges, *([count] * len(ranges) for count in LINEAR)):
            singles += some
            pairs += more
    text = LINEAR_TEXT.format(pads=asked.linear, contacts=LINEAR[0], pairs=LINEAR[1])
    contacts = linear_rows(singles)
    page += table("Many pads in `default`", text, contacts)
    rows = [
        {name: value for name, value in row.items() if "force" not in name and ", N" not in name}
        for row in pair_rows(pairs)
    ]
    page += table("Two contacts at once on many pads in `default`", LINEAR_PAIRS, rows)
    record["many pads"] = {"contacts": contacts, "pairs": rows}
    out = output_folder(asked.quick)
    (out / "electrodes.md").write_text("\n".join(page))
    (out / "electrodes.json").write_text(json.dumps(record, indent=1).replace("NaN", "null") + "\n")


HEAD = """\
{hands} fingers of [electrodes.toml](../../config/electrodes.toml) drawn in the [worlds](../worlds.md)
`default` and `harsh`, seeds of the reporting family; {touches} touches of each pad, {low:g} to {high:g} N
(log-uniform), at uniform positions of the drawing's rectangle from 2 % of a side inside its edges; else as in
[worlds](worlds.md). Touches of one pad share its parts: intervals are of touches on these pads, but those
"of fingers", which follow from how they differ."""
PAIRS = """\
Two touches at once on the pad with six electrodes, {low:g} to {high:g} N each, at uniform positions from 5 %
of a side inside its edges; parts of {fingers} fingers, sheets without creep and hysteresis, for
which forces of two contacts aren't compensated. Reported at a false-alarm rate of 0.1 %; of the {touches}
single touches above {false} were reported as two. Intervals are of fingers."""

LINEAR_TEXT = """\
A few fingers can't show coverage: what moves the contacts of one pad is the same for all of them, so that
whole pads lie inside or outside of their regions. Here {pads} pads with six electrodes are drawn, of the same
seeds, with {contacts} single contacts and {pairs} pairs each. Their currents follow from gaps, gains,
anisotropy and size to first order of the daemon's model, without solving their sheets; total currents are
log-uniform, 0.6 to 2.5 mA, without drift. It shows whether the likelihood and its covariance are those of
such parts; errors of the model are in the tables above."""
LINEAR_PAIRS = "As the table above, positions alone."


if __name__ == "__main__":
    main()
