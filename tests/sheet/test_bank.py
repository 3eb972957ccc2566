"""A bank of models learns from steady holds, without a force reference."""

import numpy as np
import numpy.typing as npt
import pytest

from handtouch.sheet import BANK_LEARNED, S1, S2, BankPrior, BankState, Creep, ModelBank, SheetModel
from tests.sheets import power_law

PERIOD_S = 1.0
GRIPS = (16, 256) * 6


class Hold:
    """Grips of 3 N on one sheet, with flicker: `model` is its true behaviour, `assumed` the file's."""

    def __init__(self, model: SheetModel, assumed: SheetModel) -> None:
        self.state = BankState.empty(1)
        self.bank = ModelBank(assumed.adaptation, BankPrior(), self.state)
        self._model, self._sheet = model, model.initial_state(1)
        self._rng, self._flow_s = np.random.default_rng(5), np.zeros(1)

    def grip(self, long_s: float, swing: float = 0.0) -> tuple[float, float]:
        """Hold 3 N; return the compensated force and its standard deviation at the end."""
        self.bank.begin_contacts(np.array([0]), np.zeros(1), 0.3)
        step, flow = self._model.discretise(PERIOD_S), np.full(1, PERIOD_S)
        reading: npt.NDArray[np.float64] = np.zeros(1)
        for t in np.arange(0, long_s, PERIOD_S):
            load = 3.0 * (1 + swing * np.sin(t))
            smooth = step.forward(self._sheet, load)
            reading = smooth * (1 + 0.005 * self._rng.standard_normal())
            self.bank.advance(reading / self.state.growth, flow, self._flow_s)
            self._flow_s += flow
        back_std, creep_std = self.bank.spread(slice(None))
        effective = reading / self.state.growth
        std = np.hypot(back_std, creep_std * effective)
        step.forward(self._sheet, 0.0)
        return float((effective + self.bank.mean_back_n()).item()), float(std.item())


def without(model: SheetModel, creep: Creep) -> SheetModel:
    """Return a sheet with this creep that doesn't fluctuate."""
    return SheetModel(model.adaptation, creep)


SETTLED = Creep(1.0, (), ())
NOT_ADAPTING = SheetModel(type(S1.adaptation)(0.0, 3000.0, 5400.0, 0.02), SETTLED)


def test_adaptation_that_a_sheet_does_not_show_is_no_longer_compensated() -> None:
    hold = Hold(NOT_ADAPTING, S1)
    for long_s in GRIPS:
        force, _ = hold.grip(long_s)
    assert hold.bank.mean_back_n()[0] < 0.1
    assert force == pytest.approx(3.0, rel=0.03)


def test_adaptation_that_a_sheet_shows_stays_compensated() -> None:
    hold = Hold(without(S2, SETTLED), S2)
    for long_s in GRIPS:
        force, _ = hold.grip(long_s)
    assert hold.bank.mean_back_n()[0] > 0.3
    assert force == pytest.approx(3.0, rel=0.06)


def test_slow_creep_is_learned_and_compensated() -> None:
    hold = Hold(SheetModel(NOT_ADAPTING.adaptation, power_law(0.08)), NOT_ADAPTING)
    assert power_law(0.08).response(128.0) > 1.4
    for long_s in GRIPS[:4]:
        hold.grip(long_s)
    force, _ = hold.grip(128)
    assert force == pytest.approx(3.0, rel=0.06)


@pytest.mark.parametrize("law_age_s", [1.5, 10.0])
@pytest.mark.parametrize("age_s", [1.0, 1.5, 10.0, 40.0])
def test_slow_creep_is_uncertain_by_the_time_since_the_law_was_measured(
    law_age_s: float, age_s: float
) -> None:
    """(t / t0)^n: an exponent that is known within 0.05 leaves 0.05 |ln(t / t0)| of the load."""
    bank = ModelBank(NOT_ADAPTING.adaptation, BankPrior(exponent_std=0.05), BankState.empty(1))
    bank.set_law_ages(np.full(1, law_age_s))
    bank.begin_contacts(np.array([0]), np.zeros(1), 0.3)
    bank.advance(np.full(1, 3.0), np.full(1, age_s), np.zeros(1))
    _, creep_std = bank.spread(slice(None))
    assert creep_std[0] == pytest.approx(0.05 * abs(np.log(age_s / law_age_s)), abs=1e-12)


@pytest.mark.parametrize("law_age_s", [1.5, 10.0])
def test_a_law_measured_later_contains_what_a_sheet_crept_until_then(law_age_s: float) -> None:
    """Readings in units of what the sheet reads at the law's age are the load's, at any age."""
    creep = power_law(0.08)
    hold = Hold(SheetModel(NOT_ADAPTING.adaptation, creep), NOT_ADAPTING)
    hold.bank.set_law_ages(np.full(1, law_age_s))
    for long_s in GRIPS[:4]:
        hold.grip(long_s)
    for long_s in (2, 10, 128):
        force, _ = hold.grip(long_s)
        assert force / creep.response(law_age_s) == pytest.approx(3.0, rel=0.06)


def test_intervals_narrow_with_use() -> None:
    hold = Hold(NOT_ADAPTING, NOT_ADAPTING)
    _, first = hold.grip(4)
    for _ in range(20):
        hold.grip(16)
    _, last = hold.grip(4)
    assert last < first / 3


def test_unsteady_holds_are_no_evidence() -> None:
    hold = Hold(NOT_ADAPTING, S1)
    before = hold.bank.learned[0, : BANK_LEARNED // 3].copy()
    for _ in range(5):
        hold.grip(20, swing=0.5)
    change = hold.bank.learned[0, : BANK_LEARNED // 3] - before
    assert np.abs(change).max() < 1.0


def test_what_was_learned_can_be_set_again() -> None:
    hold = Hold(NOT_ADAPTING, S1)
    for long_s in GRIPS[:4]:
        hold.grip(long_s)
    fresh = Hold(NOT_ADAPTING, S1)
    fresh.bank.set_learned(0, hold.bank.learned[0])
    np.testing.assert_allclose(fresh.bank.learned, hold.bank.learned)
    with pytest.raises(ValueError, match=str(BANK_LEARNED)):
        fresh.bank.set_learned(0, np.zeros(3))
    with pytest.raises(ValueError, match="exponents"):
        fresh.bank.set_learned(0, np.full(BANK_LEARNED, -1.0))


class Pads:
    """A bank of pads with one material, each of which adapts or doesn't; all but the last are held."""

    def __init__(self, adapts: list[bool]) -> None:
        self.state = BankState.empty(len(adapts))
        self.bank = ModelBank(S1.adaptation, BankPrior(), self.state)
        sheets = [without(S1, SETTLED) if one else NOT_ADAPTING for one in adapts]
        steps = [sheet.discretise(PERIOD_S) for sheet in sheets]
        states = [sheet.initial_state(1) for sheet in sheets]
        held = np.arange(len(adapts)) < len(adapts) - 1
        flow, flow_s = np.where(held, PERIOD_S, 0.0), np.zeros(len(adapts))
        for _ in range(3):
            self.bank.begin_contacts(np.flatnonzero(held), np.zeros(held.sum()), 0.3)
            for _ in range(256):
                loads = [step.forward(state, 3.0).item() for step, state in zip(steps, states, strict=True)]
                self.bank.advance(np.array(loads, np.float64) / self.state.growth, flow, flow_s)
                flow_s += flow
            for step, state in zip(steps, states, strict=True):
                step.forward(state, 0.0)


def test_adaptation_is_rejected_where_holds_are_steady_and_then_none_is_compensated() -> None:
    pads = Pads([False, False, False])
    assert pads.bank.rejected[:2].all()
    assert (pads.bank.mean_back_n()[:2] == 0.0).all()


def test_adaptation_is_rejected_on_no_pad_that_shows_it() -> None:
    assert not Pads([True, True, True]).bank.rejected.any()


def test_pads_of_one_material_are_evidence_for_a_pad_that_was_not_touched() -> None:
    assert Pads([False, False, False, False]).bank.rejected.all()
    alone = ModelBank(S1.adaptation, BankPrior(), BankState.empty(1))
    assert not alone.rejected.any()


def test_a_pad_that_adapts_differs_from_others_of_its_material() -> None:
    rejected = Pads([False, False, False, False, True, False]).bank.rejected
    assert rejected.tolist() == [True, True, True, True, False, True]


@pytest.mark.parametrize("loads", [(1e-3, 1e30), (1e-30, 1e30)])
def test_readings_that_no_model_explains_are_evidence_for_none(loads: tuple[float, float]) -> None:
    state = BankState.empty(1)
    bank = ModelBank(S1.adaptation, BankPrior(), state)
    for age_s in range(1, 300):  # windows end when the age has doubled
        bank.advance(np.array([loads[age_s.bit_length() % 2]]), np.ones(1), np.array([float(age_s)]))
    for part in ("log_weight", "back_n", "exponent", "exponent_variance", "growth"):
        assert np.isfinite(getattr(state, part)).all(), part
