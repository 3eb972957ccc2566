"""EDS files: which TPDOs they tell of, and files as vendors ship them."""

from __future__ import annotations

from pathlib import Path

import pytest

from handtouch import shipped
from handtouch.canbus.eds import EdsError, load, tpdo_numbers

RECORD = """
[{index}]
ParameterName={name}
ObjectType=0x9
SubNumber=2
[{index}sub0]
ParameterName=entries
ObjectType=0x7
DataType=0x0005
AccessType=ro
DefaultValue=1
[{index}sub1]
ParameterName=first
ObjectType=0x7
DataType=0x0007
AccessType=rw
DefaultValue={value}
"""


def test_shipped_node_has_its_channels_in_tpdo2() -> None:
    assert tpdo_numbers(load(shipped.path("handtouch-node.eds"), 5))[0] == 2


def test_tpdos_with_analogue_inputs_come_first(tmp_path: Path) -> None:
    path = tmp_path / "Gerät.EDS"
    text = "; für Fühler, 20 °C\n[DeviceInfo]\nVendorName=Müller\n"
    for number, entry in ((1, "0x60000108"), (4, "0x64010110"), (7, "")):
        text += RECORD.format(index=f"{0x17FF + number:04x}", name="TPDO", value="$NODEID+0x180")
        text += RECORD.format(index=f"{0x19FF + number:04x}", name="mapping", value=entry)
    path.write_bytes(text.encode("latin-1"))
    assert tpdo_numbers(load(path, 5)) == (4, 1, 7)


@pytest.mark.parametrize(
    "raw", [b"no section\n", b"[1000]\n", b"\x00\xff\xfe", b"[1000]\nParameterName=x\nObjectType=zz\n"]
)
def test_unreadable_files_are_named(tmp_path: Path, raw: bytes) -> None:
    path = tmp_path / "odd.eds"
    path.write_bytes(raw)
    with pytest.raises(EdsError, match=r"odd\.eds"):
        load(path, 5)
