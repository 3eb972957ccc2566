"""How long tests took in earlier sessions: the longest files begin first, `--within` takes the fastest tests.

Public name: `Durations`, a plugin of pytest.
"""

from __future__ import annotations

import json
import os
from collections import defaultdict
from pathlib import Path

import pytest

UNKNOWN_S, UNKNOWN_PROCESSES_S = 0.1, 10.0
"""What a test that was never measured may take, and one of end_to_end/ or of installations."""


class Durations:
    """Durations [s] of tests' set-up and of the rest, in a file that each session brings up to date.

    A set-up may serve its whole file: each test counts all of those, a choice of tests counts them once.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._known = self._read()
        self._measured: dict[str, list[float]] = {}

    def sort(self, items: list[pytest.Item]) -> None:
        """Sort by files, longest first."""
        length_s = defaultdict[str, float](float)
        for item in items:
            length_s[file_of(item.nodeid)] += sum(self._expected(item.nodeid))
        items.sort(key=lambda item: -length_s[file_of(item.nodeid)])

    def fastest(self, items: list[pytest.Item], seconds: float) -> list[pytest.Item]:
        """Return the fastest tests that take so long together."""
        known = {item.nodeid: self._expected(item.nodeid) for item in items}
        setup_s = defaultdict[str, float](float)
        for test, (own_s, _) in known.items():
            setup_s[file_of(test)] += own_s
        left_s, files, taken = seconds, set[str](), set[str]()
        for test in sorted(known, key=lambda test: known[test][1] + setup_s[file_of(test)]):
            left_s -= known[test][1] + (0.0 if file_of(test) in files else setup_s[file_of(test)])
            if left_s < 0:
                break
            files.add(file_of(test))
            taken.add(test)
        return [item for item in items if item.nodeid in taken]

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add up a test's phases; one that is skipped tells nothing."""
        if not report.skipped:
            self._measured.setdefault(report.nodeid, [0.0, 0.0])[report.when != "setup"] += report.duration

    def pytest_sessionfinish(self) -> None:
        """Write, but for xdist's workers, whose reports reach their controller, and beside it in vcan-run."""
        if self._measured and not {"PYTEST_XDIST_WORKER", "VCAN_RUN"} & os.environ.keys():
            rounded = {test: [round(part_s, 3) for part_s in both] for test, both in self._measured.items()}
            self._path.parent.mkdir(parents=True, exist_ok=True)
            part = self._path.with_suffix(f".{os.getpid()}")
            part.write_text(json.dumps(self._read() | rounded, indent=0))
            part.replace(self._path)  # whole at any time

    def _expected(self, test: str) -> list[float]:
        processes = "end_to_end" in test or test.count("/") == 1
        return self._known.get(test) or [0.0, UNKNOWN_PROCESSES_S if processes else UNKNOWN_S]

    def _read(self) -> dict[str, list[float]]:
        return dict(json.loads(self._path.read_text())) if self._path.exists() else {}


def file_of(test: str) -> str:
    """Return the file in a test's id."""
    return test.partition("::")[0]
