"""Hypothesis for this folder: how long an example takes says nothing on shared cores, so no deadline."""

from __future__ import annotations

from hypothesis import settings

settings.register_profile("shared cores", deadline=None)
settings.load_profile("shared cores")
