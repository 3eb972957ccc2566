"""The pad that is designed: what stays as it is, and what its parts may differ by.

Public names: `PadTask`, `PartTolerances`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.design.layout import BoundaryLengths, ElectrodeLayout
from handtouch.field import ContactLaw, Surface
from handtouch.hand import pad_surface
from handtouch.hand.expected_error import EDGE_MARGIN, pad_design
from handtouch.hand.pads import log_aspect_std


@dataclass(frozen=True)
class PartTolerances:
    """Standard deviations of a pad's parts, as `[node]` and `[sheet]` state them; see docs/theory.md."""

    gain: float = 0.0
    resistor: float = 0.0
    gap_m: float = 0.0
    log_aspect: float = 0.0
    sheet_ohm: float = 0.0
    contact_ohm: float = 0.0
    alpha: float = 0.0
    radius: float = 0.0
    """Relative spread of the contact's radius, which differs from touch to touch."""

    @classmethod
    def from_tables(cls, pad: config.Pad, node: config.Node, sheet: config.Sheet) -> PartTolerances:
        """Return the tolerances that a deployment states."""
        return cls(
            gain=node.gain_std,
            resistor=node.series_std,
            gap_m=1e-3 * sheet.gap_std_mm,
            log_aspect=log_aspect_std(pad, sheet),
            sheet_ohm=sheet.ohm_per_square_std,
            contact_ohm=sheet.contact_ohm_std,
            alpha=sheet.alpha_std,
            radius=sheet.contact_radius_std_mm / sheet.contact_radius_mm,
        )


@dataclass(frozen=True)
class PadTask:
    """A pad of a deployment, and the contacts that it is designed for.

    force_n: of each contact. points: of a side, on which a goal is computed. margin: of each side, left out.
    """

    deployment: config.Deployment
    hand: str
    pad: config.Pad
    force_n: float = 1.0
    tolerances: PartTolerances = field(default_factory=PartTolerances)
    points: int = 9
    margin: float = EDGE_MARGIN

    @classmethod
    def from_deployment(
        cls, deployment: config.Deployment, link: str | None, force_n: float, nominal: bool = False
    ) -> PadTask:
        """Return the task for the pad on a link, or the first pad, with the tolerances of the deployment;
        nominal: with none.

        Raises ValueError naming the known links.
        """
        name = pad_design(deployment, link).name
        entry = next(entry for entry in deployment.pads if entry.pad.link == name)
        pad = entry.pad
        node, sheet = deployment.nodes[pad.node], deployment.sheet_of(pad)
        tolerances = PartTolerances() if nominal else PartTolerances.from_tables(pad, node, sheet)
        return cls(deployment, entry.hand, pad, force_n, tolerances)

    def with_points(self, points: int) -> PadTask:
        """Return the same task on another number of points a side."""
        return replace(self, points=points)

    @cached_property
    def surface(self) -> Surface:
        """Surface of the pad."""
        return pad_surface(self.pad)

    @cached_property
    def boundary(self) -> BoundaryLengths:
        """Lengths along its boundary."""
        return BoundaryLengths(self.surface)

    @cached_property
    def law(self) -> ContactLaw:
        """Contact law of its sheet."""
        return pad_design(self.deployment, self.pad.link).law

    @property
    def node(self) -> config.Node:
        """Table of its node."""
        return self.deployment.nodes[self.pad.node]

    @property
    def sheet(self) -> config.Sheet:
        """Table of its sheet."""
        return self.deployment.sheet_of(self.pad)

    @cached_property
    def noise_a(self) -> float:
        """Standard deviation of a channel's current [A], quantisation included."""
        return pad_design(self.deployment, self.pad.link).noise_a

    @cached_property
    def configured(self) -> ElectrodeLayout:
        """Electrodes as the deployment has them."""
        return ElectrodeLayout.from_pad(self.pad, self.boundary)

    @cached_property
    def grid(self) -> tuple[FloatArray, FloatArray]:
        """Positions x and y (points^2,) on the rectangle, x fastest; evenly spaced on it."""
        steps = np.linspace(self.margin, 1 - self.margin, self.points)
        x, y = np.meshgrid(steps * self.surface.a, steps * self.surface.b)
        return x.ravel(), y.ravel()
