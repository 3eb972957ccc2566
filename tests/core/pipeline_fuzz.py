"""Fuzz of the core by its pipeline: random pads, counts, clocks, rates and events, and laws of every tick.

Public names: `Fuzz`, `Law`, `LAWS`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.config import ConfigError, parse
from handtouch.core.active_calibration import ActiveCalibration
from handtouch.core.columns import TickResult
from handtouch.core.events import (
    BackForceEvent,
    BaselineEvent,
    CalibrationEvent,
    DemandEvent,
    Event,
    ExcitationEvent,
    ForceEvent,
    GravityEvent,
    ReplacementEvent,
    SamplingEvent,
)
from handtouch.core.pipeline import Pipeline
from handtouch.core.slab import ChannelField
from handtouch.core.stages.rows import VALUE_SLICES
from handtouch.daemon.table_cache import build_pad_model
from handtouch.hand import pad_surface
from handtouch.wire import ForceStatus, PadState, PositionStatus
from tests.deployments import CYLINDER, SIX_ARCS, THREE_ARCS

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
DISC = (
    '{ kind = "outline", outline_x_mm = [9, -9], outline_y_mm = [0, 0], edge_turn_deg = [180, 180], '
    "corners_mm = [35.3429, 49.4801, 7.0686, 21.2058] }"
)
CONE = '{ kind = "cone", near_radius_mm = 10.5, far_radius_mm = 9.5, slant_mm = 25.0, arc_deg = 150.0 }'
SPHERE = '{ kind = "sphere", radius_mm = 10.0, from_deg = -30.0, to_deg = 55.0, arc_deg = 140.0 }'


def plane(length_mm: float, width_mm: float) -> str:
    return f'{{ kind = "plane", length_mm = {length_mm}, width_mm = {width_mm} }}'


def arcs(names: dict[str, tuple[float, float]]) -> str:
    listed = ", ".join(f"{name} = [{begin}, {end}]" for name, (begin, end) in names.items())
    return f"electrode_arcs_mm = {{ {listed} }}"


SHAPES: dict[str, tuple[str, float, str]] = {
    "30 x 24 mm": (plane(30, 24), 0.6, ""),
    "1 m x 1 m": (plane(1000, 1000), 20.0, ""),
    "3 x 2 mm": (plane(3, 2), 0.05, ""),
    "100 x 10 mm": (plane(100, 10), 0.5, ""),
    "24 x 24 mm without gaps": (plane(24, 24), 0.0, ""),
    "24 x 24 mm, gaps of 11 mm": (plane(24, 24), 11.0, ""),
    "30 x 24 mm, 336 ohm": (plane(30, 24), 0.6, "series_ohm = [336.0, 336.0, 336.0, 336.0]"),
    "30 x 24 mm, 1 Mohm at one side": (plane(30, 24), 0.6, "series_ohm = [1e6, 0.0, 0.0, 0.0]"),
    "cylinder": (CYLINDER, 0.6, ""),
    "cone": (CONE, 0.6, ""),
    "sphere": (SPHERE, 0.6, ""),
    "three arcs": (DISC, 0.0, arcs(THREE_ARCS)),
    "six arcs": (DISC, 0.0, arcs(SIX_ARCS)),
}
"""Surface, gap and further keys of pads by name."""
RANGES: dict[str, dict[str, tuple[float, float]]] = {
    "node": {"drive_v": (0.1, 100.0), "full_scale_ma": (1e-3, 1e3), "noise_counts": (1e-3, 300.0)},
    "sheet": {
        "ohm_per_square": (1.0, 1e6),
        "contact_ohm_mm2": (1.0, 1e8),
        "alpha": (0.2, 5.0),
        "reference_kpa": (0.1, 1e4),
        "contact_radius_mm": (0.01, 50.0),
        "contact_radius_std_mm": (1e-4, 10.0),
        "hertz_force_n": (0.01, 100.0),
        "max_force_n": (0.05, 1e3),
        "contact_tilt_std": (1e-3, 1.0),
        "ohm_per_square_std": (1e-4, 1.0),
        "contact_ohm_std": (1e-4, 1.0),
        "alpha_std": (1e-4, 1.0),
        "anisotropy_std": (1e-4, 1.0),
        "gap_std_mm": (1e-4, 3.0),
        "unevenness_std": (1e-4, 1.0),
        "size_std_mm": (1e-4, 3.0),
    },
}
"""Ranges of the keys that are drawn, by their logarithms, well beyond pads that anybody builds."""
OPTIONAL = ("hertz_force_n", "max_force_n")
ELONGATIONS = (0.0, 0.4, 2.0)
USUAL = {
    "node": {"drive_v": 5.0, "full_scale_ma": 10.0, "noise_counts": 1.0},
    "sheet": {
        "ohm_per_square": 2400.0,
        "contact_ohm_mm2": 20000.0,
        "alpha": 1.5,
        "contact_radius_mm": 2.5,
        "contact_radius_std_mm": 0.5,
    },
}
BEHAVIOURS = ("", "", "", "", "", "", "", "", "", "S1", "S2", "unknown")
RAILS = np.array([-32768, -32767, -32766, -30, -2, -1, 0, 1, 2, 30, 1000, 30000, 32765, 32766, 32767])
PERIODS_NS = (500_000, 1_000_000, 5_000_000, 50_000_000, 1_000_000_000)
STARTS_NS = (1, 10**9, 10**17)
HOUR_NS = 3600 * 10**9
LAWS = (
    "values that are published are finite",
    "no force is valid, and no position of fewer than three electrodes, at the top of a range",
    "no contact continues at the bottom of a range",
    "covariances of positions are positive, and within the pad",
    "a force's deviation is positive",
    "forces are at least 0 and at most max_force_n",
    "the state is finite",
    "messages can be read, and are finite",
)
TICKS_OF_A_ROUND = 400
LISTENED = 0.05
"""Part of the ticks whose messages are encoded and read"""


@dataclass
class Law:
    """A law of every tick: number of values that were checked, and that broke it, with the first of them."""

    name: str
    checked: int = 0
    broken: int = 0
    first: str = ""

    def check(self, kept: NDArray[np.bool_], describe: Callable[[int], str]) -> None:
        """Count values (k,) of which it is kept or not; `describe`: a number among them."""
        self.checked += len(kept)
        if not kept.all():
            self.broken += int((~kept).sum())
            self.first = self.first or describe(int(np.flatnonzero(~kept)[0]))


class Fuzz:
    """One model of random pads, driven for rounds of ticks by random samples, clocks and events.

    `ticks`: of pads, samples that passed the pipeline or were missing. `laws`: what was found.
    """

    def __init__(
        self,
        seed: int,
        kinds: int = 4,
        shapes: Sequence[str] = tuple(SHAPES),
        pads: Sequence[tuple[str, str]] = (),
    ) -> None:
        """Draw `kinds` of electronics and sheet for each shape; the first one is a usual one.

        pads: instead, shapes with keys, written as a law's `first` shows them.
        """
        self.rng, self.seed, self.ticks = np.random.default_rng(seed), seed, 0
        chosen = pads or [(shape, self._draw(shape, kind)) for shape in shapes for kind in range(kinds)]
        self.pads = [(f"{shape}; {text}", *_tables(k, shape, text)) for k, (shape, text) in enumerate(chosen)]
        deployment = parse(_deployment([tables for _, *tables in self.pads]))
        self.model = build_pad_model(deployment)
        self.size, self.counts_of = self.model.size, self.model.electrode_counts
        self._used = np.arange(self.model.channels) < self.counts_of[:, None]
        sheets = [deployment.sheets[pad.sheet] for _, pad in deployment.pads]
        self._max_force_n = np.array([sheet.max_force_n or np.inf for sheet in sheets])
        lengths = [np.sum(pad_surface(pad).side_lengths_m()) for _, pad in deployment.pads]
        self._trace_m2 = np.square(lengths)  # beyond that of any contact on the pad
        self.laws = [Law(name) for name in LAWS]
        self._messages: list[wire.OutgoingMessage] = []
        self._listening = False

    # Pads -------------------------------------------------------------------------------------------------

    def _draw(self, shape: str, kind: int) -> str:
        """Return the keys of node and sheet of a pad that a deployment accepts."""
        if kind == 0:
            return "usual"
        while True:
            text = self._random_keys(shape, only_ends=kind == 1)
            try:
                parse(_deployment([_tables(0, shape, text)]))
            except ConfigError:
                continue
            return text

    def _random_keys(self, shape: str, *, only_ends: bool) -> str:
        lines = []
        for table, ranges in RANGES.items():
            for key, (low, high) in ranges.items():
                if key in OPTIONAL and self.rng.random() < 0.5:
                    continue
                if key == "ohm_per_square" and "ohm" in shape:
                    continue  # it would be another network, whose table takes a second
                at = self.rng.random()
                at = round(at) if only_ends else at
                lines.append(f"{table}.{key} = {low * (high / low) ** at:.3g}")
        lines.append(f"sheet.contact_elongation_std = {self.rng.choice(ELONGATIONS)}")
        behaviour = self.rng.choice(BEHAVIOURS)
        return ", ".join([*lines, *([f"behaviour {behaviour}"] if behaviour else [])])

    # Rounds -----------------------------------------------------------------------------------------------

    def run(self, ticks: int) -> list[Law]:
        """Run rounds until so many ticks of pads have passed; return the laws."""
        until = self.ticks + ticks
        while self.ticks < until:
            self._run_round()
        return self.laws

    def hold(self, *steps: Sequence[Sequence[int]], ticks: int = 20, period_ns: int = 5_000_000) -> list[Law]:
        """Hold each of these counts on all pads for so many ticks, baselines known; return the laws."""
        self._begin_round(period_ns)
        self._set_baselines()
        for counts in steps:
            for pad, row in enumerate(counts):
                self._readings[pad, : len(row)] = row
            for _ in range(ticks):
                self._t_ns += period_ns
                self.pipeline.begin_cycle(self._t_ns, self._t_ns)
                self._tick(self._t_ns + 1000, np.arange(self.size))
            self._check_state()
        return self.laws

    def _begin_round(self, period_ns: int) -> None:
        size = self.size
        for pad in range(size):
            self.model.set_calibration(pad, self.model.default_calibration(pad))
        self._period_ns = period_ns
        self.pipeline = Pipeline(self.model, self._period_ns, 0.6, self)
        self.pipeline.node_state[:] = PadState.CLEAR
        for slot, count in enumerate(self.counts_of.tolist()):
            fields = tuple(ChannelField(k // 4, 16 * (k % 4), 16, True) for k in range(count))
            self.pipeline.slab.set_layout(slot, fields)
        self._t_ns = STARTS_NS[0]
        self._readings: IntArray = np.zeros((size, self.model.channels), dtype=np.int64)
        self._kept = np.zeros(size, dtype=np.int64)

    def _set_baselines(self) -> None:
        for pad in range(self.size):
            offset = (0.0,) * int(self.counts_of[pad])
            self.pipeline.add_event(BaselineEvent(pad, offset, offset))

    def _run_round(self) -> None:
        rng = self.rng
        self._begin_round(int(rng.choice(PERIODS_NS)))
        self._t_ns = int(rng.choice(STARTS_NS))
        if rng.random() < 0.7:  # else baselines are unknown for a while
            self._set_baselines()
        for number in range(TICKS_OF_A_ROUND):
            if rng.random() < 0.03:
                self.pipeline.add_event(self._draw_event())
            self._listening = rng.random() < LISTENED
            self._advance_clock()
            self.pipeline.begin_cycle(self._t_ns, self._t_ns)
            self._draw_readings()
            late_ns = int(rng.choice([1000, 1000, 1000, -self._period_ns, 0, 5 * self._period_ns]))
            self._tick(self._t_ns + late_ns, np.flatnonzero(rng.random(self.size) < 0.97))
            if rng.random() < 0.01:
                self.pipeline.node_state[:] = PadState.CLEAR
                self.pipeline.node_state[rng.integers(self.size)] = rng.choice(list(map(int, PadState)))
            if number % 50 == 0:
                self._check_state()
        self.pipeline.end_session(self._t_ns)
        state = self.pipeline.state
        self.pipeline.load_state(self.pipeline.save_state(), state.layout())

    def _tick(self, arrival_ns: int, sampled: NDArray[np.intp]) -> None:
        """Run a tick with the samples of some pads."""
        pipeline, counts = self.pipeline, self._readings.astype("<i2")
        for pad in sampled.tolist():
            data = counts[pad, : self.counts_of[pad]].tobytes()
            for pdo in range(0, len(data), 8):
                pipeline.slab.write_pdo(pad, data[pdo : pdo + 8], arrival_ns, pdo // 8)
        result = pipeline.finish_cycle(_NO_LIMIT_NS, self._t_ns + 2000)
        assert result is not None
        self.ticks += self.size
        self._check(result)
        self._read_messages()

    def _advance_clock(self) -> None:
        step = self.rng.random()
        if step < 0.95:
            self._t_ns += self._period_ns
        elif step < 0.97:
            self._t_ns += int(self.rng.integers(1, 20)) * self._period_ns
        elif step < 0.98:
            self._t_ns += 1
        elif step < 0.99:
            self._t_ns += 2 * HOUR_NS
        else:
            self._t_ns = max(1, self._t_ns - 10 * self._period_ns)

    # Samples ----------------------------------------------------------------------------------------------

    def _draw_readings(self) -> None:
        """Change the readings of some pads; the others repeat theirs, some with noise."""
        rng, shape = self.rng, self._readings.shape
        self._kept -= 1
        changed = self._kept < 0
        self._kept[changed] = rng.integers(1, 12, int(changed.sum()))
        kind = rng.integers(8, size=len(changed))
        fraction = self._contacts(np.flatnonzero(changed))
        largest = np.exp(rng.uniform(0, math.log(40000), (len(changed), 1)))
        drawn = np.select(
            [kind[:, None] == k for k in range(8)],
            [
                np.rint(rng.normal(size=shape)),
                np.rint(fraction * largest),
                np.rint(fraction * largest + rng.normal(size=shape)),
                rng.integers(-32768, 32768, shape),
                rng.integers(-3, 4, shape),
                rng.choice(RAILS, shape),
                np.rint(np.exp(rng.uniform(0, math.log(32767), shape))),
                np.broadcast_to(rng.choice(RAILS, (len(changed), 1)), shape),
            ],
        )
        lone = rng.random(len(changed)) < 0.2  # one channel carries all
        drawn[lone] = np.where(
            rng.integers(shape[1], size=(int(lone.sum()), 1)) == np.arange(shape[1]),
            32766,
            drawn[lone].clip(-2, 30),
        )
        self._readings[changed] = drawn[changed].clip(-32768, 32767)
        moved = ~changed & (rng.random(len(changed)) < 0.3)
        self._readings[moved] += rng.integers(-2, 3, (int(moved.sum()), shape[1]))
        np.clip(self._readings, -32768, 32767, out=self._readings)
        self._readings[~self._used] = 0

    def _contacts(self, pads: IntArray) -> FloatArray:
        """Return fractions (n, c) of contacts on these pads (k,), to the corners, over the largest."""
        fractions = np.ones(self._readings.shape)
        for pad, (x, y) in zip(pads.tolist(), self.rng.random((len(pads), 2)).tolist(), strict=True):
            nodes = self.model.forward_tables[pad].nodes
            row = nodes[int(x * len(nodes)), int(y * len(nodes)), 0, : self.counts_of[pad]]
            fractions[pad, : self.counts_of[pad]] = row / row.max()
        return fractions

    def _draw_event(self) -> Event:
        rng, size = self.rng, self.size
        pad = int(rng.integers(size))
        count = int(self.counts_of[pad])
        some = rng.random((6, size)) < 0.8
        makers: list[Callable[[], Event]] = [
            lambda: BaselineEvent(
                pad,
                tuple(rng.uniform(-2000, 30000, count).tolist()),
                tuple(rng.uniform(0, 50, count).tolist()),
            ),
            lambda: BaselineEvent(
                pad, tuple(self._readings[pad, :count].astype(float).tolist()), (0.0,) * count
            ),
            lambda: CalibrationEvent(pad, self._draw_calibration(count)),
            lambda: ReplacementEvent(pad),
            lambda: BackForceEvent(pad, float(rng.uniform(0, 20)), float(rng.uniform(0, 20))),
            lambda: ExcitationEvent(tuple((rng.random(size) < 0.8).tolist())),
            lambda: DemandEvent(
                *(tuple(some[0].tolist()), tuple((some[0] & some[1]).tolist())),
                *(tuple(rng.choice([1, 1, 2, 20], size).tolist()), (False,) * size, (False,) * size),
                *(tuple(some[2].tolist()), int(rng.choice([1, 1, 5]))),
            ),
            lambda: SamplingEvent(
                tuple((rng.random(size) < 0.8).tolist()),
                tuple((rng.choice([1, 1, 10], size) * self._period_ns).tolist()),
                (pad,),
            ),
            lambda: GravityEvent(tuple(map(tuple, _unit(rng.normal(size=(size, 3))).tolist()))),
            lambda: ForceEvent(
                (pad,), (float(np.exp(rng.uniform(-9, 9))),), (float(np.exp(rng.uniform(-9, 9))),), self._t_ns
            ),
        ]
        return makers[rng.integers(len(makers))]()

    def _draw_calibration(self, count: int) -> ActiveCalibration:
        rng = self.rng
        root = rng.normal(size=(count, count)) * np.exp(rng.uniform(-9, 0))
        dead = int(rng.integers(count)) if rng.random() < 0.2 and count >= 5 else None
        return ActiveCalibration(
            "fuzz",
            tuple(np.exp(rng.uniform(math.log(0.1), math.log(10.0), count)).tolist()),
            gain_covariance=tuple((root @ root.T).ravel().tolist()) if rng.random() < 0.5 else None,
            quarantined=bool(rng.random() < 0.1),
            position_unreliable=bool(rng.random() < 0.1),
            dead_electrode=dead,
        )

    # Laws -------------------------------------------------------------------------------------------------

    def _check(self, result: TickResult) -> None:
        """Check the published columns of a tick."""
        tick, size = self.pipeline.tick, self.size
        columns, published = tick.columns, tick.columns.published
        is_new = np.zeros(size, np.bool_)
        for rows in (result.began, result.updated, result.framed):
            is_new[rows] = True
        valid = columns.position_status == PositionStatus.VALID
        has_force = columns.force_status == ForceStatus.VALID
        shown = (columns.force_status == ForceStatus.UNRELIABLE) | has_force
        finite, at_top, at_bottom, covariance, deviation, force, _, _ = self.laws

        def among(rows: IntArray) -> Callable[[int], str]:
            return lambda k: self._describe(int(rows[k]))

        rows = np.arange(size)
        known = np.stack([np.isfinite(published[name]).reshape(size, -1).all(axis=1) for name in LOCATED])
        either = np.stack([~np.isinf(column).reshape(size, -1).any(axis=1) for column in published.values()])
        kept = (
            (known.all(axis=0) | ~valid) & (np.isfinite(published["force_n"]) | ~shown) & either.all(axis=0)
        )
        finite.check(kept, among(rows))
        saturated = np.asarray(tick.contacts.saturated_channels).reshape(size, -1).sum(axis=1)
        located = self.counts_of - saturated >= 3
        rows = np.flatnonzero(is_new & (saturated > 0))
        at_top.check((~shown & (located | ~valid))[rows], among(rows))
        bottom = self.pipeline.slab.limits[:, : self.model.channels]
        rows = np.flatnonzero(((tick.counts <= bottom) & self._used).any(axis=1))
        at_bottom.check(~np.asarray(tick.state.touching, np.bool_)[rows], among(rows))
        rows = np.flatnonzero(np.isfinite(columns.position_m[:, 0]) & is_new)
        covariance.check(self._covariance_is_positive(rows), among(rows))
        rows = np.flatnonzero(shown)
        std = published["force_std_n"][rows]
        deviation.check((std > 0) & np.isfinite(std), among(rows))
        rows = np.flatnonzero(np.isfinite(published["force_n"]))
        force_n, most_n = published["force_n"][rows], self._max_force_n[rows]
        force.check((force_n >= 0) & (force_n <= most_n * (1 + 1e-6)), among(rows))

    def _covariance_is_positive(self, rows: IntArray) -> NDArray[np.bool_]:
        """Return True where a covariance is symmetric, and positive in the pad's plane."""
        columns = self.pipeline.tick.columns
        matrix, normal = columns.covariance_m2[rows], columns.normal[rows]
        single = columns.published["covariance_m2"][rows].reshape(-1, 3, 3).astype(np.float64)
        scale = np.abs(matrix).max(axis=(1, 2))
        axis = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
        first = _unit(np.cross(normal, axis))
        second = np.cross(normal, first)
        kept = np.isfinite(scale) & (np.abs(matrix - matrix.swapaxes(1, 2)).max(axis=(1, 2)) <= 1e-9 * scale)
        for found, tolerance in ((matrix, 1e-9), (single, 1e-5)):
            xx, yy = (np.einsum("ni,nij,nj->n", t, found, t) for t in (first, second))
            xy = np.einsum("ni,nij,nj->n", first, found, second)
            kept &= (xx > 0) & (yy > 0) & (xx * yy - xy * xy > -tolerance * xx * yy)
        kept &= np.trace(matrix, axis1=1, axis2=2) <= self._trace_m2[rows]
        noise = columns.pad_noise_m2[rows]
        kept &= (noise[:, 0] > 0) & (noise[:, 2] > 0)
        kept &= noise[:, 0] * noise[:, 2] - noise[:, 1] ** 2 > -1e-9 * noise[:, 0] * noise[:, 2]
        return np.asarray(kept)

    def _check_state(self) -> None:
        state = self.pipeline.state
        for name in FINITE:
            kept = np.isfinite(getattr(state, name)).reshape(len(getattr(state, name)), -1).all(axis=1)
            self.laws[6].check(kept, lambda k, name=name: f"{name}, row {k}: {self._describe(k)}")  # type: ignore[misc]
        self.laws[6].check(
            (state.noise_squared >= 0).all(axis=1) & (state.offset_std >= 0),
            lambda k: f"noise: {self._describe(k)}",
        )

    def _read_messages(self) -> None:
        law = self.laws[7]
        for message in self._messages:
            read, problem = wire.decode(wire.encode(message)), ""
            if isinstance(read, wire.Contact):
                numbers = [
                    *(read.position_m or ()),
                    *(read.covariance_m2 or ()),
                    read.force_n,
                    read.force_std_n,
                ]
                if not all(number is None or math.isfinite(number) for number in numbers):
                    problem = str(read)
                if read.position_status == "valid" and (
                    read.position_m is None or read.covariance_m2 is None
                ):
                    problem = str(read)
                if read.force_status == "valid" and (read.force_n is None or read.force_std_n is None):
                    problem = str(read)
            law.check(np.array([not problem]), lambda _, problem=problem: problem)  # type: ignore[misc]
        self._messages.clear()

    def _describe(self, pad: int) -> str:
        """Return what is known of a pad in the present tick."""
        columns, values = self.pipeline.tick.columns, self.pipeline.state.values[pad]
        name = self.pads[pad][0] if pad < self.size else ""
        gains = self.model.calibrations[pad].gains if pad < self.size else ()
        shown = {
            key: values[at].tolist()
            for key, at in VALUE_SLICES.items()
            if key in ("xy", "covariance_m2", "pad_noise_m2")
        }
        return (
            f"counts {self._readings[pad, : self.counts_of[pad]].tolist()}, force "
            f"{columns.force_n[pad]:.4g} +- {columns.force_std_n[pad]:.4g} N "
            f"({ForceStatus(columns.force_status[pad]).name}), position "
            f"{PositionStatus(columns.position_status[pad]).name}, {shown}, period {self._period_ns} ns, "
            f"gains {gains}: pad {name}; seed {self.seed}, tick {self.ticks}"
        )

    # Sink of the pipeline's messages ------------------------------------------------------------------------

    def has_subscriber(self, topic: str) -> bool:
        return self._listening and not topic.startswith(("tick", "state", "config"))

    def send(self, message: wire.OutgoingMessage) -> None:
        self._messages.append(message)


LOCATED = ("position_m", "normal", "covariance_m2")
FINITE = (
    *("offset", "offset_std", "noise_squared", "drift_speed", "common_drift", "load_coefficients"),
    *(
        "disturbance",
        "threshold_factor",
        "log_gain",
        "log_gain_std",
        "back_n",
        "back_std_n",
        "sheet_elements",
        "sheet_plays",
    ),
    *("misfits", "bank_log_weight", "bank_growth", "touched_s", "total_current_a"),
)
"""Arrays of the state that are never NaN"""
_NO_LIMIT_NS = np.iinfo(np.int64).max


def _tables(number: int, shape: str, text: str) -> tuple[str, str, str]:
    """Return the tables of node, sheet and pad `number`."""
    surface, gap_mm, extra = SHAPES[shape]
    keys = {table: dict(values) for table, values in USUAL.items()}
    for entry in text.split(", "):
        name, _, value = entry.partition(" = ")
        if value:
            table, _, key = name.partition(".")
            keys[table][key] = float(value)
    count = 3 if "three" in shape else 6 if "six" in shape else 4
    channels = ", ".join(f'"0x6401:{sub + 1}"' for sub in range(count))
    behaviour = text.partition("behaviour ")[2]
    node = f"[node.n{number}]\nchannels = [{channels}]\n{_lines(keys['node'])}"
    sheet = f"[sheet.s{number}]\n{_lines(keys['sheet'])}"
    sheet += f'[sheet.s{number}.behaviour]\npreset = "{behaviour}"\n' if behaviour else ""
    pad = (
        f'[[hand.pad]]\nlink = "p{number}"\nbus = "can0"\nnode_id = {number + 1}\nnode = "n{number}"\n'
        f'sheet = "s{number}"\nsurface = {surface}\ngap_mm = {gap_mm}\n{extra}\n'
    )
    return node, sheet, pad


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _lines(keys: dict[str, float]) -> str:
    return "".join(f"{key} = {value!r}\n" for key, value in keys.items())


def _deployment(pads: list[Any]) -> str:
    bus = '[[bus]]\nname = "can0"\ninterface = "virtual"\nchannel = "fuzz"\n'
    nodes, sheets, tables = ("\n".join(parts) for parts in zip(*pads, strict=True))
    touch = "[touch]\nbegin_ms = 0.0\nend_ms = 0.0\n"
    return f'{bus}\n{nodes}\n{sheets}\n{touch}\n[[hand]]\nname = "h"\n{tables}'
