"""Shear pads of all patterns with a force vector, beneath pads whose force and position are set."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from handtouch.config import Deployment, Shear, parse
from handtouch.core.shear_pads import shear_parameters
from handtouch.core.slab import ChannelField, Slab
from handtouch.core.stages.rows import MOUNT_COUNT, VALUE_SLICES
from handtouch.core.stages.shear import ShearForces, ShearTable
from handtouch.core.state import TickState
from handtouch.field.shear_estimate import ShearPad
from handtouch.hand import mount_transform
from handtouch.wire import ForceStatus, PadState, PositionStatus
from tests.deployments import deployment_text, pad_text

FloatArray = npt.NDArray[np.float64]
PATTERNS = {
    "crossed": '{ kind = "crossed_bars", bars = 2, pitch_mm = 3.4, overlap_mm = 0.6, length_mm = 6.0, '
    "gap_mm = 0.4 }",
    "discs": '{ kind = "discs", discs = 9, radius_mm = 2.0, gap_mm = 0.4 }',
    "pinwheel": '{ kind = "pinwheel", arm_mm = 5.0, overlap_mm = 0.8, length_mm = 5.0 }',
}
NOISE_COUNTS = 1.5
CENTRE_STD_M = 4e-4
LAYOUT = tuple(ChannelField(k // 4, 16 * (k % 4), 16, True) for k in range(8))
FORCE_STD_N = 0.2


def shear_text(name: str, pattern: str) -> str:
    """Return the table of a kind of shear pad."""
    return f"""
[shear.{name}]
pattern = {pattern}
film_mm = 0.15
film_ohm_mm2 = 9000.0
plate_mm = 14.0
stiffness_n_per_mm = [12.0, 10.0]
"""


def shear_deployment(kinds: Sequence[str] = tuple(PATTERNS), extra: str = "") -> str:
    """Return the text of a hand of flat pads, each above a shear pad of one of these kinds.

    extra: further keys of each pad.
    """
    pads = [
        pad_text(
            f"tip{number}",
            number + 1,
            extra=f'shear = "{kind}"\nmount = {{ rpy_deg = [10.0, 20.0, 30.0] }}\n{extra}',
        )
        for number, kind in enumerate(kinds)
    ]
    text = deployment_text(*pads, full_scale_ma=25.0)
    channels = ", ".join(f'"0x6401:{sub}"' for sub in range(1, 9))
    tables = "".join(shear_text(kind, pattern) for kind, pattern in PATTERNS.items())
    return text.replace("[node.n]\n", f"[node.n]\nchannels = [{channels}]\n", 1) + tables


class ShearBench:
    """Pads above shear pads of these kinds, with the state of a tick; nothing detects or locates contacts."""

    def __init__(self, kinds: Sequence[str]) -> None:
        self.deployment: Deployment = parse(shear_deployment(kinds))
        self.pads = len(kinds)
        self.state = TickState.empty(self.pads)
        self.slab = Slab(self.pads, 8)
        for slot in range(self.pads):
            self.slab.set_layout(slot, LAYOUT)
        self.position_status = np.full(self.pads, PositionStatus.VALID, np.uint8)
        self.force_status = np.full(self.pads, ForceStatus.VALID, np.uint8)
        pads = shear_parameters(self.deployment, 4, np.full(self.pads, NOISE_COUNTS))
        self.mounts = np.zeros((self.pads, MOUNT_COUNT))
        tables = [ShearTable(*shear) for shear in pads]
        self.forces = ShearForces(tables, self.state, self.position_status, self.force_status, self.mounts)
        self.state.unverified[:] = False
        self.state.pad_state[:] = PadState.CLEAR

    def shear(self, pad: int) -> Shear:
        """Return the table of a pad's shear pad."""
        return self.deployment.shears[self.deployment.pads[pad].pad.shear or ""]

    def theory(self, pad: int, **keys: Any) -> ShearPad:
        """Return the exact theory of a shear pad."""
        shear = self.shear(pad)
        return ShearPad(shear.build_pattern(), 5.0, shear.build_film(), **keys)

    def counts(self, pad: int, motion: npt.ArrayLike, normal_n: float) -> FloatArray:
        """Return counts (4,) of a shear pad at a displacement (2,) [m] under a central normal force."""
        theory = self.theory(pad)
        whole = np.zeros(len(theory.pattern.components))
        whole[:2] = motion
        assert theory.film is not None
        return theory.currents(whole, theory.film.conductance(normal_n)) * 32767 / 25e-3

    def touch(
        self,
        pad: int,
        normal_n: float | None,
        centre_m: npt.ArrayLike,
        counts: npt.ArrayLike,
        tilt_rad: float = 0.0,
    ) -> None:
        """Set a pad's contact, None for none, and write its sample of shear counts (4,).

        tilt_rad: of the surface there about the pad's y, as of a curved pad.
        """
        state, touching = self.state, normal_n is not None
        state.touching[pad], state.contact_id[pad] = touching, pad + 1 if touching else 0
        values = state.values[pad]
        values[VALUE_SLICES["pad_m"]] = np.array([15e-3, 12e-3]) + centre_m
        values[VALUE_SLICES["force_n"]] = normal_n if normal_n is not None else np.nan
        values[VALUE_SLICES["force_std_n"]] = FORCE_STD_N
        values[VALUE_SLICES["covariance_m2"]] = np.diag([CENTRE_STD_M**2, CENTRE_STD_M**2, 0.0]).ravel()
        rotation, _ = mount_transform(self.deployment.pads[pad].pad)
        values[VALUE_SLICES["normal"]] = rotation @ [np.sin(tilt_rad), 0.0, np.cos(tilt_rad)]
        words = np.concatenate([np.zeros(4), np.rint(counts)]).astype("<i2").tobytes()
        for pdo in range(2):
            self.slab.write_pdo(pad, words[8 * pdo : 8 * pdo + 8], 1, pdo)

    def tick(self) -> int:
        """Run the stage on the present samples of all pads; return how long it took [ns]."""
        self.state.ticks[0] += 1
        self.state.sample_ns[:] += 10_000_000
        self.slab.unpack_counts()
        begin_ns = time.perf_counter_ns()
        self.forces.update_forces(self.slab)
        spent_ns = time.perf_counter_ns() - begin_ns
        self.slab.begin_cycle(2)
        return spent_ns
