"""`handtouch figures` draws the paper's theoretical figures."""

from __future__ import annotations

from pathlib import Path

import pytest

from handtouch.cli import main
from handtouch.field import figures


def test_all_theoretical_figures_are_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["figures", "--out", str(tmp_path / "new")]) == 0
    drawn = [Path(line) for line in capsys.readouterr().out.split()]
    assert [path.name for path in drawn] == [f"figure_{n}.png" for n in range(2, 8)]
    for path in drawn:
        assert path.read_bytes().startswith(b"\x89PNG")
        assert path.stat().st_size > 20_000


def test_unwritable_folder_is_reported_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert main(["figures", "--out", str(tmp_path / "file" / "folder")]) == 1
    errors = capsys.readouterr().err
    assert len(errors.splitlines()) == 1
    assert "folder" in errors


def test_truncation_of_eq_2_acts_as_a_contact_radius() -> None:
    """Up to the ripple of 45 terms, truncated eq. 2 differs from ln(R / A) / 2 pi by a constant."""
    import numpy as np

    from handtouch.field import Rectangle

    fraction = np.linspace(0.1, 0.9, 33)
    closed = np.log(Rectangle(1.0, 1.0).conformal_radius(fraction, 0.5)) / (2 * np.pi)
    for limit, ripple in ((45, 0.01), (531, 0.001)):
        difference = figures.truncated_double_sum(fraction, limit) - closed
        assert np.ptp(difference) < ripple
