"""Spread of what a deployment doesn't know of channels that aren't electrodes of a sheet.

Public names: `ResponseSpread`, `HiddenResponse`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.simulate.preisach import PlayLoops
from handtouch.simulate.worlds.distributions import Distribution, Fixed
from handtouch.simulate.worlds.sheet_kinds import SheetKind

_CREEP_STD, _PER_LOOP_WIDTH = 0.03, 2.0
"""Relative error of a force by an elastomer: by creep, and by loops, over their width on its data sheet."""
_ZERO, _ONE = Fixed(0.0), Fixed(1.0)
Draw = Callable[[Distribution, int, str], NDArray[np.float64]]


@dataclass(frozen=True)
class ResponseSpread:
    """Parts of each channel, and effects that estimators have no model of."""

    position_offset_mm: Distribution = _ZERO
    """Each component of a channel's displacement along the surface."""
    width_ratio: Distribution = _ONE
    """Width of its response."""
    signal_ratio: Distribution = _ONE
    """Signal of all channels of a pad at one force."""
    crosstalk: Distribution = _ZERO
    """Share of each neighbour's signal that a channel reads besides its own, one value per pad."""
    tail: Distribution = _ZERO
    """Share of the response that is twice as wide, one value per pad."""
    film_unevenness: Distribution = _ZERO
    """Amplitude of each of the five smoothest waves of the logarithm of a film's resistance."""
    field_n: Distribution = _ZERO
    """Signal of a magnetic pad's channels in the Earth's field along their axes, as that of a force [N]."""
    field_tilt: Distribution = _ZERO
    """Each component of a channel's axis off the normal."""
    kind: SheetKind | None = None
    """Creep and hysteresis of the elastomer; None: none."""

    @property
    def _elastomer_std(self) -> float:
        """Relative standard deviation of a force by creep and hysteresis."""
        if self.kind is None:
            return 0.0
        loops = self.kind.law.hysteresis
        width = loops.width if isinstance(loops, PlayLoops) else 0.0
        return float(np.hypot(_CREEP_STD, _PER_LOOP_WIDTH * width))

    def describe(self, deployment: config.Deployment, of_films: Mapping[str, float]) -> config.Deployment:
        """Return the deployment as its builder writes it, with the tolerances of its responses; of_films: of
        those that are films with electrodes."""
        if not deployment.responses and not any(pad.response for _, pad in deployment.pads):
            return deployment
        stated = {
            "position_std_mm": self.position_offset_mm.std,
            "width_std": self.width_ratio.std,
            "crosstalk_std": float(np.hypot(self.crosstalk.mean, self.crosstalk.std)),
            "profile_std": float(np.hypot(self.tail.mean, self.tail.std)),
            "signal_std": float(np.hypot(self.signal_ratio.std, self._elastomer_std)),
            "contact_elongation_std": of_films["contact_elongation_std"],
        }
        law_std = float(np.hypot(of_films["contact_ohm_std"], self._elastomer_std))
        of_films = {
            **of_films,
            "contact_ohm_std": law_std,
            "unevenness_std": self.film_unevenness.std,
        }

        def described(table: Any) -> Any:
            if not isinstance(table, config.ResponseTable):
                return table
            told = {**stated, **(of_films if table.is_current else {})}
            known = {key: value for key, value in told.items() if key in type(table).model_fields}
            return table.model_copy(update=known)

        responses = {name: described(table) for name, table in deployment.responses.items()}
        return deployment.model_copy(update={"responses": responses}).with_pads(
            lambda _, pad: pad.model_copy(update={"response": described(pad.response)})
        )


@dataclass(frozen=True)
class HiddenResponse:
    """True properties of the channels of a pad."""

    position_offset_mm: tuple[float, ...]
    """(2 n,), along x of all, then across."""
    width_ratio: tuple[float, ...]
    signal_ratio: float
    crosstalk: float
    tail: float
    field_n: float
    field_tilt: tuple[float, ...]
    """(3 n,), of each channel's axis"""

    @classmethod
    def draw(cls, spread: ResponseSpread, count: int, draw: Draw) -> HiddenResponse:
        """Draw the properties of n channels; `draw` has a stream for each name."""
        return cls(
            tuple(draw(spread.position_offset_mm, 2 * count, "taxel_position").tolist()),
            tuple(draw(spread.width_ratio, count, "taxel_width").tolist()),
            float(draw(spread.signal_ratio, 1, "signal")[0]),
            float(draw(spread.crosstalk, 1, "neighbours")[0]),
            float(draw(spread.tail, 1, "tail")[0]),
            float(draw(spread.field_n, 1, "field")[0]),
            tuple(draw(spread.field_tilt, 3 * count, "axis").tolist()),
        )
