"""A simulated shear pad: from forces to displacement, by its layer's history, to currents and to counts.

Public names: `SimulatedShearPad`, `LayerHistory`; `Plates`, `solve_section` (current through the film's
cross-section between the bars of two facing patterns); `VirtualShear` (the channels of a pad's deployment).
Bilinear elements on a grid that is graded towards the plates' edges; plates meet the film through a specific
contact resistance, or impose their potential where it is 0. Nothing of `handtouch.field` is used, so that the
two can be checked against each other.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.linalg import splu

from handtouch import config
from handtouch.arrays import FloatArray, IntArray
from handtouch.config.channels import node_channels
from handtouch.config.roles import SHEAR, channel_numbers
from handtouch.config.shear import Bars, CrossedBars, Discs, Pinwheel, Shear
from handtouch.config.tables import SIDE_ELECTRODES
from handtouch.simulate import noise
from handtouch.simulate.stimulus import PadStimulus
from handtouch.simulate.worlds import DrawnWorld, HiddenShear

_MM = 1e-3
_TABLE_NODES = 7
_OUTER = 2.3  # width of an electrode over the overlap
_WIDE = 8.0  # thicknesses of the film: an overlap whose edges don't see each other
_SHEAR_MODULUS_PA = 2e5
_SHEAR = 0.1  # shear of the layer at which its stiffening is stated
_PLAY_SHARES = 3.0 ** -np.arange(1, 6)  # radii of plays over the force at this shear
_CREEP_S = 5.0
_POINTS = (np.arange(7) + 0.5) / 7 - 0.5  # along an edge
_ARC = 400


class LayerHistory:
    """Displacement of the elastic layer of one pad under a changing force, with hysteresis and creep.

    Vector plays of five sizes give loops about in proportion to their force. The layer is silicone of
    0.2 MPa, whose thickness follows from its stiffness; it is the same under any pattern of electrodes.
    """

    def __init__(self, shear: Shear, hidden: HiddenShear) -> None:
        stiffness = np.array(shear.stiffness_n_per_mm) / _MM
        self._stiffness = stiffness * hidden.stiffness_ratio * np.array(hidden.axis_ratio)
        thickness_m = _SHEAR_MODULUS_PA * (shear.plate_mm * _MM) ** 2 / float(stiffness.mean())
        self._sheared_m = _SHEAR * thickness_m
        self._radii = _PLAY_SHARES * float(stiffness.mean()) * self._sheared_m
        self._hidden = hidden
        self._plays = np.zeros((len(self._radii), 2))
        self._crept = np.zeros(2)

    @property
    def state(self) -> tuple[FloatArray, FloatArray]:
        """Memory of the layer: what `restore` takes."""
        return self._plays.copy(), self._crept.copy()

    def restore(self, state: tuple[FloatArray, FloatArray]) -> None:
        """Return to an earlier state."""
        self._plays, self._crept = state[0].copy(), state[1].copy()

    def advance(self, force_n: FloatArray, elapsed_s: float) -> FloatArray:
        """Apply a force (2,) for a time; return the displacement (2,) [m] at its end."""
        hidden = self._hidden
        away = force_n - self._plays
        size = np.linalg.norm(away, axis=1)
        slack = np.where(size > self._radii, 1 - self._radii / np.maximum(size, 1e-300), 0.0)
        self._plays += slack[:, None] * away
        share = hidden.hysteresis
        carried = (1 - share * len(self._radii)) * force_n + share * self._plays.sum(axis=0)
        elastic = carried / self._stiffness
        elastic = elastic / (1 + hidden.stiffening * float(elastic @ elastic) / self._sheared_m**2)
        settled = -math.expm1(-elapsed_s / _CREEP_S)
        self._crept += settled * (hidden.creep * elastic - self._crept)
        moved: FloatArray = elastic + self._crept
        return moved


@dataclass(frozen=True)
class SimulatedShearPad:
    """Electrodes and film of one shear pad."""

    shear: Shear
    drive_v: float
    hidden: HiddenShear

    @property
    def channels(self) -> int:
        """Number of electrodes."""
        return 2 if isinstance(self.shear.pattern, Bars) else 4

    def currents(self, displacement_m: FloatArray, normal_n: FloatArray, centre_m: FloatArray) -> FloatArray:
        """Return currents (channels, n) [A] at displacements (2, n) of the skin.

        normal_n (n,), centre_m (2, n): normal force and its centre, whose pressure is linear over the plate.
        """
        hidden, shear = self.hidden, self.shear
        side = shear.plate_mm * _MM
        offset = np.array(hidden.plate_offset_mm) * _MM
        moved = displacement_m + offset[:, None]
        turn = math.radians(hidden.plate_turn_deg)
        pressure = np.maximum(normal_n, 0.0) / side**2 / (1e3 * shear.film_reference_kpa)
        conductivity = shear.film_mm * _MM / (1e-6 * shear.film_ohm_mm2) / hidden.film_ohm_ratio
        amperes = np.zeros((self.channels, moved.shape[1]))
        for channel, place, current in self._cells(moved, turn):
            lean = 1 + 12 * (place @ centre_m) / side**2
            amperes[channel] += current * (1 + np.maximum(pressure * lean, 0.0)) ** (
                shear.film_alpha + hidden.alpha_offset
            )
        return self.drive_v * conductivity * amperes

    def _cells(self, moved: FloatArray, turn: float) -> list[tuple[int, FloatArray, FloatArray]]:
        """Return channel, centroid (2,) and current (n,) per volt of each overlap, for a film of 1 S/m."""
        pattern = self.shear.pattern
        if isinstance(pattern, Discs):
            return self._discs(pattern, moved)
        if isinstance(pattern, Pinwheel):
            return self._arms(pattern, moved, turn)
        size = max(pattern.bars * pattern.pitch_mm, pattern.length_mm) / 2 * _MM
        fields = [(0, np.array([1.0, 0.0]), np.zeros(2))]
        if isinstance(pattern, CrossedBars):
            x, y = np.array([1.0, 0.0]), np.array([0.0, 1.0])
            places = [(0, x, (-1, -1)), (0, x, (1, 1)), (2, y, (-1, 1)), (2, y, (1, -1))]
            fields = [(channel, way, size * np.array(at)) for channel, way, at in places]
        found = []
        length = (pattern.length_mm * _MM + 2 * self._excess_m) * np.ones(2)
        half = (pattern.gap_mm + pattern.overlap_mm) / 2 * _MM
        for channel, way, centre in fields:
            low, high = self._pair_tables[channel > 0]
            for bar in range(pattern.bars):
                at = centre + way * pattern.pitch_mm * _MM * (bar - (pattern.bars - 1) / 2)
                local = self._along_edge(moved, turn, at, way, pattern.length_mm * _MM)
                found.append((channel, at - half * way, length[0] * low(local).mean(axis=0)))
                found.append((channel + 1, at + half * way, length[1] * high(local).mean(axis=0)))
        return found

    def _arms(
        self, pattern: Pinwheel, moved: FloatArray, turn: float
    ) -> list[tuple[int, FloatArray, FloatArray]]:
        arm = pattern.arm_mm * _MM
        layout = [((-1, 0), (0, -1)), ((1, 0), (0, 1)), ((0, -1), (-1, 0)), ((0, 1), (1, 0))]
        length = pattern.length_mm * _MM + 2 * self._excess_m
        found = []
        for channel, (where, sense) in enumerate(layout):
            at, way = arm * np.array(where, np.float64), np.array(sense, np.float64)
            middle = at + way * pattern.overlap_mm * _MM
            local = self._along_edge(moved, turn, middle, way, pattern.length_mm * _MM)
            current = length * self._single_tables[channel](local).mean(axis=0)
            found.append((channel, at + way * pattern.overlap_mm * _MM / 2, current))
        return found

    def _discs(self, pattern: Discs, moved: FloatArray) -> list[tuple[int, FloatArray, FloatArray]]:
        """Count the area of every sector under a disc along rays, edges moved by their excess."""
        radius, film = (
            pattern.radius_mm * _MM + self._excess_m,
            self.shear.film_mm * _MM * self.hidden.film_ratio,
        )
        film_conductance = 1 / (film * (1 + 2 * self.hidden.contact_share))
        found = []
        angles = (np.arange(_ARC) + 0.5) / _ARC * math.pi / 2 - math.pi / 4  # a sector that faces +x
        for channel, middle in enumerate((math.pi, 0.0, -math.pi / 2, math.pi / 2)):
            inset = (pattern.gap_mm / 2 - self.hidden.edge_offset_mm[channel]) * _MM - self._gap_gain_m
            corner = math.sqrt(2) * inset * np.array([math.cos(middle), math.sin(middle)])
            ray = np.stack([np.cos(angles + middle), np.sin(angles + middle)])
            start = corner[:, None] - moved  # from the disc's centre
            along = ray.T @ start
            reach = -along + np.sqrt(np.maximum(along**2 - (start**2).sum(axis=0) + radius**2, 0.0))
            area = (reach**2).mean(axis=0) / 2 * math.pi / 2
            place = 0.6 * pattern.radius_mm * _MM * np.array([math.cos(middle), math.sin(middle)])
            found.append((channel, place, pattern.discs * area * film_conductance))
        return found

    def _along_edge(
        self, moved: FloatArray, turn: float, at: FloatArray, way: FloatArray, length: float
    ) -> FloatArray:
        """Return the motion (points, n) across an edge of points of a bar around `at`."""
        points = at + np.outer(_POINTS * length, np.array([-way[1], way[0]]))
        turned = points @ np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
        return np.asarray(((turned - points) @ way)[:, None] + way @ moved)

    @property
    def _section(self) -> tuple[float, float]:
        """Thickness of the film and contact resistance as a length of film."""
        film = self.shear.film_mm * _MM * self.hidden.film_ratio
        return film, self.hidden.contact_share * film

    @cached_property
    def _excess_m(self) -> float:
        """Width that an edge over a larger plate adds."""
        film, contact = self._section
        return film * _unit_excess(round(contact / film, 3))

    @cached_property
    def _gap_gain_m(self) -> float:
        """Width that the field in half a gap between two sectors adds to each."""
        assert isinstance(self.shear.pattern, Discs)
        film, contact = self._section
        half, wide = self.shear.pattern.gap_mm * _MM / 2, _WIDE * film
        lower = ((-wide, -half), (half, wide))
        current = solve_section(Plates(((-2 * wide, 2 * wide),), lower, film, contact)).sum() / 2
        return float(current * (film + 2 * contact) - (wide - half) - self._excess_m)

    @cached_property
    def _pair_tables(self) -> tuple[tuple[CubicSpline, CubicSpline], ...]:
        """Currents of both electrodes under a bar per metre, across x and across y, over its displacement."""
        pattern = self.shear.pattern
        assert isinstance(pattern, Bars | CrossedBars)
        film, contact = self._section
        edges = np.array(self.hidden.edge_offset_mm) * _MM
        gap, overlap = pattern.gap_mm * _MM / 2, pattern.overlap_mm * _MM
        nodes = np.linspace(-1, 1, _TABLE_NODES) * overlap
        outer = gap + _OUTER * overlap
        tables = []
        for first in (0, 2)[: self.channels // 2]:
            lower = ((-outer, -gap + edges[first]), (gap - edges[first + 1], outer))
            current = np.array(
                [
                    solve_section(Plates(((u - gap - overlap, u + gap + overlap),), lower, film, contact))
                    for u in nodes
                ]
            )
            tables.append((CubicSpline(nodes, current[:, 0]), CubicSpline(nodes, current[:, 1])))
        return tuple(tables)

    @cached_property
    def _single_tables(self) -> tuple[CubicSpline, ...]:
        """Currents of a single bar's electrode per metre over its motion along the sense of the cell."""
        pattern = self.shear.pattern
        assert isinstance(pattern, Pinwheel)
        film, contact = self._section
        overlap = pattern.overlap_mm * _MM
        nodes = np.linspace(-1, 1, _TABLE_NODES) * overlap
        wide = _OUTER * overlap
        current = np.array(
            [
                solve_section(Plates(((-wide, u),), ((0.0, wide),), film, contact))[0]
                for u in np.linspace(-0.3, 2.3, 2 * _TABLE_NODES) * overlap
            ]
        )
        table = CubicSpline(np.linspace(-0.3, 2.3, 2 * _TABLE_NODES) * overlap, current)
        values = [table(nodes + overlap + edge * _MM) for edge in self.hidden.edge_offset_mm]
        return tuple(CubicSpline(nodes, value) for value in values)


@lru_cache(maxsize=512)
def _unit_excess(contact: float) -> float:
    """Return the width that one edge adds, for a film of 1 m, at a contact resistance."""
    overlap = _WIDE
    current = solve_section(Plates(((-overlap, overlap),), ((0.0, 3 * overlap),), 1.0, contact))[0]
    return float(current * (1 + 2 * contact) - overlap) / 2


_GRADING = (1e-2, 2.0)  # element at an edge, in thicknesses of the film, and growth from one to the next
_COARSEST = 2.0
_MARGIN = 4.0  # margin of the film beyond the outermost edge
_TINY = 1e-6  # length of film that stands for no contact resistance, over the thickness


@dataclass(frozen=True)
class Plates:
    """Cross-section of a film: intervals [m] of plates along x, of the upper and the lower side.

    contact_m: specific contact resistance of either side over the film's resistivity, a length of film.
    """

    upper: tuple[tuple[float, float], ...]
    lower: tuple[tuple[float, float], ...]
    film_m: float
    contact_m: float = 0.0


def solve_section(plates: Plates) -> FloatArray:
    """Return the currents into the lower plates per metre of bar, per volt, for a film of 1 S/m.

    Errors are those of an overlap that is wider by 0.03 of the film's thickness.
    """
    film = plates.film_m
    ends = np.unique(np.array([*plates.upper, *plates.lower]).ravel()) / film
    x = _graded(ends, np.array([ends[0] - _MARGIN, ends[-1] + _MARGIN]), *_GRADING)
    y = _graded(np.array([0.0, 1.0]), np.array([0.0, 1.0]), *_GRADING)
    columns, rows = len(x), len(y)
    node = np.arange(columns * rows).reshape(columns, rows)
    stiffness = _bilinear(x, y, node)
    leak = 1 / max(plates.contact_m / film, _TINY)
    drive = np.zeros(columns * rows)
    lower: list[FloatArray] = []
    for side, intervals in ((rows - 1, plates.upper), (0, plates.lower)):
        for begin, end in intervals:
            inside = (x[:-1] > begin / film - 1e-9) & (x[1:] < end / film + 1e-9)
            first, second = node[:-1, side][inside], node[1:, side][inside]
            half = leak * np.diff(x)[inside] / 2  # lumped: the plate's current through its contact
            weight = np.bincount(first, half, columns * rows) + np.bincount(second, half, columns * rows)
            stiffness = stiffness + diags(weight)
            if side:
                drive += weight
            else:
                lower.append(np.asarray(weight, np.float64))
    potential = splu(stiffness.tocsc()).solve(drive)
    return np.array([weight @ potential for weight in lower])


def _graded(points: FloatArray, limits: FloatArray, finest: float, growth: float) -> FloatArray:
    """Return coordinates that are finest at `points`, from limit to limit."""
    stops = np.unique(np.concatenate([points, limits]))
    pieces = []
    for begin, end in itertools.pairwise(stops.tolist()):
        both = begin in points and end in points
        length = (end - begin) / 2 if both else end - begin
        steps = [finest]
        while sum(steps) < length:
            steps.append(min(steps[-1] * growth, _COARSEST))
        ramp = np.concatenate([[0.0], np.cumsum(steps)])
        ramp *= length / ramp[-1]
        pieces += [begin + ramp] if begin in points else []
        pieces += [end - ramp[::-1]] if both or begin not in points else []
    return np.unique(np.round(np.concatenate(pieces), 12))


def _bilinear(x: FloatArray, y: FloatArray, node: IntArray) -> csr_matrix:
    """Return the stiffness matrix of bilinear elements of unit conductivity on a tensor grid."""
    wide, high = np.meshgrid(np.diff(x), np.diff(y), indexing="ij")
    corner = np.stack([node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]]).reshape(4, -1)
    along = np.array([[2, -2, -1, 1], [-2, 2, 1, -1], [-1, 1, 2, -2], [1, -1, -2, 2]]) / 6
    across = np.array([[2, 1, -1, -2], [1, 2, -2, -1], [-1, -2, 2, 1], [-2, -1, 1, 2]]) / 6
    entries = np.multiply.outer(along, (high / wide).ravel()) + np.multiply.outer(
        across, (wide / high).ravel()
    )
    i, j = np.broadcast_arrays(corner[:, None], corner[None, :])
    size = node.size
    return coo_matrix((entries.ravel(), (i.ravel(), j.ravel())), shape=(size, size)).tocsr()


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
