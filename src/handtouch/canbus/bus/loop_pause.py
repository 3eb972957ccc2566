"""Pauses of the loop that receives frames: a stopped process, a stalled host, a slow stage.

Public name: `LoopPause`. Time is an argument [ns].
"""

from __future__ import annotations


class LoopPause:
    """Measures by how much a loop is late: call `begin_wait`, `end_wait` and `end_receive` in each pass.

    Timeouts are extended by that time, so that a stopped host doesn't accuse its nodes. The first
    `allowed_ns` don't count: a loop that is always a little late still detects a lost node.
    """

    def __init__(self, allowed_ns: int) -> None:
        self._allowed_ns = allowed_ns
        self._last_ns: int | None = None  # the last call
        self._late_ns = 0  # before the present wait

    def begin_wait(self, now_ns: int) -> None:
        """Begin to wait for frames."""
        self._late_ns = 0 if self._last_ns is None else now_ns - self._last_ns
        self._last_ns = now_ns

    def end_wait(self, wake_ns: int, now_ns: int) -> int:
        """End the wait that was to last until `wake_ns`; return the pause since `end_receive` [ns]."""
        since_ns = now_ns if self._last_ns is None else self._last_ns
        late_ns = self._late_ns + max(now_ns - max(wake_ns, since_ns), 0)
        self._last_ns = now_ns
        return max(late_ns - self._allowed_ns, 0)

    def end_receive(self, now_ns: int) -> int:
        """Return the pause since `end_wait`, while the waiting frames were read [ns]."""
        late_ns = 0 if self._last_ns is None else now_ns - self._last_ns
        self._last_ns = now_ns
        return max(late_ns - self._allowed_ns, 0)
