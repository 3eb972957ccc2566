"""What becomes of a law: a new version in the calibration store, beside what was known of the unit.

Public name: `store_law`.
"""

from __future__ import annotations

import getpass
import platform
from datetime import UTC, datetime
from pathlib import Path

import handtouch
from handtouch import config
from handtouch.calibrate.record import Head
from handtouch.calibrate.report import Outcome
from handtouch.supervise.calibration import Calibration, Offsets, Provenance, four
from handtouch.supervise.store import Store, StoreError, store_path

METHOD = "guided session"


def store_law(
    path: Path, deployment: config.Deployment, pad: tuple[str, config.Pad], head: Head, outcome: Outcome
) -> str:
    """Store the law of a session on a pad of a hand of the deployment at `path`; the version's name.

    Gains and the sheet's state are kept as they were, if they are this unit's under these tables; offsets
    are those of the zero that was taken. Raises StoreError, also for a unit without a serial number.
    """
    hand, of = pad
    if head.serial is None:
        raise StoreError(f"{outcome.pad}: its node has no serial number; a calibration is bound to one")
    fit = outcome.fit
    weights = ", ".join(row.weight for row in outcome.errors)
    provenance = Provenance(
        METHOD,
        contacts=len(fit.residuals),
        residual=fit.misfit,
        hand=hand,
        link=of.link,
        host=platform.node(),
        program=f"{getpass.getuser()}, handtouch {handtouch.__version__}",
        note=f"weights {weights}; scatter {fit.scatter:.1%}; sheet {'' if fit.observed else 'not '}observed",
    )
    with Store(store_path(deployment.daemon.store, path.parent)) as store:
        newest = store.newest(head.serial, head.nominal)
        own = newest is not None and newest.config == head.nominal and not newest.provenance.foreign
        known = newest.calibration if newest is not None and own else Calibration()
        offsets = known.offsets
        if len(head.zero) == 2:
            offsets = Offsets(four(head.zero[0]), four(head.zero[1]))
        made = Calibration(known.gains, offsets, fit.law, known.sheet)
        return store.write(head.serial, head.nominal, made, provenance, datetime.now(UTC)).name
