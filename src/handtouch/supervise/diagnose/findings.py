"""What goes into a diagnosis and what comes out: `Block` in, `Finding` out; `Kind`, `DiagnosisModel`.

Electrodes and channels are always in the order x0, xa, y0, yb.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.canbus.objects.channels import ELECTRODES, channels_of, in_order
from handtouch.field.network import ElectrodeNetwork
from handtouch.field.surface import Surface
from handtouch.hand import network_of, surface_of

FloatArray = NDArray[np.float64]


class Kind(StrEnum):
    """What a pad may be found to have; all but `HELD_OBJECT` are faults."""

    HELD_OBJECT = "held object"
    OFFSET = "offset"
    HYSTERESIS_TAIL = "hysteresis tail"
    STUCK_CONTACT = "stuck contact"
    MOISTURE = "moisture"
    DEAD_ELECTRODE = "dead electrode"
    SHORTED_ELECTRODE = "shorted electrode"
    SWAPPED_ELECTRODES = "swapped electrodes"
    SATURATED_CHANNEL = "saturated channel"
    STUCK_CHANNEL = "stuck channel"
    TORN_CORNER = "torn corner"
    GAIN_STEP = "gain step"
    COMMON_DRIFT = "common drift"
    UNEXPLAINED = "unexplained"


@dataclass(frozen=True)
class Block:
    """Samples of all n pads of a hand, as in topic `raw/<hand>`, m one after another.

    sample_ns: (m, n) time of each row's sample. counts: (m, n, 4). fresh: (m, n), whether the sample belongs
    to this tick. Blocks of 0.2 to 0.5 s serve best; samples of a pad come in the order of time.
    """

    sample_ns: NDArray[np.int64]
    counts: NDArray[np.int64]
    fresh: NDArray[np.bool_]


@dataclass(frozen=True)
class Finding:
    """One thing that is, or was, the matter with a pad.

    link: that carries the pad. since_ns: when it began, as far as the samples tell. until_ns: when it was
    over; None while it lasts. cause, remedy: in plain words. evidence: numbers, by name and unit.
    confidence: probability that this, and not another kind or nothing, is the matter. location, strength:
    whether they can be relied on while it lasts. electrodes: those concerned. place_m: arc lengths from x0
    and y0. size_m: how large it is across.
    """

    kind: Kind
    link: str
    since_ns: int
    cause: str
    remedy: str
    evidence: Mapping[str, float] = field(default_factory=dict)
    confidence: float = 1.0
    location: bool = True
    strength: bool = True
    electrodes: tuple[str, ...] = ()
    place_m: tuple[float, float] | None = None
    size_m: float | None = None
    until_ns: int | None = None

    @property
    def fault(self) -> bool:
        """Whether somebody should do something about it."""
        return self.kind != Kind.HELD_OBJECT


@dataclass(frozen=True)
class DiagnosisModel:
    """What is known of the n pads of a hand before any sample.

    networks, surfaces, sheets: of each pad. drive_v: (n,). ampere_per_count, offset_counts: (n, 4) as
    calibrated; offsets are what the store has, not a running baseline. noise_counts: (n,) of a reading.
    limits: (n, 4, 2) least and greatest count.
    """

    links: tuple[str, ...]
    networks: Sequence[ElectrodeNetwork]
    surfaces: Sequence[Surface]
    sheets: Sequence[config.Sheet]
    drive_v: FloatArray
    ampere_per_count: FloatArray
    noise_counts: FloatArray
    limits: FloatArray
    offset_counts: FloatArray

    @classmethod
    def of(cls, deployment: config.Deployment, hand: str) -> DiagnosisModel:
        """The pads of a hand as its file describes them. Raises KeyError for a hand that isn't in it."""
        pads = {h.name: h.pads for h in deployment.hands}[hand]
        nodes = [deployment.nodes[pad.node] for pad in pads]
        scale, limits = np.zeros((len(pads), 4)), np.zeros((len(pads), 4, 2))
        for row, (pad, node) in enumerate(zip(pads, nodes, strict=True)):
            channels = in_order(channels_of(node.channels, node.eds), pad.electrodes)
            for k, (name, channel) in enumerate(zip(ELECTRODES, channels, strict=True)):
                full = node.full_scale_counts or channel.limits[1]
                factor = node.channel_scale[pad.electrodes.index(name)]
                scale[row, k] = node.full_scale_ma * 1e-3 / full * factor
                limits[row, k] = channel.limits
        made: dict[object, ElectrodeNetwork] = {}  # pads of one make share one object, and with it tables
        networks = []
        for pad in pads:
            make = (pad.surface, pad.gap_mm, pad.series_ohm, pad.sheet)
            if make not in made:
                made[make] = network_of(pad, deployment.sheets[pad.sheet])
            networks.append(made[make])
        return cls(
            links=tuple(pad.link for pad in pads),
            networks=networks,
            surfaces=[surface_of(pad) for pad in pads],
            sheets=[deployment.sheets[pad.sheet] for pad in pads],
            drive_v=np.array([node.drive_v for node in nodes]),
            ampere_per_count=scale,
            noise_counts=np.array([node.noise_counts for node in nodes]),
            limits=limits,
            offset_counts=np.zeros((len(pads), 4)),
        )
