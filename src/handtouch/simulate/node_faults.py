"""Faults of a pad's node, as tables of a scenario file: its errors, and its behaviour on the bus.

A fault class declares its `kind`, the keys of its `[[node_fault]]` table, and how it begins and ends.
Public names: `NodeFault` and its subclasses, `NODE_FAULTS` (by kind), `AnyNodeFault` (any of them).
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from handtouch.config.base import Name, NonNegative, OneOfKinds, Positive, Table
from handtouch.config.channels import parse_object
from handtouch.config.eds import EdsError
from handtouch.config.tables import Unsigned32
from handtouch.device import Device
from handtouch.wire.faults import FaultKind

Byte = Annotated[int, Field(ge=0, le=0xFF)]
ErrorCode = Annotated[int, Field(ge=0x0100, le=0xFFFF)]


class NodeFault(Table):
    """`[[node_fault]]`: keys of all kinds; a subclass overrides how it begins and ends."""

    link: Name = Field(description="link of the pad whose node has the fault")
    from_s: NonNegative = Field(description="begin, in seconds since the start; once, even if it repeats")
    until_s: Positive | None = Field(None, description="end; left out: it lasts")

    def begin(self, device: Device) -> None:
        """Cause the fault."""
        raise NotImplementedError

    def end(self, device: Device) -> None:
        """Remove the fault."""
        raise NotImplementedError

    @model_validator(mode="after")
    def _check_interval(self) -> Self:
        if self.until_s is not None and self.until_s <= self.from_s:
            raise ValueError(f"until_s = {self.until_s} must come after from_s = {self.from_s}")
        return self


class Emcy(NodeFault):
    """Error reported by EMCY, with error register and history; the node stays operational."""

    kind: Literal[FaultKind.EMCY] = FaultKind.EMCY
    code: ErrorCode = Field(0x5000, description="error code of the EMCY message")
    register_bits: Byte = Field(1, description="error register, 0x1001")

    def begin(self, device: Device) -> None:
        """Send the message."""
        device.send_emergency(self.code, self.register_bits)

    def end(self, device: Device) -> None:
        """Send the error reset."""
        device.send_emergency(0)


class RefusesOperational(NodeFault):
    """Error that keeps the node from being operational, through resets too."""

    kind: Literal[FaultKind.REFUSES_OPERATIONAL] = FaultKind.REFUSES_OPERATIONAL
    code: ErrorCode = Field(0x5000, description="error code of the EMCY message")
    register_bits: Byte = Field(1, description="error register, 0x1001")

    def begin(self, device: Device) -> None:
        """Latch the error."""
        device.latch_error(self.code, self.register_bits)

    def end(self, device: Device) -> None:
        """Clear the error."""
        device.clear_error()


class BootLoop(NodeFault):
    """Node that restarts again and again, as by a watchdog or a weak supply."""

    kind: Literal[FaultKind.BOOT_LOOP] = FaultKind.BOOT_LOOP
    period_s: Positive = Field(0.2, description="time between two restarts")

    def begin(self, device: Device) -> None:
        """Begin to restart."""
        device.start_boot_loop(round(self.period_s * 1e9))

    def end(self, device: Device) -> None:
        """Stay on after the last restart."""
        device.stop_boot_loop()


class IllegalNmtState(NodeFault):
    """Heartbeats with an NMT state that CiA 301 doesn't define."""

    kind: Literal[FaultKind.ILLEGAL_NMT_STATE] = FaultKind.ILLEGAL_NMT_STATE
    state: Annotated[int, Field(ge=0, le=127)] = Field(99, description="NMT state in the heartbeats")

    def begin(self, device: Device) -> None:
        """Replace the state in the heartbeats."""
        device.heartbeat_state = self.state

    def end(self, device: Device) -> None:
        """Send the node's state."""
        device.heartbeat_state = None


def _check_object(text: str) -> str:
    try:
        parse_object(text)
    except EdsError as error:
        raise ValueError(str(error)) from error
    return text


class ChangedSetting(NodeFault):
    """Object changed as by another master or a configuration tool; it stays so until it is written again."""

    kind: Literal[FaultKind.CHANGED_SETTING] = FaultKind.CHANGED_SETTING
    changed_object: Annotated[str, AfterValidator(_check_object)] = Field(
        "0x1801:2", description="the object, INDEX:SUB"
    )
    value: Unsigned32 = Field(240, description="its new value")

    def begin(self, device: Device) -> None:
        """Write the object."""
        index, sub = parse_object(self.changed_object)[:2]
        device.write_object(index, sub, self.value)

    def end(self, device: Device) -> None:
        """Leave the object as it is."""


NODE_FAULTS: Mapping[str, type[NodeFault]] = MappingProxyType(
    {it.model_fields["kind"].default: it for it in NodeFault.__subclasses__()}
)
"""By kind, as in a scenario file."""
AnyNodeFault = Annotated[NodeFault, OneOfKinds(NODE_FAULTS)]
