"""EMCY messages as text."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handtouch.canbus.objects.emergency import decode_emergency, describe_emergency


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
