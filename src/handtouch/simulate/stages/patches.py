"""Nodes of patches on a sheet: its tables at nodes, and the currents through these.

Public names: `NodeTables`, `NodeSystems`. Arguments are flat arrays in row-major order.
"""

from __future__ import annotations

import math

_4_PI = 4.0 * math.pi
_MAX_OWN = 0.7
"""Greatest distance that stands for a node's own, over that to the nearest node. With more, nodes of long
patches had less potential of their own than of their neighbours, as in no sheet: 15 % of random patches up to
three times as long as wide, whose currents could fall as the force rose; none with this. Currents of such
patches are then within 1.6 % (rms) of finite volumes', as before"""


class NodeTables:
    """Tables of sheets: polynomials of `degree` along both sides, on elements between the same breaks.

    table: (sheets, points, points, rows), `points` along each side. breaks: (elements + 1,), fractions of a
    side. values, slopes: (degree + 1, degree + 1), from powers of the place in an element, -1 to 1, to the
    weights of its points and to their derivatives.
    """

    def __init__(
        self,
        table: memoryview[float],
        points: int,
        rows: int,
        breaks: memoryview[float],
        values: memoryview[float],
        slopes: memoryview[float],
        work: memoryview[float],
    ) -> None:
        """work: (4, degree + 1)."""
        self.table, self.points, self.rows, self.breaks = table, points, rows, breaks
        self.values, self.slopes, self.work = values, slopes, work
        self.elements, self.size = len(breaks) - 1, len(work) // 4

    def read(
        self,
        sheets: memoryview[int],
        s: memoryview[float],
        t: memoryview[float],
        found: memoryview[float],
        slopes: memoryview[float],
    ) -> None:
        """Write the values (rows, k) at places (k,) on sheets (k,), and where `slopes` isn't empty their
        derivatives (rows, 2, k) by s and t."""
        count, sloped = len(s), len(slopes) > 0
        for k in range(count):
            first = sheets[k] * self.points * self.points
            first += _weigh(self, s[k], 0, sloped) * self.points
            first = (first + _weigh(self, t[k], 2 * self.size, sloped)) * self.rows
            for row in range(self.rows):
                found[row * count + k] = _sum(self, first + row, 0, 2 * self.size)
                if sloped:
                    at = 2 * row * count + k
                    slopes[at] = _sum(self, first + row, self.size, 2 * self.size)
                    slopes[at + count] = _sum(self, first + row, 0, 3 * self.size)


def _weigh(tables: NodeTables, place: float, at: int, sloped: bool) -> int:
    """Write the weights of the points of the place's element, and their derivatives if `sloped`, into `work`
    from index `at` on; return the number of the first point. A place beyond the breaks counts as at the
    outermost."""
    inside = min(max(place, tables.breaks[0]), tables.breaks[tables.elements])
    element = 0
    while element < tables.elements - 1 and tables.breaks[element + 1] <= inside:
        element += 1
    half = (tables.breaks[element + 1] - tables.breaks[element]) / 2.0
    x = (inside - tables.breaks[element]) / half - 1.0
    _sum_powers(tables, tables.values, x, 1.0, at)
    if sloped:
        _sum_powers(tables, tables.slopes, x, 1.0 / half, at + tables.size)
    return element * (tables.size - 1)


def _sum_powers(tables: NodeTables, factors: memoryview[float], x: float, power: float, at: int) -> None:
    """Write the polynomials with these factors at x, times `power`, into `work` from index `at` on."""
    size, work = tables.size, tables.work
    for i in range(size):
        work[at + i] = power * factors[i]
    for p in range(1, size):
        power *= x
        for i in range(size):
            work[at + i] += power * factors[p * size + i]


def _sum(tables: NodeTables, first: int, along: int, across: int) -> float:
    """Return a row's sum over an element from index `first` on, by the weights in `work` from `along` and
    `across` on."""
    total = 0.0
    for i in range(tables.size):
        line, at = 0.0, first + i * tables.points * tables.rows
        for j in range(tables.size):
            line += tables.work[across + j] * tables.table[at + j * tables.rows]
        total += tables.work[along + i] * line
    return total


class NodeSystems:
    """Linear systems of the nodes of patches (k, nodes).

    area_m2, pressure: (k, nodes), as in `PatchNodes`. green: (k, nodes, nodes), Green's function between them
    on a sheet of 1 ohm per square, written by `fill_green`, each pair once. Scratch: system (nodes, nodes),
    and nearest2 (nodes,), squares of distances to the nearest node.
    """

    def __init__(
        self,
        nodes: int,
        area_m2: memoryview[float],
        pressure: memoryview[float],
        green: memoryview[float],
        system: memoryview[float],
        nearest2: memoryview[float],
    ) -> None:
        self.nodes, self.area_m2, self.pressure = nodes, area_m2, pressure
        self.green, self.system, self.nearest2 = green, system, nearest2

    def fill_green(
        self, place_m: memoryview[float], own_m: memoryview[float], radius_m: memoryview[float]
    ) -> None:
        """Compute Green's function of places (k, 2, nodes), distances that stand for a node's own, and
        conformal radii (k, nodes)."""
        nodes, green, nearest2 = self.nodes, self.green, self.nearest2
        for patch in range(len(own_m) // nodes):
            first = patch * nodes
            for i in range(nodes):
                nearest2[i] = own_m[first + i] * own_m[first + i] / (_MAX_OWN * _MAX_OWN)
            for i in range(nodes):
                at, radius = (first + i) * nodes, radius_m[first + i]
                x, y = place_m[2 * first + i], place_m[2 * first + nodes + i]
                for j in range(i + 1, nodes):
                    dx, dy = place_m[2 * first + j] - x, place_m[2 * first + nodes + j] - y
                    square = dx * dx + dy * dy
                    nearest2[i], nearest2[j] = min(nearest2[i], square), min(nearest2[j], square)
                    ratio = radius * radius_m[first + j] / square
                    green[at + j] = math.log(1.0 + ratio) / _4_PI
                ratio = radius * radius / (_MAX_OWN * _MAX_OWN * nearest2[i])
                green[at + i] = math.log(1.0 + ratio) / _4_PI

    def solve(
        self,
        patches: memoryview[int],
        force_n: memoryview[float],
        sheet_ohm: memoryview[float],
        layer: memoryview[float],
        current: memoryview[float],
    ) -> None:
        """Write the currents (n, nodes) of contacts of patches (n,) for 1 V to grounded electrodes.

        layer: (3, n), a contact's specific resistance [ohm m^2], reference pressure [Pa] and exponent.
        """
        count, nodes = len(patches), self.nodes
        for k in range(count):
            first, at = patches[k] * nodes, k * nodes
            log_force, specific = math.log(force_n[k] / layer[count + k]), 0.0
            for i in range(nodes):
                row = i * nodes
                for j in range(i, nodes):
                    self.system[row + j] = sheet_ohm[k] * self.green[first * nodes + row + j]
                # under an even pressure, all nodes conduct alike
                if i == 0 or self.pressure[first + i] != self.pressure[first + i - 1]:
                    log_ratio = log_force + math.log(self.pressure[first + i])
                    specific = layer[k] * math.exp(-layer[2 * count + k] * log_ratio)
                self.system[row + i] += specific / self.area_m2[first + i]
                current[at + i] = 1.0
            _solve_symmetric(self.system, nodes, current, at)


def _solve_symmetric(system: memoryview[float], n: int, right: memoryview[float], first: int) -> None:
    """Replace a right side from index `first` on by the solution of a symmetric positive system, whose upper
    triangle is overwritten: elimination without pivots."""
    for p in range(0, n, 2):  # two at once, so that each element is read and written half as often
        top, under = p * n, p * n + n
        if p + 1 < n:
            ratio = system[top + p + 1] / system[top + p]
            for j in range(p + 1, n):
                system[under + j] -= ratio * system[top + j]
            right[first + p + 1] -= ratio * right[first + p]
        for i in range(p + 2, n):
            row = i * n
            ratio, second = system[top + i] / system[top + p], system[under + i] / system[under + p + 1]
            for j in range(i, n):
                system[row + j] = system[row + j] - ratio * system[top + j] - second * system[under + j]
            right[first + i] = right[first + i] - ratio * right[first + p] - second * right[first + p + 1]
    for p in range(n - 1, -1, -1):
        total = right[first + p]
        for j in range(p + 1, n):
            total -= system[p * n + j] * right[first + j]
        right[first + p] = total / system[p * n + p]
