"""Counter of rejected connections and messages by cause, with rate-limited warnings.

Public name: `CauseCounter`.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping

_LOG_REPEAT_PERIOD_NS = 10_000_000_000


class CauseCounter:
    """Counts events by cause; logs the first of each cause at once, then one line per 10 s with their number.

    `counts` (cause -> events), `last_problem` (text of the latest event). `texts` describe the causes.
    """

    def __init__(self, log: logging.Logger, subject: str, texts: Mapping[str, str]) -> None:
        self.counts: Counter[str] = Counter()
        self.last_problem = ""
        self._log, self._subject, self._texts = log, subject, texts
        self._last_logged: dict[str, tuple[int, int]] = {}

    def add(self, cause: str, detail: str, now_ns: int, events: int = 1) -> None:
        """Count an event or several, and log it if its cause was not logged in the last 10 s."""
        self.counts[cause] += events
        self.last_problem = self._texts[cause] + (f": {detail}" if detail else "")
        last_ns, last_count = self._last_logged.get(cause, (now_ns - _LOG_REPEAT_PERIOD_NS, 0))
        if now_ns - last_ns < _LOG_REPEAT_PERIOD_NS:
            return
        more = self.counts[cause] - last_count - events
        suffix = f"; {more} more since the last report" if more else ""
        self._log.warning("%s: %s%s", self._subject, self.last_problem, suffix)
        self._last_logged[cause] = now_ns, self.counts[cause]
