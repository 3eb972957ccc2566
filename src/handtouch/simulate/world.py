"""Differences between the simulated hand and its deployment file: noise, tolerances, contact size, drift.

Public names: `World`, `PadParts`, `ElectronicsDrift`.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.config.channels import ELECTRODES
from handtouch.hand.pads import mount_transform, rotation_from_rpy
from handtouch.sheet import S1, S2, SheetModel
from handtouch.simulate import noise

FloatArray = NDArray[np.float64]
Four = tuple[float, float, float, float]


@dataclass(frozen=True)
class PadParts:
    """True parts of one pad; electrodes in the order x0, xa, y0, yb."""

    gain: Four
    """Channel gains relative to the configured ones."""
    series_ohm: Four
    gap_before_mm: Four
    """Bare length of each electrode's side, along the surface, at its low end (y = 0 or x = 0)."""
    gap_after_mm: Four
    """Bare length at its high end."""


@dataclass(frozen=True)
class World:
    """True properties of a hand that its deployment file doesn't know; the same seed gives the same world.

    Parts are distributed uniformly within their tolerances, contact radii and sheets normally. By default
    sheets are ideal and nothing drifts. Raises ValueError for a seed below 0.
    """

    seed: int = 1
    noise_counts: float | None = None
    """Standard deviation of a reading; None: the configured one."""
    gain_tolerance: float = 0.02
    gap_tolerance_mm: float = 0.2
    resistor_tolerance: float = 0.05
    radius_std_ratio: float = 1.0
    """Standard deviation of a contact's radius, in units of the sheet's contact_radius_std_mm."""
    sheet: SheetModel | None = None
    """Sheet behaviour (creep, adaptation, hysteresis), e.g. `handtouch.sheet.S1`; None: ideal sheets."""
    sheet_relative_std: float = 0.15
    """Relative standard deviation between pads of the model's times, share and threshold."""
    zero_drift_counts_per_s: float = 0.0
    """Maximum drift rate of each channel's zero; channels drift independently."""
    temperature_drift_k_per_s: float = 0.0
    """Maximum drift rate of the hand's temperature."""
    offset_counts_per_k: float = 0.0
    """Standard deviation of the temperature coefficients of the channels' zeros."""
    gain_per_k: float = 0.0
    """Temperature coefficient of all gains."""
    mount_std_mm: float = 0.0
    """Standard deviation of a pad's mounting position on its link, per axis."""
    mount_std_deg: float = 0.0
    """Standard deviation of a pad's orientation on its link, per axis."""
    supply_drift_per_s: float = 0.0
    """Maximum relative drift rate of the supply voltage."""

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ValueError(f"seed = {self.seed}: must be 0 or more")

    @classmethod
    def ideal_parts(cls, seed: int = 1) -> World:
        """Return a world with noise and quantisation only; everything else is as configured."""
        return cls(seed, None, 0.0, 0.0, 0.0, 0.0)

    def parts(self, hand: str, pad: config.Pad) -> PadParts:
        """Return a pad's true parts; they depend only on the seed, the names and the pad's own table."""
        drawn = np.random.default_rng((self.seed, zlib.crc32(f"{hand}/{pad.link}".encode()))).uniform(
            -1, 1, 16
        )
        gain = 1 + self.gain_tolerance * drawn[:4]
        series = np.array(pad.series_ohm) * (1 + self.resistor_tolerance * drawn[4:8])
        gaps = np.maximum(pad.gap_mm + self.gap_tolerance_mm * drawn[8:].reshape(2, 4), 0.0)
        before, after = gaps
        return PadParts(_as_four(gain), _as_four(series), _as_four(before), _as_four(after))

    def mount(self, hand: str, pad: config.Pad) -> tuple[FloatArray, FloatArray]:
        """Return true rotation (3, 3) and translation (3,) [m] of the pad's frame in its link's frame."""
        rotation, translation = mount_transform(pad)
        if not (self.mount_std_mm or self.mount_std_deg):
            return rotation, translation
        drawn = np.random.default_rng((self.seed, zlib.crc32(f"mount/{hand}/{pad.link}".encode())))
        offset_m, rotation_deg = (
            1e-3 * self.mount_std_mm * drawn.normal(size=3),
            self.mount_std_deg * drawn.normal(size=3),
        )
        return rotation @ rotation_from_rpy(np.radians(rotation_deg)), translation + rotation @ offset_m

    def replacement_gain(self, serial: int) -> Four:
        """Return the channel gains of a replacement node."""
        drawn = np.random.default_rng((self.seed, serial, 1)).uniform(-1, 1, 4)
        return _as_four(1 + self.gain_tolerance * drawn)

    @classmethod
    def with_drift(cls, seed: int = 1, sheet: SheetModel = S2) -> World:
        """Return a world with tolerances, sheet behaviour and drifting electronics."""
        return cls(seed, sheet=sheet)._add_drift()

    @classmethod
    def from_options(cls, seed: int, *, tolerances: bool, sheet: str | None, drift: bool) -> World:
        """Return the world of the command line's options; `sheet` is the name of a preset, S1 or S2."""
        world = cls(seed) if tolerances else cls.ideal_parts(seed)
        if sheet:
            world = replace(world, sheet={"S1": S1, "S2": S2}[sheet])
        return world._add_drift() if drift else world

    def _add_drift(self) -> World:
        return replace(
            self,
            zero_drift_counts_per_s=0.05,
            temperature_drift_k_per_s=0.01,
            offset_counts_per_k=2.0,
            gain_per_k=1e-4,
            supply_drift_per_s=1e-5,
        )

    def sheet_model(self, hand: str, link: str) -> SheetModel | None:
        """Return the true sheet behaviour of one pad; None: ideal."""
        if self.sheet is None:
            return None
        drawn = np.random.default_rng((self.seed, zlib.crc32(f"sheet/{hand}/{link}".encode())))
        factors = np.exp(self.sheet_relative_std * drawn.standard_normal(6))
        nominal, creep = self.sheet.adaptation, self.sheet.creep
        adaptation = replace(
            nominal,
            share=np.maximum(1 - (1 - np.asarray(nominal.share)) * factors[0], 0.0),
            time_s=np.asarray(nominal.time_s) * factors[1],
            recovery_s=np.asarray(nominal.recovery_s) * factors[2],
            threshold_n=np.asarray(nominal.threshold_n) * factors[3],
        )
        times = tuple(float(time_s * factors[4]) for time_s in creep.times_s)
        temperature = self.sheet.temperature
        return replace(
            self.sheet,
            adaptation=adaptation,
            creep=replace(creep, times_s=times),
            temperature=replace(temperature, gain_per_k=float(temperature.gain_per_k * factors[5])),
        )

    def contact_radius_mm(self, sheet: config.Sheet, touch: int) -> float:
        """Return the true radius of a contact; `touch` is its number in the scenario."""
        drawn = np.random.default_rng((self.seed, touch)).normal()
        std = self.radius_std_ratio * sheet.contact_radius_std_mm
        return max(sheet.contact_radius_mm + std * drawn, 0.3 * sheet.contact_radius_mm)


class ElectronicsDrift:
    """Drift of the electronics: zeros of each channel, and temperature and supply of the whole hand.

    Rows are pads. All methods are functions of times (n,) since the start.
    """

    def __init__(self, world: World, names: Sequence[tuple[str, str]]) -> None:
        """names: hand and link of each row."""
        self._world = world
        self.is_constant = not (
            world.zero_drift_counts_per_s or world.temperature_drift_k_per_s or world.supply_drift_per_s
        )
        self._zero_keys = np.array(
            [
                noise.stream_key(world.seed, "zero", *name, channel)
                for name in names
                for channel in ELECTRODES
            ],
            np.uint64,
        )
        self._offset_counts_per_k = world.offset_counts_per_k * noise.standard_normal(self._zero_keys, 0)
        self._temperature_key, self._supply_key = (
            np.array([noise.stream_key(world.seed, name)]) for name in ("warmth", "supply")
        )

    def temperature_rise_k(self, times_s: FloatArray) -> FloatArray:
        """Return the hand's temperature (n,) relative to that at the start."""
        return np.asarray(
            self._bounded_walk(self._world.temperature_drift_k_per_s, self._temperature_key, times_s)[0]
        )

    def supply_ratio(self, times_s: FloatArray) -> FloatArray:
        """Return the supply voltage (n,) relative to the nominal one."""
        return np.asarray(
            1 + self._bounded_walk(self._world.supply_drift_per_s, self._supply_key, times_s)[0]
        )

    def gain_ratio(self, times_s: FloatArray) -> FloatArray:
        """Return the gain of all channels (n,) relative to that at the start."""
        return np.asarray(1 + self._world.gain_per_k * self.temperature_rise_k(times_s))

    def zero_counts(self, times_s: FloatArray) -> FloatArray:
        """Return the counts (n, rows, 4) of channels without current."""
        walk = self._bounded_walk(self._world.zero_drift_counts_per_s, self._zero_keys, times_s)
        walk += self._offset_counts_per_k[:, None] * self.temperature_rise_k(times_s)
        return np.asarray(walk.T.reshape(len(times_s), len(self._zero_keys) // 4, 4))

    @staticmethod
    def _bounded_walk(rate: float, keys: NDArray[np.uint64], times_s: FloatArray) -> FloatArray:
        """Return random walks (keys, n) that start at 0 and never exceed the rate."""
        if not rate:
            return np.zeros((len(keys), len(times_s)))
        return np.asarray(rate * (noise.random_walk(keys, times_s) - _walk_at_start(keys.tobytes())))


@lru_cache(maxsize=1024)
def _walk_at_start(keys: bytes) -> FloatArray:
    return noise.random_walk(np.frombuffer(keys, np.uint64), 0.0)


def _as_four(values: NDArray[np.float64]) -> Four:
    x0, xa, y0, yb = values.tolist()
    return x0, xa, y0, yb
