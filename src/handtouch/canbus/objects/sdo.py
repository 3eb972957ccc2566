"""SDO client of one node: read and write unsigned objects; errors name the object.

Public names: `NodeSdoClient`, `ObjectTransport`, `SdoTransport`, `BootStepError`, `BootStepCancelled`.
Transfers block until the node responds, so they run in a worker thread of the master;
`SdoTransport.deliver_response` passes the node's responses on from the receiving thread.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from typing import Any, Protocol

from canopen import ObjectDictionary
from canopen.sdo import SdoAbortedError, SdoClient, SdoCommunicationError

from handtouch.canbus import cia301
from handtouch.config.channels import WritableObject

SDO_TIMEOUT_S = 0.2
MAX_SDO_ATTEMPTS = 2
"""A lost frame costs one timeout; a node that responds to neither attempt is silent."""

_MAX_RECEIVER_POLLS = 20
_TPDO_PARAMETERS = {
    1: "COB-ID",
    2: "transmission type",
    3: "inhibit time",
    5: "event timer",
    cia301.SYNC_START_SUB: "SYNC start value",
}
_MAX_LATE_RESPONSES = 4
_COMMAND_MASK, _ABORT = 0xE0, 0x80
_UPLOAD, _DOWNLOAD = 0x40, 0x60
_COMMANDS_WITH_OBJECT = (_UPLOAD, _DOWNLOAD, _ABORT)  # responses with index and sub-index
_INITIATE_RESPONSES = {0x40: _UPLOAD, 0x20: _DOWNLOAD}
"""Command of the first response, by that of the request; a segment's isn't one of them."""
_NO_OBJECT_ABORT_CODES = frozenset({0x06020000, 0x06090011, 0x060A0023, 0x08000024})


class BootStepError(Exception):
    """A step of a node's boot failed; `str` is the reason.

    `timed_out`: the node didn't respond. `wrong_device`: it is not the configured node.
    """

    def __init__(self, reason: str, *, timed_out: bool = False, wrong_device: bool = False) -> None:
        super().__init__(reason)
        self.timed_out = timed_out
        self.wrong_device = wrong_device


class BootStepCancelled(Exception):  # noqa: N818 - not an error: the node's state has changed meanwhile
    """The boot attempt that a step belongs to has ended."""


class ObjectTransport(Protocol):
    """Runs transfers of one node's objects; `run` gets a client with canopen's `upload` and `download`."""

    def transfer(
        self,
        index: int,
        sub: int,
        description: str,
        run: Callable[[Any], bytes | None],
        is_cancelled: Callable[[], bool],
    ) -> bytes | None:
        """Run an upload or download. Raises BootStepError, or BootStepCancelled."""


class _SdoNetwork:
    """The part of a canopen network that its SDO client uses; `command` is that of the latest request
    that isn't an abort."""

    def __init__(self, send: Callable[[int, bytes], bool]) -> None:
        self._send = send
        self.command = 0

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:  # noqa: ARG002
        command = data[0] & _COMMAND_MASK
        self.command = self.command if command == _ABORT else command
        self._send(can_id, bytes(data))


class _SdoClient(SdoClient):  # type: ignore[misc]  # canopen has no types
    """canopen's client, whose timeout expires only once the frames that arrived before it have been read.

    `responded`: to a request of this attempt. `late_responses`: to earlier requests, so far; a node that
    sends one is about to respond, and the timeout starts again.
    """

    received_until_ns: Callable[[], int] | None = None
    is_of_another_request: Callable[[bytes], bool]
    responded = False
    late_responses = 0

    def read_response(self) -> bytes:
        most = self.late_responses + _MAX_LATE_RESPONSES
        while True:
            late_before = self.late_responses
            try:
                response = self._read_received()
            except SdoCommunicationError:
                if self.late_responses == late_before or self.late_responses > most:
                    raise
                continue
            if not self.is_of_another_request(response) or self.late_responses > most:
                self.responded = True
                return response
            self.late_responses += 1  # passed on while the request before it ended

    def _read_received(self) -> bytes:
        deadline_ns = time.monotonic_ns() + round(self.RESPONSE_TIMEOUT * 1e9)
        try:
            return bytes(super().read_response())
        except SdoCommunicationError:
            if self.received_until_ns is None or not self._wait_for_receiver(deadline_ns):
                raise
            return bytes(super().read_response())

    def _wait_for_receiver(self, deadline_ns: int) -> bool:
        """Wait while the receiving thread is behind the deadline, for one more timeout at most.

        Return True if a response has come.
        """
        assert self.received_until_ns is not None
        for _ in range(_MAX_RECEIVER_POLLS):
            if not self.responses.empty() or self.received_until_ns() >= deadline_ns:
                break
            time.sleep(self.RESPONSE_TIMEOUT / _MAX_RECEIVER_POLLS)
        return not self.responses.empty()


class SdoTransport:
    """SDO channel of one node: one transfer at a time, responses from another thread.

    `received_until_ns` returns the time before which all arrived frames have been read, None: unknown.
    """

    def __init__(
        self,
        node_id: int,
        send: Callable[[int, bytes], bool],
        timeout_s: float | None = None,
        received_until_ns: Callable[[], int] | None = None,
    ) -> None:
        self._client = _SdoClient(
            cia301.SDO_REQUEST + node_id, cia301.SDO_RESPONSE + node_id, ObjectDictionary()
        )
        self._client.received_until_ns = received_until_ns
        self._client.is_of_another_request = self._is_of_another_request
        self._client.network = self._network = _SdoNetwork(send)
        self._client.RESPONSE_TIMEOUT = self._timeout_s = SDO_TIMEOUT_S if timeout_s is None else timeout_s
        self.awaiting_response = False
        self.responses = 0
        """responses received so far, invalid ones included"""
        self._dropped: bytes | None = None
        self._object = bytes(3)
        self._requested: set[bytes] = set()

    def deliver_response(self, data: bytes) -> None:
        """Pass on a response, from the receiving thread, while `awaiting_response`.

        A response for another object, or to an upload after a download, is dropped: it is late, or answers a
        probe or another master; so is one of another length than 8 bytes. The reason of a timeout has the
        latest one dropped.
        """
        self.responses += 1
        if len(data) == cia301.SDO_BYTES and not self._is_of_another_request(data):
            self._client.on_response(0, data, 0.0)
            return
        self._client.late_responses += self._is_late(data)
        self._dropped = data

    def _is_of_another_request(self, data: bytes) -> bool:
        command = data[0] & _COMMAND_MASK
        if command in _COMMANDS_WITH_OBJECT and data[1:4] not in (self._object, bytes(3)):
            return True
        expected = _INITIATE_RESPONSES.get(self._network.command)
        return command in (_UPLOAD, _DOWNLOAD) and command != expected

    def _is_late(self, data: bytes) -> bool:
        return len(data) == cia301.SDO_BYTES and data[1:4] in self._requested

    def transfer(
        self,
        index: int,
        sub: int,
        description: str,
        run: Callable[[SdoClient], bytes | None],
        is_cancelled: Callable[[], bool],
    ) -> bytes | None:
        """Run an upload or download, with one retry; `description` is for the error text.

        Raises BootStepError, or BootStepCancelled if `is_cancelled` is true before an attempt.
        """
        self._object = index.to_bytes(2, "little") + bytes((sub,))
        self._requested.add(self._object)
        timeout: SdoCommunicationError | None = None
        self._dropped = None
        for _ in range(MAX_SDO_ATTEMPTS):
            if is_cancelled():
                raise BootStepCancelled
            self._client.responded = False
            self.awaiting_response = True
            try:
                return run(self._client)
            except SdoAbortedError as error:
                raise BootStepError(f"{description}: refused by the node ({error})") from error
            except SdoCommunicationError as error:
                if self._client.responded:
                    silent = isinstance(error.__context__, queue.Empty)
                    cause = (
                        f"no answer within {self._timeout_s * 1e3:.0f} ms after the first segments"
                        if silent
                        else f"invalid SDO response: {error}; a firmware fault, or two nodes with this id"
                    )
                    raise BootStepError(f"{description}: {cause}") from error
                timeout = error
            finally:
                self.awaiting_response = False
        limit = f"within {self._timeout_s * 1e3:.0f} ms in {MAX_SDO_ATTEMPTS} attempts"
        cause = self._explain_silence(limit)
        raise BootStepError(f"{description}: {cause}", timed_out=True) from timeout

    def _explain_silence(self, limit: str) -> str:
        """Return why a request has no answer, by the latest response dropped meanwhile."""
        dropped = self._dropped
        if dropped is None:
            return f"no answer {limit}; is its SDO server running, the bus overloaded?"
        if self._is_late(dropped) and dropped[1:4] != self._object:
            index, sub = int.from_bytes(dropped[1:3], "little"), dropped[3]
            return (
                f"no answer {limit}, but a late one to an earlier request, 0x{index:04X}:{sub:02X}; "
                "is the node, the bus or this host overloaded?"
            )
        expected = cia301.SDO_BYTES
        size = "" if len(dropped) == expected else f", {len(dropped)} bytes instead of {expected}"
        return f"no valid SDO response {limit}; received: {dropped.hex(' ') or 'no data'}{size}"


def _tpdo_parameter(number: int, sub: int) -> tuple[int, int, str]:
    """Return index, sub-index and name of a parameter of a TPDO."""
    return cia301.TPDO_COMMUNICATION + number - 1, sub, f"{_TPDO_PARAMETERS[sub]} of TPDO{number}"


def _never_cancelled() -> bool:
    return False


class NodeSdoClient:
    """Unsigned objects of one node; every method raises BootStepError, or BootStepCancelled."""

    def __init__(
        self, transport: ObjectTransport, is_cancelled: Callable[[], bool] = _never_cancelled
    ) -> None:
        self._transport = transport
        self.is_cancelled = is_cancelled

    def read(self, index: int, sub: int, name: str, size: int | None = None) -> int:
        """Read an object, of `size` bytes where that isn't stated by CiA 301; what follows them is
        ignored."""
        data = self._transfer(index, sub, f"reading {name}", lambda c: c.upload(index, sub))
        return int.from_bytes((data or b"")[: size or cia301.object_bytes(index, sub)], "little")

    def read_optional(self, index: int, sub: int, name: str) -> int | None:
        """Read an object; None if the node doesn't have it."""
        try:
            return self.read(index, sub, name)
        except BootStepError as error:
            cause = error.__cause__
            if isinstance(cause, SdoAbortedError) and cause.code in _NO_OBJECT_ABORT_CODES:
                return None
            raise

    def read_if_present(self, index: int, sub: int, name: str, needed: bool = False) -> int | None:
        """Read an object that CiA 301 doesn't require; None if the node refuses, or answers everything but
        it.

        With `needed` a second time-out raises: the node may be busy.
        """
        try:
            return self.read_or_none(index, sub, name)
        except BootStepError as error:
            if not error.timed_out:
                raise
        try:  # a second time: frames may have been lost
            return self.read_or_none(index, sub, name)
        except BootStepError as error:
            if error.timed_out and not needed:
                return None
            raise

    def read_or_none(self, index: int, sub: int, name: str) -> int | None:
        """Read an object that the node's operation doesn't depend on; None if the node refuses."""
        try:
            return self.read(index, sub, name)
        except BootStepError as error:
            if isinstance(error.__cause__, SdoAbortedError):
                return None
            raise

    def write_verified(self, index: int, sub: int, value: int, name: str, size: int | None = None) -> None:
        """Write an object and read it back; `size` as in `read`."""
        size = size or cia301.object_bytes(index, sub)
        assert size is not None
        data = value.to_bytes(size, "little")
        self._transfer(index, sub, f"writing {name}", lambda c: c.download(index, sub, data))
        actual = self.read(index, sub, name, size)
        if actual != value:
            raise BootStepError(f"{name}, 0x{index:04X}:{sub:02X}, was set to {value} but reads {actual}")

    def write_if_different(
        self, index: int, sub: int, value: int, name: str, size: int | None = None
    ) -> None:
        """Write and verify an object unless it has the value already."""
        if self.read(index, sub, name, size) != value:
            self.write_verified(index, sub, value, name, size)

    def set_object(self, target: WritableObject, value: int, name: str) -> None:
        """Write and verify an object of the deployment unless it has the value already."""
        self.write_if_different(target.index, target.sub, value, name, target.size_bytes)

    def read_tpdo(self, number: int, sub: int) -> int:
        """Read a parameter of a TPDO, 0x1800 + n."""
        return self.read(*_tpdo_parameter(number, sub))

    def write_tpdo(self, number: int, sub: int, value: int) -> None:
        """Write a parameter of a TPDO and read it back."""
        index, sub, name = _tpdo_parameter(number, sub)
        self.write_verified(index, sub, value, name)

    def _transfer(
        self, index: int, sub: int, description: str, run: Callable[[SdoClient], bytes | None]
    ) -> bytes | None:
        description += f", 0x{index:04X}:{sub:02X}"
        return self._transport.transfer(index, sub, description, run, self.is_cancelled)
