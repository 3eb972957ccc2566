"""Contact points on the links of a hand in a MuJoCo simulation.

Public names: `LinkPoints` (points on the links), `NO_POINTS`, `ContactReader` (reads MuJoCo's data).
"""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from handtouch import config
from handtouch.arrays import FloatArray, IntArray


@dataclass(frozen=True)
class LinkPoints:
    """Contact points (k,) on the links of pads, of several environments, in their order."""

    environment: IntArray
    """(k,)."""
    pad: IntArray
    """(k,), row of a pad on the link; a point on a link with several pads is a row for each."""
    point_m: FloatArray
    """(k, 3), in the link's frame."""
    force_n: FloatArray
    """(k, 3), force on the link, in its frame."""
    curvature: FloatArray
    """(k,), mean curvature of the other body [1/m]."""

    def every(self, step: int, first: int) -> LinkPoints:
        """Return the contacts of every `step`-th environment from `first` on, numbered from 0."""
        rows = self.environment % step == first
        return LinkPoints(
            self.environment[rows] // step,
            *(column[rows] for column in (self.pad, self.point_m, self.force_n, self.curvature)),
        )


NO_POINTS = LinkPoints(*(np.zeros(0, np.intp),) * 2, *(np.zeros((0, 3)),) * 2, np.zeros(0))


class ContactReader:
    """Reads the contacts of the pads of a deployment from data of a model.

    A pad senses contacts of the geom `pad LINK`, or of all geoms of its link's body if there is none.
    `bodies` are names of bodies by link, where they differ. Raises ValueError for a link without a body.
    """

    def __init__(self, pads: Sequence[config.Pad], model: Any, bodies: Mapping[str, str]) -> None:
        self._model, self.time_step_s = model, float(model.opt.timestep)
        links = [pad.mount.link or pad.link for pad in pads]
        self._bodies = np.array([_body_id(model, bodies.get(link, link), link) for link in links])
        self._senses = np.zeros((len(pads), model.ngeom), np.bool_)
        for row, pad in enumerate(pads):
            geom = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, f"pad {pad.link}")
            self._senses[row] = (
                np.arange(model.ngeom) == geom if geom >= 0 else model.geom_bodyid == self._bodies[row]
            )
        self._curvature = np.array([_curvature(model, geom) for geom in range(model.ngeom)])
        self._states: list[Any] = []
        self._views: tuple[list[Any], list[FloatArray], list[FloatArray]] = [], [], []
        """of the states read last: contacts, and rotations and positions of bodies; they follow each step"""

    def read(self, states: Sequence[Any]) -> LinkPoints:
        """Return the contacts of environments with the data `states`, after a step or mj_forward."""
        if len(states) != len(self._states) or not all(map(operator.is_, states, self._states)):
            self._states = list(states)
            contacts = [data.contact for data in states]
            self._views = contacts, [data.xmat for data in states], [data.xpos for data in states]
        in_all = list(map(len, self._views[0]))
        owners = [number for number, count in enumerate(in_all) if count]
        if not owners:
            return NO_POINTS
        contacts, rotations, positions = ([views[number] for number in owners] for views in self._views)
        counts = [in_all[number] for number in owners]
        geoms = np.concatenate([each.geom for each in contacts])
        owner = np.repeat(np.arange(len(owners)), counts)
        side, pad, contact = np.nonzero(self._senses[:, geoms.T].transpose(1, 0, 2))
        order = np.argsort(owner[contact], kind="stable")
        side, pad, contact = side[order], pad[order], contact[order]
        owner, k = owner[contact], len(pad)
        environment, index = np.array(owners)[owner], contact - (np.cumsum(counts) - counts)[owner]
        forces, contact_force = np.empty((k, 6)), mujoco.mj_contactForce  # 0 of excluded contacts
        for number, at, force in zip(environment.tolist(), index.tolist(), forces, strict=True):
            contact_force(self._model, states[number], at, force)
        frames = np.concatenate([each.frame for each in contacts])[contact].reshape(-1, 3, 3)
        # rows of a contact's frame: its normal, from the first geom to the second, and two tangents
        on_second = np.einsum("ki,kij->kj", forces[:, :3], frames)
        on_link = np.where(side[:, None] == 1, on_second, -on_second)
        body = owner * self._model.nbody + self._bodies[pad]
        rotation = np.concatenate(rotations)[body].reshape(k, 3, 3)
        origin = np.concatenate(positions)[body]
        position = np.concatenate([each.pos for each in contacts])[contact]
        return LinkPoints(
            environment,
            pad,
            np.einsum("kji,kj->ki", rotation, position - origin),
            np.einsum("kji,kj->ki", rotation, on_link),
            self._curvature[geoms[contact, 1 - side]],
        )


def _body_id(model: Any, name: str, link: str) -> int:
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
    if number < 0:
        known = ", ".join(model.body(body).name for body in range(1, model.nbody))
        raise ValueError(
            f'the model has no body "{name}" for link {link}: state it in bodies={{"{link}": ...}}; '
            f"its bodies: {known}"
        )
    return int(number)


def _curvature(model: Any, geom: int) -> float:
    """Return the mean curvature [1/m] of a geom's side; 0 for flat ones and meshes."""
    kind, size = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return float(1 / size[0])
    if kind in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER):
        return float(0.5 / size[0])
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return float(np.mean(1 / size))
    return 0.0
