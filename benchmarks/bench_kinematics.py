"""Tick time with palm and base frames: 15 pads of the shipped hand, at rest under a steady press.

Cases take turns on the same samples, with joint states at 1 kHz beside them; a case is the pipeline of the
daemon from the last sample to encoded messages. Then the parts by themselves.
Writes docs/benchmarks/kinematics.{md,json}.
"""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.page import made_by, options, output_folder
from handtouch import wire
from handtouch.config import load, shipped
from handtouch.config.tables import SceneRequest
from handtouch.core.link_poses import LinkPoses
from handtouch.core.pad_model import PadModel
from handtouch.core.pipeline import Pipeline
from handtouch.core.scene import ActiveScenes, Demand
from handtouch.daemon.authentication import Authenticator
from handtouch.daemon.inputs import InputReceiver
from handtouch.hand.joints import JointStateBuffer
from handtouch.hand.robot_models import RobotModels
from handtouch.wire.inputs import JointState, decode, encode
from tests.exact_pads import ExactNetworks

PERIOD_NS = 5_000_000
JOINTS_EVERY_NS = 1_000_000
STRENGTH = 20.0  # of the threshold's current
PLAIN = ("position", "force")
STATED = {"mount_std_mm": 0.3, "mount_std_deg": 1.0, "joint_std_deg": 0.3}
EXACT = dict.fromkeys(STATED, 0.0)
CASES: dict[str, tuple[tuple[str, ...], dict[str, float] | None]] = {
    "no URDF": (PLAIN, None),
    "URDF, palm not asked for": (PLAIN, STATED),
    "palm": ((*PLAIN, "palm"), EXACT),
    "palm, uncertain mounts and joints": ((*PLAIN, "palm"), STATED),
    "palm and base": ((*PLAIN, "palm", "base"), EXACT),
    "palm and base, uncertain mounts and joints": ((*PLAIN, "palm", "base"), STATED),
}
"""Outputs, and what the file states of the hand; None: no URDF."""


class Case:
    """A pipeline of the shipped hand in one scene, all of whose messages are encoded."""

    subscriptions = frozenset({b""})

    def __init__(
        self, model: PadModel, robots: RobotModels, described: bool, outputs: tuple[str, ...]
    ) -> None:
        self.pipeline = Pipeline(model, PERIOD_NS, 0.6, self, robots=robots if described else None)
        self.pipeline.node_state[:] = 0
        self.spent: list[int] = []
        self.sent_bytes = 0
        names = list(zip(model.hands, model.links, strict=True))
        self._joints = JointStateBuffer(robots.joint_names[0])
        self.pipeline.transforms.joints_at = lambda _, t_ns: self._joints.interpolate(t_ns)
        Demand(ActiveScenes(SceneRequest(outputs=outputs), names), self, 200.0, self._apply).update(0)  # type: ignore[arg-type]

    def has_subscriber(self, topic: str) -> bool:
        return topic.startswith(("contact/", "hand/"))

    def send(self, message: wire.OutgoingMessage) -> None:
        self.sent_bytes += sum(map(len, wire.encode(message)))

    def _apply(self, demand: Any, *_: Any) -> None:
        self.pipeline.apply_demand(demand)

    def tick(self, t_ns: int, counts: Any) -> None:
        for joints_ns in range(t_ns - PERIOD_NS, t_ns, JOINTS_EVERY_NS):
            angle = 0.5 + 0.4 * np.sin(joints_ns * 1e-9 + np.arange(16))
            self._joints.add_state(joints_ns, self._joints.names, angle)
        pipeline = self.pipeline
        pipeline.begin_cycle(t_ns, t_ns)
        for pad, row in enumerate(counts):
            pipeline.slab.write_pdo(pad, row.tobytes(), t_ns + 1000)
        begin_ns = time.thread_time_ns()
        if pipeline.tick_if_due(t_ns + 2000) is None:  # before the first tick no pad is expected
            pipeline.tick_if_due(t_ns + PERIOD_NS - 1)
        self.spent.append(time.thread_time_ns() - begin_ns)


def measure(touched: int, ticks: int) -> list[dict[str, Any]]:
    """A row a case: median microseconds of a tick, and bytes sent."""
    deployment = load(shipped.path("utah_mit.toml"))
    model = PadModel(deployment)
    cases = {}
    for name, (outputs, stated) in CASES.items():
        hand = deployment.hands[0].model_copy(update=stated or {})
        robots = RobotModels(deployment.model_copy(update={"hands": (hand,)}))
        cases[name] = Case(model, robots, stated is not None, outputs)
    pads = np.arange(model.size)
    exact = ExactNetworks(model)
    share = (
        exact.fractions(pads, *(0.5 * exact.sides).T).T
        * (STRENGTH * model.begin_threshold_a[:, None])
        / model.ampere_per_count
    )
    share[touched:] = 0.0
    chance, order = np.random.default_rng(1), list(cases.values())
    for number in range(ticks + 20):
        counts = np.rint(share + 0.2 * chance.normal(size=share.shape)).astype("<i2")
        for case in order[number % len(order) :] + order[: number % len(order)]:
            case.tick(10**9 + number * PERIOD_NS, counts)
    first = _median_us(cases["no URDF"].spent[20:])
    return [
        {
            "case": name,
            "touched": touched,
            "us": (us := _median_us(case.spent[20:])),
            "more_us": us - first,
            "of_first": us / first,
            "bytes": case.sent_bytes / (ticks + 20),
        }
        for name, case in cases.items()
    ]


def parts(repeats: int) -> dict[str, float]:
    """Microseconds of each part by itself."""
    import zmq

    deployment = load(shipped.path("utah_mit.toml"))
    robots = RobotModels(deployment)
    poses, names = LinkPoses(robots.kinematics[0]), robots.joint_names[0]
    states = JointStateBuffer(names)
    for number in range(64):
        states.add_state(number * JOINTS_EVERY_NS, names, np.full(16, 0.01 * number))
    message = encode(JointState("right", 1, names, np.full(16, 0.5)))
    position, point, std = np.full(16, 0.5), np.array([0.01, 0.0, 0.01]), np.full(16, 0.01)
    clock = iter(range(10**12, 10**15))
    with zmq.Context() as context, Authenticator(context) as authenticator:
        known = {"right": JointStateBuffer(names)}
        pads = [("right", pad.link) for pad in deployment.hands[0].pads]
        inputs = InputReceiver.open(context, "tcp://127.0.0.1:*", authenticator, known, pads)

        def take() -> None:
            now_ns = next(clock)
            topic, payload = message
            inputs.process_message([topic, payload.replace(b"\xa4t_ns\x01", b"\xa4t_ns\xc0")], now_ns)

        def pose() -> None:
            poses.set_joint_positions(position)
            for link in range(5):
                poses.pose_in_palm(link)

        found = {
            "take in a joint state of 16 joints": _each_us(take, repeats),
            "of that, decode it": _each_us(lambda: decode(message), repeats),
            "look for messages, none there": _each_us(lambda: inputs.poll(0), repeats),
            "joints at the time of a sample": _each_us(lambda: states.interpolate(60_500_000), repeats),
            "kinematics of 16 joints": _each_us(lambda: poses.set_joint_positions(position), repeats),
            "kinematics, and the poses of 5 links in the palm": _each_us(pose, repeats),
            "covariance of a point from the joints": _each_us(
                lambda: poses.joint_covariance_m2(0, point, std), repeats
            ),
        }
        assert not inputs.dropped, inputs.problem
        inputs.close()
    return found


def _median_us(spent_ns: list[int]) -> float:
    return float(np.median(spent_ns)) * 1e-3


def _each_us(work: Callable[[], object], repeats: int) -> float:
    spent = []
    for _ in range(repeats):
        begin_ns = time.perf_counter_ns()
        work()
        spent.append(time.perf_counter_ns() - begin_ns)
    return _median_us(spent)


def main() -> None:
    quick = options(__doc__).parse_args().quick
    ticks = 20 if quick else 1000
    rows = [row for touched in (0, 1, 5, 15) for row in measure(touched, ticks)]
    single = parts(200 if quick else 5000)
    text = _page(rows, single)
    print(text)
    out = output_folder(quick)
    (out / "kinematics.md").write_text(text)
    (out / "kinematics.json").write_text(json.dumps({"rows": rows, "parts_us": single}, indent=1) + "\n")


def _page(rows: list[dict[str, Any]], single: dict[str, float]) -> str:
    machine = f"{platform.machine()}, {os.cpu_count()} processors, Python {platform.python_version()}"
    machine += f", load {os.getloadavg()[0]:.0f}"  # others' work cools the caches
    lines = [
        "# Tick time of palm and base frames",
        "",
        "From the last sample to encoded contacts and hand frame, 15 pads of the shipped hand, steady",
        "presses; joint states come at 1 kHz. Cases take turns on the same samples; medians of processor",
        f"time. {machine}.",
        f"{made_by()}.",
        "",
        "| pads touched | case | us a tick | more, us | of the first | bytes a tick |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    lines += [
        f"| {r['touched']} | {r['case']} | {r['us']:.0f} | {r['more_us']:+.0f} | {r['of_first']:.0%} "
        f"| {r['bytes']:.0f} |"
        for r in rows
    ]
    lines += ["", "The parts alone, medians, consecutively with warm caches:", ""]
    lines += ["| part | us |", "| --- | --- |"]
    lines += [f"| {name} | {us:.1f} |" for name, us in single.items()]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
