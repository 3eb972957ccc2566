"""What the simulator hides from the estimator: noise, tolerances of parts, the true size of contacts.

Public names: `World`, `Parts`, `Climate`.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from handtouch import config
from handtouch.canbus.objects.channels import ELECTRODES
from handtouch.hand.pads import mount_of, rotation_of
from handtouch.sheet import S1, S2, SheetModel
from handtouch.simulate import noise

FloatArray = NDArray[np.float64]
Four = tuple[float, float, float, float]


@dataclass(frozen=True)
class Parts:
    """One pad as it was really built; electrodes in the order x0, xa, y0, yb."""

    gain: Four
    """Of the channels; 1 is as configured."""
    series_ohm: Four
    gap_before_mm: Four
    """Bare length of each electrode's side, along the surface, from the corner where y or x begins."""
    gap_after_mm: Four
    """The same, to the corner where y or x ends."""


@dataclass(frozen=True)
class World:
    """How reality differs from the deployment file; the same seed makes the same world.

    Parts are spread evenly within their tolerances, contact radii and sheets normally. Sheets are ideal and
    nothing drifts unless it is said so. Raises ValueError for a seed below 0.
    """

    seed: int = 1
    noise_counts: float | None = None
    """Standard deviation of a reading; None: that of the file."""
    gain_tolerance: float = 0.02
    gap_tolerance_mm: float = 0.2
    resistor_tolerance: float = 0.05
    radius_spread: float = 1.0
    """Standard deviation of a contact's radius, in units of the sheet's contact_radius_std_mm."""
    sheet: SheetModel | None = None
    """How the sheets creep, fade and remember, as `handtouch.sheet.S1`; None: they don't."""
    sheet_spread: float = 0.15
    """Relative standard deviation, from pad to pad, of that model's times, share and threshold."""
    drift_counts_per_s: float = 0.0
    """How fast the zero of a channel wanders at most, each channel on its own."""
    warmth_k_per_s: float = 0.0
    """How fast the temperature of the whole hand wanders at most."""
    offset_counts_per_k: float = 0.0
    """Standard deviation of the temperature coefficients of the channels' zeros."""
    gain_per_k: float = 0.0
    """Temperature coefficient of all gains."""
    mount_mm: float = 0.0
    """Standard deviation of where a pad sits on its link, along each axis."""
    mount_deg: float = 0.0
    """And of how it is turned, about each axis."""
    supply_per_s: float = 0.0
    """How fast the driving potential wanders at most, relative to itself."""

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ValueError(f"seed = {self.seed}: must be 0 or more")

    @classmethod
    def ideal_parts(cls, seed: int = 1) -> World:
        """Only noise and quantisation hidden: everything else is as the file says."""
        return cls(seed, None, 0.0, 0.0, 0.0, 0.0)

    def parts(self, hand: str, pad: config.Pad) -> Parts:
        """The pad as built; depends on nothing but the seed, the names and the pad's own table."""
        drawn = np.random.default_rng((self.seed, zlib.crc32(f"{hand}/{pad.link}".encode()))).uniform(
            -1, 1, 16
        )
        gain = 1 + self.gain_tolerance * drawn[:4]
        series = np.array(pad.series_ohm) * (1 + self.resistor_tolerance * drawn[4:8])
        gaps = np.maximum(pad.gap_mm + self.gap_tolerance_mm * drawn[8:].reshape(2, 4), 0.0)
        before, after = gaps
        return Parts(_four(gain), _four(series), _four(before), _four(after))

    def mount(self, hand: str, pad: config.Pad) -> tuple[FloatArray, FloatArray]:
        """Rotation (3, 3) and translation (3,) [m] of the pad's frame in its link's, as it really is."""
        rotation, translation = mount_of(pad)
        if not (self.mount_mm or self.mount_deg):
            return rotation, translation
        drawn = np.random.default_rng((self.seed, zlib.crc32(f"mount/{hand}/{pad.link}".encode())))
        off_m, turned_deg = 1e-3 * self.mount_mm * drawn.normal(size=3), self.mount_deg * drawn.normal(size=3)
        return rotation @ rotation_of(np.radians(turned_deg)), translation + rotation @ off_m

    def gain_of(self, serial: int) -> Four:
        """Gains of the channels of a unit that is put in instead of another."""
        drawn = np.random.default_rng((self.seed, serial, 1)).uniform(-1, 1, 4)
        return _four(1 + self.gain_tolerance * drawn)

    @classmethod
    def drifting(cls, seed: int = 1, sheet: SheetModel = S2) -> World:
        """Parts with tolerances, real sheets, and electronics that drift: an ordinary day."""
        return cls(seed, sheet=sheet)._with_drift()

    @classmethod
    def named(cls, seed: int, *, tolerances: bool, sheet: str | None, drift: bool) -> World:
        """As the command line has it; a sheet by its name, S1 or S2."""
        world = cls(seed) if tolerances else cls.ideal_parts(seed)
        if sheet:
            world = replace(world, sheet={"S1": S1, "S2": S2}[sheet])
        return world._with_drift() if drift else world

    def _with_drift(self) -> World:
        return replace(
            self,
            drift_counts_per_s=0.05,
            warmth_k_per_s=0.01,
            offset_counts_per_k=2.0,
            gain_per_k=1e-4,
            supply_per_s=1e-5,
        )

    def model(self, hand: str, link: str) -> SheetModel | None:
        """The sheet of one pad."""
        if self.sheet is None:
            return None
        drawn = np.random.default_rng((self.seed, zlib.crc32(f"sheet/{hand}/{link}".encode())))
        factors = np.exp(self.sheet_spread * drawn.standard_normal(6))
        was, creep = self.sheet.adaptation, self.sheet.creep
        adaptation = replace(
            was,
            share=np.maximum(1 - (1 - np.asarray(was.share)) * factors[0], 0.0),
            time_s=np.asarray(was.time_s) * factors[1],
            recovery_s=np.asarray(was.recovery_s) * factors[2],
            threshold_n=np.asarray(was.threshold_n) * factors[3],
        )
        times = tuple(float(time_s * factors[4]) for time_s in creep.times_s)
        warmth = self.sheet.temperature
        return replace(
            self.sheet,
            adaptation=adaptation,
            creep=replace(creep, times_s=times),
            temperature=replace(warmth, gain_per_k=float(warmth.gain_per_k * factors[5])),
        )

    def radius_mm(self, sheet: config.Sheet, touch: int) -> float:
        """True radius of a contact; `touch` is its number in the scenario."""
        drawn = np.random.default_rng((self.seed, touch)).normal()
        spread = self.radius_spread * sheet.contact_radius_std_mm
        return max(sheet.contact_radius_mm + spread * drawn, 0.3 * sheet.contact_radius_mm)


class Climate:
    """What the electronics go through: zeros that wander each on its own, and what the whole hand shares.

    Rows are pads. Functions of times (n,) from the start.
    """

    def __init__(self, world: World, names: Sequence[tuple[str, str]]) -> None:
        """names: hand and link of each row."""
        self._world = world
        self.steady = not (world.drift_counts_per_s or world.warmth_k_per_s or world.supply_per_s)
        self._zeros = np.array(
            [noise.key(world.seed, "zero", *name, channel) for name in names for channel in ELECTRODES],
            np.uint64,
        )
        self._per_k = world.offset_counts_per_k * noise.normal(self._zeros, 0)
        self._warmth, self._supply = (
            np.array([noise.key(world.seed, name)]) for name in ("warmth", "supply")
        )

    def warmer_k(self, times_s: FloatArray) -> FloatArray:
        """Temperature of the hand (n,) above that at the start."""
        return np.asarray(self._walk(self._world.warmth_k_per_s, self._warmth, times_s)[0])

    def drive(self, times_s: FloatArray) -> FloatArray:
        """Potential (n,) relative to what it should be."""
        return np.asarray(1 + self._walk(self._world.supply_per_s, self._supply, times_s)[0])

    def gain(self, times_s: FloatArray) -> FloatArray:
        """Of all channels (n,), relative to what it was."""
        return np.asarray(1 + self._world.gain_per_k * self.warmer_k(times_s))

    def zero(self, times_s: FloatArray) -> FloatArray:
        """Counts (n, rows, 4) that channels show without any current."""
        walk = self._walk(self._world.drift_counts_per_s, self._zeros, times_s)
        walk += self._per_k[:, None] * self.warmer_k(times_s)
        return np.asarray(walk.T.reshape(len(times_s), len(self._zeros) // 4, 4))

    @staticmethod
    def _walk(rate: float, keys: NDArray[np.uint64], times_s: FloatArray) -> FloatArray:
        """Walks (keys, n) from 0, never steeper than the rate."""
        if not rate:
            return np.zeros((len(keys), len(times_s)))
        return np.asarray(rate * (noise.wander(keys, times_s) - _at_start(keys.tobytes())))


@lru_cache(maxsize=1024)
def _at_start(keys: bytes) -> FloatArray:
    return noise.wander(np.frombuffer(keys, np.uint64), 0.0)


def _four(values: NDArray[np.float64]) -> Four:
    x0, xa, y0, yb = values.tolist()
    return x0, xa, y0, yb
