"""Errors of nodes: EMCY messages as text, which of them last, error register and history."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch.canbus.objects.emergency import (
    MAX_EMERGENCIES,
    ErrorLog,
    ReportedErrors,
    decode_emergency,
    describe_emergency,
)


@pytest.mark.parametrize(
    ("code", "register", "text"),
    [
        (0x0000, 0, "0x0000 no error"),
        (0x1000, 1, "0x1000 generic error (register: generic)"),
        (0x2310, 3, "0x2310 current at the device's output (register: current)"),
        (0x3456, 0, "0x3456 voltage"),
        (0x4200, 9, "0x4200 device temperature (register: temperature)"),
        (0x8130, 0x11, "0x8130 life guard or heartbeat error (register: communication)"),
        (0x8277, 0, "0x8277 protocol error"),
        (0xFF01, 0x81, "0xFF01 device specific (register: manufacturer)"),
        (0xA000, 0, "0xA000 unknown error"),
    ],
)
def test_code_and_register_are_described(code: int, register: int, text: str) -> None:
    assert describe_emergency(code, register) == text


@given(st.integers(0, 0xFFFF), st.integers(0, 0xFF), st.binary(min_size=5, max_size=5))
def test_decoding_keeps_every_field(code: int, register: int, detail: bytes) -> None:
    message = decode_emergency(code.to_bytes(2, "little") + bytes((register,)) + detail, 7)
    assert message is not None
    assert message.text == describe_emergency(code, register)
    assert (message.code, message.register, message.arrival_ns) == (code, register, 7)
    assert bytes.fromhex(message.manufacturer) == detail


@given(st.binary(max_size=20).filter(lambda data: len(data) != 8))
def test_other_lengths_are_not_decoded(data: bytes) -> None:
    assert decode_emergency(data, 0) is None


def received(log: ErrorLog, code: int, register: int, t_ns: int = 0) -> list[tuple[int, int | None]]:
    """Pass on an EMCY message; return codes and clearing times of the errors that changed."""
    message = decode_emergency(code.to_bytes(2, "little") + bytes((register, 1, 2, 3, 4, 5)), t_ns)
    assert message is not None
    return [(error.code, error.cleared_ns) for error in log.add_emergency(message)]


def test_error_lasts_until_the_error_reset() -> None:
    log = ErrorLog()
    assert received(log, 0x5000, 1, 10) == [(0x5000, None)]
    assert log.describe() == "error register 0x01 (generic), EMCY 0x5000 device hardware"
    assert received(log, 0x0000, 0, 30) == [(0x5000, 30)]
    assert (log.describe(), log.register) == ("", 0)
    assert [error.code for error in log.emergencies] == [0x5000]  # "no error" is no error


def test_error_reset_with_remaining_bits_clears_the_errors_without_them_only() -> None:
    log = ErrorLog()
    received(log, 0x2310, 0b11, 1)
    received(log, 0x4200, 0b1011, 2)
    received(log, 0x5000, 0b1011, 3)
    assert received(log, 0x0000, 0b1001, 4) == [(0x2310, 4)]
    assert log.describe() == (
        "error register 0x09 (generic, temperature), EMCY 0x5000 device hardware, "
        "EMCY 0x4200 device temperature"
    )


def test_error_register_read_from_the_node_clears_errors() -> None:
    log = ErrorLog()
    received(log, 0x8130, 0x11, 1)
    assert log.add_report(ReportedErrors(0x11, (0x8130,)), 2) == ()
    assert log.add_report(ReportedErrors(None), 3) == ()  # the node has no such object
    assert [error.cleared_ns for error in log.add_report(ReportedErrors(0, (0x8130,)), 4)] == [4]
    assert log.history == (0x8130,)


def test_history_explains_a_register_without_emcy() -> None:
    log = ErrorLog()
    log.add_report(ReportedErrors(1, (0x12345000, 0x8130), 0), 1)
    assert log.describe() == (
        "error register 0x01 (generic), latest in 0x1003: EMCY 0x5000 device hardware, "
        "0x1029:01 = 0 (pre-operational after a communication error)"
    )


def test_repeated_message_is_counted_and_evicts_no_other() -> None:
    log = ErrorLog()
    received(log, 0x2310, 3, 1)
    for t_ns in range(2, 3000):
        received(log, 0x5000, 1, t_ns)
    assert [(error.code, error.count, error.arrival_ns) for error in log.emergencies] == [
        (0x2310, 1, 1),
        (0x5000, 2998, 2),
    ]


@given(st.lists(st.tuples(st.integers(0, 0xFFFF), st.integers(0, 255)), max_size=60))
def test_errors_are_bounded_and_none_outlasts_an_empty_register(messages: list[tuple[int, int]]) -> None:
    log = ErrorLog()
    for t_ns, (code, register) in enumerate(messages):
        received(log, code, register, t_ns)
        assert log.register == register
        assert len(log.emergencies) <= MAX_EMERGENCIES
        assert all(error.code >= 0x100 for error in log.emergencies)
    received(log, 0, 0, len(messages))
    assert all(error.cleared_ns is not None for error in log.emergencies)
    assert log.describe() == ""
