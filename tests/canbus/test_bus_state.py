"""Bus state by ISO 11898-1 and <linux/can/error.h>, with remedies."""

from __future__ import annotations

import errno

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch.canbus.bus.bus_state import (
    BusFault,
    BusState,
    ErrorState,
    fault_from_exception,
    is_queue_full,
)

S = 1_000_000_000
DOWN = BusFault(ErrorState.DOWN, "Network is down")


def state_after(classes: int, data: str, interface: str = "socketcan") -> BusState:
    state = BusState(interface, "can0")
    state.handle_error_frame(classes, bytes.fromhex(data), S, 0, 0)
    return state


@pytest.mark.parametrize(
    ("classes", "data", "condition", "causes"),
    [
        (0x001, "", "active", ["transmit timeout"]),
        (0x002, "0b00000000000000", "active", ["lost arbitration"]),
        (0x004, "0001000000000000", "active", ["controller receive overflow"]),
        (0x004, "0002000000000000", "active", ["controller transmit overflow"]),
        (0x004, "0004000000000060", "warning", ["receive warning"]),
        (0x004, "0008000000006000", "warning", ["transmit warning"]),
        (0x004, "0010000000000080", "passive", ["receive passive"]),
        (0x004, "0020000000008000", "passive", ["transmit passive"]),
        (0x004, "0030000000008080", "passive", ["receive passive", "transmit passive"]),
        (0x004, "0040000000000000", "active", ["active again"]),
        (0x008, "0000010000000000", "active", ["bit error"]),
        (0x008, "0000020000000000", "active", ["form error"]),
        (0x008, "0000040000000000", "active", ["stuff error"]),
        (0x008, "0000080000000000", "active", ["bit error"]),
        (0x008, "0000200000000000", "active", ["overload"]),
        (0x008, "0000000800000000", "active", ["CRC error"]),
        (0x008, "0000800000000000", "active", ["unspecified"]),  # while sending: no kind given
        (0x008, "0000801900000000", "active", ["no acknowledge"]),
        (0x010, "0000000004000000", "active", ["transceiver"]),
        (0x020, "", "active", ["no acknowledge"]),
        (0x040, "", "bus-off", ["bus-off"]),
        (0x080, "", "active", ["bus error"]),
        (0x100, "", "active", ["restarted"]),
        (0x200, "0000000000005f00", "active", ["unspecified"]),
        (0x200, "0000000000006000", "warning", ["unspecified"]),
        (0x200, "000000000000007f", "warning", ["unspecified"]),
        (0x200, "0000000000000080", "passive", ["unspecified"]),
        (0x048, "0000040000000000", "bus-off", ["bus-off", "stuff error"]),
    ],
)
def test_every_class_of_error_frame_is_reported(
    classes: int, data: str, condition: str, causes: list[str]
) -> None:
    state = state_after(classes, data)
    assert state.error_state.value == condition
    assert list(state.causes.items()) == [(cause, 1) for cause in causes]


@given(st.integers(0, 0x1FFFFFFF), st.binary(max_size=64))
def test_no_error_frame_however_malformed_raises_or_goes_uncounted(classes: int, data: bytes) -> None:
    state = BusState()
    state.handle_error_frame(classes, data, S, 0, 0)
    state.update(2 * S, 0, 0, 0, None)
    assert sum(state.causes.values()) >= 1
    assert bool(state.problem) == (state.error_state is not ErrorState.ACTIVE)


def test_error_counters_are_kept() -> None:
    figures = state_after(0x204, "0020000000008803").report()
    assert (figures["transmit_errors"], figures["receive_errors"]) == (0x88, 3)
    assert (figures["state"], figures["since_ns"]) == ("passive", S)


def test_bus_off_is_reported_with_a_remedy() -> None:
    state = state_after(0x040, "")
    assert "can0 stays off until `ip link set can0 type can restart`" in state.problem
    assert "restart-ms 100" in state.problem
    state.restart_ms = 100
    assert "the kernel restarts can0 after 100 ms" in state.problem
    other = BusState("pcan", "PCAN_USBBUS1")
    other.update(S, 0, 0, 0, BusFault(ErrorState.BUS_OFF, "The bus is off"))
    assert "reopened until it works" in other.problem
    assert other.causes == {"bus-off": 1}
    other.update(2 * S, 0, 0, 0, BusFault(ErrorState.BUS_OFF, "The bus is off"))
    assert other.causes == {"bus-off": 1}  # still the same one


def test_missing_acknowledgement_is_reported() -> None:
    state = BusState()
    for _ in range(16):
        state.handle_error_frame(0x008, bytes.fromhex("0000801900000000"), S, 0, 0)
    state.handle_error_frame(0x004, bytes.fromhex("0020000000008000"), S, 0, 0)
    assert "mostly no acknowledge" in state.problem
    assert "no other node acknowledges" in state.problem


def test_damaged_frames_point_at_the_wiring() -> None:
    state = BusState()
    for _ in range(5):
        state.handle_error_frame(0x008, bytes.fromhex("0000040000000000"), S, 0, 0)
    state.handle_error_frame(0x004, bytes.fromhex("0010000000000080"), S, 0, 0)
    assert "mostly stuff error" in state.problem
    assert "termination" in state.problem


def test_restarted_controller_is_active_since_its_restart() -> None:
    state = state_after(0x040, "")
    state.handle_error_frame(0x100, b"", 3 * S, 0, 0)
    assert (state.error_state, state.since_ns, state.problem) == (ErrorState.ACTIVE, 3 * S, "")


def test_frame_after_bus_off_proves_that_the_controller_is_on() -> None:
    """Drivers that restart silently: one that is off receives nothing."""
    state = BusState()
    state.handle_error_frame(0x040, b"", S, 700, 0)
    state.update(2 * S, 700, 50, 0, None)
    assert state.error_state is ErrorState.BUS_OFF  # what we sent may wait in a queue
    state.update(3 * S, 701, 50, 0, None)
    assert (state.error_state, state.since_ns) == (ErrorState.ACTIVE, 3 * S)


@pytest.mark.parametrize(
    ("bits", "frames", "sent", "condition"),
    [
        ("10", 254, 0, "passive"),
        ("10", 255, 0, "active"),
        ("20", 1000, 254, "passive"),
        ("20", 255, 255, "active"),
    ],
)
def test_error_counters_that_must_have_fallen_end_a_passive_state(
    bits: str, frames: int, sent: int, condition: str
) -> None:
    """For drivers that don't report recovery: each good frame takes one off a counter of at most 255."""
    state = BusState()
    state.handle_error_frame(0x004, bytes.fromhex(f"00{bits}000000000000"), S, 100, 10)
    state.update(2 * S, 100 + frames, 10 + sent, 0, None)
    assert state.error_state.value == condition


def test_interface_that_goes_down_and_comes_up() -> None:
    state = BusState()
    state.update(S, 0, 0, 0, DOWN)
    assert (state.error_state, state.since_ns) == (ErrorState.DOWN, S)
    assert "ip link set can0 up" in state.problem
    state.update(2 * S, 0, 0, 0, DOWN)
    assert state.since_ns == S
    state.update(3 * S, 0, 0, 0, None)
    assert (state.error_state, state.problem) == (ErrorState.ACTIVE, "")


def test_full_transmit_queue_is_reported_for_two_seconds() -> None:
    state = BusState()
    state.update(S, 0, 0, 3, None)
    assert state.error_state is ErrorState.ACTIVE
    assert "transmit queue full, 3 frames not sent" in state.problem
    assert "txqueuelen" in state.problem
    state.update(3 * S, 0, 0, 3, None)
    assert state.problem
    state.update(4 * S, 0, 0, 3, None)
    assert state.problem == ""


def test_bad_datagram_is_reported_without_a_state_change() -> None:
    state = BusState("udp_multicast", "239.0.0.1")
    state.update(S, 0, 0, 0, BusFault(ErrorState.ACTIVE, "could not unpack"))
    assert (state.error_state, state.problem) == (ErrorState.ACTIVE, "could not unpack")


def test_error_frames_in_an_unknown_layout_are_only_counted() -> None:
    state = state_after(0x040, "ffffffffffffffff", "kvaser")
    assert (state.error_state, state.causes) == (ErrorState.ACTIVE, {"error frame": 1})


@pytest.mark.parametrize(
    ("error", "condition"),
    [
        (can.CanOperationError("Error receiving: Network is down", errno.ENETDOWN), "down"),
        (OSError(errno.ENODEV, "No such device"), "down"),
        (can.CanOperationError("The CAN controller is in bus-off state"), "bus-off"),
        (can.CanOperationError("Bus error: the CAN controller is in bus off"), "bus-off"),
        (ValueError(), "active"),
    ],
)
def test_exceptions_are_mapped_to_faults(error: Exception, condition: str) -> None:
    expected = fault_from_exception(error)
    assert expected.error_state.value == condition
    assert expected.text


@pytest.mark.parametrize(
    ("error", "full"),
    [
        (OSError(errno.ENOBUFS, "No buffer space available"), True),
        (BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable"), True),
        (can.CanOperationError("Transmit buffer full"), True),
        (can.CanOperationError("Failed to transmit: No buffer space available", errno.ENOBUFS), True),
        (can.CanOperationError("The transmit queue is full"), True),
        (OSError(errno.ENETDOWN, "Network is down"), False),
        (can.CanOperationError("no such thing"), False),
    ],
)
def test_full_queue_is_distinguished_from_other_failures(error: Exception, full: bool) -> None:
    assert is_queue_full(error) is full
