"""Inputs and results of a hand's diagnosis: `DiagnosisModel`, `HandSamples`, `PadDiagnosis`.

Electrodes and channels are in the order of the pad's: x0, xa, y0, yb, or that of its arcs. Arrays have c
channels, those of the pad with most; columns beyond a pad's own are 0.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.config.channels import node_channels, order_by_electrode
from handtouch.core.pad_model import ampere_per_count_of
from handtouch.field.model import ChannelModel, FractionModel
from handtouch.field.surface_base import Surface
from handtouch.hand import (
    channel_gain_std,
    models_with_other_parts,
    network_parameters,
    pad_channels,
    pad_surface,
)
from handtouch.wire.faults import FaultKind
from handtouch.wire.health import Diagnosis


@dataclass(frozen=True)
class HandSamples:
    """m consecutive samples of all n pads of a hand, as in topic `raw/<hand>`.

    sample_ns: (m, n) time of each sample. counts: (m, n, c). fresh: (m, n), whether the sample belongs to
    this tick. Blocks of 0.2 to 0.5 s work best; samples of a pad are in order of time.
    """

    sample_ns: NDArray[np.int64]
    counts: NDArray[np.int64]
    fresh: NDArray[np.bool_]


@dataclass(frozen=True)
class PadDiagnosis:
    """A diagnosis of one pad with what is not published of it.

    published: as health carries it. link: that carries the pad. values: evidence as numbers, by name and
    unit. electrodes: those concerned. until_ns: end; None while it lasts.
    """

    published: Diagnosis
    link: str
    values: Mapping[str, float] = field(default_factory=dict)
    electrodes: tuple[str, ...] = ()
    until_ns: int | None = None

    @property
    def kind(self) -> FaultKind:
        """Identifier of the fault."""
        return self.published.kind

    @property
    def is_fault(self) -> bool:
        """Return whether it is known to need attention; a held object doesn't, and a load may be one."""
        return self.kind not in (FaultKind.HELD_OBJECT, FaultKind.STATIC_LOAD)


@dataclass(frozen=True)
class DiagnosisModel:
    """Parameters of the n pads of a hand, from deployment file and calibration.

    electrodes: names of each pad's. networks, surfaces, sheets: of each pad; parts: networks in each of which
    one part of the pad differs by one standard deviation, made when called. drive_v: (n,). ampere_per_count,
    offset_counts: (n, c) as calibrated; offsets are the stored ones, not a running baseline.
    gain_covariance: (n, c, c) of the logarithms of the gains, as stated or calibrated. noise_counts: (n,) of
    a reading. limits: (n, c, 2) counts at and beyond which a reading is saturated, infinite
    beyond a pad's own and where there is none. designs: equal for
    pads of which all this is equal, calibration aside.
    """

    links: tuple[str, ...]
    electrodes: Sequence[tuple[str, ...]]
    networks: Sequence[ChannelModel]
    surfaces: Sequence[Surface]
    sheets: Sequence[config.Sheet]
    parts: Sequence[Callable[[], Sequence[FractionModel]]]
    drive_v: FloatArray
    ampere_per_count: FloatArray
    noise_counts: FloatArray
    limits: FloatArray
    designs: Sequence[Hashable]
    offset_counts: FloatArray
    gain_covariance: FloatArray

    @property
    def reading_noise_counts(self) -> FloatArray:
        """Noise (n,) of a reading, that of its rounding included."""
        return np.asarray(np.hypot(self.noise_counts, 12**-0.5))

    @classmethod
    def from_deployment(cls, deployment: config.Deployment, hand: str) -> DiagnosisModel:
        """Build the model of a hand from its deployment. Raises KeyError for an unknown hand."""
        pads = {h.name: h.pads for h in deployment.hands}[hand]
        nodes = [deployment.nodes[pad.node] for pad in pads]
        most = max(len(pad.electrode_names) for pad in pads)
        scale, limits = np.zeros((len(pads), most)), np.zeros((len(pads), most, 2))
        limits[:] = -np.inf, np.inf
        for row, (pad, node) in enumerate(zip(pads, nodes, strict=True)):
            own = slice(len(pad.electrode_names))
            scale[row, own] = ampere_per_count_of(pad, deployment)
            limits[row, own] = [one.saturation for one in order_by_electrode(node_channels(node), pad)]
        by_design: dict[Hashable, ChannelModel] = {}  # pads of one design share one network
        networks, designs = [], []
        for pad, node in zip(pads, nodes, strict=True):
            sheet = deployment.sheet_of(pad)
            design = (*network_parameters(pad), sheet, node.gain_std, node.series_std)
            designs.append(design)
            if design not in by_design:
                by_design[design] = pad_channels(pad, sheet, node)
            networks.append(by_design[design])
        return cls(
            links=tuple(pad.link for pad in pads),
            electrodes=[pad.electrode_names for pad in pads],
            networks=networks,
            surfaces=[pad_surface(pad) for pad in pads],
            sheets=[deployment.sheet_of(pad) for pad in pads],
            parts=[
                partial(models_with_other_parts, network, pad, node, deployment.sheet_of(pad))
                for network, pad, node in zip(networks, pads, nodes, strict=True)
            ],
            drive_v=np.array([node.drive_v for node in nodes]),
            ampere_per_count=scale,
            noise_counts=np.array([node.noise_counts for node in nodes]),
            limits=limits,
            designs=designs,
            offset_counts=np.zeros(scale.shape),
            gain_covariance=np.stack(
                [
                    channel_gain_std(pad, node) ** 2 * np.diag((row > 0).astype(float))
                    for pad, node, row in zip(pads, nodes, scale, strict=True)
                ]
            ),
        )

    @property
    def channel_counts(self) -> list[int]:
        """Number of channels of each pad."""
        return [len(names) for names in self.electrodes]
