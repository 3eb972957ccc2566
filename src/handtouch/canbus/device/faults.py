"""What can be wrong with a node: the switches of `Device`, and `Line`, what its cable does to its frames."""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from types import MappingProxyType
from typing import Any, Generic, TypeVar

import can

from .inputs import CHANNELS, STRAIGHT

T = TypeVar("T")


class Line:
    """A bad cable or transceiver: what becomes of the frames that a node sends.

    `lost`, `duplicate`, `corrupt` : probability [0, 1] that a frame doesn't arrive, arrives twice, or with
    bytes changed; `lost_every` n loses each n-th frame, `late_ns` delays all. `data_only` leaves all but
    TPDOs alone. The same `seed` gives the same faults. Raises ValueError for what is no probability or time.
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
        self._chance = random.Random(seed)
        self._seen = 0

    def frames(self, message: can.Message) -> list[can.Message]:
        """What arrives of a frame: nothing, one or two, copies of it."""
        self._seen += 1
        every = bool(self._lost_every) and self._seen % self._lost_every == 0
        if every or self._happens(self._lost):
            return []
        data = bytearray(message.data)
        if data and self._happens(self._corrupt):
            for at in self._chance.sample(range(len(data)), self._chance.randint(1, len(data))):
                data[at] ^= self._chance.randint(1, 255)
        copies = 2 if self._happens(self._duplicate) else 1
        identifier = message.arbitration_id
        return [
            can.Message(arbitration_id=identifier, data=data, is_extended_id=False) for _ in range(copies)
        ]

    def _happens(self, share: float) -> bool:
        return share > 0 and self._chance.random() < share


class Switch(Generic[T]):
    """An attribute that tells its owner when it is set: `refresh` is called."""

    def __init__(self, default: T, check: Callable[[T], bool] = lambda _: True, needs: str = "") -> None:
        self._default, self._check, self._needs = default, check, needs

    def __set_name__(self, owner: type, name: str) -> None:
        self._name, self._slot = name, f"_{name}"

    def __get__(self, owner: Any, kind: type | None = None) -> T:
        value: T = getattr(owner, self._slot, self._default)
        return value

    def __set__(self, owner: Any, value: T) -> None:
        if not self._check(value):
            raise ValueError(f"{self._name} needs {self._needs}, got {value!r}")
        setattr(owner, self._slot, value)
        owner.refresh()


def _are_channels(values: Sequence[int] | AbstractSet[int] | Mapping[int, int]) -> bool:
    return set(values) <= set(range(CHANNELS))


class Switches:
    """Switches that last, through reboots too, until they are taken back; set from any thread."""

    send_heartbeat = Switch(True)
    """False: no heartbeats, and no answers to node guarding; data go on."""
    send_data = Switch(True)
    """False: no TPDOs; heartbeats go on."""
    frame_bytes: Switch[int | None] = Switch(
        None, lambda n: n is None or 0 <= n <= 8, "a number of bytes, 0 to 8, or None"
    )
    """Length of its TPDOs, whatever their mapping says."""
    line: Switch[Line | None] = Switch(None)
    """What becomes of its frames on the way."""
    held: Switch[Mapping[int, int]] = Switch(MappingProxyType({}), _are_channels, "channels from 0 to 3")
    """Channel (0-3) -> count that this channel shows whatever it measures."""
    dead: Switch[AbstractSet[int]] = Switch(frozenset(), _are_channels, "electrodes from 0 to 3")
    """Electrodes (0-3, in the sampler's order) whose wire is broken: noise is left of their currents."""
    wired: Switch[Sequence[int]] = Switch(
        STRAIGHT, lambda w: len(w) == CHANNELS and _are_channels(w), "four electrodes from 0 to 3"
    )
    """The electrode (0-3) that each of the four inputs is connected to."""

    def refresh(self) -> None:
        """A switch was set."""
        raise NotImplementedError
