"""What a machine allows the daemon's loop in time is found, with the command that improves it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from handtouch import config
from handtouch.config import shipped
from handtouch.host.machine import HostCheck, Machine
from handtouch.procedures import doctor
from handtouch.procedures.timing_checks import check_timing, parse_cpus


def machine(root: Path, **files: str) -> Machine:
    """Return one with these files; __ stands for / in a name."""
    for name, text in files.items():
        path = root / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n")
    return Machine(root / "proc", root / "sys")


def deployment(**of_daemon: Any) -> config.Deployment:
    stated = config.load(shipped.path("utah_mit.toml"))
    return stated.model_copy(update={"daemon": stated.daemon.model_copy(update=of_daemon)})


def checks(stated: config.Deployment, on: Machine) -> dict[str, HostCheck]:
    return {check.subject: check for check in check_timing(stated, on)}


def test_a_prepared_machine_has_nothing_to_improve(tmp_path: Path) -> None:
    prepared = machine(
        tmp_path,
        sys__kernel__realtime="1",
        sys__devices__system__cpu__cpu3__cpufreq__scaling_governor="performance",
        sys__devices__system__cpu__cpu0__cpufreq__scaling_governor="powersave",
        sys__devices__system__cpu__isolated="2-3",
        sys__class__net__can0__device__irq="45",
        proc__irq__45__smp_affinity_list="0-1",
    )
    found = checks(deployment(cpus=(3,), realtime_priority=40), prepared)
    assert set(found) == {"kernel", "governor", "CPUs", "interrupts"}
    assert all(check.state == "ok" for check in found.values())


@pytest.mark.parametrize(
    ("file", "text", "subject", "remedy"),
    [
        ("sys__kernel__realtime", "0", "kernel", "realtime-kernel"),
        ("sys__devices__system__cpu__cpu3__cpufreq__scaling_governor", "schedutil", "governor", "cpupower"),
        ("sys__devices__system__cpu__isolated", "1-2", "CPUs", "isolcpus=3"),
        ("proc__irq__45__smp_affinity_list", "2-3", "interrupts", "echo 2 > /proc/irq/45/smp_affinity_list"),
        ("proc__irq__45__smp_affinity_list", "3", "interrupts", "another CPU"),
    ],
)
def test_each_thing_that_delays_the_loop_comes_with_its_remedy(
    tmp_path: Path, file: str, text: str, subject: str, remedy: str
) -> None:
    on = machine(tmp_path, **{"sys__class__net__can0__device__irq": "45", file: text})
    check = checks(deployment(cpus=(3,), realtime_priority=40), on)[subject]
    assert check.state == "warn"
    assert remedy in check.remedy


def test_only_a_deployment_that_asks_for_real_time_is_warned(tmp_path: Path) -> None:
    on = machine(tmp_path, sys__devices__system__cpu__cpu0__cpufreq__scaling_governor="powersave")
    for stated, state in ((deployment(), "ok"), (deployment(realtime_priority=40), "warn")):
        found = {check.subject: check.state for check in doctor.check_host(stated, on)}
        assert found["kernel"] == found["governor"] == state


def test_an_adapter_with_a_queue_per_interrupt_has_each_checked(tmp_path: Path) -> None:
    root = "sys__class__net__can0__device__msi_irqs__"
    on = machine(
        tmp_path,
        **{f"{root}45": "msi", f"{root}46": "msi"},
        proc__irq__45__smp_affinity_list="0",
        proc__irq__46__smp_affinity_list="3",
    )
    found = [
        check.state for check in check_timing(deployment(cpus=(3,)), on) if check.subject == "interrupts"
    ]
    assert found == ["ok", "warn"]


def test_lists_of_cpus_are_read_as_the_kernel_writes_them() -> None:
    assert parse_cpus("0-2,5\n") == {0, 1, 2, 5}
    assert parse_cpus("\n") == set()
