"""Touch of a hand in a MuJoCo simulation: the arrays that the daemon would publish, without a bus or daemon.

Public names: `TactileSensor`, `SETTLING_S`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch import config, wire
from handtouch.config.channels import node_channels, order_by_electrode
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.core.slab import CountSlab
from handtouch.core.stages.slip import MOTION_CLASSES
from handtouch.simulate.tactile.mujoco_contacts import NO_POINTS, ContactReader, LinkPoints
from handtouch.simulate.tactile.reading import TactileReading
from handtouch.simulate.tactile.simulated_pads import SimulatedPads
from handtouch.simulate.worlds import World, world_named
from handtouch.wire import PadState

SETTLING_S = 0.5
"""A hundred samples of the shipped rate: zeros are known to a tenth of a sample's noise"""
_SLIDING = MOTION_CLASSES.index("sliding")
_HANDS_PER_PIPELINE = 64
"""Environments that share a tick: enough to spread the cost of a call, and few enough for the caches"""
_START_NS = 1_000_000_000
_NOISE_SEEDS = 4096  # later ones repeat: times must not reach the hours in which drift matters


class TactileSensor:
    """Pads of a deployment on the links of a MuJoCo model, in one or several environments.

    `world` is a name of `handtouch.simulate.worlds.WORLDS` or a `World`; `seed` draws from it what the
    deployment doesn't know, such as gains and mounts. With several seeds, environment k has the world of seed
    k modulo their number; environments of one seed differ in noise and history. Call `read` once per
    `period_s`, the deployment's SYNC period unless stated otherwise. `bodies`: names of the model's bodies by
    link, where they differ; a geom named `pad LINK` replaces the body's geoms as what the pad senses.

    For `SETTLING_S` before the first reading nothing touches, so that the zeros of the channels are known.
    `detects_slip`: slip is detected too, see `sliding`.

    `links` are the names of the pads, "hand/link", in the order of the arrays. Raises ValueError for an
    unknown world or seed, or a link without a body.
    """

    def __init__(
        self,
        deployment: config.Deployment,
        model: Any,
        world: str | World = "default",
        seed: int | Sequence[int] = 1,
        *,
        environments: int = 1,
        period_s: float | None = None,
        bodies: Mapping[str, str] | None = None,
        detects_slip: bool = False,
    ) -> None:
        if environments < 1:
            raise ValueError(f"environments = {environments}: must be 1 or more")
        seeds = [seed] if isinstance(seed, int) else list(seed)
        deployment = _with_electrodes_only(deployment)
        self.links = deployment.pad_names
        self.environments = environments
        self.period_s = 1e-3 * deployment.daemon.sync_period_ms if period_s is None else period_s
        self._period_ns = round(1e9 * self.period_s)
        pads = [entry.pad for entry in deployment.pads]
        if others := [entry.name for entry in deployment.pads if entry.pad.response]:
            raise ValueError(f"{', '.join(others)}: only sheets with electrodes are simulated with MuJoCo")
        self._reader = ContactReader(pads, model, bodies or {})
        drawn = [world_named(world).draw(number) for number in seeds[:environments]]
        self._members = [np.arange(first, environments, len(drawn)) for first in range(len(drawn))]
        self._hands = [
            SimulatedPads(deployment, one, len(members), self.period_s)
            for one, members in zip(drawn, self._members, strict=True)
        ]
        self._cores = _pipelines(deployment, environments, self._period_ns)
        for core in self._cores:
            core.tick.slip.set_requested(np.full(core.model.size, detects_slip))
        self._states = [core.save_state() for core in self._cores]
        self._columns = {
            name: (column.shape[1:], column.dtype)
            for name, column in self._cores[0].messages.frame_columns().items()
        }
        self._settling_samples = round(SETTLING_S / self.period_s)
        self._samples = 0
        self._restarted: set[int] = set()
        self._arguments = (
            deployment,
            model,
            world,
            tuple(seeds),
            environments,
            self.period_s,
            bodies,
            detects_slip,
        )
        self._settle()

    @property
    def steps(self) -> int:
        """Number of MuJoCo's steps per reading."""
        return max(round(self.period_s / self._reader.time_step_s), 1)

    @property
    def sliding(self) -> NDArray[np.bool_]:
        """Pads (environments, p) whose contact slid in the last reading; none unless slip is detected."""
        slips = [core.tick.slip for core in self._cores]
        slid = [(one.contact_id > 0) & (one.contacts().label == _SLIDING) for one in slips]
        return np.concatenate(slid).reshape(self.environments, -1)

    def read(self, data: Any) -> TactileReading:
        """Return the reading at the contacts of an environment's MjData, or of a sequence of them.

        Call it after `mj_step`; contacts and poses are those of the begin of that step. Raises ValueError for
        another number of environments.
        """
        several = isinstance(data, Sequence)
        states = list(data) if several else [data]
        if len(states) != self.environments:
            raise ValueError(f"{len(states)} MjData for a sensor of {self.environments} environments")
        counts = self._sample(self._reader.read(states))
        reading = self._process(counts)
        return reading if several else reading.environment(0)

    def reset(self, environments: Sequence[int] | None = None) -> None:
        """Begin a new episode in some environments, by default in all: sheets are fresh, and contacts end.

        In the next reading their pads are `PadState.STARTING`, untouched; zeros remain known. Noise and drift
        go on; see `restart`.
        """
        chosen = range(self.environments) if environments is None else environments
        for number in chosen:
            self._hands[number % len(self._hands)].reset(number // len(self._hands))
        self._restarted.update(chosen)

    def restart(self, seed: int = 0) -> None:
        """Go back to the state before the first reading, in all environments; `seed` chooses the noise.

        What follows is the same as after any other restart with this seed.
        """
        for core, state in zip(self._cores, self._states, strict=True):
            core.load_state(state, core.state.layout())
            core.cycle.sync_ns = core.cycle.previous_sync_ns = 0
        for hands in self._hands:
            hands.restart()
        self._samples = seed % _NOISE_SEEDS * self._settling_samples
        self._settle()

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how to make an equal sensor in the same state, for pickle and copy."""
        state = (
            self._samples,
            [(core.save_state(), core.cycle.sync_ns, core.cycle.previous_sync_ns) for core in self._cores],
            [hands.save_state() for hands in self._hands],
            set(self._restarted),
        )
        return _sensor_in_state, (self._arguments, state)

    def load_state(self, state: tuple[Any, ...]) -> None:
        """Continue with the state of an equal sensor."""
        self._samples, cores, hands, self._restarted = state
        for core, (saved, sync_ns, previous_sync_ns) in zip(self._cores, cores, strict=True):
            core.load_state(saved, core.state.layout())
            core.cycle.sync_ns, core.cycle.previous_sync_ns = sync_ns, previous_sync_ns
        for pads, sheets in zip(self._hands, hands, strict=True):
            pads.load_state(sheets)

    def _settle(self) -> None:
        """Take samples without a touch, so that the zeros of the channels are known."""
        for _ in range(self._settling_samples):
            self._process(self._sample(NO_POINTS))

    def _sample(self, contacts: LinkPoints) -> NDArray[np.int64]:
        """Return counts (environments, pads, 4) at the next sample."""
        self._samples += 1
        t_s = self._samples * self.period_s
        counts = np.empty((self.environments, len(self.links), 4), np.int64)
        seeds = len(self._hands)
        for first, (hands, members) in enumerate(zip(self._hands, self._members, strict=True)):
            counts[members] = hands.sample(t_s, contacts if seeds == 1 else contacts.every(seeds, first))
        return counts

    def _process(self, counts: NDArray[np.int64]) -> TactileReading:
        sync_ns = _START_NS + self._samples * self._period_ns
        pads = len(self.links)
        rows = self.environments * pads
        columns = {name: np.empty((rows, *shape), dtype) for name, (shape, dtype) in self._columns.items()}
        for number, core in enumerate(self._cores):
            first = number * _HANDS_PER_PIPELINE
            present = counts[first : first + core.model.size // pads]
            core.node_state[:] = PadState.CLEAR
            for environment in self._restarted:
                if first <= environment < first + len(present):
                    row = (environment - first) * pads
                    core.node_state[row : row + pads] = PadState.STARTING
            core.begin_cycle(sync_ns, sync_ns)
            core.slab.store_counts(present.reshape(-1, 4), sync_ns + 1)
            core.tick_if_due(sync_ns + core.cycle.window_ns)
            of_core = slice(first * pads, (first + len(present)) * pads)
            core.messages.copy_frame_columns({name: column[of_core] for name, column in columns.items()})
        self._restarted.clear()
        shape = self.environments, pads
        return TactileReading(
            counts=counts,
            **{
                name: column.reshape(*shape, *((3, 3) if column.shape[1:] == (9,) else column.shape[1:]))
                for name, column in columns.items()
            },
        )


def _sensor_in_state(arguments: tuple[Any, ...], state: tuple[Any, ...]) -> TactileSensor:
    deployment, model, world, seeds, environments, period_s, bodies, detects_slip = arguments
    made = TactileSensor(
        deployment,
        model,
        world,
        seeds,
        environments=environments,
        period_s=period_s,
        bodies=bodies,
        detects_slip=detects_slip,
    )
    made.load_state(state)
    return made


class _CountPipeline(Pipeline):
    """A pipeline that is given counts."""

    slab: CountSlab


class _NoSink:
    """Nothing subscribes: readings are taken from the arrays."""

    def has_subscriber(self, topic: str) -> bool:  # noqa: ARG002
        return False

    def send(self, message: wire.OutgoingMessage) -> None:
        """Ignore a message."""


def _pipelines(deployment: config.Deployment, environments: int, period_ns: int) -> list[_CountPipeline]:
    """Return pipelines for the environments, whose hands are copies of the deployment's."""
    models: dict[int, PadModel] = {}
    made = []
    for first in range(0, environments, _HANDS_PER_PIPELINE):
        count = min(_HANDS_PER_PIPELINE, environments - first)
        if count not in models:
            models[count] = PadModel(_repeated(deployment, count))
        model = models[count]
        core = _CountPipeline(model, period_ns, deployment.daemon.sample_window_fraction, _NoSink())
        core.slab = CountSlab(np.tile(_channel_limits(deployment), (count, 1, 1)))
        made.append(core)
    return made


def _repeated(deployment: config.Deployment, count: int) -> config.Deployment:
    """Return a deployment with copies of its hands."""
    hands = tuple(
        hand.model_copy(update={"name": f"{hand.name}.{number}"})
        for number in range(count)
        for hand in deployment.hands
    )
    return deployment.model_copy(update={"hands": hands})


def _with_electrodes_only(deployment: config.Deployment) -> config.Deployment:
    """Return a deployment without shear pads and second sheets: a reading has four channels."""
    left_out = {"shear": None, "second_sheet": None}
    return deployment.with_pads(lambda _, pad: pad.model_copy(update=left_out))


def _channel_limits(deployment: config.Deployment) -> NDArray[np.int64]:
    """Return the limits (pads, 4, 2) of the channels x0, xa, y0, yb."""
    nodes = deployment.nodes
    return np.array(
        [
            [channel.limits for channel in order_by_electrode(node_channels(nodes[pad.node]), pad)]
            for _, pad in deployment.pads
        ],
        np.int64,
    )
