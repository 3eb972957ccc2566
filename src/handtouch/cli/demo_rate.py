"""SYNC rate of the demo: as high as this machine holds with simulation, daemon and learning together.

Public names: `lower_rate`, `sustained_period_ms`, `solving_time_s`.
"""

from __future__ import annotations

import os
import sys
import time

import numpy as np

from handtouch.config import Deployment
from handtouch.core.compiled import Compilation
from handtouch.core.contact_solver import VALUE_COUNT, make_solver
from handtouch.core.pad_model import PadModel
from handtouch.host.installation import compile_command

_MAX_LOAD = 0.25
"""Part of a period for solving contacts; the simulated hand and the view share the interpreter."""
_MAX_PERIOD_MS = 1000.0  # longest period that a deployment may state
_MIN_PROCESSORS, _SHARED_PERIOD_MS = 4, 10.0
"""A simulated hand takes 2.2 ms for a sample with touches, on two processors of 2026: at 200 Hz, its nodes
answer too late while the supervisor builds its tables beside it"""
_TRIALS = 5
_CONTACT_RADII = 10.0  # current of a trial's contacts, in thresholds of detection


def lower_rate(deployment: Deployment, model: PadModel) -> Deployment:
    """Return the deployment with a SYNC rate that this machine holds, and report it on stderr if it is lower.

    With few processors the simulated hand, which shares the interpreter, gets half of them at most; with an
    uncompiled core a tick must have the time for a contact on every pad.
    """
    compilation = Compilation.current()
    configured_ms, processors = deployment.daemon.sync_period_ms, len(os.sched_getaffinity(0))
    if compilation.compiled:
        cause, period_ms = f"{processors} processors", configured_ms
        if processors < _MIN_PROCESSORS:
            period_ms = max(configured_ms, _SHARED_PERIOD_MS)
        remedy = "which simulation, daemon and learning hold together; `handtouch run` alone holds more"
    else:
        cause, period_ms = "core uncompiled", sustained_period_ms(configured_ms, solving_time_s(model))
        remedy = f"which this machine holds: {compilation.reason}; {compilation.remedy or compile_command()}"
    if period_ms == configured_ms:
        return deployment
    rates = f"from {1e3 / configured_ms:g} to {1e3 / period_ms:g} Hz"
    print(f"{cause}: SYNC rate lowered {rates}, {remedy}", file=sys.stderr)
    settings = deployment.daemon.model_copy(update={"sync_period_ms": period_ms})
    return deployment.model_copy(update={"daemon": settings})


def sustained_period_ms(configured_ms: float, solving_s: float) -> float:
    """Return the configured SYNC period, doubled until solving all contacts takes at most a quarter of it."""
    period_ms = configured_ms
    while solving_s * 1e3 > _MAX_LOAD * period_ms and 2 * period_ms <= _MAX_PERIOD_MS:
        period_ms *= 2
    return period_ms


def solving_time_s(model: PadModel) -> float:
    """Return the median time of a tick's contacts, one on every pad."""
    currents = np.zeros((model.size, model.channels))
    for row, network in zip(currents, model.networks, strict=True):
        row[: len(network.series_ohm)] = network.fractions(network.a / 3, network.b / 3)
    currents *= _CONTACT_RADII * model.begin_threshold_a[:, None]
    values = np.full((model.size, VALUE_COUNT), np.nan)
    requested = np.ones(model.size, dtype=np.bool_)
    solver = make_solver(model, currents, np.zeros(model.size), requested, values)
    pads = np.arange(model.size, dtype=np.intp).data
    times_s = []
    for _ in range(_TRIALS):
        start_s = time.perf_counter()
        solver.solve_contacts(pads)
        times_s.append(time.perf_counter() - start_s)
    return float(np.median(times_s))
