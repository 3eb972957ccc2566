"""A pad as a running daemon serves it: hand frames as samples, tare and calibration by control.

Public names: `DaemonEndpoints`, `ServedPad`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

from handtouch import client, wire
from handtouch.calibration.calibration import LawParameters
from handtouch.client.hand_arrays import SAMPLED_STATES
from handtouch.procedures.calibrate.procedure import PadSample

_RECEIVE_TIMEOUT_S = 0.5
_SCENE_LEASE_S = 60.0
_TARE_TIMEOUT_S = 60.0


@dataclass(frozen=True)
class DaemonEndpoints:
    """Endpoints of a daemon, and its public key."""

    live: str
    control: str
    key: str | None


class ServedPad:
    """The pad `hand`/`link` of a daemon; use it in a `with` block, in which a scene keeps the pad active.

    `active_calibration`: the daemon's answer to `calibrate`. `serial`: of the node, None until known or if
    there is none. `tare_offsets`: mean counts and their variances (4,) of the last tare. `store`: that which
    the daemon reads, None without. second_ampere_per_count: of the channel of the pad's second sheet, None
    without one. Raises what `client.request` does.
    """

    def __init__(
        self, endpoints: DaemonEndpoints, hand: str, link: str, second_ampere_per_count: float | None = None
    ) -> None:
        self.name = f"{hand}/{link}"
        self.active_calibration: dict[str, Any] = {}
        self.serial: int | None = None
        self.tare_offsets: tuple[list[float], list[float]] | None = None
        self.store: Path | None = None
        self._endpoints, self._hand, self._link = endpoints, hand, link
        self._second_ampere_per_count = second_ampere_per_count
        self._second_count, self._second_zero = math.nan, 0.0
        self._sync_ns = 0
        self._lease_renewed_s = -math.inf

    def __enter__(self) -> Self:
        self.active_calibration = self._request("calibrate", pad=self.name)
        if path := self.active_calibration.get("store"):  # of a daemon that may run as another user
            self.store = Path(path)
        self._renew_lease()
        self._messages = client.connect(
            f"hand/{self._hand}",
            f"health/{self._hand}/{self._link}",
            *([] if self._second_ampere_per_count is None else [f"raw/{self._hand}"]),
            endpoint=self._endpoints.live,
            key=self._endpoints.key,
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._messages.close()
        self._request("scene", name=self._scene_name, reset=True)

    def samples(self) -> Iterator[PadSample]:
        """Yield a sample for each frame; without frames, one that is not alive every half second."""
        while True:
            self._renew_lease()
            message = self._messages.recv(_RECEIVE_TIMEOUT_S)
            if isinstance(message, wire.Health):
                self.serial = message.serial or None
            elif isinstance(message, wire.Raw):
                counts = client.columns(message).get("second_counts")
                if counts is not None and len(counts):
                    self._second_count = float(counts[message.links.index(self._link)])
            elif isinstance(message, wire.HandFrame) and not message.retained:
                self._sync_ns = max(message.t_ns, self._sync_ns)
                yield self._sample_from_frame(message)
            elif message is None:
                self._sync_ns += round(_RECEIVE_TIMEOUT_S * 1e9)
                yield PadSample(self._sync_ns, alive=False)

    def tare(self) -> str:
        """Zero the pad; return the reason of a refusal, empty if it was done."""
        (pad,) = self._request("tare", _TARE_TIMEOUT_S, pads=[self.name])["pads"]
        if not pad["tared"]:
            return str(pad["reason"])
        variance = [std**2 / max(pad["samples"], 1) for std in pad["std_counts"]]
        self.tare_offsets = list(pad["offset_counts"]), variance
        self._second_zero = pad.get("second_offset_counts") or 0.0
        return ""

    def apply_laws(self, calibration_id: str, laws: Sequence[LawParameters]) -> str:
        """Apply the laws of the pad's sheets; return the identifier of the active calibration."""
        parameters: dict[str, Any] = {
            name: {key: value for key, value in asdict(law).items() if key != "covariance"}
            for name, law in zip(("law", "second_law"), laws, strict=False)
        }
        answer = self._request("calibrate", pad=self.name, name=calibration_id, **parameters)
        return str(answer["calibration_id"])

    @property
    def _scene_name(self) -> str:
        return f"calibrate {self.name}"[:64]

    def _renew_lease(self) -> None:
        now_s = time.monotonic()
        if now_s - self._lease_renewed_s > _SCENE_LEASE_S / 3:
            self._lease_renewed_s = now_s
            self._request(
                "scene",
                name=self._scene_name,
                links=[self.name],
                outputs=["position", "force", *([] if self._second_ampere_per_count is None else ["raw"])],
                rate_hz=0,
                lease_s=_SCENE_LEASE_S,
            )

    def _sample_from_frame(self, frame: wire.HandFrame) -> PadSample:
        row = frame.links.index(self._link)
        columns = client.columns(frame)
        state = wire.PadState(int(columns["state"][row]))
        x, y = columns["pad_m"][row].tolist()
        return PadSample(
            frame.t_ns,
            alive=state in SAMPLED_STATES,
            touched=state is wire.PadState.TOUCHED,
            current_a=float(columns["total_current_a"][row]),
            position_m=(x, y),
            force_n=float(columns["force_n"][row]),
            second_current_a=(self._second_count - self._second_zero)
            * (self._second_ampere_per_count or math.nan),
        )

    def _request(self, command: str, timeout_s: float = 3.0, **arguments: Any) -> dict[str, Any]:
        endpoint, key = self._endpoints.control, self._endpoints.key
        return client.request(command, endpoint=endpoint, key=key, timeout_s=timeout_s, **arguments)
