"""Noise of a node's channels, and the position noise that it gives on a pad of a deployment.

Public names: `PadNoise`, `measure_noise`, `noise_of`, `position_noise`.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.hand.expected_error import FIRM_TOUCH_N, error_summary, pad_design
from handtouch.node.adc_fault import AdcError
from handtouch.node.excitation import make_switch
from handtouch.node.pad_input import PadInput
from handtouch.node.sampling import AdcInput, make_inputs
from handtouch.node.settings import NodeFile, NodePad

_WHOLE = 1e-6  # of a step
_ROUNDING_STD = 12**-0.5  # of a step


@dataclass(frozen=True)
class PadNoise:
    """Noise of an untouched pad's c channels.

    `mean_ma`, `std_ma` : mean and standard deviation (c,) of the currents [mA], or of values that aren't
    currents in their own unit; `std_counts` : (c,), of published counts, before their rounding, with the
    rounding of a source's whole numbers; `samples` : their number
    """

    pad: NodePad
    mean_ma: FloatArray
    std_ma: FloatArray
    std_counts: FloatArray
    samples: int


def measure_noise(
    file: NodeFile,
    samples: int,
    period_s: float,
    sleep: Callable[[float], None] = time.sleep,
    clock: Callable[[], int] = time.monotonic_ns,
) -> list[PadNoise]:
    """Sample every pad with its excitation on; return the noise of each. Raises AdcError at any failure."""
    switches = [switch for pad in file.settings.pads if (switch := make_switch(pad.excitation))]
    inputs = make_inputs(file, [None] * len(file.settings.pads), clock)
    try:
        for switch in switches:
            switch.set(True)
        return [noise for adc in inputs for noise in _measure_adc(adc, samples, period_s, sleep)]
    finally:
        for adc in inputs:
            adc.close()
        for switch in switches:
            with contextlib.suppress(AdcError):
                switch.set(False)
            switch.close()


def position_noise(
    noise: PadNoise, deployment: config.Deployment, link: str | None = None
) -> list[tuple[str, float, float, float]]:
    """Return (link, force [N], median and worst error of position [m]) for a light and a firm touch.

    `link` : of the pad, by default the one with the serial number, else the node id, else the link's name
    that the node's file has. The noise is the root mean square of the channels' and of rounding to counts.
    Raises ValueError without such a pad.
    """
    chosen = link or _link_of(noise.pad, deployment)
    design = replace(
        pad_design(deployment, chosen), noise_counts=float(np.sqrt(np.mean(noise.std_counts**2)))
    )
    if noise.pad.full_scale is None:
        design = replace(design, full_scale_a=noise.pad.full_scale_ma * 1e-3)
    forces = (design.light_touch_n, FIRM_TOUCH_N)
    return [(design.name, force, *error_summary(design, force)) for force in forces]


def _link_of(pad: NodePad, deployment: config.Deployment) -> str:
    pads = [entry.pad for entry in deployment.pads]
    for matches in (
        [other for other in pads if pad.serial is not None and other.serial == pad.serial],
        [other for other in pads if pad.node_id is not None and other.node_id == pad.node_id],
        [other for other in pads if other.link == pad.name],
    ):
        if matches:
            return matches[0].link
    raise ValueError(
        f"pad {pad.name}: the deployment has no pad with its serial number, node id or name; name the link"
    )


def _measure_adc(
    adc: AdcInput, samples: int, period_s: float, sleep: Callable[[float], None]
) -> list[PadNoise]:
    currents: list[list[FloatArray]] = [[] for _ in adc.pads]
    missing = samples
    while missing:
        adc.wait(period_s, sleep)
        measured = adc.read_currents_ma()
        if measured is not None:
            missing -= 1
            for values, current_ma in zip(currents, measured, strict=True):
                values.append(current_ma)
    return [noise_of(pad, np.array(values)) for pad, values in zip(adc.pads, currents, strict=True)]


def noise_of(pad: PadInput, currents_ma: FloatArray) -> PadNoise:
    """Return the noise of samples (samples, c); whole numbers hide what is less than one."""
    std_ma = np.std(currents_ma, axis=0, ddof=1)
    steps = currents_ma / pad.step_ma
    is_whole = (np.abs(steps - np.rint(steps)) < _WHOLE).all(axis=0) & (pad.pad.source is not None)
    rounding_ma = np.where(is_whole, pad.step_ma * _ROUNDING_STD, 0.0)
    std_counts = np.hypot(std_ma, rounding_ma) * pad.counts_per_ma
    return PadNoise(pad.pad, currents_ma.mean(axis=0), std_ma, std_counts, len(currents_ma))
