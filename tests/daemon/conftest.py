"""The deployment and model of the core's tests."""

from tests.core.conftest import Bench, bench

__all__ = ["Bench", "bench"]
