"""Rows of named numbers: contacts in the palm and base frames and their slip, settings of a pad.

Public names: `FRAME_ROW`, `PART_FRAMES`, `CONTACT_FRAMES`, `SLIP_ROW`, `SLIP_ONSETS`, `SLIP_RAMP_BLOCKS`,
`SHEAR_CHANNELS`, `TOUCH_ROW`. They are here, since the stages that write them take the state.
"""

from __future__ import annotations

import numpy as np

from handtouch.config import Touch
from handtouch.core.memory import number_row

FRAME_ROW = np.dtype([("position_m", "<f8", 3), ("normal", "<f8", 3), ("covariance_m2", "<f8", 9)])
"""A contact in one frame"""
PART_FRAMES = np.dtype([("palm", FRAME_ROW), ("base", FRAME_ROW)])
"""One of two contacts on a pad"""
CONTACT_FRAMES = np.dtype([("palm", FRAME_ROW), ("base", FRAME_ROW), ("joints_age_s", "<f8")])
"""A contact, and the age of the joints that it was transformed by"""

TOUCH_ROW = number_row(Touch)
"""Keys of `[touch]`, of one pad"""

SHEAR_CHANNELS = 4
"""Electrodes of a shear pad: x0, xa, y0, yb"""
SLIP_ONSETS, SLIP_RAMP_BLOCKS = 33, 8
"""Onset hypotheses; what is known of a ramp from each, see `slip`"""
SLIP_ROW = np.dtype(
    [
        ("label", "<f8"),  # index of `slip.MOTION_CLASSES`
        ("log_odds", "<f8"),  # ln of the odds of slip
        ("slipping", "<f8"),  # 1 while the centroid moves
        ("slips", "<f8"),  # of this contact so far
        ("samples", "<f8"),
        ("age_s", "<f8"),  # from its first sample to its last
        ("position_m", "<f8", 2),  # on the pad, filtered
        ("velocity_m_per_s", "<f8", 2),
        ("position_variance", "<f8", 2),
        ("mixed_variance", "<f8", 2),  # covariance of position and velocity
        ("velocity_variance", "<f8", 2),
        ("force_n", "<f8"),  # smoothed
        ("force_rate_n_per_s", "<f8"),
        ("force_rate_std", "<f8"),
        ("firm_current_a", "<f8"),
        ("peak_current_a", "<f8"),
        ("slip_start_m", "<f8", 2),  # position at the onset
        ("rest_s", "<f8"),  # of a centroid that slipped
        ("log_ratio", "<f8"),  # ln R
        ("onset_age_s", "<f8"),  # of the likeliest onset, where slip is likely
        ("slip_velocity_m_per_s", "<f8", 2),  # since that onset
        ("first_press", "<f8"),  # currents over that of a firm contact
        ("last_press", "<f8"),
        ("before_press", "<f8"),
        ("press_noise", "<f8"),
        ("tested", "<f8"),  # samples since the test began
        ("until_onset", "<f8"),  # samples
        ("onset_number", "<f8"),
        ("learning_s", "<f8"),
        ("log_tremor_variance", "<f8", 2),  # as learnt
        ("grip_log_tremor_variance", "<f8", 2),  # before the slip
        ("motion", "<f8", (2, 4)),
        ("covariance", "<f8", (2, 10)),
        ("onset_ages_s", "<f8", SLIP_ONSETS),  # 0: unused
        ("ramps", "<f8", (2, SLIP_RAMP_BLOCKS, SLIP_ONSETS)),
        ("log_creep_variance", "<f8", (2, SLIP_ONSETS)),
        ("grip_log_creep_variance", "<f8", (2, SLIP_ONSETS)),  # before the slip
        ("last_m", "<f8", 2),
        ("last_noise_m2", "<f8"),
    ]
)
"""A contact of a pad; of pairs the first is along x, the second along y"""
