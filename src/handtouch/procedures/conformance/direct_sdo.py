"""SDO client that waits for the response in the calling thread, and reports every violation of the protocol.

Public names: `DirectSdoClient`, `NoResponseError`, `InvalidResponseError`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Protocol

from canopen.sdo import SdoAbortedError, SdoCommunicationError

from handtouch.canbus import cia301
from handtouch.canbus.objects.sdo import MAX_SDO_ATTEMPTS, SDO_TIMEOUT_S, BootStepError

_HEAD = struct.Struct("<BHB")
_COMMAND, _ABORT, _UPLOAD, _DOWNLOAD = 0xE0, 0x80, 0x40, 0x60
_TOGGLE = 0x10
_MAX_BYTES = 4096
_TOGGLE_ABORT = 0x05030000


class NoResponseError(SdoCommunicationError):  # type: ignore[misc]  # canopen has no types
    """The node didn't respond in time."""


class InvalidResponseError(SdoCommunicationError):  # type: ignore[misc]
    """The response violates the protocol."""


class SdoExchange(Protocol):
    """Send a request of eight bytes; return the response, None if there is none in time."""

    def __call__(self, request: bytes, /) -> bytes | None: ...


class DirectSdoClient:
    """Uploads of any length and downloads of up to four bytes, without retries.

    `violations` : texts of the invalid responses; `lost` : number of requests without a response

    It is the transport of a `NodeSdoClient`, too. `upload` and `download` raise SdoAbortedError for an abort,
    NoResponseError, or InvalidResponseError.
    """

    def __init__(self, exchange: SdoExchange) -> None:
        self.violations: list[str] = []
        self.lost = 0
        self._exchange = exchange

    def upload(self, index: int, sub: int) -> bytes:
        """Read an object."""
        response = self._request(_HEAD.pack(_UPLOAD, index, sub) + bytes(4), _UPLOAD, _name(index, sub))
        command = response[0]
        if command & 2:
            return response[4 : 8 - (command >> 2 & 3)] if command & 1 else response[4:]
        size = int.from_bytes(response[4:], "little") if command & 1 else None
        return self._upload_segments(index, sub, size)

    def download(self, index: int, sub: int, data: bytes) -> None:
        """Write an object of one to four bytes."""
        if not 1 <= len(data) <= 4:
            raise ValueError(f"need one to four bytes, got {len(data)}")
        request = _HEAD.pack(0x23 | 4 - len(data) << 2, index, sub) + data.ljust(4, b"\0")
        self._request(request, _DOWNLOAD, _name(index, sub))

    def transfer(
        self,
        index: int,  # noqa: ARG002 - the description has it
        sub: int,  # noqa: ARG002
        description: str,
        run: Callable[[DirectSdoClient], bytes | None],
        is_cancelled: Callable[[], bool],  # noqa: ARG002 - nothing cancels a transfer here
    ) -> bytes | None:
        """Run an upload or download of a `NodeSdoClient`, with one retry. Raises BootStepError."""
        error: SdoCommunicationError | None = None
        for _ in range(MAX_SDO_ATTEMPTS):
            try:
                return run(self)
            except SdoAbortedError as abort:
                raise BootStepError(f"{description}: refused by the node ({abort})") from abort
            except SdoCommunicationError as failure:
                error = failure
        raise BootStepError(f"{description}: {error}", timed_out=True) from error

    def _upload_segments(self, index: int, sub: int, size: int | None) -> bytes:
        name, data, toggle = _name(index, sub), b"", 0
        while len(data) <= _MAX_BYTES:
            response = self._response(bytes((0x60 | toggle,)) + bytes(7), name)
            if response[0] & _COMMAND or response[0] & _TOGGLE != toggle:
                self._exchange(_HEAD.pack(_ABORT, index, sub) + _TOGGLE_ABORT.to_bytes(4, "little"))
                raise self._invalid(name, f"{response.hex(' ')} as segment with toggle bit {toggle >> 4}")
            data += response[1 : 8 - (response[0] >> 1 & 7)]
            if response[0] & 1:
                if size is not None and size != len(data):
                    raise self._invalid(name, f"{len(data)} bytes in segments, {size} announced")
                return data
            toggle ^= _TOGGLE
        raise self._invalid(name, f"more than {_MAX_BYTES} bytes in segments")

    def _request(self, request: bytes, command: int, name: str) -> bytes:
        """Send the first request of a transfer and return its valid response."""
        response = self._response(request, name)
        if response[1:4] != request[1:4]:
            raise self._invalid(name, f"response for another object, {response.hex(' ')}")
        if response[0] & _COMMAND != command:
            raise self._invalid(name, f"invalid response {response.hex(' ')}")
        return response

    def _response(self, request: bytes, name: str) -> bytes:
        """Send a request and return a response of eight bytes that isn't an abort."""
        response = self._exchange(request)
        if response is None:
            self.lost += 1
            raise NoResponseError(f"no response within {SDO_TIMEOUT_S * 1e3:.0f} ms")
        if len(response) != cia301.SDO_BYTES:
            raise self._invalid(name, f"response of {len(response)} bytes")
        if response[0] == _ABORT and response[1:4] in (request[1:4], bytes(3)):
            raise SdoAbortedError(int.from_bytes(response[4:], "little"))
        return response

    def _invalid(self, name: str, text: str) -> InvalidResponseError:
        self.violations.append(f"{name}: {text}")
        return InvalidResponseError(text)


def _name(index: int, sub: int) -> str:
    return f"0x{index:04X}:{sub:02X}"
