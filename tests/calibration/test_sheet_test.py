"""Contacts on another sheet than the calibrated one are reported; those on the same sheet aren't."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from handtouch.calibration.auto_calibration import AutoCalibrator, GainUpdate
from handtouch.calibration.gains import PartModels
from handtouch.calibration.stationary_contacts import StationaryContact
from handtouch.config import parse
from handtouch.field import ElectrodeNetwork
from handtouch.hand import channel_gain_std, models_with_other_parts, pad_channels, part_limits, part_stds
from handtouch.hand.pads import log_aspect_std
from tests.deployments import deployment_text, pad_text

DEPLOYMENT = parse(
    deployment_text(pad_text("p", 1, '{ kind = "plane", length_mm = 20.0, width_mm = 20.0 }'), touch="")
)
PAD = DEPLOYMENT.pads[0].pad
NODE, SHEET = DEPLOYMENT.nodes[PAD.node], DEPLOYMENT.sheet_of(PAD)


def sheet(stds: float) -> ElectrodeNetwork:
    """Return a pad whose sides have another ratio than stated, by so many stated standard deviations."""
    network = pad_channels(PAD, SHEET, NODE)
    assert isinstance(network, ElectrodeNetwork)
    return network.stretched(math.exp(stds * log_aspect_std(PAD, SHEET)))


def contacts(network: ElectrodeNetwork, count: int, seed: int, from_s: float) -> Iterator[StationaryContact]:
    """Yield contacts anywhere on a pad, one a second, with noise."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0.1, 0.9, (2, count)) * [[network.a], [network.b]]
    total = rng.uniform(0.2e-3, 2e-3, count)
    noise = 1e-7 * np.ones(4)
    for k, current in enumerate((total * network.fractions(x, y)).T):
        yield StationaryContact(current + rng.normal(0, noise), noise, 8, round(1e9 * (from_s + k)))


@pytest.fixture(scope="module")
def calibrated() -> AutoCalibrator:
    """A pad that its contacts have calibrated."""
    network = pad_channels(PAD, SHEET, NODE)
    parts = PartModels(models_with_other_parts(network, PAD, NODE, SHEET), part_limits(PAD, NODE))
    made = AutoCalibrator(network, parts, part_stds(PAD, NODE, SHEET), channel_gain_std(PAD, NODE))
    made.assign_node(1, None, None, "", 0)
    add(made, sheet(-0.7), 96, seed=1, from_s=0.0)
    assert made.calibration_state == "calibrated"
    return made


def add(
    calibrator: AutoCalibrator, network: ElectrodeNetwork, count: int, seed: int, from_s: float
) -> list[GainUpdate]:
    return [calibrator.add_contact(one) for one in contacts(network, count, seed, from_s)]


def test_contacts_on_the_calibrated_sheet_report_nothing_and_those_on_another_one_a_new_sheet(
    calibrated: AutoCalibrator,
) -> None:
    own = calibrated.gains
    add(calibrated, sheet(-0.7), 64, seed=2, from_s=1000.0)
    assert not calibrated.diagnoses
    calibrated.apply_gains(own)
    updates = add(calibrated, sheet(0.8), 64, seed=3, from_s=2000.0)
    (diagnosis,) = calibrated.diagnoses
    assert (diagnosis.kind, diagnosis.position_valid, diagnosis.force_valid) == (
        "sheet_replaced",
        True,
        False,
    )
    assert "contacts" in diagnosis.evidence
    assert "--new-sheet" in diagnosis.remedy
    # positions are learned anew, and nothing of it is stored as the old sheet's
    assert any(update.apply for update in updates)
    assert not any(update.store for update in updates[32:])
    # an operator's gains, as of `--new-sheet` or a rollback, end it
    calibrated.apply_gains(own)
    assert not calibrated.diagnoses
