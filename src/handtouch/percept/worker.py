"""Work of the percept process: the daemon's stream of contacts to percepts and action requests.

Public name: `PerceptWorker`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from handtouch import wire
from handtouch.arrays import FloatArray
from handtouch.config import Deployment, Pad
from handtouch.core.pad_model import contact_law, law_of, networks_of
from handtouch.hand import mount_transform, pad_surface
from handtouch.percept.action_request import make_request_message
from handtouch.percept.estimator import HandSnapshot
from handtouch.percept.messages import PerceptStatus, make_percept_message
from handtouch.percept.pipeline import PerceptPipeline
from handtouch.percept.samples import SAMPLE_FIELDS, ContactBuffer, ContactSamples, PerceptEstimate
from handtouch.percept.shape import pair_distance
from handtouch.percept.stiffness_estimator import ExpectedRadius
from handtouch.wire import PERCEPT_KINDS

_COLUMNS = wire.COLUMNS[wire.PerceptInput]
_FIELDS = tuple(name for name in SAMPLE_FIELDS if name in _COLUMNS and name != "pad_noise_m2")
_SURFACE_GRID = (0.06, 0.35, 0.65, 0.94)
"""Places along both sides of a pad, as fractions, at which its surface is compared with an object's"""
_STREAMED = ("object",)
"""Kinds that are published with every estimate"""
_STATUS_PERIOD_NS = 500_000_000
_REPEAT_PERIOD_NS = 500_000_000
"""Period of messages while a percept doesn't change; changes are reported at once."""


class PerceptWorker:
    """Estimates the percepts that each message of the daemon requests. Times are those of the stream [ns]."""

    def __init__(self, deployment: Deployment) -> None:
        pads = [pad for _, pad in deployment.pads]
        n, names = len(pads), [hand for hand, _ in deployment.pads]
        self._hands = list(dict.fromkeys(names))
        self._rows = {hand: np.flatnonzero([name == hand for name in names]) for hand in self._hands}
        self._links = [pad.link for pad in pads]
        self._networks = networks_of(deployment)
        self._surfaces = [pad_surface(pad) for pad in pads]
        self._mounts = [mount_transform(pad) for pad in pads]
        self.contacts = ContactBuffer(n, [self._hands.index(name) for name in names])
        """latest samples of every contact"""
        shear_pads = np.array([pad.shear is not None for pad in pads], np.bool_)
        self._pipeline = PerceptPipeline.build(
            self.contacts,
            self.pair_distance_m,
            shear_pads,
            self._surface_points(),
            np.array([surface.extent_m for surface in self._surfaces]),
            [_expected_radius(deployment, pad) for pad in pads],
        )
        self._requested = np.zeros(n, dtype=np.uint8)
        self._xy = np.full((n, 2), np.nan)  # positions of the last samples
        self._status_ns = 0
        self._last_reported: dict[tuple[str, int, int], tuple[int, str, str]] = {}
        """kind, hand, pad -> time [ns], state, label"""

    def process_input(self, message: wire.PerceptInput) -> list[wire.Percept]:
        """Process the contacts of a tick of one hand."""
        rows = self._rows[message.hand]
        self._set_requested(rows, _COLUMNS["requested"].to_array(message.requested))
        ids = _COLUMNS["contact_id"].to_array(message.contact_id)
        before = self.contacts.contact_id[rows]
        ended = rows[(before > 0) & (before != ids)]  # also where the message of the end was lost
        percepts, requests = self._pipeline.process_tick(
            self._read_samples(message, rows, ids),
            ended,
            message.t_ns,
            self._read_snapshot(message, rows, ids),
        )
        found = [
            make_percept_message(percept, self._hands[percept.hand], self._link_name(percept.pad))
            for percept in percepts
            if self._is_due(percept)
        ]
        return found + [
            make_request_message(
                request, self._hands[request.question.hand], self._link_name(request.question.pad)
            )
            for request in requests
        ]

    def status_if_due(self, now_ns: int) -> PerceptStatus | None:
        """Return a heartbeat twice a second, after the message of `now_ns` was processed."""
        if now_ns - self._status_ns < _STATUS_PERIOD_NS:
            return None
        self._status_ns = now_ns
        return PerceptStatus(now_ns)

    def pair_distance_m(self, pad: int, residual: float, residual_std: float) -> tuple[float, float]:
        """Return `pair_distance` and its standard deviation in metres on the surface."""
        x, y = self._xy[pad].tolist()
        if not math.isfinite(x + y):
            return math.nan, math.inf
        network = self._networks[pad]
        distance, std = pair_distance(network, x, y, residual, residual_std)
        step = 0.02 * min(network.a, network.b)
        offset = step * np.array([0.0, 1.0])
        xs, ys = x + offset * (residual >= 0), y + offset * (residual < 0)
        placed = self._positions_m(pad, xs, ys)
        scale = float(np.linalg.norm(placed[1] - placed[0])) / step
        return scale * distance, scale * std

    def _set_requested(self, rows: NDArray[np.intp], requested: NDArray[np.uint8]) -> None:
        if np.array_equal(requested, self._requested[rows]):
            return
        self._requested[rows] = requested
        bits = self._requested[None] >> np.arange(len(PERCEPT_KINDS) + 1, dtype=np.uint8)[:, None] & 1
        *kinds, action_requests = bits.astype(np.bool_)
        self._pipeline.set_requested(np.array(kinds), action_requests)

    def _read_samples(
        self, message: wire.PerceptInput, rows: NDArray[np.intp], ids: NDArray[np.uint32]
    ) -> ContactSamples:
        links = _COLUMNS["row"].to_array(message.row)
        pads = rows[links]
        sample = ContactSamples(pads, _COLUMNS["sample_ns"].to_array(message.sample_ns), ids[links])
        if not len(pads):
            return sample
        for name in _FIELDS:
            if data := getattr(message, name):
                sample[name] = _COLUMNS[name].to_array(data)
        noise = _COLUMNS["pad_noise_m2"].to_array(message.pad_noise_m2)
        sample["pad_noise_m2"] = noise[:, [[0, 1], [1, 2]]]
        self._xy[pads] = _COLUMNS["xy"].to_array(message.xy)
        return sample

    def _read_snapshot(
        self, message: wire.PerceptInput, rows: NDArray[np.intp], ids: NDArray[np.uint32]
    ) -> HandSnapshot | None:
        if not message.link_poses:
            return None
        poses = _COLUMNS["link_poses"].to_array(message.link_poses)
        base = _COLUMNS["base_pose"].to_array(message.base_pose)[0]
        slips = np.zeros(len(rows))
        odds = np.nan_to_num(
            _COLUMNS["slip_log_odds"].to_array(message.slip_log_odds), nan=-np.inf, posinf=np.inf
        )
        slips[_COLUMNS["row"].to_array(message.row)] = expit(odds)
        return HandSnapshot(
            hand=self._hands.index(message.hand),
            first=int(rows[0]),
            t_ns=message.t_ns,
            contact_id=ids,
            clear=_COLUMNS["clear"].to_array(message.clear).astype(np.bool_),
            slip_probability=slips,
            rotation=poses[:, :9].reshape(-1, 3, 3),
            origin_m=poses[:, 9:],
            base_rotation=base[:9].reshape(3, 3),
            base_m=base[9:],
            known_object=message.known_object,
        )

    def _positions_m(self, row: int, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return points (k, 3) of a pad's surface in its link's frame."""
        rotation, translation = self._mounts[row]
        return np.asarray((rotation @ self._surfaces[row].point(x, y)).T + translation)

    def _surface_points(self) -> FloatArray:
        """Return points over each pad's surface (n, f, 3) in its link's frame; its centre where one is off
        it."""
        x, y = (part.ravel() for part in np.meshgrid(_SURFACE_GRID, _SURFACE_GRID))
        found = []
        for row, surface in enumerate(self._surfaces):
            placed = self._positions_m(row, x * surface.a, y * surface.b)
            off = ~np.isfinite(placed).all(axis=1)
            placed[off] = placed[len(x) // 2]
            found.append(placed)
        return np.stack(found)

    def _is_due(self, percept: PerceptEstimate) -> bool:
        key, state = (percept.kind, percept.hand, percept.pad), (percept.state, percept.label)
        last_ns, *before = self._last_reported.get(key, (-(10**18), "", ""))
        if percept.kind in _STREAMED:
            return True
        if tuple(before) == state and percept.estimate_ns - last_ns < _REPEAT_PERIOD_NS:
            return False
        self._last_reported[key] = percept.estimate_ns, *state
        return True

    def _link_name(self, pad: int) -> str:
        return self._links[pad] if pad >= 0 else ""


def _expected_radius(deployment: Deployment, pad: Pad) -> ExpectedRadius | None:
    """Return what the tables of a pad's two sheets say of radii; None for one sheet."""
    if pad.second_sheet is None:
        return None
    sheets = deployment.sheet_of(pad), deployment.sheets[pad.second_sheet]
    relative = math.hypot(*(sheet.alpha_std / sheet.alpha for sheet in sheets))
    apart = abs(2 / sheets[0].alpha - 2 / sheets[1].alpha)
    return ExpectedRadius(contact_law(sheets[0], law_of(sheets[0])), relative / apart)
