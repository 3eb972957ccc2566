"""Objects over SDO: defaults, and the SDO aborts of CiA 301."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

FOUR = tuple((0x2001, sub) for sub in (1, 2, 3, 4))
MORE = """
[2F00]
ParameterName=No default
DataType=0x0007
AccessType=rw
LowLimit=5
HighLimit=9
[2F01]
ParameterName=Text without default
DataType=0x0009
AccessType=ro
[2F02]
ParameterName=Secret
DataType=0x0005
AccessType=wo
[2F03]
ParameterName=Ratio
DataType=0x0008
AccessType=rw
DefaultValue=0.5
[2F04]
ParameterName=Negative
DataType=0x0003
AccessType=rw
DefaultValue=-2
LowLimit=-3
HighLimit=3
[2F05]
ParameterName=Two letters
DataType=0x000B
AccessType=ro
DefaultValue=hé
"""


@pytest.fixture
def node(bench: Any, write_eds: Callable[..., Path]) -> Any:
    kinds = [(*c, 16, True) for c in FOUR]
    return bench.running(eds=write_eds(kinds, [[(*c, 16) for c in FOUR]], more=MORE), channels=FOUR)


@pytest.mark.usefixtures("node")
@pytest.mark.parametrize(
    ("address", "value"),
    [
        ((0x2F00, 0), 0),  # the EDS leaves it to the node
        ((0x2F01, 0), -0x08000024),  # no data
        ((0x2F02, 0), -0x06010001),  # write only
        ((0x2F03, 0), 0x3F000000),  # a float
        ((0x2F04, 0), 0xFFFE),
        ((0x2F05, 0), 0x00E90068),  # UTF-16
        ((0x2F09, 0), -0x06020000),  # no such object
        ((0x2F00, 1), -0x06090011),  # no such sub-index
        ((0x2001, 5), -0x06090011),
    ],
)
def test_an_object_has_the_default_of_its_eds(bench: Any, address: tuple[int, int], value: int) -> None:
    assert bench.read(1, *address) == value


@pytest.mark.usefixtures("node")
@pytest.mark.parametrize(
    ("address", "value", "size", "code"),
    [
        ((0x2F00, 0), 4, 4, 0x06090032),
        ((0x2F00, 0), 10, 4, 0x06090031),
        ((0x2F00, 0), 9, 4, 0),
        ((0x2F00, 0), 9, 2, 0x06070010),
        ((0x2F04, 0), 0xFFFD, 2, 0),  # -3
        ((0x2F04, 0), 0xFFFC, 2, 0x06090032),
        ((0x2F02, 0), 7, 1, 0),
        ((0x2001, 1), 7, 2, 0x06010002),
    ],
)
def test_a_value_is_accepted_or_refused_with_its_abort_code(
    bench: Any, address: tuple[int, int], value: int, size: int, code: int
) -> None:
    assert bench.write(1, *address, value, size) == code
    if not code and address != (0x2F02, 0):
        assert bench.read(1, *address) == value


def test_a_communication_reset_leaves_the_application_and_a_node_reset_does_not(
    bench: Any, node: Any
) -> None:
    for command, kept in ((130, 7), (129, 0)):
        bench.write(1, 0x2F00, 0, 7, 4)
        bench.write(1, 0x1800, 2, 3, 1)
        bench.nmt(command, 1)
        assert (node.read_object(0x2F00, 0), node.read_object(0x1800, 2)) == (kept, 1)


def test_switches_may_be_set_while_the_node_is_served(bench: Any) -> None:
    nodes = [bench.running(node_id) for node_id in (1, 2, 3)]
    done = threading.Event()
    expected: list[BaseException] = []

    def play() -> None:
        try:
            for n in range(300):
                for node in nodes:
                    node.stuck_counts = {n % 4: n}
                    node.wiring = (3, 2, 1, 0)
                    node.stick_channel(n % 4)
                    node.sdo.fail[n, 0] = None
                    node.reboot()
                    node.release_channels()
                    node.wiring = (0, 1, 2, 3)
        except BaseException as error:  # noqa: BLE001 - whatever it is, the test must report it
            expected.append(error)
        finally:
            done.set()

    thread = threading.Thread(target=play)
    thread.start()
    while not done.is_set():
        bench.nmt(1, 0)
        bench.sync()
        bench.run(1)
    thread.join()
    assert not expected
    bench.nmt(1, 0)
    assert [data for _, data in bench.sync()] == [bytes((10, 0, 20, 0, 30, 0, 40, 0))] * 3
