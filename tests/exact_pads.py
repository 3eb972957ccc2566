"""Exact theory of all pads of a deployment, which the core's tables approximate: the reference of tests."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from handtouch.config import Deployment
from handtouch.core.pad_model import PadModel, contact_law
from handtouch.field import ForceEstimate, PointEstimate, estimate
from handtouch.field.model import ChannelModel
from handtouch.field.network import ElectrodeNetwork
from handtouch.hand import mount_transform, pad_surface

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.intp]


class HasNetworks(Protocol):
    """A model of pads."""

    @property
    def networks(self) -> Sequence[ChannelModel]: ...


class ExactNetworks:
    """Networks of a model's pads, evaluated for many points, one call for each distinct network.

    `sides` (n, 2): a and b of each pad. `index` (k,) of the methods: numbers of pads, one for each point.
    """

    def __init__(self, model: PadModel) -> None:
        self.networks = model.networks
        self.sides = np.array([(network.a, network.b) for network in model.networks])

    def fractions(self, index: ArrayLike, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Return the measured fractions (channels, k) of points (k,)."""
        x, y = np.asarray(x), np.asarray(y)
        found = np.empty((len(self.networks[0].fractions(*(self.sides[0] / 2))), len(x)))
        for pad, points in self._groups(np.asarray(index)):
            found[:, points] = self.networks[pad].fractions(x[points], y[points])
        return found

    def spreading_radius(self, index: ArrayLike, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Return the spreading radius (k,) of points (k,), in the unit of the sides."""
        x, y = np.asarray(x), np.asarray(y)
        found = np.empty(len(x))
        for pad, points in self._groups(np.asarray(index)):
            found[points] = self.networks[pad].spreading_radius(x[points], y[points])
        return found

    def estimate(self, index: ArrayLike, currents: FloatArray, noise: ArrayLike) -> PointEstimate:
        """Return the most likely contacts (k,) for currents (channels, k) and noise that broadcasts."""
        sigma = np.broadcast_to(np.asarray(noise), currents.shape)
        x, y, total, residual, chi_squared = np.full((5, currents.shape[1]), np.nan)
        covariance, converged = np.full((len(x), 3, 3), np.nan), np.zeros(len(x), np.bool_)
        found = PointEstimate(x, y, total, residual, chi_squared, covariance, converged)
        for pad, points in self._groups(np.asarray(index)):
            some = estimate(self.networks[pad], currents[:, points], sigma[:, points])
            for name, values in vars(found).items():
                values[points] = getattr(some, name)
        return found

    def _groups(self, index: IndexArray) -> Iterator[tuple[int, IndexArray]]:
        """Yield a pad of each distinct network, and the points on pads with this network."""
        numbers = {id(network): pad for pad, network in enumerate(self.networks)}
        first = np.array([numbers[id(network)] for network in self.networks])[index]
        for pad in np.unique(first).tolist():
            yield pad, np.flatnonzero(first == pad)


class LinkContacts(NamedTuple):
    """Contacts (k,) in the frames of their links."""

    position_m: FloatArray
    """(k, 3)"""
    normal: FloatArray
    """(k, 3), unit vectors, outward"""
    covariance_m2: FloatArray
    """(k, 3, 3) of position_m; singular along the normal, because a contact lies on the surface"""
    pad_m: FloatArray
    """(k, 2) arc lengths from the electrodes x0 and y0"""
    scale_m_per_unit: FloatArray
    """(k,) metres on the surface per unit of the rectangle"""


class ExactPads(ExactNetworks):
    """The same with surfaces, mounts and contact laws."""

    def __init__(self, deployment: Deployment, model: PadModel) -> None:
        super().__init__(model)
        self._model = model
        self._pads = [pad for _, pad in deployment.pads]
        self._sheets = [deployment.sheets[pad.sheet] for pad in self._pads]
        self._drive_v = [deployment.nodes[pad.node].drive_v for pad in self._pads]

    def to_link_frame(
        self, index: ArrayLike, x: ArrayLike, y: ArrayLike, covariance: FloatArray
    ) -> LinkContacts:
        """Return contacts at (x, y) (k,) with covariance (k, 2, 2) on pads `index` (k,)."""
        contacts = zip(np.asarray(index).tolist(), np.asarray(x), np.asarray(y), covariance, strict=True)
        return LinkContacts(*map(np.array, zip(*(self._placed(*one) for one in contacts), strict=True)))

    def _placed(self, pad: int, x: float, y: float, covariance: FloatArray) -> LinkContacts:
        surface, (rotation, translation) = pad_surface(self._pads[pad]), mount_transform(self._pads[pad])
        tangents = (surface.tangents(x, y) * surface.scales(x, y)[:, None]) @ rotation.T
        return LinkContacts(
            rotation @ surface.point(x, y) + translation,
            rotation @ surface.normal(x, y),
            tangents.T @ covariance @ tangents,
            np.array(surface.from_rectangle(x, y)),
            surface.scale(x, y),
        )

    def position_m(self, index: ArrayLike, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Return positions (k, 3) of points in the frames of their links [m]."""
        index = np.asarray(index)
        placed = self.to_link_frame(index, np.asarray(x), np.asarray(y), np.zeros((len(index), 2, 2)))
        return placed.position_m

    def force(self, currents: FloatArray, found: PointEstimate) -> list[ForceEstimate]:
        """Return the forces of contacts on all pads (n,), of their currents (channels, n)."""
        pads = np.arange(len(self._pads))
        placed = self.to_link_frame(pads, found.x, found.y, found.covariance[:, :2, :2])
        radius_m = self.spreading_radius(pads, found.x, found.y) * placed.scale_m_per_unit
        forces = []
        for pad, sheet in enumerate(self._sheets):
            law, form = self._model.law(pad), self.networks[pad].series_quadratic_form
            share = currents[:, pad] / currents[:, pad].sum()
            forces.append(
                contact_law(sheet, law).force(
                    found.total[pad],
                    self._drive_v[pad],
                    law.ohm_per_square,
                    radius_m[pad],
                    float(share @ form @ share),
                    current_std_a=np.sqrt(found.covariance[pad, 2, 2]),
                )
            )
        return forces


def electrodes_of(model: HasNetworks) -> list[ElectrodeNetwork]:
    """Return the electrodes of a model's pads, all of which must have some."""
    networks = [network for network in model.networks if isinstance(network, ElectrodeNetwork)]
    assert len(networks) == len(model.networks)
    return networks
