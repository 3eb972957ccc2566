"""Rows of named numbers in the state: contacts in the palm and base frames.

Public names: `FRAME_ROW`, `PART_FRAMES`, `CONTACT_FRAMES`. Here, since the stage that writes them takes the
state.
"""

from __future__ import annotations

import numpy as np

FRAME_ROW = np.dtype([("position_m", "<f8", 3), ("normal", "<f8", 3), ("covariance_m2", "<f8", 9)])
"""A contact in one frame"""
PART_FRAMES = np.dtype([("palm", FRAME_ROW), ("base", FRAME_ROW)])
"""One of two contacts on a pad"""
CONTACT_FRAMES = np.dtype([("palm", FRAME_ROW), ("base", FRAME_ROW), ("joints_age_s", "<f8")])
"""A contact, and the age of the joints that it was transformed by"""
