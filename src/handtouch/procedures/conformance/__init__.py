"""Conformance of sensor nodes on a bus with docs/firmware.md: `handtouch conformance`.

`procedure.run_checks` tests one node over a `Line`, in the line's time, and returns a `NodeReport`; it prints
nothing. `object_checks`, `network_checks`, `pdo_checks` and `operator_checks` are its stages,
`catalogue` lists the checks, `required_objects` the objects that a node needs.
"""

from handtouch.procedures.conformance.catalogue import CATALOGUE
from handtouch.procedures.conformance.line import PortLine
from handtouch.procedures.conformance.procedure import (
    BusInUseError,
    check_bus_is_free,
    compare_serials,
    find_nodes,
    run_checks,
)
from handtouch.procedures.conformance.required_objects import REQUIRED_OBJECTS
from handtouch.procedures.conformance.results import (
    NodeReport,
    Verdict,
    count_verdicts,
)
from handtouch.procedures.conformance.session import ConformanceOptions, NodeUnderTest
from handtouch.procedures.conformance.targets import Targets, select_targets

__all__ = [
    "CATALOGUE",
    "REQUIRED_OBJECTS",
    "BusInUseError",
    "ConformanceOptions",
    "NodeReport",
    "NodeUnderTest",
    "PortLine",
    "Targets",
    "Verdict",
    "check_bus_is_free",
    "compare_serials",
    "count_verdicts",
    "find_nodes",
    "run_checks",
    "select_targets",
]
