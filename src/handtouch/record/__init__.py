"""Touches kept: record what a daemon publishes as MCAP, read it back, export it, draw it.

Public names: `Recording`. Making contacts again from a recording is `daemon/rerun.py`.
"""

from handtouch.record.read import Recording

__all__ = ["Recording"]
