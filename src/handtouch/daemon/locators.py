"""Other ways to find contacts than the daemon's own: for replay, to tell what would have been different.

Public names: `NAMES`, `locator`, `Otherwise`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch.config import Deployment
from handtouch.daemon.model import Locate, networks_of
from handtouch.daemon.pipeline import Pipeline
from handtouch.daemon.rerun import Anew
from handtouch.field import chooser

FloatArray = NDArray[np.float64]


def _slug(method: str) -> str:
    return method.replace(",", "").replace(" ", "-")


NAMES = {_slug(method): method for method in chooser.COSTS}
"""As they are asked for -> as `field` calls them."""


def locator(deployment: Deployment, name: str) -> Locate:
    """The method `name` of NAMES for every pad. Raises ValueError naming a pad that it isn't for."""
    methods: dict[int, chooser.Locator] = {}
    networks = networks_of(deployment)
    pads = [f"{hand.name}/{pad.link}" for hand in deployment.hands for pad in hand.pads]
    for pad, network in zip(pads, networks, strict=True):
        if id(network) not in methods:
            try:
                methods[id(network)] = chooser.method_for(network, NAMES[name])
            except ValueError as error:
                raise ValueError(f"--locator {name}: {pad}: {error}") from None
    of_pad = [methods[id(network)] for network in networks]

    def locate(index: NDArray[np.intp], currents: FloatArray, noise: FloatArray) -> FloatArray:
        places = np.full((len(index), 2), np.nan)
        for row, pad in enumerate(index.tolist()):
            with np.errstate(all="ignore"):
                x, y = of_pad[pad](currents[:, row : row + 1], noise[:, row : row + 1])
            places[row] = x[0], y[0]
        return places

    return locate


class Otherwise(Anew):
    """As `Anew`; `locate` finds contacts, None: the daemon's own way."""

    def __init__(self, *arguments: Any, locate: Locate | None = None, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._locate = locate

    def _adopted(self, saved: dict[str, Any], run: int) -> Pipeline:
        pipeline = super()._adopted(saved, run)
        pipeline.model.locate = self._locate
        return pipeline
