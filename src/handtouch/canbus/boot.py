"""What the master does to a node over SDO when it boots it: identify, read the PDO mapping, configure.

These block until the node answers, so they run in the master's worker thread; `Sdo.deliver` brings them the
answers from the thread that receives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from canopen import ObjectDictionary
from canopen.sdo import SdoAbortedError, SdoClient, SdoCommunicationError

from .eds import ANALOGUE_INPUT

SDO_TIMEOUT_S = 0.2
SDO_ATTEMPTS = 2
"""A lost frame costs one time-out; a node that answers neither attempt is silent."""
SYNCHRONOUS = 1
"""Transmission type: with every SYNC."""
CHANNELS = tuple(ANALOGUE_INPUT << 16 | sub << 8 | 16 for sub in (1, 2, 3, 4))
"""The PDO mapping wanted: 0x6401 sub 1 to 4, 16 bits each, in this order."""

_IDENTITY, _HEARTBEAT, _COMMUNICATION, _MAPPING = 0x1018, 0x1017, 0x1800, 0x1A00
_NOT_VALID, _EXTENDED, _IDENTIFIER = 1 << 31, 1 << 29, 0x7FF
_NAMES_OBJECT = (0x40, 0x60, 0x80)  # SDO answers with index and sub-index: upload, download, abort
_NOT_THERE = frozenset({0x06020000, 0x06090011, 0x060A0023, 0x08000024})  # SDO abort codes


class BootError(Exception):
    """A step failed; `str` is the reason in words."""

    def __init__(self, reason: str, *, silent: bool = False, stranger: bool = False) -> None:
        super().__init__(reason)
        self.silent = silent
        self.stranger = stranger


class Outdated(Exception):  # noqa: N818 - not an error: the node has moved on and nobody waits for this any more
    """The attempt that a step belongs to is over."""


@dataclass(frozen=True, slots=True)
class Identity:
    """Object 0x1018; None where the node hasn't the sub-index."""

    vendor_id: int
    product_code: int | None = None
    revision: int | None = None
    serial: int | None = None


@dataclass(frozen=True, slots=True)
class Expected:
    """What the configuration says of a node; None is not checked."""

    vendor_id: int | None = None
    product_code: int | None = None
    serial: int | None = None


@dataclass(frozen=True, slots=True)
class Tpdo:
    """The TPDO that carries the four channels, as the node has it."""

    number: int
    cob_id: int
    enabled: bool
    transmission: int


class _Link:
    """What canopen's SDO client asks of its network."""

    def __init__(self, send: Callable[[int, bytes], bool]) -> None:
        self._send = send

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:  # noqa: ARG002
        self._send(can_id, bytes(data))


class Sdo:
    """SDO client of one node. `read` and `write` raise BootError with the object named, or Outdated."""

    def __init__(self, node_id: int, send: Callable[[int, bytes], bool]) -> None:
        self._client = SdoClient(0x600 + node_id, 0x580 + node_id, ObjectDictionary())
        self._client.network = _Link(send)
        self._client.RESPONSE_TIMEOUT = SDO_TIMEOUT_S
        self.waiting = False
        self._answered = False
        self._object = bytes(3)
        self.outdated: Callable[[], bool] = lambda: False

    def deliver(self, data: bytes) -> None:
        """An answer of the node, 8 bytes; from the receiving thread, while `waiting`.

        One for another object is dropped: it answers a probe, another master, or came too late.
        """
        if data[0] & 0xE0 in _NAMES_OBJECT and data[1:4] not in (self._object, bytes(3)):
            return
        self._answered = True
        self._client.on_response(0, data, 0.0)

    def read(self, index: int, sub: int, what: str) -> int:
        """Value of an unsigned object."""
        data = self._transfer(index, sub, f"reading {what}", lambda c: c.upload(index, sub))
        return int.from_bytes(data or b"", "little")

    def read_optional(self, index: int, sub: int, what: str) -> int | None:
        """As `read`; None where the node hasn't got the object."""
        try:
            return self.read(index, sub, what)
        except BootError as error:
            if isinstance(error.__cause__, SdoAbortedError) and error.__cause__.code in _NOT_THERE:
                return None
            raise

    def write(self, index: int, sub: int, value: int, size: int, what: str) -> None:
        """Set an unsigned object of `size` bytes and read it back."""
        data = value.to_bytes(size, "little")
        self._transfer(index, sub, f"writing {what}", lambda c: c.download(index, sub, data))
        kept = self.read(index, sub, what)
        if kept != value:
            raise BootError(f"{what}, 0x{index:04X}:{sub:02X}, was set to {value} but reads {kept}")

    def _transfer(
        self, index: int, sub: int, doing: str, transfer: Callable[[SdoClient], bytes | None]
    ) -> bytes | None:
        doing += f", 0x{index:04X}:{sub:02X}"
        self._object = index.to_bytes(2, "little") + bytes((sub,))
        silence: SdoCommunicationError | None = None
        for _ in range(SDO_ATTEMPTS):
            if self.outdated():
                raise Outdated
            self._answered = False
            self.waiting = True
            try:
                return transfer(self._client)
            except SdoAbortedError as error:
                raise BootError(f"{doing}: refused by the node ({error})") from error
            except SdoCommunicationError as error:
                if self._answered:
                    raise BootError(f"{doing}: {error}") from error
                silence = error
            finally:
                self.waiting = False
        told = (
            f"{doing}: no answer within {SDO_TIMEOUT_S * 1e3:.0f} ms, asked {SDO_ATTEMPTS} times; "
            "is its SDO server running, the bus overloaded?"
        )
        raise BootError(told, silent=True) from silence


def identify(sdo: Sdo, expected: Expected) -> Identity:
    """Read 0x1018. Raises BootError where it differs from what is expected."""
    identity = Identity(
        sdo.read(_IDENTITY, 1, "vendor id"),
        sdo.read_optional(_IDENTITY, 2, "product code"),
        sdo.read_optional(_IDENTITY, 3, "revision"),
        sdo.read_optional(_IDENTITY, 4, "serial number"),
    )
    for what, key, found, wanted in (
        ("vendor id", "vendor_id", identity.vendor_id, expected.vendor_id),
        ("product code", "product_code", identity.product_code, expected.product_code),
        ("serial number", "serial", identity.serial, expected.serial),
    ):
        if wanted is not None and found != wanted:
            told = "none" if found is None else f"{found} (0x{found:X})"
            raise BootError(
                f"another device: {what} is {told}, configured is {wanted} (0x{wanted:X}); "
                f"put the right node there, or correct {key} in the deployment",
                stranger=True,
            )
    return identity


def read_mapping(sdo: Sdo, numbers: Sequence[int]) -> Tpdo:
    """Find the TPDO that carries the four channels, among those numbers in this order.

    Raises BootError telling what there is instead where none does.
    """
    seen = []
    for number in numbers:
        index = _MAPPING + number - 1
        count = sdo.read_optional(index, 0, f"mapping of TPDO{number}")
        if count is None:
            continue
        entries = tuple(
            sdo.read(index, sub, f"mapping of TPDO{number}") for sub in range(1, min(count, 64) + 1)
        )
        if entries == CHANNELS:
            return _communication(sdo, number)
        seen.append(f"TPDO{number} has {', '.join(map(_entry, entries)) or 'nothing'}")
    raise BootError(
        "no TPDO carries 0x6401:01 to :04 as four 16-bit values in this order: "
        + ("; ".join(seen) or "the node has no TPDO")
        + "; map them in the node, and store the mapping"
    )


def configure(sdo: Sdo, tpdo: Tpdo, heartbeat_ms: int, halt: Callable[[], None]) -> None:
    """Set what differs: PDO enabled and synchronous, heartbeat time; each is read back.

    `halt` makes the node pre-operational; called only if a PDO must be changed, which many nodes refuse
    while they run.
    """
    index = _COMMUNICATION + tpdo.number - 1
    if not tpdo.enabled or tpdo.transmission != SYNCHRONOUS:
        halt()
    if tpdo.transmission != SYNCHRONOUS:
        sdo.write(index, 2, SYNCHRONOUS, 1, f"transmission type of TPDO{tpdo.number}")
    if not tpdo.enabled:
        sdo.write(index, 1, tpdo.cob_id, 4, f"identifier of TPDO{tpdo.number}")
    if sdo.read(_HEARTBEAT, 0, "heartbeat time") != heartbeat_ms:
        sdo.write(_HEARTBEAT, 0, heartbeat_ms, 2, "heartbeat time")


def _communication(sdo: Sdo, number: int) -> Tpdo:
    index = _COMMUNICATION + number - 1
    cob_id = sdo.read(index, 1, f"identifier of TPDO{number}")
    if cob_id & _EXTENDED or not cob_id & _IDENTIFIER:
        raise BootError(f"TPDO{number} has no 11-bit identifier (0x{index:04X}:01 is 0x{cob_id:08X})")
    transmission = sdo.read(index, 2, f"transmission type of TPDO{number}")
    return Tpdo(number, cob_id & _IDENTIFIER, not cob_id & _NOT_VALID, transmission)


def _entry(entry: int) -> str:
    return f"0x{entry >> 16:04X}:{entry >> 8 & 0xFF:02X} ({entry & 0xFF} bit)"
