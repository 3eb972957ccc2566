"""Faults of a simulated node: the switches of `Device`, and `LineFaults` of its cable."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from types import MappingProxyType
from typing import Any, Generic, TypeVar

import can

from handtouch.config.base import MAX_CHANNELS
from handtouch.device.inputs import CHANNELS, STRAIGHT_WIRING

T = TypeVar("T")


class LineFaults:
    """Faults of a bad cable or transceiver in the frames that a node sends.

    `lost`, `duplicate`, `corrupt` : probability [0, 1] that a frame is lost, duplicated, or has bytes changed
    `lost_every` : n to lose each n-th frame
    `late_ns` : delay of all frames
    `data_only` : True to affect TPDOs only
    `seed` : the same seed gives the same faults

    Raises ValueError for an invalid probability or time.
    """

    def __init__(
        self,
        *,
        lost: float = 0.0,
        lost_every: int = 0,
        late_ns: int = 0,
        duplicate: float = 0.0,
        corrupt: float = 0.0,
        data_only: bool = True,
        seed: int = 0,
    ) -> None:
        if not all(0 <= share <= 1 for share in (lost, duplicate, corrupt)):
            raise ValueError(
                f"lost, duplicate and corrupt must be 0 to 1, got {lost}, {duplicate} and {corrupt}"
            )
        if lost_every < 0 or late_ns < 0:
            raise ValueError(f"lost_every and late_ns must not be negative, got {lost_every} and {late_ns}")
        self.late_ns, self.data_only = late_ns, data_only
        self._lost, self._lost_every = lost, lost_every
        self._duplicate, self._corrupt = duplicate, corrupt
        self._random = random.Random(seed)
        self._frame_count = 0

    def received_copies(self, message: can.Message) -> list[can.Message]:
        """Return the frames received for a frame sent: none, one or two, copies of it."""
        self._frame_count += 1
        every = bool(self._lost_every) and self._frame_count % self._lost_every == 0
        if every or self._occurs(self._lost):
            return []
        data = bytearray(message.data)
        if data and self._occurs(self._corrupt):
            for at in self._random.sample(range(len(data)), self._random.randint(1, len(data))):
                data[at] ^= self._random.randint(1, 255)
        copies = 2 if self._occurs(self._duplicate) else 1
        identifier = message.arbitration_id
        return [
            can.Message(arbitration_id=identifier, data=data, is_extended_id=False) for _ in range(copies)
        ]

    def _occurs(self, share: float) -> bool:
        return share > 0 and self._random.random() < share


class FaultSwitch(Generic[T]):
    """Attribute that calls its owner's `refresh` when it is set."""

    def __init__(self, default: T, check: Callable[[T], bool] = lambda _: True, needs: str = "") -> None:
        self._default, self._check, self._needs = default, check, needs

    def __set_name__(self, owner: type, name: str) -> None:
        self._name, self._slot = name, f"_switch_{name}"

    def __get__(self, owner: Any, kind: type | None = None) -> T:
        value: T = getattr(owner, self._slot, self._default)
        return value

    def __set__(self, owner: Any, value: T) -> None:
        if not self._check(value):
            raise ValueError(f"{self._name} needs {self._needs}, got {value!r}")
        setattr(owner, self._slot, value)
        owner.refresh()


def _are_channels(values: Sequence[int] | AbstractSet[int] | Mapping[int, int]) -> bool:
    return set(values) <= set(range(MAX_CHANNELS))


class FaultSwitches:
    """Fault switches, settable from any thread; they stay set until they are cleared, through reboots too."""

    send_heartbeat = FaultSwitch(True)
    """False: no heartbeats, and no responses to node guarding; data continue."""
    heartbeat_state: FaultSwitch[int | None] = FaultSwitch(
        None, lambda state: state is None or 0 <= state <= 127, "an NMT state, 0 to 127, or None"
    )
    """NMT state in its heartbeats and guarding responses, whatever its own is."""
    send_data = FaultSwitch(True)
    """False: no TPDOs; heartbeats continue."""
    frame_bytes: FaultSwitch[int | None] = FaultSwitch(
        None, lambda n: n is None or 0 <= n <= 8, "a number of bytes, 0 to 8, or None"
    )
    """Length of its TPDOs regardless of their mapping."""
    line: FaultSwitch[LineFaults | None] = FaultSwitch(None)
    """Faults of its cable."""
    stuck_counts: FaultSwitch[Mapping[int, int]] = FaultSwitch(
        MappingProxyType({}), _are_channels, "channels from 0 to 15"
    )
    """Channel (from 0) -> constant count of this channel."""
    open_electrodes: FaultSwitch[AbstractSet[int]] = FaultSwitch(
        frozenset(), _are_channels, "electrodes from 0 to 15"
    )
    """Electrodes (from 0, in the sampler's order) with a broken wire: only noise is measured."""
    wiring: FaultSwitch[Sequence[int]] = FaultSwitch(
        STRAIGHT_WIRING,
        lambda w: len(w) >= CHANNELS and _are_channels(w),
        "four or more electrodes from 0 to 15",
    )
    """Electrode (from 0) that each of the inputs is connected to; four also for a node with three."""

    def refresh(self) -> None:
        """Apply a changed switch."""
        raise NotImplementedError
