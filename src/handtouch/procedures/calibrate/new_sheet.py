"""A sheet replaced without its node: what was learned of the old one is set aside.

Public name: `store_new_sheet`.
"""

from __future__ import annotations

import platform
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from handtouch import config
from handtouch.calibration.calibration import NEW_SHEET_METHOD, Calibration, Provenance
from handtouch.calibration.store import Store, StoreError
from handtouch.host.user import program_name


def store_new_sheet(
    path: Path, pad: config.NamedPad, serial: int, default_calibration_id: str, now: datetime
) -> str:
    """Store a version of the node's calibration that has its gains only; return its calibration_id.

    Law, sheet state, learned gaps and waves, and the untouched readings were the old sheet's; they stay in
    older versions. Raises StoreError, also where the newest version isn't this pad's own.
    """
    with Store(path) as store:
        newest = store.newest(serial, default_calibration_id)
        known = newest.calibration if newest is not None else Calibration()
        if newest is not None and not newest.is_own(default_calibration_id):
            raise StoreError(
                f"{pad.name}: version {newest.number} of node {serial} is of another node or other tables, "
                "so its gains can't be kept; calibrate the pad"
            )
        gains = replace(known.gains, parts=None) if known.gains else None
        provenance = Provenance(
            NEW_SHEET_METHOD,
            hand=pad.hand,
            link=pad.pad.link,
            host=platform.node(),
            program=program_name(),
            note=f"after version {newest.number}" if newest is not None else "",
        )
        made = Calibration(gains)
        return store.write(serial, default_calibration_id, made, provenance, now).calibration_id
