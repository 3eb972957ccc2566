"""Table of claims: a check's figures beside those measured with the checked estimators, and now.

Public names: `Figure`, `Claim`, `write_page`.
"""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scores import MIN_TOUCHES, ClusterShare, Share

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Figure:
    """A measured figure with its 95 % interval."""

    value: float
    low: float
    high: float

    @classmethod
    def of_share(cls, share: Share | ClusterShare) -> Figure:
        """Return a share in per cent."""
        return cls(100 * share.value, *(100 * limit for limit in share.interval))

    @classmethod
    def of_ratios(cls, ratios: FloatArray) -> Figure:
        """Return the mean of independent ratios."""
        reach = 1.96 * float(ratios.std(ddof=1)) / math.sqrt(len(ratios))
        return cls(float(ratios.mean()), float(ratios.mean()) - reach, float(ratios.mean()) + reach)

    def __str__(self) -> str:
        return f"{self.value:.3g} ({self.low:.3g} to {self.high:.3g})"


@dataclass(frozen=True)
class Claim:
    """A row: what was checked, the check's figures, the conditions here, and why figures may differ."""

    title: str
    unit: str
    check: tuple[float, ...]
    """One figure, or the ends of a range."""
    conditions: str
    as_share: bool = True
    """A share in %."""
    trials: int = MIN_TOUCHES
    """Of the check, for its sampling error; where they aren't known, those of a slice here."""
    why: str = ""
    """Tested reason for a figure that differs."""

    def agrees(self, figure: Figure) -> bool:
        """Return whether a figure is the check's within the sampling error of both."""
        low, high = min(self.check), max(self.check)
        near = min(max(figure.value, low), high)
        if self.as_share:
            ends = Share(round(near / 100 * self.trials), self.trials).interval
            reach = 100 * ends[1] - near if figure.value > near else near - 100 * ends[0]
        else:
            reach = 0.02 * abs(near)
        own = figure.high - figure.value if near > figure.value else figure.value - figure.low
        return abs(figure.value - near) <= math.hypot(reach, own)


HEAD = """\
An independent check, with seeds, pads, sheets and scenes of its own, found that what handtouch states
about its accuracy held mainly in the worlds that its benchmarks drew. Each of its figures is measured
here again, in worlds of the reporting family and with the daemon's settings. *As found*: with the
estimators that were checked, at commit `{commit}`; *now*: with those of this page's commit, which may be
better. Intervals are 95 %; touches of one pad, which share its hidden quantities, count as a cluster.
*Agrees*: the figure as found and the check's differ by no more than the sampling error of both; that of
the check is taken as of {touches} touches where it doesn't state their number, and as 2 % for errors."""


def write_page(
    rows: Sequence[tuple[Claim, Figure]], before: dict[str, Any], stamp: str, folder: Path
) -> None:
    """Write claims.{md,json}; `before`: commit, figures and other settings as found."""
    lines = [
        "# Claims about accuracy, checked",
        "",
        f"{stamp}; {platform.machine()}, numpy {np.__version__}.",
        "",
    ]
    lines += [HEAD.format(commit=before["commit"], touches=MIN_TOUCHES), ""]
    lines += ["| claim | unit | conditions here | check | as found | agrees | now |", "|" + " --- |" * 7]
    notes: list[str] = []
    for claim, now in rows:
        known = before["figures"].get(claim.title)
        found = Figure(**known) if known else None
        check = " to ".join(f"{value:.3g}" for value in claim.check).replace(" to inf", " and more")
        agrees = "" if found is None else "yes" if claim.agrees(found) else "no"
        if agrees == "no":
            notes.append(f"* {claim.title}: {claim.why or 'no reason was found'}")
        cells = (claim.title, claim.unit, claim.conditions, check, found or "", agrees, now)
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    if notes:
        lines += ["", "Where figures as found differ from the check's:", "", *notes]
    if others := before.get("other_settings", ()):
        lines += ["", "## As found, in other settings", ""]
        lines += [
            f"With the estimators of commit `{before['commit']}`; shares in %, rms errors in % of 5 N.",
            "",
        ]
        lines += ["| quantity | setting | found |", "|" + " --- |" * 3]
        lines += [f"| {row['quantity']} | {row['setting']} | {Figure(*row['found'])} |" for row in others]
    (folder / "claims.md").write_text("\n".join([*lines, ""]))
    record = {claim.title: asdict(figure) for claim, figure in rows}
    (folder / "claims.json").write_text(json.dumps(record, indent=1).replace("NaN", "null") + "\n")
    print("\n".join(lines))
