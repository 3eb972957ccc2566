"""A sheet replaced without its node: contacts until it is reported, and reports without one.

Pads of two shapes (20 x 20 and 36 x 20 mm) in each [world](../worlds.md), seeds of the reporting family, are
calibrated by ordinary contacts: 0.5 to 5 N anywhere, a minute apart, so that temperature drifts for hours.
Then as many contacts again follow, on the same sheet and on another one of the same world, whose gaps, sides,
waves, resistances and law are drawn anew; the node and its gains stay. *Reported*: `sheet_replaced` is among
the diagnoses of the pad by then; *on the same sheet*: pads of which it was at any time. A window of contacts
begins with the change, as after a start of the daemon.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from benchmarks import bench_swap
from benchmarks.page import Report, options, progress
from benchmarks.scores import Share
from handtouch import config
from handtouch.calibration.auto_calibration import AutoCalibrator
from handtouch.calibration.gains import PartModels
from handtouch.calibration.stationary_contacts import StationaryContact, StationaryContactDetector
from handtouch.core.pad_model import PadModel, ampere_per_count_of, noise_counts_of
from handtouch.hand import channel_gain_std, pad_channels, part_stds
from handtouch.simulate.stimulus import NodeReplacement
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, Family, MountSpread

SEEDS = {"ideal": (1,), "default": (1, 2), "harsh": (1,)}
UNITS = 4
"""Pads of each shape of a seed."""
CONTACTS = 128
"""On the calibrated sheet, then again after the change."""
STEP_S, PERIOD_S = 60.0, 1e-9 * bench_swap.PERIOD_NS
BASELINE_S = 0.05
"""Between the samples before a contact whose mean is its baseline."""
COUNTS = (32, 64, 96, 128)
_SERIAL = 1


def contacts(
    hand: VirtualHand, row: int, deployment: config.Deployment, numbers: range
) -> Iterator[StationaryContact]:
    """Yield the stationary contacts of a pad, of these numbers."""
    pad = hand.pads[row][1]
    scale = np.array(ampere_per_count_of(pad, deployment))
    detector = StationaryContactDetector(noise_counts_of(deployment.nodes[pad.node]) * scale)
    ticks = (np.arange(bench_swap.TICKS + 1) + 0.5) * PERIOD_S
    for number in numbers:
        times_s = (number + 1) * STEP_S + ticks
        before = hand.counts(row, times_s[0] - BASELINE_S * np.arange(1, 17))
        currents = (hand.counts(row, times_s) - before.mean(axis=0)) * scale
        for tick, (t_s, sample) in enumerate(zip(times_s.tolist(), currents, strict=True)):
            found = detector.add_sample((number + 1) * (tick < bench_swap.TICKS), sample, round(1e9 * t_s))
            if found is not None:
                yield found


def calibrator(
    deployment: config.Deployment, pad: config.Pad, parts: dict[str, PartModels]
) -> AutoCalibrator:
    """Return the calibration of a pad's node, without one of its own."""
    node, sheet = deployment.nodes[pad.node], deployment.sheet_of(pad)
    model = pad_channels(pad, sheet, node)
    if str(pad.surface) not in parts:
        parts[str(pad.surface)] = PartModels.of_pad(model, pad, node, sheet)
    stds = part_stds(pad, node, sheet)
    made = AutoCalibrator(model, parts[str(pad.surface)], stds, channel_gain_std(pad, node))
    made.assign_node(_SERIAL, None, None, "", 0)
    return made


def reported_after(calibration: AutoCalibrator, more: Iterator[StationaryContact]) -> int | None:
    """Return the number of contacts after which another sheet is first reported, None if it never is."""
    for number, contact in enumerate(more, 1):
        calibration.add_contact(contact)
        if calibration.sheet_replaced:
            return number
    return None


def run(name: str, seed: int, units: int) -> list[tuple[int | None, int | None]]:
    """Return, for each pad, after how many contacts a sheet is reported: on another one, on the same one."""
    world = replace(WORLDS[name], mounts=MountSpread()).draw(Family.REPORTING.seed(seed))
    deployment = world.describe(bench_swap.deployment_of(units))
    scenario = bench_swap.touches(PadModel(deployment), 2 * CONTACTS, seed, STEP_S, STEP_S)
    links = [pad.link for _, pad in deployment.pads]
    change = [NodeReplacement(link=link, at_s=(CONTACTS + 0.5) * STEP_S, sheet=2) for link in links]
    same = VirtualHand(deployment, scenario, world)
    new = VirtualHand(deployment, scenario.model_copy(update={"node_replacements": tuple(change)}), world)
    found, parts = [], dict[str, PartModels]()
    for row, (_, pad) in enumerate(same.pads):
        before, later = calibrator(deployment, pad, parts), calibrator(deployment, pad, parts)
        for contact in contacts(same, row, deployment, range(CONTACTS)):
            before.add_contact(contact)
        after = []
        for hand in (new, same):
            later.assign_node(_SERIAL + 1, None, before.gains, "", round(1e9 * (CONTACTS + 0.5) * STEP_S))
            after.append(
                reported_after(later, contacts(hand, row, deployment, range(CONTACTS, 2 * CONTACTS)))
            )
        found.append((after[0], after[1]))
        progress(f"{name} {seed}: {pad.link}: {found[-1]}")
    return found


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--world", choices=[*WORLDS], action="append", help="default: all")
    args = parser.parse_args()
    for name in args.world or WORLDS:
        seeds, units = (SEEDS[name][:1], 1) if args.quick else (SEEDS[name], UNITS)
        pads = [pad for seed in seeds for pad in run(name, seed, units)]
        new = [pad[0] for pad in pads]
        report = Report(args.quick, part=name)
        report.table("Reported", [
            {"contacts on another sheet": count,
             "reported, %": Share(sum(after is not None and after <= count for after in new), len(pads)),
             "on the same sheet, pads": Share(
                 sum(after is not None and after <= count for _, after in pads), len(pads))}
            for count in COUNTS
        ])  # fmt: skip
        report.keep()


if __name__ == "__main__":
    main()
