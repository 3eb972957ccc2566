"""The tables of docs/firmware.md state what the theory gives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from docs.firmware_tables import BANDWIDTH_HZ, error_rows, feedback_ohm, location_shift_m
from handtouch import config
from handtouch.canbus.bus.load import burst_s, frame_bits
from handtouch.config import shipped
from handtouch.hand.expected_error import PadDesign, expected_error, pad_design

PAGE = Path(__file__).parents[2] / "docs" / "firmware.md"


@pytest.fixture(scope="module")
def deployment() -> config.Deployment:
    return config.load(shipped.path("utah_mit.toml"))


@pytest.fixture(scope="module")
def pad(deployment: config.Deployment) -> PadDesign:
    return pad_design(deployment)


def test_the_first_order_shift_is_that_of_the_estimator(pad: PadDesign) -> None:
    """One channel reads 1 % too much: the most likely position moves by as much."""

    def one_channel(currents: np.ndarray) -> np.ndarray:
        errors = np.zeros((1, *currents.shape))
        errors[0, 1] = 0.01 * currents[1]
        return errors

    steps = np.linspace(0.1, 0.9, 15)
    x, y = np.meshgrid(steps * pad.network.a, steps * pad.network.b)
    fractions = pad.network.fractions(x, y)
    fractions[1] *= 1.01
    located = pad.network.estimate(fractions, 1e-4)
    sx, sy = np.broadcast_to(pad.surface.scales(x, y), (2, *x.shape))
    shift = np.hypot((located.x - x) * sx, (located.y - y) * sy)
    assert location_shift_m(pad, 1.0, one_channel) == pytest.approx(float(np.median(shift)), rel=0.02)


def test_a_shift_is_proportional_to_the_error_and_independent_of_the_force(pad: PadDesign) -> None:
    def gains(share: float) -> float:
        return location_shift_m(pad, 1.0, lambda currents: share * np.eye(4)[:, :, None, None] * currents)

    assert gains(0.02) == pytest.approx(2 * gains(0.01))
    light = location_shift_m(pad, 0.1, lambda i: 0.01 * np.eye(4)[:, :, None, None] * i)
    assert light == pytest.approx(gains(0.01))


def test_equal_errors_of_all_channels_shift_nothing(pad: PadDesign) -> None:
    """Noise of the drive is common to the four channels."""
    assert location_shift_m(pad, 1.0, lambda currents: 0.01 * currents[None]) < 1e-12


def test_noise_of_a_count_costs_the_bound_of_the_design(pad: PadDesign) -> None:
    (row,) = [row for row in error_rows(pad) if row[0] == "noise of 1 count"]
    step_a = pad.full_scale_a / 2**15
    steps = np.linspace(0.1, 0.9, 25)
    x, y = np.meshgrid(steps * pad.network.a, steps * pad.network.b)
    bound = np.median(expected_error(pad, 1.0, x, y)[0]) * step_a / pad.noise_a
    assert row[3] == f"{1e6 * bound:.2g} um"


def test_the_figures_in_the_text_follow_from_bus_and_electronics(
    deployment: config.Deployment, pad: PadDesign
) -> None:
    page = " ".join(PAGE.read_text(encoding="utf-8").split())
    daemon, bus = deployment.daemon, deployment.buses[0]
    burst_ms = 1e3 * burst_s(bus.bitrate_bit_s, len(deployment.pads))
    window_ms = daemon.sample_window_fraction * daemon.sync_period_ms
    capacitor_nf = 1e9 / (2 * np.pi * feedback_ohm(pad) * BANDWIDTH_HZ)
    for text in (
        f"{len(deployment.pads)} TPDOs take {burst_ms:.1f} ms at 1 Mbit/s",
        f"{window_ms:g} ms of {daemon.sync_period_ms:g} ms",
        f"in the mailbox {window_ms - burst_ms:.1f} ms after SYNC",
        f"the SYNC frame, {frame_bits(0)} us at 1 Mbit/s, and the TPDO, {frame_bits(8)} us",
        f"R {feedback_ohm(pad):.0f} ohm",
        f"C {capacitor_nf:.0f} nF",
        f"handtouch writes {deployment.nodes['four_channel'].heartbeat_ms} ms, and a node is lost after "
        f"{deployment.nodes['four_channel'].heartbeat_timeout_ms} ms",
        f"{1e3 * pad.surface.length_m:.0f} mm by {1e3 * pad.surface.arc_rad * pad.surface.radius_m:.0f} mm",  # type: ignore[attr-defined]
    ):
        assert text in page
