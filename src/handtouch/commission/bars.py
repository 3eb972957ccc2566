"""The four channels of a node as bars, for a terminal.

Public name: `bars`.
"""

from __future__ import annotations

import numpy as np
from rich.text import Text

from .press import PRESSED, PressDetector

_BAR = 40


def bars(slot: int, name: str, detector: PressDetector) -> Text:
    """The channels of a slot, on a scale to the strongest, from the least that counts as a press."""
    deltas = detector.deltas[slot]
    scale = max(float(np.abs(deltas).max()), PRESSED * float(detector.noise[slot]) / 2)
    pressed = detector.level[slot] > PRESSED
    text = Text()
    for channel, delta in enumerate(deltas.tolist(), 1):
        filled = round(_BAR * abs(delta) / scale)
        text.append(f"  {channel} ", "dim")
        text.append("█" * filled, "cyan" if pressed else "dim")
        text.append("·" * (_BAR - filled), "dim")
        text.append(f" {delta:+7.0f}\n")
    text.append(f"  {name}   a: again, s: skip, q: quit", "dim")
    return text
