"""Contacts on a pad with switched electrodes: still and moving, and two at once.

Fingers of [switched.toml](../../config/switched.toml) with hidden quantities drawn in the
[world](../worlds.md) `default`, seeds of the reporting family, on sheets without creep and hysteresis, at 100
Hz; touches of 0.3 to 6 N (log-uniform) that stand anywhere on the pad or slide along straight paths, through
the daemon's own pipeline. The tip has eight electrodes, four of them connected in each SYNC period; the
phalanx beside it, of the same size and sheet, four whole sides, which can't report two contacts. One sample
of each touch, in the middle of its path; `unreliable` positions have a wider region too. Pairs: at rest on
the switched pad, 0.3 to 3 N each, at a false-alarm rate of 0.1 %. Intervals are of fingers: contacts of one
pad share its parts.
"""

from __future__ import annotations

import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from benchmarks.bench_electrodes import PlayedPair, compare_pair, pair_rows, share_of
from benchmarks.bench_worlds import drawn_world, with_stated_touches
from benchmarks.hand_touches import REST_S, STEP_S, TOUCH_S, serve, tangent_basis
from benchmarks.page import Report, options
from benchmarks.scores import Share
from handtouch import wire
from handtouch.config import Pad, load, shipped
from handtouch.core.pad_model import PadModel
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.truth import GroundTruth
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import DrawnWorld

SPEEDS_MM_S = (0.0, 10.0, 30.0, 100.0)
FORCES_N, PAIR_FORCES_N = (0.3, 6.0), (0.3, 3.0)
SIZE_MM, PATH_MM = (24.0, 18.0), 12.0
SAMPLED_PART = 0.64
"""Of a touch, at which its sample is."""
DISTANCES_MM = (6.0, 10.0, 14.0)
Key = tuple[str, float]
"""Link and speed."""


@dataclass(frozen=True)
class Sample:
    """Error [mm] of a located contact, its squared deviation and standard deviation [mm], and if it is
    `valid`."""

    finger: int
    error_mm: float
    square: float
    std_mm: float
    valid: bool


@dataclass(frozen=True)
class Played:
    """Samples of one finger; `touches`: number played of each key; `false_pairs`: single ones reported as
    two."""

    samples: dict[Key, list[Sample]]
    touches: int
    pairs: list[PlayedPair]
    false_pairs: int


def hold_states(counts: NDArray[np.int64], pads: list[Pad]) -> None:
    """Repeat the counts (ticks, pads, c) of each state until its next sample: one state a SYNC."""
    number = np.arange(len(counts))
    for row, pad in enumerate(pads):
        for state, electrodes in enumerate(pad.state_numbers):
            last = np.maximum(number - (number - state) % len(pad.state_numbers), 0)
            counts[:, row, list(electrodes)] = counts[last][:, row, list(electrodes)]


def draw(rng: np.random.Generator, links: list[str], count: int, speed: float, first: int) -> list[Any]:
    """Return touches of each link, at rest or along straight paths of at most `PATH_MM`."""
    duration_s = min(TOUCH_S, PATH_MM / speed) if speed else TOUCH_S
    length, touches = speed * duration_s / np.array(SIZE_MM), []
    for link in links:
        for number in range(first, first + count):
            while True:
                angle = rng.uniform(0, 2 * np.pi)
                begin = rng.uniform(0.05, 0.95, 2)
                end = begin + length * (np.cos(angle), np.sin(angle))
                if (abs(end - 0.5) < 0.45).all():
                    break
            force_n = float(np.exp(rng.uniform(*np.log(FORCES_N))))
            path = (tuple(begin.tolist()), tuple(end.tolist())) if speed else (tuple(begin.tolist()),)
            from_s = REST_S + number * STEP_S
            touches.append(
                ScenarioTouch(link=link, from_s=from_s, duration_s=duration_s, path=path, force_n=(force_n,))
            )
    return touches


def play(finger: int, touches: int, pairs: int) -> Played:
    """Play the touches of every speed, and pairs of touches on the tip, of one drawn finger."""
    drawn = drawn_world("default", finger)
    drawn = DrawnWorld(drawn.world.with_sheets(), drawn.seed)
    deployment = drawn.describe(load(shipped.path("switched.toml")))
    stated, rng = with_stated_touches(deployment, drawn), np.random.default_rng((drawn.seed, 8))
    model, pads = PadModel(stated), [entry.pad for entry in deployment.pads]
    played: list[ScenarioTouch] = []
    for number, speed in enumerate(SPEEDS_MM_S):
        played += draw(rng, model.links, touches, speed, number * touches)
    first_pair = len(SPEEDS_MM_S) * touches
    low, high = np.log(PAIR_FORCES_N)
    played += [
        ScenarioTouch(
            link="tip",
            from_s=REST_S + number * STEP_S,
            duration_s=TOUCH_S,
            path=(tuple(rng.uniform(0.05, 0.95, 2).tolist()),),
            force_n=(float(np.exp(rng.uniform(low, high))),),
        )
        for number in range(first_pair, first_pair + pairs)
        for _ in range(2)
    ]
    hand = VirtualHand(deployment, Scenario(touch=tuple(played)), drawn)
    period_s = deployment.daemon.sync_period_ms * 1e-3
    times_s = period_s * np.arange(round((REST_S + (first_pair + pairs) * STEP_S) / period_s))
    counts = np.zeros((len(times_s), len(pads), model.channels), np.int64)
    for row, pad in enumerate(pads):
        counts[:, row, : len(pad.electrode_names)] = hand.counts(row, times_s)
    hold_states(counts, pads)
    ticks = {}
    for number in range(first_pair + pairs):
        speed = SPEEDS_MM_S[number // touches] if number < first_pair else 0.0
        duration_s = min(TOUCH_S, PATH_MM / speed) if speed else TOUCH_S
        ticks[round((REST_S + number * STEP_S + SAMPLED_PART * duration_s) / period_s)] = number
    found = serve(model, stated, counts, ticks)
    samples: dict[Key, list[Sample]] = {(link, v): [] for link in model.links for v in SPEEDS_MM_S}
    two, false_pairs = [], 0
    for tick, number in ticks.items():
        truths = list(hand.truth(float(times_s[tick])))
        if number >= first_pair:
            two.append(compare_pair(finger, found.get((number, "tip")), truths))
            continue
        for truth in truths:
            contact = found.get((number, truth.link))
            false_pairs += bool(contact and contact.parts)
            if contact is not None and contact.position_m is not None:
                samples[truth.link, SPEEDS_MM_S[number // touches]].append(compare(finger, contact, truth))
    return Played(samples, touches, two, false_pairs)


def compare(finger: int, contact: wire.Contact, truth: GroundTruth) -> Sample:
    """Compare a contact with the truth."""
    across = tangent_basis(np.array(contact.normal))
    error = across @ np.subtract(contact.position_m or np.nan, truth.position_m)
    on_pad = np.subtract(contact.covariance_m2 or np.full(9, np.nan), contact.mount_covariance_m2 or 0.0)
    covariance = across @ on_pad.reshape(3, 3) @ across.T
    square = float(error @ np.linalg.solve(covariance, error))
    valid = contact.position_status == "valid"
    return Sample(
        finger, 1e3 * float(np.linalg.norm(error)), square, 1e3 * float(np.sqrt(covariance.trace())), valid
    )


def in_region(some: list[Sample]) -> Any:
    """Return the share of samples within their 95 % region."""
    return share_of(np.array([one.square < 5.991 for one in some]), np.array([one.finger for one in some]))


def single_rows(played: list[Played]) -> list[dict[str, Any]]:
    """Return errors and coverage by speed and pad."""
    rows = []
    for speed in SPEEDS_MM_S:
        for link, name in (("tip", "switched"), ("middle", "four whole sides")):
            some = [sample for one in played for sample in one.samples[link, speed]]
            valid = [sample for sample in some if sample.valid]
            rows.append(
                {
                    "speed, mm/s": f"{speed:g}",
                    "pad": name,
                    "touches": sum(one.touches for one in played),
                    "valid, %": f"{100 * len(valid) / sum(one.touches for one in played):.0f}",
                    "median error, mm": f"{np.median([one.error_mm for one in some]):.3f}",
                    "median std, mm": f"{np.median([one.std_mm for one in some]):.3f}",
                    "valid in 95 %": in_region(valid),
                    "located in 95 %": in_region(some),
                }
            )
    return rows


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--fingers", type=int, default=10)
    parser.add_argument("--touches", type=int, default=6, help="of each pad and speed")
    parser.add_argument("--pairs", type=int, default=8, help="of each finger")
    asked = parser.parse_args()
    if asked.quick:
        asked.fingers, asked.touches, asked.pairs = 2, 2, 3
    with ProcessPoolExecutor(min(asked.fingers, os.cpu_count() or 1)) as pool:
        count = asked.fingers
        played = list(pool.map(play, range(count), [asked.touches] * count, [asked.pairs] * count))
    report = Report(asked.quick, fingers=asked.fingers, touches_of_a_pad_and_speed=asked.touches)
    report.table("Single contacts by speed", single_rows(played))
    two = [pair for one in played for pair in one.pairs]
    report.table("Two contacts at once", pair_rows(two, DISTANCES_MM))
    total = sum(len(some) for one in played for (link, _), some in one.samples.items() if link == "tip")
    false = Share(sum(one.false_pairs for one in played), total)
    report.table("Single contacts reported as two", [{"share, %": false}])
    report.keep()


if __name__ == "__main__":
    main()
