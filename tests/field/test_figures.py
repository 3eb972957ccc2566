"""The drawn figures exist, are pictures, and say what theory says."""

from __future__ import annotations

import builtins
from pathlib import Path
from typing import Any

import pytest

from handtouch import figures


def test_all_theoretical_figures_of_the_paper_are_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert figures.run(tmp_path / "new") == 0
    drawn = [Path(line) for line in capsys.readouterr().out.split()]
    assert [path.name for path in drawn] == [f"figure_{n}.png" for n in range(2, 8)]
    for path in drawn:
        assert path.read_bytes().startswith(b"\x89PNG")
        assert path.stat().st_size > 20_000


def test_without_matplotlib_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real = builtins.__import__

    def refuse(name: str, *rest: Any, **more: Any) -> Any:
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", refuse)
    assert figures.run(tmp_path) == 1
    assert "handtouch[figures]" in capsys.readouterr().err


def test_where_nothing_can_be_written_one_line_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert figures.run(tmp_path / "file" / "folder") == 1
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert "folder" in said


def test_the_cut_off_sum_of_fig_7_is_a_contact_radius() -> None:
    """Up to the ripple of 45 terms, eq. 2 cut off differs from ln(R / A) / 2 pi by a constant."""
    import numpy as np

    from handtouch.field import Rectangle

    fraction = np.linspace(0.1, 0.9, 33)
    closed = np.log(Rectangle(1.0, 1.0).conformal_radius(fraction, 0.5)) / (2 * np.pi)
    for limit, ripple in ((45, 0.01), (531, 0.001)):
        difference = figures._double_sum(fraction, limit) - closed
        assert np.ptp(difference) < ripple
