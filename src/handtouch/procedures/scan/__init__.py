"""Scan of CAN buses: find the nodes, compare them with a deployment, write the tables that it lacks.

Public names: `ScanRequest`, `BusReport`, `buses_to_scan`, `scan_buses`, `NodeComparison`, `compare_nodes`,
`fragment`, `nodes_without_pad`, `channel_names`. No NMT command is sent and no node is changed, unless LSS is
to assign node ids.
"""

from __future__ import annotations

from collections.abc import Sequence

from handtouch import config
from handtouch.host.machine import Machine
from handtouch.procedures.scan.bus_scan import BusReport, ScanRequest, scan_buses
from handtouch.procedures.scan.comparison import NodeComparison, compare_nodes, nodes_without_pad
from handtouch.procedures.scan.fragment import channel_names, fragment

__all__ = [
    "BusReport",
    "NodeComparison",
    "ScanRequest",
    "buses_to_scan",
    "channel_names",
    "compare_nodes",
    "fragment",
    "nodes_without_pad",
    "scan_buses",
]

_NO_BUS_REMEDY = (
    "give a deployment file, or a bus such as --bus can0=socketcan:can0 (`ip -br link` lists interfaces)"
)


def buses_to_scan(deployment: config.Deployment | None, texts: Sequence[str]) -> tuple[config.Bus, ...]:
    """Return the deployment's buses on the interfaces of `texts` (`--bus`), or those of `texts` alone.

    Raises ConfigError.
    """
    if deployment is not None:
        for text in texts:
            deployment = config.with_bus(deployment, text)
        return deployment.buses
    if not texts:
        raise config.ConfigError("handtouch scan", (config.Problem("no bus", "", _NO_BUS_REMEDY),))
    return tuple(_with_kernel_bit_rate(bus) for bus in config.parse_buses(texts))


def _with_kernel_bit_rate(bus: config.Bus) -> config.Bus:
    """Return a SocketCAN bus with the bit rate of its interface, unless the bus states one."""
    if bus.interface != "socketcan" or "bitrate_bit_s" in bus.model_fields_set:
        return bus
    rate = Machine().bit_rate(str(bus.channel))
    return bus if rate is None else bus.model_copy(update={"bitrate_bit_s": rate})
