"""Units that aren't SI, in SI units, and standard gravity.

Public names: `GRAM_FORCE_N`, `GRAVITY_M_S2`.
"""

GRAVITY_M_S2 = 9.80665
"""Standard gravity"""
GRAM_FORCE_N = 1e-3 * GRAVITY_M_S2
"""Weight of one gram [N] at standard gravity."""
