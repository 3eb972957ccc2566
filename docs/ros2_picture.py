"""Make docs/ros2_markers.png: the markers that `handtouch bridge ros2` sends, as RViz shows them.

Usage: ros2_picture.py LIVE_ENDPOINT DOMAIN SECONDS, while a daemon and its bridge run. Of the messages
received in that time the one with the most contacts is drawn, on the links' frames at the daemon's joints.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import matplotlib as mpl
import msgpack
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from handtouch.bridge.ros2 import messages as ros
from handtouch.bridge.ros2.network import Quality, RosNetwork
from handtouch.client import connect
from handtouch.record.foxglove import ROOT_FRAME, LinkFrames

PICTURE = Path(__file__).parent / "ros2_markers.png"
TOPIC = "handtouch/right/markers"
SPHERE, ARROW, ADD = 2, 0, 0
FloatArray = NDArray[np.float64]


def receive(endpoint: str, domain: int, seconds: float) -> tuple[list[ros.Marker], dict[str, FloatArray]]:
    """Return the markers of the message with the most, and the poses (4, 4) of the links' frames then."""
    reader = RosNetwork(domain).reader(TOPIC, ros.MarkerArray, Quality.STATE)
    links, best, poses = LinkFrames(), list[ros.Marker](), dict[str, FloatArray]()
    end_s = time.monotonic() + seconds
    with connect("config", "service", "joints/*", endpoint=endpoint, key="") as messages:
        while time.monotonic() < end_s:
            while (parts := messages.recv_unchecked(0.01)) is not None:
                set_state = {b"config": links.set_deployment, b"service": set_links(links)}
                set_state.get(parts[0], links.set_joints)(msgpack.unpackb(parts[1]))
            for received in reader.take(20):
                shown = [one for one in received.markers if one.action == ADD]
                if len(shown) > len(best):
                    best, poses = shown, link_poses(links)
    return best, poses


def set_links(links: LinkFrames) -> Any:
    """Return a function that sets the links of a `service` message."""
    return lambda payload: links.set_links(payload["hands"])


def link_poses(links: LinkFrames) -> dict[str, FloatArray]:
    """Return the pose (4, 4) of every frame in the root."""
    poses = {ROOT_FRAME: np.eye(4)}
    waiting = list(links.frames())
    while waiting:
        frame = waiting.pop(0)
        if frame.parent not in poses:
            waiting.append(frame)
            continue
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(frame.rotation).as_matrix()
        pose[:3, 3] = frame.translation_m
        poses[frame.child] = poses[frame.parent] @ pose
    return poses


def draw(markers: list[ros.Marker], poses: dict[str, FloatArray]) -> None:
    """Draw frames as triads, contacts as points, forces as arrows towards them."""
    mpl.use("agg")
    from matplotlib import pyplot

    figure = pyplot.figure(figsize=(7, 6), layout="constrained")
    axes = figure.add_subplot(projection="3d")
    for pose in poses.values():
        for axis, axis_colour in enumerate(("tab:red", "tab:green", "tab:blue")):
            line = np.stack([pose[:3, 3], pose[:3, 3] + 0.008 * pose[:3, axis]])
            axes.plot(*line.T, color=axis_colour, lw=1, alpha=0.6)
    for marker in markers:
        pose = poses[marker.header.frame_id]
        colour = (marker.color.r, marker.color.g, marker.color.b)
        if marker.type == ARROW:
            tail, tip = ([*pose @ [point.x, point.y, point.z, 1.0]][:3] for point in marker.points)
            axes.quiver(*tail, *np.subtract(tip, tail), color=colour, arrow_length_ratio=0.3, lw=2)
        elif marker.type == SPHERE and marker.ns == "contact":
            at = marker.pose.position
            axes.scatter(*(pose @ [at.x, at.y, at.z, 1.0])[:3], color=[colour], s=30)
            axes.text(*(pose @ [at.x, at.y, at.z, 1.0])[:3], f"  {marker.header.frame_id}", fontsize=7)
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    axes.set_aspect("equal")
    figure.savefig(PICTURE, dpi=90)


if __name__ == "__main__":
    found, frames = receive(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]))
    print(f"{len(found)} markers on {len({marker.header.frame_id for marker in found})} links")
    draw(found, frames)
