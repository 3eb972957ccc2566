"""Nodes that conform pass, and are left as they were; what isn't needed isn't required."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from handtouch.config import shipped
from handtouch.config.channels import WritableObject
from handtouch.device import LineFaults
from handtouch.procedures.conformance import (
    BusInUseError,
    ConformanceOptions,
    NodeReport,
    NodeUnderTest,
    Verdict,
    check_bus_is_free,
    compare_serials,
    find_nodes,
    run_checks,
)

MS = 1_000_000
NODE, SERIAL = 5, 105
OPERATIONAL = 5
EDS = str(shipped.path("handtouch-node.eds"))
Check = Callable[..., NodeReport]


def verdicts(report: NodeReport, *names: str) -> list[Verdict | None]:
    return [report.verdict(name) for name in names]


def test_the_shipped_node_passes_every_check_that_needs_no_operator(line: Any, check: Check) -> None:
    line.add()
    report = check(
        eds=EDS,
        excitation=WritableObject(0x2100, 0, 1),
        name="right/palm",
        vendor_id=0,
        product_code=0x401,
        serial=SERIAL,
    )
    assert report.failures == []
    assert report.ok
    assert {r.name for r in report.results if r.verdict is Verdict.NOT_TESTED} == {
        "guarding.response",  # it sends heartbeats
        "emcy.format",  # no error
        "pdo.remapping",  # constant
        "lss.select",
        "lss.compares",
        "operator.power_cycle",
        "operator.press",
        "operator.error",
    }
    assert [rate.period_ms for rate in report.rates] == [20.0, 10.0, 5.0]
    assert all(rate.missing == rate.extra == rate.late == 0 for rate in report.rates)


def test_everything_is_set_back(line: Any, check: Check) -> None:
    device = line.add()
    settings = {(0x1017, 0): 77, (0x1801, 2): 4, (0x1801, 5): 33, (0x1801, 1): 0xC0000285, (0x2100, 0): 0}
    for (index, sub), value in settings.items():
        device.write_object(index, sub, value)
    line.send(0, bytes((1, NODE)))
    report = check(excitation=WritableObject(0x2100, 0, 1))
    assert report.failures == []
    assert {address: device.read_object(*address) for address in settings} == settings
    assert device.state == "OPERATIONAL"
    assert report.restore_problem == ""


def test_a_strict_node_that_starts_by_itself_as_canopennode_does_passes(line: Any, check: Check) -> None:
    """PDO parameters only while disabled, operational after power-on, no heartbeat until it is set."""
    device = line.add(strict_pdo=True)
    device.write_object(0x1017, 0, 0, keep=True)
    device.write_object(0x1801, 2, 255, keep=True)
    line.send(0, bytes((1, NODE)))
    report = check(eds=None)
    assert report.failures == []
    assert (device.read_object(0x1017, 0), device.read_object(0x1801, 2)) == (0, 255)


@pytest.mark.parametrize("compares", [True, False])
def test_a_node_with_lss_passes(line: Any, check: Check, compares: bool) -> None:
    unconfigured = line.bus.add_unconfigured(serial=SERIAL, lss_compares=compares)
    unconfigured.lss.stored_id = NODE
    unconfigured.plug()
    line.frames.clear()
    report = check()
    assert report.failures == []
    assert verdicts(report, "lss.select", "lss.compares") == [Verdict.PASSED] * 2
    detail = next(result.detail for result in report.results if result.name == "lss.compares")
    assert bool(detail) is not compares
    assert not unconfigured.lss.configuring


def test_a_lss_slave_with_another_id_is_named(line: Any, check: Check) -> None:
    unconfigured = line.bus.add_unconfigured(serial=SERIAL)
    unconfigured.lss.stored_id = 9
    unconfigured.plug()
    line.add()
    report = check()
    assert [result.name for result in report.failures] == ["lss.select"]


def test_an_eds_of_another_device_fails_with_its_objects(line: Any, check: Check, tmp_path: Path) -> None:
    line.add()
    eds = tmp_path / "other.eds"
    text = (
        Path(EDS).read_text().replace("[2100]", "[2200]").replace("DefaultValue=0x64010410", "DefaultValue=1")
    )
    eds.write_text(text)
    (failure,) = check(eds=str(eds)).failures
    assert failure.name == "eds.objects"
    assert "0x2200:00" in failure.detail
    assert "0x1A01:04: constant 0x64010410 instead of 0x1" in failure.detail


def test_another_identity_than_that_of_the_deployment_fails(line: Any, check: Check) -> None:
    line.add()
    report = check(name="right/palm", serial=1)
    assert [result.name for result in report.failures] == ["identity.configured"]


def test_resets_and_lss_can_be_left_out(line: Any, check: Check) -> None:
    line.add()
    line.sent.clear()
    report = check(ConformanceOptions(syncs=10, resets=False, lss=False))
    assert not [data for can_id, data in line.sent if can_id == 0 and data[0] in (129, 130)]
    assert not [can_id for can_id, _ in line.sent if can_id == 0x7E5]
    assert verdicts(report, "nmt.reset_node", "lss.select") == [Verdict.NOT_TESTED] * 2


def test_no_frame_is_addressed_to_another_node(line: Any, check: Check) -> None:
    line.add()
    other = line.add(6)
    line.send(0, bytes((1, 6)))
    line.sent.clear()
    assert check().ok
    assert other.state == "OPERATIONAL"
    assert {data[1] for can_id, data in line.sent if can_id == 0} == {NODE, 127}
    assert {can_id for can_id, _ in line.sent if can_id & 0x780 == 0x600} == {0x600 + NODE, 0x600 + 127}


def test_no_command_is_sent_to_a_node_that_is_present(line: Any, check: Check) -> None:
    """The test of addressing needs an id that no node has."""
    line.add()
    other = line.add(127)
    line.send(0, bytes((1, 127)))
    report = check()
    assert report.verdict("nmt.addressed") is Verdict.PASSED
    assert other.state == "OPERATIONAL"


def test_a_node_that_cannot_be_set_back_is_reported(line: Any) -> None:
    device = line.add()

    def freeze(step: str) -> None:
        if step == "SDO protocol":
            device.sdo.frozen = True

    report = run_checks(line, NodeUnderTest("can0", NODE), ConformanceOptions(syncs=10), freeze)
    assert "no response" in report.restore_problem
    assert not report.ok


@pytest.mark.parametrize(
    ("can_id", "name"),
    [(0x000, "NMT master"), (0x080, "SYNC producer"), (0x605, "SDO client of node 5"), (0x7E5, "LSS master")],
)
def test_a_bus_with_another_master_is_refused_before_anything_is_sent(
    line: Any, can_id: int, name: str
) -> None:
    line.at(300, lambda: line.frames.append((can_id, b"", line.t_ns)))
    with pytest.raises(BusInUseError, match=name):
        check_bus_is_free(line, "can0")
    assert line.sent == []


def test_a_master_that_starts_meanwhile_is_named_and_the_node_is_set_back(line: Any) -> None:
    device = line.add()
    line.at(700, lambda: line.frames.append((0x000, b"\1\5", line.t_ns)))
    with pytest.raises(BusInUseError, match="NMT master"):
        run_checks(line, NodeUnderTest("can0", NODE), ConformanceOptions(syncs=10))
    assert device.read_object(0x1017, 0) == 200


def test_a_node_that_handtouch_has_stopped_is_tested_and_stopped_again(line: Any, check: Check) -> None:
    device = line.add()
    line.send(0, bytes((2, NODE)))
    line.frames.clear()
    assert find_nodes(line) == []
    assert check_bus_is_free(line, "can0") == {NODE}
    assert check().ok
    assert device.state == "STOPPED"


def test_an_operational_node_without_sdo_server_stays_operational(line: Any, check: Check) -> None:
    device = line.add()
    device.sdo.frozen = True
    line.send(0, bytes((1, NODE)))
    assert not check().ok
    assert device.state == "OPERATIONAL"


def test_a_node_is_set_back_when_the_procedure_is_interrupted(line: Any) -> None:
    device = line.add()
    line.send(0, bytes((1, NODE)))

    def interrupt(step: str) -> None:
        if step == "SYNC every 10 ms":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_checks(line, NodeUnderTest("can0", NODE), ConformanceOptions(syncs=10), interrupt)
    assert (device.state, device.read_object(0x1017, 0)) == ("OPERATIONAL", 200)


def test_equal_serial_numbers_fail_on_all_nodes_that_share_one(line: Any) -> None:
    for node_id, serial in ((4, 7), (5, 7), (6, 8)):
        line.add(node_id, serial=serial)
    assert find_nodes(line) == [4, 5, 6]
    options = ConformanceOptions(syncs=10)
    reports = [run_checks(line, NodeUnderTest("can0", node_id), options) for node_id in (4, 5, 6)]
    assert all(report.ok for report in reports)
    compare_serials(reports)
    assert [report.verdict("identity.serial") for report in reports] == ["failed", "failed", "passed"]


def test_a_node_that_refuses_operational_fails_with_its_error_and_no_more(line: Any, check: Check) -> None:
    device = line.add()
    device.latch_error(0x5000)
    line.frames.clear()
    report = check()
    assert [result.name for result in report.failures] == ["nmt.operational", "emcy.none"]
    assert "0x5000 device hardware" in report.failures[0].detail
    assert verdicts(report, "pdo.complete", "pdo.event_timer") == [Verdict.NOT_TESTED] * 2


def test_late_tpdos_while_this_computer_pauses_are_no_failure_of_the_node(line: Any) -> None:
    line.add().line = LineFaults(late_ns=4 * MS)

    def pause() -> None:
        line.t_ns += 20 * MS

    def disturb(step: str) -> None:
        if step == "SYNC every 5 ms":
            for delay_ms in range(20, 1000, 60):
                line.at(delay_ms, pause)

    report = run_checks(line, NodeUnderTest("can0", NODE), ConformanceOptions(syncs=40), disturb)
    (result,) = [result for result in report.results if result.name == "pdo.delay"]
    assert result.verdict is Verdict.NOT_TESTED
    assert "this computer paused" in result.detail


def test_a_frame_loss_is_counted_for_each_rate(line: Any, check: Check) -> None:
    device = line.add()
    device.send_data = False
    report = check()
    assert [rate.missing for rate in report.rates] == [40, 40, 40]
    assert verdicts(report, "pdo.delay", "pdo.length", "channels.noise") == [Verdict.NOT_TESTED] * 3


def test_a_report_is_json_and_names_what_to_do(line: Any, check: Check) -> None:
    device = line.add()
    device.send_heartbeat = False
    report = json.loads(json.dumps(check().to_map()))
    assert report["ok"] is False
    failed = [entry for entry in report["checks"] if entry["verdict"] == "failed"]
    assert failed
    assert all(entry["remedy"] for entry in failed)
