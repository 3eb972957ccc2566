"""Make docs/diagnoses.png: the four currents of a simulated pad with each fault, during the same presses.

Usage: diagnoses_picture.py
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from handtouch import config
from handtouch.config import shipped
from handtouch.simulate.faults import FAULTS
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS

matplotlib.use("Agg")
from matplotlib import pyplot as plt

PICTURE = Path(__file__).parent / "diagnoses.png"
LINK, BEGIN_S, LENGTH_S, RATE_HZ = "palm_thumb", 8.0, 24.0, 50
PRESSES = ((0.22, 0.42), (0.78, 0.42), (0.42, 0.22), (0.42, 0.78))
"""Positions of presses, one after another: beside x0, xa, y0, yb, as fractions of the pad."""
CHANNELS = {"x0": "#1f6fb4", "xa": "#c23b22", "y0": "#2e8b57", "yb": "#e0a030"}
FAULTS_SHOWN: dict[str, dict[str, Any]] = {
    "healthy": {},
    "gum": {"kind": "gum", "place": (0.7, 0.3), "force_n": 0.4, "press_n": 0.9, "radius_mm": 3.0},
    "moisture": {"kind": "moisture", "place": (0.4, 0.6), "leak_ohm": 12000.0, "grow_s": 10.0},
    "hysteresis_tail": {},
    "torn_corner": {"kind": "torn_corner", "corner": "x0y0", "along_x_mm": 18.0, "along_y_mm": 18.0},
    "dead_electrode: x0": {"kind": "dead_electrode", "electrode": "x0"},
    "shorted_electrode: x0 to the layer": {"kind": "shorted_electrode", "electrode": "x0"},
    "swapped_cables: x0 and y0": {"kind": "swapped_cables", "order": ("y0", "xa", "x0", "yb")},
    "saturated_channel: x0": {"kind": "saturated_channel", "electrode": "x0"},
    "stuck_channel: x0": {"kind": "stuck_channel", "electrode": "x0", "count": 300},
    "offset: x0": {"kind": "offset", "electrode": "x0", "counts": 250.0},
    "gain_step: x0": {"kind": "gain_step", "electrode": "x0", "factor": 2.0},
}


def touches(name: str) -> list[ScenarioTouch]:
    """Return the same presses for all, and a press with its tail."""
    made = [
        ScenarioTouch(link=LINK, from_s=at, duration_s=0.8, path=(PRESSES[k % 4],), force_n=(0.6,))
        for k, at in enumerate(np.arange(0.5, LENGTH_S - 1, 1.5))
        if name != "hysteresis_tail" or not BEGIN_S - 1 < at < LENGTH_S - 3
    ]
    if name == "hysteresis_tail":
        fading = 0.25 * np.exp(-np.arange(0, LENGTH_S - BEGIN_S - 3, 0.5) / 12)
        forces = (1.0,) * 6 + tuple(fading.tolist())
        left_s = LENGTH_S - BEGIN_S
        made.append(
            ScenarioTouch(
                link=LINK, from_s=BEGIN_S, duration_s=left_s, path=((0.6, 0.4),), force_n=forces, ramp_s=0.1
            )
        )
    return made


def main() -> None:
    """Simulate the pad with each fault, and draw its counts."""
    whole = config.load(shipped.path("utah_mit.toml"))
    (hand,) = whole.hands
    pads = tuple(pad for pad in hand.pads if pad.link == LINK)
    alone = whole.model_copy(update={"hands": (hand.model_copy(update={"pads": pads}),)})
    times = np.arange(0, LENGTH_S, 1 / RATE_HZ)
    figure, panels = plt.subplots(4, 3, figsize=(13, 12), layout="constrained", sharex=True)
    for axes, (name, keys) in zip(panels.flat, FAULTS_SHOWN.items(), strict=True):
        acting = []
        if keys:
            acting = [FAULTS[keys["kind"]].model_validate({"link": LINK, "from_s": BEGIN_S, **keys})]
        world = WORLDS["ideal"].draw(1)
        virtual = VirtualHand(alone, Scenario(touch=tuple(touches(name))), world, faults=tuple(acting))
        for channel, (electrode, colour) in enumerate(CHANNELS.items()):
            axes.plot(times, virtual.counts(0, times)[:, channel], color=colour, lw=1, label=electrode)
        if name != "healthy":
            axes.axvline(BEGIN_S, color="#8a8a8a", lw=0.8, ls=":")
        axes.set_title(name, loc="left")
        axes.set_yscale("symlog", linthresh=100)
        axes.set_ylim(-30, 5e4)
        axes.set_yticks([0, 100, 1000, 10000], ["0", "100", "1000", "10000"])
    panels[0, 0].legend(frameon=False, ncols=4, loc="upper left", fontsize=8)
    for axes in panels[-1]:
        axes.set_xlabel("time, s")
    for axes in panels[:, 0]:
        axes.set_ylabel("counts")
    figure.savefig(PICTURE, dpi=70)


if __name__ == "__main__":
    main()
