"""Keys and interrupts of guided sessions."""

from __future__ import annotations

import os
import signal

import pytest

from handtouch.procedures.dialogue import open_dialogue


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_is_raised_by_read_key_and_a_second_one_at_once(number: int) -> None:
    before = signal.getsignal(number)
    with open_dialogue() as dialogue:
        os.kill(os.getpid(), number)  # whatever is called then must not lose it
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                dialogue.read_key()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
    assert signal.getsignal(number) is before
