"""Tolerances of parts: covariance that they add to the currents of a contact, and its whitening.

Every tolerance changes the fractions along one vector: a gain by its own fraction; the end of an electrode
by a constant vector times a field on the pad (Hadamard: of the potentials, only the strength of their
singularity at that end differs); a series resistor by a constant vector times its fraction; the ratio of the
pad's sides by a vector of fields.
"""

from __future__ import annotations

import math

from handtouch.core.stages import tables


class PadTolerances:
    """Tolerances of one pad of n electrodes, as standard deviations.

    values: nodes as `tables.read_values` needs them, over the pad in `cells` cells, each as many of the
    forward model's as 1 / `cell_ratio`; columns are the fields of the 2 n ends of electrodes, then the
    derivatives of the n fractions by the logarithm of the ratio of the sides. end_vectors: (2 n n,) changes
    of fractions by one standard deviation of each end, per its field. aspect_std: of that logarithm.
    series_vectors: (n n,) changes by the logarithm of each resistor, per its electrode's fraction;
    series_std, sheet_std: of the logarithms of resistors and sheet resistance. middle_u_m: arc length from
    the electrode x0 to the pad's middle; size_x, size_y: relative standard deviations of its sides.
    """

    def __init__(
        self,
        values: memoryview[float],
        cells: int,
        cell_ratio: float,
        end_vectors: memoryview[float],
        aspect_std: float,
        series_vectors: memoryview[float],
        series_std: float,
        sheet_std: float,
        has_series: bool,
        middle_u_m: float,
        size_x: float,
        size_y: float,
        is_shape_exact: bool,
    ) -> None:
        self.values = values
        self.cells = cells
        self.cell_ratio = cell_ratio
        self.end_vectors = end_vectors
        self.aspect_std = aspect_std
        self.series_vectors = series_vectors
        self.series_std, self.sheet_std, self.has_series = series_std, sheet_std, has_series
        self.middle_u_m, self.size_x, self.size_y = middle_u_m, size_x, size_y
        self.is_shape_exact = is_shape_exact  # none but gains have a tolerance


class Whitening:
    """Whitening of currents over noise: `matrix` (n n,) is lower triangular; its product with currents that
    noise and tolerances vary is uncorrelated, of variance 1. `fields` (3 n,), `vector` (n,): working memory.
    """

    def __init__(
        self, matrix: memoryview[float], fields: memoryview[float], vector: memoryview[float], electrodes: int
    ) -> None:
        self.matrix, self.fields, self.vector = matrix, fields, vector
        self.electrodes = electrodes


def whiten_by_gains(
    whitening: Whitening, gain_covariance: memoryview[float], first: int, readings: memoryview[float]
) -> None:
    """Set the whitening for a contact at an unknown position: that by gains alone, each by itself.

    gain_covariance: of log gains, (n n,) from index `first` on. readings: (n,) currents over noise.
    """
    n, matrix = whitening.electrodes, whitening.matrix
    for i in range(n):
        for j in range(n):
            matrix[i * n + j] = 0.0
        variance = gain_covariance[first + i * n + i] * readings[i] * readings[i]
        matrix[i * n + i] = 1.0 / math.sqrt(1.0 + variance)


def whiten(
    whitening: Whitening,
    pad: PadTolerances,
    gain_covariance: memoryview[float],
    first: int,
    fractions: memoryview[float],
    weight: memoryview[float],
    total: float,
    s: float,
    t: float,
) -> None:
    """Set the whitening for a contact at (s, t), in cells of the forward model, with a total current.

    fractions: (n,) there. weight: (n,) 1 / noise.
    """
    n, matrix, vector = whitening.electrodes, whitening.matrix, whitening.vector
    for i in range(n):
        vector[i] = total * fractions[i] * weight[i]
    for i in range(n):
        for j in range(i + 1):
            matrix[i * n + j] = gain_covariance[first + i * n + j] * vector[i] * vector[j]
        matrix[i * n + i] += 1.0
    if not pad.is_shape_exact:
        _add_shape(whitening, pad, fractions, weight, total, s, t)
    _invert_root(matrix, n)


def apply_whitening(
    whitening: Whitening, values: memoryview[float], first: int, out: memoryview[float]
) -> None:
    """Write the whitened values (n,), from index `first` on, to `out`."""
    n = whitening.electrodes
    for i in range(n):
        row = 0.0
        for j in range(i + 1):
            row += whitening.matrix[i * n + j] * values[first + j]
        out[i] = row


def transpose_whitening(
    whitening: Whitening, values: memoryview[float], weight: memoryview[float], out: memoryview[float]
) -> None:
    """Write the product of `values` (n,) with the whitening, times `weight` (n,), to `out`: the derivative by
    each current of a function of whitened currents whose derivatives are `values`."""
    n = whitening.electrodes
    for i in range(n):
        row = 0.0
        for j in range(i, n):
            row += whitening.matrix[j * n + i] * values[j]
        out[i] = row * weight[i]


def _add_shape(
    whitening: Whitening,
    pad: PadTolerances,
    fractions: memoryview[float],
    weight: memoryview[float],
    total: float,
    s: float,
    t: float,
) -> None:
    """Add the covariance by ends of electrodes, ratio of the sides, and resistors."""
    n, vector, fields = whitening.electrodes, whitening.vector, whitening.fields
    tables.read_values(pad.values, pad.cells, 3 * n, s * pad.cell_ratio, t * pad.cell_ratio, fields)
    for k in range(2 * n):
        for i in range(n):
            vector[i] = pad.end_vectors[k * n + i] * total * fields[k] * weight[i]
        _add_square(whitening)
    for i in range(n):
        vector[i] = pad.aspect_std * total * fields[2 * n + i] * weight[i]
    _add_square(whitening)
    if not pad.has_series:
        return
    for k in range(n):
        for i in range(n):
            vector[i] = pad.series_vectors[k * n + i] * pad.series_std * total * fractions[k] * weight[i]
        _add_square(whitening)
    for i in range(n):  # a larger sheet resistance is a smaller one of every resistor
        together = 0.0
        for k in range(n):
            together += pad.series_vectors[k * n + i] * fractions[k]
        vector[i] = pad.sheet_std * together * total * weight[i]
    _add_square(whitening)


def _add_square(whitening: Whitening) -> None:
    """Add the square of `vector` to the lower triangle."""
    n, matrix, vector = whitening.electrodes, whitening.matrix, whitening.vector
    for i in range(n):
        for j in range(i + 1):
            matrix[i * n + j] += vector[i] * vector[j]


def _invert_root(matrix: memoryview[float], n: int) -> None:
    """Replace the lower triangle of a matrix not below the identity by the inverse of its Cholesky factor."""
    for i in range(n):
        for j in range(i + 1):
            rest = matrix[i * n + j]
            for k in range(j):
                rest -= matrix[i * n + k] * matrix[j * n + k]
            if i == j:
                matrix[i * n + i] = math.sqrt(max(rest, 1e-6))
            else:
                matrix[i * n + j] = rest / matrix[j * n + j]
    for i in range(n):
        matrix[i * n + i] = 1.0 / matrix[i * n + i]
        for j in range(i):
            row = 0.0
            for k in range(j, i):
                row -= matrix[i * n + k] * matrix[k * n + j]
            matrix[i * n + j] = row * matrix[i * n + i]
