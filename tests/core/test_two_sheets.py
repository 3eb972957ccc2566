"""Pads with two sheets: force and contact radius together, from the total currents of both."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch.config import parse
from handtouch.config.roles import channel_count
from handtouch.core.events import BaselineEvent
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.core.slab import ChannelField
from handtouch.wire import ContactRadiusStatus, ForceStatus, OutgoingMessage, PadState
from tests.deployments import EXACT_SHEET, PLAIN_SHEET, deployment_text, pad_text
from tests.sandwich import Sandwich

PERIOD_NS, START_NS = 5_000_000, 1_000_000_000
ALPHA, SECOND_ALPHA = 1.5, 1.0
SECOND = f"""
[sheet.even]
ohm_per_square = 600.0
contact_ohm_mm2 = 40000.0
alpha = {SECOND_ALPHA}
contact_radius_mm = 3.0
contact_radius_std_mm = 1.0
{{extra}}{PLAIN_SHEET}{EXACT_SHEET}
"""
PLANE = '{ kind = "plane", length_mm = 60.0, width_mm = 60.0 }'
SANDWICH = Sandwich((20_000e-6, 40_000e-6), (ALPHA, SECOND_ALPHA), (2400.0, 600.0))
CHANNELS = "channels = [" + ", ".join(f'"0x6401:{k}"' for k in range(1, 6)) + "]"


class Values(NamedTuple):
    """Values of a pad after a tick."""

    force_n: float
    force_std_n: float
    force_status: ForceStatus
    radius_m: float
    radius_std_m: float
    radius_status: ContactRadiusStatus


class Rig:
    """A pipeline whose pads are pressed in their middle; the second sheet's count may be replaced."""

    def __init__(self, extra: str = "", second_extra: str = "", pads: tuple[str, ...] = ()) -> None:
        two = pad_text("two", 1, PLANE, extra='second_sheet = "even"\nnode = "five"')
        two = two.replace('node = "n"\n', "", 1)
        text = deployment_text(two, *pads, contact_radius_mm=3.0, contact_radius_std_mm=1.0, exact_parts=True)
        text = text.replace("[sheet.s]", f"[sheet.s]\n{extra}", 1)
        five = text[text.index("[node.n]") : text.index("[sheet.s]")].replace("[node.n]", "[node.five]")
        self.deployment = parse(text + SECOND.format(extra=second_extra) + five + CHANNELS + "\n")
        self.model = PadModel(self.deployment)
        self.pipeline = Pipeline(self.model, PERIOD_NS, 0.6, self)
        self.pipeline.node_state[:] = PadState.CLEAR
        for row, (_, pad) in enumerate(self.deployment.pads):
            count = channel_count(pad)
            layout = tuple(ChannelField(k // 4, 16 * (k % 4), 16, True) for k in range(count))
            self.pipeline.slab.set_layout(row, layout)
        self.rng, self.t_ns = np.random.default_rng(1), START_NS
        for row in range(self.model.size):
            self.pipeline.add_event(BaselineEvent(row, (0.0,) * 4, (0.1,) * 4, (), (0.0, 0.1)))

    def has_subscriber(self, topic: str) -> bool:  # noqa: ARG002
        return False

    def send(self, message: OutgoingMessage) -> None:
        raise AssertionError(message)

    @property
    def spreading_m(self) -> float:
        """Spreading radius in the middle of the first pad."""
        network = self.model.networks[0]
        return float(network.spreading_radius(network.a / 2, network.b / 2)) * 60e-3 / network.a

    def currents(self, force_n: float, radius_m: float) -> NDArray[np.float64]:
        """Return the total currents of both sheets by the law of each."""
        return SANDWICH.currents(force_n, radius_m, 5.0, self.spreading_m) if force_n else np.zeros(2)

    def is_unique(self, force_n: float, radius_m: float) -> bool:
        """Return True if no other contact passes the same currents."""
        return SANDWICH.is_unique(self.currents(force_n, radius_m), 5.0, self.spreading_m)

    def press(
        self, force_n: float, radius_m: float = 3e-3, ticks: int = 30, second: float | None = None
    ) -> Values:
        """Press all pads for some ticks; second: count that the second sheet's channel reads instead."""
        first_a, second_a = self.currents(force_n, radius_m)
        electrodes = np.full(4, first_a / 4 / self.model.ampere_per_count[0, 0])
        other = second_a / self.model.second_ampere_per_count[0]
        for _ in range(ticks):
            self.t_ns += PERIOD_NS
            self.pipeline.begin_cycle(self.t_ns, self.t_ns)
            for row, (_, pad) in enumerate(self.deployment.pads):
                count = channel_count(pad)
                exact = np.append(electrodes, other)[:count] + self.rng.normal(0.0, 0.7, count)
                counts = np.clip(np.rint(exact), -32768, 32767)
                if second is not None and count > 4:
                    counts[4] = second
                for number, first in enumerate(range(0, count, 4)):
                    data = counts[first : first + 4].astype("<i2").tobytes()
                    self.pipeline.slab.write_pdo(row, data.ljust(8, b"\0"), self.t_ns + 1, number)
            self.pipeline.tick_if_due(self.t_ns + 4 * PERIOD_NS // 5)
            self.pipeline.prepare_next_tick()
        return self.values(0)

    @property
    def channel_status(self) -> str:
        """Status of the first pad's second sheet."""
        counts = self.pipeline.tick.channel_counts
        return self.pipeline.tick.second.find_status(0, counts, self.pipeline.slab.saturated(counts))

    def values(self, pad: int) -> Values:
        columns, published = self.pipeline.tick.columns, self.pipeline.tick.columns.published
        return Values(
            float(published["force_n"][pad]),
            float(published["force_std_n"][pad]),
            ForceStatus(int(columns.force_status[pad])),
            float(published["contact_radius_m"][pad]),
            float(published["contact_radius_std_m"][pad]),
            ContactRadiusStatus(int(columns.contact_radius_status[pad])),
        )


@pytest.mark.parametrize("radius_m", [1.2e-3, 2e-3, 3e-3, 5e-3])
@pytest.mark.parametrize("force_n", [0.2, 1.0, 4.0])
def test_force_and_radius_are_those_of_the_theory_whatever_the_radius(
    force_n: float, radius_m: float
) -> None:
    rig = Rig()
    rig.press(0.0)
    found = rig.press(force_n, radius_m)
    assert found.force_status == "valid"
    assert found.radius_status == "valid"
    if rig.is_unique(force_n, radius_m):
        assert found.force_n == pytest.approx(force_n, rel=0.03)
        assert found.radius_m == pytest.approx(radius_m, rel=0.1)
    assert abs(found.force_n - force_n) < 4 * found.force_std_n + 0.02 * force_n
    assert abs(found.radius_m - radius_m) < 4 * found.radius_std_m + 0.02 * radius_m


BEHAVIOUR = """behaviour = { preset = "S1", adaptation_share = 0.0, creep_share = %.1f, creep_time_s = 0.25, \
slow_creep = 0.0, parameter_std_fraction = 0.0, press_std = 0.2, back_force_std_n = 0.0 }
"""


CREEPING = BEHAVIOUR.replace("slow_creep = 0.0", "slow_creep = 0.05").replace(
    "press_std = 0.2", "press_std = 0.01"
)


def press_creeping(creep_share: float, force_n: float, radius_m: float) -> Values:
    """Return what is published 0.5 s into a press on sheets that creep."""
    behaviour = BEHAVIOUR % creep_share
    rig = Rig(behaviour, behaviour)
    rig.press(0.0)
    for tick in range(1, 101):
        left = creep_share * np.exp(-tick * PERIOD_NS * 1e-9 / 0.25)
        found = rig.press(force_n * (1 - left), radius_m, ticks=1)
    return found


@pytest.mark.parametrize("radius_m", [1.8e-3, 4.5e-3])
def test_creep_does_not_tell_how_large_a_contact_is(radius_m: float) -> None:
    """History and current grow alike with a radius that is supposed: what two presses differ in by chance
    stays as uncertain as without creep, however long the press lasts."""
    still, creeping = (press_creeping(share, 1.0, radius_m) for share in (0.0, 0.6))
    assert still.radius_status == creeping.radius_status == "valid"
    assert creeping.radius_std_m == pytest.approx(still.radius_std_m, rel=0.05)
    assert creeping.radius_m == pytest.approx(still.radius_m, rel=0.03)
    assert creeping.force_n == pytest.approx(still.force_n, rel=0.03)


def test_force_of_one_sheet_is_wrong_where_its_radius_is() -> None:
    """What two sheets are for: the second's channel out of range leaves the first sheet's force, and
    interval."""
    rig = Rig()
    rig.press(0.0)
    both = rig.press(1.0, 5e-3)
    alone = rig.press(1.0, 5e-3, second=32767)
    assert alone.radius_status == "assumed"
    assert rig.channel_status == "saturated"
    assert alone.radius_m == pytest.approx(2.85e-3, rel=0.1)
    assert abs(alone.force_n - 1.0) > 5 * abs(both.force_n - 1.0)
    assert alone.force_std_n > 5 * both.force_std_n


def test_sheets_that_contradict_each_other_are_said_to() -> None:
    rig = Rig()
    rig.press(0.0)
    exact = float(rig.currents(1.0, 3e-3)[1] / rig.model.second_ampere_per_count[0])
    found = rig.press(1.0, second=round(0.3 * exact), ticks=20)
    assert found.radius_status == "contradictory"
    assert found.force_status == "unreliable"
    assert rig.channel_status == "contradictory"


def test_a_calibrated_law_of_the_second_sheet_is_applied_and_undone() -> None:
    rig = Rig()
    rig.press(0.0)
    before = rig.press(1.0)
    default = rig.pipeline.calibrations[0]
    law = rig.model.default_second_law(0)
    assert law is not None
    measured = replace(law, contact_ohm_mm2=1.1 * law.contact_ohm_mm2, covariance=((0.0,) * 3,) * 3)
    rig.pipeline.set_calibration(0, replace(default, calibration_id="measured", second_law=measured))
    assert rig.press(1.0).force_n == pytest.approx(1.1 * before.force_n, rel=0.03)
    rig.pipeline.set_calibration(0, default)
    assert rig.press(1.0) == pytest.approx(before, rel=1e-3)


@pytest.mark.parametrize(
    ("keys", "least_rise"), [(("law",), 1.01), (("second_law",), 1.5), (("law", "second_law"), 1.5)]
)
def test_force_is_uncertain_by_the_time_since_the_laws_of_both_sheets_were_measured(
    keys: tuple[str, ...], least_rise: float
) -> None:
    """The second sheet's law, of alpha 1, counts more, as its force doesn't depend on the radius."""
    rig = Rig(CREEPING % 0.0, CREEPING % 0.0)
    rig.press(0.0)
    file, stds = rig.pipeline.calibrations[0], []
    laws = {"law": rig.model.default_law(0), "second_law": rig.model.default_second_law(0)}
    for age_s in (1.5, 15.0):
        own = {key: replace(law, age_s=age_s) for key, law in laws.items() if law is not None and key in keys}
        measured = replace(
            file, calibration_id="measured", law=own.get("law"), second_law=own.get("second_law")
        )
        rig.pipeline.set_calibration(0, measured)
        rig.press(0.0, ticks=100)
        stds.append(rig.press(1.0, ticks=200).force_std_n)
    assert stds[1] > least_rise * stds[0]


def test_a_stuck_second_channel_is_left_out_and_taken_again_once_it_moves() -> None:
    rig = Rig()
    rig.press(0.0)
    exact = float(rig.currents(1.0, 3e-3)[1] / rig.model.second_ampere_per_count[0])
    assert rig.press(1.0, second=round(exact), ticks=150).radius_status == "valid"
    assert rig.press(1.0, second=round(exact), ticks=150).radius_status == "assumed"
    assert rig.channel_status == "stuck"
    assert rig.press(1.0).radius_status == "valid"
    assert rig.channel_status == "operational"


def test_a_dead_second_channel_leaves_the_force_of_the_first_sheet() -> None:
    rig = Rig()
    rig.press(0.0)
    assert rig.press(1.0, second=0, ticks=8).radius_status == "assumed"
    assert rig.channel_status == "operational"  # the frame may be late
    found = rig.press(1.0, second=0, ticks=60)
    assert found.radius_status == "assumed"
    assert found.force_status == "valid"
    assert rig.channel_status == "dead"


def test_a_tare_measures_the_zero_of_the_second_sheet() -> None:
    rig = Rig()
    rig.press(0.0)
    rig.pipeline.add_event(BaselineEvent(0, (0.0,) * 4, (0.1,) * 4, (), (500.0, 0.1)))
    exact = float(rig.currents(1.0, 3e-3)[1] / rig.model.second_ampere_per_count[0])
    rig.press(0.0, second=500, ticks=5)
    found = rig.press(1.0, second=round(exact) + 500)
    assert found.radius_status == "valid"
    assert found.force_n == pytest.approx(1.0, rel=0.02)


def test_a_zero_that_drifts_is_tracked_while_untouched() -> None:
    rig = Rig()
    rig.press(0.0)
    for offset in range(1, 41):  # 2 counts a second
        rig.press(0.0, ticks=100, second=offset)
    expected = rig.pipeline.tick.second._baseline.expected_counts[0, 0]
    assert expected == pytest.approx(40.0, abs=25.0)
    assert rig.pipeline.tick.state.second is not None
    assert not rig.pipeline.tick.state.second.touching[0]


def test_a_pad_with_one_sheet_gives_the_same_bits_beside_one_with_two() -> None:
    plain = (pad_text("one", 2, PLANE),)
    beside, alone = Rig(pads=plain), Rig(pads=(*plain,))
    alone.model.second_pads = alone.model.second_pads[:0]
    alone.pipeline = Pipeline(alone.model, PERIOD_NS, 0.6, alone)
    alone.pipeline.node_state[:] = PadState.CLEAR
    assert not alone.pipeline.tick.second.any_configured
    for rig in (beside, alone):
        for row, (_, pad) in enumerate(rig.deployment.pads):
            count = channel_count(pad)
            layout = tuple(ChannelField(k // 4, 16 * (k % 4), 16, True) for k in range(count))
            rig.pipeline.slab.set_layout(row, layout)
            if rig is alone:
                rig.pipeline.add_event(BaselineEvent(row, (0.0,) * 4, (0.1,) * 4))
    for force_n in (0.0, 0.5, 3.0):
        for rig in (beside, alone):
            rig.press(force_n, ticks=10)
        assert beside.values(1) == alone.values(1) or force_n == 0.0
    assert beside.values(1).radius_status == "assumed"
    states = [rig.pipeline.tick.columns.values[1].tobytes() for rig in (beside, alone)]
    assert states[0] == states[1]


def test_a_saved_state_continues_to_the_same_bits() -> None:
    rig, other = Rig(), Rig()
    rig.press(0.0)
    rig.press(2.0, 4e-3, ticks=10)
    other.press(0.0, ticks=1)
    other.pipeline.load_state(rig.pipeline.save_state(), rig.pipeline.state.layout())
    other.t_ns, other.rng = rig.t_ns, np.random.default_rng(5)
    other.pipeline.cycle.sync_ns = rig.pipeline.cycle.sync_ns
    rig.rng = np.random.default_rng(5)
    found = [one.press(2.5, 4e-3, ticks=10) for one in (rig, other)]
    assert found[0] == found[1]
    assert rig.pipeline.save_state() == other.pipeline.save_state()


def test_a_state_without_second_sheets_is_refused() -> None:
    rig = Rig()
    other: Any = Pipeline(PadModel(parse(deployment_text(pad_text("two", 1)))), PERIOD_NS, 0.6, rig)
    with pytest.raises(ValueError, match="second sheets"):
        other.load_state(rig.pipeline.save_state(), rig.pipeline.state.layout())
