"""What this machine's kernel and CPUs allow the daemon's loop in time; used by `handtouch doctor`.

Public names: `check_timing`, `parse_cpus`. A deployment that asks for real time gets warnings, any other the
facts.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from handtouch import config
from handtouch.host.machine import HostCheck, Machine

_STEADY_GOVERNOR = "performance"


def check_timing(deployment: config.Deployment | None, machine: Machine) -> Iterator[HostCheck]:
    """Yield kernel, frequencies, reserved CPUs, and interrupts of SocketCAN adapters."""
    daemon = deployment.daemon if deployment else config.Daemon()
    wants_realtime = bool(daemon.realtime_priority or daemon.cpus)
    for check in _check_each(deployment, daemon, machine):
        yield check if wants_realtime else HostCheck(check.subject, "ok", check.detail)


def _check_each(
    deployment: config.Deployment | None, daemon: config.Daemon, machine: Machine
) -> Iterator[HostCheck]:
    yield _kernel(machine)
    if (governors := _governors(machine, daemon.cpus)) is not None:
        yield governors
    if daemon.cpus:
        yield _reserved(machine, daemon.cpus)
    for bus in deployment.buses if deployment else ():
        if bus.interface == "socketcan":
            yield from _interrupts(machine, str(bus.channel), daemon.cpus)


def parse_cpus(text: str) -> set[int]:
    """Return the CPUs of a list of the kernel, such as 0-2,5. Raises ValueError for another text."""
    found: set[int] = set()
    for part in text.strip().split(",") if text.strip() else ():
        first, _, last = part.partition("-")
        found |= set(range(int(first), int(last or first) + 1))
    return found


def _kernel(machine: Machine) -> HostCheck:
    if _read(machine.sys / "kernel/realtime") == "1":
        return HostCheck("kernel", "ok", "PREEMPT_RT")
    return HostCheck(
        "kernel",
        "warn",
        "not a real-time kernel: other work delays the loop by up to milliseconds",
        "install one: linux-image-rt-amd64 (Debian), `pro enable realtime-kernel` (Ubuntu)",
    )


def _governors(machine: Machine, cpus: Iterable[int]) -> HostCheck | None:
    """Return how frequencies are chosen, of the loop's CPUs or of all; None where the kernel doesn't."""
    folder, wanted = machine.sys / "devices/system/cpu", set(cpus)
    found = {
        int(path.parent.parent.name[3:]): _read(path)
        for path in folder.glob("cpu[0-9]*/cpufreq/scaling_governor")
    }
    chosen = sorted({name for cpu, name in found.items() if name and (not wanted or cpu in wanted)})
    if not chosen:
        return None
    if chosen == [_STEADY_GOVERNOR]:
        return HostCheck("governor", "ok", _STEADY_GOVERNOR)
    text = f"{', '.join(chosen)}: a CPU that waits for frames slows down, and the next tick is late"
    return HostCheck("governor", "warn", text, f"cpupower frequency-set -g {_STEADY_GOVERNOR}")


def _reserved(machine: Machine, cpus: tuple[int, ...]) -> HostCheck:
    names = ",".join(map(str, cpus))
    isolated = parse_cpus(_read(machine.sys / "devices/system/cpu/isolated"))
    if shared := sorted(set(cpus) - isolated):
        text = f"any process may run on CPU {', '.join(map(str, shared))} of [daemon] cpus"
        remedy = f"boot with isolcpus={names} nohz_full={names} rcu_nocbs={names}"
        return HostCheck("CPUs", "warn", text, remedy)
    return HostCheck("CPUs", "ok", f"{names} reserved by isolcpus")


def _interrupts(machine: Machine, name: str, cpus: tuple[int, ...]) -> Iterator[HostCheck]:
    """Yield the CPUs that serve an adapter's interrupts; nothing for one without its own, as on USB."""
    device = machine.sys / "class/net" / name / "device"
    numbers = [path.name for path in sorted(device.glob("msi_irqs/*"))]
    if not numbers and (number := _read(device / "irq")) not in ("", "0"):
        numbers = [number]
    for number in numbers:
        text = _read(machine.proc / "irq" / number / "smp_affinity_list")
        if not text:
            continue
        served, detail = parse_cpus(text), f"{name}: interrupt {number} on CPU {text}"
        others = sorted(served - set(cpus))
        if not served & set(cpus):
            yield HostCheck("interrupts", "ok", detail)
        elif others:
            target = ",".join(map(str, others))
            yield HostCheck(
                "interrupts",
                "warn",
                f"{detail}, which [daemon] cpus reserves for the loop",
                f"echo {target} > /proc/irq/{number}/smp_affinity_list, and stop irqbalance",
            )
        else:
            yield HostCheck("interrupts", "warn", f"{detail}, as the loop", "choose another CPU for either")


def _read(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""
