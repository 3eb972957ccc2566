"""Maps from presses at known places, beside what is stated of the pad or without a theory."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from handtouch import config
from handtouch.config import Deployment, load, parse, shipped
from handtouch.core.memory import view_memory
from handtouch.core.pad_model import PadModel
from handtouch.core.stages.rows import VALUE_COUNT, VALUE_SLICES
from handtouch.core.stages.solve import ContactSolver
from handtouch.field.measured import PressTable
from handtouch.field.network import ElectrodeNetwork
from handtouch.field.taxels import TaxelArray
from handtouch.hand import electrode_network
from handtouch.procedures.calibrate.press_map import MapJob, Place, PressCollector, read_places

FloatArray = NDArray[np.float64]
LENGTH_M, WIDTH_M = 30e-3, 24e-3
POSITION_STD_M = 1e-4
GAINS = np.array([1.04, 0.97, 1.02, 0.98])


def two_finger(**sheet: float) -> Deployment:
    deployment = load(shipped.path("two_finger.toml"))
    sheets = {"soft": deployment.sheets["soft"].model_copy(update={"crowding": False} | sheet)}
    return deployment.model_copy(update={"sheets": sheets})


def places(count: int, seed: int) -> FloatArray:
    """Return places (count, 2) [m] on the pad."""
    rng = np.random.default_rng(seed)
    return np.asarray(rng.uniform(0.06, 0.94, (count, 2)) * (LENGTH_M, WIDTH_M))


@pytest.fixture(scope="module")
def true_network() -> ElectrodeNetwork:
    """The first pad with other gaps than stated."""
    deployment = two_finger()
    entry = deployment.pads[0]
    offsets = ((0.4, -0.2), (-0.4, 0.3), (0.3, 0.3), (-0.3, 0.1))
    pad = entry.pad.model_copy(update={"gap_offsets_mm": offsets})
    return electrode_network(pad, deployment.sheet_of(pad)).stretched(math.exp(0.05))


def sheet_signals(network: ElectrodeNetwork, at: FloatArray, seed: int) -> FloatArray:
    """Return currents (k, 4) [mA] of presses at places (k, 2) [m], with gains and noise."""
    rng = np.random.default_rng(seed)
    fractions = network.fractions(at[:, 0] * network.a / LENGTH_M, at[:, 1]).T * GAINS
    return np.asarray(rng.uniform(0.3, 3.0, (len(at), 1)) * fractions + rng.normal(0, 3e-4, fractions.shape))


def written(path: Path, at: FloatArray, signals: FloatArray, force_n: FloatArray | None = None) -> Path:
    noisy = at + np.random.default_rng(9).normal(0, POSITION_STD_M, at.shape)
    path.write_bytes(PressTable.content(noisy, signals, force_n, position_std_m=POSITION_STD_M))
    return path


def with_map(deployment: Deployment, file: Path) -> Deployment:
    (hand,) = deployment.hands
    first = hand.pads[0].model_copy(update={"press_map": str(file)})
    hand = hand.model_copy(update={"pads": (first, *hand.pads[1:])})
    return deployment.model_copy(update={"hands": (hand,)})


def located(model: PadModel, signals: FloatArray, unit: float) -> tuple[FloatArray, FloatArray]:
    """Return places (k, 2) [m] of contacts of the first pad with signals (k, n), and covariances."""
    found, spread = np.zeros((len(signals), 2)), np.zeros((len(signals), 2, 2))
    for number, one in enumerate(signals):
        currents = np.zeros((model.size, model.channels))
        values = np.full((model.size, VALUE_COUNT), np.nan)
        currents[0, : len(one)] = unit * one
        solver = ContactSolver(model, currents, np.zeros(model.size), np.ones(model.size, np.bool_), values)
        solver.solve_contacts(view_memory(np.array([0])))
        found[number] = values[0, VALUE_SLICES["pad_m"]]
        spread[number] = values[0, VALUE_SLICES["covariance_m2"]].reshape(3, 3)[:2, :2]
    return found, spread


def scores(model: PadModel, at: FloatArray, signals: FloatArray, unit: float) -> tuple[float, float]:
    """Return rms error [m], and the share in 95 %, of contacts of a plane pad."""
    found, spread = located(model, signals, unit)
    error = found - at
    squares = np.einsum("ki,kij,kj->k", error, np.linalg.inv(spread), error)
    return float(np.sqrt(np.square(error).sum(axis=1).mean())), float((squares < 5.99).mean())


def test_sixty_presses_halve_the_error_of_an_imperfect_sheet_and_say_how_well(
    tmp_path: Path, true_network: ElectrodeNetwork
) -> None:
    deployment = two_finger(gap_std_mm=0.3, anisotropy_std=0.05)
    at, wanted = places(60, 1), places(60, 2)
    file = written(tmp_path / "presses.npz", at, sheet_signals(true_network, at, 3))
    touches = sheet_signals(true_network, wanted, 4)
    plain = PadModel(deployment)
    stated, _ = scores(plain, wanted, touches, 1e-3)
    model = PadModel(with_map(deployment, file))
    mapped, inside = scores(model, wanted, touches, 1e-3)
    assert mapped < 0.4 * stated
    assert model.default_calibration_ids[0] != plain.default_calibration_ids[0]
    assert mapped < 1e-4
    assert inside >= 0.9


def test_a_pad_without_a_theory_is_located_by_its_presses(tmp_path: Path) -> None:
    text = shipped.path("taxels.toml").read_text(encoding="utf-8")
    deployment = parse(text)
    pad = deployment.pads[1].pad
    array = pad.response.build(pad.surface.build())  # type: ignore[union-attr]
    assert isinstance(array, TaxelArray)
    rng = np.random.default_rng(5)
    at, wanted = rng.uniform(0.5e-3, 11.5e-3, (2, 80, 2))
    force_n = rng.uniform(0.5, 3.0, 80)

    def signals(where: FloatArray) -> FloatArray:
        clean = 0.5 * force_n[:, None] * array.fractions(*where.T).T
        return np.asarray(clean + rng.normal(0, 1e-3, clean.shape))

    file = written(tmp_path / "presses.npz", at, signals(at), force_n)
    measured = f"""
        kind = "measured"
        presses = "{file}"
        names = ["a", "b", "c", "d", "e"]
    """
    begin, end = text.index("[response.barometers]"), text.index("[[hand]]")
    changed = text[:begin] + "[response.barometers]\n" + measured + "\n" + text[end:]
    first = changed.index("[[hand.pad]]")
    only = changed[:first] + changed[changed.index("[[hand.pad]]", first + 1) :]
    one = parse(only.replace(only[only.index("[response.cells]") : only.index("[response.bar")], ""))
    model = PadModel(one)
    assert model.electrodes == [("a", "b", "c", "d", "e")]
    error, inside = scores(model, wanted, signals(wanted), 1.0)
    assert error < 3e-4
    assert inside >= 0.9


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda data: data | {"signals": data["signals"][:, :3]}, "signals of 3 channels; the pad has 4"),
        (lambda data: data | {"x_mm": data["x_mm"] + 50}, "isn't on the pad"),
        (lambda data: {name: data[name] for name in ("x_mm", "signals")}, "lacks y_mm"),
        (lambda data: {name: value[:5] for name, value in data.items()}, "8 presses or more"),
    ],
)
def test_a_file_that_is_no_map_of_the_pad_is_named(tmp_path: Path, change: object, problem: str) -> None:
    at = places(20, 1)
    data = {"x_mm": 1e3 * at[:, 0], "y_mm": 1e3 * at[:, 1], "signals": np.ones((20, 4))}
    np.savez(tmp_path / "presses.npz", **change(data))  # type: ignore[operator]
    text = shipped.path("two_finger.toml").read_text(encoding="utf-8")
    text = text.replace("gap_mm = 0.8", f'gap_mm = 0.8\npress_map = "{tmp_path}/presses.npz"')
    with pytest.raises(config.ConfigError, match=problem):
        parse(text)


def test_presses_of_a_recording_become_a_map_and_say_how_many_are_worth_it(
    tmp_path: Path, true_network: ElectrodeNetwork
) -> None:
    deployment = two_finger(gap_std_mm=0.3, anisotropy_std=0.05)
    job, collector = MapJob(deployment, deployment.pads[0]), PressCollector()
    at = places(48, 1)
    rows = "\n".join(f"{1e3 * x:.3f},{1e3 * y:.3f}" for x, y in at)
    (tmp_path / "places.csv").write_text(f"x_mm,y_mm\n{rows}\n")
    counts = sheet_signals(true_network, at, 3) / (1e3 * PadModel(deployment).ampere_per_count[0])
    zero, t_ns = np.array([5.0, -3.0, 2.0, 1.0]), 0
    for press in counts:
        for step in range(200):
            t_ns += 10_000_000
            if step in (100, 199):
                collector.add_event("begin" if step == 100 else "end")
            collector.add_counts(t_ns, zero + (press if step >= 100 else 0.0))
    assert np.array(collector.presses) == pytest.approx(counts)
    table = job.presses(collector.presses, read_places(tmp_path / "places.csv"), collector.samples, 0.1)
    noise_ma = 1e3 * float(np.median(PadModel(deployment).noise_a[0]))
    assert table.signal_std == pytest.approx(noise_ma / np.sqrt(collector.samples))
    report = job.report(table)
    stated, few, most = report.rows[0], report.rows[1], report.rows[-1]
    assert (stated[0], few[0], most[0]) == (0, 8, 36)
    assert most[1] < 0.5 * stated[1]
    assert not report.suspects
    assert any("36 presses" in line for line in report.lines())
    moved = [Place((0.003, 0.003), np.nan), *read_places(tmp_path / "places.csv")[1:]]
    wrong = job.report(job.presses(collector.presses, moved, collector.samples, 0.1))
    assert 1 in wrong.suspects
