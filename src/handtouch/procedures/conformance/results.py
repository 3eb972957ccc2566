"""Results of the checks of one node, and their JSON form."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any

from handtouch.canbus.nodes.spec import Identity
from handtouch.procedures.conformance.catalogue import CATALOGUE


class Verdict(StrEnum):
    """Result of a check."""

    PASSED = "passed"
    FAILED = "failed"
    NOT_TESTED = "not tested"


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Result of one check; `detail`: what was measured or found, or why it was not tested."""

    name: str
    verdict: Verdict
    detail: str = ""

    @property
    def remedy(self) -> str:
        """Remedy of a failed check, else empty."""
        return CATALOGUE[self.name].remedy if self.verdict is Verdict.FAILED else ""


@dataclass(frozen=True, slots=True)
class RateMeasurement:
    """TPDOs at one SYNC period: delays from SYNC to the last TPDO of a sample [us]; None without any.

    `missing`: SYNCs without a sample; `extra`: samples beyond one per SYNC; `late`: outside the window;
    `worst_sync_error_us`: largest deviation of the SYNC period that this computer produced.
    """

    period_ms: float
    syncs: int
    missing: int
    extra: int
    late: int
    median_us: float | None
    p99_us: float | None
    max_us: float | None
    jitter_us: float | None
    """standard deviation"""
    worst_sync_error_us: float


@dataclass(slots=True)
class NodeReport:
    """All results of one node, in the order of the catalogue.

    `channel_noise`: standard deviation of each channel in counts, empty without samples.
    `restored`: everything that the procedure changed was set back; else `restore_problem` has the cause.
    """

    bus: str
    node_id: int
    pad: str
    identity: Identity | None = None
    rates: list[RateMeasurement] = field(default_factory=list)
    channel_noise: list[float] = field(default_factory=list)
    restore_problem: str = ""
    _results: dict[str, CheckResult] = field(default_factory=dict)

    def passed(self, name: str, detail: str = "") -> None:
        """Record a passed check, unless it has failed before."""
        self._record(name, Verdict.PASSED, detail)

    def failed(self, name: str, detail: str) -> None:
        """Record a failed check; several details of one check are joined."""
        before = self._results.get(name)
        if before is not None and before.verdict is Verdict.FAILED:
            detail = f"{before.detail}; {detail}"
        self._results[_known(name)] = CheckResult(name, Verdict.FAILED, detail)

    def not_tested(self, why: str, *names: str) -> None:
        """Record checks that were not made, unless they have a result."""
        for name in names:
            self._record(name, Verdict.NOT_TESTED, why)

    def assess(self, name: str, problems: list[str], detail: str = "") -> None:
        """Record a check that passes without problems."""
        if problems:
            self.failed(name, "; ".join(problems))
        else:
            self.passed(name, detail)

    def verdict(self, name: str) -> Verdict | None:
        """Return the verdict of a check, None before it has one."""
        result = self._results.get(name)
        return None if result is None else result.verdict

    @property
    def results(self) -> list[CheckResult]:
        """Results in the order of the catalogue."""
        return [self._results[name] for name in CATALOGUE if name in self._results]

    @property
    def failures(self) -> list[CheckResult]:
        """Failed checks."""
        return [result for result in self.results if result.verdict is Verdict.FAILED]

    @property
    def ok(self) -> bool:
        """True if no check failed and the node is as it was."""
        return not self.failures and not self.restore_problem

    def complete(self, why: str) -> None:
        """Mark all checks without a result as not tested."""
        self.not_tested(why, *CATALOGUE)

    def to_map(self) -> dict[str, Any]:
        """Return the report as JSON values."""
        return {
            "bus": self.bus,
            "node_id": self.node_id,
            "pad": self.pad,
            "ok": self.ok,
            "identity": None if self.identity is None else asdict(self.identity),
            "checks": [
                {
                    "check": result.name,
                    "verdict": result.verdict.value,
                    "detail": result.detail,
                    "tests": CATALOGUE[result.name].tests,
                    "remedy": result.remedy,
                }
                for result in self.results
            ],
            "rates": [asdict(rate) for rate in self.rates],
            "channel_noise": self.channel_noise,
            "restore_problem": self.restore_problem,
        }

    def _record(self, name: str, verdict: Verdict, detail: str) -> None:
        self._results.setdefault(_known(name), CheckResult(name, verdict, detail))


def count_verdicts(report: NodeReport) -> Iterator[tuple[Verdict, int]]:
    """Yield each verdict with its number of checks."""
    for verdict in Verdict:
        yield verdict, sum(result.verdict is verdict for result in report.results)


def _known(name: str) -> str:
    if name not in CATALOGUE:
        raise KeyError(f"no check {name}")
    return name
