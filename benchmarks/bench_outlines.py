"""Pads of any outline: error against run time, information against electrodes.

Times are processor times, to be read as orders of magnitude. *Error against run time*: largest difference
from the same pad at a tolerance of 3e-10; the default is 1e-7. *Information*: Cramer-Rao bound of the root of
var x + var y, % of the extent, noise of 1 % of the total on every channel, 10 % of the extent left out at the
boundary; equal electrodes, 10 % of the pitch bare; bits: mean gain in -log2 of the area of the uncertainty
over four electrodes. *Cost*: median time of one contact in the compiled stages: position, covariance with all
tolerances, force; equal electrodes around a round fingertip, beside a plane with four sides.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.page import Report, Row, options, progress
from handtouch.config import Deployment, load, shipped
from handtouch.core.contact_solver import VALUE_COUNT, make_solver
from handtouch.core.pad_model import PadModel
from handtouch.field import (
    BoundaryElectrode,
    Outline,
    OutlineNetwork,
)

FloatArray = NDArray[np.float64]
Pad = Callable[[float], OutlineNetwork]

ROOT = Path(__file__).parent.parent
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7)
REFERENCE_TOLERANCE = 3e-10
INSET = 0.01  # of the larger extent: least distance of points from the boundary
POINTS = 400
NOISE = 0.01  # of the total, on each channel
INFORMATION_MARGIN = 0.1  # of the extent
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
        "hexagon, 3": (Outline(corners).at_origin(), 3, 0.5),
        "stadium, 6": (Outline([(0, 0), (1, 0), (1, 1), (0, 1)], [0, 1, 0, 1]).at_origin(), 6, 0.2),
        "L, 5": (l_shape, 5, 0.2),
        "round hole, 4": (holed, 4, 0.2),
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


def main() -> None:
    quick = options(__doc__).parse_args().quick
    report = Report(quick, points=POINTS)
    report.table("Error against run time", convergence(quick))
    report.table("Information against electrodes", information(quick))
    report.table("Cost in the daemon", costs(quick))
    report.keep()


if __name__ == "__main__":
    main()
