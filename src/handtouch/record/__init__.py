"""Touches kept: record what a daemon publishes as MCAP, read it back, export it, draw it.

`Recording` (in `read.py`) reads a recording. Making contacts again from one is `daemon/rerun.py`.
"""
