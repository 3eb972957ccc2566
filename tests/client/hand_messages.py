"""Messages of a hand with three pads, for tests of clients."""

from __future__ import annotations

from typing import Any

import numpy as np

from handtouch import wire

LINKS = ("thumb_tip", "index_tip", "index_base")


def make_frame(
    seq: int = 1,
    *,
    session: int = 1,
    retained: bool = False,
    links: tuple[str, ...] = LINKS,
    **values: Any,
) -> wire.HandFrame:
    """Return a frame of n links with the given columns, (n,) or (n, elements); the others are NaN or 0."""
    t_ns, hand = values.pop("t_ns", 10**9 + seq), values.pop("hand", "right")
    columns: dict[str, Any] = {}
    for name, column in wire.COLUMNS[wire.HandFrame].items():
        if name not in values and name.split("_")[0] in ("group", "palm", "base", "joints"):
            continue
        given = np.asarray(values.pop(name, np.nan if column.dtype == "<f4" else 0))
        array = np.empty((len(links), column.elements), column.dtype)
        array[:] = given[:, None] if given.ndim == 1 and column.elements == 1 else given
        columns[name] = array.tobytes()
    assert not values, values
    return wire.HandFrame(
        v=1,
        session=session,
        seq=seq,
        t_ns=t_ns,
        tick=seq,
        hand=hand,
        links=links,
        retained=retained,
        **columns,
    )


def make_contact(
    link: str, event: wire.ContactEvent, id: int, seq: int = 1, session: int = 1, hand: str = "right"
) -> wire.Contact:
    """Return a message of a contact."""
    return wire.Contact(
        v=1, session=session, seq=seq, t_ns=seq, event=event, id=id, hand=hand, link=link, frame=link,
        begin_ns=0, duration_s=0.0, age_s=0.0, position_m=None, normal=None, covariance_m2=None, pad_m=None,
        position_status="not_computed", force_n=1.0, force_std_n=0.1, peak_force_n=1.0, force_status="valid",
        total_current_a=1e-6, residual=None, residual_std=None, begin_threshold_n=0.1, end_threshold_n=0.05,
        calibration_id="x", end_reason="released" if event == "end" else "", retained=False,
    )  # fmt: skip


def make_service(seq: int = 1, session: int = 1, **values: Any) -> wire.Service:
    """Return a `service` message of a hand at 200 Hz, with the given fields."""
    return wire.Service(**{
        "v": 1, "session": session, "seq": seq, "t_ns": seq, "wall_offset_ns": 0, "version": "0", "pid": 1,
        "uptime_s": 3.0, "period_s": 0.005, "hands": {"right": list(LINKS)}, "ticks": 600, "overruns": 0,
        "rate_hz": 200.0, "core_compiled": True, "tick_us": {}, "loop": {}, "contacts": 0, "rejected": {},
        "process": {}, "buses": {}, "congestion_episodes": {}, "subscriptions": (), "retained": False,
        **values,
    })  # fmt: skip
