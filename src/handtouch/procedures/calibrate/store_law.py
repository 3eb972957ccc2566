"""New versions of a node's calibration: with a measured law, or without what was learned of an old sheet.

Public names: `store_law`, `store_new_sheet`.
"""

from __future__ import annotations

import platform
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from handtouch import config
from handtouch.calibration.calibration import (
    NEW_SHEET_METHOD,
    Calibration,
    Offsets,
    Provenance,
    channel_values,
)
from handtouch.calibration.store import Store, StoreError
from handtouch.host.user import program_name
from handtouch.procedures.calibrate.recording import RecordingHeader
from handtouch.procedures.calibrate.report import CalibrationReport

METHOD = "guided session"
_MAX_NAMED_WEIGHTS = 12


def store_law(
    path: Path,
    pad: config.NamedPad,
    header: RecordingHeader,
    report: CalibrationReport,
    now: datetime,
) -> str:
    """Store the laws measured on a pad in the store at `path`; return its calibration_id.

    Gains and sheet state of the newest version stay, if they are this node's under these tables; offsets are
    those of the tare. Raises StoreError, also for a node without a serial number.
    """
    hand, table = pad
    if header.serial is None:
        raise StoreError(f"{report.pad}: its node has no serial number; a calibration is bound to one")
    fit, second = report.fit, report.second
    names = [row.weight for row in report.weight_errors]
    weights = ", ".join(names) if len(names) <= _MAX_NAMED_WEIGHTS else f"{names[0]} to {names[-1]}"
    provenance = Provenance(
        METHOD,
        contacts=len(fit.residuals),
        residual=fit.misfit,
        hand=hand,
        link=table.link,
        host=platform.node(),
        program=program_name(),
        note=f"weights {weights}; scatter {fit.scatter:.1%}; sheet "
        f"{'' if fit.sheet_observed else 'not '}observed; radius "
        f"{'constant' if fit.law.hertz_force_n is None else 'by Hertz'}, evidence {fit.evidence:+.1f}"
        f"{'' if second is None else f'; second sheet: scatter {second.fit.scatter:.1%}'}",
    )
    with Store(path) as store:
        newest = store.newest(header.serial, header.default_calibration_id)
        own = newest is not None and newest.is_own(header.default_calibration_id)
        known = newest.calibration if newest is not None and own else Calibration()
        offsets = known.offsets
        if len(header.zero) == 2:
            offsets = Offsets(channel_values(header.zero[0]), channel_values(header.zero[1]))
        made = Calibration(
            known.gains, offsets, fit.law, known.sheet, None if second is None else second.fit.law
        )
        return store.write(header.serial, header.default_calibration_id, made, provenance, now).calibration_id


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
