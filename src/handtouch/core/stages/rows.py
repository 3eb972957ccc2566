"""Rows of named numbers: contacts, also in the palm and base frames, their slip; settings of a pad.

Public names: `VALUE_ROW`, `VALUE_SLICES`, `VALUE_COUNT`, `PART_ROW`, `PART_SLICES`, `PART_COUNT`,
`PARTS_COUNT`, `MOUNT_ROW`, `MOUNT_COUNT`, `MISFIT_ROW`, `MISFIT_COUNT`, `FRAME_ROW`, `PART_FRAMES`,
`CONTACT_FRAMES`, `SLIP_ROW`, `SLIP_ONSETS`, `SLIP_RAMP_BLOCKS`, `SHEAR_CHANNELS`, `TOUCH_ROW`. They are here,
since the stages that write them take the state or the model.
"""

from __future__ import annotations

import numpy as np

from handtouch.config import Touch
from handtouch.core.memory import number_row, row_count, slices_of

VALUE_ROW = np.dtype(
    [
        ("xy", "<f8", 2),  # on the pad's rectangle
        ("pad_m", "<f8", 2),
        ("residual", "<f8"),
        ("position_m", "<f8", 3),
        ("normal", "<f8", 3),
        ("force_n", "<f8"),
        ("force_std_n", "<f8"),
        ("residual_std", "<f8"),  # from channel noise and baseline
        ("covariance_m2", "<f8", 9),  # without that of the mount
        ("mount_covariance_m2", "<f8", 9),
        ("pad_noise_m2", "<f8", 3),  # of pad_m from channel noise: uu, uv, vv
        ("force_status", "<f8"),  # of `stages.force`
        ("cells", "<f8", 2),  # position in the pad's table, where the next tick starts from
        ("squared_misfit", "<f8"),  # of a point, see MAX_SQUARED_MISFIT
        ("is_bound", "<f8"),  # 1 where saturated channels leave the position open
        ("contact_radius_m", "<f8"),
        ("contact_radius_std_m", "<f8"),
        ("contact_radius_status", "<f8"),  # ContactRadiusStatus
        ("length_m", "<f8"),  # of its elongation, see `stages.elongation`
        ("min_length_m", "<f8"),
        ("max_length_m", "<f8"),
        ("length_axis", "<f8", 3),
        ("length_axis_std_rad", "<f8"),
    ]
)
VALUE_SLICES = slices_of(VALUE_ROW)
"""Layout of a row of values."""
VALUE_COUNT = row_count(VALUE_ROW)
PART_ROW = np.dtype(
    [
        ("position_m", "<f8", 3),
        ("normal", "<f8", 3),
        ("covariance_m2", "<f8", 9),
        ("force_n", "<f8"),
        ("force_std_n", "<f8"),
        ("id", "<f8"),  # this and the following stay while there is one contact
        ("place", "<f8", 2),  # on the pad's rectangle
        ("newest_id", "<f8"),  # of the pad, in the first of two
    ]
)
PART_SLICES = slices_of(PART_ROW)
"""Layout of one of two contacts on a pad; a row of parts has two of them, NaN where there is one contact."""
PART_COUNT, PARTS_COUNT = row_count(PART_ROW), 2 * row_count(PART_ROW)
MOUNT_ROW = np.dtype(
    [
        ("origin_m", "<f8", 3),  # of the pad on its link
        ("position_variance_m2", "<f8"),  # of that along each axis
        ("rotation_variance_rad2", "<f8"),  # and about it
    ]
)
"""A pad's mount"""
MOUNT_COUNT = row_count(MOUNT_ROW)
MISFIT_ROW = np.dtype(
    [
        ("mean_square", "<f8"),  # running mean of the squared misfits of the contacts before
        ("weighted_sum", "<f8"),  # of the last: sum of those of its samples, times the square of the current
        ("weight_sum", "<f8"),  # sum of these squares
    ]
)
"""Misfits of a pad's contacts"""
MISFIT_COUNT = row_count(MISFIT_ROW)

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
