"""Contacts on another sheet than the calibrated one are reported; those on the same sheet aren't."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from handtouch.calibration.auto_calibration import AutoCalibrator, GainUpdate
from handtouch.calibration.gains import PartModels
from handtouch.calibration.stationary_contacts import StationaryContact, StationaryContactDetector
from handtouch.config import Sheet, parse
from handtouch.field import ElectrodeNetwork
from handtouch.hand import channel_gain_std, pad_channels, part_stds
from handtouch.hand.pads import log_aspect_std
from tests.deployments import deployment_text, pad_text

DEPLOYMENT = parse(
    deployment_text(pad_text("p", 1, '{ kind = "plane", length_mm = 20.0, width_mm = 20.0 }'), touch="")
)
PAD = DEPLOYMENT.pads[0].pad
NODE, SHEET = DEPLOYMENT.nodes[PAD.node], DEPLOYMENT.sheet_of(PAD)
ELONGATED = SHEET.model_copy(update={"contact_elongation_std": 0.4, "unevenness_std": 0.05})
"""The same sheet, stated as uneven and touched by objects that aren't round, as by default."""
STOPS, SAMPLES = 12, 10
"""Places where a slide rests, and samples at each."""


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
        yield StationaryContact(current + rng.normal(0, noise), noise, 8, round(1e9 * (from_s + k)), k)


def calibrator(stated: Sheet = SHEET) -> AutoCalibrator:
    """Return the calibration of a new node of the pad."""
    network = pad_channels(PAD, stated, NODE)
    parts = PartModels.of_pad(network, PAD, NODE, stated)
    made = AutoCalibrator(network, parts, part_stds(PAD, NODE, stated), channel_gain_std(PAD, NODE))
    made.assign_node(1, None, None, "", 0)
    return made


@pytest.fixture(scope="module")
def calibrated() -> AutoCalibrator:
    """A pad that its contacts have calibrated."""
    made = calibrator()
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


def slides(network: ElectrodeNetwork, count: int, seed: int) -> Iterator[StationaryContact]:
    """Yield the stationary contacts of slides with stops, each of an object of another shape.

    The current of an elongated contact is that of two points along it, as fractions are harmonic.
    """
    rng = np.random.default_rng(seed)
    noise = 1e-7 * np.ones(4)
    detector, sync_ns = StationaryContactDetector(noise), 0
    size = network.a / 20e-3  # the pad is 20 mm long
    for touch in range(1, count + 1):
        ends = rng.uniform(0.15, 0.85, (2, 2)) * [[network.a], [network.b]]
        ratio = math.exp(abs(rng.normal(0, ELONGATED.contact_elongation_std)))
        half = size * 0.5e-3 * SHEET.contact_radius_mm * math.sqrt(ratio - 1 / ratio)
        angle = rng.uniform(0, math.pi)
        apart = half * np.array([math.cos(angle), math.sin(angle)])
        total = rng.uniform(0.2e-3, 2e-3)
        for part in np.linspace(0, 1, STOPS):
            at = ends[:, 0] + part * (ends[:, 1] - ends[:, 0])
            mean = sum(network.fractions(*(at + sign * apart)) for sign in (-1, 1)) / 2
            for _ in range(SAMPLES):
                sync_ns += 5_000_000
                found = detector.add_sample(touch, total * mean + rng.normal(0, noise), sync_ns)
                if found is not None:
                    yield found
        sync_ns += 5_000_000
        found = detector.add_sample(0, np.zeros(4), sync_ns)
        if found is not None:
            yield found


@pytest.mark.parametrize("seed", range(8))
def test_slides_on_the_calibrated_sheet_report_no_other_one_however_many_contacts_they_are(seed: int) -> None:
    """The contacts of a slide share the error of its shape, which is no evidence of another sheet."""
    made = calibrator(ELONGATED)
    for one in slides(sheet(0.0), 24, seed):
        made.add_contact(one)
        assert not made.diagnoses
