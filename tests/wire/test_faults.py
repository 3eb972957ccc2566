"""Fault kinds are identifiers with a description, documented where they are diagnosed or played."""

from __future__ import annotations

from pathlib import Path

import pytest

from handtouch.simulate.faults import FAULTS, INFLUENCES
from handtouch.wire.faults import FaultKind

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize("kind", FaultKind)
def test_every_kind_is_described_and_documented(kind: FaultKind) -> None:
    assert kind.value.replace("_", "").isalpha()
    assert kind.description
    assert any(f"`{kind}`" in (DOCS / page).read_text() for page in ("supervise.md", "simulate.md"))


def test_simulated_faults_are_kinds() -> None:
    assert {FaultKind(kind) for kind in (*FAULTS, *INFLUENCES)} < set(FaultKind)
