"""What every pad reads that nothing touches, followed while that is so and kept while it is not.

Public name: `Baseline`.

Ticks only gather (`gather`); a tenth of a second's samples are then taken in together (`learn`), with the
time that they stand for, so that rates of ticks and missing samples make no difference. Rules:
* An untouched pad is followed with a time constant, and no faster than a bound: what rises slower is drift.
* A touched pad is kept. After its release it is kept until it reads nearly its baseline again: what leaks or
  creeps back neither triggers anew nor becomes the baseline.
* What untouched pads of a hand drift by together (temperature, supply), touched ones are taken to drift too.
* The baseline at the start, and how sure it is, decide whether a first reading is a touch.
* A sheet only takes current. What reads less than its baseline was touched when that was learned, too lightly
  to be told from an offset: the baseline is learned anew.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.intp]

BLOCK_NS = 97_000_000  # no multiple of a period: what rounds stamps shifts no sample to another block
_PAUSE_NS = 3600 * 10**9
_TIME_S = 10.0  # of following
_NOISE_S = 60.0  # of learning the noise
_NOISE_BLOCKS = 10  # from one block that noise is learned from to the next
_LEAST_SAMPLES = 4  # in a block, to tell a variance from
_SPEED_S = 60.0  # of untouched time that a drift's speed is measured over
_SPEED_PART = 0.2  # of what such a measurement changes
_FIRST_SPEED = 0.02  # times the noise, a second, before the first
_NEAR = 0.5  # of what ends a contact: as near its baseline a released pad must read
_SURE = 3.0  # standard deviations
_LEAST_PADS = 3  # whose drift is taken for that of the hand
_GRAVITY_GAIN, _LEAST_TURN = 0.02, 0.05  # part of an innovation that turns explain; of g, squared
_ONES = np.ones(4)


class Baseline:
    """Of n pads of four channels x0, xa, y0, yb [counts]; `hands` are their rows.

    noise_counts: of a channel as configured. on_counts, off_counts: sums of channels that begin and end a
    contact. slow_touch_s: a reading that takes longer to rise to `off_counts` is drift. All (n,).

    Public state: `offset` (n, 4); `std` (n,) of the sum of the four; `noise_squared` (n, 4) [counts^2] as
    found in untouched samples; `waiting` (n,): released, but not back yet; `fresh` (n,): nothing read yet
    that the baseline explains; `known` (n,): it was told, or seen untouched; `drift` (n,): own drift of the
    sum, as it was lately [counts/s]; `by_gravity` (n, 4, 3): what a channel reads more by for a unit of
    gravity.
    """

    def __init__(
        self,
        noise_counts: FloatArray,
        on_counts: FloatArray,
        off_counts: FloatArray,
        slow_touch_s: FloatArray,
        hands: Iterable[slice],
    ) -> None:
        n = len(noise_counts)
        self._bound(noise_counts, on_counts, off_counts, slow_touch_s)
        self.offset = np.zeros((n, 4))
        self.std = on_counts / _SURE
        self.noise_squared = np.repeat(np.square(noise_counts)[:, None], 4, axis=1)
        self.waiting = np.zeros(n, np.bool_)
        self.fresh = np.ones(n, np.bool_)
        self.known = np.zeros(n, np.bool_)
        self.touching = np.zeros(n, np.bool_)
        self.drift = _FIRST_SPEED * noise_counts
        self.by_gravity = np.zeros((n, 4, 3))
        self.gravity: FloatArray | None = None
        """(n, 3) in each link's frame, unit of `by_gravity`, as last given to `turn`; 0: never known"""
        self.turned = np.zeros((n, 3))  # gravity, smoothed as the offset is
        self.expected = np.zeros((n, 4))
        """(n, 4) what is to be taken off a reading"""
        self._member = np.zeros((len(hands := list(hands)), n))
        for row, pads in enumerate(hands):
            self._member[row, pads] = 1.0
        self.common = np.zeros(len(hands))
        """what each hand's pads have drifted by together, a channel"""
        self._sum, self._squares, self._buffer = np.zeros((n, 4)), np.zeros((n, 4)), np.zeros((n, 4))
        self._count = np.zeros(n)
        self._blocks = np.zeros(1, np.int64)
        self._since_ns = np.full(1, -_PAUSE_NS)  # when the block began
        self._known_ns = np.zeros(n, np.int64)  # until when each pad's drift is taken in
        self._anchor, self._anchored_s = np.zeros(n), np.zeros(n)

    def adopt(
        self,
        noise_counts: FloatArray,
        on_counts: FloatArray,
        off_counts: FloatArray,
        slow_touch_s: FloatArray,
    ) -> None:
        """Other settings of the same pads from now on."""
        self._bound(noise_counts, on_counts, off_counts, slow_touch_s)

    def assume(self, pad: int, offset: npt.ArrayLike, std: npt.ArrayLike = 0.0) -> None:
        """Take a pad's offsets (4,) and their standard deviations (4,) or () [counts] from elsewhere: a
        store, or a tare. What it reads next is a touch only if it is farther off than that explains."""
        self.offset[pad] = offset
        if self.gravity is not None:
            self.offset[pad] -= self.by_gravity[pad] @ self.gravity[pad]
        self.std[pad] = np.sqrt(np.sum(np.square(np.broadcast_to(std, 4))))
        self.fresh[pad] = self.known[pad] = True
        self.waiting[pad] = self.touching[pad]
        self._anchored_s[pad] = 0.0
        self._forget(np.array([pad]))
        self._expect()

    def renew(self, pad: int) -> None:
        """Another unit is in the place of a pad: nothing that was known holds."""
        self.by_gravity[pad] = 0.0
        self.noise_squared[pad] = self._noise[pad] ** 2
        self.drift[pad] = _FIRST_SPEED * self._noise[pad]
        self.assume(pad, np.zeros(4), self._on[pad] / (2 * _SURE))
        self.known[pad] = False

    def turn(self, gravity: FloatArray) -> None:
        """Direction of gravity in each link's frame, (n, 3) of unit length, from joint states; where it is
        NaN nobody knows, and the last is taken to hold."""
        if self.gravity is None:
            self.gravity = np.zeros_like(gravity)
        known = ~np.isnan(gravity[:, 0])
        first = known & ~self.gravity.any(axis=1)
        self.gravity[known] = gravity[known]
        self.turned[first] = gravity[first]
        self._expect()

    @property
    def unsure(self) -> BoolArray:
        """Pads (n,) that have been touched since the start, so that nobody knows their baseline."""
        return np.asarray(self.touching & ~self.known)

    @property
    def noise_counts(self) -> FloatArray:
        """Standard deviation of each channel (n, 4) as found while untouched."""
        return np.asarray(np.sqrt(self.noise_squared))

    def gather(self, excess: FloatArray, free: BoolArray) -> None:
        """Keep the samples of a tick: counts less `expected` (n, 4), of the pads that are `free` (n,), that
        is untouched, with a new sample that can be trusted."""
        if np.count_nonzero(free) == free.size:
            masked = excess
        else:
            masked = np.multiply(excess, free[:, None], out=self._buffer)
        self._sum += masked
        self._squares += np.multiply(masked, masked, out=self._buffer)
        self._count += free

    def begin(self, began: IntArray) -> None:
        """Contacts began on these pads: what was gathered last may be their approach."""
        self.waiting[began] = True
        self._forget(began)

    def learn(self, t_ns: int, touching: BoolArray) -> bool:
        """Take in what was gathered, once it is a tenth of a second's, and say whether it was;
        `touching` (n,) are contacts now."""
        elapsed_ns = t_ns - int(self._since_ns[0])
        if 0 <= elapsed_ns < BLOCK_NS:
            return False
        self._since_ns[0] = t_ns
        if not 0 <= elapsed_ns < _PAUSE_NS:  # the first time, or the clock is another one
            self._known_ns[:] = t_ns
            return False
        np.copyto(self.touching, touching)
        self.waiting |= touching
        seen = self._count > 0
        mean = self._sum / np.maximum(self._count, 1.0)[:, None]
        total = mean @ _ONES
        self._release(seen & ~touching, total)
        free = seen & ~self.waiting
        dt_s = np.asarray((t_ns - self._known_ns) * 1e-9, np.float64)
        np.copyto(self._known_ns, t_ns, where=free | self.waiting)
        moved = self._follow(mean, free, dt_s)
        self._drift(moved @ _ONES, free, elapsed_ns * 1e-9, dt_s)
        self._blocks[0] += 1
        if self._blocks[0] % _NOISE_BLOCKS == 0:
            self._learn_noise(mean, free)
        if self.gravity is not None:
            self._learn_gravity(mean, free, dt_s)
        self._expect()
        self._sum[:] = 0.0
        self._squares[:] = 0.0
        self._count[:] = 0.0
        return True

    # Details: parts of `learn` -----------------------------------------------------------------------------

    def _release(self, read: BoolArray, total: FloatArray) -> None:
        """Pads that read what their baseline explains are no longer kept."""
        near = _NEAR * self._off + _SURE * np.hypot(self.std, 2 * self._noise)
        less = read & (total < -near) & (total >= -self._on)
        if np.count_nonzero(less):
            self.fresh |= less
            self.waiting |= less  # for the next block: only a part of this may be without the touch
            self.std[less] = self._on[less] / _SURE
            read = read & ~less
        elif not np.count_nonzero(self.fresh) and not np.count_nonzero(self.waiting):
            return
        first_near = _SURE * np.hypot(self.std, 2 * self._noise)
        first_near = np.minimum(first_near, np.maximum(self._on, _SURE * self.std))
        near = np.where(self.fresh, first_near, near)
        back = read & (np.abs(total) <= near)
        first = np.flatnonzero(back & self.fresh)
        if len(first):
            count = self._count[first]
            variance = np.square(self._noise[first]) * 4 / count
            gain = np.square(self.std[first]) / (np.square(self.std[first]) + variance)
            jump = self._sum[first] * (gain / count)[:, None]
            self.offset[first] += jump
            self._sum[first] -= jump * count[:, None]
            self._squares[first] = 0.0
            self._count[first] = 0.0
            self.std[first] = np.sqrt(gain * variance)
            self.fresh[first], self.known[first] = False, True
        self.waiting &= ~back

    def _follow(self, mean: FloatArray, free: BoolArray, dt_s: FloatArray) -> FloatArray:
        """Move offsets towards what is read: do/dt = excess / time, but not faster than the bound. The answer
        (n, 4) is by how much. Exact while a reading is constant, whatever the intervals."""
        excess = np.abs(mean) @ _ONES
        linear = self._rate * _TIME_S
        bound_s = np.maximum(excess - linear, 0.0) / self._rate
        left = np.minimum(excess, linear) * np.exp(np.minimum(bound_s - dt_s, 0.0) / _TIME_S)
        left = np.maximum(left, excess - self._rate * dt_s)
        part = (1 - left / np.maximum(excess, 1e-12)) * free
        moved = mean * part[:, None]
        self.offset += moved
        return np.asarray(moved)

    def _drift(self, moved: FloatArray, free: BoolArray, elapsed_s: float, dt_s: FloatArray) -> None:
        """Take untouched pads' common drift for that of the others, and carry uncertainty on."""
        pads = self._member @ free
        shift = np.where(pads >= _LEAST_PADS, self._member @ (moved * free) / np.maximum(4 * pads, 1.0), 0.0)
        self.common += shift
        kept = shift @ self._member * self.waiting
        self.offset += kept[:, None]
        settled = (self.drift * _TIME_S + _NEAR * self._noise - self.std) * -np.expm1(-dt_s / _TIME_S)
        self.std += np.where(free, settled, self.drift * elapsed_s)
        self._anchored_s += free * dt_s
        if np.count_nonzero(due := self._anchored_s >= _SPEED_S):
            own = self.offset @ _ONES - 4 * (self.common @ self._member)
            speed = np.abs(own - self._anchor)[due] / self._anchored_s[due]
            self.drift[due] += _SPEED_PART * (speed - self.drift[due])
            self._anchor[due], self._anchored_s[due] = own[due], 0.0

    def _learn_noise(self, mean: FloatArray, free: BoolArray) -> None:
        """Scatter about the mean of a block, in which no baseline moves."""
        enough = free & (self._count >= _LEAST_SAMPLES)
        spare = np.maximum(self._count - 1, 1.0)[:, None]
        variance = (self._squares - self._sum * mean) / spare
        part = -np.expm1(-_NOISE_BLOCKS * BLOCK_NS * 1e-9 / _NOISE_S) * enough
        self.noise_squared += (variance - self.noise_squared) * part[:, None]

    def _learn_gravity(self, mean: FloatArray, free: BoolArray, dt_s: FloatArray) -> None:
        """What offsets don't explain yet goes with how gravity has turned since (normalised least mean
        squares); both were smoothed alike, so an offset is no gravity."""
        assert self.gravity is not None
        turn = self.gravity - self.turned
        self.turned += turn * (-np.expm1(-dt_s / _TIME_S) * free)[:, None]
        gain = _GRAVITY_GAIN * free / (np.square(turn).sum(axis=1) + _LEAST_TURN)
        moved = (mean * gain[:, None])[:, :, None] * turn[:, None]
        self.by_gravity += moved
        self.offset -= np.matmul(moved, self.turned[:, :, None])[:, :, 0]  # explained by the turn, no offset

    def _forget(self, pads: IntArray) -> None:
        self._sum[pads] = self._squares[pads] = 0.0
        self._count[pads] = 0.0

    def _expect(self) -> None:
        np.copyto(self.expected, self.offset)
        if self.gravity is not None:
            self.expected += np.matmul(self.by_gravity, self.gravity[:, :, None])[:, :, 0]

    def _bound(self, noise: FloatArray, on: FloatArray, off: FloatArray, slow_touch_s: FloatArray) -> None:
        self._noise, self._on, self._off, self._rate = noise, on, off, off / slow_touch_s
