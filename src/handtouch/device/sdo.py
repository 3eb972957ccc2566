"""SDO server of a node: canopen's, with injected faults."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from typing import Any, Literal

from canopen.sdo import SdoServer
from canopen.sdo import constants as sdo

from handtouch.canbus import cia301
from handtouch.device.object_values import Address, ObjectValues

GarbleMode = Literal["toggle", "object", "noise"]

_COMMANDS_WITH_OBJECT = (
    sdo.REQUEST_DOWNLOAD,
    sdo.REQUEST_UPLOAD,
    sdo.REQUEST_BLOCK_UPLOAD,
    sdo.REQUEST_BLOCK_DOWNLOAD,
)
_SEGMENT_COMMANDS = (sdo.REQUEST_SEGMENT_DOWNLOAD, sdo.REQUEST_SEGMENT_UPLOAD)
_COMMAND_MASK = 0xE0


class DeviceSdoServer:
    """SDO server with fault switches, which stay set until they are cleared:

    `frozen` : no responses
    `fail` : object -> abort code in response to every request for it, None for no response
    `fail_write` : the same for downloads only
    `fail_nth` : number of a request, as counted by `requests` -> abort code or None, as in `fail`
    `garble` : wrong responses: "toggle" bits of segments, the "object" named, or "noise" for all bytes

    `requests` counts the requests received, segments included; `fail_nth[requests + 1]` is the next one.
    """

    def __init__(self, node_id: int, objects: ObjectValues, send: Callable[[int, bytes], None]) -> None:
        self.frozen = False
        self.fail: dict[Address, int | None] = {}
        self.fail_write: dict[Address, int | None] = {}
        self.fail_nth: dict[int, int | None] = {}
        self.garble: GarbleMode | None = None
        self.requests = 0
        self._objects, self._send = objects, send
        self._node_id = node_id
        self._noise = random.Random(node_id)
        self.reset()

    def reset(self) -> None:
        """Abandon the transfer in progress."""
        self._server: Any = SdoServer(
            cia301.SDO_REQUEST + self._node_id, cia301.SDO_RESPONSE + self._node_id, self._objects
        )
        self._server.network = self
        self._server._index = self._server._subindex = 0  # its abort messages need numbers

    def handle_request(self, data: bytes) -> None:
        """Handle a request of 8 bytes."""
        control = data[0] & _COMMAND_MASK
        if control == sdo.REQUEST_ABORTED:
            self.reset()
            return
        self.requests += 1
        if control in _COMMANDS_WITH_OBJECT:
            self._server._index, self._server._subindex = struct.unpack_from("<HB", data, 1)
            self._server._buffer = None
        if self.frozen:
            return
        fault = self._injected_fault(control)
        if fault is None:
            if control in _SEGMENT_COMMANDS and self._server._buffer is None:
                fault = sdo.ABORT_INVALID_COMMAND_SPECIFIER  # no transfer in progress
            else:
                self._server.on_request(cia301.SDO_REQUEST + self._node_id, data, 0.0)
                return
        if fault != _SILENCE:
            self._server.abort(fault)
            self._server._buffer = None

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:  # noqa: ARG002
        """Send a response; called by canopen's server as its network."""
        self._send(can_id, bytes(data) if self.garble is None else self._garbled(bytearray(data)))

    def _injected_fault(self, control: int) -> int | None:
        """Return the abort code or _SILENCE; None for a regular response."""
        address = (self._server._index, self._server._subindex)
        if self.requests in self.fail_nth:
            code = self.fail_nth[self.requests]
        elif control in _COMMANDS_WITH_OBJECT and address in self.fail:
            code = self.fail[address]
        elif control == sdo.REQUEST_DOWNLOAD and address in self.fail_write:
            code = self.fail_write[address]
        else:
            return None
        return _SILENCE if code is None else code

    def _garbled(self, data: bytearray) -> bytes:
        segment = data[0] & _COMMAND_MASK in (sdo.RESPONSE_SEGMENT_UPLOAD, sdo.RESPONSE_SEGMENT_DOWNLOAD)
        if self.garble == "noise":
            return self._noise.randbytes(8)
        if self.garble == "toggle" and segment:
            data[0] ^= sdo.TOGGLE_BIT
        elif self.garble == "object" and not segment:
            data[1] ^= 0xFF
        return bytes(data)


_SILENCE = -1
