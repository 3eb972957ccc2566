"""A pad as a running daemon serves it: its hand frames as samples, tare and calibration by control.

Public name: `ServedPad`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Self

from handtouch import client, wire
from handtouch.calibrate.session import Sample
from handtouch.supervise.calibration import Law

_SILENCE_S = 0.5
_LEASE_S = 60.0
_TARE_S = 60.0


@dataclass(frozen=True)
class Asked:
    """Where the daemon is."""

    live: str
    control: str
    key: str | None


class ServedPad:
    """The pad `hand`/`link` of the daemon; while it is open, a scene of its own keeps the pad working.

    `serial` is that of its node, None until it is told or where there is none; `zero`: mean counts and their
    variances (4,) of the last tare. Raises what `client.request` does.
    """

    def __init__(self, asked: Asked, hand: str, link: str) -> None:
        self.name = f"{hand}/{link}"
        self.serial: int | None = None
        self.zero: tuple[list[float], list[float]] | None = None
        self._asked, self._hand, self._link = asked, hand, link
        self._t_ns = 0
        self._leased_s = -math.inf
        self.present = self._request("calibrate", pad=self.name)
        self._hold()
        self._messages = client.connect(
            f"hand/{hand}", f"health/{hand}/{link}", endpoint=asked.live, key=asked.key
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._messages.close()
        self._request("scene", name=self._scene, reset=True)

    def samples(self) -> Iterator[Sample]:
        """A sample a frame; where none comes, one that says so, every half second."""
        while True:
            self._hold()
            message = self._messages.recv(_SILENCE_S)
            if isinstance(message, wire.Health):
                self.serial = message.serial or None
            elif isinstance(message, wire.HandFrame) and not message.repeat:
                self._t_ns = max(message.t_ns, self._t_ns)
                yield self._sample(message)
            elif message is None:
                self._t_ns += round(_SILENCE_S * 1e9)
                yield Sample(self._t_ns, alive=False)

    def tare(self) -> str:
        """Take what the pad reads for zero; why not, empty if it was done."""
        (pad,) = self._request("tare", _TARE_S, pads=[self.name])["pads"]
        if not pad["tared"]:
            return str(pad["reason"])
        spread = [std**2 / max(pad["samples"], 1) for std in pad["std_counts"]]
        self.zero = list(pad["offset_counts"]), spread
        return ""

    def apply(self, name: str, law: Law) -> str:
        """Put a law in force; the name of the calibration, as the daemon has it."""
        told = {key: getattr(law, key) for key in ("contact_ohm_mm2", "alpha", "ohm_per_square")}
        return str(self._request("calibrate", pad=self.name, name=name, law=told)["now"])

    @property
    def _scene(self) -> str:
        return f"calibrate {self.name}"[:64]

    def _hold(self) -> None:
        now_s = time.monotonic()
        if now_s - self._leased_s > _LEASE_S / 3:
            self._leased_s = now_s
            outputs = ["location", "strength"]
            self._request(
                "scene", name=self._scene, links=[self.name], outputs=outputs, rate_hz=0, lease_s=_LEASE_S
            )

    def _sample(self, frame: wire.HandFrame) -> Sample:
        row = frame.links.index(self._link)
        columns = client.columns(frame)
        state = wire.PadState(int(columns["state"][row]))
        x, y = columns["pad_m"][row].tolist()
        return Sample(
            frame.t_ns,
            alive=state in (wire.PadState.CLEAR, wire.PadState.TOUCHED),
            touched=state is wire.PadState.TOUCHED,
            current_a=float(columns["current_a"][row]),
            place_m=(x, y),
            force_n=float(columns["force_n"][row]),
        )

    def _request(self, command: str, timeout_s: float = 3.0, **arguments: Any) -> dict[str, Any]:
        asked = self._asked
        return client.request(
            command, endpoint=asked.control, key=asked.key, timeout_s=timeout_s, **arguments
        )
