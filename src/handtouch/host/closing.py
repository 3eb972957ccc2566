"""Context managers by a method `close`.

Public names: `Closing`, `AsyncClosing`.
"""

from __future__ import annotations

from typing import Self


class Closing:
    """A context manager that calls `close` at its end."""

    def close(self) -> None:
        """Release what it holds."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class AsyncClosing(Closing):
    """The same, for asyncio too."""

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()
