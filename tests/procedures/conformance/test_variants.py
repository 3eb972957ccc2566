"""Nodes that are built otherwise, but can be used: guarded, several TPDOs, REAL32, mapped over SDO."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from handtouch.config.channels import resolve_channels
from handtouch.procedures.conformance import NodeReport, Verdict
from tests.minimal_node import minimal_eds

Check = Callable[..., NodeReport]
U8, U16, U32, REAL32 = 5, 6, 7, 8


def variable(name: str, kind: int, default: object, access: str = "rw") -> str:
    return (
        f"[{name}]\nParameterName=x\nObjectType=7\nDataType={kind}\nAccessType={access}\n"
        f"DefaultValue={default}\nPDOMapping={int(name.startswith('64'))}\n"
    )


def record(index: str, subs: Sequence[tuple[int, object]], access: str = "rw") -> str:
    """A record with sub-indices 0 to n, given as (type, default)."""
    text = f"[{index}]\nParameterName=x\nObjectType=9\n" + variable(f"{index}sub0", U8, len(subs), "const")
    return text + "".join(
        variable(f"{index}sub{sub}", kind, default, access) for sub, (kind, default) in enumerate(subs, 1)
    )


def without(text: str, *indices: str) -> str:
    """An EDS text without some objects."""
    sections = text.split("[")
    return "[".join(section for section in sections if not section.startswith(indices))


def write(path: Path, text: str) -> str:
    path.write_text(text)
    return str(path)


def test_a_guarded_node_passes_with_node_guarding(line: Any, check: Check, tmp_path: Path) -> None:
    text = without(minimal_eds(), "1017") + variable("100C", U16, 0) + variable("100D", U8, 0)
    eds = write(tmp_path / "guarded.eds", text)
    line.add(eds=eds)
    report = check(eds=eds)
    assert report.failures == []
    assert report.verdict("guarding.response") is Verdict.PASSED
    assert report.verdict("heartbeat.period") is Verdict.NOT_TESTED
    assert report.verdict("nmt.stopped") is Verdict.PASSED


def test_real32_channels_in_two_tpdos_pass(line: Any, check: Check, tmp_path: Path) -> None:
    text = without(minimal_eds(), "6401", "1801", "1A01")
    text += record("6403", [(REAL32, 0)] * 4, "ro")
    for number in (0, 1):
        text += record(f"180{number}", [(U32, f"$NODEID+0x{0x180 + 0x100 * number:X}"), (U8, 1)])
        entries = [(U32, f"0x6403{2 * number + sub:02X}20") for sub in (1, 2)]
        text += record(f"1A0{number}", entries, "const")
    eds = write(tmp_path / "real.eds", text)
    channels = resolve_channels([f"0x6403:{sub}:f32/100" for sub in (1, 2, 3, 4)], eds)
    line.add(eds=eds, channels=tuple((c.index, c.sub) for c in channels), counts_per_unit=(100.0,) * 4)
    line.counts[:] = (-100, 200, 300, 400)
    report = check(eds=eds, channels=channels)
    assert report.failures == []
    (detail,) = [result.detail for result in report.results if result.name == "pdo.mapping"]
    assert sorted(detail.split(", ")) == ["TPDO1 with COB-ID 0x185", "TPDO2 with COB-ID 0x285"]
    assert all(1 < noise < 3 for noise in report.channel_noise)


def test_a_node_whose_channels_have_to_be_mapped_passes_and_is_mapped_back(
    line: Any, check: Check, tmp_path: Path
) -> None:
    text = minimal_eds().replace(
        "AccessType=const\nDefaultValue=0x6401", "AccessType=rw\nDefaultValue=0x6401"
    )
    text = without(text, "1A01sub0") + variable("1A01sub0", U8, 4)
    eds = write(tmp_path / "mapped.eds", text)
    device = line.add(eds=eds)
    device.write_object(0x1A01, 0, 0)
    report = check(eds=None)
    assert report.failures == []
    assert report.verdict("pdo.remapping") is Verdict.PASSED
    assert device.read_object(0x1A01, 0) == 0


def test_a_node_that_may_not_be_mapped_fails_with_its_tpdos(line: Any, check: Check) -> None:
    device = line.add()
    device.write_object(0x1A01, 0, 3)
    report = check(allow_pdo_remapping=False)
    assert [result.name for result in report.failures] == ["pdo.mapping"]
    assert report.verdict("pdo.delay") is Verdict.NOT_TESTED
