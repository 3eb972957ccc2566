"""Currents of a pad of two films with a pressed layer between, by finite volumes.

Public names: `TwoLayerCircuit`, `two_layer_circuit`. Drive and readout: amplifiers hold the upper film's
electrodes at the drive voltage and the lower film's at ground, behind their leads; a contact's whole current
passes one film, then the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.simulate.pad_circuit import layer_of
from handtouch.simulate.pad_geometry import SimulatedSurface
from handtouch.simulate.response_circuit import ResponseCircuit
from handtouch.simulate.solved_contact import PatchNodes, solve_patches
from handtouch.simulate.unevenness import Unevenness
from handtouch.simulate.worlds.world import UNEVEN_MODES, HiddenPad

_CELLS = 64  # along each side
_TERMS = 60  # of the series of Green's function


@dataclass(frozen=True, kw_only=True)
class TwoLayerCircuit(ResponseCircuit):
    """Channels x0, xa of the upper film, y0, yb of the lower one; `tables` are their shares, with leads."""

    sheet: config.Sheet
    """Its resistance is that of both films."""
    drive_v: float
    lead_ohm: FloatArray
    log_radius: RectBivariateSpline
    """Mean of the films' ln of the spreading radius [m], by fractions of the pad."""

    def signals(self, position: FloatArray, patch: FloatArray, force_n: FloatArray) -> FloatArray:
        nodes = PatchNodes.of_patches(self.shape, position, patch)
        x, y = np.clip(np.moveaxis(nodes.position, 1, 0), 0.0, 1.0)
        shares = np.stack([table.ev(x, y) for table in self.tables])
        number = np.arange(len(force_n))
        ohm, mean, _ = solve_patches(
            nodes,
            self.log_radius.ev(x, y),
            shares,
            number,
            force_n,
            self.sheet.ohm_per_square,
            layer_of(self.sheet),
        )
        current = self.drive_v / (ohm + np.square(mean) @ self.lead_ohm)
        return np.asarray(current[:, None] * mean)


def two_layer_circuit(
    pad: config.Pad, sheet: config.Sheet, drive_v: float, shape: SimulatedSurface, hidden: HiddenPad
) -> TwoLayerCircuit:
    """Return the true films of a pad; sheet: as built, of both films."""
    unevenness = Unevenness(UNEVEN_MODES, hidden.unevenness)
    leads = np.array(pad.response.lead_ohm) + np.array(hidden.series_ohm)  # type: ignore[union-attr]
    gaps_m = 1e-3 * np.stack([hidden.gap_before_mm, hidden.gap_after_mm], axis=1)
    at = (np.arange(_CELLS) + 0.5) / _CELLS
    shares = []
    for film in range(2):
        own = _Film(shape, unevenness, film, gaps_m[2 * film : 2 * film + 2])
        loss = own.conductance / (sheet.ohm_per_square / 2) * leads[2 * film : 2 * film + 2].sum()
        begin = own.conductance / (sheet.ohm_per_square / 2) * leads[2 * film]
        of_end = (own.share + begin) / (1 + loss)
        shares += [RectBivariateSpline(at, at, values) for values in (1 - of_end, of_end)]
    width_m = shape.arc * float(shape.radius(shape.length_m / 2))
    x, y = np.meshgrid(at * shape.length_m, at * width_m, indexing="ij")
    upper, lower = _log_radius(x, y, shape.length_m, width_m), _log_radius(y, x, width_m, shape.length_m)
    return TwoLayerCircuit(
        shape=shape,
        tables=tuple(shares),
        mixing=np.eye(4),
        names=pad.electrode_names,
        sheet=sheet,
        drive_v=drive_v,
        lead_ohm=leads,
        log_radius=RectBivariateSpline(at, at, (upper + lower) / 2),
    )


class _Film:
    """A film with electrodes on two opposite sides, all along them but for gaps at their ends.

    film: 0, electrodes at both ends of x, or 1, of y. gaps_m: (2, 2) of both, at their low and high end.
    """

    def __init__(
        self, shape: SimulatedSurface, unevenness: Unevenness, film: int, gaps_m: FloatArray
    ) -> None:
        n = _CELLS
        at = (np.arange(n) + 0.5) / n
        width = shape.arc * shape.radius(at * shape.length_m)
        s, t = np.meshgrid(at, at, indexing="ij")
        ratio = unevenness.ohm_ratio(np.stack([s.ravel(), t.ravel()])).reshape(n, n)
        along = width[:, None] / shape.length_m / ratio
        across = shape.length_m / width[:, None] / ratio
        sides = np.array([width[0], width[-1]]) if film == 0 else np.full(2, shape.length_m)
        if film == 1:
            along, across = across.T, along.T
        number = np.arange(n * n).reshape(n, n)
        ends = [
            (at > gap[0] / side) & (at < 1 - gap[1] / side) for gap, side in zip(gaps_m, sides, strict=True)
        ]
        pairs = [
            (number[:-1], number[1:], 2 / (1 / along[:-1] + 1 / along[1:])),
            (number[:, :-1], number[:, 1:], 2 / (1 / across[:, :-1] + 1 / across[:, 1:])),
        ]
        rows = np.concatenate([part.ravel() for one, other, _ in pairs for part in (one, other)])
        columns = np.concatenate([part.ravel() for one, other, _ in pairs for part in (other, one)])
        values = np.concatenate([-part.ravel() for _, _, part in pairs for _ in range(2)])
        to_ends = np.zeros((2, n * n))
        for end, (row, is_on) in enumerate(zip((0, -1), ends, strict=True)):
            to_ends[end, number[row][is_on]] = 2 * along[row][is_on]
        diagonal = -np.bincount(rows, values, n * n) + to_ends.sum(axis=0)
        cells = number.ravel()
        stiffness = coo_array(
            (np.append(values, diagonal), (np.append(rows, cells), np.append(columns, cells)))
        )
        share = splu(stiffness.tocsc()).solve(to_ends[1])
        self.share: FloatArray = share.reshape(n, n) if film == 0 else share.reshape(n, n).T
        """(s, t), of the current at each cell, that of the far electrode"""
        self.conductance = float(to_ends[0] @ share)
        """between the electrodes, for one ohm per square"""


def _log_radius(x: FloatArray, y: FloatArray, a: float, b: float) -> FloatArray:
    """Return ln of the spreading radius of a film grounded at x = 0 and a.

    By Green's function as a sine series along x, that of an endless strip by its sum.
    """
    found = np.log(2 * a / math.pi * np.sin(math.pi * x / a))
    for k in range(1, _TERMS + 1):
        wave = math.pi * k / a
        sine2 = np.sin(wave * x) ** 2
        depth = wave * b
        # 2 cosh(w y) cosh(w (b - y)) / sinh(w b), of which 1 is the endless strip's
        film = (1 + np.exp(-2 * wave * y)) * (1 + np.exp(-2 * wave * (b - y))) / (1 - math.exp(-2 * depth))
        found = found + 2 / k * sine2 * (film - 1)
    return np.asarray(found)
