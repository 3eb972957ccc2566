"""Print a digest of contacts in palm and base at many joint states: `python frames_many.py COUNT`."""

from __future__ import annotations

import hashlib
import sys

import numpy as np

from handtouch.config import load, shipped
from handtouch.core.columns import PadColumns, TickResult
from handtouch.core.stages import frames
from handtouch.core.stages.frames import ContactTransforms
from handtouch.core.state import TickState
from handtouch.hand.joints import JointSnapshot
from handtouch.hand.robot_models import RobotModels


def main(count: int) -> None:
    """Transform contacts of the shipped hand, some at unknown positions or joints, that come and go."""
    rng, deployment = np.random.default_rng(5), load(shipped.path("utah_mit.toml"))
    robots = RobotModels(deployment)
    n, m = len(deployment.hands[0].pads), len(robots.joint_names[0])
    state, everything = TickState.empty(n), np.ones(n, dtype=np.bool_)
    transforms, columns = ContactTransforms(["right"] * n, robots, state), PadColumns.of_state(state)
    transforms.set_requested(everything, everything)
    digest, none = hashlib.sha256(), np.zeros(0, dtype=np.intp)

    def joints_at(_: str, t_ns: int) -> JointSnapshot:
        age_s = np.where(rng.uniform(size=m) < 0.01, np.inf, rng.exponential(0.03, m))
        position = np.where(np.isinf(age_s), np.nan, rng.uniform(-2, 2, m))
        return JointSnapshot(t_ns, position, age_s, rng.choice([0.0, 0.01], m))

    transforms.joints_at = joints_at
    for number in range(1, -(-count // n) + 1):
        pads = np.flatnonzero(rng.uniform(size=n) < 0.7)
        state.contact_id[:] = 0
        state.contact_id[pads] = 1 + pads + n * (number // 3)
        state.sample_ns[:] = 10 * number + rng.integers(0, 2, n)
        columns.position_m[:], columns.normal[:] = 0.03 * rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
        columns.covariance_m2[:] = rng.normal(size=(n, 3, 3))
        columns.position_m[rng.uniform(size=n) < 0.05] = np.nan
        transforms.transform_updated(TickResult(0, none, pads, none, none))
        digest.update(np.nan_to_num(state.palm_values, nan=-7.0, posinf=-8.0).tobytes())
        for result in (state.palm_status, state.palm_rotation, state.joint_variance_m2, state.group_id):
            digest.update(np.nan_to_num(result, nan=-7.0).tobytes())
        digest.update(b"".join(transforms.hand_columns(slice(0, n)).values()))
    print("compiled" if frames.__file__.endswith(".so") else "interpreted", digest.hexdigest())


if __name__ == "__main__":
    main(int(sys.argv[1]))
