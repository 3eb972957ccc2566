"""Print what a board prints that reads two pads: eight numbers a line, 100 times a second.

A stand-in for a microcontroller with the sensors of config/two_finger.toml; docs/howto.md pipes it into
`handtouch node`. Each pad is touched for a second in turn, along a line; numbers are counts of a 16-bit ADC
without those of the untouched pad, as config/board_node.toml has them.
"""

from __future__ import annotations

import itertools
import random
import sys
import time
from pathlib import Path

from handtouch.config import load
from handtouch.hand import pad_network

CONFIG = Path(__file__).parents[1] / "config" / "two_finger.toml"
RATE_HZ = 100
MA_PER_COUNT, NOISE_COUNTS = 0.0004196, 0.5
TOTAL_MA = 2.0  # of all electrodes, of a touch of about 1 N


def main() -> None:
    deployment = load(CONFIG)
    pads = [entry.pad for entry in deployment.pads]
    networks = [pad_network(pad, deployment.sheets[pad.sheet]) for pad in pads]
    noise, begin_s = random.Random(1), time.monotonic()
    for line in itertools.count():
        counts = [noise.gauss(0.0, NOISE_COUNTS) for _ in range(4 * len(pads))]
        turn, phase = divmod(line, RATE_HZ)
        if phase >= RATE_HZ // 4:  # a pause between two touches
            pad = turn % len(pads)
            along = 0.3 + 0.4 * phase / RATE_HZ
            fractions = networks[pad].fractions(along * networks[pad].a, 0.5 * networks[pad].b)
            for channel, fraction in enumerate(fractions, 4 * pad):
                counts[channel] += fraction * TOTAL_MA / MA_PER_COUNT
        print(", ".join(f"{value:.0f}" for value in counts), flush=True)
        time.sleep(max(0.0, begin_s + (line + 1) / RATE_HZ - time.monotonic()))


if __name__ == "__main__":
    try:
        main()
    except (KeyboardInterrupt, BrokenPipeError):
        sys.exit(0)
