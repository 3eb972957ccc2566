"""Keys and interrupts of guided sessions."""

from __future__ import annotations

import os
import signal

import pytest

from handtouch.dialogue import open_dialogue


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_waits_until_keys_are_asked_for_and_a_second_one_does_not(number: int) -> None:
    before = signal.getsignal(number)
    with open_dialogue() as dialogue:
        os.kill(os.getpid(), number)  # whatever is called then must not lose it
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                dialogue.key()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
    assert signal.getsignal(number) is before
