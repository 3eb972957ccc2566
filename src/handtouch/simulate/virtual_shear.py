"""Shear pad of a virtual hand: counts of its channels over time, from the forces on the pad above.

Public name: `VirtualShear`. It has no clock: the same time gives the same counts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.config.channels import node_channels
from handtouch.config.roles import SHEAR, channel_numbers
from handtouch.config.tables import SIDE_ELECTRODES
from handtouch.simulate import noise
from handtouch.simulate.shear_pad import LayerHistory, SimulatedShearPad
from handtouch.simulate.stimulus import PadStimulus
from handtouch.simulate.worlds import DrawnWorld

CountArray = NDArray[np.int64]
_STEP_S = 4e-3
_CHUNK_STEPS = 50
_MAX_KEPT_STEPS = 50_000


class VirtualShear:
    """Shear pad of one pad: elastic layer with its history, electrodes with their true parts, channels.

    repeat_period_s: period after which the contacts of `touches` repeat; infinite: they don't.
    """

    def __init__(
        self,
        deployment: config.Deployment,
        hand: str,
        pad: config.Pad,
        touches: PadStimulus,
        world: DrawnWorld,
        repeat_period_s: float,
    ) -> None:
        assert pad.shear is not None
        node, name = deployment.nodes[pad.node], f"{hand}/{pad.link}"
        self._shear, self._hidden = deployment.shears[pad.shear], world.shear(name)
        self._touches, self._repeat_period_s = touches, repeat_period_s
        self._electrodes = SimulatedShearPad(self._shear, node.drive_v, self._hidden)
        shape = world.surface(hand, pad)
        self._size_m = np.diag(shape.metres_per_fraction(0.5, 0.5))
        channels, numbers = node_channels(node), list(channel_numbers(pad, SHEAR))
        self._limits = np.array([channels[number].limits for number in numbers])
        full = np.array([node.full_scale_counts or high for high in self._limits[:, 1]])
        scale = np.array([node.channel_scale[number] for number in numbers])
        self._counts_per_ampere = full / (node.full_scale_ma * 1e-3 * scale) * world.shear_gain(name)
        self._noise_counts = node.noise_counts * world.pad(hand, pad).noise_ratio
        self._noise_keys = np.array(
            [
                noise.stream_key(world.seed, "shear", hand, pad.link, electrode)
                for electrode in SIDE_ELECTRODES
            ]
        )
        self._restart()

    def tangential_n(self, times_s: FloatArray) -> FloatArray:
        """Return the tangential force (2, n) on the pad at times (n,) since the start, in the pad's frame."""
        return self._touches.tangential_n(self._scenario_time_s(times_s))

    def counts(self, times_s: FloatArray) -> CountArray:
        """Return counts (n, 4) of x0, xa, y0, yb at times (n,) since the start."""
        position, force, _ = self._touches.contacts(self._scenario_time_s(times_s))
        total = force.sum(axis=0)
        share = force / np.where(total > 0, total, 1.0)
        centre = np.einsum("kcn,kn->cn", position - 0.5, share) * self._size_m[:, None]
        amperes = self._electrodes.currents(self._displacement_m(times_s), total, centre)
        counts = amperes.T * self._counts_per_ampere
        sample_ns = np.rint(times_s * 1e9).astype(np.int64)
        counts += self._noise_counts * noise.standard_normal(self._noise_keys, sample_ns[:, None])
        return np.asarray(np.clip(np.rint(counts), *self._limits.T), np.int64)

    def _restart(self) -> None:
        self._history = LayerHistory(self._shear, self._hidden)
        self._first_step, self._states = 0, [self._history.state]

    def _displacement_m(self, times_s: FloatArray) -> FloatArray:
        """Return displacements (2, n) of the skin, each under the force of its time after the last step."""
        if times_s.min() < self._first_step * _STEP_S:
            self._restart()
        while (len(self._states) - 1 + self._first_step) * _STEP_S <= times_s.max():
            done = self._first_step + len(self._states) - 1
            at = (done + 1 + np.arange(_CHUNK_STEPS)) * _STEP_S
            for force in self.tangential_n(np.asarray(at, np.float64)).T:
                self._history.advance(force, _STEP_S)
                self._states.append(self._history.state)
        if len(self._states) > 2 * _MAX_KEPT_STEPS:
            del self._states[:_MAX_KEPT_STEPS]
            self._first_step += _MAX_KEPT_STEPS
        last, moved = self._states[-1], np.zeros((2, len(times_s)))
        steps = np.floor(times_s / _STEP_S).astype(int)
        for k, force in enumerate(self.tangential_n(times_s).T):
            self._history.restore(self._states[int(steps[k]) - self._first_step])
            moved[:, k] = self._history.advance(force, float(times_s[k] - steps[k] * _STEP_S))
        self._history.restore(last)
        return moved

    def _scenario_time_s(self, times_s: FloatArray) -> FloatArray:
        return times_s % self._repeat_period_s if np.isfinite(self._repeat_period_s) else times_s
