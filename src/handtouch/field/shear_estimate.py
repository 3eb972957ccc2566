"""Shear pads: displacement of the upper pattern by the currents, for any `ShearPattern`.

Public names: `ShearPad` -> `ShearEstimate`. The core solves the same for its pads: `core/stages/shear.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from handtouch.arrays import FloatArray
from handtouch.field.shear import FilmLaw, ShearPattern

_MAX_STEPS = 30
_STEP_TOLERANCE = 1e-10


@dataclass(frozen=True)
class ShearEstimate:
    """Most likely motion of the upper pattern for the currents of a shear pad.

    motion: (k, ...), the pattern's `components`. covariance: (..., k, k). conductance_s_per_m2: of the film,
    with its standard deviation for noise. chi_squared: of the misfit, `degrees` of freedom. NaN where a
    current isn't positive and where no displacement within the travel has such currents.
    """

    motion: FloatArray
    covariance: FloatArray
    conductance_s_per_m2: FloatArray
    conductance_std: FloatArray
    chi_squared: FloatArray
    degrees: int


@dataclass(frozen=True)
class ShearPad:
    """A shear pattern under a voltage, with the film's law where off-centre pressure is to be compensated.

    part_std: relative error of each channel that is the same in all samples, by gains and edges. It weights
    the currents; as a tare removes what it does to a displacement, covariances don't include it.
    """

    pattern: ShearPattern
    drive_v: float
    film: FilmLaw | None = None
    part_std: float = 0.0

    def currents(
        self, motion: npt.ArrayLike, conductance_s_per_m2: npt.ArrayLike, tilt: npt.ArrayLike = 0.0
    ) -> FloatArray:
        """Return the currents (n, ...) [A] at a motion (k, ...); tilt: logarithm of each channel's factor."""
        areas, _ = self.pattern.areas(motion)
        return self.drive_v * np.asarray(conductance_s_per_m2) * areas * np.exp(tilt)

    @np.errstate(all="ignore")
    def estimate(
        self,
        currents_a: npt.ArrayLike,
        noise_a: npt.ArrayLike,
        *,
        normal_force_n: npt.ArrayLike = 0.0,
        centre_m: npt.ArrayLike = (0.0, 0.0),
        centre_std_m: float = 0.0,
        normal_force_std_n: npt.ArrayLike = 0.0,
    ) -> ShearEstimate:
        """Return motion and conductance for currents (n, ...), by maximum likelihood.

        noise_a: standard deviation of each current, broadcast against them. normal_force_n (...), centre_m
        (2, ...) with their standard deviations: of the contact above, whose pressure is not even; used with
        `film` only. Raises ValueError unless the first axis has the pattern's channels.
        """
        currents = np.asarray(currents_a, np.float64)
        count, unknowns = self.pattern.channels, len(self.pattern.components)
        if currents.shape[:1] != (count,):
            raise ValueError(f"currents_a has shape {currents.shape}: the pattern has {count} channels")
        shape = currents.shape[1:]
        read = np.where(currents > 0, currents, np.nan).reshape(count, -1)
        noise = np.broadcast_to(np.asarray(noise_a, np.float64), currents.shape).reshape(count, -1)
        tilt, weight = np.zeros_like(read), np.zeros((read.shape[1], count, count))
        if self.film is not None:
            force, force_std = (
                np.broadcast_to(np.asarray(value, np.float64), shape).ravel()
                for value in (normal_force_n, normal_force_std_n)
            )
            centre = np.asarray(centre_m, np.float64)
            centre = np.broadcast_to(centre.reshape(2, *centre.shape[1:] or [1] * len(shape)), (2, *shape))
            tilt, by_centre, by_force = self.film.tilts(
                np.maximum(force, 0.0), centre.reshape(2, -1), self.pattern.centroids_m
            )
            spread = np.concatenate([by_centre * centre_std_m, (by_force * force_std)[:, None]], axis=1)
            weight = np.einsum("icm,jcm->mij", spread, spread)
        # in logarithms: ln I = ln(V Y) + ln area + tilt
        weight += np.einsum("im,ij->mij", (noise / read) ** 2, np.eye(count))
        information = np.full_like(weight, np.nan)
        known = np.isfinite(weight).all(axis=(1, 2)) & (noise > 0).all(axis=0)
        information[known] = np.linalg.inv(weight[known] + self.part_std**2 * np.eye(count))
        motion, level, gain, misfit = self._fit(np.log(read) - tilt, information)
        covariance = gain @ weight @ gain.swapaxes(1, 2)
        conductance = np.exp(level) / self.drive_v
        return ShearEstimate(
            motion=motion.reshape(unknowns, *shape),
            covariance=covariance[:, 1:, 1:].reshape(*shape, unknowns, unknowns),
            conductance_s_per_m2=conductance.reshape(shape),
            conductance_std=(conductance * np.sqrt(covariance[:, 0, 0])).reshape(shape),
            chi_squared=misfit.reshape(shape),
            degrees=count - unknowns - 1,
        )

    def _fit(
        self, logs: FloatArray, information: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return motion (k, m), ln(V Y), derivatives (m, 1 + k, n) of both by the logs, ln(V Y) first, and
        misfit, by Gauss-Newton steps.
        """
        unknowns, cases = len(self.pattern.components), logs.shape[1]
        motion, level = np.zeros((unknowns, cases)), np.full(cases, np.nan)
        travel = self.pattern.travel_m
        for _ in range(_MAX_STEPS):
            areas, slopes = self.pattern.areas(motion)
            columns = np.concatenate([np.ones((logs.shape[0], 1, cases)), slopes / areas[:, None]], axis=1)
            level = np.where(np.isnan(level), (logs - np.log(areas)).mean(axis=0), level)
            off = logs - np.log(areas) - level
            weighted = np.einsum("mij,jkm->mik", information, columns)
            normal = np.einsum("ikm,mil->mkl", columns, weighted)
            step = _solve(normal, np.einsum("mik,im->mk", weighted, off))
            size = np.abs(step[:, 1 : 1 + min(unknowns, 2)]).max(axis=1)
            damp = np.minimum(1.0, 0.5 * travel / np.maximum(size, 1e-300))
            level = level + damp * step[:, 0]
            motion = motion + damp * step[:, 1:].T
            if not (size > _STEP_TOLERANCE * travel).any():
                break
        areas, _ = self.pattern.areas(motion)
        off = logs - np.log(areas) - level
        misfit = np.einsum("im,mij,jm->m", off, information, off)
        lost = ~(np.hypot(motion[0], motion[1] if unknowns > 1 else 0.0) < travel)
        gain = _solve(normal, weighted.swapaxes(1, 2))
        motion, level, misfit = (np.where(lost, np.nan, value) for value in (motion, level, misfit))
        gain[lost] = np.nan
        return motion, level, gain, misfit


def _solve(matrices: FloatArray, right: FloatArray) -> FloatArray:
    """Solve (m, k, k) systems; NaN where a matrix isn't finite or singular."""
    columns = right[..., None] if right.ndim == 2 else right
    result = np.full_like(columns, np.nan)
    regular = np.flatnonzero(np.isfinite(matrices).all(axis=(1, 2)))
    regular = regular[np.linalg.cond(matrices[regular]) < 1 / np.finfo(np.float64).eps]
    result[regular] = np.linalg.solve(matrices[regular], columns[regular])
    return result[..., 0] if right.ndim == 2 else result
