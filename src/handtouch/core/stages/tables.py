"""Bicubic tables of smooth functions on a pad: values and first derivatives at any point.

A table holds, at each node of a square grid, the value of each column and its derivatives along both axes and
across, per cell. Between the nodes it is the bicubic Hermite polynomial of these.
"""

from __future__ import annotations


def read_table(
    table: memoryview[float], first: int, cells: int, columns: int, s: float, t: float, out: memoryview[float]
) -> None:
    """Write the values of all columns at (s, t), their derivatives by s and by t into `out`, (3 columns,).

    table: nodes in rows along t, each with its columns' values, derivatives by s, by t and by both, from
    index `first` on. s, t: in cells, 0 to `cells`.
    """
    i, j = int(s), int(t)
    if i > cells - 1:
        i = cells - 1
    if j > cells - 1:
        j = cells - 1
    p, q = s - i, t - j
    # cubic Hermite functions of both nodes' values (v, w) and slopes (d, e), and their derivatives
    v1 = p * p * (3.0 - 2.0 * p)
    v0 = 1.0 - v1
    d0, d1 = p * (1.0 - p) * (1.0 - p), p * p * (p - 1.0)
    v1_s = 6.0 * p * (1.0 - p)
    d0_s, d1_s = (1.0 - p) * (1.0 - 3.0 * p), p * (3.0 * p - 2.0)
    w1 = q * q * (3.0 - 2.0 * q)
    w0 = 1.0 - w1
    e0, e1 = q * (1.0 - q) * (1.0 - q), q * q * (q - 1.0)
    w1_t = 6.0 * q * (1.0 - q)
    e0_t, e1_t = (1.0 - q) * (1.0 - 3.0 * q), q * (3.0 * q - 2.0)
    node = 4 * columns
    near = first + (j * (cells + 1) + i) * node
    far = near + (cells + 1) * node
    for c in range(columns):
        a = near + c
        b = a + node
        # along s at both rows of nodes: values, derivatives by s, and those of the slopes by t
        row0 = v0 * table[a] + v1 * table[b] + d0 * table[a + columns] + d1 * table[b + columns]
        row0_s = v1_s * (table[b] - table[a]) + d0_s * table[a + columns] + d1_s * table[b + columns]
        a += 2 * columns
        b += 2 * columns
        slope0 = v0 * table[a] + v1 * table[b] + d0 * table[a + columns] + d1 * table[b + columns]
        slope0_s = v1_s * (table[b] - table[a]) + d0_s * table[a + columns] + d1_s * table[b + columns]
        a = far + c
        b = a + node
        row1 = v0 * table[a] + v1 * table[b] + d0 * table[a + columns] + d1 * table[b + columns]
        row1_s = v1_s * (table[b] - table[a]) + d0_s * table[a + columns] + d1_s * table[b + columns]
        a += 2 * columns
        b += 2 * columns
        slope1 = v0 * table[a] + v1 * table[b] + d0 * table[a + columns] + d1 * table[b + columns]
        slope1_s = v1_s * (table[b] - table[a]) + d0_s * table[a + columns] + d1_s * table[b + columns]
        out[c] = w0 * row0 + w1 * row1 + e0 * slope0 + e1 * slope1
        out[columns + c] = w0 * row0_s + w1 * row1_s + e0 * slope0_s + e1 * slope1_s
        out[2 * columns + c] = w1_t * (row1 - row0) + e0_t * slope0 + e1_t * slope1


def read_values(
    table: memoryview[float], cells: int, columns: int, s: float, t: float, out: memoryview[float]
) -> None:
    """Write the values of all columns at (s, t) into `out`, (columns,); see `read_table`."""
    i, j = int(s), int(t)
    if i > cells - 1:
        i = cells - 1
    if j > cells - 1:
        j = cells - 1
    p, q = s - i, t - j
    v1, w1 = p * p * (3.0 - 2.0 * p), q * q * (3.0 - 2.0 * q)
    v0, w0 = 1.0 - v1, 1.0 - w1
    d0, d1 = p * (1.0 - p) * (1.0 - p), p * p * (p - 1.0)
    e0, e1 = q * (1.0 - q) * (1.0 - q), q * q * (q - 1.0)
    near = 4 * columns * (j * (cells + 1) + i)
    far = near + 4 * columns * (cells + 1)
    for c in range(columns):
        out[c] = 0.0
    for node in range(4):
        is_right, is_far = node % 2 == 1, node > 1
        along, along_slope = v1 if is_right else v0, d1 if is_right else d0
        across, across_slope = w1 if is_far else w0, e1 if is_far else e0
        first = far if is_far else near
        if is_right:
            first += 4 * columns
        value, by_s = along * across, along_slope * across
        by_t, by_both = along * across_slope, along_slope * across_slope
        for c in range(columns):
            a = first + c
            out[c] += value * table[a] + by_s * table[a + columns]
            out[c] += by_t * table[a + 2 * columns] + by_both * table[a + 3 * columns]
