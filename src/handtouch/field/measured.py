"""Maps from labelled presses: what a pad's channels read where it was pressed, beside its theory if it has
one, with what is still unknown.

Public names: `PressTable`, `MeasuredMap`, `MapPrior`.

The signals are a Gaussian process: the theory's, changed by parts that are off by what is stated of them, and
by a smooth rest whose size and length are the most likely ones (C. Rasmussen and C. Williams, Gaussian
Processes for Machine Learning, 2006, 2.2 and 5.4.1). Without a theory the rest is all.
"""

from __future__ import annotations

import hashlib
import io
import math
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray
from handtouch.field.channel_map import VARIATIONS, ChannelMap
from handtouch.field.model import ChannelModel, FractionModel
from handtouch.field.network import ElectrodeNetwork
from handtouch.field.surface_base import Surface

MIN_PRESSES = 8
_GRID_POINTS = 25  # along each side, closer towards its ends
_TRIED_PRESSES = 40  # by which size and length of the smooth rest are found
_RESTS, _ERRORS = (0.003, 0.006, 0.012, 0.03), (1e-3, 2e-3, 4e-3, 0.01)
"""Deviations of the rest beside a theory, and of a signal from press to press, over the unit signal."""
_FREE_RESTS = (0.15, 0.4, 1.0)  # without a theory, over the greatest signal
_LENGTHS = (0.12, 0.2, 0.35, 0.6)  # of the rest, over the longer side
_WIDENING = 1.3
"""Of variances: size and length of the rest aren't known either; by pads of the tuning family."""
_FORCE_STD = 0.1  # relative, of a press's strength by its stated force
_SLOPE_STEP = 1e-3  # in sides
_HAIR = 1e-6  # the same of places on an edge
_LEAST_VARIANCE = 1e-14


class PressTable:
    """Presses of a pad at known places.

    Made from the content of a NumPy archive (.npz) with k presses: `x_mm`, `y_mm` (k,), lengths along the
    surface from the corner of x0 and y0, with `z_mm` coordinates of the pad frame; `signals` (k, n), changes
    of the n channels by a press in the unit of the node's counts, mA where it measures currents. Optional:
    `force_n` (k,), which a pad without a theory needs; `position_std_mm` (1 sigma along each axis),
    `signal_std`, noise of a signal, and `serial`, that of the node. min_presses: least k. Raises ValueError
    for what isn't.
    """

    def __init__(self, data: bytes, min_presses: int = MIN_PRESSES) -> None:
        self.data = data
        """content of the file"""
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as archive:
                found = {name: np.asarray(archive[name], np.float64) for name in archive.files}
        except (EOFError, OSError, ValueError, zipfile.BadZipFile) as error:
            raise ValueError("no NumPy archive (.npz) of numbers") from error
        axes = ["x_mm", "y_mm", *(["z_mm"] if "z_mm" in found else [])]
        if missing := [name for name in (*axes, "signals") if name not in found]:
            raise ValueError(f"lacks {', '.join(missing)}; it has {', '.join(found) or 'nothing'}")
        self.signals = found["signals"]
        """(k, n)"""
        count = len(self.signals)
        columns = [found[name] for name in axes] + [found.get("force_n", np.ones(count))]
        if self.signals.ndim != 2 or count < min_presses or any(one.shape != (count,) for one in columns):
            raise ValueError(
                f"signals must have a row for each of {min_presses} presses or more, and {', '.join(axes)} "
                "(and force_n) a value for each"
            )
        if not all(np.isfinite(values).all() for values in found.values()):
            raise ValueError("has values that aren't finite")
        if not ((self.signals.max(axis=1) > 0).all() and (columns[-1] > 0).all()):
            raise ValueError("force_n and the greatest signal of each press must be positive")
        self.place_m = 1e-3 * np.stack(columns[:-1], axis=1)
        """(k, 2) along the surface, or (k, 3) in the pad frame"""
        self.force_n = columns[-1] if "force_n" in found else None
        """(k,); None: unknown"""
        self.position_std_m = 1e-3 * float(found.get("position_std_mm", np.array(0.1)))
        self.signal_std = float(found.get("signal_std", np.array(0.0)))
        self.serial = int(found["serial"]) if "serial" in found else None

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PressTable) and self.data == other.data

    def __hash__(self) -> int:
        return hash(self.data)

    @property
    def name(self) -> str:
        """Hash of the file."""
        return hashlib.sha256(self.data).hexdigest()

    @staticmethod
    def content(
        place_m: FloatArray,
        signals: FloatArray,
        force_n: FloatArray | None = None,
        *,
        position_std_m: float,
        signal_std: float = 0.0,
        serial: int | None = None,
    ) -> bytes:
        """Return the content of a file of these presses."""
        values: dict[str, Any] = dict(zip(("x_mm", "y_mm", "z_mm"), 1e3 * place_m.T, strict=False))
        values |= {"signals": signals, "position_std_mm": 1e3 * position_std_m, "signal_std": signal_std}
        values |= {"force_n": force_n} if force_n is not None else {}
        values |= {"serial": serial} if serial is not None else {}
        file = io.BytesIO()
        np.savez_compressed(file, **values)
        return file.getvalue()

    def chosen(self, rows: npt.NDArray[Any]) -> PressTable:
        """Return the table of some presses, one or more, by their numbers or a mask."""
        force_n = None if self.force_n is None else self.force_n[rows]
        return PressTable(
            self.content(
                self.place_m[rows],
                self.signals[rows],
                force_n,
                position_std_m=self.position_std_m,
                signal_std=self.signal_std,
                serial=self.serial,
            ),
            min_presses=1,
        )


@dataclass(frozen=True)
class MapPrior:
    """What is known of a pad before any press.

    theory: its signals as stated, None: unknown. parts: models in each of which one part is off by a standard
    deviation. gain_std: of the logarithm of a channel's gain. size_stds: relative ones of the pad's sides.
    alpha: exponent of the force in the strength of a press, where no theory is known.
    """

    theory: ChannelModel | None = None
    parts: tuple[FractionModel, ...] = ()
    gain_std: float = 0.0
    size_stds: tuple[float, float] = (0.0, 0.0)
    alpha: float = 1.0


class MeasuredMap(ChannelMap):
    """Signals of a pad by its presses, per unit of the strength of a contact."""

    def __init__(
        self,
        surface: Surface,
        presses: PressTable,
        prior: MapPrior,
        contact_radius_m: float,
        contact_radius_std_m: float = 0.0,
        contact_elongation_std: float = 0.0,
    ) -> None:
        count = presses.signals.shape[1]
        if prior.theory is not None and len(prior.theory.series_ohm) != count:
            expected = len(prior.theory.series_ohm)
            raise ValueError(f"signals of {count} channels; the pad has {expected}")
        if prior.theory is None and presses.force_n is None:
            raise ValueError("lacks force_n, which a pad without a theory needs")
        super().__init__(surface, count, contact_radius_m, contact_radius_std_m, contact_elongation_std)
        self.presses, self._prior, self.theory = presses, prior, prior.theory
        if self.theory is not None:
            self.sheet_ohm_per_square, self.states = self.theory.sheet_ohm_per_square, self.theory.states
            self.ends, self.is_potential = self.theory.ends, self.theory.is_potential

    @property
    def touch_error(self) -> float:
        return self._solution.touch_error

    @property
    def press_scores(self) -> FloatArray:
        """Squared errors (k,) of the presses, each by the map of the others, over what is expected."""
        return self._solution.scores

    @property
    def series_ohm(self) -> tuple[float, ...]:
        return super().series_ohm if self.theory is None else self.theory.series_ohm

    @property
    def conductance(self) -> FloatArray:
        return super().conductance if self.theory is None else self.theory.conductance

    @property
    def currents_per_ideal(self) -> FloatArray:
        return super().currents_per_ideal if self.theory is None else self.theory.currents_per_ideal

    @property
    def series_quadratic_form(self) -> FloatArray:
        return super().series_quadratic_form if self.theory is None else self.theory.series_quadratic_form

    @property
    def series_sensitivity(self) -> FloatArray:
        return super().series_sensitivity if self.theory is None else self.theory.series_sensitivity

    @cached_property
    def centres(self) -> FloatArray:
        return super().centres if self.theory is None else self.theory.centres

    def spreading_radius(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        return super().spreading_radius(x, y) if self.theory is None else self.theory.spreading_radius(x, y)

    def series_resistance(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        return super().series_resistance(x, y) if self.theory is None else self.theory.series_resistance(x, y)

    def with_open_electrode(self, electrode: int) -> Self:
        """Return the pad without one channel: of a sheet, whose current the others collect."""
        other = super().with_open_electrode(electrode)
        if self.theory is not None:
            other.theory = self.theory.with_open_electrode(electrode)
        return other

    def respond(self, x: FloatArray, y: FloatArray) -> FloatArray:
        change = _evaluate(self._solution.mean, x / self.a, y / self.b)
        return change if self.theory is None else change + self.theory.fractions(x, y)

    def channel_slopes(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the deviations of what each channel has for itself."""
        own = _evaluate(self._solution.own, x / self.a, y / self.b)
        return np.stack([np.maximum(own, 0.0), np.zeros_like(own)])

    def variation_slopes(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return what the presses leave unknown of all channels together, as a root of its covariance."""
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        found = _evaluate(self._solution.common, x / self.a, y / self.b)
        return found.reshape(VARIATIONS, self.channels, *x.shape)

    def patch_slopes(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return those of `ChannelMap`, of a sheet, which is harmonic, the derivatives by x x and x y."""
        if isinstance(self.theory, ElectrodeNetwork):
            return self.theory.patch_slopes(x, y)
        return super().patch_slopes(x, y)

    @cached_property
    def _solution(self) -> _MapPosterior:
        return _solve(self.surface, self.presses, self._prior)


@dataclass(frozen=True)
class _MapPosterior:
    """Splines by fractions of the sides: mean change (n,), common (VARIATIONS n,) and own (n,) deviations."""

    mean: tuple[Any, ...]
    common: tuple[Any, ...]
    own: tuple[Any, ...]
    touch_error: float
    scores: FloatArray


def _evaluate(splines: Sequence[Any], s: npt.ArrayLike, t: npt.ArrayLike) -> FloatArray:
    return np.stack([spline(s, t, grid=False) for spline in splines])


class _Process:
    """Prior of the changes of n channels at places (2, k), fractions of the sides."""

    def __init__(self, surface: Surface, prior: MapPrior, channels: int) -> None:
        self._surface, self.prior, self.channels = surface, prior, channels
        self._metres = np.array(surface.extent_m)

    def nominal(self, place: FloatArray) -> FloatArray:
        """Return the signals (n, k) of the theory, 0 without one."""
        theory = self.prior.theory
        if theory is None:
            return np.zeros((self.channels, place.shape[1]))
        return theory.fractions(*self.inside(place))

    def inside(self, place: FloatArray) -> FloatArray:
        """Return coordinates (2, k) of the rectangle, a hair off its edges."""
        sides = np.array([[self._surface.a], [self._surface.b]])
        return np.asarray(np.clip(place, _HAIR, 1 - _HAIR) * sides)

    def features(self, place: FloatArray) -> FloatArray:
        """Return the changes (f, n, k) by each part of the theory, one standard deviation each."""
        prior, nominal = self.prior, self.nominal(place)
        if prior.theory is None:
            return np.zeros((0, *nominal.shape))
        at = self.inside(place)
        found = [part.fractions(*at) - nominal for part in prior.parts if part is not prior.theory]
        found += [prior.gain_std * nominal * unit[:, None] for unit in np.eye(self.channels)]
        slopes = self.slopes(place)
        found += [
            std * (place[axis] - 0.5) * slopes[axis] for axis, std in enumerate(prior.size_stds) if std > 0
        ]
        return np.stack(found)

    def slopes(self, place: FloatArray) -> FloatArray:
        """Return derivatives (2, n, k) of the theory by fractions of the sides."""
        found = []
        for axis in range(2):
            step = np.zeros((2, 1))
            step[axis] = _SLOPE_STEP
            at = np.clip(place, 2 * _SLOPE_STEP, 1 - 2 * _SLOPE_STEP)
            found.append((self.nominal(at + step) - self.nominal(at - step)) / (2 * _SLOPE_STEP))
        return np.stack(found)

    def correlation(self, one: FloatArray, other: FloatArray, length: float) -> FloatArray:
        """Return the correlation (k, l) of the smooth rest, Matern's of 5/2; length: over the longer side."""
        scale = (self._metres / (length * self._metres.max()))[:, None]
        away = (scale * one)[:, :, None] - (scale * other)[:, None]
        far = math.sqrt(5) * np.sqrt(np.square(away).sum(axis=0))
        return np.asarray((1 + far + far * far / 3) * np.exp(-far))


@dataclass(frozen=True)
class _Data:
    """Changes (k, n) at places (2, k) of presses, per unit of strength, with the covariances (k, n, n) of
    noise, place and strength."""

    place: FloatArray
    change: FloatArray
    covariance: FloatArray
    scale: float
    """Greatest signal."""

    @classmethod
    def of_presses(
        cls, process: _Process, surface: Surface, presses: PressTable, slopes: FloatArray | None
    ) -> _Data:
        place = np.clip(surface.fractions_of_places(presses.place_m), 0.0, 1.0).T
        nominal = process.nominal(place)
        if process.prior.theory is None:
            assert presses.force_n is not None
            strength = unit_signal(presses, process.prior.alpha) * presses.force_n**process.prior.alpha
            expected, loose = presses.signals.T / strength, _FORCE_STD
            slopes = np.zeros((2, *expected.shape)) if slopes is None else slopes
        else:
            strength = (nominal * presses.signals.T).sum(axis=0) / np.square(nominal).sum(axis=0)
            # the law of strength is another matter: forces needn't be known
            expected, loose, slopes = nominal, 1.0, process.slopes(place)
        covariance = loose**2 * np.einsum("ik,jk->kij", expected, expected)
        covariance += np.square(presses.signal_std / strength)[:, None, None] * np.eye(len(nominal))
        for axis, extent in enumerate(surface.extent_m):
            step = presses.position_std_m / extent * slopes[axis]
            covariance += np.einsum("ik,jk->kij", step, step)
        return cls(
            place, (presses.signals.T / strength - nominal).T, covariance, float(np.abs(expected).max())
        )


def unit_signal(presses: PressTable, alpha: float) -> float:
    """Return the signal of the channel that responds most, by a press of 1 N, as its median."""
    assert presses.force_n is not None
    return float(np.median(presses.signals.max(axis=1) / presses.force_n**alpha))


class _ProcessFit:
    """Posterior of one size and length of the rest and one error of a touch."""

    def __init__(
        self, process: _Process, data: _Data, features: FloatArray, rest: float, length: float, error: float
    ) -> None:
        from scipy.linalg import cho_solve, cholesky  # not loaded with the package

        self._process, self._data, self._rest, self._length = process, data, rest, length
        count, n = data.change.shape
        self._flat = features.transpose(0, 2, 1).reshape(len(features), count * n)
        correlation = process.correlation(data.place, data.place, length)
        prior = self._flat.T @ self._flat + rest**2 * np.kron(correlation, np.eye(n))
        blocks = prior.reshape(count, n, count, n)
        number = np.arange(count)
        blocks[number, :, number, :] += data.covariance + error**2 * np.eye(n)
        self.root = cholesky(prior + 1e-12 * np.eye(len(prior)), lower=True)
        self.weights = cho_solve((self.root, True), data.change.ravel())
        whitened = data.change.ravel() @ self.weights
        self.evidence = float(-0.5 * whitened - np.log(np.diag(self.root)).sum())

    @property
    def scores(self) -> FloatArray:
        """Squared errors (k,) of presses left out one by one, over what is expected of them; of each the
        strength is unknown, which counts as none."""
        from scipy.linalg import cho_solve

        count, n = self._data.change.shape
        inverse = cho_solve((self.root, True), np.eye(count * n)).reshape(count, n, count, n)
        number = np.arange(count)
        own, weights = inverse[number, :, number, :], self.weights.reshape(count, n)
        scores = np.einsum("ki,ki->k", weights, np.linalg.solve(own, weights[:, :, None])[:, :, 0])
        return np.asarray(scores / (n - 1))

    def posterior(self, place: FloatArray, features: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean (k, n) and covariance (k, n, n) at places (2, k) with these features (f, n, k)."""
        from scipy.linalg import solve_triangular

        n, count = self._data.change.shape[1], place.shape[1]
        flat = features.transpose(0, 2, 1).reshape(len(features), count * n)
        correlation = self._process.correlation(place, self._data.place, self._length)
        cross = flat.T @ self._flat + self._rest**2 * np.kron(correlation, np.eye(n))
        mean = (cross @ self.weights).reshape(count, n)
        seen = solve_triangular(self.root, cross.T, lower=True).reshape(-1, count, n)
        prior = np.einsum("fik,fjk->kij", features, features) + self._rest**2 * np.eye(n)
        return mean, prior - np.einsum("mki,mkj->kij", seen, seen)


def _solve(surface: Surface, presses: PressTable, prior: MapPrior) -> _MapPosterior:
    """Return the most likely process as splines."""
    from scipy.interpolate import RectBivariateSpline

    n = presses.signals.shape[1]
    process, slopes = _Process(surface, prior, n), None
    way = (1 - np.cos(np.pi * np.arange(_GRID_POINTS) / (_GRID_POINTS - 1))) / 2
    grid = np.stack(np.meshgrid(way, way, indexing="ij")).reshape(2, -1)

    def spline(values: FloatArray) -> Any:
        return RectBivariateSpline(way, way, values.reshape(_GRID_POINTS, _GRID_POINTS))

    for _ in range(1 if prior.theory is not None else 2):
        data = _Data.of_presses(process, surface, presses, slopes)
        features = process.features(data.place)
        rest, length, error = _most_likely(process, data, features)
        fit = _ProcessFit(process, data, features, rest, length, error)
        mean, covariance = fit.posterior(grid, process.features(grid))
        means = tuple(spline(values) for values in mean.T)
        s, t = data.place
        slopes = np.stack([[one(s, t, dx=1 - k, dy=k, grid=False) for one in means] for k in range(2)])

    common, own = _roots(_WIDENING * max(1.0, float(fit.scores.mean())) * covariance)
    return _MapPosterior(
        means,
        tuple(spline(values) for values in common),
        tuple(spline(values) for values in own),
        error,
        fit.scores,
    )


def _most_likely(process: _Process, data: _Data, features: FloatArray) -> tuple[float, float, float]:
    """Return deviation and length of the rest, and the error of a touch, by the marginal likelihood."""
    few = slice(0, _TRIED_PRESSES)
    fewer = _Data(data.place[:, few], data.change[few], data.covariance[few], data.scale)
    rests = _FREE_RESTS if process.prior.theory is None else _RESTS
    return max(
        (
            (data.scale * rest, length, data.scale * error)
            for rest in rests
            for length in _LENGTHS
            for error in _ERRORS
        ),
        key=lambda found: _ProcessFit(process, fewer, features[:, :, few], *found).evidence,
    )


def _roots(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return deviations (VARIATIONS n, k) common to the channels, and each's own (n, k), of covariances (k,
    n, n): columns of the triangular root as far as they go, which vary as smoothly as the covariance, and
    what these leave."""
    left = covariance.copy()
    count, n, _ = left.shape
    common = np.zeros((VARIATIONS, n, count))
    for column in range(min(n, VARIATIONS)):
        pivot = np.sqrt(np.maximum(left[:, column, column], _LEAST_VARIANCE))
        vector = left[:, :, column] / pivot[:, None]
        vector[:, :column] = 0.0
        common[column] = vector.T
        left -= vector[:, :, None] * vector[:, None]
    own = np.sqrt(np.maximum(np.diagonal(left, axis1=1, axis2=2), 0.0)).T
    own[: min(n, VARIATIONS)] = 0.0
    return common.reshape(-1, count), own
