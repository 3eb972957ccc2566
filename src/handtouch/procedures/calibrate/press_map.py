"""A pad's map by presses at known places: from a running daemon with an operator, or from recorded messages.

Public names: `Place`, `read_places`, `PressCollector`, `MapJob`, `MapReport`.
"""

from __future__ import annotations

import csv
import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.config.responses import Measured
from handtouch.core.memory import view_memory
from handtouch.core.pad_model import PadModel
from handtouch.core.stages.rows import VALUE_COUNT, VALUE_SLICES
from handtouch.core.stages.solve import ContactSolver
from handtouch.field.channel_map import ChannelMap
from handtouch.field.estimate import estimate
from handtouch.field.measured import MIN_PRESSES, MeasuredMap, PressTable
from handtouch.field.model import ChannelModel
from handtouch.hand import models_with_other_parts, pad_channels, pad_surface
from handtouch.hand.pads import press_map

_SETTLED_NS, _UNTOUCHED_NS, _MARGIN_NS = 300_000_000, 1_000_000_000, 150_000_000
"""Times of a press before it counts, of the zero before it, and next to begin and end that don't count."""
_MIN_SAMPLES = 5
_LEAST_NOISE = 1e-4  # of a signal, over the greatest one
_COUNTS = (8, 16, 32, 60, 120, 240)
_STEPS, _HELD_OUT = 3, 4
_INSIDE = 5.99  # squared error in covariances, 95 % of two components
_SUSPECT = 9.0  # score of a press, over the median
_WORTH = 0.1  # less error by the last step, as a fraction


@dataclass(frozen=True)
class Place:
    """Where a press is: lengths along the surface, or coordinates of the pad frame [m]; force [N], NaN for an
    unknown one."""

    at_m: tuple[float, ...]
    force_n: float


def read_places(path: Path) -> list[Place]:
    """Return the places of a CSV table with columns x_mm, y_mm, if given z_mm and force_n, in the order of
    the presses. Raises ValueError naming the line, OSError."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = csv.DictReader(file)
        names = rows.fieldnames or []
        axes = [name for name in ("x_mm", "y_mm", "z_mm") if name in names]
        if axes[:2] != ["x_mm", "y_mm"]:
            raise ValueError(
                f"{path}: the first line must name columns x_mm and y_mm, not {', '.join(names)}"
            )
        places = []
        for row in rows:
            try:
                at_m = tuple(1e-3 * float(row[axis]) for axis in axes)
                places.append(Place(at_m, float(row["force_n"]) if "force_n" in names else math.nan))
            except (TypeError, ValueError) as error:
                raise ValueError(f"{path}: line {rows.line_num} isn't numbers: {error}") from error
    if len(places) < MIN_PRESSES:
        raise ValueError(f"{path}: has {len(places)} places; {MIN_PRESSES} or more are needed, better 60")
    return places


class PressCollector:
    """Mean signals of presses, less the zero before each, from samples of counts and contact events."""

    def __init__(self) -> None:
        self.presses: list[FloatArray] = []
        """(n,) counts of each"""
        self.samples = 0
        """least number of samples that a press's mean is of"""
        self._untouched: deque[tuple[int, FloatArray]] = deque()
        self._held: list[tuple[int, FloatArray]] = []
        self._zero: FloatArray | None = None

    def add_event(self, event: str) -> bool:
        """Take the event of a contact message; return whether a press that counts has ended."""
        if event == "begin":
            self._held, self._zero = [], None
            times = [t_ns for t_ns, _ in self._untouched] or [0]
            first, last = times[0] + _MARGIN_NS, times[-1] - _MARGIN_NS
            before = [counts for t_ns, counts in self._untouched if first <= t_ns <= last]
            if len(before) >= _MIN_SAMPLES:
                self._zero = np.mean(before, axis=0)
        elif event == "end" and self._zero is not None:
            zero, self._zero = self._zero, None
            self._untouched.clear()
            begin, end = self._held[0][0] + _SETTLED_NS, self._held[-1][0] - _MARGIN_NS
            settled = [counts for t_ns, counts in self._held if begin <= t_ns <= end]
            if len(settled) >= _MIN_SAMPLES:
                self.presses.append(np.mean(settled, axis=0) - zero)
                self.samples = min(self.samples or len(settled), len(settled))
                return True
        return False

    def add_counts(self, t_ns: int, counts: FloatArray) -> None:
        """Take the counts (n,) of a sample."""
        if self._zero is not None:
            self._held.append((t_ns, counts))
            return
        self._untouched.append((t_ns, counts))
        while t_ns - self._untouched[0][0] > _UNTOUCHED_NS:
            self._untouched.popleft()


@dataclass(frozen=True)
class MapReport:
    """How well presses locate others that they don't know: rows of number, rms error [mm], share inside 95 %;
    number 0: by what is stated. `suspects`: numbers of presses, from 1, far from where they should be."""

    rows: tuple[tuple[int, float, float], ...]
    suspects: tuple[int, ...]

    def lines(self) -> Iterator[str]:
        """Yield the report as text."""
        yield "Presses left out, located by the map of others:"
        yield f"{'by':>15}  {'rms error':>9}  {'in their 95 %':>13}"
        for count, error, inside in self.rows:
            name = f"{count} presses" if count else "what is stated"
            yield f"{name:>15}  {error:>6.3f} mm  {inside:>13.0%}"
        if len(self.rows) > 2:
            last, before = self.rows[-1][1], self.rows[-2][1]
            gain = 1 - last / before
            yield (
                f"The last step gained {gain:.0%}: more presses are worth it."
                if gain > _WORTH
                else "More presses gain little: the rest is noise, and the error of the given places."
            )
        if self.suspects:
            yield f"Far from the map: press {', '.join(map(str, self.suspects))}; is its place right?"


class MapJob:
    """A pad whose map is measured. Raises ValueError for one that isn't in the deployment."""

    def __init__(self, deployment: config.Deployment, entry: config.NamedPad) -> None:
        self.deployment, self.pad, self.name = deployment, entry.pad, entry.name
        self._row = deployment.pads.index(entry)
        self._sheet, self._node = deployment.sheet_of(entry.pad), deployment.nodes[entry.pad.node]
        self._stated = entry.pad.model_copy(update={"press_map": None})
        self._model = PadModel(deployment)
        self._per_ampere = 1e3 if self._node.full_scale is None else 1.0  # mA, or the node's unit

    def presses(
        self, counts: Sequence[FloatArray], places: Sequence[Place], samples: int, std_mm: float
    ) -> PressTable:
        """Return the table of presses with these counts (n,) at these places.

        Of a sheet on which currents crowd, places are moved to the centre of the current, which a map is of.
        """
        scale = self._per_ampere * self._model.ampere_per_count[self._row]
        own = len(self.pad.electrode_names)
        signals = np.array(counts)[:, :own] * scale[:own]
        at = np.array([place.at_m for place in places])
        if self._model.crowding[self._row]:
            moved = self._positions(signals, crowding=False) - self._positions(signals, crowding=True)
            at = self._moved(at, np.nan_to_num(moved))
        force_n = np.array([place.force_n for place in places])
        noise = float(np.median(self._per_ampere * self._model.noise_a[self._row, :own]))
        return PressTable(
            PressTable.content(
                at,
                signals,
                None if np.isnan(force_n).any() else force_n,
                position_std_m=1e-3 * std_mm,
                signal_std=noise / math.sqrt(max(samples, 1)),
                serial=self.pad.serial,
            )
        )

    def _positions(self, signals: FloatArray, *, crowding: bool) -> FloatArray:
        """Return the arc lengths (k, 2) [m] of presses by the pad as stated."""
        model, row = self._model, self._row
        model.crowding[row] = crowding
        currents, values = np.zeros((model.size, model.channels)), np.empty((model.size, VALUE_COUNT))
        solver = ContactSolver(model, currents, np.zeros(model.size), np.ones(model.size, np.bool_), values)
        found = np.empty((len(signals), 2))
        for number, one in enumerate(signals):
            currents[row, : len(one)] = one / self._per_ampere
            values[row] = np.nan
            solver.solve_contacts(view_memory(np.array([row])))
            found[number] = values[row, VALUE_SLICES["pad_m"]]
        return found

    def _moved(self, at: FloatArray, step_m: FloatArray) -> FloatArray:
        """Return places moved by arc lengths (k, 2)."""
        if at.shape[1] == 2:
            return at + step_m
        surface = pad_surface(self.pad)
        place = surface.fractions_of_places(at) * (surface.a, surface.b)
        return np.asarray(at + np.einsum("akd,ka->kd", surface.tangents(*place.T).transpose(0, 2, 1), step_m))

    def report(self, presses: PressTable, seed: int = 0) -> MapReport:
        """Return how well some of the presses locate the others, as many as there are."""
        is_theory = not isinstance(self.pad.response, Measured)
        theory = pad_channels(self._stated, self._sheet, self._node) if is_theory else None
        order = np.random.default_rng(seed).permutation(len(presses.signals))
        held = max(len(order) // _HELD_OUT, 1)
        left_out, rest = presses.chosen(order[:held]), order[held:]
        rows = [] if theory is None else [(0, *self._scores(theory, left_out))]
        numbers = [n for n in _COUNTS if n < len(rest)] + [len(rest)] * (len(rest) >= MIN_PRESSES)
        rows += [(n, *self._scores(self.map_of(presses.chosen(rest[:n])), left_out)) for n in numbers]
        scores = self.map_of(presses).press_scores
        suspects = np.flatnonzero(scores > _SUSPECT * max(1.0, float(np.median(scores)))) + 1
        return MapReport(tuple(rows), tuple(suspects.tolist()))

    def map_of(self, presses: PressTable) -> MeasuredMap:
        """Return the map that presses show."""
        response = self.pad.response
        if isinstance(response, Measured):
            return response.map_of(pad_surface(self.pad), presses)
        return press_map(self.pad, self._sheet, self._node, presses)

    def _scores(self, model: ChannelModel, presses: PressTable) -> tuple[float, float]:
        """Return the rms error [mm] of presses located by a model, and the share inside their 95 %."""
        errors_m, squares = self._errors(model, presses)
        return 1e3 * math.sqrt(float(np.mean(errors_m**2))), float(np.mean(squares < _INSIDE))

    def _errors(self, model: ChannelModel, presses: PressTable) -> tuple[FloatArray, FloatArray]:
        """Return distances (k,) [m] of presses from where a model locates them, and their squares in the
        covariances of signals, model and given places; as stated, of those that a map states."""
        surface = pad_surface(self.pad)
        sides = np.array([surface.a, surface.b])
        wanted = surface.fractions_of_places(presses.place_m) * sides
        noise = max(presses.signal_std, _LEAST_NOISE * float(presses.signals.max()))
        start = estimate(model, presses.signals.T, noise)
        errors_m, squares = np.zeros((2, len(wanted)))
        for number, signals in enumerate(presses.signals):
            place, total = np.array([start.x[number], start.y[number]]), float(start.total[number])
            for _ in range(_STEPS):
                place = np.clip(np.nan_to_num(place, nan=0.5), 1e-6 * sides, (1 - 1e-6) * sides)
                fractions, slopes = model.fractions_with_jacobian(*place)
                jacobian = np.column_stack([total * slopes, fractions])
                covariance = noise**2 * np.eye(len(signals)) + total**2 * self._unknown(model, place)
                information = jacobian.T @ np.linalg.solve(covariance, jacobian)
                step = np.linalg.solve(
                    information, jacobian.T @ np.linalg.solve(covariance, signals - total * fractions)
                )
                place, total = place + step[:2], total + float(step[2])
            place = np.clip(place, 1e-6 * sides, (1 - 1e-6) * sides)
            scales = surface.scales(*place)
            away = (place - wanted[number]) * scales
            spread = np.linalg.inv(information)[:2, :2] * np.outer(scales, scales)
            spread += presses.position_std_m**2 * np.eye(2)
            errors_m[number], squares[number] = np.hypot(*away), away @ np.linalg.solve(spread, away)
        return errors_m, squares

    def _unknown(self, model: ChannelModel, place: FloatArray) -> FloatArray:
        """Return the covariance (n, n) of a model's signals: what map or deployment leave unknown."""
        nominal = model.fractions(*place)
        if isinstance(model, ChannelMap):
            own, common = model.channel_slopes(*place), model.variation_slopes(*place)
            changes = np.concatenate([common, *(np.diag(part) for part in own)])
            spread = model.touch_error**2
        else:
            parts = models_with_other_parts(model, self._stated, self._node, self._sheet)
            changes, spread = np.array([part.fractions(*place) - nominal for part in parts]), 0.0
        if not isinstance(model, MeasuredMap):
            changes = np.concatenate([changes, np.diag(self._node.gain_std * nominal)])
        return np.asarray(changes.T @ changes + spread * np.eye(len(nominal)))
