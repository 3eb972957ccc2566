"""Hours of a finger of taxels whose zeros move: by drift, or as it turns in the Earth's magnetic field.

Public names: `Zeros`, `Found`, `play_zeros`, `finger`. Counts of drawn sensors go through the
daemon's stages, with the orientations that a robot sends 20 ms late.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from handtouch.config import Deployment, load, shipped
from handtouch.config.channels import node_channels
from handtouch.config.responses import Taxels
from handtouch.core.gravity import quaternion_vectors
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import run_tick
from handtouch.core.slab import CountSlab, Cycle
from handtouch.core.tick import TickProcessor
from handtouch.simulate.base_motion import BaseTurn, base_rotation
from handtouch.simulate.scenario import Scenario
from handtouch.simulate.touch import ScenarioTouch
from handtouch.simulate.virtual_hand import VirtualHand
from handtouch.simulate.worlds import WORLDS, Family, MountSpread
from handtouch.simulate.worlds.distributions import Fixed

FloatArray = NDArray[np.float64]
PERIOD_S, CHUNK_S = 600.0, 60.0
EVERY_S, TURN_DEG, TURN_S, RAMP_S = 15.0, 20.0, 1.0, 0.25
TOUCH_S, AFTER_TURN_S, AT_REST_S = 0.6, 0.3, 8.0
SENT_EVERY, SENT_LATE = 2, 2
"""Of orientations, in ticks of 10 ms."""


@dataclass(frozen=True)
class Zeros:
    """How zeros move: drift of each channel, up in one hour and down in the next, as the signal of a force
    and relative; shift of a magnetic pad by a turn of `TURN_DEG`, as that of a force."""

    drift_n: float = 0.0
    gain_drift: float = 0.0
    turn_n: float = 0.0


@dataclass
class Found:
    """Contacts without a touch, and touches by their force: all, and those found."""

    hours: float = 0.0
    false: int = 0
    touches: dict[str, int] = field(default_factory=dict)
    found: dict[str, int] = field(default_factory=dict)

    def add(self, other: Found) -> None:
        """Add those of another finger."""
        self.hours, self.false = self.hours + other.hours, self.false + other.false
        for mine, theirs in ((self.touches, other.touches), (self.found, other.found)):
            for name, count in theirs.items():
                mine[name] = mine.get(name, 0) + count


def finger(magnetic: bool) -> Deployment:
    """Return the finger of taxels.toml, with Hall sensors if `magnetic`."""
    deployment = load(shipped.path("taxels.toml"))
    (hand,) = deployment.hands
    pads = tuple(
        pad.model_copy(update={"response": pad.response.model_copy(update={"magnetic": magnetic})})
        for pad in hand.pads
        if isinstance(pad.response, Taxels)
    )
    hand = hand.model_copy(update={"pads": pads})
    return deployment.model_copy(update={"hands": (hand,)})


def scenario(links: Sequence[str], zeros: Zeros, seed: int) -> Scenario:
    """Return ten minutes with a turn every 15 s, forth and back, and touches after those forth."""
    rng = np.random.default_rng((seed, 11))
    touches, turns, last = [], [], np.zeros(3)
    for number, from_s in enumerate(np.arange(EVERY_S, PERIOD_S, EVERY_S).tolist()):
        last = -last if number % 2 else rng.normal(size=3)
        if zeros.turn_n:
            rev_s = TURN_DEG / 360 / (TURN_S - RAMP_S)
            turns.append(
                BaseTurn(
                    from_s=from_s,
                    duration_s=TURN_S,
                    axis=(float(last[0]), float(last[1]), float(last[2])),
                    rev_s=rev_s,
                    ramp_s=RAMP_S,
                )
            )
        places = rng.uniform(0.02, 0.98, (len(links), 2)).tolist()
        soon = number % 4 == 0
        begin_s = from_s + (TURN_S + AFTER_TURN_S if soon else AT_REST_S)
        for link, (x, y) in zip(links, places, strict=True):
            if number % 2 == 0:
                force_n = 0.3 if soon and zeros.turn_n else 0.2
                touches.append(
                    ScenarioTouch(
                        link=link, from_s=begin_s, duration_s=TOUCH_S, path=((x, y),), force_n=(force_n,)
                    )
                )
    return Scenario(
        touch=tuple(touches),
        turn=tuple(turns[: len(turns) // 2 * 2]),
        pause_s=PERIOD_S - max(touch.until_s for touch in touches),
        repeat=True,
    )


def play_zeros(zeros: Zeros, number: int, hours: float, world: str = "default") -> Found:
    """Return what was found on a finger of the reporting family."""
    drawn = replace(WORLDS[world], mounts=MountSpread()).draw(Family.REPORTING.seed(number))
    if zeros.turn_n:
        spread = replace(drawn.world.responses, field_n=Fixed(zeros.turn_n / np.sin(np.radians(TURN_DEG))))
        drawn = replace(drawn, world=replace(drawn.world, responses=spread))
    stated = drawn.describe(finger(bool(zeros.turn_n)))
    played = scenario([entry.pad.link for entry in stated.pads], zeros, drawn.seed)
    return _Run(stated, played, VirtualHand(stated, played, drawn), zeros, drawn.seed).run(hours)


class _Run:
    def __init__(
        self, stated: Deployment, played: Scenario, hand: VirtualHand, zeros: Zeros, seed: int
    ) -> None:
        self._played, self._hand, self._zeros = played, hand, zeros
        self._period_s = stated.daemon.sync_period_ms * 1e-3
        period_ns = round(1e9 * self._period_s)
        self._model = PadModel(stated)
        nodes = [node_channels(stated.nodes[entry.pad.node]) for entry in stated.pads]
        most = max(map(len, nodes))
        limits = np.array([[c.limits for c in (*own, *own)[:most]] for own in nodes])
        self._tick, self._cycle = TickProcessor(self._model, period_ns), Cycle(period_ns, 0.6)
        self._slab, self._up = CountSlab(limits), np.zeros(self._model.size, np.uint8)
        rng = np.random.default_rng((seed, 12))
        self._sign = rng.choice([-1.0, 1.0], (2, self._model.size, most))
        units = [pad.response.unit_signal for _, pad in stated.pads if isinstance(pad.response, Taxels)]
        self._counts_per_n = np.array(units)[:, None] / self._model.mean_ampere_per_count[:, None]
        self._channels = np.arange(most) < np.array([len(own) for own in nodes])[:, None]

    def run(self, hours: float) -> Found:
        found, spans = Found(hours), self._spans()
        open_touches: set[tuple[int, float]] = set()
        for begin_s in np.arange(0.0, 3600 * hours, CHUNK_S).tolist():
            times_s = begin_s + self._period_s * np.arange(round(CHUNK_S / self._period_s))
            for t_s, pad in self._began(times_s):
                within = t_s % self._played.duration_s
                own = [span for span in spans[pad] if span[0] - 0.02 <= within <= span[1] + 0.1]
                if own:
                    open_touches.add((pad, t_s - within + own[0][0]))
                else:
                    found.false += 1
            for pad, own_spans in enumerate(spans):
                for from_s, until_s, force_n in own_spans:
                    at_s = begin_s - begin_s % self._played.duration_s + from_s
                    if begin_s <= at_s + until_s - from_s < begin_s + CHUNK_S:
                        name = f"{force_n:g} N"
                        found.touches[name] = found.touches.get(name, 0) + 1
                        found.found[name] = found.found.get(name, 0) + ((pad, at_s) in open_touches)
        return found

    def _spans(self) -> list[list[tuple[float, float, float]]]:
        return [
            [
                (touch.from_s, touch.until_s, touch.force_n[0])
                for touch in self._played.touches
                if touch.link == link
            ]
            for link in self._model.links
        ]

    def _began(self, times_s: FloatArray) -> list[tuple[float, int]]:
        """Return times and pads of the contacts that began."""
        began, zeros = [], self._zeros
        counts = np.zeros((len(times_s), *self._channels.shape))
        for row, used in enumerate(self._channels):
            counts[:, row, used] = self._hand.counts(row, times_s)
        hours = 1 - np.abs((times_s / 3600) % 2 - 1)
        counts *= 1 + zeros.gain_drift * self._sign[0] * hours[:, None, None]
        counts += zeros.drift_n * self._counts_per_n * self._sign[1] * hours[:, None, None]
        orientations = self._orientations(times_s) if zeros.turn_n else None
        for tick, sample in enumerate(np.rint(counts).astype(np.int64)):
            t_s = float(times_s[tick])
            if orientations is not None and tick % SENT_EVERY == 0 and not np.isnan(orientations[tick, 0]):
                self._tick.baseline.set_felt_gravity(np.tile(orientations[tick], (self._model.size, 1)))
            sync_ns = 10**9 + round(1e9 * t_s)
            self._tick.prepare_next_tick()
            self._slab.begin_cycle(sync_ns)
            self._cycle.begin_cycle(sync_ns)
            self._slab.store_counts(sample * self._channels, sync_ns + 1000)
            result = run_tick(self._tick, self._slab, self._up, self._cycle)
            began += [(t_s, pad) for pad in result.began.tolist()]
        return began

    def _orientations(self, times_s: FloatArray) -> FloatArray:
        """Return the orientations (n, 3) as they were sent, see `GravityTracker`; NaN at rest."""
        within = (times_s - SENT_LATE * self._period_s) % self._played.duration_s
        turns = self._played.turns
        near = [
            turn
            for first in range(0, len(turns), 2)
            if turns[first].from_s < within.max() and within.min() < turns[first + 1].from_s + TURN_S
            for turn in turns[first : first + 2]
        ]
        made = quaternion_vectors(base_rotation(near, within))
        moves = np.abs(np.diff(made, axis=0, append=made[-1:])).max(axis=1) > 0
        made[~(moves | (np.arange(len(made)) == 0))] = np.nan
        return made
