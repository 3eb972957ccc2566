"""Advice on two films instead of a sheet: by noise alone, and beside what the daemon states of such a pad."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from handtouch.cli import main
from handtouch.config import load, parse, shipped
from handtouch.core.memory import view_memory
from handtouch.core.pad_model import PadModel
from handtouch.core.stages.rows import VALUE_COUNT, VALUE_SLICES
from handtouch.core.stages.solve import ContactSolver
from handtouch.design.films import FILM_OHM, LEAD_STD_OHM, film_position_std
from handtouch.design.goals import position_std
from handtouch.design.pad_task import PadTask

GAIN_STD = 0.01


def task(*, nominal: bool) -> PadTask:
    """Return the plane fingertip of the gripper, with errors of gains."""
    deployment = load(shipped.path("two_finger.toml"))
    nodes = {name: node.model_copy(update={"gain_std": GAIN_STD}) for name, node in deployment.nodes.items()}
    stated = deployment.model_copy(update={"nodes": nodes})
    return PadTask.from_deployment(stated, "thumb_tip", 1.0, nominal=nominal)


def film_pad() -> PadModel:
    """Return the same pad as two films."""
    text = shipped.path("two_layers.toml").read_text(encoding="utf-8")
    text = text[: text.rindex("[[hand.pad]]")]
    exact = ("contact_elongation_std", "contact_tilt_std", "unevenness_std", "size_std_mm")
    for old, new in (
        ("cylinder", "plane"),
        ("radius_mm = 12.0, length_mm = 24.0, arc_deg = 120.0", "length_mm = 30.0, width_mm = 24.0"),
        ("full_scale_ma = 60.0", f"full_scale_ma = 10.0\ngain_std = {GAIN_STD}"),
        ("alpha = 1.2", "alpha = 1.5\n" + "\n".join(f"{key} = 0.0" for key in exact)),
        ("ohm_per_square = 400.0", f"ohm_per_square = {FILM_OHM}"),
    ):
        assert old in text
        text = text.replace(old, new)
    return PadModel(parse(text))


def test_by_noise_alone_two_films_are_better_at_the_worst_place() -> None:
    pad = task(nominal=True)
    sheet, films = position_std(pad, pad.configured), film_position_std(pad)
    assert films.max() < 0.4 * sheet.max()
    assert films.max() < 1.5 * films.min()  # the same up to the edges


def test_what_is_advised_of_two_films_is_what_the_daemon_states_of_them() -> None:
    pad, model = task(nominal=False).with_points(3), film_pad()
    advised = film_position_std(pad, LEAD_STD_OHM)
    for place, expected in zip(np.stack(pad.grid, axis=1), advised, strict=True):
        currents, values = np.zeros((1, model.channels)), np.full((1, VALUE_COUNT), np.nan)
        currents[0] = model.centre_current(0, 1.0) / 2 * model.networks[0].fractions(*place)
        solver = ContactSolver(model, currents, np.zeros(1), np.ones(1, np.bool_), values)
        solver.solve_contacts(view_memory(np.array([0])))
        covariance = values[0, VALUE_SLICES["covariance_m2"]].reshape(3, 3)
        assert np.sqrt(covariance.trace()) == pytest.approx(expected, rel=0.05)


def test_the_command_states_both(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["design", str(shipped.path("two_finger.toml")), "--goal", "position", "--world", "ideal"]
    assert main([*command, "--max-series-ohm", "0", "--no-check", "-o", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    sheet, known, unknown = (
        float(re.search(pattern, printed)[1])  # type: ignore[index]
        for pattern in (r"after +([\d.]+) mm", r"four wires: ([\d.]+) mm", r"([\d.]+) mm where leads")
    )
    assert known < 0.4 * sheet < unknown
