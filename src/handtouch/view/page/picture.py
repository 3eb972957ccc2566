"""What the page shows, kept up to date by messages; every page is told what changed since it was told last.

Public names: `Board`, `Picture`. No clock, no socket. Values are plain, for JSON.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from handtouch import wire
from handtouch.client import columns
from handtouch.config import Deployment
from handtouch.view.lines import DOUBTED, finding_text
from handtouch.view.page.felt import Felt
from handtouch.view.page.layout import describe

FloatArray = NDArray[np.float64]
_MESSAGES = 60
_STATES = tuple(state.name.lower() for state in wire.PadState)
_WELL = ("clear", "touched")
_ILL = ("stale", "lost", "faulted")
_AT_ONCE_NS = 1_000_000_000
_SURE = 2.4477
"""Half axes of the ellipse that holds a Gaussian of two dimensions with 95 %, in standard deviations."""


class Board:
    """Values by key, each with the number of the change that made it so."""

    def __init__(self) -> None:
        self.changes = 0
        self._kept: dict[str, tuple[int, Any]] = {}

    def put(self, key: str, value: Any) -> None:
        """Keep a value; nothing happens if it is the same as before."""
        if key not in self._kept or self._kept[key][1] != value:
            self.changes += 1
            self._kept[key] = self.changes, value

    def drop(self, prefix: str) -> None:
        """Have no value for the keys that begin so: None."""
        for key in [key for key in self._kept if key.startswith(prefix)]:
            self.put(key, None)

    def since(self, change: int) -> dict[str, Any]:
        """What has changed after that change."""
        return {key: value for key, (number, value) in self._kept.items() if number > change}


class Picture:
    """Takes messages by `take`; `step` puts what they come to on `board`, for the pages.

    `percepts`: whether they were subscribed to; without, the page says how to have them.

    Keys of the board: `scene` (as `layout.describe`), `joints/<hand>`, `pad/<hand>/<link>`,
    `contact/<hand>/<link>` (None: not touched), `felt/<hand>/<link>` (as `Felt.told`), `percepts`, `service`,
    `alive`, `messages`, `t` (seconds).
    """

    def __init__(self, percepts: bool = False) -> None:
        self.board = Board()
        self.board.put("percepts", percepts)
        self._run: int | None = None
        self._deployment = ""
        self._frames: dict[str, wire.HandFrame] = {}
        self._passing: dict[str, tuple[wire.HandFrame, int]] = {}
        self._health: dict[str, wire.Health] = {}
        self._felt = Felt()
        self._ill: dict[str, tuple[str, str]] = {}
        self._told: deque[dict[str, Any]] = deque(maxlen=_MESSAGES)
        self._wall_offset_ns = 0
        self._told_ns = 0

    def take(self, message: wire.Message) -> None:
        """Take in a message of any topic."""
        if self._run is not None and message.run != self._run:
            self._forget(message.t_ns)
        self._run = message.run
        if isinstance(message, wire.HandFrame):
            self._take_frame(message)
        elif isinstance(message, wire.Joints):
            angles = zip(message.names, message.position_rad, strict=False)
            known = {name: round(angle, 4) for name, angle in angles if angle is not None}
            self.board.put(f"joints/{message.hand}", known)
        elif isinstance(message, wire.Percept):
            self._felt.take(message)
        elif isinstance(message, wire.Health):
            self._take_health(message)
        elif isinstance(message, wire.Service):
            self._wall_offset_ns = message.wall_offset_ns
            self.board.put("service", _service(message))
        elif isinstance(message, wire.Config):
            self._take_config(message)

    def step(self, alive: bool) -> None:
        """Put what was taken since the last step on the board; `alive`: was the daemon heard lately."""
        self.board.put("alive", alive)
        if not alive:
            self._frames.clear()
            self._passing.clear()
            self._felt.clear()
            self.board.drop("contact/")
            self.board.drop("felt/")
            return
        touched: dict[str, int] = {}
        for hand, frame in self._frames.items():
            told = columns(frame)
            for row, link in enumerate(frame.links):
                key = f"{hand}/{link}"
                self._put_pad(key, _STATES[told["state"][row]] if told["state"][row] < 7 else "faulted")
                touched[key] = int(told["contact"][row])
                last = (frame, row) if touched[key] else self._passing.get(key)
                self.board.put(f"contact/{key}", _contact(*last) if last else None)
            self.board.put("t", round(frame.t_ns * 1e-9, 3))
        if self._frames:
            now_ns = max(frame.t_ns for frame in self._frames.values())
            for key, felt in self._felt.told(touched, now_ns).items():
                self.board.put(f"felt/{key}", felt)
        self._frames.clear()
        self._passing.clear()

    def _take_frame(self, frame: wire.HandFrame) -> None:
        """A touch that is over before the next step is shown in that all the same."""
        before = self._frames.get(frame.hand)
        if before is not None and before.links == frame.links:
            was, now = columns(before)["contact"], columns(frame)["contact"]
            for row in np.flatnonzero((was != 0) & (was != now)).tolist():
                self._passing[f"{frame.hand}/{frame.links[row]}"] = before, row
        self._frames[frame.hand] = frame

    def _take_config(self, message: wire.Config) -> None:
        told = f"{message.deployment}{sorted(message.files)}"
        if told == self._deployment:
            return
        self._deployment = told
        try:
            deployment = Deployment.model_validate_json(message.deployment)
        except ValidationError as error:
            self._tell(message.t_ns, f"the daemon's deployment can't be read here: {error}", "lost")
            return
        scene = describe(deployment, message.files)
        self.board.put("scene", scene)
        for problem in scene["problems"]:
            self._tell(message.t_ns, problem, "stale")

    def _take_health(self, health: wire.Health) -> None:
        key = f"{health.hand}/{health.link}"
        before, self._health[key] = self._health.get(key), health
        if health.state in _ILL and self._ill.get(key) != (health.state, health.reason):
            self._ill[key] = health.state, health.reason
            why = f": {health.reason}" if health.reason else f", node {health.node}"
            self._tell(health.t_ns, f"{health.state}{why}", health.state, health.link)
        elif health.state in _WELL and key in self._ill:
            del self._ill[key]
            self._tell(health.t_ns, "well again", "clear", health.link)
        known = {finding.get("kind") for finding in before.findings} if before else set()
        for finding in health.findings:
            if finding.get("kind") not in known:
                self._tell(health.t_ns, finding_text(finding), "doubted", health.link)
        if before and before.trust in DOUBTED and health.trust not in DOUBTED:
            self._tell(health.t_ns, f"{health.trust} again", "clear", health.link)
        self._put_pad(key, health.state)

    def _put_pad(self, key: str, state: str) -> None:
        """State and health of a pad, as its colour tells them."""
        health = self._health.get(key)
        told: dict[str, Any] = {"state": state, "look": "clear" if state == "touched" else state}
        if health is not None:
            doubted = health.trust in DOUBTED or health.findings
            if doubted and state in _WELL:
                told["look"] = "doubted"
            told |= {
                "node": health.node,
                "hz": round(health.rate_hz),
                "reason": health.reason,
                "findings": [finding_text(finding) for finding in health.findings],
                "trust": health.trust,
                "calibrating": health.calibrating,
            }
        self.board.put(f"pad/{key}", told)

    def _forget(self, t_ns: int) -> None:
        """The daemon restarted: what it said before is void; how the hand looks may still be true."""
        self._frames.clear()
        self._passing.clear()
        self._health.clear()
        self._ill.clear()
        self._felt.clear()
        self.board.drop("contact/")
        self.board.drop("felt/")
        self._tell(t_ns, "the daemon was started anew", "starting")

    def _tell(self, t_ns: int, text: str, look: str, link: str = "") -> None:
        """A line for people; what befalls several pads at once is one."""
        last = self._told[-1] if self._told else None
        links = [link] if link else []
        if (
            last
            and link
            and (last["text"], last["look"]) == (text, look)
            and t_ns - self._told_ns < _AT_ONCE_NS
        ):
            self._told.pop()
            links = [*last["links"], *(links if link not in last["links"] else [])]
        self._told_ns = t_ns
        at_s = round((t_ns + self._wall_offset_ns) * 1e-9, 2) if self._wall_offset_ns else None
        self._told.append({"at_s": at_s, "links": links, "text": text, "look": look})
        self.board.put("messages", list(self._told))


def _service(service: wire.Service) -> dict[str, Any]:
    supervisor = service.supervisor or {}
    return {
        "version": service.version,
        "rate_hz": round(service.rate_hz),
        "tick_us": service.tick_us.get("p50"),
        "drops": sum(service.drops.values()),
        "overruns": service.overruns,
        "supervisor": supervisor.get("state"),
        "buses": {
            name: {
                "load": round(bus.get("load", 0.0), 2),
                "state": bus.get("state", "?"),
                "problem": bus.get("problem", ""),
            }
            for name, bus in sorted(service.buses.items())
        },
    }


def _contact(frame: wire.HandFrame, row: int) -> dict[str, Any]:
    """A touch, with the half axes of the ellipse that holds its place with 95 %, link frame."""
    told = columns(frame)
    position = told["position_m"][row]
    value: dict[str, Any] = {
        "id": int(told["contact"][row]),
        "force_n": _number(told["force_n"][row], 3),
        "force_std_n": _number(told["force_std_n"][row], 3),
        "saturated": bool(told["saturated"][row]),
        "unestimated": bool(told["unestimated"][row]) if "unestimated" in told else False,
    }
    if np.isfinite(position).all():
        variance, axes = np.linalg.eigh(np.nan_to_num(told["covariance_m2"][row]).reshape(3, 3).astype(float))
        half = axes * (_SURE * np.sqrt(np.maximum(variance, 0.0)))
        value |= {
            "at": _vector(position),
            "normal": _vector(told["normal"][row]),
            "axes": [_vector(half[:, 2]), _vector(half[:, 1])],
            "pad_m": _vector(told["pad_m"][row]),
        }
    return value


def _vector(values: FloatArray) -> list[float]:
    return [round(value, 7) for value in values.tolist()]


def _number(value: float, digits: int) -> float | None:
    return round(float(value), digits) if np.isfinite(value) else None
