"""`handtouch calibrate` by known weights: law, guided procedure, store, daemon.

Readings come from the simulator's independent forward path, whose law, sheet and contact radius are hidden.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from numpy.typing import NDArray
from rich.text import Text

from handtouch import cli, client, config
from handtouch.calibration.calibration import (
    NEW_SHEET_METHOD,
    Calibration,
    CalibrationVersion,
    Gains,
    LawParameters,
    Offsets,
    Provenance,
    StoredSheetState,
    matrix,
)
from handtouch.calibration.store import Store
from handtouch.config import shipped
from handtouch.core.active_calibration import ActiveCalibration
from handtouch.core.pad_model import contact_law, default_calibration_id_of, law_of
from handtouch.core.sheet_force import sheet_behaviour_of
from handtouch.daemon.daemon import HandtouchDaemon
from handtouch.daemon.table_cache import build_pad_model
from handtouch.device import DeviceBus
from handtouch.host.units import GRAM_FORCE_N
from handtouch.procedures import calibrate
from handtouch.procedures.calibrate import plot
from handtouch.procedures.calibrate import procedure as procedure_module
from handtouch.procedures.calibrate import recording as record
from handtouch.procedures.calibrate.fit import MIN_EVIDENCE, PARAMETERS, LawFit, fit_law
from handtouch.procedures.calibrate.procedure import PadSample, SettlingDetector, WeightProcedure
from handtouch.procedures.calibrate.readings import (
    PadCircuitModel,
    Weight,
    WeightReading,
    measurement_order,
    parse_weights,
)
from handtouch.procedures.dialogue import Key
from handtouch.sheet import S1, SheetCompensator
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.sheet_physics import ElementCreep, SheetStates
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS
from tests.deployments import deployment_text, pad_text
from tests.sandwich import Sandwich
from tests.sheets import apparent_load

TRUE = {"contact_ohm_mm2": 14_000.0, "alpha": 1.62, "ohm_per_square": 2900.0}
FIVE = "20,50,100,200,500"
SCATTER = 0.05
PERIOD_NS = 5_000_000
_numbers = itertools.count()
TEXT = deployment_text(
    pad_text("plane", 1, extra="serial = 4711"),
    daemon='sync_period_ms = 5.0\nstore = "store.db"',
    channel="none",
    full_scale_ma=20.0,
    contact_radius_std_mm=0.25,
    touch="begin_threshold_n = 0.05\nend_threshold_n = 0.025",
)


@cache
def parsed() -> config.Deployment:
    return config.parse(TEXT)


def deployed(**sheet: float) -> config.Deployment:
    """The pad, its sheet as the file says but for what is given."""
    deployment = parsed()
    made = deployment.sheets["s"].model_copy(update=sheet)
    return deployment.model_copy(update={"sheets": {"s": made}})


class Table:
    """A pad on a table under weights, one after another: the k-th placed on it at the times from 10 k + 1.

    On flat feet; with `hertz_force_n` on a round one, under which the contact has 2.5 mm at that force.
    """

    def __init__(
        self,
        weights: list[Weight],
        seed: int = 1,
        radius_std: float = 0.0,
        scatter: float = SCATTER,
        **law: float,
    ) -> None:
        rng = np.random.default_rng(seed)
        radii = {w.radius_m: w.radius_m * math.exp(radius_std * rng.normal()) for w in weights}
        touches = tuple(
            ScenarioTouch(
                link="plane",
                from_s=10.0 * k,
                duration_s=9.0,
                path=((0.5 + 0.02 * rng.normal(), 0.5 + 0.02 * rng.normal()),),
                force_n=(weight.force_n * math.exp(scatter * rng.normal()),),
                radius_mm=None if "hertz_force_n" in law else 1e3 * radii[weight.radius_m],
            )
            for k, weight in enumerate(weights)
        )
        hidden = deployed(**{**TRUE, **law})
        self.hand = VirtualHand(hidden, Scenario(touch=touches), WORLDS["ideal"].draw(seed))
        self.weights = weights

    def readings(self) -> list[WeightReading]:
        """Return a reading of every weight at rest."""
        noise_a = 20e-3 / 32767 * 2 / math.sqrt(200)
        output = []
        for k, weight in enumerate(self.weights):
            (truth,) = self.hand.truth(10.0 * k + 4.0)
            output.append(WeightReading(weight, sum(truth.currents_a), noise_a, 200, (truth.u_m, truth.v_m)))
        return output


@cache
def circuit_model(**sheet: float) -> PadCircuitModel:
    deployment = deployed(**sheet)
    return PadCircuitModel(deployment, deployment.hands[0].pads[0])


def fitted(readings: list[WeightReading], radius_std: float = 0.01, **sheet: float) -> LawFit:
    model = circuit_model(**sheet)
    circuits = [model.circuit_at(reading.position_m, 1e-4) for reading in readings]
    return fit_law(readings, circuits, law_of(model.sheet), model.sheet.reference_kpa * 1e3, radius_std)


def weights(text: str = FIVE, repeats: int = 3) -> list[Weight]:
    return measurement_order(parse_weights(text, "gf", 2.5), repeats)


# The law -----------------------------------------------------------------------------------------------


def test_hidden_law_is_found_without_scatter() -> None:
    fit = fitted(Table(weights(), scatter=0.0).readings(), radius_std=1e-6)
    assert fit.sheet_observed
    assert not fit.problems
    for name, true in TRUE.items():
        assert getattr(fit.law, name) == pytest.approx(true, rel=0.01)
    assert fit.scatter < 0.01


def test_a_law_is_as_old_as_the_weights_that_it_was_measured_by() -> None:
    readings = Table(weights()).readings()
    assert fitted(readings).law.age_s == 1.5
    ages_s = [2.0 if k % 2 else 8.0 for k in range(len(readings) - 1)] + [4.0]
    timed = [
        replace(reading, unloaded_s=10.0 * k - 1.0, loaded_s=10.0 * k, measured_s=10.0 * k + age_s)
        for k, (reading, age_s) in enumerate(zip(readings, ages_s, strict=True))
    ]
    assert fitted(timed).law.age_s == pytest.approx(4.0)


@pytest.mark.parametrize("radius_std", [0.0, 0.1])
def test_intervals_cover_the_true_law_in_95_percent_of_procedures(radius_std: float) -> None:
    """Their half widths are 1.96 standard deviations of the errors' logarithms, give or take 2.5 of 40."""
    sessions = 40
    errors = np.zeros((sessions, len(PARAMETERS)))
    for seed in range(sessions):
        fit = fitted(Table(weights(), seed, radius_std).readings(), max(radius_std, 0.002))
        assert not fit.problems
        for number, name in enumerate(PARAMETERS):
            interval = fit.intervals[name]
            half_width = math.log(interval.high / interval.low) / 2
            errors[seed, number] = 1.96 * math.log(getattr(fit.law, name) / TRUE[name]) / half_width
    assert (np.mean(np.abs(errors) <= 1.96, axis=0) >= 0.86).all(), errors
    deviations = np.sqrt(np.mean(errors**2, axis=0))
    assert (np.abs(deviations - 1) <= 2.5 / math.sqrt(2 * sessions)).all(), deviations


WIDE_SPAN = "10,20,50,100,200,500,1000,2000"
IN_THE_MIDDLE_N = math.exp(sum(math.log(w.force_n) for w in weights(WIDE_SPAN, 1)) / 8)


@pytest.mark.parametrize("file", [{}, {"hertz_force_n": 1.0}], ids=["file-constant", "file-hertz"])
def test_the_radius_law_that_explains_the_readings_much_better_is_chosen(file: dict[str, float]) -> None:
    given_n = file.get("hertz_force_n", IN_THE_MIDDLE_N)
    flat = fitted(Table(weights(WIDE_SPAN)).readings(), 0.1, **file)
    round_ = fitted(Table(weights(WIDE_SPAN), hertz_force_n=given_n).readings(), 0.1, **file)
    assert flat.law.hertz_force_n is None
    assert flat.evidence < -MIN_EVIDENCE
    assert round_.law.hertz_force_n == pytest.approx(given_n)
    assert round_.evidence > MIN_EVIDENCE
    for fit in (flat, round_):
        assert not fit.problems
        for name in PARAMETERS:
            assert fit.intervals[name].low <= TRUE[name] <= fit.intervals[name].high
    forces = np.array([0.1, 10.0])
    assert round_.radius_m(forces, 2.5e-3) == pytest.approx(
        2.5e-3 * np.cbrt(forces / given_n), rel=0.3
    )  # as known as by the prior of 10 %, and the sheet


def test_readings_that_decide_on_no_radius_law_keep_the_files() -> None:
    readings = Table(weights(), seed=3, hertz_force_n=1.0).readings()
    for file in ({}, {"hertz_force_n": 1.0}):
        fit = fitted(readings, 0.2, **file)
        assert abs(fit.evidence) < MIN_EVIDENCE
        assert fit.law.hertz_force_n == file.get("hertz_force_n")


def test_scatter_between_presses_is_estimated() -> None:
    output = [fitted(Table(weights(repeats=4), seed, scatter=0.08).readings()).scatter for seed in range(20)]
    assert np.mean(output) == pytest.approx(0.08, rel=0.15)


def test_uncertain_radius_widens_k_and_sheet_but_not_alpha() -> None:
    readings = Table(weights()).readings()
    well, badly = fitted(readings, 0.002), fitted(readings, 0.2)

    def width(fit: LawFit, name: str) -> float:
        return fit.intervals[name].high / fit.intervals[name].low

    assert width(badly, "contact_ohm_mm2") > 1.5 * width(well, "contact_ohm_mm2")
    assert width(badly, "ohm_per_square") > 1.3 * width(well, "ohm_per_square")
    assert width(badly, "alpha") == pytest.approx(width(well, "alpha"), rel=0.1)
    assert "--radius-mm" in " ".join(badly.remarks)


def test_light_weights_leave_the_sheet_unobservable() -> None:
    fit = fitted(Table(weights("5,10,20,40,80", 4)).readings())
    assert not fit.sheet_observed
    assert "sheet's resistance is not observable" in " ".join(fit.remarks)
    assert "heavier" in " ".join(fit.remarks)
    low, high = fit.intervals["ohm_per_square"].low, fit.intervals["ohm_per_square"].high
    assert low < TRUE["ohm_per_square"] < high
    assert fit.intervals["alpha"].low < TRUE["alpha"] < fit.intervals["alpha"].high


@pytest.mark.parametrize(
    ("text", "repeats", "changes", "reason"),
    [
        ("50,100", 5, {}, "2 different weights"),
        ("50,100,200", 1, {}, "repeat each weight"),
        ("400,500,600", 3, {}, "span only"),
        ("2000,3000,5000,8000", 3, {"contact_ohm_mm2": 500.0}, "lighter weights"),
        (FIVE, 2, {"scatter": 0.6}, "scatter by"),
    ],
)
def test_insufficient_readings_are_reported_with_a_remedy(
    text: str, repeats: int, changes: dict[str, float], reason: str
) -> None:
    readings = Table(weights(text, repeats), 2, **changes).readings()
    try:
        output = " ".join(fitted(readings).problems)
    except ValueError as error:
        output = str(error)
    assert reason in output


def test_mixed_up_weights_are_named() -> None:
    readings = Table(weights()).readings()
    names = {"100 gf": "200 gf", "200 gf": "100 gf"}
    known = {reading.weight.name: reading.weight for reading in readings}
    swapped = [
        WeightReading(
            known[names.get(r.weight.name, r.weight.name)], r.current_a, r.current_std_a, 200, r.position_m
        )
        for r in readings
    ]
    assert any("200 gf gave less current than 100 gf" in problem for problem in fitted(swapped).problems)


def test_contact_growing_with_the_weight_is_no_law() -> None:
    grown = [weights(f"{gf}@{mm}", 6) for gf, mm in ((5, 0.5), (20, 3.5), (100, 0.8), (300, 3.8), (500, 4.5))]
    readings = Table([weight for kind in grown for weight in kind], scatter=0.01).readings()
    claimed = [
        WeightReading(Weight(r.weight.force_n, 2.5e-3, ""), r.current_a, r.current_std_a, 200, r.position_m)
        for r in readings
    ]
    try:
        output = " ".join(fitted(claimed).problems)
    except ValueError as error:
        output = str(error)
    assert output


def test_weights_are_parsed_with_force_unit_and_radius() -> None:
    light, heavy = parse_weights(" 50, 200@4 ", "gf", 2.5)
    assert (light.force_n, light.radius_m, light.name) == (50 * GRAM_FORCE_N, 2.5e-3, "50 gf")
    assert heavy.radius_m == pytest.approx(4e-3)
    assert heavy.name == "200 gf on 4 mm"
    assert parse_weights("2", "n", 1.0)[0].force_n == 2
    for wrong in ("", "50,x", "-1", "50@0", "nan", "inf"):
        with pytest.raises(ValueError, match="weight"):
            parse_weights(wrong, "gf", 2.5)


# Guided procedure --------------------------------------------------------------------------------------


def settle(
    currents: Callable[[float], float], seconds: float = 8.0, period_s: float = 5e-3
) -> tuple[float, float] | None:
    """Return time [s] and mean of the reading; touched from 0 on, a sample every 5 ms."""
    settling = SettlingDetector()
    for k in range(round(seconds / period_s)):
        t_s = period_s * k
        sample = PadSample(round(t_s * 1e9), True, True, currents(t_s), (0.015, 0.012))
        if (settled := settling.add_sample(sample)) is not None:
            return t_s, settled[0]
    return None


def test_reading_waits_for_creep_and_tolerates_noise_of_the_sheet() -> None:
    errors, times = [], []
    for seed in range(4):
        press, reading = (apparent_load(S1, lambda _: 1.0, seed) for _ in range(2))
        settled = settle(lambda t_s, reading=reading: 1e-3 * reading(t_s))  # type: ignore[misc]
        assert settled is not None
        times.append(settled[0])
        errors.append(settled[1] / (1e-3 * press(6.0)) - 1)
    assert max(times) < 6.0
    assert np.sqrt(np.mean(np.square(errors))) < 0.02  # noise of 1 % included


def test_few_samples_are_waited_for() -> None:
    for period_s in (0.06, 0.2):
        settled = settle(lambda _: 1e-3, period_s=period_s)
        assert settled is not None
        assert settled[0] == pytest.approx(1.0 + 20 * period_s, abs=1.5 * period_s)


def test_drifting_reading_is_rejected() -> None:
    assert settle(lambda t_s: 1e-3 * (1 + 0.02 * t_s)) is None
    assert settle(lambda _: 1e-3) is not None


class Desk:
    """Pad of a `Table` by the clock of its samples; `refused`: reasons of refused tares."""

    def __init__(self, table: Table, refused: list[str] | None = None) -> None:
        self._table, self._readings = table, table.readings()
        self.placed: int | None = None
        self.refused = refused or []
        self.t_ns = 0

    def samples(self) -> Iterator[PadSample]:
        while True:
            self.t_ns += PERIOD_NS
            if self.placed is None:
                yield PadSample(self.t_ns, True)
            else:
                reading = self._readings[self.placed]
                yield PadSample(self.t_ns, True, True, reading.current_a, reading.position_m, 0.5)

    def tare(self) -> str:
        return self.refused.pop(0) if self.refused else ""


@dataclass
class Operator:
    """Operator who follows the prompts and answers questions with `keys`; a Dialogue.

    `put` and `take` move the weights; `instead` (number of the prompt): key pressed instead.
    """

    put: Callable[[int], None]
    take: Callable[[], None]
    keys: list[Key] = field(default_factory=list)
    instead: dict[int, Key] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)
    pending: list[Key] = field(default_factory=list)
    prompts: int = 0

    @property
    def accepts_keys(self) -> bool:
        return bool(self.keys or self.pending)

    def print_line(self, text: str, style: str = "") -> None:  # noqa: ARG002
        self.lines.append(text)
        if "] place " in text:
            number = self.prompts
            self.prompts += 1
            if number in self.instead:
                self.pending.append(self.instead[number])
            else:
                self.put(int(text[1:].split("/")[0]) - 1)
        elif "remove it" in text:
            self.take()
        elif "Enter" in text and self.keys:
            self.pending.append(self.keys.pop(0))

    def show_live(self, t_ns: int, draw: Callable[[], Text]) -> None:  # noqa: ARG002
        draw()

    def read_key(self) -> Key | None:
        return self.pending.pop(0) if self.pending else None

    @property
    def text(self) -> str:
        return "\n".join(self.lines)


def seated(table: Table, **options: Any) -> tuple[WeightProcedure, Operator, Desk]:
    desk = Desk(table, options.pop("refused", None))
    operator = Operator(
        lambda k: setattr(desk, "placed", k), lambda: setattr(desk, "placed", None), **options
    )
    deployment = deployed()
    circuit_model = PadCircuitModel(deployment, deployment.hands[0].pads[0])
    return (
        WeightProcedure("h/plane", table.weights, circuit_model, desk, operator, timeout_s=5.0),
        operator,
        desk,
    )


def test_procedure_reads_every_weight_up_and_down() -> None:
    guided, operator, _ = seated(Table(weights(repeats=2)))
    readings = list(guided.run())
    assert [reading.weight.name for reading in readings[:6]] == [
        f"{n} gf" for n in (20, 50, 100, 200, 500, 500)
    ]
    assert "readings scatter by" in operator.text
    fit = fitted(readings)
    for name in PARAMETERS:
        assert fit.intervals[name].low < TRUE[name] < fit.intervals[name].high


def test_tare_refused_while_loaded_can_be_repeated() -> None:
    guided, operator, _ = seated(Table(weights(repeats=1)), refused=["it is touched"], keys=[Key.ENTER])
    assert len(list(guided.run())) == 5
    assert "not tared: it is touched" in operator.text
    guided, _, _ = seated(Table(weights(repeats=1)), refused=["it is touched"], keys=[Key.QUIT])
    assert list(guided.run()) == []


def test_keys_skip_or_repeat_a_weight_or_quit() -> None:
    guided, _, _ = seated(Table(weights(repeats=2)), instead={1: Key.SKIP, 2: Key.AGAIN})
    names = [reading.weight.name for reading in guided.run()]
    assert names.count("50 gf") == 0
    assert len(names) == 8
    guided, operator, _ = seated(Table(weights(repeats=2)), instead={3: Key.QUIT})
    assert len(list(guided.run())) == 3
    assert "the readings so far are kept" in operator.text


def test_missing_weight_is_reported_and_can_be_skipped() -> None:
    guided, operator, desk = seated(Table(weights(repeats=1)), keys=[Key.SKIP])
    operator.put = lambda k: setattr(desk, "placed", k if k != 1 else None)
    assert len(list(guided.run())) == 4
    assert "no contact" in operator.text


def test_reading_near_an_edge_or_out_of_range_is_rejected() -> None:
    deployment = deployed()
    circuit_model = PadCircuitModel(deployment, deployment.hands[0].pads[0])
    reading = WeightReading(weights()[0], 1e-3, 0.0, 200, (0.015, 0.012))
    assert circuit_model.rejection_reason(reading) == ""
    assert "middle" in circuit_model.rejection_reason(replace(reading, position_m=(0.027, 0.012)))
    for beyond in (replace(reading, current_a=90e-3), replace(reading, second_current_a=20e-3)):
        assert "end of its range" in circuit_model.rejection_reason(beyond)


# Recordings and plots ----------------------------------------------------------------------------------


def written(folder: Path, readings: list[WeightReading]) -> tuple[Path, Path]:
    """Write a deployment file and a recording on its pad."""
    file, log = folder / "hand.toml", folder / "readings.jsonl"
    file.write_text(TEXT)
    deployment = config.load(file)
    nominal = default_calibration_id_of(deployment.hands[0].pads[0], deployment)
    with record.ReadingRecorder(log) as recorder:
        recorder.write_header(
            record.RecordingHeader("h/plane", nominal, 4711, 0.02, ((1.0,) * 4, (0.01,) * 4))
        )
        for reading in readings:
            recorder.write_reading(reading)
    return file, log


def test_recording_is_fitted_again_plotted_and_stored(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    readings = Table(weights()).readings()
    file, log = written(tmp_path, readings)
    assert [replace(reading, reported_force_n=0.0) for reading in record.read_recording(log)[1]] == [
        replace(reading, reported_force_n=0.0) for reading in readings
    ]
    command = ["calibrate", "plane", "--config", str(file), "--from", str(log)]
    picture = tmp_path / "law.png"
    assert cli.main([*command, "--plot", str(picture), "--yes"]) == 0
    output = capsys.readouterr().out
    assert "contact_ohm_mm2" in output
    assert "o" in output.split("+---")[0]
    assert picture.read_bytes()[:4] == b"\x89PNG"
    with Store(tmp_path / "store.db") as store:
        version = store.newest(4711)
    assert version is not None
    assert version.calibration.law is not None
    assert version.calibration.offsets is not None
    assert (version.provenance.method, version.provenance.contacts) == ("guided session", 15)
    assert cli.main([*command, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["law"]["alpha"] == version.calibration.law.alpha
    assert answer["intervals_95"]["alpha"][0] < TRUE["alpha"] < answer["intervals_95"]["alpha"][1]
    assert answer["force_error_after"] < 0.1


def test_weights_on_two_feet_fit_the_laws_of_both_sheets_which_are_stored_shown_and_undone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, log, store = tmp_path / "hand.toml", tmp_path / "readings.jsonl", tmp_path / "store.db"
    text = shipped.path("two_sheets.toml").read_text()
    file.write_text(text.replace("[daemon]\n", f'[daemon]\nstore = "{store}"\n', 1))
    deployment = config.load(file)
    hidden = Sandwich((23_000e-6, 36_000e-6), (1.58, 1.04), (2600.0, 640.0))
    model = PadCircuitModel(deployment, deployment.pads[0].pad)
    spreading_m, rng = model.circuit_at((0.015, 0.012)).spreading_m, np.random.default_rng(3)
    with record.ReadingRecorder(log) as recorder:
        nominal = default_calibration_id_of(deployment.pads[0].pad, deployment)
        recorder.write_header(record.RecordingHeader("gripper/thumb_tip", nominal, 1, 0.05))
        for weight in measurement_order(
            parse_weights("20@2,50@2,100@2,200@2,20@4,50@4,200@4,500@4", "gf", 3.0), 2
        ):
            loads_n = weight.force_n * np.exp(0.02 * rng.normal(size=2))
            currents = [
                float(hidden.currents(load_n, weight.radius_m, 5.0, spreading_m)[number])
                for number, load_n in enumerate(loads_n)
            ]
            recorder.write_reading(
                WeightReading(weight, currents[0], 1e-7, 200, (0.015, 0.012), math.nan, currents[1], 1e-7)
            )
    command = ["calibrate", "thumb_tip", "--config", str(file), "--from", str(log)]
    assert cli.main([*command, "--yes", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    for laws, number in ((answer, 0), (answer["second_sheet"], 1)):
        low, high = laws["intervals_95"]["alpha"]
        assert low < hidden.alpha[number] < high
        assert laws["law"]["contact_ohm_mm2"] == pytest.approx(1e6 * hidden.contact_ohm_m2[number], rel=0.1)
    assert cli.main(command) == 0
    assert "second sheet" in capsys.readouterr().out
    with Store(store) as opened:
        made = opened.newest(1)
        assert made is not None
        assert made.calibration.second_law is not None
        assert made.calibration.second_law.alpha == answer["second_sheet"]["law"]["alpha"]
        opened.write(1, made.config, Calibration(), made.provenance, datetime.now(UTC))
    for words, shown in ((["show", "1", "--version", "1"], "second_law.alpha"), (["rollback", "1", "1"], "")):
        assert cli.main(["calibrations", *words, "--store", str(store)]) == 0
        assert shown in capsys.readouterr().out
    with Store(store) as opened:
        undone = opened.newest(1)
    assert undone is not None
    assert undone.calibration == made.calibration


def test_weights_leave_no_bias_in_forces_of_a_sheet_that_creeps_adapts_and_has_loops(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kinds = WORLDS["default"].sheets.reporting_kinds
    (film,) = (kind for kind in kinds if kind is not None and kind.name == "conductive_film")
    hidden = replace(film.law, creep=ElementCreep(0.7, (0.3,), (0.6,)))  # as the file states it
    sheet = parsed().sheets["s"]
    circuit = circuit_model().circuit_at((0.015, 0.012))
    true = law_of(sheet.model_copy(update=TRUE))
    drive_v, spreading_m = circuit.drive_v, circuit.spreading_m
    states, output, now_s = SheetStates(hidden), [], 0.0
    for weight in weights(repeats=4):
        pause_n, rest_n, _ = (
            float(states.advance(np.zeros(1, np.intp), dt_s, load_n)[0])
            for dt_s, load_n in ((1.0, 0.0), (1.5, weight.force_n), (2.0, weight.force_n))
        )
        assert pause_n == 0.0
        current_a = contact_law(sheet, true).current(
            rest_n, drive_v, true.ohm_per_square, spreading_m, circuit.series_ohm
        )
        reading = WeightReading(weight, float(current_a), 1e-7, 200, (0.015, 0.012))
        output.append(replace(reading, unloaded_s=now_s, loaded_s=now_s + 1.0, measured_s=now_s + 2.5))
        now_s += 4.5
    file, log = written(tmp_path, output)
    behaviour = film.behaviour.model_dump(exclude_none=True)
    table = "".join(f"{key} = {json.dumps(value)}\n" for key, value in behaviour.items())
    file.write_text(f"{TEXT}\n[sheet.s.behaviour]\n{table}")
    assert cli.main(["calibrate", "plane", "--config", str(file), "--from", str(log), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["law"]
    law = replace(true, **{name: found[name] for name in PARAMETERS})
    errors = []
    for load_n in (0.15, 0.3, 0.6, 1.2, 2.4, 4.8):
        states = SheetStates(hidden)
        compensator = SheetCompensator(sheet_behaviour_of(film.behaviour).model, 1)
        for apparent_n in states.advance(np.zeros(80, np.intp), 5e-3, load_n):
            current_a = contact_law(sheet, true).current(
                apparent_n, drive_v, true.ohm_per_square, spreading_m, circuit.series_ohm
            )
            estimate = contact_law(sheet, law).force(
                current_a, drive_v, law.ohm_per_square, spreading_m, circuit.series_ohm
            )
            (force_n,) = compensator.compensate(np.array([float(estimate.force_n)]), 5e-3)
        errors.append(force_n / load_n - 1)
    assert abs(np.mean(errors)) < 0.03, errors
    assert np.abs(errors).max() < 0.08, errors


def test_a_new_sheet_keeps_the_gains_of_its_node_and_nothing_of_the_old_sheet(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, _ = written(tmp_path, [])
    deployment = config.load(file)
    nominal = default_calibration_id_of(deployment.hands[0].pads[0], deployment)
    gains = Gains((1.1, 1.0, 1.0, 0.9), matrix(1e-6 * np.eye(4)))
    law = LawParameters(21_000.0, 1.4, 2400.0, matrix(np.diag([1e-4, 1e-4, 1e-6])))
    old = Calibration(gains, Offsets((1.0,) * 4, (0.1,) * 4), law, StoredSheetState("S1", 1, b"state"))
    with Store(tmp_path / "store.db") as store:
        store.write(4711, nominal, old, Provenance("guided session"), datetime.now(UTC))
    assert cli.main(["calibrate", "plane", "--new-sheet", "--config", str(file)]) == 0
    assert "4711-2" in capsys.readouterr().out
    with Store(tmp_path / "store.db") as store:
        version = store.newest(4711)
    assert version is not None
    assert version.calibration == Calibration(gains)
    assert version.provenance.method == NEW_SHEET_METHOD
    assert cli.main(["calibrate", "plane", "--new-sheet"]) == 2
    assert cli.main(["calibrate", "plane", "--new-sheet", "--config", str(file), "--weights", "20"]) == 2


def test_a_law_of_a_growing_radius_is_stored_and_applied(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    readings = Table(weights(WIDE_SPAN), hertz_force_n=1.0).readings()
    file, log = written(tmp_path, readings)
    assert cli.main(["calibrate", "plane", "--config", str(file), "--from", str(log), "--yes"]) == 0
    assert "grows as force^(1/3)" in capsys.readouterr().out
    with Store(tmp_path / "store.db") as store:
        version = store.newest(4711)
    assert version is not None
    law = CalibrationVersion.from_json(json.loads(json.dumps(version.to_json()))).calibration.law
    assert law is not None
    assert law.hertz_force_n == pytest.approx(IN_THE_MIDDLE_N)
    model = build_pad_model(deployed())
    before_a = model.end_threshold_a[0]
    model.set_calibration(0, ActiveCalibration(version.calibration_id, law=law))
    light_a = min(reading.current_a for reading in readings)  # of 10 gf, four times the threshold
    assert 0.1 * light_a < model.end_threshold_a[0] < 0.4 * light_a
    assert model.end_threshold_a[0] > 1.5 * before_a


def test_exit_status_of_insufficient_or_invalid_recordings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, log = written(tmp_path, Table(weights("400,500,600")).readings())
    command = ["calibrate", "plane", "--config", str(file), "--from", str(log)]
    assert cli.main([*command, "--yes"]) == 1
    assert "Not enough" in capsys.readouterr().out
    assert not (tmp_path / "store.db").exists()
    log.write_text(log.read_text() + "{}\n")
    assert cli.main(command) == 2
    assert "line 11" in capsys.readouterr().err
    assert cli.main(["calibrate", "other", *command[2:]]) == 2
    assert "names 0 pads" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--weights", "20"], "--config CONFIG is missing"),
        (["--weights", "20", "--name", "x"], "use either"),
        (["--gains", "1", "1", "1", "1"], "--name NAME is missing"),
        (["--weights", "20", "--from", "f", "--config", "c"], "use either"),
    ],
)
def test_conflicting_arguments_are_reported(
    arguments: list[str], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["calibrate", "plane", *arguments]) == 2
    assert reason in capsys.readouterr().err


def test_sketch_shows_every_weight_within_its_width() -> None:
    readings = Table(weights()).readings()
    deployment = deployed()
    circuit_model = PadCircuitModel(deployment, deployment.hands[0].pads[0])
    lines = plot.sketch(
        fitted(readings), readings, [circuit_model.circuit_at(r.position_m) for r in readings]
    ).splitlines()
    assert max(map(len, lines)) <= 72
    columns = {k for line in lines for k, sign in enumerate(line) if sign == "o"}
    assert len(columns) == 5


# With a daemon -----------------------------------------------------------------------------------------


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[HandtouchDaemon, Path, Callable[..., Operator]]]:
    """Run a daemon in a thread, whose node has the weights that an operator places."""
    table = Table(weights("20,60,200,600", 2), scatter=0.03)
    placed: list[int | None] = [None]
    ticks = itertools.count()

    def sample(_: int) -> NDArray[np.int64]:
        k = placed[0]
        return table.hand.sample(
            9.5 + 1e-4 * next(ticks) % 0.3 if k is None else 10 * k + 2 + next(ticks) % 5000 / 1e3
        )

    def operator(**options: Any) -> Operator:
        return Operator(lambda k: placed.__setitem__(0, k), lambda: placed.__setitem__(0, None), **options)

    channel = f"calibrate{next(_numbers)}"
    file = tmp_path / "hand.toml"
    endpoints = "".join(
        f'{stream} = "tcp://127.0.0.1:*"\n' for stream in ("live", "complete", "control", "inputs")
    )
    text = TEXT.replace('channel = "none"', f'channel = "{channel}"')
    text = text.replace("[daemon]\n", f"[daemon]\n{endpoints}")
    file.write_text(text.replace("store.db", str(tmp_path / "store.db")))
    stop = threading.Event()
    with (
        can.Bus(interface="virtual", channel=channel) as wire,
        HandtouchDaemon.open(config.load(file)) as daemon,
    ):
        nodes = DeviceBus(wire, sample)
        nodes.add(1, serial=4711)
        nodes.start()
        thread = threading.Thread(target=daemon.run, args=(stop,))
        thread.start()
        try:
            yield daemon, file, operator
        finally:
            stop.set()
            thread.join()
            nodes.stop()


def test_guided_calibration_with_a_daemon_corrects_forces_and_is_stored(
    served: tuple[HandtouchDaemon, Path, Callable[..., Operator]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    daemon, file, make_operator = served
    operator = make_operator()
    for name in ("_CREEP_DELAY_NS", "_MEAN_DURATION_NS", "_MIN_UNLOADED_NS"):
        monkeypatch.setattr(procedure_module, name, 250_000_000)
    monkeypatch.setattr(calibrate, "open_dialogue", lambda: contextlib.nullcontext(operator))
    endpoints = daemon.publisher.endpoints["live"], daemon.control.endpoint
    _until_delivering(endpoints[1])
    log = file.with_name("readings.jsonl")
    options = ["--live", endpoints[0], "--endpoint", endpoints[1], "--log", str(log), "--yes", "--json"]
    status = cli.main(
        [
            "calibrate",
            "plane",
            "--config",
            str(file),
            "--weights",
            "20,60,200,600",
            "--repeats",
            "2",
            *options,
        ]
    )
    output = capsys.readouterr()
    assert status == 0, operator.text + output.err
    answer = json.loads(output.out)
    assert answer["force_error_before"] > 2 * answer["force_error_after"]
    assert answer["calibration_id"] == "4711-1"
    now = client.request("calibrate", endpoint=endpoints[1], timeout_s=20, pad="plane")
    assert now["calibration_id"] == "4711-1"
    assert now["law"]["alpha"] == answer["law"]["alpha"]
    assert len(record.read_recording(log)[1]) == 8
    with Store(file.with_name("store.db")) as store:
        version = store.newest(4711)
    assert version is not None
    assert version.config == now["default_calibration_id"]


def _until_delivering(control: str) -> None:
    end_s = time.monotonic() + 20
    while client.request("status", endpoint=control, timeout_s=20)["pads"][0]["node_state"] != "operational":
        assert time.monotonic() < end_s
        time.sleep(0.05)
