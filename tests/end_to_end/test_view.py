"""The page in a real browser, with real daemon and nodes: contacts are drawn at their positions."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from numpy.typing import NDArray

from handtouch import Robot, config
from handtouch.config import shipped
from handtouch.core.stages.kinematics import LinkPoses
from handtouch.hand.kinematics import HandKinematics
from handtouch.hand.pads import mount_transform, pad_surface
from handtouch.hand.urdf import read_urdf

TOUCHES = {"index_distal": (0.5, 0.5), "palm_fingers": (0.25, 0.7)}
"""Link -> fractions of its pad."""
SCENARIO = "repeat = true\npause_s = 0.1\n" + "".join(
    f'[[touch]]\nlink = "{link}"\nfrom_s = 0.1\nduration_s = 60.0\npath = [[{x}, {y}]]\nforce_n = [1.5]\n'
    for link, (x, y) in TOUCHES.items()
)
ANGLES = {"index_mcp": 0.3, "index_pip": 0.2, "index_dip": 0.1, "thumb_cmc": -0.2}
ORANGE, RED, GREEN = (255, 90, 31), (229, 72, 77), (79, 165, 139)


class Browser:
    """Chromium, driven by tests/javascript/browser.mjs."""

    def __init__(self, folder: Path, chromium: str) -> None:
        self._process = subprocess.Popen(
            ["node", str(folder / "browser.mjs"), chromium],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def ask(self, **command: Any) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(command) + "\n")
        self._process.stdin.flush()
        answer = json.loads(self._process.stdout.readline())
        assert "error" not in answer, (command, answer)
        return answer["value"]

    def wait(self, expression: str) -> None:
        self.ask(wait=expression)

    def evaluate(self, expression: str) -> Any:
        return self.ask(evaluate=expression)

    def picture(self, path: Path) -> NDArray[np.float64]:
        """Return a screenshot, (rows, columns, 3), 0 to 255."""
        self.ask(screenshot=str(path))
        return np.asarray(imread(path)[:, :, :3] * 255.0, np.float64)

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()


@pytest.fixture
def browser(javascript: Path, chromium: str) -> Iterator[Browser]:
    opened = Browser(javascript, chromium)
    yield opened
    opened.close()


def start_view(rig: Any, port: int) -> str:
    """Start `handtouch view` and return the URL that it prints."""
    with (rig.folder / "view.txt").open("a") as output:
        command = [sys.executable, "-m", "handtouch", "view", "--key", "", "--port", str(port)]
        rig.processes["view"] = subprocess.Popen(
            [*command, "--endpoint", rig.endpoints["live"]],
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    end_s = time.monotonic() + 60
    while "http" not in rig.printed("view"):
        assert time.monotonic() < end_s, rig.all_printed()
        time.sleep(0.02)
    words: list[str] = rig.printed("view").split()
    return next(word for word in words if word.startswith("http"))


def expected_m(link: str) -> NDArray[np.float64]:
    """Return the position of a touch in the base frame: on the mounted pad, by the kinematics."""
    deployment = config.load(shipped.path("utah_mit.toml"))
    pad = next(pad for pad in deployment.hands[0].pads if pad.link == link)
    surface, (rotation, at) = pad_surface(pad), mount_transform(pad)
    x, y = TOUCHES[link]
    robot = read_urdf(shipped.path("utah_mit.urdf"))
    kinematics = HandKinematics(robot, [link], "palm", robot.root)
    poses = LinkPoses(kinematics)
    poses.set_joint_positions(np.array([ANGLES.get(name, 0.0) for name in kinematics.joints]))
    pose = poses.pose_in_base(0)
    on_link = rotation @ surface.point(x * surface.a, y * surface.b) + at
    return np.asarray(pose.rotation @ on_link + pose.translation_m)


def pixel_of(browser: Browser, point_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixel of a point of the world."""
    camera = browser.evaluate(
        "(() => { const { view, projection } = handtouch.hand.cameraMatrices();"
        "const box = document.getElementById('hand').getBoundingClientRect();"
        "return { view: [...view], projection: [...projection], size: [box.width, box.height] } })()"
    )
    view, projection = (np.reshape(camera[name], (4, 4)).T for name in ("view", "projection"))
    clip = projection @ view @ [*point_m, 1.0]
    x, y = clip[:2] / clip[3]
    return np.asarray(np.array([(x + 1) / 2, (1 - y) / 2]) * camera["size"])


def middle_of(picture: NDArray[np.float64], colour: tuple[int, ...], near: NDArray[np.float64]) -> Any:
    """Return the number of pixels of a colour within 12 px of a point, and the nearest one's distance."""
    rows, columns = np.nonzero(np.abs(picture - colour).max(axis=2) < 12)
    far = np.hypot(columns - near[0], rows - near[1])
    return np.count_nonzero(far < 12), far.min() if len(far) else np.inf


def picture_of_contacts(browser: Browser, path: Path) -> tuple[NDArray[np.float64], dict[str, Any]]:
    """Return a picture and what `middle_of` finds in it at each touch; the first that shows them all.

    Where drawing is slow, a picture may be of a frame before the last change of joints or layout.
    """
    for _ in range(20):
        drawn = browser.evaluate("handtouch.counts.frames")
        browser.wait(f"handtouch.counts.frames > {drawn}")
        picture = browser.picture(path)
        markers = {link: middle_of(picture, ORANGE, pixel_of(browser, expected_m(link))) for link in TOUCHES}
        if all(count > 20 for count, _ in markers.values()):
            break
    return picture, markers


def hue_of(picture: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    column, row = at.round().astype(int)
    colour = picture[row - 1 : row + 2, column - 1 : column + 2].mean(axis=(0, 1))
    return np.asarray(colour / np.linalg.norm(colour))


def check_tooltips(browser: Browser, unrolled: list[float]) -> None:
    """A pad's tooltip opens where the pointer or the keyboard reaches it, and closes when they leave."""
    tooltip = "document.getElementById('tooltip')"
    browser.ask(move=unrolled)
    browser.wait(f"!{tooltip}.hidden && {tooltip}.textContent.includes('palm_fingers: ok')")
    browser.ask(move=browser.evaluate("handtouch.hand.pixelsOf('right/palm_heel')"))
    browser.wait(f"!{tooltip}.hidden && {tooltip}.textContent.includes('palm_heel: ok')")
    browser.ask(move=[browser.evaluate("innerWidth") - 2, 2])
    browser.wait(f"{tooltip}.hidden")
    browser.evaluate("document.querySelector('#nodes button').focus()")
    browser.wait(f"!{tooltip}.hidden && {tooltip}.textContent.includes('thumb_proximal')")
    before = browser.evaluate("handtouch.hand.view.azimuth")
    browser.evaluate("document.getElementById('hand').focus()")
    browser.wait(f"{tooltip}.hidden")
    browser.ask(press="ArrowLeft")
    browser.wait(f"handtouch.hand.view.azimuth !== {before}")
    browser.ask(press="0")
    browser.wait(f"handtouch.hand.view.azimuth === {before}")


@pytest.mark.timeout(300)  # the browser renders in software, on a machine under load
def test_contacts_are_drawn_at_their_positions_and_the_page_survives_restarts(
    rig: Any, browser: Browser, free_port: int, tmp_path: Path
) -> None:
    rig.scenario.write_text(SCENARIO)
    rig.simulate()
    rig.start("run")
    browser.ask(open=start_view(rig, free_port))  # it waits for the daemon
    rig.wait_operational()
    with Robot(rig.endpoints["inputs"], key="") as robot:
        while not browser.evaluate("Boolean(handtouch.state.joints.right?.index_mcp)"):
            robot.send_joints("right", ANGLES)
            time.sleep(0.05)
    touched = " && ".join(f"handtouch.state.contacts['right/{link}']?.position_m" for link in TOUCHES)
    all_clear = "Object.values(handtouch.state.pads).every((pad) => pad.status === 'clear')"
    browser.wait(f"{touched} && {all_clear}")
    picture, markers = picture_of_contacts(browser, tmp_path / "touched.png")
    for link, (count, nearest) in markers.items():
        assert count > 20, link
        assert nearest < 2.5, link
    left, top, wide, high = browser.evaluate("handtouch.pads.boxes['right/palm_fingers']")
    x0, y0 = browser.evaluate("(({x, y}) => [x, y])(document.getElementById('pads').getBoundingClientRect())")
    x, y = TOUCHES["palm_fingers"]
    unrolled = np.array([x0 + left + (1 - y) * wide, y0 + top + (1 - x) * high])  # x points up, y to the left
    assert middle_of(picture, ORANGE, unrolled)[1] < 1.5
    mirrored = np.array([x0 + left + y * wide, y0 + top + x * high])
    assert middle_of(picture, ORANGE, mirrored)[0] == 0
    heel = np.array(browser.evaluate("handtouch.hand.pixelsOf('right/palm_heel')"))
    green = np.array(GREEN) / np.linalg.norm(GREEN)
    assert hue_of(picture, heel) @ green > 0.99

    check_tooltips(browser, [x0 + left + wide / 2, y0 + top + high / 2])

    rig.processes["run"].kill()
    rig.processes.pop("run").wait()
    browser.wait("document.getElementById('trouble').textContent.includes('daemon disconnected')")
    assert browser.evaluate("Object.values(handtouch.state.contacts).every((contact) => !contact)")
    browser.wait("document.getElementById('up').textContent.startsWith('last known: ')")
    rig.start("run")
    browser.wait(f"document.getElementById('trouble').hidden && {touched}")
    browser.wait("!document.getElementById('up').textContent.includes('known')")
    assert "daemon restarted" in browser.evaluate("JSON.stringify(handtouch.state.messages)")

    rig.end("simulate")
    browser.wait("handtouch.state.pads['right/palm_heel'].status === 'lost'")
    drawn = browser.evaluate("handtouch.counts.frames")
    browser.wait(f"handtouch.counts.frames > {drawn}")
    red = np.array(RED) / np.linalg.norm(RED)
    assert hue_of(browser.picture(tmp_path / "lost.png"), heel) @ red > 0.99
    chips = browser.evaluate("[...document.querySelectorAll('#nodes button')].map((chip) => chip.ariaLabel)")
    statuses = browser.evaluate("Object.values(handtouch.state.pads).map((pad) => pad.status)")
    assert "palm_heel: lost, node absent" in chips
    lost = statuses.count("lost")
    assert sum(": lost" in chip for chip in chips) == lost
    assert f"{lost} lost" in browser.evaluate("document.getElementById('up').textContent")
    assert "lost: " in browser.evaluate("document.getElementById('messages').textContent")

    assert rig.end("view") == 0
    browser.wait("!handtouch.state.connected")
    start_view(rig, free_port)
    browser.wait("handtouch.state.connected && handtouch.state.pads['right/palm_heel'].status === 'lost'")
    assert browser.ask(errors=True) == []
