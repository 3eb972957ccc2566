"""`handtouch calibrate` by known weights: the law, the session with a person, the store, the daemon.

Readings come from the simulator's own forward path, whose law, sheet and contact radius nobody is told.
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
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from numpy.typing import NDArray
from rich.text import Text

from handtouch import calibrate, cli, client, config
from handtouch.calibrate import plot, record, session
from handtouch.calibrate.fit import PARAMETERS, Fit, fit_law
from handtouch.calibrate.readings import GRAM_FORCE_N, Place, Reading, Weight, order, parse_weights
from handtouch.calibrate.session import Sample, Session, Settling
from handtouch.canbus.device import DeviceBus
from handtouch.daemon.daemon import Daemon
from handtouch.daemon.model import law_of, nominal_of
from handtouch.dialogue import Key
from handtouch.sheet import S1, SheetTrack
from handtouch.simulate.hand import VirtualHand
from handtouch.simulate.scenario import Scenario, Touch
from handtouch.simulate.world import World
from handtouch.supervise.store import Store

TRUE = {"contact_ohm_mm2": 14_000.0, "alpha": 1.62, "ohm_per_square": 2900.0}
FIVE = "20,50,100,200,500"
SCATTER = 0.05
PERIOD_NS = 5_000_000
_numbers = itertools.count()
TEXT = """
[daemon]
sync_period_ms = 5.0
store = "store.db"

[[bus]]
name = "can0"
interface = "virtual"
channel = "none"

[node.n]
drive_v = 5.0
full_scale_ma = 20.0
noise_counts = 1.0

[sheet.s]
ohm_per_square = 2400.0
contact_ohm_mm2 = 20000.0
alpha = 1.5
contact_radius_mm = 2.5
contact_radius_std_mm = 0.25

[touch]
on_n = 0.05
off_n = 0.025

[[hand]]
name = "h"

[[hand.pad]]
link = "plane"
bus = "can0"
node_id = 1
node = "n"
sheet = "s"
serial = 4711
surface = { kind = "plane", length_mm = 30.0, width_mm = 24.0 }
gap_mm = 0.6
mount = { position_mm = [0.0, 0.0, 0.0] }
"""


def deployed(**sheet: float) -> config.Deployment:
    """The pad, its sheet as the file says but for what is given."""
    deployment = config.parse(TEXT)
    made = deployment.sheets["s"].model_copy(update=sheet)
    return deployment.model_copy(update={"sheets": {"s": made}})


class Table:
    """A pad on a table under weights, one after another: the k-th lies on it at the times from 10 k + 1."""

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
            Touch(
                link="plane",
                from_s=10.0 * k,
                duration_s=9.0,
                path=((0.5 + 0.02 * rng.normal(), 0.5 + 0.02 * rng.normal()),),
                force_n=(weight.force_n * math.exp(scatter * rng.normal()),),
                radius_mm=1e3 * radii[weight.radius_m],
            )
            for k, weight in enumerate(weights)
        )
        hidden = deployed(**{**TRUE, **law})
        self.hand = VirtualHand(hidden, Scenario(touch=touches), World.ideal_parts(seed))
        self.weights = weights

    def readings(self) -> list[Reading]:
        """Of every weight, once it lies still."""
        noise_a = 20e-3 / 32767 * 2 / math.sqrt(200)
        told = []
        for k, weight in enumerate(self.weights):
            (truth,) = self.hand.truth(10.0 * k + 4.0)
            told.append(Reading(weight, sum(truth.currents_a), noise_a, 200, (truth.u_m, truth.v_m)))
        return told


def fitted(readings: list[Reading], radius_std: float = 0.01) -> Fit:
    deployment = deployed()
    place = Place(deployment, deployment.hands[0].pads[0])
    circuits = [place.circuit(reading.place_m, 1e-4) for reading in readings]
    return fit_law(readings, circuits, law_of(place.sheet), place.sheet.reference_kpa * 1e3, radius_std)


def weights(text: str = FIVE, repeats: int = 3) -> list[Weight]:
    return order(parse_weights(text, "gf", 2.5), repeats)


# The law -----------------------------------------------------------------------------------------------


def test_without_scatter_the_hidden_law_is_found_to_the_accuracy_of_the_two_forward_paths() -> None:
    fit = fitted(Table(weights(), scatter=0.0).readings(), radius_std=1e-6)
    assert fit.observed
    assert not fit.problems
    for name, true in TRUE.items():
        assert getattr(fit.law, name) == pytest.approx(true, rel=0.01)
    assert fit.scatter < 0.01


@pytest.mark.parametrize("radius_std", [0.0, 0.1])
def test_intervals_hold_the_truth_in_95_percent_of_sessions(radius_std: float) -> None:
    sessions = 100
    held = dict.fromkeys(PARAMETERS, 0)
    for seed in range(sessions):
        fit = fitted(Table(weights(), seed, radius_std).readings(), max(radius_std, 0.002))
        assert not fit.problems
        for name in PARAMETERS:
            held[name] += fit.intervals[name].low <= TRUE[name] <= fit.intervals[name].high
    for name, count in held.items():
        assert 0.90 <= count / sessions <= 0.995, (name, count)  # 95 %, give or take 2.5 deviations of 100


def test_scatter_from_press_to_press_is_told_as_part_of_the_load() -> None:
    told = [fitted(Table(weights(repeats=4), seed, scatter=0.08).readings()).scatter for seed in range(20)]
    assert np.mean(told) == pytest.approx(0.08, rel=0.15)


def test_a_radius_known_badly_widens_k_and_the_sheet_but_not_alpha() -> None:
    readings = Table(weights()).readings()
    well, badly = fitted(readings, 0.002), fitted(readings, 0.2)

    def width(fit: Fit, name: str) -> float:
        return fit.intervals[name].high / fit.intervals[name].low

    assert width(badly, "contact_ohm_mm2") > 1.5 * width(well, "contact_ohm_mm2")
    assert width(badly, "ohm_per_square") > 1.3 * width(well, "ohm_per_square")
    assert width(badly, "alpha") == pytest.approx(width(well, "alpha"), rel=0.1)
    assert "--radius-mm" in " ".join(badly.remarks)


def test_light_weights_alone_do_not_tell_the_sheet_and_that_is_said() -> None:
    fit = fitted(Table(weights("5,10,20,40,80", 4)).readings())
    assert not fit.observed
    assert "sheet's resistance is not observable" in " ".join(fit.remarks)
    assert "heavier" in " ".join(fit.remarks)
    low, high = fit.intervals["ohm_per_square"].low, fit.intervals["ohm_per_square"].high
    assert low < TRUE["ohm_per_square"] < high
    assert fit.intervals["alpha"].low < TRUE["alpha"] < fit.intervals["alpha"].high


@pytest.mark.parametrize(
    ("text", "repeats", "changes", "why"),
    [
        ("50,100", 5, {}, "2 different weights"),
        ("50,100,200", 1, {}, "repeat each weight"),
        ("400,500,600", 3, {}, "span only"),
        ("2000,3000,5000,8000", 3, {"contact_ohm_mm2": 500.0}, "lighter weights"),
        (FIVE, 2, {"scatter": 0.6}, "scatter by"),
    ],
)
def test_readings_that_do_not_suffice_are_told_with_what_to_add(
    text: str, repeats: int, changes: dict[str, float], why: str
) -> None:
    readings = Table(weights(text, repeats), 2, **changes).readings()
    try:
        told = " ".join(fitted(readings).problems)
    except ValueError as error:
        told = str(error)
    assert why in told


def test_weights_that_were_mixed_up_are_named() -> None:
    readings = Table(weights()).readings()
    names = {"100 gf": "200 gf", "200 gf": "100 gf"}
    known = {reading.weight.name: reading.weight for reading in readings}
    swapped = [
        Reading(known[names.get(r.weight.name, r.weight.name)], r.current_a, r.current_std_a, 200, r.place_m)
        for r in readings
    ]
    assert any("200 gf gave less current than 100 gf" in problem for problem in fitted(swapped).problems)


def test_a_foot_that_grows_with_the_weight_does_not_pass_for_a_law() -> None:
    grown = [weights(f"{gf}@{mm}", 6) for gf, mm in ((5, 0.5), (20, 3.5), (100, 0.8), (300, 3.8), (500, 4.5))]
    readings = Table([weight for kind in grown for weight in kind], scatter=0.01).readings()
    claimed = [
        Reading(Weight(r.weight.force_n, 2.5e-3, ""), r.current_a, r.current_std_a, 200, r.place_m)
        for r in readings
    ]
    try:
        told = " ".join(fitted(claimed).problems)
    except ValueError as error:
        told = str(error)
    assert told


def test_weights_are_gram_forces_or_newtons_on_radii_of_their_own() -> None:
    light, heavy = parse_weights(" 50, 200@4 ", "gf", 2.5)
    assert (light.force_n, light.radius_m, light.name) == (50 * GRAM_FORCE_N, 2.5e-3, "50 gf")
    assert heavy.radius_m == pytest.approx(4e-3)
    assert heavy.name == "200 gf on 4 mm"
    assert parse_weights("2", "n", 1.0)[0].force_n == 2
    for wrong in ("", "50,x", "-1", "50@0", "nan", "inf"):
        with pytest.raises(ValueError, match="weight"):
            parse_weights(wrong, "gf", 2.5)


# The session -------------------------------------------------------------------------------------------


def settle(currents: Callable[[float], float], seconds: float = 8.0) -> tuple[float, float] | None:
    """Time [s] and mean of the reading; touched from 0 on, a sample every 5 ms."""
    settling = Settling()
    for k in range(round(seconds / 5e-3)):
        t_s = 5e-3 * k
        sample = Sample(round(t_s * 1e9), True, True, currents(t_s), (0.015, 0.012))
        if (settled := settling.feed(sample)) is not None:
            return t_s, settled[0]
    return None


def test_a_reading_waits_for_the_creep_of_a_real_sheet_and_its_flicker_does_not_hold_it_up() -> None:
    errors, times = [], []
    for seed in range(4):
        sheet = SheetTrack(S1, 1, lambda _: 1.0, seed=seed)
        press = float(sheet.apparent_n(6.0)[0])
        settled = settle(lambda t_s, sheet=sheet: 1e-3 * float(sheet.apparent_n(t_s)[0]))  # type: ignore[misc]
        assert settled is not None
        times.append(settled[0])
        errors.append(settled[1] / (1e-3 * press) - 1)
    assert max(times) < 6.0
    assert np.sqrt(np.mean(np.square(errors))) < 0.02  # flicker of 1 % included


def test_a_reading_that_drifts_on_is_none() -> None:
    assert settle(lambda t_s: 1e-3 * (1 + 0.02 * t_s)) is None
    assert settle(lambda _: 1e-3) is not None


class Desk:
    """The pad of a `Table` by the clock of its samples, as `Session` sees it; `refused`: words of a tare."""

    def __init__(self, table: Table, refused: list[str] | None = None) -> None:
        self._table, self._readings = table, table.readings()
        self.lies: int | None = None
        self.refused = refused or []
        self.t_ns = 0

    def samples(self) -> Iterator[Sample]:
        while True:
            self.t_ns += PERIOD_NS
            if self.lies is None:
                yield Sample(self.t_ns, True)
            else:
                reading = self._readings[self.lies]
                yield Sample(self.t_ns, True, True, reading.current_a, reading.place_m, 0.5)

    def tare(self) -> str:
        return self.refused.pop(0) if self.refused else ""


@dataclass
class Person:
    """Somebody who does as told, and answers questions with `keys`; a Dialogue.

    `put` and `take` move the weights; `instead` (number of the prompt) is how they err.
    """

    put: Callable[[int], None]
    take: Callable[[], None]
    keys: list[Key] = field(default_factory=list)
    instead: dict[int, Key] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)
    pending: list[Key] = field(default_factory=list)
    prompts: int = 0

    @property
    def listens(self) -> bool:
        return bool(self.keys or self.pending)

    def say(self, text: str, style: str = "") -> None:  # noqa: ARG002
        self.said.append(text)
        if "] put " in text:
            number = self.prompts
            self.prompts += 1
            if number in self.instead:
                self.pending.append(self.instead[number])
            else:
                self.put(int(text[1:].split("/")[0]) - 1)
        elif "take it off" in text:
            self.take()
        elif "Enter" in text and self.keys:
            self.pending.append(self.keys.pop(0))

    def show(self, t_ns: int, draw: Callable[[], Text]) -> None:  # noqa: ARG002
        draw()

    def key(self) -> Key | None:
        return self.pending.pop(0) if self.pending else None

    @property
    def text(self) -> str:
        return "\n".join(self.said)


def seated(table: Table, **options: Any) -> tuple[Session, Person, Desk]:
    desk = Desk(table, options.pop("refused", None))
    person = Person(lambda k: setattr(desk, "lies", k), lambda: setattr(desk, "lies", None), **options)
    deployment = deployed()
    place = Place(deployment, deployment.hands[0].pads[0])
    return Session("h/plane", table.weights, place, desk, person, patience_s=5.0), person, desk


def test_a_session_reads_every_weight_up_and_down_and_the_law_follows() -> None:
    guided, person, _ = seated(Table(weights(repeats=2)))
    readings = list(guided.run())
    assert [reading.weight.name for reading in readings[:6]] == [
        f"{n} gf" for n in (20, 50, 100, 200, 500, 500)
    ]
    assert "readings scatter by" in person.text
    fit = fitted(readings)
    for name in PARAMETERS:
        assert fit.intervals[name].low < TRUE[name] < fit.intervals[name].high


def test_zero_is_refused_while_loaded_and_taken_when_asked_again() -> None:
    guided, person, _ = seated(Table(weights(repeats=1)), refused=["it is touched"], keys=[Key.ENTER])
    assert len(list(guided.run())) == 5
    assert "not taken: it is touched" in person.text
    guided, _, _ = seated(Table(weights(repeats=1)), refused=["it is touched"], keys=[Key.QUIT])
    assert list(guided.run()) == []


def test_a_weight_is_left_out_for_good_done_again_or_ends_the_session_by_a_key() -> None:
    guided, _, _ = seated(Table(weights(repeats=2)), instead={1: Key.SKIP, 2: Key.AGAIN})
    names = [reading.weight.name for reading in guided.run()]
    assert names.count("50 gf") == 0
    assert len(names) == 8
    guided, person, _ = seated(Table(weights(repeats=2)), instead={3: Key.QUIT})
    assert len(list(guided.run())) == 3
    assert "what was read is kept" in person.text


def test_a_weight_that_nobody_puts_down_is_told_and_left_out_when_asked() -> None:
    guided, person, desk = seated(Table(weights(repeats=1)), keys=[Key.SKIP])
    person.put = lambda k: setattr(desk, "lies", k if k != 1 else None)
    assert len(list(guided.run())) == 4
    assert "nothing was felt" in person.text


def test_a_weight_near_an_edge_or_beyond_a_channel_s_range_is_refused() -> None:
    deployment = deployed()
    place = Place(deployment, deployment.hands[0].pads[0])
    assert place.complaint((0.015, 0.012), 1e-3) == ""
    assert "middle" in place.complaint((0.027, 0.012), 1e-3)
    assert "end of its range" in place.complaint((0.015, 0.012), 90e-3)


# On file, and drawn ------------------------------------------------------------------------------------


def written(folder: Path, readings: list[Reading]) -> tuple[Path, Path]:
    """A deployment file, and a session recorded on its pad."""
    file, log = folder / "hand.toml", folder / "session.jsonl"
    file.write_text(TEXT)
    deployment = config.load(file)
    nominal = nominal_of(deployment.hands[0].pads[0], deployment)
    with record.Recorder(log) as recorder:
        recorder.head(record.Head("h/plane", nominal, 4711, 0.02, ((1.0,) * 4, (0.01,) * 4)))
        for reading in readings:
            recorder.reading(reading)
    return file, log


def test_a_recorded_session_is_fitted_anew_drawn_and_stored(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    readings = Table(weights()).readings()
    file, log = written(tmp_path, readings)
    assert [replace(reading, told_n=0.0) for reading in record.read(log)[1]] == [
        replace(reading, told_n=0.0) for reading in readings
    ]
    command = ["calibrate", "plane", "--config", str(file), "--from", str(log)]
    picture = tmp_path / "law.png"
    assert cli.main([*command, "--plot", str(picture), "--yes"]) == 0
    told = capsys.readouterr().out
    assert "contact_ohm_mm2" in told
    assert "o" in told.split("+---")[0]
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


def test_too_little_on_file_is_exit_status_1_and_what_is_no_session_2(
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
    ("arguments", "why"),
    [
        (["--weights", "20"], "--config FILE is missing"),
        (["--weights", "20", "--name", "x"], "take either"),
        (["--gains", "1", "1", "1", "1"], "--name NAME is missing"),
        (["--weights", "20", "--from", "f", "--config", "c"], "take either"),
    ],
)
def test_what_does_not_go_together_is_told(
    arguments: list[str], why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["calibrate", "plane", *arguments]) == 2
    assert why in capsys.readouterr().err


def test_the_sketch_shows_every_weight_and_stays_on_its_page() -> None:
    readings = Table(weights()).readings()
    deployment = deployed()
    place = Place(deployment, deployment.hands[0].pads[0])
    lines = plot.sketch(fitted(readings), readings, [place.circuit(r.place_m) for r in readings]).splitlines()
    assert max(map(len, lines)) <= 72
    columns = {k for line in lines for k, sign in enumerate(line) if sign == "o"}
    assert len(columns) == 5


# With a daemon -----------------------------------------------------------------------------------------


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[Daemon, Path, Callable[..., Person]]]:
    """A daemon in a thread, whose node feels what a person puts on it."""
    table = Table(weights("20,60,200,600", 2), scatter=0.03)
    lies: list[int | None] = [None]
    ticks = itertools.count()

    def sample(_: int) -> NDArray[np.int64]:
        k = lies[0]
        return table.hand.sample(
            9.5 + 1e-4 * next(ticks) % 0.3 if k is None else 10 * k + 2 + next(ticks) % 5000 / 1e3
        )

    def person(**options: Any) -> Person:
        return Person(lambda k: lies.__setitem__(0, k), lambda: lies.__setitem__(0, None), **options)

    channel = f"calibrate{next(_numbers)}"
    file = tmp_path / "hand.toml"
    endpoints = "".join(
        f'{stream} = "tcp://127.0.0.1:*"\n' for stream in ("live", "complete", "control", "inputs")
    )
    text = TEXT.replace('channel = "none"', f'channel = "{channel}"')
    text = text.replace("[daemon]\n", f"[daemon]\n{endpoints}")
    file.write_text(text.replace("store.db", str(tmp_path / "store.db")))
    stop = threading.Event()
    with can.Bus(interface="virtual", channel=channel) as wire, Daemon(config.load(file)) as daemon:
        nodes = DeviceBus(wire, sample)
        nodes.add(1, serial=4711)
        nodes.start()
        thread = threading.Thread(target=daemon.run, args=(stop,))
        thread.start()
        try:
            yield daemon, file, person
        finally:
            stop.set()
            thread.join()
            nodes.stop()


def test_weights_on_a_pad_of_a_running_daemon_make_its_forces_true_and_are_stored(
    served: tuple[Daemon, Path, Callable[..., Person]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    daemon, file, person = served
    someone = person()
    for name in ("_CREEP_NS", "_MEAN_NS", "_OFF_NS"):
        monkeypatch.setattr(session, name, 250_000_000)
    monkeypatch.setattr(calibrate, "open_dialogue", lambda: contextlib.nullcontext(someone))
    endpoints = daemon.publisher.endpoints["live"], daemon.control.endpoint
    _until_delivering(endpoints[1])
    log = file.with_name("session.jsonl")
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
    told = capsys.readouterr()
    assert status == 0, someone.text + told.err
    answer = json.loads(told.out)
    assert answer["force_error_before"] > 2 * answer["force_error_after"]
    assert answer["calibration"] == "4711-1"
    now = client.request("calibrate", endpoint=endpoints[1], pad="plane")
    assert now["now"] == "4711-1"
    assert now["law"]["alpha"] == answer["law"]["alpha"]
    assert len(record.read(log)[1]) == 8
    with Store(file.with_name("store.db")) as store:
        version = store.newest(4711)
    assert version is not None
    assert version.config == now["nominal"]


def _until_delivering(control: str) -> None:
    end_s = time.monotonic() + 20
    while client.request("status", endpoint=control)["pads"][0]["node"] != "operational":
        assert time.monotonic() < end_s
        time.sleep(0.05)
