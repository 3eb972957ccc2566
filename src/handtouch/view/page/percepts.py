"""Current percepts per pad and hand, as text for the page.

Public names: `PerceptSummaries`. Reads no clock: times are those of the messages.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from handtouch import wire
from handtouch.view.message_lines import percept_summary

_ELLIPSOID_CHI2 = 7.815
"""95 % of a normal distribution in three dimensions"""
_DEFAULT_LABELS = ("sticking", "point")
"""Usual classes: listed, but not shown next to the pad."""
_PERCEPT_TIMEOUT_NS = 3_000_000_000
"""A current percept is repeated twice a second; one of the whole hand expires after this time."""


class _HeldPercept(NamedTuple):
    contact_id: int
    expires_ns: int
    label: str
    text: str
    missing: str
    poses: list[dict[str, Any]]


def _drawn_pose(pose: wire.ObjectPose) -> dict[str, Any]:
    """Return a hypothesis as it is drawn in the palm: half axes of the position's 95 % ellipsoid, and z."""
    variances, axes = np.linalg.eigh(np.reshape(pose["palm_covariance"], (6, 6))[:3, :3])
    half_m = np.sqrt(np.maximum(variances, 0.0) * _ELLIPSOID_CHI2)
    rotation = Rotation.from_quat(pose["palm_quaternion"]).as_matrix()
    return {
        "weight": pose["weight"],
        "position_m": pose["palm_position_m"],
        "axes_m": (axes * half_m).T.tolist(),
        "z": rotation[:, 2].tolist(),
    }


class PerceptSummaries:
    """Collects percepts; `current` returns the valid ones as plain values."""

    def __init__(self) -> None:
        self._pads: dict[str, dict[str, _HeldPercept]] = {}

    def add_percept(self, percept: wire.Percept) -> None:
        """Store a percept message of any kind."""
        pad = self._pads.setdefault(f"{percept.hand}/{percept.link}", {})
        is_request = percept.kind == "action_request"
        shown = percept.state == "estimated" and percept.label not in _DEFAULT_LABELS
        pad[f"{percept.kind} {percept.question}" if is_request else percept.kind] = _HeldPercept(
            percept.contact_id,
            percept.expires_ns if is_request else percept.t_ns + _PERCEPT_TIMEOUT_NS,
            percept.label if is_request or shown else "",
            percept_summary(percept),
            f"{percept.kind}: {percept.reason}" if percept.state == "undetermined" else "",
            [_drawn_pose(pose) for pose in percept.poses],
        )

    def current(self, contacts: dict[str, int], now_ns: int) -> dict[str, dict[str, Any] | None]:
        """Return hand/link (hand/: the whole hand) -> its valid percepts, None where the last one ended.

        `contacts`: contact id of each pad in the latest frames, 0 for none; percepts of other contacts ended.
        """
        return {key: self._summarise_pad(key, contacts.get(key), now_ns) for key in list(self._pads)}

    def clear(self) -> None:
        """Discard all percepts."""
        self._pads.clear()

    def _summarise_pad(self, key: str, contact_id: int | None, now_ns: int) -> dict[str, Any] | None:
        is_hand = key.endswith("/")
        valid = {
            kind: held
            for kind, held in self._pads[key].items()
            if now_ns < held.expires_ns and (contact_id is None or is_hand or held.contact_id == contact_id)
        }
        if not valid:
            del self._pads[key]
            return None
        self._pads[key] = valid
        estimates = [valid[kind] for kind in wire.PERCEPT_KINDS if kind in valid]
        poses = [pose for held in estimates for pose in held.poses]
        return ({"poses": poses} if poses else {}) | {
            "labels": [held.label for held in estimates if held.label],
            "lines": [held.text for held in estimates if held.text],
            "requests": [held.text for kind, held in valid.items() if kind not in wire.PERCEPT_KINDS],
            "missing": [held.missing for held in estimates if held.missing],
        }
