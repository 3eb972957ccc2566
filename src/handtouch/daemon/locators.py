"""Other ways to find contacts than the daemon's own: for replay, to tell what would have been different.

Public names: `NAMES`, `locator`, `Otherwise`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch.config import Deployment
from handtouch.daemon.follow import RESIDUAL, VALUES, Follower, Solved
from handtouch.daemon.model import PadModel, networks_of
from handtouch.daemon.pipeline import Pipeline
from handtouch.daemon.rerun import Anew
from handtouch.field import chooser

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
Locate = Callable[[IntArray, FloatArray, FloatArray], FloatArray]
"""Pads (k,), currents (4, k) and their noise (4, k) to places (k, 2) on their rectangles, NaN for none."""


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

    def locate(index: IntArray, currents: FloatArray, noise: FloatArray) -> FloatArray:
        places = np.full((len(index), 2), np.nan)
        for row, pad in enumerate(index.tolist()):
            with np.errstate(all="ignore"):
                x, y = of_pad[pad](currents[:, row : row + 1], noise[:, row : row + 1])
            places[row] = x[0], y[0]
        return places

    return locate


class _Solver(Follower):
    """Finds contacts by `locate` at every sample: the maps that other followers draw are of likelihoods."""

    def __init__(self, model: PadModel, locate: Locate) -> None:
        super().__init__(model)
        self._locate = locate

    def solve(self, pads: IntArray, currents: FloatArray, xy: FloatArray) -> Solved:  # noqa: ARG002
        """Tell what holds at the places found, and nowhere else."""
        places = self._locate(pads, currents.T, self._model.noise_a[pads].T)
        solved = self.draw(pads, currents, places, solved=True)
        maps = self._maps[pads]
        maps[:, :-VALUES, :4] = np.nan  # trusted for no other currents
        maps[:, -VALUES:, :4] = 0.0  # no step from there towards the most likely place
        maps[:, RESIDUAL - VALUES, :2] = 1 / currents.sum(axis=1, keepdims=True)
        self._maps[pads] = maps
        return solved


class Otherwise(Anew):
    """As `Anew`; `locate` finds contacts, None: the daemon's own way."""

    def __init__(self, *arguments: Any, locate: Locate | None = None, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._locate = locate

    def _restore(self, payload: dict[str, Any]) -> None:
        super()._restore(payload)
        if self.pipeline is not None and self._locate is not None:
            self._find_by(self.pipeline, self._locate)

    def _find_by(self, pipeline: Pipeline, locate: Locate) -> None:
        """Put another follower in the place of a new one."""
        before = pipeline.tick.follower
        if not isinstance(before, _Solver):
            pipeline.tick.follower = _Solver(pipeline.model, locate)
            pipeline.tick.follower.take_over(before)
            pipeline.tick.forget(np.arange(pipeline.model.size))
