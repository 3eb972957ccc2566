"""Each fault is diagnosed by its own signature; a held object is no fault."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import lru_cache

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch import config
from handtouch.config import shipped
from handtouch.field.network import ElectrodeNetwork
from handtouch.simulate.faults import FAULTS
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, DrawnWorld, ElectronicsSpread, Fixed, Normal, World
from handtouch.supervisor.diagnose import (
    DiagnosisModel,
    HandDiagnostics,
    HandSamples,
    PadDiagnosis,
)
from handtouch.supervisor.diagnose.contact_faults import ContactFault, ContactFaultDetector
from handtouch.supervisor.diagnose.descriptions import describe_contact_fault, describe_static_load
from handtouch.supervisor.diagnose.hypotheses import ContactCurrents, Hypothesis, HypothesisTables
from handtouch.supervisor.diagnose.static_load import MIN_LOAD_COUNTS, StaticLoad
from handtouch.wire.faults import FaultKind
from tests.exact_pads import electrodes_of

PAD, SECOND = 13, 1_000_000_000
LINK = "palm_thumb"
Counts = NDArray[np.float64]
_TABLES: dict[Hashable, HypothesisTables] = {}


@lru_cache(maxsize=1)
def model() -> DiagnosisModel:
    whole = DiagnosisModel.from_deployment(config.load(shipped.path("utah_mit.toml")), "right")
    rows = slice(PAD, PAD + 2)
    return DiagnosisModel(**{name: value[rows] for name, value in vars(whole).items()})


def play(
    contacts: Callable[[float, np.random.Generator], Counts], length_s: float, seed: int = 1
) -> tuple[HandDiagnostics, list[PadDiagnosis]]:
    """Half-second blocks at 100 Hz of two pads; `contacts` gives what the first reads at a time."""
    rng, diagnosis, changes = np.random.default_rng(seed), HandDiagnostics(model(), tables=_TABLES), []
    for first in np.arange(0, length_s, 0.5):
        times = first + np.arange(50) / 100
        counts = rng.normal(size=(50, 2, 4))
        counts[:, 0] += [contacts(t, rng) for t in times]
        stamps = np.repeat(np.rint((times + 1) * SECOND).astype(np.int64)[:, None], 2, axis=1)
        read = np.clip(np.rint(counts), -32768, 32767).astype(np.int64)
        changes += diagnosis.process_block(HandSamples(stamps, read, np.ones((50, 2), np.bool_)))
    return diagnosis, changes


def run(diagnosis: HandDiagnostics, counts: Callable[[Counts], NDArray[np.int64]], length_s: float) -> None:
    """Half-second blocks at 100 Hz of counts (50, n, 4) by times (50,)."""
    for first in np.arange(0, length_s, 0.5):
        times = first + np.arange(50) / 100
        read = counts(times)
        stamps = np.repeat(np.rint((times + 1) * SECOND).astype(np.int64)[:, None], read.shape[1], axis=1)
        diagnosis.process_block(HandSamples(stamps, read, np.ones(stamps.shape, np.bool_)))


def simulate(
    fault: dict[str, object],
    length_s: float,
    series_ohm: tuple[float, ...] = (0.0,) * 4,
    world: DrawnWorld | None = None,
    *others: dict[str, object],
) -> list[PadDiagnosis]:
    """Return the diagnoses of one pad of the virtual hand, pressed all over while it has faults."""
    whole = config.load(shipped.path("utah_mit.toml"))
    (hand,) = whole.hands
    (pad,) = (pad for pad in hand.pads if pad.link == LINK)
    pad = pad.model_copy(update={"series_ohm": series_ohm})
    alone = whole.model_copy(update={"hands": (hand.model_copy(update={"pads": (pad,)}),)})
    rng = np.random.default_rng(1)
    touches = tuple(
        ScenarioTouch(
            link=LINK, from_s=at, duration_s=0.7, path=(tuple(rng.uniform(0.08, 0.92, 2)),), force_n=(2.0,)
        )
        for at in np.arange(0.5, length_s - 1, 1.0).tolist()
    )
    acting = tuple(FAULTS[str(one["kind"])].model_validate(one) for one in (fault, *others))
    world = world or WORLDS["default"].only("parts", "contacts").draw(3)
    virtual = VirtualHand(alone, Scenario(touch=touches), world, faults=acting)
    diagnosis = HandDiagnostics(DiagnosisModel.from_deployment(alone, "right"), tables=_TABLES)
    run(diagnosis, lambda times: virtual.counts(0, times)[:, None], length_s)
    return diagnosis.diagnoses()


@lru_cache(maxsize=4096)
def fractions(x: float, y: float, series_ohm: tuple[float, ...] = (0.0,) * 4) -> Counts:
    """Return the shares of the electrodes; kept, as a contact has them for many samples."""
    network = electrodes_of(model())[0].with_series_ohm(series_ohm)
    return np.asarray(network.fractions(x * network.a, y * network.b))


@lru_cache(maxsize=4096)
def press(number: int) -> Counts:
    """Return the counts of a press anywhere: the same for the same number."""
    rng = np.random.default_rng(number)
    return np.asarray(fractions(*rng.uniform(0.1, 0.9, 2)) * np.exp(rng.uniform(6, 9)))


def presses(t: float) -> Counts:
    """One a second, half a second long: the same at the same time."""
    number, part = divmod(t, 1.0)
    return np.zeros(4) if part > 0.5 else press(int(number))


def test_ordinary_presses_give_no_diagnosis() -> None:
    diagnosis, changes = play(lambda t, _: presses(t), 40)
    assert diagnosis.diagnoses() == []
    assert changes == []


@pytest.mark.parametrize("gains", [(0.96, 1, 1, 1), (0.98, 0.98, 1.02, 1.02)])
def test_gains_within_tolerance_give_no_diagnosis_after_many_contacts(
    gains: tuple[float, ...],
) -> None:
    _, changes = play(lambda t, _: presses(t) * gains, 100)
    assert changes == []


def test_offset_names_its_channel_also_while_the_pad_is_held() -> None:
    """A press of some seconds hides an offset to lower readings: another channel reads most."""

    def contacts(t: float, _: np.random.Generator) -> Counts:
        held = 420 * fractions(0.85, 0.85) if 15 < t < 22 else np.zeros(4)
        return np.asarray(held - np.array([0, 0, 0, 300 * (t > 5)]))

    _, changes = play(contacts, 30)
    assert {change.electrodes for change in changes if change.kind == FaultKind.OFFSET} == {("yb",)}


def detector(series_ohm: float = 0.0) -> ContactFaultDetector:
    """Detector of the first pad, with the tolerances that its deployment states."""
    made, network = model(), electrodes_of(model())[0].with_series_ohm([series_ohm] * 4)
    if network not in _TABLES:
        networks = (part for part in made.parts[0]() if isinstance(part, ElectrodeNetwork))
        parts = [part.with_series_ohm([series_ohm] * 4) for part in networks]
        _TABLES[network] = HypothesisTables(network, made.surfaces[0], parts)
    return ContactFaultDetector(_TABLES[network], made.gain_covariance[0])


def touch(detector: ContactFaultDetector, numbers: range, gains: tuple[float, ...] = (1, 1, 1, 1)) -> None:
    """Touch the pad anywhere, the same for the same numbers."""
    for number in numbers:
        rng = np.random.default_rng(number)
        counts = fractions(*rng.uniform(0.1, 0.9, 2)) * np.exp(rng.uniform(6, 9)) * gains
        counts += rng.normal(scale=0.5, size=4)
        position = counts[[1, 3]] / (counts[[0, 2]] + counts[[1, 3]])
        contact = ContactCurrents(number * SECOND, 1e-6 * counts, np.full(4, 5e-7), position)
        detector.add_contact(contact, np.zeros(4, dtype=np.bool_))


def test_step_within_what_tolerances_explain_is_known_by_the_contacts_before() -> None:
    """0.85 of a gain is no evidence on a pad that was never touched before."""
    always, stepped = detector(), detector()
    touch(always, range(100), (0.85, 1, 1, 1))
    assert always.fault is None
    touch(stepped, range(40))
    assert stepped.fault is None
    touch(stepped, range(40, 100), (0.85, 1, 1, 1))
    assert stepped.fault is not None
    assert stepped.fault.kind == FaultKind.GAIN_STEP


def test_gain_step_ends_when_contacts_contradict_it() -> None:
    pad = detector()
    touch(pad, range(40), (1, 1, 1.6, 1))
    assert pad.fault is not None
    assert (pad.fault.kind, pad.fault.hypothesis.electrodes) == (FaultKind.GAIN_STEP, ("y0",))
    touch(pad, range(40, 80))
    assert pad.fault is None


def test_strokes_along_the_centre_line_are_no_evidence_of_shorted_electrodes() -> None:
    """Both electrodes read the same there, shorted or not."""
    pad, network = detector(500.0), electrodes_of(model())[0].with_series_ohm([500.0] * 4)
    for number in range(60):
        y = np.random.default_rng(number).uniform(0.06, 0.94)
        counts = 3000 * network.fractions(0.5 * network.a, y * network.b)
        contact = ContactCurrents(number * SECOND, 1e-6 * counts, np.full(4, 5e-7), np.array([0.5, y]))
        pad.add_contact(contact, np.zeros(4, dtype=np.bool_))
        assert pad.fault is None


def stuck(t: float) -> Counts:
    """A constant contact from 5 s on; every fourth second another one beside it."""
    beside = fractions(0.7, 0.3) * 1500.0 if t % 4 > 3 else np.zeros(4)
    return np.asarray(fractions(0.3, 0.6) * (600.0 if t > 5 else 0.0) + beside)


def test_static_contact_that_outlasts_others_on_its_pad_is_gum() -> None:
    diagnosis, _ = play(lambda t, _: stuck(t), 60)
    (found,) = diagnosis.diagnoses()
    assert found.kind == FaultKind.GUM
    assert found.is_fault
    assert found.link == model().links[0]
    assert abs(found.published.since_ns - 6 * SECOND) <= SECOND
    assert found.published.pad_m is not None
    assert found.published.size_m is not None
    assert found.published.pad_m[0] == pytest.approx(0.3 * 0.042, abs=1e-3)
    assert found.published.pad_m[1] == pytest.approx(0.6 * 0.032, abs=1e-3)


def test_a_load_that_no_contact_explains_has_no_position() -> None:
    load = StaticLoad(0, np.array([0.5, 2.7, -9.8, -11.1]), kind=FaultKind.GUM)
    published = describe_static_load(model(), 0, load).published
    assert (published.pad_m, published.size_m) == (None, None)


def test_offset_of_a_pad_with_gum_is_diagnosed_too() -> None:
    """The gum keeps its begin and its position."""

    def contacts(t: float, _: np.random.Generator) -> Counts:
        return np.asarray(stuck(t) - np.array([0, 0, 0, 300.0 * (t > 13)]))

    diagnosis, _ = play(contacts, 60)
    offset, gum = sorted(diagnosis.diagnoses(), key=lambda found: found.kind != FaultKind.OFFSET)
    assert (offset.kind, offset.electrodes) == (FaultKind.OFFSET, ("yb",))
    assert gum.kind == FaultKind.GUM
    assert abs(gum.published.since_ns - 6 * SECOND) <= SECOND
    assert gum.published.pad_m == pytest.approx((0.3 * 0.042, 0.6 * 0.032), abs=1e-3)


def test_offset_ends_when_its_channel_returns() -> None:
    def contacts(t: float, _: np.random.Generator) -> Counts:
        return np.asarray(presses(t) + np.array([0, 400.0 * (5.7 < t < 20.7), 0, 0]))

    diagnosis, changes = play(contacts, 40)
    assert diagnosis.diagnoses() == []
    (ended,) = (change for change in changes if change.until_ns is not None)
    assert (ended.kind, ended.electrodes) == (FaultKind.OFFSET, ("xa",))


def test_moisture_after_an_offset_is_diagnosed_too() -> None:
    def contacts(t: float, _: np.random.Generator) -> Counts:
        leak = fractions(0.4, 0.4) * 2000 * max(0.0, -np.expm1(-(t - 15) / 30))
        return np.asarray(leak + np.array([0, 300.0 * (t > 3), 0, 0]))

    diagnosis, _ = play(contacts, 80)
    assert {found.kind for found in diagnosis.diagnoses()} == {FaultKind.OFFSET, FaultKind.MOISTURE}


@pytest.mark.parametrize("count", [5000.0, 1e6])
def test_gum_is_diagnosed_by_the_channels_that_are_left(count: float) -> None:
    """Of a pad with a channel that is stuck, or at the end of its range."""
    rng = np.random.default_rng(3)
    whole, diagnosis = model(), HandDiagnostics(model(), tables=_TABLES)

    def read(times: Counts) -> NDArray[np.int64]:
        counts = rng.normal(size=(len(times), len(whole.links), 4))
        counts[:, 0] += [stuck(t - 10) for t in times]
        read = np.clip(np.rint(counts), -32768, 32767).astype(np.int64)
        read[times > 2, 0, 3] = min(count, 32767)
        return read

    run(diagnosis, read, 80)
    lost = FaultKind.STUCK_CHANNEL if count < 1e5 else FaultKind.SATURATED_CHANNEL
    assert {found.kind for found in diagnosis.diagnoses()} == {lost, FaultKind.GUM}
    (gum,) = (found for found in diagnosis.diagnoses() if found.kind == FaultKind.GUM)
    assert gum.published.pad_m is None


@pytest.mark.parametrize(("x", "found"), [(0.03, set()), (0.5, {FaultKind.SATURATED_CHANNEL})])
def test_a_firm_contact_held_beside_its_electrode_is_no_saturated_channel(
    x: float, found: set[FaultKind]
) -> None:
    """Elsewhere the contact doesn't explain the channel."""

    def held(t: float, _: np.random.Generator) -> Counts:
        rng = np.random.default_rng(int(3 * t))
        contact = fractions(x, 0.5 + 0.01 * rng.normal()) * 50_000 * np.exp(0.02 * rng.normal())
        counts = contact if t > 5 else np.zeros(4)
        return np.asarray(counts + np.array([1e6 * (x == 0.5 and t > 5), 0, 0, 0]))

    diagnosis, _ = play(held, 60)
    assert {fault.kind for fault in diagnosis.diagnoses() if fault.is_fault} == found


def test_short_to_the_layer_is_distinguished_from_a_saturated_channel_of_the_same_pad() -> None:
    made, network = model(), model().networks[0]
    idle = -made.drive_v[0] * network.conductance[0] / network.sheet_ohm_per_square
    counts = np.asarray(idle / made.ampere_per_count[0])

    def contacts(t: float, _: np.random.Generator) -> Counts:
        shorted = np.array([1e6, *counts[1:]]) if t > 15 else np.zeros(4)
        return np.where([0, 0, t > 3, 0], 1e6, shorted)

    diagnosis, _ = play(contacts, 30)
    assert {(found.kind, found.electrodes) for found in diagnosis.diagnoses()} == {
        (FaultKind.SATURATED_CHANNEL, ("y0",)),
        (FaultKind.SHORTED_ELECTRODE, ("x0",)),
    }


def test_still_contact_is_no_gum_while_nothing_else_happens() -> None:
    """A robot that rests a finger on a table gives the same currents: only the probability is reported."""
    _, changes = play(lambda t, _: fractions(0.3, 0.6) * (600.0 if t > 5 else 0.0), 120)
    assert {change.kind for change in changes} == {FaultKind.STATIC_LOAD}
    first, *later = [change.published for change in changes]
    assert f"probably gum ({first.confidence:.0%})" in first.cause
    assert 0.5 < first.confidence < 0.99
    assert all(one.confidence > first.confidence + 0.1 for one in later)
    assert (first.position_valid, first.force_valid) == (True, True)
    assert not any(change.is_fault for change in changes)


def test_a_static_load_becomes_gum_once_presses_beside_it_leave_it_as_it_was() -> None:
    def contacts(t: float, _: np.random.Generator) -> Counts:
        gum = fractions(0.3, 0.6) * (600.0 if t > 5 else 0.0)
        return np.asarray(gum + (presses(t) if t > 90 else 0.0))

    diagnosis, changes = play(contacts, 120)
    assert [found.kind for found in diagnosis.diagnoses()] == [FaultKind.GUM]
    assert {change.kind for change in changes} == {FaultKind.STATIC_LOAD, FaultKind.GUM}


def test_static_contact_with_tremor_is_a_held_object() -> None:
    def held(t: float, _: np.random.Generator) -> Counts:
        rng = np.random.default_rng(int(3 * t))
        x, y = 0.4 + 0.01 * rng.normal(size=2)
        return fractions(x, y) * 2000 * np.exp(0.05 * rng.normal()) if t > 5 else np.zeros(4)

    diagnosis, _ = play(held, 40)
    (found,) = diagnosis.diagnoses()
    assert found.kind == FaultKind.HELD_OBJECT
    assert not found.is_fault


@pytest.mark.parametrize("size", [-400.0, 400.0])
def test_static_signal_of_one_channel_is_an_offset(size: float) -> None:
    diagnosis, _ = play(lambda t, _: np.array([0, size if t > 5 else 0, 0, 0]), 40)
    assert [(f.kind, f.electrodes) for f in diagnosis.diagnoses()] == [(FaultKind.OFFSET, ("xa",))]


def test_slowly_growing_leakage_is_moisture() -> None:
    diagnosis, _ = play(lambda t, _: fractions(0.4, 0.4) * 2000 * max(0.0, -np.expm1(-(t - 5) / 30)), 60)
    assert [f.kind for f in diagnosis.diagnoses()] == [FaultKind.MOISTURE]


def test_gum_on_a_sheet_that_adapts_is_no_moisture() -> None:
    """It came at once, though its current more than doubles within half a minute."""

    def contacts(t: float, _: np.random.Generator) -> Counts:
        gum = fractions(0.3, 0.6) * 600 * (1 - 1.4 * np.expm1(-(t - 5) / 10)) * (t > 5)
        return np.asarray(gum + (presses(t) if t % 4 > 3 else 0.0))

    diagnosis, changes = play(contacts, 60)
    assert {change.kind for change in changes} == {FaultKind.GUM}
    assert [found.kind for found in diagnosis.diagnoses()] == [FaultKind.GUM]


def test_moisture_ends_when_the_pad_has_dried() -> None:
    """It stays while there is a leak, also a small one, and nothing else is diagnosed meanwhile."""
    dried_s = 80 + 15 * np.log(2000 / MIN_LOAD_COUNTS)

    def contacts(t: float, _: np.random.Generator) -> Counts:
        leak = fractions(0.4, 0.4) * 2000 * max(0.0, -np.expm1(-(t - 5) / 15)) * np.exp(-max(t - 80, 0) / 15)
        return np.asarray(leak + presses(t))

    diagnosis, changes = play(contacts, dried_s + 30)
    assert diagnosis.diagnoses() == []
    assert {change.kind for change in changes} == {FaultKind.MOISTURE}
    assert changes[-1].until_ns == pytest.approx((dried_s + 1) * SECOND, abs=10 * SECOND)


def test_open_electrode_is_a_dead_electrode() -> None:
    def read(t: float, _: np.random.Generator) -> Counts:
        number, part = divmod(t, 1.0)
        place = np.random.default_rng(int(number)).uniform(0.1, 0.9, 2)
        return np.asarray(fractions(*place, (0, 0, np.inf, 0)) * 3000 * (part < 0.5))

    diagnosis, _ = play(read, 40)
    assert [(f.kind, f.electrodes) for f in diagnosis.diagnoses()] == [(FaultKind.DEAD_ELECTRODE, ("y0",))]


def loose(t: float, until_s: float = np.inf) -> Counts:
    """Presses of half a second; xa opens and closes in each of them, from 3 s on."""
    part = t % 1.0
    if not (3 < t < until_s and 0.2 < part < 0.35) or part > 0.5:
        return presses(t)
    rng = np.random.default_rng(int(t))
    shares = fractions(*rng.uniform(0.1, 0.9, 2), (0, np.inf, 0, 0))
    return np.asarray(shares * 0.95 * np.exp(rng.uniform(6, 9)))


def test_electrode_that_opens_and_closes_is_a_dead_electrode_part_of_the_time() -> None:
    _, changes = play(lambda t, _: loose(t), 30)
    (found,) = changes
    assert (found.kind, found.electrodes) == (FaultKind.DEAD_ELECTRODE, ("xa",))
    assert "electrode xa is open part of the time" in found.published.cause
    assert found.published.since_ns < 10 * SECOND
    assert not found.published.position_valid


def test_electrode_that_opens_under_a_contact_and_stays_open_is_dead() -> None:
    """Also where contacts would be those of a healthy pad: far from it."""

    def contacts(t: float, _: np.random.Generator) -> Counts:
        if t % 1.0 > 0.5:
            return np.zeros(4)
        place = np.random.default_rng(int(t)).uniform(0.1, 0.5 if t > 11 else 0.9, 2)
        return np.asarray(fractions(*place, (0, np.inf if t > 10.2 else 0, 0, 0)) * 3000)

    _, changes = play(contacts, 20)
    (found,) = changes
    assert (found.kind, found.electrodes) == (FaultKind.DEAD_ELECTRODE, ("xa",))
    assert "carries no current" in found.published.cause


def test_loose_electrode_isnt_left_out_of_the_location_of_contacts() -> None:
    """Its contacts would be located wrongly while it is connected."""
    diagnosis, _ = play(lambda t, _: loose(t), 15)
    assert diagnosis.diagnoses()
    assert diagnosis.dead_electrodes() == {}


def test_loose_electrode_ends_when_contacts_stay_connected() -> None:
    diagnosis, changes = play(lambda t, _: loose(t, 12), 90)
    assert diagnosis.diagnoses() == []
    (ended,) = (change for change in changes if change.until_ns is not None)
    assert ended.electrodes == ("xa",)


def test_contacts_that_jump_from_sample_to_sample_are_no_loose_electrode() -> None:
    """Also from and to the electrodes, where other channels read zero."""

    def jumping(t: float, _: np.random.Generator) -> Counts:
        rng = np.random.default_rng(int(t * 10))
        place = np.clip(rng.uniform(-0.3, 1.3, 2), 0.01, 0.99)
        return np.asarray(fractions(*place) * np.exp(rng.uniform(7.0, 7.3)))

    _, changes = play(jumping, 60)
    assert not [change for change in changes if change.kind == FaultKind.DEAD_ELECTRODE]


def test_swapped_cables_are_named() -> None:
    diagnosis, _ = play(lambda t, _: presses(t)[[0, 3, 2, 1]], 40)
    assert [(f.kind, f.electrodes) for f in diagnosis.diagnoses()] == [
        (FaultKind.SWAPPED_CABLES, ("xa", "yb"))
    ]


def test_gain_step_is_diagnosed_with_its_factor() -> None:
    diagnosis, _ = play(lambda t, _: presses(t) * [1, 1, 1.6, 1], 60)
    (found,) = diagnosis.diagnoses()
    assert (found.kind, found.electrodes) == (FaultKind.GAIN_STEP, ("y0",))
    assert found.values["factor"] == pytest.approx(1.6, rel=0.1)


def test_saturated_channel_ends_when_it_recovers() -> None:
    diagnosis, changes = play(lambda t, _: np.array([0, 0, 0, 1e6 if 5 < t < 15 else 0]), 25)
    assert diagnosis.diagnoses() == []
    assert [f.kind for f in changes if f.until_ns is None] == [FaultKind.SATURATED_CHANNEL]
    assert [f.electrodes for f in changes if f.until_ns is not None] == [("yb",)]


def test_a_hold_is_as_old_as_the_first_samples_however_long_the_host_is_up() -> None:
    """Before the first sample of any node, blocks have samples of 0 counts at the time 0."""
    diagnosis = HandDiagnostics(model(), tables=_TABLES)
    for _ in range(3):
        nothing = np.zeros((50, 2), np.int64)
        diagnosis.process_block(
            HandSamples(nothing, np.zeros((50, 2, 4), np.int64), nothing.astype(np.bool_))
        )
    begin_ns, rng, changes = 20_000 * SECOND, np.random.default_rng(7), []
    for first in np.arange(0, 5, 0.5):
        stamps = np.repeat(
            (begin_ns + np.rint((first + np.arange(50) / 100) * SECOND)).astype(np.int64)[:, None], 2, 1
        )
        read = np.rint(rng.normal(size=(50, 2, 4)) + [[[300, 200, 250, 250]], [[0] * 4]][0]).astype(np.int64)
        changes += diagnosis.process_block(HandSamples(stamps, read, np.ones((50, 2), np.bool_)))
    assert changes == []  # a hold of five seconds


def test_block_of_another_hand_is_refused() -> None:
    with pytest.raises(ValueError, match=r"must be \(m, 2, 4\)"):
        HandDiagnostics(model()).process_block(
            HandSamples(np.zeros((5, 3), np.int64), np.zeros((5, 3, 4), np.int64), np.ones((5, 3), np.bool_))
        )


@pytest.mark.parametrize("series_ohm", [0.0, 500.0])
def test_torn_corner_is_diagnosed_with_its_size(series_ohm: float) -> None:
    fault = {"kind": "torn_corner", "link": LINK, "from_s": 0.0, "corner": "x0yb"}
    fault |= {"along_x_mm": 17.0, "along_y_mm": 14.0}
    (found,) = simulate(fault, 60, (series_ohm,) * 4)
    assert (found.kind, found.electrodes) == (FaultKind.TORN_CORNER, ("x0", "yb"))
    assert found.values["along_x_mm"] == pytest.approx(17, abs=5)
    assert found.values["along_y_mm"] == pytest.approx(14, abs=5)


def test_dead_electrode_is_diagnosed_by_contacts_behind_resistors() -> None:
    """Contacts all over the pad seem to lie along one side, close to each other: they count as different."""
    fault: dict[str, object] = {"kind": "dead_electrode", "link": LINK, "from_s": 0.0, "electrode": "y0"}
    (found,) = simulate(fault, 30, (1000.0,) * 4)
    assert (found.kind, found.electrodes) == (FaultKind.DEAD_ELECTRODE, ("y0",))


def test_shorted_electrodes_are_observable_with_resistors() -> None:
    fault = {"kind": "shorted_electrode", "link": LINK, "from_s": 0.0, "electrode": "x0", "to": "y0"}
    (found,) = simulate(fault, 60, series_ohm=(500.0,) * 4)
    assert (found.kind, found.electrodes) == (FaultKind.SHORTED_ELECTRODE, ("x0", "y0"))


def test_short_on_a_sheet_of_another_resistance_is_no_saturated_channel() -> None:
    fault = {"kind": "shorted_electrode", "link": LINK, "from_s": 1.0, "electrode": "x0", "short_ohm": 20.0}
    (found,) = simulate(fault, 25, world=WORLDS["harsh"].only("parts").draw(0))
    assert (found.kind, found.electrodes) == (FaultKind.SHORTED_ELECTRODE, ("x0",))


@pytest.mark.parametrize("series_ohm", [150.0, 900.0])
def test_short_behind_a_series_resistor_is_diagnosed(series_ohm: float) -> None:
    """Its channel is at the end of its range, or below it; the others carry less than without resistors."""
    fault = {"kind": "shorted_electrode", "link": LINK, "from_s": 1.0, "electrode": "y0", "short_ohm": 20.0}
    (found,) = simulate(fault, 25, series_ohm=(series_ohm,) * 4)
    assert (found.kind, found.electrodes) == (FaultKind.SHORTED_ELECTRODE, ("y0",))


def test_short_of_a_pad_with_a_dead_electrode_is_no_saturated_channel() -> None:
    """The current that the dead electrode doesn't take is in the others."""
    dead: dict[str, object] = {"kind": "dead_electrode", "link": LINK, "from_s": 2.0, "electrode": "y0"}
    short: dict[str, object] = {"kind": "shorted_electrode", "link": LINK, "from_s": 4.0, "electrode": "x0"}
    found = simulate(short, 30, (0.0,) * 4, None, dead)
    assert ("x0",) in [one.electrodes for one in found if one.kind == FaultKind.SHORTED_ELECTRODE]
    assert FaultKind.SATURATED_CHANNEL not in [one.kind for one in found]


def test_saturation_under_a_lasting_contact_is_less_certain() -> None:
    held, _ = play(lambda _, __: np.array([2000, 1500, 900, 1e6]), 25)
    (found,) = held.diagnoses()
    assert found.kind == FaultKind.SATURATED_CHANNEL
    assert found.published.confidence < 0.7
    rests, _ = play(lambda t, _: np.array([2000, 1500, 900, 1e6]) * [*[t < 22] * 3, 1], 25)
    (found,) = rests.diagnoses()
    assert found.published.confidence == 1.0


def test_drift_of_several_pads_is_common_drift() -> None:
    whole = config.load(shipped.path("utah_mit.toml"))
    (hand,) = whole.hands
    few = whole.model_copy(update={"hands": (hand.model_copy(update={"pads": hand.pads[-5:]}),)})
    late = ScenarioTouch(link=LINK, from_s=1000.0, duration_s=1.0, path=((0.5, 0.5),), force_n=(1.0,))
    world = World(
        "warm",
        electronics=ElectronicsSpread(
            temperature_drift_k_per_s=Fixed(0.4), offset_counts_per_k=Normal(0.0, 8.0)
        ),
    ).draw(3)
    virtual = VirtualHand(few, Scenario(touch=(late,)), world)
    diagnosis = HandDiagnostics(DiagnosisModel.from_deployment(few, "right"), tables=_TABLES)
    run(diagnosis, lambda times: np.stack([virtual.counts(row, times) for row in range(5)], axis=1), 60)
    faults = [found.kind for found in diagnosis.diagnoses() if found.is_fault]
    assert len(faults) >= 2
    assert set(faults) == {FaultKind.COMMON_DRIFT}


def test_contacts_that_no_fault_explains_are_unexplained() -> None:
    def nowhere(t: float, _: np.random.Generator) -> Counts:
        rng = np.random.default_rng(int(t))
        return rng.dirichlet(np.ones(4)) * 5000 * (t % 1 < 0.5)

    diagnosis, _ = play(nowhere, 120)
    assert [(f.kind, f.electrodes) for f in diagnosis.diagnoses()] == [(FaultKind.UNEXPLAINED, ())]


def test_ambiguous_gain_step_and_torn_corner_are_both_named() -> None:
    gain = Hypothesis(FaultKind.GAIN_STEP, ("x0",), 0.7)
    cut = Hypothesis(FaultKind.TORN_CORNER, ("x0", "yb"), 1.0, (0.5, 0.5))
    fault = ContactFault(cut, (), 41.0, 0.6, SECOND, 20, gain)
    found = describe_contact_fault(model(), 0, fault)
    assert found.kind == FaultKind.UNEXPLAINED
    assert "channel x0 collects too little" in found.published.cause
    assert "torn at the corner of x0 and yb" in found.published.cause
