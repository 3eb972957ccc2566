"""The daemon's side of the percept process: streams contacts to it, and checks what it returns.

Public name: `PerceptClient`. Everything here runs in the hot thread; `ChildProcess` runs the process. It is
started when a percept is requested that needs it, and stopped once none has been for a while.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from handtouch import wire
from handtouch.arrays import IntArray
from handtouch.config import Deployment, ObjectTable
from handtouch.core.columns import TickResult
from handtouch.core.pipeline import Pipeline
from handtouch.core.scene import RequestedOutputs
from handtouch.core.stages.rows import VALUE_SLICES
from handtouch.core.stages.slip import SLIP_SLICES
from handtouch.daemon.child_process import ChildProcess, child_statistics
from handtouch.percept.messages import PerceptMessageError, PerceptStatus, pack_message, unpack_output
from handtouch.wire import PERCEPT_KINDS, ContactRadiusStatus, ForceStatus, PadState, PositionStatus

_IDLE_PERIOD_NS = 50_000_000
"""Longest time between two messages of the stream, whose time the process works by"""
_STOP_DELAY_NS = 30_000_000_000
"""From the last request to the process' end: starting it takes a second"""
_MAX_MESSAGES_PER_TICK = 2
_VALUE_COLUMNS = (
    "xy",
    "pad_m",
    "pad_noise_m2",
    "position_m",
    "normal",
    "covariance_m2",
    "force_n",
    "force_std_n",
    "residual",
    "residual_std",
)
_MOTION, _OBJECT = PERCEPT_KINDS.index("motion"), PERCEPT_KINDS.index("object")
_log = logging.getLogger("handtouch.percept")


def stated_objects(deployment: Deployment) -> dict[str, str]:
    """Return the object of each hand of a deployment, as `wire.PerceptInput.known_object` states it."""
    return {
        hand.name: "" if hand.object is None else known_object(hand.object, deployment.objects[hand.object])
        for hand in deployment.hands
    }


def known_object(name: str, table: ObjectTable) -> str:
    """Return an object as `wire.PerceptInput.known_object` states it."""
    return f"{name}={table.model_dump_json()}"


class PerceptClient:
    """Call `set_requested` when the demand changes and `process_tick` after every tick. Times in ns.

    `publish` is called with each valid percept of the process. `malformed` counts its invalid messages.
    """

    def __init__(
        self,
        deployment: Deployment,
        pipeline: Pipeline,
        publish: Callable[[wire.Percept], None],
        process: ChildProcess | None = None,
    ) -> None:
        n = pipeline.model.size
        self._deployment, self._pipeline, self._publish = deployment, pipeline, publish
        self.process = process or ChildProcess(
            "handtouch.percept.child",
            "percept",
            lambda: self._deployment.model_dump_json(by_alias=True).encode(),
        )
        self.malformed = 0
        self._links = deployment.links_by_hand
        self._pads: NDArray[np.bool_] = np.zeros(n, dtype=np.bool_)
        self._requested = np.zeros(n, dtype=np.uint8)
        self._needed = False
        self._needed_ns = 0
        self._seq: Counter[str] = Counter()
        self._sent_ns = dict.fromkeys(pipeline.model.rows_of_hand, 0)
        self._snapshot_ns = dict.fromkeys(pipeline.model.rows_of_hand, 0)
        self._object_pads: NDArray[np.bool_] = np.zeros(n, dtype=np.bool_)
        self._stated = stated_objects(deployment)
        self._objects = dict(self._stated)
        self._last_sent_sync_ns = 0
        self._status: PerceptStatus | None = None

    @property
    def active(self) -> bool:
        """The process is needed, or hasn't ended yet."""
        return self._needed or self.process.state != "stopped"

    def set_requested(self, requested: RequestedOutputs, now_ns: int) -> None:
        """Set what each pad's contacts are needed for."""
        none = np.zeros((1, len(self._requested)), dtype=np.bool_)
        kinds = (
            np.repeat(none, len(PERCEPT_KINDS), axis=0) if requested.percepts is None else requested.percepts
        )
        actions = none if requested.action_requests is None else requested.action_requests[None]
        bits = np.concatenate([kinds, actions])
        self._requested = np.packbits(bits, axis=0, bitorder="little")[0]
        bits[_MOTION] = False  # the core detects it
        self._pads, self._object_pads = np.asarray(bits.any(axis=0)), bits[_OBJECT]
        self._needed, self._needed_ns = bool(self._pads.any()), now_ns
        if self._needed and not self.process.enabled:
            self.process.start(now_ns)

    def restart_with(self, deployment: Deployment, now_ns: int) -> None:
        """Restart the process with a reloaded deployment."""
        self._deployment = deployment
        self.process.restart(now_ns)

    def set_stated_objects(self, deployment: Deployment) -> None:
        """Set the objects of a reloaded deployment, of the hands where they differ from those before."""
        after = stated_objects(deployment)
        self._objects |= {hand: known for hand, known in after.items() if known != self._stated.get(hand)}
        self._stated = after

    def set_object(self, hand: str, known: str) -> None:
        """Set the object in a hand, as `wire.PerceptInput.known_object` states it; empty for none."""
        self._objects[hand] = known

    @property
    def objects(self) -> Mapping[str, str]:
        """The object in each hand, alike."""
        return self._objects

    def process_tick(self, result: TickResult, now_ns: int) -> None:
        """Send a tick's contacts; publish the percepts that were received."""
        if not self.active:
            return
        if self._needed:
            self._needed_ns = now_ns
        elif now_ns - self._needed_ns > _STOP_DELAY_NS:
            self.process.stop()
            self._status = None
        if self.process.pid is None:
            if self.process.poll(now_ns):
                self._status = None
            return
        for data in self.process.receive(now_ns, _MAX_MESSAGES_PER_TICK):
            self._handle_message(data)
        self.process.poll(now_ns)
        rows = np.sort(np.concatenate([result.began, result.updated]))
        rows = rows[self._pads[rows]]
        for hand, hand_rows in self._pipeline.model.rows_of_hand.items():
            mine = rows[(rows >= hand_rows.start) & (rows < hand_rows.stop)]
            idle = now_ns - self._sent_ns[hand] >= _IDLE_PERIOD_NS
            if len(mine) or idle or np.count_nonzero(self._pads[result.ended]):
                self._sent_ns[hand] = now_ns
                if self.process.send(pack_message(self._make_input(hand, hand_rows, mine, result.sync_ns))):
                    self._last_sent_sync_ns = result.sync_ns

    def statistics(self) -> dict[str, Any]:
        """Return the state of the process for the `service` message."""
        processed_ns = self._status.processed_ns if self._status else None
        statistics = child_statistics(self.process, self._last_sent_sync_ns, processed_ns)
        return {**statistics, "malformed": self.malformed}

    def close(self) -> None:
        """Stop the process."""
        self.process.close()

    # Details ----------------------------------------------------------------------------------------------

    def _make_input(self, hand: str, hand_rows: slice, rows: IntArray, sync_ns: int) -> wire.PerceptInput:
        self._seq[hand] += 1
        tick = self._pipeline.tick
        columns, values, slip = tick.columns, tick.columns.values[rows], tick.slip.state[rows]
        fields: dict[str, Any] = {name: values[:, VALUE_SLICES[name]].tobytes() for name in _VALUE_COLUMNS}
        log_odds = slip[:, SLIP_SLICES["log_odds"]]
        log_odds[slip[:, SLIP_SLICES["slipping"]] != 0] = np.inf
        log_odds[tick.slip.contact_id[rows] == 0] = np.nan
        ids = np.where(self._pads[hand_rows], tick.state.contact_id[hand_rows], 0)
        return wire.PerceptInput(
            v=wire.SCHEMA_VERSION,
            session=0,
            seq=self._seq[hand],
            t_ns=sync_ns,
            hand=hand,
            contact_id=ids.astype("<u4").tobytes(),
            requested=self._requested[hand_rows].tobytes(),
            row=(rows - hand_rows.start).astype("<u4").tobytes(),
            sample_ns=columns.sample_ns[rows].tobytes(),
            total_current_a=columns.total_current_a[rows].tobytes(),
            slip_log_odds=log_odds.tobytes(),
            slip_velocity_m_per_s=slip[:, SLIP_SLICES["slip_velocity_m_per_s"]].tobytes(),
            tremor_std_m=np.exp(0.5 * slip[:, SLIP_SLICES["log_tremor_variance"]]).tobytes(),
            retained=False,
            **fields,
            **self._palm_columns(rows),
            **self._shear_columns(rows),
            **self._radius_columns(rows),
            **self._snapshot(hand, hand_rows, sync_ns),
        )

    def _snapshot(self, hand: str, rows: slice, sync_ns: int) -> dict[str, Any]:
        """Return what is sent 20 times a second about a hand whose object's pose is requested."""
        due = sync_ns - self._snapshot_ns[hand] >= _IDLE_PERIOD_NS
        if not (due and np.count_nonzero(self._object_pads[rows])):
            return {}
        self._snapshot_ns[hand] = sync_ns
        unknown = np.full((rows.stop - rows.start, 12), np.nan), np.full(12, np.nan)
        poses = self._pipeline.link_poses(hand, sync_ns) or unknown
        clear = (self._pipeline.tick.columns.state[rows] == PadState.CLEAR) & self._object_pads[rows]
        return {
            "clear": clear.astype("<u1").tobytes(),
            "link_poses": poses[0].tobytes(),
            "base_pose": poses[1].tobytes(),
            "known_object": self._objects[hand],
        }

    def _palm_columns(self, rows: IntArray) -> dict[str, Any]:
        transforms = self._pipeline.transforms
        if not (transforms.any_requested and len(rows)):
            return {}
        placed, rotation, age_s, joints_m2 = transforms.in_palm(rows)
        return {
            "palm_position_m": placed[:, :3].tobytes(),
            "palm_normal": placed[:, 3:6].tobytes(),
            "palm_covariance_m2": placed[:, 6:].tobytes(),
            "palm_rotation": rotation.tobytes(),
            "palm_joints_m2": joints_m2.tobytes(),
            "joints_age_s": age_s.tobytes(),
        }

    def _shear_columns(self, rows: IntArray) -> dict[str, Any]:
        """Return force vectors, NaN where there is none or no ratio with the normal force."""
        tick = self._pipeline.tick
        if not (tick.shear.any_configured and len(rows)):
            return {}
        status, vector = tick.state.force_vector_status[rows], tick.state.force_vector[rows]
        usable = np.isin(status, (ForceStatus.VALID, ForceStatus.UNRELIABLE))
        usable &= tick.columns.position_status[rows] == PositionStatus.VALID
        vector[~usable] = np.nan
        return {
            "force_vector_n": vector[:, :3].tobytes(),
            "force_vector_covariance_n2": vector[:, 3:].tobytes(),
        }

    def _radius_columns(self, rows: IntArray) -> dict[str, Any]:
        """Return radii by both sheets of a pad, NaN where there is none or its force isn't valid."""
        tick = self._pipeline.tick
        if not (tick.second.any_configured and len(rows)):
            return {}
        values = tick.columns.values[rows]
        unusable = values[:, VALUE_SLICES["contact_radius_status"]][:, 0] != ContactRadiusStatus.VALID
        unusable |= tick.columns.force_status[rows] != ForceStatus.VALID
        found = {}
        for name in ("contact_radius_m", "contact_radius_std_m"):
            found[name] = np.where(unusable, np.nan, values[:, VALUE_SLICES[name]][:, 0]).tobytes()
        return found

    def _handle_message(self, data: bytes) -> None:
        try:
            message = unpack_output(data)
            if isinstance(message, PerceptStatus):
                self._status = message
                return
            if message.kind == "motion" or message.link not in ("", *self._links.get(message.hand, ())):
                raise PerceptMessageError(
                    f"no percept of it: {message.kind} of {message.hand}/{message.link}"
                )
        except PerceptMessageError as error:
            self.malformed += 1
            _log.warning("percept process: malformed message: %s", error)
            return
        self._publish(message)
