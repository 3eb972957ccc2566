"""The SDO server of a node: canopen's, and what can go wrong with one."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from typing import Any, Literal

from canopen.sdo import SdoServer
from canopen.sdo import constants as sdo

from .objects import Address, Objects

Garble = Literal["toggle", "object", "noise"]

_REQUEST, _ANSWER = 0x600, 0x580
_NAMES_OBJECT = (
    sdo.REQUEST_DOWNLOAD,
    sdo.REQUEST_UPLOAD,
    sdo.REQUEST_BLOCK_UPLOAD,
    sdo.REQUEST_BLOCK_DOWNLOAD,
)
_SEGMENTS = (sdo.REQUEST_SEGMENT_DOWNLOAD, sdo.REQUEST_SEGMENT_UPLOAD)
_CONTROL = 0xE0


class Server:
    """Answers requests. Its switches last until they are taken back:

    `frozen` : answers nothing
    `fail` : object -> abort code with which every request for it is answered, None for silence
    `fail_write` : the same for writing alone; the object can be read
    `fail_nth` : number of a request, as `requests` counts them -> abort code or None, as in `fail`
    `garble` : answers are wrong: "toggle" bits of segments, the "object" that they name, or all is "noise"

    `requests` counts the requests that came, segments too; `fail_nth[requests + 1]` is the next one.
    """

    def __init__(self, node_id: int, objects: Objects, send: Callable[[int, bytes], None]) -> None:
        self.frozen = False
        self.fail: dict[Address, int | None] = {}
        self.fail_write: dict[Address, int | None] = {}
        self.fail_nth: dict[int, int | None] = {}
        self.garble: Garble | None = None
        self.requests = 0
        self._objects, self._send = objects, send
        self._node_id = node_id
        self._noise = random.Random(node_id)
        self.reset()

    def reset(self) -> None:
        """Forget the transfer that is going on."""
        self._server: Any = SdoServer(_REQUEST + self._node_id, _ANSWER + self._node_id, self._objects)
        self._server.network = self
        self._server._index = self._server._subindex = 0  # its abort messages fail on None

    def request(self, data: bytes) -> None:
        """A request of 8 bytes."""
        control = data[0] & _CONTROL
        if control == sdo.REQUEST_ABORTED:
            self.reset()
            return
        self.requests += 1
        if control in _NAMES_OBJECT:
            self._server._index, self._server._subindex = struct.unpack_from("<HB", data, 1)
            self._server._buffer = None
        if self.frozen:
            return
        fault = self._fault(control)
        if fault is None:
            if control in _SEGMENTS and self._server._buffer is None:
                fault = sdo.ABORT_INVALID_COMMAND_SPECIFIER  # of no transfer
            else:
                self._server.on_request(_REQUEST + self._node_id, data, 0.0)
                return
        if fault != _SILENCE:
            self._server.abort(fault)
            self._server._buffer = None

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:  # noqa: ARG002
        """What canopen's server asks of its network."""
        self._send(can_id, bytes(data) if self.garble is None else self._garbled(bytearray(data)))

    def _fault(self, control: int) -> int | None:
        """Abort code or _SILENCE; None to answer as usual."""
        address = (self._server._index, self._server._subindex)
        if self.requests in self.fail_nth:
            code = self.fail_nth[self.requests]
        elif control in _NAMES_OBJECT and address in self.fail:
            code = self.fail[address]
        elif control == sdo.REQUEST_DOWNLOAD and address in self.fail_write:
            code = self.fail_write[address]
        else:
            return None
        return _SILENCE if code is None else code

    def _garbled(self, data: bytearray) -> bytes:
        segment = data[0] & _CONTROL in (sdo.RESPONSE_SEGMENT_UPLOAD, sdo.RESPONSE_SEGMENT_DOWNLOAD)
        if self.garble == "noise":
            return self._noise.randbytes(8)
        if self.garble == "toggle" and segment:
            data[0] ^= sdo.TOGGLE_BIT
        elif self.garble == "object" and not segment:
            data[1] ^= 0xFF
        return bytes(data)


_SILENCE = -1
