"""Measure pads of any outline: error against run time, finite elements, information against electrodes.

Prints its tables and writes docs/benchmarks/outlines.md, outlines.json and outlines.png.
"""

from __future__ import annotations

import importlib.util
import json
import math
import tempfile
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray
from skfem import ElementTriP2, ElementTriP3, ElementTriP4

from benchmarks.page import made_by, options, output_folder, progress, table
from handtouch.config import Deployment, load, shipped
from handtouch.core.contact_solver import VALUE_COUNT, make_solver
from handtouch.core.pad_model import PadModel
from handtouch.field import (
    BoundaryElectrode,
    ElectrodeNetwork,
    MeshNetwork,
    Outline,
    OutlineNetwork,
    read_stl,
)
from handtouch.field.outline_surface import OutlineSurface
from handtouch.hand import pad_network, pad_surface

matplotlib.use("Agg")
from matplotlib import pyplot as plt

FloatArray = NDArray[np.float64]
Pad = Callable[[float], OutlineNetwork]
Row = dict[str, Any]

ROOT = Path(__file__).parent.parent
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
REFERENCE_TOLERANCE = 3e-10
INSET = 0.01  # of the larger extent: least distance of points from the boundary
POINTS = 400
NOISE = 0.01  # of the total, on each channel
INFORMATION_MARGIN = 0.1  # of the extent
STL_ELECTRODES_DEG = ((52.5, 172.5), (187.5, 307.5), (322.5, 397.5))  # from vertex to vertex
COST_ELECTRODES, COST_CONTACTS = (3, 4, 6, 8, 12, 16), 2000
OUTLINE_MM = 56.548  # of the fingertip in config/electrodes.toml
GAP_SHARE = 0.1  # of the pitch of the electrodes


def equal_electrodes(
    outline: Outline, count: int, share: float, first: float = 0.0
) -> list[BoundaryElectrode]:
    """Electrodes of one length at one pitch; `share` of it bare."""
    perimeter = outline.perimeter()
    pitch = perimeter / count
    starts = [(first + k * pitch) % perimeter for k in range(count)]
    return [BoundaryElectrode(s, (s + pitch * (1 - share)) % perimeter) for s in starts]


def shapes() -> dict[str, Pad]:
    """Return the pads, built at a tolerance."""
    corners = [(z.real, z.imag) for z in 1 + np.exp(1j * np.pi / 3 * np.arange(6))]
    l_shape = Outline([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)])
    holed = Outline([(0, 0), (2, 0), (2, 1), (0, 1)], holes=[Outline.circle(0.2).moved(0.8, 0.25)])
    outlines = {
        "disc, 3": (Outline.circle(1.0), 3, 0.5),
        "disc, 4": (Outline.circle(1.0), 4, 0.5),
        "disc, 8": (Outline.circle(1.0), 8, 0.5),
        "disc, 16": (Outline.circle(1.0), 16, 0.5),
        "hexagon, 3": (Outline(corners).at_origin(), 3, 0.5),
        "ellipse 2:1, 5": (Outline.ellipse(2.0, 1.0), 5, 0.2),
        "stadium, 6": (Outline([(0, 0), (1, 0), (1, 1), (0, 1)], [0, 1, 0, 1]).at_origin(), 6, 0.2),
        "L, 5": (l_shape, 5, 0.2),
        "L, 16": (l_shape, 16, 0.3),
        "round hole, 4": (holed, 4, 0.2),
        "strip 10:1, 6": (Outline([(0, 0), (10, 0), (10, 1), (0, 1)]), 6, 0.2),
    }

    def make(name: str) -> Pad:
        outline, count, share = outlines[name]
        first = 0.0 if name.startswith(("disc", "hexagon")) else 0.137 * outline.perimeter()
        electrodes = equal_electrodes(outline, count, share, first)
        return lambda tolerance: OutlineNetwork(outline, electrodes, 1000.0, tolerance=tolerance)

    return {name: make(name) for name in outlines}


def inner_points(pad: OutlineNetwork, inset: float, count: int) -> tuple[FloatArray, FloatArray]:
    """Random points, at least `inset` of the larger extent from the boundary."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform(0, pad.a, 20 * count), rng.uniform(0, pad.b, 20 * count)
    ring = inset * max(pad.a, pad.b) * np.exp(2j * np.pi * np.arange(32) / 32)
    inside = pad.outline.contains(x[:, None] + ring.real, y[:, None] + ring.imag).all(axis=1)
    return x[inside][:count], y[inside][:count]


def timed(make: Pad, tolerance: float) -> tuple[OutlineNetwork, float]:
    """Return a pad and the processor time of building it."""
    start = time.process_time()
    pad = make(tolerance)
    return pad, time.process_time() - start


def convergence(quick: bool) -> list[Row]:
    """Errors at each tolerance against the same solved to a smaller one."""
    rows = []
    for name, make in shapes().items():
        if quick and name not in ("disc, 3", "L, 5"):
            continue
        reference = make(REFERENCE_TOLERANCE)
        x, y = inner_points(reference, INSET, POINTS)
        fractions, jacobian = reference.fractions_with_jacobian(x, y)
        radius = reference.spreading_radius(x, y)
        for tolerance in TOLERANCES:
            pad, seconds = timed(make, tolerance)
            ours = pad.fractions_with_jacobian(x, y)
            rows.append(
                {
                    "outline, electrodes": name,
                    "tolerance": tolerance,
                    "unknowns": pad.unknowns,
                    "build, CPU s": seconds,
                    "conductance": float(np.abs(pad.conductance - reference.conductance).max()),
                    "fractions": float(np.abs(ours[0] - fractions).max()),
                    "gradients, per larger extent": float(
                        np.abs(ours[1] - jacobian).max() * max(pad.a, pad.b)
                    ),
                    "spreading radius, relative": float(
                        np.abs(pad.spreading_radius(x, y) / radius - 1).max()
                    ),
                }
            )
        progress(name)
    return rows


def closed_forms() -> list[Row]:
    """Errors at the default tolerance against solutions known otherwise."""
    rows = []
    for name, make in shapes().items():
        if not name.startswith(("disc", "hexagon")):
            continue
        conductance = make(1e-7).conductance
        count = len(conductance)
        expected = np.sort(2 * np.sin(np.pi * np.arange(count) / count))
        error = np.abs(np.linalg.eigvalsh((conductance + conductance.T) / 2) - expected).max()
        rows.append(
            {"pad": name, "known": "eigenvalues 2 sin(pi k / m) of the conductance", "error": float(error)}
        )
    for gap in (0.2, 0.05, 0.01):
        exact, a = ElectrodeNetwork(1.5, 1.0, gap, 1000.0), 1.5
        ends = [(2 * a + 1 + gap, 2 * a + 2 - gap), (a + gap, a + 1 - gap), (gap, a - gap)]
        electrodes = [BoundaryElectrode(*pair) for pair in [*ends, (a + 1 + gap, 2 * a + 1 - gap)]]
        pad = OutlineNetwork(Outline([(0, 0), (a, 0), (a, 1), (0, 1)]), electrodes, 1000.0)
        x, y = inner_points(pad, INSET, POINTS)
        (f, j), (f0, j0) = pad.fractions_with_jacobian(x, y), exact.fractions_with_jacobian(x, y)
        errors = {
            "conductance": pad.conductance - exact.conductance,
            "fractions": f - f0,
            "gradients": j - j0,
            "spreading radius": pad.spreading_radius(x, y) / exact.spreading_radius(x, y) - 1,
        }
        for known, error in errors.items():
            rows.append(
                {
                    "pad": f"rectangle 1.5:1, gaps {100 * gap:g} %",
                    "known": f"{known} of the theta-function solution",
                    "error": float(np.abs(error).max()),
                }
            )
    return rows


def surfaces(quick: bool) -> list[Row]:
    """A round fingertip: a disc on a sphere, by the daemon's model and from an STL file of its triangles.

    Stereographic projection keeps the fractions of a flat disc, whose closed form is in `closed_forms`.
    """
    tests = _load_test_module("test_mesh_network")
    (tip, *_) = load(shipped.path("electrodes.toml")).pads
    surface, sheet = pad_surface(tip.pad), load(shipped.path("electrodes.toml")).sheets[tip.pad.sheet]
    assert isinstance(surface, OutlineSurface)
    network, radius_m = pad_network(tip.pad, sheet), 9e-3
    sphere = 12.0 / 9.0  # radius of the ball over that of the drawing
    exact = OutlineNetwork(
        Outline.circle(1.0),
        [BoundaryElectrode(begin / 9.0 % math.tau, end / 9.0 % math.tau) for begin, end in tip.pad.arcs_mm],
        1000.0,
        tolerance=REFERENCE_TOLERANCE,
    )
    rng = np.random.default_rng(1)
    at = 0.9 * np.sqrt(rng.uniform(size=POINTS)) * np.exp(2j * np.pi * rng.uniform(size=POINTS))
    expected = exact.fractions(at.real + 1, at.imag + 1)
    drawn = network.fractions(*surface.to_rectangle(radius_m * (at.real + 1), radius_m * (at.imag + 1)))
    rows: list[Row] = [
        {
            "model": "outline_on_sphere of the daemon",
            "triangles": "-",
            "edge over extent, %": "-",
            "conductance": float(np.abs(network.conductance - exact.conductance).max()),
            "fractions": float(np.abs(drawn - expected).max()),
        }
    ]
    angles = np.radians(STL_ELECTRODES_DEG)
    exact = OutlineNetwork(
        Outline.circle(1.0),
        [BoundaryElectrode(float(begin), float(end)) for begin, end in angles % math.tau],
        1000.0,
        tolerance=REFERENCE_TOLERANCE,
    )
    expected = exact.fractions(at.real + 1, at.imag + 1)
    ends = tests.lifted(np.stack([np.cos(angles), np.sin(angles)], axis=-1).reshape(-1, 2), 2 * sphere)
    points_m = tests.lifted(np.stack([at.real, at.imag], axis=1), 2 * sphere)
    for rings in (8,) if quick else (8, 16, 32, 64):
        flat, triangles = tests.disc(rings)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "fingertip.stl"
            _write_stl(path, tests.lifted(flat, 2 * sphere), triangles)
            points, found = read_stl(path)
        pairs = [(tests.as_point(a), tests.as_point(b)) for a, b in ends.reshape(-1, 2, 3)]
        pad = MeshNetwork(points, found, pairs, 1000.0)
        inside = points_m[:, :2] - points[:, :2].min(axis=0)
        rows.append(
            {
                "model": "STL file",
                "triangles": len(found),
                "edge over extent, %": 50.0 / rings,
                "conductance": float(np.abs(pad.conductance - exact.conductance).max()),
                "fractions": float(np.nanmax(np.abs(pad.fractions(*inside.T) - expected))),
            }
        )
    progress("surfaces")
    return rows


def _write_stl(path: Path, points: FloatArray, triangles: NDArray[np.intp]) -> None:
    records = np.zeros(len(triangles), [("n", "<f4", 3), ("c", "<f4", (3, 3)), ("a", "<u2")])
    records["c"] = points[triangles]
    path.write_bytes(b"fingertip".ljust(80) + np.uint32(len(triangles)).tobytes() + records.tobytes())


def _load_test_module(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "tests" / "field" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def elements(quick: bool) -> list[Row]:
    """An L with a square hole against the finite elements of the tests, refined."""
    fem = _load_test_module("test_outline_fem")
    outline, pad = fem.pad_with_hole()
    fractions = pad.fractions(*fem.POINTS)
    rows = []
    cases = [(2, ElementTriP2(), 8), (3, ElementTriP3(), 16), (4, ElementTriP4(), 20)]
    for order, element, levels in cases[: 1 if quick else 3]:
        start = time.process_time()
        found = fem.solve_elements(outline, fem.ENDS, levels, element)
        rows.append(
            {
                "order of elements": order,
                "halvings at singular points": levels,
                "unknowns": int(found.unknowns),
                "CPU s": time.process_time() - start,
                "conductance": float(np.abs(found.conductance - pad.conductance).max()),
                "fractions": float(np.abs(found.fractions - fractions).max()),
            }
        )
        progress(f"elements of order {order}")
    return rows


def information(quick: bool) -> list[Row]:
    """Cramer-Rao bound of the position against the number of electrodes."""
    rows = []
    square = Outline([(0, 0), (1, 0), (1, 1), (0, 1)])
    for count in (3, 4, 8) if quick else range(3, 17):
        row: Row = {"electrodes": count}
        for name, outline in (("disc", Outline.circle(0.5)), ("square", square)):
            # from the middle of a gap at a corner on: with four, one electrode on each side of the square
            electrodes = equal_electrodes(
                outline, count, GAP_SHARE, GAP_SHARE / 2 * outline.perimeter() / count
            )
            pad = OutlineNetwork(outline, electrodes, 1000.0)
            x, y = inner_points(pad, INFORMATION_MARGIN, POINTS)
            fractions, jacobian = pad.fractions_with_jacobian(x, y)
            columns = np.moveaxis(np.concatenate([jacobian, fractions[:, None]], axis=1), (0, 1), (-2, -1))
            covariance = NOISE**2 * np.linalg.inv(np.swapaxes(columns, -1, -2) @ columns)
            error = 100 * np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1])
            bits = -0.5 * np.log2(np.linalg.det(covariance[:, :2, :2]))
            row |= {
                f"{name}: median, %": float(np.median(error)),
                f"{name}: worst, %": float(error.max()),
                f"{name}: mean information, bits": float(bits.mean()),
            }
        rows.append(row)
    reference = rows[1]
    for row in rows:
        for name in ("disc", "square"):
            key = f"{name}: mean information, bits"
            row[f"{name}: bits over 4 electrodes"] = row[key] - reference[key]
    for row in rows:
        for name in ("disc", "square"):
            del row[f"{name}: mean information, bits"]
    progress("information")
    return rows


def one_pad(electrodes: int) -> Deployment:
    """Return a deployment of one pad: a round fingertip with equal arcs, or for 0 a plane with four sides."""
    whole = load(shipped.path("electrodes.toml" if electrodes else "utah_mit.toml"))
    hand, pad = whole.hands[0], whole.hands[0].pads[0]
    nodes = dict(whole.nodes)
    if electrodes:
        ends = np.linspace(0.0, OUTLINE_MM, electrodes + 1)
        arcs = {f"e{k}": (float(a) + 0.5, float(b) - 0.5) for k, (a, b) in enumerate(pairwise(ends))}
        changes = {
            "electrode_arcs_mm": arcs,
            "electrodes": tuple(arcs),
            "series_ohm": (0.0,) * electrodes,
            "gap_offsets_mm": ((0.0, 0.0),) * electrodes,
        }
        pad = pad.model_copy(update=changes)
        channels = tuple(f"0x6401:{sub + 1}" for sub in range(electrodes))
        kind = {"channels": channels, "channel_scale": (1.0,) * electrodes}
        nodes[pad.node] = nodes[pad.node].model_copy(update=kind)
    hands = (hand.model_copy(update={"pads": (pad,)}),)
    return whole.model_copy(update={"hands": hands, "nodes": nodes})


def costs(quick: bool) -> list[Row]:
    """Return the time of a contact in the daemon's stages and the size of a pad's tables, by electrodes."""
    rows = []
    for electrodes in (0, 4) if quick else (0, *COST_ELECTRODES):
        begin_s = time.process_time()
        model = PadModel(one_pad(electrodes))
        build_s = time.process_time() - begin_s
        network, rng = model.networks[0], np.random.default_rng(1)
        x, y = rng.uniform(0.1, 0.9, (2, 50 if quick else COST_CONTACTS)) * [[network.a], [network.b]]
        readings = 2e-3 * network.fractions(x, y).T
        readings += model.noise_a[0] * rng.normal(size=readings.shape)
        given, values = np.zeros((1, model.channels)), np.full((1, VALUE_COUNT), np.nan)
        solver = make_solver(model, given, np.zeros(1), np.ones(1, np.bool_), values)
        pads = np.zeros(1, np.intp)
        times_us: dict[str, list[float]] = {"new": [], "tracked": []}
        for reading in readings:
            for state, held in times_us.items():
                given[0] = reading + model.noise_a[0] * rng.normal(size=model.channels)
                values[:] = values if state == "tracked" else np.nan
                begin_ns = time.perf_counter_ns()
                solver.solve_contacts(pads.data)
                held.append((time.perf_counter_ns() - begin_ns) / 1e3)
        table = model.forward_tables[0]
        rows.append(
            {
                "electrodes": f"{electrodes} on arcs" if electrodes else "4 on sides",
                "new contact, us": float(np.median(times_us["new"])),
                "tracked contact, us": float(np.median(times_us["tracked"])),
                "tables, MB": (table.nodes.nbytes + table.tolerance_nodes.nbytes) / 1e6,
                "build, CPU s": build_s,
            }
        )
    return rows


def draw(path: Path, accuracy: list[Row], bound: list[Row]) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2))
    for name in dict.fromkeys(row["outline, electrodes"] for row in accuracy):
        mine = [row for row in accuracy if row["outline, electrodes"] == name]
        errors = [max(row["fractions"], 1e-15) for row in mine]
        left.loglog([row["build, CPU s"] for row in mine], errors, "o-", label=name, markersize=3)
    left.set(xlabel="time to build, CPU s", ylabel="largest error of a fraction")
    left.legend(fontsize=7)
    counts = [row["electrodes"] for row in bound]
    for name in ("disc", "square"):
        for kind, style in (("median", "o-"), ("worst", "s--")):
            values = [row[f"{name}: {kind}, %"] for row in bound]
            right.plot(counts, values, style, label=f"{name}, {kind}", markersize=3)
    right.set(xlabel="electrodes", ylabel="Cramer-Rao bound of the position, % of the extent", yscale="log")
    right.legend(fontsize=8)
    for axes in (left, right):
        axes.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=90)


def main() -> None:
    quick = options(__doc__).parse_args().quick
    known, accuracy = closed_forms(), convergence(quick)
    mesh, curved = elements(quick), surfaces(quick)
    bound, cost = information(quick), costs(quick)
    page = [
        "# Pads of any outline",
        "",
        f"{made_by()}.",
        "",
        "Times are processor times of a shared machine, to be read as orders of magnitude.",
        "",
        "![Error against time to build; bound against electrodes](outlines.png)",
        "",
        *table(
            "Closed forms", "Largest error at the default tolerance, from 1 % of the extent inwards.", known
        ),
        *table(
            "Error against run time",
            f"Largest difference from the same pad at a tolerance of {REFERENCE_TOLERANCE:g}, {POINTS} "
            "points from 1 % of the larger extent inwards. The default tolerance is 1e-7.",
            accuracy,
        ),
        *table(
            "Finite elements",
            "An L with a square hole and five electrodes, one over the re-entrant corner: largest difference "
            "of scikit-fem's solution from that of the boundary integral equation.",
            mesh,
        ),
        *table(
            "A fingertip on a sphere",
            "A disc of 18 mm on a ball of 12 mm radius: the pad with three electrodes of "
            "config/electrodes.toml, and an STL file of triangles whose three electrodes end at "
            "vertices. Largest difference from the disc that stereographic projection maps it to, in 90 % "
            "of its radius.",
            curved,
        ),
        *table(
            "Information against electrodes",
            f"Cramer-Rao bound of the root of var x + var y, % of the extent, noise of {100 * NOISE:g} % of "
            f"the total on every channel, {100 * INFORMATION_MARGIN:g} % of the extent left out at the "
            f"boundary; equal electrodes, {100 * GAP_SHARE:g} % of the pitch bare. Bits: mean gain in -log2 "
            "of the area of the uncertainty over four electrodes.",
            bound,
        ),
        *table(
            "Cost in the daemon",
            "Median time of one contact in the compiled stages: position, covariance with all tolerances, "
            "force; a new contact, and one that is followed. Equal electrodes around a round fingertip, "
            "beside a plane with four sides.",
            cost,
        ),
    ]
    folder = output_folder(quick)
    (folder / "outlines.md").write_text("\n".join(page))
    data = {
        "closed_forms": known,
        "accuracy": accuracy,
        "elements": mesh,
        "surfaces": curved,
        "information": bound,
        "cost": cost,
    }
    (folder / "outlines.json").write_text(json.dumps(data, indent=1) + "\n")
    draw(folder / "outlines.png", accuracy, bound)


if __name__ == "__main__":
    main()
