"""Detection of presses in samples, and statistics of channels at rest."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from handtouch import config
from handtouch.config import shipped
from handtouch.procedures.commission.press import (
    Press,
    PressDetector,
    RestStatistics,
    find_rest_problems,
    find_reversed_channels,
    reacting_channels,
)
from handtouch.procedures.commission.press_instructions import describe_position, describe_press

PERIOD_NS = 5_000_000
Counts = NDArray[np.int64]


class Line:
    """A detector for some pads with noise of 1 count, fed for some time with what is pressed."""

    def __init__(self, pads: int = 3, seed: int = 1, offset: float = 0.0) -> None:
        self.detector = PressDetector(np.full((pads, 4), offset), np.ones(pads))
        self.alive = np.ones(pads, bool)
        self._rng = np.random.default_rng(seed)
        self._offset = offset
        self._pads, self._t_ns = pads, 0

    def feed(self, seconds: float, **pressed: list[float]) -> list[Press]:
        """Presses found while pads, by names such as p1, carry these currents."""
        found = []
        for _ in range(round(seconds * 1e9 / PERIOD_NS)):
            counts = self._offset + self._rng.standard_normal((self._pads, 4))
            for name, currents in pressed.items():
                counts[int(name[1:])] += currents
            self._t_ns += PERIOD_NS
            press = self.detector.detect_press(self._t_ns, np.rint(counts).astype(np.int64), self.alive)
            if press is not None:
                found.append(press)
        return found


def test_press_is_detected_once_until_release() -> None:
    line = Line(offset=40.0)
    assert line.feed(0.5) == []
    (press,) = line.feed(2.0, p1=[800, 200, 300, 100])
    assert (press.slot, press.other_slots) == (1, ())
    assert press.counts == pytest.approx([800, 200, 300, 100], abs=2)
    assert line.feed(0.5) == []
    assert [press.slot for press in line.feed(0.5, p2=[0, 900, 0, 100])] == [2]


def test_short_and_light_touches_are_ignored() -> None:
    line = Line()
    line.feed(0.5)
    for _ in range(5):
        assert line.feed(0.2, p0=[800, 200, 300, 100]) == []
        assert line.feed(0.2) == []
    assert line.feed(3.0, p0=[20, 20, 20, 20]) == []


def test_initial_press_counts_only_after_release() -> None:
    line = Line()
    assert line.feed(2.0, p0=[800, 200, 300, 100]) == []
    assert line.detector.pressed_slots == [0]
    line.feed(0.3)
    assert len(line.feed(0.5, p0=[800, 200, 300, 100])) == 1


def test_pads_pressed_together_are_reported_without_faint_neighbours() -> None:
    line = Line()
    line.feed(0.5)
    (both,) = line.feed(0.5, p0=[800, 200, 300, 100], p2=[100, 300, 100, 100])
    assert (both.slot, both.other_slots) == (0, (2,))
    line.feed(0.5)
    (one,) = line.feed(0.5, p0=[8000, 200, 300, 100], p2=[30, 40, 30, 30])
    assert one.other_slots == ()


def test_baseline_tracks_drift_but_no_press() -> None:
    line = Line(pads=1)
    line.feed(0.5)
    for drift in np.linspace(0, 60, 200).tolist():
        assert line.feed(0.02, p0=[drift] * 4) == []
    before = line.detector.baseline.copy()
    line.feed(0.25, p0=[2000.0, 900, 900, 900])
    assert line.detector.baseline == pytest.approx(before, abs=3)


def test_late_pad_starts_from_its_first_sample() -> None:
    line = Line(offset=500.0)
    line.detector.baseline[1] = np.nan
    line.alive[1] = False
    assert line.feed(0.5) == []
    line.alive[1] = True
    assert line.feed(1.0) == []
    assert [press.slot for press in line.feed(0.5, p1=[800, 200, 300, 100])] == [1]


def test_lasting_load_can_become_the_baseline() -> None:
    line = Line()
    line.feed(0.5, p0=[300.0] * 4)
    line.detector.reset_baseline()
    assert line.feed(0.5, p0=[300.0] * 4) == []
    assert [press.slot for press in line.feed(0.5, p0=[300.0] * 4, p1=[500.0] * 4)] == [1]


@given(
    st.integers(0, 2),
    st.lists(st.floats(0, 5000), min_size=4, max_size=4).filter(lambda c: sum(c) > 200),
    st.integers(0, 1000),
)
@settings(max_examples=30, deadline=None)
def test_pressed_pad_is_the_one_reported(slot: int, currents: list[float], seed: int) -> None:
    line = Line(seed=seed)
    line.feed(0.4)
    (press,) = line.feed(0.5, **{f"p{slot}": currents})
    assert press.slot == slot
    assert press.counts == pytest.approx(currents, abs=3)


def rest(channels: list[tuple[float, float]], seed: int = 1) -> RestStatistics:
    """From means and standard deviations of the channels."""
    noise = np.random.default_rng(seed).standard_normal((200, 4))
    return RestStatistics.from_counts(np.rint([m for m, _ in channels] + noise * [s for _, s in channels]))


def test_healthy_pad_has_no_problems() -> None:
    for seed in range(50):
        assert find_rest_problems(rest([(0, 1.0)] * 4, seed), 1.0) == []


def test_stuck_noisy_offset_and_negative_channels_are_named() -> None:
    findings = find_rest_problems(rest([(250, 0.0), (0, 4.0), (60, 1.0), (-60, 1.0)]), 1.0)
    assert [str(finding) for finding in findings] == [
        "channel 1 is stuck at 250 counts: broken input or amplifier",
        f"channel 2 is noisy: {rest([(0, 0), (0, 4.0), (0, 0), (0, 0)]).std[1]:.1f} counts, "
        "noise_counts = 1 is configured",
        "channel 3 has an offset of +60 counts at rest",
        "channel 4 has a negative reading of -60 counts at rest",
    ]


def test_quiet_channel_is_not_stuck() -> None:
    assert find_rest_problems(rest([(0, 0.05)] * 4), 0.1) == []


def test_touch_during_rest_is_detected() -> None:
    counts = np.zeros((100, 4))
    counts[50:] = 900
    assert RestStatistics.from_counts(counts).was_touched(1.0)
    assert not rest([(300, 1.0)] * 4).was_touched(1.0)


def test_reversed_and_silent_channels_are_reported() -> None:
    presses = [Press(0, np.array([500.0, -300.0, 2.0, 40.0])), Press(0, np.array([9.0, -30.0, 1.0, 4.0]))]
    assert [finding.channel for finding in find_reversed_channels(presses, 1.0)] == [1]
    assert reacting_channels(presses, 1.0).tolist() == [True, True, False, True]


DEPLOYMENT = config.load(shipped.path("utah_mit.toml"))
PADS = {pad.link: pad for pad in DEPLOYMENT.hands[0].pads}


def test_descriptions_name_ends_sides_edges_and_tips_by_axes() -> None:
    assert (
        describe_position(PADS["thumb_proximal"], "xa")
        == "the end towards +x of the link, away from its origin"
    )
    assert (
        describe_position(PADS["thumb_proximal"], "x0") == "the end towards -x of the link, near its origin"
    )
    assert describe_position(PADS["thumb_proximal"], "yb") == "the side towards +y of the link"
    assert (
        describe_position(PADS["thumb_distal"], "xa")
        == "the tip towards +x of the link, away from its origin"
    )
    assert describe_position(PADS["thumb_distal"], "x0") == "the rim towards -x of the link, near its origin"
    assert describe_position(PADS["palm_heel"], "y0") == "the edge towards -y of the link"
    cone = PADS["thumb_middle"].surface.model_copy(update={"far_radius_mm": 6.0})
    sharp = PADS["thumb_middle"].model_copy(update={"surface": cone})
    assert describe_position(sharp, "xa").startswith("the narrow end")
    assert describe_position(sharp, "x0").startswith("the wide end")


def test_descriptions_follow_the_mount() -> None:
    mount = config.Mount(position_mm=(26.0, 0.0, 12.5), rpy_deg=(0.0, 0.0, 90.0))
    turned = PADS["palm_heel"].model_copy(update={"mount": mount})
    assert "+y" in describe_position(turned, "xa")
    assert "-x" in describe_position(turned, "yb")
    tilted = mount.model_copy(update={"rpy_deg": (0.0, 45.0, 0.0)})
    assert "+x and -z" in describe_position(PADS["palm_heel"].model_copy(update={"mount": tilted}), "xa")


def test_instructions_give_the_position_in_millimetres() -> None:
    pad = PADS["palm_heel"]  # 36 by 56 mm, its middle at (22, 8, 14)
    assert describe_press(pad, "xa").endswith("in the middle across (about x 35, y 8, z 14 mm)")
    assert describe_press(pad, "yb").endswith("in the middle lengthwise (about x 22, y 28, z 14 mm)")
