"""Make the film and pictures of docs/bolt.md: an episode of examples/start_bolt.py, by MuJoCo's renderer.

Usage: MUJOCO_GL=egl python docs/bolt_picture.py [SEED]. The film shows every 200 ms. Touched pads are orange;
red: contacts with their normals; blue: the bolt's axis as the program knows it, with the ellipsoids of 95 %
of both ends.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from handtouch.simulate.tactile.bolt_scene import HOLE_M, Bolt, BoltStart
from handtouch.simulate.tactile.bolt_workcell import BoltWorkcell, Pose, Sensed

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "examples"))
from bolt_pose import Contact, InGrip, KnownBolt, OnTable, compose  # noqa: E402
from start_bolt import BoltStarter, Step  # noqa: E402

FloatArray = NDArray[np.float64]
WIDTH, HEIGHT, EVERY = 480, 360, 20
FRAME_MS = 80
_BACKGROUND = 236, 239, 243
_COLOURS = {"table": (0.75, 0.72, 0.66, 1), "wedge": (0.45, 0.5, 0.6, 1), "pad": (0.25, 0.3, 0.35, 1)}
_SKIN, _METAL, _TOUCHED = (0.62, 0.66, 0.7, 1), (0.85, 0.7, 0.3, 1), (1.0, 0.45, 0.1, 1)
_CONTACT, _KNOWN, _ELLIPSOID = (0.85, 0.1, 0.1, 1), (0.1, 0.35, 0.9, 1), (0.1, 0.35, 0.9, 0.4)
_NORMAL_M, _THIN_M, _POINT_M = 0.035, 0.6e-3, 1.5e-3
_SEEN_THROUGH = 0.3
"""Of the bolt's colour, once its place is known"""
_GLOW = 0.7
_SIGMAS = 2.8  # of 95 % in three dimensions
_STILLS = {
    Step.GRASP: ("bolt_search.png", 0.14, 160, -30),
    Step.ORIENT: ("bolt_grip.png", 0.16, 120, 15),
    Step.DONE: ("bolt.png", 0.3, 160, -15),
}
"""Pictures at the begin of steps: file, distance [m], azimuth and elevation [deg] of the camera"""


class Estimate:
    """Both ends of the bolt (2, 3) in a frame, and their covariances (2, 3, 3), as a fit leaves them."""

    def __init__(
        self, x: FloatArray, covariance: FloatArray, ends_of: Callable[[FloatArray], FloatArray]
    ) -> None:
        self.points_m = ends_of(x)
        step = 1e-4
        slopes = np.stack([(ends_of(x + step * e) - self.points_m) / step for e in np.eye(len(x))])
        self.covariances_m2 = np.einsum("aej,ab,bek->ejk", slopes, covariance, slopes)


class WatchedBolt(KnownBolt):
    """What was found last: contacts and estimate in the world, or an estimate in the grip."""

    def __init__(self, bolt: Bolt) -> None:
        super().__init__(bolt)
        self.contacts: list[Contact] = []
        self.on_table: Estimate | None = None
        self.in_grip: Estimate | None = None

    def poses_on_table(self, contacts: list[Contact], spheres: FloatArray) -> list[OnTable]:
        """Do as the program's."""
        found = super().poses_on_table(contacts, spheres)
        self.contacts, self.in_grip = list(contacts), None
        self.on_table = Estimate(found[0].parameters, found[0].covariance, lambda x: self.ends(self.lying(x)))
        return found

    def pose_in_grip(self, expected: Pose, contacts: list[Contact]) -> InGrip:
        """Do as the program's."""
        found = super().pose_in_grip(expected, contacts)
        self.contacts = []
        self.in_grip = Estimate(found.change, found.covariance, lambda x: self.ends(found.at(x)))
        return found


class FilmedCell(BoltWorkcell):
    """A workcell that is filmed, with what the program knows."""

    def film(self) -> None:
        """Begin."""
        model = self.scene.model
        for geom in range(model.ngeom):
            name = model.geom(geom).name
            model.geom_rgba[geom] = next(
                (c for start, c in _COLOURS.items() if name.startswith(start)), _SKIN
            )
        self._metal = [model.geom(name).id for name in ("shank", "chamfer", "head")]
        model.geom_rgba[self._metal] = _METAL
        model.vis.global_.offwidth, model.vis.global_.offheight = WIDTH, HEIGHT
        model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.4, 0.6
        self._pads = [model.geom(f"pad {link}").id for link in self.links]
        self._renderer = mujoco.Renderer(model, HEIGHT, WIDTH)
        self._camera = mujoco.MjvCamera()
        self._target_m = np.array([0.0, 0.0, 0.05])
        self.frames: list[Image.Image] = []
        self._periods, self._step = 0, Step.SEARCH
        self.watched = WatchedBolt(self.scene.bolt)
        self.program: BoltStarter | None = None

    def move(self, flange: Pose, joint_rad: np.ndarray[Any, Any]) -> Sensed:
        """Move, and take a picture now and then."""
        sensed = super().move(flange, joint_rad)
        self._periods += 1
        if self._periods % EVERY == 0:
            bolt = self.scene.bolt_pose[0]
            near = bolt if np.linalg.norm(bolt - HOLE_M) > 0.1 else HOLE_M
            self._target_m += 0.15 * (near + np.array([0.0, 0.0, 0.02]) - self._target_m)
            self.frames.append(self._picture(sensed, self._target_m))
        self.take_still(sensed)
        return sensed

    def take_still(self, sensed: Sensed) -> None:
        """Take a picture from near by at the begin of some steps."""
        step = self.program.steps[-1] if self.program and self.program.steps else Step.SEARCH
        if step is not self._step and step in _STILLS:
            file, *view = _STILLS[step]
            self._picture(sensed, self.scene.bolt_pose[0], *view).save(HERE / file)
        self._step = step

    def _picture(
        self,
        sensed: Sensed,
        target_m: FloatArray,
        distance_m: float = 0.42,
        azimuth_deg: float = 160,
        elevation_deg: float = -15,
    ) -> Image.Image:
        touched = sensed.touch.touched
        self.scene.model.geom_rgba[self._pads] = np.where(touched[:, None], _TOUCHED, _COLOURS["pad"])
        known = self.watched.on_table is not None
        self.scene.model.geom_rgba[self._metal, 3] = _SEEN_THROUGH if known else 1.0
        self._camera.lookat[:], self._camera.distance = target_m, distance_m
        self._camera.azimuth, self._camera.elevation = azimuth_deg, elevation_deg
        self._renderer.update_scene(self.scene.data, self._camera)
        self._add_contacts(sensed)
        self._add_estimate()
        pixels = self._renderer.render().copy()
        pixels[(pixels == 0).all(axis=2)] = _BACKGROUND  # MuJoCo leaves it black
        return Image.fromarray(pixels)

    def _add_contacts(self, sensed: Sensed) -> None:
        touch, shown = sensed.touch, []
        for row in np.flatnonzero(touch.touched):
            body = self.scene.data.body(self.links[row])
            rotation = body.xmat.reshape(3, 3)
            shown.append((body.xpos + rotation @ touch.position_m[row], rotation @ touch.normal[row]))
        for point, normal in [*shown, *((each.point_m, each.normal) for each in self.watched.contacts)]:
            sphere = np.full(3, _POINT_M)
            self._add(mujoco.mjtGeom.mjGEOM_SPHERE, sphere, point, np.eye(3), _CONTACT)
            self._add_line(point - _NORMAL_M * normal, point, _CONTACT)

    def _add_estimate(self) -> None:
        frame: Pose = np.zeros(3), np.eye(3)
        known = self.watched.on_table
        if self.watched.in_grip and self.program:
            frame, known = self.program._grip_pose(), self.watched.in_grip
        if known is None:
            return
        points = [compose(frame, (point, np.eye(3)))[0] for point in known.points_m]
        self._add_line(points[0], points[1], _KNOWN)
        for point, own in zip(points, known.covariances_m2, strict=True):
            variances, axes = np.linalg.eigh(frame[1] @ own @ frame[1].T)
            radii = np.maximum(_SIGMAS * np.sqrt(np.maximum(variances, 0.0)), 1e-3)
            self._add(mujoco.mjtGeom.mjGEOM_ELLIPSOID, radii, point, axes, _ELLIPSOID)

    def _add(self, kind: Any, size: FloatArray, place: FloatArray, turn: FloatArray, colour: Any) -> Any:
        scene = self._renderer.scene
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(geom, kind, size, place, turn.ravel(), np.array(colour, np.float32))
        geom.emission = _GLOW
        scene.ngeom += 1
        return geom

    def _add_line(self, begin: FloatArray, end: FloatArray, colour: Any) -> None:
        kind = mujoco.mjtGeom.mjGEOM_CAPSULE
        geom = self._add(kind, np.zeros(3), np.zeros(3), np.eye(3), colour)
        mujoco.mjv_connector(geom, kind, _THIN_M, begin, end)


def main() -> None:
    """Film an episode."""
    seed = int(sys.argv[1]) if len(sys.argv) > 1 else 1
    cell = FilmedCell(seed, BoltStart.drawn(seed))
    cell.film()
    cell.program = program = BoltStarter(cell, log=print)
    program.bolt = cell.watched
    program.run()
    cell.take_still(program._sensed)
    first, *others = cell.frames + cell.frames[-1:] * 10
    film = HERE / "bolt.webp"
    first.save(film, save_all=True, append_images=others, duration=FRAME_MS, loop=0, quality=70, method=4)
    print(f"{film.name}: {len(cell.frames)} pictures, {film.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
