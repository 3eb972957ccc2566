"""Bars of a node's channels, for a terminal.

Public name: `render_channel_bars`.
"""

from __future__ import annotations

import numpy as np
from rich.text import Text

from handtouch.procedures.commission.press import PRESS_THRESHOLD_SIGMA, PressDetector

_BAR_COLUMNS = 40


def render_channel_bars(slot: int, name: str, detector: PressDetector, channels: int) -> Text:
    """Return bars of a slot's first `channels`, scaled to the strongest, at least to half the press
    threshold.
    """
    deltas = detector.deltas[slot, :channels]
    scale = max(float(np.abs(deltas).max()), PRESS_THRESHOLD_SIGMA * float(detector.noise_counts[slot]) / 2)
    pressed = detector.level_sigma[slot] > PRESS_THRESHOLD_SIGMA
    text = Text()
    for channel, delta in enumerate(deltas.tolist(), 1):
        filled = round(_BAR_COLUMNS * abs(delta) / scale)
        text.append(f"  {channel} ", "dim")
        text.append("█" * filled, "cyan" if pressed else "dim")
        text.append("·" * (_BAR_COLUMNS - filled), "dim")
        text.append(f" {delta:+7.0f}\n")
    text.append(f"  {name}   a: again, s: skip, q: quit", "dim")
    return text
