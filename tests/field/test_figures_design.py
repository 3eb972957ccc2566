"""The design page: its expected errors are what estimates scatter, and it draws any configured pad."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from handtouch import config, design
from handtouch.field import ContactLaw, ElectrodeNetwork, Plane, Rectangle

CONFIG = Path(__file__).parents[2] / "config" / "utah_mit.toml"


def square(gap: float = 0.001) -> design.PadDesign:
    return design.PadDesign(
        "square",
        Plane(0.03, 0.03),
        ElectrodeNetwork(0.03, 0.03, gap, 2400.0),
        ContactLaw(2e-2, 1.5, 2.5e-3),
        drive_v=5.0,
        full_scale_a=0.01,
        noise_counts=1.0,
        light_n=0.06,
    )


def test_expected_error_is_what_estimates_scatter() -> None:
    pad = square()
    x, y = 0.011, 0.009
    expected, total = design.expected_error(pad, 0.1, x, y)
    currents = total * pad.network.currents(x, y)[:, None]
    noise = pad.noise_a * np.random.default_rng(8).standard_normal((4, 4000))
    found = pad.network.estimate(currents + noise, pad.noise_a)
    assert math.sqrt(np.var(found.x) + np.var(found.y)) == pytest.approx(float(expected), rel=0.05)


def test_expected_error_of_the_ideal_square_is_theorys() -> None:
    """Noise of 1 % of the total: 4.5 % of the side at worst, 10 % from the edges."""
    pad = square(0.0)
    _, total = design.expected_error(pad, 1.0, 0.003, 0.003)
    noisy = replace(pad, noise_counts=0.01 * float(total) / pad.full_scale_a * 2**15)
    error, _ = design.expected_error(noisy, 1.0, 0.003, 0.003)
    assert error / 0.03 == pytest.approx(0.045, abs=0.001)
    assert Rectangle(0.03, 0.03).side_fractions(0.003, 0.003).max() < 0.5


def test_fewer_bits_and_more_resistance_only_cost() -> None:
    pad = square()
    best = design.summary_of(pad, 1.0)
    for worse in (
        replace(pad, bits=12),
        replace(pad, network=pad.network.with_series((336.0,) * 4)),
        replace(pad, noise_counts=3.0),
    ):
        assert all(more > less for more, less in zip(design.summary_of(worse, 1.0), best, strict=True))


@pytest.mark.parametrize("link", ["thumb_middle", "index_distal"])
def test_every_kind_of_pad_is_drawn(link: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert design.run(CONFIG, tmp_path / "new", link=link) == 0
    lines = capsys.readouterr().out.splitlines()
    for line, kind in zip(lines, ("error", "choices"), strict=False):
        assert Path(line) == tmp_path / "new" / f"{link}_{kind}.png"
        assert Path(line).read_bytes().startswith(b"\x89PNG")
    assert "expected location error" in lines[-1]


def test_a_pad_whose_electrodes_touch_is_drawn_too() -> None:
    assert len(design.draw_choices(square(0.0)).axes) == 4


def test_the_first_pad_is_drawn_unless_another_is_named() -> None:
    deployment = config.load(CONFIG)
    assert design.design_of(deployment).name == deployment.hands[0].pads[0].link


def test_a_wrong_file_or_link_is_a_matter_of_usage(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert design.run(tmp_path / "none.toml", tmp_path) == 2
    assert design.run(CONFIG, tmp_path, link="tail") == 2
    said = capsys.readouterr().err
    assert "none.toml" in said
    assert "tail" in said
    assert "thumb_distal" in said


def test_where_nothing_can_be_written_one_line_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert design.run(CONFIG, tmp_path / "file" / "folder") == 1
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert "folder" in said
