"""Percept `shape`: objects inside and outside its classes, and the radii's deviations.

Objects of known shape that lie anyhow, touched by six pads: 2, 4 or 12 touches of each, within about 20
degrees of a place that is drawn on the object. Each pad has a place and an angle of its own, wrong by 0.7 mm
and 0.01 rad in all its touches, as mounts and joints make them; the contacts' covariances state the places.
Each touch lies within 0.2 mm of the surface, its normal within 0.05 rad of the surface's. Radii are
log-uniform from 8 to 40 mm; the box has sides of 40, 50 and 60 mm, the cone widens by 20 degrees from a
radius of 20 mm in the middle, the ellipsoid has half axes of 20, 30 and 45 mm. Seeds of the reporting family.
"""

from __future__ import annotations

import math
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from benchmarks.page import Report, Row, options, progress
from benchmarks.scores import Share
from handtouch.percept.classify import classify_shape
from handtouch.percept.primitives import SHAPE_CLASSES, SIZE_PARAMETERS
from handtouch.simulate.worlds import Family

FloatArray = NDArray[np.float64]
OUTSIDE = ("box", "cone", "ellipsoid")
"""Shapes that no class contains."""
PADS, TOUCHES = 6, (2, 4, 12)
RADII_M = (0.008, 0.040)
PLACE_STD_M, TURN_STD_RAD = 0.7e-3, 0.01
"""Errors that a pad's touches share."""
SURFACE_STD_M, NORMAL_STD_RAD, SPREAD = 0.2e-3, 0.05, 0.35
"""Errors of each touch; standard deviation of its direction from the pad's, of a unit vector."""
_BOX_M, _ELLIPSOID_M, _CONE_RAD = np.array([0.020, 0.025, 0.030]), np.array([0.020, 0.030, 0.045]), 0.349
_CYLINDER_M, _CONE_M, _PLANE_M = 0.04, (0.02, 0.03), 0.04


def surface_at(kind: str, way: FloatArray, radius_m: float) -> tuple[FloatArray, FloatArray]:
    """Return point and outward normal of an object in a direction (3,) from its middle."""
    if kind == "box":
        face = int(np.argmin(_BOX_M / np.abs(way)))
        normal: FloatArray = np.eye(3)[face] * np.sign(way[face])
        return way * _BOX_M[face] / abs(way[face]), normal
    if kind == "ellipsoid":
        point = way / np.linalg.norm(way / _ELLIPSOID_M)
        normal = point / _ELLIPSOID_M**2
        return point, normal / np.linalg.norm(normal)
    if kind == "flat":
        return np.array([*_PLANE_M * way[:2], 0.0]), np.array([0.0, 0.0, 1.0])
    if kind == "sphere":
        return radius_m * way, way
    along = np.array([0.0, 0.0, 1.0])
    across = np.array([*way[:2], 0.0]) / math.hypot(*way[:2])
    if kind == "cylinder":
        return radius_m * across + _CYLINDER_M * way[2] * along, across
    height_m, wide = _CONE_M[1] * way[2], math.tan(_CONE_RAD)
    point = (_CONE_M[0] + wide * height_m) * across + height_m * along
    return point, math.cos(_CONE_RAD) * across - math.sin(_CONE_RAD) * along


def touched(
    kind: str, each: int, rng: np.random.Generator, radius_m: float
) -> tuple[tuple[FloatArray, FloatArray, FloatArray], NDArray[np.intp]]:
    """Return points, normals and covariances of touches, `each` of every pad, and their pads."""
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    points, normals = [], []
    for place in rng.normal(size=(PADS, 3)):
        shift, tilt = PLACE_STD_M * rng.normal(size=3), TURN_STD_RAD * rng.normal(size=3)
        for _ in range(each):
            way = place / np.linalg.norm(place) + SPREAD * rng.normal(size=3)
            point, outward = surface_at(kind, way / np.linalg.norm(way), radius_m)
            points.append(turn @ (point + SURFACE_STD_M * rng.normal() * outward) + shift)
            outward = turn @ outward
            outward = outward + np.cross(tilt, outward) + NORMAL_STD_RAD * rng.normal(size=3)
            normals.append(-outward / np.linalg.norm(outward))
    covariances = np.tile(PLACE_STD_M**2 * np.eye(3), (PADS * each, 1, 1))
    return (np.array(points), np.array(normals), covariances), np.repeat(np.arange(PADS), each)


def shape_row(kind: str, each: int, objects: int) -> Row:
    """Return how objects of a kind are classified."""
    labels, states, inside, sharpness = [], [], [], []
    for number in range(objects):
        rng = np.random.default_rng((Family.REPORTING.seed(number), each))
        radius_m = float(np.exp(rng.uniform(*np.log(RADII_M))))
        of, pads = touched(kind, each, rng, radius_m)
        found = classify_shape(*of, pads=pads)
        labels.append(found.label)
        states.append(found.state)
        if found.label == kind and SIZE_PARAMETERS[kind]:
            fit = found.fits[kind]
            inside.append(abs(fit.radius_m - radius_m) < 1.96 * fit.radius_std_m)
            sharpness.append(100 * fit.radius_std_m / radius_m)
    right, named = np.array(labels) == kind, np.array(labels) != ""
    progress(f"{kind}, {each} touches of each pad")
    return {
        "object": kind,
        "touches of each pad": each,
        "objects": objects,
        "right, %": Share.of_mask(right) if kind in SHAPE_CLASSES else "no class",
        "wrong, %": Share.of_mask(named & ~right),
        "invalid, %": Share.of_mask(np.array(states) == "invalid"),
        "undetermined, %": Share.of_mask(np.array(states) == "undetermined"),
        "radius in 95 %": Share.of_mask(np.array(inside)) if inside else "-",
        "median std of the radius, %": f"{np.median(sharpness):.2g}" if sharpness else "-",
    }


def main() -> None:
    quick = options(__doc__).parse_args().quick
    objects = 3 if quick else 80
    report = Report(quick, objects_of_a_row=objects)
    inside = [kind for kind in SHAPE_CLASSES if kind != "edge"]
    report.table(
        "By object", [shape_row(kind, each, objects) for kind in (*inside, *OUTSIDE) for each in TOUCHES]
    )
    report.keep()


if __name__ == "__main__":
    main()
