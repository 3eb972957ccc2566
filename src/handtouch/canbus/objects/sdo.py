"""SDO client of one node: read and write unsigned objects, with the object named in whatever goes wrong.

Public names: `Sdo`, `StepError`, `Outdated`. Transfers block until the node answers, so they run in a worker
thread of the master; `Sdo.deliver` brings them the answers from the thread that receives.
"""

from __future__ import annotations

from collections.abc import Callable

from canopen import ObjectDictionary
from canopen.sdo import SdoAbortedError, SdoClient, SdoCommunicationError

SDO_TIMEOUT_S = 0.2
SDO_ATTEMPTS = 2
"""A lost frame costs one time-out; a node that answers neither attempt is silent."""

_NAMES_OBJECT = (0x40, 0x60, 0x80)  # SDO answers with index and sub-index: upload, download, abort
_NOT_THERE = frozenset({0x06020000, 0x06090011, 0x060A0023, 0x08000024})  # abort codes


class StepError(Exception):
    """A step of a node's start failed; `str` is the reason in words.

    `silent`: no answer came. `stranger`: it is not the configured node.
    """

    def __init__(self, reason: str, *, silent: bool = False, stranger: bool = False) -> None:
        super().__init__(reason)
        self.silent = silent
        self.stranger = stranger


class Outdated(Exception):  # noqa: N818 - not an error: the node has moved on and nobody waits for this any more
    """The attempt that a step belongs to is over."""


class _Link:
    """What canopen's SDO client asks of its network."""

    def __init__(self, send: Callable[[int, bytes], bool]) -> None:
        self._send = send

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:  # noqa: ARG002
        self._send(can_id, bytes(data))


class Sdo:
    """SDO client of one node. `read` and `write` raise StepError with the object named, or Outdated."""

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
        except StepError as error:
            if isinstance(error.__cause__, SdoAbortedError) and error.__cause__.code in _NOT_THERE:
                return None
            raise

    def write(self, index: int, sub: int, value: int, size: int, what: str) -> None:
        """Set an unsigned object of `size` bytes and read it back."""
        data = value.to_bytes(size, "little")
        self._transfer(index, sub, f"writing {what}", lambda c: c.download(index, sub, data))
        kept = self.read(index, sub, what)
        if kept != value:
            raise StepError(f"{what}, 0x{index:04X}:{sub:02X}, was set to {value} but reads {kept}")

    def set(self, index: int, sub: int, value: int, size: int, what: str) -> None:
        """As `write`, but only if it isn't so already."""
        if self.read(index, sub, what) != value:
            self.write(index, sub, value, size, what)

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
                raise StepError(f"{doing}: refused by the node ({error})") from error
            except SdoCommunicationError as error:
                if self._answered:
                    raise StepError(f"{doing}: {error}") from error
                silence = error
            finally:
                self.waiting = False
        told = (
            f"{doing}: no answer within {SDO_TIMEOUT_S * 1e3:.0f} ms, asked {SDO_ATTEMPTS} times; "
            "is its SDO server running, the bus overloaded?"
        )
        raise StepError(told, silent=True) from silence
