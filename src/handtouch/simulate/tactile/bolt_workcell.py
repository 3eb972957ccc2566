"""A hand with touch, an arm and a bolt, as a controller has them: commands, reported joints and touch.

Public names: `BoltWorkcell`, `Sensed`; `ServedTouch`, the same touch by the real daemon: nodes on a bus, and
a client of its messages.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import tomlkit
from numpy.typing import NDArray

from handtouch import config
from handtouch.arrays import FloatArray
from handtouch.client.hand import Hand
from handtouch.client.hand_arrays import HandArrays
from handtouch.client.subscriber import Subscriber, connect
from handtouch.config import shipped
from handtouch.simulate.tactile.bolt_scene import Bolt, BoltScene, BoltStart
from handtouch.simulate.tactile.nodes import TactileNodes
from handtouch.simulate.tactile.reading import TactileReading
from handtouch.simulate.tactile.sensor import TactileSensor
from handtouch.simulate.worlds import world_named
from handtouch.wire import COLUMNS, HandFrame, PadState, Percept

_WINDOW = 0.9  # of the period, for the nodes' answers
_GROUP = "239.74.163.47"
_TIMEOUT_S = 300.0


class ServedTouch:
    """Reads as `TactileSensor` what a daemon publishes, which samples simulated nodes over a bus; close it.

    The daemon is `handtouch run` with the shipped hand's file, sheets and nodes as the deployment states
    them, and a SYNC period `slower` times as long: nodes and daemon live in slow motion, and the simulation's
    time passes by `period_s` a reading. It waits for a sample of every pad. The bus is UDP multicast on this
    machine. Raises BusError where it can't be opened, TimeoutError for a daemon that publishes nothing.
    """

    def __init__(self, deployment: config.Deployment, model: Any, world: str, seed: int, slower: int) -> None:
        self.links = deployment.pad_names
        self.period_s = 1e-3 * deployment.daemon.sync_period_ms
        self.steps = round(self.period_s / model.opt.timestep)
        self.repeated = 0
        """readings for which the simulation came late, so that nodes sampled its contacts again"""
        with ExitStack() as stack:
            folder = stack.enter_context(TemporaryDirectory(prefix="handtouch-bolt-"))
            file = _served(deployment, Path(folder), slower)
            served = config.load(file)
            self._nodes = stack.enter_context(TactileNodes(served, model, world, seed))
            process = subprocess.Popen([sys.executable, "-m", "handtouch", "run", str(file)])
            stack.callback(process.wait)
            stack.callback(process.terminate)
            daemon, (hand,) = served.daemon, served.hands
            self._hand = stack.enter_context(
                Hand(hand.name, endpoint=daemon.live, control=daemon.control, key="", max_age_s=_TIMEOUT_S)
            )
            self._seq = -1
            self._await(lambda arrays: bool((arrays.state.array == PadState.CLEAR).all()))
            self._motions: Subscriber[Percept] = stack.enter_context(
                connect("percept/*/motion", endpoint=daemon.live, key="")
            )
            self._labels = dict.fromkeys(self.links, "")
            self._stack = stack.pop_all()

    def close(self) -> None:
        """Stop daemon and nodes."""
        self._stack.close()

    @property
    def sliding(self) -> NDArray[np.bool_]:
        """Pads (1, p) that the daemon's percepts report as sliding by now."""
        while (motion := self._motions.recv(0.0)) is not None:
            self._labels[f"{motion.hand}/{motion.link}"] = motion.label
        return np.array([[label == "sliding" for label in self._labels.values()]])

    def read(self, data: Any) -> TactileReading:
        """Return the frame of the first SYNC from now on, at the contacts of an MjData."""
        self._nodes.update(data)
        now_ns, before = time.monotonic_ns(), self._seq
        arrays = self._await(lambda arrays: arrays.t_ns >= now_ns and bool(arrays.sampled.array.all()))
        self._seq = arrays.frame.seq
        self.repeated += before >= 0 and self._seq > before + 1
        return _reading(arrays)

    def _await(self, fits: Callable[[HandArrays], bool]) -> HandArrays:
        end_s = time.monotonic() + _TIMEOUT_S
        while time.monotonic() < end_s:
            if (arrays := self._hand.wait(1.0)) and fits(arrays):
                return arrays
        raise TimeoutError(f"the daemon published no such frame within {_TIMEOUT_S:g} s")


def _reading(arrays: HandArrays) -> TactileReading:
    """Return a frame's columns as arrays; NaN in those that no scene requests."""
    pads = len(arrays.links)
    found: dict[str, Any] = {"counts": np.zeros((pads, 4), np.int64)}
    for name in (field.name for field in fields(TactileReading) if field.name != "counts"):
        column, data = COLUMNS[HandFrame][name], getattr(arrays.frame, name)
        shape = {1: (pads,), 9: (pads, 3, 3)}.get(column.elements, (pads, column.elements))
        found[name] = column.to_array(data).reshape(shape) if data else np.full(shape, np.nan, np.float32)
    return TactileReading(**found)


def _served(deployment: config.Deployment, folder: Path, slower: int) -> Path:
    """Write the shipped hand's file, with what a deployment states of sheets and nodes, in slow motion.

    Its bus is on this machine, its endpoints are in the folder. Return its path.
    """
    shipped = config.shipped.path("utah_mit.toml")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("", 0))
        port = free.getsockname()[1]
    document: Any = tomlkit.parse(shipped.read_text())
    for bus in document["bus"]:
        bus |= {"interface": "udp_multicast", "channel": _GROUP, "options": {"port": port}}
    for name, sheet in deployment.sheets.items():
        document["sheet"][name] = sheet.model_dump(exclude_defaults=True)
    for name, node in deployment.nodes.items():
        slow = {key: slower * getattr(node, key) for key in ("heartbeat_ms", "heartbeat_timeout_ms")}
        document["node"][name] = node.model_dump(exclude_defaults=True) | slow
    for hand in document["hand"]:
        hand["urdf"] = str(shipped.parent / hand["urdf"])
    document["daemon"] |= {
        name: f"ipc://{folder}/{name}" for name in ("live", "complete", "control", "inputs")
    }
    document["daemon"] |= {"sample_window_fraction": _WINDOW, "log_level": "error"}
    document["daemon"]["sync_period_ms"] = slower * deployment.daemon.sync_period_ms
    path = folder / "hand.toml"
    path.write_text(tomlkit.dumps(document))
    return path


Pose = tuple[FloatArray, FloatArray]
"""Position (3,) and rotation (3, 3)."""
PERIOD_MS = 10.0
"""Of SYNC: half the shipped rate is enough for this task."""


class Sensed(NamedTuple):
    """What is known after a command."""

    joint_rad: FloatArray
    """(m,), reported positions of the hand's joints, in the order of `BoltWorkcell.joints`"""
    touch: TactileReading
    sliding: NDArray[np.bool_]
    """(p,), pads whose contact slid by the reading before"""


class BoltWorkcell:
    """The shipped hand in a world of a seed, and a bolt on a table.

    Each `move` commands the arm's flange and the hand's joints for one SYNC period, and returns what encoders
    and pads report at its end. Motors follow their encoders, whose zeros the world draws. The pads' counts go
    through the daemon's pipeline, in this process; `slower` given: over a bus and by a daemon,
    as `ServedTouch` states; `close` stops it. `scene` has the truth, which a controller doesn't get.
    """

    def __init__(
        self,
        seed: int,
        start: BoltStart,
        world: str = "default",
        clearance_m: float = 1e-3,
        *,
        bolt: Bolt | None = None,
        slower: int = 0,
    ) -> None:
        drawn = world_named(world).draw(seed)
        deployment = drawn.describe(config.load(shipped.path("utah_mit.toml")))
        daemon = deployment.daemon.model_copy(update={"sync_period_ms": PERIOD_MS})
        deployment = deployment.model_copy(update={"daemon": daemon})
        hand = deployment.hands[0]
        self.urdf = str(hand.urdf)
        self.scene = BoltScene(hand, drawn, start, clearance_m, bolt)
        self.joints = self.scene.joints
        of = (deployment, self.scene.model, world, seed)
        self.touch = ServedTouch(*of, slower) if slower else TactileSensor(*of, detects_slip=True)
        self.links = tuple(link.partition("/")[2] for link in self.touch.links)
        self.period_s = self.touch.period_s
        errors = drawn.joints(hand.name, len(self.joints))
        self._zero_rad, self._noise_rad = np.radians(errors.offset_deg), np.radians(errors.noise_deg)
        self._delay_steps = min(round(1e3 * errors.delay_s), self.touch.steps)
        self._begin_noise(seed)

    def close(self) -> None:
        """Stop the daemon, if there is one."""
        if isinstance(self.touch, ServedTouch):
            self.touch.close()

    def restart(self, start: BoltStart, seed: int) -> None:
        """Begin again with the bolt elsewhere, and the same hand; `seed` chooses the noise.

        What follows is the same as after any other restart with them. Raises ValueError for a cell with a
        daemon, which can't begin again.
        """
        if isinstance(self.touch, ServedTouch):
            raise ValueError("a cell with a daemon can't begin again: make another one")
        self.scene.restart(start)
        self.touch.restart(seed)
        self._begin_noise(seed)

    def _begin_noise(self, seed: int) -> None:
        self._rng = np.random.default_rng((seed, 48))

    def start_at(self, flange: Pose, joint_rad: FloatArray) -> None:
        """Put flange and joints somewhere at once, before the first `move`."""
        self.scene.place_arm(*flange, joint_rad - self._zero_rad)

    def move(self, flange: Pose, joint_rad: FloatArray) -> Sensed:
        """Command a pose of the flange and joint positions (m,); return the state a SYNC period later."""
        scene = self.scene
        scene.arm, scene.target_rad = flange, joint_rad - self._zero_rad
        scene.step(self.touch.steps - self._delay_steps)
        noise_rad = self._noise_rad * self._rng.normal(size=len(self.joints))
        reported_rad = scene.joint_rad + self._zero_rad + noise_rad
        if self._delay_steps:
            scene.step(self._delay_steps)
        (sliding,) = self.touch.sliding  # as percepts follow the frames
        return Sensed(reported_rad, self.touch.read(scene.data), sliding)
